"""A microphone is heard to the last sample, whatever happens to it; real PortAudio throughout."""

import os
import signal
import subprocess
import time
from contextlib import contextmanager

import numpy as np
import pytest
from conftest import HEARTHLOG
from logs import features, read
from waiting import wait_for

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import nanoseconds

RATE = 16_000
ROUNDING = 2**-11  # of the features that a log has
FRAME = 50_000_000
SECONDS = 1_000_000_000


@contextmanager
def recording(microphone, folder, *options):
    """Run `hearthlog record` on a microphone; at the end it is asked to stop."""
    # One file a day, or an hour that ends just now would make two.
    command = [*HEARTHLOG, "record", "--device", microphone.device, "-o", str(folder)]
    command += ["--max-bag-duration", "86400", *options]
    with subprocess.Popen(
        command, env=microphone.env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
            process.output, process.errors = process.communicate(timeout=60)
        finally:
            process.kill()


def wait_for_frames(folder, count, seconds=120):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if folder.exists() and list(folder.rglob("*.mcap*")) and len(features(folder)[0]) >= count:
            return
        time.sleep(0.2)
    pytest.fail(f"not {count} frames in {seconds} s")


def sound(seconds=7, seed=3):
    """Noise that never repeats within itself, as int16."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, 3000, RATE * seconds + 311).astype(np.int16)


def batch(data, start, count):
    """Features of `count` frames of the looping data, from sample `start` on."""
    index = (start + np.arange(count * FRAME_SAMPLES)) % len(data)
    frames = (data[index].astype(np.float32) / np.float32(32768)).reshape(-1, FRAME_SAMPLES)
    return DEFAULT.extractor()(frames)


def first_sample(data, values, guess):
    """Find where in the looping data the second frame began, near `guess`."""
    for offset in sorted(range(-400, 401), key=abs):
        if np.array_equal(batch(data, guess - FRAME_SAMPLES + offset, 2)[1], values[1]):
            return guess - FRAME_SAMPLES + offset
    pytest.fail("the features are not those of the microphone's samples")


def realtime_offset():
    return time.time_ns() - time.monotonic_ns()


def test_every_sample_is_captured_and_gives_the_features_of_the_batch(labmic, tmp_path):
    data = sound()
    labmic.configure(data=data)
    with recording(labmic, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 20 * 20, 50)
    assert process.returncode == 0, process.errors
    frames, stamps, values = features(tmp_path / "logs")
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    guess = labmic.index_at(int(stamps[1]) - realtime_offset())
    start = first_sample(data, values, guess)
    np.testing.assert_array_equal(values, batch(data, start, len(frames)))
    true = (start + frames * FRAME_SAMPLES) * SECONDS / RATE + realtime_offset()
    assert np.abs(stamps - true).max() < 1_000_000


def test_stamps_stay_within_a_millisecond_of_a_microphone_that_drifts_by_50_ppm(labmic, tmp_path):
    data = sound()
    labmic.configure(ppm=50, data=data)
    with recording(labmic, tmp_path / "logs"):
        wait_for_frames(tmp_path / "logs", 30 * 20, 60)
    frames, stamps, values = features(tmp_path / "logs")
    guess = labmic.index_at(int(stamps[1]) - realtime_offset())
    start = first_sample(data, values, guess)
    np.testing.assert_array_equal(values, batch(data, start, len(frames)))
    true = (start + frames * FRAME_SAMPLES) * SECONDS / (RATE * (1 + 50e-6)) + realtime_offset()
    assert np.abs(stamps - true).max() < 1_000_000


def test_a_microphone_that_is_unplugged_and_comes_back_leaves_a_gap(labmic, tmp_path):
    with recording(labmic, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 20)
        labmic.unplug()
        time.sleep(5)
        labmic.restore()
        wait_for_frames(tmp_path / "logs", len(features(tmp_path / "logs")[0]) + 40)
    assert process.returncode == 3
    assert len(process.errors) < 2000
    frames, stamps, _ = features(tmp_path / "logs")
    (gap,) = read(tmp_path / "logs", "gap")
    jump = int(np.flatnonzero(np.diff(frames) > 1)[0])
    assert gap.frames_lost == frames[jump + 1] - frames[jump] - 1
    assert nanoseconds(gap.header.stamp) == stamps[jump] + FRAME
    assert nanoseconds(gap.header.stamp) + nanoseconds(gap.duration) == stamps[jump + 1]
    assert abs(gap.frames_lost * FRAME - nanoseconds(gap.duration)) < FRAME
    levels = [s.level for m in read(tmp_path / "logs", "diagnostics") for s in m.status]
    assert 2 in levels
    assert levels[-1] == 0


def test_a_loss_of_the_microphone_leaves_one_log_that_is_labelled_and_whole(labmic, tmp_path):
    labmic.configure(data=sound())
    logs = tmp_path / "logs"
    with recording(labmic, logs, "--model", "general"):
        wait_for_frames(logs, 60)
        for _ in range(2):
            labmic.unplug()
            time.sleep(5)
            labmic.restore()
            wait_for_frames(logs, len(features(logs)[0]) + 60)
    (log,) = find_logs(logs)
    assert len(read(log, "gap")) == 2
    assert len(read(log, "segment")) >= 2
    (findings,) = examine(log)
    assert not [line for line in map(str, findings.shown) if line.startswith("error")]


def test_a_microphone_that_freezes_is_started_again(labmic, tmp_path):
    with recording(labmic, tmp_path / "logs"):
        wait_for_frames(tmp_path / "logs", 20)
        labmic.freeze()
        time.sleep(4)
        labmic.restore()
        wait_for_frames(tmp_path / "logs", len(features(tmp_path / "logs")[0]) + 40)
    (gap,) = read(tmp_path / "logs", "gap")
    assert gap.reason == "the microphone went silent"


@pytest.mark.parametrize("burst", [0.8, 2.0, 3.5])
def test_a_sound_card_that_gives_its_sound_in_long_pieces_is_heard_without_a_loss(
    labmic, tmp_path, burst
):
    labmic.configure(burst=burst)
    with recording(labmic, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 240, seconds=60)
    assert process.returncode == 0, process.errors
    frames, stamps, _ = features(tmp_path / "logs")
    np.testing.assert_array_equal(np.diff(frames), 1)
    assert np.abs(np.diff(stamps) - FRAME).max() < FRAME / 5
    assert ("went silent" in process.errors) == (burst > 1)


def test_a_recorder_that_is_killed_loses_a_second_and_the_next_start_says_so(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 60)
        process.kill()
        killed = time.time_ns()
        process.wait()
    (left,) = logs.rglob("*.active")
    _, stamps, _ = features(left)
    assert killed - (int(stamps[-1]) + FRAME) < SECONDS
    with recording(labmic, logs):
        wait_for(lambda: not left.exists())
        wait_for_frames(logs, len(stamps) + 40)
    assert not list(logs.rglob("*.active"))
    first, second = sorted(logs.rglob("*.mcap"))
    np.testing.assert_array_equal(features(first)[1], stamps)
    (gap,) = read(second, "gap")
    assert nanoseconds(gap.header.stamp) == stamps[-1] + FRAME
    _, later, _ = features(second)
    assert nanoseconds(gap.header.stamp) + nanoseconds(gap.duration) == later[0]


def test_the_time_between_two_recordings_is_a_gap_and_no_failure(labmic, tmp_path):
    logs = tmp_path / "logs"
    for _ in range(2):
        with recording(labmic, logs) as process:
            wait_for_frames(logs, 20 if not logs.exists() else len(features(logs)[0]) + 20)
        assert process.returncode == 0, process.errors
    first, second = sorted(logs.rglob("*.mcap"))
    (gap,) = read(second, "gap")
    assert gap.reason == "the recorder was not running"
    assert nanoseconds(gap.header.stamp) == features(first)[1][-1] + FRAME
    assert not [line for one in examine(logs) for line in one.shown if line.level == "error"]


def test_a_microphone_at_another_rate_is_resampled(labmic, tmp_path):
    time_axis = np.arange(48_000 * 2) / 48_000
    tone = (8000 * np.sin(2 * np.pi * 1000 * time_axis)).astype(np.int16)
    labmic.configure(rate=48_000, data=tone)
    with recording(labmic, tmp_path / "logs"):
        wait_for_frames(tmp_path / "logs", 60)
    frames, stamps, values = features(tmp_path / "logs")
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    assert np.abs(np.diff(stamps) - FRAME).max() < 100_000
    assert np.median(values[:, 0]) == pytest.approx((8000 / 32768) ** 2 / 2, rel=0.01)
    assert np.median(values[:, 7]) * RATE / 2 == pytest.approx(1000, abs=1)


@pytest.mark.parametrize(
    ("offset", "rate", "what"),
    [
        (0, RATE, "digital silence"),
        (-655, RATE, "nothing but an offset"),
        (-655, 48_000, "nothing but an offset"),
        (400, 44_100, "nothing but an offset"),
    ],
)
def test_a_dead_microphone_is_reported_and_an_offset_is_no_level(
    labmic, tmp_path, offset, rate, what
):
    noise = np.random.default_rng(1).integers(-1, 2, rate) if offset else 0
    labmic.configure(rate, data=(offset + noise * np.ones(rate)).astype(np.int16))
    with recording(labmic, tmp_path / "logs"):
        wait_for_frames(tmp_path / "logs", 220)
    found = [s for m in read(tmp_path / "logs", "diagnostics") for s in m.status]
    (*_, dead) = [s for s in found if s.level == 2]
    assert dead.message == f"the microphone gives {what}: is it muted or dead?"
    values = {pair.key: pair.value for pair in dead.values}
    assert float(values["level_dbfs"]) == -70.0


@pytest.mark.parametrize("rate", [RATE, 48_000])
def test_a_faint_room_with_an_offset_is_not_dead(labmic, tmp_path, rate):
    room = np.random.default_rng(2).normal(0, 0.8, 3 * rate)  # steps of 16 bits: -92 dBFS
    labmic.configure(rate, data=np.rint(655 + room).astype(np.int16))
    with recording(labmic, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 240)
    assert "dead" not in process.errors


def test_sound_of_pulseaudio_is_heard_to_the_last_sample(pulse_microphone, tmp_path):
    data = sound(5, seed=4)
    pulse_microphone.play(data)
    with recording(pulse_microphone, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 200)
    assert process.returncode == 0, process.errors
    frames, _, values = features(tmp_path / "logs")
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    energies = values[-60:, 0]
    cyclic = np.concatenate([data, data]).astype(np.float64) / 32768
    power = np.concatenate([[0.0], np.cumsum(cyclic**2)])
    frame_power = (power[FRAME_SAMPLES:] - power[:-FRAME_SAMPLES]) / FRAME_SAMPLES
    frame_power = frame_power[: len(data)]
    (start,) = [
        offset
        for offset in np.flatnonzero(
            np.isclose(frame_power, energies[0], rtol=ROUNDING)
            & np.isclose(np.roll(frame_power, -FRAME_SAMPLES), energies[1], rtol=ROUNDING)
        )
        if np.array_equal(batch(data, int(offset), 3)[1:], values[-60:-57][1:])
    ]
    np.testing.assert_array_equal(batch(data, int(start), 60)[1:], values[-60:][1:])


def test_a_microphone_that_is_not_there_at_the_start_is_waited_for(labmic, tmp_path):
    labmic.unplug()
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        assert b"there are" not in os.read(process.stderr.fileno(), 1000)
        labmic.restore()
        wait_for_frames(logs, 20)
    assert process.returncode == 0, process.errors
    levels = [s.level for m in read(logs, "diagnostics") for s in m.status]
    assert (levels[0], levels[-1]) == (2, 0)
    assert read(logs, "info")[-1].device == "labmic"
    assert not [line for one in examine(logs) for line in one.shown if line.level == "error"]


def test_a_microphone_that_nothing_is_called_is_waited_for_with_a_list_of_those_there_are(
    labmic, tmp_path
):
    command = [*HEARTHLOG, "record", "--device", "Blue Yeti", "-o", str(tmp_path / "logs")]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=labmic.env, stderr=pipe, text=True) as process:
        line = process.stderr.readline()
        process.terminate()
    expected = "mic: no microphone is called 'Blue Yeti'; there are 'labmic'; waiting for it"
    assert line == f"hearthlog: {expected}\n"


def test_a_microphone_that_is_lost_is_never_replaced_by_another_one(labmic, tmp_path):
    labmic.add_device("labmic2")
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 20)
        labmic.unplug()
        time.sleep(8)
        labmic.restore()
        wait_for_frames(logs, len(features(logs)[0]) + 40)
    assert {info.device for info in read(logs, "info")} == {"labmic"}
    (gap,) = read(logs, "gap")
    assert gap.frames_lost > 100


def test_several_microphones_are_heard_and_lost_apart_in_one_log(labmic, tmp_path):
    labmic.configure(data=sound())
    second = labmic.add_device("second")
    second.configure(data=sound())
    logs, about = tmp_path / "logs", tmp_path / "home.toml"
    about.write_text(
        f"""
        output = "{logs}"
        [[microphone]]
        name = "kitchen"
        device = "labmic"
        model = "general"
        [[microphone]]
        name = "hall"
        device = "second"
        """
    )
    command = [*HEARTHLOG, "record", "--config", str(about), "--max-bag-duration", "15"]
    with subprocess.Popen(command, env=labmic.env, stderr=subprocess.PIPE, text=True) as process:
        wait_for_frames(logs, 200)
        second.unplug()
        time.sleep(6)
        second.restore()
        wait_for_frames(logs, len(features(logs)[0]) + 400)
        process.terminate()
        _, output = process.communicate(timeout=30)
    assert "hall: the microphone went silent" in output
    assert "kitchen:" not in output
    kitchen, hall = (frames_of(logs, name) for name in ("kitchen", "hall"))
    assert kitchen == list(range(len(kitchen)))
    (gap,) = read(logs, "gap")
    assert gap.header.frame_id == "hall"
    assert len(hall) + gap.frames_lost == hall[-1] + 1
    assert {label.header.frame_id for label in read(logs, "label")} == {"kitchen"}
    assert not [line for one in examine(logs) for line in one.shown if line.level == "error"]


def frames_of(logs, microphone):
    return sorted(m.frame for m in read(logs, "features") if m.header.frame_id == microphone)


def test_devices_lists_microphones_by_name(labmic, hearthlog):
    result = hearthlog("devices", env=labmic.env)
    assert result.returncode == 0
    assert result.stdout.startswith("labmic  ")
