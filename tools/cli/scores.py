"""Scores as tables."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from hearthlog.schemas.errors import shortened
from hearthlog.tools.cli.table import NAME_WIDTH, print_confusion, print_table

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.event_scores import Detections
    from hearthlog.analyzer.evaluation.scenes import SceneScores, SingleCoughs
    from hearthlog.analyzer.training.scores import Bin, Interval, Scores

_CLASS = ("class", "support", "precision", "recall", "F1", "95 %")
_EVENTS = ("1-s F1", "event F1")


def print_scores(scores: "Scores", detections: "Detections | None" = None, hours: int = 24) -> None:
    """Print how good each class is, and which are taken for which; alarms are of some hours."""
    rows = [
        (
            shortened(name, NAME_WIDTH),
            str(one.support),
            *map(share, (one.precision, one.recall, one.f1)),
            between(one.f1_interval),
            *_events(detections, name, hours),
        )
        for name, one in scores.per_class.items()
    ]
    macro = map(share, (scores.macro_precision, scores.macro_recall, scores.macro_f1))
    interval = between(scores.macro_f1_interval)
    events = _events(detections, None, hours)
    rows.append(("macro", str(scores.segments), *macro, interval, *events))
    alarms = "false alarms/day" if hours == 24 else "false alarms/h"
    print_table((*_CLASS, *_EVENTS, alarms) if detections else _CLASS, rows)
    print()
    print_counts(scores.classes, scores.confusion)


def _events(detections: "Detections | None", name: str | None, hours: int) -> tuple[str, ...]:
    """Write the scores by events of a class, or of all."""
    if detections is None:
        return ()
    both = detections.segment_based, detections.event_based
    alarms = {name: n * hours / 24 for name, n in detections.false_alarms_per_day.items()}
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


def print_scenes(scenes: "Sequence[SceneScores]") -> None:
    """Print how good the labels of each scene are, and their means and ranges."""
    figures = [(one.macro_f1, one.event_f1, one.false_alarms_per_hour) for one in scenes]
    rows = [(f"seed {one.seed}", *_scene(row)) for one, row in zip(scenes, figures, strict=True)]
    if len(scenes) > 1:
        columns = list(zip(*figures, strict=True))
        rows.append(("mean", *_scene([sum(column) / len(column) for column in columns])))
        rows.append(("lowest", *_scene([min(column) for column in columns])))
        rows.append(("highest", *_scene([max(column) for column in columns])))
    print_table(("scene", "macro F1", "event F1", "false alarms/h"), rows)


def _scene(figures: Sequence[float]) -> tuple[str, str, str]:
    macro_f1, event_f1, alarms = figures
    return share(macro_f1), share(event_f1), f"{alarms:.1f}"


def print_coughs(coughs: "SingleCoughs") -> None:
    """Print what became of single coughs."""
    seconds = coughs.median_seconds
    length = "" if seconds is None else f", median label {seconds:.2f} s"
    print(
        f"\n{coughs.coughs} single coughs of 0.3 s: {coughs.found:.3f} found{length}; "
        f"{coughs.others:.2f} other labels a cough"
    )


def print_skipped(skipped: Mapping[str, int], what: str = "recordings") -> None:
    """Print how many recordings were left out, and why."""
    if skipped:
        print(f"\n{what} left out")
        print_table((), [(str(count), reason) for reason, count in skipped.items()], words=2)


def share(value: float | None) -> str:
    """Write a share, or - where there is none."""
    return "-" if value is None else f"{value:.3f}"


def between(interval: "Interval | None") -> str:
    """Write an interval, or - where there is none."""
    return "-" if interval is None else f"{interval[0]:.3f}-{interval[1]:.3f}"
