"""Publisher of states and events to an MQTT broker."""

import json
import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from paho.mqtt.client import MQTTMessage

from hearthlog.analyzer.activity import ANY_SOUND, SoundEvent
from hearthlog.analyzer.bridge.home_state import HomeState, LiveMicrophone
from hearthlog.analyzer.bridge.mqtt import (
    CONFIG,
    PUBLISHED,
    RetainedTopics,
    TopicKey,
    Topics,
)
from hearthlog.analyzer.bridge.mqtt.connection import Connection
from hearthlog.analyzer.bridge.mqtt.home_assistant import (
    command_discovery,
    device_id,
    discovery,
    home_id,
    topics_in_discovery,
)
from hearthlog.analyzer.bridge.output import RECENT, OutputUpdate
from hearthlog.analyzer.bridge.settings import MqttSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeState, Report
from hearthlog.analyzer.logs.local_time import iso_time
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.schemas.errors import shortened

if TYPE_CHECKING:
    from hearthlog.analyzer.bridge.commands import Answer, Commands

_ONLINE = {True: "online", False: "offline"}
_ON = {True: "ON", False: "OFF"}
_LONGEST = 200  # characters
_BORN = b"online"  # birth message of Home Assistant
_MOST_WAITING = 20  # waiting commands
_MOST_OFF = 1000  # muted classes read back from the broker
_MOST_BEGUN = 1000
_LARGEST_FOUND = 1 << 20  # bytes of a discovery payload that is read back
_MOST_FOUND, _MOST_FOUND_SIZE = 5000, 1 << 20  # adopted topics, and their characters


class MqttPublisher:
    """Output that publishes the states and events of a recorder to an MQTT broker.

    Raise `BridgeError` if a file of the settings cannot be used.
    """

    def __init__(
        self, settings: MqttSettings, home: RecorderAddress, state: BridgeState, report: Report
    ) -> None:
        self._settings = settings
        self._home = home
        self._topics = topics = Topics(settings.topic, home.node)
        self._classes: dict[str, list[str]] = {}  # announced classes, by microphone
        # Classes with a switch, and classes whose switch is removed.
        self._switches: tuple[list[str], list[str]] | None = None
        # Events not published yet.
        self._begun: deque[SoundEvent] = deque(maxlen=_MOST_BEGUN)
        self._ended: deque[SoundEvent] = deque(maxlen=_MOST_BEGUN)
        self._is_born = False
        self._birth_topic = f"{settings.discovery_topic}/status"
        self._command_topic = topics.at("command")
        subscriptions = [self._birth_topic] if settings.home_assistant else []
        self._received: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self._answers: deque[Answer] = deque(maxlen=_MOST_WAITING)
        self._report = report
        self._announced = RetainedTopics(state, report)
        self._forgotten: set[str] = set()  # topics being cleared at the broker
        self._has_published_muted = False
        # Earlier versions stored retained topics and muted classes only at the broker.
        self._is_new = self._announced.is_new
        self._found, self._found_size = 0, 0  # topics read back from the broker
        self._reads_back = settings.commands and self._is_new
        self._off: set[str] = set()  # muted classes read back from the broker
        self._was_ready = False
        if settings.commands:
            subscriptions.append(self._command_topic)
            if self._reads_back:
                subscriptions.append(topics.at(PUBLISHED) + "+")
        if self._is_new:
            subscriptions.append(self._discovery_topic("+"))
        self._connection = Connection(
            settings,
            settings.client_id or f"hearthlog-{home.node}",
            topics.at("bridge"),
            report,
            subscriptions=subscriptions,
            received=self._take,
        )
        self._announced.add(topics.at("bridge"), TopicKey("bridge"))
        self._commands = self._take_commands() if settings.commands else None

    def update(self, update: OutputUpdate) -> None:
        """Publish an update."""
        self._keep(TopicKey("recorder"), _ONLINE[update.state.is_recording()])
        for each in update.state.every():
            if update.state.is_removed(each.name):
                self._classes.pop(each.name, None)
                continue
            if each.classes != self._classes.get(each.name, []):
                self._describe(each)
            self._leave_out_again(each.classes)
            self._publish_state(each, update)
            if each.name in update.state.microphones:
                self._publish_problem(each, update.state)
        self._clear_gone(update.state)
        self._describe_switches()
        self._begun += update.begun
        self._ended += update.ended
        if self._connection.is_ready():
            self._was_ready = True
            self._announced.save()  # before publishing retained values that must be cleared later
            self._report_muted()
            self._publish_begun(update)
            self._send_events("event_ended", self._recent(self._ended, update), update)
        self._obey(update.state)
        if self._is_born:
            self._is_born = False
            self._connection.repeat()
        self._connection.flush()
        if self._was_ready or not self._reads_back:
            self._announced.save()

    def _publish_begun(self, update: OutputUpdate) -> None:
        """Publish the events that began, except those that an earlier bridge published."""
        events = self._announced.new_events(self._recent(self._begun, update))
        self._send_events("event", events, update)
        for event in events:
            self._announced.note_event(event)
            if self._announced.is_published(event.label):
                key = TopicKey("last_event", event.microphone)
                self._keep(key, json.dumps(event_fields(event, update)))

    def _recent(self, waiting: deque[SoundEvent], update: OutputUpdate) -> list[SoundEvent]:
        """Take the waiting events, without those that are too old."""
        recent = [event for event in waiting if update.today.now - event.end <= RECENT]
        waiting.clear()
        return recent

    def _send_events(self, kind: str, events: Sequence[SoundEvent], update: OutputUpdate) -> None:
        for event in (each for each in events if self._announced.is_published(each.label)):
            topic = self._topics.at(kind, event.microphone)
            self._connection.send(topic, json.dumps(event_fields(event, update)))

    def alert(self, name: str, text: str, time: int) -> bool:
        """Publish an alert with a time in ns of UTC; call again until this returns True."""
        since = iso_time(time, self._home.zone)
        fields = {"event_type": "alert", "name": name, "text": text, "time": since}
        return self._connection.deliver(self._topics.at("alert"), json.dumps(fields))

    def close(self) -> None:
        """Publish `offline`, and stop."""
        if self._commands is not None:
            self._commands.close()
        self._connection.close()
        self._announced.save()

    def _take_commands(self) -> "Commands":
        # Imported here: without commands, the code that corrects logs is not needed.
        from hearthlog.analyzer.bridge.commands import Commands  # noqa: PLC0415

        home = self._home
        return Commands(home.folder, self._announced.switch, self._answers.append)

    def _obey(self, state: HomeState) -> None:
        """Queue received commands, and publish the results of finished ones."""
        while self._commands is not None and self._received:
            self._commands.add(self._received.popleft(), state)
        while self._answers:
            answer = self._answers.popleft()
            self._connection.send(self._topics.at("command/answer"), json.dumps(answer._asdict()))

    def _take(self, message: MQTTMessage) -> None:
        """Store a received message; runs in the thread of the connection."""
        if message.topic == self._birth_topic:
            self._is_born |= message.payload == _BORN and not message.retain
        elif message.topic == self._command_topic:
            if not message.retain:  # a retained command was meant for an earlier time
                self._received.append(bytes(message.payload))
        elif self._reads_back and message.retain and message.payload == b"OFF":
            key = self._topics.parse(message.topic)
            if key is not None and key.kind == PUBLISHED and len(self._off) < _MOST_OFF:
                self._off.add(key.label)
        elif self._is_new and message.retain and not self._was_ready:
            self._take_found(bytes(message.payload))

    def _take_found(self, payload: bytes) -> None:
        """Adopt topics from the discovery payload of an earlier bridge, up to a limit."""
        keys = topics_in_discovery(self._topics, payload) if len(payload) <= _LARGEST_FOUND else []
        for key in keys:
            topic = self._topic(key)
            size = self._found_size + len(topic)
            if size > _MOST_FOUND_SIZE or self._found >= _MOST_FOUND:
                return
            self._found, self._found_size = self._found + 1, size
            self._announced.add(topic, key)

    def _leave_out_again(self, classes: Iterable[str]) -> None:
        """Mute the classes that an earlier bridge had muted."""
        for label in self._off.intersection(classes):
            self._off.discard(label)
            self._announced.switch(label, is_published=False)
            self._has_published_muted = False

    def _discovery_topic(self, device: str) -> str:
        return f"{self._settings.discovery_topic}/device/{device}/config"

    def _report_muted(self) -> None:
        """Report the muted classes once, and how to unmute them."""
        muted = self._announced.muted()
        if muted and not self._has_published_muted:
            remedy = (
                f'a command such as {{"told": true, "label": "{muted[0]}"}} changes that'
                if self._settings.commands
                else "a command did that, and commands are off now: to change it, start the "
                f"bridge once with --unmute {muted[0]}"
            )
            self._report(f"mqtt: not published: {', '.join(muted)}; {remedy}")
        self._has_published_muted = True

    def _topic(self, key: TopicKey) -> str:
        if key.kind != CONFIG:
            return self._topics.at(*key)
        node, microphone = self._topics.node, key.microphone
        return self._discovery_topic(device_id(node, microphone) if microphone else home_id(node))

    def _keep(self, key: TopicKey, value: str) -> None:
        """Publish a retained value, and record its topic."""
        topic = self._topic(key)
        self._announced.add(topic, key)
        self._forgotten.discard(topic)
        self._connection.keep(topic, value)

    def _describe(self, microphone: LiveMicrophone) -> None:
        """Announce the classes of a microphone to Home Assistant, before their first values."""
        name, classes = microphone.name, microphone.classes
        self._classes[name] = list(classes)
        if self._settings.home_assistant:
            gone = sorted(self._announced.labels(name).difference(classes))
            config = discovery(self._topics, name, classes, gone)
            self._keep(TopicKey(CONFIG, name), json.dumps(config))

    def _describe_switches(self) -> None:
        """Announce the commands to Home Assistant, if both are enabled."""
        if not (self._settings.home_assistant and self._settings.commands):
            return
        classes = sorted({name for names in self._classes.values() for name in names})
        switches = classes, sorted(self._announced.labels("").difference(classes))
        if switches != self._switches:
            self._switches = switches
            config = command_discovery(self._topics, *switches)
            self._keep(TopicKey(CONFIG), json.dumps(config))

    def _clear_gone(self, state: HomeState) -> None:
        """Clear retained topics of this or an earlier bridge that are obsolete."""
        if self._forgotten and self._connection.is_taken():
            self._announced.remove(self._forgotten)
            self._forgotten.clear()
        present = {each.name for each in state.every()}
        for topic, key in list(self._announced.topics.items()):
            if self._is_gone(topic, key, state):
                self._connection.forget(topic)
                self._forgotten.add(topic)
            elif key.kind == "listening" and key.microphone not in present:
                self._connection.keep(topic, _ONLINE[False])  # no recent messages

    def _is_gone(self, topic: str, key: TopicKey, state: HomeState) -> bool:
        kind, microphone, label = key
        if topic != self._topic(key):  # the recorder or the topic was renamed
            return True
        if kind == CONFIG and not self._settings.home_assistant:
            return True
        if not microphone:
            return kind in {CONFIG, PUBLISHED} and not self._settings.commands
        if state.is_removed(microphone):
            return True
        classes = self._classes.get(microphone)
        return bool(label) and classes is not None and label not in classes

    def _publish_state(self, microphone: LiveMicrophone, update: OutputUpdate) -> None:
        def keep(kind: str, value: str) -> None:
            self._keep(TopicKey(kind, microphone.name), value)

        keep("listening", _ONLINE[microphone.is_listening()])
        if not microphone.label:
            return
        confidence = round(microphone.confidence, 3)
        label = microphone.shown_label
        label = label if self._announced.is_published(label) else UNKNOWN
        keep("heard", json.dumps({"label": label, "confidence": confidence}))
        keep("sound", _ON[microphone.active.is_active(ANY_SOUND)])
        if math.isfinite(microphone.level_dbfs):
            keep("level", f"{microphone.level_dbfs:.1f}")
        counts = microphone.counts(update.today, update.state.corrections)
        began = {
            "day_start": iso_time(update.today.midnight, update.zone),
            "night_start": iso_time(update.today.night, update.zone),
        }
        for label in (each for each in microphone.classes if each != SILENCE):
            is_published = self._announced.is_published(label)
            if self._settings.commands:
                self._keep(TopicKey(PUBLISHED, label=label), _ON[is_published])
            of_day, of_night = counts[label]
            values = {
                "on": _ON[microphone.active.is_active(label) and is_published],
                "counts": json.dumps({"today": of_day, "night": of_night, **began}),
                "count_today": str(of_day),
                "count_night": str(of_night),
            }
            last = microphone.last_event(label)
            if last is not None:  # otherwise the retained value of an earlier bridge is right
                values["last_heard"] = iso_time(last.end, update.zone)
            for kind, value in values.items():
                self._keep(TopicKey(kind, microphone.name, label), value)

    def _publish_problem(self, microphone: LiveMicrophone, state: HomeState) -> None:
        others = state.microphones.keys() - {microphone.name}
        bad = [
            f"{subject}: {health.text}"
            for subject, health in sorted(state.health.items())
            if health.level and subject.partition(" ")[0] not in others
        ]
        value = {"state": _ON[bool(bad)], "text": shortened("; ".join(bad), _LONGEST)}
        self._keep(TopicKey("problem", microphone.name), json.dumps(value))


def event_fields(event: SoundEvent, update: OutputUpdate) -> dict[str, str | float]:
    """Return the JSON fields of an event."""
    return {
        "event_type": event.label,
        "id": event.id,
        "start": iso_time(event.start, update.zone),
        "end": iso_time(event.end, update.zone),
        "seconds": round(event.seconds, 2),
        "confidence": round(event.confidence, 3),
    }
