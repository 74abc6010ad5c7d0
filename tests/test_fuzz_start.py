"""Whatever a recorder is started with, it starts or says why not: soon, and in little memory."""

import json
import os
from datetime import UTC
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from fuzzing import Victim
from hypothesis import example, given
from hypothesis import strategies as st
from test_fuzz import BYTES, FEW, START, of_bytes

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import Settings, load_settings
from hearthlog.recorder.pause_schedule import PauseSchedule
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogError

CONFIGURATION = b"""\
node = "flat"
output = "logs"
max_bag_size = "50M"
timezone = "Europe/Berlin"
quiet_hours = ["22:00-06:30"]
never_keep = ["speech", 'a']
flush_seconds = 1.5

[[microphone]]
name = "kitchen"
device = "rtsp://user:secret@camera/1"
model = "none"
"""


def configured(path, _folder):
    """Load a configuration, and use what needs more than its values."""
    try:
        settings = load_settings(path, {}, {})
    except HearthlogError as error:
        check_line(str(error))
        raise
    settings.rest().describe()
    settings.keeping_rules()


def check_line(text):
    assert text.isprintable(), repr(text)
    assert len(text) < 2000


def configured_by_the_environment(path, _folder):
    variables = json.loads(path.read_bytes())
    before = dict(os.environ)
    try:
        os.environ.update({f"HEARTHLOG_{name}": value for name, value in variables.items()})
        configured(None, None)
    finally:
        os.environ.clear()
        os.environ.update(before)


def labelled(path, _folder):
    """Load a model, and label with it."""
    classifier = Classifier(load_model(path))
    assert classifier.feature_set


def recorded(path, _folder):
    """Take a file for a microphone; no more than it may hold is looked at."""
    frames = 0
    for event in FileSource([path], START).events(Flag()):
        frames += len(getattr(event, "stamps", ()))
        if frames > 100_000:
            break


def paused(path, folder):
    path.replace(folder / ".pause")
    rest = PauseSchedule([], UTC, folder)
    assert rest.reason() in {"", "paused"}
    rest.describe()


def victim_of(reader):
    @pytest.fixture(scope="module")
    def victim(tmp_path_factory):
        victim = Victim(tmp_path_factory.mktemp("victim"), (reader,))
        yield victim
        victim.close()

    return victim


of_configurations = victim_of(configured)
of_environments = victim_of(configured_by_the_environment)
of_models = victim_of(labelled)
of_sounds = victim_of(recorded)
of_pauses = victim_of(paused)


def changed(data, mutations):
    data = bytearray(data)
    of_bytes(data, mutations)
    return bytes(data)


MUTATIONS = st.lists(BYTES, min_size=1, max_size=5)
VALUES = st.recursive(
    st.one_of(st.integers(), st.floats(), st.booleans(), st.text(max_size=40)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.sampled_from("ab"), inner, max_size=2)
    ),
    max_leaves=6,
)
TEXTS = st.text(max_size=60).filter(lambda text: "\0" not in text)
KEYS = st.sampled_from([*Settings.model_fields, "microphone", "more"])


@FEW
@given(MUTATIONS)
def test_a_configuration_whose_bytes_were_changed(of_configurations, mutations):
    assert not of_configurations.read(changed(CONFIGURATION, mutations), "home.toml")


@FEW
@given(st.dictionaries(KEYS, VALUES, max_size=4))
@example({"output": "\0"})
@example({"timezone": "../" * 2000})
@example({"quiet_hours": ["22:00-06:30"] * 10_000})
@example({"microphone": [{"device": "rtsp://" + "[" * 1000}]})
@example({"max_bag_size": "9" * 4000 + "T", "max_bag_duration": 1e300})
def test_a_configuration_of_any_values(of_configurations, values):
    def toml(value):
        if isinstance(value, dict):
            return "{" + ", ".join(f"{key} = {toml(inner)}" for key, inner in value.items()) + "}"
        if isinstance(value, list):
            return "[" + ", ".join(map(toml, value)) + "]"
        return json.dumps(value)

    lines = "\n".join(f"{key} = {toml(value)}" for key, value in values.items())
    assert not of_configurations.read(lines.encode("utf-8", "replace"), "home.toml")


@FEW
@given(st.dictionaries(KEYS.map(str.upper), TEXTS, max_size=4))
@example({"MICROPHONE": "[" * 50_000})
@example({"MICROPHONE": '[{"name": "a", "device": "http://[::1"}]'})
@example({"NODE": "\udcff"})
def test_any_environment(of_environments, variables):
    assert not of_environments.read(json.dumps(variables).encode(), "variables.json")


@FEW
@given(MUTATIONS)
def test_a_model_file_whose_bytes_were_changed(of_models, model_file, mutations):
    data = changed(Path(model_file).read_bytes(), mutations)
    assert not of_models.read(data, "model.safetensors")


@pytest.fixture(scope="module")
def sounds_of(tmp_path_factory):
    """Two seconds of noise, as files of several kinds."""
    folder = tmp_path_factory.mktemp("sounds")
    noise = np.random.default_rng(0).normal(0, 0.1, (88_200, 2))
    for name in ("a.wav", "a.flac", "a.ogg", "a.aiff", "a.w64", "a.mp3"):
        soundfile.write(folder / name, noise, 44_100)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@FEW
@given(st.sampled_from(["a.wav", "a.flac", "a.ogg", "a.aiff", "a.w64", "a.mp3"]), MUTATIONS,
       st.booleans())  # fmt: skip
def test_an_audio_file_whose_bytes_were_changed(of_sounds, sounds_of, name, mutations, only_header):
    data = sounds_of[name]
    header = 200 if only_header else len(data)
    assert not of_sounds.read(changed(data[:header], mutations) + data[header:], name)


@FEW
@given(st.binary(max_size=100))
def test_any_content_of_the_file_that_pauses(of_pauses, content):
    assert not of_pauses.read(content, "pause")
