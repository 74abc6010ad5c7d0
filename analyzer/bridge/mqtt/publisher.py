"""What is heard, said to a broker."""

import json
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from paho.mqtt.client import MQTTMessage

from hearthlog.analyzer.bridge.day import Today, iso_time
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.heard_now import ANY_SOUND
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.home_state import HomeState, MicrophoneState
from hearthlog.analyzer.bridge.mqtt.connection import Connection
from hearthlog.analyzer.bridge.mqtt.discovery import (
    command_discovery,
    device_id,
    discovery,
    home_id,
)
from hearthlog.analyzer.bridge.mqtt.held_values import HeldValues
from hearthlog.analyzer.bridge.mqtt.topics import Topics
from hearthlog.analyzer.bridge.output import RECENT, News
from hearthlog.analyzer.bridge.settings import MqttSettings
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.text import shortened

if TYPE_CHECKING:
    from hearthlog.analyzer.bridge.mqtt.commands import Answer, Commands

_ONLINE = {True: "online", False: "offline"}
_ON = {True: "ON", False: "OFF"}
_LONGEST = 200  # characters
_BORN = b"online"  # of Home Assistant
_MOST_ASKED = 20  # commands that wait
_MOST_BEGUN = 1000


class MqttPublisher:
    """Says everything that a broker is to know of a recorder.

    Parameters
    ----------
    settings : MqttSettings
    home : Home
    say : callable
        Told what is wrong, in a line.

    Raises
    ------
    BridgeError
        If a file of the settings cannot be used.
    """

    def __init__(self, settings: MqttSettings, home: Home, say: Callable[[str], None]) -> None:
        self._settings = settings
        self._home = home
        self._topics = topics = Topics(settings.topic, home.node)
        self._classes: dict[str, list[str]] = {}  # those that were told of, by microphone
        # Those that there are switches of, and those of which no more.
        self._switches: tuple[list[str], list[str]] | None = None
        self._held = HeldValues(topics)
        # Events that were not told of yet.
        self._begun: deque[Event] = deque(maxlen=_MOST_BEGUN)
        self._ended: deque[Event] = deque(maxlen=_MOST_BEGUN)
        self._is_born = False
        subscriptions = self._held.subscriptions
        if settings.home_assistant:
            subscriptions.append(self._birth_topic)
        self._asked: deque[bytes] = deque(maxlen=_MOST_ASKED)
        self._answers: deque[Answer] = deque(maxlen=_MOST_ASKED)
        if settings.commands:
            subscriptions.append(self._command_topic)
        client_id = settings.client_id or f"hearthlog-{home.node}"
        self._connection = Connection(
            settings,
            client_id,
            topics.of_home("bridge"),
            say,
            subscriptions=subscriptions,
            received=self._take,
        )
        self._commands = self._take_commands() if settings.commands else None

    def update(self, news: News) -> None:
        """Say what is new."""
        self._connection.keep(self._topics.of_home("recorder"), _ONLINE[news.state.is_recording()])
        for each in news.state.every():
            if each.classes != self._classes.get(each.name, []):
                self._describe(each)
            self._say_state(each, news)
        for microphone in news.state.microphones.values():
            self._say_problem(microphone, news.state)
        self._clear_others(news.state)
        self._describe_switches()
        self._begun += news.begun
        self._ended += news.ended
        if self._connection.is_ready():
            self._tell_begun(news)
            self._send_events("event_ended", self._recent(self._ended, news), news)
        self._obey(news.state)
        if self._is_born:
            self._is_born = False
            self._connection.repeat()
        self._connection.flush()

    def _tell_begun(self, news: News) -> None:
        """Tell of the events that began, but for those that an earlier bridge told of."""
        events = self._held.new_events(self._recent(self._begun, news))
        self._send_events("event", events, news)
        for event in (each for each in events if self._held.is_told(each.label)):
            topic = self._topics.of_microphone(event.microphone, "last_event")
            self._connection.keep(topic, json.dumps(event_fields(event, news)))

    def _recent(self, waiting: deque[Event], news: News) -> list[Event]:
        """Take the events that waited for a broker, but for those that are no news any more."""
        recent = [event for event in waiting if news.today.now - event.end <= RECENT]
        waiting.clear()
        return recent

    def _send_events(self, kind: str, events: Sequence[Event], news: News) -> None:
        for event in (each for each in events if self._held.is_told(each.label)):
            topic = self._topics.of_microphone(event.microphone, kind)
            self._connection.send(topic, json.dumps(event_fields(event, news)))

    def alert(self, name: str, text: str, time: int) -> bool:
        """Say that an alert rings, at each call, until the broker has it, which it tells.

        Parameters
        ----------
        name : str
            Of its rule.
        text : str
            What is the case.
        time : int
            Since when, in nanoseconds of UTC.
        """
        since = iso_time(time, self._home.zone)
        fields = {"event_type": "alert", "name": name, "text": text, "time": since}
        return self._connection.deliver(self._topics.of_home("alert"), json.dumps(fields))

    def close(self) -> None:
        """Say `offline`, and end."""
        if self._commands is not None:
            self._commands.close()
        self._connection.close()

    def _take_commands(self) -> "Commands":
        # Imported here: who commands nothing needs nothing that corrects logs.
        from hearthlog.analyzer.bridge.mqtt.commands import Commands  # noqa: PLC0415

        home = self._home
        return Commands(home.folder, home.node, self._held.switch, self._answers.append)

    def _obey(self, state: HomeState) -> None:
        """Have the commands carried out that came, and answer those that are."""
        while self._commands is not None and self._asked:
            self._commands.add(self._asked.popleft(), state.find_event)
        while self._answers:
            answer = self._answers.popleft()
            self._connection.send(
                self._topics.of_home("command/answer"), json.dumps(answer._asdict())
            )

    @property
    def _command_topic(self) -> str:
        return self._topics.of_home("command")

    @property
    def _birth_topic(self) -> str:
        return f"{self._settings.discovery_topic}/status"

    def _take(self, message: MQTTMessage) -> None:
        """Note a message, in the thread of the connection."""
        if message.topic == self._birth_topic:
            self._is_born |= message.payload == _BORN and not message.retain
        elif message.topic == self._command_topic:
            if not message.retain:  # else it was meant for whoever was there then
                self._asked.append(bytes(message.payload))
        else:
            self._held.take(message)

    def _describe(self, microphone: MicrophoneState) -> None:
        """Tell Home Assistant of the classes of a microphone, before the first value of one."""
        name, classes = microphone.name, microphone.classes
        self._classes[name] = list(classes)
        self._held.add_classes(name, classes)
        self._tell_home_assistant(name)

    def _tell_home_assistant(self, microphone: str, gone: tuple[str, ...] = ()) -> None:
        if self._settings.home_assistant:
            topic = self._config_topic(device_id(self._topics.node, microphone))
            config = discovery(self._topics, microphone, self._classes[microphone], gone)
            self._connection.keep(topic, json.dumps(config))

    def _describe_switches(self) -> None:
        """Tell Home Assistant what it may command; nothing where it may not."""
        if not self._settings.home_assistant:
            return
        topic = self._config_topic(home_id(self._topics.node))
        if not self._settings.commands:
            self._connection.forget(topic)
            return
        classes = sorted({name for names in self._classes.values() for name in names})
        switches = classes, self._held.other_switches(classes)
        if switches != self._switches:
            self._switches = switches
            config = command_discovery(self._topics, *switches)
            self._connection.keep(topic, json.dumps(config))

    def _config_topic(self, device: str) -> str:
        return f"{self._settings.discovery_topic}/device/{device}/config"

    def _clear_others(self, state: HomeState) -> None:
        """Have the broker forget the classes that earlier models had."""
        for name in self._held.other_microphones([each.name for each in state.every()]):
            self._connection.keep(self._topics.of_microphone(name, "listening"), _ONLINE[False])
        for name, classes in self._classes.items():
            gone = self._held.other_classes(name, classes)
            if gone:
                self._tell_home_assistant(name, tuple(gone))
            for label in gone:
                for kind in ("on", "count_today", "count_night", "last_heard"):
                    self._connection.forget(self._topics.of_class(name, label, kind))

    def _say_state(self, microphone: MicrophoneState, news: News) -> None:
        def say(kind: str, value: str) -> None:
            self._connection.keep(self._topics.of_microphone(microphone.name, kind), value)

        say("listening", _ONLINE[microphone.is_listening()])
        if not microphone.label:
            return
        confidence = round(microphone.confidence, 3)
        label = microphone.label if self._held.is_told(microphone.label) else UNKNOWN
        say("heard", json.dumps({"label": label, "confidence": confidence}))
        say("sound", _ON[microphone.heard.is_heard(ANY_SOUND)])
        if math.isfinite(microphone.level_dbfs):
            say("level", f"{microphone.level_dbfs:.1f}")
        for label in (each for each in microphone.classes if each != SILENCE):
            is_told = self._held.is_told(label)
            if self._settings.commands:
                self._connection.keep(self._topics.of_told(label), _ON[is_told])
            for kind, value in class_values(microphone, label, news):
                topic = self._topics.of_class(microphone.name, label, kind)
                self._connection.keep(topic, value if is_told or kind != "on" else _ON[False])

    def _say_problem(self, microphone: MicrophoneState, state: HomeState) -> None:
        others = state.microphones.keys() - {microphone.name}
        bad = [
            f"{subject}: {health.text}"
            for subject, health in sorted(state.health.items())
            if health.level and subject.partition(" ")[0] not in others
        ]
        value = {"state": _ON[bool(bad)], "text": shortened("; ".join(bad), _LONGEST)}
        topic = self._topics.of_microphone(microphone.name, "problem")
        self._connection.keep(topic, json.dumps(value))


def class_values(microphone: MicrophoneState, label: str, news: News) -> Iterator[tuple[str, str]]:
    """Yield what the broker keeps of a class: the kind of topic, and its value.

    Parameters
    ----------
    microphone : MicrophoneState
    label : str
        The class.
    news : News
        Of whose day and night events are counted.
    """
    yield "on", _ON[microphone.heard.is_heard(label)]
    for kind, count in zip(
        ("count_today", "count_night"), counts(microphone, label, news.today), strict=True
    ):
        yield kind, str(count)
    last = microphone.last_event(label)
    if last is not None:  # else what the broker has from an earlier bridge is right
        yield "last_heard", iso_time(last.end, news.zone)


def counts(microphone: MicrophoneState, label: str, today: Today) -> tuple[int, int]:
    """Count the events of a class that began since midnight, and those of the last night."""
    night = [e for e in microphone.events(label, today.night) if e.start < today.morning]
    return len(microphone.events(label, today.midnight)), len(night)


def event_fields(event: Event, news: News) -> dict[str, str | float]:
    """Describe an event for JSON."""
    return {
        "event_type": event.label,
        "id": event.id,
        "start": iso_time(event.start, news.zone),
        "end": iso_time(event.end, news.zone),
        "seconds": round(event.seconds, 2),
        "confidence": round(event.confidence, 3),
    }
