"""Statements on a surface about a composed day, and whether they are true."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from hearthlog.analyzer.activity.daily_metrics import HOUR, DayMetrics
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.tools.lab.true_day import TrueDay

HOLDS, LABELLED, FALSE = "holds", "wrong as labelled", "false"
REPORT, PAGE, INFO = "report", "page", "info"
TOLERANCE = 0.2
_MODEST = re.compile(r"labelled|up to|perhaps|by the sound of it", re.IGNORECASE)
_WORDS = (
    *("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"),
    *("eleven", "twelve", "once", "twice"),
)
_NUMBERS = dict(zip(_WORDS, [*range(13), 1, 2], strict=True))
NUMBER = rf"(?:\d+|{'|'.join(_NUMBERS)})"
_COUNT = re.compile(rf"({NUMBER})(?: to ({NUMBER}))?(?: times)?", re.IGNORECASE)
_LENGTH = re.compile(r"(?:(\d+) h )?([\d.]+) (min|s|h)\b")


class Statement(NamedTuple):
    """A statement on a surface, and the truth.

    Attributes
    ----------
    surface : str
        `report`, `page` or `info`.
    verdict : str
        `HOLDS`, `LABELLED` (wrong, but it says that it is as labelled) or `FALSE`.
    is_range : bool
        Whether it is a count with a range.
    """

    surface: str
    text: str
    truth: str
    verdict: str
    is_range: bool = False


def is_modest(text: str) -> bool:
    """Whether a text says that it is only as labelled."""
    return bool(_MODEST.search(text))


def is_close(number: float, true: float) -> bool:
    """Whether a number without a range is true: within a fifth, or within one."""
    return abs(number - true) <= max(1.0, TOLERANCE * true)


def read_count(text: str) -> tuple[int, int] | None:
    """Read a count or its range: `4 to 9 (12 labelled)`, `8`, `twice`; None if there is none."""
    match = _COUNT.match(text.strip())
    if match is None:
        return None
    low, high = (read_number(each) for each in (match[1], match[2] or match[1]))
    return low, high


def read_minutes(text: str) -> float | None:
    """Read a length of time in minutes: `1 h 05 min`, `under 1 min`; None if there is none."""
    match = _LENGTH.search(text)
    if match is None:
        return None
    number = float(match[2]) * {"min": 1, "s": 1 / 60, "h": 60}[match[3]]
    return 60 * int(match[1] or 0) + number * (0.5 if "under" in text else 1)


def read_number(text: str) -> int:
    """Read a number in digits or words."""
    return int(text) if text.isdigit() else _NUMBERS[text.lower()]


def judge(surface: str, text: str, truth: str, *, right: bool, modest: bool) -> Statement:
    """Return a statement that is right or not; a modest one that is wrong is not false."""
    return Statement(surface, text, truth, HOLDS if right else LABELLED if modest else FALSE)


def judge_count(
    surface: str, text: str, stated: tuple[int, int], true: float, *, modest: bool
) -> Statement:
    """Compare a count, or its range, with the true number."""
    low, high = stated
    if low == high:
        return judge(surface, text, f"{true:g}", right=is_close(low, true), modest=modest)
    right = low <= true <= high
    return Statement(surface, text, f"{true:g}", HOLDS if right else FALSE, is_range=True)


def judge_length(surface: str, text: str, stated: float, true: float, *, modest: bool) -> Statement:
    """Compare a length of time with the true one, both in minutes."""
    return judge(surface, text, f"{true:.1f} min", right=is_close(stated, true), modest=modest)


def judge_times(
    surface: str, text: str, name: str, clocks: Sequence[str], truth: TrueDay, *, modest: bool
) -> Statement:
    """Compare times of day with the true times of a class."""
    wrong = [each for each in clocks if not _is_true_time(truth, name, each)]
    stated = f"none at {', '.join(wrong)}" if wrong else "so it is"
    return judge(surface, text, stated, right=not wrong, modest=modest)


def _is_true_time(truth: TrueDay, name: str, clock: str) -> bool:
    day = truth.metrics
    times = [time_at(day, clock), time_at(day, clock) - 24 * HOUR]  # the evening before
    return any(truth.near(name, time) for time in times)


def time_at(day: DayMetrics, clock: str) -> int:
    """Return a time of day in nanoseconds of UTC."""
    hours, minutes = map(int, clock.split(":"))
    return int(day.span.starts[0]) + hours * HOUR + minutes * MINUTE
