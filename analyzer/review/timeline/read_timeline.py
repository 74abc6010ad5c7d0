"""Read logs, their layers and clips, as a timeline: once through, within bounded memory."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.channel_names import checked_array_names
from hearthlog.analyzer.logs.clips import read_clips
from hearthlog.analyzer.logs.coverage import coverage_of
from hearthlog.analyzer.logs.layers import TimedFile, find_timed_files, latest_records
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.logs.typed_columns import decode_types
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.analyzer.review.timeline.decode import (
    FIELDS,
    chained,
    decibel,
    lasting,
    runs,
    shown_topic,
    spans_of,
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
    Timeline,
    no_spans,
)
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import AUDIO_LAYER, REVIEW_LAYER, log_of_layer
from hearthlog.schemas.logs.merged_reading import iterate_pieces
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, REVIEW, parse_topic
from hearthlog.schemas.progress import Progress, ignore_progress

SHARES = 1_200  # of a timeline, at most: more than a screen has pixels
_SHORTEST = 2 * FRAME_NANOSECONDS  # of a share, so that each has a frame
MOST_CLIP_SECONDS = 3_600  # of kept sound that is shown: 115 MB
_WHOLE_BYTES = 2 << 30  # of logs that are read whole: about three days
_ENERGY = "energy"
_OF_LAYERS = (message_types.LABEL, message_types.SEGMENT)


def read_timeline(
    paths: Iterable[Path],
    start: int | None = None,
    end: int | None = None,
    *,
    zone: str | None = None,
    progress: Progress = ignore_progress,
) -> Timeline:
    """Read what some logs hold.

    Of more than about three days a sample is read: some chunks of each log, evenly.

    Parameters
    ----------
    paths : iterable of Path
        Logs, whose layers come with them, or folders of logs.
    start, end : int, optional
        In nanoseconds of UTC.
    zone : str, optional
        IANA name of the home's time zone; by default the logs say it.
    progress : callable, optional
        Is called with the share that is done.

    Raises
    ------
    LogError
        If there is no log.
    DataError
        If there is nothing in this span of time.
    """
    losses: list[str] = []
    found = find_timed_files(paths, start, end, losses)
    if not found:
        raise _nothing(losses, limited=start is not None or end is not None)
    first = min(file.first for file in found) if start is None else start
    last = max(file.last for file in found) + FRAME_NANOSECONDS if end is None else end
    last = max(last, first + _SHORTEST)
    grid = Grid(first, last, min(SHARES, (last - first) // _SHORTEST))
    every = -(-sum(file.size for file in found if not file.layer) // _WHOLE_BYTES)
    reader = _Reader(grid, max(every, 1))
    for number, file in enumerate(found):
        try:
            reader.read(file)
        except (LogError, DataError) as error:
            losses.append(str(error))
        progress((number + 1) / len(found))
    known = home_zone(zone, latest_records(file.path for file in found))
    microphones = reader.microphones()
    heard = {
        name: coverage_of(
            [
                (file.first, file.last + FRAME_NANOSECONDS, file.path)
                for file in found
                if not file.layer and file.path in reader.logs(name)
            ]
        )
        for name in microphones
    }
    timeline = Timeline(grid, microphones, reader.lines(), str(known), heard, reader.every, losses)
    if not timeline.microphones:
        raise _nothing(losses, limited=start is not None or end is not None)
    return timeline


def _nothing(losses: Sequence[str], *, limited: bool) -> DataError:
    where = "in this span of time; `hearthlog info` shows what there is" if limited else "to show"
    first = f" ({losses[0]})" if losses else ""
    return DataError(f"no features, labels, segments or gaps {where}{first}")


@dataclass
class _Growing:
    """Rows of one topic, whose names may differ from log to log."""

    grid: Grid
    keep: bool
    means: dict[tuple[str, ...], GridMeans] = field(default_factory=dict)
    frames: list[FrameValues] = field(default_factory=list)

    def add(self, names: tuple[str, ...], times: Any, values: Any) -> None:
        self.means.setdefault(names, GridMeans(self.grid, len(names))).add(times, values)

    def series(self) -> GridSeries | None:
        """Bring all to the same columns."""
        if not self.means:
            return None
        names = tuple(dict.fromkeys(name for names in self.means for name in names))
        values = np.full((self.grid.count, len(names)), np.nan)
        for own, means in self.means.items():
            part = means.values
            heard = ~np.isnan(part[:, 0])
            columns = [names.index(name) for name in own]
            values[np.flatnonzero(heard)[:, np.newaxis], columns] = part[heard]
        return GridSeries(names, values)


@dataclass
class _Heard:
    """What was read of a microphone so far."""

    features: _Growing
    level_frames: list[FrameValues] = field(default_factory=list)
    labels: dict[str, _Growing] = field(default_factory=dict)
    novelty: dict[str, GridMeans] = field(default_factory=dict)
    spans: dict[str, list[LabelledSpans]] = field(default_factory=dict)
    gaps: list[LabelledSpans] = field(default_factory=list)
    troubles: list[tuple[int, str]] = field(default_factory=list)
    clips: list[SoundClip] = field(default_factory=list)
    logs: set[Path] = field(default_factory=set)


class _Reader:
    """Takes one log after the other, in the order of time."""

    def __init__(self, grid: Grid, every: int) -> None:
        self.every = every
        self._grid = grid
        self._heard: dict[str, _Heard] = {}
        self._lines: list[LogLines] = []
        self._clip_seconds = 0.0
        self._layers: dict[tuple[Path, str], Path] = {}

    def read(self, file: TimedFile) -> None:
        """Take a log or a layer."""
        if file.layer == AUDIO_LAYER:
            self._read_clips(file.path)
            return
        if file.layer == REVIEW_LAYER:
            return  # with its log
        kinds = FIELDS
        if file.layer:
            kinds = {kind: FIELDS[kind] for kind in _OF_LAYERS}
        self._read_messages(file, kinds)
        if not file.layer:
            self._read_marks(file.path)  # last, for a damaged layer must not hide its log

    def _read_messages(self, file: TimedFile, kinds: Mapping[str, Sequence[str]]) -> None:
        for topics, end, every in self._parts(file):
            decoded = partial(decode_types, file.path, types=kinds)
            span = (self._grid.start, end)
            for batch in iterate_pieces([file.path], topics, *span, decoded, every=every):
                for columns in batch:
                    self._take(file.path, columns)
                if min(int(columns.log_times[0]) for columns in batch) > self._grid.end:
                    break  # what ended later began later, but for what lasted for minutes

    def _parts(self, file: TimedFile) -> Iterator[tuple[list[str] | None, int | None, int]]:
        """Yield topics, the log time up to which they are read, and one of how many chunks."""
        with LogFile(file.path) as log:
            topics = [channel.topic for channel in log.channels.values()]
            complete = log.complete  # or its topics are known only when all of it is read
        if not file.layer:
            wanted = [name for name in topics if not name.endswith("/statistics")]
            yield wanted if complete else None, None, self.every
            return
        self._check_alone(file.path, topics)
        # They have chunks of their own, so all can be read even where labels are too many.
        yield [name for name in topics if name.endswith("/segment")], None, 1
        if self.every == 1:
            yield [name for name in topics if name.endswith("/label")], self._grid.end, 1

    def _check_alone(self, path: Path, topics: Sequence[str]) -> None:
        """Raise LogError if another layer of the same log has the same labelling."""
        log = log_of_layer(path)
        for topic in topics:
            other = self._layers.setdefault((log, topic), path)
            if other != path:
                raise LogError(
                    f"{path}: contradicts {other.name}, which has {topic} of the same log too; "
                    "move one of them away"
                )

    def _take(self, path: Path, columns: Columns) -> None:
        if columns.type == message_types.LOG:
            self._take_lines(columns)
        elif columns.type == message_types.DIAGNOSTICS:
            self._take_health(columns)
        elif topic := shown_topic(columns.topic):
            heard = self._microphone(topic.microphone)
            heard.logs.add(path)
            name = topic.labelling
            if columns.type == message_types.FEATURES:
                self._take_features(path, columns, heard)
            elif columns.type == message_types.LABEL:
                self._take_labels(path, columns, heard, name)
            elif columns.type == message_types.SEGMENT:
                heard.spans.setdefault(name, []).append(spans_of(columns, "label"))
            elif columns.type == message_types.GAP:
                heard.gaps.append(spans_of(columns, "reason"))

    def _microphone(self, name: str) -> _Heard:
        return self._heard.setdefault(name, _Heard(_Growing(self._grid, keep=False)))

    def _within(self, columns: Columns) -> Columns:
        return columns.between(self._grid.start, self._grid.end)

    def _take_features(self, path: Path, columns: Columns, heard: _Heard) -> None:
        columns = self._within(columns)
        if not len(columns):
            return
        names = checked_array_names(path, columns, "values")
        times, values = columns["header.stamp"], columns["values"]
        heard.features.add(names, times, values)
        if self.every == 1 and _ENERGY in names:
            level = decibel(values[:, names.index(_ENERGY)])
            heard.level_frames.append(FrameValues(("level",), times, level[:, np.newaxis]))

    def _take_labels(self, path: Path, columns: Columns, heard: _Heard, name: str) -> None:
        columns = self._within(columns)
        if not len(columns):
            return
        names = checked_array_names(path, columns, "probabilities")
        times, values = columns["header.stamp"], columns["probabilities"]
        growing = heard.labels.setdefault(name, _Growing(self._grid, keep=self.every == 1))
        growing.add(names, times, values)
        if growing.keep:
            growing.frames.append(FrameValues(names, times, values))
        novelty = columns["novelty"]
        known = np.isfinite(novelty)
        if known.any():
            means = heard.novelty.setdefault(name, GridMeans(self._grid, 1))
            means.add(times[known], novelty[known, np.newaxis])

    def _take_lines(self, columns: Columns) -> None:
        columns = self._within(columns)
        self._lines.append(LogLines(columns["stamp"], columns["level"], columns["msg"]))

    def _take_health(self, columns: Columns) -> None:
        columns = self._within(columns)
        rows = zip(
            columns["header.stamp"].tolist(),
            columns["header.frame_id"].tolist(),
            columns["status"],
            strict=True,
        )
        for stamp, name, statuses in rows:
            bad = [status["message"] for status in statuses if status["level"]]
            if shown_topic(f"/{name}/gap"):
                self._microphone(name).troubles.append((stamp, "; ".join(bad)[:200]))

    def _read_marks(self, log: Path) -> None:
        for mark in read_marks(log):
            if mark.start < self._grid.end and mark.end > self._grid.start:
                spans = self._microphone(mark.microphone).spans.setdefault(REVIEW, [])
                texts = np.array([mark.label], object)
                spans.append(LabelledSpans(np.array([mark.start]), np.array([mark.end]), texts))

    def _read_clips(self, path: Path) -> None:
        with LogFile(path) as file:
            topics = sorted(channel.topic for channel in file.channels.values())
        for topic in topics:
            name = parse_topic(topic)
            if name is None or name[1:] != (LIVE, "audio"):
                raise LogError(f"{path}: has a topic {topic[:64]!r}, which no layer of sound has")
            clips = self._microphone(name.microphone).clips
            for start, rate, samples in read_clips(path, topic, self._grid.start, self._grid.end):
                self._clip_seconds += len(samples) / rate
                if self._clip_seconds > MOST_CLIP_SECONDS:
                    raise DataError(
                        f"{path}: more than {MOST_CLIP_SECONDS // 60} minutes of sound: what comes "
                        "later is not shown; name a shorter span with --start and --end"
                    )
                clips.append(SoundClip(start, rate, samples))

    def microphones(self) -> dict[str, MicrophoneTimeline]:
        """Return what was heard by those microphones that have something to show."""
        return {
            name: self._finished(name, heard)
            for name, heard in sorted(self._heard.items())
            if heard.features.means or heard.labels or heard.spans or heard.gaps or heard.clips
        }

    def logs(self, microphone: str) -> set[Path]:
        """Return the logs and layers that have something of a microphone."""
        return self._heard[microphone].logs

    def lines(self) -> LogLines:
        """Return the events, in the order of time."""
        if not self._lines:
            return LogLines(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, object))
        times = np.concatenate([lines.times for lines in self._lines])
        levels = np.concatenate([lines.levels for lines in self._lines])
        texts = np.concatenate([lines.texts for lines in self._lines])
        order = np.argsort(times, kind="stable")
        return LogLines(times[order], levels[order], texts[order])

    def _finished(self, name: str, heard: _Heard) -> MicrophoneTimeline:
        labellings = [self._labelling(heard, each) for each in _ordered(heard)]
        features = heard.features.series()
        level = None
        if features is not None and _ENERGY in features.names:
            level = decibel(features.values[:, features.names.index(_ENERGY)])
        return MicrophoneTimeline(
            name=name,
            labellings=labellings,
            features=features,
            level=level,
            level_frames=heard.level_frames,
            gaps=self._joined(heard.gaps),
            troubles=lasting(heard.troubles, self._grid.end),
            clips=chained(heard.clips),
        )

    def _labelling(self, heard: _Heard, name: str) -> LabellingTimeline:
        growing = heard.labels.get(name)
        parts = heard.spans.get(name, [])
        if name == LIVE and self.every > 1 and growing is not None:
            parts = []  # of segments a sample says nothing
        if growing is not None:  # what is open at the end is no segment yet
            parts = [
                *parts,
                *runs(growing.frames, max((int(s.ends.max()) for s in parts), default=0)),
            ]
        spans = self._joined(parts)
        return LabellingTimeline(
            name,
            spans,
            None if growing is None else growing.series(),
            heard.novelty[name].values[:, 0] if name in heard.novelty else None,
            [] if growing is None else growing.frames,
        )

    def _joined(self, parts: Sequence[LabelledSpans]) -> LabelledSpans:
        """Chain spans, in the order of time, cut off to the grid."""
        if not parts:
            return no_spans()
        spans = LabelledSpans(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        starts = np.maximum(spans.starts, self._grid.start)
        ends = np.minimum(spans.ends, self._grid.end)
        left = np.flatnonzero(starts < ends)
        order = left[np.argsort(starts[left], kind="stable")]
        return LabelledSpans(starts[order], ends[order], spans.texts[order])


def _ordered(heard: _Heard) -> list[str]:
    names = {*heard.labels, *heard.spans}
    return sorted(names, key=lambda name: (name == REVIEW, name != LIVE, name))
