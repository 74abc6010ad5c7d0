"""A day beside the routines of its home: what is unlike, by how much, and how rare that is."""

from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import GENERAL, HOUR, at, midnight, write_day
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from livehome import rule
from pydantic import ValidationError

from hearthlog.analyzer.activity import day_anomaly as usual
from hearthlog.analyzer.activity.day_anomaly import (
    FEWEST,
    Routines,
    compare,
    fit_baseline,
    regular_hours,
)
from hearthlog.analyzer.activity.day_profile import (
    COUNT,
    FIRST,
    LAST,
    LENGTH,
    DayFigure,
    HomeSegments,
    Profiles,
)
from hearthlog.analyzer.activity.segments import read_activity
from hearthlog.analyzer.bridge.alerts.evaluation import notifications
from hearthlog.analyzer.bridge.alerts.rules import history
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import difference, joined, single_span
from hearthlog.analyzer.report.report import Period, make_report
from hearthlog.analyzer.report.wording import difference_text, judgement_text
from hearthlog.schemas.frames import NANOSECONDS

MONDAY = date(2026, 2, 2)
VIENNA = ZoneInfo("Europe/Vienna")
CLASSES = ("speech", "coughing", "tap_water", "objects_activity")


def usual_day(rng, *, up=7.0, lunch=True):
    """Events of a day: (second, seconds, label, confidence)."""
    up += rng.normal(0, 0.15)
    found = []

    def some(label, start, hours, count, seconds):
        hours = rng.uniform(start, start + hours, count)
        found.extend((hour * HOUR, rng.uniform(*seconds), label, 0.9) for hour in hours)

    some("coughing", 1, 4, rng.integers(2, 5), (1, 3))
    some("tap_water", up, 0.3, 6, (5, 15))
    some("objects_activity", up + 0.4, 0.5, 12, (5, 20))
    if lunch:
        some("objects_activity", 12 + rng.normal(0, 0.15), 0.6, rng.integers(14, 20), (5, 20))
    some("tap_water", 9, 12, rng.integers(5, 8), (5, 15))
    some("speech", 17 + rng.normal(0, 0.15), 2.5, rng.integers(60, 80), (10, 60))
    return sorted(found)


def home(days, zone=UTC, gaps=()):
    """What was heard on days that begin with a Monday: lists of events by the clock on the wall."""
    rows = []
    for number, events in enumerate(days):
        day = MONDAY + timedelta(days=number)
        for second, seconds, label, _ in events:
            moment = datetime(day.year, day.month, day.day) + timedelta(seconds=second)  # noqa: DTZ001
            start = round(moment.replace(tzinfo=zone).timestamp() * NANOSECONDS)
            rows.append((start, start + round(seconds * NANOSECONDS), label))
    begin = midnight(MONDAY) - 2 * HOUR * NANOSECONDS
    covered = single_span(begin, begin + (len(days) * 24 + 8) * HOUR * NANOSECONDS)
    for start, end in gaps:
        covered = difference(covered, single_span(start, end))
    parts = [Labelling(*covered, np.full(len(covered.starts), "silence", object))]
    for label in CLASSES:
        own = np.array([row[:2] for row in rows if row[2] == label], np.int64).reshape(-1, 2)
        spans = joined(own[:, 0], own[:, 1])
        for start, end in gaps:
            spans = difference(spans, single_span(start, end))
        parts.append(Labelling(*spans, np.full(len(spans.starts), label, object)))
    starts, ends, labels = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("starts", "ends", "labels")
    )
    order = np.argsort(starts, kind="stable")
    return HomeSegments(
        Labelling(starts[order], ends[order], labels[order]), dict.fromkeys(CLASSES, covered)
    )


def month(last, count=29, seed=1, **keys):
    """A month of usual days, of which the last is as it is told."""
    rng = np.random.default_rng(seed)
    days = [usual_day(rng, **keys) for _ in range(count)]
    return [*days, last(rng)]


def judged(days, number=-1, **keys):
    """The judgement of a day; its night is the one before."""
    day = MONDAY + timedelta(days=number % len(days))
    return Routines(Profiles(home(days, **keys), UTC, night_after=False)).judge(day)


def text_of(found):
    return "; ".join(map(difference_text, found.differences))


def test_a_usual_day_is_as_usual_and_few_are_called_rare():
    rarity = [judged(month(usual_day, seed=seed)).once_in for seed in range(12)]
    assert sum(each < 7 for each in rarity) >= 9
    assert sum(each >= 30 for each in rarity) <= 1
    assert judgement_text(judged(month(usual_day))) == "As usual, compared with 27 earlier days."


def test_getting_up_late_is_said_with_how_much_later():
    found = judged(month(lambda rng: usual_day(rng, up=9.0)))
    assert found.once_in >= 30
    first = next(each for each in found.differences if each.figure.what == FIRST)
    assert first.value - first.middle == pytest.approx(120, abs=30)
    assert "first busy half hour from 0" in text_of(found)
    assert "later than usual (06:" in text_of(found)
    assert judgement_text(found).startswith("Unusual compared with 27 earlier days: ")


def test_a_meal_that_is_missed_is_named_by_its_hours():
    found = judged(month(lambda rng: usual_day(rng, lunch=False)))
    assert found.once_in >= 30
    assert "no household sounds from 11:" in text_of(found)


def test_a_day_is_judged_by_two_weeks():
    days = month(usual_day, count=FEWEST + 2)
    assert judged(days).days == FEWEST
    assert judged(days[1:]) is None


def test_a_day_is_not_judged_that_was_hardly_heard():
    noon = midnight(MONDAY) + (29 * 24 + 6) * HOUR * NANOSECONDS
    assert judged(month(usual_day), gaps=[(noon, noon + 16 * HOUR * NANOSECONDS)]) is None


def test_what_was_not_heard_is_not_said_to_be_missing():
    """Lunch is in a gap; so are the first sounds of the morning on another day."""
    day = midnight(MONDAY) + 29 * 24 * HOUR * NANOSECONDS
    lunch = [(day + int(11.4 * HOUR) * NANOSECONDS, day + 13 * HOUR * NANOSECONDS)]
    found = judged(month(usual_day), gaps=lunch)
    assert found.once_in < 30
    assert "household" not in text_of(found)
    morning = [(day + 5 * HOUR * NANOSECONDS, day + int(8.5 * HOUR) * NANOSECONDS)]
    profiles = Profiles(home(month(usual_day), gaps=morning), UTC, night_after=False)
    values = profiles.of(MONDAY + timedelta(days=29)).values
    assert np.isnan(values[profiles.figures.index(DayFigure(FIRST, "clock"))])


def test_what_is_late_on_a_weekday_may_be_usual_at_a_weekend():
    rng = np.random.default_rng(3)
    days = [usual_day(rng, up=9.5 if number % 7 >= 5 else 7.0) for number in range(34)]
    assert "later" not in text_of(judged(days, 33))  # a Saturday
    late = [*days[:31], usual_day(rng, up=9.5)]
    assert "later" in text_of(judged(late))  # a Thursday


def test_a_new_habit_is_usual_after_some_weeks():
    rng = np.random.default_rng(4)
    days = [usual_day(rng, up=7.0 if number < 30 else 9.0) for number in range(62)]
    assert judged(days, 31).once_in >= 30
    assert judged(days, 61).days == 28
    assert judged(days, 61).once_in < 30


def test_what_lasts_for_three_days_is_rarer_than_one_day_of_it():
    """Up three quarters of an hour late now and then is nothing; on three days it is something."""
    once, thrice = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        before = [usual_day(rng) for _ in range(31)]
        late = [usual_day(rng, up=7.8) for _ in range(3)]
        once.append(judged([*before, late[-1]]))
        thrice.append(judged([*before[:-2], *late]))
    pairs = zip(once, thrice, strict=True)
    assert sum(three.once_in > one.once_in for one, three in pairs) >= 3
    together = max((each for each in thrice if each.span == 3), key=lambda each: each.once_in)
    assert "Typical of the last 3 days: first busy half hour" in judgement_text(together)


def test_one_figure_far_from_usual_is_told_of_a_day_that_is_as_usual_on_the_whole():
    far = [(at("01:00") + 300 * n, 2, "coughing", 1) for n in range(20)]
    found = judged(month(lambda rng: sorted([*usual_day(rng), *far])))
    text = judgement_text(replace(found, once_in=2.0))
    assert text.startswith("On the whole as usual, compared with 27 earlier days, but: ")
    assert "times of coughing in the night 2" in text


def test_hours_are_those_of_the_clock_on_days_that_it_is_changed():
    rng = np.random.default_rng(5)
    days = [usual_day(rng) for _ in range(60)]  # the clock is set forward on 29 March
    profiles = Profiles(home(days, zone=VIENNA), VIENNA, night_after=False)
    place = profiles.figures.index(DayFigure(FIRST, "clock"))
    for number in (54, 55, 56):
        day = profiles.of(MONDAY + timedelta(days=number))
        assert 6.4 * 60 < day.values[place] < 7.8 * 60
        objects = day.half_hours[profiles.classes.index("objects_activity")]
        assert np.nansum(objects[23:27]) > 1, "lunch is at noon"
    change = profiles.of(date(2026, 3, 29)).half_hours
    assert np.isnan(change[:, 4]).all(), "there was no 02:00"


def test_the_night_is_the_one_before_or_the_one_after():
    rng = np.random.default_rng(6)
    days = [usual_day(rng) for _ in range(4)]
    days[2] += [(at("02:00") + 60 * n, 2, "coughing", 1) for n in range(30)]
    recorded = home(days)
    for night_after, number in ((False, 2), (True, 1)):
        profiles = Profiles(recorded, UTC, night_after=night_after)
        place = profiles.figures.index(DayFigure("coughing", COUNT, night=True))
        counts = [profiles.of(MONDAY + timedelta(days=n)).values[place] for n in (1, 2)]
        assert [count > 25 for count in counts] == [number == 1, number == 2]


def test_coughing_beside_a_television_does_not_count():
    rng = np.random.default_rng(7)
    days = [usual_day(rng) for _ in range(3)]
    plain = Profiles(home(days), UTC, night_after=False).of(MONDAY)
    television = [(at("20:00") + 20 * n, 15, "speech", 1) for n in range(180)]
    coughs = [(at("20:00") + 60 * n + 16, 1, "coughing", 1) for n in range(60)]
    days[0] = sorted([*days[0], *television, *coughs])
    profiles = Profiles(home(days), UTC, night_after=False)
    place = profiles.figures.index(DayFigure("coughing", COUNT))
    assert profiles.of(MONDAY).values[place] == plain.values[place]


def test_a_busy_half_hour_has_five_sounds():
    four = [(at("05:00") + 120 * n, 3, "tap_water", 1) for n in range(4)]
    day = [*four, *((at("09:00") + 120 * n, 3, "tap_water", 1) for n in range(5))]
    profiles = Profiles(home([day, day, day]), UTC, night_after=False)
    values = profiles.of(MONDAY + timedelta(days=1)).values
    clock = [profiles.figures.index(DayFigure(what, "clock")) for what in (FIRST, LAST)]
    assert values[clock].tolist() == [540, 548]


def test_an_evening_may_end_after_midnight():
    rng = np.random.default_rng(12)
    late = [(at("23:30") + 300 * n, 20, "speech", 1) for n in range(7)]
    night = [(at("00:05") + 300 * n, 20, "speech", 1) for n in range(18)]
    days = [usual_day(rng) for _ in range(32)]
    days[30], days[31] = sorted([*days[30], *late]), sorted([*night, *days[31]])
    found = judged(days, 30)
    assert "last busy half hour until 01:30, " in text_of(found)
    assert " later than usual (19:" in text_of(found)


TABLES = arrays.arrays(
    float,
    st.tuples(st.integers(1, 9), st.integers(1, 4)),
    elements=st.one_of(st.floats(0, 99), st.just(np.nan)),
)


@given(TABLES, st.sampled_from([0.1, 0.5, 0.9]))
def test_quantiles_are_those_of_what_is_known(table, share):
    known = np.isfinite(table).any(axis=0)
    ours = usual.quantile(table, share)
    assert np.isnan(ours[~known]).all()
    expected = np.nanquantile(table[:, known], share, axis=0) if known.any() else ours[known]
    np.testing.assert_allclose(ours[known], expected)


def test_days_that_are_left_out_are_compared_with_all_others_and_not_with_themselves():
    rng = np.random.default_rng(9)
    profiles = Profiles(home([usual_day(rng) for _ in range(20)]), UTC, night_after=False)
    days = [profiles.of(MONDAY + timedelta(days=number)) for number in range(20)]
    compared = compare(days[-1:], days[:-1], profiles.figures, profiles.classes)
    hours = regular_hours(days[:-1], profiles.classes)
    figures = [*profiles.figures, *hours]
    kept = [figures.index(figure) for figure in compared.figures]
    table = usual.rooted(usual.figure_table(days[:-1], profiles.classes, hours), figures)[:, kept]
    weekend = np.array([day.day.weekday() >= 5 for day in days[:-1]])
    for row in (0, 11):
        rest = np.arange(19) != row
        own = fit_baseline(table[rest], weekend[rest], compared.figures)
        expected = own.deviations(table[row], weekend[row])
        np.testing.assert_array_equal(compared.others[row], expected)


def test_regular_hours_do_not_overlap_and_have_what_they_say():
    rng = np.random.default_rng(10)
    profiles = Profiles(home([usual_day(rng) for _ in range(30)]), UTC, night_after=False)
    days = [profiles.of(MONDAY + timedelta(days=number)) for number in range(28)]
    found = regular_hours(days, profiles.classes)
    meals = [figure.hours for figure in found if figure.what == "objects_activity"]
    assert [any(a <= hour < b for a, b in meals) for hour in (15, 25, 40)] == [True, True, False]
    for name in profiles.classes:
        own = sorted(figure.hours for figure in found if figure.what == name)
        assert all(a[1] <= b[0] for a, b in pairwise(own))
        assert all(figure.kind == LENGTH for figure in found)


# In logs


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Nineteen days of which the last has no lunch, and a bad night after it."""
    root = tmp_path_factory.mktemp("logs")
    rng = np.random.default_rng(2)
    about = {"classes": [*GENERAL, "tap_water"], "file_hours": 6}
    for number in range(20):
        events = usual_day(rng, lunch=number != 18)
        if number == 19:
            events = sorted(
                [*events, *((at("02:00") + 60 * n, 2, "coughing", 1) for n in range(30))]
            )
        write_day(root, MONDAY + timedelta(days=number), events, **about)
    return root


def test_an_alert_tells_of_an_unusual_day_in_the_morning_after_it(logs):
    shelf, start = find_home_logs([logs]), midnight(MONDAY)
    recorded = read_activity(shelf, "home", start, 1 << 62, pytest.fail)
    end = start + 20 * 24 * HOUR * NANOSECONDS
    (ring,), _ = notifications(rule("unusual_day", "day", once_in=100), recorded, start, end, UTC)
    assert ring.time == start + (19 * 24 + 8) * HOUR * NANOSECONDS
    assert ring.text.startswith("Fri 20 Feb and the night after it, ")
    assert "times of coughing in the night 3" in ring.text
    assert "no household sounds from 11:" in ring.text


def test_a_report_says_what_was_unlike_usual_days_and_how_rare_that_is(logs, tmp_path):
    page = tmp_path / "page.html"
    make_report(find_home_logs([logs]), Period(MONDAY + timedelta(days=18), 1, UTC), page)
    assert "Unusual compared with 16 earlier days: " in page.read_text()
    assert "o household sounds from 11:" in page.read_text()


def test_a_rule_reads_five_weeks_and_waits_for_the_end_of_the_night():
    assert history(rule("unusual_day", "day")) > 33 * 24 * HOUR * NANOSECONDS
    with pytest.raises(ValidationError, match="a night ends at 07:00"):
        rule("unusual_day", "day", at="06:00")
    with pytest.raises(ValidationError, match="once_in"):
        rule("unusual_day", "day", once_in=3)


def test_a_simulated_home_misses_its_water():
    about = "the wheel leaves the benchmarks out"
    routine = pytest.importorskip("hearthlog.tools.lab.routine", reason=about)
    clips = pytest.importorskip("hearthlog.tools.home.clips")
    home = routine.simulate(3, 4, [routine.once_in], clips.ClipLibrary())
    assert (home.normal >= 30).mean() < 0.1
    assert np.median([rows.max() for rows in home.changed["no water"]]) >= 30
    assert np.median([rows.max() for rows in home.changed["nothing"]]) < 30
    assert next(routine.alarm_lines([home])).startswith("once_in")
