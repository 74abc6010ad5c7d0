"""Label files are taken as other programs, and the people who use them, write them."""

import os
import pty
import resource
import select
import shutil
import subprocess
from functools import partial
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG
from foreign_label_files import FILES
from log_fixtures import run

from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import NANOSECONDS

START = 1_772_348_400 * NANOSECONDS
TAKEN = [file for file in FILES if not file.refused]


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture(scope="module")
def minute(tmp_path_factory):
    """A log of a minute of noise, without labels."""
    folder = tmp_path_factory.mktemp("minute")
    noise = np.random.default_rng(7).normal(0, 0.01, 60 * 16_000)
    soundfile.write(folder / "noise.wav", noise, 16_000)
    settings = Settings(output=folder / "logs", model=None)
    source = FileSource([folder / "noise.wav"], START)
    (log,) = record(settings, source, Flag()).logs
    return log


@pytest.fixture
def log(minute, tmp_path):
    """A log to write beside."""
    return Path(shutil.copy(minute, tmp_path))


@pytest.fixture
def take(log, hearthlog, tmp_path):
    """Import a label file; return what came of it, and the marks in seconds."""
    (zero,) = (one.starts[0] for one in find_coverage(log).values())

    def import_labels(name, content, *options, class_map=""):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        if class_map:
            (tmp_path / "labels.toml").write_text(class_map)
            options += ("--map", tmp_path / "labels.toml")
        result = hearthlog("annotate", "import", log, path, *options)
        marks = [
            ((mark.start - zero) / NANOSECONDS, (mark.end - zero) / NANOSECONDS, mark.label)
            for mark in read_marks(log)
        ]
        return result, marks

    return import_labels


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.program}: {file.what}")
def test_a_file_as_people_have_it_is_taken(take, file):
    result, marks = take(file.name, file.content, *file.options, class_map=file.map)
    assert marks == list(file.marks)
    assert result.returncode == (1 if file.refused else 3 if file.left_out else 0)
    for output in (*file.left_out, file.refused):
        assert output in result.stderr
    assert result.stderr.count("\n") <= 3


def test_of_33_such_files_at_least_30_are_taken():
    assert (len(FILES), len(TAKEN)) == (33, 30)


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.program}: {file.what}")
def test_strictly_a_file_of_which_something_would_be_left_out_is_refused_whole(take, file):
    result, marks = take(file.name, file.content, "--strict", *file.options, class_map=file.map)
    if file.left_out or file.refused:
        assert (result.returncode, result.stdout, marks) == (1, "", [])
    else:
        assert (result.returncode, marks) == (0, list(file.marks))


def test_names_that_are_only_spelt_like_classes_are_not_taken_unasked(take):
    content = "1\t2\tTürklingel\n3\t4\tCOUGH\n5\t6\tCOUGH\n"
    result, marks = take("labels.txt", content)
    assert (result.returncode, result.stdout, marks) == (1, "", [])
    assert "'COUGH' as coughing (2 labels) and 'Türklingel' as tuerklingel (1" in result.stderr
    assert "--yes accepts these classes, --map names others" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(("answer", "status"), [("y", 0), ("n", 1), ("", 1)])
def test_at_a_terminal_it_asks(log, tmp_path, answer, status):
    labels = tmp_path / "labels.txt"
    labels.write_text("1\t2\tTap Water\n")
    ours, theirs = pty.openpty()
    command = [*HEARTHLOG, "annotate", "import", log, labels]
    with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, stderr=theirs) as process:
        os.close(theirs)
        output = b""
        while b"[y/N]" not in output and select.select([ours], [], [], 60)[0]:
            output += os.read(ours, 1024)
        assert not read_marks(log)
        os.write(ours, f"{answer}\n".encode())
        assert process.wait(60) == status
    os.close(ours)
    assert b"'Tap Water' as tap_water (1 label)" in output
    assert [mark.label for mark in read_marks(log)] == ["tap_water"] * (status == 0)


def test_where_the_input_is_closed_nobody_is_asked(log, tmp_path):
    labels = tmp_path / "labels.txt"
    labels.write_text("1\t2\tTap Water\n")
    command = ["sh", "-c", '"$@" <&-', "sh", *HEARTHLOG, "annotate", "import", log, labels]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "--yes accepts these classes" in done.stderr


def test_with_a_map_only_classes_that_it_or_hearthlog_knows_are_guessed(take):
    content = "1\t2\tDoor Bell\n3\t4\tDing-dong\n5\t6\tEurasian Blackbird\n7\t8\tLaughter\n"
    result, marks = take("labels.txt", content, "--yes", class_map='"ding-dong" = "door_bell"')
    assert marks == [(1, 2, "door_bell"), (3, 4, "door_bell"), (7, 8, "laughing")]
    assert result.returncode == 3
    assert "1 label left out: " in result.stderr
    assert ":3: 'Eurasian Blackbird' is not a class name" in result.stderr


def test_a_map_goes_before_the_name_itself_and_knows_a_label_in_any_capitals(take):
    content = "1\t2\tspeaker_00\n3\t4\tTU\u0308RKLINGEL\n"
    class_map = 'SPEAKER_00 = "speech"\n"Türklingel" = "doorbell"\n'
    result, marks = take("labels.txt", content, class_map=class_map)
    assert (result.returncode, marks) == (0, [(1, 2, "speech"), (3, 4, "doorbell")])


@pytest.mark.parametrize(
    ("class_map", "reason"),
    [
        ('a = "Tap Water"', "'a' needs the name of a class in quotes"),
        ("a = 1", "'a' needs the name of a class in quotes"),
        ('[a]\nb = "cry"', "'a' needs the name of a class in quotes"),
        ('a = "cry"\nA = "speech"', "'A' has two classes: cry and speech"),
        ("a = ", "labels.toml"),
    ],
)
def test_a_map_that_is_none_is_refused_in_one_line(take, class_map, reason):
    result, marks = take("labels.txt", "1\t2\ta\n", class_map=class_map)
    assert (result.returncode, marks) == (1, [])
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1


def test_each_name_that_is_no_class_is_said_once_with_its_number_and_its_first_line(take):
    names = [f"what {i}?" for i in range(14)]
    lines = [f"{i}\t{i}.5\t{name}\n" for i, name in enumerate([*names, *names])]
    result, marks = take("labels.txt", "".join([*lines, "40\t41\tspeech\n"]))
    assert (result.returncode, marks) == (3, [(40, 41, "speech")])
    output = result.stderr.splitlines()
    assert sum("'what 3?'" in line for line in output) == 1
    assert "2 labels left out, the first: " in output[1]
    assert "labels.txt:1: 'what 0?' is not a class name" in output[1]
    assert output[-1] == "hearthlog: 8 labels more left out, of 4 kinds"


def test_of_a_file_that_is_half_unreadable_the_other_half_is_taken(take):
    good = "".join(f"{i},{i}.5,speech\n" for i in range(1, 50, 2))
    bad = 'one,two,speech\n60,"x"y,speech\n1,2,3,4,5\n'
    result, marks = take("labels.csv", f"start,end,label\n{good}{bad}{good[:0]}51,52,cry\n")
    assert (result.returncode, len(marks), marks[-1][2]) == (3, 26, "cry")
    assert "1 wrong time left out: " in result.stderr
    assert "2 unreadable lines left out, the first: " in result.stderr
    assert ":28: is not CSV" in result.stderr


def test_overlaps_of_one_class_are_one_and_those_of_a_frame_cost_no_label(take):
    spans = "1\t3", "2\t4", "2.5\t3.5"
    same = "".join(f"{span}\tspeech\n" for span in spans)
    result, marks = take("labels.txt", f"{same}3.96\t6\tcoughing\n8\t9\tcry\n8\t9\tcry\n")
    assert result.returncode == 0
    assert marks == [(1, 3, "speech"), (3, 4, "speech"), (4, 6, "coughing"), (8, 9, "cry")]


def test_what_a_longer_label_of_another_class_covers_is_left_out_and_the_rest_is_taken(take):
    result, marks = take("labels.txt", "1\t9\tmusic\n4\t4.02\tcoughing\n8\t10\tspeech\n")
    assert marks == [(1, 9, "music"), (9, 10, "speech")]
    assert "2 overlaps left out, the first: " in result.stderr
    assert result.returncode == 3


def test_a_label_that_is_left_out_takes_no_other_with_it(take):
    lines = "1\t99999\tmusic\n2\t3\tno class?\n2\t2.5\tspeech\n"
    result, marks = take("labels.txt", lines)
    assert (result.returncode, marks) == (3, [(2, 2.5, "speech")])
    assert ":1: music lies outside of what mic heard" in result.stderr


def test_the_microphone_that_is_chosen_goes_before_the_one_in_the_file(take):
    content = "start,end,label,microphone\n1,2,speech,attic\n"
    result, marks = take("labels.csv", content)
    assert (result.returncode, marks) == (1, [])
    assert "no microphone 'attic' in the logs; there is mic; `annotate import" in result.stderr
    result, marks = take("labels.csv", content, "--microphone", "attic")
    assert (result.returncode, marks) == (1, [])
    assert result.stderr.endswith(".mcap: no microphone 'attic'; there is mic\n")
    result, marks = take("labels.csv", content, "--microphone", "mic")
    assert (result.returncode, marks) == (0, [(1, 2, "speech")])


@pytest.mark.parametrize(
    ("name", "options", "status", "reason"),
    [
        ("a.txt", ["--tier", "x"], 1, "a.txt: has no tiers to choose with --tier"),
        ("a.rttm", ["--column", "label=x"], 1, "a.rttm: has no columns to choose with --column"),
        ("a.csv", ["--column", "label=x"], 1, "a.csv:1: no column 'x'; there is 'start', 'end' or"),
        ("a.csv", ["--column", "x"], 2, "--column x: write start, end, duration, label,"),
        ("a.csv", ["--column", "name=label"], 2, "--column name=label: write start, end"),
        ("a.csv", ["--column", "label="], 2, "--column label=: write start"),
        ("a.eaf", ["--tier", "y", "--tier", "x"], 1, "a.eaf: no tier 'y'; there is 'x'"),
    ],
)
def test_what_cannot_be_chosen_is_said(take, name, options, status, reason):
    content = "start,end,label\n1,2,speech\n"
    if name.endswith("eaf"):
        content = '<ANNOTATION_DOCUMENT><TIER TIER_ID="x"/></ANNOTATION_DOCUMENT>'
    result, marks = take(name, content, *options)
    assert (result.returncode, marks) == (status, [])
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1


MOST = 16 << 20  # bytes of a label file
HOSTILE = {  # and what is said of them
    "lines.txt": (b"x\n" * (MOST // 2), "has 8,388,608 lines; at most 1,000,000 are read"),
    "labels.txt": (b"".join(b"1\t2\tA %x\n" % i for i in range(20_000)), "overlaps left out"),
    "overlaps.txt": (
        b"".join(b"%d\t99\ta\n1\t%d\tb\n" % (i, i) for i in range(2, 20_000)),
        "lies outside of what mic heard",
    ),
    "accents.txt": (
        b"1\t2\ta" + "\u0301\u0323".encode() * (MOST // 4 - 9),
        "is not a class name",
    ),
    "quotes.csv": (b"start,end,label\n" + b'1,2,"a\n' * 900_000, "is not CSV"),
    "columns.csv": (b"start".ljust(MOST, b","), "is not CSV (a record is longer than 1 MB)"),
    "header.csv": (b"start,end,label,a" + b" " * 100_000 + b"b\n1,2,no?\n", "not a class name"),
    "wide.txt": ("start\tend\tlabel\n".encode("utf-16") + b"1\0" * (7 << 20), "longer than 1"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_neither_hangs_nor_fills_the_memory(log, tmp_path, name):
    content, output = HOSTILE[name]
    labels = tmp_path / name
    labels.write_bytes(content)
    result = subprocess.run(
        [*HEARTHLOG, "annotate", "import", log, labels, "--yes"],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30)),
    )
    assert result.returncode in {1, 3}
    assert output in result.stderr
    assert "Traceback" not in result.stderr
    assert len(result.stderr) < 5000
