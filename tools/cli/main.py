"""Entry point of `hearthlog`: subcommands and error handling."""

import gc
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from inspect import getdoc
from typing import Annotated, Any

from hearthlog.schemas.blas import kernel_environment

# Before the import of numpy: products here are small, and idle BLAS threads burn a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.update(kernel_environment())
# A search through all installed distributions, whose plugins no recorder should load.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


@contextmanager
def _ended_by_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process without a traceback while a block imports modules."""
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


with _ended_by_interrupt():
    import typer
    from typer.core import TyperArgument, TyperOption

    from hearthlog import __version__
    from hearthlog.schemas.errors import HearthlogError, HearthlogWarning
    from hearthlog.schemas.files import denied_text, is_denied
    from hearthlog.tools.cli.terminal import OutputClosedError, checked_output, print_notice

# In help order; each is a function, or an app of its own, in the module of its name.
PANELS = {
    "Every day": (
        *("record", "devices", "info", "watch", "events", "report", "pause", "resume", "demo"),
    ),
    "A model of the home": (
        *("review", "train", "enrol", "discover", "voices", "relabel", "models", "annotate"),
    ),
    "House and service": ("setup", "bridge", "install_service", "retain", "alerts", "config"),
    "Files": ("doctor", "recover", "cat", "export", "cut", "merge", "catalog"),
    "Research": ("replay", "diff", "manifest", "evaluate"),
}
VERBS = tuple(verb for panel in PANELS.values() for verb in panel)
_MODULES = {  # subcommands that share a module
    "alerts": "bridge",
    "catalog": "info",
    **dict.fromkeys(("cat", "cut", "merge"), "export"),
    **dict.fromkeys(
        ("config", "devices", "install_service", "pause", "resume", "retain"), "recorder"
    ),
    "diff": "relabel",
    "enrol": "annotate",
    "manifest": "train",
    "recover": "doctor",
    "replay": "relabel",
    "report": "events",
    "voices": "discover",
}
_TYPES = {"str": "TEXT", "int": "NUMBER", "float": "NUMBER"}
_TYPES |= dict.fromkeys(("Path", "path", "file", "directory"), "PATH")
_NAMED = 10  # files named per fault
_WORDS = (  # replacements for messages of the option parser
    (re.compile(r"Input should be greater than or equal to "), "it must be at least "),
    (re.compile(r"Input should be less than or equal to "), "it must be at most "),
    (re.compile(r"Input should be a valid integer, .*"), "it must be a whole number"),
    (re.compile(r"Input should be a valid number, .*"), "it must be a number"),
    (re.compile(r"Input should be (a valid )?"), "it must be "),
)
_debug = {"on": False}


def make_app(verbs: Iterable[str] = VERBS) -> typer.Typer:
    """Return the app with some subcommands; only their modules are imported."""
    app = typer.Typer(
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)
    for verb in verbs:
        module = import_module(f"hearthlog.tools.cli.{_MODULES.get(verb, verb)}")
        command = getattr(module, verb)
        panel = next(panel for panel, inside in PANELS.items() if verb in inside)
        if isinstance(command, typer.Typer):
            for one in command.registered_commands:
                one.help = _without_line_breaks(one.callback)
            app.add_typer(command, name=verb, rich_help_panel=panel)
        else:
            own, text = getattr(module, "COMMAND_CLASS", None), _without_line_breaks(command)
            app.command(cls=own, help=text, rich_help_panel=panel)(command)
    return app


def _without_line_breaks(function: Any) -> str:
    """Join the lines of each paragraph of a docstring; the help wraps them to the window."""
    return "\n\n".join(" ".join(part.split()) for part in (getdoc(function) or "").split("\n\n"))


def _option_type(option: TyperOption, ctx: Any) -> str | None:
    """Return a readable type for an option, where typer shows the Python type."""
    if option.is_flag:
        return None
    if option.metavar is not None:
        return option.metavar
    shown = option.display_type(ctx).strip("<>")
    kind = shown.removeprefix("list[").removesuffix("]").split()[0]
    return _TYPES.get(kind, shown)


setattr(TyperOption, "display_type_rich", _option_type)  # noqa: B010  for mypy, which knows another
setattr(TyperArgument, "display_type_rich", lambda *_, **_options: None)  # noqa: B010  named so


def _print_version(shown: bool) -> None:
    if shown:
        print(f"hearthlog {__version__}")
        raise typer.Exit


def _options(
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
    del version  # already shown
    _debug["on"] = debug


def main() -> None:
    """Run the command line; a warning turns exit status 0 into 3."""
    gc.set_threshold(10_000, 20, 20)  # modules are no garbage: the default costs 10 % of the start
    if sys.stdin is None:  # closed by the parent process
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: PTH123, SIM115
    verbs = _wanted_verbs()
    if "install_service" not in verbs:  # units are world-readable
        os.umask(0o077)  # data of a home is private
    with _ended_by_signals(), checked_output(), _warnings_shown() as warned:
        with _ended_by_interrupt():
            app = make_app(verbs)
        status = _status_of(lambda: app(prog_name="hearthlog", standalone_mode=False))
        status = _status_of(sys.stdout.flush) or status
    sys.exit(status or (3 if warned else 0))


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise an error in the block, so that temporary files are removed.

    Subcommands with other needs set handlers of their own.
    """

    def end(number: int, _: object) -> None:
        sys.exit(128 + number)

    ours = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGTERM, signal.SIGHUP] if ours else []
    numbers = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _wanted_verbs() -> Iterable[str]:
    """Return the subcommand of the command line; all without one, as for help and completion."""
    for word in sys.argv[1:]:
        if word.replace("-", "_") in VERBS:
            return [word.replace("-", "_")]
        if word not in {"--debug", "--version"}:
            break
    return VERBS


def _status_of(step: Callable[[], Any]) -> str | int | None:
    """Return the exit status of a step; an error prints one line, and gives exit status 1 or 2."""
    try:
        return step()
    except SystemExit as end:
        return end.code
    except typer.TyperException as error:
        if error.format_message():  # otherwise the help was shown
            print_notice(_usage_text(error))
        return error.exit_code
    except OutputClosedError:
        return 0  # the reader has closed the pipe, as in `| head`
    except (HearthlogError, ModuleNotFoundError, OSError) as error:
        if _debug["on"]:
            raise
        print_notice(*(getattr(error, "lines", None) or [_message(error)]))
        return error.status if isinstance(error, HearthlogError) else 1


def _usage_text(error: typer.TyperException) -> str:
    context = getattr(error, "ctx", None)
    verb = "hearthlog" if context is None else context.command_path
    text = error.format_message().rstrip(".").replace(": Value error,", ":")
    for form, words in _WORDS:
        text = form.sub(words, text)
    return f"{text[0].lower()}{text[1:]}; see `{verb} --help`"


def _message(error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError) and not isinstance(error, HearthlogError):
        from hearthlog.analyzer.errors import missing

        return missing(error.name or "")
    if isinstance(error, PermissionError) and is_denied(error.filename or ""):
        return f"{error.filename}: {denied_text(error.filename)}"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


@contextmanager
def _warnings_shown() -> Iterator[dict[str, set[str]]]:
    """Print hearthlog's warnings, and collect the files (or other subjects) of each text."""
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
                print_notice(f"{message.where}: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", HearthlogWarning)
        warnings.showwarning = show
        yield warned
        for text, places in warned.items():
            if len(places) > _NAMED:
                print_notice(f"and {len(places) - _NAMED:,} more: {text}")


if __name__ == "__main__":
    main()
