"""The models that labelled the microphones of a log as it was recorded."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.logs.recorder_info import first_message, microphones_of
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.metadata import read_provenance, recorded_scenarios
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import topic

_ANY = ""  # microphone, where the record alone names a model


class LabelledBy(NamedTuple):
    """A model; both texts are empty for none."""

    model: str
    model_sha256: str


NO_MODEL = LabelledBy("", "")


def models_of(log: Path) -> Mapping[str, LabelledBy]:
    """Read which models labelled the microphones of a log.

    Returns
    -------
    mapping of str to LabelledBy
        By the names of the microphones, in their order. Of a file in which none of them says it,
        that of its `hearthlog` record, by an empty name. Empty if it says nothing, is damaged, or
        has no message of several microphones yet.
    """
    models: dict[str, LabelledBy] = {}
    with suppress(LogError), LogFile(log) as file:
        names = sorted(microphones_of(file, "info"))
        for name in names:
            info = first_message(file, topic(name, "info"), message_types.STREAM_INFO)
            if info:
                models[name] = LabelledBy(info["model"], info["model_sha256"])
        if not models and len(names) <= 1:
            for record in read_provenance(file)[-1:]:
                models[_ANY] = LabelledBy(record.get("model", ""), record.get("model_sha256", ""))
    return models


def model_of(log: Path, microphone: str, scenario: str = "") -> LabelledBy:
    """Read which model labelled a microphone of a log, or of a layer; as `models_of`.

    Parameters
    ----------
    scenario : str, optional
        For which it labelled; empty for the sounds of the home.
    """
    if scenario:
        return scenario_models(log).get((microphone, scenario), NO_MODEL)
    models = models_of(log)
    return models.get(microphone, models.get(_ANY, NO_MODEL))


def scenario_models(log: Path) -> Mapping[tuple[str, str], LabelledBy]:
    """Read which models labelled for the scenarios of a log.

    Returns
    -------
    mapping of (str, str) to LabelledBy
        By microphone and scenario; empty if there is none, or the log is damaged.
    """
    of_scenarios: dict[tuple[str, str], LabelledBy] = {}
    with suppress(LogError), LogFile(log) as file:
        for record in read_provenance(file):
            for one in recorded_scenarios(record):
                of_scenarios[one.microphone, one.name] = LabelledBy(one.model, one.sha256)
    return of_scenarios
