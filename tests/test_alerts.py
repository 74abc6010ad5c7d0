"""Alerts while a log is written: the same as on replay, and told once, also after a restart."""

import json
import shutil
import time
from contextlib import contextmanager
from datetime import UTC, date
from functools import partial
from itertools import chain, repeat
from threading import Event, Lock, Thread
from types import SimpleNamespace
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import HOUR, midnight, write_day
from livehome import LiveHome as WrittenHome
from livehome import following, rule
from log_fixtures import run
from waiting import wait_for

from hearthlog.analyzer.activity.live import LiveActivity, LiveLabel
from hearthlog.analyzer.activity.segments import SegmentCollector, read_activity
from hearthlog.analyzer.bridge.alerts.delivery import Outbox
from hearthlog.analyzer.bridge.alerts.evaluation import notifications
from hearthlog.analyzer.bridge.alerts.output import AlertsOutput, RuleProgressStore, RuleWatch
from hearthlog.analyzer.bridge.alerts.rules import Notification, RuleState
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.settings import DeliverySettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState, state_folder
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.models.features.auros21 import FEATURE_NAMES
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, log_path
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages.topics import topics_of


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


SECOND = 1_000_000_000
MINUTE = 60 * SECOND
CLASSES = ["silence", "speech", "coughing", "tap_water"]
DAY = date(2026, 3, 2)
AHEAD = 400 * 24 * HOUR * SECOND


def watching(folder, rules, now, say=pytest.fail):
    """An evaluation of rules, with its notifications, and its progress on the disk."""
    state = BridgeState(folder, "home", say)
    outbox = Outbox(state, ["x"], say)
    memory = RuleProgressStore(state, say)
    return RuleWatch(rules, UTC, outbox, memory, say, now), outbox, memory


COUGHS = rule("more_than", "coughs", count=2, window="1h", **{"class": "coughing"})
WATER = rule("longer_than", "water", longer_than="10m", **{"class": "tap_water"})
QUIET = rule("none_by", "quiet", since="01:00", by="03:00", **{"class": "speech"})
DEAF = rule("none_by", "deaf", since="03:00", by="04:30", **{"class": "speech"})
EACH = rule("more_than", "each", count=0, window="1m", cooldown="1m", **{"class": "coughing"})
SPEECH = rule("more_than", "speech", minutes=7, window="20m", cooldown="10m", **{"class": "speech"})


def labels_of(columns):
    """What each second of the day is labelled as, as far as it was heard."""
    labels = {}
    fields = (columns[name].tolist() for name in ("header.stamp", "duration", "label"))
    for start, duration, label in zip(*fields, strict=True):
        labels |= dict.fromkeys(range(start // SECOND, (start + duration) // SECOND), label)
    return labels


def test_what_is_followed_live_rings_as_on_replay(tmp_path):
    """Long sounds have no segment yet when they ring, nor has a long silence when it is judged."""
    rng = np.random.default_rng(4)
    events = [(second, 2.0, "coughing", 0.9) for second in rng.uniform(0, 5 * HOUR, 60)]
    events += [(600.0 + 3600 * n, 1500.0, "tap_water", 0.9) for n in range(2)]
    events += [(16_320.0, 440.0, "speech", 0.8), (18_500.0, 900.0, "speech", 0.8)]
    about = {"classes": CLASSES, "hours": range(6), "gaps": [(11_000, 4000, "unplugged")]}
    write_day(tmp_path / "logs", DAY, events, **about)
    begin = midnight(DAY)
    (columns,) = read_columns(find_logs(tmp_path), ["/mic/segment"]).values()
    gaps = read_columns(find_logs(tmp_path), ["/mic/gap"])["/mic/gap"]
    labels = labels_of(columns)
    rules = [COUGHS, WATER, QUIET, DEAF, SPEECH, EACH]
    watch, outbox, _ = watching(tmp_path, rules, begin + MINUTE)
    live, now, found, until = LiveActivity(begin, 30 * SECOND), begin + MINUTE, [], 0
    edge = begin
    while now < begin + 5.5 * HOUR * SECOND:
        live.push([columns.between(edge, now), gaps.between(edge, now)])
        for second in range(edge // SECOND, now // SECOND):
            if second in labels:
                live.add_label("mic", LiveLabel(second * SECOND, labels[second], 0.9), CLASSES)
        until = live.complete_until(now)
        new = watch.evaluate(live.activity, pytest.fail, until, now)
        assert all(now - each.time < 90 * SECOND for each in new)
        found += new
        live.forget_before(watch.needed_from(now))
        edge, now = now, now + int(rng.integers(1, 40)) * SECOND
    recorded = read_activity(
        find_home_logs([tmp_path / "logs"]), "home", begin, 1 << 62, pytest.fail
    )
    expected = [notifications(one, recorded, begin + MINUTE, until, UTC)[0] for one in rules]
    assert sorted(found) == sorted(ring for own in expected for ring in own)
    assert [len(own) > 0 for own in expected] == [True] * 6
    assert [ring.is_known for own in expected[2:4] for ring in own] == [True, False]
    assert outbox.waiting_for("x", 1 << 62) == sorted(found, key=lambda ring: ring.time)


def test_what_was_read_and_the_news_after_it_are_the_activity_of_a_replay(tmp_path):
    """Also what is among the news although it was read."""
    rng = np.random.default_rng(6)
    events = [(second, 2.0, "coughing", 0.9) for second in rng.uniform(0, 4 * HOUR, 80)]
    gaps = [(5000, 600, "unplugged")]
    write_day(tmp_path, DAY, events, classes=CLASSES, hours=range(4), gaps=gaps)
    begin, logs = midnight(DAY), find_home_logs([tmp_path])
    columns = [
        part
        for kind in ("segment", "gap")
        for part in read_columns(find_logs(tmp_path), [f"/mic/{kind}"]).values()
    ]
    live = LiveActivity(begin, 30 * SECOND)
    live.read(logs, "home", begin + 2 * HOUR * SECOND, pytest.fail)
    halfway = live.activity().written
    assert len(halfway.starts) == 1, "the recorder wrote in the gap, too"
    for number in range(8):
        edges = [begin + half * HOUR * SECOND // 2 for half in (number, number + 1)]
        live.push([part.between(*edges) for part in columns])
    live.push([part.between(begin + 4 * HOUR * SECOND, None) for part in columns])
    expected = read_activity(logs, "home", begin, 1 << 62, pytest.fail)
    assert live.activity().sounds.keys() == expected.sounds.keys()
    for key, own in expected.sounds.items():
        got = live.activity().sounds[key]
        np.testing.assert_array_equal(got.starts, own.starts)
        np.testing.assert_array_equal(got.ends, own.ends)
    for one, other in zip(live.activity().coverage["mic"], expected.coverage["mic"], strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_more_is_known_than_labels_have_decided():
    live, begin = LiveActivity(0, 30 * SECOND), 1000
    assert live.complete_until(2000 * SECOND) == 1970 * SECOND  # nobody is heard
    for second in range(begin, begin + 100):
        live.add_label("mic", LiveLabel(second * SECOND, "silence", 0.9), CLASSES)
    now = (begin + 100) * SECOND
    assert live.complete_until(now) == (begin + 94) * SECOND
    assert live.complete_until(now + 100 * SECOND) == now + 70 * SECOND  # it is away


def test_a_scenario_that_is_taken_away_keeps_nobody_waiting():
    live, begin = LiveActivity(0, 30 * SECOND), 1_000_000 * SECOND
    for second in range(3 * 3600):
        time = begin + second * SECOND
        live.add_label("mic", LiveLabel(time, "silence", 0.9), ["silence", "speech"])
        if second < 3600:
            live.add_label("mic-water", LiveLabel(time, "tap_water", 0.9), ["silence", "tap_water"])
    assert time - live.complete_until(time) < 10 * SECOND
    assert [name for name, *_ in live.open_segments()] == ["mic"]
    taps = live.activity().of("tap_water")
    assert taps.ends.tolist() == [begin + (3599 - 5) * SECOND]


def test_what_was_heard_before_a_recorder_was_killed_stays_heard(tmp_path):
    """Its last segment was never written; the next recorder writes the gap that follows."""
    write_day(tmp_path, DAY, hours=range(3), gaps=[(2 * HOUR, 600, "the recorder was not running")])
    gaps = read_columns(find_logs(tmp_path), ["/mic/gap"])["/mic/gap"]
    begin = midnight(DAY)
    live = LiveActivity(begin, 30 * SECOND)
    for second in range(100, 2 * HOUR, 10):
        live.add_label("mic", LiveLabel(begin + second * SECOND, "silence", 0.9), CLASSES)
    before = live.activity().coverage["mic"].length
    assert before > 1.9 * HOUR * SECOND
    live.push([gaps])
    assert live.activity().coverage["mic"].length == before


def test_what_rang_while_the_bridge_was_down_is_told_once_unless_a_day_ago(
    tmp_path,
):
    events = [(HOUR + 60.0 * n, 2.0, "coughing", 0.9) for n in range(3)]
    write_day(tmp_path / "logs", DAY, events, classes=CLASSES)
    begin = midnight(DAY)
    recorded = read_activity(
        find_home_logs([tmp_path / "logs"]), "home", begin, 1 << 62, pytest.fail
    )
    for down_hours, expected in ((20, 1), (30, 0)):
        folder = tmp_path / str(down_hours)
        state = BridgeState(folder, "home", pytest.fail)
        outbox = Outbox(state, ["x"], pytest.fail)
        memory = RuleProgressStore(state, pytest.fail)

        def start(now, memory=memory, outbox=outbox):
            return RuleWatch([COUGHS], UTC, outbox, memory, pytest.fail, now)

        start(begin).save(begin)
        now = begin + down_hours * HOUR * SECOND
        for _ in range(2):  # the second bridge is killed before it has remembered, the third not
            before = state.read("rules")
            assert len(start(now).evaluate(lambda: recorded, pytest.fail, now, now)) == expected
            state.write("rules", before)
        assert len(outbox) == expected
        start(now).evaluate(lambda: recorded, pytest.fail, now, now)
        start(now).save(now)
        assert start(now).evaluate(lambda: recorded, pytest.fail, now + SECOND, now + SECOND) == []


def test_a_new_rule_does_not_ring_for_the_silence_before_it(tmp_path):
    silent = rule("recorder_silent", "silent", silent_for="10m")
    begin = midnight(DAY)
    watch, _, _ = watching(tmp_path, [silent], begin)
    nothing = SegmentCollector().activity()

    def ring_times(minutes):
        until = begin + minutes * 60 * SECOND
        found = watch.evaluate(lambda: nothing, pytest.fail, until, until)
        return [(ring.time - begin) // (60 * SECOND) for ring in found]

    assert ring_times(1) == []
    assert ring_times(9) == []
    assert ring_times(30) == [10]  # no recorder came


def test_weeks_are_read_once_a_day_when_they_are_judged(tmp_path):
    for number in range(1, 11):
        events = [(9 * HOUR, 3000.0 if number == 10 else 300.0, "tap_water", 0.9)]
        write_day(tmp_path / "logs", DAY.replace(day=number), events, classes=CLASSES, file_hours=6)
    one = rule("unlike_usual", of="minutes", **{"class": "tap_water"})
    now = midnight(DAY.replace(day=10)) + 12 * HOUR * SECOND
    watch, _, _ = watching(tmp_path, [one], now)
    requested = []

    def weeks(start, end):
        requested.append(end)
        return read_activity(find_home_logs([tmp_path / "logs"]), "home", start, end, pytest.fail)

    found = []
    for _ in range(30):
        now += HOUR * SECOND
        found += watch.evaluate(pytest.fail, weeks, now, now)
    assert len(requested) == 1
    assert [ring.text for ring in found] == ["Water tap on 2026-03-10: 50 min, usually 5 min"]


def test_a_rule_that_was_changed_begins_anew_and_a_damaged_memory_too(tmp_path):
    output = []
    state = BridgeState(tmp_path, "home", pytest.fail)
    memory = RuleProgressStore(state, output.append)
    progress = {"coughs": RuleState(5, has_rung=True, until=7)}
    memory.save([COUGHS], progress)
    assert memory.load([COUGHS]) == progress
    changed = COUGHS.model_copy(update={"count": 3})
    assert memory.load([changed])["coughs"].until == 0
    assert output == []
    state.write("rules", '{"x": 3}')
    assert memory.load([COUGHS])["coughs"].until == 0
    assert output == [f"{state.path}, rules: cannot be read; all rules start over"]


def test_a_clock_that_ran_ahead_does_not_silence_a_rule(tmp_path):
    output = []
    memory = RuleProgressStore(BridgeState(tmp_path, "home", pytest.fail), output.append)
    memory.save([COUGHS], {"coughs": RuleState(until=9 * HOUR * SECOND)})
    watch, _, _ = watching(tmp_path, [COUGHS], HOUR * SECOND, output.append)
    assert watch.needed_from(HOUR * SECOND) < HOUR * SECOND
    assert output == ["alerts: the clock was set back; the rules start over"]


def test_one_look_with_the_clock_ahead_does_not_silence_rules_nor_ring_in_time_to_come(tmp_path):
    output, now = [], midnight(DAY) + 4 * HOUR * SECOND
    silent = rule("recorder_silent", "silent", silent_for="10m", cooldown="1m")
    watch, outbox, memory = watching(tmp_path, [silent, QUIET, COUGHS], now, output.append)
    nothing = SegmentCollector().activity()

    def evaluate(until):
        return watch.evaluate(lambda: nothing, pytest.fail, until, until)

    assert evaluate(now + SECOND) == []
    assert {ring.rule for ring in evaluate(now + AHEAD)} == {"silent", "quiet"}
    assert len(outbox) == 2
    assert evaluate(now + 2 * SECOND) == []
    assert len(outbox) == 0
    assert memory.load([COUGHS])["coughs"].until == now + 2 * SECOND  # also after a kill
    assert [ring.rule for ring in evaluate(now + 11 * MINUTE)] == ["silent"]
    assert output == ["alerts: the clock was set back; the rules start over"]


class Recorder(Thread):
    """Writes a log up to now, and on: silence, three coughs, then water of which is no segment."""

    def __init__(self, root):
        super().__init__(daemon=True)
        now = time.time_ns() // SECOND * SECOND
        self.stop, self.water = Event(), now - 15 * MINUTE
        topics = topics_of("mic", FEATURE_NAMES, CLASSES)
        path = log_path(root, "home", now - HOUR * SECOND)
        self.writer = LogWriter(path, topics, {"node": "home"})
        rows = [(now - HOUR * SECOND, "silence")]
        for cough in range(3):
            start = now - (40 - cough) * MINUTE
            rows += [(start, "coughing"), (start + 2 * SECOND, "silence")]
        starts = np.array([start for start, _ in rows])
        ends = np.append(starts[1:], self.water)
        fields = {
            "header.stamp": starts,
            "header.frame_id": "mic",
            "duration": ends - starts,
            "label": [label for _, label in rows],
            "confidence": np.full(len(rows), 0.9, np.float32),
        }
        self.writer.write_columns([TopicBatch("/mic/segment", ends, fields)])
        self.writer.flush()
        self.lock = Lock()
        self.start()

    def write_segment(self, end):
        """Write a second of silence."""
        ends = np.array([end])
        fields = {
            "header.stamp": ends - SECOND,
            "header.frame_id": "mic",
            "duration": np.array([SECOND]),
            "label": ["silence"],
            "confidence": np.array([0.9], np.float32),
        }
        with self.lock:
            self.writer.write_columns([TopicBatch("/mic/segment", ends, fields)])
            self.writer.flush()

    def run(self):
        while not self.stop.is_set():
            times = np.array([time.time_ns()])
            fields = {
                "header.stamp": times,
                "header.frame_id": "mic",
                "frame": times,
                "label": ["tap_water"],
                "confidence": np.array([0.9], np.float32),
                "novelty": np.zeros(1, np.float32),
                "probabilities": np.zeros((1, len(CLASSES)), np.float32),
            }
            with self.lock:
                self.writer.write_columns([TopicBatch("/mic/label", times, fields)])
                self.writer.flush()
            self.stop.wait(0.5)  # as a recorder does
        self.writer.finish()


@contextmanager
def bridge(root, rules, reported, output):
    """A bridge that tells of rings of some rules."""
    home = RecorderAddress(root / "logs", "home", ZoneInfo("Europe/Vienna"))

    def send(*ring):
        is_taken = next(connected)
        reported.extend([ring] * is_taken)
        return is_taken

    state = BridgeState(root / "state", "home", output.append)
    connected = chain([False, False], repeat(True))  # the broker comes after the first ring
    own = AlertsOutput(rules, DeliverySettings(), home, state, output.append, send)
    with following(home, {"alerts": own}, output):
        yield
    state.close()


def test_a_bridge_tells_of_a_sound_that_goes_on_and_after_a_restart_not_again(tmp_path):
    reported, output = [], []
    recorder = Recorder(tmp_path / "logs")
    try:
        with bridge(tmp_path, [COUGHS, WATER], reported, output):
            wait_for(lambda: len(reported) == 2)
        assert {name for name, _, _ in reported} == {"coughs", "water"}
        texts = {name: text for name, text, _ in reported}
        assert "Coughing: 3 times in the last 1 h, more than 2" in texts["coughs"]
        assert "Water tap for longer than 10 min, since " in texts["water"]
        assert BridgeState(tmp_path / "state", "home", pytest.fail).names("outbox") == []
        other = rule("recorder_silent", "other")
        late = COUGHS.model_copy(update={"name": "late"})
        with bridge(tmp_path, [COUGHS, WATER, other, late], reported, output):
            wait_for(lambda: len(reported) > 2)
        assert [name for name, _, _ in reported[2:]] == ["late"]
    finally:
        recorder.stop.set()
        recorder.join()
    assert output == []


def new_columns(logs, seen):
    """Segments and gaps that were written to the logs since the last call."""
    found = []
    for columns in read_columns(find_logs(logs), ["/mic/segment", "/mic/gap"]).values():
        rows = [n for n, time in enumerate(columns.log_times) if (columns.topic, time) not in seen]
        seen.update((columns.topic, time) for time in columns.log_times)
        found.append(columns.take(np.array(rows, np.intp)))
    return found


def news_of_water(time, columns=()):
    microphone = SimpleNamespace(
        name="mic",
        label="tap_water",
        confidence=0.9,
        classes=CLASSES,
        active=SimpleNamespace(time=time),
    )
    state = HomeState()
    state.microphones["mic"] = microphone
    return SimpleNamespace(state=state, columns=columns)


@pytest.mark.parametrize("starts_ahead", [True, False])
def test_alerts_ring_after_the_clock_was_ahead_for_a_look(starts_ahead, tmp_path, monkeypatch):
    """Also what was written, and labelled, in that time does not stop them."""
    reported, output, ahead = [], [], [0]
    right = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: right() + ahead[0])
    recorder = Recorder(tmp_path / "logs")
    home = RecorderAddress(tmp_path / "logs", "home", UTC)
    newest, seen = recorder.water, set()

    def send(name, _text, rung):
        reported.append((name, rung))
        return True

    def hears(condition):
        nonlocal newest
        newest = min(newest + MINUTE, right())
        own.update(news_of_water(newest + ahead[0], new_columns(home.folder, seen)))
        return condition()

    try:
        ahead[0] = AHEAD * starts_ahead
        own = AlertsOutput(
            [COUGHS, WATER],
            DeliverySettings(),
            home,
            BridgeState(tmp_path / "state", "home", pytest.fail),
            output.append,
            send,
        )
        if not starts_ahead:
            wait_for(lambda: hears(lambda: len(reported) == 2))
            ahead[0] = AHEAD
            newest = right()
        wait_for(lambda: hears(lambda: own._watch.needed_from(0) > right() + AHEAD // 2))
        recorder.write_segment(right() + ahead[0])
        wait_for(lambda: hears(lambda: own._activity._segment("mic").start > right() + AHEAD // 2))
        ahead[0], newest = 0, recorder.water
        own.update(news_of_water(right() + AHEAD))  # known then, and looked at now
        reported.clear()
        wait_for(lambda: hears(lambda: len(reported) == 2))
        own.close()
    finally:
        recorder.stop.set()
        recorder.join()
    assert {name for name, _ in reported} == {"coughs", "water"}
    assert all(rung <= right() for _, rung in reported)
    assert len([line for line in output if "start over" in line]) == 1


def test_a_broker_is_told_the_same_of_one_ring_after_the_other_until_it_has_each(
    tmp_path, monkeypatch
):
    calls = []

    def send(*ring):
        calls.append(ring)
        return calls.count(ring) == 3

    home = RecorderAddress(tmp_path / "logs", "home", UTC)
    own = AlertsOutput(
        [COUGHS],
        DeliverySettings(),
        home,
        BridgeState(tmp_path, "home", pytest.fail),
        pytest.fail,
        send,
    )
    now, right = time.time_ns(), time.time_ns
    own._outbox.put(
        Notification("coughs", now + number, f"ring {number}", is_known=True, due=now)
        for number in (1, 2)
    )
    try:
        for minutes in range(0, 60, 4):
            monkeypatch.setattr(time, "time_ns", lambda m=minutes: right() + m * MINUTE)
            own.update(SimpleNamespace(state=HomeState(), columns=()))
            if minutes == 4:  # one that rang before those, and is found later
                own._outbox.put([Notification("coughs", now, "ring 0", is_known=True, due=now)])
    finally:
        own.close()
    numbers = [text.partition("ring ")[2][0] for _, text, _ in calls]
    assert numbers == ["1"] * 3 + ["0"] * 3 + ["2"] * 3
    assert len(set(calls)) == 3


def test_rules_of_which_nobody_would_be_told_are_refused(tmp_path):
    home = RecorderAddress(tmp_path, "home", UTC)
    state = BridgeState(tmp_path, "home", pytest.fail)
    with pytest.raises(BridgeError, match="alerts have no target; set urls_file in"):
        AlertsOutput([COUGHS], DeliverySettings(), home, state, pytest.fail)


def test_the_state_is_where_it_is_configured_or_where_systemd_says_or_beside_the_logs(
    tmp_path, monkeypatch
):
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    assert state_folder(None, tmp_path / "logs") == tmp_path / "bridge"
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/a:{tmp_path}/b")
    assert state_folder(None, tmp_path / "logs") == tmp_path / "a"
    assert state_folder(tmp_path / "c" / "d", tmp_path / "logs").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(BridgeError, match=r"cannot be made \(.+\); name another one"):
        state_folder(tmp_path / "file" / "d", tmp_path)


CONFIG = """
[[bridge.alert]]
name = "coughs"
rule = "more_than"
class = "coughing"
count = 2
window = "1h"
quiet_hours = ["22:00-06:30"]

[[bridge.alert]]
name = "no speech"
rule = "none_by"
class = "speech"
since = "00:30"
by = "03:30"
"""


@pytest.fixture(scope="module")
def two_days(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alerts")
    (folder / "home.toml").write_text(CONFIG)
    events = [(HOUR + 60.0 * n, 2.0, "coughing", 0.9) for n in range(3)]
    about = {"classes": CLASSES, "timezone": "Europe/Vienna"}
    write_day(folder / "logs", DAY, events, **about)
    hours = range(2, 24)
    write_day(folder / "logs", DAY.replace(day=3), hours=hours, **about)
    return folder


def test_a_replay_prints_each_ring_and_how_often_each_rule_rings(two_days, hearthlog):
    done = hearthlog("alerts", "replay", two_days / "logs", "--config", two_days / "home.toml")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        (
            "2026-03-02 02:02  coughs: Coughing: 3 times in the last 1 h, more than 2 "
            "(delivered at 2026-03-02 06:30)"
        ),
        "2026-03-02 03:30  no speech: Talking: none from 00:30 to 03:30",
        (
            "2026-03-03 03:30  no speech: Talking from 00:30 to 03:30: unknown, because only "
            "33 % of that time was recorded"
        ),
        "",
        "name       rule       alerts  a week  not known",
        "coughs     more_than       1     3.6          0",
        "no speech  none_by         2     7.1          1",
        "2 days, 2026-03-02 02:00 to 2026-03-04 01:00, Europe/Vienna",
    ]


def test_a_replay_as_json_is_of_the_span_that_is_asked_for(two_days, hearthlog):
    options = ["--start", "2026-03-02T12:00", "--json", "--config", two_days / "home.toml"]
    done = hearthlog("alerts", "replay", two_days / "logs", *options)
    result = json.loads(done.stdout)
    assert result["start"] == "2026-03-02T13:00:00.000+01:00"
    assert result["rules"]["coughs"] == []
    assert [ring["known"] for ring in result["rules"]["no speech"]] == [False]


def test_a_replay_says_that_no_model_knows_the_class_of_a_rule(two_days, hearthlog, tmp_path):
    (tmp_path / "home.toml").write_text(CONFIG.replace("coughing", "couhging"))
    options = ["--config", tmp_path / "home.toml"]
    done = hearthlog("alerts", "replay", two_days / "logs", *options)
    assert done.stderr.startswith(
        "hearthlog: coughs: no model here has the class 'couhging'; there are "
    )
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("table", ["", '[[microphone]]\nname = "kitchen"\n'])
def test_a_replay_says_that_nothing_of_the_microphone_of_a_rule_was_recorded(
    two_days, hearthlog, tmp_path, table
):
    rule = CONFIG.replace('class = "coughing"', 'class = "coughing"\nmicrophone = "kitchen"')
    (tmp_path / "home.toml").write_text(table + rule)
    options = ["--config", tmp_path / "home.toml"]
    done = hearthlog("alerts", "replay", two_days / "logs", *options)
    assert done.stderr == (
        "hearthlog: coughs: nothing of the microphone 'kitchen' was recorded in this time; "
        "there is mic\n"
    )


def test_a_bridge_says_that_no_model_knows_the_class_of_a_rule(tmp_path, monkeypatch):
    monkeypatch.setattr("hearthlog.analyzer.bridge.alerts.output._WAIT_SECONDS", 0.1)
    output, recorder = [], WrittenHome(tmp_path / "logs")
    wrong = rule("more_than", "wrong", count=1, window="1h", **{"class": "couhging"})
    try:
        with bridge(tmp_path, [COUGHS, wrong], [], output):
            until = time.monotonic() + 120
            while not output and time.monotonic() < until:
                recorder.hears("silence")
                time.sleep(0.1)
    finally:
        recorder.close()
    (line,) = {*output}
    assert line.startswith("alerts: wrong: no model here has the class 'couhging'; there")


def test_a_replay_goes_by_the_time_zone_of_the_configuration_before_that_of_the_logs(
    two_days, hearthlog, tmp_path
):
    (tmp_path / "home.toml").write_text(f'timezone = "Asia/Tokyo"\n{CONFIG}')
    options = ["--json", "--config", tmp_path / "home.toml"]
    done = hearthlog("alerts", "replay", two_days / "logs", *options)
    result = json.loads(done.stdout)
    assert result["timezone"] == "Asia/Tokyo"
    assert {ring["time"][10:] for ring in result["rules"]["no speech"]} == {"T03:30:00.000+09:00"}


def test_a_replay_with_a_damaged_log_uses_the_others_and_ends_with_status_3(
    two_days, hearthlog, tmp_path
):
    shutil.copytree(two_days, tmp_path / "home")
    log = find_logs(tmp_path / "home" / "logs")[10]
    log.write_bytes(log.read_bytes()[:100])
    options = ["--config", two_days / "home.toml"]
    done = hearthlog("alerts", "replay", tmp_path / "home" / "logs", *options)
    assert done.returncode == 3
    assert str(log) in done.stderr
    assert "coughs     more_than       1" in done.stdout


@pytest.mark.parametrize(
    ("content", "options", "status", "states"),
    [
        ("", [], 2, "has no rule; docs/alerts.md shows how"),
        (f'node = "flat"\n{CONFIG}', [], 1, "no logs of the recorder 'flat' (node in the"),
        (CONFIG, ["--end", "2026-01-01"], 2, "--start and --end select nothing"),
        (CONFIG + "loud = 1\n", [], 2, "unknown key"),
        (CONFIG, ["--timezone", "Europe/Atlantis"], 1, "is no time zone"),
    ],
)
def test_a_replay_of_what_makes_no_sense_is_one_line(  # noqa: PLR0913, PLR0917
    content, options, status, states, two_days, hearthlog, tmp_path
):
    (tmp_path / "home.toml").write_text(content)
    options = ["--config", tmp_path / "home.toml", *options]
    done = hearthlog("alerts", "replay", two_days / "logs", *options)
    assert (done.returncode, done.stdout) == (status, "")
    assert states in done.stderr
    assert done.stderr.count("\n") == 1
