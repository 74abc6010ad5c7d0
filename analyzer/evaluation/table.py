"""Scores as lines of text, at most 100 characters wide."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from hearthlog.analyzer.evaluation.event_scores import Detections
from hearthlog.analyzer.training.scores import Bin, Interval, Scores
from hearthlog.schemas.text import printable

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.grid_search import Tried  # which imports scikit-learn

WIDTH = 100
_NAME = 16  # objects_activity


def class_table(scores: Scores, detections: Detections | None = None) -> Iterator[str]:
    """Yield a line for each class, and its mean."""
    head = (
        f"{'class':{_NAME}} {'support':>8} {'precision':>9} {'recall':>6} {'F1':>6}   95 %       "
    )
    if detections is not None:
        head += f"{'1-s F1':>7} {'event F1':>9} {'false alarms/day':>17}"
    yield head.rstrip()
    for name, one in scores.per_class.items():
        line = (
            f"{shown(name):{_NAME}} {one.support:8} {_share(one.precision):>9} "
            f"{_share(one.recall):>6} {_share(one.f1):>6}   {_between(one.f1_interval)}"
        )
        if detections is not None:
            by_second = detections.segment_based.per_class[name].f1
            by_event = detections.event_based.per_class[name].f1
            alarms = detections.false_alarms_per_day[name]
            line += f"{_share(by_second):>7} {_share(by_event):>9} {alarms:17.1f}"
        yield line
    line = (
        f"{'macro':{_NAME}} {scores.segments:8} {scores.macro_precision:9.3f} "
        f"{scores.macro_recall:6.3f} {scores.macro_f1:6.3f}   {_between(scores.macro_f1_interval)}"
    )
    if detections is not None:
        by_second, by_event = detections.segment_based.macro_f1, detections.event_based.macro_f1
        alarms = sum(detections.false_alarms_per_day.values())
        line += f"{_share(by_second):>7} {_share(by_event):>9} {alarms:17.1f}"
    yield line


def confusion_table(scores: Scores) -> Iterator[str]:
    """Yield the confusion matrix, if it is narrow enough."""
    size = max(len(str(value)) for row in scores.confusion for value in row) + 2
    if _NAME + size * len(scores.classes) > WIDTH:
        yield "confusion: too many classes for a table; --json and --plot have it"
        return
    yield "confusion: true class in rows, predicted in columns"
    for name, row in zip(scores.classes, scores.confusion, strict=True):
        yield f"{shown(name):{_NAME}}" + "".join(f"{value:{size}}" for value in row)


def reliability_table(bins: Sequence[Bin], error: float) -> Iterator[str]:
    """Yield how sure the model is and how often it is right."""
    yield f"expected calibration error {error:.3f}"
    for title, values in (
        ("sure", [f"{b.confidence:.2f}" for b in bins]),
        ("right", [f"{b.accuracy:.2f}" for b in bins]),
        ("segments", [str(b.count) for b in bins]),
    ):
        yield f"{title:9}" + "".join(f"{value:>6}" for value in values)


def search_table(tried: Sequence["Tried"]) -> Iterator[str]:
    """Yield a line for each method that was tried."""
    names = "".join(f"{name:>8} " for name in tried[0].method.parameters)
    yield f"{names}{'macro F1':>9}   95 %"
    for method, scores in tried:
        values = "".join(f"{value:8g} " for value in method.parameters.values())
        yield f"{values}{scores.macro_f1:9.3f}   {_between(scores.macro_f1_interval)}"


def shown(name: str) -> str:
    """Return a name as it can be printed, shortened if it is long."""
    return printable(name if len(name) <= _NAME else name[: _NAME - 1] + "…")


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _between(interval: Interval | None) -> str:
    return f"{'-':^11}" if interval is None else f"{interval[0]:.3f}-{interval[1]:.3f}"
