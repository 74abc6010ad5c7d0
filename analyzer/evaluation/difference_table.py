"""A difference as lines of text, at most 100 characters wide."""

from collections.abc import Iterator, Sequence

from hearthlog.analyzer.evaluation.difference import Amounts, Difference
from hearthlog.analyzer.evaluation.table import WIDTH, shown
from hearthlog.schemas.times import NANOSECONDS, time_text

NAME_WIDTH = 18


def difference_table(difference: Difference, spans: int) -> Iterator[str]:
    """Yield agreement, amounts and confusion, and where the longest disagreements are."""
    found = difference
    yield f"a: {found.a}, {found.minutes_a:.1f} minutes"
    yield f"b: {found.b}, {found.minutes_b:.1f} minutes"
    yield f"compared where both have a label; days are those of UTC, {_days(found)}"
    for name, only in ((found.a, found.only_a), (found.b, found.only_b)):
        if only:
            yield f"only {name} has: {', '.join(only)}"
    yield ""
    yield _HEAD
    yield from _amounts("all", found.total)
    if len(found.days) > 1:
        for day, amounts in found.days.items():
            yield ""
            yield from _amounts(day, amounts)
    yield ""
    yield from _confusion(found)
    yield ""
    yield from _disagreements(found, spans)


_HEAD = (
    f"{'':{NAME_WIDTH}} {'minutes a':>10} {'minutes b':>10} {'both':>10} {'events a':>9} "
    f"{'events b':>9} {'agreement':>10} {'kappa':>6}"
)


def _amounts(title: str, amounts: Amounts) -> Iterator[str]:
    events_a = sum(one.events_a for one in amounts.per_class.values())
    events_b = sum(one.events_b for one in amounts.per_class.values())
    both = amounts.minutes * amounts.agreement
    kappa = "-" if amounts.kappa is None else f"{amounts.kappa:.3f}"
    yield (
        f"{title:{NAME_WIDTH}} {amounts.minutes:10.1f} {amounts.minutes:10.1f} {both:10.1f} "
        f"{events_a:9} {events_b:9} {amounts.agreement:10.1%} {kappa:>6}"
    )
    for name, one in amounts.per_class.items():
        yield (
            f"  {shown(name):{NAME_WIDTH - 2}} {one.minutes_a:10.1f} {one.minutes_b:10.1f} "
            f"{one.minutes_both:10.1f} {one.events_a:9} {one.events_b:9}"
        )


def _confusion(difference: Difference) -> Iterator[str]:
    named = list(zip(difference.classes, difference.confusion, strict=True))
    rows = [(name, [f"{minutes:.1f}" for minutes in row]) for name, row in named]
    size = max(len(value) for _, row in rows for value in row) + 2
    if NAME_WIDTH + size * len(rows) > WIDTH:
        yield "confusion: too many classes for a table; --json has it"
        return
    yield "confusion in minutes: classes of a in rows, of b in columns"
    for name, row in rows:
        yield f"{shown(name):{NAME_WIDTH}}" + "".join(f"{value:>{size}}" for value in row)


def _disagreements(difference: Difference, spans: int) -> Iterator[str]:
    runs, classes = difference.disagreements, difference.classes
    count = len(runs.starts)
    if not count:
        yield "they never disagree"
        return
    yield f"{count} disagreements, longest first{'' if count <= spans else f': {spans} of them'}"
    yield f"{'start':24} {'seconds':>7}  {'a':{NAME_WIDTH}} b"
    for start, end, a, b in zip(*(column[:spans].tolist() for column in runs), strict=True):
        yield f"{span_text(start, end)}  {shown(classes[a]):{NAME_WIDTH}} {shown(classes[b])}"


def span_text(start: int, end: int) -> str:
    """Write when a span starts, and how many seconds it lasts."""
    return f"{time_text(start)[:23]}Z {(end - start) / NANOSECONDS:7.2f}"


def _days(difference: Difference) -> str:
    days: Sequence[str] = list(difference.days)
    return days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
