"""Logs are copied to other times: all else in them stays, and every command takes them as real."""

import shutil
import subprocess
import sys
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from mcap.reader import make_reader

from hearthlog.analyzer.marks.marks import Mark, read_marks, write_marks
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import active_path, find_logs, is_layer
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.salvage.recover import thin_log
from hearthlog.tools.lab.home.copies import copy_logs

START = 1_772_323_200 * NANOSECONDS  # midnight
MINUTE = 60
MODEL = starter_file(GENERAL)
MOVED = {"header.stamp", "stamp", "made"}


@pytest.fixture(scope="module")
def recording(day, tmp_path_factory):
    """Three logs of a minute, of one recording."""
    folder = tmp_path_factory.mktemp("recording")
    record(
        Settings(output=folder, model=MODEL, max_bag_duration=MINUTE),
        FileSource([day], START),
        Flag(),
    )
    return folder


@pytest.fixture(scope="module")
def relabelled(recording, tmp_path_factory):
    folder = Path(shutil.copytree(recording, tmp_path_factory.mktemp("relabelled") / "logs"))
    command = [sys.executable, "-m", "hearthlog.tools.cli.main", "relabel", folder]
    subprocess.run([*command, "--model", MODEL], check=True, capture_output=True)
    return folder


def frames_of(log):
    return read_columns([log], ["/mic/features"])["/mic/features"]["frame"]


def logs_in(folder):
    return [path for path in find_logs(folder) if not is_layer(path)]


def part(folder, place, numbers):
    """Some of the logs of a folder, and their layers."""
    for log in [logs_in(folder)[number] for number in numbers]:
        for path in log.parent.glob(f"{log.name.removesuffix('.mcap')}.*"):
            other = place / path.relative_to(folder)
            other.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, other)
    return place


def segments(folder):
    read = read_columns(logs_in(folder), ["/mic/segment"])["/mic/segment"]
    return read["header.stamp"], read["header.stamp"] + read["duration"]


def test_logs_that_were_thinned_to_their_labels_are_copied(recording, tmp_path):
    thinned = tmp_path / "thinned"
    for log in logs_in(recording):
        copy = thinned / log.relative_to(recording)
        copy.parent.mkdir(parents=True, exist_ok=True)
        thin_log(log, copy, 3)
    copy_logs(thinned, tmp_path / "month", 2, 3 * MINUTE)
    before, after = (segments(folder)[0] for folder in (thinned, tmp_path / "month"))
    assert after.tolist() == [*before, *(before + 3 * MINUTE * NANOSECONDS)]


def is_sound(capfd, folder):
    done = run(capfd, "doctor", folder)
    assert done.returncode == 0, done.stderr + done.stdout
    return True


def test_copies_are_equal_but_for_time_and_frame(relabelled, tmp_path, capfd):
    write_marks(logs_in(relabelled)[0], [Mark("mic", START, START + 10**9, "speech", made=START)])
    copy_logs(relabelled, tmp_path / "logs", 3, 3 * MINUTE)
    originals, copies = find_logs(relabelled), find_logs(tmp_path / "logs")
    assert len(copies) == 3 * len(originals) == 21
    shifts = {log: number * 180 for number in range(3) for log in logs_in(relabelled)}
    assert len(shifts) == 3
    names = [f"home_20260301T000{minute}00Z.mcap" for minute in range(9)]
    assert [log.name for log in logs_in(tmp_path / "logs")] == names
    for number in range(3):
        for log in originals:
            minute = int(log.name[16:18]) + 3 * number
            copy = tmp_path / "logs/2026/03/01" / (log.name[:16] + f"{minute:02}" + log.name[18:])
            is_moved(log, copy, 180 * number)
    marks = [mark for log in logs_in(tmp_path / "logs") for mark in read_marks(log)]
    assert [(m.start, m.made) for m in marks] == [
        (START + i * 180 * NANOSECONDS,) * 2 for i in range(3)
    ]
    is_sound(capfd, tmp_path / "logs")


def is_moved(log, copy, seconds):
    """The copy holds what the log does, at times that are so many seconds later."""
    time, frames = seconds * NANOSECONDS, seconds * 20
    with log.open("rb") as one, copy.open("rb") as other:
        pairs = zip(
            make_reader(one).iter_messages(), make_reader(other).iter_messages(), strict=True
        )
        for (_, channel, message), (_, same, moved) in pairs:
            assert (channel.topic, channel.metadata) == (same.topic, same.metadata)
            assert moved.log_time == message.log_time + time
            assert moved.publish_time == message.publish_time + time
            assert moved.sequence == message.sequence
    before, after = read_columns([log]), read_columns([copy])
    assert before.keys() == after.keys()
    for topic, columns in before.items():
        for name, values in columns.fields.items():
            by = time if name in MOVED else frames if name == "frame" else 0
            expected = values + values.dtype.type(by) if by else values
            assert np.array_equal(
                after[topic][name], expected, equal_nan=values.dtype == np.float32
            )
    with LogFile(log) as one, LogFile(copy) as other:
        assert len(one.chunks) == len(other.chunks)


def test_a_copy_that_is_not_moved_is_the_log_byte_for_byte(recording, tmp_path):
    copy_logs(recording, tmp_path / "logs", 1)
    for log in find_logs(recording):
        assert (tmp_path / "logs" / log.relative_to(recording)).read_bytes() == log.read_bytes()


def test_frames_go_on_from_copy_to_copy_and_layers_are_current(relabelled, tmp_path, capfd):
    copy_logs(relabelled, tmp_path / "logs", 2, 3 * MINUTE)
    frames = np.concatenate([frames_of(log) for log in logs_in(tmp_path / "logs")])
    assert np.array_equal(frames, np.arange(2 * 3600))
    done = run(capfd, "relabel", tmp_path / "logs", "--model", MODEL)
    assert done.returncode == 0, done.stderr
    assert "6 layers there already" in done.stdout + done.stderr


def test_logs_from_the_middle_of_a_recording_leave_no_segment_twice(relabelled, tmp_path, capfd):
    middle = part(relabelled, tmp_path / "middle", (2,))
    first, _ = segments(middle)
    assert first[0] < START + 2 * MINUTE * NANOSECONDS  # it began in the log before
    copy_logs(middle, tmp_path / "logs", 3, MINUTE)
    starts, ends = segments(tmp_path / "logs")
    assert len(starts) == 3 * len(first)
    assert (starts[1:] >= ends[:-1]).all()
    assert (ends > starts).all()
    is_sound(capfd, tmp_path / "logs")
    done = run(capfd, "relabel", tmp_path / "logs", "--model", MODEL)
    assert "3 layers there already" in done.stdout + done.stderr


def test_a_log_that_begins_behind_two_segments_leaves_none_of_them_twice(
    recording, day, tmp_path, capfd
):
    # The last minute of a recording, which begins behind the end of a segment decided in it.
    known = read_columns(logs_in(recording)[:2], ["/mic/segment"])["/mic/segment"]
    ends = known["header.stamp"] + known["duration"]
    is_late = known.log_times - ends > NANOSECONDS // 2
    begins = int(ends[1:][is_late[1:]][0]) + NANOSECONDS // 10 - START
    samples, rate = soundfile.read(day)
    cut = tmp_path / "cut.wav"
    soundfile.write(cut, samples[: (begins + MINUTE * NANOSECONDS) * rate // NANOSECONDS], rate)
    earlier = START - begins % (MINUTE * NANOSECONDS)
    settings = Settings(output=tmp_path / "other", model=MODEL, max_bag_duration=MINUTE)
    record(settings, FileSource([cut], earlier), Flag())
    middle = part(tmp_path / "other", tmp_path / "middle", (-1,))
    starts, ends = segments(middle)
    first = earlier + begins
    assert ends[0] < first
    assert starts[1] < first
    copy_logs(middle, tmp_path / "logs", 3, MINUTE)
    of_copies = segments(tmp_path / "logs")
    assert len(of_copies[0]) == len(starts) + 2 * (ends > first).sum()
    assert (of_copies[0][1:] >= of_copies[1][:-1]).all()
    assert (of_copies[1] > of_copies[0]).all()
    is_sound(capfd, tmp_path / "logs")


def test_where_a_recorder_begins_every_copy_does(recording, tmp_path, capfd):
    copy_logs(recording, tmp_path / "logs", 3)
    logs = logs_in(tmp_path / "logs")
    assert [log.parent.name for log in logs] == ["01"] * 3 + ["02"] * 3 + ["03"] * 3
    assert [int(frames_of(log)[0]) for log in logs] == [0, 1200, 2400] * 3
    is_sound(capfd, tmp_path / "logs")


def test_layers_of_logs_that_were_thinned_are_current_too(relabelled, tmp_path, capfd):
    logs = Path(shutil.copytree(relabelled, tmp_path / "thinned"))
    for log in logs_in(logs):
        thin_log(log, tmp_path / "thin.mcap", 1)
        shutil.move(tmp_path / "thin.mcap", log)
    copy_logs(logs, tmp_path / "logs", 2, 3 * MINUTE)
    is_sound(capfd, tmp_path / "logs")
    done = run(capfd, "relabel", tmp_path / "logs", "--model", MODEL)
    assert "6 layers there already" in done.stdout + done.stderr


def test_an_unfinished_log_stays_unfinished(recording, tmp_path):
    logs = part(recording, tmp_path / "one", (0,))
    (log,) = logs_in(logs)
    full = log.read_bytes()
    log.unlink()
    with LogFile(logs_in(recording)[0]) as file:
        last = file.chunks[-1]
    active_path(log).write_bytes(full[: last["offset"] + last["length"] + last["index_length"]])
    copy_logs(logs, tmp_path / "logs", 2, MINUTE)
    first, second = find_logs(tmp_path / "logs")
    assert second.name == "home_20260301T000100Z.mcap.active"
    assert first.read_bytes() == active_path(log).read_bytes()
    assert np.array_equal(frames_of(second), frames_of(first) + 1200)


def test_what_cannot_be_copied_is_refused_in_one_line(recording, tmp_path):
    hole = part(recording, tmp_path / "hole", (1,))
    with pytest.raises(LogError, match="begins with frame 1200, so that a copy goes on from frame"):
        copy_logs(hole, tmp_path / "logs", 2, 2 * MINUTE)
    with pytest.raises(LogError, match="these logs span more than 120 s"):
        copy_logs(recording, tmp_path / "logs", 2, 2 * MINUTE)
    named = tmp_path / "named"
    named.mkdir()
    shutil.copy(logs_in(recording)[0], named / "hour.mcap")
    with pytest.raises(LogError, match="has no time in its name"):
        copy_logs(named, tmp_path / "logs", 2)
    damaged = part(recording, tmp_path / "damaged", (0, 1, 2))
    log = logs_in(damaged)[1]
    content = bytearray(log.read_bytes())
    with LogFile(log) as file:
        content[file.chunks["offset"][1] + 100] ^= 1
    log.write_bytes(content)
    with pytest.raises(LogError, match="is damaged, and not copied"):
        copy_logs(damaged, tmp_path / "broken", 2)
    assert not (tmp_path / "broken").exists()
    with pytest.raises(LogError, match="is one file; name the folder"):
        copy_logs(log, tmp_path / "broken", 2)
    done = subprocess.run(
        [sys.executable, "-m", "hearthlog.tools.lab.home.copies", recording, "2", "-o", tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == f"hearthlog: {tmp_path}: exists already; name a new folder\n"


def test_the_command_says_what_it_has_written(recording, tmp_path, capfd):
    command = [sys.executable, "-m", "hearthlog.tools.lab.home.copies", recording, "2"]
    done = subprocess.run(
        [*command, "-o", tmp_path / "logs"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"6 files in {tmp_path / 'logs'}\n"
    assert run(capfd, "info", tmp_path / "logs").returncode == 0
    assert run(capfd, "catalog", tmp_path / "logs").returncode == 0
    page = run(
        capfd, "report", tmp_path / "logs", "--day", "2026-03-02", "-o", tmp_path / "day.html"
    )
    assert page.returncode == 0, page.stderr
