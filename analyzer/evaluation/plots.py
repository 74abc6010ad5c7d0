"""Plots of scores and scenes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hearthlog.analyzer.evaluation.scenes import ScenesEvaluation
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.training.scores import Bin, Scores
from hearthlog.models.classes import SILENCE, colour
from hearthlog.schemas.errors import shortened
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import new_file

_NAME_WIDTH = 16


def save_plot(path: Path, title: str, scores: Scores, bins: Sequence[Bin] = ()) -> None:
    """Draw the confusion matrix, F1 by class and, if there are bins, the reliability diagram.

    Raise `LogError` if the file exists, or cannot be written.
    """
    count = len(scores.classes)
    names = plot_names(scores.classes)
    figure = new_figure((9 + 0.45 * count, 3.5 + 0.45 * count), title)
    if bins:
        axes = figure.subplot_mosaic([["matrix", "f1"], ["matrix", "sure"]], width_ratios=(3, 2))
        _reliability(axes["sure"], bins)
    else:
        axes = figure.subplot_mosaic([["matrix", "f1"]], width_ratios=(3, 2))
    _matrix(axes["matrix"], scores, names)
    draw_f1(axes["f1"], scores, names)
    save_figure(figure, path)


def new_figure(inches: tuple[float, float], title: str) -> Figure:
    """Return an empty figure of a width and a height."""
    figure = Figure(figsize=inches, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a new PNG file.

    Raise `LogError` if the file exists, or cannot be written.
    """
    with new_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def plot_names(classes: Sequence[str]) -> list[str]:
    """Return class names as printed in figures."""
    return [shortened(name, _NAME_WIDTH).replace("$", r"\$") for name in classes]


def _matrix(axes: Any, scores: Scores, names: Sequence[str]) -> None:
    counts = np.array(scores.confusion)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for row, column in np.argwhere(counts > 0).tolist():
        axes.text(
            column,
            row,
            f"{100 * share[row, column]:.0f}",
            ha="center",
            va="center",
            color="white" if share[row, column] > 0.5 else "black",
        )
    axes.set_xticks(range(len(names)), names, rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(
        range(len(names)),
        [f"{name} ({n})" for name, n in zip(names, counts.sum(axis=1), strict=True)],
    )
    axes.set(title="confusion, % of the true class", xlabel="predicted", ylabel="true (support)")


def draw_f1(axes: Any, scores: Scores, names: Sequence[str]) -> None:
    """Draw a bar of F1 for each class, with its interval."""
    for place, one in enumerate(scores.per_class.values()):
        if one.f1 is None:
            continue
        axes.barh(place, one.f1, color="tab:blue", alpha=0.6)
        if one.f1_interval is not None:
            axes.plot(one.f1_interval, (place, place), color="black", linewidth=1.5)
    axes.axvline(scores.macro_f1, color="tab:red", linestyle="--", linewidth=1)
    if scores.macro_f1_interval is not None:
        axes.axvspan(*scores.macro_f1_interval, color="tab:red", alpha=0.1)
    axes.set_yticks(range(len(names)), names)
    axes.set(
        title=f"F1, 95 % intervals; macro {scores.macro_f1:.3f} (red)",
        xlim=(0, 1),
        ylim=(len(names) - 0.5, -0.5),
    )


def _reliability(axes: Any, bins: Sequence[Bin]) -> None:
    confidence, accuracy = ([getattr(b, name) for b in bins] for name in ("confidence", "accuracy"))
    share = np.array([b.count for b in bins]) / sum(b.count for b in bins)
    axes.plot((0, 1), (0, 1), color="grey", linestyle=":")
    axes.plot(confidence, accuracy, color="tab:blue")
    axes.scatter(confidence, accuracy, s=20 + 400 * share, color="tab:blue", alpha=0.6)
    axes.set(
        title="reliability (dots: share of segments)",
        xlabel="probability of the winning class",
        ylabel="how often it is right",
        xlim=(0, 1.02),
        ylim=(0, 1.05),
    )


_ROW_MINUTES = 10
_MOST_ROWS = 3


def save_scenes(path: Path, title: str, found: ScenesEvaluation) -> None:
    """Draw F1 and false alarms by class, and the first scene: truth above labels.

    Raise `LogError` if the file exists, or cannot be written.
    """
    names = plot_names(found.scores.classes)
    minutes = found.truth.ends.max() / NANOSECONDS / 60
    rows = int(min(np.ceil(minutes / _ROW_MINUTES), _MOST_ROWS))
    lanes = [f"lane {row}" for row in range(rows)]
    height = 1.5 + 0.32 * len(names)
    figure = new_figure((13, height + 0.9 * rows + 0.8), title)
    places: list[Any] = [["f1", "alarms"], *[[lane, lane] for lane in lanes]]
    axes = figure.subplot_mosaic(places, height_ratios=(height, *[0.9] * rows))
    draw_f1(axes["f1"], found.scores, names)
    alarms = [count / 24 for count in found.detections.false_alarms_per_day.values()]
    axes["alarms"].barh(range(len(names)), alarms, color="tab:red", alpha=0.6)
    axes["alarms"].set_yticks(range(len(names)), names)
    axes["alarms"].set(
        title=f"false alarms an hour; {sum(alarms):.0f} in all", ylim=(len(names) - 0.5, -0.5)
    )
    for row, lane in enumerate(lanes):
        _lane(axes[lane], found, row)
    axes[lanes[-1]].set_xlabel("minutes of the first scene")
    shown = [name for name in found.scores.classes if name != SILENCE]
    patches = [Patch(facecolor=_rgb(name), edgecolor="grey") for name in shown]
    figure.legend(
        patches, plot_names(shown), loc="outside lower center", ncols=min(len(shown), 9), fontsize=8
    )
    save_figure(figure, path)


def _lane(axes: Any, found: ScenesEvaluation, row: int) -> None:
    """Draw ten minutes of a labelled scene."""
    for base, labelling in ((1, found.truth), (0, found.found)):
        for name in sorted(set(labelling.labels) - {SILENCE}):
            spans = _minutes(labelling, name)
            axes.broken_barh(spans, (base + 0.06, 0.88), facecolor=_rgb(name), linewidth=0)
    axes.set_yticks((1.5, 0.5), ("truth", "labels"))
    axes.set(xlim=(row * _ROW_MINUTES, (row + 1) * _ROW_MINUTES), ylim=(0, 2))
    axes.axhline(1, color="black", linewidth=0.5)
    axes.set_facecolor("#e3e7ec")  # `unknown` is white


def _minutes(labelling: Labelling, name: str) -> list[tuple[float, float]]:
    """Return start and length of each span of a label."""
    rows = labelling.labels == name
    starts, ends = (times[rows] / NANOSECONDS / 60 for times in (labelling.starts, labelling.ends))
    return list(zip(starts.tolist(), (ends - starts).tolist(), strict=True))


def _rgb(name: str) -> tuple[float, float, float]:
    red, green, blue = colour(name)
    return red / 255, green / 255, blue / 255
