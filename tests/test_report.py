"""The report for a carer: what its figures are, what the page says, what it refuses."""

import html
import re
from datetime import date, timedelta
from functools import partial
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import BATHROOM, GENERAL, HOUR, at, midnight, write_day, write_life
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run
from logs import read
from matplotlib.figure import Figure
from PIL import Image

from hearthlog.analyzer.activity.daily_metrics import day_of, metrics_of_home
from hearthlog.analyzer.activity.event_counts import Strata, checked_rates
from hearthlog.analyzer.activity.home_data import read_home
from hearthlog.analyzer.activity.values import (
    FEWEST,
    Clock,
    Count,
    Duration,
    compared,
    exactly,
    usual_range,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.hidden_classes import write_hidden_classes
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import day_span, home_zone, local_time
from hearthlog.analyzer.logs.spans import Spans, cut, difference, intersection, joined, lengths
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.relabel.layer import layer_topics
from hearthlog.analyzer.report.headline import day_headline
from hearthlog.analyzer.report.report import Period, make_report, read_report_data
from hearthlog.analyzer.report.timeline import timeline_of
from hearthlog.analyzer.report.timeline_plot import _draw_lanes, save_timelines
from hearthlog.models.classes import COUNTED_IF_SURE, colour, ordered
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages.message_types import nanoseconds


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


DAY = date(2026, 3, 1)
UTC = ZoneInfo("UTC")


def look(root, day=DAY, zone=UTC, labelling="live"):
    data = read_home(find_home_logs([root]), labelling, 0, day_span(day, zone))
    return day_of(metrics_of_home(data), day, zone)


def rows_of(page):
    """The cells of the rows of all tables, by the first of each."""
    found = {}
    for row in re.findall(r"<tr.*?</tr>", page, re.DOTALL):
        cells = [
            " ".join(re.sub(r"<[^>]*>", " ", cell).split())
            for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL)
        ]
        found.setdefault(cells[0], cells[1:])
    return found


def page_of(root, tmp_path, first=DAY, days=1, draw=None) -> str:
    output = tmp_path / f"page-{first}-{days}.html"
    make_report(find_home_logs([root]), Period(first, days, UTC), output, draw=draw)
    return output.read_text()


def text_of(page: str) -> str:
    """The words of a page, as they are read."""
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page.partition("<body>")[2]))


# Spans

spans = st.lists(st.tuples(st.integers(0, 60), st.integers(1, 9)), max_size=8).map(
    lambda pairs: joined(
        np.array([start for start, _ in pairs], np.int64),
        np.array([start + length for start, length in pairs], np.int64),
    )
)


def ticks(some: Spans) -> set[int]:
    pairs = zip(some.starts.tolist(), some.ends.tolist(), strict=True)
    return {tick for start, end in pairs for tick in range(start, end)}


@given(spans, spans)
def test_spans_are_joined_taken_from_each_other_and_measured_as_sets_are(a, b):
    assert ticks(intersection(a, b)) == ticks(a) & ticks(b)
    assert ticks(difference(a, b)) == ticks(a) - ticks(b)
    assert ticks(cut(a, 10, 30)) == ticks(a) & set(range(10, 30))
    edges = np.array([0, 7, 20, 21, 80])
    between = [len(ticks(a) & set(range(x, y))) for x, y in pairwise(edges)]
    assert lengths(a, edges).tolist() == between


# Counting


def test_sounds_of_a_class_within_ten_seconds_are_one_event(tmp_path):
    events = [
        (at("10:00:00"), 2, "coughing", 0.5),
        (at("10:00:11"), 2, "coughing", 0.9),  # 9 s later: the same
        (at("10:00:24"), 2, "coughing", 0.6),  # 11 s later: another one
    ]
    write_day(tmp_path, DAY, events)
    count = look(tmp_path).count("coughing")
    assert (count.labelled, count.certain, count.range) == (2, 0, None)
    assert look(tmp_path).minutes("coughing").minutes == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("alias", "name"), [("crying_sobbing", "crying"), ("shout", "yelling"), ("cough", "coughing")]
)
def test_a_sound_by_another_name_is_counted_told_and_drawn_as_its_class(tmp_path, alias, name):
    pages = []
    for label in (name, alias):
        events = [(at("10:00"), 60, label, 0.6), (at("23:00"), 30, label, 1.0)]
        classes = [label if each == name else each for each in GENERAL]
        write_day(tmp_path / label, DAY, events, classes=classes)
        pages.append(page_of(tmp_path / label, tmp_path / label))
    day = look(tmp_path / alias)
    assert (day.count(name).labelled, day.minutes(name).minutes) == (2, 1.5)
    assert day.home.classes == ordered(GENERAL)
    assert pages[0] == pages[1]


def test_what_two_microphones_hear_at_one_time_counts_once(tmp_path):
    write_day(tmp_path, DAY, [(at("10:00"), 60, "speech", 0.8)], microphone="kitchen", node="a")
    write_day(tmp_path, DAY, [(at("10:00:30"), 60, "speech", 0.6)], microphone="hall", node="b")
    day = look(tmp_path)
    assert day.count("speech").labelled == 1
    assert day.minutes("speech").minutes == pytest.approx(1.5)
    assert day.sound.minutes == pytest.approx(1.5)
    assert day.minutes("silence").minutes == pytest.approx(24 * 60 - 1.5)
    assert day.share == 1


def test_what_the_model_is_not_sure_of_is_counted_apart(tmp_path):
    coughs = [(at(f"{hour:02}:30"), 3, "coughing", 0.9) for hour in (9, 10)]
    coughs += [(at(f"{hour:02}:30"), 3, "coughing", 0.6) for hour in (1, 11, 12)]
    rings = [(at("15:00"), 5, "phone_ring", 0.95), (at("16:00"), 5, "phone_ring", 0.4)]
    write_day(tmp_path / "logs", DAY, [*coughs, *rings])
    page = page_of(tmp_path / "logs", tmp_path)
    text = re.sub(r"\s+", " ", re.sub("<[^>]*>", " ", page))
    assert "Coughing twice, perhaps 3 more (perhaps 1 at night)." in text
    assert re.search(r"Coughing 1\? 2 \(\+2\?\) 0 .*Telephone ringing 0 1 0 15:00", text)
    assert "16:00?" not in text, "a telephone that may be something else is no count and no time"
    assert text.count("? = perhaps: the model is not sure of these") == 1


def test_of_several_times_those_that_are_not_sure_have_a_question_mark(tmp_path):
    nights = [(at("23:30"), 3, "coughing", 0.9), (at("23:50"), 3, "coughing", 0.6)]
    write_day(tmp_path / "logs", DAY - timedelta(days=1), nights)
    write_day(tmp_path / "logs", DAY, [])
    text = text_of(page_of(tmp_path / "logs", tmp_path))
    assert "Coughing once in the night, perhaps 1 more (Saturday 23:30, Saturday 23:50?)." in text
    assert "Coughing 1 (+1?) 0 0 Saturday 23:30, Saturday 23:50?" in text


def test_a_count_is_said_as_labelled_or_with_the_range_that_checked_minutes_give():
    assert exactly(3).text == "3"
    assert Count(7, 0, Strata(100, 20, 7)).text == "7"
    doubtful = Count(7, 0, Strata(100, 20, 7), unsure=3)
    assert (doubtful.text, (doubtful + doubtful).text) == ("4 (+3?)", "8 (+6?)")
    assert Count(3, 0, Strata(100, 20, 3), unsure=3).text == "3?"
    printed = np.array([1, 1, 1, 1, 0, 0, 2, 1])
    rates = checked_rates(printed, np.minimum(printed, 1), printed > 0, 0.5)
    count = Count(27, 2, Strata(100, 20, 25), rates)
    low, high = count.range
    assert 2 <= low < 25 < high
    assert count.text == f"{low} to {high} (27 labelled)"
    assert count == Count(27, 2, Strata(100, 20, 25), rates), "the same each time"
    both = count + Count(3, 3, rates=rates)
    assert (both.labelled, both.range) == (30, (low + 3, high + 3))
    assert [Duration(m).text for m in (0, 0.2, 59.4, 125)] == [
        "0 min",
        "under 1 min",
        "59 min",
        "2 h 05 min",
    ]
    assert Clock(425).text == "07:05"


def test_what_is_usual_needs_a_week_and_what_is_unusual_is_outside_of_all_of_it():
    days = [exactly(n) for n in (3, 4, 4, 5, 6, 3, 4)]
    assert usual_range(days[: FEWEST - 1]) is None
    known = usual_range(days)
    assert known == (4, 3, 6)
    assert exactly(0).spread(*known) == "4 (3 to 6)"
    assert compared(exactly(7), known) == 1
    assert compared(exactly(6), known) == 0
    assert compared(exactly(2), known) == -1


# The home's time


def test_a_day_begins_at_the_midnight_of_the_home_and_may_have_23_or_25_hours(tmp_path):
    vienna = ZoneInfo("Europe/Vienna")
    for day, hours in ((date(2026, 3, 29), 23), (date(2026, 10, 25), 25), (DAY, 24)):
        start, end = day_span(day, vienna)
        assert (end - start) // NANOSECONDS == hours * HOUR
    changed = date(2026, 3, 29)
    write_day(tmp_path, changed - timedelta(days=1), [(at("23:30"), 60, "speech", 1.0)])
    write_day(
        tmp_path, changed, [(at("21:59"), 30, "speech", 1.0), (at("22:10"), 60, "music", 1.0)]
    )
    day = look(tmp_path, changed, vienna)
    assert day.span.length == 23 * HOUR * NANOSECONDS
    assert day.count("speech").labelled == 2
    assert day.count("music").labelled == 0, "that is of the next day"
    assert len(day.sound_by_hour) == 23
    assert day.sound_by_hour[0] == pytest.approx(1.0)
    assert day.share == 1


def test_the_zone_is_that_of_the_option_or_the_logs_or_utc(tmp_path):
    assert str(home_zone(None)) == "UTC"
    assert str(home_zone(None, [{}, {"timezone": "Asia/Kolkata"}])) == "Asia/Kolkata"
    assert str(home_zone("Europe/Vienna", [{"timezone": "Asia/Kolkata"}])) == "Europe/Vienna"
    for name in ("Mars/Olympus", "../../etc/passwd", "", "Europe", "x" * 5000, "a\0b"):
        with pytest.raises(DataError, match="is no time zone"):
            home_zone(name)
    write_day(tmp_path, DAY, hours=[20], timezone="Asia/Kolkata")
    shelf = find_home_logs([tmp_path])
    zone = home_zone(None, shelf.records())
    assert shelf.days(zone) == [DAY + timedelta(days=1)], "20:00 UTC is 01:30 there"


# What a recorder writes


def test_minutes_and_events_are_those_of_the_segments_that_a_recorder_wrote(recorded, tmp_path):
    printed = read(recorded, "segment")
    first = nanoseconds(printed[0].header.stamp)
    start = local_time(first, UTC).date()
    day = look(recorded, start)
    for name in day.home.classes:
        own = [segment for segment in printed if segment.label == name]
        length = sum(nanoseconds(segment.duration) for segment in own)
        if not own:  # of a few minutes of a day nobody knows what was not in it
            assert day.minutes(name) is day.count(name) is None
            continue
        if name in {*COUNTED_IF_SURE, "unknown"}:  # it is unknown where the model is not sure
            continue
        assert day.minutes(name).minutes == pytest.approx(length / (60 * NANOSECONDS))
        if name != "silence":
            assert 0 < day.count(name).labelled <= len(own)
    text = text_of(page_of(recorded, tmp_path, start))
    assert re.search(r"day from [0-2]\d:\d\d to [0-2]\d:\d\d: ", text)
    assert not re.search("of these: [^.]*not sure", text)


def text_beside_picture(page):
    return text_of(re.sub(r"<desc.*?</desc>", "", page))


def test_what_is_missing_of_a_day_is_stated_once_and_why_below(tmp_path):
    write_day(tmp_path, DAY, [(at("10:30"), 60, "speech", 0.8)], hours=[10])
    text = text_beside_picture(page_of(tmp_path, tmp_path))
    assert "Sunday from 10:00 to 11:00: talking. There are logs only from 10:00 to 11:00." in text
    for again in (
        "ot listening",
        "not listen",
        "box was off",
        "knows nothing",
        "Most of the sound",
    ):
        assert again not in text


def test_the_reason_of_a_gap_is_below_the_headline_that_counts_its_hours(tmp_path):
    gap = (at("10:00"), 2 * HOUR, "silent")
    write_day(tmp_path, DAY, hours=[0, *range(8, 14), 23], gaps=[gap])
    text = text_beside_picture(page_of(tmp_path, tmp_path))
    assert (
        "In the 6 hours that the box listened on Sunday: nothing but quiet. The box did not" in text
    )
    assert "The box was off for 16 h 00 min of the time not listened to, or its logs" in text
    assert "2 h 00 min, once (10:00 to 12:00)" in text
    assert "Not listening:" not in text


# What nobody listened to


def test_of_a_day_that_was_hardly_heard_nothing_is_said_not_to_have_been(tmp_path):
    events = [(at("12:05"), 3, "coughing", 1.0), (at("12:10"), 90, "speech", 1.0)]
    write_day(tmp_path, DAY, events, hours=[12])
    day = look(tmp_path)
    assert day.count("coughing").labelled == 1
    assert day.minutes("speech").minutes == pytest.approx(1.5)
    unknown = [day.count("yelling"), day.minutes("music"), day.night_count("coughing"), day.quiet]
    unknown += [day.night_sound, day.night_stretches, day.first, day.last]
    assert unknown == [None] * 8
    page = page_of(tmp_path, tmp_path)
    rows, text = rows_of(page), text_of(page)
    assert rows["Coughing"] == ["1", "12:05", "under 1 min"]
    longer = ("First longer sounds a minute or more in ten", "Last longer sounds a minute")
    for title in ("Longest quiet, 07\N{EN DASH}22", *longer, "Behaviour: shouting"):
        assert title not in rows
    assert "Shouting" not in rows
    assert (
        "The box listened too little to tell whether there was any of these: crying, shout" in text
    )
    assert "The box listened too little to tell more." in text
    assert "was quiet" not in text
    assert (
        "Coughing once by day (12:05). Sunday from 12:00 to 13:00: talking. There are "
        "logs only from 12:00 to 13:00."
    ) in text


@pytest.mark.parametrize(("last", "known"), [(16, False), (18, True)])
def test_a_0_is_said_where_three_quarters_of_the_time_were_heard(tmp_path, last, known):
    write_day(tmp_path, DAY, hours=range(last))
    day = look(tmp_path)
    assert (day.count("coughing") is not None) == known
    assert (day.minutes("coughing") is not None) == known
    assert (day.sound is not None) == known
    assert day.night_count("coughing").labelled == 0  # 7 of its 9 hours
    assert day.quiet.minutes == 60 * (last - 7)


def test_a_lively_time_is_the_first_where_it_was_listened_to_before(tmp_path):
    events = [(at(f"{hour}:00"), 120, "speech", 1.0) for hour in ("08", "20")]
    write_day(tmp_path, DAY, events)
    full = look(tmp_path)
    assert (full.first.text, full.last.text) == ("08:00", "20:09")
    write_day(tmp_path / "late", DAY, events, hours=range(8, 24))
    late = look(tmp_path / "late")
    assert late.first is None
    assert late.last.text == "20:09"


def test_a_sum_of_days_of_which_most_are_not_known_is_not_0(tmp_path):
    for ago in range(7):
        hours = range(24) if ago > 3 else [12]
        write_day(tmp_path / "logs", DAY - timedelta(days=ago), hours=hours)
    page = page_of(tmp_path / "logs", tmp_path, DAY - timedelta(days=6), 7)
    rows = rows_of(page)
    assert rows["Listened"][:7] == ["92 %", "100 %", "100 %", "12 %", "4 %", "4 %", "4 %"], (
        "each with the evening before"
    )
    assert {cells[-1] for cells in rows.values()} & {"0", "0 min"} == set()


# Nights, quiet, hours


def test_the_night_is_that_which_ends_on_the_day(tmp_path):
    coughs = [(at("22:30"), 2, "coughing", 1.0), (at("21:30"), 2, "coughing", 1.0)]
    write_day(tmp_path, DAY - timedelta(days=1), coughs)
    write_day(tmp_path, DAY, [*coughs, *((at(t), 2, "coughing", 1.0) for t in ("06:59", "07:01"))])
    day = look(tmp_path)
    assert day.night_count("coughing").labelled == 2
    assert day.count("coughing").labelled == 4
    assert day.night_hours == 9


def test_the_longest_quiet_stretch_is_sought_while_the_clock_shows_day(tmp_path):
    events = [
        (at("06:00"), 120, "objects_activity", 1.0),
        (at("09:00"), 600, "speech", 1.0),
        (at("13:00"), 60, "speech", 1.0),
        (at("17:00"), 60, "speech", 1.0),
        (at("23:15"), 120, "music", 1.0),
    ]
    write_day(tmp_path, DAY, events, gaps=[(at("18:00"), 4 * HOUR, "the recorder was not running")])
    day = look(tmp_path)
    assert day.quiet.minutes == pytest.approx(239)  # 13:01 to 17:00; the gap is no quiet
    assert (day.first.text, day.last.text) == ("06:00", "23:19")
    assert day.sound_by_hour[9] == pytest.approx(10)
    assert day.share == pytest.approx(20 / 24)


def test_a_silence_that_ends_late_still_belongs_to_the_evening_it_began_in(tmp_path):
    write_day(tmp_path, DAY, hours=range(22))
    path = tmp_path / "2026/03/02/home_20260302T000000Z.mcap"
    path.parent.mkdir(parents=True)
    one_segment(path, "/mic/segment", midnight(DAY) + 22 * HOUR * NANOSECONDS, 8 * HOUR, "silence")
    assert look(tmp_path).share == 1


def one_segment(path, topic, start, seconds, label):
    """Write a log with a single segment."""
    name = topic.split("/")[1]
    topics = layer_topics(name, "x", GENERAL)
    topics = [type(t)(topic, t.type) if t.name.endswith("/segment") else t for t in topics]
    writer = LogWriter(path, topics, {"version": "0", "node": "home"})
    length = seconds * NANOSECONDS
    fields = {
        "header.stamp": np.array([start]),
        "header.frame_id": name,
        "duration": np.array([length]),
        "label": [label],
        "confidence": np.ones(1, np.float32),
    }
    writer.write_columns([TopicBatch(topic, np.array([start + length]), fields)])
    return writer.finish()


# What people say


def test_what_a_reviewer_says_replaces_what_the_model_said_and_is_certain(tmp_path):
    logs = write_day(tmp_path, DAY, [(at("10:00"), 60, "crying", 0.6)], hours=[10])
    start = midnight(DAY) + 10 * HOUR * NANOSECONDS
    write_marks(logs[0], [Mark("mic", start + 10**9, start + 61 * 10**9, "laughing")])
    day = look(tmp_path)
    assert day.count("laughing").labelled == 1
    assert day.minutes("laughing").minutes == 1
    assert day.minutes("crying").minutes == pytest.approx(1 / 60)
    assert day.count("crying").labelled == 1


def test_what_no_model_listens_for_is_not_said_to_be_absent_though_a_person_marked_it(tmp_path):
    earlier = DAY - timedelta(days=1)
    logs = write_day(tmp_path / "logs", earlier, hours=[10])
    write_day(tmp_path / "logs", DAY)
    start = midnight(earlier) + 10 * HOUR * NANOSECONDS
    write_marks(logs[0], [Mark("mic", start + 10**9, start + 61 * 10**9, "flushing_water")])
    assert look(tmp_path / "logs").count("flushing_water") is None
    page = page_of(tmp_path / "logs", tmp_path)
    assert "toilet flush" not in re.search("Not once: coughing[^<]*", page)[0]
    assert "does not know these sounds" in page
    assert "toilet flush" in re.search("says nothing about them: [^.]*", page)[0]


def test_a_relabelling_is_read_in_place_of_what_the_recorder_said(tmp_path):
    log, *_ = write_day(tmp_path, DAY, [(at("10:00"), 60, "crying", 0.6)], hours=[10])
    layer = log.with_name(f"{log.stem}.relabel-new-2.mcap")
    start = midnight(DAY) + 10 * HOUR * NANOSECONDS
    one_segment(layer, "/mic/relabel/new_2/segment", start, 30, "laughing")
    day = look(tmp_path, labelling="new-2")
    assert day.minutes("laughing").minutes == 0.5
    assert day.count("crying") is None
    with pytest.raises(DataError, match=r"no labelling 'new-3' .*; there is live, new-2"):
        look(tmp_path, labelling="new-3")


def test_the_last_whole_day_is_that_which_the_logs_reach_to_the_end_of(tmp_path):
    for day in (DAY, DAY + timedelta(days=1)):
        write_day(tmp_path, day, hours=[0, 12])
    last = tmp_path / "2026/03/02/home_20260302T230000Z.mcap"
    start = midnight(DAY) + 47 * HOUR * NANOSECONDS
    one_segment(last, "/mic/segment", start, 1800, "speech")
    assert find_home_logs([tmp_path]).last_complete_day(UTC) == DAY
    last.unlink()
    one_segment(last, "/mic/segment", start, 3570, "speech")
    assert find_home_logs([tmp_path]).last_complete_day(UTC) == DAY + timedelta(days=1)


# The headline


def headline(root, tmp_path, **period) -> str:
    found = re.search('<p class="headline">(.*?)</p>', page_of(root, tmp_path, **period))[1]
    return re.sub("<[^>]*>", "", found)


def test_the_headline_of_a_quiet_day_names_its_coughs(tmp_path):
    coughs = [(at(t), 2, "coughing", 0.9) for t in ("06:13", "15:26", "15:30")]
    write_day(tmp_path / "logs", DAY, [*coughs, (at("16:00"), 5, "yelling", 0.9)])
    assert headline(tmp_path / "logs", tmp_path) == (
        "Coughing 3 times (1 at night). Shouting once by day (16:00). Sunday was quiet."
    )


@pytest.mark.parametrize(
    ("lively", "text"),
    [
        ([19, 20, 21], "Sunday was quiet but for 19:00 to 22:00."),
        ([8, 22, 23], "Sunday was quiet but for 08:00 to 09:00 and 22:00 to 24:00."),
        ([8, 10, 12, 14], "Sunday was quiet but for four hours."),
        (range(9, 16), "Sunday had sound in 7 of 24 hours."),
    ],
)
def test_a_day_is_quiet_if_at_most_six_of_its_hours_have_five_minutes_of_sound(
    tmp_path, lively, text
):
    sounds = [(at(f"{hour:02}:20"), 300, "music", 0.9) for hour in lively]
    write_day(tmp_path / "logs", DAY, [*sounds, (at("07:00"), 290, "music", 0.9)])
    assert headline(tmp_path / "logs", tmp_path) == text


@pytest.mark.parametrize(
    ("other", "text"),
    [
        ([], "Sunday was quiet but for something like a television from 19:58 to 22:02."),
        (
            [9, 10],
            (
                "Sunday was quiet but for 09:00 to 11:00 and something like a television from "
                "19:58 to 22:02."
            ),
        ),
        ([9, 11, 13], "Sunday was quiet but for five hours."),
    ],
)
def test_the_headline_of_a_quiet_day_names_a_television_that_makes_its_hours_lively(
    tmp_path, other, text
):
    talking = [(at("20:00") + 30 * number, 15, "speech", 0.9) for number in range(240)]
    sounds = [(at(f"{hour:02}:20"), 310, "music", 0.9) for hour in other]
    write_day(tmp_path / "logs", DAY, [*sounds, *talking])
    assert headline(tmp_path / "logs", tmp_path) == text


@pytest.mark.parametrize(
    ("hours", "text"),
    [
        ([0, *range(6, 24)], "Sunday was quiet (listened to 19 of 24 hours)."),
        (range(5, 24), "Sunday from 05:00 was quiet."),
        (range(5, 23), "Sunday from 05:00 to 23:00 was quiet."),
        ([0, 1, *range(4, 20)], "Sunday until 20:00 was quiet (listened to 18 of 20 hours)."),
        (
            range(6, 18),
            (
                "Sunday from 06:00 to 18:00: nothing but quiet. There are logs only from 06:00 "
                "to 18:00."
            ),
        ),
        (
            [*range(8), *range(13, 24)],
            (
                "In the 19 hours that the box listened on Sunday: nothing but quiet. The box did "
                "not listen in the other 5 hours."
            ),
        ),
    ],
)
def test_a_day_is_not_called_quiet_where_nobody_listened(tmp_path, hours, text):
    write_day(tmp_path / "logs", DAY, hours=hours)
    assert headline(tmp_path / "logs", tmp_path) == text


_TALK, _SONG = (at("22:10"), 300, "speech", 0.9), (at("22:20"), 900, "music", 0.9)
_CLATTER = (at("23:20"), 40, "objects_activity", 0.9)


@pytest.mark.parametrize(
    ("hours", "sounds", "text"),
    [
        (
            [22, 23],
            [_TALK, _SONG, _CLATTER],
            "from 22:00 to 24:00: talking, household sounds and something",
        ),
        ([22, 23], [(at("22:10"), 20, "speech", 0.9)], "from 22:00 to 24:00: under 1 min of sound"),
        ([22, 23], [(at("22:10"), 240, "unknown", 0.4)], "from 22:00 to 24:00: 4 min of sound."),
        (
            [3, 22],
            [_TALK],
            "In the 2 h 00 min that the box listened on Sunday: talking. There are logs",
        ),
    ],
)
def test_the_headline_of_a_partly_recorded_day_says_when_and_what_was_labelled(
    tmp_path, hours, sounds, text
):
    write_day(tmp_path / "logs", DAY, sounds, hours=hours)
    assert text in headline(tmp_path / "logs", tmp_path)


@pytest.mark.parametrize(
    ("hours", "hatched", "text"),
    [
        (range(10), 0, "from 00:00 to 10:00: nothing but quiet. There are logs only up to 10:00."),
        (range(8, 10), 0, "There are logs only from 08:00 to 10:00."),
        (range(20), 0, "Sunday until 20:00 was quiet."),
        (
            [*range(8), 9],
            90,
            "logs only up to 10:00. In between, it did not listen for 1 h 00 min.",
        ),
    ],
)
def test_hours_without_logs_at_the_ends_are_not_called_not_recorded(tmp_path, hours, hatched, text):
    write_day(tmp_path / "logs", DAY, hours=hours)
    page = page_of(tmp_path / "logs", tmp_path)
    assert text in text_of(page)
    assert "other" not in text_of(page).partition("Labelled by")[0]
    assert 'class="alert"' not in page, "nothing to have looked at"
    gaps = re.findall(r'class="gap" style="left: ([\d.]+)%; width: ([\d.]+)%', page)
    assert max((float(left) + float(width) for left, width in gaps), default=0) <= hatched


def test_the_days_of_a_week_before_the_first_log_and_after_the_last_are_a_row_each(tmp_path):
    for ago in (3, 2):
        write_day(tmp_path / "logs", DAY - timedelta(days=ago))
    page = page_of(tmp_path / "logs", tmp_path, DAY - timedelta(days=6), 7)
    assert re.findall(r'class="unlogged".*?><span>(.*?)</span>', page) == [
        "before the first log",
        "after the last log",
    ]
    assert re.findall(r'class="row"><span class="name">(.*?)</span>', page) == [
        *("Mon 23 to Wed 25 Feb", "Thu 26 Feb", "Fri 27 Feb", "Sat 28 Feb to Sun 1 Mar"),
    ]
    heads = re.findall(r"<th[^>]*>((?:Mon|Tue|Wed|Thu|Fri|Sat|Sun) \d+)</th>", page)
    assert {*heads} == {"Thu 26", "Fri 27"}
    assert 'class="gap"' not in page
    assert 'class="alert"' not in page
    text = text_of(page)
    assert "Both of the two days listened to" in text
    assert "there are no logs of the other five days." in text
    assert "There are logs only from Thu 26 Feb to Fri 27 Feb." in text


def test_the_lane_of_a_model_of_one_class_fills_its_picture(tmp_path):
    write_day(tmp_path, DAY, [(at("10:00"), 3600, "coughing", 0.9)], classes=["coughing"])
    data, _ = read_report_data(find_home_logs([tmp_path]), Period(DAY, 1, UTC))
    axes = Figure().subplots()
    _draw_lanes(axes, [("", timeline_of(data.days[0]))])
    assert axes.get_ylim() == (1, 0)


def test_a_minute_of_a_day_is_no_hour_and_leaves_the_rest_of_the_day(tmp_path):
    rest = [(at("10:00") + edge, 1500, "gone") for edge in (0, 2100)]
    rest += [(at(hour), HOUR, "gone") for hour in ("00:00", "23:00")]
    write_day(tmp_path / "logs", DAY, hours=[0, 10, 23], gaps=rest)
    assert headline(tmp_path / "logs", tmp_path) == (
        "Sunday from 10:25 to 10:35: nothing but quiet. The box did not listen in the rest of the "
        "day."
    )


def test_what_is_beside_a_television_does_not_describe_the_recorded_time(tmp_path):
    talking = [(at("22:10") + 20 * i, 15, "speech", 0.9) for i in range(60)]
    clatter = [(second + 15, 5, "objects_activity", 0.9) for second, *_ in talking[10:40]]
    write_day(tmp_path / "logs", DAY, [*talking, *clatter], hours=[22])
    assert headline(tmp_path / "logs", tmp_path).startswith(
        "Sunday from 22:00 to 23:00: something like a television."
    )


def test_a_week_has_a_headline_of_its_days(tmp_path):
    for ago in range(7):
        coughs = [(at("03:00") + 60 * n, 2, "coughing", 0.9) for n in range(ago)]
        hours = [12] if ago in {1, 2} else range(24)
        write_day(tmp_path / "logs", DAY - timedelta(days=ago), coughs, hours=hours)
    first = DAY - timedelta(days=6)
    assert headline(tmp_path / "logs", tmp_path, first=first, days=7) == (
        "Coughing 18 times on 4 days; most on Mon 23 Feb: 6. "
        "All of the five days listened to were quiet; of the other two days there is too little."
    )


def test_a_week_of_which_one_day_was_recorded_is_headed_by_that_day(tmp_path):
    write_day(tmp_path / "logs", DAY)
    assert headline(tmp_path / "logs", tmp_path, first=DAY - timedelta(days=6), days=7) == (
        "Only Sunday was listened to: it was quiet."
    )


def test_what_the_night_has_of_the_evening_before_is_named_so_that_counts_add_up(tmp_path):
    before = [(at("23:28"), 2, "coughing", 0.9)]
    write_day(tmp_path / "logs", DAY - timedelta(days=1), before)
    times = ["01:51", "02:16", "06:01", "14:00"]
    coughs = [(at(time), 2, "coughing", 0.9) for time in times]
    write_day(tmp_path / "logs", DAY, coughs)
    page = page_of(tmp_path / "logs", tmp_path)
    assert "Coughing 5 times (4 at night)." in page
    assert ": coughing 4 times (1 of them on Saturday); under 1 min of sound" in page
    times = "Saturday 23:28, 01:51, 02:16, 06:01, 14:00"
    assert rows_of(page)["Coughing"] == ["4", "1", "0", times, "under 1 min"]
    other = tmp_path / "other"
    other.mkdir()
    write_day(other / "logs", DAY - timedelta(days=1), before)
    write_day(other / "logs", DAY, coughs[:1])
    assert "Coughing twice in the night (Saturday 23:28, 01:51)." in headline(other / "logs", other)


def test_how_long_a_sound_lasted_is_apart_from_a_television(tmp_path):
    talking = [(at("13:00") + 60 * number, 30, "speech", 0.9) for number in range(60)]
    write_day(tmp_path / "logs", DAY, [*talking, (at("18:00"), 5, "coughing", 0.9)])
    page = page_of(tmp_path / "logs", tmp_path)
    apart = "30\N{NO-BREAK SPACE}min beside a television"
    assert f'<span class="unit">0 min</span><small>{apart}</small>' in page
    assert f'<td data-head="Count">0 min<small>{apart}</small>' in page
    other = tmp_path / "other"
    other.mkdir()
    week = page_of(tmp_path / "logs", other, first=DAY - timedelta(days=6), days=7)
    assert f"0 min<small>{apart}</small></td>" in week


def test_a_name_that_nobody_gave_is_not_shown(tmp_path):
    write_day(tmp_path / "logs", DAY)
    assert "icrophone: mic" not in page_of(tmp_path / "logs", tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    write_day(other / "logs", DAY, node="anna", microphone="kitchen")
    assert "Home: anna. Microphone: kitchen. </p>" in page_of(other / "logs", other)


def test_talking_and_music_beside_a_television_are_in_no_count_no_length_and_no_sure_mark(tmp_path):
    evening = [(at("19:00") + 20 * n, 15, ("speech", "music")[n % 2], 0.9) for n in range(120)]
    write_day(tmp_path / "logs", DAY, [*evening, (at("08:00"), 120, "speech", 0.9)])
    page = page_of(tmp_path / "logs", tmp_path)
    rows = rows_of(page)
    minutes = "15\N{NO-BREAK SPACE}min beside a television".replace("\N{NO-BREAK SPACE}", " ")
    beside = "60 beside a television"
    assert rows[f"Talking {beside}"] == ["0", "1", "0", "08:00", f"2 min {minutes}"]
    assert rows[f"Music {beside}"] == ["0", "0", "0", "", f"0 min {minutes}"]
    assert "Talking 1, and 60 beside a television; Music 0, and 60 beside a television." in page
    assert "Most of the sound, a television aside: talking." in page
    assert "are neither counted nor in the lengths; they are shown faint." in page
    other = tmp_path / "other"
    other.mkdir()
    week = rows_of(page_of(tmp_path / "logs", other, DAY - timedelta(days=6), 7))
    assert week["Talking"] == ["1 60 beside a television", f"2 min {minutes}"]
    assert week["Music"] == ["0 60 beside a television", f"0 min {minutes}"]


def test_water_and_a_sound_of_the_home_itself_count_beside_a_television_in_number_and_length(
    tmp_path,
):
    talking = [(at("10:00") + 20 * n, 15, "speech", 0.9) for n in range(60)]
    own = [(at("10:05:15"), 4, "flushing_water", 0.9), (at("10:10:15"), 4, "doorbell", 0.9)]
    classes = [*GENERAL, "flushing_water", "doorbell"]
    write_day(tmp_path / "logs", DAY, [*talking, *own], classes=classes)
    page = page_of(tmp_path / "logs", tmp_path)
    rows = rows_of(page)
    assert rows["Toilet flush"] == ["0", "1", "0", "10:05", "under 1 min"]
    assert rows["Doorbell"] == ["0", "1", "0", "10:10", "under 1 min"]
    assert "Counted there, too: toilet flush and doorbell." in page


def test_an_event_of_a_sound_that_begins_before_a_television_is_counted_and_measured_as_one(
    tmp_path,
):
    talking = [(at("10:00") + 20 * n, 15, "speech", 0.9) for n in range(60)]
    write_day(tmp_path / "logs", DAY, [(at("09:50"), 660, "objects_activity", 0.9), *talking[3:]])
    rows = rows_of(page_of(tmp_path / "logs", tmp_path))
    assert rows["Household sounds"] == ["0", "1", "0", "09:50", "11 min"]


def test_marks_of_which_the_model_is_not_sure_are_half_as_high(tmp_path):
    coughs = [(at("10:00"), 5, "coughing", 0.9), (at("15:00"), 5, "coughing", 0.5)]
    write_day(tmp_path / "logs", DAY, [*coughs, (at("18:00"), 1800, "objects_activity", 0.5)])
    page = page_of(tmp_path / "logs", tmp_path)
    assert '<path class="short" d="M720 0v1"/>' in page
    assert '<g class="low"><path class="long" d="M1200 0.5h30v0.5h-30z"/>' in page
    assert '<path class="short" d="M1020 0.5v0.5"/></g>' in page
    assert "half as high: not sure" in page
    assert ">Coughing 2; Household sounds 1. There are logs only from 00:00 on.</desc>" in page


def test_sounds_of_one_minute_are_named_once_with_their_number(tmp_path):
    coughs = [(at(time), 2, "coughing", 0.9) for time in ("23:04:01", "23:04:40", "23:37")]
    write_day(tmp_path / "logs", DAY, coughs)
    assert headline(tmp_path / "logs", tmp_path).startswith(
        "Coughing 3 times after 22:00 (23:04 twice, 23:37)."
    )


def test_the_first_sentence_of_a_headline_is_a_part_and_not_cut_at_a_full_stop(tmp_path):
    write_day(tmp_path / "logs", DAY, [(at("12:05"), 2, "coughing", 0.9)])
    data, _ = read_report_data(find_home_logs([tmp_path / "logs"]), Period(DAY, 1, UTC))
    assert day_headline(data.days[0]) == ("Coughing once by day (12:05).", "Sunday was quiet.")
    page = page_of(tmp_path / "logs", tmp_path)
    assert (
        '<p class="headline">Coughing once by day (12:05). <br><span class="second">Sunday' in page
    )


@pytest.mark.parametrize(
    ("sounds", "text"),
    [
        ([], "Nothing was labelled from 04:00 to 08:00 and after 08:09. Steady"),
        (
            [(at("06:00"), 3, "music", 0.9), (at("06:04"), 2, "coughing", 0.5)],
            (
                "From 04:00 to 08:00 and after 08:09: less than a minute of sound in each ten "
                "minutes; the longest was music, 3 s at 06:00."
            ),
        ),
        (
            [(at("02:00"), 900, "music", 0.9), (at("07:17"), 50, "speech", 0.5)],
            "the longest was perhaps talking, 50 s at 07:17. Steady",
        ),
    ],
)
def test_short_sounds_before_the_first_lively_minutes_are_not_denied(tmp_path, sounds, text):
    write_day(tmp_path / "logs", DAY, [*sounds, (at("08:00"), 300, "music", 0.9)])
    assert text in text_of(page_of(tmp_path / "logs", tmp_path))


@pytest.mark.parametrize(
    ("classes", "steady"),
    [(GENERAL, "a fan's or a shower's"), ([*GENERAL, "shower"], "a fan's")],
)
def test_a_shower_that_the_model_does_not_know_counts_as_quiet(tmp_path, classes, steady):
    write_day(tmp_path / "logs", DAY, [(at("08:00"), 300, "music", 0.9)], classes=classes)
    text = html.unescape(text_of(page_of(tmp_path / "logs", tmp_path)))
    assert f"Steady sound, such as {steady}, counts as quiet" in text


@pytest.mark.parametrize(
    ("steady", "words"),
    [
        ([(at("07:17"), 420, 14)], "Steady sound from 07:17 to 07:24."),
        ([(at("07:17"), 420, 5)], ""),
        ([(at("07:17"), 120, 14)], ""),
        ([(at("08:00"), 10 * HOUR, 14)], ""),  # a street by day is no sound of its own
        (
            [(at("03:00"), 360, 14), (at("11:30"), 360, 14)],
            "Steady sound from 03:00 to 03:06 and 11:30 to 11:36.",
        ),
        (
            [(at(f"{hour:02}:00"), 180, 14) for hour in (3, 9, 11)],
            "Steady sound at three times.",
        ),
    ],
)
def test_a_quiet_day_names_steady_sound_that_no_label_names(tmp_path, steady, words):
    write_day(tmp_path / "logs", DAY, [(at("07:19"), 3, "coughing", 0.9)], steady=steady)
    text = text_of(page_of(tmp_path / "logs", tmp_path))
    assert f"Coughing once by day (07:19). Sunday was quiet. {words}".strip() in text
    assert ("Steady sound from" in text or "Steady sound at" in text) == bool(words)
    assert ("such as water, a fan or a machine, was louder" in text) == bool(words)


def test_no_shower_that_the_model_knows_is_called_steady_sound(tmp_path):
    shower = [(at("07:17"), 420, "shower", 0.9)]
    about = {"classes": BATHROOM, "steady": [(at("07:17"), 420, 14)]}
    write_day(tmp_path / "logs", DAY, shower, **about)
    assert "no label names" not in text_of(page_of(tmp_path / "logs", tmp_path))


def test_a_week_of_one_recorded_day_has_the_sentence_of_that_day(tmp_path):
    write_day(tmp_path / "logs", DAY, [(at("19:20"), 600, "objects_activity", 0.9)])
    week = {"first": DAY - timedelta(days=6), "days": 7}
    assert headline(tmp_path / "logs", tmp_path, **week).startswith(
        "Only Sunday was listened to: it was quiet but for 19:00 to 20:00."
    )
    write_day(tmp_path / "logs", DAY - timedelta(days=1))
    write_day(tmp_path / "logs", DAY - timedelta(days=2), hours=[12])
    other = tmp_path / "other"
    other.mkdir()
    assert headline(tmp_path / "logs", other, **week).startswith(
        "Both of the two days listened to were quiet but for a few hours; of the other five days"
    )


def test_what_to_set_and_which_commands_to_use_is_at_the_end_for_whoever_set_it_up(tmp_path):
    write_day(tmp_path / "logs", DAY)
    page = page_of(tmp_path / "logs", tmp_path)
    own, _, setup = page.partition("<h2>For whoever set this up</h2>")
    assert "<small>Times are UTC, perhaps not local time.</small></h1>" in own
    assert "says nothing about them: toilet flush, shower and water tap.</p>" in own
    assert "<code>" not in own
    assert "set <code>timezone</code>" in setup
    assert "run <code>hearthlog annotate import</code>; then <code>hearthlog train" in setup
    assert "<h2>" not in setup


def test_a_home_that_is_set_up_and_whose_model_knows_all_has_no_such_part(tmp_path):
    classes = [*GENERAL, "flushing_water", "shower", "tap_water"]
    write_day(tmp_path / "logs", DAY, classes=classes, timezone="Europe/Vienna")
    output = tmp_path / "page.html"
    zone = ZoneInfo("Europe/Vienna")
    make_report(find_home_logs([tmp_path / "logs"]), Period(DAY, 1, zone), output)
    assert "Times are those of Europe/Vienna.</p>" in output.read_text()
    assert "set this up" not in output.read_text()


def test_the_first_and_the_last_longer_sounds_are_not_called_the_first_and_the_last_sound(tmp_path):
    short = [(at(t), 20, "objects_activity", 0.9) for t in ("07:30", "22:30")]
    talking = [(at(t), 90, "speech", 0.9) for t in ("12:00", "19:01")]
    write_day(tmp_path / "logs", DAY, [*short, *talking])
    for days in (1, 7):
        page = page_of(tmp_path / "logs", tmp_path, DAY - timedelta(days=days - 1), days)
        rows = rows_of(page)
        after = [""] * (days == 1)
        assert rows["First sound from 04:00, however short"] == ["07:30", *after]
        assert rows["First longer sounds a minute or more in ten"] == ["12:00", *after]
        assert rows["Last longer sounds a minute or more in ten"] == ["19:09", *after]
        assert "There may be shorter sounds before and after them." in text_of(page)


def test_what_a_day_says_of_its_night_names_the_morning_it_ends_on(tmp_path):
    write_day(tmp_path / "logs", DAY, [(at("03:00"), 2, "coughing", 0.9)])
    page = page_of(tmp_path / "logs", tmp_path)
    (heads,) = re.findall(r"<tr><th scope=.col.>Sound.*?</tr>", page)
    assert "Night to Sunday, 22\N{EN DASH}07" in re.sub("<.*?>", "", heads)
    assert "In the night to Sunday, 22:00 to 07:00: coughing once (03:00);" in page
    assert not re.search(r">Night[< ](?!to Sunday)", page), "no other night"


def test_times_of_sounds_are_those_at_which_they_began(tmp_path):
    busy = [(at("08:00") + 3600 * n, 240, "objects_activity", 0.9) for n in range(6)]
    shown = [(at("16:00"), 240, "coughing", 0.9)]
    write_day(tmp_path / "logs", DAY, [*busy, *shown])
    page = page_of(tmp_path / "logs", tmp_path)
    assert rows_of(page)["Household sounds"][3] == "first 08:00, last 13:00"
    assert rows_of(page)["Coughing"][3] == "16:00"
    assert "Coughing once by day (16:00)." in page
    assert "The time of a sound is that of its beginning." in page


# The page


def test_times_of_up_to_five_sounds_are_written_and_of_more_the_first_and_the_last(tmp_path):
    rings = [(at(t), 5, "phone_ring", 0.9) for t in ("09:58", "10:08", "15:26")]
    words = [(at("08:00") + 600 * n, 4, "speech", 0.9) for n in range(6)]
    coughs = [(at("11:00") + second, 5, "coughing", 0.9) for second in (0, 30)]
    write_day(tmp_path / "logs", DAY, [*rings, *words, *coughs])
    rows = rows_of(page_of(tmp_path / "logs", tmp_path))
    assert rows["Coughing"] == ["0", "2", "0", "11:00 twice", "under 1 min"]
    assert rows["Telephone ringing"] == ["0", "3", "0", "09:58, 10:08, 15:26", "under 1 min"]
    assert rows["Talking"] == ["0", "6", "0", "first 08:00, last 08:50", "under 1 min"]
    assert list(rows)[1:4] == ["Coughing", "Telephone ringing", "Talking"], (
        "what matters comes first"
    )


def test_a_hidden_class_is_not_among_those_that_a_model_does_not_know(tmp_path):
    write_day(tmp_path / "logs", DAY, [(at("10:00"), 5, "crying", 0.9)])
    write_hidden_classes(tmp_path / "logs", ["crying"])
    page = page_of(tmp_path / "logs", tmp_path)
    assert "says nothing about them: toilet flush, shower and water tap." in page
    assert "rying" not in page


def test_the_picture_has_a_title_and_tells_in_words_what_it_shows(tmp_path):
    coughs = [(at("10:00"), 5, "coughing", 0.9), (at("15:00"), 5, "coughing", 0.9)]
    write_day(tmp_path / "logs", DAY, coughs, hours=[*range(18), 20])
    page = page_of(tmp_path / "logs", tmp_path)
    assert page.count('role="img"') == 1
    assert 'aria-label="The sounds of Sunday, 1 March 2026"' in page
    assert (
        ">Coughing 2. There are logs only from 00:00 to 21:00. "
        "Not listening: 18:00 to 20:00.</desc>" in page
    )
    assert page.count('aria-hidden="true"') == 1, "its words and strips are not read one by one"


@pytest.mark.parametrize(
    ("hours", "text"),
    [
        ([18, 19], "Only 18:00 to 21:00 is shown."),
        ([0], "Only 00:00 to 03:00 is shown."),
        ([23], "Only 21:00 to 24:00 is shown."),
        ([8, 15], "Only 08:00 to 16:00 is shown."),
        (range(8, 17), "From 22:00 of the evening before to midnight."),
        ([3, 22], "From 22:00 of the evening before to midnight."),
    ],
)
def test_the_picture_covers_the_hours_of_a_recording_of_at_most_a_third_of_the_day(
    tmp_path, hours, text
):
    write_day(tmp_path / "logs", DAY, hours=hours)
    assert text in text_of(page_of(tmp_path / "logs", tmp_path))


@pytest.mark.parametrize(("hours", "stripes"), [([18, 19], 0), (range(24), 1)])
def test_sounds_two_minutes_apart_are_two_marks_on_an_evening_and_stripes_on_a_day(
    tmp_path, hours, stripes
):
    coughs = [(at(time), 1, "coughing", 0.9) for time in ("18:40", "18:42")]
    write_day(tmp_path / "logs", DAY, coughs, hours=hours)
    page = page_of(tmp_path / "logs", tmp_path)
    assert page.count('class="many"') == stripes
    assert len(re.findall(r'class="short" d="M\d+ 0v1M\d+ 0v1"', page)) == 1


def test_the_png_of_an_evening_is_as_wide_as_its_hours(tmp_path):
    events = [(at("18:00"), HOUR, "objects_activity", 1.0), (at("20:00"), HOUR, "crying", 1.0)]
    write_day(tmp_path / "logs", DAY, events, hours=[18, 19, 20])
    page_of(tmp_path / "logs", tmp_path, draw=save_timelines)
    with Image.open(next(tmp_path.glob("*.png"))) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    lefts = {
        name: np.nonzero((abs(pixels - colour(name)) <= 3).all(axis=2).sum(axis=0) > 10)[0]
        for name in ("objects_activity", "crying")
    }
    for columns in lefts.values():
        assert 360 < np.ptp(columns) < 520, "an hour of three"
    assert lefts["crying"][0] - lefts["objects_activity"][0] == pytest.approx(
        2 * np.ptp(lefts["objects_activity"]), rel=0.02
    )


def test_a_page_of_a_restless_week_is_small(tmp_path):
    names = [name for name in GENERAL if name != "silence"]
    steps = range(0, 24 * HOUR, 30)
    restless = [(float(t), 12, names[t // 30 % len(names)], 0.9) for t in steps]
    for ago in range(7):
        write_day(tmp_path / "logs", DAY - timedelta(days=ago), restless)
    assert len(page_of(tmp_path / "logs", tmp_path)) < 100_000
    week = page_of(tmp_path / "logs", tmp_path, first=DAY - timedelta(days=6), days=7)
    assert len(week) < 200_000


class Outline(HTMLParser):
    """Tags that are opened and closed, and what a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.stack, self.fetched, self.scripts, self.headings = [], [], 0, []

    def handle_starttag(self, tag, attrs):
        if tag not in {"meta", "img", "br"}:
            self.stack.append(tag)
        self.scripts += tag == "script"
        wanted = [value for name, value in attrs if name in {"src", "href"}]
        self.fetched += [value for value in wanted if not value.startswith("data:")]

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        if self.stack[-1:] == ["h2"]:
            self.headings.append(data)


@pytest.fixture(scope="module")
def flat(tmp_path_factory) -> Path:
    """Nine days of a flat with two microphones; the last has a bad night and a broken one."""
    root = tmp_path_factory.mktemp("flat")
    write_life(root, DAY - timedelta(days=9), 9)
    coughs = [(at("01:00") + 300 * n, 2.0, "coughing", 0.9) for n in range(40)]
    write_day(
        root,
        DAY,
        [*coughs, (at("12:00"), 900, "speech", 0.9)],
        node="flat",
        microphone="living_room",
        gaps=[(at("14:10"), 3000, "the microphone went silent")],
        health=[(at("14:10"), 2, "the model is gone"), (at("14:40"), 0, "listening")],
    )
    about = {"node": "bathroom", "microphone": "bathroom", "classes": BATHROOM}
    flush = [(at("02:00"), 12, "flushing_water", 0.9), (at("07:30"), 300, "shower", 1.0)]
    write_day(root, DAY, flush, hours=range(14), **about)
    return root


@pytest.fixture(scope="module")
def flat_page(flat, tmp_path_factory) -> str:
    return page_of(flat, tmp_path_factory.mktemp("page"))


def test_a_page_needs_nothing_but_itself(flat_page):
    outline = Outline()
    outline.feed(flat_page)
    assert outline.stack == []
    assert outline.scripts == 0
    assert outline.fetched == []
    assert "url(" not in flat_page
    assert "@import" not in flat_page
    assert outline.headings == [
        "What was heard",
        "Quiet and activity",
        "For the interRAI Home Care assessment",
        "How to read this",
        "For whoever set this up",
    ]


def test_a_page_says_what_was_not_as_usual_and_what_was_not_heard(flat_page):
    text = text_of(flat_page)
    assert "Sunday, 1 March 2026" in text
    assert re.search(
        r"Coughing 40 more often usually \d+ \(\d+ to \d+\) 0 .* first 01:00, last 04:15", text
    )
    assert "How unusual the day was cannot be said yet: that takes 14 days in the four" in text
    assert text.count("Not listening: 50 min (3 %)") == 1, "it is missing once"
    assert "The microphone went silent: 50 min, once (14:10 to 15:00)" in text
    assert "The microphone bathroom was not listening for 10 h 00 min" in text
    assert "The box was off" not in text, "the gap says why"
    assert "living room: the model is gone: 30 min, once (14:10 to 14:40)" in text
    assert re.search(r"Toilet flush 1 usually .* 02:00 under 1 min", text)
    assert re.search(r"Shower .* 07:30 5 min", text)
    assert "diagnosis" in text


def test_a_class_is_only_compared_on_days_on_which_it_would_have_been_heard(flat, flat_page):
    shelf = find_home_logs([flat])
    data = read_home(shelf, "live", 0, day_span(DAY, UTC))
    day = day_of(metrics_of_home(data), DAY, UTC)
    assert day.comparable("coughing")
    assert not day.comparable("shower"), "the bathroom was heard for 14 hours"
    assert "water taps less often" not in text_of(flat_page)
    part = "Toilet flush, shower and water tap could be heard for 62 % of the time only."
    assert part in text_of(flat_page)


def test_without_a_week_to_compare_with_the_page_says_so(tmp_path):
    write_day(tmp_path / "logs", DAY - timedelta(days=1))
    write_day(tmp_path / "logs", DAY)
    page = page_of(tmp_path / "logs", tmp_path)
    assert "Not compared with other days: of the 28 days before, only 1 day could be used" in page
    assert "Usually" not in page
    assert "It was quiet." in page
    assert "Sunday was quiet." in page


def test_a_week_has_its_seven_days_and_their_total(flat, tmp_path):
    page = page_of(flat, tmp_path, DAY - timedelta(days=6), 7)
    text = text_of(page)
    assert "Week 9, 23 February to 1 March 2026" in text
    assert page.count('<th scope="col">Wed 25</th>') == 5
    assert page.count('<th scope="col">All</th>') == 5
    data = read_home(find_home_logs([flat]), "live", 0, day_span(DAY, UTC))
    home = metrics_of_home(data)
    days = [day_of(home, DAY - timedelta(days=n), UTC) for n in range(7)]
    total = sum((day.count("shower") for day in days), Count())
    assert rows_of(page)["Shower"][-1] == total.show(total.middle)


def test_a_week_of_one_logged_day_has_one_table_of_sounds_without_the_day(tmp_path):
    talking = [(at("12:00"), 90, "speech", 0.9)]
    write_day(tmp_path / "logs", DAY, [*talking, (at("14:00"), 2, "coughing", 0.9)])
    page = page_of(tmp_path / "logs", tmp_path, DAY - timedelta(days=6), 7)
    rows = rows_of(page)
    assert rows["Sound"] == ["How often", "How long"]
    assert "Listened" not in rows, "the summary says how much of the week"
    assert (rows["Talking"], rows["Coughing"]) == (["1", "2 min"], ["1", "under 1 min"])
    assert page.count('scope="col">Sun 1<') == 1, "of quiet and activity, with the night"


def test_sounds_of_less_than_a_minute_a_day_have_no_row_of_lengths_in_a_week(tmp_path):
    for ago in (0, 1):
        day = DAY - timedelta(days=ago)
        events = [(at("12:00"), 90, "speech", 0.9), (at("14:00"), 2 + ago, "coughing", 0.9)]
        write_day(tmp_path / "logs", day, events)
    page = page_of(tmp_path / "logs", tmp_path, DAY - timedelta(days=6), 7)
    often, _, long = page.partition("<h2>How long it was heard</h2>")
    long = long.partition("<h2>")[0]
    assert "Listened" in often, "once"
    assert "Listened" not in long
    assert "Coughing" not in long
    assert "<p>Under a minute a day: coughing.</p>" in long
    assert rows_of(long)["Talking"] == ["2 min", "2 min", "3 min"]


def test_the_same_logs_give_the_same_bytes(flat, flat_page, tmp_path):
    assert page_of(flat, tmp_path) == flat_page  # the picture is in it


def test_names_from_a_log_cannot_become_markup(tmp_path):
    gap = [(at("10:00"), 600, '<script>alert("x")</script> & more')]
    health = [(at("11:00"), 2, "<img src=http://x.example/y>"), (at("11:05"), 0, "")]
    write_day(tmp_path / "logs", DAY, gaps=gap, health=health)
    page = page_of(tmp_path / "logs", tmp_path)
    outline = Outline()
    outline.feed(page)
    assert (outline.scripts, outline.fetched) == (0, [])
    assert "&lt;script&gt;" in page
    assert "&lt;/script&gt; &amp; more" in page


def test_the_picture_draws_half_as_high_what_is_not_sure_and_pale_what_is_beside_a_television(
    tmp_path,
):
    talking = [(at("20:00") + 60 * n, 55, "speech", 0.9) for n in range(120)]
    events = [(at("06:00"), HOUR, "crying", 1.0), (at("12:00"), HOUR, "yelling", 0.5), *talking]
    write_day(tmp_path / "logs", DAY, events)
    page_of(tmp_path / "logs", tmp_path, draw=save_timelines)
    with Image.open(next(tmp_path.glob("*.png"))) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    found = {
        name: (abs(pixels[:, 150:] - colour(name)) <= 3).all(axis=2).sum(axis=1) > 20
        for name in ("crying", "yelling", "speech")
    }
    high, low, pale = (int(rows.sum()) for rows in found.values())
    assert low == pytest.approx(high / 2, abs=2)
    assert not pale


def test_the_picture_has_the_colours_of_the_classes_where_they_were_heard(tmp_path):
    events = [(at("06:00"), HOUR, "objects_activity", 1.0), (at("18:00"), HOUR, "crying", 1.0)]
    write_day(tmp_path / "logs", DAY, events, gaps=[(at("12:00"), HOUR, "gone")])
    page_of(tmp_path / "logs", tmp_path, draw=save_timelines)
    with Image.open(next(tmp_path.glob("*.png"))) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    places = {}
    for name in ("objects_activity", "crying"):
        rows, columns = np.nonzero((abs(pixels - colour(name)) <= 3).all(axis=2))
        assert len(rows) > 500
        places[name] = np.median(rows), np.median(columns)
    assert places["crying"][0] < places["objects_activity"][0], (
        "a line for each, the most important first"
    )
    hour = (places["crying"][1] - places["objects_activity"][1]) / 12
    assert 45 < hour < 65, "twelve hours of a day that is as wide as the page"


# The command


def test_the_command_makes_a_page_of_the_last_whole_day(hearthlog, tmp_path):
    write_day(tmp_path / "logs", DAY - timedelta(days=1), timezone="Europe/Vienna")
    write_day(tmp_path / "logs", DAY, timezone="Europe/Vienna")
    done = hearthlog("report", tmp_path / "logs", "-o", tmp_path / "day.html")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == [str(tmp_path / "day.html"), str(tmp_path / "day.png")]
    page = (tmp_path / "day.html").read_text()
    assert "Sunday, 1 March 2026" in page
    assert "Europe/Vienna" in page
    alone = hearthlog("report", tmp_path / "logs", "--no-picture", "-o", tmp_path / "page.html")
    assert alone.stdout.split() == [str(tmp_path / "page.html")]
    assert (tmp_path / "page.html").read_text() == page
    again = hearthlog("report", tmp_path / "logs", "-o", tmp_path / "day.html")
    assert again.returncode == 1
    assert "exists already" in again.stderr
    assert (tmp_path / "day.html").read_text() == page
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "day.html",
        "day.png",
        "logs",
        "page.html",
    ]


def test_a_damaged_log_is_not_heard_and_the_command_says_so(hearthlog, tmp_path):
    logs = write_day(tmp_path / "logs", DAY)
    logs[10].write_bytes(logs[10].read_bytes()[:40] + b"\xff" * 900)
    done = hearthlog("report", tmp_path / "logs", "--day", DAY, "-o", tmp_path / "day.html")
    assert done.returncode == 3
    assert logs[10].name in done.stderr
    text = text_of((tmp_path / "day.html").read_text())
    assert "Not listening: 1 h 00 min (4 %)." in text
    assert "The box was off then, or its logs are not here." in text
    assert "1 log could not be read, or only in part." in text


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["--day", "2026-04-01"], 1, "no logs of 2026-04-01 .* there are 2026-03-01$"),
        (["--week", "2026-W20"], 1, "no logs of 2026-05-11 to 2026-05-17"),
        (["--day", "someday"], 2, "--day someday: not a day such as 2026-03-01, today or yest"),
        (["--day", "yesterday"], 1, r"no logs of \d{4}-\d\d-\d\d .* there are 2026-03-01$"),
        (["--week", "9999-W52"], 2, "--week 9999-W52: not a week"),
        (["--day", "2026-03-01", "--week", "2026-W09"], 2, "exclude each other"),
        (["--labels", "pub-7"], 1, "no labelling 'pub-7' beside these logs; there is live"),
        (["--timezone", "Nowhere"], 1, "'Nowhere' is no time zone: use a name such as"),
        (["-o", "day.pdf"], 2, "a page is named"),
    ],
)
def test_a_wrong_wish_gets_one_line(hearthlog, tmp_path, arguments, status, line):
    write_day(tmp_path / "logs", DAY, hours=[9])
    done = hearthlog("report", tmp_path / "logs", *arguments)
    assert done.returncode == status
    assert re.search(line, done.stderr.strip())
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_labels_as_others_write_them_are_called_by_the_nearest_name(hearthlog, tmp_path):
    odd = [(at("09:10"), 30.0, "Türklingel", 0.9), (at("09:20"), 30.0, "=cmd|'/c calc'!A1", 0.9)]
    write_day(tmp_path / "logs", DAY, odd, hours=[9])
    output = tmp_path / "day.html"
    done = hearthlog("report", tmp_path / "logs", "--day", DAY, "-o", output)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "is called other here, and 1 more so: no name of a class" in done.stderr
    assert "Tuerklingel" in text_of(output.read_text())
    assert "cmd" not in text_of(output.read_text())


def test_logs_without_labels_or_without_anything_say_what_to_do(hearthlog, tmp_path):
    write_day(tmp_path / "mute", DAY, hours=[9], gaps=[(at("09:00"), HOUR, "gone")])
    done = hearthlog("report", tmp_path / "mute")
    assert done.returncode == 1
    assert "no labels of live in the logs of that time: `hearthlog relabel" in done.stderr
    (tmp_path / "empty").mkdir()
    done = hearthlog("report", tmp_path / "empty")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "no log (*.mcap) in this folder" in done.stderr


def test_a_log_that_is_there_twice_is_refused(tmp_path):
    log, *_ = write_day(tmp_path / "a", DAY, hours=[9])
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / log.name).write_bytes(log.read_bytes())
    with pytest.raises(Exception, match="overlap; is a log there twice"):
        look(tmp_path)


def test_the_headline_tells_night_day_and_evening_apart_with_the_times_of_rare_sounds(tmp_path):
    times = "02:10 06:13 12:00 22:30 23:15"
    write_day(tmp_path, DAY, [(at(time), 2, "coughing", 0.9) for time in times.split()])
    page = page_of(tmp_path, tmp_path)
    assert text_of(page).count("Coughing 3 times (2 at night); twice after 22:00 (22:30, 23:15).")


# What needs a look

SCREAM = 4.0, "music", 0.33, {"coughing": 0.13, "yelling": 0.12}, 48.0
PLATES = 5.0, "objects_activity", 0.4, {"coughing": 0.05, "yelling": 0.05}, 20.0
COUGH = 1.0, "objects_activity", 0.4, {"coughing": 0.33}, 19.0


def needing_look_in(page):
    alert = page.partition('<section class="alert">')[2].partition("</section>")[0]
    return [line for line in re.findall(r"<p[^>]*>(.*?)</p>", alert) if "Needs a look" in line]


@pytest.mark.parametrize(
    ("sound", "line"),
    [
        (
            SCREAM,
            (
                "Needs a look, 14:02 and 15:05: loud, and the model is not sure; it might be "
                "coughing or shouting."
            ),
        ),
        (COUGH, "Needs a look, 14:02 and 15:05: the model is not sure; it might be coughing."),
        (
            (4.0, "music", 0.33, {}, 48.0),
            "Needs a look, 14:02 and 15:05: loud, and the model is not sure; it might be music.",
        ),
        (
            (4.0, "unknown", 0.3, {}, 40.0),
            "Needs a look, 14:02 and 15:05: loud, and the model is not sure.",
        ),
        (PLATES, None),
        ((4.0, "music", 0.9, {"yelling": 0.05}, 48.0), None),  # loud, and the model is sure
    ],
)
def test_a_loud_or_worrying_sound_that_the_model_is_unsure_of_needs_a_look(tmp_path, sound, line):
    write_day(tmp_path, DAY, doubts=[(at(time), *sound) for time in ("14:02", "15:05")])
    lines = needing_look_in(page_of(tmp_path, tmp_path))
    assert lines == ([] if line is None else [line])


def test_what_would_be_part_of_a_cough_that_is_counted_needs_no_look_of_its_own(tmp_path):
    coughs = [(at("14:02:08"), 2.0, "coughing", 0.9)]
    write_day(tmp_path, DAY, coughs, doubts=[(at(time), *COUGH) for time in ("14:02", "15:05")])
    lines = needing_look_in(page_of(tmp_path, tmp_path))
    assert lines == ["Needs a look, 15:05: the model is not sure; it might be coughing."]


def test_doubtful_sounds_of_one_time_are_one_and_only_the_loudest_five_times_need_a_look(tmp_path):
    near = [(at("08:00") + 60 * number, *SCREAM) for number in range(4)]
    later = [(at("09:00") + 1200 * n, *SCREAM[:4], 31.0 + n) for n in range(10)]
    write_day(tmp_path, DAY, doubts=[*near, *later])
    (line,) = needing_look_in(page_of(tmp_path, tmp_path))
    assert line.startswith("Needs a look, 08:00 to 08:03, 11:00, 11:20, 11:40 and 12:00: loud")


def test_neither_a_television_nor_what_a_person_reviewed_or_hides_needs_a_look(tmp_path):
    talking = [(at("13:00") + 60 * number, 8, "speech", 0.9) for number in range(60)]
    doubts = [(at(time), *SCREAM) for time in ("13:30", "16:00", "17:00")]
    write_day(tmp_path, DAY, talking, doubts=doubts)
    log = next(log for log in find_logs(tmp_path) if "T16" in log.name)
    start = midnight(DAY) + round(at("16:00") * 1e9)
    write_marks(log, [Mark("mic", start, start + 4 * 10**9, "yelling")])
    (line,) = needing_look_in(page_of(tmp_path, tmp_path))
    assert line.startswith("Needs a look, 17:00: loud")
    write_hidden_classes(tmp_path, frozenset({"music"}))
    other = tmp_path / "other"
    other.mkdir()
    assert not needing_look_in(page_of(tmp_path, other))
