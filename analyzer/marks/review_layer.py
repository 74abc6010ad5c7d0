"""The file of a review layer: its topics, and the rows of each."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.logs.typed_columns import decode_types, is_compatible
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column
from hearthlog.schemas.messages.topics import Topic, is_review, labelling_topic, parse_topic

_KINDS = {
    message_types.SEGMENT: "segment",
    message_types.MARK: "mark",
    message_types.REVIEWED: "reviewed",
}
_SPAN = ("header.stamp", "duration")
_ORIGIN = ("reviewer", "made", "corrects")
# Of a row, behind its microphone, start and end.
_OWN = {
    message_types.SEGMENT: ("label",),
    message_types.MARK: ("label", *_ORIGIN, "reason"),
    message_types.REVIEWED: (*_ORIGIN, "chosen"),
}
_FIELDS = {type_: (*_SPAN, *own) for type_, own in _OWN.items()}
Key = tuple[str, str]  # a labelling, as `review`, and a type of messages
Row = tuple[Any, ...]


def read_rows(path: Path) -> dict[Key, list[Row]]:
    """Read a review layer.

    Returns
    -------
    dict of (str, str) to list of tuple
        By labelling and type: microphone, start and end in nanoseconds of UTC, and of a segment its
        label; of a mark label, reviewer, made, corrects and reason; of a reviewed span reviewer,
        made, corrects and chosen.

    Raises
    ------
    LogError
        If it cannot be read, is damaged or cut off, or holds other topics.
    """
    with LogFile(path) as file:
        complete = file.complete
    selection = select([path])
    if not complete:
        raise LogError(f"{path}: is cut off; `hearthlog recover` saves what is there of it")
    for name, same in selection.channels.items():
        kind = next((k for k in _KINDS if all(is_compatible(*d, k, _FIELDS[k]) for d in same)), "")
        parts = parse_topic(name)
        if parts is None or not is_review(parts.labelling) or parts.kind != _KINDS.get(kind):
            raise LogError(f"{path}: is no review layer: it has a topic {name!r}; move it away")
    selection.verify()
    rows: dict[Key, list[Row]] = {}
    for batch in selection.messages():
        for columns in decode_types(path, batch, _FIELDS):
            parts = parse_topic(columns.topic)
            assert parts is not None
            key = parts.labelling, columns.type
            rows.setdefault(key, []).extend(_rows(parts.microphone, columns))
    return rows


def layer_bytes(name: str, spans: Mapping[Key, Sequence[Any]], metadata: dict[str, str]) -> bytes:
    """Return the content of a review layer."""
    batches = [
        (
            Topic(labelling_topic(microphone, labelling, _KINDS[type_]), type_),
            [span for span in same if span.microphone == microphone],
        )
        for (labelling, type_), same in spans.items()
        for microphone in sorted({span.microphone for span in same})
    ]
    # In another folder, where nobody takes it for a log being recorded.
    with tempfile.TemporaryDirectory(prefix="hearthlog") as folder:
        writer = LogWriter(Path(folder) / name, [topic for topic, _ in batches], metadata)
        writer.write_columns([_batch(*batch) for batch in batches])
        return writer.finish().read_bytes()


def _rows(microphone: str, columns: Columns) -> Iterator[Row]:
    starts = columns["header.stamp"]
    ends = starts + columns["duration"]
    own = [columns[name].tolist() for name in _OWN[columns.type]]
    for row in zip(starts.tolist(), ends.tolist(), *own, strict=True):
        yield (microphone, *row)


def _batch(topic: Topic, spans: Sequence[Any]) -> TopicBatch:
    starts = np.array([span.start for span in spans])
    ends = np.array([span.end for span in spans])
    fields: dict[str, Column] = {
        "header.stamp": starts,
        "header.frame_id": spans[0].microphone,
        "duration": ends - starts,
    }
    if topic.type == message_types.SEGMENT:
        fields["confidence"] = np.ones(len(spans), np.float32)
    for name in _OWN[topic.type]:
        values = [getattr(span, name) for span in spans]
        fields[name] = np.array(values) if name == "made" else values
    return TopicBatch(topic.name, ends, fields)
