"""Process of Rerun's viewer, reachable from this machine only, without usage statistics."""

import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from ctypes.util import find_library
from importlib.util import find_spec
from pathlib import Path
from typing import Self

from hearthlog.analyzer.errors import DataError, missing
from hearthlog.analyzer.http import free_port, hidden_address

_WAIT_SECONDS = 60
_STOP_SECONDS = 5
_GRAPHICS_CARDS = ("dri/renderD*", "nvidia[0-9]*", "dxg")
# The Vulkan of Mesa 22.3 compiles shaders for each picture and frees none: 2 MB more a second.
# Its OpenGL does not, but hides its support of float textures, which the viewer needs.
_OPENGL = {"WGPU_BACKEND": "gl", "MESA_EXTENSION_OVERRIDE": "+GL_ARB_color_buffer_float"}
_BACKTRACE = re.compile(r"\s*\d+: ")


def program() -> Path:
    """Return the path of the viewer's program in the installed `rerun` package.

    Raise `DataError` if it is not installed.
    """
    spec = find_spec("rerun_cli")
    path = Path(spec.origin).with_name("rerun") if spec and spec.origin else None
    if path is None or not path.exists():
        raise DataError(missing("rerun_cli"))
    return path


def hidden_options() -> str:
    """Return options of `rerun` that hide a viewer started by the user from web pages.

    By default it listens to the complete network, and shows its data to every web page that finds
    it.
    """
    address = hidden_address()
    return f"--bind {address} --port {free_port(bind=address)}"


def has_display() -> bool:
    """Return whether a window can be opened (on Linux: an X11 or Wayland display exists)."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(map(os.environ.get, names))


def check_display(instead: str) -> None:
    """Raise DataError on Linux without an X11 or Wayland display."""
    if not has_display():
        raise DataError(f"there is no display: use --web for a browser, or {instead}")


class ViewerProcess:
    """A running viewer.

    Raise `DataError` if the viewer is not installed.
    """

    def __init__(self, arguments: Sequence[str], port: int | None = None) -> None:
        self.address = hidden_address()
        self.port = free_port(port, self.address)
        self._folder = tempfile.TemporaryDirectory(prefix="hearthlog-rerun-")
        self._log = Path(self._folder.name, "log.txt")
        command = [str(program()), "--bind", self.address, "--port", str(self.port), *arguments]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603 - the program is the package's own
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=_renderer() | os.environ | _own_configuration(Path(self._folder.name)),
                start_new_session=True,  # Ctrl-C is for the parent, which closes it
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Address for data: `rerun+http://…/proxy`."""
        return f"rerun+http://{self.address}:{self.port}/proxy"

    def is_running(self) -> bool:
        """Return whether the viewer runs; its user may have closed the window."""
        return self._process.poll() is None

    def wait_until_it_listens(self) -> None:
        """Wait until the viewer accepts data.

        Raise `DataError` if it ends instead, or takes longer than a minute.
        """
        deadline = time.monotonic() + _WAIT_SECONDS
        while time.monotonic() < deadline:
            with socket.socket() as probe:
                if probe.connect_ex((self.address, self.port)) == 0:
                    return
            if not self.is_running():
                raise self.failed()
            time.sleep(0.02)
        raise self.failed()

    def check(self) -> None:
        """Raise DataError with the last error of the log, if the viewer ended with an error."""
        if (self._process.poll() or 0) > 0:
            raise self.failed()

    def failed(self) -> DataError:
        """Return the error that explains from its log why the viewer does not run."""
        lines = self._log.read_text(errors="replace").splitlines()
        lines = [line for line in lines if not _BACKTRACE.match(line)]
        errors = [
            line for line in lines if "rror" in line or "panick" in line or "No graphics" in line
        ]
        text = (errors or lines or ["it said nothing"])[-1].strip()
        return DataError(
            f"Rerun's viewer does not run here ({text[:200]}); use --web for a browser"
        )

    def close(self) -> None:
        """Stop the viewer and delete its log."""
        self._process.terminate()
        try:
            self._process.wait(_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()


def _renderer() -> dict[str, str]:
    """Return environment variables that make OpenGL work without a graphics card."""
    has_card = any(any(Path("/dev").glob(pattern)) for pattern in _GRAPHICS_CARDS)
    if not sys.platform.startswith("linux") or has_card or find_library("EGL") is None:
        return {}
    return _OPENGL


def _own_configuration(folder: Path) -> dict[str, str]:
    """Return environment variables for a private viewer configuration.

    It disables statistics, and does not restore the layout of an earlier run.
    """
    configuration = folder / "rerun" / "analytics.json"
    configuration.parent.mkdir()
    statistics = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(configuration),
        "data_dir_path": str(folder),
    }
    configuration.write_text(json.dumps(statistics), "utf-8")
    return {"XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
