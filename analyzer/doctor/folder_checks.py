"""The logs of a folder, compared with each other."""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from hearthlog.analyzer.doctor.file_checks import ExaminedFile
from hearthlog.analyzer.doctor.findings import Findings
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.analyzer.doctor.message_checks import ALLOWED_DELAY
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, millisecond_text
from hearthlog.schemas.logs.files import SUFFIX, is_layer, log_of_layer

_DAY = re.compile(r"\d{4}/\d{2}/\d{2}")
_TOLERANCE = 0.01  # of the time between two files, that a sound card's clock may be off by
_BESIDE = 60 * NANOSECONDS  # that a layer may go beyond its log
_LEFT = {
    f"{SUFFIX}.damaged": "is what could not be recovered whole; `hearthlog recover` may save more",
    f"{SUFFIX}.recovering": "was left by a recovery that was cut short; the next one makes it anew",
    f"{SUFFIX}.thinning": "was left by a recorder that was killed; the next one deletes it",
    ".tmp": "was left by a command that was cut short; delete it",
}


def check_leftovers(folder: Path) -> Iterator[Findings]:
    """Find the files that killed recorders and commands have left behind."""
    for path in sorted(folder.rglob("*")):
        for suffix, what in _LEFT.items():
            if path.name.endswith(suffix) and SUFFIX in path.name:
                findings = Findings(path)
                findings.warning("leftover", what)
                yield findings


def check_series(files: Sequence[ExaminedFile]) -> None:
    """Compare the logs of each node of a home with each other, and add to their findings.

    Parameters
    ----------
    files : sequence of ExaminedFile
        In any order; those that are not ours, or have no messages, are passed over.
    """
    homes = {home for file in files if (home := _folder_of_days(file.findings.path)) is not None}
    nodes: dict[tuple[Path | None, str], list[ExaminedFile]] = {}
    for file in files:
        if file.ours and file.span is not None:
            home = next((each for each in file.findings.path.parents if each in homes), None)
            nodes.setdefault((home, file.node), []).append(file)
    for same in nodes.values():
        same.sort(key=_start)
        _check_overlaps(same)
        for microphone in {name for file in same for name in file.frames}:
            _check_frames(microphone, [file for file in same if microphone in file.frames])
    _check_layers(files)


def _check_layers(files: Sequence[ExaminedFile]) -> None:
    """Find layers that say nothing of the time of the log that they are named after."""
    spans = {file.findings.path: file.span for file in files if file.span is not None}
    for path in filter(is_layer, spans):
        log, (start, end) = log_of_layer(path), spans[path]
        first, last = spans.get(log, (start, end))
        if end < first - _BESIDE or last + _BESIDE < start:
            findings = next(file.findings for file in files if file.findings.path == path)
            what = f"speaks of a time when {log.name} was not recorded"
            advice = "it belongs to another log; move it beside that"
            findings.warning("layer", what, advice, time=start)


def _folder_of_days(path: Path) -> Path | None:
    """Return the folder of a home, which has a log in YYYY/MM/DD; None if it is not in one."""
    return path.parents[3] if _DAY.fullmatch("/".join(path.parts[-4:-1])) else None


def _start(file: ExaminedFile) -> int:
    assert file.span is not None
    return file.span[0]


def _check_overlaps(files: Sequence[ExaminedFile]) -> None:
    """Two logs of one node speak of the same time only where its clock was set back."""
    twice = [again for file in files if (again := _lived_twice(file)) is not None]
    latest = files[0]
    for file in files[1:]:
        assert file.span is not None
        assert latest.span is not None
        start, end = file.span[0], min(file.span[1], latest.span[1])
        delay = ALLOWED_DELAY if len(file.frames) > 1 else 0
        if start < latest.span[1] - delay and not any(a <= start and end <= b for a, b in twice):
            what = f"begins before {latest.findings.path.name} of the same node ends"
            advice = "move the one away that does not belong here"
            file.findings.error("overlap", what, advice, time=start)
        if file.span[1] > latest.span[1]:
            latest = file


def _lived_twice(file: ExaminedFile) -> tuple[int, int] | None:
    """Return the time that came again because the clock was set back before a file, or None."""
    back = [frames.gap_before for frames in file.frames.values() if _begins_back(frames)]
    gaps = [gap for gap in back if gap is not None]
    if not gaps:
        return None
    return min(new for _, new in gaps) - NANOSECONDS, max(old for old, _ in gaps) + NANOSECONDS


def _begins_back(frames: FrameSequence) -> bool:
    """Tell whether a file begins with the setting back of the clock."""
    return frames.gap_before is not None and frames.gap_before[1] < frames.gap_before[0]


def _check_frames(microphone: str, files: Sequence[ExaminedFile]) -> None:
    """Frame numbers go on from file to file, or begin at 0 again."""
    for earlier, file in pairwise(files):
        frames, last = file.frames[microphone], earlier.frames[microphone].last
        if frames.first is None or frames.first[0] == 0 or last is None:
            continue
        missing = frames.first[0] - last[0] - 1 - frames.lost_before
        missing -= earlier.frames[microphone].lost_behind
        if missing and not _goes_on(frames, [each.frames[microphone] for each in files]):
            _say_missing(microphone, earlier, file, missing)


def _goes_on(frames: FrameSequence, others: Sequence[FrameSequence]) -> bool:
    """Tell whether frames go on with where others end: the clock may have been set between."""
    assert frames.first is not None
    number = frames.first[0] - frames.lost_before
    time = frames.first[1] if frames.gap_before is None else frames.gap_before[0]
    ends = (other.last for other in others if other.last is not None)
    return any(last[0] + 1 == number and abs(last[1] - time) < NANOSECONDS for last in ends)


def _say_missing(microphone: str, previous: ExaminedFile, file: ExaminedFile, missing: int) -> None:
    frames, last = file.frames[microphone], previous.frames[microphone].last
    assert frames.first is not None
    assert last is not None
    if frames.gap_before is not None and abs(frames.gap_before[0] - last[1]) >= NANOSECONDS:
        when = millisecond_text(frames.gap_before[0])
        what = f"{microphone}: goes on with a log that ends at {when}, which is not here"
        advice = "the clock was set then; it was deleted, or is missing"
        file.findings.warning("missing-log", what, advice, time=frames.first[1])
        return
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
