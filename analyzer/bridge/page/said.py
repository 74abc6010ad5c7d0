"""What people said of events, in the page and elsewhere: kept as marks in the logs' layers."""

import errno
from collections.abc import Iterator
from pathlib import Path
from threading import Lock

from hearthlog.analyzer.bridge.corrections import correct_event
from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.page.words import class_words
from hearthlog.analyzer.marks.marks import Mark, read_marks
from hearthlog.models.classes import CLASS_NAME, CLASSES, SILENCE, class_name
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.logs.files import find_logs, log_name, review_path
from hearthlog.schemas.messages.topics import spelt

REVIEWER = "page of the home"
READ_ONLY = (
    "It was not saved: the bridge may only read the logs, not write beside them. Whoever set up "
    "the box can change that."
)
_MOST_LOGS = 64  # whose marks are read: of more than a day and a half
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_BY_WORDS = {spelt(row.words): row.name for row in CLASSES}


class Said:
    """What people said of the events of a recorder."""

    def __init__(self, folder: Path, node: str) -> None:
        self._folder = folder
        self._node = node
        self._marks: list[Mark] = []
        self._own: dict[str, str] = {}  # labels by the ids of events
        self._lock = Lock()

    def read_back(self) -> None:
        """Read what the layers of the newest logs say.

        Raise `HearthlogError` if one of them is damaged.
        """
        logs = [log for log in find_logs(self._folder) if self._is_of_node(log)]
        marked = [log for log in logs[-_MOST_LOGS:] if review_path(log).exists()]
        self._marks = [mark for log in marked for mark in read_marks(log)]

    def of(self, event: Event) -> str:
        """Return what people said that an event was, in a few words; empty for nothing."""
        label = self._own.get(event.id)
        if label is not None:
            return f"You said: {_in_words(label)}"
        found = list(_over(event, self._marks))
        if not found:
            return ""
        mark = max(found, key=lambda mark: min(mark.end, event.end) - max(mark.start, event.start))
        who = "You said" if mark.reviewer == REVIEWER else "Marked"
        return f"{who}: {_in_words(mark.label)}"

    def say(self, event: Event, text: str) -> str:
        """Mark what an event was, and return that in words.

        Raise `BridgeError` if the text cannot be a class, or the event cannot be marked.
        """
        label = class_of(text)
        with self._lock:
            try:
                correct_event(self._folder, self._node, event, label, REVIEWER)
            except BridgeError as error:
                raise _explained(error) from error
            self._own[event.id] = label
            while len(self._own) > 1000:
                del self._own[next(iter(self._own))]
        return self.of(event)

    def _is_of_node(self, log: Path) -> bool:
        name = log_name(log)
        return name.node == self._node and not name.layer


def class_of(text: str) -> str:
    """Return the name of the class that somebody means: `Water tap` is `tap_water`.

    Raise `BridgeError` if no class can have this name.
    """
    spelling = spelt(text.strip()).strip("_")
    label = class_name(_BY_WORDS.get(spelling, spelling))
    if not CLASS_NAME.fullmatch(label):
        raise BridgeError(
            "This name cannot be used: write it with the letters a to z, digits and spaces, "
            "beginning with a letter."
        )
    return label


def _in_words(label: str) -> str:
    return "nothing" if label == SILENCE else class_words(label)


def _over(event: Event, marks: list[Mark]) -> Iterator[Mark]:
    for mark in marks:
        if (
            mark.microphone == event.microphone
            and mark.start < event.end
            and mark.end > event.start
        ):
            yield mark


def _explained(error: BridgeError) -> HearthlogError:
    """Say for people at home why something was not saved."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _FORBIDDEN:
            return BridgeError(READ_ONLY)
        cause = cause.__cause__
    return BridgeError(f"It was not saved: {error}")
