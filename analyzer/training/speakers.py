"""Scenario of speakers: enrolled voices, and `unknown` for other voices."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.home_recordings import (
    HOME,
    HomeSound,
    marked_recordings,
    read_reviewed_sound,
    without_excluded_marks,
)
from hearthlog.analyzer.training.manifest import LABELS, Scenario
from hearthlog.analyzer.training.method import Method
from hearthlog.models.classes import OTHER, SILENCE, SPEECH, UNKNOWN, class_name, find_class
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.schemas.arrays import Float32, Indices
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import CUT
from hearthlog.schemas.messages.topics import LIVE

SPEAKERS = "speakers"
APART = 1800 * NANOSECONDS  # between two enrolments
_LEAST_SECONDS = 10.0  # of a voice
_LEAST_TIMES = 2


def speaker_recordings(folders: Iterable[Path], features: FeatureSet) -> Iterator[Recording]:
    """Read the marks of the voices and of the scenario; each log is a source.

    Enrolled spans of logs are one source if they are less than half an hour apart. Raise `LogError`
    or `DataError` as `hearthlog.analyzer.training.home_recordings.home_recordings` does.
    """
    cut: list[Recording] = []
    for folder in folders:
        of_both = chain.from_iterable(
            read_reviewed_sound(folder, features, scenario) for scenario in ("", SPEAKERS)
        )
        for sound in of_both:
            taught = sound if sound.enrolled else _with_speaker(without_excluded_marks(sound))
            for one in marked_recordings([taught], folder, features, 0.0):
                # `unknown` means undecided in a review, but nobody enrolled in an enrolment.
                label = OTHER if class_name(one.label) == UNKNOWN else one.label
                own = one._replace(label=label, group=f"{HOME} {sound.log.stem}", most=None)
                if sound.log.stem.endswith(CUT):
                    cut.append(own)
                else:
                    yield own
    yield from _by_time(cut)


def _with_speaker(sound: HomeSound) -> HomeSound:
    """Drop `speech` labels that name no speaker."""
    marks = sound.marks
    if sound.labelling == LIVE:
        marks = [mark for mark in marks if class_name(mark.label) != SPEECH]
    return replace(sound, marks=marks)


def _by_time(recordings: Iterable[Recording]) -> Iterator[Recording]:
    """Merge the groups of recordings of a label that are less than half an hour apart."""
    latest: dict[str, tuple[int, str]] = {}  # end and group of each label
    for one in sorted(recordings, key=lambda each: each.span or (0, 0)):
        start, end = one.span or (0, 0)
        before, group = latest.get(one.label, (start - APART, ""))
        if start - before >= APART:
            group = one.group
        latest[one.label] = max(before, end), group
        yield one._replace(group=group)


def is_voice(label: str) -> bool:
    """Return whether a label is a person's name, that is, no class of sound."""
    return find_class(label) is None


def speakers_scenario(recordings: Sequence[Recording]) -> Scenario:
    """Return the scenario of enrolled voices, silence, and `unknown` for the rest.

    Raise `DataError` if no voice is enrolled, or a voice only once or for less than ten seconds.
    """
    groups: dict[str, set[str]] = {}
    seconds: dict[str, float] = {}
    for one in recordings:
        if is_voice(one.label):
            groups.setdefault(one.label, set()).add(one.group)
            total = seconds.get(one.label, 0.0) + len(one.features) * FRAME_SECONDS
            seconds[one.label] = total
    if not groups:
        raise DataError("nobody is enrolled; begin with `hearthlog enrol anna --home voices`")
    for name in sorted(groups):
        if len(groups[name]) < _LEAST_TIMES:
            raise DataError(
                f"{name} is enrolled once: enrol {name} at another time, too, to be tested on "
                "speech that was not learned from"
            )
        if seconds[name] < _LEAST_SECONDS:
            raise DataError(
                f"{name} is enrolled for {seconds[name]:.1f} s: {_LEAST_SECONDS:.0f} s are needed"
            )
    others = tuple(sorted(LABELS - {SILENCE} | {OTHER}))
    names = {name: (name,) for name in sorted(groups)}
    return Scenario(SPEAKERS, {SILENCE: (SILENCE,), **names, UNKNOWN: others})


def others_of(model: Model, method: Method, scenario: Scenario) -> tuple[Float32, Indices]:
    """Return the training windows [shape=(n, width)] of a sound model as silence or unknown.

    Raise `DataError` if the model has not stored training inputs of the kind that the method uses.
    """
    description = model.description
    from hearthlog.analyzer.training.window_methods import (  # noqa: PLC0415  needs scikit-learn
        kept_inputs,
    )

    kept = kept_inputs(model)
    if kept is None or (method.feature_set, method.inputs) != (
        description.feature_set,
        description.inputs,
    ):
        raise DataError(
            f"method {method.name} cannot learn from {model.name} how others sound; use --method "
            f"{description.method}, or give --data with silence and the speech of others"
        )
    inputs, target = kept
    classes = list(scenario.classes)
    numbers = [
        classes.index(SILENCE if class_name(name) == SILENCE else UNKNOWN) for name in model.classes
    ]
    return inputs, np.array(numbers)[target]
