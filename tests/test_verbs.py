"""Every verb, as it is installed, in a folder whose files have the names of modules."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from hearthlog.analyzer.http import free_port
from hearthlog.tools.cli.main import make_app
from hearthlog.tools.home.simulate import write_day, write_training_set

pytestmark = pytest.mark.fast

HEARTHLOG = str(Path(sys.executable).with_name("hearthlog"))
PACKAGES = ("hearthlog", "recorder", "tools")
MODULES = ("analyzer", "models", "numpy", "queue", "schemas", "typing")
TRAP = "open(__file__ + '.sprung', 'w').close()\nraise ImportError(__file__)\n"

# In this order: what one writes, the next ones read.
MAKING = (
    "train --data clips --scenario bathroom --output first.safetensors",
    "record day.flac --model first.safetensors --start 2026-03-01T06:59 --output logs",
    "relabel logs --model first.safetensors --workers 2",
    "annotate import logs day.txt",
)
READING = (
    "info logs",
    "retain --dry-run",
    "manifest folder clips --output folder.csv",
    "catalog logs",
    "cat logs --topics /mic/segment",
    "export logs --topics /mic/label --output label.parquet",
    "annotate export logs --output marks.eaf",
    "cut logs --end 2026-03-01T07:00 --output early.mcap",
    "merge logs --output all.mcap",
    "doctor logs",
    "recover cut.mcap --output whole.mcap",
    "enrol coughing --home home --file clips/coughing/coughing_001.flac",
    "train --base first.safetensors --home logs --output adapted.safetensors",
    "evaluate model first.safetensors --data clips",
    "diff logs live first",
    "discover logs --least 2",
    "voices --help",
    "report logs --day 2026-03-01 --output day.html",
    "events logs --day 2026-03-01",
    "replay logs --model first.safetensors",
    "models list --folder .",
    "pause logs --for 1h",
    "resume logs",
    "config schema",
    "alerts replay logs --config rules.toml",
)
DRAWING = (
    "review logs --save day.rrd",
    "replay logs --model first.safetensors --output again.rrd",
    "demo --minutes 1",
)
LISTENING = (
    "devices",
    "setup --no-service --yes --config set-up.toml",
    "enrol coughing --home listened --microphone labmic --seconds 1",
)
RECORDING = "record --device labmic --output heard"
WATCHING = "watch logs --serve"
BRIDGING = "bridge unrecorded --config home.toml"
TOLD = '[bridge.ping]\nurl = "http://127.0.0.1:9"\n'
RULES = """
[[bridge.alert]]
name = "much water"
rule = "more_than"
class = "tap_water"
count = 1
window = "1h"
"""
INSTALLING = "install-service --user"
LOST = 3
needs_viewer = pytest.mark.skipif(find_spec("rerun") is None, reason="needs hearthlog[viewer]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with sounds to learn from, a day, what was made of them, and traps."""
    folder = tmp_path_factory.mktemp("traps")
    for path in [
        *(f"{name}/__init__.py" for name in PACKAGES),
        *(f"{name}.py" for name in MODULES),
    ]:
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(TRAP)
    write_training_set(folder / "clips", clips_per_class=3, seed=1)
    write_day(folder / "day.flac", 2, seed=2, manifest=None)
    make_private(folder)
    for command in MAKING:
        result = run(folder, command)
        assert (result.returncode, sprung(folder)) == (0, []), f"{command}: {result.stderr}"
    (folder / "home.toml").write_text(TOLD)
    (folder / "rules.toml").write_text(RULES)
    full = min(folder.glob("logs/**/*Z.mcap")).read_bytes()
    (folder / "cut.mcap").write_bytes(full[: len(full) // 2])
    assert {path.name for path in exposed(folder)} == {"home.toml", "rules.toml", "cut.mcap"}
    make_private(folder)
    return folder


def exposed(folder):
    """List what others of this machine may look into."""
    made = (path for path in folder.rglob("*") if not path.is_symlink())
    return [path for path in made if path.stat().st_mode & 0o077]


def make_private(folder):
    for path in exposed(folder):
        path.chmod(0o700 if path.is_dir() else 0o600)


def run(folder, command, env=None):
    return subprocess.run(
        [HEARTHLOG, *shlex.split(command)],
        cwd=folder, env=env, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
        umask=0o022,
    )  # fmt: skip


@contextmanager
def running(folder, command, env=None):
    """Start a verb that runs until it is asked to stop, which it is at the end."""
    with subprocess.Popen(
        [HEARTHLOG, *shlex.split(command)],
        cwd=folder, env=env, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        umask=0o022,
    ) as process:  # fmt: skip
        try:
            yield process
            process.send_signal(signal.SIGINT)
            process.wait()
        finally:
            process.kill()


def sprung(folder):
    """Name the files of the folder that were imported, and set them up again."""
    marks = sorted(folder.rglob("*.sprung"))
    for mark in marks:
        mark.unlink()
    return [str(mark.relative_to(folder)) for mark in marks]


def test_every_verb_is_tried_here():
    commands = (*MAKING, *READING, *DRAWING, *LISTENING, RECORDING, WATCHING, BRIDGING, INSTALLING)
    tried = {command.split()[0] for command in commands}
    assert tried == set(typer.main.get_command(make_app()).commands)


def test_every_verb_says_what_it_does():
    for words, command in verbs(typer.main.get_command(make_app())):
        result = CliRunner().invoke(make_app(), [*words, "--help"])
        assert result.exit_code == 0, result.output
        assert command.help.splitlines()[0][:40] in result.output


def verbs(command, words=()):
    yield words, command
    for name, part in getattr(command, "commands", {}).items():
        yield from verbs(part, (*words, name))


def test_the_traps_work(folder):
    for name in (*PACKAGES, *MODULES):
        result = subprocess.run([sys.executable, "-Bc", f"import {name}"], cwd=folder, check=False)
        assert result.returncode == 1
    assert len(sprung(folder)) == len(PACKAGES) + len(MODULES)


@pytest.mark.parametrize("command", READING)
def test_a_verb_imports_nothing_of_the_folder_and_writes_for_nobody_else(folder, command):
    result = run(folder, command)
    lost = command.startswith(("recover", "evaluate"))  # the model has learned from these clips
    assert result.returncode == (LOST if lost else 0), result.stderr
    assert (sprung(folder), exposed(folder)) == ([], [])


@needs_viewer
@pytest.mark.parametrize("command", DRAWING)
def test_a_verb_that_draws_imports_nothing_and_writes_for_nobody_else(folder, command):
    result = run(folder, command)
    assert result.returncode == 0, result.stderr
    assert (sprung(folder), exposed(folder)) == ([], [])


@needs_viewer
def test_watching_imports_nothing_of_the_folder(folder):
    with running(folder, f"{WATCHING} --port {free_port()}") as process:
        assert "open with" in process.stderr.readline()
    assert process.returncode == 0
    assert sprung(folder) == []


def test_bridging_imports_nothing_of_the_folder(folder):
    with running(folder, BRIDGING) as process:
        assert "waiting for a recorder" in process.stderr.readline()
    assert process.returncode == 0
    assert (sprung(folder), exposed(folder)) == ([], [])


@pytest.mark.parametrize("command", LISTENING)
def test_a_verb_that_listens_imports_nothing_of_the_folder(folder, labmic, command):
    noise = np.random.default_rng(0).normal(0.0, 3000.0, 16_000)
    labmic.configure(data=noise.astype(np.int16))
    result = run(folder, command, labmic.env)
    assert (sprung(folder), exposed(folder)) == ([], [])
    assert result.returncode == 0, result.stderr


def test_recording_imports_nothing_of_the_folder(folder, labmic):
    with running(folder, RECORDING, labmic.env) as process:
        while process.poll() is None and not list(folder.glob("heard/**/*.active")):
            time.sleep(0.1)
    assert (sprung(folder), exposed(folder)) == ([], [])
    assert process.returncode == 0


@pytest.mark.skipif(find_spec("rerun") is not None, reason="hearthlog[viewer] is installed")
@pytest.mark.parametrize("command", [*DRAWING, WATCHING])
def test_without_a_viewer_a_verb_that_draws_says_in_a_line_what_to_install(folder, command):
    result = run(folder, command)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "pip install" in line


def test_installing_imports_nothing_of_the_folder(folder, tmp_path):
    (tmp_path / "systemctl").symlink_to(shutil.which("true"))
    own = {"PATH": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path), "XDG_RUNTIME_DIR": ""}
    result = run(folder, INSTALLING, os.environ | own)
    assert sprung(folder) == []
    assert result.returncode == 0, result.stderr
    assert f"WorkingDirectory={folder}\n" in Path(result.stdout.strip()).read_text("utf-8")
