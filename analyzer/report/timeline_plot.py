"""Timeline picture of a day or a week, printable in grey."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hearthlog.analyzer.activity.daily_metrics import HOUR, DayMetrics
from hearthlog.analyzer.activity.values import Duration, UsualRange, usual_range
from hearthlog.analyzer.colours import colour_on_paper
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, local_time
from hearthlog.analyzer.logs.spans import Spans, lengths, without
from hearthlog.analyzer.report.wording import short_day
from hearthlog.models.classes import SILENCE, in_words
from hearthlog.schemas.arrays import Int64

_DAY_BINS, _WEEK_BINS = 30, 6  # per hour
_LEAST = 0.35  # of a lane's height, so that short sounds such as a cough stay visible
_INK, _PALE, _NIGHT = "#1d2733", "#8a94a0", "#e9ecf1"
_DOTS = 150  # per inch


def save_day(path: Path, day: DayMetrics, earlier: Sequence[DayMetrics]) -> None:
    """Draw a day: a lane per class, and the minutes with sound in each hour."""
    names = _names(day)
    heights = [0.34 * len(names) + 0.1, 1.15]
    figure = Figure(figsize=(10, sum(heights) + 0.95), layout="constrained")
    FigureCanvasAgg(figure)
    lanes, hours = figure.subplots(2, 1, sharex=True, height_ratios=heights)
    _lanes(lanes, names, [day], _DAY_BINS)
    _hours(hours, day, earlier)
    _save(figure, path)


def save_week(path: Path, days: Sequence[DayMetrics]) -> None:
    """Draw a week: seven lanes per class, the first day at the top."""
    names = _names(*days)
    figure = Figure(figsize=(10, 0.66 * len(names) + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _lanes(axes, names, days, _WEEK_BINS)
    _save(figure, path)


def _names(*days: DayMetrics) -> list[str]:
    return [name for name in days[0].home.classes if name != SILENCE]


def _lanes(axes: Any, names: Sequence[str], days: Sequence[DayMetrics], bins: int) -> None:
    """Draw a block per class, with a line per day."""
    count = len(days)
    for place, name in enumerate(names):
        face = tuple(part / 255 for part in colour_on_paper(name))
        for line, day in enumerate(days):
            edges = _edges(day, bins)
            filled = lengths(day.home.spans[name], edges) / np.maximum(np.diff(edges), 1)
            heights = np.where(filled > 0, np.maximum(filled, _LEAST), 0)
            base = place + (line + 0.92) / count
            tops = base - heights * 0.84 / count
            axes.stairs(tops, _hours_of(day, edges), baseline=base, fill=True, color=face, lw=0)
    for line, day in enumerate(days):
        for place, name in enumerate(names):
            _unheard(axes, day, day.home.listened[name], (place + line / count, 1 / count))
    for place in range(1, len(names)):
        axes.axhline(place, color="#c5ccd4", linewidth=0.6)
    axes.set_yticks(np.arange(len(names)) + 0.5, [_plain(in_words(name)) for name in names])
    axes.set_ylim(max(len(names), 1), 0)
    _dress(axes, max(days, key=lambda day: day.span.length))
    if count > 1:
        axes.set_title(
            f"Each block: {short_day(days[0].day)} at the top, {short_day(days[-1].day)} at the "
            "bottom",
            fontsize=9,
            color=_INK,
            loc="left",
        )


def _hours(axes: Any, day: DayMetrics, earlier: Sequence[DayMetrics]) -> None:
    """Draw the minutes with sound in each hour, and the usual range."""
    minutes = day.sound_by_hour
    places = np.arange(len(minutes))
    axes.bar(places, minutes, width=0.84, align="edge", color="#5b6b7c")
    for place, (number, baseline) in enumerate(
        zip(minutes, _usual_hours(day, earlier), strict=True)
    ):
        top = max(number, 0.0 if baseline is None else baseline.median)
        if number >= 0.5:
            axes.text(place + 0.42, top + 3, f"{number:.0f}", ha="center", fontsize=7.5)
        if baseline is not None:
            axes.plot(
                (place, place + 0.84), (baseline.median, baseline.median), color="black", lw=1.6
            )
            axes.plot(
                (place, place + 0.84), (baseline.median, baseline.median), color="white", lw=0.5
            )
    _unheard(axes, day, day.coverage, (0, 75))
    axes.set_ylim(0, 75)
    axes.set_yticks((0, 30, 60))
    label = "minutes with sound\nin each hour"
    axes.set_ylabel(label, fontsize=8.5, rotation=0, ha="right", va="center", color=_INK)
    _dress(axes, day)
    axes.tick_params(labelbottom=True)


def _usual_hours(day: DayMetrics, earlier: Sequence[DayMetrics]) -> list[UsualRange | None]:
    """Return the usual range of each hour; None where the clock was changed."""
    same = [each.sound_by_hour for each in earlier if len(each.hours) == len(day.hours)]
    columns: list[NDArray[np.float64]] = list(np.array(same).T) if same else []
    hours = [usual_range([Duration(float(number)) for number in column]) for column in columns]
    return hours or [None] * (len(day.hours) - 1)


def _unheard(axes: Any, day: DayMetrics, coverage: Spans, band: tuple[float, float]) -> None:
    """Hatch visible gaps in the coverage."""
    edges = _edges(day, _DAY_BINS)
    missing = without(day.span, coverage)
    empty = lengths(missing, edges) > np.diff(edges) / 2
    bounds = np.flatnonzero(np.diff(np.concatenate([[False], empty, [False]]).astype(int)))
    hours = _hours_of(day, edges)
    wide = [(hours[a], hours[b] - hours[a]) for a, b in bounds.reshape(-1, 2).tolist()]
    if wide:
        axes.broken_barh(wide, band, facecolor="white", edgecolor=_PALE, hatch="////", lw=0)


def _edges(day: DayMetrics, bins: int) -> Int64:
    start, end = int(day.span.starts[0]), int(day.span.ends[0])
    return np.append(np.arange(start, end, HOUR // bins), end)


def _hours_of(day: DayMetrics, times: Int64) -> NDArray[np.float64]:
    return (times - day.span.starts[0]) / HOUR


def _dress(axes: Any, day: DayMetrics) -> None:
    """Mark hours and the night; days of 23 or 25 hours use local clock times."""
    hours = day.hours
    clock = [local_time(int(time), day.zone).hour for time in hours[:-1]]
    for place, hour in enumerate(clock):
        if not MORNING <= hour < EVENING:
            axes.axvspan(place, place + 1, color=_NIGHT, lw=0, zorder=0)
    axes.set_xlim(0, _hours_of(day, hours)[-1])
    every = [place for place, hour in enumerate(clock) if hour % 2 == 0]
    axes.set_xticks(every, [f"{clock[place]:02}" for place in every])
    axes.grid(axis="x", color="#c5ccd4", linewidth=0.5, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=_INK)
    for side in axes.spines.values():
        side.set_color("#c5ccd4")


def _plain(text: str) -> str:
    return text.replace("$", r"\$")


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, format="png", dpi=_DOTS, metadata={"Software": None})
