"""Read logs, their layers and clips, as a timeline: once through, within bounded memory."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import time_ns

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.clips import read_clips
from hearthlog.analyzer.logs.layers import (
    Coverage,
    TimedFile,
    coverage_of,
    find_timed_files,
    latest_records,
)
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.logs.selection import decode_types
from hearthlog.analyzer.logs.spans import joined, without
from hearthlog.analyzer.logs.spans import one as one_span
from hearthlog.analyzer.marks.marks import read_review
from hearthlog.analyzer.review.timeline.collect import Collector
from hearthlog.analyzer.review.timeline.decode import FIELDS, read_rows, shown_topic
from hearthlog.analyzer.review.timeline.grid import Grid
from hearthlog.analyzer.review.timeline.model import (
    LabelledSpans,
    MicrophoneTimeline,
    SoundClip,
    Timeline,
)
from hearthlog.models.classifiers.names import MOST_AHEAD_FRAMES
from hearthlog.schemas.arrays import Float32, Int16
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import AUDIO_LAYER, REVIEW_LAYER, log_of_layer
from hearthlog.schemas.logs.merged_reading import iterate_pieces
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, parse_topic

SHARES = 1_200  # of a timeline, at most: more than a screen has pixels
MOST_CLIP_SECONDS = 3_600  # of kept sound that is shown: 115 MB
MOST_FRAMES = 3 * 3600 * NANOSECONDS  # of which every frame is kept; a day's would be 90 MB
_PART = 3600 * NANOSECONDS
OFF = "the recorder was off"
_SHORTEST = 2 * FRAME_NANOSECONDS  # of a share, so that each has a frame
_WHOLE_BYTES = 2 << 30  # of logs that are read whole: about three days
_OF_LAYERS = (message_types.LABEL, message_types.SEGMENT)
# At most, from the time of a label until it is known: names wait for windows.
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

    Of more than about three days a sample is read: some chunks of each log, evenly.

    Parameters
    ----------
    start, end : int, optional
        In nanoseconds of UTC; by default from the first message to the last.
    progress : callable, optional
        Told the share of the logs that is read, 0 to 1.

    Raises
    ------
    LogError
        If there is no log.
    DataError
        If there is nothing in this span of time, or no such time zone.
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
    grid = Grid(first, last, min(SHARES, (last - first) // _SHORTEST))
    every = -(-sum(file.size for file in files if not file.layer) // _WHOLE_BYTES)
    reader = _Reader(grid, max(every, 1))
    for number, file in enumerate(files):
        try:
            reader.read(file)
        except (LogError, DataError) as error:
            losses.append(str(error))
        progress((number + 1) / len(files))
    collector = reader.collector
    microphones = collector.microphones()
    if not microphones:
        raise _nothing(losses, limited=limited)
    coverage = {
        name: coverage_of(
            [
                (file.first, file.last + FRAME_NANOSECONDS, file.path)
                for file in inside
                if not file.layer and file.path in collector.logs(name)
            ]
        )
        for name in microphones
    }
    for name, microphone in microphones.items():
        microphone.gaps = _unheard(microphone, coverage[name], grid)
    home = str(home_zone(zone, latest_records(file.path for file in files)))
    return Timeline(grid, microphones, collector.lines(), home, coverage, reader.every, losses)


def read_frames(
    timeline: Timeline, start: int | None = None, end: int | None = None
) -> Iterator[Timeline]:
    """Read the frames of a timeline that is too long to keep them, an hour at a time.

    Parameters
    ----------
    start, end : int, optional
        In nanoseconds of UTC; by default from its start to its end.
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
    # The last labels before a log begins may be in it: a part ends before them.
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


def _unheard(microphone: MicrophoneTimeline, coverage: Coverage, grid: Grid) -> LabelledSpans:
    """Add to the gaps of a recorder when it was off, as far as that is past."""
    gaps = microphone.gaps
    spans = [gaps, *(one.spans for one in microphone.labellings)]
    past = max(time_ns(), *coverage.ends, grid.start)
    whole = one_span(grid.start, min(grid.end, past))
    starts = np.concatenate([coverage.starts, *(each.starts for each in spans)]).astype(np.int64)
    ends = np.concatenate([coverage.ends, *(each.ends for each in spans)]).astype(np.int64)
    recorded = joined(starts, ends, NANOSECONDS)
    off = without(whole, recorded)
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
    """Return 16-bit samples: those of an hour are large."""
    return np.clip(np.rint(samples * 32768.0), -32768, 32767).astype(np.int16)


class _Reader:
    """Reads one log or layer after the other, in the order of time."""

    def __init__(self, grid: Grid, every: int) -> None:
        self.every = every
        frames = every == 1 and grid.end - grid.start <= MOST_FRAMES
        self.collector = Collector(grid, sampled=every > 1, frames=frames)
        self._grid = grid
        self._clip_seconds = 0.0
        self._layers: dict[tuple[Path, str], Path] = {}

    def read(self, file: TimedFile) -> None:
        """Collect the messages of a log or of a layer."""
        if file.layer == AUDIO_LAYER:
            self._read_clips(file.path)
            return
        if file.layer == REVIEW_LAYER:
            return  # with its log
        types = FIELDS
        if file.layer:
            types = {name: FIELDS[name] for name in _OF_LAYERS}
        self._read_messages(file, types)
        if not file.layer:  # last, for a damaged layer must not hide its log
            self.collector.add_review(read_review(file.path))

    def _read_messages(self, file: TimedFile, types: Mapping[str, Sequence[str]]) -> None:
        for topics, end, every in self._parts(file):
            decoded = partial(decode_types, file.path, types=types)
            span = (self._grid.start, end)
            for batch in iterate_pieces([file.path], topics, *span, decoded, every=every):
                for columns in batch:
                    self._collect(file.path, columns)
                if min(int(columns.log_times[0]) for columns in batch) > self._grid.end + _LATE:
                    break  # what ended later began later, but for what lasted for minutes

    def _parts(self, file: TimedFile) -> Iterator[tuple[list[str] | None, int | None, int]]:
        """Yield topics, the log time up to which they are read, and one of how many chunks."""
        with LogFile(file.path) as log:
            topics = [channel.topic for channel in log.channels.values()]
            complete = log.complete  # or its topics are known only when all of it is read
        if not file.layer:
            needed = [name for name in topics if not name.endswith("/statistics")]
            yield needed if complete else None, None, self.every
            return
        self._check_alone(file.path, topics)
        # They have chunks of their own, so all can be read even where labels are too many.
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
            self.collector.add_log(topic.microphone, path)
        if columns.type == message_types.LABEL:  # which is known later than its frame
            stamps = columns["header.stamp"]
            inside = (stamps >= self._grid.start) & (stamps < self._grid.end)
            columns = columns if inside.all() else columns.take(np.flatnonzero(inside))
        elif columns.type not in _OF_SPANS:
            columns = columns.between(self._grid.start, self._grid.end)
        rows = read_rows(path, columns) if len(columns) else None
        if rows is not None:
            self.collector.add(rows)

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
                self.collector.add_clip(name.microphone, SoundClip(start, rate, _as_kept(samples)))
