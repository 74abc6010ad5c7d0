"""The feature sets of others: as their papers define them, and from sound to labels."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import librosa
import numpy as np
import pytest
import scipy.linalg
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.recorder_info import features_of, read_recorder_infos
from hearthlog.analyzer.training.manifest import load_scenario
from hearthlog.analyzer.training.train import method_named
from hearthlog.models.features.installed import feature_set
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs

EXAMPLE = Path(__file__).parents[1] / "examples" / "feature-sets"
sys.path.insert(0, str(EXAMPLE))
from hearthlog_feature_sets import auditory_image, logmel, plp, prediction, rasta  # noqa: E402

SETS = [logmel.LOGMEL, plp.PLP, rasta.RASTA, auditory_image.SAI]
CLIPS = Path(__file__).parent / "data" / "household"


@pytest.fixture(params=SETS, ids=lambda one: one.name)
def features(request):
    return request.param


def noise(frames: int, seed: int = 1, loudness: float = 0.1) -> np.ndarray:
    samples = np.random.default_rng(seed).normal(0.0, loudness, (frames, FRAME_SAMPLES))
    return samples.astype(np.float32)


def tone(hertz: float, frames: int = 8, amplitude: float = 0.5) -> np.ndarray:
    time = np.arange(frames * FRAME_SAMPLES) / SAMPLE_RATE
    sound = amplitude * np.sin(2 * np.pi * hertz * time)
    return sound.astype(np.float32).reshape(frames, FRAME_SAMPLES)


@settings(max_examples=10)
@given(sizes=st.lists(st.integers(1, 40), min_size=1, max_size=8))
def test_blocks_of_any_size_give_the_same_bits(sizes):
    frames = noise(sum(sizes), len(sizes))
    for one in SETS:
        extract = one.extractor()
        complete = extract(frames)
        extract.restart()
        parts = [extract(part) for part in np.split(frames, np.cumsum(sizes)[:-1])]
        assert np.concatenate(parts).tobytes() == complete.tobytes(), one.name


def test_a_gap_leaves_no_trace(features):
    extract = features.extractor()
    extract(noise(10, 2))
    extract.restart()
    np.testing.assert_array_equal(extract(noise(10, 3)), features.extractor()(noise(10, 3)))


def test_any_samples_give_finite_values(features):
    frames = noise(12)
    frames[1], frames[2], frames[3], frames[4, ::3] = 0.0, np.nan, np.inf, 1e38
    values = features.extractor()(frames)
    assert np.isfinite(values).all()
    assert values.shape == (12, features.width)
    assert features.extractor()(frames[:0]).shape == (0, features.width)


def test_the_power_of_a_frame_follows_from_its_values(features):
    frames = noise(30)
    power = features.power(features.extractor()(frames))
    np.testing.assert_allclose(power, np.square(frames).mean(axis=1), rtol=0.01)


def test_mel_bands_are_those_of_librosa():
    weights = librosa.filters.mel(
        sr=SAMPLE_RATE, n_fft=FRAME_SAMPLES, n_mels=40, fmin=50.0, htk=True, norm=None
    )
    ours = logmel._mel_bank().T
    np.testing.assert_allclose(ours / ours.max(), weights / weights.max(), atol=1e-6)


def test_mel_bands_of_noise_add_up_to_its_power():
    values = logmel.LOGMEL.extractor()(noise(400))
    bands = logmel.LOGMEL.band_powers(values)
    assert bands[:, :-1].sum(axis=1).mean() / bands[:, -1].mean() == pytest.approx(1.0, abs=0.05)


def test_prediction_solves_the_normal_equations():
    sound = np.random.default_rng(4).normal(size=(5, 200))
    full = np.stack([np.correlate(row, row, "full")[199 : 199 + 13] for row in sound])
    coefficients, error = prediction.prediction(full)
    for row, solved, left in zip(full, coefficients, error, strict=True):
        exact = scipy.linalg.solve_toeplitz(row[:-1], -row[1:])
        np.testing.assert_allclose(solved, exact, atol=1e-6)
        assert left == pytest.approx(row[0] + row[1:] @ exact, rel=1e-6)


def test_cepstra_are_those_of_the_spectrum_of_the_model():
    bands = np.random.default_rng(5).uniform(1e-6, 1e-2, (3, prediction.BANDS))
    labelled = np.cbrt(bands * prediction._equal_loudness())
    labelled[:, 0], labelled[:, -1] = labelled[:, 1], labelled[:, -2]
    coefficients, error = prediction.prediction(np.fft.irfft(labelled, axis=1)[:, :13])
    filters = np.concatenate([np.ones((3, 1)), coefficients], axis=1)
    log_spectrum = np.log(error[:, np.newaxis] / np.abs(np.fft.rfft(filters, 4096, axis=1)) ** 2)
    exact = np.fft.irfft(log_spectrum, axis=1)[:, :13]
    np.testing.assert_allclose(prediction.cepstra_of(bands), exact, atol=1e-4)


def test_hearing_is_most_sensitive_between_two_and_five_kilohertz():
    curve = prediction._equal_loudness()
    centres = 600.0 * np.sinh(prediction._centres() / 6.0)
    assert 2000 < centres[curve.argmax()] < 5000
    low, middle = np.interp([100.0, 1000.0], centres, 10 * np.log10(curve + 1e-9))
    assert -30 < low - middle < -20  # at 40 dB
    assert curve[0] == 0.0
    assert (np.diff(curve[: curve.argmax() + 1]) > 0).all()


def test_a_tone_is_in_the_critical_band_around_it():
    centres = 600.0 * np.sinh(prediction._centres() / 6.0)
    for band in (5, 10, 15):
        powers = prediction.critical_bands(tone(centres[band]).astype(np.float64))[2]
        assert powers.argmax() == band
        assert powers[band] == pytest.approx(0.125, rel=0.2)
        assert powers[band + 2] > 3 * powers[band - 2]  # it masks what is above it


def test_rasta_hears_no_difference_in_gain_and_plp_does():
    frames = noise(100)
    quiet = frames * np.float32(0.25)
    changes = {
        one.name: np.abs(one.extractor()(frames) - one.extractor()(quiet))[60:, 1:].max()
        for one in (plp.PLP, rasta.RASTA)
    }
    assert changes["rasta"] < 0.01
    assert changes["plp"] > 0.5


def test_rasta_passes_changes_as_fast_as_speech_alone():
    def swing(hertz):
        time = np.arange(400 * FRAME_SAMPLES).reshape(400, FRAME_SAMPLES) / SAMPLE_RATE
        gain = np.exp(np.sin(2 * np.pi * hertz * time))
        values = rasta.RASTA.extractor()((noise(400) * gain).astype(np.float32))
        return values[100:, 1].std()

    assert swing(3.0) > 3 * swing(0.05)


def test_a_tone_keeps_its_amplitude_in_the_channel_around_it():
    centres = [
        np.angle(filter_[1] / -4) * SAMPLE_RATE / (2 * np.pi)
        for _, filter_ in auditory_image._gammatone_bank()
    ]
    assert centres[0] == pytest.approx(80.0)
    assert centres[-1] == pytest.approx(7000.0)
    for channel in (4, 12, 20):
        images = auditory_image.AuditoryImages()
        activity = images._activity(tone(centres[channel], 20).ravel().astype(np.float64))
        peaks = activity[:, -4000:].max(axis=1) ** 2
        assert peaks[channel] == pytest.approx(0.5, rel=0.02)
        assert peaks.argmax() == channel


def test_the_image_of_pulses_stands_still_at_their_period():
    frames = np.zeros((20, FRAME_SAMPLES), np.float32)
    frames.ravel()[::200] = 0.9  # 80 Hz, 12.5 ms
    images = auditory_image.AuditoryImages()
    pattern = images._activity(frames.ravel().astype(np.float64))
    image = auditory_image.stabilised(pattern[:, -560 - 4 * FRAME_SAMPLES :])
    high = image[:, 12:].mean(axis=1)  # channels that tell pulses apart
    assert (high[:, 195:206].max(axis=1) > 5 * high[:, 90:110].mean(axis=1)).all()
    np.testing.assert_allclose(high[0], high[3], rtol=0.3, atol=0.02)


def test_the_twelve_sounds_of_a_kitchen_are_a_scenario():
    scenario = load_scenario(str(EXAMPLE / "kitchen.toml"))
    assert len(scenario.classes) == 12
    assert scenario.find("tap_water") == "tap_water"


@pytest.mark.parametrize("name", [one.name for one in SETS])
def test_what_is_not_installed_names_the_distribution_that_brings_it(name):
    line = f"'{name}' is not installed; distribution hearthlog-feature-sets, in examples .* pro"
    with pytest.raises(ModelError, match=f"feature set {line}"):
        feature_set(name)
    with pytest.raises(DataError, match=f"method {line}"):
        method_named(name)


def test_a_classifier_that_is_not_installed_names_the_distribution_that_brings_it(hearthlog):
    done = hearthlog("evaluate", "method", "forest", "--data", "d", "--scenario", "bathroom")
    assert done.returncode == 2
    line = "method 'forest' is not installed; distribution hearthlog-classifiers, in examples "
    assert line in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> dict[str, str]:
    """The environment of commands that find the example installed."""
    folder = tmp_path_factory.mktemp("extension")
    source = shutil.copytree(EXAMPLE, folder / "source")  # a build leaves its traces in it
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", folder / "site", source], check=True, capture_output=True)
    path = os.pathsep.join(filter(None, [str(folder / "site"), os.environ.get("PYTHONPATH")]))
    return {"PYTHONPATH": path}


_COMMANDS = """
import json, sys
from typer.testing import CliRunner
from hearthlog.tools.cli.main import make_app
for words in json.loads(sys.argv[1]):
    done = CliRunner().invoke(make_app(words[:1]), words)
    print(json.dumps([done.exit_code, done.stdout, str(done.exception)]))
"""


def run(env, *commands):
    """Run commands in one process; return exit status, output and error of each."""
    words = json.dumps([[str(word) for word in one] for one in commands])
    python = [sys.executable, "-P", "-c", _COMMANDS, words]
    done = subprocess.run(python, capture_output=True, text=True, env=os.environ | env, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_real_sound_is_learned_recorded_and_replayed(installed, tmp_path):
    scenario, sound = tmp_path / "few.toml", tmp_path / "evening.flac"
    scenario.write_text('[classes]\ncoughing = ["coughing"]\nother = ["objects_activity"]\n')
    files = sorted(CLIPS.glob("*/*.flac"))[::6]
    blocks = [block for file in files for block in read_audio(file)]
    soundfile.write(sound, np.concatenate(blocks)[: 40 * SAMPLE_RATE], SAMPLE_RATE)
    model, logs = tmp_path / "rasta.safetensors", tmp_path / "logs"
    requested = ["--data", CLIPS / "manifest.csv", "--scenario", scenario, "--method", "rasta"]
    trained, recorded, replayed = run(
        installed,
        ["train", *requested, "-o", model],
        ["record", sound, "--model", model, "-o", logs],
        ["replay", logs, "--model", model, "--json"],
    )
    assert trained[0] in {0, 3}, trained
    assert recorded[0] == 0, recorded
    info = read_columns(find_logs(logs), ["/mic/info"])["/mic/info"]
    assert info["feature_set"][0] == "rasta"
    compared = json.loads(replayed[1])["compared"]
    assert compared["identical_labels"] == compared["labels"] == 40 * 20 - 19
    (origin,) = read_recorder_infos(find_logs(logs)[0], "features")
    with pytest.raises(LogError, match=r"the recorder had it from hearthlog-feature-sets 1\.0\.0"):
        features_of(origin)
