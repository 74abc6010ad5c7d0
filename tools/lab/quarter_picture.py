"""A simulated quarter in lines and as a picture."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hearthlog.analyzer.evaluation.plots import new_figure, save_figure
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.tools.lab.quarter_scores import MICROPHONE_WEEK, WRONG_WEEK, Scored, Week

_INCHES = (9.0, 7.5)
_BAD = (WRONG_WEEK, "Wrong marks"), (MICROPHONE_WEEK, "Another microphone")
_CIRCLE, _ALONE, _GREY = "#0072b2", "#d55e00", "#8a94a0"  # told apart without red and green


def line_of(week: Week) -> str:
    """Say a week in a line.

    Parameters
    ----------
    week : Week
    """
    known = _known()
    circle, alone = week.circle, week.alone
    became = "lets it label" if week.promoted else "refused" if week.trained else "no model"
    return (
        f"week {week.number:2} {week.model:8} F1 {circle.macro_f1(known):.3f} "
        f"(starter {alone.macro_f1(known):.3f}), silence {circle.f1([SILENCE])[SILENCE]:.3f}, "
        f"false events {sum(circle.false_events.values()):.0f} "
        f"({sum(alone.false_events.values()):.0f}); {week.marks} marks, {week.spans} spans, "
        f"{week.random} minutes in {week.minutes:.1f} min; {became}"
    )


def save_picture(path: Path, weeks: Sequence[Week]) -> None:
    """Draw F1 of frames, false events a day and the minutes of review of each week, as PNG.

    Parameters
    ----------
    path : Path
        Must not exist.
    weeks : sequence of Week

    Raises
    ------
    LogError
        If the file exists, or cannot be written.
    """
    save_figure(quarter_figure(weeks), path)


def quarter_figure(weeks: Sequence[Week]) -> Any:
    """Return the figure of a quarter: three panels over the weeks."""
    known = _known()
    figure = new_figure(_INCHES, "A quarter of a simulated home, ten minutes of review a week")
    f1, false, minutes = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
    _draw_two(f1, weeks, lambda one: one.macro_f1(known))
    f1.set(ylim=(0, 1))
    f1.set_title("How much is labelled right (macro F1 of frames)", loc="left", pad=22)
    _draw_two(false, weeks, lambda one: sum(one.false_events.values()))
    false.set(yscale="log")
    false.yaxis.set_major_formatter("{x:,.0f}")
    false.set_title("False events a day", loc="left")
    numbers = [week.number for week in weeks]
    minutes.bar(numbers, [week.minutes for week in weeks], color=_GREY)
    minutes.set(xlabel="Week", xticks=numbers)
    minutes.yaxis.get_major_locator().set_params(integer=True)
    minutes.set_title("Minutes of questions a week", loc="left")
    for number, name in _BAD:
        if number <= len(weeks):
            above = f1.get_xaxis_transform()
            f1.text(number, 1.02, name, ha="center", va="bottom", transform=above)
            for axes in (f1, false, minutes):
                axes.axvspan(number - 0.5, number + 0.5, color=_GREY, alpha=0.25, lw=0, zorder=0)
    figure.legend(*f1.get_legend_handles_labels(), loc="outside lower left", ncols=3, frameon=False)
    return figure


def _known() -> list[str]:
    """List the classes of the starter model, which are what both can be scored on."""
    classes = load_model(starter_file(GENERAL)).classes
    return [name for name in classes if name != UNKNOWN]


def _draw_two(axes: Any, weeks: Sequence[Week], figure: Callable[[Scored], float]) -> None:
    numbers, alone = [week.number for week in weeks], [figure(week.alone) for week in weeks]
    circle = [figure(week.circle) for week in weeks]
    axes.plot(numbers, circle, "o-", color=_CIRCLE, label="Corrected every week: the circle")
    refused = [row for row, week in enumerate(weeks) if not week.promoted]
    places, values = ([each[row] for row in refused] for each in (numbers, circle))
    look = {"color": _CIRCLE, "markerfacecolor": "white"}
    axes.plot(places, values, "o", label="Its next model is refused", **look)
    axes.plot(numbers, alone, "s--", color=_ALONE, label="Starter model alone")
