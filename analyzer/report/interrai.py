"""What sound can say to the questions of an interRAI Home Care assessment, in plain words.

The wording is ours, and item numbers are left out: they differ between the editions of the form,
whose text is licensed. Most questions of the form are about the last three days.
"""

from collections.abc import Callable
from typing import NamedTuple

from hearthlog.analyzer.report import words
from hearthlog.analyzer.report.figures import Day
from hearthlog.analyzer.report.values import Count, Minutes

DAYS = 3


class Item(NamedTuple):
    """One question.

    Attributes
    ----------
    topic : str
        What the assessment asks about.
    heard : str
        What is counted.
    needs : str
        The class that must be known; empty if any sound will do.
    value : callable
        Counts it on one day.
    limits : str
        What sound cannot tell.
    """

    topic: str
    heard: str
    needs: str
    value: Callable[[Day], Count | Minutes | None]
    limits: str


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
        "toilet flushes in the night",
        words.FLUSH,
        lambda day: day.night_count(words.FLUSH),
        "Whether help was needed, or whether there was any incontinence.",
    ),
    Item(
        "Toilet use",
        "toilet flushes, day and night",
        words.FLUSH,
        lambda day: day.count(words.FLUSH),
        "Toilet visits without a flush, and who used it.",
    ),
    Item(
        "Bathing",
        "showers",
        words.SHOWER,
        lambda day: day.count(words.SHOWER),
        "Whether help was needed, and washing at the basin.",
    ),
    Item(
        "Coughing",
        "bouts of coughing, day and night",
        words.COUGH,
        lambda day: day.count(words.COUGH),
        "The cause, or whether there is phlegm or shortness of breath.",
    ),
    Item(
        "Mood: crying",
        "times of crying",
        words.CRY,
        lambda day: day.count(words.CRY),
        "Who cried and why; a film sounds the same. Sadness is often silent.",
    ),
    Item(
        "Behaviour: shouting",
        "times of shouting",
        words.SHOUT,
        lambda day: day.count(words.SHOUT),
        "At whom, or whether it was a call for help, anger or television.",
    ),
    Item(
        "Using the telephone",
        "times the telephone rang",
        words.PHONE,
        lambda day: day.count(words.PHONE),
        "Whether it was answered, by whom, and calls that the person made.",
    ),
    Item(
        "Company and conversation",
        "talking, in all",
        words.SPEECH,
        lambda day: day.minutes(words.SPEECH),
        "Who talked. Radio and television count as well; what was said is not kept.",
    ),
)
