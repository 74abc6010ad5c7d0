"""Fixtures that several tests share."""

import fcntl
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

# As in the command, and before the import of numpy: idle threads of BLAS burn a core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from brokers import broker
from command_server import FRESH_HEARTHLOG, HEARTHLOG, CommandPopen
from log_fixtures import record_logs
from microphones import labmic, labmic_plugin, pulse_daemon, pulse_microphone
from stores import bucket, in_memory, s3_account, throttled_account
from streams import camera, live_server

from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import load_scenario, read_manifest
from hearthlog.analyzer.training.train import (
    LAG_SECONDS,
    REACH_SECONDS,
    SHORTEST_SECONDS,
    default_transitions,
    train_model,
)
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.models.classifiers.model import Smoothing
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Rooms
from hearthlog.tools.home.simulate import write_day, write_training_set

# Its workers have 80 columns, whatever the terminal: tables there are as in a pipe elsewhere.
os.environ.pop("COLUMNS", None)

__all__ = [
    "FRESH_HEARTHLOG",
    "HEARTHLOG",
    "broker",
    "bucket",
    "camera",
    "in_memory",
    "labmic",
    "labmic_plugin",
    "live_server",
    "pulse_daemon",
    "pulse_microphone",
    "s3_account",
    "throttled_account",
]

_HOUSEHOLD = Path(__file__).parents[2] / "shared" / "data" / "household"
_CLIPS = Path(__file__).parent / "data" / "household"
os.environ["HEARTHLOG_MODEL"] = "none"  # unless a test names one
os.environ["HEARTHLOG_EMBEDDING"] = "none"  # whatever networks this machine has
subprocess.Popen = CommandPopen


def pytest_configure(config):
    """Draw the same random examples every time, unless `--hypothesis-seed` asks for others."""
    installed = config.pluginmanager.hasplugin("hypothesispytest")
    if installed and config.getoption("--hypothesis-seed") is None:
        from hypothesis import settings  # noqa: PLC0415

        settings.load_profile("ci")


@pytest.fixture(scope="session")
def household() -> Path:
    """Real labelled recordings: a collection where the machine has it, else clips of it."""
    return _HOUSEHOLD if (_HOUSEHOLD / "manifest.csv").exists() else _CLIPS


@pytest.fixture(scope="session")
def all_household() -> Path:
    """The collection, for what needs all classes, or was measured on it."""
    if not (_HOUSEHOLD / "manifest.csv").exists():
        pytest.skip("needs all household recordings, in ../shared/data/household")
    return _HOUSEHOLD


def spread_files(household: Path, count: int) -> list[Path]:
    """List about so many recordings, of all classes; all if there are fewer."""
    files = sorted(household.glob("*/*.flac"))
    return files[:: max(len(files) // count, 1)]


@pytest.fixture(scope="session")
def real_frames(household) -> np.ndarray:
    """Four minutes of real sound of all classes, as frames."""
    files = spread_files(household, 65)
    samples = np.concatenate([block for path in files for block in read_audio(path)])
    return samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)


@pytest.fixture
def hearthlog():
    """Run the command in a process of its own and return what came of it."""

    def run(*arguments, env=None, timeout=500):
        return subprocess.run(
            [*HEARTHLOG, *map(str, arguments)],
            capture_output=True,
            text=True,
            env={**os.environ, **(env or {})},
            timeout=timeout,
            check=False,
        )

    return run


def of_the_run(tmp_path_factory, name: str, write) -> Path:
    """Let one process of a test run write a folder, for all of them to read."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder = root / name
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (root / f"{name}.done").exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a process that did not finish it
            folder.mkdir()
            write(folder)
            (root / f"{name}.done").touch()
    return folder


@pytest.fixture(scope="session")
def training_set(tmp_path_factory) -> Path:
    """Simulated sounds of all labels, five clips each."""

    def write(folder):
        write_training_set(folder, clips_per_class=5, seed=11)

    return of_the_run(tmp_path_factory, "clips", write) / "manifest.csv"


@pytest.fixture(scope="session")
def model_file(tmp_path_factory, training_set) -> Path:
    """A model of the general scenario that merges labels, trained on simulated sounds.

    It does not say so, as the models that are in use are of real ones.
    """

    def write(folder):
        scenario = load_scenario("general")
        clips = [replace(clip, source="") for clip in read_manifest(training_set, scenario.labels)]
        data = build_dataset(clips, scenario, lambda *_: None)
        model = train_model(data, scenario, lambda *_: None, smoothing="merge")
        save_model(model, folder / "simulated.safetensors")

    return of_the_run(tmp_path_factory, "model", write) / "simulated.safetensors"


@pytest.fixture(scope="session")
def second_file(tmp_path_factory, training_set) -> Path:
    """A model that takes a whole second and no floor, and labels the middle of it."""

    def write(folder):
        method = replace(PAPER, feature_set=DEFAULT.name)
        scenario = load_scenario("general")
        clips = read_manifest(training_set, scenario.labels)
        data = build_dataset(clips, scenario, lambda *_: None)
        model = train_model(data, scenario, lambda *_: None, method, "merge")
        save_model(model, folder / "second.safetensors")

    return of_the_run(tmp_path_factory, "second", write) / "second.safetensors"


@pytest.fixture(scope="session")
def hmm_file(tmp_path_factory, model_file) -> Path:
    """The same model, with smoothing."""
    model = load_model(model_file)
    smoothing = Smoothing(
        method="hmm",
        lag_seconds=LAG_SECONDS,
        weight=0.4,
        reach_seconds=REACH_SECONDS,
        shortest_seconds=SHORTEST_SECONDS,
    )
    about = model.description.model_copy(update={"smoothing": smoothing})
    path = tmp_path_factory.mktemp("hmm") / "smoothed.safetensors"
    transitions = default_transitions(model.classes)
    save_model(replace(model, description=about, transitions=transitions), path)
    return path


@pytest.fixture(scope="session")
def day(tmp_path_factory) -> Path:
    """Three minutes of a simulated home, as FLAC."""

    def write(folder):
        write_day(folder / "day.flac", 3, seed=12, manifest=None)
        times = (1_772_348_400, 1_772_348_400)  # from a full hour on: it makes one log
        os.utime(folder / "day.flac", times)

    return of_the_run(tmp_path_factory, "day", write) / "day.flac"


@pytest.fixture(scope="session")
def sounds(household) -> list[Path]:
    """Real sounds of a home to record."""
    return spread_files(household, 52)


@pytest.fixture(scope="session")
def recorded(sounds, tmp_path_factory, model_file) -> Path:
    """A folder of logs with gaps, of a minute each; the last one, unfinished, is beside it."""
    return record_logs(sounds, tmp_path_factory.mktemp("logs"), model_file)


USUAL_RIGHTS = os.umask(0o022)
os.umask(USUAL_RIGHTS)


@pytest.fixture(autouse=True)
def usual_rights():
    """Give files the usual rights again, where a recorder ran in this process."""
    os.umask(USUAL_RIGHTS)
    yield
    os.umask(USUAL_RIGHTS)


@pytest.fixture
def refused(hearthlog):
    """Run a command that must fail with one line on stderr, and return that line."""

    def run(*arguments, status=1, env=None):
        result = hearthlog(*arguments, env=env)
        assert result.returncode == status, result
        assert result.stdout == ""
        assert result.stderr.startswith("hearthlog: ")
        assert result.stderr.count("\n") == 1
        return result.stderr.removeprefix("hearthlog: ").rstrip()

    return run


@pytest.fixture(scope="session")
def clip_library():
    """The clips that homes are composed of."""
    return ClipLibrary()


@pytest.fixture(scope="session")
def living_room():
    """A living room as its microphone hears it."""
    return Rooms("living_room", seed=1)


@pytest.fixture(scope="module")
def phone(tmp_path_factory):
    """A browser that is shown the page of a home."""
    from servedhome import Phone  # noqa: PLC0415  only with a page
    from viewers import browsing  # noqa: PLC0415  likewise

    with browsing("about:blank", tmp_path_factory.mktemp("browser")) as browser:
        yield Phone(browser)
