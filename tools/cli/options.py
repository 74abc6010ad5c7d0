"""Options and arguments shared by several subcommands, and their parsing."""

import getpass
from contextlib import suppress
from datetime import date, datetime, timedelta, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import read_time
from hearthlog.schemas.new_files import check_new
from hearthlog.tools.cli.terminal import wrong_use

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from hearthlog.analyzer.logs.home_logs import HomeLogs
    from hearthlog.analyzer.training.manifest import LabelledClip, SkippedClip
    from hearthlog.analyzer.training.method import Method

_LAST = (1 << 63) - 1  # log time

METHOD = "embedding where its network is, else room"
METHODS = (
    "How to learn: embedding (room with the embeddings of a network), room, room21 (the 21 "
    "features of auros21), bands, paper, svm (the inputs of room, a support vector machine), or "
    "the method of another distribution: see docs/classifiers.md."
)


def log_location(text: str) -> Path:
    """Parse the path of a log or folder, or a store URL."""
    if "://" not in text:
        return Path(text)
    from hearthlog.analyzer.logs.locations import location

    return location(text)


LOG_HELP = "A log, or a folder of logs, or a URL such as s3://bucket/home."


def logs_folder() -> str:
    """Return the recorder's folder: `logs`, unless the environment names another."""
    from hearthlog.recorder.config import load_settings

    return str(load_settings(None, {}, {}).output)


IN_LOGS: dict[str, Any] = {"default_factory": logs_folder, "show_default": "logs"}
_EACH_IN_LOGS: dict[str, Any] = {"default_factory": lambda: [logs_folder()], "show_default": "logs"}
_ANY_LOGS = "Logs, or folders of logs, or URLs such as s3://bucket/home."

# Readability is checked on access, with better messages than typer's.
Log = Annotated[Path, typer.Argument(help=LOG_HELP, parser=log_location, **IN_LOGS)]
LocalLog = Annotated[
    Path, typer.Argument(help="A log, or a folder of logs.", readable=False, **IN_LOGS)
]
Logs = Annotated[list[Path], typer.Argument(help=_ANY_LOGS, parser=log_location, **_EACH_IN_LOGS)]
LocalLogs = Annotated[
    list[Path], typer.Argument(help="Logs, or folders of logs.", readable=False, **_EACH_IN_LOGS)
]
LogsFolder = Annotated[
    Path, typer.Argument(help="Folder of a recorder's logs.", readable=False, **IN_LOGS)
]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topics", help="Topic, or pattern such as '/mic/*'; may be repeated."),
]
Start = Annotated[
    str | None,
    typer.Option(
        metavar="TIME",
        help="First log time, such as 2026-03-01T07:00 (UTC unless it has an offset).",
    ),
]
End = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Log time of the end, exclusive."),
]
RetentionDays = Annotated[
    int | None,
    typer.Option(
        help="Delete logs older than this many days with recordings.",
        show_default="no limit",
    ),
]
MaxBagFiles = Annotated[
    int | None,
    typer.Option(help="Delete the oldest logs beyond this number.", show_default="no limit"),
]
MaxRecordSize = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Delete the oldest logs beyond this total size, such as 20G.",
        show_default="no limit",
    ),
]
MinFreeSpace = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Delete the oldest logs while the disk has less free space; 0: never.",
        show_default="500M",
    ),
]
NewLog = Annotated[Path, typer.Option("--output", "-o", help="New log, *.mcap.")]
Microphone = Annotated[
    str | None, typer.Option(help="Name of the microphone, if there are several.")
]
Timezone = Annotated[
    str | None,
    typer.Option(
        help="Time zone of the home, such as Europe/Vienna.",
        show_default="the zone in the logs, else UTC",
    ),
]
CLIPS = "Manifest of labelled clips (CSV), or the folder of a manifest.csv."
Clips = Annotated[Path, typer.Option(help=CLIPS)]
SCENARIO = "Classes: bathroom, general, or a TOML file."
OwnScenario = Annotated[
    str | None, typer.Option(help=SCENARIO, show_default="the scenario of the (first) model")
]
Day = Annotated[
    str | None,
    typer.Option(
        help="Such as 2026-03-01, today or yesterday; by default the last complete day in the logs."
    ),
]
Labels = Annotated[str, typer.Option(help="Labelling: live, or the model of a relabel layer.")]
RecorderConfiguration = Annotated[
    Path | None, typer.Option(help="Configuration of the recorder, a TOML file.")
]
Scheduler = Annotated[
    str | None, typer.Option(help="Dask cluster to work on, such as tcp://host:port.")
]
Plot = Annotated[Path | None, typer.Option(help="Picture to write, *.png.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def manifest_path(path: Path) -> Path:
    """Return the manifest at a path, or in the folder at the path."""
    return path / "manifest.csv" if path.is_dir() else path


def labelled_clips(
    data: "Sequence[Path]", labels: "Collection[str]", left_out: "list[SkippedClip]"
) -> "list[LabelledClip]":
    """Read manifests, or folders with one; collect unusable entries in `left_out`."""
    from hearthlog.analyzer.training.manifest import read_manifest

    paths = map(manifest_path, data)
    return [clip for path in paths for clip in read_manifest(path, labels, left_out)]


def home_and_zone(logs: "Sequence[Path]", timezone: str | None) -> "tuple[HomeLogs, tzinfo]":
    """Find the logs of a home, and its time zone: the given one, else that in the logs."""
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone

    home = find_home_logs(logs)
    return home, home_zone(timezone, home.records())


def models_folder(given: Path | None = None) -> Path:
    """Return the model folder: the given one, the folder of the configured model, or `models`."""
    from hearthlog.models.registry import DEFAULT_FOLDER
    from hearthlog.models.starter import STARTERS
    from hearthlog.recorder.config import NO_MODEL, load_settings

    if given is not None:
        return given
    configured = load_settings(None, {}, {}).model
    if configured in {None, NO_MODEL, *map(Path, STARTERS)}:
        return DEFAULT_FOLDER
    assert configured is not None
    return configured.parent


def starter_here(model: Path) -> Path:
    """Return the model for a name; a starter is resolved by the installed network."""
    from hearthlog.models.modelfile import starter_for
    from hearthlog.recorder.config import load_settings
    from hearthlog.recorder.labelling.embedder_probe import likely_network

    return starter_for(model, likely_network(load_settings(None, {}, {}).embedding))


def starter_of(model: Path, logs: "Iterable[Path]") -> Path:
    """Return the model for a name; a starter is resolved by the embeddings in the logs.

    All logs get one model, so that the labelling has one name: without embeddings it is about as
    accurate as the other starter.
    """
    from hearthlog.analyzer.logs.recorder_info import first_embedding_source
    from hearthlog.models.classifiers.classifier import Classifier
    from hearthlog.models.modelfile import load_model, starter_for
    from hearthlog.models.starter import NETWORK
    from hearthlog.schemas.logs.files import find_logs

    other = starter_for(model, NETWORK)
    if other == model:
        return model
    classifier = Classifier(load_model(other))
    for path in logs:
        with suppress(LogError):  # reported where the logs are read
            for log in reversed(find_logs(path)):
                with suppress(LogError):
                    if classifier.takes_embeddings(first_embedding_source(log)):
                        return other
    return model


def check_output(option: str, path: Path | None, suffix: str, what: str) -> None:
    """End with the exit status of wrong use unless a new file may have this name.

    Raise `LogError` if the file exists.
    """
    if path is None:
        return
    if path.suffix != suffix:
        wrong_use(f"{option} {path}: {what} is named *{suffix}")
    check_new(path)


def parse_time(text: str, option: str) -> int:
    """Parse a time, in nanoseconds of UTC; invalid text ends with wrong use."""
    try:
        return read_time(text)
    except ValueError:
        wrong_use(f"{option} {text}: not a time such as 2026-03-01T07:00")


def parse_span(start: str | None, end: str | None) -> tuple[int | None, int | None]:
    """Parse the options --start and --end, in nanoseconds of UTC."""
    first = None if start is None else min(max(parse_time(start, "--start"), 0), _LAST)
    last = None if end is None else min(max(parse_time(end, "--end"), 0), _LAST)
    if first is not None and last is not None and first >= last:
        wrong_use(f"--end {end} is not after --start {start}")
    return first, last


_YEARS = range(1970, 2200)
NEAR = {"today": 0, "yesterday": 1}  # days before today


def read_day(option: str, text: str, zone: tzinfo) -> date:
    """Parse a day of a home; invalid text ends with wrong use."""
    if text in NEAR:
        return datetime.now(zone).date() - timedelta(days=NEAR[text])
    return read_date(option, text)


def read_date(option: str, text: str) -> date:
    """Parse a date, or a week as its Monday; invalid text ends with wrong use."""
    try:
        found = date.fromisoformat(text)
    except ValueError:
        found = date.min
    if found.year not in _YEARS:
        of_week = option == "--week"
        example = "2026-W09, or a day in it" if of_week else "2026-03-01, today or yesterday"
        wrong_use(f"{option} {text}: not a {option[2:]} such as {example}")
    return found


def scenario_files(given: list[str] | None) -> dict[str, Path]:
    """Parse values of `--scenario`: model files by scenario name."""
    files: dict[str, Path] = {}
    for text in given or ():
        name, equals, file = text.partition("=")
        if not (name and equals and file):
            wrong_use(f"--scenario {text[:80]!r}: say NAME=FILE, the name and its model file")
        if name in files:
            wrong_use(f"--scenario {name}: given twice; each scenario has one model")
        files[name] = Path(file)
    return files


def chosen_method(name: str | None, **parameters: float | None) -> "Method":
    """Return a training method with the given parameters.

    By default it is the best one, without a network if the recorder disables networks.
    """
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.training.train import DEFAULT, default_method, method_named
    from hearthlog.recorder.config import load_settings
    from hearthlog.recorder.labelling.embedder_probe import NO_NETWORK

    chosen = {key: value for key, value in parameters.items() if value is not None}
    for key, value in chosen.items():
        if not 0 < value < float("inf"):
            wrong_use(f"--{key} {value:g}: it must be more than 0")
    try:
        if name is not None:
            method = method_named(name)
        elif load_settings(None, {}, {}).embedding == NO_NETWORK:
            method = DEFAULT
        else:
            method = default_method()
        return method.with_parameters(chosen)
    except DataError as error:
        wrong_use(str(error))


def reviewer_name(option: str | None) -> str:
    """Return the reviewer's name; empty without an option and a login name."""
    from hearthlog.analyzer.marks.marks import PERSON_NAME

    if option is not None:
        name = option.strip()
        if not name or not PERSON_NAME.fullmatch(name):
            wrong_use(f"--reviewer {option[:64]!r}: a name has 1 to 200 characters, in one line")
        return name
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        return ""
    return name if PERSON_NAME.fullmatch(name) else ""
