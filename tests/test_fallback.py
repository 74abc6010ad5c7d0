"""A fallback is heard only where one is named, only while the device is not there, and is said."""

import subprocess
from contextlib import contextmanager

import numpy as np
import pytest
from conftest import HEARTHLOG
from logs import features, read
from test_capture import wait_for_frames

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.schemas.logs.files import find_logs

INSTEAD = "labmic is not there; spare is heard in its place"


@contextmanager
def recording(labmic, logs, more=""):
    """Record labmic, with another one as its fallback."""
    about = logs.with_suffix(".toml")
    about.write_text(
        f'output = "{logs}"\nmax_bag_duration = 86400\n'
        f'[[microphone]]\ndevice = "labmic"\nfallback = "spare"\n{more}'
    )
    command = [*HEARTHLOG, "record", "--config", str(about)]
    with subprocess.Popen(command, env=labmic.env, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
            process.terminate()
            _, process.errors = process.communicate(timeout=60)
        finally:
            process.kill()


def devices(logs):
    """What is heard, in the order of the logs."""
    return [info.device for log in find_logs(logs) for info in read(log, "info")]


def wait_for_more(logs, count):
    wait_for_frames(logs, len(features(logs)[0]) + count, 120)


def test_a_device_that_is_lost_is_replaced_by_its_fallback_until_it_is_back(labmic, tmp_path):
    labmic.add_device("spare")
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 40)
        labmic.unplug()
        while devices(logs)[-1] != "spare":  # what was captured before may still be written
            wait_for_more(logs, 20)
        wait_for_more(logs, 60)
        labmic.restore()
        while devices(logs)[-1] != "labmic":
            wait_for_more(logs, 20)
        wait_for_more(logs, 40)
    assert devices(logs) == ["labmic", "spare", "labmic"]
    lost, back = read(logs, "gap")
    assert lost.reason == "the microphone went silent; spare is heard in its place"
    assert lost.frames_lost > 200
    assert back.reason == "labmic is there again"
    assert back.frames_lost < 40
    frames, stamps, _ = features(logs)
    assert len(frames) + lost.frames_lost + back.frames_lost == frames[-1] + 1
    assert (np.diff(stamps) > 0).all()
    assert f"hearthlog: mic: {INSTEAD}\nhearthlog: mic: listening\n" in process.errors
    statuses = [status for each in read(logs, "diagnostics") for status in each.status]
    reported = {
        next(value.value for value in status.values if value.key == "device")
        for status in statuses
        if status.message == INSTEAD
    }
    assert reported == {"spare"}
    assert not [line for one in examine(logs) for line in one.shown if line.level == "error"]


def test_a_fallback_is_heard_from_the_start_where_the_device_is_not_there(labmic, tmp_path):
    labmic.add_device("spare")
    labmic.unplug()
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 40)
        assert devices(logs)[-1] == "spare"
        labmic.restore()
        while devices(logs)[-1] != "labmic":
            wait_for_more(logs, 20)
    (gap,) = read(logs, "gap")
    assert gap.reason == "labmic is there again"


def test_a_fallback_is_heard_where_the_device_has_too_few_channels_for_an_array(labmic, tmp_path):
    labmic.add_device("spare")
    labmic.configure(data=np.ones((1600, 2), np.int16))
    logs = tmp_path / "logs"
    with recording(labmic, logs, "array = [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]\n") as process:
        wait_for_frames(logs, 40)
    assert process.returncode == 0, process.errors
    assert devices(logs) == ["spare"]
    reported = "labmic' has 2 channels, and `array` names places for 3: name one for each channel"
    assert reported in process.errors
    assert "; spare is heard in its place\n" in process.errors


@pytest.mark.parametrize("other", ["hall", "spare"])
def test_the_device_of_another_microphone_is_no_fallback(hearthlog, tmp_path, other):
    about = tmp_path / "home.toml"
    about.write_text(
        '[[microphone]]\nname = "a"\ndevice = "labmic"\nfallback = "spare"\n'
        f'[[microphone]]\nname = "b"\ndevice = "{other}"\nfallback = "spare"\n'
    )
    result = hearthlog("record", "--config", about)
    assert result.returncode == 2
    assert "two microphones have device 'spare'" in result.stderr
