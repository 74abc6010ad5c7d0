"""The microphones of the tests do what the tests of capture rely on."""

import contextlib
import subprocess
import sys
import time

import numpy as np
import pytest
from microphones import DIES_WITH_PARENT, _need

RATE = 16_000
BLOCK = 800
HEADER = np.dtype([("adc_time", "<f8"), ("monotonic", "<f8"), ("realtime", "<f8")])
RECORD = np.dtype([*HEADER.descr, ("samples", "<i2", (BLOCK,))])
RECORDER = f"""
import queue, struct, sys, time
import sounddevice
blocks = queue.SimpleQueue()

def hear(samples, frames, times, flags):
    stamps = times.inputBufferAdcTime, time.monotonic(), time.time()
    blocks.put(struct.pack("<3d", *stamps) + bytes(samples))

settings = dict(samplerate={RATE}, blocksize={BLOCK}, channels=1, dtype="int16", latency=0.5)
with sounddevice.RawInputStream(device=sys.argv[1], callback=hear, **settings):
    with open(sys.argv[2], "ab", buffering=0) as file:
        while True:
            file.write(blocks.get())
"""


class Recording:
    """What a child process has recorded so far; the child can be killed, PortAudio cannot."""

    def __init__(self, process, path):
        self.process = process
        self._path = path

    def blocks(self):
        return np.fromfile(self._path, RECORD, self.count())

    def count(self):
        return self._path.stat().st_size // RECORD.itemsize if self._path.exists() else 0

    def wait_for(self, count):
        self.wait_until(lambda: self.count() >= count)
        return self.blocks()

    def wait_until(self, condition, seconds=120.0):
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"not in time; {self.count()} blocks came"
            assert self.process.poll() is None, "the recording process ended"
            time.sleep(0.05)

    def grown_in(self, seconds):
        before = self.count()
        time.sleep(seconds)
        return self.count() - before


@pytest.fixture
def record(tmp_path):
    with contextlib.ExitStack() as stack:

        def start(microphone):
            path = tmp_path / f"{microphone.device}.blocks"
            process = subprocess.Popen(
                [*DIES_WITH_PARENT, sys.executable, "-c", RECORDER, microphone.device, str(path)],
                env=microphone.env,
                stderr=subprocess.DEVNULL,  # a vanished device writes millions of lines
            )
            stack.callback(process.wait, timeout=5)
            stack.callback(process.kill)
            return Recording(process, path)

        yield start


def steps(samples):
    return np.diff(samples.ravel().astype(np.int64)) % 65_536


def index_error(microphone, blocks):
    """First sample of each block against the index at its ADC time, in samples."""
    expected = [microphone.index_at(round(seconds * 1e9)) for seconds in blocks["adc_time"]]
    recorded = blocks["samples"][:, 0].astype(np.int64) + 32_768
    return (np.array(expected) - recorded + 32_768) % 65_536 - 32_768


def is_stretch_of_loop(recorded, played):
    laps = recorded.size // played.size + 2
    return recorded.tobytes() in np.tile(played, laps).tobytes()


def hears_only(recording, level):
    return (recording.blocks()["samples"][-5:] == level).all()


def noise(seed, count):
    return np.random.default_rng(seed).integers(-32_768, 32_768, count).astype(np.int16)


def test_a_second_of_labmic_is_a_ramp_without_a_jump(labmic, record):
    assert (steps(record(labmic).wait_for(20)["samples"]) == 1).all()


def test_the_sample_at_the_adc_time_is_the_one_that_index_at_says(labmic, record):
    assert np.abs(np.median(index_error(labmic, record(labmic).wait_for(20)))) <= 8


def test_the_adc_time_of_labmic_is_on_the_monotonic_clock(labmic, record):
    blocks = record(labmic).wait_for(10)
    assert np.median(np.abs(blocks["monotonic"] - blocks["adc_time"])) < 1
    assert np.median(np.abs(blocks["realtime"] - blocks["adc_time"])) > 1


def test_a_drifting_labmic_takes_its_samples_faster(labmic, record):
    labmic.configure(ppm=500)
    blocks = record(labmic).wait_for(40)
    assert np.abs(np.median(index_error(labmic, blocks))) <= 8
    rate = (blocks.size - 1) * BLOCK / (blocks["adc_time"][-1] - blocks["adc_time"][0])
    assert rate == pytest.approx(16_008, abs=2)


def test_index_at_is_exact_after_years_of_uptime(labmic):
    labmic.configure(ppm=-37.5)
    years = 100_000_000
    assert labmic.index_at(years * 10**9) == years * RATE - 60_000_000
    assert labmic.index_at(years * 10**9 - 1) == years * RATE - 60_000_000 - 1


def test_an_unplugged_labmic_delivers_no_block_any_more(labmic, record):
    recording = record(labmic)
    recording.wait_for(5)
    labmic.unplug()
    time.sleep(0.3)
    assert recording.grown_in(0.7) == 0


def test_an_unplugged_labmic_cannot_be_opened_until_it_is_restored(labmic, record):
    labmic.unplug()
    refused = record(labmic)
    assert refused.process.wait(timeout=20) == 1
    labmic.restore()
    record(labmic).wait_for(5)


def test_a_frozen_labmic_delivers_no_block_until_it_is_restored(labmic, record):
    recording = record(labmic)
    before = recording.wait_for(5).size
    labmic.freeze()
    time.sleep(0.3)
    assert recording.grown_in(0.7) == 0
    labmic.restore()
    recording.wait_for(before + 20)


def test_given_samples_are_heard_in_a_loop(labmic, record):
    data = noise(1, 5_000)
    labmic.configure(data=data)
    assert is_stretch_of_loop(record(labmic).wait_for(20)["samples"], data)


def test_two_microphones_are_heard_and_unplugged_apart(labmic, record):
    kitchen = labmic.add_device("kitchen")
    first, second = record(labmic), record(kitchen)
    first.wait_for(5)
    second.wait_for(5)
    kitchen.unplug()
    time.sleep(0.3)
    assert second.grown_in(0.5) == 0
    assert first.grown_in(0.5) > 5


def test_pulseaudio_returns_what_is_played_bit_for_bit(pulse_microphone, record):
    data = noise(2, 20_011)
    pulse_microphone.play(data)
    recording = record(pulse_microphone)
    recording.wait_for(26)  # more than one lap, after what was there before the player had begun
    recording.wait_until(lambda: is_stretch_of_loop(recording.blocks()["samples"][-26:], data))


def test_pulseaudio_plays_the_newer_samples_after_a_change(pulse_microphone, record):
    recording = record(pulse_microphone)
    recording.wait_for(5)
    for level in 1_000, -1_000:
        pulse_microphone.play(np.full(RATE, level, np.int16))
        recording.wait_until(lambda: hears_only(recording, level))  # noqa: B023


@pytest.mark.parametrize(
    ("required", "outcome"), [("", pytest.skip.Exception), ("1", pytest.fail.Exception)]
)
def test_missing_sound_skips_on_a_desk_and_fails_where_required(required, outcome, monkeypatch):
    monkeypatch.setenv("TESTS_REQUIRE_AUDIO", required)
    # Both are caught: a skip that escaped would skip this test instead of failing it.
    with pytest.raises((pytest.skip.Exception, pytest.fail.Exception), match="package gcc") as end:
        _need("gcc", present=None)
    assert end.type is outcome
