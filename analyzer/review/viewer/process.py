"""Rerun's program: found, started and stopped; it sends no statistics, and only we can reach it."""

import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Self

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.extras import remedy

HOST = "127.0.0.1"
_WAIT_SECONDS = 60
_STOP_SECONDS = 5
_BACKTRACE = re.compile(r"\s*\d+: ")


def program() -> Path:
    """Find the program of the package that we use, whatever else is installed.

    Raises
    ------
    DataError
        If it is not there.
    """
    spec = find_spec("rerun_cli")
    found = Path(spec.origin).with_name("rerun") if spec and spec.origin else None
    if found is None or not found.exists():
        raise DataError(f"Rerun's viewer is not installed; {remedy('rerun_cli')}")
    return found


def free_port(wanted: int | None = None) -> int:
    """Choose a port of this machine.

    Raises
    ------
    DataError
        If the port that is wanted is in use.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, wanted or 0))
        except OSError as error:
            raise DataError(
                f"port {wanted} is in use ({error.strerror}); choose another one with --port"
            ) from error
        return int(probe.getsockname()[1])


def check_display(instead: str) -> None:
    """Raise DataError where a window cannot be opened, which says what else there is."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in names):
        raise DataError(f"there is no display here: use --web to look in a browser, or {instead}")


class ViewerProcess:
    """A run of the program.

    Parameters
    ----------
    arguments : sequence of str
    port : int
        The one that it listens on, of this machine only.
    """

    def __init__(self, arguments: Sequence[str], port: int) -> None:
        self.port = port
        self._folder = tempfile.TemporaryDirectory(prefix="hearthlog-rerun-")
        self._log = Path(self._folder.name, "log.txt")
        command = [str(program()), "--bind", HOST, "--port", str(port), *arguments]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603 - the program is the package's own
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=os.environ | _apart(Path(self._folder.name)),
                start_new_session=True,  # Ctrl-C is for us: we close it in order
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Where data for it is sent to."""
        return f"rerun+http://{HOST}:{self.port}/proxy"

    def is_running(self) -> bool:
        """Tell whether it runs; somebody may have closed its window."""
        return self._process.poll() is None

    def wait_until_it_listens(self) -> None:
        """Wait until data can be sent to it.

        Raises
        ------
        DataError
            If it ends instead, or takes too long.
        """
        deadline = time.monotonic() + _WAIT_SECONDS
        while time.monotonic() < deadline:
            with socket.socket() as probe:
                if probe.connect_ex((HOST, self.port)) == 0:
                    return
            if not self.is_running():
                raise self.failed()
            time.sleep(0.02)
        raise self.failed()

    def check(self) -> None:
        """Raise DataError if it ended because it could not go on."""
        if (self._process.poll() or 0) > 0:
            raise self.failed()

    def failed(self) -> DataError:
        """Make the error that says why it does not run."""
        lines = self._log.read_text(errors="replace").splitlines()
        lines = [line for line in lines if not _BACKTRACE.match(line)]
        why = [
            line for line in lines if "rror" in line or "panick" in line or "No graphics" in line
        ]
        text = (why or lines or ["it said nothing"])[-1].strip()
        return DataError(
            f"Rerun's viewer does not run here ({text[:200]}); use --web to look in a browser"
        )

    def close(self) -> None:
        """Stop it."""
        self._process.terminate()
        try:
            self._process.wait(_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()


def _apart(folder: Path) -> dict[str, str]:
    """Keep the program apart from other runs of it.

    It sends nothing to its makers, and does not lay a timeline out as an earlier one was.
    """
    configuration = folder / "rerun" / "analytics.json"
    configuration.parent.mkdir()
    about = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(configuration),
        "data_dir_path": str(folder),
    }
    configuration.write_text(json.dumps(about), "utf-8")
    return {"XDG_CONFIG_HOME": str(folder), "XDG_DATA_HOME": str(folder)}
