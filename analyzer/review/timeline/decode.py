"""What a timeline takes of logs: topics, fields, and what is made of them."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hearthlog.analyzer.review.timeline.model import FrameValues, LabelledSpans, SoundClip, no_spans
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import REVIEW, TopicName, parse_topic

_KINDS = {"features", "label", "segment", "gap"}
FIELDS = {
    message_types.FEATURES: ("header.stamp", "values"),
    message_types.LABEL: ("header.stamp", "novelty", "probabilities"),
    message_types.SEGMENT: ("header.stamp", "duration", "label"),
    message_types.GAP: ("header.stamp", "duration", "reason"),
    message_types.DIAGNOSTICS: ("header.stamp", "header.frame_id", "status"),
    message_types.LOG: ("stamp", "level", "msg"),
}
_QUIETEST = 1e-10  # of a mean square: -100 dB


def shown_topic(name: str) -> TopicName | None:
    """Return the parts of a topic that has a part in the timeline; marks are read otherwise."""
    topic = parse_topic(name)
    if topic is None or topic.kind not in _KINDS or topic.labelling == REVIEW:
        return None
    return topic


def decibel(energy: Any) -> Any:
    """Return the level of a mean square, in dB relative to full scale."""
    return 10 * np.log10(np.maximum(energy, _QUIETEST))


def spans_of(columns: Columns, text: str) -> LabelledSpans:
    """Return the spans that segments or gaps are about; `text` is the field that is shown."""
    starts = columns["header.stamp"]
    return LabelledSpans(starts, starts + columns["duration"], columns[text])


def runs(parts: Sequence[FrameValues], after: int) -> Iterator[LabelledSpans]:
    """Join successive frames whose most probable class is the same, from some time on."""
    for names, all_times, all_values in parts:
        later = all_times >= after
        times, values = all_times[later], all_values[later]
        if not len(times):
            continue
        best = values.argmax(axis=1)
        broken = np.diff(times, prepend=times[0]) > 1.5 * FRAME_NANOSECONDS
        first = np.flatnonzero(broken | (np.diff(best, prepend=-1) != 0))
        last = np.append(first[1:], len(times)) - 1
        texts = np.array(names, object)[best[first]]
        yield LabelledSpans(times[first], times[last] + FRAME_NANOSECONDS, texts)


def lasting(troubles: Sequence[tuple[int, str]], end: int) -> LabelledSpans:
    """Let a trouble last until the next message says that it is over, or that it is another."""
    changes = [
        (stamp, text)
        for (stamp, text), (_, before) in zip(troubles, [(0, ""), *troubles], strict=False)
        if text != before
    ]
    stops = [*(stamp for stamp, _ in changes[1:]), end]
    spans = [(a, b, text) for (a, text), b in zip(changes, stops, strict=False) if text and a < b]
    if not spans:
        return no_spans()
    starts, ends, texts = zip(*spans, strict=True)
    return LabelledSpans(np.array(starts), np.array(ends), np.array(texts, object))


def chained(parts: Sequence[SoundClip]) -> list[SoundClip]:
    """Join what follows each other."""
    clips: list[list[SoundClip]] = []
    for part in sorted(parts, key=lambda clip: clip.start):
        last = clips[-1][-1] if clips else None
        if last and last.rate == part.rate and abs(part.start - last.end) < FRAME_NANOSECONDS:
            clips[-1].append(part)
        else:
            clips.append([part])
    return [
        SoundClip(run[0].start, run[0].rate, np.concatenate([part.samples for part in run]))
        for run in clips
    ]
