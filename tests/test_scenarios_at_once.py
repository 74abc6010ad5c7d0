"""Several models label the same sound at once, each for a scenario, on topics of its own."""

import json
import math
import re
import shutil
from collections.abc import Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run
from logreader import LogReader
from mcap.records import Channel
from prometheus_client.parser import text_string_to_metric_families
from test_model_changes import MICROPHONE, block, wait_for

from hearthlog.analyzer.activity.live import FIELDS, LiveActivity, is_of_alerts
from hearthlog.analyzer.activity.segments import is_of_activity, read_activity
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.mqtt import Topics
from hearthlog.analyzer.bridge.mqtt.home_assistant import discovery
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.page import ENGLISH
from hearthlog.analyzer.bridge.page.status import scenario_lines
from hearthlog.analyzer.bridge.prometheus import PrometheusOutput
from hearthlog.analyzer.bridge.settings import PrometheusSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.local_time import today
from hearthlog.analyzer.review.lanes import timeline_lanes
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Description, Model
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.starter import BATHROOM, GENERAL, starter_file
from hearthlog.recorder import recording
from hearthlog.recorder.config import Settings, load_settings
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import Loaded, ModelWatch, ReloadRequests
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.log.recovery import recover_active
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.recording_session import RecordingSession
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import ConfigurationError, HearthlogError, LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import (
    LIVE,
    check_scenario_name,
    labelling_topic,
    parse_topic,
    scenario_labelling,
)
from hearthlog.schemas.salvage.recover import STEPS, thin_log
from hearthlog.tools.cli.options import scenario_files

START = 1_772_348_400 * 1_000_000_000
GOLDEN = Path(__file__).parent / "golden/0.1.0/models/merged.safetensors"
SOUNDS = "flushing_water", "speech", "coughing", "flushing_water", "music", "phone_ring"
OF_WATER = [f"/mic/scenario/water/{kind}" for kind in ("label", "segment")]


def renamed(model: Model, names: Mapping[str, str]) -> Model:
    """Call classes of a model by other names."""
    text = model.description.model_dump_json()
    for old, new in names.items():
        text = text.replace(f'"{old}"', f'"{new}"')
    return replace(model, description=Description.model_validate_json(text))


def keep(path: Path, names: Mapping[str, str], starter: str = BATHROOM) -> Path:
    """Put a starter model with other names of classes in the place of a file."""
    path.parent.mkdir(exist_ok=True)
    replace_file(renamed(load_model(starter_file(starter)), names), path)
    return path


def replace_file(model: Model, path: Path) -> None:
    new = path.with_name(f"new_{path.name}")
    save_model(model, new)
    new.replace(path)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """A quarter of a minute of clips of a home, and noise between them."""
    folder = Path(__file__).parents[1] / "tools/home/clips"
    clips = [min((folder / name).glob("*.flac")) for name in SOUNDS]
    rng = np.random.default_rng(2)
    parts = [soundfile.read(clip, dtype="float32")[0][:32_000] for clip in clips]
    spaced = [np.concatenate([part, np.zeros(8_000, np.float32)]) for part in parts]
    full = np.concatenate(spaced) + rng.normal(0, 3e-4, sum(map(len, spaced))).astype(np.float32)
    path = tmp_path_factory.mktemp("sound") / "home.wav"
    soundfile.write(path, np.clip(full, -1, 1), 16_000)
    return path


def record(sound: Path, logs: Path, **settings: object) -> Path:
    """Record the sound to one log, and return it."""
    requested = Settings(output=logs, max_bag_duration=86_400, **{"model": GENERAL, **settings})
    (log,) = record_files(requested, FileSource([sound], START), Flag()).logs
    return log


@pytest.fixture(scope="module")
def log(sound, tmp_path_factory) -> Path:
    """The log of a recorder with the scenario `water`."""
    return record(sound, tmp_path_factory.mktemp("logs"), scenarios={"water": BATHROOM})


@pytest.fixture(scope="module")
def long_log(tmp_path_factory) -> Path:
    """Ten minutes of knocks, which the live model hears and the scenario does not."""
    clips = Path(__file__).parents[1] / "tools/home/clips/objects_activity"
    samples, rate = soundfile.read(min(clips.glob("*.flac")), dtype="float32")
    loudest = int(np.convolve(samples**2, np.ones(1600), "same").argmax())
    knock = samples[max(loudest - 4000, 0) : loudest + 4000]
    full = np.random.default_rng(3).normal(0, 3e-3, 600 * rate).astype(np.float32)
    for first in range(10 * rate, 590 * rate, 20 * rate):
        full[first : first + len(knock)] += 0.3 * knock / np.abs(knock).max()
    folder = tmp_path_factory.mktemp("long")
    soundfile.write(folder / "long.wav", np.clip(full, -1, 1), rate)
    return record(folder / "long.wav", folder / "logs", model=BATHROOM, scenarios={"home": GENERAL})


def written(log: Path, topics: list[str] | None = None) -> list[tuple[str, int, bytes]]:
    return [(m.topic, m.log_time, m.data) for m in LogReader(log).messages(topics)]


def payloads(log: Path, topic: str) -> list[bytes]:
    return [data for _, _, data in written(log, [topic])]


def channels_of(log: Path) -> dict[str, Channel]:
    with LogFile(log) as file:
        return {channel.topic: channel for channel in file.channels.values()}


def lines(log: Path) -> list[str]:
    return [m.decode().msg for m in LogReader(log).messages(["/rosout"])]


def test_a_scenario_says_what_its_model_says_alone_and_changes_nothing_else(sound, log, tmp_path):
    alone = record(sound, tmp_path / "alone", model=BATHROOM)
    without = record(sound, tmp_path / "without")
    for kind in ("label", "segment"):
        assert payloads(log, f"/mic/scenario/water/{kind}") == payloads(alone, f"/mic/{kind}")
        assert payloads(log, f"/mic/{kind}")
    rest = [each for each in written(log) if each[0] not in OF_WATER]
    assert rest.pop(2)[0] == "/rosout"  # which scenario runs
    assert rest == written(without)


def test_scenarios_label_where_no_model_does(sound, log, tmp_path):
    other = record(sound, tmp_path / "logs", model="none", scenarios={"water": BATHROOM},
                   feature_set="home33")  # fmt: skip
    assert written(other, OF_WATER) == written(log, OF_WATER)
    assert not payloads(other, "/mic/label")


def test_a_log_says_which_scenarios_ran_and_is_sound(log, capfd):
    about = LogReader(log).metadata["hearthlog"]
    model = load_model(starter_file(BATHROOM))
    assert (about["model"], about["scenario/mic/water"]) == (GENERAL, BATHROOM)
    assert about["scenario/mic/water/sha256"] == model.sha256
    assert lines(log)[1] == f"scenario water: 5 labels by bathroom ({model.sha256[:12]})"
    printed = run(capfd, "info", log)
    assert f"scenario water, mic: model bathroom ({model.sha256[:12]})\n" in printed.stdout
    bars = "Microphone mic, scenario water: time labelled as each sound"
    assert bars in printed.stdout, "which no table of a day has"
    facts = json.loads(run(capfd, "info", log, "--json").stdout)
    assert facts["scenarios"] == [
        {"microphone": "mic", "name": "water", "model": BATHROOM, "sha256": model.sha256}
    ]
    assert "model.scenario-water.json" in facts["attachments"]
    assert set(facts["segments"]) == {"mic", "mic/scenario/water"}
    checked = run(capfd, "doctor", log)
    assert (checked.returncode, checked.stdout) == (0, "1 file: 0 errors, 0 warnings\n")


def test_a_replay_gives_the_labels_of_a_scenario_again(log, tmp_path, capfd):
    done = run(capfd, "replay", log, "-o", tmp_path / "again", "--scenario", "water=bathroom")
    assert (done.returncode, done.stderr.count("bit for bit")) == (0, 2)
    (again,) = find_logs(tmp_path / "again")
    assert written(again, OF_WATER) == written(log, OF_WATER)
    assert lines(again)[:2] == lines(log)[:2]
    assert run(capfd, "doctor", again).returncode == 0
    assert run(capfd, "replay", log, "-o", tmp_path / "without").returncode == 0
    (without,) = find_logs(tmp_path / "without")
    about = LogReader(without).metadata["hearthlog"]
    assert not written(without, OF_WATER)
    assert not [key for key in about if key.startswith("scenario")]
    assert run(capfd, "doctor", without).returncode == 0


def test_a_replay_of_a_part_gives_the_labels_of_a_scenario_too(long_log, tmp_path, capfd):
    out = tmp_path / "part"
    words = ["--start-offset", "420", "--scenario", f"home={GENERAL}", "-o", out]
    assert run(capfd, "replay", long_log, *words).returncode == 0
    (part,) = find_logs(out)
    for topic in ("/mic/scenario/home/label", "/mic/scenario/home/segment", "/mic/segment"):
        again = payloads(part, topic)
        assert again == payloads(long_log, topic)[-len(again) :]
        assert again


def test_a_replay_refuses_what_a_recorder_refuses(log, tmp_path, capfd):
    words = ["--scenario", f"x={GENERAL}", "-o", tmp_path / "out"]
    refused = run(capfd, "replay", log, *words)
    assert refused.returncode == 1
    assert "and so does the live model, general" in refused.stderr


def test_a_relabelling_gives_them_again_in_a_layer(sound, tmp_path, capfd):
    log = record(sound, tmp_path / "logs", scenarios={"water": BATHROOM})
    assert run(capfd, "relabel", log, "--model", "bathroom").returncode == 0
    (layer,) = (tmp_path / "logs").rglob("*.relabel-bathroom.mcap")
    spoken = payloads(log, OF_WATER[1])
    assert payloads(layer, "/mic/relabel/bathroom/segment") == spoken
    assert spoken


def test_a_killed_recorder_keeps_what_scenarios_said(sound, log, tmp_path):
    settings = Settings(output=tmp_path / "logs", scenarios={"water": BATHROOM}, model=GENERAL)
    source = FileSource([sound], START)
    watches = ModelWatch(Path(GENERAL), SimpleQueue()), ModelWatch(Path(BATHROOM), SimpleQueue())
    models = LabellingModels(watches[0], scenarios={"water": watches[1]})
    session = RecordingSession(settings, {"mic": source}, {"mic": models})
    for number, event in enumerate(source.events(Flag())):
        session.add("mic", event)
        if number == 20:
            break
    (left,) = tmp_path.rglob("*.active")
    shutil.copytree(tmp_path / "logs", tmp_path / "killed")  # as it is on the disk
    session.finish()
    for watch in watches:
        watch.close()
    recover_active(tmp_path / "killed", "home")
    (recovered,) = find_logs(tmp_path / "killed")
    assert recovered.name == left.stem
    spoken = written(recovered, OF_WATER)
    assert spoken == written(log, OF_WATER)[: len(spoken)]
    frames = len(payloads(recovered, "/mic/features"))
    assert frames - 20 < len(payloads(recovered, OF_WATER[0])) < frames


@pytest.fixture
def session(tmp_path, monkeypatch):
    """A recording whose scenario's model can be replaced, and a way to feed it."""
    monkeypatch.setattr("hearthlog.recorder.labelling.model_watch.LOOK_SECONDS", 0.02)
    path = keep(tmp_path / "models/water.safetensors", {})
    requests = ReloadRequests()
    general = keep(tmp_path / "models/home.safetensors", {}, GENERAL)
    with (
        closing(ModelWatch(general, requests.queue())) as live,
        closing(ModelWatch(path, requests.queue(), "water")) as water,
    ):
        models = LabellingModels(live, scenarios={"water": water})
        session = RecordingSession(
            Settings(output=tmp_path / "logs"), {"mic": MICROPHONE}, {"mic": models}
        )
        frames = iter(range(0, 100_000, 30))

        def feed() -> RecordingSession:
            session.add("mic", block(next(frames), 30))
            return session

        feed()
        yield path, feed, requests
        session.finish()


def test_the_model_of_a_scenario_is_replaced_while_it_records(session, tmp_path, capfd):
    path, feed, _ = session
    keep(path, {"tap_water": "running_tap"})
    wait_for(lambda: feed() and len(list((tmp_path / "logs").rglob("*.mcap*"))) == 2)
    feed().finish()
    first, second = find_logs(tmp_path / "logs")
    names = [
        json.loads(channels_of(each)[OF_WATER[0]].metadata["probabilities_names"])
        for each in (first, second)
    ]
    assert "tap_water" in names[0]
    assert "running_tap" in names[1]
    digest = load_model(path).sha256[:12]
    assert any(f"scenario/water water ({digest}) from frame " in line for line in lines(second))
    assert f"scenario water: 5 labels by water ({digest})" in lines(second)
    spoken = [
        message.decode().frame
        for each in (first, second)
        for message in LogReader(each).messages(OF_WATER[:1])
    ]
    assert spoken == list(range(min(spoken), max(spoken) + 1)), "it was never interrupted"
    assert run(capfd, "doctor", tmp_path / "logs").returncode == 0


def test_a_broken_model_of_a_scenario_is_refused_and_the_old_one_goes_on(session, tmp_path, capfd):
    path, feed, _ = session
    (path.parent / "broken").write_bytes(b"no model")
    (path.parent / "broken").replace(path)
    wait_for(lambda: feed().summary.models_refused == 1)
    path.unlink()
    wait_for(lambda: feed().summary.models_refused == 2)
    feed().finish()
    (log,) = find_logs(tmp_path / "logs")
    refused = [line for line in lines(log) if "refused" in line]
    assert [line.partition(": ")[0] for line in refused] == ["scenario water"] * 2
    assert refused[0].startswith("scenario water: model water refused: ")
    assert refused[0].endswith("; going on with water")
    assert capfd.readouterr().err.count("scenario water: model water refused") == 2
    assert len(payloads(log, OF_WATER[0])) == len(payloads(log, "/mic/label")) > 60


def test_a_replacement_with_a_class_of_another_model_is_refused(session, tmp_path):
    path, feed, requests = session
    before = load_model(path)
    keep(path, {"tap_water": "speech"})
    wait_for(lambda: feed().summary.models_refused == 1)
    requests.request()
    wait_for(lambda: feed().summary.models_refused == 2)
    replace_file(before, path)
    for _ in range(20):
        feed()
    feed().finish()
    (log,) = find_logs(tmp_path / "logs")
    (line, _) = [line for line in lines(log) if "refused" in line]
    assert line == (
        "scenario water: model water refused: labels 'speech', and so does the live model, home; "
        "each class can be of one only: leave one of them out, or train one without the class; "
        "going on with water"
    )


@pytest.mark.parametrize(
    ("name", "shown"),
    [("speech", "'speech'"), ("ringtone", "'ringtone'"), ("cough", "'cough'")],
)
def test_a_class_of_two_models_is_refused_at_the_start(name, shown, tmp_path, sound):
    path = keep(tmp_path / "models/water.safetensors", {"tap_water": name})
    with pytest.raises(ConfigurationError, match=f"scenario water: model water labels {shown}, and "
                       "so does the live model, general"):  # fmt: skip
        record(sound, tmp_path / "logs", scenarios={"water": path})
    assert not (tmp_path / "logs").exists() or not list((tmp_path / "logs").rglob("*.mcap*"))


def test_a_class_of_two_scenarios_is_refused_and_both_are_named(tmp_path, sound):
    other = keep(tmp_path / "models/other.safetensors", {"tap_water": "rain"})
    wanted = (
        "scenario rain: model other labels 'flushing_water', and so does scenario water, bathroom"
    )
    with pytest.raises(ConfigurationError, match=wanted):
        record(sound, tmp_path / "logs", scenarios={"water": BATHROOM, "rain": other})
    names = {"tap_water": "rain", "flushing_water": "hail"}
    other = keep(tmp_path / "models/other.safetensors", names)
    log = record(sound, tmp_path / "logs", scenarios={"water": BATHROOM, "rain": other})
    labels = [payloads(log, f"/mic/scenario/{name}/label") for name in ("water", "rain")]
    assert len(labels[0]) == len(labels[1]) > 100, "silence, unknown and other may be of both"


def test_a_recorder_of_microphones_goes_on_without_a_scenario_that_cannot_label(sound, tmp_path):
    spoken = keep(tmp_path / "spoken.safetensors", {"tap_water": "speech"})
    scenarios = {"gone": tmp_path / "gone.safetensors", "old": GOLDEN, "spoken": spoken}
    requested = Settings(
        output=tmp_path / "logs", model=GENERAL, scenarios={**scenarios, "water": BATHROOM}
    )
    with FolderLock(requested.output, requested.node) as lock:
        summary = recording._record(
            requested, {"mic": FileSource([sound], START)}, Flag(), None, lock
        )
    assert summary.models_refused == 3
    (log,) = find_logs(requested.output)
    assert set(OF_WATER) <= set(channels_of(log))
    reported = [line for line in lines(log) if "left out until the next start" in line]
    assert len(reported) == 3
    assert all(
        any(line.startswith(f"scenario {name}: ") for line in reported) for name in scenarios
    )


def test_what_goes_on_since_another_was_refused_keeps_its_classes(tmp_path):
    waters = ("flushing_water", "tap_water")
    of_a, of_b = (dict(zip(waters, names, strict=True)) for names in (("a", "c"), ("b", "d")))
    files = {
        name: keep(tmp_path / f"{name}.safetensors", of)
        for name, of in zip("ab", (of_a, of_b), strict=True)
    }
    requests = ReloadRequests()
    with ExitStack() as stack:
        live = stack.enter_context(closing(ModelWatch(Path(GENERAL), requests.queue())))
        watches = {
            name: stack.enter_context(closing(ModelWatch(file, requests.queue(), name)))
            for name, file in files.items()
        }
        models = LabellingModels(live, None, watches)
        bathroom = load_model(starter_file(BATHROOM))
        for name, of in (("a", of_b), ("b", {"tap_water": "speech"})):
            model = renamed(bathroom, of)
            watches[name].ready = Loaded(model, Classifier(model))
        assert len(models.refusals()) == 2
        assert models.change() == []


def test_two_scenarios_whose_files_are_swapped_label_by_each_others_models(tmp_path):
    waters = ("flushing_water", "tap_water")
    names = {"a": ("a", "c"), "b": ("b", "d")}
    files = {
        name: keep(tmp_path / f"{name}.safetensors", dict(zip(waters, of, strict=True)))
        for name, of in names.items()
    }
    requests = ReloadRequests()
    with ExitStack() as stack:
        watches = {
            name: stack.enter_context(closing(ModelWatch(file, requests.queue(), name)))
            for name, file in files.items()
        }
        models = LabellingModels(None, None, watches)
        loaded = {name: models.in_use[f"scenario/{name}"] for name in names}
        watches["a"].ready = loaded["b"]  # one after the other, as they are loaded
        (refused,) = models.refusals()
        assert refused.startswith("scenario a: model b refused: labels 'b', and so does scenario b")
        assert not models.refusals()
        watches["b"].ready = loaded["a"]
        assert not models.refusals()
        assert {change.labelling: change.model.name for change in models.change()} == {
            "scenario/a": "b",
            "scenario/b": "a",
        }
        watches["b"].ready = loaded["a"]  # as SIGHUP has it
        assert not models.refusals()
        assert [change.labelling for change in models.change()] == ["scenario/b"]


def test_a_model_for_another_feature_set_is_refused_in_a_line(tmp_path, sound):
    golden = load_model(GOLDEN)
    names = {name: f"my_{name}" for name in golden.classes if name not in {"silence", "unknown"}}
    path = tmp_path / "old.safetensors"
    save_model(renamed(golden, names), path)
    with pytest.raises(ConfigurationError, match="scenario old: model old is for feature set "
                       "auros21, and what is recorded is home33") as refused:  # fmt: skip
        record(sound, tmp_path / "logs", scenarios={"old": path})
    assert "\n" not in str(refused.value)


def test_a_scenario_without_its_file_is_named(tmp_path, sound):
    with pytest.raises(HearthlogError, match=r"scenario water: .*gone.safetensors: no such"):
        record(sound, tmp_path / "logs", scenarios={"water": tmp_path / "gone.safetensors"})


def test_each_microphone_may_have_its_own_scenarios(sound, tmp_path):
    microphones = [{"name": "hall", "device": "x", "scenarios": {}}, {"name": "bath"}]
    settings = Settings(microphone=microphones, scenarios={"water": BATHROOM})
    hall, bath = settings.microphone
    assert settings.scenarios_of(bath) == {"water": Path(BATHROOM)}
    assert settings.scenarios_of(hall) == {}
    sources = {name: FileSource([sound], START) for name in ("hall", "bath")}
    with closing(ModelWatch(Path(BATHROOM), SimpleQueue(), "water")) as watch:
        models = {"bath": LabellingModels(scenarios={"water": watch}), "hall": LabellingModels()}
        requested = settings.model_copy(update={"output": tmp_path, "feature_set": "home33"})
        session = RecordingSession(requested, sources, models)
        for number, events in enumerate(
            zip(*(s.events(Flag()) for s in sources.values()), strict=True)
        ):
            for name, event in zip(sources, events, strict=True):
                session.add(name, event)
            if number == 5:
                break
        session.finish()
    (log,) = find_logs(tmp_path)
    about = LogReader(log).metadata["hearthlog"]
    assert [key for key in about if key.startswith("scenario")] == [
        "scenario/bath/water", "scenario/bath/water/sha256"
    ]  # fmt: skip
    assert {topic for topic in channels_of(log) if "scenario" in topic} == {
        "/bath/scenario/water/label", "/bath/scenario/water/segment"
    }  # fmt: skip


def test_readers_find_a_scenario_by_its_name_and_do_not_take_it_for_the_live_labels(log, capfd):
    labellings = find_labellings(log)
    assert labellings.names("mic") == [LIVE, "scenario/water"]
    assert labellings.find("mic", "water") == "scenario/water"
    classes = labellings.read("mic", "scenario/water").classes
    assert "tap_water" in classes
    assert "tap_water" not in labellings.read("mic", LIVE).classes
    lanes = list(timeline_lanes(read_timeline([log])))
    (lane,) = [lane for lane in lanes if lane.name == "Water"]
    assert lanes.index(lane) > max(i for i, each in enumerate(lanes) if each.labelling == LIVE)
    assert not [each.name for each in lanes if each.name.endswith("differs")]
    assert set(lane.spans.texts) <= {"Water tap", "Toilet flush"}
    assert len(lane.spans)
    done = run(capfd, "diff", log, "live", "water")
    assert "b: scenario/water" in done.stdout


def test_the_labels_of_scenarios_stay_when_a_log_grows_old(log, tmp_path, capfd):
    old = tmp_path / log.name
    thin_log(log, old, len(STEPS) - 1)
    assert written(old, OF_WATER) == written(log, OF_WATER)
    assert not payloads(old, "/mic/features")
    assert run(capfd, "doctor", old).returncode == 0


def test_a_report_has_a_section_for_a_scenario_and_is_the_same_without_it(
    sound, log, tmp_path, capfd
):
    without = record(sound, tmp_path / "logs")
    pages = []
    for name, path in (("with", log), ("without", without)):
        page = tmp_path / f"{name}.html"
        done = run(capfd, "report", path, "-o", page, "--day", "2026-03-01")
        assert done.returncode == 0, done.stderr
        pages.append(page.read_text("utf-8"))
    section = re.search("<h2>Scenario “water”</h2>.*?</table>.*?</p>\n", pages[0], re.DOTALL)
    assert "under 1 min" in section[0]
    assert "Other" not in section[0]
    assert pages[0].replace(section[0], "") == pages[1]


def test_what_a_bridge_tells_of_a_scenario_is_apart_from_its_microphone(log):
    assert all(map(is_of_activity, [*OF_WATER, "/mic/gap", "/mic/label"]))
    assert not any(map(is_of_activity, ["/mic/candidate/label", "/mic/scenario/water/gap"]))
    columns = read_columns([log], [*OF_WATER, "/mic/label", "/mic/segment"])
    state, without = HomeState(), HomeState()
    begun = state.push(list(columns.values()))
    live = without.push([part for topic, part in columns.items() if topic not in OF_WATER])
    assert [event for event in begun if event.microphone == "mic"] == live
    assert {event.microphone for event in begun} == {"mic", "mic-water"}
    assert [each.name for each in state.every()] == ["mic", "mic-water"]
    water = state.scenarios["mic-water"]
    assert water.classes == ["silence", "flushing_water", "tap_water"]
    assert set(water.labels()) <= {"flushing_water", "tap_water"}
    assert state.microphones["mic"].labels() == without.microphones["mic"].labels()
    reported = discovery(Topics("hearthlog", "home"), "mic-water", water.classes)["components"]
    assert "level" not in reported
    assert reported["heard"]["state_topic"] == "hearthlog/home/mic-water/heard"
    assert any("tap_water" in key for key in reported)


def test_figures_and_the_page_tell_of_a_scenario_beside_its_microphone(log, tmp_path):
    state = HomeState()
    columns = read_columns([log], [*OF_WATER, "/mic/gap", "/mic/label", "/mic/segment"])
    update = OutputUpdate(state, [], [], today(START + 60 * NANOSECONDS, UTC), UTC)
    figures, home = tmp_path / "figures.prom", RecorderAddress(tmp_path, "home", UTC)
    output = PrometheusOutput(
        PrometheusSettings(text_file=figures, readable_by="all"),
        home,
        BridgeState(tmp_path, "home", pytest.fail),
        0,
        pytest.fail,
    )

    def samples() -> dict[tuple[str, ...], float]:
        output._due = 0.0
        output.update(update)
        return {
            (sample.name, *(value for key, value in sample.labels.items() if key != "node")): float(
                sample.value
            )
            for family in text_string_to_metric_families(figures.read_text())
            for sample in family.samples
            if "event" in sample.name
        }

    state.push([part for topic, part in columns.items() if topic not in OF_WATER])
    without = samples()
    assert not any("scenario" in name for name, *_ in without)
    assert scenario_lines(update) == []
    state.push([part for topic, part in columns.items() if topic in OF_WATER])
    found = samples()
    assert without.items() <= found.items()
    water = {key: value for key, value in found.items() if "scenario" in key[0]}
    assert found.keys() - without.keys() == water.keys()
    flushes = state.scenarios["mic-water"].events("flushing_water", 0)
    names = ("flushing_water", "mic", "water")
    assert water["hearthlog_scenario_events_total", *names] == len(flushes) > 0
    assert water["hearthlog_scenario_event_seconds_total", *names] == sum(
        flush.seconds for flush in flushes
    )
    (line,) = scenario_lines(update)
    assert line["what"] == "Water"
    assert line["about"].startswith("Now not listening. Today ")
    assert f"toilet flush {ENGLISH.times(len(flushes))} (" in line["about"]
    state.scenarios["mic-water"].seen = math.inf
    assert scenario_lines(update)[0]["about"].startswith("Now ")
    assert "not listening" not in scenario_lines(update)[0]["about"]
    tomorrow = OutputUpdate(state, [], [], today(START + 86_400 * NANOSECONDS, UTC), UTC)
    assert scenario_lines(tomorrow)[0]["about"].endswith("Today nothing.")


def test_alerts_hear_what_a_scenario_labels_from_the_log_and_as_it_is_written(log):
    start, end = START, START + 60 * 1_000_000_000
    replayed = read_activity(find_home_logs([log]), "home", start, end, pytest.fail)
    columns = read_columns([log], None, fields={f for own in FIELDS.values() for f in own})
    live = LiveActivity(start, 0)
    live.push([part for topic, part in columns.items() if is_of_alerts(topic)])
    labels = read_columns([log], OF_WATER)[OF_WATER[1]]["label"].tolist()
    for activity in (replayed, live.activity()):
        water = activity.of("flushing_water")
        assert len(water.starts) == labels.count("flushing_water") > 0
        assert set(water.microphones) == {"mic"}
        none = {("other", True), ("silence", True), ("flushing_water", False)}
        assert none.isdisjoint(activity.sounds)
    assert "flushing_water" in replayed.classes["mic-water"]


def test_the_doctor_misses_the_labels_of_a_scenario_that_ran(log, tmp_path, capfd):
    cut = tmp_path / "home_20260301T070000Z.mcap"
    full = log.read_bytes()
    cut.write_bytes(full.replace(b"scenario/mic/water", b"scenario/mic/waver"))
    done = run(capfd, "doctor", cut)
    assert "/mic/scenario/waver/label is missing" in done.stdout
    assert "/mic/scenario/water/label should not be there" in done.stdout


NAMES = st.from_regex("[a-z](_?[a-z0-9]){0,20}", fullmatch=True)


@given(NAMES, NAMES, st.sampled_from(["label", "segment"]))
def test_a_topic_of_a_scenario_says_of_which(microphone, name, kind):
    labelling = scenario_labelling(check_scenario_name(name))
    parts = parse_topic(labelling_topic(microphone, labelling, kind))
    assert parts == (microphone, labelling, kind)


@pytest.mark.parametrize("name", ["", "Speakers", "a__b", "a/b", "9a", "é", "a" * 65, "a\n"])
def test_a_name_that_is_no_topic_is_refused(name):
    with pytest.raises(LogError, match="scenario name"):
        check_scenario_name(name)


def test_what_the_command_line_says_of_scenarios_holds_for_every_microphone(tmp_path):
    file = tmp_path / "home.toml"
    file.write_text('[[microphone]]\nname = "bath"\nscenarios = {}\n')
    given = {"scenarios": {"water": Path("bathroom")}}
    settings, own = load_settings(file, given, {}), load_settings(file, {}, {})
    assert settings.scenarios_of(settings.microphone[0]) == given["scenarios"]
    assert own.scenarios_of(own.microphone[0]) == {}


def test_the_command_line_and_a_file_name_scenarios(tmp_path, capfd):
    assert scenario_files(["a=x.safetensors", "b=c=d"]) == {
        "a": Path("x.safetensors"), "b": Path("c=d")
    }  # fmt: skip
    file = tmp_path / "home.toml"
    file.write_text('[scenarios]\nwater = "bathroom"\n')
    shown = run(capfd, "config", "--config", file).stdout
    assert f'scenarios = {{water = "bathroom"}}  # {file}, line 1\n' in shown
    assert run(capfd, "config", "check", file).returncode == 0
    file.write_text('[scenarios]\nWater = "bathroom"\n')
    wrong = run(capfd, "config", "check", file)
    assert wrong.returncode == 2
    assert wrong.stderr.startswith(f"hearthlog: {file}, line 2: scenarios.Water: scenario name")
    for given_ in (["water"], ["=x"], ["water="]):
        refused = run(capfd, "record", "x.wav", "--scenario", *given_)
        assert (refused.returncode, "say NAME=FILE" in refused.stderr) == (2, True)
    twice = run(capfd, "record", "x.wav", "--scenario", "a=x", "--scenario", "a=y")
    assert "--scenario a: given twice" in twice.stderr
