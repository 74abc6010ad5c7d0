"""What a month has shown, beside what was aimed at."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import stem
from hearthlog.tools.lab.month.fast_microphone import PPM
from hearthlog.tools.lab.month.faults import Fault
from hearthlog.tools.lab.month.folders import MonthFolder
from hearthlog.tools.lab.month.log_coverage import holes
from hearthlog.tools.lab.month.watch import MonthRecord, Run

_DAY = 86_400 * NANOSECONDS
_MOST_LOST = {"killed": 1.0, "power cut": 5.0}  # seconds
_MOST_GROWTH = 2e6  # bytes of memory


@dataclass
class Summary:
    """Lines for a person, and whether a target is missed."""

    lines: list[str] = field(default_factory=list)
    missed: bool = False

    def add(self, line: str, *, met: bool = True) -> None:
        """Add a line.

        Parameters
        ----------
        line : str
        met : bool
            Whether the target in it is met.
        """
        self.lines.append(line if met else f"{line}  MISSED")
        self.missed |= not met


def summarize(record: MonthRecord, faults: Sequence[Fault], folder: MonthFolder) -> Summary:
    """Sum a month up.

    Parameters
    ----------
    record : MonthRecord
    faults : sequence of Fault
    folder : MonthFolder
    """
    summary = Summary()
    kinds = Counter(fault.kind for fault in faults)
    summary.add(", ".join(f"{count} {kind}" for kind, count in kinds.most_common()))
    for problem in record.problems:
        summary.add(problem, met=False)
    for hole in (found := holes(record.coverages)):
        summary.add(hole, met=False)
    errors = [error for coverage in record.coverages for error in coverage.errors]
    errors += [
        str(finding)
        for findings in examine(folder.logs)
        for finding in findings.shown
        if finding.level == "error"
    ]
    for error in errors:
        summary.add(error, met=False)
    frames = sum(coverage.frames for coverage in record.coverages)
    gaps = Counter(why for each in record.coverages for _, _, why in each.spans if why)
    summary.add(
        f"{len(record.coverages)} logs, {frames} frames, {sum(gaps.values())} gaps, "
        f"{len(found)} holes that are in no gap, {len(errors)} errors of the doctor"
    )
    _add_losses(summary, record, folder)
    _add_growth(summary, max(record.runs, key=lambda run: len(run.samples)))
    return summary


def _add_losses(summary: Summary, record: MonthRecord, folder: MonthFolder) -> None:
    """Say how much of the sound that the recorder was given is in no log, by what ended it."""
    process_of = {log: process for process, log in folder.begun()}
    last: dict[int, int] = {}
    for coverage in record.coverages:
        process = process_of[stem(coverage.path)]
        last[process] = max(last.get(process, -1), coverage.last_frame)
    lost: dict[str, list[float]] = {}
    for run in record.runs:
        frames = last.get(run.process, -1) + 1
        seconds = (run.sound - frames * FRAME_NANOSECONDS * (1 + PPM * 1e-6)) / NANOSECONDS
        lost.setdefault(run.end, []).append(seconds)
    for end, each in lost.items():
        summary.add(
            f"{end}: {len(each)} times, lost at most {max(each):.2f} s, at the median "
            f"{np.median(each):.2f} s",
            met=max(each) <= _MOST_LOST.get(end, 1.0),
        )


def _add_growth(summary: Summary, run: Run) -> None:
    """Compare the last day of the longest life of the recorder with its second day."""
    times = np.array([sample.now for sample in run.samples])
    if not len(times) or times[-1] - times[0] < 3 * _DAY:
        summary.add("no process lived for three days: growth was not measured")
        return
    second = (times >= times[0] + _DAY) & (times < times[0] + 2 * _DAY)
    final = times >= times[-1] - _DAY
    days = (times[-1] - times[0]) / _DAY
    memory = np.array([sample.memory for sample in run.samples], float)
    growth = float(np.median(memory[final]) - np.median(memory[second]))
    summary.add(
        f"memory of a process of {days:.0f} days: {np.median(memory[second]) / 1e6:.1f} MB on its "
        f"second day, {growth / 1e6:+.1f} MB on its last; at most {memory.max() / 1e6:.1f} MB",
        met=growth < _MOST_GROWTH,
    )
    for name in ("descriptors", "children"):
        values = np.array([getattr(sample, name) for sample in run.samples])
        # A leak raises the low values; what runs for a while only the high ones.
        before, after = (int(np.percentile(values[day], 10)) for day in (second, final))
        summary.add(f"{name}: {before}, then {after}", met=bool(after <= before))
