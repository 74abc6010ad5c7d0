"""What a broker holds of earlier bridges, and which classes it is not told of."""

import json
from collections.abc import Collection, Sequence
from contextlib import suppress
from threading import Lock

from paho.mqtt.client import MQTTMessage

from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.mqtt.topics import Topics

_OFF = b"OFF"


class HeldValues:
    """Notes of the values that a broker kept, as it sends them to who subscribes; for any thread.

    Parameters
    ----------
    topics : Topics
    """

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._lock = Lock()
        self._classes: set[tuple[str, str]] = set()  # microphones and classes
        self._microphones: set[str] = set()
        self._switched: set[str] = set()  # classes that there may be a switch of
        self._untold: set[str] = set()  # those that are switched off
        self._last_events: set[str] = set()  # ids

    @property
    def subscriptions(self) -> list[str]:
        """Filters of the topics that there are notes of."""
        root = f"{self._topics.root}/+"
        kinds = "listening", "last_event", "class/+/on"
        return [*(f"{root}/{kind}" for kind in kinds), f"{self._topics.root}/told/+"]

    def take(self, message: MQTTMessage) -> None:
        """Note a value that was kept; what comes as it is published is one's own."""
        topic, payload = message.topic, bytes(message.payload)
        if not message.retain or not payload:
            return
        with self._lock:
            if held := self._topics.parse_class(topic, "on"):
                self._classes.add(held)
            elif name := self._topics.parse_microphone(topic, "listening"):
                self._microphones.add(name)
            elif self._topics.parse_microphone(topic, "last_event"):
                self._last_events.add(_id_of(payload))
            elif label := self._topics.parse_told(topic):
                self._switched.add(label)
                if payload == _OFF:
                    self._untold.add(label)

    def add_classes(self, microphone: str, labels: Collection[str]) -> None:
        """Note the classes of a microphone of which the broker was told by this bridge."""
        with self._lock:
            self._classes.update((microphone, label) for label in labels)
            self._switched.update(labels)

    def other_microphones(self, known: Collection[str]) -> list[str]:
        """Return the microphones that are not known any more, each once."""
        with self._lock:
            others = sorted(self._microphones.difference(known))
            self._microphones.difference_update(others)
            return others

    def other_classes(self, microphone: str, known: Collection[str]) -> list[str]:
        """Return the classes of a microphone that are not known any more, each once."""
        with self._lock:
            others = {(name, c) for name, c in self._classes if name == microphone}
            gone = {(name, label) for name, label in others if label not in known}
            self._classes -= gone
            return sorted(label for _, label in gone)

    def new_events(self, events: Sequence[Event]) -> list[Event]:
        """Return the events that an earlier bridge has not told of.

        Parameters
        ----------
        events : sequence of Event
            In the order in which they began; what is before one that was told of was told of, too.
        """
        with self._lock:
            told = {
                (event.microphone, n)
                for n, event in enumerate(events)
                if event.id in self._last_events
            }
        last = {name: max(n for m, n in told if m == name) for name, _ in told}
        return [e for n, e in enumerate(events) if n > last.get(e.microphone, -1)]

    def other_switches(self, known: Collection[str]) -> list[str]:
        """Return the classes that there may be switches of, and that are not known any more."""
        with self._lock:
            return sorted(self._switched.difference(known))

    def is_told(self, label: str) -> bool:
        """Tell whether the broker is told when a class is heard."""
        with self._lock:
            return label not in self._untold

    def switch(self, label: str, is_told: bool) -> None:  # noqa: FBT001  it is handed over
        """Have the broker told of a class or not."""
        with self._lock:
            (self._untold.discard if is_told else self._untold.add)(label)


def _id_of(payload: bytes) -> str:
    """Return the id of an event, as JSON; empty if it has none."""
    with suppress(ValueError, RecursionError, TypeError, KeyError):
        return str(json.loads(payload)["id"])
    return ""
