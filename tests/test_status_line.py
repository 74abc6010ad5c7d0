"""On a terminal one line says what the recorder hears, and never holds it up."""

import os
import pty
import re
import signal
import subprocess
import termios
import time
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from select import select

import numpy as np
import pytest
from conftest import HEARTHLOG
from rich.cells import cell_len
from test_capture import features, wait_for_frames

from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.models.modelfile import load_model
from hearthlog.models.registry import override_judgement, promote
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import OK, Frames, SourceHealth
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.recording_session import RecorderState, RecordingSession
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.tools.cli.live_display import line_of

EVENING = datetime(2026, 3, 1, 20, 14, tzinfo=UTC)
NO_TIME = np.zeros(10, np.int64)


def state_of(**microphones):
    """Make the state of a recorder that hears talking, each microphone at another amplitude."""
    state = RecorderState()
    probabilities = np.tile(np.array([0.13, 0.87], np.float32), (10, 1))
    for name, amplitude in microphones.items():
        samples = np.full((10, FRAME_SAMPLES), amplitude, np.float32)
        state.sound[name] = Frames(0, samples, NO_TIME)
        times = NO_TIME, NO_TIME, NO_TIME
        state.labels[name] = FrameLabels(
            ("silence", "speech"), *times, probabilities, probabilities, np.zeros(10), True
        )
    return state


def test_the_line_says_what_is_heard_how_surely_how_loud_and_what_was_kept():
    state = state_of(mic=10 ** (-35 / 20))
    assert line_of(state, EVENING) == "20:14  talking 87%  -35 dB"
    state.keeps, state.clip_frames = True, 20 * 200
    assert line_of(state, EVENING).endswith("-35 dB  3 min of clips")
    state.labels["mic"] = None
    state.sound["mic"] = Frames(0, np.zeros((1, FRAME_SAMPLES), np.float32), NO_TIME[:1])
    assert line_of(state, EVENING) == "20:14  -120 dB  3 min of clips"
    state.trouble["mic"] = "no microphone found"
    assert line_of(state, EVENING) == "20:14  no microphone found  3 min of clips"
    assert line_of(RecorderState(), EVENING) == "20:14  starting"


def test_several_microphones_have_one_line():
    state = state_of(kitchen=0.1, bath=0.01)
    state.trouble["hall"] = "no microphone found"
    assert line_of(state, EVENING) == (
        "20:14  kitchen: talking 87%  -20 dB  bath: talking 87%  -40 dB  hall: no microphone found"
    )


class Nowhere:
    device = "test"


def test_a_pause_is_shown_from_the_start_on_and_a_level_is_one_without_an_offset(tmp_path):
    state, start = RecorderState(), 1_772_348_400_000_000_000
    settings = Settings(output=tmp_path)
    session = RecordingSession(
        settings, {"mic": Nowhere()}, {"mic": LabellingModels()}, state=state
    )
    paused = SourceHealth(start, OK, "paused until 07:00: the microphone is closed")
    session.add("mic", paused)
    assert line_of(state, EVENING) == f"20:14  {paused.summary}"
    session.add("mic", SourceHealth(start, OK, "listening"))
    assert line_of(state, EVENING) == "20:14  starting"
    noise = np.random.default_rng(1).normal(0, 0.01, (40, FRAME_SAMPLES)).astype(np.float32)
    session.add("mic", Frames(0, noise + 0.1, start + np.arange(40) * 50_000_000))
    assert line_of(state, EVENING) == "20:14  -40 dB"
    session.add("mic", replace(paused, stamp=start + 3_000_000_000))
    assert line_of(state, EVENING) == f"20:14  {paused.summary}"
    session.finish()


class Terminal:
    """A terminal of 40 columns, which can be stopped."""

    def __init__(self):
        self._screen, self.end = pty.openpty()
        termios.tcsetwinsize(self.end, (24, 40))
        self.text = ""

    def wait_for(self, pattern):
        deadline = time.monotonic() + 60
        while not re.search(pattern, self.text):
            assert time.monotonic() < deadline, self.text
            if select([self._screen], [], [], 0.1)[0]:
                self.text += os.read(self._screen, 4096).decode()

    def stop(self):
        termios.tcflow(self.end, termios.TCOOFF)

    def close(self):
        os.close(self._screen)
        os.close(self.end)


@contextmanager
def recording(labmic, folder, terminal):
    command = [*HEARTHLOG, "record", "-o", str(folder / "logs"), "--keep-audio", "always"]
    with subprocess.Popen(
        command, env=labmic.env, cwd=folder, stdout=subprocess.PIPE, stderr=terminal.end, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_files_have_a_bar_and_at_the_pace_of_real_time_the_line(tmp_path, terminal, day):
    command = [*HEARTHLOG, "record", str(day), "-o", str(tmp_path / "logs"), "--realtime"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=terminal.end) as process:
        terminal.wait_for(r"\d\d:\d\d  -\d+ dB")
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
    assert "\x1b" not in terminal.text
    terminal.text = ""
    command = [*command[:-2], str(tmp_path / "fast")]
    with subprocess.Popen(command, cwd=tmp_path, stderr=terminal.end) as process:
        terminal.wait_for(r"recording .*100%")
        assert process.wait(timeout=60) == 0
    assert " dB" not in terminal.text


@pytest.fixture
def terminal():
    terminal = Terminal()
    yield terminal
    terminal.close()


def test_a_terminal_shows_models_and_microphones_that_change_and_may_stop(
    labmic, tmp_path, terminal
):
    labmic.env.pop("HEARTHLOG_MODEL", None)
    with recording(labmic, tmp_path, terminal) as process:
        terminal.wait_for(r"\d\d:\d\d  [a-z ]+ \d+%  -?\d+ dB")
        labmic.unplug()
        terminal.wait_for(r"hearthlog: mic: .*silent")
        labmic.restore()
        (tmp_path / "models").mkdir()
        terminal.wait_for(r"hearthlog: mic: listening")
        override_judgement(tmp_path / "models", load_model(Path("bathroom")).sha256)
        promote(tmp_path / "models", "bathroom")
        terminal.wait_for(r"hearthlog: the labels are by bathroom now, after general")
        lines = re.split(r"[\r\n]+", terminal.text)
        assert max(cell_len(line) for line in lines if re.match(r"\d\d:", line)) < 40
        assert "\x1b" not in terminal.text
        terminal.stop()
        wait_for_frames(tmp_path / "logs", len(features(tmp_path / "logs")[0]) + 60)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=30)
    assert process.returncode in {0, 3}
    assert all(Path(tmp_path, line).exists() for line in output.split())
