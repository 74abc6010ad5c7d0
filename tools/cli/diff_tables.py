"""A difference between two labellings, and a queue of spans to review, as tables."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from hearthlog.schemas.errors import shortened
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.cli.table import NAME_WIDTH, print_confusion, print_table
from hearthlog.tools.cli.text import moment

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.event_scores import Amounts, LabellingDifference
    from hearthlog.analyzer.review.ranking import ReviewQueue

_AMOUNTS = "minutes a", "minutes b", "both", "events a", "events b", "agreement", "kappa"


def print_difference(difference: "LabellingDifference", spans: int) -> None:
    """Print agreement, amounts and confusion, and where the longest disagreements are."""
    a, b, days = difference.a, difference.b, list(difference.days)
    span = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    print(f"a: {a}, {difference.minutes_a:.1f} minutes")
    print(f"b: {b}, {difference.minutes_b:.1f} minutes")
    print(f"compared where both have a label; days are those of UTC, {span}")
    for name, only in ((a, difference.only_a), (b, difference.only_b)):
        if only:
            print(f"only {name} has: {', '.join(only)}")
    rows = list(_amounts("all", difference.total))
    if len(days) > 1:
        for day, amounts in difference.days.items():
            rows += [("",) * (1 + len(_AMOUNTS)), *_amounts(day, amounts)]
    print()
    print_table(("", *_AMOUNTS), rows)
    print()
    minutes = [[f"{value:.1f}" for value in row] for row in difference.confusion]
    title = "confusion in minutes: classes of a in rows, of b in columns"
    print_confusion(difference.classes, minutes, title)
    print()
    _print_disagreements(difference, spans)


def _amounts(title: str, amounts: "Amounts") -> Iterator[tuple[str, ...]]:
    classes = amounts.per_class.values()
    yield (
        title,
        *(f"{amounts.minutes:.1f}",) * 2,
        f"{amounts.minutes * amounts.agreement:.1f}",
        str(sum(one.events_a for one in classes)),
        str(sum(one.events_b for one in classes)),
        f"{amounts.agreement:.1%}",
        "-" if amounts.kappa is None else f"{amounts.kappa:.3f}",
    )
    for name, one in amounts.per_class.items():
        minutes = (f"{value:.1f}" for value in (one.minutes_a, one.minutes_b, one.minutes_both))
        events = str(one.events_a), str(one.events_b)
        yield f"  {shortened(name, NAME_WIDTH - 2)}", *minutes, *events, "", ""


def _print_disagreements(difference: "LabellingDifference", spans: int) -> None:
    count = len(difference.disagreements.starts)
    if not count:
        print("they never disagree")
        return
    which = "" if count <= spans else f": {spans} of them"
    print(f"{count} disagreements, longest first{which}")
    names = [shortened(name, NAME_WIDTH) for name in difference.classes]
    columns = (column[:spans].tolist() for column in difference.disagreements)
    rows = [
        (*_span(start, end), names[a], names[b]) for start, end, a, b in zip(*columns, strict=True)
    ]
    print_table(("start", "seconds", "a", "b"), rows, words=4)


def print_queue(queue: "ReviewQueue") -> None:
    """Print a row for each span, the most useful first."""
    spans = queue.spans
    figures = (queue.scores, queue.uncertainty, queue.disagreement, queue.novelty)
    rows = [
        (*_span(start, end), *(shortened(name, NAME_WIDTH) for name in names), *values)
        for start, end, names, values in zip(
            spans.starts.tolist(),
            spans.ends.tolist(),
            zip(queue.labels, queue.others, strict=True),
            zip(*([f"{value:.2f}" for value in column] for column in figures), strict=True),
            strict=True,
        )
    ]
    head = "start", "seconds", "label", "other label", "score", "unsure", "differ", "novel"
    print_table(head, rows, words=4)


def _span(start: int, end: int) -> tuple[str, str]:
    """Write when a span starts, and how many seconds it lasts."""
    return str(moment(start)), f"{(end - start) / NANOSECONDS:7.2f}"
