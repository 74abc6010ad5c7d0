"""`python -m hearthlog.tools.lab.home DAYS -o FOLDER`: days of a home as logs, and what is true."""

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer

from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.tools.home.clips import SHIPPED, ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import LIVING_ROOM, ROOMS
from hearthlog.tools.home.simulate import reported, truth_of, write_sound, write_truth
from hearthlog.tools.home.sounds import SimulationError
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.days import Habits, plan_days
from hearthlog.tools.lab.home.recording import embedder_of, record_composition

_HOUR_FRAMES = round(3600 / FRAME_SECONDS)


def home(
    days: Annotated[int, typer.Argument(help="From midnight to midnight.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder.")],
    model: Annotated[
        Path | None, typer.Option(help="Model file; without it there are no labels.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Another one makes another home.")] = 0,
    room: Annotated[
        str, typer.Option(help=f"Where the microphone is: {', '.join(ROOMS)}.")
    ] = LIVING_ROOM,
    start: Annotated[
        datetime, typer.Option(formats=["%Y-%m-%d"], help="First day, which is one of UTC.")
    ] = datetime(2026, 3, 1),  # noqa: DTZ001 - typer reads it so
    manifest: Annotated[
        Path, typer.Option(help="Clips to compose of; labels that it lacks are made up.")
    ] = SHIPPED,
    coughs_from: Annotated[
        int | None, typer.Option(help="Day, from 0, from which on nights get worse.")
    ] = None,
    audio: Annotated[
        bool, typer.Option("--audio", help="Write sound, a FLAC file an hour, and no logs.")
    ] = False,
) -> None:
    """Simulate days of a home: logs as its recorder leaves them, and what is true of them."""
    if output.exists():
        raise SimulationError(f"{output}: exists already; name a new folder")
    if audio and model is not None:
        raise SimulationError("--audio writes no logs that --model could label; leave one out")
    if model is not None:
        embedder_of(load_model(model))  # before hours of a home are planned and written
    library = ClipLibrary(manifest)
    if library.made_up:
        print(f"hearthlog: made up without clips: {', '.join(library.made_up)}", file=sys.stderr)
    habits = Habits(seed, start.weekday(), coughs_from)
    composition = Composition(plan_days(days, library, habits), library, Rooms(room, seed))
    start = start.replace(tzinfo=UTC)
    with reported(output):
        output.mkdir(parents=True)
        write_truth(truth_of(composition), output / "truth.txt", output / "events.csv")
        if audio:
            _write_hours(composition, output / "audio", start)
            return
    settings = Settings(output=output / "logs", model=model, timezone="UTC")
    begin = round(start.timestamp()) * NANOSECONDS
    record_composition(composition, settings, begin, progress=_print_progress)


def _write_hours(composition: Composition, folder: Path, start: datetime) -> None:
    folder.mkdir()
    frames = composition.plan.frames
    for first in range(0, frames, _HOUR_FRAMES):
        at = start + timedelta(seconds=first * FRAME_SECONDS)
        path = folder / f"home_{at:%Y%m%dT%H%M%SZ}.flac"
        write_sound(composition, path, first, min(_HOUR_FRAMES, frames - first))
        _print_progress(min(1.0, (first + _HOUR_FRAMES) / frames))


def _print_progress(share: float) -> None:
    if sys.stderr.isatty():
        print(f"\r{share:4.0%}", end="" if share < 1.0 else "\n", file=sys.stderr, flush=True)


if __name__ == "__main__":
    run(home)
