"""Logs written from arrays are what the writer of mcap makes of single messages: the same bytes."""

from io import BytesIO
from operator import itemgetter
from unittest.mock import patch

import numpy as np
import pytest
from conftest import spread_files
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap import compressed_chunk
from hearthlog.schemas.mcap.chunk_writer import Block, ChunkWriter, message_blocks
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, header, message
from hearthlog.schemas.messages.topics import Topic

pytestmark = pytest.mark.fast

LABELS = ["speech", "silence", "telephone_bell_ringing", ""]
TOPICS = [
    Topic("/mic/features", message_types.FEATURES, array_names={"values": ["a", "b"]}),
    Topic("/mic/label", message_types.LABEL),
]


def begun(writer):
    writer.start("ros2", "hearthlog")
    writer.add_metadata("hearthlog", {"node": "home", "löwe": ""})
    writer.add_attachment(1, 2, "card.md", "text/markdown", b"# A model")
    for name in ("a/msg/A", "b/msg/B"):
        schema = writer.register_schema(name, "ros2msg", b"int32 x")
        writer.register_channel(f"/{name[0]}", "cdr", schema, {"key": "value"})
    return writer


# Batches of (channel, size of the payload, step to the next message).
BATCHES = st.lists(
    st.lists(
        st.tuples(st.integers(1, 2), st.sampled_from([4, 5, 40, 900]), st.integers(0, 2)),
        max_size=30,
    ),
    max_size=6,
)


@settings(deadline=None)
@given(BATCHES, st.sampled_from([100, 1000, 5000, 1 << 20]), st.lists(st.booleans(), min_size=6))
def test_blocks_make_the_same_file_as_single_messages(batches, chunk_size, flushed):
    level_of_mcap = patch.object(compressed_chunk, "_LEVEL", 3)
    with level_of_mcap, patch.object(compressed_chunk, "_LOCAL", compressed_chunk._Local()):
        check_files(batches, chunk_size, flushed)


def check_files(batches, chunk_size, flushed):
    one, many, single = BytesIO(), BytesIO(), BytesIO()
    theirs = begun(Writer(one, chunk_size=chunk_size))
    ours = begun(ChunkWriter(many, chunk_size))
    by_one = begun(ChunkWriter(single, chunk_size))
    time = 10**18
    for batch, flush in zip(batches, flushed, strict=False):
        rows = []
        for number, (channel, size, step) in enumerate(batch):
            rows.append((channel, size, time, number, bytes([number % 251]) * size))
            time += step
        for channel, _, stamp, number, data in rows:
            theirs.add_message(channel, stamp, data, stamp + 1, number)
            by_one.add_message(channel, stamp, data, stamp + 1, number)
        ours.write(blocks(rows))
        if flush and hasattr(theirs, "flush"):  # from mcap 1.5 on
            for writer in (theirs, ours, by_one):
                writer.flush()
    for writer in (theirs, ours, by_one):
        writer.finish()
    assert many.getvalue() == one.getvalue() == single.getvalue()


def blocks(rows):
    """Group rows by channel and size, the last group first."""
    found = {}
    for row in rows:
        found.setdefault(row[:2], []).append(row)
    return [
        Block(
            channel,
            np.array([row[2] for row in same]),
            np.array([row[2] + 1 for row in same]),
            np.array([row[3] for row in same], np.uint32),
            np.array([row[4] for row in same], f"V{size}"),
            np.array([row[3] for row in same]),
        )
        for (channel, size), same in reversed(found.items())
    ]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32), st.integers(0, 3000))
def test_columns_make_the_same_log_as_encoded_messages(tmp_path_factory, seed, count):
    folder = tmp_path_factory.mktemp("logs")
    rng = np.random.default_rng(seed)
    times = 10**18 + np.cumsum(rng.integers(0, 3, count)) * 1_000_001
    frames = np.arange(count)
    values = rng.random((count, 2), np.float32)
    labels = [LABELS[i] for i in rng.integers(0, len(LABELS), count)]
    common = {"header.stamp": times, "header.frame_id": "mic", "frame": frames}
    decided = {
        "label": labels,
        "confidence": values[:, 0],
        "novelty": np.full(count, np.nan, np.float32),
        "probabilities": values,
    }
    many = LogWriter(folder / "many.mcap", TOPICS, {"node": "home"})
    for part in (slice(0, count // 3), slice(count // 3, count)):
        many.write_columns(
            [
                TopicBatch("/mic/features", times[part], rows({**common, "values": values}, part)),
                TopicBatch("/mic/label", times[part], rows({**common, **decided}, part)),
            ]
        )
    one = LogWriter(folder / "one.mcap", TOPICS, {"node": "home"})
    for part in (range(count // 3), range(count // 3, count)):
        encoded = [(times[i], "/mic/features", features(times[i], i, values[i])) for i in part]
        encoded += [
            (times[i], "/mic/label", label(times[i], i, labels[i], values[i])) for i in part
        ]
        for time, topic, data in sorted(encoded, key=itemgetter(0)):
            one.write(topic, int(time), data)
    assert content(many.finish()) == content(one.finish())


def rows(columns, part):
    return {name: v if isinstance(v, str) else v[part] for name, v in columns.items()}


def features(time, frame, values):
    about = header(int(time), "mic")
    return encode(message(message_types.FEATURES, header=about, frame=frame, values=values))


def label(time, frame, name, values):
    return encode(
        message(
            message_types.LABEL,
            header=header(int(time), "mic"),
            frame=frame,
            label=name,
            confidence=values[0],
            novelty=np.nan,
            probabilities=values,
        )
    )


def content(path):
    """Return all bytes before the index but the `rosbag2` record, which has the file's name."""
    with LogFile(path) as file:
        bag, contents = file.record_locations[-2:]
        rest = bag.offset + bag.length
        return file.read(0, bag.offset) + file.read(rest, contents.offset + contents.length - rest)


def test_messages_that_were_read_are_written_as_they_were(
    household, model_file, tmp_path, hearthlog
):
    audio = spread_files(household, 26)
    done = hearthlog("record", *audio, "-o", tmp_path, "--model", model_file)
    assert done.returncode == 0, done.stderr
    (log,) = find_logs(tmp_path)[:1]
    stream = BytesIO()
    writer = ChunkWriter(stream)
    writer.start("ros2", "hearthlog")
    with LogFile(log) as file:
        read_chunks(file, file.chunks[:1])
        for schema in file.schemas.values():
            writer.register_schema(schema.name, schema.encoding, schema.data)
        for channel in file.channels.values():
            writer.register_channel(
                channel.topic, channel.message_encoding, channel.schema_id, channel.metadata
            )
    for batch in iterate_messages([log]):
        writer.write([block for raw in batch for block in message_blocks(raw, raw.channel.id)])
    writer.finish()
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(stream.getvalue())
    for ours, theirs in zip(messages_of(copy), messages_of(log), strict=True):
        assert ours == theirs


def messages_of(path):
    """All messages, by topic and in the order of time."""
    found = []
    with LogFile(path) as file:
        for raw in read_chunks(file, file.chunks):
            heads = raw.heads
            found += [
                (raw.channel.topic, time, sent, sequence, raw.buffer[o : o + size].tobytes())
                for time, sent, sequence, o, size in zip(
                    heads["log_time"].tolist(),
                    heads["publish_time"].tolist(),
                    heads["sequence"].tolist(),
                    raw.offsets.tolist(),
                    raw.sizes.tolist(),
                    strict=True,
                )
            ]
    return sorted(found)


def test_a_log_says_how_many_messages_it_has_and_from_when_to_when(tmp_path):
    writer = LogWriter(tmp_path / "a.mcap", TOPICS, {})
    times = np.arange(5) * NANOSECONDS + 7
    fields = {"header.stamp": times, "header.frame_id": "mic", "frame": np.arange(5)}
    values = np.zeros((5, 2), np.float32)
    writer.write_columns([TopicBatch("/mic/features", times, {**fields, "values": values})])
    with LogFile(writer.finish()) as file:
        about = file.statistics
    assert about.message_count == 5
    assert about.message_start_time == 7
    assert about.message_end_time == 4 * NANOSECONDS + 7
    assert about.channel_message_counts == {1: 5}
