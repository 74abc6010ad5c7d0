"""Texts in a file of others neither steer a terminal nor end in a traceback."""

import json
import unicodedata
from dataclasses import replace
from functools import partial
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from mcap.records import Metadata
from rewriting import Log

from hearthlog.analyzer.logs.selection import array_names
from hearthlog.models.classifiers.model import PublicCollection
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import Topic

START = 1_772_348_400 * NANOSECONDS
STEERING = "\x1b]0;evil\x07\x9b31m\x00\r\n"
DEEP = "[" * 100_000


@pytest.fixture(scope="module")
def log(tmp_path_factory, day, model_file):
    """A log of ten seconds."""
    folder = tmp_path_factory.mktemp("log")
    samples, rate = soundfile.read(day, frames=10 * 16_000, dtype="int16")
    soundfile.write(folder / "sound.wav", samples, rate)
    settings = Settings(output=folder / "logs", model=model_file)
    (path,) = record(settings, FileSource([folder / "sound.wav"], START), Flag()).logs
    return path


@pytest.fixture
def hearthlog(capfd):
    return partial(run, capfd)


@pytest.fixture
def steering(log, tmp_path):
    """The log with labels that steer a terminal."""
    found = Log(log)
    for topic in ("/mic/segment", "/mic/label"):
        for message in found.messages(topic):
            found.change(message, label="speech" + STEERING)
    return found.write(tmp_path / log.name)


def with_metadata(log, folder, topic, **texts):
    """Write the log anew, with other texts in the metadata of a channel."""
    found = Log(log)
    found.named(topic).metadata.update(texts)
    return found.write(folder / log.name)


def controls(text):
    return {c for c in text if unicodedata.category(c) == "Cc"} - {"\n", "\t"}


def test_labels_as_csv_have_no_control_characters(hearthlog, steering, tmp_path):
    printed = hearthlog("cat", steering, "--topics", "/mic/segment", "--format", "csv")
    assert printed.returncode == 0
    assert hearthlog("export", steering, "-o", tmp_path / "all", "--format", "csv").returncode == 0
    for text in (printed.stdout, (tmp_path / "all" / "mic_label.csv").read_text()):
        assert controls(text) == set()
        assert "speech\N{REPLACEMENT CHARACTER}]0;evil" in text


def test_labels_for_audacity_have_no_control_characters(hearthlog, steering, tmp_path):
    output = tmp_path / "labels.txt"
    assert hearthlog("export", steering, "-o", output, "--topics", "/mic/segment").returncode == 0
    assert controls(output.read_text()) == set()
    assert output.read_text().count("\tspeech ]0;evil 31m\n") > 0


@pytest.mark.parametrize("form", ["text", "ndjson"])
def test_labels_as_lines_have_no_control_characters(hearthlog, steering, form):
    printed = hearthlog("cat", steering, "--format", form)
    assert controls(printed.stdout) == set()
    assert "speech\\u001b]0;evil" in printed.stdout


@pytest.mark.parametrize("words", ["--topics /none", "--format csv"])
def test_an_error_that_names_the_topics_of_a_file_is_one_line(hearthlog, log, tmp_path, words):
    found = Log(log)
    found.named("/mic/gap").topic = f"/{STEERING}/gap"
    result = hearthlog("cat", found.write(tmp_path / log.name), *words.split())
    assert result.returncode in {1, 2}
    assert "/mic/label" in result.stderr
    assert result.stderr[:-1].isprintable()


def test_an_error_is_one_line():
    assert str(LogError(f"{STEERING}.mcap: no log")) == " ]0;evil  31m   .mcap: no log"


def test_the_card_of_a_model_does_not_steer_the_terminal(hearthlog, model_file, tmp_path):
    model = load_model(model_file)
    source = PublicCollection(name="\x9b31m", licence="\x9b2J", clips=1)
    data = model.description.training_data.model_copy(update={"collections": [source]})
    about = model.description.model_copy(update={"training_data": data})
    save_model(replace(model, description=about), tmp_path / "a.safetensors")
    result = hearthlog("models", "show", "a", "--folder", tmp_path)
    assert result.returncode == 0
    assert controls(result.stdout) == set()
    assert "|\n- " not in result.stdout


@pytest.mark.parametrize("name", ['"\\ud800"', '"\\u001b"', '"\\u009b"', "1", "null"])
def test_names_that_cannot_be_printed_are_none(name):
    assert array_names({"values_names": f'["energy", {name}]'}, "values") == []


@pytest.mark.parametrize("names", ["\ud800", "\x1b", DEEP, "{}", ""])
@pytest.mark.parametrize(
    "words",
    [
        "cat LOG --format csv --topics /mic/label",
        "export LOG -o OUT.npz --topics /mic/label",
        "export LOG -o OUT.parquet --topics /mic/label",
        "review LOG --save OUT.rrd",
        "evaluate log LOG --reference LOG",
        "report LOG -o OUT.html",
    ],
)
def test_a_channel_with_unfit_names_ends_nothing_in_a_traceback(
    hearthlog, log, tmp_path, names, words
):
    if len(names) == 1:  # one of as many as there are
        others = json.loads(Log(log).named("/mic/label").metadata["probabilities_names"])
        names = json.dumps([names, *others[1:]])
    path = with_metadata(log, tmp_path, "/mic/label", probabilities_names=names)
    places = {"LOG": path}
    given = [places.get(word, word.replace("OUT", f"{tmp_path}/out")) for word in words.split()]
    assert hearthlog(*given).returncode in {0, 1, 3}


def test_a_log_whose_quality_of_service_is_a_bottomless_list_can_be_recovered(
    hearthlog, log, tmp_path
):
    path = with_metadata(log, tmp_path, "/mic/label", offered_qos_profiles=DEEP)
    assert hearthlog("recover", path, "-o", tmp_path / "saved.mcap").returncode == 0


@pytest.mark.parametrize(
    "began",
    ['{"label": 1e999, "start": 0, "frames": 0, "confidence": 0}', DEEP, "null", "{}", "1e999"],
)
def test_a_layer_that_says_nonsense_of_how_it_began_is_one_line(
    hearthlog, log, model_file, tmp_path, began
):
    copy = tmp_path / log.name
    copy.write_bytes(log.read_bytes())
    assert hearthlog("relabel", copy, "--model", model_file).returncode == 0
    (layer,) = tmp_path.glob("*.relabel-*.mcap")
    found = Log(layer)
    record = next(r for r in found.records() if isinstance(r, Metadata) and "began" in r.metadata)
    record.metadata["began"] = began
    layer.unlink()
    found.write(layer)
    result = hearthlog("relabel", copy, "--model", model_file)
    assert result.returncode == 1
    assert f"{layer}: is no layer of `relabel`; move it away" in result.stderr


def gap_on(topic, path):
    times = START + np.arange(3) * NANOSECONDS
    fields = {
        "header.stamp": times,
        "header.frame_id": "mic",
        "duration": np.full(3, NANOSECONDS // 4),
        "reason": "overrun",
        "frames_lost": np.full(3, 5, np.uint64),
    }
    writer = LogWriter(path, [Topic(topic, message_types.GAP)], {})
    writer.write_columns([TopicBatch(topic, times, fields)])
    return writer.finish()


@pytest.mark.parametrize("topic", ["gap", "/gap", "", "/"])
def test_gaps_of_no_microphone_are_catalogued_and_reported_as_none(hearthlog, log, tmp_path, topic):
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / log.name).write_bytes(log.read_bytes())
    gap_on(topic, logs / "home_20260301T060000Z.mcap")
    assert hearthlog("catalog", logs).returncode == 0
    assert hearthlog("report", logs, "-o", tmp_path / "day.html").returncode in {0, 3}
