"""Logs of ours in the hands of the official TypeScript readers, those of Foxglove."""

import json
import os
import shutil
import subprocess
from collections import Counter
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pytest
from logreader import LogReader
from mcap.reader import make_reader
from test_interoperability import TOPICS, chunks, logs, plain, recorded

from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages.message_types import (
    GAP,
    LABEL,
    duration_message,
    encode,
    header,
    message,
)
from hearthlog.schemas.messages.topics import Topic

__all__ = ["logs", "recorded"]  # fixtures

FOLDER = Path(__file__).parent / "typescript"
WHOLE, CUT = 0, 3  # exit status
CRC_IN_CHUNK = 9 + 3 * 8  # behind opcode, length, two times and a size


def need_node(modules):
    if shutil.which("node") and modules.is_dir():
        return
    reason = "needs Node.js and, once, `npm ci --prefix tests/typescript`"
    if os.environ.get("TESTS_REQUIRE_NODE") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


def run(way, path):
    need_node(FOLDER / "node_modules")
    command = ["node", FOLDER / "read.mjs", way, path]
    return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False)


def rows(way, path, status=WHOLE):
    done = run(way, path)
    assert done.returncode == status, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def ours(log):
    """The messages of a log in its order, in the words of the TypeScript reader."""
    return [
        {
            "topic": item.topic,
            "schema": item.type,
            "logTime": item.log_time,
            "publishTime": item.log_time,
            "sequence": 0,
            "fields": plain(item.decode()),
        }
        for item in log.messages()
    ]


def like(theirs, own):
    """What JSON carried, typed as the same part of our message is."""
    if theirs is None or own is None:
        return theirs
    if isinstance(own, dict):
        return {name: like(part, own.get(name)) for name, part in theirs.items()}
    if isinstance(own, bytes):
        values = theirs if isinstance(theirs, list) else [theirs]
        return np.array([float(value) for value in values]).tobytes()
    if isinstance(own, list):
        return [like(*pair) for pair in zip_longest(theirs, own)]
    if isinstance(own, int) and isinstance(theirs, str):
        return int(theirs)
    return theirs


def test_the_typescript_readers_give_the_same_messages_bit_for_bit(logs):
    types = {}
    for path in logs:
        own = ours(LogReader(path))
        types |= {row["topic"]: row["schema"] for row in own}
        for way in ("messages", "stream"):
            assert like(rows(way, path), own) == own
    assert types == TOPICS


def test_extreme_values_survive(tmp_path):
    floats = [np.nan, np.inf, -np.inf, -0.0, 2.0**-149, 0.1, np.finfo(np.float32).max]
    frames = 2**64 - 1
    fields = {
        LABEL: {
            "frame": frames,
            "label": "Spüle \U0001f6b0",
            "confidence": -0.0,
            "novelty": np.inf,
            "probabilities": np.array(floats, np.float32),
        },
        GAP: {"duration": duration_message(-1), "reason": "", "frames_lost": frames},
    }
    log = LogWriter(tmp_path / "log.mcap", [Topic("/" + name, name) for name in fields], {})
    for name, values in fields.items():
        log.write("/" + name, 2**63 - 2, encode(message(name, header=header(0, "mic"), **values)))
    path = log.finish()
    own = ours(LogReader(path))
    assert len(own) == len(fields)
    for way in ("messages", "stream"):
        assert like(rows(way, path), own) == own


def test_a_file_that_is_being_written_streams_up_to_its_last_whole_chunk(recorded, tmp_path):
    _, unfinished = recorded
    full = unfinished.read_bytes()
    layout = chunks(full)
    middle, _ = layout[len(layout) // 2]
    cut = tmp_path / "cut.mcap.active"
    for length in (middle - 1, middle, len(full)):
        cut.write_bytes(full[:length])
        own = ours(LogReader(cut))
        assert len(own) == sum(count for end, count in layout if end <= length)
        assert like(rows("stream", cut, CUT), own) == own


def test_the_index_says_what_is_in_the_file(logs):
    for path in logs:
        (output,) = rows("summary", path)
        log = LogReader(path)
        own = ours(log)
        times = [row["logTime"] for row in own]
        statistics, channels = output["statistics"], output["channels"]
        topics = {str(c["id"]): c["topic"] for c in channels}
        counts = {topics[i]: int(n) for i, n in statistics["channelMessageCounts"].items()}
        assert output["header"]["profile"] == "ros2"
        assert counts == Counter(row["topic"] for row in own)
        assert int(statistics["messageCount"]) == len(own)
        assert int(statistics["messageStartTime"]) == times[0]
        assert int(statistics["messageEndTime"]) == times[-1]
        assert statistics["chunkCount"] == len(output["compressions"])
        assert set(output["compressions"]) == {"zstd"}
        assert {c["topic"]: c["metadata"] for c in channels} == {
            topic: channel.metadata for topic, channel in log.channels.items()
        }
        assert output["metadata"] == log.metadata
        assert output["attachments"] == {k: data.decode() for k, data in log.attachments.items()}
        assert (len(log.metadata), len(log.attachments)) == (3, 3)


def flipped(path, place, folder):
    """A copy of a log with one bit of it changed."""
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    damaged = folder / f"damaged_{place}.mcap"
    damaged.write_bytes(data)
    return damaged


def test_the_file_carries_the_checksums_that_the_typescript_readers_check(logs, tmp_path):
    (output,) = rows("summary", logs[0])
    with logs[0].open("rb") as stream:
        summary = make_reader(stream).get_summary()
    chunk = summary.chunk_indexes[1].chunk_start_offset + CRC_IN_CHUNK
    attachment = summary.attachment_indexes[0]
    text = attachment.offset + attachment.length - 5  # its last byte; a checksum follows
    schema = int(output["footer"]["summaryStart"]) + 20
    assert any(logs[0].read_bytes()[chunk : chunk + 4])  # a zero would not be checked
    for place, ways, complaint in (
        (chunk, ["messages", "stream"], "Incorrect chunk CRC"),
        (text, ["summary", "stream"], "Attachment CRC32 mismatch"),
        (schema, ["messages", "summary"], "Incorrect summary CRC"),
    ):
        damaged = flipped(logs[0], place, tmp_path)
        for way in ways:
            done = run(way, damaged)
            assert done.returncode == 1
            assert complaint in done.stderr


@pytest.mark.parametrize(
    ("required", "outcome"), [("", pytest.skip.Exception), ("1", pytest.fail.Exception)]
)
def test_missing_node_skips_on_a_desk_and_fails_where_required(
    required, outcome, monkeypatch, tmp_path
):
    monkeypatch.setenv("TESTS_REQUIRE_NODE", required)
    # Both are caught: a skip that escaped would skip this test instead of failing it.
    with pytest.raises((pytest.skip.Exception, pytest.fail.Exception), match="npm ci") as end:
        need_node(tmp_path / "node_modules")
    assert end.type is outcome
