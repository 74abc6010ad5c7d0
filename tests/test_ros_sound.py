"""The sound of a topic of ROS 2 is recorded as that of a microphone is."""

import signal
import subprocess
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG
from logs import features, read
from rosgraph import DISTRIBUTIONS, Ros, end, next_domain, wait_until_logged

from hearthlog.analyzer.doctor.examination import examine

SPEAK = Path(__file__).parent / "ros" / "speak.py"
RAW = "foxglove_msgs/msg/RawAudio"
DATA = "audio_common_msgs/msg/AudioData"
STAMPED = "audio_common_msgs/msg/AudioDataStamped"


@pytest.fixture
def ros():
    """Give one distribution: what differs between them is not of sound."""
    return Ros(DISTRIBUTIONS[-1], next_domain())


@pytest.fixture
def sound(day, tmp_path):
    """Twelve seconds, at another rate and with more channels if that is asked for."""

    def write(rate=16_000, channels=1):
        samples, _ = soundfile.read(day, dtype="int16", frames=12 * 16_000, start=60 * 16_000)
        samples = np.repeat(samples, rate // 16_000)
        other = np.zeros((len(samples), channels - 1), np.int16)
        path = tmp_path / f"{rate}_{channels}.wav"
        soundfile.write(path, np.hstack([samples[:, np.newaxis], other]), rate)
        return path

    return write


@contextmanager
def topic_recorder(ros, logs, address):
    """Record a topic, in the Python of that ROS."""
    command = ["python", "-m", "hearthlog.tools.cli.main", "record", "--device", address]
    with ros.start(*command, "-o", logs, "--model", "none") as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def speaking(ros, name, path, milliseconds=20, left_out=()):
    """Publish a sound."""
    with ros.start("python", SPEAK, "/robot/audio", name, path, milliseconds, *left_out) as robot:
        try:
            yield robot
        finally:
            robot.kill()


@pytest.mark.parametrize(
    "case", [(RAW, 20), (STAMPED, 32), (DATA, 64)], ids=["raw", "stamped", "data"]
)
def test_a_topic_has_the_features_of_its_sound(ros, case, sound, tmp_path):
    name, milliseconds = case
    path, logs = sound(), tmp_path / "logs"
    robot = speaking(ros, name, path, milliseconds)
    with robot, topic_recorder(ros, logs, "ros2:///robot/audio") as recorder:
        wait_until_logged(logs, features=120)
        output = end(recorder)
    assert recorder.returncode == 0, output
    command = [*HEARTHLOG, "record", str(path), "-o", str(tmp_path / "file"), "--model", "none"]
    subprocess.run(command, check=True)
    frames, stamps, values = features(logs)
    expected = features(tmp_path / "file")[2]
    assert np.array_equal(frames, np.arange(len(frames)))
    assert np.array_equal(values, expected[: len(values)])
    assert np.ptp(np.diff(stamps)) < 20_000_000
    assert {info.device for info in read(logs, "info")} == {"ros2:///robot/audio"}
    assert not [
        finding
        for findings in examine(logs)
        for finding in findings.shown
        if finding.level == "error"
    ]


def test_the_first_channel_of_an_array_is_heard_at_its_own_rate(ros, sound, tmp_path):
    path, logs = sound(48_000, 4), tmp_path / "logs"
    with speaking(ros, DATA, path):
        address = "ros2:///robot/audio?rate=48000&channels=4"
        with topic_recorder(ros, logs, address) as recorder:
            wait_until_logged(logs, features=120)
            end(recorder)
    frames, stamps, values = features(logs)
    assert np.array_equal(frames, np.arange(len(frames)))
    assert (stamps[-1] - stamps[0]) / len(stamps) == pytest.approx(50e6, rel=0.02)
    assert len(np.unique(values[:, 0])) > 60


def test_messages_that_are_lost_are_a_gap(ros, sound, tmp_path):
    logs = tmp_path / "logs"
    robot = speaking(ros, RAW, sound(), 100, left_out=range(20, 27))
    with robot, topic_recorder(ros, logs, "ros2:///robot/audio") as recorder:
        wait_until_logged(logs, features=120)
        end(recorder)
    frames, stamps, _ = features(logs)
    (gap,) = read(logs, "gap")
    assert gap.reason == "messages with sound were lost on the way"
    assert gap.frames_lost == 14
    (step,) = np.flatnonzero(np.diff(frames) > 1)
    assert (stamps[step + 1] - stamps[step]) / 50e6 == pytest.approx(15, abs=1.1)


def test_a_topic_that_stops_is_waited_for(ros, sound, tmp_path):
    logs = tmp_path / "logs"
    with topic_recorder(ros, logs, "ros2:///robot/audio") as recorder:
        for round_ in range(2):
            with speaking(ros, RAW, sound()):
                wait_until_logged(logs, features=100 * (round_ + 1))
            time.sleep(5)
        end(recorder)
    (gap,) = read(logs, "gap")
    assert "the microphone went silent" in gap.reason


@pytest.mark.timeout(200)
@pytest.mark.parametrize(
    "case",
    [
        (None, "ros2:///robot/audio", "nobody publishes /robot/audio in domain"),
        (
            "std_msgs/msg/String",
            "ros2:///robot/audio",
            "is std_msgs/msg/String, which is not audio",
        ),
        (DATA, "ros2:///robot/audio?channels=3", "not int16 samples of 3 channels"),
    ],
)
def test_what_is_wrong_with_a_topic_is_said(ros, case, sound, tmp_path):
    name, address, line = case
    robot = speaking(ros, name, sound()) if name else nullcontext()
    with robot, topic_recorder(ros, tmp_path / "logs", address) as recorder:
        output = ""
        while line not in output:
            output = recorder.stdout.readline()
            assert output
        assert "waiting for it" in output
        end(recorder, signal.SIGINT)
