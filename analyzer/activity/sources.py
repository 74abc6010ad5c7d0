"""Labelling sources: the home's model, or the model of a scenario, at a microphone."""

from hearthlog.schemas.messages.topics import (
    DIAGNOSTICS,
    LIVE,
    SCENARIO,
    TopicName,
    is_scenario,
    parse_topic,
)

_BETWEEN = "-"


def labelling_source(topic: TopicName) -> str | None:
    """Return the labelling source of a topic; None if the topic is not labelled live."""
    if topic.labelling == LIVE:
        return topic.microphone
    if is_scenario(topic.labelling):
        return source_name(topic.microphone, topic.labelling.removeprefix(f"{SCENARIO}/"))
    return None


def source_of_topic(topic: str) -> str | None:
    """Return the labelling source of a topic by its name; None as `labelling_source`."""
    name = parse_topic(topic)
    return None if name is None else labelling_source(name)


def source_name(microphone: str, scenario: str) -> str:
    """Return the labelling source of a scenario: `<microphone>-<scenario>`."""
    return f"{microphone}{_BETWEEN}{scenario}"


def source_parts(source: str) -> tuple[str, str]:
    """Return microphone and scenario of a labelling source; no scenario for the home's model."""
    microphone, _, scenario = source.partition(_BETWEEN)
    return microphone, scenario


def source_microphone(source: str) -> str:
    """Return the microphone of a labelling source."""
    return source_parts(source)[0]


def is_of_scenario(source: str) -> bool:
    """Whether a labelling source is the model of a scenario."""
    return _BETWEEN in source


def is_of_activity(topic: str) -> bool:
    """Whether a topic shows the activity of a home, or the health of its recorder."""
    name = parse_topic(topic)
    if name is None or labelling_source(name) is None:
        return topic == DIAGNOSTICS
    return name.kind in {"label", "segment"} or (name.kind == "gap" and name.labelling == LIVE)
