"""Rules replayed over a month ring exactly when the truth says, and so do they day by day."""

import itertools
from datetime import UTC, date, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import HOUR, midnight, write_day
from hypothesis import given, settings
from hypothesis import strategies as st
from livehome import rule
from pydantic import TypeAdapter, ValidationError

from hearthlog.analyzer.activity import LONGEST_PAUSE
from hearthlog.analyzer.activity.segments import SegmentCollector, read_activity
from hearthlog.analyzer.bridge.alerts.evaluation import (
    end_of_quiet,
    home_sound,
    notifications,
    wall_times,
)
from hearthlog.analyzer.bridge.alerts.rule_checks import unknown_class
from hearthlog.analyzer.bridge.alerts.rules import (
    AlertRules,
    RuleState,
    duration_words,
    history,
    read_duration,
)
from hearthlog.analyzer.bridge.settings import load_bridge_settings
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.recorder.pause_schedule import quiet_hours
from hearthlog.schemas.errors import ConfigurationError

VIENNA = ZoneInfo("Europe/Vienna")
SECOND = 1_000_000_000
MINUTE, DAY = 60 * SECOND, 86_400 * SECOND
NOON = midnight(date(2026, 3, 2)) + 12 * HOUR * SECOND


def home(*segments, covered=(), classes=None, written=()):
    """What was heard: segments (second, seconds, class[, confidence, microphone]) after noon."""
    gathered = SegmentCollector()
    for microphone, names in (classes or {}).items():
        gathered.add_classes(microphone, names)
    for start, seconds, label, *more in sorted(segments):
        confidence, microphone = (*more, *(1.0, "mic")[len(more) :])
        begin = NOON + round(start * SECOND)
        end = begin + round(seconds * SECOND)
        gathered.add_segment(microphone, begin, end, label, confidence)
    for start, end in covered:
        gathered.add_segment("mic", start, end, "silence", 1.0)
    for start, seconds in written:
        begin = NOON + round(start * SECOND)
        gathered.add_written_span(begin, begin + round(seconds * SECOND))
    return gathered.activity()


def rung(one, recorded, hours=24):
    """Seconds after noon at which a rule rings."""
    found, _ = notifications(one, recorded, NOON, NOON + hours * HOUR * SECOND, UTC)
    return [(ring.time - NOON) / SECOND for ring in found]


def test_a_rule_of_more_than_rings_with_the_event_that_is_one_too_many():
    recorded = home(*((minute * 60, 2, "coughing") for minute in (0, 10, 20, 30, 40)))
    one = rule("more_than", count=2, window="30m", **{"class": "coughing"})
    assert rung(one, recorded) == [20 * 60]
    assert rung(rule("more_than", count=3, window="30m", **{"class": "coughing"}), recorded) == []


def test_segments_with_short_pauses_between_them_are_one_event_of_all_microphones():
    recorded = home((0, 2, "coughing", 1.0, "a"), (9, 2, "coughing", 1.0, "b"), (21, 1, "coughing"))
    assert rung(rule("more_than", count=0, window="1h", **{"class": "coughing"}), recorded) == [0]
    assert rung(rule("more_than", count=1, window="1h", **{"class": "coughing"}), recorded) == []


def test_an_event_counts_when_it_has_lasted_long_enough_and_is_sure_enough():
    recorded = home(
        (0, 2, "crying"), (100, 3, "crying"), (107, 3, "crying"), (500, 9, "crying", 0.5)
    )
    base = {"count": 0, "window": "1h", "class": "crying", "least_seconds": 5}
    assert rung(rule("more_than", **base), recorded) == [109]
    assert rung(rule("more_than", **base | {"least_seconds": 7}), recorded) == [507]
    assert rung(rule("more_than", **base | {"least_seconds": 7, "confidence": 0.6}), recorded) == []


def test_a_rule_of_one_microphone_does_not_mind_the_others():
    recorded = home((0, 2, "crying", 1.0, "hall"), (60, 2, "crying", 1.0, "bath"))
    keys = {"count": 0, "window": "1h", "class": "crying"}
    assert rung(rule("more_than", microphone="bath", **keys), recorded) == [60]


def test_a_rule_of_minutes_rings_in_the_second_in_which_there_are_more():
    recorded = home((0, 600, "shower"), (1200, 600, "shower"), (4000, 1000, "shower"))
    one = rule("more_than", minutes=15, window="1h", cooldown="1m", **{"class": "shower"})
    expected = _first_seconds(recorded.of("shower"), 3600, 900)
    assert rung(one, recorded) == expected


def test_minutes_of_events_that_must_be_long_count_from_when_they_are():
    recorded = home((0, 50, "shower"), (100, 100, "shower"), (300, 100, "shower"))
    one = rule("more_than", minutes=2, window="1h", least_seconds=60, **{"class": "shower"})
    # The first never counts; the second does with all of its 60 seconds, then second by second.
    assert rung(one, recorded) == [360]


def _first_seconds(sounds, window, most):
    """Seconds at which the sum over the window passes a limit, counted second by second."""
    on = np.zeros(20_000, int)
    for start, end in zip(sounds.starts, sounds.ends, strict=True):
        on[(start - NOON) // SECOND : (end - NOON) // SECOND] = 1
    sums = np.cumsum(on)
    amounts = sums - np.concatenate([np.zeros(window, int), sums[:-window]])
    over = amounts > most
    return np.flatnonzero(np.diff(over.astype(int), prepend=0) == 1).tolist()


TALK = [(30.0 * n, 15, "speech") for n in range(120)]  # an hour of a television


@pytest.mark.parametrize(
    ("kind", "keys"),
    [
        ("more_than", {"minutes": 5, "window": "1h"}),
        ("more_than", {"count": 20, "window": "1h"}),
        ("longer_than", {"longer_than": "5m", "pause": "1m"}),
    ],
)
def test_a_rule_of_talking_does_not_ring_for_a_television_but_one_of_any_sound_does(kind, keys):
    assert rung(rule(kind, **keys, **{"class": "speech"}), home(*TALK)) == []
    assert rung(rule(kind, **keys), home(*TALK)) != []
    coughs = [(start, seconds, "coughing") for start, seconds, _ in TALK]
    assert rung(rule(kind, **keys, **{"class": "cough"}), home(*TALK, *coughs)) != []


def test_talk_alone_rings_when_it_is_known_to_be_of_no_television():
    recorded = home((0, 300, "speech"), (3000, 400, "speech"), *((s + 9000, *t) for s, *t in TALK))
    one = rule("longer_than", longer_than="6m", **{"class": "speech"})
    (ring,), _ = notifications(one, recorded, NOON, NOON + DAY, UTC)
    assert (ring.time - NOON) / SECOND == 3000 + 360 + 11 * 60
    assert ring.text == "Talking for longer than 6 min, since 12:50"


def test_who_watches_television_all_day_is_not_missed():
    television = [(20.0 * n, 15, "speech") for n in range(1500)]
    recorded = home(*television, covered=[(-43_200, 43_200)])
    for keys in ({"class": "speech"}, {}):
        one = rule("none_by", since="12:30", by="20:00", **keys)
        assert rung(one, recorded) == []
    gathered = SegmentCollector()
    for number, day in enumerate(days_of(11)):
        begin = midnight(day)
        gathered.add_segment("mic", begin, begin + DAY, "silence", 1.0)
        for start in range(0, 30_000, 20) if number == 10 else range(0, 30_000, 3000):
            length = (15 if number == 10 else 60) * SECOND
            at = begin + (36_000 + start) * SECOND
            gathered.add_segment("mic", at, at + length, "speech", 1.0)
    start = midnight(days_of(1)[0])
    for of in ("count", "minutes"):
        one = rule("unlike_usual", of=of, **{"class": "speech"})
        assert notifications(one, gathered.activity(), start, start + 12 * DAY, UTC)[0] == []


def test_a_rule_of_any_sound_takes_all_classes_but_silence():
    recorded = home((0, 100, "silence"), (100, 40, "music"), (140, 40, "speech"))
    assert rung(rule("longer_than", longer_than="1m"), recorded) == [160]


def test_a_sound_that_lasts_too_long_rings_while_it_does_and_once():
    recorded = home((0, 70, "tap_water"), (75, 100, "tap_water"), (1000, 3, "tap_water"))
    one = rule("longer_than", longer_than="1m", cooldown="1m", **{"class": "tap_water"})
    assert rung(one, recorded) == [60]
    # The limit lies in a pause: it goes on when it is heard again.
    one = rule("longer_than", longer_than="72s", **{"class": "tap_water"})
    assert rung(one, recorded) == [75]
    # Twelve seconds are two sounds, unless the rule says otherwise.
    recorded = home((0, 40, "tap_water"), (52, 40, "tap_water"))
    assert rung(rule("longer_than", longer_than="1m"), recorded) == []
    assert rung(rule("longer_than", longer_than="1m", pause="15s"), recorded) == [60]


def test_what_begins_in_the_cooldown_rings_at_its_end_if_it_still_is_so():
    long = home((0, 200, "shower"), (1000, 9000, "shower"))
    short = home((0, 200, "shower"), (1000, 900, "shower"))
    one = rule("longer_than", longer_than="2m", cooldown="1h", **{"class": "shower"})
    assert rung(one, long) == [120, 120 + 3600]
    assert rung(one, short) == [120]


def test_no_word_from_the_recorder_rings_once_until_it_writes_again():
    recorded = home(written=[(-3600, 3600), (300, 600), (5000, 90_000)])
    assert rung(rule("recorder_silent", silent_for="10m"), recorded) == [900 + 600]
    assert rung(rule("recorder_silent", silent_for="10m"), home(), hours=2) == [0]
    assert rung(rule("recorder_silent", silent_for="4m"), recorded) == [240, 240 + 3600]


@pytest.mark.parametrize(("share", "known"), [(0.8, True), (0.7, False)])
def test_none_by_a_time_is_not_known_where_too_little_was_heard(share, known):
    begin = NOON + 18 * HOUR * SECOND  # 06:00
    recorded = home(covered=[(begin, begin + round(4 * share * HOUR) * SECOND)])
    one = rule("none_by", since="06:00", by="10:00", **{"class": "flushing_water"})
    found, _ = notifications(one, recorded, NOON, NOON + DAY, UTC)
    assert [ring.is_known for ring in found] == [known]
    assert found[0].time == NOON + 22 * HOUR * SECOND
    assert found[0].text == (
        "Toilet flush: none from 06:00 to 10:00"
        if known
        else "Toilet flush from 06:00 to 10:00: unknown, because only 70 % of that time was "
        "recorded"
    )


def test_a_microphone_whose_model_does_not_know_a_class_does_not_listen_for_it():
    segments = [(18 * HOUR, 4 * HOUR, "silence", 1.0, name) for name in ("hall", "bath")]
    one = rule("none_by", since="06:00", by="10:00", **{"class": "flushing_water"})
    know = {"hall": ["silence", "speech"], "bath": ["silence", "flushing_water"]}
    both, hall = home(*segments, classes=know), home(segments[0], classes=know)
    assert [ring.is_known for ring in notifications(one, both, NOON, NOON + DAY, UTC)[0]] == [True]
    assert [ring.is_known for ring in notifications(one, hall, NOON, NOON + DAY, UTC)[0]] == [False]


def test_a_class_of_a_scenario_is_heard_by_its_microphone_and_is_no_further_sound():
    know = {"hall": ["silence", "speech"], "hall-speakers": ["silence", "anna", "unknown"]}
    spoken = [(0, 30, "speech", 1.0, "hall"), (0, 30, "anna", 1.0, "hall-speakers")]
    nobody = (60, 30, "unknown", 1.0, "hall-speakers")
    silence = [(18 * HOUR, 4 * HOUR, "silence", 1.0, name) for name in know]
    recorded = home(*spoken, nobody, *silence, classes=know)
    count = {"count": 0, "window": "1h", "microphone": "hall"}
    assert rung(rule("more_than", **count, **{"class": "anna"}), recorded) == [0]
    assert rung(rule("more_than", **count, **{"class": "unknown"}), recorded) == []
    assert rung(rule("more_than", **count), recorded) == rung(
        rule("more_than", **count), home(*spoken[:1])
    )
    assert len(recorded.of("").starts) == 1
    assert unknown_class(rule("more_than", **count, **{"class": "anna"}), recorded.classes) == ""
    for name in ("ben", "unknown"):
        of_name = rule("more_than", **count, **{"class": name})
        assert name in unknown_class(of_name, recorded.classes)
    absent = rule("none_by", since="06:00", by="10:00", microphone="hall", **{"class": "anna"})
    assert [
        ring.is_known for ring in notifications(absent, recorded, NOON, NOON + DAY, UTC)[0]
    ] == [True]
    assert set(home_sound(recorded).listened) == {"silence", "speech"}
    assert set(home_sound(recorded).labels.labels) == {"silence", "speech"}


@pytest.mark.parametrize(
    ("day", "minute", "first", "last"),
    [
        ("2026-03-29", "02:30", "2026-03-29T01:00", "2026-03-29T01:00"),
        ("2026-03-29", "03:00", "2026-03-29T01:00", "2026-03-29T01:00"),
        ("2026-03-29", "01:59", "2026-03-29T00:59", "2026-03-29T00:59"),
        ("2026-10-25", "02:30", "2026-10-25T00:30", "2026-10-25T01:30"),
        ("2026-10-25", "03:00", "2026-10-25T02:00", "2026-10-25T02:00"),
        ("2026-07-01", "02:30", "2026-07-01T00:30", "2026-07-01T00:30"),
    ],
)
def test_a_time_that_the_clock_shows_twice_or_never_is_found(day, minute, first, last):
    hours, minutes = map(int, minute.split(":"))
    times = wall_times(date.fromisoformat(day), 60 * hours + minutes, VIENNA)
    utc = [datetime.fromtimestamp(time // SECOND, UTC) for time in times]
    assert [f"{moment:%Y-%m-%dT%H:%M}" for moment in utc] == [first, last]


@pytest.mark.parametrize("day", ["2026-03-29", "2026-10-25", "2026-07-01"])
def test_quiet_hours_end_by_the_clock_of_the_home(day):
    start = midnight(date.fromisoformat(day)) - 3 * HOUR * SECOND
    for minute in range(0, 24 * 60, 7):
        time = start + minute * MINUTE
        until = end_of_quiet([quiet_hours("22:00-02:30"), quiet_hours("02:30-06:30")], time, VIENNA)
        shown = datetime.fromtimestamp(time // SECOND, VIENNA)
        is_quiet = shown.hour >= 22 or (shown.hour, shown.minute) < (6, 30)
        ends = datetime.fromtimestamp(until // SECOND, VIENNA)
        assert (ends.hour, ends.minute) == (6, 30) if is_quiet else until == time
        assert 0 <= until - time < 10 * HOUR * SECOND


def test_a_ring_in_quiet_hours_waits_for_their_end_unless_it_is_urgent():
    recorded = home((12 * HOUR, 5, "crying"))
    keys = {"count": 0, "window": "1h", "class": "crying", "quiet_hours": ["22:00-06:30"]}
    (ring,), _ = notifications(rule("more_than", **keys), recorded, NOON, NOON + DAY, UTC)
    assert ring.due - ring.time == 6.5 * HOUR * SECOND
    (ring,), _ = notifications(
        rule("more_than", urgent=True, **keys), recorded, NOON, NOON + DAY, UTC
    )
    assert ring.due == ring.time


def days_of(count, first=date(2026, 2, 1)):
    return [first + timedelta(days=number) for number in range(count)]


def test_a_night_unlike_those_of_the_four_weeks_before_rings_in_the_morning():
    """Four to six coughs a night; 40 in the night to day 20, which day 21 is compared with."""
    gathered = SegmentCollector()
    days = days_of(30)
    for number, day in enumerate(days):
        evening = midnight(day) - 2 * HOUR * SECOND
        gathered.add_segment("mic", midnight(day) - DAY // 2, midnight(day) + DAY, "silence", 1.0)
        for cough in range({20: 40}.get(number, 4 + number % 3)):
            start = evening + (cough + 1) * 5 * MINUTE
            gathered.add_segment("mic", start, start + SECOND, "coughing", 1.0)
    one = rule("unlike_usual", part="night", **{"class": "cough"})
    first, last = midnight(days[0]), midnight(days[-1]) + DAY
    found, _ = notifications(one, gathered.activity(), first, last, UTC)
    assert [(ring.time, ring.text) for ring in found] == [
        (
            midnight(days[20]) + 8 * HOUR * SECOND,
            "Coughing in the night to 2026-02-21: 40 times, usually 5 (4 to 6)",
        )
    ]


def test_a_day_is_compared_by_the_counts_of_the_report_without_coughs_beside_a_television():
    def texts(*, is_television):
        gathered = SegmentCollector()
        for number, day in enumerate(days_of(11)):
            begin, is_last = midnight(day), number == 10
            gathered.add_segment("mic", begin, begin + DAY, "silence", 1.0)
            for minute in range(0, 400 if is_last else 50, 10):
                start = begin + (600 + minute) * MINUTE
                gathered.add_segment("mic", start, start + SECOND, "coughing", 1.0)
            for minute in range(600, 1020) if is_last and is_television else ():
                start = begin + minute * MINUTE + 20 * SECOND
                gathered.add_segment("mic", start, start + 20 * SECOND, "speech", 1.0)
        one = rule("unlike_usual", **{"class": "cough"})
        start = midnight(days_of(1)[0])
        found, _ = notifications(one, gathered.activity(), start, start + 12 * DAY, UTC)
        return [ring.text for ring in found]

    assert texts(is_television=False) == ["Coughing on 2026-02-11: 40 times, usually 5"]
    assert texts(is_television=True) == [], "beside a television, so none is missing"


def test_a_day_rings_only_with_a_week_to_compare_it_with_of_which_enough_was_heard():
    def with_days(before, share=1.0):
        gathered = SegmentCollector()
        for number, day in enumerate(days_of(before + 1)):
            begin = midnight(day)
            own = share if number == 0 else 1.0
            gathered.add_segment("mic", begin, begin + round(own * DAY), "silence", 1.0)
            length = (60 if number == before else 10) * MINUTE
            gathered.add_segment("mic", begin + DAY // 3, begin + DAY // 3 + length, "shower", 1.0)
        one = rule("unlike_usual", of="minutes", **{"class": "shower"})
        start = midnight(days_of(1)[0])
        return [
            ring.text
            for ring in notifications(one, gathered.activity(), start, start + 99 * DAY, UTC)[0]
        ]

    expected = ["Shower on 2026-02-08: 1 h 00 min, usually 10 min"]
    assert with_days(7) == expected
    assert with_days(6) == []
    assert with_days(7, share=0.7) == []


# A month with a truth, over both changes of the clock.


def write_month(root, first, count=30):
    """Write a month in Vienna; return when each rule must ring, by the clock on the wall.

    Every day has a flush at 07:10, but each fifth; on each seventh day the microphone hears
    nothing from 05:00 to 11:00. Six coughs from 03:00 on in each third night; a shower of half an
    hour on each fourth evening, of ten minutes on the others.
    """
    truth = {"no flush": [], "not known": [], "coughs": [], "shower": []}
    events, gaps = {}, {}
    for number in range(count):
        day = first + timedelta(days=number)

        def utc(text, day=day):
            hours, minutes = map(int, text.split(":"))
            shown = datetime(day.year, day.month, day.day, hours, minutes, tzinfo=VIENNA)
            return shown.astimezone(UTC)

        def put(moment, *what, into=events):
            second = (moment - datetime.combine(moment, datetime.min.time(), UTC)).total_seconds()
            into.setdefault(moment.date(), []).append((second, *what))

        is_deaf = number % 7 == 6
        if is_deaf:
            put(utc("05:00"), 6 * HOUR, "unplugged", into=gaps)
            truth["not known"].append(f"{day} 10:00")
        elif number % 5 == 4:
            truth["no flush"].append(f"{day} 10:00")
        else:
            put(utc("07:10"), 12.0, "flushing_water", 0.9)
        if number % 3 == 2:
            for cough in range(6):
                put(utc("03:00") + timedelta(minutes=5 * cough), 2.0, "coughing", 0.9)
            truth["coughs"].append(f"{day} 03:25")
        minutes = 30 if number % 4 == 3 else 10
        put(utc("20:00"), minutes * 60.0, "shower", 0.9)
        if minutes == 30:
            truth["shower"].append(f"{day} 20:20")
    classes = ["silence", "flushing_water", "coughing", "shower"]
    for day in days_of(count + 2, first - timedelta(days=1)):
        about = {"classes": classes, "timezone": "Europe/Vienna", "file_hours": 6}
        write_day(root, day, events.get(day, ()), gaps=gaps.get(day, ()), **about)
    return truth


RULES = {
    "no flush": rule("none_by", since="06:00", by="10:00", **{"class": "flushing_water"}),
    "coughs": rule("more_than", count=5, window="1h", **{"class": "coughing"}),
    "shower": rule("longer_than", longer_than="20m", **{"class": "shower"}),
}


@pytest.mark.parametrize("first", [date(2026, 3, 10), date(2026, 10, 5)])
def test_rules_over_thirty_days_ring_exactly_when_the_truth_says(first, tmp_path):
    truth = write_month(tmp_path, first)
    begin = wall_times(first, 0, VIENNA)[0]
    end = wall_times(first + timedelta(days=30), 0, VIENNA)[0]
    lost = []
    recorded = read_activity(find_home_logs([tmp_path]), "home", begin - 3 * DAY, end, lost.append)
    found = {
        name: notifications(one, recorded, begin, end, VIENNA)[0] for name, one in RULES.items()
    }

    def shown(own, *, known=True):
        times = [each.time for each in own if each.is_known == known]
        return [
            f"{datetime.fromtimestamp(time // SECOND, VIENNA):%Y-%m-%d %H:%M}" for time in times
        ]

    assert lost == []
    assert {name: shown(own) for name, own in found.items()} == {
        name: truth[name] for name in RULES
    }
    assert shown(found["no flush"], known=False) == truth["not known"]
    assert min(map(len, truth.values())) >= 4


@pytest.mark.parametrize("first", [date(2026, 3, 29), date(2026, 10, 25)])
def test_a_time_of_day_in_the_hour_of_the_change_rings_once_on_that_day(first):
    day = wall_times(first, 0, VIENNA)[0]
    one = rule("none_by", since="23:00", by="02:30", **{"class": "crying"})
    recorded = home(covered=[(day - DAY, day + 2 * DAY)])
    found, _ = notifications(one, recorded, day, day + DAY, VIENNA)
    assert [ring.time for ring in found] == [wall_times(first, 150, VIENNA)[1]]


# Any division of the time gives the same rings.


@st.composite
def lives(draw):
    """Six hours with sounds, pauses of all lengths, and a recorder that falls silent."""
    seconds = st.integers(1, 20) | st.integers(1, 900)
    recorded, now = [], 0
    while now < 6 * HOUR and len(recorded) < 80:
        now += draw(seconds)
        length = draw(st.integers(1, 400))
        recorded.append((now, length, draw(st.sampled_from(["coughing", "music"]))))
        now += length if draw(st.booleans()) else length // 2
    writes, at_second = [], -600
    while at_second < 7 * HOUR:
        length = draw(st.integers(10, 4000))
        writes.append((at_second, length))
        at_second += length + draw(st.integers(30, 1500))
    edges = [second for start, length, _ in recorded for second in (start, start + length)]
    near = st.builds(int.__add__, st.sampled_from(edges), st.integers(-2, 15))
    cuts = draw(st.sets(near | st.integers(1, 7 * HOUR), max_size=60))
    return recorded, writes, sorted(cut for cut in cuts if 0 < cut < 7 * HOUR)


DIVIDED = [
    rule("more_than", count=2, window="20m", cooldown="15m", **{"class": "coughing"}),
    rule("more_than", count=1, window="10m", least_seconds=60, cooldown="1m"),
    rule("more_than", minutes=5, window="15m", cooldown="2m"),
    rule("more_than", minutes=4, window="15m", cooldown="20m", least_seconds=30),
    rule("longer_than", longer_than="5m", cooldown="30m", pause="3m"),
    rule("longer_than", longer_than="100s", cooldown="1m", **{"class": "music"}),
    rule("recorder_silent", silent_for="10m", cooldown="1h"),
    rule("none_by", since="12:30", by="14:00", **{"class": "music"}, least_share=0.3),
]


@settings(max_examples=60, deadline=None)
@given(lives())
def test_any_division_of_the_time_gives_the_same_rings(life):
    recorded, writes, cuts = life
    full = home(*recorded, written=writes)
    edges = [NOON + second * SECOND for second in (0, *cuts, 7 * HOUR)]
    for one in DIVIDED:
        at_once = notifications(one, full, edges[0], edges[-1], UTC)
        found, state = [], RuleState()
        for start, end in itertools.pairwise(edges):
            known = full.between(start - history(one), end, LONGEST_PAUSE)
            more, state = notifications(one, known, start, end, UTC, state)
            found += more
        assert (found, state) == at_once


def test_a_rule_of_any_sound_says_when_the_first_of_them_began_however_it_is_evaluated():
    activity = home((0, 60, "music"), (70, 1500, "coughing"))
    one = rule("longer_than", longer_than="20m", pause="3m")
    (at_once,), _ = notifications(one, activity, NOON, NOON + HOUR * SECOND, UTC)
    cut = NOON + 1000 * SECOND
    _, state = notifications(one, activity.between(0, cut, LONGEST_PAUSE), NOON, cut, UTC)
    end = NOON + HOUR * SECOND
    later = activity.between(cut - history(one), end, LONGEST_PAUSE)
    assert notifications(one, later, cut, end, UTC, state)[0] == [at_once]
    assert at_once.text.endswith("since 12:00")


def test_a_sound_that_pauses_where_one_evaluation_ends_rings_once():
    recorded = home((0, 100, "music"), (105, 100, "music"))
    one = rule("longer_than", longer_than="1m", cooldown="1m")
    edges = [NOON + second * SECOND for second in (0, 102, 300)]
    first, state = notifications(one, recorded.between(0, edges[1], 0), edges[0], edges[1], UTC)
    assert len(first) == 1
    assert notifications(one, recorded, edges[1], edges[2], UTC, state)[0] == []


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("20m", 1200), ("1h30m", 5400), ("7d", 604_800)]
)
def test_a_duration_is_read_and_said(text, seconds):
    assert read_duration(text) == seconds * SECOND
    assert read_duration(duration_words(seconds * SECOND).replace(" ", "").replace("min", "m"))


@pytest.mark.parametrize("text", ["", "20", "m", "2 h", "1.5h", 20, None, "h1"])
def test_what_is_no_duration_is_refused(text):
    with pytest.raises(
        ValueError, match="is not a duration; write one such as 90s, 20m, 1h30m or 7d"
    ):
        read_duration(text)


@pytest.mark.parametrize(
    ("keys", "states"),
    [
        ({"rule": "more_than", "window": "2h"}, "set either count or minutes"),
        (
            {"rule": "more_than", "window": "2h", "count": 1, "minutes": 1},
            "either count or minutes",
        ),
        ({"rule": "more_than", "window": "9d", "count": 1}, "a minute to seven days"),
        (
            {"rule": "none_by", "since": "6:00", "by": "10:00"},
            "is not a time of day; write one such as",
        ),
        ({"rule": "none_by", "since": "10:00", "by": "10:00"}, "are the same time of day"),
        (
            {"rule": "longer_than", "longer_than": "1m", "class": "silence"},
            "is not a sound",
        ),
        ({"rule": "unlike_usual", "part": "night", "at": "06:00"}, "a night ends at 07:00"),
        ({"rule": "recorder_silent", "class": "music"}, "Extra inputs are not permitted"),
        ({"rule": "loud"}, "'more_than', 'none_by', 'longer_than', 'recorder_silent'"),
        ({"rule": "recorder_silent", "quiet_hours": ["22-6"]}, "write it as 22:00-06:30"),
    ],
)
def test_a_rule_that_makes_no_sense_is_refused(keys, states):
    with pytest.raises(ValidationError, match=states):
        TypeAdapter(AlertRules).validate_python([{"name": "it", **keys}])


def test_a_configuration_with_two_rules_of_one_name_is_refused_where_they_are(tmp_path):
    file = tmp_path / "home.toml"
    table = '[[bridge.alert]]\nname = "it"\nrule = "recorder_silent"\n'
    file.write_text(table)
    assert [each.name for each in load_bridge_settings(file)[1].alert] == ["it"]
    file.write_text(2 * table)
    with pytest.raises(ConfigurationError, match="two rules have the name 'it'"):
        load_bridge_settings(file)
