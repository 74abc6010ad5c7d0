"""Doubtful labels: loud or worrying sounds of no sure class, and steady sound labelled quiet."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.checked_minutes import UNSURE_BELOW
from hearthlog.analyzer.activity.event_counts import MINUTE, events_and_confidences
from hearthlog.analyzer.logs.labelling import Labelling, in_order
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.logs.spans import NONE, Spans, joined, lengths, rows_at
from hearthlog.models.classes import (
    COUNTED_IF_SURE,
    IMPORTANT,
    SILENCE,
    TELEVISION,
    UNKNOWN,
    WORRYING,
    class_name,
)
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns

_LISTED = frozenset({*IMPORTANT, SILENCE, TELEVISION})  # labels that need no doubt
_NO_MAJORITY_BELOW = 0.5  # confidence
_LOUD_DB = 30.0  # above the quiet around: household sounds reach 25, a scream in the room 45
_NAMED, _LIKELY = 0.1, 0.25  # probability to name a class; to list a sound that is not loud
_MOST = 100  # events of which frames are read, the least sure first
_AROUND = 10 * NANOSECONDS  # before and after an event, for the level of the quiet
_DELAY = 10 * NANOSECONDS  # longest from a frame to its label
_QUIET = 10  # percentile of the levels around
_SECOND = 20  # frames
_TINY = 1e-12
_LOUDER_DB = 8.0  # than the quiet around, steady sound: a refrigerator adds about 3, a shower 14
_QUIET_MINUTES = 60  # before and after
_SHORTEST = 3 * MINUTE  # steady sound
_PAUSE = MINUTE  # with another sound in it
_QUIET_SHARE = 0.75  # of a quiet minute
_FIELDS = "header.stamp", "label", "probabilities", "values"


class DoubtfulSound(NamedTuple):
    """An event of which the model is not sure."""

    label: str
    start: int
    end: int
    level_db: float  # of its loudest second above the quiet around; -inf if unknown
    probabilities: Mapping[str, float]  # mean probability of each of `WORRYING` that the model has

    @property
    def is_loud(self) -> bool:
        """Whether it was much louder than household sounds are."""
        return self.level_db >= _LOUD_DB

    def needs_review(self, hidden: Collection[str] = (), near: Collection[str] = ()) -> bool:
        """Whether a person should review it: it was loud, or is likely coughing or crying.

        A sound that is not loud needs no review if all it may be sounded just before or after it
        (`near`): were it of that class, both would be one event.
        """
        if not self.is_loud and {*near}.issuperset(perhaps([self], hidden)):
            return False
        likely = (
            share >= _LIKELY for name, share in self.probabilities.items() if name not in hidden
        )
        return self.label not in hidden and (self.is_loud or any(likely))


def perhaps(sounds: Collection[DoubtfulSound], hidden: Collection[str] = ()) -> list[str]:
    """Return which of `WORRYING` some sounds might be, the most probable first.

    A model that lacks one of them gives its probability to the others, so these must be likely.
    """
    has_all = all(name in sound.probabilities for sound in sounds for name in WORRYING)
    least = _NAMED if has_all else _LIKELY
    probabilities = {
        name: max(sound.probabilities.get(name, 0.0) for sound in sounds)
        for name in WORRYING
        if name not in hidden
    }
    return [
        name
        for name in sorted(probabilities, key=lambda n: -probabilities[n])
        if probabilities[name] >= least
    ]


def has_no_majority(label: str, confidence: float) -> bool:
    """Whether no class has most of the probability of an event, unless it is listed anyway."""
    return confidence < _NO_MAJORITY_BELOW and class_name(label) not in _LISTED


def is_too_doubtful(label: str, confidence: float) -> bool:
    """Whether an event that nobody reviewed is in no count, because the model is not sure."""
    return confidence < UNSURE_BELOW and class_name(label) in COUNTED_IF_SURE


def without_too_doubtful(labels: Labelling, reviewed: Spans = NONE) -> Labelling:
    """Call events that are too doubtful to count `unknown`, outside of reviewed spans."""
    names = labels.labels.copy()
    for name in COUNTED_IF_SURE:
        events, highest = events_and_confidences(labels, name)
        unsure = (highest < UNSURE_BELOW) & (rows_at(reviewed, events.starts) < 0)
        spans = Spans(events.starts[unsure], events.ends[unsure])
        names[(labels.labels == name) & (rows_at(spans, labels.starts) >= 0)] = UNKNOWN
    return replace(labels, labels=names)


def doubtful_events(labels: Labelling) -> Labelling:
    """Return the events that are in doubt, with the highest confidence of their segments."""
    parts = []
    for name in sorted(set(labels.labels[labels.confidences < _NO_MAJORITY_BELOW])):
        events, highest = events_and_confidences(labels, name)
        rows = [has_no_majority(name, confidence) for confidence in highest.tolist()]
        names = np.full(sum(rows), name, object)
        parts.append(Labelling(events.starts[rows], events.ends[rows], names, highest[rows]))
    return in_order([labels.rows(np.zeros(len(labels), bool)), *parts])


def read_doubtful_sounds(
    logs: Iterable[tuple[Path, int, int]], topics: tuple[str, str], events: Labelling
) -> list[DoubtfulSound]:
    """Read level and probabilities of at most a hundred doubtful events, in time order.

    Each log, or layer with the labels, has start and end in nanoseconds of UTC; topics are of the
    labels and of the features. Events without readable labels are left out.
    """
    logs, found = list(logs), []
    for row in np.sort(np.argsort(events.confidences, kind="stable")[:_MOST]).tolist():
        start, end = int(events.starts[row]), int(events.ends[row])
        first, last = start - _AROUND, end + _AROUND + _DELAY
        paths = [path for path, begin, stop in logs if begin < last and stop > first]
        try:
            columns = read_columns(paths, topics, first, last, _FIELDS)
        except LogError:
            continue  # as without labels
        labels, features = map(columns.get, topics)
        probabilities = None if labels is None else _probabilities(labels, start, end)
        if probabilities is not None:
            level = -inf if features is None else _level(features, start, end)
            found.append(DoubtfulSound(str(events.labels[row]), start, end, level, probabilities))
    return found


def _probabilities(labels: Columns, start: int, end: int) -> dict[str, float] | None:
    """Return the mean probabilities of `WORRYING` in the frames with sound; None without any."""
    names = [class_name(name) for name in array_names(labels.metadata, "probabilities")]
    own = labels.take(np.flatnonzero(_inside(labels, start, end) & (labels["label"] != SILENCE)))
    probabilities = own["probabilities"]
    if not len(own) or probabilities.shape[1:] != (len(names),):
        return None
    mean = probabilities.mean(axis=0, dtype=np.float64).tolist()
    return {
        name: sum(share for own, share in zip(names, mean, strict=True) if own == name)
        for name in WORRYING
        if name in names
    }


def _level(features: Columns, start: int, end: int) -> float:
    """Return the level of the loudest second of an event above the quiet around, in dB."""
    energy = _energy_of(features, "values")
    if energy is None or not len(own := energy[_inside(features, start, end)]):
        return -inf
    frames = min(_SECOND, len(own))
    loudest = np.convolve(own, np.full(frames, 1 / frames), "valid").max()
    return _decibels(loudest) - _decibels(np.percentile(energy, _QUIET))


def _inside(columns: Columns, start: int, end: int) -> Bool:
    stamps = columns["header.stamp"]
    inside: Bool = (stamps >= start) & (stamps < end)
    return inside


def _decibels(energy: Float64 | float) -> float:
    return float(10.0 * np.log10(np.maximum(energy, _TINY)))


def read_steady_sound(
    logs: Iterable[Path], topic: str, quiet: Spans, start: int, end: int
) -> Spans:
    """Return when a microphone recorded steady sound, from the statistics of its features.

    A model that does not know water, fans or machines labels their steady sound as quiet.

    Parameters
    ----------
    topic : str
        Of the statistics.
    quiet : Spans
        Labelled quiet.
    start, end : int
        Nanoseconds of UTC, of a day.
    """
    parts = [part for log in logs if (part := _read_energies(log, topic, start, end)) is not None]
    if not parts:
        return NONE
    times = np.concatenate([times for times, _ in parts])
    energy = np.concatenate([energy for _, energy in parts])
    return steady_sound(times, energy, quiet) if len(times) else NONE


def steady_sound(times: Int64, energy: Float64, quiet: Spans) -> Spans:
    """Return the steady sound among quiet minutes.

    Parameters
    ----------
    times : numpy.ndarray
        [shape=(n,)] in nanoseconds of UTC, in order.
    energy : numpy.ndarray
        [shape=(n,)] mean square of the sound of about a second.
    quiet : Spans
        Labelled quiet.
    """
    minutes, firsts = np.unique(times // MINUTE, return_index=True)
    edges = np.arange(minutes[0], minutes[-1] + 2) * MINUTE
    is_quiet = lengths(quiet, edges)[minutes - minutes[0]] >= _QUIET_SHARE * MINUTE
    if not is_quiet.any():
        return NONE
    middles = np.array([np.median(part) for part in np.split(energy, firsts[1:])])
    levels = 10 * np.log10(np.maximum(middles, _TINY))
    minutes, levels = minutes[is_quiet], levels[is_quiet]
    # A street may be 10 dB louder by day than at night: compared is the quiet of two hours around.
    padded = np.pad(
        levels, _QUIET_MINUTES, mode="symmetric" if len(levels) >= _QUIET_MINUTES else "edge"
    )
    around = np.median(
        np.lib.stride_tricks.sliding_window_view(padded, 2 * _QUIET_MINUTES + 1), axis=1
    )
    starts = minutes[levels >= around + _LOUDER_DB] * MINUTE
    spans = joined(starts, starts + MINUTE, _PAUSE)
    long = spans.ends - spans.starts >= _SHORTEST
    return Spans(spans.starts[long], spans.ends[long])


def _read_energies(log: Path, topic: str, start: int, end: int) -> tuple[Int64, Float64] | None:
    """Return log times, which lie in the span, and mean energies; None if there are none."""
    try:
        columns = read_columns([log], [topic], start, end, ["mean"]).get(topic)
    except LogError:
        return None  # as without statistics
    energy = None if columns is None else _energy_of(columns, "mean")
    return None if columns is None or energy is None else (columns.log_times, energy)


def _energy_of(columns: Columns, field: str) -> Float64 | None:
    """Return the energies among the features in a field; None without them."""
    names, values = array_names(columns.metadata, field), columns[field]
    if "energy" not in names or values.shape[1:] != (len(names),):
        return None
    energy: Float64 = values[:, names.index("energy")].astype(np.float64)
    return energy
