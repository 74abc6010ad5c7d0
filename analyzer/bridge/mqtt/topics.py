"""MQTT topics: names, and the record of topics that the broker retains."""

import fcntl
import os
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import NamedTuple, Protocol
from urllib.parse import quote, unquote

from pydantic import BaseModel

from hearthlog.analyzer.activity.events import SoundEvent
from hearthlog.analyzer.bridge.state import StateFile
from hearthlog.schemas.new_files import open_lock, private_folder

_KEPT = "".join(chr(code) for code in range(33, 127) if chr(code) not in "%+#/$")


CONFIG, TOLD = "config", "told"  # kinds of places


class Place(NamedTuple):
    """The subject of a topic; parts that do not apply are empty."""

    kind: str
    microphone: str = ""
    label: str = ""


class Topics(NamedTuple):
    """Topic names of one recorder."""

    base: str
    node: str

    @property
    def root(self) -> str:
        """Common prefix of the recorder's topics."""
        return f"{self.base}/{self.node}"

    def at(self, kind: str, microphone: str = "", label: str = "") -> str:
        """Return the topic of a place of any kind but `config`, which uses discovery topics.

        Parameters
        ----------
        kind : str
            Of the recorder, such as `bridge`; of a microphone, such as `heard`; or of a class, such
            as `on`, or `told`, which shows whether its events are published.
        label : str, optional
            The class; characters that are invalid in topics or not ASCII are percent-encoded, such
            as `%2B`.
        """
        part = quote(label, safe=_KEPT)
        if kind == TOLD:
            return f"{self.root}/told/{part}"
        if label:
            return f"{self.root}/{microphone}/class/{part}/{kind}"
        return f"{self.root}/{microphone}/{kind}" if microphone else f"{self.root}/{kind}"

    def parse(self, topic: str) -> Place | None:
        """Return the place of a topic, the inverse of `at`; None for other topics."""
        parts = topic.removeprefix(f"{self.root}/").split("/")
        match parts:
            case [kind]:
                place = Place(kind)
            case ["told", label]:
                place = Place(TOLD, label=unquote(label))
            case [microphone, kind]:
                place = Place(kind, microphone)
            case [microphone, "class", label, kind]:
                place = Place(kind, microphone, unquote(label))
            case _:
                return None
        return place if self.at(*place) == topic else None


def identifier(text: str) -> str:
    """Escape a text for an identifier; different texts give different results."""
    escaped = r"[^a-z0-9_]|_(?=[0-9a-f]+[^a-z0-9])"
    return re.sub(escaped, lambda match: f"_{ord(match[0]):x}_", text)


_PREFIX, _SUFFIX = "mqtt-", ".json"  # around the name of the recorder
_UNSAVED = "topics that go are not cleared after the next start"


class _Content(BaseModel, extra="forbid"):
    broker: str = ""
    topics: dict[str, Place] = {}
    muted: list[str] = []
    last_events: dict[str, str] = {}  # id of the last published event, by microphone


class _IsRenamed(Protocol):
    def __call__(self, former: str, /, *, is_first: bool) -> bool: ...


class RetainedTopics:
    """Persistent record of retained topics, muted classes and last published events."""

    def __init__(
        self,
        folder: Path,
        node: str,
        broker: str,
        is_renamed: _IsRenamed,
        say: Callable[[str], None],
    ) -> None:
        self.path = folder / f"{_PREFIX}{node}{_SUFFIX}"
        self._report = say
        self._lock = Lock()
        self._is_changed = False
        self._descriptor = self._take_lock(folder)
        has_own = self.path.exists()
        # Files of former recorder names, with locks that keep other bridges from using them.
        self._former: dict[Path, int] = {}
        if self._descriptor is not None:
            for path in sorted(folder.glob(f"{_PREFIX}*{_SUFFIX}")):
                former = path.name.removeprefix(_PREFIX).removesuffix(_SUFFIX)
                if path != self.path and is_renamed(former, is_first=not has_own):
                    self._take_over(path)
        sources = [*self._former, *([self.path] if has_own else [])]
        self.is_new = self._descriptor is None or not sources
        contents = [] if self.is_new else [self._file(source).load() for source in sources]
        self._is_changed = bool(self._former)
        self._broker = broker
        self.topics: dict[str, Place] = {}
        # Kept if the broker's address changes: it may be the same broker; a new one has no topics.
        self._muted: set[str] = set()
        self._last_events: dict[str, str] = {}
        for each in filter(None, contents):
            self.topics |= each.topics
            self._muted.update(each.muted)
            self._last_events |= each.last_events

    def add(self, topic: str, place: Place) -> None:
        """Record a topic with a retained value."""
        with self._lock:
            if self.topics.get(topic) != place:
                self.topics[topic] = place
                self._is_changed = True

    def remove(self, topics: Iterable[str]) -> None:
        """Remove topics that were cleared at the broker."""
        with self._lock:
            for topic in topics:
                self._is_changed |= self.topics.pop(topic, None) is not None

    def microphones(self) -> set[str]:
        """Return the microphones with recorded topics."""
        return {place.microphone for place in self.topics.values() if place.microphone}

    def labels(self, microphone: str) -> set[str]:
        """Return the recorded classes of a microphone, or of the switches for an empty name."""
        places = list(self.topics.values())
        return {each.label for each in places if each.label and each.microphone == microphone}

    def muted(self) -> list[str]:
        """Return the muted classes, sorted."""
        with self._lock:
            return sorted(self._muted)

    def is_told(self, label: str) -> bool:
        """Whether events of a class are published."""
        with self._lock:
            return label not in self._muted

    def switch(self, label: str, is_told: bool) -> None:  # noqa: FBT001  passed as a callback
        """Unmute or mute a class."""
        with self._lock:
            (self._muted.discard if is_told else self._muted.add)(label)
            self._is_changed = True

    def new_events(self, events: Sequence[SoundEvent]) -> list[SoundEvent]:
        """Return the events that no earlier bridge has published.

        Parameters
        ----------
        events : sequence of SoundEvent
            In order of start; all events up to the last published one count as published.
        """
        last = {
            event.microphone: number
            for number, event in enumerate(events)
            if self._last_events.get(event.microphone) == event.id
        }
        return [e for n, e in enumerate(events) if n > last.get(e.microphone, -1)]

    def note_event(self, event: SoundEvent) -> None:
        """Record a published event."""
        with self._lock:
            self._last_events[event.microphone] = event.id
            self._is_changed = True

    def save(self) -> None:
        """Save changes; they are on disk on return."""
        with self._lock:
            if self._descriptor is None or not (self._is_changed or self.is_new):
                return
            content = _Content(
                broker=self._broker,
                topics=self.topics,
                muted=sorted(self._muted),
                last_events=self._last_events,
            )
            self._is_changed = self.is_new = False
            if self._file(self.path).save(content):
                self._remove_former()

    def close(self) -> None:
        """Save changes, and release the lock for other bridges."""
        self.save()
        for descriptor in [*self._former.values(), self._descriptor]:
            if descriptor is not None:
                os.close(descriptor)
        self._former.clear()
        self._descriptor = None

    def _say(self, text: str) -> None:
        self._report(f"mqtt: {text}")

    def _take_over(self, path: Path) -> None:
        """Lock the record of a former name, unless another bridge uses it."""
        with suppress(OSError):
            descriptor = _locked(path)
            if descriptor is not None:
                self._former[path] = descriptor

    def _remove_former(self) -> None:
        """Delete the adopted records, and only then release their locks."""
        while self._former:
            path = next(iter(self._former))
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                self._say(f"{error}; {_UNSAVED}")
                return
            os.close(self._former.pop(path))

    def _take_lock(self, folder: Path) -> int | None:
        try:
            private_folder(folder)
            descriptor = _locked(self.path)
        except OSError as error:
            self._say(f"{folder}: cannot be used ({error.strerror}); nothing is saved")
            return None
        if descriptor is None:
            self._say(
                f"{folder}: is used by another bridge; nothing is saved: give each bridge its "
                "own `state` in [bridge]"
            )
        return descriptor

    def _file(self, path: Path) -> StateFile[_Content]:
        damaged = "cannot be read and starts over; all classes are published"
        return StateFile(path, _Content, self._say, damaged, _UNSAVED)


def _locked(path: Path) -> int | None:
    """Lock the record of a name; None if another bridge has the lock."""
    descriptor = open_lock(path.with_name(f".{path.stem}.lock"))
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor
