"""Who hears: a microphone by the model of the home, or by that of a scenario.

The second is named `<microphone>-<scenario>`, which is no name of a microphone.
"""

from hearthlog.schemas.messages.topics import LIVE, SCENARIO, TopicName, is_scenario

_BETWEEN = "-"


def listener_of(topic: TopicName) -> str | None:
    """Name who labels what a topic has; None for what no recorder labels live."""
    if topic.labelling == LIVE:
        return topic.microphone
    if is_scenario(topic.labelling):
        return listener_name(topic.microphone, topic.labelling.removeprefix(f"{SCENARIO}/"))
    return None


def listener_name(microphone: str, scenario: str) -> str:
    """Name the model of a scenario that hears by a microphone."""
    return f"{microphone}{_BETWEEN}{scenario}"


def microphone_of_listener(listener: str) -> str:
    """Return the name of the microphone."""
    return listener.partition(_BETWEEN)[0]


def scenario_of_listener(listener: str) -> str:
    """Return the name of the scenario; empty for the model of the home."""
    return listener.partition(_BETWEEN)[2]


def is_of_scenario(listener: str) -> bool:
    """Tell whether the model of a scenario hears."""
    return _BETWEEN in listener
