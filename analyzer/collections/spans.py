"""Sounds of one file, as parts of it that have one label each."""

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from hearthlog.analyzer.collections.clip import Sound
from hearthlog.analyzer.collections.label_map import BROAD, SEVERAL, Decision, LabelMap

_SHORTEST = 1.0  # seconds, from which `train` cuts a segment

_Span = tuple[float, float]


class Part(NamedTuple):
    """A part of a file with one label; `end` is infinite for the rest of the file."""

    label: str
    detail: str
    start: float
    end: float


def labelled_parts(
    sounds: Sequence[Sound], seconds: float, label_map: LabelMap
) -> tuple[list[Part], Counter[tuple[str, str]]]:
    """Return the parts of a file in which one label is heard alone.

    A sound shorter than a second is extended evenly to one. What overlaps a sound of another label,
    or of one that the map leaves out, is left out; what overlaps a sound of the same label is
    joined with it.

    Parameters
    ----------
    seconds : float
        Length of the file; infinite if it is not known.
    """
    decided = [(sound, label_map.decide(sound.categories)) for sound in sounds]
    told = [(sound, what) for sound, what in decided if what.reason != BROAD]
    covered: dict[str, list[_Span]] = {}
    for sound, what in told:
        covered.setdefault(what.label, []).append((sound.start, sound.end))
    joined = {label: _joined(spans) for label, spans in covered.items()}
    alone: dict[str, list[tuple[_Span, str]]] = {}
    left_out: Counter[tuple[str, str]] = Counter()
    for sound, what in decided:
        span = _extended(sound, seconds)
        reason = what.reason or _reason(span, what, joined)
        if reason:
            left_out[reason, what.detail] += 1
        else:
            alone.setdefault(what.label, []).append((span, what.detail))
    parts = []
    for label, heard in alone.items():
        spans = _joined(span for span, _ in heard)
        names: list[set[str]] = [set() for _ in spans]
        for span, detail in heard:
            names[bisect_right(spans, (span[0], math.inf)) - 1].add(detail)
        parts += [
            Part(label, " + ".join(sorted(details)), *span)
            for span, details in zip(spans, names, strict=True)
        ]
    return parts, left_out


def _extended(sound: Sound, seconds: float) -> _Span:
    missing = _SHORTEST - (sound.end - sound.start)
    if missing <= 0:
        return sound.start, sound.end
    start = max(0.0, min(sound.start - missing / 2, seconds - _SHORTEST))
    return start, start + _SHORTEST


def _reason(span: _Span, what: Decision, joined: Mapping[str, list[_Span]]) -> str:
    others = (spans for label, spans in joined.items() if label != what.label)
    return SEVERAL if any(_overlaps(span, spans) for spans in others) else ""


def _overlaps(span: _Span, others: list[_Span]) -> bool:
    """Whether a span overlaps one of others, which are sorted and overlap nowhere."""
    place = bisect_left(others, (span[1],))
    return place > 0 and others[place - 1][1] > span[0]


def _joined(spans: Iterable[_Span]) -> list[_Span]:
    """Sort spans, and join those that touch or overlap."""
    joined: list[_Span] = []
    for start, end in sorted(spans):
        if joined and start <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(end, joined[-1][1])
        else:
            joined.append((start, end))
    return joined
