"""A simulated quarter in lines and as a picture."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hearthlog.analyzer.evaluation.plots import new_figure, save_figure
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.tools.lab.quarter_scores import MICROPHONE_WEEK, WRONG_WEEK, Scored, Week

_INCHES = (9.0, 7.5)
_BAD = (WRONG_WEEK, "wrong marks"), (MICROPHONE_WEEK, "another microphone")


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
    """Draw F1 of frames, false events a day and the marks of each week, as PNG.

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
    known = _known()
    figure = new_figure(_INCHES, "a quarter of a simulated home, ten minutes of review a week")
    f1, false, asked = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
    _draw_two(f1, weeks, lambda one: one.macro_f1(known))
    f1.set(ylabel="macro F1 of frames", ylim=(0, 1))
    f1.legend(loc="lower left")
    for number, name in _BAD:
        if number <= len(weeks):
            f1.text(number, 0.02, name, ha="center", va="bottom", rotation=90, color="tab:red")
    _draw_two(false, weeks, lambda one: sum(one.false_events.values()))
    false.set(ylabel="false events in 24 h", yscale="log")
    numbers = [week.number for week in weeks]
    asked.bar(numbers, [week.minutes for week in weeks], color="tab:blue", alpha=0.5)
    asked.set(ylabel="minutes asked", xlabel="week", xticks=numbers)
    for axes in (f1, false, asked):
        _shade(axes, len(weeks))
    save_figure(figure, path)


def _known() -> list[str]:
    """List the classes of the starter model, which are what both can be scored on."""
    classes = load_model(starter_file(GENERAL)).classes
    return [name for name in classes if name != UNKNOWN]


def _draw_two(axes: Any, weeks: Sequence[Week], figure: Callable[[Scored], float]) -> None:
    numbers, alone = [week.number for week in weeks], [figure(week.alone) for week in weeks]
    axes.plot(numbers, alone, "s--", color="grey", label="starter alone")
    axes.plot(numbers, [figure(week.circle) for week in weeks], "-", color="tab:blue")
    for promoted, face, name in (
        (True, "tab:blue", "circle, its next model let label"),
        (False, "white", "circle, its next model refused"),
    ):
        some = [week for week in weeks if week.promoted == promoted]
        values = [figure(week.circle) for week in some]
        places = [week.number for week in some]
        axes.plot(places, values, "o", color="tab:blue", markerfacecolor=face, label=name)


def _shade(axes: Any, weeks: int) -> None:
    for number, _ in _BAD:
        if number <= weeks:
            axes.axvspan(number - 0.5, number + 0.5, color="tab:red", alpha=0.1)
