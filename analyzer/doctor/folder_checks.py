"""The logs of a folder, compared with each other."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from hearthlog.analyzer.doctor.file_checks import ExaminedFile
from hearthlog.analyzer.doctor.findings import Findings
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import SUFFIX
from hearthlog.schemas.times import millisecond_text

_TOLERANCE = 0.01  # of the time between two files, that a sound card's clock may be off by
_LEFT = {
    f"{SUFFIX}.damaged": "is what could not be recovered whole; `hearthlog recover` may save more",
    f"{SUFFIX}.recovering": "was left by a recovery that was cut short; the next one makes it anew",
    ".tmp": "was left by a command that was cut short; delete it",
}


def check_leftovers(folder: Path) -> Iterator[Findings]:
    """Find the files that killed recorders and commands have left behind.

    Parameters
    ----------
    folder : Path
        Is searched with all folders in it.

    Yields
    ------
    Findings
        One for each such file, in the order of their paths.
    """
    for path in sorted(folder.rglob("*")):
        for suffix, what in _LEFT.items():
            if path.name.endswith(suffix) and SUFFIX in path.name:
                findings = Findings(path)
                findings.warning("leftover", what)
                yield findings


def check_series(files: Sequence[ExaminedFile]) -> None:
    """Compare the logs of each node with each other, and add to their findings.

    Parameters
    ----------
    files : sequence of ExaminedFile
        In any order; those that are not ours, or have no messages, are passed over.
    """
    nodes: dict[str, list[ExaminedFile]] = {}
    for file in files:
        if file.ours and file.span is not None:
            nodes.setdefault(file.node, []).append(file)
    for same in nodes.values():
        same.sort(key=_start)
        _check_overlaps(same)
        for microphone in {name for file in same for name in file.frames}:
            _check_frames(microphone, [file for file in same if microphone in file.frames])


def _start(file: ExaminedFile) -> int:
    assert file.span is not None
    return file.span[0]


def _check_overlaps(files: Sequence[ExaminedFile]) -> None:
    """Two logs of one node speak of the same time only where its clock was set back."""
    latest = files[0]
    for file in files[1:]:
        assert file.span is not None
        assert latest.span is not None
        if file.span[0] < latest.span[1] and not (_set_back(file) or _set_back(latest)):
            what = f"begins before {latest.findings.path.name} of the same node ends"
            advice = "move the one away that does not belong here"
            file.findings.error("overlap", what, advice, time=file.span[0])
        if file.span[1] > latest.span[1]:
            latest = file


def _set_back(file: ExaminedFile) -> bool:
    return any(_begins_back(frames) for frames in file.frames.values())


def _begins_back(frames: FrameSequence) -> bool:
    """Tell whether a file begins with the setting back of the clock."""
    return frames.gap_before is not None and frames.gap_before[1] < frames.gap_before[0]


def _check_frames(microphone: str, files: Sequence[ExaminedFile]) -> None:
    """Frame numbers go on from file to file, or begin at 0 again."""
    by_end = {}
    for file in files:
        if (last := file.frames[microphone].last) is not None:
            by_end[last[1] + FRAME_NANOSECONDS] = file
    for earlier, file in pairwise(files):
        frames = file.frames[microphone]
        if frames.first is None or frames.first[0] == 0:
            continue
        previous = earlier
        if _begins_back(frames) and frames.gap_before is not None:
            previous = by_end.get(frames.gap_before[0], earlier)
        last = previous.frames[microphone].last
        if last is None:
            continue
        missing = frames.first[0] - last[0] - 1 - frames.lost_before
        if missing:
            _say_missing(microphone, previous, file, missing)


def _say_missing(microphone: str, previous: ExaminedFile, file: ExaminedFile, missing: int) -> None:
    frames, last = file.frames[microphone], previous.frames[microphone].last
    assert frames.first is not None
    assert last is not None
    elapsed = frames.first[1] - last[1]
    counted = (frames.first[0] - last[0]) * FRAME_NANOSECONDS
    name = previous.findings.path.name
    if missing > 0 and abs(elapsed - counted) <= _TOLERANCE * elapsed + FRAME_NANOSECONDS:
        what = f"{microphone}: {missing} frames between {name} and this log are in neither"
        advice = f"a log from {millisecond_text(last[1])} on is missing"
        file.findings.warning("missing-log", what, advice, time=frames.first[1])
    else:
        what = (
            f"{microphone}: begins with frame {frames.first[0]}, and {name} ends with {last[0]}; "
            f"gaps between them lost {frames.lost_before}"
        )
        advice = "one of them does not belong here, or was changed"
        file.findings.error("frames-continue", what, advice, time=frames.first[1])
