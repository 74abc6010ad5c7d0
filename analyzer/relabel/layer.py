"""The layer that a relabelling makes: its name, its topics, and what it says of itself."""

import glob
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from hearthlog.models.labels.segments import Run
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.provenance import provenance, read_provenance
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import Topic, labelling_topic, relabelling

_TAIL = 1 << 16  # bytes
_RUN = ("label", "start", "frames", "confidence")


class Source(NamedTuple):
    """What a layer is made from; equal sources give equal labels and segments.

    Attributes
    ----------
    model, model_sha256 : str
    input_sha256 : str
        As `digest` gives it.
    before, behind : str
        Stems of the logs beside it; empty where there is none, or where it could not be told yet
        whether the sound goes on there.
    """

    model: str
    model_sha256: str
    input_sha256: str
    before: str
    behind: str


class About(NamedTuple):
    """What a layer says of itself.

    Attributes
    ----------
    source : Source
    began, ended : Run or None
        The segment that was open when the log began, and when it ended.
    lost : str
        What of the log could not be read.
    """

    source: Source
    began: Run | None
    ended: Run | None
    lost: str


def topics_of(microphone: str, model: str, classes: Sequence[str]) -> tuple[Topic, Topic]:
    """Return the topics of the labels and of the segments."""
    labelling = relabelling(model)
    label, segment = (labelling_topic(microphone, labelling, kind) for kind in ("label", "segment"))
    return (
        Topic(label, message_types.LABEL, array_names={"probabilities": classes}),
        Topic(segment, message_types.SEGMENT),
    )


def digest(log: Path) -> str:
    """Identify a log: the SHA-256 of its size and its last 64 KiB.

    There its index is, or the end of it, and the checksum of the index: it takes no reading of a
    whole log to see that it is still the same.
    """
    with LogFile(log, indexed=False) as file:
        size = file.size
        tail = file.read(max(size - _TAIL, 0), _TAIL)
    return hashlib.sha256(str(size).encode() + b"\0" + tail).hexdigest()


def read_about(layer: Path) -> About | None:
    """Read what a layer says of itself; None if there is no layer.

    Raises
    ------
    LogError
        If it is damaged, or is none.
    """
    if not layer.exists():
        return None
    try:
        with LogFile(layer) as file:
            record = {key: text for each in read_provenance(file) for key, text in each.items()}
        return About(
            Source(*(record[name] for name in Source._fields)),
            _read_run(record["began"]),
            _read_run(record["ended"]),
            record["lost"],
        )
    except (KeyError, ValueError, TypeError, ArithmeticError, RecursionError, LogError) as error:
        why = error if isinstance(error, LogError) else f"{layer}: is no layer of `relabel`"
        raise LogError(f"{why}; move it away, and run again") from error


def part_path(layer: Path) -> Path:
    """Name the beginning of a layer, which nothing takes for a log."""
    return layer.with_name(f".{layer.name}.{os.urandom(8).hex()}.part")


def delete_parts(layer: Path) -> None:
    """Delete what this and other runs have begun of a layer, now that it is there."""
    for part in layer.parent.glob(f".{glob.escape(layer.name)}.*"):
        with suppress(OSError):
            part.unlink()


def metadata_of(about: About, log: str, node: str, more: Mapping[str, str]) -> dict[str, str]:
    """Make the `hearthlog` record of a layer."""
    return provenance(
        node,
        log=log,
        **more,
        **about.source._asdict(),
        began=_run_text(about.began),
        ended=_run_text(about.ended),
        lost=about.lost,
        made=_now(),
    )


def _now() -> str:
    """Return the time, or that of SOURCE_DATE_EPOCH, by which builds are made reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%SZ}"


def _run_text(run: Run | None) -> str:
    return "" if run is None else json.dumps(run._asdict())


def _read_run(text: str) -> Run | None:
    if not text:
        return None
    fields = json.loads(text)
    return Run(*(int(fields[name]) for name in _RUN))
