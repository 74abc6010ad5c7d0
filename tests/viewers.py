"""Rerun's viewer, run without a screen."""

import json
import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from rerun.experimental import ViewerClient

_WAIT_SECONDS = 120
_DRAW_SECONDS = 2


def rerun_home(folder: Path) -> dict[str, str]:
    """An environment in which Rerun keeps its files in a folder of its own."""
    return {"XDG_CONFIG_HOME": str(folder / "config"), "XDG_DATA_HOME": str(folder / "data")}


@pytest.fixture
def viewer(tmp_path, monkeypatch):
    """Rerun's viewer; it asks for a Vulkan driver, such as Mesa's llvmpipe."""
    for name, value in rerun_home(tmp_path).items():
        monkeypatch.setenv(name, value)
    configuration = tmp_path / "config" / "rerun" / "analytics.json"
    configuration.parent.mkdir(parents=True)
    statistics = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(configuration),
        "data_dir_path": str(tmp_path / "data"),
    }
    configuration.write_text(json.dumps(statistics))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = Path(sys.executable).with_name("rerun")
    try:
        client = ViewerClient.spawn(headless=True, port=port, executable_path=str(program))
        client.get_state()
    except ConnectionError as error:
        if os.environ.get("HEARTHLOG_REQUIRE_AUDIO") == "1":
            raise
        pytest.skip(f"Rerun's viewer does not run here: {error}")
    with client:
        yield client


def shown(client, path, views):
    """Open a file, wait until so many views are there, and return a picture and their state."""
    client.open([str(path)])
    _patiently(client.get_state, lambda state: not state.loading and len(state.views) >= views)
    time.sleep(_DRAW_SECONDS)
    return _patiently(client.take_screenshot), _patiently(client.get_state)


def _patiently(operation, is_enough=lambda _: True):
    """Ask the viewer until it answers what is wanted; on a busy machine it paints slowly."""
    deadline = time.monotonic() + _WAIT_SECONDS
    while True:
        answer = "the viewer does not answer"
        with suppress(TimeoutError):
            answer = operation()
            if is_enough(answer):
                return answer
        assert time.monotonic() < deadline, answer
        time.sleep(0.1)
