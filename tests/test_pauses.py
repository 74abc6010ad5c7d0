"""Quiet hours and pauses: the microphone is closed, and the log says why nobody was listened to."""

import os
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from conftest import FRESH_HEARTHLOG, HEARTHLOG
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run
from logs import features, read
from test_capture import wait_for_frames
from test_model_changes import wait_for

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.recorder.pause_schedule import (
    PauseSchedule,
    pause,
    paused_until,
    quiet_hours,
    resume,
)
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.logs.files import find_logs


@contextmanager
def recording(labmic, logs, **configured):
    """Record labmic, with more keys; at the end the process is asked to stop."""
    file = logs.with_suffix(".toml")
    lines = {"output": str(logs), "model": "none", **configured}
    file.write_text("".join(f"{key} = {value!r}\n" for key, value in lines.items()))
    with file.open("a") as more:
        more.write("[[microphone]]\ndevice = 'labmic'\n")
    command = [*FRESH_HEARTHLOG, "record", "--config", str(file)]
    with subprocess.Popen(command, env=labmic.env, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
            process.terminate()
            _, process.errors = process.communicate(timeout=60)
        finally:
            process.kill()


def captures(process):
    """The processes that capture sound for a recorder."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    lines = [Path(f"/proc/{child}/cmdline").read_bytes() for child in children]
    return [line for line in lines if b"sources.capture" in line]


def health(logs):
    return [status.message for each in read(logs, "diagnostics") for status in each.status]


def hearthlog(*arguments):
    return subprocess.run([*HEARTHLOG, *map(str, arguments)], check=False, capture_output=True,
                          text=True)  # fmt: skip


def test_a_pause_closes_the_microphone_and_is_a_gap(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 30)
        paused = hearthlog("pause", logs, "--for", "2h")
        assert (paused.returncode, paused.stderr) == (0, "")
        wait_for(lambda: not captures(process))
        wait_for(lambda: any(text.startswith("paused until ") for text in health(logs)))
        before = len(features(logs)[0])
        assert hearthlog("resume", logs).stdout == f"{logs}: recording again\n"
        wait_for_frames(logs, before + 30)
    assert process.returncode == 0, "it was not lost, so all is well"
    [gap] = read(logs, "gap")
    assert gap.reason == "paused"
    assert gap.frames_lost > 10
    assert [finding for each in examine(logs) for finding in each.shown] == []
    assert hearthlog("resume", logs).stdout == f"{logs}: was not paused\n"


def test_in_quiet_hours_the_microphone_is_never_opened(labmic, tmp_path):
    logs = tmp_path / "logs"
    now = datetime.now(UTC)
    hours = f"{now - timedelta(hours=1):%H:%M}-{now + timedelta(hours=1):%H:%M}"
    with recording(labmic, logs, quiet_hours=[hours], timezone="UTC") as process:
        end = f"{now + timedelta(hours=1):%H:%M}"
        wait_for(lambda: f"quiet hours until {end}: the microphone is closed" in health(logs))
        assert captures(process) == []
    assert (process.returncode, process.errors) == (0, "")
    assert len(features(logs)[0]) == 0


def test_a_recorder_that_starts_in_a_pause_waits_and_says_so_in_the_gap(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 20)
    pause(logs, None)
    with recording(labmic, logs) as process:
        wait_for(lambda: "paused until hearthlog resume: the microphone is closed" in health(logs))
        assert captures(process) == []
        resume(logs)
        wait_for_frames(logs, 40)
    [gap] = read(logs, "gap")
    assert gap.reason == "the recorder was not running; paused"
    assert [finding.level for each in examine(logs) for finding in each.shown] == ["warning"]


@pytest.mark.parametrize("text", ["22-6", "24:00-06:00", "22:00-06:60", "22:00", "", "x" * 999])
def test_what_are_no_hours_is_refused(text):
    with pytest.raises(
        ConfigurationError, match=r"is not a span of hours; write it as 22:00-06:30$"
    ):
        quiet_hours(text)


MINUTES = st.integers(0, 24 * 60 - 1)


@given(MINUTES, MINUTES, MINUTES)
def test_quiet_hours_last_from_their_start_to_their_end_over_midnight_too(start, end, minute):
    text = f"{start // 60:02}:{start % 60:02}-{end // 60:02}:{end % 60:02}"
    left = quiet_hours(text).minutes_left(minute)
    if start < end:
        assert (left > 0) == (start <= minute < end)
    else:
        assert (left > 0) == (minute >= start or minute < end)
    if left:
        assert (minute + left) % (24 * 60) == end


def test_a_pause_follows_no_link_and_belongs_to_whom_the_folder_belongs_to(tmp_path):
    other, logs = tmp_path / "other", tmp_path / "logs"
    other.write_text("1")
    logs.mkdir()
    for name in (".pause", ".pause.new", ".pause.tmp"):
        (logs / name).symlink_to(other)
    if os.geteuid() == 0:
        os.chown(logs, 12345, 12345)
    pause(logs, timedelta(hours=1), "Anna")
    assert other.read_text() == "1"
    assert not (logs / ".pause").is_symlink()
    assert (logs / ".pause").stat().st_uid == logs.stat().st_uid
    assert PauseSchedule([], UTC, logs).describe().startswith("paused by Anna until ")


def test_a_pause_ends_by_itself(tmp_path):
    rest = PauseSchedule([], UTC, tmp_path)
    pause(tmp_path, timedelta(seconds=5))
    assert rest.reason() == "paused"
    wait_for(lambda: rest.reason() == "")


@pytest.mark.parametrize("content", [b"", b"tomorrow", b"\xff" * 100, b"9" * 64, b"-" * 64])
def test_a_pause_file_that_cannot_be_read_pauses(tmp_path, content):
    (tmp_path / ".pause").write_bytes(content)
    assert PauseSchedule([], UTC, tmp_path).reason() == "paused"
    assert PauseSchedule([], UTC, tmp_path).describe().startswith("paused until ")


def test_a_pause_whose_end_nobody_lives_to_see_has_none(tmp_path):
    (tmp_path / ".pause").write_text("9" * 400)
    assert paused_until(tmp_path) is None


def test_a_pipe_in_place_of_the_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / ".pause")
    assert paused_until(tmp_path) is None
    assert PauseSchedule([], UTC, tmp_path).reason() == "paused"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["pause", "nowhere"], "nowhere: no such folder; name the folder that the recorder"),
        (["resume", "nowhere"], "nowhere: no such folder; name the folder that the recorder"),
        (["pause", ".", "--for", "soon"], "--for soon: not a duration such as 30m, 2h or 1d"),
        (["pause", ".", "--for", "0h"], "--for 0h: must be more than zero and at most a year"),
        (["pause", ".", "--for", "999999d"], "--for 999999d: must be more than zero and at most a"),
    ],
)
def test_a_pause_that_makes_no_sense(arguments, words):
    result = hearthlog(*arguments)
    assert result.returncode == 2
    assert result.stderr.startswith(f"hearthlog: {words}")


def test_a_new_configuration_is_taken_at_sighup_and_a_wrong_one_is_not(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 20)
        file = logs.with_suffix(".toml")
        good = file.read_text()
        file.write_text(good.replace("model", "modell"))
        process.send_signal(signal.SIGHUP)
        output = process.stderr.readline()
        assert output == (
            f"hearthlog: {file}, line 2: unknown key 'modell'; is model meant?; the recorder "
            "keeps its present configuration\n"
        )
        file.write_text("node = 'flat'\n" + good)
        process.send_signal(signal.SIGHUP)
        wait_for(lambda: list(logs.rglob("flat_*")))
        time.sleep(0.1)
        assert process.poll() is None
    assert process.returncode == 0
    assert {path.name.split("_")[0] for path in find_logs(logs)} == {"home", "flat"}


@pytest.mark.parametrize(
    ("who", "file", "folder"), [("owner", 0o600, 0o700), ("group", 0o640, 0o750)]
)
def test_nobody_else_may_read_the_logs(labmic, tmp_path, who, file, folder):
    logs = tmp_path / "logs"
    with recording(labmic, logs, readable_by=who, max_bag_duration=2):
        wait_for(lambda: len(find_logs(logs)) > 2)
    paths = [path for path in logs.rglob("*") if path.name != ".home.lock"]
    for path in [logs, *paths]:
        assert path.stat().st_mode & 0o777 == (folder if path.is_dir() else file), path


@pytest.mark.parametrize(("file", "folder"), [(0o600, 0o700), (0o640, 0o750)])
def test_what_is_added_to_logs_is_for_those_who_may_read_the_logs(
    recorded, tmp_path, capfd, file, folder
):
    logs = tmp_path / "logs"
    shutil.copytree(recorded, logs)
    for path in (logs, *logs.rglob("*")):
        path.chmod(folder if path.is_dir() else file)
    logs.chmod(0o755)  # made by hand
    (tmp_path / "marks.txt").write_text("1.0\t3.0\tcoughing\n")
    assert run(capfd, "annotate", "import", logs, tmp_path / "marks.txt").returncode == 0
    assert run(capfd, "pause", logs).returncode == 0
    made = [logs / ".pause", *logs.rglob("*.review.mcap")]
    assert len(made) > 1
    assert {path.stat().st_mode & 0o777 for path in made} == {file}
