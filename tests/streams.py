"""Microphones in the network for the tests: a server of live sound, and a camera by GStreamer."""

import shutil
import signal
import struct
import subprocess
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from microphones import DIES_WITH_PARENT, _need

RATE = 16_000
_BLOCK = 800
_SYSTEM_PYTHON = "/usr/bin/python3"
_CAMERA = Path(__file__).with_name("rtsp_camera.py")


class LiveServer:
    """Serves a loop of int16 samples as WAV over HTTP, as it sounds: mono, or an axis of channels.

    Sample n sounds at CLOCK_MONOTONIC = `epoch` + n / 16000, for all who listen.

    Attributes
    ----------
    burst : float
        Seconds from before the call that are sent at first, at once.
    speed : float
        How much faster than it sounds the sound is sent.
    condition : str
        "": sends sound; "stalls": sends no more; "ends": closes the connection; "silent": does not
        answer; "html", "playlist": answers with such; "locked": wants `listener` with password
        `pass@word`.
    """

    def __init__(self, data: np.ndarray, secret: Path | None = None):
        self.data, self.secret = data, secret
        self.burst, self.speed, self.condition = 0.0, 1.0, ""
        self.epoch = time.monotonic()
        self.requested: list[str] = []  # what was asked for
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True
        self.port = self._server.server_port
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/mic"

    def close(self):
        self._server.shutdown()
        self._server.server_close()

    def _handler(server):  # noqa: N805
        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_):
                pass

            def do_GET(self):
                server.requested.append(self.path)
                with suppress(OSError):
                    server._answer(self)

        return Handler

    def _answer(self, to: BaseHTTPRequestHandler):
        # "bGlz…" is listener:pass@word
        known = to.headers.get("Authorization") == "Basic bGlzdGVuZXI6cGFzc0B3b3Jk"
        while self.condition == "silent":
            time.sleep(0.1)
        if self.condition == "locked" and not known:
            to.send_response(401)
            to.send_header("WWW-Authenticate", 'Basic realm="microphone"')
            to.end_headers()
            return
        to.send_response(200)
        page = {
            "html": "<!DOCTYPE html><html><body>Welcome</body></html>",
            "playlist": f"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nfile://{self.secret}\n"
            "#EXT-X-ENDLIST\n",
        }.get(self.condition)
        if page is not None:
            to.send_header("Content-Length", str(len(page)))
            to.end_headers()
            to.wfile.write(page.encode())
            return
        to.end_headers()
        channels = self.data[0].size
        sizes = struct.pack(
            "<IHHIIHH", 16, 1, channels, RATE, 2 * channels * RATE, 2 * channels, 16
        )
        to.wfile.write(b"RIFF\xff\xff\xff\xffWAVEfmt " + sizes + b"data\xff\xff\xff\xff")
        self._send_sound(to.wfile)

    def _send_sound(self, to):
        called = time.monotonic()
        first = position = int((called - self.epoch - self.burst) * RATE)
        while self.condition in ("", "locked", "stalls"):
            now = (time.monotonic() - called) * self.speed + self.burst
            due = first + int(now * RATE)
            while position + _BLOCK <= due and self.condition != "stalls":
                index = np.arange(position, position + _BLOCK) % len(self.data)
                to.write(self.data[index].tobytes())
                position += _BLOCK
            time.sleep(0.02)


class Camera:
    """A camera; what it serves is in `rtsp_camera.py`."""

    def __init__(self, sound: Path):
        self._process = subprocess.Popen(
            [*DIES_WITH_PARENT, _SYSTEM_PYTHON, str(_CAMERA), str(sound)],
            stdout=subprocess.PIPE,
            text=True,
        )
        self.port, self.locked_port = map(int, self._process.stdout.readline().split())

    def address(self, path: str) -> str:
        return f"rtsp://127.0.0.1:{self.port}/{path}"

    def freeze(self):
        self._process.send_signal(signal.SIGSTOP)

    def restore(self):
        self._process.send_signal(signal.SIGCONT)

    def close(self):
        self._process.kill()
        self._process.communicate()


@pytest.fixture
def live_server():
    """A server of eleven seconds of noise; see `LiveServer`."""
    _need("ffmpeg", shutil.which("ffmpeg"))
    server = LiveServer(noise(11))
    yield server
    server.close()


@pytest.fixture
def camera(tmp_path):
    """A camera that plays two minutes of noise to each who listens; see `Camera`."""
    _need("ffmpeg", shutil.which("ffmpeg"))
    _need("gir1.2-gst-rtsp-server-1.0, with python3-gi", _has_rtsp_server())
    sound = tmp_path / "camera.s16"
    noise(120).tofile(sound)
    camera = Camera(sound)
    yield camera
    camera.close()


def noise(seconds: int) -> np.ndarray:
    return np.random.default_rng(5).normal(0, 3000, RATE * seconds + 311).astype("<i2")


def _has_rtsp_server() -> bool:
    if not Path(_SYSTEM_PYTHON).exists():
        return False
    command = [_SYSTEM_PYTHON, "-c", "import gi; gi.require_version('GstRtspServer', '1.0')"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0
