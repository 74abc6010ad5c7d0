"""Marks go to the files of others and come back, and others read what was written."""

import csv
import json
import shutil
from functools import partial
from itertools import pairwise

import pympi
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from log_fixtures import run
from pyannote.core import Annotation, Segment
from pyannote.database.util import load_rttm

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import ROUNDING, Coverage, find_coverage
from hearthlog.analyzer.marks.formats import FORMATS
from hearthlog.analyzer.marks.formats.labels import Choice
from hearthlog.analyzer.marks.label_files import ImportOptions, import_labels, write_labels
from hearthlog.analyzer.marks.marks import LATEST, Mark, new_marks, read_marks
from hearthlog.schemas.frames import NANOSECONDS, seconds_text
from hearthlog.schemas.logs.files import find_logs

SECOND = NANOSECONDS
MILLISECOND = SECOND // 1000
HOUR = 3600 * SECOND
START = 1_772_348_370_123_456_789
MICROPHONES = ("hall", "kitchen")
SAYING = (".selections.txt", ".csv", ".eaf", ".json")  # who made a mark, when, and of what
EXACT = (".txt", ".selections.txt", ".csv", ".json", ".rttm")
SOME = [
    Mark("hall", START + SECOND, START + 2 * SECOND, "speech", "Ann", START, "live"),
    Mark("hall", START + 2 * SECOND, START + 3 * SECOND, "coughing", "Bob"),
    Mark("kitchen", START + 2 * SECOND, START + 4 * SECOND, "tap_water", "Ann", 0, "paper-1"),
]
TEXT = st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff")
NAMES = st.text(TEXT, max_size=20).map(str.strip)


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def logs(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "logs")


def recorded_in(log, microphones=MICROPHONES):
    """Microphones of which the second began to listen a little later."""
    starts = [START + i * 1_234_567 for i in range(len(microphones))]
    return {
        name: Coverage([log], [first], [START + HOUR])
        for name, first in zip(microphones, starts, strict=True)
    }


def read_labels(path, labelled, microphone=None):
    """Marks of a file of which nothing may be left out, and whose labels are names of classes."""
    return import_labels(path, labelled, ImportOptions(microphone, strict=True), refuse).by_log


def refuse(folded):
    raise DataError(f"not names of classes: {folded}")


def there_and_back(path, marks, labelled):
    write_labels(path, marks, labelled)
    ((_, found),) = read_labels(path, labelled).items()
    return sorted(found)


@st.composite
def marks_of(draw, unit=1, end=HOUR):
    """Marks of microphones, in units of nanoseconds, that do not overlap, and say all they can."""
    found = []
    labels = st.from_regex(r"[a-z][a-z0-9_]{0,63}", fullmatch=True)
    for name in MICROPHONES:
        times = st.integers(2_000_000 // unit, (end - 1) // unit)
        borders = sorted(draw(st.sets(times, min_size=2, max_size=12)))
        for first, last in pairwise(borders):
            if draw(st.booleans()):
                states = draw(NAMES), draw(st.integers(0, LATEST)), draw(NAMES)
                span = START + first * unit, START + last * unit
                found.append(Mark(name, *span, draw(labels), *states))
    assume(found)
    return sorted(found)


@given(marks=marks_of(), suffix=st.sampled_from(EXACT))
@settings(deadline=None, max_examples=150)
def test_marks_go_through_a_file_and_lose_only_what_it_has_no_place_for(
    tmp_path_factory, marks, suffix
):
    path = tmp_path_factory.mktemp("labels") / f"labels{suffix}"
    labelled = recorded_in(path)
    if suffix == ".txt":
        marks = [mark for mark in marks if mark.microphone == marks[0].microphone]
        labelled = {marks[0].microphone: labelled[marks[0].microphone]}
    kept = len(Mark._fields) if suffix in SAYING else 4
    assert there_and_back(path, marks, labelled) == [Mark(*mark[:kept]) for mark in marks]


@given(marks=marks_of(unit=MILLISECOND))
@settings(deadline=None)
def test_marks_of_whole_milliseconds_go_through_elan_as_they_are(tmp_path_factory, marks):
    path = tmp_path_factory.mktemp("labels") / "labels.eaf"
    labelled = recorded_in(path)
    marks = [*marks, Mark("hall", START, START + MILLISECOND, "first")]  # when ELAN's time begins
    assert there_and_back(path, marks, labelled) == sorted(marks)


@given(marks=marks_of(end=HOUR - 100 * MILLISECOND))  # what is beyond all that was heard is refused
@settings(deadline=None)
def test_elan_rounds_marks_and_none_vanishes_overlaps_or_moves_an_older_one(
    tmp_path_factory, marks
):
    path = tmp_path_factory.mktemp("labels") / "labels.eaf"
    found = there_and_back(path, marks, recorded_in(path))
    assert [mark[3:] + mark[:1] for mark in found] == [mark[3:] + mark[:1] for mark in marks]
    if all(mark.end - mark.start > MILLISECOND for mark in marks):
        for mark, rounded in zip(marks, found, strict=True):
            assert abs(mark.start - rounded.start) <= MILLISECOND // 2
            assert abs(mark.end - rounded.end) <= MILLISECOND // 2
        assert new_marks(found, marks) == []


@pytest.mark.parametrize("suffix", EXACT)
def test_after_most_of_a_year_no_nanosecond_is_lost(tmp_path, suffix):
    labelled = {"hall": Coverage([tmp_path], [START], [START + 24 * 365 * HOUR])}
    begin = START + 24 * 300 * HOUR + 123_456_789
    mark = Mark("hall", begin, begin + 987_654_321, "cry")
    assert there_and_back(tmp_path / f"labels{suffix}", [mark], labelled) == [mark]


def test_many_marks_within_a_millisecond_stay_apart_in_elan(tmp_path):
    labelled = recorded_in(tmp_path)
    marks = [Mark("hall", START + i * 1000, START + i * 1000 + 900, "cry") for i in range(40)]
    found = there_and_back(tmp_path / "labels.eaf", marks, labelled)
    assert [(m.start - START) // MILLISECOND for m in found] == list(range(40))


@pytest.mark.parametrize("suffix", [".csv", ".eaf", ".json"])
def test_a_file_that_says_when_it_begins_fits_when_older_logs_are_gone(tmp_path, suffix):
    path = tmp_path / f"labels{suffix}"
    earlier = {
        name: Coverage([tmp_path, tmp_path], [START - HOUR, one.starts[0]], [START, one.ends[0]])
        for name, one in recorded_in(tmp_path).items()
    }
    write_labels(path, SOME, earlier)
    (found,) = read_labels(path, recorded_in(tmp_path)).values()
    if suffix != ".eaf":
        assert sorted(found) == SOME
    assert new_marks(found, SOME) == []


@pytest.mark.parametrize(
    "declared",
    ["UTF-8", "UTV-8", "ISO-8859-1", "utf-7", "shift_jis", "idna", "hex", "rot13", "UTF-16"],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_what_an_elan_file_says_of_its_encoding_changes_no_name(tmp_path, declared, encoding):
    labelled = recorded_in(tmp_path)
    mark = SOME[0]._replace(reviewer="Jörg 日本")
    write_labels(tmp_path / "written.eaf", [mark], labelled)
    text = (tmp_path / "written.eaf").read_text("utf-8")
    assert 'encoding="UTF-8"' in text
    path = tmp_path / "labels.eaf"
    path.write_bytes(text.replace("UTF-8", declared).encode(encoding))
    ((_, (found,)),) = read_labels(path, labelled).items()
    assert (found.reviewer, found.label) == ("Jörg 日本", mark.label)


@pytest.mark.parametrize(
    "name", ["=1+1", "@SUM(A1)", "+x", "-x", "'=x", "''@", "'x", "-5", "\uff1dx"]
)
def test_a_name_that_a_spreadsheet_would_run_is_disarmed_in_csv_and_read_as_it_was(tmp_path, name):
    path = tmp_path / "labels.csv"
    mark = SOME[0]._replace(reviewer=name)
    assert there_and_back(path, [mark], recorded_in(tmp_path)) == [mark]
    (row,) = csv.DictReader(path.read_text().splitlines())
    assert row["reviewer"] == (name if name in {"'x", "-5"} else f"'{name}")


def test_pympi_reads_what_elan_would(tmp_path):
    path = tmp_path / "labels.eaf"
    write_labels(path, SOME, recorded_in(tmp_path))
    document = pympi.Elan.Eaf(path)
    times = {
        name: document.get_annotation_data_for_tier(name) for name in document.get_tier_names()
    }
    assert times == {
        "hall@Ann": [(1000, 2000, "speech")],
        "made: hall@Ann": [(1000, 2000, "2026-03-01T06:59:30.123456789Z", "speech")],
        "corrects: hall@Ann": [(1000, 2000, "live", "speech")],
        "hall@Bob": [(2000, 3000, "coughing")],
        "kitchen@Ann": [(2000, 4000, "tap_water")],
        "corrects: kitchen@Ann": [(2000, 4000, "paper-1", "tap_water")],
    }
    about = document.get_parameters_for_tier("kitchen@Ann")
    assert (about["PARTICIPANT"], about["ANNOTATOR"]) == ("kitchen", "Ann")
    assert list(document.get_linguistic_type_names()) == ["marks", "corrects", "made"]


def test_what_pympi_and_people_write_as_elan_is_read(tmp_path):
    path = tmp_path / "labels.eaf"
    document = pympi.Elan.Eaf(author="Ann")
    document.add_linked_file("/sound/hall.wav", mimetype="audio/x-wav")
    document.add_tier("sounds", ann="Ann")
    document.add_annotation("sounds", 1500, 2500, "speech")
    document.add_annotation("sounds", 2500, 3000, " coughing\n")
    document.add_linguistic_type("remark", "Symbolic_Association", timealignable=False)
    document.add_tier("remarks", "remark", parent="sounds")
    document.add_ref_annotation("remarks", "sounds", 1600, "on the telephone")
    document.to_file(path)
    found = read_labels(path, recorded_in(tmp_path, ["hall"]))[tmp_path]
    assert found == [
        Mark("hall", START + 1500 * MILLISECOND, START + 2500 * MILLISECOND, "speech", "Ann"),
        Mark("hall", START + 2500 * MILLISECOND, START + 3000 * MILLISECOND, "coughing", "Ann"),
    ]


def test_a_tier_of_elan_below_another_is_read_where_it_is_chosen(tmp_path):
    path = tmp_path / "labels.eaf"
    document = pympi.Elan.Eaf(author="Ann")
    document.add_linguistic_type("part", "Included_In")
    document.add_tier("scenes")
    document.add_tier("sounds", "part", parent="scenes")
    document.add_annotation("scenes", 1000, 9000, "in the kitchen, cooking")
    document.add_annotation("sounds", 1500, 2500, "speech")
    document.to_file(path)
    options = ImportOptions(choice=Choice(["sounds"]), strict=True)
    found = import_labels(path, recorded_in(tmp_path, ["hall"]), options, refuse).by_log[tmp_path]
    span = START + 1500 * MILLISECOND, START + 2500 * MILLISECOND
    assert found == [Mark("hall", *span, "speech")]


def test_pyannote_reads_and_writes_rttm_alike(tmp_path):
    path = tmp_path / "labels.rttm"
    labelled = recorded_in(tmp_path)
    write_labels(path, SOME, labelled)
    loaded = load_rttm(path)
    late = labelled["kitchen"].starts[0]
    assert list(loaded["hall"].itertracks(yield_label=True)) == [
        (Segment(1, 2), 0, "speech"),
        (Segment(2, 3), 1, "coughing"),
    ]
    ((segment, _, label),) = loaded["kitchen"].itertracks(yield_label=True)
    assert label == "tap_water"
    assert segment.start == pytest.approx(2 - (late - START) / SECOND, abs=1e-9)
    written = Annotation(uri="hall")
    written[Segment(0.25, 1.5)] = "speech"
    with path.open("w") as stream:
        written.write_rttm(stream)
    (found,) = read_labels(path, labelled)[tmp_path]
    assert found == Mark("hall", START + SECOND // 4, START + SECOND * 3 // 2, "speech")


def test_rttm_of_older_tools_and_its_other_lines_are_read(tmp_path):
    path = tmp_path / "labels.rttm"
    path.write_text(
        ";; of the evaluation in 2009\n"
        "SPKR-INFO hall 1 <NA> <NA> <NA> unknown speech <NA>\n\n"
        "SPEAKER hall 1   1.50   .50 <NA> <NA> speech <NA>\n"
    )
    (found,) = read_labels(path, recorded_in(tmp_path))[tmp_path]
    assert found == Mark("hall", START + SECOND * 3 // 2, START + SECOND * 2, "speech")


def test_a_selection_table_has_the_columns_of_raven(tmp_path):
    path = tmp_path / "day.Table.1.selections.txt"
    write_labels(path, SOME, recorded_in(tmp_path))
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream, delimiter="\t"))
    assert rows[0] == {
        "Selection": "1",
        "View": "Spectrogram 1",
        "Channel": "1",
        "Begin Time (s)": "1.000000000",
        "End Time (s)": "2.000000000",
        "Low Freq (Hz)": "0.000",
        "High Freq (Hz)": "8000.000",
        "Annotation": "speech",
        "Microphone": "hall",
        "Reviewer": "Ann",
        "Made": "2026-03-01T06:59:30.123456789Z",
        "Corrects": "live",
    }
    assert [row["Selection"] for row in rows] == ["1", "2", "3"]
    assert [row["Channel"] for row in rows] == ["1", "1", "2"]


def test_a_table_that_raven_saved_is_known_by_its_content_and_its_views_are_one(tmp_path):
    path = tmp_path / "table.txt"
    path.write_bytes(
        b"Selection\tView\tChannel\tBegin Time (s)\tEnd Time (s)\tLow Freq (Hz)\tHigh Freq (Hz)"
        b"\tDelta Time (s)\tAnnotation\r\n"
        b"1\tWaveform 1\t1\t6.709509878\t15.096397225\t1739.0\t3798.8\t8.38\tspeech\r\n"
        b"1\tSpectrogram 1\t1\t6.709509878\t15.096397225\t1739.0\t3798.8\t8.38\tspeech\r\n"
        b"2\tSpectrogram 1\t1\t29.383026016\t40.257059266\t1587.1\t4136.5\t\tcoughing\r\n"
    )
    found = read_labels(path, recorded_in(tmp_path, ["hall"]))[tmp_path]
    assert found == [
        Mark("hall", START + 6_709_509_878, START + 15_096_397_225, "speech"),
        Mark("hall", START + 29_383_026_016, START + 40_257_059_266, "coughing"),
    ]


def test_label_studio_gets_a_task_for_each_microphone(tmp_path):
    path = tmp_path / "tasks.json"
    write_labels(path, SOME, recorded_in(tmp_path))
    hall, kitchen = json.loads(path.read_text())
    assert hall["data"] == {
        "audio": "hall.wav",
        "microphone": "hall",
        "start": "2026-03-01T06:59:30.123456789Z",
    }
    assert [list(task["annotations"][0]) for task in (hall, kitchen)] == [["result"]] * 2
    assert hall["annotations"][0]["result"][0] == {
        "id": "mark1",
        "from_name": "label",
        "to_name": "audio",
        "type": "labels",
        "origin": "manual",
        "meta": {"reviewer": "Ann", "made": "2026-03-01T06:59:30.123456789Z", "corrects": "live"},
        "original_length": 3600.0,
        "value": {"start": 1.0, "end": 2.0, "channel": 0, "labels": ["speech"]},
    }


def item(start, end, *labels, **other):
    value = {"start": start, "end": end, "channel": 0, "labels": list(labels)}
    return {"id": "x", "from_name": "label", "to_name": "audio", "type": "labels"} | {
        "value": value,
        **other,
    }


def task(*results, kind="annotations", **other):
    return {"id": 7, "data": {"audio": "/upload/a.wav"}, kind: [{"result": results, **other}]}


def tasks_file(tmp_path, *tasks):
    path = tmp_path / "tasks.json"
    path.write_text(json.dumps(tasks))
    return path


@pytest.mark.parametrize(
    ("by", "name"),
    [
        (10, "user 10"),
        ({"id": 3, "email": "ann@example.org"}, "ann@example.org"),
        ({"id": 3}, "3"),
        (None, ""),
    ],
)
def test_an_export_of_label_studio_says_who_annotated_and_when(tmp_path, by, name):
    rating = {"type": "rating", "value": {"rating": 3}}
    done = task(
        item(12.778410892095105, 28.50568583621215, "speech", original_length=3600.2),
        rating,
        completed_by=by,
        created_at="2021-03-09T22:16:08.728353Z",
    )
    cancelled = task(item(1, 2, "speech"), was_cancelled=True)
    done |= {"predictions": [{"result": [item(0, 1, "cry")]}]}
    path = tasks_file(tmp_path, done, cancelled)
    (found,) = read_labels(path, recorded_in(tmp_path, ["hall"]))[tmp_path]
    span = START + 12_778_410_892, START + 28_505_685_836
    assert found == Mark("hall", *span, "speech", name, 1_615_328_168_728_353_000)


def test_predictions_that_label_studio_would_import_are_read_but_not_those_beside_annotations(
    tmp_path,
):
    predicted = task(item(1, 2, "speech"), kind="predictions", model_version="m", created_at="x")
    labelled = recorded_in(tmp_path, ["hall"])
    path = tasks_file(tmp_path, predicted)
    assert read_labels(path, labelled)[tmp_path] == [
        Mark("hall", START + SECOND, START + 2 * SECOND, "speech")
    ]
    path = tasks_file(tmp_path, predicted | {"annotations": []})
    with pytest.raises(DataError, match="holds no labels"):
        read_labels(path, labelled)


EAF = """<?xml version="1.0" encoding="UTF-8"?>
<ANNOTATION_DOCUMENT FORMAT="3.0">
<HEADER TIME_UNITS="milliseconds">{header}</HEADER>
<TIME_ORDER>
<TIME_SLOT TIME_SLOT_ID="ts1" TIME_VALUE="{first}"/>
<TIME_SLOT TIME_SLOT_ID="ts2" TIME_VALUE="2000"/>
<TIME_SLOT TIME_SLOT_ID="ts3"/>
</TIME_ORDER>
<TIER TIER_ID="t" {tier}>
<ANNOTATION>
<ALIGNABLE_ANNOTATION ANNOTATION_ID="a1" TIME_SLOT_REF1="ts1" TIME_SLOT_REF2="{last}">
<ANNOTATION_VALUE>{label}</ANNOTATION_VALUE>
</ALIGNABLE_ANNOTATION>
</ANNOTATION>
</TIER>
</ANNOTATION_DOCUMENT>
"""
BOMB = '<!DOCTYPE a [<!ENTITY b "{0}"><!ENTITY c "{1}">]><a>{1}</a>'.format("x" * 99, "&b;" * 99)


def eaf(header="", first=1000, tier="", last="ts2", label="speech"):
    return EAF.format(header=header, first=first, tier=tier, last=last, label=label)


RAVEN = "Selection\tBegin Time (s)\tEnd Time (s)\tAnnotation"


def studio(*results, **other):
    return json.dumps([task(*results, **other)])


@pytest.mark.parametrize(
    "case",
    [
        ("a.txt", "1.0\t1.0\tspeech\n", "a.txt:1: speech is a point; mark a span of time"),
        ("a.txt", "1\t2\tspeech\n4\t3\tspeech\n", "a.txt:2: speech ends before it starts"),
        ("a.txt", "-1\t2\tspeech\n", "a.txt:1: speech starts at -1 s, before the first frame"),
        ("a.txt", "1\tinf\tspeech\n", "a.txt:1: 'inf' is neither seconds nor a time such as"),
        ("a.txt", "nan\t2\tspeech\n", "a.txt:1: 'nan' is neither seconds nor a time such as"),
        ("a.txt", "1,5.0\t2\tspeech\n", "a.txt:1: '1,5.0' is neither seconds nor a time"),
        ("a.txt", "1\t2e98\tspeech\n", "a.txt:1: speech lies outside of what mic heard"),
        ("a.txt", "1\t1e9\tspeech\n", "a.txt:1: speech lies outside of what mic heard"),
        ("a.txt", "1\t2\tMusic?\n", "a.txt:1: 'Music?' is not a class name; name"),
        ("a.txt", "1\t2\t\n", "a.txt:1: has no text"),
        ("a.txt", "2\t4\tspeech\n\n1\t2.1\tcry\n", "a.txt:1: speech overlaps cry in line 3"),
        ("a.txt", "1 2 speech\n", "a.txt:1: is not start, end and label with tabs between"),
        ("a.txt", "\n\\\t100\t200\n", "a.txt: holds no labels"),
        ("a.csv", "start,end,label\n", "a.csv: holds no labels"),
        ("a.csv", "start,label\n1,speech\n", "a.csv:1: no column is called end: choose it with"),
        ("a.csv", "1,2,cry\n", "a.csv:1: does not name the columns: say which is what, as"),
        ("a.csv", "start,end,label\n1,2\n", "a.csv:2: has no text"),
        ("a.csv", "start,end,label\n1,2,5,cry\n", "a.csv:2: has 4 fields, the first line 3"),
        ("a.csv", 'start,"end"x,label\n', "a.csv:1: is not CSV"),
        ("a.csv", 'start,end,label\n1,2,"a"b\n', "a.csv:2: is not CSV"),
        ("a.csv", "start,end,label\n1,9999-99-99,cry\n", "a.csv:2: '9999-99-99' is neither"),
        ("a.csv", "start,end,label\n1,9026,cry\n", "a.csv:2: cry lies outside of what mic"),
        ("a.csv", "start,end,label\n1999-01-01,1999-01-02,cry\n", "a.csv:2: cry lies outside"),
        (
            "a.csv",
            "start,end,label,microphone\n1,2,cry,attic\n",
            "a.csv:2: no microphone 'attic' in the logs; there is mic",
        ),
        ("a.csv", "start,end,label,made\n1,2,cry,soon\n", "a.csv:2: 'soon' is neither seconds"),
        ("a.csv", "start,end,label,made\n1,2,cry,9999-01-01\n", "a.csv:2: a label cannot be made"),
        (
            "a.csv",
            'start,end,label,reviewer\n1,2,cry,"a\nb"\n',
            "a.csv:2: 'a\\nb' cannot be a name: use up to 200 characters",
        ),
        ("a.txt", f"{RAVEN}\n1\t2\t1\tcry\n", "a.txt:2: cry ends before it starts"),
        ("a.txt", f"{RAVEN}\n1\t1\t2\tcry\t\tx\n", "a.txt:2: has 6 fields, the first line 4"),
        ("a.txt", f"{RAVEN}\n", "a.txt: holds no labels"),
        ("a.txt", f"{RAVEN}\n1\t1\t\tcry\n", "a.txt:2: '' is no number of seconds"),
        (
            "a.txt",
            f"{RAVEN}\tSpecies\n",
            "a.txt:1: the label may be the column 'Annotation' or 'Species': choose it with",
        ),
        (
            "a.txt",
            f"{RAVEN[:-10]}Notes\n1\t1\t2\tcry\n",
            "a.txt:1: no column is called label: choose it with --column label=NAME; there is 'S",
        ),
        (
            "a.txt",
            f"{RAVEN}\n1\t1\t3\tcry\n2\t2\t4\tspeech\n",
            "a.txt:3: speech overlaps cry in line 2",
        ),
        ("a.rttm", "SPEAKER mic 1 1 2 cry\n", "a.rttm:1: is no line of RTTM"),
        ("a.rttm", "SPEAKER my mic 1 1 2 - - cry - - -\n", "a.rttm:1: is no line of RTTM"),
        ("a.rttm", "SPEAKER mic 1 1 0 - - cry -\n", "a.rttm:1: cry is a point"),
        ("a.rttm", "SPEAKER mic 1 1 -1 - - cry -\n", "a.rttm:1: cry ends before it starts"),
        ("a.rttm", "SPEAKER mic 1 1 nan - - cry -\n", "a.rttm:1: 'nan' is no number of seconds"),
        ("a.rttm", "SPEAKER mic 1 9e98 1 - - cry -\n", "a.rttm:1: "),
        ("a.rttm", "SPEAKER day1 1 1 1 - - cry -\n", "a.rttm:1: no microphone 'day1' in the logs"),
        ("a.rttm", "LEXEME mic 1 1 1 hello lex ann -\n", "a.rttm: holds no labels"),
        ("a.eaf", "1\t2\tspeech\n", "a.eaf:1: is not XML (syntax error)"),
        ("a.eaf", eaf()[:-30], "a.eaf:15: is not XML (unclosed token)"),
        ("a.eaf", "<html/>", "a.eaf:1: is no document of ELAN"),
        ("a.eaf", BOMB, "a.eaf:1: declares a DTD, as ELAN never does"),
        ("a.eaf", f"{'<a>' * 99_999}", "a.eaf:1: is no document of ELAN"),
        ("a.eaf", eaf(header="<a>" * 99_999), "a.eaf:3: is no document of ELAN"),
        ("a.eaf", eaf(header=f"<a {'b' * 70_000}='c'/>"), "a.eaf:3: is no document of ELAN"),
        ("a.eaf", eaf().replace("milliseconds", "PAL-frames"), "a.eaf:3: has times that are no"),
        (
            "a.eaf",
            eaf(header='<MEDIA_DESCRIPTOR MEDIA_URL="file:///a.wav" TIME_ORIGIN="40"/>'),
            "a.eaf:3: has an offset of the recording",
        ),
        ("a.eaf", eaf(first=3000), "a.eaf:11: speech ends before it starts"),
        ("a.eaf", eaf(first=2000), "a.eaf:11: speech is a point"),
        ("a.eaf", eaf(first="1.5"), "a.eaf:11: '1.5' is no number of milliseconds"),
        ("a.eaf", eaf(first="9" * 5000), f"a.eaf:11: '{'9' * 64}' is no number of milli"),
        ("a.eaf", eaf(last="ts3"), "a.eaf:11: 'speech' has no time; align it in ELAN"),
        ("a.eaf", eaf(last="ts4"), "a.eaf:11: 'speech' has no time; align it in ELAN"),
        ("a.eaf", eaf(label="Loud, I think"), "a.eaf:11: 'Loud, I think' is not a class name"),
        ("a.eaf", eaf(label=""), "a.eaf:11: has no text"),
        ("a.eaf", eaf(tier='PARTICIPANT="Mrs Day"'), "a.eaf:11: no microphone 'Mrs Day' in the"),
        ("a.eaf", eaf(tier='PARENT_REF="x"'), "a.eaf: holds no labels"),
        (
            "a.eaf",
            eaf(header='<PROPERTY NAME="hearthlog:start">then</PROPERTY>'),
            "a.eaf:11: 'then' is neither",
        ),
        ("a.json", "{", "a.json: is not JSON ("),
        ("a.json", "[" * 99_999, "a.json: is not JSON ("),
        ("a.json", "[]", "a.json: holds no labels"),
        ("a.json", "7", "a.json: task 1: is no task of Label Studio; export them as JSON"),
        ("a.json", '{"audio": "a.wav", "label": []}', "a.json: task 1: is no task of Label Studio"),
        ("a.json", '[{"data": {}}]', "a.json: task 1: has no annotations and no predictions"),
        ("a.json", '{"data": {}, "annotations": [1]}', "a.json: task 1, annotation 1: has no res"),
        (
            "a.json",
            studio(item(1, 2, "cry"), item(1.5, 3, "speech")),
            "a.json: task 1, annotation 1, result 2: speech overlaps cry in task 1, annotation 1,",
        ),
        (
            "a.json",
            studio(item(1, 1, "cry")),
            "a.json: task 1, annotation 1, result 1: cry is a po",
        ),
        (
            "a.json",
            studio(item(1, float("nan"), "cry")),
            "a.json: task 1, annotation 1, result 1: ",
        ),
        (
            "a.json",
            studio(item(1, [2], "cry")),
            "a.json: task 1, annotation 1, result 1: '[\"2\"]' ",
        ),
        ("a.json", studio(item(1, 2)), "a.json: task 1, annotation 1, result 1: has no text"),
        (
            "a.json",
            studio(item(1, 2, "a", "b")),
            "a.json: task 1, annotation 1, result 1: has 2 la",
        ),
        (
            "a.json",
            studio(item(1, 2, "cry", type="timeserieslabels")),
            "a.json: task 1, annotation 1, result 1: 'timeserieslabels' is no label of a span",
        ),
        (
            "a.json",
            studio(item(1, 2, "cry", original_length=12.5)),
            "a.json: task 1, annotation 1, result 1: labels a recording of 12.5 s, and these",
        ),
        (
            "a.json",
            studio(item(1, 2, "cry", meta={"reviewer": "\ud800"})),
            "a.json: task 1, annotation 1, result 1: '\\ud800' cannot be a name",
        ),
    ],
)
def test_a_label_that_cannot_be_is_refused_with_its_place(tmp_path, case):
    name, text, line = case
    labels = tmp_path / name
    labels.write_text(text)
    with pytest.raises(DataError) as refused:
        read_labels(labels, recorded_in(tmp_path, ["mic"]))
    assert str(refused.value).startswith(f"{tmp_path}/{line}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"1\t2\tspeech\n3\t4\t\xff\n", ":2: is not UTF-8"),
        ("1\t2\tspeech\n".encode("utf-16")[:-1], ":1: is not UTF-8"),
        (b"\0" * (65 << 20), ": larger than "),
        (None, ": no such label file"),
    ],
)
def test_a_file_that_is_no_label_file_is_refused(logs, hearthlog, tmp_path, content, reason):
    for form in FORMATS:
        labels = tmp_path / f"labels{form.suffix}"
        if content is not None:
            labels.write_bytes(content)
        result = hearthlog("annotate", "import", logs, labels)
        assert (result.returncode, result.stdout) == (1, "")
        assert result.stderr.startswith(f"hearthlog: {labels}{reason}")
        assert result.stderr.count("\n") == 1
        assert not list(logs.rglob("*.review.mcap"))


def test_labels_of_windows_and_of_spectral_selections_are_read(logs, hearthlog, tmp_path):
    labels = tmp_path / "labels.txt"
    labels.write_bytes(b"\xef\xbb\xbf1.5\t2.5\tspeech\r\n\\\t100.0\t4000.0\r\n")
    assert hearthlog("annotate", "import", logs, labels).returncode == 0
    log = find_logs(logs)[0]
    zero = find_coverage(log)["mic"].starts[0]
    span = zero + SECOND * 3 // 2, zero + SECOND * 5 // 2
    assert [mark[:4] for mark in read_marks(log)] == [("mic", *span, "speech")]


def test_a_class_that_no_model_knows_is_taken_for_it_is_new(logs, hearthlog, tmp_path):
    labels = tmp_path / "labels.txt"
    labels.write_text("1\t2\tkettle_whistle\n")
    result = hearthlog("annotate", "import", logs, labels)
    assert result.stdout.endswith("kettle_whistle  1 mark, 1.00 s\n")


def test_of_several_microphones_one_is_chosen_where_the_file_has_no_place_for_them(tmp_path):
    labelled = recorded_in(tmp_path)
    with pytest.raises(DataError, match=r"choose one with --microphone \(hall, kitchen\)"):
        write_labels(tmp_path / "labels.txt", SOME, labelled)
    write_labels(tmp_path / "labels.txt", SOME[:2], labelled)
    with pytest.raises(DataError, match=r":1: of which microphone\? choose one with"):
        read_labels(tmp_path / "labels.txt", labelled)
    (found,) = read_labels(tmp_path / "labels.txt", labelled, "hall").values()
    assert [mark[:4] for mark in found] == [mark[:4] for mark in SOME[:2]]


def test_labels_of_another_microphone_are_counted_where_one_is_chosen(tmp_path):
    path, labelled = tmp_path / "labels.csv", recorded_in(tmp_path)
    write_labels(path, SOME, labelled)
    found = import_labels(path, labelled, ImportOptions("kitchen"), refuse)
    assert found.moved == {"hall": 2}
    (marks,) = found.by_log.values()
    assert [mark.microphone for mark in marks] == ["kitchen"] * 3


def test_what_would_be_too_large_to_be_read_again_is_not_written(tmp_path):
    times = range(START, START + 100_000 * MILLISECOND, MILLISECOND)
    marks = [Mark("hall", time, time + MILLISECOND, "cry", "x" * 200) for time in times]
    path = tmp_path / "labels.csv"
    with pytest.raises(DataError, match="would be larger than 16 MB; export fewer logs"):
        write_labels(path, marks, recorded_in(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_what_xml_cannot_hold_of_a_name_is_replaced(tmp_path):
    (found,) = there_and_back(
        tmp_path / "a.eaf", [SOME[0]._replace(reviewer="A\uffffn")], recorded_in(tmp_path)
    )
    assert found.reviewer == "A\N{REPLACEMENT CHARACTER}n"


@pytest.mark.parametrize("suffix", SAYING)
def test_what_would_steer_a_terminal_is_replaced(tmp_path, suffix):
    mark = SOME[0]._replace(reviewer="A\x9b31mn", corrects="\x8flive")
    (found,) = there_and_back(tmp_path / f"a{suffix}", [mark], recorded_in(tmp_path))
    assert (found.reviewer, found.corrects) == (
        "A\N{REPLACEMENT CHARACTER}31mn",
        "\N{REPLACEMENT CHARACTER}live",
    )


def test_a_mark_before_the_first_frame_is_written_as_it_is():
    assert seconds_text(-SECOND // 2) == "-0.500000000"
    assert seconds_text(3 * SECOND + 1) == "3.000000001"


@pytest.mark.parametrize(
    ("change", "new"),
    [
        ({}, False),
        ({"start": START + SECOND + ROUNDING}, False),
        ({"end": START + 2 * SECOND - ROUNDING - 1}, True),
        ({"start": START + SECOND + ROUNDING + 1}, True),
        ({"label": "crying"}, True),
        ({"reviewer": "", "made": 0, "corrects": ""}, False),
        ({"reviewer": "Bob"}, True),
        ({"microphone": "kitchen"}, True),
    ],
)
def test_a_mark_is_new_if_it_says_what_none_says_yet(change, new):
    mark = SOME[0]._replace(**change)
    assert new_marks([mark], SOME) == ([mark] if new else [])


_PIECES = st.sampled_from(
    [
        "1.5",
        "\t",
        ",",
        "\n",
        " ",
        "2",
        "speech",
        "start,end,label\n",
        f"{RAVEN}\n1",
        "SPEAKER mic 1 1 2 - - cry -\n",
        '"',
        ";",
        "Begin Time (s)\tDuration\tSpecies\n",
        "TIME;END;Common_Name;Class\n",
        "1,5",
        "Türklingel",
        "a\u0301",
        "\r",
        "1e99",
        "-",
        "\x00",
        "\\",
        "\ufeff",
        "2026-03-01T07:00:00.123456789Z",
        "0001-01-01T00:00+23:59",
        "[",
        "]",
        "{",
        "}",
        '"data":{},',
        '"annotations":[{"result":[',
        '{"type":"labels","value":{"start":1,"end":2,"labels":["cry"]}}',
        "<ANNOTATION_DOCUMENT>",
        "<TIER>",
        '<TIME_SLOT TIME_SLOT_ID="a" TIME_VALUE="5"/>',
        '<ALIGNABLE_ANNOTATION TIME_SLOT_REF1="a">cry</ALIGNABLE_ANNOTATION>',
        "</TIER>",
        "</ANNOTATION_DOCUMENT>",
        "<!DOCTYPE a>",
        "&lol;",
        "&#0;",
    ]
).map(str.encode)


@given(
    parts=st.lists(_PIECES | st.binary(max_size=8), max_size=30),
    suffix=st.sampled_from([form.suffix for form in FORMATS]),
)
@settings(deadline=None, max_examples=300)
def test_whatever_is_in_a_label_file_it_is_read_or_refused_in_one_line(
    tmp_path_factory, parts, suffix
):
    path = tmp_path_factory.mktemp("labels") / f"labels{suffix}"
    path.write_bytes(b"".join(parts))
    labelled = {"mic": Coverage([path], [SECOND], [9 * SECOND])}
    output = []
    for strict in (True, False):
        try:
            options = ImportOptions(strict=strict)
            found = import_labels(path, labelled, options, lambda _: None)
            output += [str(error) for _, error in found.left_out.kinds()]
        except DataError as error:
            output.append(str(error))
    assert not any("\n" in line for line in output)
