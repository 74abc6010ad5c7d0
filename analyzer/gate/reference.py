"""What is known of the sounds of a home: marks, and what was looked at and left as it was."""

from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.labelling import Labellings, find_labellings
from hearthlog.analyzer.logs.spans import Spans, joined, remains
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, read_marks, read_reviewed
from hearthlog.models.classes import UNKNOWN, class_name
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE, relabelling

_SHORTEST = NANOSECONDS // 2  # sound that counts
_REMAINS = 2 * NANOSECONDS  # what is shorter beside a mark is the marked sound, not cut exactly
_FOLLOWING = 3  # logs: a segment is in the one in which it ends


class Sound(NamedTuple):
    """A sound whose label is known.

    Attributes
    ----------
    random : bool
        Whether it is of time that was drawn at random, and not chosen.
    """

    start: int
    end: int
    label: str
    random: bool
    microphone: str


def reference(log: Path, following: Sequence[Path] = ()) -> list[Sound]:
    """Return the sounds of a log whose labels are known.

    Returns
    -------
    list of Sound
        Of half a second or more, by the start; first those of time that was drawn at random.

    Raises
    ------
    LogError
        If its review layer is damaged, or what was looked at has gone.
    """
    marks, drawn = read_marks(log), _drawn(read_reviewed(log))
    labellings = find_labellings(log, *following[:_FOLLOWING]) if drawn else Labellings([])
    inside = [sound for span in drawn for sound in _true(labellings, span, marks)]
    others = [
        Sound(mark.start, mark.end, mark.label, random=False, microphone=mark.microphone)
        for mark in marks
        if class_name(mark.label) != UNKNOWN  # whoever marked it could not tell
        and not any(_inside(mark, span) for span in drawn)
    ]
    return [sound for sound in [*inside, *others] if sound.end - sound.start >= _SHORTEST]


def left_alone(log: Path) -> list[Sound]:
    """Return the sounds of a log that a person looked at, not by chance, and did not mark.

    Returns
    -------
    list of Sound
        Of half a second or more, and of two beside a mark; none of what cannot be read.
    """
    sounds: list[Sound] = []
    with suppress(DataError, LogError):
        marks = read_marks(log)
        spans = [span for span in read_reviewed(log) if span.chosen != RANDOM]
        labellings = find_labellings(log) if spans else Labellings([])
        for span in spans:
            with suppress(DataError, LogError):
                marked = {(mark.start, mark.end) for mark in marks}
                edges = {edge for mark in marked for edge in mark}
                sounds += [
                    sound._replace(random=False)
                    for sound in _parts(labellings, span, marks)
                    if (sound.start, sound.end) not in marked
                    and sound.end - sound.start >= _least(sound, edges)
                ]
    return sounds


def _least(sound: Sound, edges: AbstractSet[int]) -> int:
    """Return how long a sound has to be to count."""
    return _SHORTEST if edges.isdisjoint((sound.start, sound.end)) else _REMAINS


def _true(labellings: Labellings, span: ReviewedSpan, marks: Iterable[Mark]) -> Iterator[Sound]:
    """Yield what is true of a reviewed span: the labelling, and the marks over it.

    What touches and has one label is one sound, however it was marked.
    """
    parts: dict[str, list[Sound]] = {}
    for part in _parts(labellings, span, marks):
        parts.setdefault(class_name(part.label), []).append(part)
    for same in parts.values():
        spans = spans_of([(part.start, part.end) for part in same])
        for start, end in zip(*(edge.tolist() for edge in spans), strict=True):
            yield same[0]._replace(start=start, end=end)


def _parts(labellings: Labellings, span: ReviewedSpan, marks: Iterable[Mark]) -> Iterator[Sound]:
    known = partial(Sound, random=True, microphone=span.microphone)
    own = [m for m in marks if m.microphone == span.microphone and _inside(m, span)]
    for mark in own:
        if class_name(mark.label) != UNKNOWN:
            yield known(max(mark.start, span.start), min(mark.end, span.end), mark.label)
    corrects = LIVE if span.corrects == LIVE else relabelling(span.corrects)
    name = labellings.find(span.microphone, corrects)
    labels = labellings.read(span.microphone, name, span.start, span.end).labelling
    rest, row = remains(labels, spans_of([(mark.start, mark.end) for mark in own]))
    for start, end, label in zip(rest.starts, rest.ends, labels.labels[row], strict=True):
        yield known(int(start), int(end), str(label))


def _drawn(reviewed: Iterable[ReviewedSpan]) -> list[ReviewedSpan]:
    return [span for span in reviewed if span.chosen == RANDOM]


def _inside(mark: Mark, span: ReviewedSpan) -> bool:
    return mark.start < span.end and mark.end > span.start


def spans_of(times: Sequence[tuple[int, int]], pause: int = 0) -> Spans:
    """Join spans of time that overlap or are no more than a pause apart."""
    array = np.array(times, np.int64).reshape(-1, 2)
    return joined(array[:, 0], array[:, 1], pause)
