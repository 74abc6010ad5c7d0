"""What a reviewer marked stands beside the log, and goes to label files and back unchanged."""

import getpass
import shutil
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_fixtures import run, small_disk, write_log
from logreader import LogReader

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import ROUNDING, find_coverage
from hearthlog.analyzer.marks.formats import FORMATS
from hearthlog.analyzer.marks.marks import (
    LATEST,
    QUEUE,
    RANDOM,
    Mark,
    MarkedSpan,
    ReviewedSpan,
    read_marks,
    read_reviewed,
    write_marks,
)
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs, review_path
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.message_types import SEGMENT, duration_message, header, message

SECOND = NANOSECONDS
NAMES = [f"again{form.suffix}" for form in FORMATS]
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
    return find_coverage(log)["mic"].starts[0]


def mark(zero, start, end, label="coughing"):
    return Mark("mic", zero + round(start * SECOND), zero + round(end * SECOND), label)


def segment(start, duration, label):
    fields = {"duration": duration_message(duration), "label": label, "confidence": 1.0}
    return message(SEGMENT, header=header(start, "mic"), **fields)


def all_marks(logs):
    recorded = [path for path in find_logs(logs) if not path.name.endswith(".review.mcap")]
    return [mark for path in recorded for mark in read_marks(path)]


def layers(logs):
    return {path.name: path.read_bytes() for path in logs.rglob("*.review.mcap")}


def test_exported_labels_come_back_as_marks_of_every_log(logs, hearthlog, tmp_path):
    labels = tmp_path / "day.txt"
    assert hearthlog("export", logs, "-o", labels).returncode == 0
    result = hearthlog("annotate", "import", logs, labels)
    assert (result.returncode, result.stderr.count("\n")) == (0, 1)
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


@pytest.mark.parametrize("name", NAMES)
def test_import_export_import_gives_the_same_layers_byte_for_byte(logs, hearthlog, tmp_path, name):
    labels, again = tmp_path / "day.txt", tmp_path / name
    hearthlog("export", logs, "-o", labels)
    hearthlog("annotate", "import", logs, labels, "--reviewer", "Ann O'Neil, RN")
    first, marks = layers(logs), all_marks(logs)
    assert {mark.reviewer for mark in marks} == {"Ann O'Neil, RN"}
    assert hearthlog("annotate", "export", logs, "-o", again).stdout == f"{again}\n"
    result = hearthlog("annotate", "import", logs, again, "--reviewer", "Bob")
    assert result == (0, "", f"hearthlog: {len(marks)} marks existed already\n")
    assert layers(logs) == first
    for path in logs.rglob("*.review.mcap"):
        path.unlink()
    assert hearthlog("annotate", "import", logs, again, "--reviewer", "Bob").returncode == 0
    if again.suffix in {".csv", ".eaf", ".json"} or again.name.endswith(".selections.txt"):
        assert layers(logs) == first
    else:
        assert [mark[:4] for mark in all_marks(logs)] == [mark[:4] for mark in marks]
        assert {mark.reviewer for mark in all_marks(logs)} == {"Bob"}


def test_a_label_file_that_does_not_say_who_labelled_is_yours(log, hearthlog, tmp_path):
    labels = tmp_path / "labels.csv"
    labels.write_text("start,end,label,reviewer,made\n1,2,speech,,\n3,4,speech,Ann,2026-03-02\n")
    before = time.time_ns()
    done = hearthlog("annotate", "import", log, labels)
    assert done.returncode == 0
    assert (
        "next: a model of this home, from these (keep recording: the check needs ten" in done.stderr
    )
    assert f"hearthlog train --home {log}\n" in done.stderr
    mine, hers = read_marks(log)
    assert mine.reviewer == getpass.getuser()
    assert before <= mine.made <= time.time_ns()
    assert (hers.reviewer, hers.made) == ("Ann", 1_772_409_600 * SECOND)
    for name in (" ", "two\nlines", "x" * 201, "\udc80"):
        assert hearthlog("annotate", "import", log, labels, "--reviewer", name).returncode == 2


def test_what_a_file_cannot_say_of_a_mark_is_not_lost_and_what_it_changes_is_taken(
    log, zero, hearthlog, tmp_path
):
    printed = {"reviewer": "Ann", "made": 5 * SECOND, "corrects": "live"}
    write_marks(
        log, [mark(zero, 1.0000004, 2)._replace(**printed), mark(zero, 3, 4)._replace(**printed)]
    )
    labels = tmp_path / "labels.txt"
    labels.write_text("1.000000\t2.000000\tcoughing\n3.0\t4.0\tspeech\n")
    result = hearthlog("annotate", "import", log, labels, "--reviewer", "Bob")
    assert result.stdout.splitlines()[1:] == ["speech  1 mark, 1.00 s"]
    assert result.stderr.startswith("hearthlog: 1 mark existed already\n")
    same, changed = read_marks(log)
    assert same == mark(zero, 1.0000004, 2)._replace(**printed)
    assert (changed.label, changed.reviewer) == ("speech", "Bob")


def test_a_label_that_crosses_into_the_next_log_is_split_there(logs, hearthlog, tmp_path):
    labelled = find_coverage(logs)["mic"]
    border = (labelled.starts[1] - labelled.starts[0]) / SECOND
    labels = tmp_path / "labels.csv"
    labels.write_text(f"start,end,label\n{border - 2:.3f},{border + 3:.3f},speech\n")
    assert hearthlog("annotate", "import", logs, labels).stdout.endswith("2 marks, 5.00 s\n")
    (before,), (after,) = (read_marks(path) for path in labelled.logs[:2])
    assert before.end == after.start == labelled.starts[1]
    assert after.end - before.start == pytest.approx(5 * SECOND, abs=ROUNDING)


def test_a_layer_is_a_log_that_says_what_made_it_and_doctor_is_content(logs, log, zero, hearthlog):
    before = hearthlog("doctor", logs).stdout.splitlines()[:-1]
    printed = mark(zero, 1, 2)._replace(reviewer="Ann", made=5 * SECOND, corrects="live")
    layer = write_marks(log, [printed, mark(zero, 0.5, 1, "speech")])
    assert layer == review_path(log)
    reader = LogReader(layer)
    by_topic = {}
    for item in reader.messages():
        by_topic.setdefault(item.topic, []).append((item.log_time - zero, item.decode()))
    assert sorted(by_topic) == ["/mic/review/mark", "/mic/review/segment"]
    for messages in by_topic.values():
        assert [time for time, _ in messages] == [SECOND, 2 * SECOND]
        assert [message.label for _, message in messages] == ["speech", "coughing"]
        assert {message.header.frame_id for _, message in messages} == {"mic"}
    assert {message.confidence for _, message in by_topic["/mic/review/segment"]} == {1}
    printed = [(m.reviewer, m.made.sec, m.corrects) for _, m in by_topic["/mic/review/mark"]]
    assert printed == [("", 0, ""), ("Ann", 5, "live")]
    about = reader.metadata["hearthlog"]
    assert (about["node"], about["log"]) == ("home", log.name)
    assert about["version"]
    assert hearthlog("doctor", logs).stdout.splitlines()[:-1] == before
    assert hearthlog("doctor", layer).returncode == 0
    info = hearthlog("info", layer)
    assert info.returncode == 0
    assert f"layer: {layer}" in info.stdout
    assert f"layer: {layer}" in hearthlog("info", logs, "--verbose").stdout


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


def test_marks_say_who_made_them_when_and_what_they_correct(log, zero):
    marks = [
        mark(zero, 1, 2)._replace(reviewer="Ann", made=SECOND + 1, corrects="live"),
        mark(zero, 2, 3),
        mark(zero, 3, 9)._replace(reviewer="Zoë " + 196 * "\N{OLD PERSONAL COMPUTER}", made=LATEST),
    ]
    write_marks(log, marks)
    assert read_marks(log) == marks
    write_marks(log, [mark(zero, 4, 5)._replace(reviewer="Bob")])
    cut = [m for m in read_marks(log) if m.start >= zero + 3 * SECOND]
    assert [m.reviewer[:3] for m in cut] == ["Zoë", "Bob", "Zoë"]
    assert [m.made for m in cut] == [LATEST, 0, LATEST]


def test_marks_are_deleted_where_that_is_said_and_cut_around_it(log, zero):
    printed = {"reviewer": "Ann", "made": SECOND, "corrects": "live"}
    old = [mark(zero, 1, 4)._replace(**printed), mark(zero, 5, 6), mark(zero, 7, 8)]
    write_marks(log, old)
    gaps = [MarkedSpan(*mark(zero, *times)[:3]) for times in ((2, 3), (5, 7))]
    write_marks(log, [mark(zero, 5.5, 5.6, "speech")], gaps)
    assert read_marks(log) == [
        mark(zero, 1, 2)._replace(**printed),
        mark(zero, 3, 4)._replace(**printed),
        mark(zero, 5.5, 5.6, "speech"),
        mark(zero, 7, 8),
    ]
    layer = write_marks(log, [], [MarkedSpan("mic", zero, zero + 9 * SECOND)])
    assert not layer.exists()


def looked_at(zero, start, end, **printed):
    return ReviewedSpan("mic", zero + start * SECOND, zero + end * SECOND, **printed)


def test_a_layer_keeps_what_was_looked_at_beside_the_marks(log, zero):
    minute = looked_at(zero, 0, 60, reviewer="Ann", made=5 * SECOND, chosen=RANDOM)
    span = looked_at(zero, 10, 12, corrects="other", chosen=QUEUE)
    write_marks(log, [mark(zero, 1, 2)], reviewed=[minute])
    write_marks(log, [], reviewed=[span, minute])
    assert read_reviewed(log) == [minute, span]
    write_marks(log, [], [MarkedSpan("mic", zero, zero + 9 * SECOND)])
    assert (read_marks(log), read_reviewed(log)) == ([], [minute, span])
    layer = write_marks(log, [], not_reviewed=[minute])
    assert read_reviewed(log) == [span]
    write_marks(log, [mark(zero, 3, 4)], not_reviewed=[span])
    assert (read_marks(log), read_reviewed(log)) == ([mark(zero, 3, 4)], [])
    write_marks(log, [], [MarkedSpan("mic", zero, zero + 9 * SECOND)])
    assert not layer.exists()


def test_a_layer_that_goes_while_it_is_read_is_none(log, zero):
    done = threading.Event()

    def come_and_go():
        while not done.is_set():
            write_marks(log, [mark(zero, 1, 2)])
            write_marks(log, [], [MarkedSpan("mic", zero, zero + 9 * SECOND)])

    writer = threading.Thread(target=come_and_go)
    writer.start()
    try:
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            assert read_marks(log) in ([], [mark(zero, 1, 2)])
    finally:
        done.set()
        writer.join()


@pytest.mark.parametrize(
    "wrong",
    [{"start": 9, "end": 9}, {"chosen": "by chance"}, {"reviewer": "a\nb"}, {"made": -1}],
)
def test_a_reviewed_span_that_is_none_is_refused(log, zero, wrong):
    with pytest.raises(DataError, match=r"review"):
        write_marks(log, [], reviewed=[looked_at(zero, 1, 2)._replace(**wrong)])
    assert not review_path(log).exists()


def test_a_layer_in_which_nothing_is_marked_is_a_layer(logs, log, zero, hearthlog, tmp_path):
    layer = write_marks(log, [], reviewed=[looked_at(zero, 0, 60, chosen=RANDOM)])
    assert hearthlog("doctor", layer).returncode == 0
    assert "/mic/review/reviewed" in hearthlog("info", layer, "--json").stdout
    assert f"layer: {layer}" in hearthlog("info", logs, "--verbose").stdout
    assert "corrects=live chosen=random" in hearthlog("cat", layer).stdout
    none = hearthlog("diff", logs, "live", "review")
    assert (none.returncode, none.stderr.count("\n")) == (1, 1)
    none = hearthlog("annotate", "export", logs, "-o", tmp_path / "none.csv")
    assert (none.returncode, none.stderr.count("\n")) == (1, 1)
    assert "Traceback" not in hearthlog("catalog", logs).stderr


def test_a_layer_from_before_marks_said_who_made_them_is_read(log, zero):
    segments = [
        (zero + end * SECOND, segment(zero + (end - 1) * SECOND, SECOND, "speech"))
        for end in (2, 4)
    ]
    write_log(review_path(log), {"/mic/review/segment": segments})
    assert read_marks(log) == [mark(zero, 1, 2, "speech"), mark(zero, 3, 4, "speech")]
    new = mark(zero, 3.5, 5)._replace(reviewer="Ann")
    write_marks(log, [new])
    assert read_marks(log) == [mark(zero, 1, 2, "speech"), mark(zero, 3, 3.5, "speech"), new]


def test_of_two_processes_that_mark_at_once_nothing_is_lost(log, zero):
    code = (
        "import sys; from pathlib import Path\n"
        "from hearthlog.analyzer.marks.marks import Mark, write_marks\n"
        "log, first = Path(sys.argv[1]), int(sys.argv[2])\n"
        "for start in range(first, first + 12 * 10**8, 10**8):\n"
        "    write_marks(log, [Mark('mic', start, start + 10**7, 'cry')])"
    )
    starts = [zero, zero + 5 * 10**7]
    started = [
        subprocess.Popen([sys.executable, "-c", code, str(log), str(start)]) for start in starts
    ]
    assert [process.wait(60) for process in started] == [0, 0]
    assert len(read_marks(log)) == 24


def test_what_rounding_leaves_of_an_old_mark_is_gone(log, zero):
    old = mark(zero, 1, 2)
    write_marks(log, [old])
    new = old._replace(start=old.start + ROUNDING, end=old.end - ROUNDING, label="speech")
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
    labelled = find_coverage(tmp_path / "logs")["mic"]
    assert labelled.starts[1] - labelled.starts[0] == round((3 + begins_late) * SECOND)
    (before,), (after, _) = (read_marks(log) for log in labelled.logs)
    assert before.end == after.start == labelled.starts[1]
    assert after.end - before.start == 4 * SECOND


def test_where_nothing_was_recorded_nothing_can_be_marked(logs, hearthlog, tmp_path):
    labelled = find_coverage(logs)["mic"]
    assert len(labelled.logs) > 2
    labelled.logs[1].unlink()
    labels = tmp_path / "labels.txt"
    border = (labelled.starts[1] - labelled.starts[0]) / SECOND
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
    write_marks(log, [mark(find_coverage(log)["mic"].starts[0], 1, 2)])
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
    good = mark(zero, 1, 2)
    for wrong in (
        good._replace(reviewer="two\nlines"),
        good._replace(corrects="x" * 201),
        good._replace(reviewer="\ud800"),
        good._replace(made=-1),
        good._replace(made=LATEST + 1),
        good._replace(made=1 << 80),
        good._replace(end=LATEST + 1),
        good._replace(start=-1),
    ):
        with pytest.raises(DataError, match=r"cannot be made|no span of time"):
            write_marks(log, [wrong])
    with pytest.raises(LogError, match="cannot be a topic"):
        write_marks(log, [good._replace(microphone="../mic")])
    assert not review_path(log).exists()


@pytest.mark.parametrize("damage", ["cut off", "cut off at once", "changed"])
def test_a_damaged_layer_is_named_and_left_alone(log, zero, damage):
    layer = write_marks(log, [mark(zero, start / 10, start / 10 + 0.1) for start in range(99)])
    damaged = layer.read_bytes()
    if damage == "cut off":
        damaged = damaged[:-30]
    elif damage == "cut off at once":
        damaged = damaged[:100]
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
        ("/M!c/review/segment", "speech", "is no review layer: it has a topic '/M!c/review"),
        ("/mic/segment", "speech", "is no review layer: it has a topic '/mic/segment'"),
    ],
)
def test_a_layer_that_somebody_else_wrote_badly_is_refused(tmp_path, topic, label, reason):
    segments = [(start * SECOND, segment(start * SECOND, 2 * SECOND, label)) for start in (5, 6)]
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
