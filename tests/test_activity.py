"""One day with everything in it has the same numbers on every surface."""

import json
from datetime import date, timedelta
from functools import partial
from threading import Event
from time import sleep
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import GENERAL, at, midnight, write_day
from livehome import rule
from log_fixtures import run

from hearthlog.analyzer.activity.checked_minutes import read_checked_minutes
from hearthlog.analyzer.activity.daily_metrics import (
    day_of,
    home_sound,
    metrics_of_home,
)
from hearthlog.analyzer.activity.day_profile import COUNT, LENGTH, Profiles
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.home_data import read_home
from hearthlog.analyzer.activity.home_events import EventTotal
from hearthlog.analyzer.activity.segments import read_activity
from hearthlog.analyzer.bridge.alerts.evaluation import notifications
from hearthlog.analyzer.bridge.home_state import follow_home
from hearthlog.analyzer.bridge.output import OutputUpdate, Totals
from hearthlog.analyzer.bridge.page.day import HomeDay, picture_of
from hearthlog.analyzer.bridge.prometheus import HomeCollector
from hearthlog.analyzer.bridge.settings import RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import EVENING, MORNING, at_hour, day_span, today
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, single_span
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, read_marks, write_marks
from hearthlog.analyzer.promotion.paired_labels import reference_sounds
from hearthlog.analyzer.promotion.recent_time import recent_logs, spans_of
from hearthlog.analyzer.relabel.layer import layer_topics
from hearthlog.models.classes import IMPORTANT, ON_TELEVISION, SILENCE
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch

DAY, ZONE = date(2026, 3, 29), ZoneInfo("Europe/Vienna")  # an hour is missing in this night
SOUNDS = [name for name in GENERAL if name != SILENCE]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Three days: a cough over midnight, one at the missing hour, a television, a gap."""
    folder, rng = tmp_path_factory.mktemp("activity") / "logs", np.random.default_rng(8)
    for day in (DAY - timedelta(days=2), DAY - timedelta(days=1), DAY):
        television = [
            (at("17:00") + 12 * n + rng.uniform(0, 4), rng.uniform(1, 7), str(label), 0.7)
            for n, label in enumerate(rng.choice(SOUNDS, 400))
        ]
        events = [
            (second, rng.uniform(0.5, 3), "coughing", rng.uniform(0.4, 1))
            for second in (at("00:59:59"), at("01:00:05"), at("01:30"), at("05:10"), at("20:30"))
        ]
        events.append((at("07:00"), 900.0, "speech", 0.8))
        if day < DAY:
            events.append((at("22:59:57"), 5.0, "crying", 0.9))  # over midnight
        gaps = [(at("12:00"), 3000, "unplugged")]
        write_day(folder, day, [*events, *television], gaps=gaps, timezone="Europe/Vienna")
    return folder


def day_metrics(logs, labelling="live"):
    before = day_span(DAY - timedelta(days=1), ZONE)[0]
    data = read_home(find_home_logs([logs]), labelling, before, day_span(DAY, ZONE))
    return data, day_of(metrics_of_home(data), DAY, ZONE)


def reported(logs):
    """Of each sound: counts of the day and its night, and of the day those beside a television."""
    _, day = day_metrics(logs)
    counts = {}
    for name in SOUNDS:
        night = day.home.minutes.counted(name, day.home.events_in(name, day.night))
        counts[name] = day.count(name).labelled, len(night), day.uncounted_events(name)
    assert sum(neighbour for *_, neighbour in counts.values()) > 100
    return counts


@pytest.fixture(scope="module")
def followed(logs):
    """State of the bridge after it has read all logs."""
    start = today(day_span(DAY, ZONE)[1] - 1, ZONE).midnight - 12 * 3600 * NANOSECONDS
    home = RecorderAddress(logs, "home", ZONE)
    states = follow_home(home, start, stop := Event(), pytest.fail)
    state = next(state for state, _, _ in states if state.caught_up)
    stop.set()
    return state


def test_the_broker_and_the_figures_get_the_counts_of_the_report(logs, followed):
    (own,) = followed.microphones.values()
    # In the evening before 22:00 the last night is the one that ended in the morning.
    moment = today(at_hour(DAY, EVENING, ZONE) - 1, ZONE)
    counts = own.counts(moment)
    update = OutputUpdate(followed, [], [], moment, ZONE)
    metrics = {
        metric.name: {sample.labels["label"]: sample.value for sample in metric.samples}
        for metric in HomeCollector(update, RecorderAddress(logs, "home", ZONE), []).collect()
        if metric.name.startswith("hearthlog_events_")
    }
    assert {name: (day or 0, night or 0) for name, (day, night) in counts.items()} == {
        name: (of_day, of_night) for name, (of_day, of_night, _) in reported(logs).items()
    }
    for part, name in enumerate(("hearthlog_events_today", "hearthlog_events_night")):
        known = {label: own[part] for label, own in counts.items() if own[part] is not None}
        assert metrics[name] == known


def test_the_page_shows_the_counts_of_the_report(logs, followed):
    moment = today(at_hour(DAY, EVENING, ZONE) - 1, ZONE)
    (room,) = picture_of(HomeDay([*followed.microphones.values()], moment, ZONE))["rooms"]
    (own,) = followed.microphones.values()
    _, day = day_metrics(logs)
    for lane in room["lanes"]:
        name = lane["label"]
        later = [e for e in own.events(name, moment.now) if e.start < day_span(DAY, ZONE)[1]]
        _, of_night, _ = reported(logs)[name]
        waking = single_span(*(at_hour(DAY, hour, ZONE) for hour in (MORNING, EVENING)))
        of_day = day.home.minutes.between(waking).count(name, None).labelled
        assert [count or 0 for count in lane["counts"]] == [of_night, of_day], (name, later)


def test_totals_and_alerts_at_once_count_also_beside_a_television_but_no_talk_of_it(
    logs, followed, tmp_path
):
    start, end = day_span(DAY, ZONE)
    totals = Totals(BridgeState(tmp_path, "home", pytest.fail), start, pytest.fail)
    counted = {total.label: total.events for total in totals.count(followed, end)}
    hour = 3600 * NANOSECONDS
    recorded = read_activity(find_home_logs([logs]), "home", start - hour, end, pytest.fail)
    for name, (alone, _, neighbour) in reported(logs).items():
        of_day = alone + neighbour
        assert counted.get(name, 0) == of_day, name
        if name in ON_TELEVISION and name not in IMPORTANT:
            of_day = alone
        if of_day:
            hours = (end - start) // hour
            for count, rings in ((of_day - 1, True), (of_day, False)):
                one = rule("more_than", count=count, window=f"{hours}h", **{"class": name})
                rang, _ = notifications(one, recorded, end - NANOSECONDS, end, ZONE)
                assert bool(rang) == rings, (name, count)


def test_the_routine_counts_and_measures_what_the_report_does(logs):
    data, day = day_metrics(logs)
    profiles = Profiles(home_sound(data, day.home), ZONE, night_after=False)
    values = dict(zip(profiles.figures, profiles.of(DAY).values, strict=True))
    waking = at_hour(DAY, MORNING, ZONE), at_hour(DAY, EVENING, ZONE)
    for figure, value in values.items():
        if figure.what in SOUNDS and figure.kind == COUNT:
            start, end = waking if not figure.night else (day.night.starts[0], day.night.ends[0])
            starts = day.home.events[figure.what]
            inside = starts[(starts >= start) & (starts < end)]
            share = day.home.coverage
            listened = sum(
                max(min(b, end) - max(a, start), 0) for a, b in zip(*share, strict=True)
            ) / (end - start)
            counted = day.home.minutes.counted(figure.what, inside)
            assert value == pytest.approx(len(counted) / listened), figure
    assert {figure.kind for figure in values} >= {COUNT, LENGTH}


def test_two_microphones_are_counted_apart_by_the_bridge_and_joined_by_the_report(tmp_path, capfd):
    near = [(at(f"{hour:02}:10:00"), 2.0, "coughing", 0.9) for hour in range(3, 20)]
    far = [(at(f"{hour:02}:10:05"), 2.0, "coughing", 0.9) for hour in range(3, 9)]
    far += [(at(f"{hour:02}:40:00"), 2.0, "coughing", 0.9) for hour in range(10, 14)]
    own = {"microphone": "bath", "timezone": "Europe/Vienna", "others": {"kitchen": far}}
    write_day(tmp_path, DAY, near, **own)
    start, end = day_span(DAY, ZONE)
    states = follow_home(
        RecorderAddress(tmp_path, "home", ZONE), start, stop := Event(), pytest.fail
    )
    state = next(state for state, _, _ in states if state.caught_up)
    stop.set()
    totals = Totals(BridgeState(tmp_path / "state", "home", pytest.fail), start, pytest.fail)
    counted = {(one.microphone, one.label): one.events for one in totals.count(state, end)}
    assert counted == {("bath", "coughing"): 17, ("kitchen", "coughing"): 10}
    moment = today(at_hour(DAY, EVENING, ZONE) - 1, ZONE)
    rooms = picture_of(HomeDay([*state.microphones.values()], moment, ZONE))["rooms"]
    shown = {
        room["room"]: lane["count"]
        for room in rooms
        for lane in room["lanes"]
        if lane["label"] == "coughing"
    }
    assert shown == {"Bath": 17, "Kitchen": 10}
    together = {"coughing": {"counted": 21, "television": 0, "unsure": 0}}  # six were heard by both
    _, day = day_metrics(tmp_path)
    assert day.count("coughing").labelled == 21
    listed = json.loads(run(capfd, "events", tmp_path, "--day", DAY, "--json").stdout)
    assert listed["counts"] == together
    assert json.loads(run(capfd, "info", tmp_path, "--json").stdout)["day"]["counts"] == together


def test_the_contents_of_logs_name_the_counts_of_the_report(logs, capfd):
    found = json.loads(run(capfd, "info", logs, "--json").stdout)["day"]
    day = day_metrics(logs)[1].to_evening
    assert found["date"] == DAY.isoformat()
    assert found["counts"] == {
        name: {
            "counted": count.labelled,
            "television": day.uncounted_events(name),
            "unsure": count.unsure,
        }
        for name in day.home.classes
        if (count := day.count(name)) is not None and count.labelled + day.uncounted_events(name)
    }
    assert sum(map(sum, (each.values() for each in found["counts"].values()))) > 10
    assert found["counts"]["speech"]["counted"] == 0, "of a television"


def relabelled(logs, change):
    """Write a relabel layer beside each log, with other labels; return the layers."""
    layers = []
    for log in [path for path in find_logs(logs) if not is_layer(path)]:
        segments = read_columns([log])["/mic/segment"]
        fields = dict(segments.fields)
        fields["label"] = [change.get(name, name) for name in fields["label"]]
        topic = "/mic/relabel/new_2/segment"
        topics = [
            type(each)(topic, each.type) if each.name.endswith("/segment") else each
            for each in layer_topics("mic", "x", GENERAL)
        ]
        layer = log.with_name(f"{log.stem}.relabel-new-2.mcap")
        writer = LogWriter(layer, topics, {"version": "0", "node": "home"})
        writer.write_columns([TopicBatch(topic, segments.log_times, fields)])
        layers.append(writer.finish())
    return layers


def test_a_relabelling_has_the_counts_of_its_own_report_and_changes_no_other(logs, capfd):
    layers = relabelled(logs, {"yelling": "laughing"})
    try:
        for labelling in ("live", "new-2"):
            words = "events", logs, "--day", DAY, "--json", "--labels", labelling
            found = json.loads(run(capfd, *words).stdout)["counts"]
            day = day_metrics(logs, labelling)[1].with_night
            for name in SOUNDS:
                counts = found.get(name, {"counted": 0, "television": 0})
                count = day.count(name)
                assert counts["counted"] == (0 if count is None else count.labelled), name
                assert counts["television"] == day.uncounted_events(name), name
            assert ("yelling" in found) == (labelling == "live")
    finally:
        for layer in layers:
            layer.unlink()


def marks_of(log):
    """Give what a person would mark who agrees with every label of a log."""
    segments = read_columns([log])["/mic/segment"]
    ends = segments["header.stamp"] + segments["duration"]
    rows = zip(segments["header.stamp"].tolist(), ends.tolist(), segments["label"], strict=True)
    return [Mark("mic", start, end, str(label)) for start, end, label in rows]


def test_the_catalogue_a_comparison_and_an_evaluation_count_the_events_of_the_report(logs, capfd):
    hearthlog, (start, end) = partial(run, capfd), day_span(DAY, ZONE)

    def counted(labelling="live"):
        home = metrics_of_home(read_home(find_home_logs([logs]), labelling, 0, (start, end)))
        return {name: own for name, own in home.events.items() if name != SILENCE and len(own)}

    starts = counted()
    for name, (alone, _, neighbour) in reported(logs).items():
        own = starts.get(name, np.empty(0, np.int64))
        assert ((own >= start) & (own < end)).sum() == alone + neighbour, name
    events = {name: len(own) for name, own in starts.items()}
    listed = json.loads(hearthlog("catalog", logs, "--json").stdout)["labels"]
    (logs / "catalog.sqlite").unlink()
    assert {one["label"]: one["events"] for one in listed if one["label"] != SILENCE} == events
    assert sum(one["segments"] for one in listed) > sum(one["events"] for one in listed)
    layers = relabelled(logs, {"yelling": "laughing"})
    try:
        difference = json.loads(hearthlog("diff", logs, "live", "new-2", "--json").stdout)
        kinds, afterwards = difference["total"]["per_class"], counted("new-2")
        for name in SOUNDS:
            assert kinds[name]["events_a"] == events.get(name, 0), name
            assert kinds[name]["events_b"] == len(afterwards.get(name, ())), name
        days = difference["days"].values()
        assert sum(one["per_class"]["coughing"]["events_a"] for one in days) == events["coughing"]
    finally:
        for layer in layers:
            layer.unlink()
    marked = [path for path in find_logs(logs) if not is_layer(path)]
    layers = [write_marks(log, marks) for log in marked if (marks := marks_of(log))]
    try:
        words = "evaluate", "log", logs, "--reference", "review", "--json"
        found = json.loads(hearthlog(*words).stdout)["events"]
        assert found == {name: {"reference": k, "labelled": k} for name, k in events.items()}
    finally:
        for layer in layers:
            layer.unlink()


def test_the_gate_knows_the_sounds_of_the_events_that_the_accuracy_counts(logs):
    times = "01:29:40", "01:50", "05:09:40", "17:30", "20:29:40"
    drawn = [midnight(DAY) + int(at(time)) * NANOSECONDS for time in times]
    quiet, coughing = drawn[1:3]
    marks = [
        Mark("mic", quiet + n * NANOSECONDS, quiet + (n + 1) * NANOSECONDS, "crying")
        for n in (10, 15, 40)  # two of them are one event
    ]
    marks.append(Mark("mic", coughing, coughing + 30 * NANOSECONDS, "laughing"))
    layers = set()
    for start in drawn:
        span = ReviewedSpan("mic", start, start + MINUTE, made=1, chosen=RANDOM)
        entries = find_home_logs([logs]).between(start, start + MINUTE)
        (log,) = [entry.path for entry in entries if not is_layer(entry.path)]
        inside = [mark for mark in marks if start <= mark.start < start + MINUTE]
        layers.add(write_marks(log, inside, reviewed=[span]))
    try:
        home = find_home_logs([logs])
        losses: list[str] = []
        checked = read_checked_minutes(home, "live", *day_span(DAY, ZONE), losses)
        known = reference_sounds(recent_logs([logs]), losses)
        assert losses == []
        assert len(checked) == len(drawn)
        sounds = {}
        for sound in (sound for _, own in known for sound in own if sound.random):
            sounds.setdefault(sound.label, []).append((sound.start, sound.end))
        events = {name: len(spans_of(own, EVENT_PAUSE).starts) for name, own in sounds.items()}
        del events[SILENCE]
        counted = {name: int(own[2].sum()) for name, own in checked.events.items()}
        assert events == {name: count for name, count in counted.items() if count}
        assert events["crying"] == 2
        assert len(sounds["crying"]) == 3
        assert "coughing" in events
    finally:
        for layer in layers:
            layer.unlink()


def test_the_list_of_events_and_the_report_agree_before_and_after_a_review(
    logs, capfd, monkeypatch
):
    hearthlog = partial(run, capfd)

    def read_slowly(log):
        sleep(0.5)  # a slow disk: the first counts of the bridge wait for it
        return read_marks(log)

    monkeypatch.setattr("hearthlog.analyzer.bridge.corrections.read_marks", read_slowly)

    def listed(*words):
        span = "--start", f"{DAY}T00:00", "--end", f"{DAY + timedelta(days=1)}T00:00"
        result = hearthlog("events", logs, *span, "--json", *words)
        counts, none = json.loads(result.stdout)["counts"], dict.fromkeys(EventTotal._fields, 0)
        return {name: counts.get(name, none) for name in SOUNDS}

    def expected():
        _, day = day_metrics(logs)
        return {
            name: {
                "counted": day.count(name).labelled,
                "television": day.uncounted_events(name),
                "unsure": day.count(name).unsure,
            }
            for name in SOUNDS
        }

    def at_the_broker():
        address = RecorderAddress(logs, "home", ZONE)
        midnight_before = day_span(DAY - timedelta(days=1), ZONE)[0]
        states = follow_home(address, midnight_before, stop := Event(), pytest.fail)
        state = next(state for state, _, _ in states if state.caught_up)
        stop.set()
        moment = today(at_hour(DAY, EVENING, ZONE) - 1, ZONE)
        (own,) = state.microphones.values()
        counts = own.counts(moment, state.corrections)
        return {name: day or 0 for name, (day, _) in counts.items()}

    def counted(found):
        return {name: each["counted"] for name, each in found.items()}

    before = listed()
    assert before == expected()
    assert at_the_broker() == counted(before)
    start = midnight(DAY) + int(at("05:10")) * NANOSECONDS
    (log,) = [path for path in find_logs(logs) if not is_layer(path) and "20260329T05" in path.name]
    quiet = start + 1200 * NANOSECONDS
    marks = [
        Mark("mic", start, start + 5 * NANOSECONDS, "laughing"),
        Mark("mic", quiet, quiet + NANOSECONDS, "crying"),  # which no label names
    ]
    layer = write_marks(log, marks)
    try:
        after = listed()
        assert after == expected()
        assert at_the_broker() == counted(after)
        assert after["crying"]["counted"] == before["crying"]["counted"] + 1
        assert after["coughing"]["counted"] == before["coughing"]["counted"] - 1
        assert after["laughing"]["counted"] == before["laughing"]["counted"] + 1
    finally:
        layer.unlink()


def test_a_sound_that_a_person_marked_counts_beside_a_television_too(logs, capfd):
    words = "events", logs, "--day", DAY, "--json"
    before = json.loads(run(capfd, *words).stdout)["counts"]["crying"]
    start = midnight(DAY) + int(at("17:30")) * NANOSECONDS
    (log,) = [path for path in find_logs(logs) if not is_layer(path) and "20260329T17" in path.name]
    layer = write_marks(log, [Mark("mic", start, start + 2 * NANOSECONDS, "crying")])
    try:
        after = json.loads(run(capfd, *words).stdout)["counts"]["crying"]
        assert after["counted"] == before["counted"] + 1
        day = day_metrics(logs)[1].with_night
        count = day.count("crying")
        assert (
            after
            == EventTotal(count.labelled, day.uncounted_events("crying"), count.unsure)._asdict()
        )
    finally:
        layer.unlink()
