"""Addresses, labelling sources, days and texts for the home that a bridge follows."""

from datetime import timedelta, tzinfo

from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import in_words
from hearthlog.schemas.errors import printable, shortened

_LONGEST = 200  # characters of a text from a log
_LONGEST_NAME = 60
_SURE, _FAIRLY_SURE = 0.9, 0.7
_HEARD = {"listening", "reading"}  # diagnostic texts of a working microphone


def clock(time: int, zone: tzinfo) -> str:
    """Format the local time of day: `14:05`."""
    return f"{local_time(time, zone):%H:%M}"


def when(time: int, now: int, zone: tzinfo, *, seconds: bool = False) -> str:
    """Format a time relative to now: `14:05`, `yesterday 23:10`, `3 May 14:05`.

    Parameters
    ----------
    seconds : bool
        Whether to include seconds.
    """
    moment, today = local_time(time, zone), local_time(now, zone).date()
    shown = f"{moment:%H:%M:%S}" if seconds else f"{moment:%H:%M}"
    if moment.date() == today:
        return shown
    if moment.date() == today - timedelta(days=1):
        return f"yesterday {shown}"
    return f"{moment.day} {moment:%B} {shown}"


def long_date(time: int, zone: tzinfo) -> str:
    """Format a date: `Tuesday, 3 May`."""
    moment = local_time(time, zone)
    return f"{moment:%A}, {moment.day} {moment:%B}"


def length(seconds: float) -> str:
    """Format a length of time: `12 seconds`, `3 minutes`, `2 hours 10 minutes`."""
    if seconds < 1:
        return "less than a second"
    if seconds < 90:
        return _counted(round(seconds), "second")
    minutes = round(seconds / 60)
    if minutes < 90:
        return _counted(minutes, "minute")
    hours, rest = divmod(minutes, 60)
    return _counted(hours, "hour") + (f" {_counted(rest, 'minute')}" if rest else "")


def sureness(confidence: float) -> str:
    """Format the confidence of a model: `sure (95 %)`."""
    words = "not sure"
    if confidence >= _FAIRLY_SURE:
        words = "sure" if confidence >= _SURE else "fairly sure"
    return f"{words} ({100 * confidence:.0f} %)"


def times(count: int) -> str:
    """Format a count: `never`, `once`, `4 times`."""
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


def class_words(label: str) -> str:
    """Return the human-readable name of a class, on one line of limited length."""
    return shortened(in_words(label), _LONGEST_NAME)


def room(microphone: str) -> str:
    """Return the human-readable name of a microphone's room."""
    return shortened(microphone.replace("_", " ").capitalize(), _LONGEST_NAME)


def told(text: str) -> str:
    """Return a text from a log on one line of limited length."""
    return shortened(" ".join(printable(text).split()), _LONGEST)


def reason(text: str) -> str:
    """Return why a microphone does not listen; empty if its last diagnostics give no reason.

    Parameters
    ----------
    text : str
        Last diagnostics of the microphone: `listening` if the recorder ended or was killed.
    """
    return "" if text in _HEARD else text


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
