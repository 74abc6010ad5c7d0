"""The command `hearthlog`: its verbs, and how errors reach the user."""

import os
import sys
from typing import Annotated

# Before numpy is imported: the products here are small, and idle BLAS threads burn a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from schemas.errors import HearthlogError
from tools.cli.annotate import annotate
from tools.cli.cat import cat
from tools.cli.cut import cut
from tools.cli.demo import demo
from tools.cli.devices import devices
from tools.cli.diff import diff
from tools.cli.doctor import doctor
from tools.cli.enrol import enrol
from tools.cli.evaluate import evaluate
from tools.cli.export import export
from tools.cli.info import info
from tools.cli.merge import merge
from tools.cli.models import models
from tools.cli.record import record
from tools.cli.recover import recover
from tools.cli.relabel import relabel
from tools.cli.replay import replay
from tools.cli.report import report
from tools.cli.review import review
from tools.cli.train import train
from tools.cli.watch import watch

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
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


@app.callback()
def options(
    *,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show where in the code an error came from.")
    ] = False,
) -> None:
    """Listen to a home: sound to features and labels, in logs that anyone can open."""
    _debug["on"] = debug


_debug = {"on": False}


def main() -> None:
    """Run the command line; an error is one line, and exit status 1."""
    try:
        app()
    except (HearthlogError, ModuleNotFoundError) as error:
        if _debug["on"]:
            raise
        message = str(error)
        if isinstance(error, ModuleNotFoundError):
            message = f"{error.name} is not installed; try: pip install 'hearthlog[analyzer]'"
        print(f"hearthlog: {message}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
