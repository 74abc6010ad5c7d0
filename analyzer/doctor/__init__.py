"""Checks of logs against the MCAP specification, docs/log.md and each other, and their findings."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import printable
from hearthlog.schemas.frames import millisecond_text

Level = Literal["error", "warning"]
_SHOWN = 5  # maximum findings of one kind in one file
_LENGTH = 600  # maximum characters of a finding

RECOVER = "`hearthlog recover` saves what is whole"
REINDEX = "the messages are not affected; `hearthlog recover` makes a log with a new index"
DISTRUST = "do not train from it; if hearthlog wrote it as it is, report that"


class Finding(NamedTuple):
    """One problem in a log."""

    path: Path
    level: Level
    rule: str  # violated rule of docs/doctor.md
    what: str
    advice: str = ""  # what to do; empty if `what` is sufficient
    offset: int | None = None  # byte of the file at which the record begins
    time: int | None = None  # log time in nanoseconds

    def __str__(self) -> str:
        parts = [f"{self.level}: {self.path}"]
        if self.offset is not None:
            parts.append(f"byte {self.offset}")
        if self.time is not None:
            parts.append(millisecond_text(self.time))
        parts.append(f"{self.what} [{self.rule}]")
        line = ": ".join(parts) + (f"; {self.advice}" if self.advice else "")
        return printable(line[:_LENGTH])


@dataclass
class Findings:
    """The findings of one file: the first few of each rule, and the count of all."""

    path: Path
    shown: list[Finding] = field(default_factory=list)
    counts: Counter[tuple[Level, str]] = field(default_factory=Counter)  # by level and rule

    def error(
        self,
        rule: str,
        what: str,
        advice: str = "",
        *,
        offset: int | None = None,
        time: int | None = None,
    ) -> None:
        """Add a violation of the MCAP specification or of docs/log.md.

        The advice on what to do is empty if `what` is sufficient. `offset` is the byte of the file
        at which the record begins, `time` a log time in nanoseconds of UTC.
        """
        self._add(Finding(self.path, "error", rule, what, advice, offset, time))

    def warning(
        self,
        rule: str,
        what: str,
        advice: str = "",
        *,
        offset: int | None = None,
        time: int | None = None,
    ) -> None:
        """Add an incomplete part or a loss, as `error`."""
        self._add(Finding(self.path, "warning", rule, what, advice, offset, time))

    def rows(  # noqa: PLR0913
        self,
        rule: str,
        wrong: Bool,
        times: Int64,
        what: Callable[[int], str],
        level: Level = "error",
        *,
        advice: str = DISTRUST,
    ) -> None:
        """Add the rows [shape=(n,)] of a column that violate a rule; times are nanoseconds of UTC.

        `what` returns the text of a finding for a row number, from 0; it is called for the first
        five rows.
        """
        places = np.flatnonzero(wrong)
        advice = advice if level == "error" else ""
        for row in places[:_SHOWN].tolist():
            time = int(times[row])
            with np.errstate(over="ignore"):  # damaged numbers may have any value
                self._add(Finding(self.path, level, rule, what(row), advice, None, time))
        if len(places) > _SHOWN:
            self.counts[level, rule] += len(places) - _SHOWN

    def more(self) -> dict[tuple[Level, str], int]:
        """Return the number of findings that are not shown, by level and rule."""
        shown = Counter((finding.level, finding.rule) for finding in self.shown)
        return {kind: n - shown[kind] for kind, n in self.counts.items() if n > shown[kind]}

    def _add(self, finding: Finding) -> None:
        kind = finding.level, finding.rule
        self.counts[kind] += 1
        if self.counts[kind] <= _SHOWN:
            self.shown.append(finding)
