"""systemd knows of the recorder: that it has started, how its microphones are, that it lives."""

import os
import signal
import socket
import subprocess
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from conftest import FRESH_HEARTHLOG
from test_capture import recording
from test_disk import small_disk

from hearthlog.recorder.events import ERROR, OK, Frames, SourceHealth
from hearthlog.recorder.host import ServiceManager

__all__ = ["small_disk"]

WATCHDOG = 4.0  # seconds: the recorder speaks every second


class Systemd:
    """The socket on which systemd listens."""

    def __init__(self, name):
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(name.replace("@", "\0"))
        self.env = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": str(int(WATCHDOG * 1e6))}

    def lines_within(self, seconds):
        """Return the lines that come within so many seconds."""
        end = time.monotonic() + seconds
        lines = []
        while (left := end - time.monotonic()) > 0:
            self._socket.settimeout(left)
            with suppress(TimeoutError):
                lines += self._socket.recv(4096).decode().split("\n")
        return lines

    def wait_for(self, *texts, seconds=120):
        """Wait for a line that has these texts, and return all that came until then."""
        end = time.monotonic() + seconds
        lines = []
        while time.monotonic() < end:
            lines += self.lines_within(0.2)
            if any(all(text in line for text in texts) for line in lines):
                return lines
        pytest.fail(f"{texts} was not told, but {lines}")

    def close(self):
        self._socket.close()


@pytest.fixture(params=["of a file", "abstract"])
def any_systemd(request):
    with socket_of(abstract=request.param == "abstract") as systemd:
        yield systemd


@pytest.fixture
def systemd():
    with socket_of() as systemd:
        yield systemd


@contextmanager
def socket_of(*, abstract=False):
    with TemporaryDirectory() as folder:  # its path must be short
        name = f"@hearthlog-test-{os.getpid()}" if abstract else str(Path(folder, "notify"))
        systemd = Systemd(name)
        yield systemd
        systemd.close()


def watched(microphone, systemd):
    microphone.env = microphone.env | systemd.env
    return microphone


def test_systemd_is_told_of_the_start_the_state_the_life_and_the_end(labmic, any_systemd, tmp_path):
    systemd = any_systemd
    with recording(watched(labmic, systemd), tmp_path / "logs"):
        lines = systemd.wait_for("STATUS=mic: listening")
        assert lines.count("READY=1") == 1
        assert list((tmp_path / "logs").rglob("*.active"))
        assert "WATCHDOG=1" in systemd.lines_within(WATCHDOG)
    lines = systemd.lines_within(0.5)
    assert "STOPPING=1" in lines
    assert "READY=1" not in lines


def test_a_recorder_that_waits_for_its_microphone_is_alive_and_says_what_is_missing(
    labmic, systemd, tmp_path
):
    with recording(watched(labmic, systemd), tmp_path / "logs"):
        systemd.wait_for("STATUS=mic: listening")
        labmic.unplug()
        systemd.wait_for("STATUS=mic: ", "; last heard 20")
        systemd.wait_for("WATCHDOG=1")
        systemd.wait_for("WATCHDOG=1")
        labmic.restore()
        systemd.wait_for("STATUS=mic: listening")


def test_a_microphone_that_was_never_there_does_not_keep_the_service_from_starting(
    labmic, systemd, tmp_path
):
    labmic.unplug()
    with recording(watched(labmic, systemd), tmp_path / "logs"):
        lines = systemd.wait_for("STATUS=mic: ", "waiting for it")
        assert "READY=1" in lines
        assert "last heard" not in "".join(lines)


def test_each_of_several_microphones_is_in_the_status(labmic, systemd, tmp_path):
    labmic.add_device("second")
    about = tmp_path / "home.toml"
    tables = ("kitchen", labmic.device), ("hall", "none")
    about.write_text(
        f"output = '{tmp_path / 'logs'}'\n"
        + "\n".join(f"[[microphone]]\nname='{name}'\ndevice='{device}'" for name, device in tables)
    )
    command = [*FRESH_HEARTHLOG, "record", "--config", str(about)]
    env = watched(labmic, systemd).env
    with subprocess.Popen(command, env=env, stderr=subprocess.DEVNULL) as process:
        try:
            systemd.wait_for("STATUS=kitchen: listening; hall: no microphone is called 'none'")
            systemd.wait_for("WATCHDOG=1")
        finally:
            process.terminate()


def test_a_recorder_whose_disk_is_full_is_alive(labmic, systemd, small_disk):
    with suppress(OSError):
        (small_disk / "filler").write_bytes(b"\0" * 5_000_000)
    with recording(watched(labmic, systemd), small_disk / "logs"):
        assert "READY=1" in systemd.wait_for("STATUS=mic: listening")
        assert "WATCHDOG=1" in systemd.lines_within(WATCHDOG)


def test_a_recorder_that_hangs_says_nothing(labmic, systemd, tmp_path):
    with recording(watched(labmic, systemd), tmp_path / "logs") as process:
        systemd.wait_for("STATUS=mic: listening")
        process.send_signal(signal.SIGSTOP)
        systemd.lines_within(0.5)
        assert systemd.lines_within(WATCHDOG) == []
        process.send_signal(signal.SIGCONT)
        systemd.wait_for("WATCHDOG=1")


def frames():
    return Frames(0, np.zeros((1, 800), np.float32), np.zeros(1, np.int64))


@pytest.fixture
def reported(systemd, monkeypatch):
    """Return what systemd is told of these events, in this process."""
    for name, value in (systemd.env | {"WATCHDOG_USEC": "1000"}).items():
        monkeypatch.setenv(name, value)

    def send(*events, microphones=("kitchen", "hall")):
        manager = ServiceManager(microphones)
        for microphone, event in events:
            manager.add(microphone, event)
            time.sleep(0.001)
        return systemd.lines_within(0.2)

    return send


def test_a_recorder_of_which_one_microphone_hangs_does_not_count_as_alive(reported):
    kitchen, hall = ("kitchen", frames()), ("hall", SourceHealth(0, ERROR, "not there"))
    assert reported(kitchen, kitchen, kitchen).count("WATCHDOG=1") == 0
    assert reported(kitchen, hall, kitchen, kitchen, kitchen).count("WATCHDOG=1") == 1
    assert reported(kitchen, hall, kitchen, hall).count("WATCHDOG=1") == 2


def test_what_a_microphone_says_of_itself_stays_one_line(reported):
    broken = SourceHealth(0, ERROR, "it broke\nWATCHDOG=1\n\nand how")
    lines = reported(("kitchen", broken))
    assert lines == ["READY=1", "STATUS=kitchen: it broke WATCHDOG=1 and how; hall: starting"]


def test_another_process_is_not_watched(reported, monkeypatch):
    monkeypatch.setenv("WATCHDOG_PID", "1")
    healthy = SourceHealth(0, OK, "listening")
    assert "WATCHDOG=1" not in reported(("mic", healthy), ("mic", frames()), microphones=["mic"])


def test_a_watchdog_that_is_no_number_is_none(reported, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "soon")
    assert "WATCHDOG=1" not in reported(("mic", frames()), microphones=["mic"])


def test_systemd_that_has_gone_does_not_stop_the_recorder(reported, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere/notify")
    assert reported(("mic", frames()), microphones=["mic"]) == []


def test_a_recorder_that_starts_again_by_itself_does_not_say_that_it_ends(
    labmic, systemd, tmp_path
):
    file = tmp_path / "home.toml"
    file.write_text('model = "none"\n[[microphone]]\ndevice = "labmic"\n')
    command = [*FRESH_HEARTHLOG, "record", "--config", str(file), "-o", str(tmp_path / "logs")]
    env = labmic.env | systemd.env
    with subprocess.Popen(command, env=env, stderr=subprocess.PIPE) as process:
        try:
            systemd.wait_for("STATUS=mic: listening")
            file.write_text('node = "flat"\n' + file.read_text())
            process.send_signal(signal.SIGHUP)
            lines = systemd.wait_for("RELOADING=1")
            lines += systemd.wait_for("READY=1")
            assert "STOPPING=1" not in lines
            process.terminate()
            systemd.wait_for("STOPPING=1")
        finally:
            process.kill()
