"""What sound can say to the questions of an interRAI Home Care assessment, in plain words.

The wording is ours, and item numbers are left out: they differ between the editions of the form,
whose text is licensed. Most questions of the form are about the last three days.
"""

from collections.abc import Callable
from typing import NamedTuple

from hearthlog.analyzer.report.class_words import several_in_words
from hearthlog.analyzer.report.daily_metrics import Day
from hearthlog.analyzer.report.values import Count, Minutes
from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    PHONE_RING,
    SHOWER,
    SPEECH,
    YELLING,
    in_words,
)

DAYS = 3


class Item(NamedTuple):
    """One question."""

    topic: str  # what the assessment asks about
    heard: str  # what is counted
    needs: str  # the class that must be known; empty if any sound will do
    value: Callable[[Day], Count | Minutes | None]  # counts it on one day
    limits: str  # what sound cannot tell


def _several(name: str) -> str:
    return several_in_words(name).lower()


ITEMS = (
    Item(
        "Sleep",
        "times with sound in the night",
        "",
        lambda day: day.night_stretches,
        "Whether the person slept, woke, or felt rested. A radio or a visitor sounds too.",
    ),
    Item(
        "Toilet use at night",
        f"{_several(FLUSHING_WATER)} in the night",
        FLUSHING_WATER,
        lambda day: day.night_count(FLUSHING_WATER),
        "Whether help was needed, or whether there was any incontinence.",
    ),
    Item(
        "Toilet use",
        f"{_several(FLUSHING_WATER)}, day and night",
        FLUSHING_WATER,
        lambda day: day.count(FLUSHING_WATER),
        "Toilet visits without a flush, and who used it.",
    ),
    Item(
        "Bathing",
        _several(SHOWER),
        SHOWER,
        lambda day: day.count(SHOWER),
        "Whether help was needed, and washing at the basin.",
    ),
    Item(
        "Coughing",
        f"{_several(COUGHING)}, day and night",
        COUGHING,
        lambda day: day.count(COUGHING),
        "The cause, or whether there is phlegm or shortness of breath.",
    ),
    Item(
        "Mood: crying",
        _several(CRYING),
        CRYING,
        lambda day: day.count(CRYING),
        "Who cried and why; a film sounds the same. Sadness is often silent.",
    ),
    Item(
        "Behaviour: shouting",
        _several(YELLING),
        YELLING,
        lambda day: day.count(YELLING),
        "At whom, or whether it was a call for help, anger or television.",
    ),
    Item(
        "Using the telephone",
        _several(PHONE_RING),
        PHONE_RING,
        lambda day: day.count(PHONE_RING),
        "Whether it was answered, by whom, and calls that the person made.",
    ),
    Item(
        "Company and conversation",
        f"{in_words(SPEECH).lower()}, in all",
        SPEECH,
        lambda day: day.minutes(SPEECH),
        "Who talked. Radio and television count as well; what was said is not kept.",
    ),
)
