"""Coverage of a month: which time is in frames, in gaps, or in neither."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hearthlog.analyzer.doctor.examination import examine_file
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.messages.topics import topic

_MICROPHONE = "mic"
_TOLERANCE = FRAME_NANOSECONDS // 2


@dataclass(frozen=True)
class LogCoverage:
    """What one log holds.

    Attributes
    ----------
    path : Path
    spans : list of (int, int, str)
        Start and end in nanoseconds of UTC, and the reason for a gap, empty for frames that follow
        each other; in the order of recording.
    frames : int
    last_frame : int
        Its number; -1 for a log without any.
    errors : list of str
        Of the doctor.
    """

    path: Path
    spans: list[tuple[int, int, str]]
    frames: int
    last_frame: int
    errors: list[str]


def read_log_coverage(path: Path) -> LogCoverage:
    """Read what a log holds, and let the doctor check it.

    Parameters
    ----------
    path : Path

    Raises
    ------
    LogError
        If it cannot be read.
    """
    features, gap = (topic(_MICROPHONE, kind) for kind in ("features", "gap"))
    columns = read_columns([path], {features, gap}, fields=_FIELDS)
    spans: list[tuple[int, int, int, str]] = []
    frames = np.empty(0, np.int64)
    if features in columns:
        frames, stamps = columns[features]["frame"].astype(np.int64), columns[features].log_times
        breaks = np.flatnonzero(np.diff(frames) != 1) + 1
        for part in np.split(np.arange(len(frames)), breaks):
            start, last = int(stamps[part[0]]), int(stamps[part[-1]])
            spans.append((start, start, last + FRAME_NANOSECONDS, ""))
    if gap in columns:
        gaps = columns[gap]
        rows = zip(gaps["header.stamp"], gaps.log_times, gaps["reason"], strict=True)
        spans += [(int(end) - 1, int(start), int(end), str(why)) for start, end, why in rows]
    findings = examine_file(path).findings
    return LogCoverage(
        path,
        [(start, end, why) for _, start, end, why in sorted(spans)],
        len(frames),
        int(frames.max()) if len(frames) else -1,
        [str(finding) for finding in findings.shown if finding.level == "error"],
    )


_FIELDS = ("frame", "header.stamp", "reason")


def holes(coverages: Iterable[LogCoverage]) -> list[str]:
    """Find the time that is neither in a frame nor in a gap.

    Parameters
    ----------
    coverages : iterable of LogCoverage
        In the order of recording.

    Returns
    -------
    list of str
        A line for each.
    """
    end, ends, found = 0, [0], []
    for coverage in coverages:
        for start, until, why in coverage.spans:
            # What was recorded while the clock was ahead is not looked at by what comes after.
            from_earlier = why and np.min(np.abs(np.array(ends) - start)) <= _TOLERANCE
            if ends[1:] and start > end + _TOLERANCE and not from_earlier:
                what = f"gap ({why})" if why else "frames"
                found.append(f"{coverage.path.name}: {(start - end) / 1e9:.3f} s before {what}")
            end = until
            ends.append(end)
    return found
