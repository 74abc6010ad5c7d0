"""The layer that a relabelling makes: its name, its topics and its `hearthlog` record."""

import glob
import json
import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from hearthlog.models.labels.segments import StateRun
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.metadata import provenance, read_provenance
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import Topic, label_topics, relabelling

OpenRuns = Mapping[str, StateRun]  # open segments, by the names of their microphones
_RUN = ("label", "start", "frames", "confidence")


class LayerInputs(NamedTuple):
    """What a layer is made from; equal inputs give equal labels and segments.

    `before` and `behind` are stems of the logs before and after; empty where there is none, or
    where it was not decided yet whether the sound goes on there.
    """

    model: str
    model_sha256: str  # of the model file
    input_sha256: str  # `log_digest` of the log
    before: str
    behind: str


class LayerMetadata(NamedTuple):
    """What the `hearthlog` record of a layer says."""

    inputs: LayerInputs
    open_at_start: OpenRuns  # the segments that were open when the log began
    open_at_end: OpenRuns
    loss: str  # what could not be read of the log


def layer_topics(microphone: str, model: str, classes: Sequence[str]) -> tuple[Topic, Topic]:
    """Return the topics of a layer.

    Parameters
    ----------
    classes : sequence of str
        In the order of the model's probabilities.
    """
    return label_topics(microphone, relabelling(model), classes)


def read_layer_metadata(layer: Path) -> LayerMetadata | None:
    """Read what a layer says of itself; None if there is no layer.

    Raise `LogError` if the layer is damaged, or `relabel` has not made it.
    """
    if not layer.exists():
        return None
    try:
        with LogFile(layer) as file:
            record = {key: text for each in read_provenance(file) for key, text in each.items()}
            microphones = {_microphone(channel.topic) for channel in file.channels.values()}
        return LayerMetadata(
            LayerInputs(*(record[name] for name in LayerInputs._fields)),
            _read_runs(record["began"], microphones),
            _read_runs(record["ended"], microphones),
            record["lost"],
        )
    except (KeyError, ValueError, TypeError, ArithmeticError, RecursionError, LogError) as error:
        why = error if isinstance(error, LogError) else f"{layer}: is no layer of `relabel`"
        raise LogError(f"{why}; move it away, and run again") from error


def part_path(layer: Path) -> Path:
    """Return a path for an unfinished layer: hidden beside the layer, and new each time."""
    return layer.with_name(f".{layer.name}.{os.urandom(8).hex()}.part")


def delete_parts(layer: Path) -> None:
    """Delete the unfinished files that this and other runs have left of a layer."""
    for part in layer.parent.glob(f".{glob.escape(layer.name)}.*"):
        with suppress(OSError):
            part.unlink()


def layer_record(
    metadata: LayerMetadata, log: str, node: str, more: Mapping[str, str]
) -> dict[str, str]:
    """Make the `hearthlog` record of a layer."""
    return provenance(
        node,
        log=log,
        **more,
        **metadata.inputs._asdict(),
        began=_runs_text(metadata.open_at_start),
        ended=_runs_text(metadata.open_at_end),
        lost=metadata.loss,
        made=_now(),
    )


def _now() -> str:
    """Return the time, or that of SOURCE_DATE_EPOCH, by which builds are made reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%SZ}"


def _microphone(topic: str) -> str:
    return topic.split("/")[1]


def _runs_text(runs: OpenRuns) -> str:
    """Write open segments as JSON; empty if there are none."""
    return json.dumps({name: run._asdict() for name, run in runs.items()}) if runs else ""


def _read_runs(text: str, microphones: Collection[str]) -> OpenRuns:
    """Read open segments; of older layers, which have one microphone, they have no name."""
    if not text:
        return {}
    fields = json.loads(text)
    if not isinstance(fields, dict) or not fields:
        raise ValueError
    if set(fields) == set(_RUN):
        (microphone,) = microphones
        fields = {microphone: fields}
    return {name: StateRun(*(int(run[key]) for key in _RUN)) for name, run in fields.items()}
