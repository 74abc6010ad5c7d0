"""`hearthlog enrol`: seconds of a sound into the home's own training set."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.schemas.errors import HearthlogError
from hearthlog.tools.cli.options import End, Start, parse_span
from hearthlog.tools.cli.text import end_with_warnings, tell, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.marks.enrol import Enrolled


def enrol(
    label: Annotated[str, typer.Argument(metavar="CLASS", help="What is heard.")],
    *,
    home: Annotated[Path, typer.Option(help="Folder of the home's training set.")],
    file: Annotated[
        list[Path] | None, typer.Option(help="Audio file to enrol; may be given again.")
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="Log, or folder of logs, to enrol a span of.", readable=False),
    ] = None,
    start: Start = None,
    end: End = None,
    microphone: Annotated[
        str | None, typer.Option(help="Microphone to listen to, as `hearthlog devices` lists it.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="How much of a file (default: all) or of a microphone (default: 5)."),
    ] = None,
) -> None:
    """Take seconds of a sound from a file, a log or a microphone to learn from.

    Features are kept, and no sound: a log in the folder `enrolled` of the home, all of it marked.
    Exit status 3: a file was damaged, or of several some could not be enrolled.
    """
    from hearthlog.analyzer.marks import enrol as enrolment

    least, most = enrolment.LEAST_SECONDS, enrolment.MOST_SECONDS
    if sum(given not in {None, ()} for given in (tuple(file or ()), log, microphone)) != 1:
        wrong_use("enrol one of --file, --log with --start and --end, or --microphone")
    if seconds is not None and not least <= seconds <= most:
        wrong_use(f"--seconds {seconds}: enrol from {least:.0f} to {most:.0f} s")
    if log is None and (start, end) != (None, None):
        wrong_use("--start and --end go with --log")
    first, last = parse_span(start, end)
    refused: list[str] = []
    if file:
        done = _enrol_files(home, label, file, seconds, refused)
    elif log is None:
        seconds = seconds or enrolment.SECONDS
        listening = partial(tell, f"listening for {seconds:g} s")
        done = enrolment.enrol_microphone(home, label, microphone or "", seconds, listening)
    elif first is None or last is None or seconds is not None:
        wrong_use("--log wants --start and --end, and no --seconds")
    else:
        done = [enrolment.enrol_log(home, label, log, first, last)]
    for enrolled in done:
        print(f"{enrolled.log}: {enrolled.seconds:.2f} s of {label}")
    end_with_warnings([*refused, *dict.fromkeys(each.warning for each in done if each.warning)])


def _enrol_files(
    home: Path, label: str, files: list[Path], seconds: float | None, refused: list[str]
) -> "list[Enrolled]":
    """Enrol several files; say why some are not enrolled, unless none is."""
    from hearthlog.analyzer.marks.enrol import enrol_file

    done: list[Enrolled] = []
    for path in files:
        try:
            done += enrol_file(home, label, path, seconds)
        except HearthlogError as error:
            if len(files) == 1:
                raise
            text = str(error)
            refused.append(text if str(path) in text else f"{path}: {text}")
    if not done:
        raise HearthlogError("; ".join(refused))
    return done
