"""The examples run as they stand, and every one of them is named in their README."""

import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from datetime import date
from pathlib import Path

import pytest
from conftest import HEARTHLOG
from homelife import write_day

from hearthlog.tools.home.simulate import write_training_set

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def logs(day, model_file, tmp_path_factory):
    """Three minutes of a home."""
    folder = tmp_path_factory.mktemp("examples") / "logs"
    start = ["--start", "2026-03-01T06:58:30"]
    command = [*HEARTHLOG, "record", day, "--model", model_file, "--output", folder, *start]
    subprocess.run(command, check=True, capture_output=True)
    return folder


def example(name, *arguments, cwd=None):
    """Run an example, and return what it printed."""
    command = [sys.executable, EXAMPLES / name, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_sound_file_becomes_labels(model_file, day):
    lines = example("label_sound.py", model_file, day).splitlines()
    assert re.fullmatch(r" +0\.\d\d s +\d+\.\d\d s  silence +[01]\.\d\d", lines[0])
    assert float(lines[-1].split()[2]) == pytest.approx(180)


def test_a_day_becomes_a_table_of_its_hours(logs):
    printed = example("day_in_pandas.py", logs, "2026-03-01", "Europe/Vienna")
    assert "silence" in printed
    assert re.findall(r"^(\d+) ", printed, re.MULTILINE) == ["7", "8"] * 2


def test_a_week_becomes_a_picture(tmp_path):
    for number in range(1, 8):
        events = [(3600.0 * number, 900.0, "coughing", 0.9), (43_200.0, 3600.0, "speech", 0.8)]
        write_day(tmp_path / "logs", date(2026, 3, number), events, file_hours=24)
    example("plot_week.py", tmp_path / "logs", tmp_path / "week.png")
    assert (tmp_path / "week.png").read_bytes().startswith(b"\x89PNG")


def wait_until_watching(process):
    """Wait until a process is told by the kernel of what changes in a folder."""
    deadline = time.monotonic() + 120
    is_watching = False
    while not is_watching:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
        with suppress(FileNotFoundError):  # it closes one
            descriptors = Path(f"/proc/{process.pid}/fdinfo").iterdir()
            is_watching = any("inotify wd" in each.read_text() for each in descriptors)


def test_labels_are_printed_while_they_are_recorded(day, model_file, tmp_path):
    (tmp_path / "logs").mkdir()
    command = [sys.executable, EXAMPLES / "follow_live.py", tmp_path / "logs"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as following:
        wait_until_watching(following)
        record = ["record", day, "--model", model_file, "--output", tmp_path / "logs"]
        subprocess.run([*HEARTHLOG, *record], check=True, capture_output=True)
        line = following.stdout.readline()
        following.send_signal(signal.SIGINT)
        following.stdout.read()
        assert following.wait(20) == 0
    assert re.fullmatch(r"\d\d:\d\d:\d\d\.\d{6} silence\n", line)


def test_two_ways_to_learn_are_compared(training_set, tmp_path):
    others = write_training_set(tmp_path / "others", clips_per_class=3, seed=77)
    printed = example("train_and_compare.py", training_set, others, "bathroom", cwd=tmp_path)
    assert re.search(r"^paper  macro F1 0\.\d{3}, cross-validated$", printed, re.MULTILINE)
    assert "bands - paper: " in printed
    assert len(list(tmp_path.glob("*.safetensors"))) == 1


def test_the_readme_has_a_line_for_each():
    text = (EXAMPLES / "README.md").read_text("utf-8")
    names = {path.name for path in EXAMPLES.iterdir()} - {"README.md"}
    assert set(re.findall(r"^- \[`(.+?)`\]", text, re.MULTILINE)) == names


@pytest.mark.parametrize("name", [path.name for path in EXAMPLES.glob("*.py")])
def test_an_example_without_arguments_says_how_it_is_used(name):
    done = subprocess.run(
        [sys.executable, EXAMPLES / name], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert f"python {name} " in done.stderr
    assert "Traceback" not in done.stderr


def test_an_example_ends_at_an_error_with_its_line(tmp_path):
    command = [sys.executable, EXAMPLES / "plot_week.py", tmp_path, tmp_path / "week.png"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, f"{tmp_path}: no log (*.mcap) in this folder\n")


@pytest.mark.parametrize(
    ("name", "lacks"),
    [
        ("day_in_pandas.py", "pandas"),
        ("plot_week.py", "matplotlib"),
        ("train_and_compare.py", "sklearn"),
    ],
)
def test_an_example_that_lacks_something_says_in_a_line_what_to_install(name, lacks, tmp_path):
    code = (
        f"import runpy, sys; sys.modules[{lacks!r}] = None; sys.argv = [{name!r}, *'abc']\n"
        f"runpy.run_path({str(EXAMPLES / name)!r}, run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "[headless]'" in line
