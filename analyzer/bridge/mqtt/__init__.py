"""Output to an MQTT broker and Home Assistant: its topics, and the record of those retained."""

import re
from collections.abc import Iterable, Sequence
from threading import Lock
from typing import NamedTuple
from urllib.parse import quote, unquote

from pydantic import BaseModel

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.bridge.state import RETAINED, BridgeState, Report, StateEntry

_KEPT = "".join(chr(code) for code in range(33, 127) if chr(code) not in "%+#/$")


CONFIG, PUBLISHED = "config", "told"  # kinds of topics


class TopicKey(NamedTuple):
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
        """Return the topic of a key of any kind but `config`, which uses discovery topics.

        A kind is of the recorder, such as `bridge`; of a microphone, such as `heard`; or of a
        class, such as `on`, or `told`, which shows whether its events are published. Characters of
        a label that are invalid in topics or not ASCII are percent-encoded, such as `%2B`.
        """
        part = quote(label, safe=_KEPT)
        if kind == PUBLISHED:
            return f"{self.root}/told/{part}"
        if label:
            return f"{self.root}/{microphone}/class/{part}/{kind}"
        return f"{self.root}/{microphone}/{kind}" if microphone else f"{self.root}/{kind}"

    def parse(self, topic: str) -> TopicKey | None:
        """Return the key of a topic, the inverse of `at`; None for other topics."""
        parts = topic.removeprefix(f"{self.root}/").split("/")
        match parts:
            case [kind]:
                key = TopicKey(kind)
            case ["told", label]:
                key = TopicKey(PUBLISHED, label=unquote(label))
            case [microphone, kind]:
                key = TopicKey(kind, microphone)
            case [microphone, "class", label, kind]:
                key = TopicKey(kind, microphone, unquote(label))
            case _:
                return None
        return key if self.at(*key) == topic else None


def identifier(text: str) -> str:
    """Escape a text for an identifier; different texts give different results."""
    escaped = r"[^a-z0-9_]|_(?=[0-9a-f]+[^a-z0-9])"
    return re.sub(escaped, lambda match: f"_{ord(match[0]):x}_", text)


_DAMAGED = "cannot be read and starts over; all classes are published"
_UNSAVED = "topics that go are not cleared after the next start"


class _Content(BaseModel, extra="forbid"):
    broker: str = ""  # of earlier versions
    topics: dict[str, TopicKey] = {}
    muted: list[str] = []
    last_events: dict[str, str] = {}  # id of the last published event, by microphone


class RetainedTopics:
    """Persistent record of retained topics, muted classes and last published events.

    `is_new`: there was no record.
    """

    def __init__(self, state: BridgeState, report: Report) -> None:
        def entry(name: str) -> StateEntry[_Content]:
            return StateEntry(
                state, name, _Content, lambda text: report(f"mqtt: {text}"), _DAMAGED, _UNSAVED
            )

        self._lock = Lock()
        self._entry = entry(RETAINED)
        names = state.names(RETAINED)
        self._former = [name for name in names if name != RETAINED]  # of other recorder names
        self.is_new = not names
        self._is_changed = bool(self._former)
        self.topics: dict[str, TopicKey] = {}
        # Of any broker: another address may be the same broker; a new one has no topics.
        self._muted: set[str] = set()
        self._last_events: dict[str, str] = {}
        own = [RETAINED] if RETAINED in names else []
        for each in (entry(name).load() for name in [*self._former, *own]):
            if each is not None:
                self.topics |= each.topics
                self._muted.update(each.muted)
                self._last_events |= each.last_events

    def add(self, topic: str, key: TopicKey) -> None:
        """Record a topic with a retained value."""
        with self._lock:
            if self.topics.get(topic) != key:
                self.topics[topic] = key
                self._is_changed = True

    def remove(self, topics: Iterable[str]) -> None:
        """Remove topics that were cleared at the broker."""
        with self._lock:
            for topic in topics:
                self._is_changed |= self.topics.pop(topic, None) is not None

    def microphones(self) -> set[str]:
        """Return the microphones with recorded topics."""
        return {key.microphone for key in self.topics.values() if key.microphone}

    def labels(self, microphone: str) -> set[str]:
        """Return the recorded classes of a microphone, or of the switches for an empty name."""
        keys = list(self.topics.values())
        return {each.label for each in keys if each.label and each.microphone == microphone}

    def muted(self) -> list[str]:
        """Return the muted classes, sorted."""
        with self._lock:
            return sorted(self._muted)

    def is_published(self, label: str) -> bool:
        """Whether events of a class are published."""
        with self._lock:
            return label not in self._muted

    def switch(self, label: str, is_published: bool) -> None:  # noqa: FBT001  passed as a callback
        """Unmute or mute a class."""
        with self._lock:
            (self._muted.discard if is_published else self._muted.add)(label)
            self._is_changed = True

    def new_events(self, events: Sequence[SoundEvent]) -> list[SoundEvent]:
        """Return the events, in order of start, that no earlier bridge has published.

        All events up to the last published one count as published.
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
            if not (self._is_changed or self.is_new):
                return
            content = _Content(
                topics=self.topics,
                muted=sorted(self._muted),
                last_events=self._last_events,
            )
            self._is_changed = self.is_new = False
            if self._entry.save(content, self._former):
                self._former = []
