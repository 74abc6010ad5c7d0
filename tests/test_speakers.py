"""Who speaks is learned from people who are enrolled, and told beside everything else."""

import shutil

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

import numpy as np
import soundfile
from conversations import ALLISON, START, THEO, two_voices
from typer.testing import CliRunner

from hearthlog.analyzer.discover.speech import check_voices, is_of_two
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.marks.enrol import enrol_file, enrol_log
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.speakers import others_of, speaker_recordings, speakers_scenario
from hearthlog.analyzer.training.train import method_named
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.cli.main import make_app
from hearthlog.tools.lab.conversations import converse, record_samples

RATE = 16_000


def train(*words):
    options = "--scenario", "speakers", *map(str, words)
    return CliRunner().invoke(make_app(["train", "enrol"]), ["train", *options])


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return two_voices(tmp_path_factory.mktemp("clips"))


@pytest.fixture(scope="module")
def enrolled(clips, tmp_path_factory):
    """A training set in which each of two people is enrolled twice; their last clips are not."""
    folder = tmp_path_factory.mktemp("enrolled")
    for name, voice in (("theo", THEO), ("allison", ALLISON)):
        for number, clip in enumerate(clips[voice][:2]):
            path = folder / f"{name}{number}.wav"
            samples, turns = converse({voice: [clip]}, 16.0, number)
            output = [samples[int(t.start * RATE) : int(t.end * RATE)] for t in turns]
            soundfile.write(path, np.concatenate(output), RATE)
            enrol_file(folder / "voices", name, path)
    return folder / "voices"


@pytest.fixture(scope="module")
def model(enrolled, tmp_path_factory):
    """A model of who of them speaks."""
    path = tmp_path_factory.mktemp("model") / "speakers.safetensors"
    done = train("--home", enrolled, "-o", path)
    assert done.exit_code == 0, done.stderr
    return path, done.stdout


def labels_of(model, samples, folder):
    """Record samples with a model, and return the labels of segments by their length."""
    logs = record_samples(samples.astype(np.float32), folder, START, model)
    columns = read_columns(find_logs(logs))["/mic/segment"]
    seconds = {}
    for label, length in zip(columns["label"], columns["duration"], strict=True):
        seconds[label] = seconds.get(label, 0.0) + length / 1e9
    return seconds


def test_a_recorder_tells_who_of_those_that_are_enrolled_speaks(model, clips, tmp_path):
    path, reported = model
    assert load_model(path).classes == ("silence", "allison", "theo", "unknown")
    assert load_model(path).description.scenario_name == "speakers"
    assert "sources never split" in reported
    for name, voice in (("theo", THEO), ("allison", ALLISON)):
        samples, turns = converse({voice: clips[voice][2:]}, 30.0, 1)
        recorded = labels_of(path, samples, tmp_path / name)
        spoken = sum(turn.end - turn.start for turn in turns)
        assert recorded.get(name, 0.0) > 0.7 * spoken, recorded
        assert recorded[name] > 0.8 * (sum(recorded.values()) - recorded.get("silence", 0.0)), (
            recorded
        )


def test_other_sounds_are_nobody(model, household, tmp_path):
    samples = [soundfile.read(path)[0] for path in sorted(household.glob("coughing/*"))[:8]]
    recorded = labels_of(model[0], np.concatenate(samples), tmp_path)
    nobody = recorded.get("unknown", 0.0) + recorded.get("silence", 0.0)
    assert nobody > 0.7 * sum(recorded.values())


def test_the_same_enrolled_sound_gives_the_same_model(model, enrolled, tmp_path):
    again = tmp_path / "again.safetensors"
    train("--home", enrolled, "-o", again)
    assert load_model(again).sha256 == load_model(model[0]).sha256


def refusal(folder, tmp_path):
    path = tmp_path / "none.safetensors"
    done = train("--home", folder, "-o", path)
    assert isinstance(done.exception, DataError)
    assert not path.exists()
    assert str(done.exception).isprintable()
    return str(done.exception)


def test_somebody_enrolled_with_two_voices_is_refused(enrolled, clips, tmp_path):
    both = shutil.copytree(enrolled, tmp_path / "both")
    path = tmp_path / "other.wav"
    soundfile.write(path, np.concatenate(clips[ALLISON][2:]), RATE)
    enrol_file(both, "theo", path)
    output = refusal(both, tmp_path)
    assert "theo: two voices are heard in what is enrolled (2" in output
    assert "enrol the other voice under a name of its own" in output


def test_two_voices_are_two_and_one_is_one(clips):
    def values(*voices):
        samples = np.concatenate([np.concatenate(clips[voice]) for voice in voices])
        return DEFAULT.extractor()(samples[: len(samples) // 800 * 800].reshape(-1, 800))

    assert is_of_two(values(THEO, ALLISON), DEFAULT)
    assert not is_of_two(values(THEO), DEFAULT)
    assert not is_of_two(values(ALLISON), DEFAULT)


def test_silence_and_a_few_words_are_of_no_two_voices():
    silence = DEFAULT.extractor()(np.zeros((100, 800), np.float32))
    check_voices([recording("anna")._replace(features=silence)], DEFAULT)
    assert not is_of_two(silence[:0], DEFAULT)


def test_somebody_enrolled_once_is_asked_again(enrolled, tmp_path):
    once = shutil.copytree(enrolled, tmp_path / "once")
    latest = sorted(once.rglob("theo_*"))[-2:]
    for path in latest:
        path.unlink()
    output = refusal(once, tmp_path)
    assert "theo is enrolled once: enrol theo at another time, too" in output


def recording(label, group="a", seconds=12.0):
    values = np.ones((int(seconds * 20), DEFAULT.width), np.float32)
    return Recording(label, group, "", "", values)


def test_sounds_without_a_voice_enrol_nobody():
    with pytest.raises(DataError, match="nobody is enrolled; begin with `hearthlog enrol anna"):
        speakers_scenario([recording("speech"), recording("silence"), recording("Cough")])


def test_too_little_of_a_voice_is_told():
    with pytest.raises(DataError, match=r"anna is enrolled for 8\.0 s: 10 s are needed"):
        speakers_scenario([recording("anna", seconds=4), recording("anna", "b", 4)])


def test_the_speech_of_others_is_unknown():
    scenario = speakers_scenario([recording("anna"), recording("anna", "b"), recording("speech")])
    assert list(scenario.classes) == ["silence", "anna", "unknown"]
    assert scenario.find("speech", marked=True) == "unknown"
    assert scenario.find("Cough", marked=True) == "unknown"
    assert scenario.find("other", marked=True) == "unknown"
    assert scenario.find("silence", marked=True) == "silence"


@pytest.mark.parametrize("label", ["speech", "unknown"])
def test_a_guest_may_be_enrolled_once(enrolled, clips, tmp_path, label):
    home, path = shutil.copytree(enrolled, tmp_path / "home"), tmp_path / "guest.wav"
    soundfile.write(path, np.concatenate(clips[ALLISON][2:]), RATE)
    enrol_file(home, label, path)
    done = train("--home", home, "-o", tmp_path / "speakers.safetensors")
    assert done.exit_code == 0, done.exception
    learned = load_model(tmp_path / "speakers.safetensors").description.training_data
    assert learned.classes["unknown"].sources == 1


def test_what_is_cut_out_of_a_log_within_half_an_hour_is_one_source(clips, tmp_path):
    samples = np.tile(np.concatenate(clips[THEO]), 10)[: 16 * RATE].astype(np.float32)
    voices = tmp_path / "voices"
    for minutes in (0, 20, 40, 80):
        start = START + minutes * 60 * NANOSECONDS
        logs = record_samples(samples, tmp_path / str(minutes), start, starter_file(GENERAL))
        for label, first in (("theo", 0), ("theo", 4), ("ben", 8)):
            begin = start + first * NANOSECONDS
            enrol_log(voices, label, logs, begin, begin + 3 * NANOSECONDS)
    sources = {}
    for one in speaker_recordings([voices], DEFAULT):
        sources.setdefault(one.label, []).append(one.group)
    assert [len(sources["theo"]), len(set(sources["theo"]))] == [8, 2]
    assert [len(sources["ben"]), len(set(sources["ben"]))] == [4, 2]
    assert not set(sources["theo"]) & set(sources["ben"])


def test_what_the_starter_model_learned_is_silence_or_unknown():
    scenario = speakers_scenario([recording("anna"), recording("anna", "b")])
    general = load_model(starter_file(GENERAL))
    inputs, target = others_of(general, method_named("room"), scenario)
    assert len(inputs) == len(target)
    assert set(target.tolist()) == {0, 2}
    with pytest.raises(DataError, match=r"method bands cannot learn from .* how others sound"):
        others_of(general, method_named("bands"), scenario)


@pytest.mark.parametrize(
    "words", [(), ("--home", "voices"), ("--output", "a.safetensors"), ("--base", "general")]
)
def test_what_the_speakers_need_is_told(words):
    done = train(*words)
    assert done.exit_code == 2
    assert "--scenario speakers goes with --home and --output, and without --base" in done.stderr
