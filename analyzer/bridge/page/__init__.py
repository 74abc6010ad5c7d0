"""Page of a home for a browser, with its texts in each language that has a file of them."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import date, timedelta, tzinfo
from functools import cache
from importlib.resources import files

from hearthlog.analyzer.activity.checked_minutes import UNMEASURED, Sureness
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import class_name, in_words
from hearthlog.schemas.errors import listed, printable, shortened

_LONGEST = 200  # characters of a text from a log
_LONGEST_NAME = 60
_WORKING = {"listening", "reading"}  # diagnostic texts of a working microphone
_FILES = "hearthlog.analyzer.bridge.page"
_LANGUAGE = re.compile(r"([a-z]{2,3})\.json")
_DEFAULT = "en"
_LONGEST_HEADER = 500  # characters of an `Accept-Language`
_CLASS = "class."
_TIMES = {0: "never", 1: "once", 2: "twice"}  # keys of counts that have a word
_MINUTE, _HOUR = 60, 60  # seconds and minutes
_WHOLE_MINUTES = 5  # from which on no half minute is written
_WITH_CAUSE = ("error.not saved", "error.not played")


class Translation:
    """The texts of a language, `en`, `de` …, by key, with placeholders in braces."""

    def __init__(self, language: str, texts: Mapping[str, str]) -> None:
        self.language = language
        self.texts = texts
        self._months, self._weekdays = texts["months"].split(), texts["weekdays"].split()

    def text(self, key: str, **values: object) -> str:
        """Return the text of a key, with values in place of its placeholders."""
        return self.texts[key].format(**values)

    def count(self, key: str, number: int) -> str:
        """Format a number of things: `12 seconds`."""
        return self.text(f"{key}.{'one' if number == 1 else 'other'}", count=self.number(number))

    def number(self, number: int) -> str:
        """Format a whole number: `1,204`."""
        return f"{number:,}".replace(",", self.texts["thousands"])

    def listed(self, texts: Sequence[str], last: str = "and") -> str:
        """Return texts as a list: `a, b and c`."""
        return listed(texts, self.texts[last])

    def translated(self, english: str) -> str:
        """Return the text in place of an English one of the same key; itself if there is none.

        An error that ends with a cause keeps the cause.
        """
        key = _keys_of_english().get(english)
        if key is not None:
            return self.texts[key]
        for key in _WITH_CAUSE:
            begin, _, _ = ENGLISH.texts[key].partition("{text}")
            if english.startswith(begin):
                return self.text(key, text=self.translated(english.removeprefix(begin)))
        return english

    def when(
        self, time: int, now: int, zone: tzinfo, *, seconds: bool = False, is_past: bool = False
    ) -> str:
        """Format a time relative to now: `14:05`, `yesterday 23:10`, `3 May 14:05`.

        If `now` is on a past day, no other day is called yesterday.
        """
        moment, today = local_time(time, zone), local_time(now, zone).date()
        shown = f"{moment:%H:%M:%S}" if seconds else f"{moment:%H:%M}"
        if moment.date() == today:
            return shown
        if not is_past and moment.date() == today - timedelta(days=1):
            return self.text("yesterday", time=shown)
        short = self.text("date", day=moment.day, month=self._months[moment.month - 1])
        return self.text("date and time", date=short, time=shown)

    def long_date(self, day: date) -> str:
        """Format a date: `Tuesday, 3 May`."""
        names = {"weekday": self._weekdays[day.weekday()], "month": self._months[day.month - 1]}
        return self.text("long date", day=day.day, **names)

    def short_date(self, day: date) -> str:
        """Format a date: `Tue, 3 May`."""
        weekday = self._weekdays[day.weekday()][: int(self.texts["letters of a short weekday"])]
        month = self._months[day.month - 1]
        return self.text("long date", weekday=weekday, day=day.day, month=month)

    def length(self, seconds: float) -> str:
        """Format a length of time: `12 seconds`, `1½ minutes`, `2 hours 10 minutes`.

        It has half minutes below five minutes.
        """
        if seconds < 1:
            return self.text("below a second")
        if round(seconds) < _MINUTE:
            return self.count("second", round(seconds))
        halves = int(2 * seconds / _MINUTE + 0.5)
        if halves < 2 * _WHOLE_MINUTES and halves % 2:
            return self.text("minute.other", count=f"{halves // 2}½")
        minutes = int(seconds / _MINUTE + 0.5)
        if minutes < _HOUR:
            return self.count("minute", minutes)
        hours, rest = divmod(minutes, _HOUR)
        return self.count("hour", hours) + (f" {self.count('minute', rest)}" if rest else "")

    def sureness(self, confidence: float, home: Sureness = UNMEASURED) -> str:
        """Return a word for the confidence of a model, as far as a home bears it out."""
        word = home.word(confidence)
        return self.text(word) if word else ""

    def times(self, count: int) -> str:
        """Format a count: `never`, `once`, `4 times`."""
        return self.text(_TIMES.get(count, "times"), count=self.number(count))

    def more_times(self, count: int, before: int) -> str:
        """Format a count, of at least one, in addition to another: `once more`.

        After `4 times` it is `3 more`, after `once` `3 more times`.
        """
        key = _TIMES.get(count, "times" if before in _TIMES else "count")
        return self.text(f"more.{key}", count=self.number(count))

    def clocks(self, clocks: Sequence[str]) -> str:
        """Return times of day as a list, one that recurs with how often: `23:04 twice, 23:37`."""
        counts = Counter(clocks)
        if len(counts) == len(clocks):
            return self.listed(clocks)
        return ", ".join(
            self.text("times in a minute", clock=each, times=self.times(count))
            if count > 1
            else each
            for each, count in counts.items()
        )

    def class_words(self, label: str) -> str:
        """Return the display name of a class, on one line of limited length."""
        words = self.texts.get(f"{_CLASS}{class_name(label)}") or in_words(label)
        return shortened(words, _LONGEST_NAME)

    def inside(self, words: str) -> str:
        """Return the display name of a class as it is written inside of a sentence."""
        return words.lower() if self.texts["page.nouns"] == "lower case" else words

    def inside_first(self, sentence: str) -> str:
        """Return a sentence that begins with a name as the later part of another one."""
        return self.inside(sentence[:1]) + sentence[1:]


@cache
def languages() -> frozenset[str]:
    """Return the languages with a file of texts."""
    names = (_LANGUAGE.fullmatch(each.name) for each in files(_FILES).iterdir())
    return frozenset(match[1] for match in names if match)


@cache
def translation_for(language: str) -> Translation:
    """Return the texts of a language; those of English if it has no file."""
    own = language if language in languages() else _DEFAULT
    return Translation(own, json.loads(files(_FILES).joinpath(f"{own}.json").read_text("utf-8")))


@cache
def _keys_of_english() -> dict[str, str]:
    return {text: key for key, text in translation_for(_DEFAULT).texts.items()}


def preferred_language(header: str) -> str:
    """Return the first language of an `Accept-Language` that has a file of texts, else English."""
    wanted: list[tuple[float, str]] = []
    for part in header[:_LONGEST_HEADER].lower().split(","):
        tag, _, weight = part.strip().partition(";q=")
        try:
            share = float(weight or 1)
        except ValueError:
            continue
        if 0 < share <= 1:
            wanted.append((-share, tag.partition("-")[0]))
    ordered = (tag for _, tag in sorted(wanted, key=lambda each: each[0]))
    return next((tag for tag in ordered if tag in languages()), _DEFAULT)


ENGLISH = translation_for(_DEFAULT)


def clock(time: int, zone: tzinfo) -> str:
    """Format the local time of day: `14:05`."""
    return f"{local_time(time, zone):%H:%M}"


def room(microphone: str) -> str:
    """Return the human-readable name of a microphone's room."""
    return shortened(microphone.replace("_", " ").capitalize(), _LONGEST_NAME)


def one_line(text: str) -> str:
    """Return a text from a log on one line of limited length."""
    return shortened(" ".join(printable(text).split()), _LONGEST)


def reason(text: str) -> str:
    """Return why a microphone does not listen by its last diagnostics; empty without a reason.

    They are `listening` if the recorder ended or was killed.
    """
    return "" if text in _WORKING else text
