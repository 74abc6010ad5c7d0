"""Every verb on the bare install, of a Raspberry Pi: it runs, or says at once what it needs."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import typer

import hearthlog.tools.home
from hearthlog.analyzer.http import free_port
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.tools.cli.main import make_app

pytestmark = pytest.mark.fast

# What only the extras bring. `make test-wheel` runs this file where none of it is installed.
OF_EXTRAS = (
    *("scipy", "sklearn", "hmmlearn", "joblib", "threadpoolctl", "matplotlib", "jinja2"),
    *("pyarrow", "pandas", "defusedxml", "rerun", "rerun_cli", "foxglove", "onnx", "onnxruntime"),
    *("paho", "apprise", "prometheus_client", "dask", "distributed", "fsspec", "s3fs", "upath"),
)
# In this order: what one writes, the next ones read.
RUNS = (
    "record evening.flac --start 2026-03-01T20:00 --keep-audio always",
    "info",
    "info logs --json",
    "relabel logs --model bathroom",
    "relabel logs --model general --json",
    "review --queue --save ten.txt",
    "annotate import logs ten.txt --yes",
    "annotate export logs --output marks.txt",
    "diff logs live bathroom",
    "diff logs live --queue --list queue.csv",
    "models list",
    "models show general",
    "models compare general home-1 --logs logs",
    "models promote home-1",
    "alerts replay logs --config rules.toml",
    "events logs",
    "enrol coughing --home logs --file evening.flac",
    "export logs --format wav --output clips",
    "export logs --topics /mic/label --output labels.npz",
    "cat logs --topics /mic/segment",
    "cut logs --end 2026-03-01T20:00:10 --output early.mcap",
    "merge logs --output all.mcap",
    "replay logs --model general",
    "doctor",
    "recover early.mcap --output whole.mcap",
    "retain --dry-run",
    "manifest folder sounds --output sounds.csv",
    "pause logs --for 1h",
    "resume logs",
    "config",
    "install-service --user",
    "bridge logs --config page.toml",
    "watch logs --text",
    "watch logs --layout home.json",
)
NEEDS = {
    "headless": (
        "report",
        "train --home logs",
        "train --data sounds.csv --scenario general --output general.safetensors",
        "catalog logs --export files.parquet",
        "export logs --topics /mic/label --output label.parquet",
        "discover logs",
        "evaluate log logs --reference marks.txt",
        "evaluate model general --data sounds.csv",
    ),
    "viewer": ("review", "review logs --save day.rrd", "watch logs"),
    "headless,viewer": ("demo",),
    "foxglove": ("watch logs --foxglove",),
    "bridge": ("bridge logs --config broker.toml",),
}
# There may be no microphone, and too little speech.
EITHER = ("devices", "voices", "setup --no-service --yes")
WRONG = "bridge nowhere/logs"
FILES = {
    "rules.toml": '[[bridge.alert]]\nname = "cough"\nrule = "more_than"\nclass = "coughing"\n'
    'count = 1\nwindow = "1h"\n',
    "page.toml": f"[bridge.page]\nport = {free_port()}\n",
    "broker.toml": '[bridge.mqtt]\nhost = "127.0.0.1"\n',
}
# Each in a fork of a process that has imported what most of them do. What runs until it is stopped
# is stopped as soon as it can be.
PROGRAM = """
import json, os, shlex, signal, sys
from pathlib import Path
for name in {of_extras}:
    sys.modules[name] = None
from hearthlog.tools.cli.main import main
import hearthlog.analyzer.promotion, hearthlog.analyzer.review.review_list
import hearthlog.analyzer.review.timeline_reader, hearthlog.recorder.recording
from hearthlog.schemas.messages.message_types import typestore
typestore()

def stop(*_):
    if signal.getsignal(signal.SIGINT) not in (signal.default_int_handler, signal.SIG_DFL):
        os.kill(os.getpid(), signal.SIGINT)

def run(command):
    for number, name in ((1, "../out"), (2, "../err")):
        os.dup2(os.open(name, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), number)
    if command.startswith(("bridge", "watch logs --text")):
        signal.signal(signal.SIGALRM, stop)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 0.5, 0.5)
    sys.argv = ["hearthlog", *shlex.split(command)]
    try:
        main()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)

done = {{}}
for command in json.load(sys.stdin):
    before = set(Path().rglob("*"))
    if not (child := os.fork()):
        run(command)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    made = sorted(map(str, set(Path().rglob("*")) - before))
    done[command] = status, Path("../out").read_text(), Path("../err").read_text(), made
json.dump(done, sys.stdout)
"""


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """What came of each command: status, results, messages and new files."""
    folder = tmp_path_factory.mktemp("bare") / "evening"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    (folder / "bin").mkdir()
    (folder / "bin/systemctl").symlink_to(shutil.which("true"))
    (folder / "models").mkdir()
    shutil.copy(starter_file(GENERAL), folder / "models/home-1.safetensors")
    clips = Path(hearthlog.tools.home.__file__).parent / "clips"
    parts = []
    for kind in ("coughing", "speech", "yelling"):
        (folder / "sounds" / kind).mkdir(parents=True)
        for path in sorted((clips / kind).glob("*_0[12].flac")):
            shutil.copy(path, folder / "sounds" / kind)
            sound, rate = soundfile.read(path)
            parts += [sound, np.random.default_rng(0).normal(0, 1e-3, 4 * rate)]
    soundfile.write(folder / "evening.flac", np.concatenate(parts), rate)
    commands = [*RUNS, *(command for group in NEEDS.values() for command in group), *EITHER, WRONG]
    own = {
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "HOME": str(folder),
        "XDG_CONFIG_HOME": str(folder / "config"),
        "XDG_RUNTIME_DIR": "",
    }
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(of_extras=OF_EXTRAS)],
        input=json.dumps(commands), cwd=folder, capture_output=True, text=True, check=False,
        env={key: value for key, value in os.environ.items() if "HEARTHLOG" not in key} | own,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_every_verb_is_tried_on_the_bare_install():
    commands = [*RUNS, *(command for group in NEEDS.values() for command in group), *EITHER]
    tried = {command.split()[0] for command in commands}
    assert tried == set(typer.main.get_command(make_app()).commands)


@pytest.mark.parametrize("command", RUNS)
def test_the_bare_install_runs_it(done, command):
    status, out, err, _ = done[command]
    assert (status, "not installed" in out + err) == (0, False), err


@pytest.mark.parametrize(
    ("extra", "command"), [(extra, command) for extra, group in NEEDS.items() for command in group]
)
def test_what_it_lacks_is_named_with_the_command_that_installs_it_before_anything_is_done(
    done, extra, command
):
    status, out, err, made = done[command]
    assert (status, out, made) == (1, "", [])
    (line,) = err.splitlines()
    assert re.match(r"hearthlog: \w[\w, -]+ not installed; try: ", line)
    assert "install" in line
    assert f"[{extra}]'" in line


def test_a_bridge_that_is_told_nothing_leaves_nothing_behind(done):
    status, out, err, made = done[WRONG]
    assert (status, out, made) == (2, "", [])
    assert err.startswith("hearthlog: no --config is given: ")


@pytest.mark.parametrize("command", EITHER)
def test_a_verb_that_finds_nothing_needs_no_extra_for_it(done, command):
    assert done[command][0] in {0, 1}
    assert "not installed" not in done[command][2]
