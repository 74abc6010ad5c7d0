"""Single-pass reader of logs, layers and clips into a timeline, within bounded memory."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import time_ns

import numpy as np

from hearthlog.analyzer.errors import DataError, collect_errors
from hearthlog.analyzer.logs.clips import read_clips
from hearthlog.analyzer.logs.layers import (
    Coverage,
    TimedFile,
    coverage_of,
    find_timed_files,
    latest_records,
)
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.logs.recorder_info import MicrophoneHealth, lasting
from hearthlog.analyzer.logs.selection import decode_types
from hearthlog.analyzer.logs.spans import difference, joined, single_span
from hearthlog.analyzer.marks.marks import Reviewed, read_review
from hearthlog.analyzer.review.lanes import (
    FEATURES,
    FIELDS,
    FLOOR,
    GAPS,
    NOVELTY,
    PLOTS,
    PROBABILITIES,
    LaneRows,
    StateRows,
    read_rows,
    shown_topic,
)
from hearthlog.analyzer.review.timeline import (
    GridMeans,
    LabelledSpans,
    LabellingTimeline,
    LogLines,
    MicrophoneTimeline,
    Plot,
    PlotKey,
    PlotKind,
    SoundClip,
    Timeline,
    TimelineGrid,
    labelled_spans,
    no_spans,
)
from hearthlog.models.classifiers.network_names import MOST_AHEAD_FRAMES
from hearthlog.schemas.arrays import Float32, Float64, Int16
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import AUDIO_LAYER, REVIEW_LAYER, log_of_layer
from hearthlog.schemas.logs.merged_reading import iterate_pieces
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, is_review, parse_topic, review_labelling


@dataclass
class _NamedMeans:
    """Means of rows whose columns may differ from log to log."""

    grid: TimelineGrid
    means: dict[tuple[str, ...], GridMeans] = field(default_factory=dict)

    def add(self, plot: Plot) -> None:
        means = self.means.setdefault(plot.names, GridMeans(self.grid, plot.values.shape[1]))
        means.add(plot.times, plot.values)

    def series(self) -> tuple[tuple[str, ...], Float64]:
        """Align all rows to the same columns; return their names and values."""
        if len(self.means) == 1:
            ((names, means),) = self.means.items()
            return names, means.values
        names = tuple(dict.fromkeys(name for names in self.means for name in names))
        values = np.full((self.grid.count, len(names)), np.nan)
        for own, means in self.means.items():
            part = means.values
            present = ~np.isnan(part[:, 0])
            columns = [names.index(name) for name in own]
            values[np.flatnonzero(present)[:, np.newaxis], columns] = part[present]
        return names, values


@dataclass
class _Microphone:
    """Data collected for one microphone, from successive logs in time order."""

    name: str
    grid: TimelineGrid
    sampled: bool
    keeps_frames: bool
    means: dict[PlotKey, _NamedMeans] = field(default_factory=dict)
    frames: dict[PlotKey, list[Plot]] = field(default_factory=dict)
    spans: dict[str, list[LabelledSpans]] = field(default_factory=dict)  # by labelling
    unsure: dict[str, list[LabelledSpans]] = field(default_factory=dict)  # likewise
    reviewed: dict[str, list[LabelledSpans]] = field(default_factory=dict)  # by scenario
    gaps: list[LabelledSpans] = field(default_factory=list)
    states: list[MicrophoneHealth] = field(default_factory=list)
    clips: list[SoundClip] = field(default_factory=list)
    logs: set[Path] = field(default_factory=set)

    @property
    def is_empty(self) -> bool:
        return not any((self.means, self.spans, self.gaps, self.clips))

    def add(self, rows: Plot | LaneRows | StateRows) -> None:
        match rows:
            case Plot():
                self._add_values(rows)
            case LaneRows() if rows.kind is GAPS:
                self.gaps.append(rows.spans)
            case LaneRows():
                self.spans.setdefault(rows.labelling, []).append(rows.spans)
                if rows.unsure.any():
                    unsure = rows.spans.where(rows.unsure)
                    self.unsure.setdefault(rows.labelling, []).append(unsure)
                self._forget_frames(rows.labelling)
            case StateRows():
                self.states += rows.states

    def _add_values(self, rows: Plot) -> None:
        key = rows.kind, rows.labelling
        self.means.setdefault(key, _NamedMeans(self.grid)).add(rows)
        if rows.kind.frame_step and (
            self.keeps_frames or (rows.kind is PROBABILITIES and not self.sampled)
        ):
            values = rows.kind.of_means(rows.values)
            self.frames.setdefault(key, []).append(rows._replace(values=values))
            self._forget_frames(rows.labelling)

    def _forget_frames(self, labelling: str) -> None:
        """Drop the frames covered by segments, unless single frames are kept."""
        spans, frames = self.spans.get(labelling), self.frames.get((PROBABILITIES, labelling))
        while (
            not self.keeps_frames and spans and frames and frames[0].times[-1] < spans[-1].ends[-1]
        ):
            del frames[0]

    def timeline(self) -> MicrophoneTimeline:
        """Return all collected data, and release the clips."""
        labels = {labelling for kind, labelling in self.means if kind is PROBABILITIES}
        names = sorted({*labels, *self.spans}, key=lambda one: (is_review(one), one != LIVE, one))
        keys = [(kind, labelling) for kind in PLOTS for labelling in ("", *names)]
        plots = {key: plot for key in keys if (plot := self._plot(*key)) is not None}
        return MicrophoneTimeline(
            name=self.name,
            labellings=[self._labelling(name, plots.get((PROBABILITIES, name))) for name in names],
            plots=plots,
            frames={k: self.frames[k] for k in keys if self.keeps_frames and k in self.frames},
            reviewed=self._join(self.reviewed.get("", [])),
            gaps=self._join(self.gaps),
            troubles=_trouble_spans(self.states, self.grid.end),
            clips=_join_clips(self.clips),
            reviewed_scenarios={
                name: self._join(parts) for name, parts in sorted(self.reviewed.items()) if name
            },
        )

    def _plot(self, kind: PlotKind, labelling: str) -> Plot | None:
        if kind is FLOOR and not labelling:
            return self._floor()
        means = self.means.get((kind, labelling))
        if means is None:
            return None
        names, values = means.series()
        if kind is NOVELTY:
            names = (f"novelty, {labelling}",)
        place = self.name, labelling, names, self.grid.middles
        return Plot(kind, *place, kind.of_means(values), self.grid.step)

    def _floor(self) -> Plot | None:
        """Hold each floor value until the next message, where features were recorded."""
        states = [state for state in self.states if not math.isnan(state.floor_dbfs)]
        features = self._plot(FEATURES, "")
        if not states or features is None:
            return None
        floors = np.array([math.nan, *(state.floor_dbfs for state in states)])
        floor = floors[np.searchsorted([state.time for state in states], features.times, "right")]
        floor = np.where(np.isnan(features.values).all(axis=1), math.nan, floor)
        return features._replace(kind=FLOOR, names=("floor",), values=floor[:, np.newaxis])

    def _labelling(self, name: str, probabilities: Plot | None) -> LabellingTimeline:
        parts = self.spans.get(name, [])
        end = max((int(spans.ends.max()) for spans in parts), default=0)
        frames = self.frames.get((PROBABILITIES, name), [])  # open segments are not logged yet
        parts = [*parts, *_runs(frames, end, FRAME_NANOSECONDS)]
        if not parts and probabilities is not None:
            means = self.means[PROBABILITIES, name].means
            parts = list(_runs(_probability_frames(means, self.grid), 0, self.grid.step))
        classes = () if probabilities is None else probabilities.names
        return LabellingTimeline(
            name, self._join(parts), classes, self._join(self.unsure.get(name, []))
        )

    def _join(self, parts: Sequence[LabelledSpans]) -> LabelledSpans:
        """Concatenate spans in time order, clipped to the grid."""
        if not parts:
            return no_spans()
        spans = LabelledSpans(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        starts = np.maximum(spans.starts, self.grid.start)
        ends = np.minimum(spans.ends, self.grid.end)
        inside = np.flatnonzero(starts < ends)
        order = inside[np.argsort(starts[inside], kind="stable")]
        return LabelledSpans(starts[order], ends[order], spans.texts[order])


def _probability_frames(
    means: Mapping[tuple[str, ...], GridMeans], grid: TimelineGrid
) -> Iterator[Plot]:
    """Yield the grid shares as frames, without empty shares."""
    for names, part in means.items():
        values = part.values
        present = ~np.isnan(values[:, 0])
        times = grid.edges[:-1][present]
        yield Plot(PROBABILITIES, "", "", names, times, values[present].astype(np.float32))


def _runs(parts: Iterable[Plot], after: int, step: int) -> Iterator[LabelledSpans]:
    """Merge successive frames (`step` apart) with the same likeliest class, from a time on."""
    for part in parts:
        later = part.times >= after
        times, values = part.times[later], part.values[later]
        if not len(times):
            continue
        best = values.argmax(axis=1)
        broken = np.diff(times, prepend=times[0]) > 1.5 * step
        first = np.flatnonzero(broken | (np.diff(best, prepend=-1) != 0))
        last = np.append(first[1:], len(times)) - 1
        texts = np.array(part.names, object)[best[first]]
        yield LabelledSpans(times[first], times[last] + step, texts)


def _trouble_spans(states: Sequence[MicrophoneHealth], end: int) -> LabelledSpans:
    """Hold each trouble until the next message that ends or replaces it."""
    changes = [(state.time, state.text or None) for state in states]
    return labelled_spans(span for span in lasting(changes, end) if span[0] < span[1])


def _join_clips(parts: list[SoundClip]) -> list[SoundClip]:
    """Join contiguous clips; release the parts, which are large."""
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


MOST_SHARES = 1_200  # of a timeline: more than a screen has pixels
MOST_CLIP_SECONDS = 3_600  # maximum kept sound shown: 115 MB
MOST_FRAMES = 3 * 3600 * NANOSECONDS  # maximum span with all frames kept; a day's are 90 MB
_PART = 3600 * NANOSECONDS
OFF = "the recorder was off"
_SHORTEST = 2 * FRAME_NANOSECONDS  # minimum share, so that each contains a frame
_COMPLETE_BYTES = 2 << 30  # maximum size of logs read completely: about three days
_OF_LAYERS = (message_types.LABEL, message_types.SEGMENT)
# Maximum delay from the time of a label to its log time: the labels wait for windows.
_LATE = (MOST_AHEAD_FRAMES + 1) * FRAME_NANOSECONDS
_OF_SPANS = (message_types.SEGMENT, message_types.GAP)  # logged at their end


def read_timeline(
    paths: Iterable[Path],
    start: int | None = None,
    end: int | None = None,
    *,
    zone: str | None = None,
    progress: Progress = ignore_progress,
) -> Timeline:
    """Read logs, their layers and clips as a timeline.

    Start and end are nanoseconds of UTC; by default from the first message to the last. Above about
    three days only a sample is read: some chunks of each log, evenly spaced. `progress` receives
    the share of the logs that is read, 0 to 1. Raise `LogError` if there is no log; `DataError` if
    this span of time is empty, or the time zone is unknown.
    """
    losses: list[str] = []
    files = find_timed_files(paths, start, None if end is None else end + _LATE, losses)
    inside = [file for file in files if end is None or file.first < end]
    limited = start is not None or end is not None
    if not inside:
        raise _nothing(losses, limited=limited)
    first = min(file.first for file in files) if start is None else start
    last = max(file.last for file in files) + FRAME_NANOSECONDS if end is None else end
    last = max(last, first + _SHORTEST)
    grid = TimelineGrid(first, last, min(MOST_SHARES, (last - first) // _SHORTEST))
    every = -(-sum(file.size for file in files if not file.layer) // _COMPLETE_BYTES)
    reader = _Reader(grid, max(every, 1))
    for number, file in enumerate(files):
        with collect_errors(losses, LogError, DataError):
            reader.read(file)
        progress((number + 1) / len(files))
    collected = {name: one for name, one in sorted(reader.microphones.items()) if not one.is_empty}
    if not collected:
        raise _nothing(losses, limited=limited)
    microphones = {name: one.timeline() for name, one in collected.items()}
    coverage = {
        name: coverage_of(
            [
                (file.first, file.last + FRAME_NANOSECONDS, file.path)
                for file in inside
                if not file.layer and file.path in one.logs
            ]
        )
        for name, one in collected.items()
    }
    for name, microphone in microphones.items():
        microphone.gaps = _unrecorded(microphone, coverage[name], grid)
    home = str(home_zone(zone, latest_records(file.path for file in files)))
    return Timeline(grid, microphones, reader.lines(), home, coverage, reader.every, losses)


def read_frames(
    timeline: Timeline, start: int | None = None, end: int | None = None
) -> Iterator[Timeline]:
    """Read frames of a timeline too long to keep them, from start to end, one hour at a time.

    Times are nanoseconds of UTC; by default the complete timeline.
    """
    start = timeline.grid.start if start is None else max(start, timeline.grid.start)
    end = timeline.grid.end if end is None else min(end, timeline.grid.end)
    if timeline.grid.end - timeline.grid.start <= MOST_FRAMES:
        yield timeline
        return
    logs = [
        log
        for one in timeline.coverage.values()
        for log in zip(one.logs, one.starts, one.ends, strict=True)
    ]
    # A log may hold the last labels from before its start: a part ends before them.
    begins = sorted({time - _LATE for _, begin, stop in logs for time in range(begin, stop, _PART)})
    edges = [start]
    for time in begins:
        if edges[-1] + 2 * _LATE < time < end - 2 * _LATE:
            edges.append(time)
    for span in pairwise([*edges, end]):
        near = {log for log, begin, stop in logs if begin < span[1] and stop > span[0]}
        try:
            part = read_timeline(near, *span, zone=timeline.zone)
        except (LogError, DataError):
            continue
        yield part


def _unrecorded(
    microphone: MicrophoneTimeline, coverage: Coverage, grid: TimelineGrid
) -> LabelledSpans:
    """Add the recorder's off times, up to now, to its gaps."""
    gaps = microphone.gaps
    spans = [gaps, *(one.spans for one in microphone.labellings)]
    past = max(time_ns(), *coverage.ends, grid.start)
    span = single_span(grid.start, min(grid.end, past))
    starts = np.concatenate([coverage.starts, *(each.starts for each in spans)]).astype(np.int64)
    ends = np.concatenate([coverage.ends, *(each.ends for each in spans)]).astype(np.int64)
    recorded = joined(starts, ends, NANOSECONDS)
    off = difference(span, recorded)
    starts = np.concatenate([gaps.starts, off.starts])
    order = np.argsort(starts, kind="stable")
    ends = np.concatenate([gaps.ends, off.ends])
    texts = np.concatenate([gaps.texts, np.full(len(off.starts), OFF, object)])
    return LabelledSpans(starts[order], ends[order], texts[order])


def _nothing(losses: Sequence[str], *, limited: bool) -> DataError:
    where = "in this span of time; `hearthlog info` shows what there is" if limited else "to show"
    first = f" ({losses[0]})" if losses else ""
    return DataError(f"no features, labels, segments or gaps {where}{first}")


def _as_kept(samples: Float32) -> Int16:
    """Return 16-bit samples, since an hour of samples is large."""
    return np.clip(np.rint(samples * 32768.0), -32768, 32767).astype(np.int16)


class _Reader:
    """Reads logs and layers one after the other, in time order."""

    def __init__(self, grid: TimelineGrid, every: int) -> None:
        self.every = every
        self.microphones: dict[str, _Microphone] = {}
        self._grid = grid
        self._keeps_frames = every == 1 and grid.end - grid.start <= MOST_FRAMES
        self._clip_seconds = 0.0
        self._layers: dict[tuple[Path, str], Path] = {}
        self._lines: list[LogLines] = []

    def lines(self) -> LogLines:
        """Return the lines of all logs, in time order."""
        if not self._lines:
            return LogLines(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, object))
        times, levels, texts = map(np.concatenate, zip(*self._lines, strict=True))
        order = np.argsort(times, kind="stable")
        return LogLines(times[order], levels[order], texts[order])

    def _microphone(self, name: str) -> _Microphone:
        new = _Microphone(name, self._grid, self.every > 1, self._keeps_frames)
        return self.microphones.setdefault(name, new)

    def read(self, file: TimedFile) -> None:
        """Collect the messages of a log or layer."""
        if file.layer == AUDIO_LAYER:
            self._read_clips(file.path)
            return
        if file.layer == REVIEW_LAYER:
            return  # read with its log
        types = FIELDS
        if file.layer:
            types = {name: FIELDS[name] for name in _OF_LAYERS}
        self._read_messages(file, types)
        if not file.layer:  # last, since a damaged layer must not hide its log
            self._add_review(read_review(file.path))

    def _add_review(self, review: Mapping[str, Reviewed]) -> None:
        """Add the marks within the span of the grid, and the reviewed spans."""
        for scenario, (marks, reviewed) in review.items():
            for mark in marks:
                if mark.start < self._grid.end and mark.end > self._grid.start:
                    microphone = self._microphone(mark.microphone)
                    own = microphone.spans.setdefault(review_labelling(scenario), [])
                    own.append(labelled_spans([(mark.start, mark.end, mark.label)]))
                    microphone.reviewed.setdefault(scenario, [])
            for one in reviewed:
                own = self._microphone(one.microphone).reviewed.setdefault(scenario, [])
                own.append(labelled_spans([(one.start, one.end, one.chosen)]))

    def _read_messages(self, file: TimedFile, types: Mapping[str, Sequence[str]]) -> None:
        for topics, end, every in self._parts(file):
            decoded = partial(decode_types, file.path, types=types)
            span = (self._grid.start, end)
            for batch in iterate_pieces([file.path], topics, *span, decoded, every=every):
                for columns in batch:
                    self._collect(file.path, columns)
                if min(int(columns.log_times[0]) for columns in batch) > self._grid.end + _LATE:
                    break  # later ends mean later starts, except for spans of minutes

    def _parts(self, file: TimedFile) -> Iterator[tuple[list[str] | None, int | None, int]]:
        """Yield topics, the log time limit, and n to read one of n chunks."""
        with LogFile(file.path) as log:
            topics = [channel.topic for channel in log.channels.values()]
            complete = log.complete  # otherwise its topics are unknown until all of it is read
        if not file.layer:
            needed = [name for name in topics if not name.endswith("/statistics")]
            yield needed if complete else None, None, self.every
            return
        self._check_alone(file.path, topics)
        # Segments have their own chunks, so all can be read even where there are too many labels.
        yield [name for name in topics if name.endswith("/segment")], None, 1
        if self.every == 1:
            labels = [name for name in topics if name.endswith("/label")]
            yield labels, self._grid.end + _LATE, 1

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

    def _collect(self, path: Path, columns: Columns) -> None:
        topic = shown_topic(columns.topic)
        if topic is not None:
            self._microphone(topic.microphone).logs.add(path)
        if columns.type == message_types.LABEL:  # labels are logged later than their frame
            stamps = columns["header.stamp"]
            inside = (stamps >= self._grid.start) & (stamps < self._grid.end)
            columns = columns if inside.all() else columns.take(np.flatnonzero(inside))
        elif columns.type not in _OF_SPANS:
            columns = columns.between(self._grid.start, self._grid.end)
        for rows in read_rows(path, columns):
            if isinstance(rows, LogLines):
                self._lines.append(rows)
            else:
                self._microphone(rows.microphone).add(rows)

    def _read_clips(self, path: Path) -> None:
        with LogFile(path) as file:
            topics = sorted(channel.topic for channel in file.channels.values())
        for topic in topics:
            name = parse_topic(topic)
            if name is None or name[1:] != (LIVE, "audio"):
                raise LogError(f"{path}: has a topic {topic[:64]!r}, which no layer of sound has")
            for start, rate, samples in read_clips(path, topic, self._grid.start, self._grid.end):
                self._clip_seconds += len(samples) / rate
                if self._clip_seconds > MOST_CLIP_SECONDS:
                    raise DataError(
                        f"{path}: more than {MOST_CLIP_SECONDS // 60} minutes of sound: what comes "
                        "later is not shown; name a shorter span with --start and --end"
                    )
                clip = SoundClip(start, rate, _as_kept(samples))
                self._microphone(name.microphone).clips.append(clip)
