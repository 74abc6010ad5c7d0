"""Home Assistant discovery: a device for each microphone, and one for commands."""

import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

from hearthlog._version import __version__
from hearthlog.analyzer.bridge.mqtt import CONFIG, PUBLISHED, TopicKey, Topics, identifier
from hearthlog.models.classes import SILENCE, in_words

Component = dict[str, Any]  # of a discovery payload, as Home Assistant defines it

_BY = "Home Assistant"
_PAUSE_MINUTES = 60
_OF_SOUND = {"level", "recorder", "problem"}  # of the microphone, not of a model


def device_id(node: str, microphone: str) -> str:
    """Return the unique Home Assistant identifier of a microphone's device."""
    return f"{home_id(node)}-{microphone}"


def home_id(node: str) -> str:
    """Return the Home Assistant identifier of a recorder's device."""
    return f"hearthlog-{identifier(node)}"


def discovery(
    topics: Topics, microphone: str, classes: Sequence[str], gone: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the discovery payload of a microphone, for Home Assistant 2024.11 and later.

    The device of `<microphone>-<scenario>` has no level or health. Entities of `gone`, former
    classes, are removed.
    """
    own = device_id(topics.node, microphone)
    sounds = [name for name in classes if name != SILENCE]
    components = _of_microphone(topics, microphone, sounds)
    if "-" in microphone:  # a scenario: names of microphones have no hyphen
        components = {kind: each for kind, each in components.items() if kind not in _OF_SOUND}
    for name, words in _words(sounds).items():
        components |= _of_class(topics, microphone, name, words)
    for key, component in components.items():
        component["unique_id"] = f"{own}-{key}"
    for name in gone:
        removed = _of_class(topics, microphone, name, name)
        components |= {key: {"p": component["p"]} for key, component in removed.items()}
    return {
        **_device(own, f"Hearthlog {topics.node} {microphone}"),
        "availability": [
            {"topic": topics.at("bridge")},
            {"topic": topics.at("listening", microphone)},
        ],
        "availability_mode": "all",
        "components": components,
    }


def command_discovery(
    topics: Topics, classes: Sequence[str], gone: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the discovery payload of a recorder's device, with the commands to the bridge.

    Switches of `gone`, former classes, are removed.
    """
    own = home_id(topics.node)
    command = topics.at("command")

    def button(name: str, icon: str, **fields: Any) -> Component:
        press = _command(**fields)
        return _entity("button", name, payload_press=press, icon=icon, command_topic=command)

    components = {
        "pause": button("Pause for an hour", "mdi:microphone-off", pause_minutes=_PAUSE_MINUTES),
        "resume": button("Listen again", "mdi:microphone", resume=True),
    }
    for name, words in _words([name for name in classes if name != SILENCE]).items():
        components[f"told_{identifier(name)}"] = _entity(
            "switch",
            f"Tell of {words}",
            entity_category="config",
            state_topic=topics.at(PUBLISHED, label=name),
            state_on="ON",
            state_off="OFF",
            payload_on=_command(told=True, label=name),
            payload_off=_command(told=False, label=name),
            command_topic=command,
        )
    for key, component in components.items():
        component["unique_id"] = f"{own}-{key}"
    components |= {f"told_{identifier(name)}": {"p": "switch"} for name in gone}
    return {
        **_device(own, f"Hearthlog {topics.node}"),
        "availability": [{"topic": topics.at("bridge")}],
        "components": components,
    }


def topics_in_discovery(topics: Topics, payload: bytes) -> list[TopicKey]:
    """Return the topics in a discovery payload of this recorder; empty for other payloads."""
    try:
        content = json.loads(payload)
        (own,) = content["device"]["identifiers"]
        bridge, *listening = [each["topic"] for each in content["availability"]]
        named = [
            each[key]
            for each in content["components"].values()
            for key in ("state_topic", "json_attributes_topic")
            if key in each
        ]
        keys = [topics.parse(topic) for topic in [*listening, *named]]
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return []
    microphone = keys[0].microphone if listening and keys[0] is not None else ""
    device = device_id(topics.node, microphone) if microphone else home_id(topics.node)
    if (own, bridge) != (device, topics.at("bridge")):
        return []
    more = [TopicKey("last_event", microphone)] if microphone else []
    found = [each for each in keys if each is not None and each.microphone == microphone]
    counted = dict.fromkeys(each.label for each in found if each.kind == "counts")
    more += [
        TopicKey(kind, microphone, label)
        for label in counted
        for kind in ("count_today", "count_night")
    ]
    return [TopicKey(CONFIG, microphone), *found, *more]


def _device(own: str, name: str) -> dict[str, Any]:
    return {
        "device": {
            "identifiers": [own],
            "name": name,
            "manufacturer": "hearthlog",
            "model": "sounds of a home",
        },
        "origin": {"name": "hearthlog", "sw_version": __version__},
        "qos": 1,
    }


def _command(**fields: Any) -> str:
    return json.dumps({**fields, "by": _BY})


def _entity(platform: str, name: str, **fields: Any) -> Component:
    return {"p": platform, "name": name, **fields}


def _of_microphone(topics: Topics, microphone: str, sounds: Sequence[str]) -> dict[str, Component]:
    def at(kind: str) -> str:
        return topics.at(kind, microphone)

    def diagnostic(name: str, device_class: str, topic: str, **fields: Any) -> Component:
        fields = {
            "device_class": device_class,
            "entity_category": "diagnostic",
            "state_topic": topic,
            **fields,
            "availability": [{"topic": topics.at("bridge")}],
        }
        return _entity("binary_sensor", name, **fields)

    online = {"payload_on": "online", "payload_off": "offline"}
    return {
        # No `options`: if a new model lacks the displayed class, Home Assistant would fail and
        # accept no further discovery. No confidence: every change would be stored.
        "heard": _entity(
            "sensor",
            "Heard",
            state_topic=at("heard"),
            value_template="{{ value_json.label }}",
            icon="mdi:ear-hearing",
        ),
        "sound": _entity(
            "binary_sensor", "Any sound", device_class="sound", state_topic=at("sound")
        ),
        "level": _entity(
            "sensor",
            "Level",
            unit_of_measurement="dBFS",
            state_class="measurement",
            state_topic=at("level"),
            suggested_display_precision=0,
            icon="mdi:volume-high",
        ),
        "event": _entity(
            "event",
            "Event",
            event_types=list(sounds),
            state_topic=at("event"),
            icon="mdi:waveform",
        ),
        "listening": diagnostic("Listening", "connectivity", at("listening"), **online),
        "recorder": diagnostic("Recorder", "connectivity", topics.at("recorder"), **online),
        "problem": diagnostic(
            "Problem",
            "problem",
            at("problem"),
            value_template="{{ value_json.state }}",
            json_attributes_topic=at("problem"),
        ),
    }


def _words(names: Sequence[str]) -> dict[str, str]:
    """Return unique readable names of classes; Home Assistant rejects triggers of equal name."""
    words = {name: in_words(name) for name in names}
    times = Counter(words.values())
    return {name: word if times[word] == 1 else f"{word} ({name})" for name, word in words.items()}


def _of_class(topics: Topics, microphone: str, name: str, words: str) -> dict[str, Component]:
    def at(kind: str) -> str:
        return topics.at(kind, microphone, name)

    def count(kind: str, start: str, what: str) -> Component:
        # Not `total_increasing`: a correction, or a television that becomes known, lowers a count.
        return _entity(
            "sensor",
            f"{words} {what}",
            state_class="total",
            state_topic=at("counts"),
            value_template=f"{{{{ value_json.{kind} }}}}",
            last_reset_value_template=f"{{{{ value_json.{start} }}}}",
            icon="mdi:counter",
        )

    last = {"device_class": "timestamp", "state_topic": at("last_heard")}
    components = {
        "on": _entity("binary_sensor", words, device_class="sound", state_topic=at("on")),
        "count_today": count("today", "day_start", "today"),
        "count_night": count("night", "night_start", "last night"),
        "last_heard": _entity("sensor", f"{words} last heard", **last),
        "trigger": {
            "p": "device_automation",
            "automation_type": "trigger",
            "topic": topics.at("event", microphone),
            "value_template": "{{ value_json.event_type }}",
            "type": "heard",
            "subtype": words,
            "payload": _untemplated(name),
        },
    }
    return {f"{kind}_{identifier(name)}": each for kind, each in components.items()}


def _untemplated(text: str) -> str:
    """Escape a text so that Home Assistant's templates leave it unchanged."""
    return "{{ " + json.dumps(text, ensure_ascii=False) + " }}" if "{" in text else text
