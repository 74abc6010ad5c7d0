"""`python -m hearthlog.tools.lab.home.copies LOGS DAYS -o FOLDER`: a month of a home from a day."""

import json
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from mcap.records import Metadata

from hearthlog.analyzer.logs.layers import find_with_layers, home_folder
from hearthlog.schemas.errors import HearthlogError, LogError, Progress, ignore_progress
from hearthlog.schemas.files import prefetch
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer, log_name, time_span
from hearthlog.schemas.logs.metadata import (
    HEARTHLOG_METADATA,
    ROSBAG2_METADATA,
    log_digest,
    provenance_records,
)
from hearthlog.schemas.mcap.chunks import read_definitions
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import LIVE, parse_topic
from hearthlog.tools.lab.home.shifted_log import Shift, ShiftedLog

_DAY = 86_400  # seconds
_NAME_TIME = re.compile(r"(?<=_)\d{8}T\d{6}Z")
_FORM = "%Y%m%dT%H%M%SZ"
_MADE = "%Y-%m-%dT%H:%M:%SZ"
_STEP = 200_000_000  # ns, within which a frame still goes on from the one before
_THREADS = 2


class _Recording(NamedTuple):
    """The logs of a node of a home, in the order of time, and what its copies have in common."""

    logs: Sequence[Path]
    frames: Mapping[str, int]  # by microphone: what each period adds to frame numbers


class _Copy(NamedTuple):
    """One copy of a recording among others."""

    number: int
    total: int
    period: int  # seconds

    def moved(self, name: str, periods: int = 0) -> str:
        """Move the time in the name of a file, or in its stem; by so many periods more."""
        return _NAME_TIME.sub(partial(self._moved_time, periods), name)

    def folder(self, folder: Path, name: str) -> Path:
        """Name the folder of a copy of a log; `folder` that of the log, `name` its name."""
        day = _time_in(name)
        moved = day + timedelta(seconds=self.number * self.period)
        parts = f"{day:%Y/%m/%d}", f"{moved:%Y/%m/%d}"
        text = folder.as_posix()
        return Path(text.removesuffix(parts[0]) + parts[1]) if text.endswith(parts[0]) else folder

    @property
    def seconds(self) -> int:
        """By how much it is moved."""
        return self.number * self.period

    def _moved_time(self, periods: int, match: re.Match[str]) -> str:
        seconds = self.seconds + periods * self.period
        return f"{_time_in(match[0]) + timedelta(seconds=seconds):{_FORM}}"


def copy_logs(
    logs: Path,
    output: Path,
    count: int,
    period: int = _DAY,
    progress: Progress = ignore_progress,
) -> list[Path]:
    """Copy a folder of logs with their layers, again and again, each time a period later.

    Messages are those of the originals, but for their times and frame numbers. Where the last
    frame of the folder would be followed by its first one a period later, frames go on from copy
    to copy; where it begins with the start of a recorder, so does every copy.

    Parameters
    ----------
    logs : Path
        Folder, on this machine.
    output : Path
        New folder.
    count : int
        Number of copies; the first is not moved.
    period : int
        Seconds from one copy to the next.
    progress : callable
        Told the share that is done.

    Returns
    -------
    list of Path
        The copies of logs and layers.

    Raises
    ------
    LogError
        If there is no log; if logs span more than the period, have no time in their names, begin
        in the middle of a recording from which no copy can go on, or are damaged; if the output
        exists or cannot be written.
    """
    recordings = [_recording(chain, period) for chain in _chains(logs)]
    jobs = [(recording, log) for recording in recordings for log in recording.logs]
    written: list[Path] = []
    with _new_folder(output):
        for done, (recording, log) in enumerate(jobs):
            files = [(path, ShiftedLog(path)) for path in find_with_layers([log])]
            write = partial(_write_copy, logs, output, recording, files)
            for paths in prefetch(write, [_Copy(i, count, period) for i in range(count)], _THREADS):
                written += paths
            progress((done + 1) / len(jobs))
    return written


@contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and delete it if what it is for fails."""
    try:
        folder.mkdir(parents=True)
        try:
            yield
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
    except FileExistsError as error:
        raise LogError(f"{error.filename}: exists already; name a new folder") from error
    except OSError as error:
        raise LogError(f"{folder}: cannot be written ({error.strerror})") from error


def _chains(folder: Path) -> list[list[Path]]:
    """List the logs of each node of each home, in the order of time."""
    if folder.is_file():
        raise LogError(f"{folder}: is one file; name the folder of the logs")
    chains: dict[tuple[Path, str], list[Path]] = {}
    for log in find_logs(folder):
        if not is_layer(log):
            name = log_name(log)
            if not _NAME_TIME.search(log.name):
                raise LogError(f"{log}: has no time in its name, as a recorder's log has")
            chains.setdefault((home_folder(log), name.node), []).append(log)
    return [sorted(logs, key=lambda log: log_name(log).time) for logs in chains.values()]


def _recording(logs: Sequence[Path], period: int) -> _Recording:
    spans = [span for span in map(time_span, logs) if span is not None]
    if spans and max(last for _, last in spans) - spans[0][0] > period * NANOSECONDS:
        raise LogError(
            f"{logs[0].parent}: these logs span more than {period} s, after which they come again"
        )
    heard: dict[str, list[Path]] = {}
    for log in logs:
        for microphone in _microphones(log):
            heard.setdefault(microphone, []).append(log)
    return _Recording(logs, {name: _frames(own, name, period) for name, own in heard.items()})


def _microphones(log: Path) -> list[str]:
    with LogFile(log) as file:
        read_definitions(file)
        names = [parse_topic(channel.topic) for channel in file.channels.values()]
    return [n.microphone for n in names if n and (n.labelling, n.kind) == (LIVE, "features")]


def _frames(logs: Sequence[Path], microphone: str, period: int) -> int:
    """Return what each period adds to the frame numbers of a microphone."""
    topic = f"/{microphone}/features"
    fields = ["frame", "header.stamp"]
    found = (read_columns([log], [topic], fields=fields) for log in (logs[0], logs[-1]))
    ends = [columns[topic] for columns in found if len(columns.get(topic, ()))]
    if len(ends) < 2:  # the logs were thinned
        return 0
    first, last = (int(ends[i]["frame"][-i]) for i in (0, 1))
    start, end = (int(ends[i]["header.stamp"][-i]) for i in (0, 1))
    count = period * NANOSECONDS // FRAME_NANOSECONDS
    late = start + period * NANOSECONDS - end - FRAME_NANOSECONDS
    if first + count == last + 1 and abs(late) <= _STEP:
        return count
    if first == 0:
        return 0
    raise LogError(
        f"{logs[0]}: {microphone} begins with frame {first}, so that a copy goes on from frame "
        f"{first + count - 1}, and these logs end with frame {last}; copy logs that begin with "
        "frame 0, or without a hole"
    )


def _write_copy(
    root: Path,
    output: Path,
    recording: _Recording,
    files: Sequence[tuple[Path, ShiftedLog]],
    copy: _Copy,
) -> list[Path]:
    """Write one copy of a log, and of the layers beside it; return their names."""
    written: list[Path] = []
    frames = {name: copy.number * count for name, count in recording.frames.items()}
    digests: dict[str, str] = {}
    for path, log in files:
        folder = output / copy.folder(path.parent.relative_to(root), path.name)
        folder.mkdir(parents=True, exist_ok=True)
        moved = folder / copy.moved(path.name)
        shift = Shift(copy.seconds, frames, _ends_before(recording, path, log, copy))
        edit = _Edit(recording, files[0][0], path, copy, digests)
        log.write(moved, shift, edit)
        if not digests:
            digests[log_digest(path)] = log_digest(moved)
        written.append(moved)
    return written


def _ends_before(
    recording: _Recording, path: Path, log: ShiftedLog, copy: _Copy
) -> Mapping[str, int]:
    """Find where the segments of the copy before end, if those of this one begin earlier."""
    start = time_span(path)
    if not copy.number or log_name(path).log != log_name(recording.logs[0]).log or start is None:
        return {}
    topics = [topic for topic, first in log.first_starts.items() if first < start[0]]
    if not topics:
        return {}
    layer = log_name(path).layer
    files = [file for each in recording.logs for file in find_with_layers([each])]
    same = [file for file in files if log_name(file).layer == layer]
    columns = read_columns(same, topics, fields=["header.stamp", "duration"])
    ends = {name: int((c["header.stamp"] + c["duration"]).max()) for name, c in columns.items()}
    before = (copy.seconds - copy.period) * NANOSECONDS
    return {name: end + before for name, end in ends.items()}


class _Edit:
    """What the metadata records of a copy say."""

    def __init__(
        self,
        recording: _Recording,
        log: Path,
        path: Path,
        copy: _Copy,
        digests: Mapping[str, str],
    ) -> None:
        self._recording = recording
        self._log = log
        self._path = path
        self._copy = copy
        self._digests = digests  # of the copied logs, by those of the originals

    def __call__(self, record: Metadata, fewer: Mapping[str, int]) -> dict[str, str]:
        """Edit one record, of a copy that has so many messages of each topic less."""
        try:
            if record.name == ROSBAG2_METADATA:
                return self._rosbag2(record.metadata, fewer)
            if record.name == HEARTHLOG_METADATA:
                return self._provenance(record.metadata)
            return dict(record.metadata)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise LogError(f"{self._path}: its record {record.name!r} is not ours") from error

    def _rosbag2(self, record: Mapping[str, str], fewer: Mapping[str, int]) -> dict[str, str]:
        key, time = "serialized_metadata", self._copy.seconds * NANOSECONDS
        information = json.loads(record[key])
        for times in (information, *information["files"]):
            times["starting_time"]["nanoseconds_since_epoch"] += time
            times["message_count"] -= sum(fewer.values())
        for topic in information["topics_with_message_count"]:
            topic["message_count"] -= fewer.get(topic["topic_metadata"]["name"], 0)
        for file in information["files"]:
            file["path"] = self._copy.moved(file["path"])
        information["relative_file_paths"] = [file["path"] for file in information["files"]]
        return {**record, key: json.dumps(information)}

    def _provenance(self, metadata: Mapping[str, str]) -> dict[str, str]:
        record = dict(metadata)
        copy, logs = self._copy, self._recording.logs
        for key in record.keys() & {"log", "before", "behind"}:
            record[key] = copy.moved(record[key])
        if "made" in record:
            made = datetime.strptime(record["made"], _MADE).replace(tzinfo=UTC)
            record["made"] = f"{made + timedelta(seconds=copy.seconds):{_MADE}}"
        for key in record.keys() & {"began", "ended"}:
            record[key] = _moved_runs(record[key], copy.seconds)
        if "input_sha256" not in record:
            return record
        record["input_sha256"] = self._digests.get(record["input_sha256"], record["input_sha256"])
        if self._log == logs[0] and copy.number:
            record["before"] = copy.moved(log_name(logs[-1]).log, -1)
            record["began"] = _moved_runs(self._open_at_end(), copy.seconds - copy.period)
        if self._log == logs[-1] and copy.number < copy.total - 1:
            record["behind"] = copy.moved(log_name(logs[0]).log, 1)
        return record

    def _open_at_end(self) -> str:
        """Return what the same layer of the last log says is open at its end."""
        layer = log_name(self._path).layer
        for path in find_with_layers([self._recording.logs[-1]]):
            if log_name(path).layer == layer:
                with LogFile(path) as file:
                    return next((r.get("ended", "") for r in provenance_records(file)), "")
        return ""


def _moved_runs(text: str, seconds: int) -> str:
    """Move the starts of open segments, as a relabel layer notes them."""
    if not text:
        return ""
    runs = json.loads(text)
    for run in [runs] if "start" in runs else runs.values():
        run["start"] += seconds * NANOSECONDS
    return json.dumps(runs)


def _time_in(name: str) -> datetime:
    match = _NAME_TIME.search(name if name.startswith("_") else f"_{name}")
    assert match is not None
    return datetime.strptime(match[0], _FORM).replace(tzinfo=UTC)


def copies(
    logs: Annotated[Path, typer.Argument(help="Folder of the logs of a day.")],
    days: Annotated[int, typer.Argument(min=1, help="How often it comes, a day later each time.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder.")],
) -> None:
    """Make a month of a home from a day: its logs and layers, again and again, as of other days."""
    written = copy_logs(logs, output, days, progress=_print_progress)
    print(f"{len(written)} files in {output}")


def _print_progress(share: float) -> None:
    if sys.stderr.isatty():
        print(f"\r{share:4.0%}", end="" if share < 1.0 else "\n", file=sys.stderr, flush=True)


if __name__ == "__main__":
    try:
        typer.run(copies)
    except HearthlogError as error:
        sys.exit(f"hearthlog: {error}")
