"""The command `hearthlog`: its verbs, and how errors reach the user."""

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

from hearthlog.schemas.blas import kernel_environment

# Before numpy is imported: the products here are small, and idle BLAS threads burn a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.update(kernel_environment())

import typer

from hearthlog import __version__
from hearthlog.schemas.errors import HearthlogError, HearthlogWarning
from hearthlog.tools.cli.alerts import alerts
from hearthlog.tools.cli.annotate import annotate
from hearthlog.tools.cli.bridge import bridge
from hearthlog.tools.cli.cat import cat
from hearthlog.tools.cli.catalog import catalog
from hearthlog.tools.cli.config import config
from hearthlog.tools.cli.cut import cut
from hearthlog.tools.cli.demo import demo
from hearthlog.tools.cli.devices import devices
from hearthlog.tools.cli.diff import diff
from hearthlog.tools.cli.doctor import doctor
from hearthlog.tools.cli.enrol import enrol
from hearthlog.tools.cli.evaluate import evaluate
from hearthlog.tools.cli.export import export
from hearthlog.tools.cli.info import info
from hearthlog.tools.cli.install_service import install_service
from hearthlog.tools.cli.manifest import manifest
from hearthlog.tools.cli.merge import merge
from hearthlog.tools.cli.models import models
from hearthlog.tools.cli.output import OutputClosedError, checked_output
from hearthlog.tools.cli.pause import pause, resume
from hearthlog.tools.cli.record import record
from hearthlog.tools.cli.recover import recover
from hearthlog.tools.cli.relabel import relabel
from hearthlog.tools.cli.replay import replay
from hearthlog.tools.cli.report import report
from hearthlog.tools.cli.retain import retain
from hearthlog.tools.cli.review import ReviewCommand, review
from hearthlog.tools.cli.text import tell
from hearthlog.tools.cli.train import train
from hearthlog.tools.cli.watch import watch

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_ON_LOGS = (
    record,
    pause,
    resume,
    install_service,
    devices,
    info,
    catalog,
    cat,
    export,
    merge,
    cut,
    doctor,
    recover,
    retain,
)
_LEARNING = (manifest, train, enrol)
_NAMED = 10  # of many files with the same fault
for verb in (*_ON_LOGS, *_LEARNING, diff, review, watch, bridge, report, replay, relabel, demo):
    app.command(cls=ReviewCommand if verb is review else None)(verb)
app.add_typer(alerts, name="alerts")
app.add_typer(annotate, name="annotate")
app.add_typer(config, name="config")
app.add_typer(evaluate, name="evaluate")
app.add_typer(models, name="models")


def _print_version(shown: bool) -> None:
    if shown:
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
    """Run the command line; with a warning of ours, what is done is done with exit status 3."""
    with checked_output(), _warnings_shown() as warned:
        status = _status_of(lambda: app(prog_name="hearthlog", standalone_mode=False))
        status = _status_of(sys.stdout.flush) or status
    sys.exit(status or (3 if warned else 0))


def _status_of(step: Callable[[], Any]) -> str | int | None:
    """Return the exit status of a step; an error is one line, and exit status 1 or 2."""
    try:
        return step()
    except SystemExit as end:
        return end.code
    except typer.TyperException as error:
        if error.format_message():  # else it has shown the help
            tell(_usage_text(error))
        return error.exit_code
    except OutputClosedError:
        return 0  # `| head` has seen enough
    except (HearthlogError, ModuleNotFoundError, OSError) as error:
        if _debug["on"]:
            raise
        tell(_message(error))
        return error.status if isinstance(error, HearthlogError) else 1


def _usage_text(error: typer.TyperException) -> str:
    context = getattr(error, "ctx", None)
    verb = "hearthlog" if context is None else context.command_path
    text = error.format_message().rstrip(".").replace(": Value error,", ":")
    return f"{text[0].lower()}{text[1:]}; see `{verb} --help`"


def _message(error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError):
        from hearthlog.analyzer.extras import remedy

        return f"{error.name} is not installed; {remedy(error.name or '')}"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


@contextmanager
def _warnings_shown() -> Iterator[dict[str, set[str]]]:
    """Print our warnings, and collect for each text the files, or others, that it is about."""
    warned: dict[str, set[str]] = {}
    others = warnings.showwarning

    def show(message: Any, *arguments: Any, **options: Any) -> None:
        if not isinstance(message, HearthlogWarning):
            others(message, *arguments, **options)
            return
        places = warned.setdefault(str(message), set())
        if not places or (message.each and str(message.where) not in places):
            places.add(str(message.where))
            if len(places) <= _NAMED:
                tell(f"{message.where}: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", HearthlogWarning)
        warnings.showwarning = show
        yield warned
        for text, places in warned.items():
            if len(places) > _NAMED:
                tell(f"and {len(places) - _NAMED:,} more: {text}")


if __name__ == "__main__":
    main()
