"""A quarter of a simulated home is lived, learned from and scored week by week."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.text import Text

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.models.starter import GENERAL
from hearthlog.schemas.frames import FRAME_SAMPLES, NANOSECONDS
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Rooms
from hearthlog.tools.home.routine import plan_short_day
from hearthlog.tools.lab import quarter
from hearthlog.tools.lab.home.days import Habits, plan_days
from hearthlog.tools.lab.home.microphones import NarrowRooms
from hearthlog.tools.lab.quarter_picture import line_of, quarter_figure, save_picture
from hearthlog.tools.lab.quarter_scores import Week, scored

START = 1_772_323_200_000_000_000


def labelling(*spans):
    starts, ends, labels = zip(*spans, strict=True)
    times = (np.array(t) * NANOSECONDS for t in (starts, ends))
    return Labelling(*times, np.array(labels, object))


def test_a_week_is_labelled_reviewed_and_learned_from(tmp_path):
    library = ClipLibrary()
    plans = [(0, plan_short_day(4, library, 1))]
    home = quarter.Home(tmp_path / "home", [plans, plans], library, 1, START)
    week = next(quarter.live(home))
    assert week.model == GENERAL
    assert week.circle == week.alone
    assert week.marks > 3
    assert 0 < week.minutes <= 10
    assert week.trained
    models = home.folder / "models"
    assert (models / "home-1.safetensors").exists()
    assert (models / "champion.safetensors").exists() == week.promoted
    assert any("learn" in line for line in week.said)
    assert "F1" in line_of(week)
    save_picture(tmp_path / "quarter.png", [week])
    assert (tmp_path / "quarter.png").stat().st_size > 10_000


def test_a_labelling_is_scored_by_time_and_by_events_that_are_none():
    truth = labelling((0, 6, "silence"), (6, 10, "cough"), (10, 20, "dog"))
    labelled = labelling((0, 2, "coughing"), (2, 8, "silence"), (8, 20, "coughing"))
    one = scored(truth, labelled)
    assert one.f1(["coughing", "silence", "music"]) == {"coughing": 4 / 18, "silence": 8 / 12}
    assert one.macro_f1(["silence"]) == pytest.approx(2 / 3)
    assert one.false_events == {"coughing": 24 * 3600 / 20}


def test_the_picture_of_a_quarter_has_level_words_that_cover_no_curve():
    truth = labelling((0, 60, "silence"), (60, 90, "cough"), (90, 200, "music"))
    weeks = []
    for number in range(1, 14):
        noise = number * 7 % 11 + 1
        labelled = [
            labelling((0, 60 - n, "silence"), (60 - n, 200, "yelling")) for n in (noise, 40)
        ]
        scores = [scored(truth, each) for each in labelled]
        weeks.append(Week(number, "home", *scores, 9.0, 5, 20, 4, True, number not in {9, 12}))
    figure = quarter_figure(weeks)
    figure.draw_without_rendering()
    words = [
        text
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text() and not text.get_text()[0].isdigit()
    ]
    found = {text.get_text() for text in words}
    assert {"Wrong marks", "Another microphone", "Starter model alone"} <= found
    for text in words:
        assert text.get_rotation() == 0
        assert text.get_text()[0].isupper()
    boxes = [text.get_window_extent() for text in words]
    for one, other in combinations(boxes, 2):
        assert not one.overlaps(other)
    for axes in figure.axes:
        for box in boxes:
            assert not box.overlaps(axes.get_window_extent())


def test_another_microphone_hears_the_same_in_a_narrow_band_and_weaker():
    near, narrow = Rooms("kitchen", 4), NarrowRooms("kitchen", 4)
    click = np.zeros(20 * FRAME_SAMPLES, np.float32)
    click[0] = 1.0
    recorded = [
        (near.floor.ravel(), narrow.floor.ravel()),
        (near.steady["fridge"].ravel(), narrow.steady["fridge"].ravel()),
        (near.received(click, "kitchen"), narrow.received(click, "kitchen")),
    ]
    for before, after in recorded:
        frequency = np.fft.rfftfreq(len(before), 1 / 16_000)
        a, b = (np.square(np.abs(np.fft.rfft(sound))) for sound in (before, after))
        inside = (frequency > 500) & (frequency < 3000)
        assert 10 * np.log10(b[inside].sum() / a[inside].sum()) == pytest.approx(-20, abs=0.5)
        outside = (frequency < 60) | (frequency > 7000)
        assert b[outside].sum() < 1e-4 * a[outside].sum()


def test_the_hours_of_a_week_are_those_in_which_the_most_is_heard():
    library, hour = ClipLibrary(None), 3600 * 20
    weeks = quarter.plan_quarter(2, library, 1)
    full = plan_days(14, library, Habits(1))
    for number, ((first, one), (second, other)) in enumerate(weeks):
        assert 0 <= first < second < 168 * hour
        assert one.frames == other.frames == hour
        begin = number * 168 * hour
        recorded = {s.clip.label for s in full.sounds if begin <= s.start < begin + 168 * hour}
        assert len(recorded - {s.clip.label for s in (*one.sounds, *other.sounds)}) <= 1
        assert [s.frames for s in one.sounds] == [
            s.frames
            for s in full.sounds
            if begin + first <= s.start and s.end <= begin + first + hour
        ]
