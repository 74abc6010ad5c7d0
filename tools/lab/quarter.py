"""`python -m hearthlog.tools.lab.quarter FOLDER`: a quarter of a home, reviewed every week.

Every week the recorder labels with the model of the week before, a person reviews for some minutes,
a model is learned from all marks, and may label if it is let.
"""

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hearthlog.analyzer.logs.labelling import Labelling, find_labellings
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.home.clips import SHIPPED, ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import DAY_FRAMES, LIVING_ROOM, HomePlan
from hearthlog.tools.home.simulate import truth_of
from hearthlog.tools.home.sounds import SimulationError
from hearthlog.tools.lab.bench.timing import HEARTHLOG
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.days import Habits, plan_days
from hearthlog.tools.lab.home.microphones import NarrowRooms
from hearthlog.tools.lab.home.person import Person, true_labelling
from hearthlog.tools.lab.home.recording import record_composition
from hearthlog.tools.lab.labelling import label_logs
from hearthlog.tools.lab.quarter_picture import line_of, save_picture
from hearthlog.tools.lab.quarter_scores import MICROPHONE_WEEK, WRONG_WEEK, Week, scored

Part = tuple[int, HomePlan]  # of a week: its first frame, and what sounds
_MINUTES = 10.0  # of review a week
_DAY = DAY_FRAMES * FRAME_NANOSECONDS
_STRETCH = DAY_FRAMES // 24


@dataclass(frozen=True)
class Home:
    """A home whose quarter is simulated.

    Attributes
    ----------
    folder : Path
        For its logs and models; new.
    weeks : sequence of list of (int, Plan)
        For each week what is recorded, and its first frame in the week.
    library : ClipLibrary
        That they are made of.
    seed : int
    start : int
        Time at which the first week begins, in nanoseconds of UTC.
    """

    folder: Path
    weeks: Sequence[list[Part]]
    library: ClipLibrary
    seed: int
    start: int


def live(home: Home) -> Iterator[Week]:
    """Live week by week: record, score, review, learn, promote.

    Parameters
    ----------
    home : Home

    Yields
    ------
    Week
        As it ends; what a command says that fails is in it.
    """
    (home.folder / "models").mkdir(parents=True)
    logs = home.folder / "logs"
    for number, parts in enumerate(home.weeks, start=1):
        begin = home.start + (number - 1) * 7 * _DAY
        end = begin + 7 * _DAY
        model = _champion(home.folder)
        truth, recorded = _record(home, number, parts, begin, model)
        sources = find_labellings(logs)
        microphone = sources.microphone(None)
        labels = sources.read(microphone, LIVE, begin, end).labelling
        alone = starter_file(GENERAL)
        starter = labels if model == alone else next(label_logs([load_model(alone)], recorded))
        wrong, models = float(number == WRONG_WEEK), home.folder / "models"
        person = Person(truth, wrong=wrong, seed=home.seed, models=models)
        done = person.review(logs, _MINUTES, end, (begin, end))
        trained, promoted, lines = _learn(home.folder)
        yield Week(
            number,
            model.stem,
            scored(truth, labels),
            scored(truth, starter),
            round(done.seconds / 60.0, 2),
            len(done.marks),
            sum(span.chosen != RANDOM for span in done.reviewed),
            sum(span.chosen == RANDOM for span in done.reviewed),
            trained,
            promoted,
            lines,
        )


def _champion(folder: Path) -> Path:
    champion = folder / "models" / "champion.safetensors"
    return champion.resolve() if champion.exists() else starter_file(GENERAL)


def _record(
    home: Home, number: int, parts: list[Part], begin: int, model: Path
) -> tuple[Labelling, list[Path]]:
    """Record a week; return what is true of it, and its logs."""
    rooms = (NarrowRooms if number == MICROPHONE_WEEK else Rooms)(LIVING_ROOM, home.seed)
    settings = Settings(output=home.folder / "logs", model=model, timezone="UTC")
    truths, logs = [], []
    for first, plan in parts:
        start = begin + first * FRAME_NANOSECONDS
        composition = Composition(plan, home.library, rooms)
        logs += record_composition(composition, settings, start)
        truths.append(true_labelling(truth_of(composition).spans, start))
    arrays = ("starts", "ends", "labels")
    return Labelling(*(np.concatenate([getattr(t, a) for t in truths]) for a in arrays)), logs


def _learn(folder: Path) -> tuple[bool, bool, list[str]]:
    """Learn a model of the home, and let it label; return whether both came to pass."""
    models, champion = folder / "models", _champion(folder)
    before = {*models.glob("home-*.safetensors")}
    lines = _run_command(folder, "train", "--home", "logs")
    made = {*models.glob("home-*.safetensors")} - before
    for model in made:
        lines += _run_command(folder, "models", "promote", model.stem)
    return bool(made), _champion(folder) != champion, lines


def _run_command(folder: Path, *arguments: str) -> list[str]:
    """Run the command in a folder, as a person there would, and return its lines."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("HEARTHLOG_")}
    done = subprocess.run(  # noqa: S603  ours
        [*HEARTHLOG, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return [*done.stdout.splitlines(), *done.stderr.splitlines()]


def plan_quarter(weeks: int, library: ClipLibrary, seed: int) -> list[list[Part]]:
    """Plan a home, and choose what is recorded: each week two hours in which the most is heard.

    Parameters
    ----------
    weeks : int
    library : ClipLibrary
    seed : int

    Returns
    -------
    list of list of (int, Plan)
        For each week the first frame in it, and the plan, of each of two hours: together they have
        the most labels of all.

    Raises
    ------
    SimulationError
        If there is no week.
    """
    period = plan_days(7 * weeks, library, Habits(seed))
    labels: list[set[str]] = [set() for _ in range(period.frames // _STRETCH)]
    for sound in period.sounds:
        labels[sound.start // _STRETCH].add(sound.clip.label)
    count = 7 * DAY_FRAMES // _STRETCH
    quarter = []
    for begin in range(0, len(labels), count):
        pairs = combinations(range(begin, begin + count), 2)
        best = max(pairs, key=lambda pair: len(labels[pair[0]] | labels[pair[1]]))
        quarter.append([((at - begin) * _STRETCH, _part(period, at * _STRETCH)) for at in best])
    return quarter


def _part(plan: HomePlan, first: int) -> HomePlan:
    """Return a stretch of a plan, without the sounds that go on at its ends."""
    end = first + _STRETCH
    sounds = [
        replace(sound, start=sound.start - first)
        for sound in plan.sounds
        if first <= sound.start and sound.end <= end
    ]
    steady = [
        replace(noise, start=noise.start - first, end=noise.end - first)
        for noise in plan.steady
        if noise.start < end and noise.end > first
    ]
    return HomePlan(_STRETCH, sounds, steady)


def quarter(
    folder: Annotated[Path, typer.Argument(help="New folder, for the home and the figures.")],
    weeks: Annotated[int, typer.Option(min=1)] = 13,
    seed: Annotated[int, typer.Option(help="Another one makes another home.")] = 0,
    manifest: Annotated[Path, typer.Option(help="Clips to compose of.")] = SHIPPED,
) -> None:
    """Live a quarter of a home; write `quarter.jsonl`, a line for each week, and `quarter.png`."""
    if folder.exists():
        raise SimulationError(f"{folder}: exists already; name a new folder")
    library = ClipLibrary(manifest)
    start = round(datetime(2026, 3, 1, tzinfo=UTC).timestamp()) * NANOSECONDS
    home = Home(folder, plan_quarter(weeks, library, seed), library, seed, start)
    done = []
    for week in live(home):
        done.append(week)
        with (folder / "quarter.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(week)) + "\n")
        print(line_of(week), flush=True)
    save_picture(folder / "quarter.png", done)


if __name__ == "__main__":
    run(quarter)
