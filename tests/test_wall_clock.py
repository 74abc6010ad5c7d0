"""A clock that says a time which no log can have ends no recorder; the log says so, and goes on."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from logs import features, read
from test_capture import FRAME, SECONDS, wait_for_frames
from waiting import wait_for

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.recorder.config import load_settings
from hearthlog.recorder.recording import record_microphones

YEAR = 365 * 86_400 * SECONDS


@pytest.fixture
def clock(monkeypatch):
    """A clock that is ahead by so many nanoseconds."""
    error, true = [0], time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: true() + error[0])
    return error


@pytest.fixture
def record(labmic, monkeypatch, tmp_path):
    """A recorder in this process, whose clock can be set."""
    for name, value in labmic.env.items():
        monkeypatch.setenv(name, value)
    about = {"output": tmp_path / "logs", "model": Path("none"), "max_bag_duration": 86_400}
    settings = load_settings(None, about, {"device": labmic.device})
    stop = threading.Event()
    recorder = threading.Thread(target=record_microphones, args=(settings, stop))

    def finish():
        stop.set()
        recorder.join(30)
        assert not [line for one in examine(logs) for line in one.shown if line.level == "error"]

    logs = tmp_path / "logs"
    recorder.finish = finish
    yield recorder, logs
    stop.set()


@pytest.mark.parametrize("error", [20 * YEAR, -70 * YEAR])
def test_a_recorder_that_starts_with_such_a_clock_follows_it_once_it_is_right(clock, record, error):
    recorder, logs = record
    clock[0] = error
    recorder.start()
    wait_for_frames(logs, 60)
    clock[0] = 0
    wait_for_frames(logs, len(features(logs)[0]) + 60)
    recorder.finish()
    (gap,) = read(logs, "gap")
    assert gap.reason.startswith("the clock was set by +")
    _, stamps, _ = features(logs)
    assert stamps[0] < YEAR
    assert abs(time.time_ns() - stamps[-1]) < 60 * SECONDS
    output = {status.message for each in read(logs, "diagnostics") for status in each.status}
    assert [line for line in output if "which a log cannot have; set it" in line]


@pytest.mark.parametrize("step", [-86_400, 7])
def test_a_clock_that_is_set_while_the_microphone_is_silent_is_told_of_in_the_gap(
    clock, record, labmic, step
):
    recorder, logs = record
    recorder.start()
    wait_for_frames(logs, 20)
    labmic.freeze()
    clock[0] = step * SECONDS
    wait_for(
        lambda: not ("waiting for it" not in reported(logs) and "went silent" not in reported(logs))
    )
    labmic.restore()
    wait_for_frames(logs, len(features(logs)[0]) + 40)
    recorder.finish()
    (gap,) = read(logs, "gap")
    assert gap.reason == f"the microphone went silent; the clock was set by {step:+.3f} s"


def reported(logs):
    """What was said of the microphone so far."""
    return " ".join(status.message for m in read(logs, "diagnostics") for status in m.status)


def test_a_clock_that_is_wrong_for_a_while_leaves_no_gap(clock, record):
    recorder, logs = record
    recorder.start()
    wait_for_frames(logs, 40)
    clock[0] = 20 * YEAR
    time.sleep(3)
    clock[0] = 0
    wait_for_frames(logs, len(features(logs)[0]) + 60)
    recorder.finish()
    frames, stamps, _ = features(logs)
    assert not read(logs, "gap")
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    assert np.diff(stamps).max() < 1.1 * FRAME


@pytest.mark.parametrize("start", ["2040-01-01", "1969-12-31"])
def test_files_of_such_a_time_are_refused(hearthlog, household, tmp_path, start):
    sound = next(household.rglob("*.flac"))
    result = hearthlog("record", sound, "--start", start, "-o", tmp_path / "logs")
    assert result.returncode == 1
    assert f"a log cannot have sound of {start}, only of 1970 to 2037; say --start" in result.stderr
    assert not (tmp_path / "logs").exists()
