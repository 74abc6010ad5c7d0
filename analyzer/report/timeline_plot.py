"""Picture of a day or a week as PNG, with the lanes of the page, printable in grey."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from hearthlog.analyzer.activity.daily_metrics import DayMetrics
from hearthlog.analyzer.report.timeline import (
    LOW,
    DayTimeline,
    HourBar,
    TimelineBlock,
    TimelineLane,
    hour_bars,
    timeline_of,
    week_timelines,
)
from hearthlog.schemas.arrays import Float64

_INK, _HATCH, _NIGHT, _LINE = "#1d2733", "#8a94a0", "#e9ecf1", "#c5ccd4"
_DOTS = 150  # per inch
_LEAST = 4.0  # steps: three pixels of the picture
_PALE = 0.36
_UNCOUNTED = (210 / 255, 94 / 255, 1 / 255, _PALE)


def save_timelines(path: Path, days: Sequence[DayMetrics], earlier: Sequence[DayMetrics]) -> None:
    """Draw a day, with the minutes with sound of each hour, or the days of a week."""
    rows = week_timelines(days) if len(days) > 1 else [("", timeline_of(days[0]))]
    timelines = [timeline for _, timeline in rows]
    lane_height = 0.3 if len(days) == 1 else 0.11
    lanes = sum(map(_lanes, timelines))
    heights = [lane_height * lanes + 0.1, *[1.1] * (len(days) == 1)]
    figure = Figure(figsize=(10, sum(heights) + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    _draw_lanes(axes[0], rows)
    if len(days) == 1:
        _draw_hours(axes[1], timelines[0], hour_bars(days[0], earlier))
    _draw_legend(figure, timelines)
    figure.savefig(path, format="png", dpi=_DOTS, metadata={"Software": None})


def _lanes(timeline: DayTimeline) -> int:
    """Return the height of a timeline in lanes: without lanes, two, which hold a line of text."""
    return len(timeline.lanes) or 2


def _draw_lanes(axes: Any, rows: Sequence[tuple[str, DayTimeline]]) -> None:
    """Draw lanes from top to bottom, those of a day together."""
    top, middles = 0, []
    for _, timeline in rows:
        height = _lanes(timeline)
        _draw_blocks(axes, timeline, timeline.nights, (top, height), color=_NIGHT)
        _draw_gaps(axes, timeline, timeline.gaps, (top, height))
        for block, text in timeline.unlogged:
            middle = (block.left + block.width / 2) * timeline.steps / 100
            if block.width >= _WRITTEN:
                level = top + height / 2
                axes.text(
                    middle,
                    level,
                    text,
                    ha="center",
                    va="center",
                    fontsize=8.5,
                    color=_HATCH,
                    backgroundcolor="white",
                )
        for place, lane in enumerate(timeline.lanes):
            _draw_gaps(axes, timeline, lane.gaps, (top + place, 1))
            _draw_lane(axes, lane, top + place)
        axes.axhline(top, color=_LINE, linewidth=0.8)
        middles.append(top + height / 2)
        top += height
    timelines = [timeline for _, timeline in rows]
    if len(rows) == 1:
        lanes = timelines[0].lanes
        axes.set_yticks(np.arange(len(lanes)) + 0.5, [_plain(lane.words) for lane in lanes])
        for place in range(1, len(lanes)):
            axes.axhline(place, color=_LINE, linewidth=0.6)
    else:
        axes.set_yticks(middles, [name for name, _ in rows])
    axes.set_ylim(top, 0)
    _draw_axis(axes, max(timelines, key=lambda timeline: timeline.steps))


def _draw_lane(axes: Any, lane: TimelineLane, top: int) -> None:
    colour = _shade(lane)
    for events, shade, height in (
        (lane.uncounted, (*colour, _PALE), 1.0),
        (lane.unsure, colour, LOW),
        (lane.counted, colour, 1.0),
    ):
        band = top + 0.12 + 0.76 * (1 - height), 0.76 * height
        axes.broken_barh(_at_least(events), band, facecolor=shade, lw=0, zorder=2)


def _shade(lane: TimelineLane) -> tuple[float, float, float]:
    red, green, blue = lane.colour
    return red / 255, green / 255, blue / 255


def _at_least(events: Float64) -> list[tuple[float, float]]:
    """Return starts and lengths that can be seen."""
    length = np.maximum(events[:, 1] - events[:, 0], _LEAST)
    starts = events.mean(axis=1) - length / 2
    return list(zip(starts.tolist(), length.tolist(), strict=True))


def _draw_blocks(
    axes: Any,
    timeline: DayTimeline,
    blocks: Sequence[TimelineBlock],
    band: tuple[float, float],
    **look: Any,
) -> None:
    share = timeline.steps / 100
    spans = [(block.left * share, block.width * share) for block in blocks]
    axes.broken_barh(spans, band, lw=0, **look)


def _draw_gaps(
    axes: Any, timeline: DayTimeline, blocks: Sequence[TimelineBlock], band: tuple[float, float]
) -> None:
    look = {"facecolor": "white", "edgecolor": _HATCH, "hatch": "////", "zorder": 1}
    _draw_blocks(axes, timeline, blocks, band, **look)


def _draw_hours(axes: Any, timeline: DayTimeline, bars: Sequence[HourBar]) -> None:
    """Draw the minutes with sound in each hour."""
    _draw_blocks(axes, timeline, timeline.nights, (0, 75), color=_NIGHT)
    _draw_gaps(axes, timeline, timeline.empty_hours, (0, 75))
    share = timeline.steps / 100
    for bar in bars:
        left, width = bar.left * share, bar.width * share
        look = {"align": "edge", "color": "#5b6b7c", "linewidth": 0, "zorder": 2}
        own = bar.minutes - bar.beside
        axes.bar(left, own, width * 0.84, **look)
        axes.bar(left, bar.beside, width * 0.84, bottom=own, alpha=_PALE, **look)
        usual = 0.0 if bar.usual is None else bar.usual.median
        if bar.minutes >= _NUMBERED:
            top, text = max(bar.minutes, usual) + 3, f"{bar.minutes:.0f}"
            axes.text(left + 0.42 * width, top, text, ha="center", fontsize=7.5)
        if bar.usual is not None:
            ends = (left, left + 0.84 * width), (usual, usual)
            axes.plot(*ends, color="black", lw=1.6)
            axes.plot(*ends, color="white", lw=0.5)
    axes.set_ylim(0, 75)
    axes.set_yticks((0, 30, 60))
    label = "minutes with sound\nin each hour"
    axes.set_ylabel(label, fontsize=8.5, rotation=0, ha="right", va="center", color=_INK)
    _draw_axis(axes, timeline)
    if timeline.hours_shown:
        axes.set_xlabel(f"only {timeline.hours_shown} is shown", fontsize=8.5, color=_INK)


_NUMBERED = 0.5
_WRITTEN = 15.0  # per cent of an axis


def _draw_axis(axes: Any, timeline: DayTimeline) -> None:
    axes.set_xlim(0, timeline.steps)
    places = [tick.left / 100 * timeline.steps for tick in timeline.ticks]
    axes.set_xticks(places, [tick.text for tick in timeline.ticks])
    axes.grid(axis="x", color=_LINE, linewidth=0.5, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=_INK)
    for side in axes.spines.values():
        side.set_color(_LINE)


def _draw_legend(figure: Any, timelines: Sequence[DayTimeline]) -> None:
    """Write what colours and hatching mean; the lanes of a day have their names beside them."""
    lanes = max((one.lanes for one in timelines), key=len) if len(timelines) > 1 else []
    entries = [Patch(color=_shade(lane), label=_plain(lane.words)) for lane in lanes]
    if any(timeline.nights for timeline in timelines):
        entries.append(Patch(color=_NIGHT, label="night"))
    if any(timeline.has_gaps for timeline in timelines):
        gap = Patch(facecolor="white", edgecolor=_HATCH, hatch="////", label="not listening")
        entries.append(gap)
    if any(timeline.has_unsure for timeline in timelines):
        entries.append(Patch(color=_HATCH, label="half as high: not sure"))
    if any(timeline.has_uncounted for timeline in timelines):
        entries.append(Patch(color=_UNCOUNTED, label="faint: beside a television"))
    figure.legend(handles=entries, loc="outside lower left", ncols=6, fontsize=8.5, frameon=False)


def _plain(text: str) -> str:
    return text.replace("$", r"\$")
