"""Scores as tables."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from hearthlog.schemas.text import shortened
from hearthlog.tools.cli.table import NAME_WIDTH, print_confusion, print_table

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.event_scores import Detections
    from hearthlog.analyzer.evaluation.grid_search import GridPoint
    from hearthlog.analyzer.training.scores import Bin, Interval, Scores

_CLASS = ("class", "support", "precision", "recall", "F1", "95 %")
_EVENTS = ("1-s F1", "event F1", "false alarms/day")


def print_scores(scores: "Scores", detections: "Detections | None" = None) -> None:
    """Print how good each class is, and which are taken for which."""
    rows = [
        (
            shortened(name, NAME_WIDTH),
            str(one.support),
            *map(share, (one.precision, one.recall, one.f1)),
            _between(one.f1_interval),
            *_events(detections, name),
        )
        for name, one in scores.per_class.items()
    ]
    macro = map(share, (scores.macro_precision, scores.macro_recall, scores.macro_f1))
    interval = _between(scores.macro_f1_interval)
    rows.append(("macro", str(scores.segments), *macro, interval, *_events(detections, None)))
    print_table((*_CLASS, *_EVENTS) if detections else _CLASS, rows)
    print()
    print_counts(scores.classes, scores.confusion)


def _events(detections: "Detections | None", name: str | None) -> tuple[str, ...]:
    """Write the scores by events of a class, or of all."""
    if detections is None:
        return ()
    both = detections.segment_based, detections.event_based
    alarms = detections.false_alarms_per_day
    if name is None:
        return *(share(one.macro_f1) for one in both), f"{sum(alarms.values()):.1f}"
    return *(share(one.per_class[name].f1) for one in both), f"{alarms[name]:.1f}"


def print_counts(classes: Sequence[str], confusion: Sequence[Sequence[int]]) -> None:
    """Print a confusion matrix of counts."""
    counts = [[str(count) for count in row] for row in confusion]
    print_confusion(classes, counts, "confusion: true class in rows, predicted in columns")


def print_reliability(bins: "Sequence[Bin]", error: float) -> None:
    """Print how sure the model is, and how often it is right then."""
    print(f"\nexpected calibration error {error:.3f}")
    rows = [(f"{one.confidence:.2f}", f"{one.accuracy:.2f}", str(one.count)) for one in bins]
    print_table(("sure", "right", "segments"), rows, words=0)


def print_search(tried: "Sequence[GridPoint]") -> None:
    """Print the scores of each method that was tried."""
    rows = [
        (
            *(f"{value:g}" for value in method.parameters.values()),
            f"{scores.macro_f1:.3f}",
            _between(scores.macro_f1_interval),
        )
        for method, scores in tried
    ]
    print_table((*tried[0].method.parameters, "macro F1", "95 %"), rows, words=0)


def print_skipped(skipped: Mapping[str, int], what: str = "recordings") -> None:
    """Print how many recordings were left out, and why."""
    if skipped:
        print(f"\n{what} left out")
        print_table((), [(str(count), reason) for reason, count in skipped.items()], words=2)


def share(value: float | None) -> str:
    """Write a share, or - where there is none."""
    return "-" if value is None else f"{value:.3f}"


def _between(interval: "Interval | None") -> str:
    return "-" if interval is None else f"{interval[0]:.3f}-{interval[1]:.3f}"
