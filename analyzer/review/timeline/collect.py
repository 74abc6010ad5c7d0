"""Rows of messages, collected on the grid of a timeline."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.recorder_info import MicrophoneHealth, lasting
from hearthlog.analyzer.logs.sound_vectors import degrees_of
from hearthlog.analyzer.marks.marks import Reviewed, ReviewedSpan
from hearthlog.analyzer.review.timeline.decode import (
    ENERGY,
    DirectionRows,
    FeatureRows,
    GapRows,
    LabelRows,
    Rows,
    SegmentRows,
    StateRows,
    decibel,
)
from hearthlog.analyzer.review.timeline.grid import Grid, GridMeans
from hearthlog.analyzer.review.timeline.model import (
    FrameValues,
    GridSeries,
    LabelledSpans,
    LabellingTimeline,
    LogLines,
    MicrophoneTimeline,
    SoundClip,
    no_spans,
)
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE, is_review, review_labelling


@dataclass
class _NamedMeans:
    """Means of rows whose columns may differ from log to log."""

    grid: Grid
    means: dict[tuple[str, ...], GridMeans] = field(default_factory=dict)

    def add(self, names: tuple[str, ...], times: Int64, values: NDArray[np.floating]) -> None:
        self.means.setdefault(names, GridMeans(self.grid, len(names))).add(times, values)

    def series(self) -> GridSeries | None:
        """Bring all rows to the same columns; None without rows."""
        if not self.means:
            return None
        names = tuple(dict.fromkeys(name for names in self.means for name in names))
        values = np.full((self.grid.count, len(names)), np.nan)
        for own, means in self.means.items():
            part = means.values
            present = ~np.isnan(part[:, 0])
            columns = [names.index(name) for name in own]
            values[np.flatnonzero(present)[:, np.newaxis], columns] = part[present]
        return GridSeries(names, values)


@dataclass
class _Microphone:
    """What is collected of a microphone."""

    features: _NamedMeans
    level_frames: list[FrameValues] = field(default_factory=list)
    labels: dict[str, _NamedMeans] = field(default_factory=dict)
    label_frames: dict[str, list[FrameValues]] = field(default_factory=dict)
    novelty: dict[str, GridMeans] = field(default_factory=dict)
    spans: dict[str, list[LabelledSpans]] = field(default_factory=dict)
    reviewed: dict[str, list[LabelledSpans]] = field(default_factory=dict)  # by scenario
    gaps: list[LabelledSpans] = field(default_factory=list)
    directions: GridMeans | None = None  # ahead and left
    states: list[MicrophoneHealth] = field(default_factory=list)
    clips: list[SoundClip] = field(default_factory=list)
    logs: set[Path] = field(default_factory=set)

    @property
    def is_empty(self) -> bool:
        return not any((self.features.means, self.labels, self.spans, self.gaps, self.clips))

    @property
    def labellings(self) -> list[str]:
        """The names of its labellings: the recorder's first, the reviewer's last."""
        names = {*self.labels, *self.spans}
        return sorted(names, key=lambda name: (is_review(name), name != LIVE, name))


class Collector:
    """Collects the rows of logs, one after the other in the order of time."""

    def __init__(self, grid: Grid, *, sampled: bool, frames: bool) -> None:
        self._grid = grid
        self._sampled = sampled
        self._frames = frames
        self._microphones: dict[str, _Microphone] = {}
        self._lines: list[LogLines] = []

    def add(self, rows: Rows) -> None:
        """Add the rows of one topic, in the order of time.

        Parameters
        ----------
        rows : Rows
            At least one, of any kind.
        """
        match rows:
            case LogLines():
                self._lines.append(rows)
            case StateRows():
                for state in rows.states:
                    self._microphone(state.microphone).states.append(state)
            case FeatureRows():
                self._add_features(rows)
            case LabelRows():
                self._add_labels(rows)
            case SegmentRows():
                self._spans(rows.microphone, rows.labelling).append(rows.spans)
                self._forget_frames(rows.microphone, rows.labelling)
            case GapRows():
                self._microphone(rows.microphone).gaps.append(rows.spans)
            case DirectionRows():
                microphone = self._microphone(rows.microphone)
                if microphone.directions is None:
                    microphone.directions = GridMeans(self._grid, 2)
                microphone.directions.add(rows.times, rows.directions)

    def add_log(self, microphone: str, log: Path) -> None:
        """Note that a log or a layer has topics of a microphone."""
        self._microphone(microphone).logs.add(log)

    def add_review(self, review: Mapping[str, Reviewed]) -> None:
        """Add the marks that are in the span of the grid, and what a person has looked at."""
        for scenario, (marks, reviewed) in review.items():
            for mark in marks:
                if mark.start < self._grid.end and mark.end > self._grid.start:
                    span = np.array([mark.start]), np.array([mark.end])
                    label = np.array([mark.label], object)
                    own = self._spans(mark.microphone, review_labelling(scenario))
                    own.append(LabelledSpans(*span, label))
                    self._looked_at(mark.microphone, scenario)
            for one in reviewed:
                self._looked_at(one.microphone, scenario).append(_one_span(one))

    def _looked_at(self, microphone: str, scenario: str) -> list[LabelledSpans]:
        return self._microphone(microphone).reviewed.setdefault(scenario, [])

    def add_clip(self, microphone: str, clip: SoundClip) -> None:
        """Add kept sound."""
        self._microphone(microphone).clips.append(clip)

    def microphones(self) -> dict[str, MicrophoneTimeline]:
        """Return the timelines of the microphones that have something to show."""
        return {
            name: self._timeline(name, rows)
            for name, rows in sorted(self._microphones.items())
            if not rows.is_empty
        }

    def logs(self, microphone: str) -> set[Path]:
        """Return the logs and layers that have topics of a microphone."""
        return self._microphones[microphone].logs

    def lines(self) -> LogLines:
        """Return the lines of all logs, in the order of time."""
        if not self._lines:
            return LogLines(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, object))
        times, levels, texts = map(np.concatenate, zip(*self._lines, strict=True))
        order = np.argsort(times, kind="stable")
        return LogLines(times[order], levels[order], texts[order])

    def _microphone(self, name: str) -> _Microphone:
        return self._microphones.setdefault(name, _Microphone(_NamedMeans(self._grid)))

    def _spans(self, microphone: str, labelling: str) -> list[LabelledSpans]:
        return self._microphone(microphone).spans.setdefault(labelling, [])

    def _add_features(self, rows: FeatureRows) -> None:
        microphone = self._microphone(rows.microphone)
        microphone.features.add(rows.names, rows.times, rows.values)
        if self._frames and ENERGY in rows.names:
            level = decibel(rows.values[:, rows.names.index(ENERGY)])
            frames = FrameValues(("level",), rows.times, level[:, np.newaxis])
            microphone.level_frames.append(frames)

    def _add_labels(self, rows: LabelRows) -> None:
        microphone, name = self._microphone(rows.microphone), rows.labelling
        means = microphone.labels.setdefault(name, _NamedMeans(self._grid))
        means.add(rows.names, rows.times, rows.probabilities)
        if not self._sampled:
            frames = FrameValues(rows.names, rows.times, rows.probabilities)
            microphone.label_frames.setdefault(name, []).append(frames)
            self._forget_frames(rows.microphone, name)
        finite = np.isfinite(rows.novelty)
        if finite.any():
            novelty = microphone.novelty.setdefault(name, GridMeans(self._grid, 1))
            novelty.add(rows.times[finite], rows.novelty[finite, np.newaxis])

    def _forget_frames(self, name: str, labelling: str) -> None:
        """Forget the frames whose segments are known, unless single frames are kept."""
        microphone = self._microphone(name)
        spans, frames = microphone.spans.get(labelling), microphone.label_frames.get(labelling)
        while not self._frames and spans and frames and frames[0].times[-1] < spans[-1].ends[-1]:
            del frames[0]

    def _timeline(self, name: str, rows: _Microphone) -> MicrophoneTimeline:
        features = rows.features.series()
        level = None
        if features is not None and ENERGY in features.names:
            level = decibel(features.values[:, features.names.index(ENERGY)])
        return MicrophoneTimeline(
            name=name,
            labellings=[self._labelling(rows, each) for each in rows.labellings],
            features=features,
            level=level,
            level_frames=rows.level_frames,
            floor=_floor(rows.states, self._grid, features),
            reviewed=self._join(rows.reviewed.get("", [])),
            gaps=self._join(rows.gaps),
            troubles=_trouble_spans(rows.states, self._grid.end),
            clips=_join_clips(rows.clips),
            direction=None if rows.directions is None else degrees_of(rows.directions.values),
            reviewed_scenarios={
                name: self._join(parts) for name, parts in sorted(rows.reviewed.items()) if name
            },
        )

    def _labelling(self, rows: _Microphone, name: str) -> LabellingTimeline:
        means, frames = rows.labels.get(name), rows.label_frames.get(name, [])
        parts = rows.spans.get(name, [])
        end = max((int(spans.ends.max()) for spans in parts), default=0)
        parts = [*parts, *_runs(frames, end, FRAME_NANOSECONDS)]  # what is open is no segment yet
        if not parts and means is not None:
            parts = list(_runs(_shares(means, self._grid), 0, self._grid.step))
        return LabellingTimeline(
            name,
            self._join(parts),
            None if means is None else means.series(),
            rows.novelty[name].values[:, 0] if name in rows.novelty else None,
            frames if self._frames else (),
        )

    def _join(self, parts: Sequence[LabelledSpans]) -> LabelledSpans:
        """Chain spans in the order of time, cut off at the ends of the grid."""
        if not parts:
            return no_spans()
        spans = LabelledSpans(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        starts = np.maximum(spans.starts, self._grid.start)
        ends = np.minimum(spans.ends, self._grid.end)
        inside = np.flatnonzero(starts < ends)
        order = inside[np.argsort(starts[inside], kind="stable")]
        return LabelledSpans(starts[order], ends[order], spans.texts[order])


def _one_span(span: ReviewedSpan) -> LabelledSpans:
    text = np.array([span.chosen], object)
    return LabelledSpans(np.array([span.start]), np.array([span.end]), text)


def _shares(means: _NamedMeans, grid: Grid) -> Iterator[FrameValues]:
    """Yield the shares of a grid as if they were frames, without those that have no values."""
    for names, part in means.means.items():
        values = part.values
        present = ~np.isnan(values[:, 0])
        yield FrameValues(names, grid.edges[:-1][present], values[present].astype(np.float32))


def _runs(parts: Iterable[FrameValues], after: int, step: int) -> Iterator[LabelledSpans]:
    """Join successive frames, `step` apart, from some time on whose likeliest class is the same."""
    for names, all_times, all_values in parts:
        later = all_times >= after
        times, values = all_times[later], all_values[later]
        if not len(times):
            continue
        best = values.argmax(axis=1)
        broken = np.diff(times, prepend=times[0]) > 1.5 * step
        first = np.flatnonzero(broken | (np.diff(best, prepend=-1) != 0))
        last = np.append(first[1:], len(times)) - 1
        texts = np.array(names, object)[best[first]]
        yield LabelledSpans(times[first], times[last] + step, texts)


def _floor(
    states: Sequence[MicrophoneHealth], grid: Grid, features: GridSeries | None
) -> Float64 | None:
    """Let a floor last until the next message, as far as features were recorded."""
    states = [state for state in states if not math.isnan(state.floor_dbfs)]
    if not states or features is None:
        return None
    floors = np.array([math.nan, *(state.floor_dbfs for state in states)])
    floor = floors[np.searchsorted([state.time for state in states], grid.middles, "right")]
    return np.where(np.isnan(features.values).all(axis=1), math.nan, floor)


def _trouble_spans(states: Sequence[MicrophoneHealth], end: int) -> LabelledSpans:
    """Let a trouble last until the next message says that it is over, or that it is another."""
    changes = [(state.time, state.text or None) for state in states]
    spans = [span for span in lasting(changes, end) if span[0] < span[1]]
    if not spans:
        return no_spans()
    starts, ends, texts = zip(*spans, strict=True)
    return LabelledSpans(np.array(starts), np.array(ends), np.array(texts, object))


def _join_clips(parts: list[SoundClip]) -> list[SoundClip]:
    """Join clips that follow each other without a hole; forget the parts, which are large."""
    runs: list[list[SoundClip]] = []
    for part in sorted(parts, key=lambda clip: clip.start):
        last = runs[-1][-1] if runs else None
        if last and last.rate == part.rate and abs(part.start - last.end) < FRAME_NANOSECONDS:
            runs[-1].append(part)
        else:
            runs.append([part])
    parts.clear()
    clips = []
    for run in runs:
        samples = np.concatenate([part.samples for part in run])
        clips.append(SoundClip(run[0].start, run[0].rate, samples))
        run.clear()
    return clips
