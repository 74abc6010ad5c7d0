"""Topics of a broker: their names, and those that it retains between two starts."""

import fcntl
import os
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import NamedTuple, Protocol
from urllib.parse import quote, unquote

from pydantic import BaseModel, ConfigDict, ValidationError

from hearthlog.analyzer.bridge.events import SoundEvent
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.files import read_whole
from hearthlog.schemas.new_files import (
    create_file,
    open_lock,
    private_folder,
    replaced_file,
)

_CLASS_PART = "/class/"
_KEPT = "".join(chr(code) for code in range(33, 127) if chr(code) not in "%+#/$")


CONFIG, TOLD = "config", "told"  # kinds of places


class Place(NamedTuple):
    """The subject of a topic; parts that do not apply are empty."""

    kind: str
    microphone: str = ""
    label: str = ""


class Topics(NamedTuple):
    """Names the topics of one recorder."""

    base: str
    node: str

    @property
    def root(self) -> str:
        """What all topics of the recorder begin with."""
        return f"{self.base}/{self.node}"

    def of_home(self, kind: str) -> str:
        """Name a topic of the recorder: `bridge` or `recorder`."""
        return f"{self.root}/{kind}"

    def of_microphone(self, microphone: str, kind: str) -> str:
        """Name a topic of a microphone, such as `listening`, `heard` or `event`."""
        return f"{self.root}/{microphone}/{kind}"

    def of_class(self, microphone: str, label: str, kind: str) -> str:
        """Name a topic of a class: `on`, `count_today`, `count_night` or `last_heard`.

        Parameters
        ----------
        label : str
            The class; what a topic may not have, or what is no ASCII, is written `%2B`, as in
            addresses.
        """
        return f"{self.root}/{microphone}{_CLASS_PART}{_part(label)}/{kind}"

    def of_told(self, label: str) -> str:
        """Name the topic that says whether a class is told of."""
        return f"{self.root}/told/{_part(label)}"

    @property
    def told_filter(self) -> str:
        """The subscription that matches all names of `of_told`."""
        return f"{self.root}/told/+"

    def name(self, place: Place) -> str:
        """Name the topic of a place of any kind but `config`, which has a topic of discovery."""
        kind, microphone, label = place
        if kind == TOLD:
            return self.of_told(label)
        if label:
            return self.of_class(microphone, label, kind)
        return self.of_microphone(microphone, kind) if microphone else self.of_home(kind)

    def parse(self, topic: str) -> Place | None:
        """Return the place of a topic that `name` gives; None of another one."""
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
        return place if self.name(place) == topic else None


def _part(label: str) -> str:
    return quote(label, safe=_KEPT)


def identifier(text: str) -> str:
    """Make a text part of an identifier, which no other text gives."""
    escaped = r"[^a-z0-9_]|_(?=[0-9a-f]+[^a-z0-9])"
    return re.sub(escaped, lambda match: f"_{ord(match[0]):x}_", text)


_PREFIX, _SUFFIX = "mqtt-", ".json"  # around the name of the recorder
_LIMIT = 4 << 20  # bytes


class _Content(BaseModel):
    model_config = ConfigDict(extra="forbid")

    broker: str = ""
    topics: dict[str, Place] = {}
    muted: list[str] = []
    last_events: dict[str, str] = {}  # id of the last event that was told of, by microphone


class _IsRenamed(Protocol):
    def __call__(self, former: str, /, *, is_first: bool) -> bool: ...


class RetainedTopics:
    """The topics that a broker keeps of this bridge, classes it is not told of, events it knows."""

    def __init__(
        self,
        folder: Path,
        node: str,
        broker: str,
        is_renamed: _IsRenamed,
        say: Callable[[str], None],
    ) -> None:
        self.path = folder / f"{_PREFIX}{node}{_SUFFIX}"
        self._say = say
        self._lock = Lock()
        self._is_changed = False
        self._descriptor = self._take_lock(folder)
        has_own = self.path.exists()
        # Of names that the recorder had: their files, and locks that no bridge of theirs can take.
        self._former: dict[Path, int] = {}
        if self._descriptor is not None:
            for path in sorted(folder.glob(f"{_PREFIX}*{_SUFFIX}")):
                former = path.name.removeprefix(_PREFIX).removesuffix(_SUFFIX)
                if path != self.path and is_renamed(former, is_first=not has_own):
                    self._take_over(path)
        sources = [*self._former, *([self.path] if has_own else [])]
        self.is_new = self._descriptor is None or not sources
        contents = [] if self.is_new else [self._load(source) for source in sources]
        self._is_changed = bool(self._former)
        self._broker = broker
        self.topics: dict[str, Place] = {}
        # Of another address of the broker, too: it may be the same one, and else has none of them.
        self._muted: set[str] = set()
        self._last_events: dict[str, str] = {}
        for each in contents:
            self.topics |= each.topics
            self._muted.update(each.muted)
            self._last_events |= each.last_events

    def add(self, topic: str, place: Place) -> None:
        """Note a topic to which a value is published that the broker keeps."""
        with self._lock:
            if self.topics.get(topic) != place:
                self.topics[topic] = place
                self._is_changed = True

    def remove(self, topics: Iterable[str]) -> None:
        """Note that the broker has forgotten topics."""
        with self._lock:
            for topic in topics:
                self._is_changed |= self.topics.pop(topic, None) is not None

    def microphones(self) -> set[str]:
        """Return the microphones that the broker knows."""
        return {place.microphone for place in self.topics.values() if place.microphone}

    def labels(self, microphone: str) -> set[str]:
        """Return the classes of a microphone that the broker knows; of none, the switches."""
        places = list(self.topics.values())
        return {each.label for each in places if each.label and each.microphone == microphone}

    def muted(self) -> list[str]:
        """Return the classes that the broker is not told of."""
        with self._lock:
            return sorted(self._muted)

    def is_told(self, label: str) -> bool:
        """Return whether events of a class are published."""
        with self._lock:
            return label not in self._muted

    def switch(self, label: str, is_told: bool) -> None:  # noqa: FBT001  it is handed over
        """Have the broker told of a class or not."""
        with self._lock:
            (self._muted.discard if is_told else self._muted.add)(label)
            self._is_changed = True

    def new_events(self, events: Sequence[SoundEvent]) -> list[SoundEvent]:
        """Return the events that no earlier bridge has told of.

        Parameters
        ----------
        events : sequence of SoundEvent
            In the order in which they began; those before the last one that was told of were told
            of, too.
        """
        last = {
            event.microphone: number
            for number, event in enumerate(events)
            if self._last_events.get(event.microphone) == event.id
        }
        return [e for n, e in enumerate(events) if n > last.get(e.microphone, -1)]

    def note_event(self, event: SoundEvent) -> None:
        """Note that an event was told of."""
        with self._lock:
            self._last_events[event.microphone] = event.id
            self._is_changed = True

    def save(self) -> None:
        """Write down what has changed; it is on the disk on return."""
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
            try:
                with replaced_file(self.path) as temporary, create_file(temporary) as stream:
                    stream.write(content.model_dump_json().encode())
                self._remove_former()
            except (LogError, OSError) as error:
                self._say(f"mqtt: {error}; topics that go are not cleared after the next start")

    def close(self) -> None:
        """Write down what has changed, and let another bridge use the folder."""
        self.save()
        for descriptor in [*self._former.values(), self._descriptor]:
            if descriptor is not None:
                os.close(descriptor)
        self._former.clear()
        self._descriptor = None

    def _take_over(self, path: Path) -> None:
        """Lock the memory of a former name, unless a bridge runs that remembers there."""
        with suppress(OSError):
            descriptor = open_lock(_lock_path(path))
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(descriptor)
                return
            self._former[path] = descriptor

    def _remove_former(self) -> None:
        """Remove the memories that were taken over, and only then let others have their names."""
        while self._former:
            path = next(iter(self._former))
            path.unlink(missing_ok=True)
            os.close(self._former.pop(path))

    def _take_lock(self, folder: Path) -> int | None:
        try:
            private_folder(folder)
            descriptor = open_lock(_lock_path(self.path))
        except OSError as error:
            self._say(f"mqtt: {folder}: cannot be used ({error.strerror}); nothing is remembered")
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            self._say(
                f"mqtt: {folder}: is used by another bridge; nothing is remembered: give each one "
                "a `state` of its own in [bridge]"
            )
            return None
        return descriptor

    def _load(self, path: Path) -> _Content:
        try:
            data = read_whole(path, "memory of what was published", _LIMIT, LogError)
            return _Content.model_validate_json(data)
        except (HearthlogError, ValidationError):
            self._say(f"mqtt: {path}: cannot be read, and begins anew; all classes are told of")
            return _Content()


def _lock_path(path: Path) -> Path:
    return path.with_name(f".{path.stem}.lock")
