"""Which scenarios a log has labels of: entries of its metadata record `hearthlog`."""

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages.topics import (
    SCENARIO,
    check_microphone_name,
    check_scenario_name,
)

_KEY = re.compile(f"{SCENARIO}/([^/]+)/([^/]+)")


class RecordedScenario(NamedTuple):
    """A scenario that ran on what a microphone heard, and the model that labelled for it."""

    microphone: str
    name: str
    model: str
    sha256: str


def scenario_entries(scenario: RecordedScenario) -> dict[str, str]:
    """Return what the record says of a scenario."""
    key = f"{SCENARIO}/{scenario.microphone}/{scenario.name}"
    return {key: scenario.model, f"{key}/sha256": scenario.sha256}


def recorded_scenarios(record: Mapping[str, str]) -> Iterator[RecordedScenario]:
    """Yield the scenarios that a record names, in its order."""
    for key, model in record.items():
        names = _KEY.fullmatch(key)
        if names is None:
            continue
        try:
            microphone, name = check_microphone_name(names[1]), check_scenario_name(names[2])
        except LogError:
            continue
        yield RecordedScenario(microphone, name, model, record.get(f"{key}/sha256", ""))
