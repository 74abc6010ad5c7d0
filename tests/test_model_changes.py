"""Another model takes over while the recorder runs: no sound is lost, the log says from when."""

import os
import re
import shutil
import signal
import subprocess
import time
from contextlib import chdir, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
import waiting
from conftest import HEARTHLOG
from log_fixtures import run
from logreader import LogReader
from logs import features, labelled_frames, read
from model_folders import keep_models, put_by_hand

from hearthlog.models.classifiers.classifier import Classifier, label_timing
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, model_card
from hearthlog.models.registry import override_judgement, promote
from hearthlog.models.starter import SHA256, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch
from hearthlog.recorder.recording_session import RecordingSession
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.logs.files import find_logs

MICROPHONE = SimpleNamespace(device="test")
SECOND = 1_000_000_000
START = 1_772_348_400 * SECOND


@pytest.fixture
def folder(tmp_path, model_file):
    return keep_models(tmp_path / "models", model_file)


@contextmanager
def recording(folder, logs, *arguments, env=None):
    """Run `hearthlog record` with the champion; at the end it is asked to stop."""
    command = [*HEARTHLOG, "record", *map(str, arguments), "-o", str(logs)]
    command += ["--model", str(folder / "champion.safetensors"), "--max-bag-duration", "86400"]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, env=env, text=True) as process:
        try:
            yield process
            process.send_signal(signal.SIGTERM)
            process.errors = process.communicate(timeout=60)[1]
        finally:
            process.kill()


def wait_for(condition, seconds=120):
    def holds():
        with suppress(LogError):  # a log is completed, and gets its name, at any time
            return condition()

    waiting.wait_for(holds, seconds)


def count(logs, kind):
    with suppress(LogError):
        return len(read(logs, kind)) if logs.exists() and list(logs.rglob("*.mcap*")) else 0
    return 0


def output(logs, level=None):
    lines = [
        item.decode() for log in find_logs(logs) for item in LogReader(log).messages(["/rosout"])
    ]
    return [line.msg for line in lines if level in {None, line.level}]


def labels_by(model_path, logs):
    """Labels of a model that has heard everything in some logs, by frame."""
    pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_path)))
    frames, stamps, values = features(logs)
    records = pipeline.push_features(values, int(frames[0]), stamps)
    labels = [record.data for record in records if record.topic == "/mic/label"]
    timing = label_timing(load_model(model_path).description)
    return dict(zip(labelled_frames(frames, timing).tolist(), labels, strict=True))


def recorded_labels(log):
    messages = list(LogReader(log).messages(["/mic/label"]))
    return {item.decode().frame: item.data for item in messages}


def check_swap(folder, logs, names):
    """See that each model labelled its own log, and that they are one recording without a hole."""
    frames, _, _ = features(logs)
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    assert [message.frame for message in read(logs, "statistics")] == frames[::20].tolist()
    paths = find_logs(logs)
    assert [info.model for info in read(logs, "info")] == names
    labelled, delays, firsts = [], [], []
    for path, name in zip(paths, names, strict=True):
        model = load_model(folder / f"{name}.safetensors")
        about = LogReader(path)
        assert about.metadata["hearthlog"]["model_sha256"] == model.sha256
        assert about.attachments["model_card.md"] == model_card(model).encode()
        found, wanted = recorded_labels(path), labels_by(folder / f"{name}.safetensors", logs)
        assert found == {frame: wanted[frame] for frame in found}
        labelled.append(list(found))
        delays.append(label_timing(model.description).delay)
        firsts.append(int(features(path)[0][0]))
    # Each speaks of what the one before had not heard enough of, and cannot look further back.
    begins = [labelled[0][0]]
    begins += [first - min(pair) for first, pair in zip(firsts[1:], pairwise(delays), strict=True)]
    ends = [end - delay for end, delay in zip([*firsts[1:], len(frames)], delays, strict=True)]
    spoken = [list(range(*span)) for span in zip(begins, ends, strict=True)]
    assert labelled == spoken
    for path, name in zip(paths[1:], names[1:], strict=True):
        first = features(path)[0][0]
        digest = load_model(folder / f"{name}.safetensors").sha256[:12]
        assert f"model {name} ({digest}) from frame {first} on" in output(path)
    segments = read(logs, "segment")
    spans = [(s.header.stamp.sec * SECOND + s.header.stamp.nanosec, s.duration) for s in segments]
    for (start, duration), (following, _) in pairwise(spans):
        assert start + duration.sec * SECOND + duration.nanosec == following


@pytest.mark.parametrize("names", [["one", "two"], ["one", "broad"], ["broad", "two"]])
def test_a_promoted_model_speaks_from_a_frame_on_and_nothing_is_lost(
    folder, tmp_path, day, capfd, names
):
    put_by_hand(folder, f"{names[0]}.safetensors")
    logs = tmp_path / "logs"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00") as process:
        wait_for(lambda: count(logs, "label") > 20)
        promote(folder, names[1])
        wait_for(lambda: len(list(logs.rglob("*.mcap*"))) == 2 and count(logs, "info") == 2)
        before = count(logs, "label")
        wait_for(lambda: count(logs, "label") > before + 20)
    assert (process.returncode, process.errors) == (0, "")
    check_swap(folder, logs, names)
    sound = np.concatenate(list(read_audio(day)))
    values = features(logs)[2]
    recorded = sound[: len(values) * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    np.testing.assert_array_equal(values, DEFAULT.extractor()(recorded))
    assert run(capfd, "doctor", logs).returncode == 0
    with chdir(tmp_path):  # the models are looked for in `models`
        result = run(capfd, "replay", logs, "-o", tmp_path / "again")
    assert result.returncode == 0, result.stderr
    for log in find_logs(logs):
        again = LogReader(tmp_path / "again" / log.relative_to(logs)).messages()
        assert [(m.topic, m.log_time, m.data) for m in again] == [
            (m.topic, m.log_time, m.data) for m in LogReader(log).messages()
        ]


def test_one_model_for_logs_of_two_gives_what_it_would_have_given_alone(
    folder, tmp_path, day, capfd
):
    logs = tmp_path / "logs"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00"):
        wait_for(lambda: count(logs, "label") > 20)
        promote(folder, "two")
        wait_for(lambda: count(logs, "info") == 2)
    other = folder / "broad.safetensors"
    result = run(capfd, "replay", logs, "--model", other, "-o", tmp_path / "again")
    assert result.returncode == 0, result.stderr
    (log,) = find_logs(tmp_path / "again")
    assert recorded_labels(log) == labels_by(other, logs)


def test_a_microphone_is_heard_on_while_the_model_changes(folder, tmp_path, labmic):
    rng = np.random.default_rng(5)
    labmic.configure(data=rng.normal(0, 3000, 16_000 * 7 + 311).astype(np.int16))
    logs = tmp_path / "logs"
    with recording(folder, logs, "--device", labmic.device, env=labmic.env) as process:
        for number, name in enumerate(["two", "broad"], 2):
            before = count(logs, "label")
            wait_for(lambda before=before: count(logs, "label") > before + 10)
            promote(folder, name)
            process.send_signal(signal.SIGHUP)
            wait_for(lambda number=number: count(logs, "info") == number)
    assert (process.returncode, process.errors) == (0, "")
    check_swap(folder, logs, ["one", "two", "broad"])


def test_a_bad_model_is_refused_once_and_the_old_one_goes_on(folder, tmp_path, day, capfd):
    logs = tmp_path / "logs"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00") as process:
        wait_for(lambda: count(logs, "label") > 0)
        (folder / "bad.safetensors").write_bytes(b"garbage" * 100)
        put_by_hand(folder, "bad.safetensors")
        wait_for(lambda: len(output(logs, level=30)) == 1)
        time.sleep(2.5)  # it is looked at again and again
        assert len(output(logs, level=30)) == 1
        process.send_signal(signal.SIGHUP)
        wait_for(lambda: len(output(logs, level=30)) == 2)
        (folder / "champion.safetensors").unlink()
        wait_for(lambda: len(output(logs, level=30)) == 3)
        promote(folder, "two")
        wait_for(lambda: count(logs, "info") == 2)
    assert process.returncode == 3
    refused = output(logs, level=30)
    assert process.errors.splitlines() == [f"hearthlog: {line}" for line in refused]
    assert [line.startswith("model champion refused: ") for line in refused] == [True] * 3
    assert [line.endswith("; going on with one") for line in refused] == [True] * 3
    assert "bad.safetensors: is not a model file" in refused[0] == refused[1]
    assert "no such model file" in refused[2]
    found = [s for m in read(logs, "diagnostics") for s in m.status if s.name.endswith(" model")]
    assert [status.level for status in found] == [1, 1, 1, 0]
    check_swap(folder, logs, ["one", "two"])
    checked = run(capfd, "doctor", logs)
    assert (checked.returncode, checked.stdout.count("[health]")) == (3, 2)


def test_a_bad_model_at_the_start_is_an_error(folder, tmp_path, day, hearthlog):
    put_by_hand(folder, "gone.safetensors")
    link = folder / "champion.safetensors"
    result = hearthlog("record", day, "--model", link, "-o", tmp_path / "logs")
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert not list((tmp_path / "logs").rglob("*.mcap*"))


def test_a_file_that_is_written_over_in_its_place_is_taken_too(folder):
    path = folder / "one.safetensors"
    watch = ModelWatch(path, SimpleQueue())
    path.write_bytes((folder / "two.safetensors").read_bytes())
    assert ready(watch).sha256 == load_model(folder / "two.safetensors").sha256
    watch.close()


def test_the_same_model_in_another_file_changes_nothing(folder, monkeypatch):
    monkeypatch.setattr("hearthlog.recorder.labelling.model_watch.LOOK_SECONDS", 0.01)
    path = folder / "one.safetensors"
    watch = ModelWatch(path, SimpleQueue())
    (folder / "copy").write_bytes(path.read_bytes())
    (folder / "copy").replace(path)
    time.sleep(0.5)
    watch.close()
    assert list(watch.refusals()) == []
    assert watch.ready is None


def test_a_watch_that_is_asked_looks_at_once(folder, monkeypatch):
    monkeypatch.setattr("hearthlog.recorder.labelling.model_watch.LOOK_SECONDS", 3600)
    requested = SimpleQueue()
    watch = ModelWatch(folder / "champion.safetensors", requested)
    promote(folder, "two")
    requested.put(None)
    assert ready(watch).name == "two"
    watch.close()


def ready(watch):
    """Wait for the model that a watch has found."""
    wait_for(lambda: not list(watch.refusals()) and watch.ready is not None)
    return watch.ready.model


def record_and_promote(folder, logs, events):
    """Record events; before the second block of frames another model is ready."""
    watch = ModelWatch(folder / "champion.safetensors", SimpleQueue())
    recording = RecordingSession(
        Settings(output=logs), {"mic": MICROPHONE}, {"mic": LabellingModels(watch)}
    )
    recording.add("mic", events[0])
    promote(folder, "two")
    ready(watch)
    for event in events[1:]:
        recording.add("mic", event)
    recording.finish()
    watch.close()
    return recording.summary.logs


def block(first, count):
    rng = np.random.default_rng(first)
    sound = rng.normal(0, 0.1, (count, FRAME_SAMPLES)).astype(np.float32)
    return Frames(first, sound, START + np.arange(first, first + count) * FRAME_NANOSECONDS)


def test_a_model_waits_for_the_next_second_if_a_log_began_in_this_one(folder, tmp_path):
    blocks = [block(first, 6) for first in range(0, 60, 6)]
    early, late = record_and_promote(folder, tmp_path / "logs", blocks)
    names = [path.name.partition("T")[2] for path in (early, late)]
    assert names == ["070000Z.mcap", "070001Z.mcap"]
    assert features(late)[0].tolist() == list(range(24, 60))


def test_a_model_that_changes_behind_a_gap_is_replayed_as_it_was(folder, tmp_path, capfd):
    start = START + 40 * FRAME_NANOSECONDS
    gap = Gap(start, start + 7 * FRAME_NANOSECONDS, "overrun", 7)
    logs = tmp_path / "logs"
    events = [block(0, 40), gap, block(47, 40), block(87, 20)]
    early, late = record_and_promote(folder, logs, events)
    assert (features(early)[0].max(), features(late)[0].min()) == (39, 47)
    with chdir(tmp_path):
        result = run(capfd, "replay", logs)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.count("bit for bit") == 2
    assert run(capfd, "doctor", logs).returncode == 3  # the gap


def test_a_recorder_whose_terminal_is_closed_completes_its_log(folder, tmp_path):
    soundfile.write(tmp_path / "noise.wav", np.zeros(16_000 * 60), 16_000)
    logs = tmp_path / "logs"
    master, terminal = os.openpty()
    command = ["env", "--default-signal=HUP"]  # for tests that run under nohup
    command += ["setsid", "--ctty", *HEARTHLOG, "record", str(tmp_path / "noise.wav"), "--realtime"]
    command += ["-o", str(logs), "--model", str(folder / "champion.safetensors")]
    process = subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal)
    os.close(terminal)
    wait_for(lambda: count(logs, "features") > 0)
    os.close(master)
    process.wait(timeout=20)
    (log,) = logs.rglob("*.mcap*")
    assert LogReader(log).complete


@pytest.mark.parametrize("scenario", ["", "bathroom"])
def test_a_model_of_which_a_bit_has_changed_is_named_at_the_start_and_labels(
    folder, capfd, scenario
):
    file = (folder / "champion.safetensors").resolve()
    data = bytearray(file.read_bytes())
    data[-8] ^= 1
    file.write_bytes(data)
    ModelWatch(file, SimpleQueue(), scenario).close()
    (line,) = capfd.readouterr().err.splitlines()
    output = (
        rf"{file}: is not as it was written \(digest \w{{12}}, not \w{{12}}\): .* backup.*labell"
    )
    assert re.search(output, line)
    assert ("scenario bathroom: " in line) == bool(scenario)
    with pytest.raises(ModelError, match="is not as it was written"):
        load_model(file)


def test_a_starter_of_which_a_bit_has_changed_is_named(monkeypatch, capfd):
    monkeypatch.setitem(SHA256, "general", "0" * 64)
    ModelWatch(Path("general"), SimpleQueue()).close()
    (line,) = capfd.readouterr().err.splitlines()
    assert re.search(
        r"general\.safetensors: is not as .*, not 0{12}\).*install hearthlog again", line
    )


def test_a_champion_that_was_replaced_is_named_at_the_start(folder, capfd):
    def output_at_start():
        ModelWatch(folder / "champion.safetensors", SimpleQueue()).close()
        return [line for line in capfd.readouterr().err.splitlines() if "was promoted" in line]

    override_judgement(folder, load_model(folder / "champion.safetensors").sha256)
    assert output_at_start() == []
    file = (folder / "champion.safetensors").resolve()
    shutil.copyfile(starter_file("bathroom"), file)
    (line,) = output_at_start()
    assert line.startswith(f"hearthlog: model {file.stem} is not the file that was promoted")
    for judgement in (folder / "judgements").iterdir():
        judgement.unlink()
    assert output_at_start() == [], "nothing is known of it"
