"""Messages only grow: what is appended hides nothing, and what is changed otherwise is named."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from grown_schema import GROWN, NEXT, grown_definitions
from hypothesis import given, settings
from hypothesis import strategies as st
from log_fixtures import run
from logreader import LogMessage, LogReader
from mcap.records import Channel
from rewriting import Log
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hearthlog import __version__
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import iterate_columns, join, read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.logs.metadata import provenance, read_provenance
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import decode_rows, encode_rows
from hearthlog.schemas.messages.fields import difference, fields_of, type_hash_of
from hearthlog.schemas.messages.message_types import (
    APPENDED,
    SCHEMA_VERSION,
    definition,
    encode,
    header,
    message,
)
from hearthlog.schemas.messages.type_definitions import message_type

GOLDEN = Path(__file__).parent / "golden"
MESSAGES = Path(message_types.__file__).parent / "msg"
OURS = [f"{message_types.PACKAGE}/msg/{path.stem}" for path in sorted(MESSAGES.glob("Audio*.msg"))]
SEGMENTS = "/hall/segment"
START = 1_772_348_370_123_456_789


@pytest.fixture
def golden(tmp_path, monkeypatch) -> Path:
    """The log of the first version with most in it, beside its layers."""
    shutil.copytree(GOLDEN / "0.1.0", tmp_path / "golden")
    monkeypatch.chdir(tmp_path / "golden")
    return next(path for path in find_logs(Path("logs")) if not is_layer(path))


def segment(**more):
    return message(
        message_types.SEGMENT,
        header=header(START, "hall"),
        duration=message_types.duration_message(1_500_000_000),
        label="coughing",
        confidence=0.5,
        **more,
    )


def decoded(kind, *payloads, fields=None):
    sizes = np.array([len(payload) for payload in payloads])
    buffer = np.frombuffer(b"".join(payloads), np.uint8)
    return decode_rows(kind, buffer, np.cumsum(sizes) - sizes, sizes, fields)


def test_a_released_field_is_where_it_was():
    for log in GOLDEN.rglob("*.mcap"):
        with LogFile(log) as file:
            version = {int(r.get("schema_version", "1")) for r in read_provenance(file)}
            for schema in file.schemas.values():
                kind = message_type(schema.name, schema.encoding, schema.data)
                assert difference(kind, max(version)) == ""


def test_what_was_appended_since_the_first_release_has_a_default_and_raised_the_version():
    first: dict[str, set[str]] = {}
    for log in (GOLDEN / "0.1.0").rglob("*.mcap"):
        with LogFile(log) as file:
            for schema in file.schemas.values():
                kind = message_type(schema.name, schema.encoding, schema.data)
                first[schema.name] = {name for name, _ in kind.types[schema.name]}
    # Which that release did not have.
    later = {message_types.REVIEWED, message_types.DIRECTION, message_types.EMBEDDING}
    for name in set(OURS) - later:
        today = [field for field, _ in message_type(name).types[name]]
        appended = APPENDED.get(name, {})
        assert first[name] | appended.keys() == set(today)
        assert [field for field in today if field in appended] == today[len(first[name]) :]
        assert all(1 < each.since <= SCHEMA_VERSION for each in appended.values())


def test_the_documentation_has_every_version_and_every_default():
    text = (Path(__file__).parents[1] / "docs" / "log.md").read_text()
    assert re.search(rf"^\| {SCHEMA_VERSION} \|", text, re.MULTILINE)
    for name, appended in APPENDED.items():
        for field in appended:
            assert f"`{name.rpartition('/')[2]}.{field}`" in text


KINDS = {
    "uint8": (st.integers(0, 255), int),
    "int64": (st.integers(-(1 << 63), (1 << 63) - 1), int),
    "float32": (st.floats(width=32, allow_nan=False), float),
    "float64": (st.floats(allow_nan=False), float),
    "bool": (st.booleans(), bool),
    "string": (st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9), str),
    "uint16[]": (st.lists(st.integers(0, 65535), max_size=5), lambda v: np.array(v, np.uint16)),
    "float64[3]": (st.lists(st.floats(width=64), min_size=3, max_size=3), np.array),
    "string[]": (st.lists(st.text("abc", max_size=3), max_size=3), list),
    "builtin_interfaces/Time": (st.integers(0, 1 << 60), message_types.time_message),
    "hearthlog_msgs/AudioSegment": (st.just(0), lambda _: segment()),
    "hearthlog_msgs/AudioSegment[]": (st.integers(0, 2), lambda n: [segment()] * n),
}


@settings(deadline=None, max_examples=60)
@given(st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=5), st.data())
def test_whatever_is_appended_what_was_there_reads_the_same(kinds, data):
    values = {f"new{i}": KINDS[k][1](data.draw(KINDS[k][0])) for i, k in enumerate(kinds)}
    own, *nested = definition(message_types.GAP).split("=" * 80 + "\n")
    lines = "".join(f"{kind} new{i}\n" for i, kind in enumerate(kinds))
    nested += definition(message_types.SEGMENT).split("=" * 80 + "\n")[1:]
    nested.append(
        "MSG: hearthlog_msgs/AudioSegment\n" + definition(message_types.SEGMENT).split("=")[0]
    )
    text = ("=" * 80 + "\n").join([own + lines, *dict.fromkeys(nested)])
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, message_types.GAP))
    gap = {
        "header": header(START, "hall"),
        "duration": message_types.duration_message(2_000_000_000),
        "reason": "overrun",
        "frames_lost": 40,
    }
    newer = store.serialize_cdr(
        store.types[message_types.GAP](**gap, **values), message_types.GAP, little_endian=True
    )
    kind = message_type(message_types.GAP, "ros2msg", text.encode())
    expected = decoded(message_type(message_types.GAP), encode(message(message_types.GAP, **gap)))
    read = decoded(kind, bytes(newer))
    assert read.keys() == expected.keys() == fields_of(kind).keys()
    assert all(np.array_equal(read[path], expected[path]) for path in expected)
    assert difference(kind, SCHEMA_VERSION) == ""
    assert type_hash_of(kind) == store.hash_rihs01(message_types.GAP)


def test_what_older_messages_lack_is_a_full_column_of_the_type_it_has(tmp_path):
    older = {name: definition(name).encode() for name in OURS}
    payload = encode(segment())
    with grown_definitions(tmp_path):
        kind = message_type(message_types.SEGMENT, "ros2msg", older[message_types.SEGMENT])
        own = decoded(message_type(message_types.SEGMENT), encode(segment()), encode(segment()))
        read = decoded(kind, payload, payload)
        assert list(read) == list(own) == list(fields_of(kind))
        assert {p: v.dtype for p, v in read.items()} == {p: v.dtype for p, v in own.items()}
        assert read["loudness"].dtype == np.float32
        assert np.isnan(read["loudness"]).all()
        assert list(decoded(kind, payload, fields=["loudness"])) == ["loudness"]
        for name in OURS:
            of_old = message_type(name, "ros2msg", older[name])
            assert fields_of(of_old) == fields_of(message_type(name))


def test_a_message_of_ours_within_another_grows_with_it(tmp_path):
    """As a type would that has segments, some day."""
    lines = "std_msgs/Header header\nhearthlog_msgs/AudioSegment best\n"
    name, lines = message_types.GAP, lines + "hearthlog_msgs/AudioSegment[] others\n"
    nested = definition(message_types.SEGMENT).partition("=" * 80 + "\n")
    text = lines + nested[1] + "MSG: hearthlog_msgs/AudioSegment\n" + "".join(nested)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    scene = store.types[name](header(START, "hall"), segment(), [segment(), segment()])
    payload = bytes(store.serialize_cdr(scene, name, little_endian=True))
    with grown_definitions(tmp_path):
        kind = message_type(name, "ros2msg", text.encode())
        read = decoded(kind, payload)
        assert read["best.confidence"].tolist() == [0.5]
        assert np.isnan(read["best.loudness"]).all()
        assert [each["label"] for each in read["others"][0]] == ["coughing", "coughing"]
        assert all(np.isnan(each["loudness"]) for each in read["others"][0])
        assert "best.loudness" in fields_of(kind)
        assert "loudness" in fields_of(kind)["others"].elements


def test_what_writes_need_not_know_what_was_appended(tmp_path):
    with grown_definitions(tmp_path):
        for name in (message_types.SEGMENT, message_types.MARK):
            columns = {
                "header.stamp": np.array([START, START + 5]),
                "header.frame_id": "hall",
                "duration": np.array([7, 8]),
                "label": ["coughing", "speech"],
            }
            if name == message_types.SEGMENT:
                columns["confidence"] = np.array([0.5, 1.0], np.float32)
            else:
                columns |= {"reviewer": "", "made": np.array([0, 0]), "corrects": ""}
            read = decoded(message_type(name), *encode_rows(name, columns, 2))
            assert read["label"].tolist() == ["coughing", "speech"]
            default = read[GROWN[name].name]
            assert len(default) == 2
            assert default.shape[1:] == ((0,) if name == message_types.MARK else ())
        one = encode(segment())
        other = encode(segment(loudness=float("nan")))
        assert one == other != encode(segment(loudness=1.0))


def test_one_message_of_another_version_is_decoded_as_ours(tmp_path, golden):
    plain = list(LogReader(golden).messages([SEGMENTS]))
    with grown_definitions(tmp_path):
        first = plain[0].decode()
        assert np.isnan(first.loudness)
        newer, text = encode(segment(loudness=-3.0)), definition(message_types.SEGMENT).encode()
    schema = type(plain[0].schema)(1, text, "ros2msg", message_types.SEGMENT)
    schema.name, schema.encoding, schema.data = message_types.SEGMENT, "ros2msg", text
    message = LogMessage(SEGMENTS, message_types.SEGMENT, START, newer, schema).decode()
    assert message == segment()
    assert plain[0].decode().label == first.label


def test_a_field_that_is_not_there_is_named(golden):
    segments = read_columns([golden], [SEGMENTS])[SEGMENTS]
    with pytest.raises(
        LogError, match=f"{SEGMENTS}: {message_types.SEGMENT} has no field 'loudness'"
    ):
        segments["loudness"]


def test_of_a_type_of_others_only_what_all_files_have_is_one_series(golden, tmp_path):
    log = Log(golden)
    schema = log.schema("/rosout")
    schema.data = schema.data.replace(b"uint32 line\n", b"uint32 line\nuint8 more\n")
    for record in log.messages("/rosout"):
        record.data += b"\x07"
    other = log.write(tmp_path / "other.mcap")
    assert read_columns([other])["/rosout"]["more"].tolist() == [7] * 11
    lines = read_columns([golden, other])["/rosout"]
    assert "more" not in lines.fields
    assert len(lines) == 22
    assert all(len(values) == 22 for values in lines.fields.values())
    batches = list(iterate_columns([golden, other], ["/rosout"]))
    assert {"more" in columns.fields for batch in batches for columns in batch} == {True, False}
    assert len(join([columns for batch in batches for columns in batch])) == 22


CONFIDENCE = b"float32 confidence"
CHANGED = {
    "renamed": (
        CONFIDENCE,
        b"float32 certainty",
        "field 4 of hearthlog_msgs/msg/AudioSegment is float32 certainty, not float32 confidence",
    ),
    "removed": (CONFIDENCE + b"\n", b"", "AudioSegment has no field float32 confidence"),
    "moved": (
        b"string label\n" + CONFIDENCE,
        CONFIDENCE + b"\nstring label",
        "is float32 confidence, not string label",
    ),
    "of another type": (CONFIDENCE, b"float64 confidence", "is float64 confidence, not float32"),
    "behind a new one": (b"std_msgs/Header", b"uint8 more\nstd_msgs/Header", "is uint8 more, not"),
    "of another type within": (b"string frame_id", b"uint32 frame_id", "2 of std_msgs/msg/Header"),
    "in a header that grew": (
        b"string frame_id",
        b"string frame_id\nuint8 more",
        "3 fields, not 2",
    ),
}


@pytest.mark.parametrize("case", CHANGED)
def test_the_doctor_names_what_no_version_has_changed(golden, capfd, case):
    before, after, what = CHANGED[case]
    log = Log(golden)
    schema = log.schema(SEGMENTS)
    assert before in schema.data
    schema.data = schema.data.replace(before, after, 1)
    log.write(golden)
    found = json.loads(run(capfd, "doctor", golden, "--json").stdout)["findings"]
    (only,) = [each["what"] for each in found if each["rule"] == "type"]
    assert only.startswith(
        f"{SEGMENTS}: {message_types.SEGMENT} is defined otherwise than by hearthlog: "
    )
    assert what in only


def grow(log, topic, line, payload=b"\0\0\0\0"):
    """Append a field to the definition of a topic, and to its messages."""
    schema = log.schema(topic)
    own, mark, nested = schema.data.partition(b"=" * 80)
    schema.data = own + line + b"\n" + mark + nested
    for each in log.messages(topic):
        each.data += bytes(-len(each.data) % 4) + payload
    return message_type(schema.name, schema.encoding, schema.data)


def test_the_doctor_accepts_a_definition_that_grew_and_its_own_type_hash_only(golden, capfd):
    log = Log(golden)
    kind = grow(log, SEGMENTS, b"float32 loudness")
    log.write(golden)
    found = json.loads(run(capfd, "doctor", golden, "--json").stdout)["findings"]
    (only,) = [each["what"] for each in found if each["rule"] == "type"]
    assert only == f"{SEGMENTS}: topic_type_hash is not that of {message_types.SEGMENT}"
    for record in log.records():
        if isinstance(record, Channel) and record.topic == SEGMENTS:
            record.metadata["topic_type_hash"] = type_hash_of(kind)
    log.write(golden)
    found = json.loads(run(capfd, "doctor", golden, "--json").stdout)["findings"]
    assert {each["rule"] for each in found} == {"gap"}


DOUBLING = b"\n".join(  # 2 to the power of 30 fields
    [
        b"own/T0[] one",
        *(
            b"=" * 80 + b"\nMSG: own/T%d\nown/T%d[] one\nown/T%d[] other" % (i, i + 1, i + 1)
            for i in range(30)
        ),
        b"=" * 80 + b"\nMSG: own/T30\nuint8 last",
    ]
)


@pytest.mark.parametrize(
    "line",
    [b"hearthlog_msgs/AudioSegment inner", b"other/Unknown thing", b"wstring w", DOUBLING],
    ids=["contains itself", "is not defined", "is wide", "doubles"],
)
@pytest.mark.parametrize("place", ["appended", "at the beginning"])
def test_a_definition_may_be_hostile(golden, capfd, line, place):
    log = Log(golden)
    if place == "appended":
        grow(log, SEGMENTS, line)
    else:
        schema = log.schema(SEGMENTS)
        schema.data = line + b"\n" + schema.data if b"=" not in line else line
    log.write(golden)
    for verb in ("doctor", "info", "cat"):
        done = run(capfd, verb, golden)  # an error that is not one line would be raised here
        assert len([line for line in done.stderr.splitlines() if line.startswith("hearthlog")]) < 2
        assert done.returncode in {0, 1, 3}


def test_the_doctor_misses_what_the_version_of_a_log_had(golden, capfd, tmp_path):
    log = Log(golden)
    log.metadata("hearthlog").metadata["schema_version"] = str(NEXT)
    log.write(golden)
    with grown_definitions(tmp_path), pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "hearthlog.schemas.logs.metadata._SCHEMA_VERSIONS", {"1": 1, "2": 2, str(NEXT): NEXT}
        )
        output = json.loads(run(capfd, "doctor", golden, "--json").stdout)
    wrong = [each["what"] for each in output["findings"] if each["level"] == "error"]
    absent = {  # in this log
        message_types.MARK,
        message_types.REVIEWED,
        message_types.DIRECTION,
        message_types.EMBEDDING,
    }
    assert output["errors"] == len({*OURS} - absent) + 1
    assert any("model.json" in what for what in wrong)  # which the first version had not
    assert any(
        what.endswith(f"{message_types.STATISTICS} has no field string formula") for what in wrong
    )


@pytest.mark.usefixtures("golden")
@pytest.mark.parametrize(
    ("arguments", "rest"),
    [
        (["info", "logs"], "1 gap"),
        (["diff", "logs", "live", "merged"], "no labelling 'live'"),
        (["evaluate", "log", "logs", "--reference", "review"], "choose one with --topic"),
        (["report", "logs", "--day", "2026-03-01", "-o", "day.html"], ""),
        (["review", "logs", "--save", "day.rrd"], "day.rrd"),
    ],
    ids=["info", "diff", "evaluate", "report", "review"],
)
def test_segments_that_cannot_be_read_are_named(capfd, arguments, rest):
    for path in find_logs(Path("logs")):
        if not is_layer(path):
            log = Log(path)
            schema = log.schema(SEGMENTS)
            schema.data = schema.data.replace(b"string label", b"string word")
            log.write(path)
    done = run(capfd, *arguments)
    line = f"hearthlog: {SEGMENTS}: {message_types.SEGMENT} is defined without label"
    assert done.stderr.count(line) == 1
    assert rest in done.stdout + done.stderr
    assert done.returncode in {1, 3}
    assert "recorded without a model" not in done.stderr


@pytest.mark.parametrize("text", [str(NEXT), "0", "-1", "1.5", "banana \x1b[31m", "9" * 5000, ""])
def test_a_version_that_is_not_known_is_said_in_one_line(golden, capfd, text):
    log = Log(golden)
    log.metadata("hearthlog").metadata["schema_version"] = text
    log.write(golden)
    done = run(capfd, "cat", golden, "--topics", SEGMENTS)
    assert (len(done.stdout.splitlines()), done.returncode) == (9, 3)
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"hearthlog: {golden}: is of schema version '{text[:1]}".rstrip("\x1b"))
    assert len(line) < 300
    assert line.isprintable()


def records(path):
    with LogFile(path) as file:
        return read_provenance(file)


def test_all_that_this_version_writes_says_its_schema_version(golden, capfd):
    write_marks(golden, [Mark("hall", START, START + 1_000_000_000, "music")])
    model = ["--model", "models/smoothed.safetensors"]
    run(capfd, "relabel", "logs", *model, "--workers", "1")
    run(capfd, "replay", "logs", *model, "-o", "again")
    new = [
        golden.with_name(f"{golden.stem}.review.mcap"),
        *Path("logs").rglob("*.relabel-smoothed.mcap"),
        *find_logs(Path("again")),
    ]
    assert len(new) == 5
    common = {"version": __version__, "schema_version": str(SCHEMA_VERSION), "node": "home"}
    assert provenance("home") == common
    for path in new:
        (record,) = records(path)
        assert common.items() <= record.items()


def test_what_copies_messages_keeps_what_is_said_of_them(golden, capfd):
    logs = [path for path in find_logs(Path("logs")) if not is_layer(path)]
    before = [record for log in logs[:1] for record in records(log)]
    run(capfd, "cut", golden, "-o", "cut.mcap", "--start", "2026-03-01T06:59:40")
    run(capfd, "recover", golden, "-o", "whole.mcap")
    run(capfd, "merge", golden, "cut.mcap", "-o", "merged.mcap")
    for path in ("cut.mcap", "whole.mcap", "merged.mcap"):
        assert records(Path(path)) == before
        assert "schema_version" not in before[0]
    run(capfd, "replay", golden, "--model", "models/smoothed.safetensors", "-o", "again")
    run(capfd, "merge", golden, *find_logs(Path("again")), "-o", "both.mcap")
    versions = [record.get("schema_version") for record in records(Path("both.mcap"))]
    assert versions == [None, str(SCHEMA_VERSION)]
    assert [r.get("schema_version") for r in select([Path("both.mcap")]).metadata] == versions
