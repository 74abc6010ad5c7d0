"""Whatever lies in the folder where hearthlog is run, none of it is executed."""

import os
import subprocess
import sys

import pytest

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.review.viewer.process import program
from hearthlog.schemas.logs.files import find_logs

TRAPS = (
    "hearthlog/__init__.py",
    "recorder/__init__.py",
    "queue.py",
    "json.py",
    "pickle.py",
    "numpy.py",
    "schemas.py",
    "models.py",
)
AS_INSTALLED = [sys.executable, "-P", "-c", "from hearthlog.tools.cli.main import main; main()"]


@pytest.fixture
def trapped(tmp_path):
    """A folder of modules, each of which leaves its name behind when it is executed."""
    folder = tmp_path / "trapped"
    for name in TRAPS:
        module = folder / name
        module.parent.mkdir(parents=True, exist_ok=True)
        module.write_text(f"open({str(tmp_path / 'executed')!r}, 'a').write({name + ' '!r})\n")
    yield folder
    executed = tmp_path / "executed"
    assert not executed.exists(), f"executed: {executed.read_text()}"


def run(folder, *arguments, env=None):
    command = [*AS_INSTALLED, *map(str, arguments)]
    env = {**os.environ, **(env or {})}
    return subprocess.run(
        command, cwd=folder, env=env, capture_output=True, text=True, timeout=120, check=False
    )


def test_listing_the_microphones_executes_nothing_of_the_folder(trapped):
    result = run(trapped, "devices")
    assert "PortAudio crashed" not in result.stderr


def test_listening_executes_nothing_of_the_folder(trapped, labmic, tmp_path):
    # Without a microphone of this name the capture process says which there are.
    command = [*AS_INSTALLED, "record", "--device", "none", "-o", str(tmp_path / "logs")]
    env = {**os.environ, **labmic.env}
    with subprocess.Popen(command, cwd=trapped, env=env, stderr=subprocess.PIPE) as process:
        line = process.stderr.readline()
        process.terminate()
    expected = (
        b"hearthlog: mic: no microphone is called 'none'; there are 'labmic'; waiting for it\n"
    )
    assert line == expected


def test_recording_and_relabelling_execute_nothing_of_the_folder(
    trapped, tmp_path, day, model_file, hmm_file
):
    logs = tmp_path / "logs"
    recorded = run(trapped, "record", day, "--model", model_file, "-o", logs)
    assert recorded.returncode == 0, recorded.stderr
    labelled = run(trapped, "relabel", logs, "--model", hmm_file, "--workers", "2")
    assert labelled.returncode == 0, labelled.stderr
    assert len(find_logs(logs)) == 2


def test_where_rerun_is_missing_a_file_of_its_name_is_not_taken_for_it(trapped, monkeypatch):
    (trapped / "rerun").write_text("#!/bin/sh\n")
    (trapped / "rerun").chmod(0o755)
    monkeypatch.chdir(trapped)
    monkeypatch.setattr("hearthlog.analyzer.review.viewer.process.find_spec", lambda _: None)
    with pytest.raises(DataError, match="is not installed"):
        program()
