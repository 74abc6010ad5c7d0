"""The command `hearthlog`: its verbs, and how errors reach the user."""

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

# Before numpy is imported: the products here are small, and idle BLAS threads burn a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from hearthlog import __version__
from hearthlog.schemas.errors import HearthlogError, HearthlogWarning
from hearthlog.tools.cli.annotate import annotate
from hearthlog.tools.cli.cat import cat
from hearthlog.tools.cli.cut import cut
from hearthlog.tools.cli.demo import demo
from hearthlog.tools.cli.devices import devices
from hearthlog.tools.cli.diff import diff
from hearthlog.tools.cli.doctor import doctor
from hearthlog.tools.cli.enrol import enrol
from hearthlog.tools.cli.evaluate import evaluate
from hearthlog.tools.cli.export import export
from hearthlog.tools.cli.info import info
from hearthlog.tools.cli.merge import merge
from hearthlog.tools.cli.models import models
from hearthlog.tools.cli.record import record
from hearthlog.tools.cli.recover import recover
from hearthlog.tools.cli.relabel import relabel
from hearthlog.tools.cli.replay import replay
from hearthlog.tools.cli.report import report
from hearthlog.tools.cli.review import review
from hearthlog.tools.cli.text import printable
from hearthlog.tools.cli.train import train
from hearthlog.tools.cli.watch import watch

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for verb in (
    record,
    devices,
    info,
    cat,
    export,
    merge,
    cut,
    doctor,
    recover,
    train,
    enrol,
    evaluate,
    diff,
    review,
    watch,
    report,
    replay,
    relabel,
    demo,
):
    app.command()(verb)
app.add_typer(annotate, name="annotate")
app.add_typer(models, name="models")


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"hearthlog {__version__}")
        raise typer.Exit


@app.callback()
def options(
    *,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", is_eager=True, callback=_print_version
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show where in the code an error came from.")
    ] = False,
) -> None:
    """Listen to a home: sound to features and labels, in logs that anyone can open."""
    del version  # shown by now
    _debug["on"] = debug


_debug = {"on": False}


def main() -> None:
    """Run the command line; an error is one line, and exit status 1."""
    try:
        with _warnings_shown():
            app()
    except (HearthlogError, ModuleNotFoundError) as error:
        if _debug["on"]:
            raise
        message = str(error)
        if isinstance(error, ModuleNotFoundError):
            from hearthlog.analyzer.extras import remedy

            message = f"{error.name} is not installed; {remedy(error.name or '')}"
        print(f"hearthlog: {message}", file=sys.stderr)
        sys.exit(1)


@contextmanager
def _warnings_shown() -> Iterator[None]:
    """Print each of our warnings once, in one line; with one, what is done is done with 3."""
    shown: set[str] = set()
    others = warnings.showwarning

    def show(message: Any, *about: Any, **more: Any) -> None:
        if not isinstance(message, HearthlogWarning):
            others(message, *about, **more)
        elif str(message) not in shown:
            shown.add(str(message))
            print(f"hearthlog: {printable(f'{message.where}: {message}')}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", HearthlogWarning)
        warnings.showwarning = show
        try:
            yield
        except SystemExit as end:
            if shown and not end.code:
                sys.exit(3)
            raise


if __name__ == "__main__":
    main()
