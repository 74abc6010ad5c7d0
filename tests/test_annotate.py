"""What a reviewer marked stands beside the log, and goes to label files and back unchanged."""

import shutil
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from spliced import run, small_disk, write_log

from analyzer.errors import DataError
from analyzer.exchange import SUFFIXES, read_labels, write_labels
from analyzer.heard import Heard, find_heard
from analyzer.marks import ROUNDING, Mark, read_marks, review_path, write_marks
from schemas.errors import LogError
from schemas.files import find_logs
from schemas.logfile import LogFile
from schemas.messages import NANOSECONDS, SEGMENT, duration_message, header, message
from schemas.reader import LogReader

SECOND = NANOSECONDS
LABELS = st.sampled_from(["coughing", "speech", "unknown"])


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def logs(recorded, tmp_path):
    """A folder of logs of a minute each, to write beside."""
    return shutil.copytree(recorded, tmp_path / "logs")


@pytest.fixture
def log(logs):
    return find_logs(logs)[0]


@pytest.fixture
def zero(log):
    """Time of the first frame."""
    return find_heard(log)["mic"].starts[0]


def mark(zero, start, end, label="coughing"):
    return Mark("mic", zero + round(start * SECOND), zero + round(end * SECOND), label)


def layers(logs):
    return {path.name: path.read_bytes() for path in logs.rglob("*.review.mcap")}


def test_exported_labels_come_back_as_marks_of_every_log(logs, hearthlog, tmp_path):
    labels = tmp_path / "day.txt"
    assert hearthlog("export", logs, "-o", labels).returncode == 0
    result = hearthlog("annotate", "import", logs, labels)
    assert (result.returncode, result.stderr) == (0, "")
    recorders = find_logs(logs)
    written = [path for path in recorders if path.name.endswith(".review.mcap")]
    assert len(written) == len(recorders) // 2 > 1
    assert result.stdout.splitlines()[: len(written)] == [str(path) for path in written]
    lines = [line.split("\t") for line in labels.read_text().splitlines()]
    marks = [m for path in recorders if path not in written for m in read_marks(path)]
    amounts = {
        line.split()[0]: float(line.split()[3])
        for line in result.stdout.splitlines()[len(written) :]
    }
    for label in {label for *_, label in lines}:
        seconds = sum(float(end) - float(start) for start, end, own in lines if own == label)
        marked = sum(m.end - m.start for m in marks if m.label == label) / SECOND
        assert marked == pytest.approx(seconds, abs=1e-4)
        assert amounts[label] == pytest.approx(seconds, abs=0.01)


@pytest.mark.parametrize("suffix", [".txt", ".csv"])
def test_import_export_import_gives_the_same_layers_byte_for_byte(
    logs, hearthlog, tmp_path, suffix
):
    labels, again = tmp_path / "day.txt", tmp_path / f"again{suffix}"
    hearthlog("export", logs, "-o", labels)
    hearthlog("annotate", "import", logs, labels)
    first = layers(logs)
    assert hearthlog("annotate", "export", logs, "-o", again).stdout == f"{again}\n"
    assert hearthlog("annotate", "import", logs, again).returncode == 0
    assert layers(logs) == first
    for path in logs.rglob("*.review.mcap"):
        path.unlink()
    assert hearthlog("annotate", "import", logs, again).returncode == 0
    assert layers(logs) == first


def test_a_label_that_crosses_into_the_next_log_is_split_there(logs, hearthlog, tmp_path):
    heard = find_heard(logs)["mic"]
    border = (heard.starts[1] - heard.starts[0]) / SECOND
    labels = tmp_path / "labels.csv"
    labels.write_text(f"start,end,label\n{border - 2:.3f},{border + 3:.3f},speech\n")
    assert hearthlog("annotate", "import", logs, labels).stdout.endswith("2 marks, 5.00 s\n")
    (before,), (after,) = (read_marks(path) for path in heard.logs[:2])
    assert before.end == after.start == heard.starts[1]
    assert after.end - before.start == pytest.approx(5 * SECOND, abs=ROUNDING)


def test_a_layer_is_a_log_that_says_what_made_it_and_doctor_is_content(logs, log, zero, hearthlog):
    before = hearthlog("doctor", logs).stdout
    layer = write_marks(log, [mark(zero, 1, 2), mark(zero, 0.5, 1, "speech")])
    assert layer == review_path(log)
    reader = LogReader(layer)
    messages = [(item.log_time, item.decode()) for item in reader.messages()]
    assert [time - zero for time, _ in messages] == [SECOND, 2 * SECOND]
    assert [message.confidence for _, message in messages] == [1, 1]
    assert {item.header.frame_id for _, item in messages} == {"mic"}
    about = reader.metadata["hearthlog"]
    assert (about["node"], about["log"]) == ("home", log.name)
    assert about["version"]
    assert hearthlog("doctor", logs).stdout == before
    assert hearthlog("doctor", layer).returncode == 0
    info = hearthlog("info", layer)
    assert info.returncode == 0
    assert f"layer: {layer}" in info.stdout
    assert f"layer: {layer}" in hearthlog("info", logs).stdout


def test_a_log_with_a_layer_replays_as_without_it(logs, log, zero, hearthlog, model_file):
    before = hearthlog("replay", logs, "--model", model_file, "--json").stdout
    write_marks(log, [mark(zero, 1, 2)])
    after = hearthlog("replay", logs, "--model", model_file, "--json").stdout
    kept = [line for line in before.splitlines() if "took" not in line]
    assert [line for line in after.splitlines() if "took" not in line] == kept


def test_new_marks_win_and_older_ones_are_cut_and_split_around_them(log, zero):
    write_marks(log, [mark(zero, 1, 10), mark(zero, 12, 13, "speech")])
    write_marks(log, [mark(zero, 3, 4, "speech"), mark(zero, 9, 12.5, "unknown")])
    assert read_marks(log) == [
        mark(zero, 1, 3),
        mark(zero, 3, 4, "speech"),
        mark(zero, 4, 9),
        mark(zero, 9, 12.5, "unknown"),
        mark(zero, 12.5, 13, "speech"),
    ]


def test_marks_of_microphones_do_not_touch_each_other(log, zero):
    other = mark(zero, 1, 10)._replace(microphone="kitchen")
    write_marks(log, [mark(zero, 0, 5)])
    write_marks(log, [other])
    assert read_marks(log) == [other, mark(zero, 0, 5)]


def test_what_rounding_leaves_of_an_old_mark_is_gone(log, zero):
    old = mark(zero, 1, 2)
    write_marks(log, [old])
    new = old._replace(start=old.start + 400, end=old.end - 400, label="speech")
    write_marks(log, [new])
    assert read_marks(log) == [new]


@st.composite
def layer_of_marks(draw):
    """Marks in units of a tenth of a second that do not overlap each other."""
    borders = sorted(draw(st.sets(st.integers(0, 60), min_size=2, max_size=14)))
    spans = [span for span in pairwise(borders) if draw(st.booleans())]
    return [mark(SECOND, start / 10, end / 10, draw(LABELS)) for start, end in spans]


@given(rounds=st.lists(layer_of_marks(), min_size=1, max_size=3))
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_at_every_moment_the_latest_mark_holds(recorded, tmp_path_factory, rounds):
    log = Path(shutil.copy(find_logs(recorded)[0], tmp_path_factory.mktemp("marks")))
    for marks in rounds:
        write_marks(log, marks)
    found = read_marks(log)
    assert all(one.end <= other.start for one, other in pairwise(found))
    for moment in range(SECOND, 8 * SECOND, SECOND // 20):
        expected = [m.label for marks in rounds for m in marks if m.start <= moment < m.end]
        assert [m.label for m in found if m.start <= moment < m.end] == expected[-1:]


@given(
    borders=st.sets(st.integers(0, 3_599_999_999_999), min_size=2, max_size=20),
    suffix=st.sampled_from([".txt", ".csv"]),
    start=st.integers(1, 1 << 61),
    label=st.from_regex(r"[a-z][a-z0-9_]{0,63}", fullmatch=True),
)
@settings(deadline=None)
def test_marks_go_through_a_label_file_to_the_nanosecond(
    tmp_path_factory, borders, suffix, start, label
):
    log = tmp_path_factory.mktemp("labels") / "log.mcap"
    heard = {"mic": Heard([log], [start], [start + 3600 * SECOND])}
    spans = list(pairwise(sorted(borders)))[::2]
    marks = [Mark("mic", start + first, start + last, label) for first, last in spans]
    path = log.with_suffix(suffix)
    write_labels(path, marks, heard)
    assert read_labels(path, heard) == {log: marks}


@pytest.mark.parametrize(
    "case",
    [
        ("a.txt", "1.0\t1.0\tspeech\n", "a.txt:1: speech is a point; mark a span of time"),
        ("a.txt", "1\t2\tspeech\n4\t3\tspeech\n", "a.txt:2: speech ends before it starts"),
        ("a.txt", "-1\t2\tspeech\n", "a.txt:1: speech starts at -1 s, before the first frame"),
        ("a.txt", "1\tinf\tspeech\n", "a.txt:1: 'inf' is neither seconds nor a time such as"),
        ("a.txt", "nan\t2\tspeech\n", "a.txt:1: 'nan' is neither seconds nor a time such as"),
        ("a.txt", "1,5\t2\tspeech\n", "a.txt:1: '1,5' is neither seconds nor a time such as"),
        ("a.txt", "1\t2e98\tspeech\n", "a.txt:1: speech lies outside of what mic heard"),
        ("a.txt", "1\t1e9\tspeech\n", "a.txt:1: speech lies outside of what mic heard"),
        ("a.txt", "1\t2\tLoud Music\n", "a.txt:1: 'Loud Music' cannot be the name of a class"),
        ("a.txt", "1\t2\t\n", "a.txt:1: '' cannot be the name of a class"),
        ("a.txt", "2\t4\tspeech\n\n1\t2.1\tcry\n", "a.txt:3: overlaps the label in line 1"),
        ("a.txt", "1 2 speech\n", "a.txt:1: is not start, end and label with tabs between"),
        ("a.txt", "1\t2\tspeech\tloud\n", "a.txt:1: is not start, end and label with tabs"),
        ("a.txt", "\n\\\t100\t200\n", "a.txt: holds no labels"),
        ("a.csv", "start,end,label\n", "a.csv: holds no labels"),
        ("a.csv", "start,label\n1,speech\n", "a.csv:1: the first line must name the columns"),
        ("a.csv", "start,end,label,by\n", "a.csv:1: the first line must name the columns"),
        ("a.csv", "start,end,label\n1,2\n", "a.csv:2: has 2 fields, the first line names 3"),
        ("a.csv", 'start,end,label\n1,2,"a"b\n', "a.csv:2: is not CSV"),
        ("a.csv", "start,end,label\n1,9999-99-99,cry\n", "a.csv:2: '9999-99-99' is neither"),
        ("a.csv", "start,end,label\n1,2026,cry\n", "a.csv:2: cry lies outside of what mic"),
        (
            "a.csv",
            "start,end,label\n1999-01-01,1999-01-02,cry\n",
            "a.csv:2: cry lies outside of what mic heard",
        ),
        (
            "a.csv",
            "start,end,label,microphone\n1,2,cry,attic\n",
            "a.csv:2: no microphone 'attic' in the logs; there is mic",
        ),
    ],
)
def test_a_label_that_cannot_be_is_refused_with_its_line(logs, hearthlog, tmp_path, case):
    name, text, line = case
    labels = tmp_path / name
    labels.write_text(text)
    result = hearthlog("annotate", "import", logs, labels)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.startswith(f"hearthlog: {tmp_path}/{line}")
    assert result.stderr.count("\n") == 1
    assert layers(logs) == {}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"1\t2\tspeech\n3\t4\t\xff\n", ":2: is not UTF-8"),
        (b"\0" * (17 << 20), ": larger than 16 MB"),
        (None, ": no such label file"),
    ],
)
def test_a_file_that_is_no_label_file_is_refused(logs, hearthlog, tmp_path, content, reason):
    labels = tmp_path / "labels.txt"
    if content is not None:
        labels.write_bytes(content)
    result = hearthlog("annotate", "import", logs, labels)
    assert result.returncode == 1
    assert result.stderr.startswith(f"hearthlog: {labels}{reason}")


def test_labels_of_windows_and_of_spectral_selections_are_read(logs, hearthlog, tmp_path):
    labels = tmp_path / "labels.txt"
    labels.write_bytes(b"\xef\xbb\xbf1.5\t2.5\tspeech\r\n\\\t100.0\t4000.0\r\n")
    assert hearthlog("annotate", "import", logs, labels).returncode == 0
    log = find_logs(logs)[0]
    zero = find_heard(log)["mic"].starts[0]
    assert read_marks(log) == [mark(zero, 1.5, 2.5, "speech")]


@pytest.mark.parametrize("begins_late", [0.02, -0.02])
def test_logs_of_a_clock_that_drifts_have_one_border(hearthlog, tmp_path, begins_late):
    sound = tmp_path / "sound.wav"
    soundfile.write(sound, np.full(3 * 16_000, 0.1), 16_000)
    for second in (0, 3 + begins_late):
        start = f"2026-03-01T08:00:{second:06.3f}"
        hearthlog("record", sound, "-o", tmp_path / "logs", "--start", start)
    labels = tmp_path / "labels.txt"
    labels.write_text("1.0\t5.0\tspeech\n5.0\t5.5\tcoughing\n")
    assert hearthlog("annotate", "import", tmp_path / "logs", labels).returncode == 0
    heard = find_heard(tmp_path / "logs")["mic"]
    assert heard.starts[1] - heard.starts[0] == round((3 + begins_late) * SECOND)
    (before,), (after, _) = (read_marks(log) for log in heard.logs)
    assert before.end == after.start == heard.starts[1]
    assert after.end - before.start == 4 * SECOND


def test_where_nothing_was_recorded_nothing_can_be_marked(logs, hearthlog, tmp_path):
    heard = find_heard(logs)["mic"]
    assert len(heard.logs) > 2
    heard.logs[1].unlink()
    labels = tmp_path / "labels.txt"
    border = (heard.starts[1] - heard.starts[0]) / SECOND
    for start, end in ((border - 1, border + 1), (border + 1, border + 2)):
        labels.write_text(f"{start:.6f}\t{end:.6f}\tspeech\n")
        result = hearthlog("annotate", "import", logs, labels)
        assert (result.returncode, result.stderr.count("outside")) == (1, 1)
    assert layers(logs) == {}


def test_an_export_never_overwrites_and_needs_marks(logs, log, zero, hearthlog, tmp_path):
    output = tmp_path / "labels.txt"
    assert "no marks to export" in hearthlog("annotate", "export", logs, "-o", output).stderr
    assert not output.exists()
    write_marks(log, [mark(zero, 1, 2)])
    output.write_text("mine")
    result = hearthlog("annotate", "export", logs, "-o", output)
    assert (result.returncode, output.read_text()) == (1, "mine")
    assert "exists already" in result.stderr


def test_wrong_use_is_told_from_what_failed(logs, log, hearthlog, tmp_path):
    assert hearthlog("annotate", "import", logs, tmp_path / "a.doc").returncode == 2
    assert hearthlog("annotate", "export", logs, "-o", tmp_path / "a.doc").returncode == 2
    missing = tmp_path / "none.mcap"
    (tmp_path / "a.txt").write_text("1\t2\tspeech\n")
    result = hearthlog("annotate", "import", missing, tmp_path / "a.txt")
    assert (result.returncode, result.stderr) == (1, f"hearthlog: {missing}: no such log\n")
    write_marks(log, [mark(find_heard(log)["mic"].starts[0], 1, 2)])
    result = hearthlog("annotate", "import", review_path(log), tmp_path / "a.txt")
    assert "no features of a microphone; name a log" in result.stderr
    result = hearthlog("annotate", "export", logs, "-o", tmp_path / "b.txt", "--microphone", "x")
    assert "no microphone 'x'; there is mic" in result.stderr


@pytest.mark.parametrize(
    ("marks", "reason"),
    [
        ([(1, 3), (2, 4)], "overlap"),
        ([(2, 1)], "no span of time"),
        ([(1, 1)], "no span of time"),
    ],
)
def test_marks_that_cannot_be_are_not_written(log, zero, marks, reason):
    with pytest.raises(DataError, match=reason):
        write_marks(log, [mark(zero, *span) for span in marks])
    with pytest.raises(DataError, match="name of a class"):
        write_marks(log, [mark(zero, 1, 2, "Loud music")])
    assert not review_path(log).exists()


@pytest.mark.parametrize("damage", ["cut off", "changed"])
def test_a_damaged_layer_is_named_and_left_alone(log, zero, damage):
    layer = write_marks(log, [mark(zero, start / 10, start / 10 + 0.1) for start in range(99)])
    damaged = layer.read_bytes()
    if damage == "cut off":
        damaged = damaged[:-30]
    else:
        with LogFile(layer) as file:
            place = int(file.chunks["offset"][0]) + 33  # the checksum
        damaged = damaged[:place] + bytes([damaged[place] ^ 1]) + damaged[place + 1 :]
    layer.write_bytes(damaged)
    with pytest.raises(LogError, match=r"review\.mcap"):
        write_marks(log, [mark(zero, 3, 4)])
    assert layer.read_bytes() == damaged


@pytest.mark.parametrize(
    ("topic", "label", "reason"),
    [
        ("/mic/review/segment", "speech", "speech and speech overlap"),
        ("/mic/review/segment", "Loud\n", "cannot be the name of a class"),
        ("/M!c/review/segment", "speech", "microphone name 'M!c' cannot be a topic"),
        ("/mic/segment", "speech", "is no review layer: it has a topic '/mic/segment'"),
    ],
)
def test_a_layer_that_somebody_else_wrote_badly_is_refused(tmp_path, topic, label, reason):
    fields = {"duration": duration_message(2 * SECOND), "label": label, "confidence": 1.0}
    segments = [
        (start * SECOND, message(SEGMENT, header=header(start * SECOND, "mic"), **fields))
        for start in (5, 6)
    ]
    layer = write_log(tmp_path / "a.review.mcap", {topic: segments})
    with pytest.raises(LogError) as refused:
        read_marks(tmp_path / "a.mcap")
    assert str(refused.value).startswith(f"{layer}: ")
    assert reason in str(refused.value)
    assert "\n" not in str(refused.value)


def test_on_a_full_disk_the_old_layer_stays(log, zero, tmp_path):
    with small_disk(tmp_path / "disk", "2m") as disk:
        moved = Path(shutil.copy(log, disk))
        layer = write_marks(moved, [mark(zero, 1, 2)])
        before = layer.read_bytes()
        with (disk / "rest").open("wb", buffering=0) as rest, suppress(OSError):
            while True:
                rest.write(bytes(4096))
        with pytest.raises(LogError, match="cannot be written"):
            write_marks(moved, [mark(zero, start / 10, start / 10 + 0.1) for start in range(99)])
        assert layer.read_bytes() == before
        assert sorted(path.name for path in disk.iterdir()) == sorted(
            [moved.name, layer.name, "rest"]
        )


_PIECES = st.sampled_from(
    [
        "1.5",
        "\t",
        ",",
        "\n",
        "2",
        "speech",
        "start,end,label\n",
        '"',
        "\r",
        "1e99",
        "-",
        "\x00",
        "\\",
        "\ufeff",
        "2026-03-01T07:00:00.123456789Z",
        "0001-01-01T00:00+23:59",
    ]
).map(str.encode)


@given(
    parts=st.lists(_PIECES | st.binary(max_size=8), max_size=30), suffix=st.sampled_from(SUFFIXES)
)
@settings(deadline=None)
def test_whatever_is_in_a_label_file_it_is_read_or_refused_in_one_line(
    tmp_path_factory, parts, suffix
):
    path = tmp_path_factory.mktemp("labels") / f"labels{suffix}"
    path.write_bytes(b"".join(parts))
    refused = ""
    try:
        read_labels(path, {"mic": Heard([path], [SECOND], [9 * SECOND])})
    except DataError as error:
        refused = str(error)
    assert "\n" not in refused
