"""How right labels are in a home, by minutes drawn at random: what is read and promised."""

import re
from datetime import date, timedelta
from itertools import pairwise
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import HOUR, at, midnight, write_day
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run
from scipy.special import betaincinv

from hearthlog.analyzer.activity.checked_minutes import (
    UNMEASURED,
    ClassCheck,
    measured_sureness,
    read_checked_minutes,
    read_sureness,
)
from hearthlog.analyzer.activity.daily_metrics import day_of, metrics_of_home
from hearthlog.analyzer.activity.event_counts import (
    FEWEST,
    MINUTE,
    beta_quantile,
    checked_rates,
    events_of,
    strata_of,
    television_minutes,
)
from hearthlog.analyzer.activity.home_data import read_home
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.marks.marks import PERSON, QUEUE, RANDOM, Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.promotion.recent_time import reference
from hearthlog.analyzer.report.report import Period, make_report
from hearthlog.analyzer.review.lanes import class_precision
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.cli.info_summary import Accuracy

DAY = date(2026, 3, 1)
START = midnight(DAY)
UTC = ZoneInfo("UTC")
EVER = 0, 1 << 61


def log_at(logs: list[Path], second: float) -> Path:
    return logs[int(second // HOUR)]


def check(logs, second, marks=(), chosen=RANDOM, corrects="live"):
    """Go through the minute that begins at a second of the day."""
    begin = START + int(second) * NANOSECONDS
    span = ReviewedSpan("mic", begin, begin + MINUTE, "Ann", 1, corrects, chosen)
    made = [
        Mark("mic", begin + int(a * NANOSECONDS), begin + int(b * NANOSECONDS), label)
        for a, b, label in marks
    ]
    write_marks(log_at(logs, second), made, reviewed=[span])


def checked(root, labelling="live"):
    losses = []
    minutes = read_checked_minutes(find_home_logs([root]), labelling, *EVER, losses)
    assert losses == []
    return minutes


def test_a_checked_minute_has_what_is_right_wrong_and_missed(tmp_path):
    coughs = [(at(t), 2, "coughing", 0.9) for t in ("10:00:05", "10:00:40", "11:30:59")]
    logs = write_day(tmp_path, DAY, [*coughs, (at("10:00:20"), 3, "speech", 0.9)])
    check(logs, at("10:00"), [(40, 42, "objects_activity"), (50, 55, "crying")])
    check(logs, at("11:31"))  # the cough began in the minute before
    check(logs, at("12:00"), [(10, 12, "coughing")])
    check(logs, at("10:01"), chosen=QUEUE)
    check(logs, at("10:02"), corrects="other")
    minutes = checked(tmp_path)
    assert len(minutes) == 3
    assert minutes.check("coughing") == (2, 1, 2, 1, 1)
    assert minutes.check("speech") == (1, 1, 1, 0, 0)
    assert minutes.check("crying") == (0, 0, 1, 1, 0)
    assert minutes.check("objects_activity") == (0, 0, 1, 1, 0)
    assert minutes.check("music") == (0, 0, 0, 0, 0)
    assert minutes.sounding.tolist() == [True, True, False]
    assert len(checked(tmp_path, "other")) == 0


def test_what_outlasts_a_checked_minute_is_right_or_missed_by_the_part_in_it_alone(tmp_path):
    fridge = [(at("10:00:50"), 20, "objects_activity", 0.9), (at("10:05:03"), 5, "crying", 0.9)]
    earlier = (at("10:02:55"), 10, "music", 0.9)  # goes on in the minute that is checked
    logs = write_day(tmp_path, DAY, [*fridge, earlier])
    check(logs, at("10:00"), [(50, 60, "speech")])
    check(logs, at("10:04"), [(57, 60, "crying")])
    check(logs, at("10:03"), [(0, 5, "speech"), (20, 22, "music")])
    minutes = checked(tmp_path)
    assert minutes.check("objects_activity") == (1, 0, 0, 0, 0)
    assert minutes.check("speech") == (0, 0, 2, 2, 0)
    assert minutes.check("crying") == (0, 0, 1, 1, 1)
    assert minutes.check("music") == (0, 0, 1, 1, 0)


def test_a_mark_that_says_nothing_is_known_says_nothing(tmp_path):
    logs = write_day(tmp_path, DAY, [(at("10:00:05"), 2, "coughing", 0.9)])
    check(logs, at("10:00"), [(5, 7, "unknown")])
    assert checked(tmp_path).check("coughing") == (0, 0, 0, 0, 0)


def test_what_nobody_could_tell_makes_nothing_beside_it_right_or_found(tmp_path):
    long = [(at("10:00:05"), 20, "coughing", 0.9), (at("12:00:20"), 10, "coughing", 0.9)]
    logs = write_day(tmp_path, DAY, long)
    check(logs, at("10:00"), [(5, 20, "music"), (20, 25, "unknown")])
    assert checked(tmp_path).check("coughing") == (1, 0, 0, 0, 0)
    check(logs, at("12:00"), [(5, 15, "coughing"), (20, 30, "unknown")])
    assert checked(tmp_path).check("coughing") == (1, 0, 1, 1, 0)


def _runs(labels, name, pause):
    """Return first and last second of the runs of a label with at most so much between them."""
    seconds = np.flatnonzero(labels == name)
    parts = np.split(seconds, np.flatnonzero(np.diff(seconds) > pause + 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts if len(part)]


def _begun(minutes, events, others, untold):
    """Count the events that begin in minutes, and those with a part in it that others have too."""
    begun = hit = 0
    there = np.zeros(len(untold), bool)
    for first, last in others:
        there[first : last + 1] = True
    for begin, inside in minutes.items():
        for first, last in events:
            end = min(last, begin + 59)
            if first in inside and not untold[first : end + 1].all():
                begun += 1
                hit += (there & ~untold)[first : end + 1].any()
    return begun, hit


def test_counts_are_those_of_a_truth_that_is_counted_second_by_second(tmp_path):
    rng = np.random.default_rng(4)
    names, day = ("coughing", "shower", "tap_water"), 6 * HOUR
    truth, labelled = (np.full(day, "silence", object) for _ in range(2))
    for begin in range(10, day - 60, 45):
        for labels in (truth, labelled):
            length, late = rng.choice([1, 4, 30]), int(rng.integers(0, 6))
            labels[begin + late : begin + late + length] = rng.choice(names)
    edges = [0, *(np.flatnonzero(labelled[1:] != labelled[:-1]) + 1).tolist(), day]
    events = [(a, b - a, labelled[a], 0.9) for a, b in pairwise(edges) if labelled[a] != "silence"]
    logs = write_day(tmp_path, DAY, events, hours=range(6))

    known, untold, minutes = labelled.copy(), np.zeros(day, bool), {}
    drawn = [*(60 * rng.choice(np.arange(30), 12, replace=False)), HOUR - 30, 3 * HOUR - 20]
    for made, begin in enumerate(map(int, drawn), 1):
        minutes[begin] = np.arange(begin, begin + 60)
        known[minutes[begin]] = truth[minutes[begin]]
        for log, part in enumerate(np.split(minutes[begin], [HOUR - begin % HOUR])):
            if len(part):  # a minute may be cut where a log ends
                a, b = (START + int(edge) * NANOSECONDS for edge in (part[0], part[-1] + 1))
                wrong = [second for second in part if truth[second] != labelled[second]]
                doubt = set(part[:7]) if made % 3 == 0 else set()
                untold[sorted(doubt)] = True
                marks = [
                    Mark("mic", START + s * NANOSECONDS, START + (s + 1) * NANOSECONDS, label)
                    for s in map(int, sorted({*wrong, *doubt}))
                    for label in ["unknown" if s in doubt else truth[s]]
                ]
                seen = ReviewedSpan("mic", a, b, "Ann", made, chosen=RANDOM)
                write_marks(logs[begin // HOUR + log], marks, reviewed=[seen])
    known[untold] = labelled[untold]

    for name in names:
        output, true = (_runs(labels, name, 10) for labels in (labelled, known))
        found, right = _begun(minutes, output, true, untold)
        there, reported = _begun(minutes, true, output, untold)
        assert checked(tmp_path).check(name)[:4] == (found, right, there, there - reported)
        assert min(right, found - right, there - reported) > 0, "something to count"
    assert len(checked(tmp_path)) == len(drawn)
    sounds = [s for i, log in enumerate(logs) for s in reference(log, logs[i + 1 :])]
    parts = [part for m in minutes.values() for part in np.split(m, [HOUR - int(m[0]) % HOUR])]
    true = np.where(untold, "unknown", known)
    for name in ("silence", *names):
        amount = sum(len(_runs(true[part], name, 0)) for part in parts)
        assert sum(sound.random and sound.label == name for sound in sounds) == amount


def test_a_span_that_nobody_can_tell_was_neither_right_nor_wrong(tmp_path):
    logs = write_day(tmp_path, DAY, [(at("10:00:05"), 50, "coughing", 0.9)])
    check(logs, at("10:00"), [(5, 55, "unknown")], chosen=QUEUE)
    assert "review queue" not in "".join(Accuracy(find_home_logs([tmp_path])).lines())
    check(logs, at("11:00"), [(5, 15, "speech")], chosen=QUEUE)
    assert "of 1 span of the review queue" in "".join(Accuracy(find_home_logs([tmp_path])).lines())


def test_a_damaged_layer_is_a_loss_and_the_other_minutes_count(tmp_path):
    logs = write_day(tmp_path, DAY, [(at("10:00:05"), 2, "coughing", 0.9)])
    check(logs, at("10:00"))
    check(logs, at("12:00"))
    next(tmp_path.rglob("*T120000Z.review.mcap")).write_bytes(b"no log")
    losses: list[str] = []
    minutes = read_checked_minutes(find_home_logs([tmp_path]), "live", *EVER, losses)
    assert (len(minutes), len(losses)) == (1, 1)
    assert "T120000Z.review.mcap" in losses[0]


def test_a_review_counts_what_was_right_in_the_four_weeks_before_and_after(tmp_path):
    for day in (DAY, DAY + timedelta(days=20), DAY + timedelta(days=70)):
        write_day(tmp_path, day, [(at("10:00:05"), 2, "coughing", 0.9)], hours=[10])
    first, _, far = find_logs(tmp_path)
    ten = START + at("10:00") * NANOSECONDS
    for log, days in ((first, 0), (far, 70)):
        begin = ten + days * 1440 * MINUTE
        write_marks(log, [], reviewed=[ReviewedSpan("mic", begin, begin + MINUTE, chosen=RANDOM)])

    (other,) = write_day(
        tmp_path, DAY, [(at("10:00:05"), 2, "coughing", 0.9)], hours=[10], node="b", microphone="b"
    )
    seen = ReviewedSpan("b", ten, ten + MINUTE, chosen=RANDOM)
    write_marks(other, [Mark("b", ten, ten + MINUTE, "speech")], reviewed=[seen])

    def counted(days):
        home, day = find_home_logs([tmp_path]), DAY + timedelta(days=days)
        return class_precision(read_timeline([tmp_path], *day_span(day, UTC)), home)

    wrong = {("b", "Coughing"): (1, 0, 0, 0, 0)}
    assert counted(20) == {("mic", "Coughing"): (1, 1, 1, 0, 0)}
    assert counted(0) == counted(20) | wrong
    write_marks(first, [Mark("mic", ten, ten + MINUTE, "speech")])
    assert counted(20) == {("mic", "Coughing"): (1, 0, 0, 0, 0)}
    assert counted(70) == {("mic", "Coughing"): (1, 1, 1, 0, 0)}


def test_fewer_than_five_minutes_promise_nothing():
    few = np.ones(FEWEST - 1, np.int64)
    assert checked_rates(few, few, few > 0, 1.0) is None


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=FEWEST, max_size=40))
def test_a_range_is_in_order_the_same_each_time_and_grows_with_what_is_counted(minutes):
    output, true = np.array(minutes).T
    loud = output > 0
    rates = checked_rates(output, true, loud, 0.3)
    again = checked_rates(output, true, loud, 0.3)
    strata = strata_of(np.tile(output, 3), np.tile(loud, 3))
    low, high = rates.range_of(strata)
    assert 0 <= low <= high
    assert again.range_of(strata) == (low, high)
    twice = rates.range_of(strata.combined_with(strata))
    assert twice[1] >= high
    assert twice[0] >= low


def test_a_range_of_a_labelling_that_is_half_right_lies_around_the_half():
    rng = np.random.default_rng(1)
    output = rng.poisson(0.4, 400)
    true = rng.binomial(output, 0.5)
    rates = checked_rates(output, true, output > 0, 0.5)
    low, high = rates.range_of(strata_of(output, output > 0))
    assert low < true.sum() < high
    assert high - low < output.sum() / 2


def test_a_class_that_is_never_labelled_may_have_been_missed_and_one_always_wrong_be_nothing():
    output, none = np.tile([0, 1], 15), np.zeros(30, np.int64)
    strata = strata_of(np.tile(output, 40), np.tile(output, 40) > 0)
    assert checked_rates(output, none, output > 0, 0.1).range_of(strata)[0] == 0
    assert checked_rates(none, none, output > 0, 0.1).range_of(strata)[1] > 0
    few = checked_rates(output[:5], none[:5], output[:5] > 0, 0.1)
    assert few.range_of(strata_of(np.tile(output, 9999), np.tile(output, 9999) > 0))[0] == 0


def test_segments_ten_seconds_apart_are_one_event():
    starts = np.array([0, 11, 23], np.int64) * NANOSECONDS
    coughs = Labelling(starts, starts + NANOSECONDS, np.full(3, "coughing", object))
    assert (events_of(coughs, "coughing").starts // NANOSECONDS).tolist() == [0, 23]


@pytest.mark.parametrize("chance", [0.9, 0.3])
def test_nine_ranges_of_ten_hold_where_minutes_are_drawn_from_other_days(chance):
    rng = np.random.default_rng(2)
    held = []
    for _ in range(60):
        loud = rng.random(1440) < 0.2
        true = np.where(loud, rng.poisson(0.2, 1440), rng.poisson(0.001, 1440))
        output = rng.binomial(true, chance) + np.where(loud, rng.poisson(0.1, 1440), 0)
        loud |= output > 0
        other, day = slice(0, 720), slice(720, 1440)
        rows = np.concatenate(
            [
                rng.choice(np.flatnonzero(loud[other]), 9, replace=False),
                rng.choice(np.flatnonzero(~loud[other]), 3, replace=False),
            ]
        )
        rates = checked_rates(output[rows], true[rows], loud[rows], 0.5)
        low, high = rates.range_of(strata_of(output[day], loud[day]))
        held.append(low <= true[day].sum() <= high)
    assert np.mean(held) >= 0.85


def sounds(name, seconds, every):
    """Label an hour, in whose minutes 10 to 25 a sound begins again and again."""
    starts = START + np.arange(10 * 60, 25 * 60, every) * NANOSECONDS
    pauses = starts + seconds * NANOSECONDS
    labels = np.array([name, "silence"] * len(starts), object)
    edges = np.append(np.stack([starts, pauses], 1).ravel(), START + 60 * MINUTE)
    return Labelling(edges[:-1], edges[1:], labels)


def television(labels):
    return television_minutes(labels, START + np.arange(61) * MINUTE)


@pytest.mark.parametrize("name", ["speech", "objects_activity", "laughing"])
def test_a_television_is_long_sound_that_changes_whatever_it_is_called(name):
    minutes = television(sounds(name, 5, 10))
    assert minutes[10:25].all()
    assert not minutes[40:].any()


@pytest.mark.parametrize(
    ("name", "seconds", "every"),
    [("crying", 5, 10), ("yelling", 5, 10), ("shower", 890, 900), ("speech", 1, 120)],
)
def test_long_crying_or_shouting_or_a_shower_or_a_few_words_are_no_television(name, seconds, every):
    assert not television(sounds(name, seconds, every)).any()


@pytest.mark.parametrize("name", ["speech", "music", "laughing"])
def test_a_sparse_television_is_known_by_its_voices(name):
    minutes = television(sounds(name, 3, 50))
    assert minutes[13:22].all()
    assert not minutes[30:].any()
    assert not television(sounds("objects_activity", 3, 50)).any(), "somebody in the kitchen"


def report_day(root, checks=None):
    data = read_home(find_home_logs([root]), "live", 0, day_span(DAY, UTC))
    return day_of(metrics_of_home(data, checks), DAY, UTC)


def test_a_sound_that_somebody_marked_is_sure_whatever_the_model_thinks(tmp_path):
    coughs = [(at(t), 2, "coughing", 0.6) for t in ("10:00:05", "12:00:05")]
    logs = write_day(tmp_path, DAY, coughs)
    count = report_day(tmp_path).count("coughing")
    assert (count.labelled, count.unsure) == (2, 2)
    check(logs, at("10:00"), [(5, 7, "coughing")])
    count = report_day(tmp_path).count("coughing")
    assert (count.labelled, count.unsure, count.certain) == (2, 1, 1)
    check(logs, at("12:00"))  # somebody went through it, and marked nothing
    count = report_day(tmp_path).count("coughing")
    assert (count.labelled, count.unsure, count.certain) == (2, 0, 2)


def test_coughs_beside_a_television_are_counted_apart(tmp_path):
    talking = [(at("10:00") + 20 * i, 15, "speech", 0.9) for i in range(60)]
    coughs = [(at(t), 2, "coughing", 0.9) for t in ("10:05:16", "10:15:16", "15:00:00")]
    write_day(tmp_path, DAY, [*talking, *coughs])
    day = report_day(tmp_path)
    assert day.count("coughing").labelled == 1
    assert day.uncounted_events("coughing") == 2
    assert day.count("speech").labelled == 0
    assert day.uncounted_events("speech") == 1


@pytest.mark.parametrize("name", ["phone_ring", "objects_activity"])
def test_what_a_television_is_taken_for_is_counted_apart_like_its_coughs(tmp_path, name):
    talking = [(at("10:00") + 50 * i, 3, "speech", 0.9) for i in range(48)]
    others = [(at(t), 2, name, 0.9) for t in ("10:12:20", "10:25:40", "15:00:00")]
    write_day(tmp_path, DAY, [*talking, *others])
    day = report_day(tmp_path)
    assert day.count(name).labelled == 1
    assert day.uncounted_events(name) == 2


def test_the_page_says_of_a_night_what_its_table_counts(tmp_path):
    talking = [(at("02:00") + 20 * i, 15, "speech", 0.9) for i in range(60)]
    coughs = [(at(t), 2, "coughing", 0.9) for t in ("02:05:16", "02:15:16", "05:00:00")]
    logs = write_day(tmp_path / "home", DAY, [*talking, *coughs])
    for minute in (5, 6, 7, 8, 9, 50):
        check(logs, at(f"02:{minute:02}"))
    make_report(find_home_logs([tmp_path / "home"]), Period(DAY, 1, UTC), tmp_path / "day.html")
    text = (tmp_path / "day.html").read_text()
    assert '22\N{EN DASH}07"><span class="unit">2</span></td>' in text
    assert ">02:05, 05:00</td>" in text
    assert "<small>1 beside a television</small>" in text
    assert "In 5 of these minutes something like a television, a radio or company" in text
    assert "Counts over 3 days, up to this one (1 of them heard)" in text
    assert "Most of the sound" not in text, "the talk is beside a television"
    lines = list(Accuracy(find_home_logs([tmp_path / "home"])).lines())
    assert lines[2].startswith(
        "coughing, crying, shouting, telephone ringing, laughing, household sounds, talking, music,"
        " other negative, other sounds and not recognised are left out of 5"
    )
    assert "coughing right" not in lines[0]


NAMES = "coughing", "objects_activity"


def test_of_a_night_only_coughing_crying_and_shouting_have_a_range(tmp_path):
    sounds = [
        (at(f"{hour:02}:00:05"), 2, name, 0.9) for hour in (2, 10, 11, 12, 13) for name in NAMES
    ]
    logs = write_day(tmp_path / "home", DAY, sounds)
    for hour in range(10, 16):
        check(logs, at(f"{hour:02}:00"), [(5, 7, NAMES[0])])
    checks = read_checked_minutes(find_home_logs([tmp_path / "home"]), "live", 0, 1 << 62, [])
    day = report_day(tmp_path / "home", checks)
    for name, is_ranged in zip(NAMES, (True, False), strict=True):
        assert (day.night_count(name).range is not None) == is_ranged
        assert day.count(name).range is not None
        assert day.count(name, day.waking).range is not None


def test_a_day_of_which_little_was_heard_is_said_to_be_heard_in_part(tmp_path):
    write_day(tmp_path / "home", DAY, [(at("08:00"), 120, "speech", 0.9)])
    write_day(tmp_path / "home", DAY - timedelta(days=1), hours=[22, 23])
    make_report(find_home_logs([tmp_path / "home"]), Period(DAY, 1, UTC), tmp_path / "day.html")
    assert "(2 of them heard, 1 only in part)" in (tmp_path / "day.html").read_text()


def test_neither_quiet_nor_what_a_model_does_not_know_is_said_to_be_right_or_wrong(tmp_path):
    sounds = [(at(f"{h:02}:00:05"), 2, "unknown", 0.9) for h in range(8, 20)]
    logs = write_day(tmp_path / "home", DAY, sounds)
    for hour in range(8, 14):
        check(logs, at(f"{hour:02}:00"), [(5, 7, "speech")])
    make_report(find_home_logs([tmp_path / "home"]), Period(DAY, 1, UTC), tmp_path / "day.html")
    text = (tmp_path / "day.html").read_text()
    assert re.findall(r">(Not recognised|Quiet)</th>.*<td[^>]*>([^<]*)</td></tr>", text) == [
        ("Not recognised", "")
    ]
    lines = list(Accuracy(find_home_logs([tmp_path / "home"])).lines())
    assert (
        lines[0] == "checked here, 6 minutes drawn at random: talking missed 6 of 6 (74 to 100 %)"
    )


def test_what_a_person_has_gone_through_is_certain_in_parts_of_minutes_too(tmp_path):
    coughs = [(at(f"{h:02}:00:{s:02}"), 2, "coughing", 0.9) for h in range(8, 20) for s in (5, 40)]
    logs = write_day(tmp_path, DAY, coughs)
    begin = START + at("12:00") * NANOSECONDS
    half = ReviewedSpan("mic", begin, begin + MINUTE // 2, "Ann", 1, "live", QUEUE)
    wrong = Mark("mic", begin + 5 * NANOSECONDS, begin + 7 * NANOSECONDS, "objects_activity")
    write_marks(log_at(logs, at("12:00")), [wrong], reviewed=[half])
    count = report_day(tmp_path).count("coughing")
    assert (count.labelled, count.certain, count.unchecked.labelled) == (23, 0, 23)
    check(logs, at("13:00"))
    count = report_day(tmp_path).count("coughing")
    assert (count.labelled, count.certain, count.unchecked.labelled) == (23, 2, 21)


def test_minutes_that_were_gone_through_are_certain_and_others_have_a_range(tmp_path):
    coughs = [(at(f"{h:02}:00:05"), 2, "coughing", 0.9) for h in range(8, 20)]
    logs = write_day(tmp_path, DAY, coughs)
    for hour in range(8, 14):
        check(logs, at(f"{hour:02}:00"), [(5, 7, "objects_activity")] if hour % 2 else [])
    count = report_day(tmp_path, checked(tmp_path)).count("coughing")
    assert (count.labelled, count.certain) == (9, 3)
    low, high = count.range
    assert 3 <= low < high
    assert report_day(tmp_path).count("coughing").range is None


def test_what_a_model_does_not_know_has_no_range(tmp_path):
    logs = write_day(tmp_path, DAY, [(at("08:00:05"), 2, "unknown", 0.9)])
    for hour in range(8, 14):
        check(logs, at(f"{hour:02}:00"))
    home = report_day(tmp_path, checked(tmp_path)).home
    assert "speech" in home.rates
    assert "unknown" not in home.rates


def test_info_and_the_report_say_what_was_checked_and_what_was_not(tmp_path, capfd):
    coughs = [(at(f"{h:02}:00:05"), 2, "coughing", 0.9) for h in range(8, 20)]
    logs = write_day(tmp_path / "home", DAY, coughs)
    page = tmp_path / "before.html"
    make_report(find_home_logs([tmp_path / "home"]), Period(DAY, 1, UTC), page)
    once = re.findall(r"\bas labelled", page.read_text())
    assert len(once) == 1, "the foot says it, of all numbers"
    assert "90 % intervals" not in page.read_text()
    for hour in range(8, 14):
        check(logs, at(f"{hour:02}:00"), [(5, 7, "objects_activity")] if hour % 2 else [])
    check(logs, at("15:00"), [(4, 60, "music")], chosen=QUEUE)
    check(logs, at("16:00"), chosen=PERSON)
    page = tmp_path / "after.html"
    make_report(find_home_logs([tmp_path / "home"]), Period(DAY, 1, UTC), page)
    text = page.read_text()
    assert "In 6 minutes of this day and the 28 days before" in text
    assert "3 of 6" in text
    assert "<h2>What was heard</h2>" in text
    assert len(re.findall(r"\bas labelled", text)) == 1
    assert "Lengths of time, and numbers without a range, are as labelled." in text
    assert re.search(r"\d+ to \d+ \(8 labelled\)", text)
    assert "not checked here" not in text
    assert "“Right here”: how many" in text
    make_report(find_home_logs([tmp_path / "home"]), Period(DAY, 7, UTC), tmp_path / "week.html")
    week = (tmp_path / "week.html").read_text()
    assert "In 6 minutes of this week" in week
    assert "Right here" not in week, "a week has no such column"
    accuracy = Accuracy(find_home_logs([tmp_path / "home"]))
    lines = list(accuracy.lines())
    assert "at most ten seconds between them count once" in lines[1]
    assert lines[0].startswith("checked here, 6 minutes drawn at random: coughing right in 3 of 6")
    assert "of 2 spans of the review queue or chosen, 1 had the right label" in lines[2]
    assert accuracy.as_json()["classes"]["coughing"]["labelled"] == 6
    done = run(capfd, "info", log_at(logs, at("08:00")))
    assert "not checked here" not in done.stdout, "no model labelled this log"


@pytest.mark.parametrize(
    ("checked_here", "left"), [(3, "2 more minutes, and"), (4, "1 more minute, and")]
)
def test_too_few_checked_minutes_say_how_many_more_are_needed(tmp_path, checked_here, left):
    logs = write_day(tmp_path, DAY, [(at("08:00:05"), 2, "coughing", 0.9)])
    for hour in range(8, 8 + checked_here):
        check(logs, at(f"{hour:02}:00"))
    assert any(line.startswith(left) for line in Accuracy(find_home_logs([tmp_path])).lines())


@given(st.floats(0.5, 5e3), st.floats(0.5, 5e3), st.sampled_from((0.025, 0.05, 0.5, 0.95, 0.975)))
def test_a_quantile_of_a_beta_distribution_is_that_of_scipy(a, b, share):
    assert beta_quantile(a, b, share) == pytest.approx(float(betaincinv(a, b, share)), rel=1e-9)


def test_an_interval_of_few_checks_is_wide_and_of_many_narrow():
    few, many = ClassCheck(4, 3, 4, 1), ClassCheck(400, 300, 400, 100)
    assert few.precision[1] - few.precision[0] > 0.5
    assert many.precision == pytest.approx((0.713, 0.784), abs=0.002)
    assert ClassCheck(0, 0, 0, 0).precision is None
    assert ClassCheck(0, 0, 3, 3).miss_rate(1)[0] > 0.4


def test_what_is_missed_in_a_quiet_minute_stands_for_more_than_in_one_with_sound(tmp_path):
    coughs = [(at(f"{h:02}:00:05"), 2, "coughing", 0.9) for h in range(8, 20)]
    logs = write_day(tmp_path, DAY, coughs)
    for hour in range(8, 14):
        check(logs, at(f"{hour:02}:00"))
    check(logs, at("15:30"), [(5, 7, "coughing")])
    check(logs, at("16:30"))
    accuracy = Accuracy(find_home_logs([tmp_path]))
    assert accuracy.weight == pytest.approx((1428 / 2) / (12 / 6))
    checked = accuracy.minutes.check("coughing")
    assert checked == (6, 6, 7, 1, 1)
    noise = [(at(f"{h:02}:{m:02}:05"), 30, "music", 0.9) for h in range(24) for m in range(60)]
    loud = write_day(tmp_path, DAY + timedelta(days=1), noise)
    begin = midnight(DAY + timedelta(days=1))
    write_marks(loud[0], [], reviewed=[ReviewedSpan("mic", begin, begin + MINUTE, chosen=QUEUE)])
    assert Accuracy(find_home_logs([tmp_path])).weight == accuracy.weight, "nothing drawn that day"
    assert checked.miss_rate(1)[1] < 0.5
    assert checked.miss_rate(accuracy.weight)[1] > 0.9
    full = ClassCheck(40, 30, 50, 20, 2)
    assert full.miss_rate(10)[0] > full.miss_rate(1)[0]


def confidences(*groups):
    """Confidences, and whether they are right, of groups of (confidence, right, wrong)."""
    pairs = [(c, r) for c, good, bad in groups for r in [True] * good + [False] * bad]
    return np.array([c for c, _ in pairs]), np.array([r for _, r in pairs], bool)


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ([], ["", "", "not sure"]),
        ([(0.95, 5, 0)], ["", "", "not sure"]),
        ([(0.95, 20, 0), (0.8, 9, 6), (0.4, 3, 9)], ["sure", "", "not sure"]),
        ([(0.95, 12, 8), (0.8, 9, 6)], ["", "", "not sure"]),
        ([(0.95, 16, 3), (0.8, 5, 7)], ["", "", "not sure"]),
        ([(0.95, 10, 0), (0.5, 30, 0)], ["sure", "sure", "sure"]),
    ],
)
def test_sure_is_a_word_for_what_was_right_nine_times_in_ten_in_the_home(groups, words):
    home = measured_sureness(*confidences(*groups))
    assert [home.word(confidence) for confidence in (0.95, 0.8, 0.5)] == words


def test_a_home_without_checked_minutes_is_sure_of_nothing(tmp_path):
    sounds = [(at(f"{h:02}:00:05"), 2, "coughing", 0.99) for h in range(8, 20)]
    logs = write_day(tmp_path, DAY, sounds)
    end = START + 86_400 * NANOSECONDS
    assert read_sureness(find_home_logs([tmp_path]), 0, end) == UNMEASURED
    for hour in range(8, 20):
        check(logs, at(f"{hour:02}:00"))
    home = read_sureness(find_home_logs([tmp_path]), 0, end)
    assert (home.word(0.995), home.word(0.9)) == ("sure", "")
