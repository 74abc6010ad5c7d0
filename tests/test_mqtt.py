"""What is heard reaches a real broker, and what people say comes back from it."""

import json
import os
import random
import signal
import time
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from brokers import Broker, Listener, SlowLink, settled_values, start_bridge
from homelife import GENERAL
from killed_bridge import ZONE, kill_at_random, start_recorder
from livehome import LiveHome, following, midday_zone
from paho.mqtt.client import MQTTMessage

from hearthlog.analyzer.bridge import state as bridge_state
from hearthlog.analyzer.bridge.mqtt import RetainedTopics, Topics
from hearthlog.analyzer.bridge.mqtt.home_assistant import device_id, discovery, topics_in_discovery
from hearthlog.analyzer.bridge.mqtt.publisher import MqttPublisher
from hearthlog.analyzer.bridge.settings import MqttSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.logs.hidden_classes import NEVER_TELL_FILE, write_hidden_classes
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.pause_schedule import paused_until
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs

ROOT = "hearthlog/home"
COUGHING = f"{ROOT}/mic/class/coughing"
DISCOVERY = f"homeassistant/device/{device_id('home', 'mic')}/config"
COMMANDS = "homeassistant/device/hearthlog-home/config"
_CLIPS = Path(__file__).parent / "data" / "household"


class Bridged:
    """A bridge in a thread, between the log of a home and a broker."""

    def __init__(
        self, folder: Path, broker: Broker, outputs=(), node="home", state=None, **settings
    ):
        self.problems = []
        place = RecorderAddress(folder, node, midday_zone())
        mqtt = MqttSettings(**({"host": "127.0.0.1", "port": broker.port} | settings))
        state = state or folder.parent / "bridge"
        self.state = BridgeState(state, node, self.problems.append)
        self.state.claim(folder)
        self.publisher = MqttPublisher(mqtt, place, self.state, self.problems.append)
        everybody = dict(outputs) | {"mqtt": self.publisher}
        self._following = following(place, everybody, self.problems)

    def __enter__(self):
        self._following.__enter__()
        return self

    def __exit__(self, *error):
        self._following.__exit__(*error)
        self.state.close()


def kept(home):
    """What the bridge of a home keeps of what the broker retains."""
    with closing(BridgeState(home.folder.parent / "bridge", "home", pytest.fail)) as state:
        return json.loads(state.read("mqtt"))


@pytest.fixture
def home(tmp_path):
    home = LiveHome(tmp_path / "logs")
    yield home
    home.close()


@pytest.fixture
def sounds():
    """Real recordings, coughs among the first."""
    clips = sorted(_CLIPS.glob("*/*.flac"))
    random.Random(2).shuffle(clips)
    return clips


@pytest.mark.fast
def test_events_since_midnight_are_counted_and_only_new_ones_are_told_of(home, broker):
    for minutes_ago in (300, 299.9, 100):  # the second goes on with the first
        home.write_segment("coughing", minutes_ago)
    last = home.write_segment("coughing", 30, seconds=2.5)
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{COUGHING}/count_today", "3")
        end = listener.wait_for(f"{COUGHING}/last_heard")
        start = home.write_segment("coughing", 0.1)
        listener.wait_for(f"{COUGHING}/count_today", "4")
        event = json.loads(listener.wait_for(f"{ROOT}/mic/event"))
        assert len(listener.payloads(f"{ROOT}/mic/event")) == 1
        assert end.startswith(_clock(last + 2_500_000_000))
    assert event.pop("start").startswith(_clock(start))
    assert event.pop("end").startswith(_clock(start + 4 * NANOSECONDS))
    assert event == {
        "event_type": "coughing",
        "id": f"mic-coughing-{start}",
        "seconds": 4.0,
        "confidence": 0.93,
    }


def _clock(nanoseconds):
    moment = datetime.fromtimestamp(nanoseconds / NANOSECONDS, midday_zone())
    return f"{moment:%Y-%m-%dT%H:%M:%S}"


def test_a_class_is_on_while_it_is_heard_and_its_event_ends(home, broker):
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        home.hears("silence")
        listener.wait_for(f"{COUGHING}/on", "OFF")
        listener.wait_for(f"{ROOT}/mic/sound", "OFF")
        home.hears("coughing")
        listener.wait_for(f"{COUGHING}/on", "ON")
        listener.wait_for(f"{ROOT}/mic/sound", "ON")
        assert listener.values[f"{ROOT}/mic/class/speech/on"] == "OFF"
        home.write_segment("coughing", 0.5, seconds=2)
        home.hears("silence")
        ended = json.loads(listener.wait_for(f"{ROOT}/mic/event_ended"))
    assert ended["event_type"] == "coughing"


def test_what_is_wrong_is_a_problem_of_the_microphone_that_it_is_about(tmp_path, broker):
    home = LiveHome(tmp_path / "logs", ("kitchen", "bath"))
    for microphone in ("kitchen", "bath"):
        home.hears("silence", microphone)
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{ROOT}/bath/problem", '{"state": "OFF", "text": ""}')
        home.write_status("bath", 1, "the microphone clips", level_dbfs="-12.5")
        home.write_status("home disk", 2, "full")
        both = '{"state": "ON", "text": "bath: the microphone clips; home disk: full"}'
        listener.wait_for(f"{ROOT}/bath/problem", both)
        listener.wait_for(f"{ROOT}/kitchen/problem", '{"state": "ON", "text": "home disk: full"}')
        assert listener.values[f"{ROOT}/bath/level"] == "-12.5"
        assert f"{ROOT}/kitchen/level" not in listener.values
    home.close()


@pytest.mark.fast
def test_a_microphone_that_the_newest_log_has_no_more_is_cleared_and_nobody_elses_is(
    tmp_path, broker
):
    home = LiveHome(tmp_path / "logs", ("kitchen", "mic"), [*GENERAL, "barking"])
    for microphone in ("kitchen", "mic"):
        home.hears("barking", microphone)
    foreign = {f"{ROOT}/mic/class/howling/on": "ON", f"{ROOT}/attic/listening": "online"}
    kitchen = f"homeassistant/device/{device_id('home', 'kitchen')}/config"
    with Listener(broker.port) as listener:
        for topic, value in foreign.items():
            listener.publish(topic, value, retain=True)
        with Bridged(home.folder, broker):
            listener.wait_for(f"{ROOT}/kitchen/class/barking/on", "ON")
            listener.wait_for(f"{ROOT}/mic/class/barking/on", "ON")
            assert listener.wait_for(kitchen)
        home.close()
        time.sleep(1)  # logs are named by the second
        other = LiveHome(tmp_path / "logs", ("mic",))
        other.hears("silence")
        with Bridged(home.folder, broker):
            listener.wait_for(f"{ROOT}/mic/class/barking/on", "")
            listener.wait_for(kitchen, "")
            gone = ('"on_barking": {"p": "binary_sensor"}', '"trigger_barking"')
            listener.wait_until(
                lambda: all(part in listener.values.get(DISCOVERY, "") for part in gone)
            )
            time.sleep(1)
            last = LiveHome(tmp_path / "logs", ("bath",))  # while the bridge runs
            last.hears("silence", "bath")
            listener.wait_for(DISCOVERY, "")
            listener.wait_for(f"{ROOT}/bath/listening", "online")
    for each in (other, last):
        each.close()
    kept = settled_values(broker.port, seconds=0.3)
    assert {topic: kept[topic] for topic in foreign} == foreign
    own = {topic for topic in kept if "/mic" in topic or "kitchen" in topic} - {*foreign}
    assert own == set()


@pytest.mark.parametrize(
    ("hours", "is_renamed"),
    [
        ({"old": [7], "new": [8, 9]}, True),
        ({"old": [7, 9], "new": [8]}, False),
        ({"old": [8, 9], "new": [7, 10]}, True),
        ({"old": [8, 10], "new": [7, 9, 11]}, False),
        ({"old": [8, 9], "new": [7]}, False),
        ({"old": [8], "new": [7, 9]}, True),
        ({"old": [8.5], "new": [8, 9]}, False),  # one log, within one of the other
        ({"old": [8], "new": [8.5, 9.5]}, False),
        ({"new": [8]}, False),  # of another folder
        ({"old": [8]}, True),
    ],
)
def test_a_recorder_that_records_beside_another_one_is_no_other_name_of_it(
    tmp_path, hours, is_renamed
):
    for node, times in hours.items():
        for hour in times:
            start = datetime(2026, 3, 1, tzinfo=UTC) + timedelta(hours=hour)
            log = tmp_path / f"{node}_{start:%Y%m%dT%H%M%SZ}.mcap"
            log.touch()
            os.utime(log, (end := start.timestamp() + 3600, end))
    home = RecorderAddress(tmp_path, "new", midday_zone())
    assert bridge_state.is_renamed(home.folder, home.node, "old", is_first=True) == is_renamed
    assert bridge_state.is_renamed(home.folder, home.node, "old", is_first=False) == (
        is_renamed and "new" in hours
    )
    assert not bridge_state.is_renamed(home.folder, home.node, "new", is_first=True)
    with FolderLock(tmp_path, "old"):
        assert not bridge_state.is_renamed(home.folder, home.node, "old", is_first=True)


def test_two_recorders_of_different_folders_clear_nothing_of_each_other(tmp_path, broker):
    homes = [LiveHome(tmp_path / node / "logs", node=node) for node in ("attic", "home")]
    state = tmp_path / "bridge"
    with Listener(broker.port) as listener:
        for _ in range(2):
            for home in homes:
                home.hears("coughing")
                node = home.folder.parent.name
                with Bridged(home.folder, broker, node=node, state=state):
                    listener.wait_for(f"hearthlog/{node}/mic/class/coughing/on", "ON")
        assert "" not in listener.values.values()
    for node in ("attic", "home"):
        with closing(BridgeState(state, node, pytest.fail)) as own:
            assert own.names("") == ["mqtt"]
    for home in homes:
        home.close()


def test_what_was_switched_off_under_any_name_of_a_recorder_stays_off(tmp_path, monkeypatch):
    for name, label in {"attic": "speech", "home": "coughing"}.items():
        (tmp_path / f"mqtt-{name}.json").write_text(json.dumps({"muted": [label]}))
    monkeypatch.setattr(bridge_state, "is_renamed", lambda *_, **__: True)
    first = BridgeState(tmp_path, "home", pytest.fail)
    first.claim(tmp_path)
    topics = RetainedTopics(first, pytest.fail)
    assert topics.muted() == ["coughing", "speech"]
    assert first.names("mqtt") == ["mqtt", "mqtt/attic"]  # until the next time it is saved
    topics.switch("speech", is_published=True)
    topics.save()
    assert first.names("mqtt") == ["mqtt"]
    first.close()
    again = BridgeState(tmp_path, "home", pytest.fail)
    assert RetainedTopics(again, pytest.fail).muted() == ["coughing"]


@pytest.mark.parametrize(
    "later",
    [
        {"node": "flat"},
        {"topic": "house/sounds"},
        {"discovery_topic": "ha"},
        {"home_assistant": False},
        {"commands": False},
    ],
    ids=str,
)
def test_what_the_configuration_names_otherwise_or_no_more_is_cleared(home, broker, later):
    home.hears("coughing")
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker, commands=True):
            listener.wait_for(f"{ROOT}/told/coughing", "ON")
            listener.wait_for(COMMANDS)
        before = settled_values(broker.port, seconds=0.3)
        with Bridged(home.folder, broker, **({"commands": True} | later)):
            gone = COMMANDS if later.keys() - {"topic"} else f"{ROOT}/bridge"
            listener.wait_for(gone, "")
            listener.wait_until(lambda: "" not in settled_values(broker.port, seconds=0.3))
        after = settled_values(broker.port, seconds=0.3)
    renamed = {
        "node": lambda topic: "/home/" in topic or "hearthlog-home" in topic,
        "topic": lambda topic: topic.startswith(ROOT),
        "discovery_topic": lambda topic: topic.startswith("homeassistant/"),
        "home_assistant": lambda topic: topic.startswith("homeassistant/"),
        "commands": lambda topic: topic == COMMANDS or "/told/" in topic,
    }[next(iter(later))]
    assert any(map(renamed, before))
    assert not any(map(renamed, after))
    assert len(after) >= 1


def test_home_assistant_is_told_everything_again_when_it_starts(home, broker):
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{COUGHING}/on")
        before = len(listener.payloads(DISCOVERY))
        listener.publish("homeassistant/status", "online")
        listener.wait_until(lambda: len(listener.payloads(DISCOVERY)) == before + 1)
        listener.wait_until(lambda: listener.payloads(f"{COUGHING}/on")[-2:] == ["OFF", "OFF"])
    with Listener(broker.port) as listener, Bridged(home.folder, broker, home_assistant=False):
        home.write_segment("coughing", 0.1)
        listener.wait_for(f"{ROOT}/mic/event")
        assert {*listener.payloads(DISCOVERY)[1:]} <= {""}  # what it was told before is cleared


def test_a_folder_without_a_log_is_waited_for_without_a_problem(tmp_path, broker):
    logs = tmp_path / "logs"
    logs.mkdir()
    with Listener(broker.port) as listener, Bridged(logs, broker) as bridged:
        listener.wait_for(f"{ROOT}/bridge", "online")
        home = LiveHome(logs)
        home.hears("coughing")
        listener.wait_for(f"{COUGHING}/on", "ON")
        home.close()
    assert bridged.problems == []


def test_a_folder_that_is_not_there_yet_is_waited_for(tmp_path, broker):
    with (
        Listener(broker.port) as listener,
        Bridged(tmp_path / "logs", broker) as bridged,
    ):
        listener.wait_for(f"{ROOT}/bridge", "online")
        home = LiveHome(tmp_path / "logs")
        home.hears("silence")
        listener.wait_for(f"{ROOT}/mic/listening", "online")
    assert bridged.problems == [f"{tmp_path}/logs: no such folder yet; waiting for a recorder"]
    home.close()


class _Failing:
    def update(self, _news):
        raise ZeroDivisionError("on purpose")

    def close(self):
        pass


def test_an_output_that_fails_stops_no_other(home, broker):
    home.hears("silence")
    with (
        Listener(broker.port) as listener,
        Bridged(home.folder, broker, {"page": _Failing()}) as bridged,
    ):
        listener.wait_for(f"{ROOT}/mic/listening", "online")
    assert set(bridged.problems) == {"page: ZeroDivisionError: on purpose"}


def test_no_event_ends_before_it_begins(home, broker):
    home.write_segment("coughing", 0.5)
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{ROOT}/mic/event_ended")
    kinds = [t.rpartition("/")[2] for _, t, _, _ in listener.messages if "/event" in t]
    assert kinds == ["event", "event_ended"]


@pytest.mark.fast
def test_a_correction_that_comes_in_is_a_mark_in_the_name_of_its_sender_and_counts(home, broker):
    start = home.write_segment("coughing", 20, seconds=3)
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker, commands=True):
        listener.wait_for(f"{COUGHING}/count_today", "1")
        command = {"correct": f"mic-coughing-{start}", "label": "Kettle", "by": "Anna"}
        listener.publish(f"{ROOT}/command", json.dumps(command))
        answer = json.loads(listener.wait_for(f"{ROOT}/command/answer"))
        listener.wait_for(f"{COUGHING}/count_today", "0")
        counts = json.loads(listener.wait_for(f"{COUGHING}/counts"))
        assert (counts["today"], counts["night"]) == (0, None)
    assert answer == {"done": True, "text": f"mic-coughing-{start} was kettle, says Anna"}
    (mark,) = read_marks(next(log for log in find_logs(home.folder) if "review" not in log.name))
    assert mark[:5] == ("mic", start, start + 3 * NANOSECONDS, "kettle", "Anna")
    assert mark.corrects == "live"


def test_a_pause_that_comes_in_has_an_end_and_says_who_asked_for_it(home, broker):
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker, commands=True):
        listener.wait_for(f"{ROOT}/bridge", "online")
        listener.publish(f"{ROOT}/command", '{"pause_minutes": 30, "by": "Anna"}')
        assert "paused for 30 minutes by Anna" in listener.wait_for(f"{ROOT}/command/answer")
        left = paused_until(home.folder) - time.time()
        assert 1700 < left <= 1800
        listener.publish(f"{ROOT}/command", '{"resume": true}')
        listener.wait_for(f"{ROOT}/command/answer", '{"done": true, "text": "it listens again"}')
    assert not (home.folder / ".pause").exists()


def test_a_class_that_is_switched_off_is_not_told_of_also_after_a_restart(home, broker):
    home.hears("coughing")
    command = {"told": False, "label": "coughing", "by": "Anna"}
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker, commands=True):
            listener.wait_for(f"{COUGHING}/on", "ON")
            listener.publish(f"{ROOT}/command", json.dumps(command))
            listener.wait_for(f"{ROOT}/told/coughing", "OFF")
            listener.wait_for(f"{COUGHING}/on", "OFF")
        with Bridged(home.folder, broker, commands=True):
            home.hears("coughing")
            home.write_segment("coughing", 0.1)
            home.write_segment("speech", 0.1)
            listener.wait_for(f"{COUGHING}/count_today", "1")  # the log has it all the same
            event = json.loads(listener.wait_for(f"{ROOT}/mic/event"))
            assert event["event_type"] == "speech"
            assert listener.values[f"{COUGHING}/on"] == "OFF"
            assert json.loads(listener.values[f"{ROOT}/mic/heard"])["label"] == "unknown"
            last = [
                json.loads(p)["event_type"] for p in listener.payloads(f"{ROOT}/mic/last_event")
            ]
            assert set(last) <= {"speech"}
            listener.publish(f"{ROOT}/command", json.dumps(command | {"told": True}))
            listener.wait_for(f"{ROOT}/told/coughing", "ON")
            home.hears("coughing")
            listener.wait_for(f"{COUGHING}/on", "ON")


@pytest.mark.fast
def test_what_somebody_left_at_the_broker_silences_nothing_where_no_commands_are_taken(
    home, broker
):
    home.hears("coughing")
    start = home.write_segment("coughing", 0.2)
    last = json.dumps({"id": f"mic-coughing-{start}"})
    left = {f"{ROOT}/told/{label}": "OFF" for label in ("coughing", "%23", "speech")}
    with Listener(broker.port) as listener:
        for topic, value in (left | {f"{ROOT}/mic/last_event": last}).items():
            listener.publish(topic, value, retain=True)
        with Bridged(home.folder, broker) as bridged:
            listener.wait_for(f"{COUGHING}/on", "ON")
            assert json.loads(listener.values[f"{ROOT}/mic/heard"])["label"] == "coughing"
            event = json.loads(listener.wait_for(f"{ROOT}/mic/event"))
            assert event["id"] == f"mic-coughing-{start}"
            broker.kill()
            broker.start()
            home.hears("silence")
            listener.wait_for(f"{COUGHING}/on")
    assert not any(line.startswith("mqtt:") for line in bridged.problems)


def test_what_was_switched_off_stays_so_without_commands_and_one_is_told_how_to_undo_it(
    home, broker
):
    home.hears("coughing")
    command = {"told": False, "label": "coughing"}
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker, commands=True):
            listener.wait_for(f"{COUGHING}/on", "ON")
            listener.publish(f"{ROOT}/command", json.dumps(command))
            listener.wait_for(f"{COUGHING}/on", "OFF")
        with Bridged(home.folder, broker) as bridged:
            home.write_segment("coughing", 0.1)
            home.write_segment("speech", 0.1)
            assert json.loads(listener.wait_for(f"{ROOT}/mic/event"))["event_type"] == "speech"
        (line,) = bridged.problems
        assert line.startswith("mqtt: not published: coughing; ")
        assert line.endswith("start the bridge once with --unmute coughing")
        config = home.folder.parent / "home.toml"
        config.write_text(
            f'output = "{home.folder}"\n[bridge.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n'
        )
        refused = start_bridge(config, home.folder.parent / "said", "--unmute", "music")
        assert refused.wait(60) == 2
        assert (
            "--unmute music: this class is published; muted: coughing"
            in (home.folder.parent / "said").read_text()
        )
        bridge = start_bridge(config, home.folder.parent / "said", "--unmute", "cough")
        try:
            home.hears("coughing")
            listener.wait_for(f"{COUGHING}/on", "ON")
        finally:
            bridge.terminate()
            bridge.wait()
    assert kept(home)["muted"] == []


def test_a_class_that_is_hidden_leaves_the_broker_until_it_is_shown_again(home, broker):
    home.hears("coughing")
    with Listener(broker.port) as listener, Bridged(home.folder, broker) as bridged:
        listener.wait_for(f"{COUGHING}/on", "ON")
        write_hidden_classes(home.folder, ["coughing"])
        listener.wait_for(f"{COUGHING}/on", "")
        (home.folder / NEVER_TELL_FILE).write_text("{")  # damaged: it stays hidden
        home.hears("coughing")
        listener.wait_until(
            lambda: any("is no list of classes" in line for line in bridged.problems)
        )
        listener.wait_for(f"{ROOT}/mic/heard", '{"label": "unknown", "confidence": 0.9}')
        assert listener.values[f"{COUGHING}/on"] == ""
        removed = json.loads(listener.values[DISCOVERY])["components"]["on_coughing"]
        assert removed == {"p": "binary_sensor"}  # without more, Home Assistant removes it
        write_hidden_classes(home.folder, [])
        home.hears("coughing")
        listener.wait_for(f"{COUGHING}/on", "ON")


def test_what_earlier_versions_switched_off_is_taken_over_where_commands_are_taken(home, broker):
    home.hears("coughing")
    with Listener(broker.port) as listener:
        for label in ("coughing", "speech"):
            listener.publish(f"{ROOT}/told/{label}", "OFF", retain=True)
        with Bridged(home.folder, broker, commands=True) as bridged:
            listener.wait_for(f"{COUGHING}/on", "OFF")
            listener.wait_for(f"{ROOT}/told/music", "ON")
    assert listener.values[f"{ROOT}/told/speech"] == "OFF"
    assert any("not published: coughing, speech; " in line for line in bridged.problems)


def test_what_no_model_knows_is_not_switched_off_by_what_is_left_at_the_broker(home, broker):
    home.hears("coughing")
    with Listener(broker.port) as listener:
        for label in ("coughing", "%3Devil", "kettle"):
            listener.publish(f"{ROOT}/told/{label}", "OFF", retain=True)
        with Bridged(home.folder, broker, commands=True) as bridged:
            listener.wait_for(f"{COUGHING}/on", "OFF")
    assert [line.partition("; ")[0] for line in bridged.problems] == [
        "mqtt: not published: coughing"
    ]
    memory = kept(home)
    assert memory["muted"] == ["coughing"]


def test_topics_with_another_name_are_cleared_at_a_broker_by_another_address(home, broker):
    home.hears("coughing")
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker):
            listener.wait_for(f"{COUGHING}/on", "ON")
        with Bridged(home.folder, broker, host="localhost", topic="house"):
            listener.wait_for(f"{ROOT}/bridge", "")
            listener.wait_until(lambda: "" not in settled_values(broker.port, seconds=0.3))
        after = settled_values(broker.port, seconds=0.3)
    assert not any(topic.startswith(ROOT) for topic in after)
    assert any(topic.startswith("house/") for topic in after)


@pytest.mark.parametrize("commands", [True, False])
def test_what_a_bridge_left_whose_memory_is_lost_is_cleared_and_nobody_elses_is(
    tmp_path, broker, commands
):
    home = LiveHome(tmp_path / "logs", ("kitchen", "mic"))
    for microphone in ("kitchen", "mic"):
        home.hears("coughing", microphone)
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker, commands=True):
            for microphone in ("kitchen", "mic"):
                listener.wait_for(f"{ROOT}/{microphone}/class/coughing/on", "ON")
            listener.wait_for(COMMANDS)
        home.close()
        (home.folder.parent / "bridge" / "state.sqlite3").unlink()
        kitchen = f"homeassistant/device/{device_id('home', 'kitchen')}/config"
        description = listener.values[kitchen]
        changes = {  # of others, however alike
            "homeassistant/device/hearthlog-attic-kitchen/config": ("home", "attic"),
            "homeassistant/device/another/config": ("hearthlog-home-kitchen", "another"),
            "homeassistant/device/moved/config": ("hearthlog/home/bridge", "x/home/bridge"),
        }
        foreign = {topic: description.replace(*change) for topic, change in changes.items()}
        foreign["homeassistant/device/no/config"] = "[" * 9000
        foreign["hearthlog/attic/bridge"] = "online"
        for topic, value in foreign.items():
            listener.publish(topic, value, retain=True)
        time.sleep(1)  # logs are named by the second
        later = LiveHome(home.folder, ("mic",))
        later.hears("coughing")
        with Bridged(home.folder, broker, commands=commands):
            listener.wait_for(kitchen, "")
            listener.wait_until(lambda: "" not in settled_values(broker.port, seconds=0.3))
            listener.wait_until(
                lambda: not any("kitchen" in key for key in _own(broker.port) - {*foreign})
            )
            listener.wait_until(lambda: (COMMANDS in _own(broker.port)) == commands)
        later.close()
        after = settled_values(broker.port, seconds=0.3)
    assert {topic: after.get(topic) for topic in foreign} == foreign
    assert f"{ROOT}/mic/class/coughing/on" in after


@pytest.mark.parametrize("kind", ["large", "many", "long"])
def test_what_is_left_at_a_broker_is_taken_over_up_to_a_bound(home, broker, kind):
    home.hears("coughing")
    topics = Topics("hearthlog", "home")
    count, name = {"large": (1, "x"), "many": (3000, "x"), "long": (100, "x" * 1000)}[kind]
    with Listener(broker.port) as listener:
        for number in range(8):
            classes = [f"{name}{each}" for each in range(count)]
            found = discovery(topics, f"old{number}", classes)
            found["components"] = {
                key: {"state_topic": each["state_topic"]}
                for key, each in found["components"].items()
                if "state_topic" in each
            }
            found["padding"] = "x" * (1 << 20) if kind == "large" else ""
            text = json.dumps(found)
            assert kind == "large" or len(text) < 1 << 20
            listener.publish(f"homeassistant/device/{number}/config", text, retain=True)
        listener.wait_for("homeassistant/device/7/config")
        with Bridged(home.folder, broker):
            listener.wait_for(f"{COUGHING}/on", "ON")
    memory = kept(home)
    taken = [topic for topic in memory["topics"] if "/old" in topic]
    assert (len(taken) == 0) == (kind == "large")
    assert len(taken) <= 5000
    assert len(json.dumps(memory)) < 4 << 20


def test_what_is_left_at_a_broker_far_away_is_taken_over(home, broker):
    home.hears("coughing")
    topics = Topics("hearthlog", "home")
    with Listener(broker.port) as listener, SlowLink(broker.port, 0.8) as link:
        for number in range(3):
            found = discovery(topics, f"old{number}", ["coughing"]) | {"padding": "x" * 1_000_000}
            text = json.dumps(found)
            listener.publish(f"homeassistant/device/{number}/config", text, retain=True)
        with Bridged(home.folder, link):
            listener.wait_for(f"{COUGHING}/on", "ON")
    memory = kept(home)
    assert {f"old{number}" for number in range(3)} <= {
        part for topic in memory["topics"] for part in topic.split("/")
    }


def test_what_comes_to_a_broker_later_is_not_taken_for_what_a_bridge_left(home, broker):
    home.hears("coughing")
    config = "homeassistant/device/later/config"
    with Listener(broker.port) as listener, Bridged(home.folder, broker) as bridged:
        listener.wait_for(f"{COUGHING}/on", "ON")
        text = (
            listener.wait_for(DISCOVERY).replace("home-mic", "home-hall").replace("/mic/", "/hall/")
        )
        listener.publish(f"{ROOT}/hall/level", "-3", retain=True)
        message = MQTTMessage(topic=config.encode())
        message.payload, message.retain = text.encode(), True
        assert topics_in_discovery(Topics("hearthlog", "home"), message.payload)
        bridged.publisher._take(message)
        home.write_segment("coughing", 0.1)
        listener.wait_for(f"{ROOT}/mic/event")
    assert listener.values[f"{ROOT}/hall/level"] == "-3"
    assert "/hall/" not in json.dumps(kept(home))


def _own(port):
    return settled_values(port, seconds=0.3).keys()


def test_a_recorder_that_gets_its_former_name_back_leaves_nothing_of_the_other(tmp_path, broker):
    with Listener(broker.port) as listener:
        for node in ("home", "attic", "home"):
            home = LiveHome(tmp_path / "logs", node=node, minutes_ago=0)
            home.hears("coughing")
            with Bridged(home.folder, broker, node=node):
                listener.wait_for(f"hearthlog/{node}/mic/class/coughing/on", "ON")
                other = "attic" if node == "home" else "home"
                listener.wait_until(
                    lambda other=other: (
                        not any(
                            f"/{other}/" in topic or f"hearthlog-{other}" in topic
                            for topic in _own(broker.port)
                        )
                    )
                )
            home.close()
            time.sleep(1)  # logs are named by the second


def test_a_second_bridge_with_the_same_state_ends_with_a_line(home, broker):
    home.hears("coughing")
    folder = home.folder.parent
    config = folder / "home.toml"
    config.write_text(
        f'output = "{home.folder}"\n[bridge.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n'
        'topic = "other"\n'
    )
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{COUGHING}/on")
        assert start_bridge(config, folder / "said").wait(60) == 1
        assert "" not in listener.values.values()
    assert "other" not in {topic.partition("/")[0] for topic in listener.values}
    assert (folder / "said").read_text().count("is used by another bridge of home; stop that") == 1


def test_home_assistant_has_switches_and_buttons_only_where_commands_are_taken(home, broker):
    home.hears("coughing")
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker, commands=True):
            parts = json.loads(listener.wait_for(COMMANDS))["components"]
            switch, button = parts["told_coughing"], parts["resume"]
            listener.wait_for(switch["state_topic"], switch["state_on"])
            listener.publish(switch["command_topic"], switch["payload_off"])
            listener.wait_for(switch["state_topic"], switch["state_off"])
            listener.publish(button["command_topic"], button["payload_press"])
            listener.wait_for(
                f"{ROOT}/command/answer", '{"done": true, "text": "it was not paused"}'
            )
        with Bridged(home.folder, broker):
            listener.wait_for(COMMANDS, "")


def test_there_are_buttons_where_no_class_is_known_yet(home, broker):
    with Listener(broker.port) as listener, Bridged(home.folder, broker, commands=True):
        assert {*json.loads(listener.wait_for(COMMANDS))["components"]} == {"pause", "resume"}


def test_a_bridge_that_is_started_again_tells_of_no_event_twice(home, broker):
    home.hears("silence")
    with Listener(broker.port) as listener:
        with Bridged(home.folder, broker):
            first = home.write_segment("coughing", 0.3)
            listener.wait_until(lambda: len(listener.payloads(f"{ROOT}/mic/event")) == 1)
        second = home.write_segment("speech", 0.2)  # while there is no bridge
        with Bridged(home.folder, broker):
            third = home.write_segment("laughing", 0.1)
            listener.wait_until(lambda: len(listener.payloads(f"{ROOT}/mic/event")) == 3)
        ids = [json.loads(event)["id"] for event in listener.payloads(f"{ROOT}/mic/event")]
    assert ids == [f"mic-coughing-{first}", f"mic-speech-{second}", f"mic-laughing-{third}"]


def test_classes_that_go_while_the_bridge_runs_are_cleared(home, broker):
    home.hears("coughing")
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{COUGHING}/on")
        time.sleep(1)  # logs are named by the second
        other = LiveHome(home.folder, classes=["silence", "shower"])
        other.hears("shower")
        listener.wait_for(f"{ROOT}/mic/class/shower/on")
        listener.wait_for(f"{COUGHING}/on", "")
        gone = '"on_coughing": {"p": "binary_sensor"}'
        listener.wait_until(lambda: gone in listener.values[DISCOVERY])
    other.close()


SENSELESS = [
    ("{", "command: Invalid JSON"),
    ("[]", "command: Input should be an object"),
    ("{}", "one of correct, told, pause_minutes and resume is required"),
    ('{"resume": true, "pause_minutes": 3}', "one of correct, told, pause_minutes and"),
    ('{"told": false}', "label belongs to correct and told"),
    ('{"pause_minutes": 1e9}', "pause_minutes: Input should be less than or equal to"),
    ('{"pause_minutes": 3, "for": 3}', "for: Extra inputs are not permitted"),
    ('{"correct": "x"}', "label belongs to correct and told"),
    ('{"correct": "x", "label": "../y"}', "'../y' cannot be the name of a class"),
    ('{"correct": "x", "label": "kettle"}', "'x' is no event since last evening"),
    ('{"resume": true, "by": "a\\u0000"}', "by: String should match pattern"),
    (f'{{"by": "{"x" * 5000}"}}', "a command has 4096 bytes at most"),
]


def test_a_command_that_makes_no_sense_is_answered_so(home, broker):
    home.hears("silence")
    answer = f"{ROOT}/command/answer"
    with Listener(broker.port) as listener, Bridged(home.folder, broker, commands=True):
        listener.wait_for(f"{ROOT}/bridge", "online")
        for number, (command, problem) in enumerate(SENSELESS, 1):
            listener.publish(f"{ROOT}/command", command)
            listener.wait_until(lambda n=number: len(listener.payloads(answer)) == n)
            answered = json.loads(listener.payloads(answer)[-1])
            assert not answered["done"]
            assert answered["text"].startswith(f"refused: {problem}")


def test_commands_are_not_taken_unless_the_configuration_says_so(home, broker):
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{ROOT}/bridge", "online")
        listener.publish(f"{ROOT}/command", '{"pause_minutes": 30}')
        home.write_segment("coughing", 0.1)
        listener.wait_for(f"{ROOT}/mic/event")
        assert f"{ROOT}/command/answer" not in listener.values
    assert not (home.folder / ".pause").exists()


def test_a_broker_has_states_and_counts_after_random_kills_as_the_logs_have_them(tmp_path, sounds):
    ending = kill_at_random(tmp_path, sounds, "general", 24, 2, random.Random(3))
    assert any(topic.endswith("/last_heard") for topic in ending.expected)
    assert ending.wrong == [], ending.output


def test_a_recorder_and_a_bridge_that_end_are_said_to_be_away(tmp_path, broker, sounds):
    config, output = tmp_path / "home.toml", tmp_path / "said"
    config.write_text(
        f'output = "{tmp_path}/logs"\ntimezone = "{ZONE}"\n'
        f'[bridge.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n'
    )
    recorder = start_recorder(config, sounds, "general", output)
    bridge = start_bridge(config, output)
    with Listener(broker.port) as listener:
        listener.wait_for(f"{ROOT}/mic/listening", "online")
        listener.wait_for(f"{ROOT}/recorder", "online")
        recorder.terminate()
        recorder.wait()
        listener.wait_for(f"{ROOT}/mic/listening", "offline")
        listener.wait_for(f"{ROOT}/recorder", "offline")
        recorder = start_recorder(config, sounds, "general", output)
        listener.wait_for(f"{ROOT}/mic/listening", "online")
        bridge.send_signal(signal.SIGSTOP)  # for longer than a recorder may be silent
        time.sleep(17)
        bridge.send_signal(signal.SIGCONT)
        seen = len(listener.messages)
        listener.wait_until(lambda: f"{ROOT}/mic/heard" in _topics(listener, seen))
        assert f"{ROOT}/mic/listening" not in _topics(listener, seen)
        bridge.kill()
        bridge.wait()
        listener.wait_for(f"{ROOT}/bridge", "offline")
    recorder.kill()
    recorder.wait()


def _topics(listener, first):
    return {topic for _, topic, _, _ in listener.messages[first:]}


def test_a_log_of_a_later_version_is_named_and_read_as_far_as_it_is_known(tmp_path, broker):
    home = LiveHome(tmp_path / "logs", schema_version="99")
    home.hears("coughing")
    with Listener(broker.port) as listener, Bridged(home.folder, broker) as bridged:
        listener.wait_for(f"{COUGHING}/on", "ON")
    (line,) = bridged.problems
    assert "is of schema version '99', and this hearthlog knows up to " in line
    assert line.endswith("; update hearthlog")
    home.close()


def test_a_class_that_is_named_like_a_wildcard_has_topics_of_its_own(tmp_path, broker):
    hostile = ["silence", "#", "+", "a/b/../c", "%2B", "{{ 1 }}", "$SYS", "é\u0000\n"]
    home = LiveHome(tmp_path / "logs", classes=hostile)
    home.hears("+")
    home.write_segment("#", 0.1)
    with Listener(broker.port) as listener, Bridged(home.folder, broker) as bridged:
        listener.wait_for(f"{ROOT}/mic/class/%2B/on", "ON")
        listener.wait_for(f"{ROOT}/mic/class/%23/count_today", "1")
        listener.wait_for(f"{ROOT}/mic/class/%252B/on", "OFF")
        config = json.loads(listener.wait_for(DISCOVERY))
    on = {topic for topic in listener.values if topic.endswith("/on")}
    assert len(on) == len(hostile) - 1
    assert all(topic.count("/") == 5 for topic in on)
    states = [c["state_topic"] for k, c in config["components"].items() if k.startswith("on_")]
    assert set(states) == on
    assert bridged.problems == []
    home.close()


def test_the_classes_of_a_log_are_told_of_before_one_of_them_is_heard(home, broker):
    home.hears("silence")
    with Listener(broker.port) as listener, Bridged(home.folder, broker):
        listener.wait_for(f"{COUGHING}/on")
        topics = [topic for _, topic, _, _ in listener.messages]
        config = json.loads(listener.values[DISCOVERY])
    assert topics.index(DISCOVERY) < topics.index(f"{COUGHING}/on")
    assert config["components"]["event"]["event_types"] == [c for c in GENERAL if c != "silence"]
