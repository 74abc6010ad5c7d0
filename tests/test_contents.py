"""What a finished log says of its messages is what they say, and is believed only if it can be."""

import hashlib
import json
import math
from dataclasses import replace
from io import BytesIO
from itertools import chain
from threading import Event

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import read
from lossy_source import LossySource
from mcap.records import Metadata
from rewriting import Log

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.logs import summary as summarising
from hearthlog.analyzer.logs.summary import summarise
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.logs.contents import (
    CONTENTS_METADATA,
    LogContents,
    as_metadata,
    from_metadata,
    stated_contents,
)
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import LogStreamWriter, LogWriter
from hearthlog.schemas.mcap.chunks import read_in_batches
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode_gap
from hearthlog.schemas.messages.topics import Topic
from hearthlog.schemas.salvage.recover import recover_log, thin_log

START = 1_772_323_200 * 10**9
LOST = {2: 25, 3: 400}


@pytest.fixture(scope="module")
def logs(tmp_path_factory, model_file, day):
    """Two files of one recording with gaps."""
    settings = Settings(
        output=tmp_path_factory.mktemp("logs"),
        model=model_file,
        microphone=[MicrophoneSettings(name="hall")],
        max_bag_duration=120,
    )
    return record(settings, LossySource(FileSource([day], START), LOST), Event()).logs


def stated(path):
    with LogFile(path) as file:
        return stated_contents(file)


def counted(path):
    contents = LogContents()
    with LogFile(path) as file:
        for batch in read_in_batches(file, file.chunks):
            contents.add(batch)
    return contents


def check(path):
    assert stated(path) is not None
    assert as_metadata(stated(path)) == as_metadata(counted(path))  # in the same order


def with_record(log, path, record):
    """Copy a log with another record of its contents."""
    rewritten = Log(log)
    rewritten.items.append(Metadata(CONTENTS_METADATA, record))
    return rewritten.write(path)


def same(summary, other):
    anywhere = {"files": [], "size": 0, "chunk_bytes": 0}
    return replace(summary, **anywhere) == replace(other, **anywhere)


def test_a_recorded_log_says_what_its_messages_say(logs):
    for log in logs:
        check(log)
    contents = stated(logs[0])
    assert [gap.frames_lost for gap in contents.gaps] == list(LOST.values())
    assert contents.frames["hall"].total() == contents.topics["/hall/label"].messages > 1000
    segments = read(logs[0], "segment")
    assert contents.segments["hall"].total() == len(segments)
    unsure = [s for s in segments if s.confidence < 0.5 and s.label not in {"silence", "unknown"}]
    assert contents.unsure["hall"]["segments"] == len(unsure)


def test_what_is_made_of_logs_says_what_its_messages_say(logs, hearthlog, tmp_path):
    both = [str(log) for log in logs]
    made = [tmp_path / name for name in ("merged.mcap", "cut.mcap", "recovered.mcap", "thin.mcap")]
    hearthlog("merge", *both, "-o", made[0])
    hearthlog("cut", logs[0], "--end", "2026-03-01T00:01:10Z", "-o", made[1])
    active = tmp_path / "torn.mcap.active"
    active.write_bytes(logs[0].read_bytes()[: logs[0].stat().st_size * 2 // 3])
    recover_log(active, made[2], made[2].name, chunk_span=10**10)
    thin_log(logs[0], made[3], 2)
    for path in made:
        check(path)
        with LogFile(path) as file:
            records = [file.record(place) for place in file.record_locations]
        assert sum(getattr(record, "name", "") == CONTENTS_METADATA for record in records) == 1
    assert len(stated(made[0]).gaps) == 2
    assert "/hall/features" not in stated(made[3]).topics


def test_layers_say_what_their_messages_say(logs, hearthlog, model_file, tmp_path):
    copies = [tmp_path / log.name for log in logs]
    for log, copy in zip(logs, copies, strict=True):
        copy.write_bytes(log.read_bytes())
    hearthlog("relabel", tmp_path, "--model", model_file)
    mark = Mark("hall", START + 10**10, START + 2 * 10**10, "speech", "Anna")
    write_marks(copies[0], [mark])
    layers = [path for path in find_logs(tmp_path) if path not in copies]
    assert len(layers) == 3
    for layer in layers:
        check(layer)


def test_a_summary_of_finished_logs_reads_no_messages(logs, monkeypatch, tmp_path):
    plain = [Log(log).write(tmp_path / log.name) for log in logs]
    expected = summarise(plain)
    monkeypatch.setattr(summarising, "read_in_batches", None)
    summary = summarise(logs)
    assert summary.metadata == expected.metadata | {CONTENTS_METADATA}
    ours = {"metadata": set(), "chunk_bytes": 0, "chunks": 0, "raw_bytes": 0}
    assert same(replace(summary, **ours), replace(expected, **ours))


@pytest.mark.parametrize("name", [b"version", b"sha256", b"silence"])
def test_a_damaged_record_is_not_believed(logs, tmp_path, name):
    path, data = tmp_path / logs[0].name, logs[0].read_bytes()
    start = data.rindex(CONTENTS_METADATA.encode(), 0, data.rindex(b"topics"))
    place = data.index(name, start)
    path.write_bytes(
        data[:place] + data[place : place + len(name)].upper() + data[place + len(name) :]
    )
    assert stated(path) is None
    assert same(summarise([path]), summarise([logs[0]]))


def test_what_another_log_says_is_not_believed(logs, tmp_path):
    path = with_record(logs[0], tmp_path / logs[0].name, as_metadata(stated(logs[1])))
    assert stated(path) is None
    assert same(summarise([path]), summarise([logs[0]]))


def test_a_record_of_a_later_version_is_not_read(logs, tmp_path):
    record = {**as_metadata(stated(logs[0])), "version": "2"}
    assert stated(with_record(logs[0], tmp_path / logs[0].name, record)) is None


@pytest.fixture(scope="module")
def values(logs):
    """What a record says, with something in every place."""
    found = json.loads(as_metadata(stated(logs[0]))["contents"])
    assert all(found.values())
    return found


ODD = (None, True, -1, 1.5, 10**400, 2**63, float("nan"), float("inf"), "a", [], {}, [1], {"a": 1})


@settings(max_examples=500, deadline=None)
@given(st.data())
def test_whatever_a_record_holds_it_is_counts_and_names_or_nothing(values, data):
    changed = json.loads(json.dumps(values))
    place, path = changed, []
    while isinstance(place, dict | list) and place:
        keys = sorted(place) if isinstance(place, dict) else range(len(place))
        path.append((place, data.draw(st.sampled_from(keys))))
        place = path[-1][0][path[-1][1]]
    parent, key = data.draw(st.sampled_from(path))
    parent[key] = data.draw(st.sampled_from(ODD))
    contents = from_metadata(record_of(json.dumps(changed)))
    if contents is not None:
        assert from_metadata(as_metadata(contents)) == contents
        assert all(type(n) is int and -(2**63) <= n < 2**63 for n in counts(contents))
        assert all(math.isfinite(n) and abs(n) < 2**63 for n in amounts(contents))
        assert all(isinstance(text, str) for text in texts(contents))


def counts(contents):
    for rows in (contents.frames, contents.segments):
        yield from chain.from_iterable(row.values() for row in rows.values())
    yield from chain.from_iterable(contents.topics.values())
    yield from chain.from_iterable((gap.start, gap.frames_lost) for gap in contents.gaps)
    yield from () if contents.health is None else contents.health[1:3]


def amounts(contents):
    for rows in (contents.seconds, contents.unsure):
        yield from chain.from_iterable(row.values() for row in rows.values())
    yield from (gap.seconds for gap in contents.gaps)
    yield from (stream["frame_seconds"] for stream in contents.streams)


def texts(contents):
    yield from chain.from_iterable((gap.microphone, gap.reason) for gap in contents.gaps)
    for stream in contents.streams:
        yield from (value for name, value in stream.items() if name != "frame_seconds")
    yield from () if contents.health is None else contents.health[::3]


def record_of(text):
    return {
        "version": "1",
        "contents": text,
        "sha256": hashlib.sha256(text.encode(errors="replace")).hexdigest(),
    }


@pytest.mark.parametrize("text", ["", "null", "[]", "[" * 20_000, "1" * 5000, '{"topics": {}}'])
def test_what_is_no_record_is_none(text):
    assert from_metadata(record_of(text)) is None


def test_a_log_with_very_many_gaps_says_nothing_of_them(tmp_path):
    assert CONTENTS_METADATA in names(gaps_in_log(tmp_path / "few.mcap", 100))
    path = gaps_in_log(tmp_path / "many.mcap", 5000)
    assert CONTENTS_METADATA not in names(path)
    assert len(summarise([path]).gaps) == 5000


def gaps_in_log(path, count):
    writer = LogWriter(path, [Topic("/mic/gap", message_types.GAP)], {})
    for time in range(START, START + count * 10**9, 10**9):
        writer.write("/mic/gap", time, encode_gap("mic", time - 10**8, time, "overflow", 2))
    return writer.finish()


def names(path):
    return summarise([path]).metadata


def test_the_doctor_finds_a_record_that_says_otherwise(logs, tmp_path):
    def rules(path):
        return {finding.rule for findings in examine(path) for finding in findings.shown}

    contents = stated(logs[0])
    assert "contents" not in rules(with_record(logs[0], tmp_path / "a.mcap", as_metadata(contents)))
    contents.frames["hall"]["speech"] += 1
    lying = with_record(logs[0], tmp_path / "b.mcap", as_metadata(contents))
    assert "contents" in rules(lying)
    assert summarise([lying]).label_seconds != summarise([logs[0]]).label_seconds
    other = with_record(logs[0], tmp_path / "c.mcap", as_metadata(stated(logs[1])))
    assert "contents" in rules(other)


def test_a_long_log_is_counted_without_being_kept(monkeypatch):
    batches = []
    monkeypatch.setattr(LogContents, "add", lambda _, batch: batches.append(len(batch[0].buffer)))
    writer = LogStreamWriter(BytesIO(), [Topic("/mic/audio", message_types.RAW_AUDIO)])
    for number in range(1000):
        writer.write_messages([(START + number, "/mic/audio", bytes(20_000))])
    writer.end("long.mcap")
    assert max(batches) < 5 << 20 < 19 << 20 < sum(batches)
