"""`python -m hearthlog.tools.lab.new_classes MANIFEST …`: marks, and classes that a model lacks.

A home is composed of recordings that the model has not learned from. A person corrects the first
minutes of its first two days, in the true class or, of what has none, as `unknown`, which is not
counted, for it teaches nothing. The model that learns from these days as `train --home` does is
judged by the gate a day later, and scored on that third day, of which no source was heard on the
other two.
"""

import csv
import shutil
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan
from hearthlog.analyzer.promotion import judge
from hearthlog.analyzer.promotion.recent_time import RecentLog, recent_logs
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.analyzer.training.manifest import LABELS, read_manifest, scenario_of
from hearthlog.models.classes import OTHER_NEGATIVE, UNKNOWN
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.starter import BATHROOM, GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import LEVELS, LIVING_ROOM, RESIDENT, HomePlan, PlannedSound
from hearthlog.tools.home.simulate import truth_of
from hearthlog.tools.lab.adaptation import wrong_sounds
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.home.person import true_labelling, write_review
from hearthlog.tools.lab.home.recording import record_composition
from hearthlog.tools.lab.labelling import label_logs
from hearthlog.tools.lab.quarter_scores import scored

PLAYED = {  # by starter
    GENERAL: (
        *("speech", "music", "phone_ring", "coughing", "yelling", "objects_activity"),
        *("crying", "laughing", OTHER_NEGATIVE),
    ),
    BATHROOM: (
        *("flushing_water", "tap_water", "shower", "coughing", "speech", "objects_activity"),
        OTHER_NEGATIVE,
    ),
}
MARKS = 10, 30, 60
_START = 1_772_323_200 * NANOSECONDS  # a midnight
_DAY = 86_400 * NANOSECONDS
_SOURCES = 8  # of a class, in each half
_SECONDS = (3.0, 10.0)  # of a sound
_PAUSES = (0.5, 2.0, 6.0)


class Home(NamedTuple):
    """A composed home: its logs, two days and then one, and what is true of them."""

    logs: list[RecentLog]
    truth: Labelling


class Outcome(NamedTuple):
    """What marks taught.

    Attributes
    ----------
    marks : int
    new : list of str
        Classes that the starter lacks.
    before, after : dict of str to float
        F1 of the frames of each class on the third day.
    reasons : tuple of str
        Why the gate refuses the model; empty if it may label.
    notes : list of str
        What `train` says of the marks.
    """

    marks: int
    new: list[str]
    before: dict[str, float]
    after: dict[str, float]
    reasons: tuple[str, ...]
    notes: list[str]


def compose(
    manifests: Sequence[Path],
    model: Path | None,
    seed: int,
    folder: Path,
    scenario: str = GENERAL,
    minutes: float = 25.0,
) -> Home:
    """Compose three short days, labelled by a model, of the labels that two sources have or more.

    Parameters
    ----------
    manifests : sequence of Path
        Of recordings that the model has not heard.
    model : Path or None
        None for the starter of the scenario: then recordings of its sources are left out.
    seed : int
        Another one makes another home, and other halves of the sources.
    folder : Path
        For the logs.
    scenario : str, optional
        What is played: `general` or `bathroom`.
    minutes : float, optional
        Of a day.

    Raises
    ------
    HearthlogError
        If a manifest or a clip of it cannot be used, or the network of the model is not there.
    """
    rng = np.random.default_rng(seed)
    halves = _halves(manifests, PLAYED[scenario], rng, folder, _learned() if model is None else {})
    lacking = {label for half in halves for label in half.made_up}
    labels = [label for label in PLAYED[scenario] if label not in lacking]
    room = LIVING_ROOM if scenario == GENERAL else BATHROOM
    settings = Settings(
        output=folder / "logs", model=model or starter_file(scenario), timezone="UTC"
    )
    truth = []
    for day, library in enumerate((halves[0], halves[0], halves[1])):
        plan = _plan(library, labels, room, rng, minutes)
        composition = Composition(plan, library, Rooms(room, seed))
        start = _START + day * _DAY
        record_composition(composition, settings, start)
        truth.append(true_labelling(truth_of(composition).spans, start))
    joined = Labelling(
        *(np.concatenate([getattr(one, name) for one in truth]) for name in vars(truth[0]))
    )
    return Home(recent_logs([folder / "logs"]), joined)


def _learned() -> set[str]:
    """Name the source groups that the starters have learned from."""
    groups: set[str] = set()
    for name in ("sources.csv", "sources-embedding.csv"):
        with starter_file(GENERAL).with_name(name).open(encoding="utf-8") as file:
            groups |= {row["source_group"] for row in csv.DictReader(file)}
    return groups


def _halves(
    manifests: Sequence[Path],
    labels: Sequence[str],
    rng: np.random.Generator,
    folder: Path,
    learned: Collection[str],
) -> list[ClipLibrary]:
    """Divide the sources that were not learned from, the same number of each label at most."""
    clips = [
        clip
        for manifest in manifests
        for clip in read_manifest(manifest, LABELS, [])
        if clip.label in labels and clip.source_group not in learned
    ]
    half_of: dict[str, int] = {}
    for label in labels:
        groups = sorted({one.source_group for one in clips if one.label == label} - half_of.keys())
        chosen = rng.permutation(groups)[: 2 * _SOURCES]
        half_of |= {str(group): place % 2 for place, group in enumerate(chosen)}
    libraries = []
    for half in range(2):
        path = folder / f"half-{half}.csv"
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("path", "label", "source_group"))
            writer.writerows(
                (one.path.resolve(), one.label, one.source_group)
                for one in clips
                if half_of.get(one.source_group) == half
            )
        libraries.append(ClipLibrary(path))
    return libraries


def _plan(
    library: ClipLibrary, labels: Sequence[str], room: str, rng: np.random.Generator, minutes: float
) -> HomePlan:
    """Lay sounds of all labels one after the other, with short pauses."""
    frames, now = round(60.0 * minutes / FRAME_SECONDS), round(10.0 / FRAME_SECONDS)
    sounds: list[PlannedSound] = []
    while now < frames:
        label = str(rng.choice(labels))
        clips = library.of(label)
        clip = clips[int(rng.integers(len(clips)))]
        length = min(round(rng.uniform(*_SECONDS) / FRAME_SECONDS), clip.frames, frames - now)
        level = rng.uniform(*LEVELS[label])
        sounds.append(PlannedSound(now, length, clip, RESIDENT, room, level, ""))
        now += length + round(rng.choice(_PAUSES) / FRAME_SECONDS)
    return HomePlan(frames, sounds, [])


def taught(home: Home, model: Path, marks: Sequence[int]) -> Iterator[Outcome]:
    """Correct the first two days of a home, learn, judge, and score its third day.

    Parameters
    ----------
    home : Home
    model : Path
        That labelled it.
    marks : sequence of int
        How many sounds are marked as a class, one half of them on each day.

    Yields
    ------
    Outcome

    Raises
    ------
    HearthlogError
        If there is nothing to learn.
    """
    base, (*days, last) = load_model(model), home.logs
    wrong = [wrong_sounds([log], home.truth, log.end, unsure=True) for log in days]
    scenario = scenario_of(base)
    known = {*base.classes} - {UNKNOWN}
    new = sorted(
        label
        for label in {*home.truth.labels} - {OTHER_NEGATIVE}
        if scenario.find(label) not in known
    )
    scale = [name for name in base.classes if name != UNKNOWN] + new
    true = [name if name in scale else scenario.find(name) for name in home.truth.labels]
    truth = replace(home.truth, labels=np.array(true, object))
    for count in marks:
        own = [_first(one, count // 2) for one in wrong]
        with tempfile.TemporaryDirectory(prefix="hearthlog-new-classes-") as place:
            logs = Path(place) / "logs"
            logs.mkdir()
            for log in home.logs[:2]:
                shutil.copy(log.path, logs)
            _write(logs, home.logs, own)
            lessons = read_home_training_set([logs], base)
            shutil.copy(model, place)  # for the gate, which looks for it there
            path = Path(place) / "home-1.safetensors"
            save_model(adapt_model(base, lessons.segments), path)
            adapted = load_model(path)
            shutil.copy(last.path, logs)
            reasons = judge(path.parent, adapted, [logs]).judgement.reasons
        before, after = (
            scored(truth, one).f1(scale) for one in label_logs([base, adapted], [last.path])
        )
        marked = sum(mark.label != UNKNOWN for one in own for mark in one)
        yield Outcome(marked, new, before, after, reasons, lessons.notes)


def _first(marks: Sequence[Mark], count: int) -> list[Mark]:
    """Return the first marks of a class, so many, and the unknown ones before the last of them."""
    if not count:
        return []
    known = np.flatnonzero([mark.label != UNKNOWN for mark in marks])
    return list(marks[: known[count - 1] + 1] if len(known) >= count else marks)


def _write(folder: Path, logs: Sequence[RecentLog], marks: Sequence[Sequence[Mark]]) -> None:
    """Write the marks of each day; what lies between them was looked at and left as it was."""
    for log, own in zip(logs, marks, strict=False):
        if own:
            name = own[0].microphone
            reviewed = ReviewedSpan(name, log.start, own[-1].end)
            write_review(find_coverage(folder)[name], own, reviewed)


def lines_of(outcome: Outcome) -> Iterator[str]:
    """Yield a row of the table, and what `train` and the gate say.

    Parameters
    ----------
    outcome : Outcome
    """
    before, after, new = outcome.before, outcome.after, outcome.new
    gains = {name: after[name] - before[name] for name in before}
    means = (np.mean(list(f1.values())) for f1 in (before, after))
    worst = min(gains, key=lambda name: gains[name])
    yield (
        f"{outcome.marks:5}  {' '.join(f'{mean:.3f}' for mean in means)}  "
        + ", ".join(f"{name} {before[name]:.2f} {after[name]:.2f}" for name in new)
        + f"; least {worst} {before[worst]:.2f} {gains[worst]:+.3f}"
    )
    yield from (f"       train: {note}" for note in outcome.notes)
    yield f"       gate: {'; '.join(outcome.reasons) or 'may label'}"


def main(
    manifests: Annotated[list[Path], typer.Argument(help="Of labelled recordings.")],
    starter: Annotated[str, typer.Option(help="That labels: general or bathroom.")] = GENERAL,
    model: Annotated[
        Path | None,
        typer.Option(help="In its place; it has learned from none of the recordings."),
    ] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Of a home; may be given again.")] = None,
    marks: Annotated[list[int] | None, typer.Option(help="How many; may be given again.")] = None,
) -> None:
    """Print macro F1 before and after marks, F1 of new classes, the largest loss, the verdict."""
    for each in seed or range(3):
        print(
            f"home {each}\nmarks  macro F1     new classes; the class that loses most", flush=True
        )
        with tempfile.TemporaryDirectory(prefix="hearthlog-new-classes-") as place:
            home = compose(manifests, model, each, Path(place), starter)
            for outcome in taught(home, model or starter_file(starter), marks or MARKS):
                print("\n".join(lines_of(outcome)), flush=True)


if __name__ == "__main__":
    run(main)
