"""Scores of scenes as pictures."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Patch

from hearthlog.analyzer.colours import colour
from hearthlog.analyzer.evaluation.evaluate_scenes import ScenesEvaluation
from hearthlog.analyzer.evaluation.plot import draw_f1, new_figure, plot_names, save_figure
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.frames import NANOSECONDS

_ROW_MINUTES = 10
_MOST_ROWS = 3


def save_scenes(path: Path, title: str, found: ScenesEvaluation) -> None:
    """Draw F1 and false alarms by class, and the first scene: the truth above its labels.

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
    """Draw ten minutes of a scene."""
    for base, labelling in ((1, found.truth), (0, found.found)):
        for name in set(labelling.labels) - {SILENCE}:
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
