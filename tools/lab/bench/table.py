"""What was measured, beside what was aimed at, as text."""

from dataclasses import dataclass

_HEAD = ("", "measured", "", "elapsed", "ours/peer", "target", "", "")
_TO_THE_RIGHT = (1, 3, 4, 5)


@dataclass(frozen=True)
class Target:
    """A figure to reach, or with `at_most` not to exceed."""

    limit: float
    at_most: bool = False

    def met(self, value: float) -> bool:
        """Tell whether a measured value is good enough."""
        return value <= self.limit if self.at_most else value >= self.limit


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes
    ----------
    what : str
    value : float or None
        None if it could not be measured; the note then says why. Times are of CPU, over all
        threads and processes, unless `what` says otherwise.
    unit : str
    ratio : float or None
        How many times as fast as this peer we are.
    target : Target or None
        Of the ratio where there is one, else of the value.
    note : str
    elapsed : float or None
        Of a time of CPU the elapsed one, and of a speed the one by elapsed time; in the same unit.
    """

    what: str
    value: float | None
    unit: str = ""
    ratio: float | None = None
    target: Target | None = None
    note: str = ""
    elapsed: float | None = None

    @property
    def verdict(self) -> str:
        """`met`, `MISSED`, or nothing where nothing was aimed at or measured."""
        judged = self.value if self.ratio is None else self.ratio
        if self.target is None or judged is None:
            return ""
        return "met" if self.target.met(judged) else "MISSED"


@dataclass(frozen=True)
class Table:
    """The rows of one measurement, and under which conditions they were measured."""

    title: str
    rows: list[Row]

    @property
    def missing(self) -> list[str]:
        """What could not be measured."""
        return [row.what.strip() for row in self.rows if row.value is None]

    def __str__(self) -> str:
        """Align the rows in columns."""
        lines = [_HEAD, *map(_cells, self.rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        texts = ["  ".join(map(_padded, line, widths, range(len(line)))) for line in lines]
        return "\n".join([self.title, *(f"  {text}".rstrip() for text in texts)])


def _padded(cell: str, width: int, column: int) -> str:
    return cell.rjust(width) if column in _TO_THE_RIGHT else cell.ljust(width)


def _cells(row: Row) -> tuple[str, ...]:
    target = "" if row.target is None else f"{'≤≥'[not row.target.at_most]} {row.target.limit:,g}"
    ratio, elapsed = ("" if n is None else _number(n) for n in (row.ratio, row.elapsed))
    value = "-" if row.value is None else _number(row.value)
    return row.what, value, row.unit, elapsed, ratio, target, row.verdict, row.note


def _number(value: float) -> str:
    """Three digits at least: more than that no timing repeats."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
