"""A catalogue says what is read of the logs, is never trusted more than they are, saves opening."""

import hashlib
import json
import os
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import date
from pathlib import Path
from threading import Event

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from homelife import write_day
from log_fixtures import record_logs, run
from logs import features, read
from mcap.opcode import Opcode
from stores import put

import hearthlog.analyzer.logs.catalog_writer
from hearthlog.analyzer.errors import LostClusterError
from hearthlog.analyzer.logs.catalog import (
    DAMAGED,
    FINISHED,
    LOG,
    UNFINISHED,
    export_parquet,
    homes,
    label_amounts,
    read_catalog,
)
from hearthlog.analyzer.logs.catalog_writer import write_catalog
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.workers import InlineWorkers, open_workers
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogWarning, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import CATALOG, active_path, find_logs, time_span
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.mcap.records import FOOTER_SIZE
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import nanoseconds
from hearthlog.schemas.messages.topics import RELABEL, REVIEW, Topic

SECOND = NANOSECONDS
START = 1_772_352_000_000_000_000  # a full hour


def fleet_of(recording: Path, folder: Path) -> Path:
    """Make two homes: one with a recording of several logs, one with a log that is cut off."""
    for path in find_logs(recording):
        copy = folder / "north" / "anna" / path.relative_to(recording)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)
    path = find_logs(recording)[0]
    copy = active_path(folder / "bert" / path.relative_to(recording))
    copy.parent.mkdir(parents=True)
    copy.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return folder


@pytest.fixture(scope="module")
def recording(day, model_file, tmp_path_factory):
    """Logs of a minute, with gaps."""
    return record_logs([day], tmp_path_factory.mktemp("recording"), model_file)


@pytest.fixture
def fleet(recording, tmp_path):
    return fleet_of(recording, tmp_path / "fleet")


def relabelled(log: Path, segments: list[tuple[int, str]]) -> Path:
    """Write a relabel layer: segments, each with its seconds, one after the other."""
    path = log.with_name(f"{log.stem}.relabel-better.1.mcap")
    topic = "/mic/relabel/better_1/segment"
    lengths = np.array([seconds for seconds, _ in segments]) * SECOND
    start = (time_span(log) or (0, 0))[0]
    fields = {
        "header.stamp": start + np.cumsum(lengths) - lengths,
        "header.frame_id": "mic",
        "duration": lengths,
        "label": [label for _, label in segments],
        "confidence": np.ones(len(segments), np.float32),
    }
    about = {
        "version": "7.8.9",
        "node": "attic",
        "log": log.name,
        "model": "better.1",
        "model_sha256": "ab" * 32,
        "input_sha256": "cd" * 32,
        "feature_set": DEFAULT.name,
    }
    writer = LogWriter(path, [Topic(topic, message_types.SEGMENT)], about)
    writer.write_columns([TopicBatch(topic, start + np.cumsum(lengths), fields)])
    return writer.finish()


def with_counts(data: bytes, count: int) -> bytes:
    """Let a log claim that each of its channels has so many messages."""
    footer = len(data) - FOOTER_SIZE
    (start,) = struct.unpack_from("<Q", data, footer + 9)
    changed = bytearray(data)
    place = start
    while place < footer:
        opcode, length = struct.unpack_from("<BQ", changed, place)
        if opcode == Opcode.STATISTICS:
            counts = place + 9 + 46  # behind numbers of fixed length, and the length of the map
            for entry in range(counts, place + 9 + length, 10):
                struct.pack_into("<Q", changed, entry + 2, count)
        place += 9 + length
    struct.pack_into("<I", changed, footer + 9 + 16, 0)  # no checksum of the summary
    return bytes(changed)


def rows(catalog) -> dict:
    return {row.path: row for row in catalog.rows()}


def without_times(catalog) -> list:
    return [replace(row, mtime=0) for row in catalog.rows()]


def garbage(path: Path) -> None:
    """Make a file nonsense of the same size and time, which whoever reads it will notice."""
    about = path.stat()
    path.write_bytes(bytes(about.st_size))
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))


def overwritten(path: Path) -> None:
    """Overwrite a few bytes of a chunk that has segments."""
    data = bytearray(path.read_bytes())
    with LogFile(path) as file:
        ids = {channel.topic: number for number, channel in file.channels.items()}
        chunk = next(
            chunk
            for chunk in file.chunks
            if ids["/mic/segment"] in file.channel_sets[chunk["channels"]]
        )
    middle = int(chunk["offset"] + chunk["length"] // 2)
    data[middle : middle + 50] = bytes(50)
    path.write_bytes(data)


def seconds_of(found) -> float:
    return nanoseconds(found.duration) / SECOND


def test_a_row_says_of_a_log_what_is_read_of_it_message_by_message(recorded, tmp_path):
    fleet = fleet_of(recorded, tmp_path / "fleet")
    catalog = write_catalog(fleet)
    assert len(catalog) == len(find_logs(fleet))
    for path in find_logs(fleet):
        row = catalog.current(path)
        numbers, stamps, values = features(path)
        segments, gaps, (info, *_) = read(path, "segment"), read(path, "gap"), read(path, "info")
        assert row.path == path.relative_to(fleet).as_posix()
        assert (row.kind, row.log, row.error) == (LOG, None, None)
        assert row.span == time_span(path)
        assert row.frames == len(values)
        assert (row.first_frame, row.first_stamp) == (numbers[0], stamps[0])
        assert (row.last_frame, row.last_stamp) == (numbers[-1], stamps[-1])
        assert row.microphones == [info.header.frame_id]
        assert (row.model, row.model_sha256) == (info.model, info.model_sha256)
        assert row.feature_set == info.feature_set
        assert row.gaps == len(gaps)
        assert row.gap_seconds == pytest.approx(sum(map(seconds_of, gaps)))
        minutes = Counter()
        for segment in segments:
            minutes[segment.label] += seconds_of(segment) / 60
        assert {one["label"]: one["minutes"] for one in row.labels} == pytest.approx(minutes)
        counts = Counter(segment.label for segment in segments)
        assert {one["label"]: one["segments"] for one in row.labels} == counts


def test_homes_nodes_and_states_are_told_apart(fleet):
    found = rows(write_catalog(fleet))
    assert {row.home for row in found.values()} == {"north/anna", "bert"}
    assert {row.state for row in found.values() if row.home == "north/anna"} == {FINISHED}
    (cut,) = [row for row in found.values() if row.home == "bert"]
    assert cut.state == UNFINISHED
    assert cut.node == Path(cut.path).name.partition("_")[0]


def test_a_log_outside_of_folders_of_days_is_of_no_home(recording, tmp_path):
    path = find_logs(recording)[0]
    shutil.copy2(path, tmp_path)
    (row,) = write_catalog(tmp_path).rows()
    assert (row.path, row.home) == (path.name, "")


def test_layers_have_rows_of_their_own_that_name_their_log(fleet):
    log = find_logs(fleet / "north")[0]
    start, _ = time_span(log)
    write_marks(log, [Mark("mic", start, start + 30 * SECOND, "crying")])
    relabelled(log, [(12, "speech"), (6, "music"), (18, "speech")])
    found = rows(write_catalog(fleet))
    name = log.relative_to(fleet).as_posix()
    relabel = found[name.replace(".mcap", ".relabel-better.1.mcap")]
    review = found[name.replace(".mcap", ".review.mcap")]
    assert (relabel.kind, relabel.log, relabel.home) == (RELABEL, name, "north/anna")
    assert (review.kind, review.log, review.microphones) == (REVIEW, name, ["mic"])
    assert (relabel.model, relabel.model_sha256) == ("better.1", "ab" * 32)
    assert (relabel.input_sha256, relabel.version, relabel.node) == ("cd" * 32, "7.8.9", "attic")
    assert relabel.frames == 0
    music, speech = relabel.labels
    second = music["first"] - 12 * SECOND
    expected = {"label": "music", "minutes": 0.1, "segments": 1, "events": 1}
    assert music == expected | {"first": second + 12 * SECOND, "last": second + 18 * SECOND}
    expected = {"label": "speech", "minutes": 0.5, "segments": 2, "events": 1}
    assert speech == expected | {"first": second, "last": second + 36 * SECOND}
    (crying,) = review.labels
    expected = {"label": "crying", "minutes": 0.5, "segments": 1, "events": 1}
    assert crying == expected | {"first": start, "last": start + 30 * SECOND}


def test_a_log_with_more_events_than_a_recorder_writes_is_an_error_of_its_own(fleet, monkeypatch):
    log = find_logs(fleet / "north")[0]
    relabelled(log, [(1, "speech"), (15, "music"), (1, "speech"), (15, "music"), (1, "speech")])
    monkeypatch.setattr("hearthlog.analyzer.logs.catalog_writer._MOST_EVENTS", 2)
    damaged = {row.path: row.error for row in write_catalog(fleet).of_state(DAMAGED)}
    name = log.relative_to(fleet).as_posix().replace(".mcap", ".relabel-better.1.mcap")
    line = "has more than 2 events of a label; no recorder writes so many"
    assert damaged[name] == line


def test_a_merged_log_says_what_its_logs_agree_on(fleet, model_file, day, tmp_path, capfd):
    log = find_logs(fleet / "north")[0]
    layer = relabelled(log, [(12, "speech"), (6, "music")])
    hall = Settings(output=tmp_path, model=model_file, microphone=[MicrophoneSettings(name="hall")])
    (other,) = record(hall, FileSource([day], START), Event()).logs
    merged = fleet / "merged.mcap"
    assert run(capfd, "merge", log, layer, other, "-o", merged).returncode == 0
    catalog = write_catalog(fleet)
    row, alone = catalog.current(merged), catalog.current(log)
    assert (row.version, row.model, row.node) == (None, None, None)
    assert row.feature_set == DEFAULT.name
    assert row.microphones == ["hall", "mic"]
    assert row.frames > alone.frames
    assert (row.first_frame, row.last_stamp) == (None, None)
    live = Counter(found.label for path in (log, other) for found in read(path, "segment"))
    assert {one["label"]: one["segments"] for one in row.labels} == live


def test_more_labels_than_a_classifier_has_are_an_error_in_a_row(tmp_path):
    log = tmp_path / "a.mcap"
    LogWriter(log, [], {}).finish()
    relabelled(log, [(1, f"label_{i}") for i in range(101)])
    assert {row.path: row.error for row in write_catalog(tmp_path).rows()} == {
        "a.mcap": None,
        "a.relabel-better.1.mcap": "has more than 100 different labels; no classifier has so many",
    }


@pytest.fixture
def file_by_file(monkeypatch):
    monkeypatch.setattr(hearthlog.analyzer.logs.catalog_writer, "_TASK", 1)


@pytest.mark.usefixtures("file_by_file")
def test_a_log_that_is_renamed_while_others_are_read_has_no_row(fleet):
    first, second, *others = find_logs(fleet)

    def rename(_):
        if second.exists():
            second.rename(second.with_name("elsewhere"))

    catalog = write_catalog(fleet, None, rename)
    names = [path.relative_to(fleet).as_posix() for path in (first, *others)]
    assert sorted(names) == [row.path for row in catalog.rows()]


def test_what_a_log_claims_of_its_frames_is_not_believed_beyond_its_size(recording, tmp_path):
    path = tmp_path / "a.mcap"
    data = find_logs(recording)[0].read_bytes()
    path.write_bytes(with_counts(data, (1 << 64) - 1))
    (row,) = write_catalog(tmp_path).rows()
    assert row.state == FINISHED
    assert row.frames == len(data)


def test_other_programs_read_the_same(fleet):
    """What a test in pandas, polars or DuckDB would find: plain columns of plain types."""
    catalog = write_catalog(fleet)
    export_parquet(catalog, fleet.parent / "files.parquet")
    table = pq.read_table(fleet.parent / "files.parquet")
    assert table["start"].type == pa.timestamp("ns", "UTC")
    times = ("mtime", "start", "end", "first_stamp", "last_stamp")
    for name in times:
        place = table.column_names.index(name)
        table = table.set_column(place, name, table[name].cast(pa.int64()))
    expected = [dict(vars(row)) for row in catalog.rows()]
    for row in expected:  # the ends of the events are for the totals of a home alone
        row["labels"] = [
            {name: value for name, value in one.items() if name not in {"first", "last"}}
            for one in row["labels"]
        ]
    assert table.to_pylist() == expected
    with closing(sqlite3.connect(fleet / CATALOG)) as database:
        found = database.execute("SELECT path, frames FROM catalog ORDER BY home, path").fetchall()
        assert found == [(row.path, row.frames) for row in catalog.rows()]
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_the_queries_in_the_documentation_give_what_they_say(fleet, monkeypatch, capsys):
    log = find_logs(fleet / "north")[0]
    relabelled(log, [(12, "speech")])
    text = (Path(__file__).parents[1] / "docs" / "catalog.md").read_text()
    (code,) = [part for part in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "pq" in part]
    fleet.rename(fleet.with_name("homes"))
    homes_folder = fleet.with_name("homes")
    export_parquet(write_catalog(homes_folder), fleet.parent / "files.parquet")
    monkeypatch.chdir(fleet.parent)
    exec(code.replace("general-1", "better.1"), {})
    printed = capsys.readouterr().out
    assert "gap_seconds_sum" in printed
    assert "minutes_sum" in printed
    left = [path.relative_to(homes_folder).as_posix() for path in find_logs(homes_folder)]
    left = [name for name in left if "relabel" not in name and Path(name).name != log.name]
    assert all(repr(name) in printed for name in left)


def test_what_did_not_change_is_not_read_again(fleet):
    first = write_catalog(fleet)
    for path in find_logs(fleet):
        garbage(path)
    again = write_catalog(fleet, read_catalog(fleet))
    assert rows(again) == rows(first)
    assert {row.state for row in write_catalog(fleet).rows()} == {DAMAGED}


def test_what_changed_came_or_went_is_read_as_if_there_was_no_catalogue(fleet):
    write_catalog(fleet)
    first, second, *_ = find_logs(fleet / "north")
    third = first.with_name("attic_20200101T000000Z.mcap")
    shutil.copy2(first, third)
    relabelled(third, [(12, "speech")])
    first.unlink()
    overwritten(second)
    catalog = write_catalog(fleet, read_catalog(fleet))
    assert rows(catalog) == rows(write_catalog(fleet))
    assert catalog.current(first) is None
    assert catalog.current(second).state == DAMAGED
    assert catalog.current(third).state == FINISHED


def test_nothing_is_said_of_a_file_that_changed_since(fleet):
    catalog = write_catalog(fleet)
    touched, grown, gone, *_ = find_logs(fleet)
    os.utime(touched, ns=(0, 1))
    about = grown.stat()
    with grown.open("ab") as stream:
        stream.write(b"more")
    os.utime(grown, ns=(about.st_atime_ns, about.st_mtime_ns))
    gone.unlink()
    assert [catalog.current(path) for path in (touched, grown, gone)] == [None] * 3
    assert catalog.current(fleet.parent / "elsewhere.mcap") is None


def test_a_damaged_log_is_a_row_with_its_error_and_is_looked_at_every_time(fleet):
    path = find_logs(fleet)[1]
    full, about = path.read_bytes(), path.stat()
    garbage(path)
    row = write_catalog(fleet).current(path)
    assert (row.state, row.span, row.frames) == (DAMAGED, None, 0)
    assert row.error == "is not an MCAP file"
    path.write_bytes(full)
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))
    assert write_catalog(fleet, read_catalog(fleet)).current(path).state == FINISHED


def test_damage_in_a_chunk_that_is_read_is_noticed(fleet):
    path = find_logs(fleet / "north")[0]
    overwritten(path)
    row = write_catalog(fleet).current(path)
    assert row.state == DAMAGED
    assert row.error.startswith("damaged at byte ")


@pytest.mark.usefixtures("file_by_file")
def test_an_interrupted_catalogue_keeps_what_was_read(fleet):
    paths = find_logs(fleet)

    def interrupt(share):
        if share >= len(paths) // 2 / len(paths):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_catalog(fleet, None, interrupt)
    known = read_catalog(fleet)
    assert len(known) == len(paths) // 2
    assert rows(write_catalog(fleet, known)) == rows(write_catalog(fleet))


@pytest.mark.parametrize("part", ["all", "first", "middle"])
def test_a_selection_is_the_same_with_a_catalogue(fleet, part):
    spans = list(map(time_span, find_logs(fleet / "north")))
    start, end = {
        "all": (None, None),
        "first": (None, spans[0][1]),
        "middle": (spans[1][0], spans[1][1] - SECOND),
    }[part]
    before = select([fleet], ["/*/segment"], start, end)
    write_catalog(fleet)
    assert select([fleet], ["/*/segment"], start, end) == before


def test_logs_outside_of_a_span_are_not_opened_where_a_catalogue_knows_theirs(fleet):
    first, *others = find_logs(fleet / "north")
    _, end = time_span(first)
    cut = find_logs(fleet / "bert")
    before = select([fleet], (), None, end - SECOND)
    write_catalog(fleet)
    for path in others:
        garbage(path)
    assert select([fleet], (), None, end - SECOND) == before
    assert set(before.logs) == {first, *cut}
    with pytest.warns(HearthlogWarning, match="is not an MCAP file"):
        select([fleet / "north"], (), None, end - SECOND)  # where there is no catalogue


def sealed(content: bytes) -> bytes:
    return content + hashlib.sha256(content).digest()


def altered(*statements: str) -> Callable[[bytes], bytes]:
    """Change a catalogue as a program would that checks nothing."""

    def change(data: bytes) -> bytes:
        with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
            database.deserialize(data[:-32])
            for pragma in ("ignore_check_constraints", "writable_schema"):
                database.execute(f"PRAGMA {pragma} = ON")
            for statement in statements:
                database.execute(statement)
            return sealed(database.serialize())

    return change


def with_bytes(place: int, value: bytes) -> Callable[[bytes], bytes]:
    return lambda data: sealed(data[:place] + value + data[place + len(value) : -32])


def without_strict(table: str, column: str, value: str) -> Callable[[bytes], bytes]:
    """Put a value of another type, or null, into a column."""
    sql = f"SELECT sql FROM sqlite_schema WHERE name = '{table}'"

    def change(data: bytes) -> bytes:
        with closing(sqlite3.connect(":memory:")) as database:
            database.deserialize(data[:-32])
            (definition,) = database.execute(sql).fetchone()
        lax = definition.replace("STRICT", "").replace("NOT NULL", "").replace("'", "''")
        define = "UPDATE sqlite_schema SET sql = '{}' WHERE name = '" + table + "'"
        loosened = altered(define.format(lax))(data)
        filled = altered(f"UPDATE {table} SET {column} = {value}")(loosened)
        return altered(define.format(definition.replace("'", "''")))(filled)

    return change


FOREIGN = {
    "empty": lambda _: b"",
    "cut": lambda data: data[: len(data) // 2],
    "another file": lambda _: b"path,home\n" * 1000,
    "a bit of a name": lambda data: data.replace(b"home_2026", b"home_2027", 1),
    "without a digest": lambda data: data[:-32],
    "only a digest": lambda _: sealed(b""),
    "no database": lambda _: sealed(b"path,home\n" * 1000),
    "in WAL mode": with_bytes(18, b"\2\2"),
    "fewer pages": lambda data: sealed(data[: len(data) // 2]),
    "a page twice": lambda data: sealed(data[:8192] + data[4096:8192] + data[12288:-32]),
    "a folder outside": altered("UPDATE folders SET path = '../' || path"),
    "an absolute folder": altered("UPDATE folders SET path = '/' || path"),
    "a log outside": altered("UPDATE files SET name = '../' || name"),
    "a name with a zero": altered("UPDATE files SET name = 'a' || char(0) || name"),
    "half a span": altered('UPDATE files SET "end" = NULL'),
    "a null": without_strict("files", "size", "NULL"),
    "another type": without_strict("files", "size", "'much'"),
    "another type of label": without_strict("labels", "minutes", "x'00'"),
}
OF_OTHERS = {
    "other tables": altered("DROP VIEW catalog", "DROP TABLE labels"),
    "another table": altered("CREATE TABLE other (path TEXT)"),
    "another column": altered("ALTER TABLE files ADD COLUMN other TEXT"),
    "a trigger": altered("CREATE TRIGGER t AFTER DELETE ON files BEGIN DELETE FROM labels; END"),
    "another view": altered("DROP VIEW catalog", "CREATE VIEW catalog AS SELECT * FROM files"),
}  # fmt: skip


@pytest.mark.parametrize("kind", [*FOREIGN, *OF_OTHERS])
def test_a_catalogue_that_cannot_be_used_is_not_used_and_made_anew(fleet, capfd, kind):
    before = select([fleet])
    full = rows(write_catalog(fleet))
    path = fleet / CATALOG
    path.write_bytes((FOREIGN | OF_OTHERS)[kind](path.read_bytes()))
    left = read_catalog(fleet)
    assert len(left) == 0
    (why,) = left.unusable
    assert why.startswith(f"{path}: cannot be used as a catalogue (")
    assert "another version" in why or kind not in OF_OTHERS
    assert select([fleet]) == before
    done = run(capfd, "catalog", fleet)
    assert done.stderr == f"hearthlog: {why}; it is rebuilt\n"
    assert rows(read_catalog(fleet)) == full


@pytest.mark.parametrize("seed", range(24))
def test_a_catalogue_with_any_bytes_is_made_anew_or_read(fleet, seed):
    write_catalog(fleet)
    random, path = np.random.default_rng(seed), fleet / CATALOG
    data = bytearray(path.read_bytes()[:-32])
    for place in random.integers(0, len(data), 1 + seed % 4):
        data[place] ^= 1 << int(random.integers(8))
    path.write_bytes(sealed(bytes(data)))
    catalog = read_catalog(fleet)
    if not catalog.unusable:
        list(catalog.rows())
    assert rows(write_catalog(fleet, catalog)).keys() == rows(write_catalog(fleet)).keys()


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_no_catalogue(fleet, make):
    before = select([fleet])
    make(fleet / CATALOG)
    assert select([fleet]) == before
    assert len(read_catalog(fleet).unusable) == 1


def test_a_catalogue_that_is_a_link_is_replaced_and_what_it_leads_to_stays(fleet):
    elsewhere = fleet.parent / "elsewhere"
    elsewhere.write_bytes(b"of root")
    (fleet / CATALOG).symlink_to(elsewhere)
    write_catalog(fleet)
    assert not (fleet / CATALOG).is_symlink()
    assert elsewhere.read_bytes() == b"of root"


def test_a_catalogue_of_an_earlier_version_is_reported_once_and_made_anew(fleet, capfd):
    older, index, kept = (
        fleet / name for name in ("catalog.parquet", "catalog.index", "mine.parquet")
    )
    older.mkdir()
    for path in (older / "home-bert.parquet", index, kept):
        path.write_bytes(b"PAR1")
    before = select([fleet])
    done = run(capfd, "catalog", fleet)
    assert done.stderr == (
        f"hearthlog: {older}: is of an earlier version of hearthlog; it is rebuilt\n"
    )
    assert (older.exists(), index.exists(), kept.exists()) == (False, False, True)
    assert run(capfd, "catalog", fleet).stderr == ""
    assert select([fleet]) == before


def test_what_others_put_beside_an_earlier_catalogue_stays(fleet):
    older, elsewhere = fleet / "catalog.parquet", fleet.parent / "elsewhere"
    for folder in (older, elsewhere):
        folder.mkdir()
        (folder / "home-a.parquet").touch()
        (folder / "ledger.parquet").touch()
    (fleet / "catalog.index").symlink_to(elsewhere)
    write_catalog(fleet)
    assert [path.name for path in older.iterdir()] == ["ledger.parquet"]
    assert len(list(elsewhere.iterdir())) == 2


def test_an_exported_table_stays_whatever_its_name_is(fleet, capfd):
    table = fleet / "catalog.parquet"
    assert run(capfd, "catalog", fleet, "--export", table).returncode == 3
    relabelled(find_logs(fleet / "north")[0], [(12, "speech")])
    assert run(capfd, "catalog", fleet).returncode == 3
    assert table.exists()


def test_a_catalogue_of_unchanged_files_is_not_written_again(fleet):
    write_catalog(fleet)
    before = (fleet / CATALOG).stat().st_ino
    write_catalog(fleet, read_catalog(fleet))
    assert (fleet / CATALOG).stat().st_ino == before
    relabelled(find_logs(fleet / "north")[0], [(12, "speech")])
    write_catalog(fleet, read_catalog(fleet))
    assert (fleet / CATALOG).stat().st_ino != before


def test_a_home_that_has_gone_has_no_rows(fleet):
    write_catalog(fleet)
    shutil.rmtree(fleet / "bert")
    catalog = write_catalog(fleet, read_catalog(fleet))
    assert {row.home for row in catalog.rows()} == {"north/anna"}
    assert rows(catalog) == rows(read_catalog(fleet))
    with closing(sqlite3.connect(fleet / CATALOG)) as database:
        folders = database.execute("SELECT path FROM folders WHERE path LIKE 'bert%'").fetchall()
        others = "SELECT file FROM labels WHERE file NOT IN (SELECT file FROM files)"
        assert (folders, database.execute(others).fetchall()) == ([], [])


def test_a_catalogue_that_is_not_written_to_its_end_leaves_the_one_before(fleet):
    write_catalog(fleet)
    before = (fleet / CATALOG).read_bytes()
    relabelled(find_logs(fleet / "north")[0], [(12, "speech")])
    code = (
        "import resource, sys; from pathlib import Path; "
        "from hearthlog.analyzer.logs.catalog_writer import write_catalog; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192)); "
        "write_catalog(Path(sys.argv[1]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, fleet], capture_output=True, text=True, check=False
    )
    assert "catalog.sqlite: cannot be written (File too large)" in done.stderr
    assert (fleet / CATALOG).read_bytes() == before
    assert [path.name for path in fleet.iterdir() if path.is_file()] == [CATALOG]


def test_processes_make_the_same_catalogue(fleet):
    alone = rows(write_catalog(fleet))
    with open_workers(2) as workers:
        assert rows(write_catalog(fleet, None, ignore_progress, workers)) == alone


@pytest.mark.usefixtures("file_by_file")
def test_a_catalogue_whose_workers_are_lost_keeps_what_was_read(fleet):
    class Lost(InlineWorkers):
        def submit(self, function, *arguments):
            if len(calls) == 2:
                raise LostClusterError("gone")
            calls.append(arguments)
            return super().submit(function, *arguments)

    calls = []
    with pytest.raises(LostClusterError):
        write_catalog(fleet, None, ignore_progress, Lost())
    assert len(read_catalog(fleet)) == 2


def test_a_log_under_two_names_is_one_with_a_catalogue_too(fleet):
    first, *_ = find_logs(fleet / "north")
    first.with_name("zz.mcap").symlink_to(first)
    before = select([fleet]), select([fleet, fleet / "north"])
    write_catalog(fleet)
    assert (select([fleet]), select([fleet, fleet / "north"])) == before


def test_what_was_before_a_span_is_the_same_with_a_catalogue(fleet):
    spans = list(map(time_span, find_logs(fleet / "north")))
    before = list(select([fleet], (), spans[2][0]).earlier)
    assert len(before) > 1
    write_catalog(fleet)
    assert list(select([fleet], (), spans[2][0]).earlier) == before


def test_a_catalogue_in_a_store_is_like_one_of_this_machine(fleet, in_memory):
    here = without_times(write_catalog(fleet))
    store = put(fleet, in_memory)
    there = write_catalog(store)
    assert without_times(there) == here
    again = read_catalog(store)
    assert rows(again) == rows(there)
    assert all(again.current(path) for path in find_logs(store))
    first = next(again.rows()).path
    (store / first).write_bytes(b"nonsense")
    assert rows(write_catalog(store, again))[first].state == DAMAGED


def test_the_command_makes_the_catalogue_of_a_bucket(fleet, bucket, capfd):
    store = put(fleet, bucket)
    assert run(capfd, "catalog", store).returncode == 3
    assert rows(read_catalog(store)).keys() == rows(write_catalog(fleet)).keys()


def test_a_selection_in_a_bucket_is_the_same_with_a_catalogue(fleet, bucket):
    first, *_ = find_logs(fleet / "north")
    store = put(fleet, bucket)
    _, end = time_span(first)
    before = select([store], (), None, end - SECOND)
    catalog = write_catalog(store)
    assert rows(write_catalog(store, read_catalog(store))) == rows(catalog)
    assert select([store], (), None, end - SECOND) == before


def test_the_homes_of_a_folder_are_summed_up(fleet):
    log = find_logs(fleet / "north")[0]
    relabelled(log, [(12, "speech"), (6, "music"), (18, "speech")])
    overwritten(find_logs(fleet / "north")[-1])
    catalog = write_catalog(fleet)
    found = [row for row in catalog.rows() if row.home == "north/anna"]
    logs = [row for row in found if row.kind == LOG]
    bert, anna = homes(catalog)
    assert (bert.home, bert.logs, bert.layers, bert.unfinished, bert.damaged) == (
        "bert",
        1,
        0,
        1,
        0,
    )
    assert (anna.home, anna.logs, anna.layers) == ("north/anna", len(logs), 1)
    assert (anna.unfinished, anna.damaged) == (0, 1)
    assert anna.size == sum(row.size for row in found)
    assert anna.hours == pytest.approx(sum(row.frames for row in logs) / 72_000)
    assert (anna.gaps, anna.gap_seconds) == (
        sum(row.gaps for row in logs),
        pytest.approx(sum(row.gap_seconds for row in logs)),
    )
    assert anna.start == min(row.start for row in logs if row.start is not None)
    assert anna.end == max(row.end for row in logs if row.end is not None)
    relabel = [one for one in label_amounts(catalog) if one.kind == RELABEL]
    assert [(one.home, one.model, one.label, one.minutes, one.segments) for one in relabel] == [
        ("north/anna", "better.1", "speech", 0.5, 2),
        ("north/anna", "better.1", "music", 0.1, 1),
    ]


def test_the_command_writes_the_catalogue_and_shows_the_homes(fleet, capfd):
    done = run(capfd, "catalog", fleet)
    assert done.returncode == 3  # a log is cut off
    assert done.stderr == ""
    assert "north/anna" in done.stdout
    assert "2 homes" in done.stdout
    head = done.stdout.splitlines()[0].split()
    assert head[:3] == ["home", "logs", "unfinished"]
    assert "damaged" not in head, "no file is"
    (cut,) = find_logs(fleet / "bert")
    assert f"unfinished: {cut.relative_to(fleet).as_posix()}" in done.stdout
    cut.unlink()
    done = run(capfd, "catalog", fleet)
    assert done.returncode == 0
    assert "unfinished" not in done.stdout.splitlines()[0]
    gaps = sum(home.gaps for home in homes(read_catalog(fleet)))
    assert ("no log has a gap" in done.stdout) == (not gaps)
    assert {row.home for row in read_catalog(fleet).rows()} == {"north/anna"}


def test_the_table_has_the_times_of_each_home_in_its_zone(tmp_path, capfd):
    day = date(2026, 3, 1)
    write_day(tmp_path / "anna", day, hours=[20], timezone="Asia/Kolkata")
    shown = run(capfd, "catalog", tmp_path).stdout.splitlines()
    assert "from (Asia/Kolkata)" in shown[0]
    assert re.search("2026-03-02 02:30 +2026-03-02 02:30$", shown[1])
    write_day(tmp_path / "bert", day, hours=[20])
    shown = run(capfd, "catalog", tmp_path).stdout.splitlines()
    assert "from (Asia/Kolkata, UTC)" in shown[0]
    assert [re.search(r"\d\d:\d\d\+\d{4}$", line)[0] for line in shown[1:4]] == [
        "02:30+0530",
        "21:00+0000",
        "21:00+0000",
    ]


def test_the_command_says_in_json_what_the_table_says(fleet, capfd):
    path = find_logs(fleet / "north")[0]
    garbage(path)
    done = run(capfd, "catalog", fleet, "--json")
    assert done.returncode == 3
    assert done.stderr == f"hearthlog: {path}: is not an MCAP file\n"
    result_text = json.loads(done.stdout)
    catalog = read_catalog(fleet)
    assert result_text["files"] == len(catalog)
    assert result_text["damaged"] == {path.relative_to(fleet).as_posix(): "is not an MCAP file"}
    assert [home["home"] for home in result_text["homes"]] == ["bert", "north/anna"]
    assert [home["hours"] for home in result_text["homes"]] == [
        home.hours for home in homes(catalog)
    ]
    minutes = sum(one["minutes"] for row in catalog.rows() for one in row.labels)
    assert sum(one["minutes"] for one in result_text["labels"]) == pytest.approx(minutes)


def test_the_command_exports_the_rows_to_a_new_parquet_file(fleet, tmp_path, capfd):
    output = tmp_path / "files.parquet"
    assert run(capfd, "catalog", fleet, "--export", output).returncode == 3
    assert pq.read_table(output).num_rows == len(read_catalog(fleet))
    done = run(capfd, "catalog", fleet, "--export", output)
    assert (done.returncode, done.stdout) == (1, "")
    assert "exists already" in done.stderr


def test_a_catalogue_is_of_a_folder_with_logs(recording, tmp_path, capfd):
    path = find_logs(recording)[0]
    done = run(capfd, "catalog", path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "give the folder" in done.stderr
    done = run(capfd, "catalog", tmp_path)
    assert (done.returncode, list(tmp_path.iterdir())) == (1, [])
    assert "no log" in done.stderr
