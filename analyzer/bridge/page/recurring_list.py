"""The sounds that recur in a home, in words: first those that nobody has named."""

from collections.abc import Mapping
from datetime import tzinfo
from typing import Any, NamedTuple

from hearthlog.analyzer.bridge.page.words import class_words, length, room, times, when
from hearthlog.analyzer.discover.summary import GroupsSummary, GroupSummary, busiest_hours
from hearthlog.schemas.errors import listed
from hearthlog.schemas.frames import read_time

_MOST_UNNAMED, _MOST_NAMED = 10, 50
_LABELS = 2
_SPACE = "\N{NO-BREAK SPACE}"


class Moment(NamedTuple):
    """When something is told, in nanoseconds of UTC, and in which time zone."""

    now: int
    zone: tzinfo


def shown_groups(summary: GroupsSummary) -> dict[str, GroupSummary]:
    """Choose the groups that are shown, by keys that no group of another file has."""
    unnamed = [each for each in summary.groups if not each.name][:_MOST_UNNAMED]
    named = [each for each in summary.groups if each.name][:_MOST_NAMED]
    return {f"{each.number} of {summary.id}": each for each in [*unnamed, *named]}


def recurring_list(
    summary: GroupsSummary, looked: int, said: Mapping[str, str], moment: Moment
) -> Any:
    """Describe the sounds that recur for JSON.

    Parameters
    ----------
    looked : int
        When the summary was written, in nanoseconds of UTC.
    """
    shown = shown_groups(summary)
    left = sum(not each.name for each in summary.groups) - _MOST_UNNAMED
    is_alone = len({name for each in summary.groups for name in each.microphones}) <= 1
    return {
        "looked": when(min(max(looked, 0), moment.now), *moment),
        "more": f"{left} more without a name come later." if left > 0 else "",
        "groups": [
            _described(key, group, said.get(key, ""), moment, is_alone=is_alone)
            for key, group in shown.items()
        ],
    }


def group_words(group: GroupSummary) -> str:
    """Name a group as people do: `Door bell`, or `Sound 3` where it has no name."""
    return class_words(group.name) if group.name else f"Sound {group.number}"


def _described(key: str, group: GroupSummary, said: str, moment: Moment, *, is_alone: bool) -> Any:
    return {
        "id": key,
        "words": group_words(group),
        "is_named": bool(group.name),
        "about": _how_often(group),
        "heard": _heard_as(group),
        "listen": f"For instance {_examples(group, moment, is_alone=is_alone)}",
        "said": said,
    }


def _how_often(group: GroupSummary) -> str:
    days = "one day" if group.days == 1 else f"{group.days} days"
    hours = busiest_hours(group.hours).replace(" to ", " and ")
    usual = f", mostly between {hours} o'clock" if hours else ""
    often = times(group.times)
    return f"{often[0].upper()}{often[1:]} on {days}{usual}, {length(group.seconds)} each"


def _heard_as(group: GroupSummary) -> str:
    labels = [*group.labels.items()][:_LABELS]
    told = [f"{class_words(label)} ({100 * share:.0f}{_SPACE}%)" for label, share in labels]
    return f"Heard as {listed(told)}" if told else ""


def _examples(group: GroupSummary, moment: Moment, *, is_alone: bool) -> str:
    return listed(
        [
            when(read_time(each.start), *moment, seconds=True)
            + ("" if is_alone else f" ({room(each.microphone)})")
            for each in sorted(group.examples, key=lambda each: read_time(each.start))
        ],
        "and",
    )
