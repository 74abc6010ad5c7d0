"""What is true of a composed home: the label of every frame, and the sounds one by one."""

import csv
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.tools.home.composition import Composition, HeardSound
from hearthlog.tools.home.plan import PlannedSound
from hearthlog.tools.home.routine import DAY_FRAMES

LabelledSpan = tuple[float, float, str]  # seconds from the start, and the label

_AUDIBLE_DB = 0.0  # over what is steady
_PLANNED = ("start", "end", "label", "from", "room", "activity", "clip", "source_group", "made_up")
_HEARD = ("level_dbfs", "heard_seconds")
_TINY = 1e-30


class Event(NamedTuple):
    """A planned sound, and what the microphone hears of it.

    Attributes
    ----------
    level : float
        Of its loudest frame as it is heard, in dBFS.
    """

    plan: PlannedSound
    level: float
    heard_frames: int


class Truth(NamedTuple):
    """What is true of a composition.

    Attributes
    ----------
    spans : list of LabelledSpan
        Without gaps: a frame has the label of the loudest sound that is audible in it, which is
        that as loud as all steady noise; silence where there is none.
    """

    spans: list[LabelledSpan]
    events: list[Event]


def truth_of(composition: Composition) -> Truth:
    """Tell the truth of a composition, without composing its sound."""
    events: list[Event] = []
    runs: list[tuple[int, int, str]] = []
    held: list[tuple[int, HeardSound]] = []  # that go on from one day to the next
    for first in range(0, composition.plan.frames, DAY_FRAMES):
        count = min(DAY_FRAMES, composition.plan.frames - first)
        begun = enumerate(composition.heard(first, count), start=len(events))
        here = [*held, *begun]
        events += [_event(sound) for _, sound in here[len(held) :]]
        loudest = _loudest(here, composition.floor_power(first, count), first)
        for number, frames in zip(*np.unique(loudest, return_counts=True), strict=True):
            if number >= 0:
                event = events[number]
                events[number] = event._replace(heard_frames=event.heard_frames + int(frames))
        labels = [SILENCE, *(event.plan.clip.label for event in events)]
        for begin, end, number in _runs(loudest):
            runs.append((first + begin, first + end, labels[number + 1]))
        held = [one for one in here if one[1].plan.start + len(one[1].power) > first + count]
    return Truth(_spans(runs), events)


def write_truth(truth: Truth, spans: Path, events: Path) -> None:
    """Write a label track for Audacity, and a table of the sounds.

    Raise `OSError` if one cannot be written.
    """
    with spans.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{start:.6f}\t{end:.6f}\t{label}\n" for start, end, label in truth.spans)
    with events.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*_PLANNED, *_HEARD))
        writer.writerows(_row(event) for event in truth.events)


def _row(event: Event) -> tuple[object, ...]:
    plan = event.plan
    return (
        f"{plan.start * FRAME_SECONDS:.2f}",
        f"{plan.end * FRAME_SECONDS:.2f}",
        plan.clip.label,
        plan.origin,
        plan.room,
        plan.activity,
        plan.clip.name,
        plan.clip.source_group,
        "yes" if plan.clip.path is None else "no",
        f"{event.level:.1f}",
        f"{event.heard_frames * FRAME_SECONDS:.2f}",
    )


def _event(sound: HeardSound) -> Event:
    return Event(sound.plan, float(10.0 * np.log10(sound.power.max() + _TINY)), 0)


def _loudest(sounds: list[tuple[int, HeardSound]], floor: Float64, first: int) -> Int64:
    """Return the number of the loudest audible sound of each frame, -1 where there is none."""
    power = floor * 10.0 ** (_AUDIBLE_DB / 10.0)
    loudest = np.full(len(floor), -1)
    for number, sound in sounds:
        begin = sound.plan.start - first
        here = slice(max(begin, 0), min(begin + len(sound.power), len(floor)))
        its = sound.power[here.start - begin : here.stop - begin]
        louder = its > power[here]
        power[here][louder] = its[louder]
        loudest[here][louder] = number
    return loudest


def _runs(values: Int64) -> Iterator[tuple[int, int, int]]:
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    for begin, end in pairwise(edges):
        yield begin, end, int(values[begin])


def _spans(runs: list[tuple[int, int, str]]) -> list[LabelledSpan]:
    """Join runs of one label."""
    spans: list[LabelledSpan] = []
    for begin, end, label in runs:
        start = begin * FRAME_SECONDS
        if spans and spans[-1][2] == label:
            start = spans.pop()[0]
        spans.append((start, end * FRAME_SECONDS, label))
    return spans
