"""What a bridge says follows from the log alone, however it came to be read."""

import math
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hearthlog.analyzer.activity import ANY_SOUND, ActiveClasses, EventRecord
from hearthlog.analyzer.activity.event_counts import events_of
from hearthlog.analyzer.bridge.bridge import ProblemReporter
from hearthlog.analyzer.bridge.home_state import Health, HomeState, LiveMicrophone
from hearthlog.analyzer.bridge.mqtt import TopicKey, Topics, identifier
from hearthlog.analyzer.bridge.output import Total, Totals
from hearthlog.analyzer.bridge.settings import load_bridge_settings
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import iso_time, today
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types

pytestmark = pytest.mark.fast

FRAME = NANOSECONDS // 20
CLASSES = ["silence", "speech", "coughing"]
VIENNA = ZoneInfo("Europe/Vienna")


def recorded(labels, cuts=()):
    """Tell what is heard after labels that came in pieces."""
    now, times = ActiveClasses(CLASSES), FRAME * np.arange(1, len(labels) + 1)
    for first, last in zip([0, *cuts], [*cuts, len(labels)], strict=True):
        now.push(labels[first:last], times[first:last])
    return [now.is_active(name) for name in (*CLASSES, ANY_SOUND)]


@given(st.lists(st.sampled_from(CLASSES), max_size=300), st.lists(st.integers(0, 300), max_size=9))
def test_what_is_heard_does_not_depend_on_how_the_labels_came(labels, cuts):
    assert recorded(labels, sorted(min(cut, len(labels)) for cut in cuts)) == recorded(labels)


def ends_of(spans, seconds):
    """When a microphone that heard coughs in some spans was told of which event's end, in s."""
    microphone, ends = LiveMicrophone("mic"), []
    microphone.names, microphone.active = CLASSES, ActiveClasses(CLASSES)
    microphone.seen = math.inf
    for now in range(seconds):
        times = now * NANOSECONDS + FRAME * np.arange(20)
        sounds = any(start <= now < end for start, end in spans)
        microphone.active.push(20 * ["coughing" if sounds else "silence"], times)
        for start, end in (span for span in spans if span[1] + 3 == now):
            span = np.array([start]) * NANOSECONDS, np.array([end]) * NANOSECONDS
            fields = {
                "header.stamp": span[0],
                "duration": span[1] - span[0],
                "label": np.array(["coughing"], object),
                "confidence": np.ones(1, np.float32),
            }
            microphone.push_segments(
                Columns("/mic/segment", message_types.SEGMENT, {}, *(3 * [span[1]]), fields)
            )
        ended = microphone.ended_events()
        ends += [(now, each.start // NANOSECONDS, each.end // NANOSECONDS) for each in ended]
    return ends


@pytest.mark.parametrize(
    ("spans", "ends"),
    [
        ([(10, 14)], [(29, 10, 14)]),
        ([(10, 14), (26, 27)], [(30, 10, 14), (42, 26, 27)]),  # another event before it is over
        ([(10, 15), (16, 43)], [(58, 10, 43)]),  # of the second segment nothing is known for long
    ],
)
def test_each_event_is_over_once_when_it_is(spans, ends):
    assert ends_of(spans, 80) == ends


@pytest.mark.parametrize(("frames", "is_recorded"), [(7, False), (8, True)])
def test_eight_labels_of_a_second_are_a_sound(frames, is_recorded):
    labels = 50 * ["silence"] + frames * ["coughing", "silence"]
    assert recorded(labels)[2:] == [is_recorded, is_recorded]


@pytest.mark.parametrize(("frames", "is_recorded"), [(200, True), (201 + 12, False)])
def test_a_sound_is_held_for_ten_seconds(frames, is_recorded):
    assert recorded(20 * ["coughing"] + frames * ["silence"])[2:] == [is_recorded, is_recorded]


def test_a_clock_that_is_set_back_ends_what_was_heard():
    now = ActiveClasses(CLASSES)
    now.push(40 * ["coughing"], 3600 * NANOSECONDS + FRAME * np.arange(40))
    assert now.is_active("coughing")
    now.push(["silence"], np.array([FRAME]))
    assert not now.is_active("coughing")


def test_events_are_counted_by_their_time_when_the_clock_is_set_back():
    record = EventRecord("mic", "coughing")
    for start, is_new in ((5000, True), (6000, True), (5500, True), (5505, False), (6500, True)):
        assert record.push(start * NANOSECONDS, (start + 2) * NANOSECONDS, 1.0) == is_new
    assert [event.start // NANOSECONDS for event in record.events] == [5000, 5500, 6000, 6500]
    assert [event.seconds for event in record.events] == [2, 4, 2, 2]
    assert len(record.since(5500 * NANOSECONDS)) == 3


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(1, 20)), max_size=40))
def test_events_are_those_of_the_report(spans):
    starts, ends, time = [], [], 0
    for pause, length in spans:
        starts.append(time + pause * NANOSECONDS)
        ends.append(time := starts[-1] + length * NANOSECONDS)
    record = EventRecord("mic", "coughing")
    for start, end in zip(starts, ends, strict=True):
        record.push(start, end, 0.5)
    labels = Labelling(
        np.array(starts, np.int64), np.array(ends, np.int64), np.array(["coughing"] * len(starts))
    )
    expected = events_of(labels, "coughing")
    assert [event.start for event in record.events] == expected.starts.tolist()
    assert [event.end for event in record.events] == expected.ends.tolist()


@pytest.mark.parametrize(
    ("now", "midnight", "night", "morning"),
    [
        ("2026-03-29T10:00+02:00", "03-29T00:00+01:00", "03-28T22:00+01:00", "03-29T07:00+02:00"),
        ("2026-10-25T22:00+01:00", "10-25T00:00+02:00", "10-25T22:00+01:00", "10-26T07:00+01:00"),
        ("2026-10-25T21:59+01:00", "10-25T00:00+02:00", "10-24T22:00+02:00", "10-25T07:00+01:00"),
    ],
)
def test_day_and_night_follow_the_clock_on_the_wall(now, midnight, night, morning):
    found = today(int(datetime.fromisoformat(now).timestamp()) * NANOSECONDS, VIENNA)
    texts = [f"2026-{text}" for text in (midnight, night, morning)]
    times = [int(datetime.fromisoformat(text).timestamp()) * NANOSECONDS for text in texts]
    assert list(found[1:]) == times


def test_a_time_is_written_with_the_offset_of_the_home():
    assert iso_time(1_792_890_000_123_456_789, VIENNA) == "2026-10-25T02:00:00.123+01:00"
    assert iso_time(1_792_886_400_000_000_000, UTC) == "2026-10-25T00:00:00.000+00:00"


@given(st.text(min_size=1, max_size=20))
def test_a_class_of_any_name_has_a_topic_of_its_own(label):
    topics = Topics("hearthlog", "home")
    topic = topics.at("on", "mic", label)
    assert not {"+", "#", "\x00"} & set(topic)
    assert topic.count("/") == 5
    if label.isprintable():
        for place in (TopicKey("told", label=label), TopicKey("on", "mic", label)):
            assert topics.parse(topics.at(*place)) == place
        assert topic.split("/")[-2] == topics.at("told", label=label).split("/")[-1]


@given(st.text(max_size=20))
def test_an_identifier_has_letters_that_home_assistant_takes(text):
    assert set(identifier(text)) <= set("abcdefghijklmnopqrstuvwxyz0123456789_")


def state_with(*events):
    """The state of a home with events of coughing, each of a second."""
    state, microphone = HomeState(), LiveMicrophone("mic")
    state.microphones["mic"] = microphone
    record = microphone._records.setdefault("coughing", EventRecord("mic", "coughing"))
    for start in events:
        record.push(start * NANOSECONDS, (start + 1) * NANOSECONDS, 1.0)
    return state


def test_totals_survive_restarts_and_are_counted_once(tmp_path):
    kept = BridgeState(tmp_path, "home", pytest.fail)
    totals = Totals(kept, 100 * NANOSECONDS, pytest.fail)
    assert totals.count(state_with(50, 150, 250)) == [Total("mic", "coughing", 2, 2.0)]
    totals.keep(state_with(50, 150, 250), 200 * NANOSECONDS)
    again = Totals(kept, 0, pytest.fail)
    assert again.time == 200 * NANOSECONDS
    assert again.count(state_with(250, 350)) == [Total("mic", "coughing", 3, 3.0)]
    assert again.count(HomeState()) == [Total("mic", "coughing", 1, 1.0)]


def test_damaged_totals_are_named_and_counted_anew(tmp_path):
    output, kept = [], BridgeState(tmp_path, "home", pytest.fail)
    kept.write("totals", '{"time": -1}')
    assert Totals(kept, 7, output.append).time == 7
    assert output == [f"{kept.path}, totals: cannot be read; counts start over"]


def test_a_trouble_is_said_again_after_an_hour(monkeypatch):
    output, now = [], [1e6]
    monkeypatch.setattr("hearthlog.analyzer.bridge.bridge.time.monotonic", lambda: now[0])
    say = ProblemReporter(output.append)
    for _ in range(3):
        say("no broker")
        say("a full disk")
    now[0] += 3601
    say("no broker")
    assert output == ["no broker", "a full disk", "no broker"]


def test_who_cannot_be_told_of_a_trouble_ends_nothing():
    def refuse(_line):
        raise OSError(28, "No space left on device")

    ProblemReporter(refuse)("no broker")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            '[bridge.mqtt]\nhost = "broker..lan"',
            "line 2: bridge.mqtt.host: 'broker..lan' cannot be",
        ),
        ('[bridge.mqtt]\nhost = ""', "line 2: bridge.mqtt.host: '' cannot be"),
        ('[bridge.mqtt]\nhots = "x"', "line 2: unknown key 'bridge.mqtt.hots'"),
        (
            "[bridge.mqtt]\nport = 1883",
            'line 1: bridge.mqtt.host: is missing; write host = "broker.lan"',
        ),
        (
            '[bridge.mqtt]\nhost = "x"\nport = 70000',
            "line 3: bridge.mqtt.port: 70000 is not a whole number from 1 to 65535",
        ),
        ('[bridge.ping]\nurl = "ftp://x"', "line 2: bridge.ping.url: is not a web address"),
        ('[bridge.page]\nbind = "224.0.0.1"', "line 2: bridge.page.bind: '224.0.0.1' is not an IP"),
        (
            '[bridge.page]\nbind = "ff02::1"',
            "line 2: bridge.page.bind: 'ff02::1' is not an IP address",
        ),
        ("bridge = 3", "line 1: bridge: is a table; write [bridge]"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named_with_its_line(tmp_path, text, problem):
    path = tmp_path / "home.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_bridge_settings(path)
    assert str(error.value).startswith(f"{path}, {problem}")


def test_the_recorder_takes_no_notice_of_the_table_of_the_bridge(tmp_path):
    path = tmp_path / "home.toml"
    path.write_text('node = "flat"\n[bridge.mqtt]\nhost = "broker"\n')
    settings, bridge = load_bridge_settings(path)
    assert settings.node == "flat"
    assert bridge.mqtt is not None
    assert bridge.mqtt.host == "broker"
    assert bridge.ping is None


def test_a_segment_that_is_written_twice_is_counted_once():
    record = EventRecord("mic", "coughing")
    spans = [(n * 20 * NANOSECONDS, (n * 20 + 2) * NANOSECONDS) for n in range(5)]
    for start, end in [*spans, *spans[2:], (200 * NANOSECONDS, 201 * NANOSECONDS)]:
        record.push(start, end, 1.0)
    assert [event.seconds for event in record.events] == [2, 2, 2, 2, 2, 1]


def test_events_of_a_clock_that_ran_ahead_are_forgotten_but_not_the_last_one():
    record = EventRecord("mic", "coughing")
    for start in (100, 200, 300, 9000):
        record.push(start * NANOSECONDS, (start + 1) * NANOSECONDS, 1.0)
    record.forget(250 * NANOSECONDS, 1000 * NANOSECONDS)
    assert [event.start // NANOSECONDS for event in record.events] == [300]
    record.forget(5000 * NANOSECONDS, 6000 * NANOSECONDS)
    assert [event.start // NANOSECONDS for event in record.events] == [300]
    assert record.push(9002 * NANOSECONDS, 9003 * NANOSECONDS, 1.0)  # not with the forgotten one


def test_what_a_recorder_speaks_of_no_more_is_forgotten_a_log_later():
    state = HomeState()
    for subjects in (("mic", "porch"), ("mic",), ("mic",)):
        state.begin_log()
        for subject in subjects:
            state._diagnosed.add(subject)
            state.health[subject] = Health(0, "")
    assert set(state.health) == {"mic"}
