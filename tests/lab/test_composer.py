"""Days of a home are planned, composed of real clips, and recorded with known truth."""

import csv
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.home", reason="the wheel leaves the lab out")

from mcap.reader import make_reader

from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.starter import starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import ModelError
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.tools.home.clips import frame_powers
from hearthlog.tools.home.composition import PERIOD_FRAMES, Composition
from hearthlog.tools.home.routine import (
    DAY_FRAMES,
    HomePlan,
    PlannedNoise,
    plan_short_day,
)
from hearthlog.tools.home.simulate import truth_of, write_sound
from hearthlog.tools.lab.home.days import Habits, plan_days
from hearthlog.tools.lab.home.recording import FeatureStream, busy_frames, record_composition

HOUR = DAY_FRAMES // 24
START = 1_772_323_200_000_000_000
PERSON = {"resident", "visitor", "phone"}


@pytest.fixture(scope="module")
def evening(clip_library, living_room):
    """Twenty minutes before the television is on, and twenty with it."""
    plan = plan_days(1, clip_library, Habits(seed=1))
    first = next(sound.start for sound in plan.sounds if sound.origin == "television")
    return Composition(part(plan, first - HOUR // 3, 2 * HOUR // 3), clip_library, living_room)


def part(plan, first, frames):
    """A part of a plan, as a plan."""
    sounds = [
        replace(sound, start=sound.start - first)
        for sound in plan.sounds
        if first <= sound.start and sound.end <= first + frames
    ]
    steady = [replace(one, start=one.start - first, end=one.end - first) for one in plan.steady]
    return HomePlan(frames, sounds, steady)


def full_scale(samples):
    return samples.astype(np.float32) / 32768


def test_the_same_seed_plans_the_same_days_and_more_days_begin_alike(clip_library):
    days = plan_days(3, clip_library, Habits(seed=5))
    again = plan_days(5, clip_library, Habits(seed=5))
    assert list(days.sounds) == [sound for sound in again.sounds if sound.start < days.frames]
    assert list(days.sounds) != list(plan_days(3, clip_library, Habits(seed=6)).sounds)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_month_is_plausible_and_planned_in_a_moment(clip_library, seed):
    began = time.process_time()
    plan = plan_days(30, clip_library, Habits(seed))
    assert time.process_time() - began < 10
    days = [[] for _ in range(30)]
    for sound in plan.sounds:
        days[sound.start // DAY_FRAMES].append(sound)
    watched, showers = [], []
    for sounds in days:
        count = Counter((one.clip.label, one.origin) for one in sounds)
        assert 2 <= count["flushing_water", "resident"] <= 16
        assert 10 <= count["objects_activity", "resident"] <= 500
        assert count["phone_ring", "phone"] <= 8
        showers.append(count["shower", "resident"] > 0)
        watched.append(sum(one.frames for one in sounds if one.origin == "television") / HOUR)
        for one in sounds:
            if one.origin == "television":
                assert 14 < one.start % DAY_FRAMES / HOUR < 24
    assert showers in ([True, False] * 15, [False, True] * 15)
    assert 1.0 < min(watched) < max(watched) < 6.0
    at_night = [one for one in plan.sounds if one.activity == "night"]
    assert {one.clip.label for one in at_night} == {"coughing"}
    assert 100 < len(at_night) < 600
    assert any(one.activity == "visit" for one in plan.sounds)


def test_a_person_and_a_device_make_one_sound_at_a_time(clip_library):
    plan = plan_days(14, clip_library, Habits(seed=2))
    assert [one.start for one in plan.sounds] == sorted(one.start for one in plan.sounds)
    for origins in (PERSON, {"television"}, {"radio"}, {"outside"}):
        sounds = [one for one in plan.sounds if one.origin in origins]
        assert sounds
        assert all(one.end <= other.start for one, other in pairwise(sounds))
    for name in ("fridge", "street", "fan"):
        noises = [one for one in plan.steady if one.name == name]
        assert noises
        assert all(one.end <= other.start for one, other in pairwise(noises))


def test_nights_get_worse_from_the_day_asked_for_and_are_the_same_before(clip_library):
    usual = plan_days(21, clip_library, Habits(seed=3))
    worse = plan_days(21, clip_library, Habits(seed=3, coughs_from=14))
    change = 14 * DAY_FRAMES
    before = [[one for one in plan.sounds if one.start < change] for plan in (usual, worse)]
    assert before[0] == before[1]

    def coughs(plan):
        return sum(one.activity == "night" and one.start >= change for one in plan.sounds)

    assert coughs(worse) > 2 * coughs(usual)


def test_the_truth_covers_the_time_and_lies_where_the_energy_is(evening):
    truth = truth_of(evening)
    frames = evening.plan.frames
    starts, ends, labels = zip(*truth.spans, strict=True)
    assert (starts[0], ends[-1]) == (0.0, pytest.approx(frames * FRAME_SECONDS))
    assert starts[1:] == ends[:-1]
    assert {"silence", "speech"} <= set(labels)
    power = frame_powers(full_scale(evening.samples(0, frames)).ravel())
    above = 10 * np.log10(power / evening.floor_power(0, frames))
    for start, end, label in truth.spans:
        span = above[round(start / FRAME_SECONDS) : round(end / FRAME_SECONDS)]
        if label == "silence":
            assert np.percentile(span, 90) < 5
        else:
            assert span.max() > 1.5
    labelled = sum(event.audible_frames for event in truth.events) * FRAME_SECONDS
    silent = sum(end - start for start, end, label in truth.spans if label == "silence")
    assert labelled + silent == pytest.approx(frames * FRAME_SECONDS)


@pytest.mark.parametrize("features", [DEFAULT, AUROS21], ids=lambda one: one.name)
def test_features_without_most_of_the_sound_are_those_of_the_sound(evening, features):
    frames = evening.plan.frames
    expected = features.extractor()(full_scale(evening.samples(0, frames)))
    busy = busy_frames(evening, 0, frames)
    assert 0.2 < busy.mean() < 0.9
    for size in (frames, 5000, 777):
        stream = FeatureStream(evening, features)
        blocks = [stream(first, min(size, frames - first)) for first in range(0, frames, size)]
        assert np.array_equal(np.concatenate(blocks), expected)


def test_steady_noise_repeats_itself_and_its_features_do_too(clip_library, living_room):
    steady = [PlannedNoise("fridge", 500, 3 * PERIOD_FRAMES + 100)]
    quiet = Composition(HomePlan(4 * PERIOD_FRAMES, (), steady), clip_library, living_room)
    values = FeatureStream(quiet, DEFAULT)(0, quiet.plan.frames)
    on = values[PERIOD_FRAMES : 2 * PERIOD_FRAMES]
    assert np.array_equal(on, values[2 * PERIOD_FRAMES : 3 * PERIOD_FRAMES])
    assert not np.array_equal(on[600:], values[3 * PERIOD_FRAMES + 600 :])
    sound = full_scale(quiet.samples(0, quiet.plan.frames))
    assert np.array_equal(values, DEFAULT.extractor()(sound))
    assert busy_frames(quiet, 0, quiet.plan.frames).sum() == 40


def recorded_and_composed(composition, model, folder):
    """The messages of a recorder that hears a composition, and those that are composed."""
    write_sound(composition, folder / "evening.flac", 0, composition.plan.frames)
    found = []
    for name in ("recorded", "composed"):
        settings = Settings(output=folder / name, model=model)
        if name == "recorded":
            source = FileSource([folder / "evening.flac"], START)
            logs = record_files(settings, source, Flag()).logs
        else:
            logs = record_composition(composition, settings, START, "evening.flac")
        assert [log.name for log in logs] == ["home_20260301T000000Z.mcap"]
        with logs[0].open("rb") as stream:
            messages = make_reader(stream).iter_messages()
            found.append([(channel.topic, one.log_time, one.data) for _, channel, one in messages])
    return found


def test_the_logs_are_those_that_the_recorder_leaves_of_the_sound(evening, model_file, tmp_path):
    recorded, composed = recorded_and_composed(evening, model_file, tmp_path)
    assert recorded == composed
    assert {topic for topic, *_ in recorded} >= {"/mic/features", "/mic/label", "/mic/segment"}


def test_a_model_that_takes_embeddings_gets_those_of_the_composed_sound(
    clip_library, living_room, tmp_path, monkeypatch
):
    pytest.importorskip("ai_edge_litert")
    network = Path(__file__).parents[2] / "shared" / "data" / "networks" / "yamnet.tflite"
    if not network.exists():
        pytest.skip("needs the network, in ../shared/data/networks")
    monkeypatch.delenv("HEARTHLOG_EMBEDDING", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    place = tmp_path / "hearthlog" / "networks" / "yamnet.tflite"
    place.parent.mkdir(parents=True)
    place.symlink_to(network)
    composition = Composition(plan_short_day(2, clip_library, 1), clip_library, living_room)
    model = starter_file("general-embedding")
    recorded, composed = recorded_and_composed(composition, model, tmp_path)
    assert recorded == composed
    assert sum(topic == "/mic/embedding" for topic, *_ in composed) > 20


def test_a_model_that_takes_embeddings_labels_no_composition_without_its_network(
    evening, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    settings = Settings(output=tmp_path / "logs", model=starter_file("general-embedding"))
    with pytest.raises(
        ModelError, match="the network yamnet is not installed; hearthlog models fetch"
    ):
        record_composition(evening, settings, START)
    assert not (tmp_path / "logs").exists()


def simulate(*arguments):
    command = [sys.executable, "-m", "hearthlog.tools.lab.home", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (("0",), "1 to 3660 days, not 0"),
        (("9999",), "1 to 3660 days, not 9999"),
        (("1", "--seed", "-1"), "whole number from 0"),
        (("1", "--room", "garage"), "no room is called 'garage'"),
        (("1", "--manifest", "gone.csv"), "gone.csv"),
        (("1", "--model", "gone.safetensors"), "gone.safetensors"),
    ],
)
def test_a_home_that_cannot_be_is_refused_in_one_line(tmp_path, arguments, output):
    result = simulate(*arguments, "-o", tmp_path / "home")
    assert result.returncode == 1
    assert output in result.stderr
    assert len([line for line in result.stderr.splitlines() if "made up" not in line]) == 1
    assert not (tmp_path / "home").exists()


def test_a_simulated_home_never_overwrites(tmp_path):
    result = simulate("1", "-o", tmp_path)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert "name a new folder" in result.stderr


def test_a_day_of_a_home_is_24_logs_and_its_truth(tmp_path):
    result = simulate("1", "-o", tmp_path / "home", "--seed", "4", "--start", "2026-05-01")
    assert (result.returncode, result.stderr) == (0, "hearthlog: made up without clips: shower\n")
    logs = sorted(path.name for path in (tmp_path / "home" / "logs").rglob("*.mcap"))
    assert logs == [f"home_20260501T{hour:02}0000Z.mcap" for hour in range(24)]
    track = (tmp_path / "home" / "truth.txt").read_text().splitlines()
    assert track[0].startswith("0.000000\t")
    assert track[-1].split("\t")[1] == "86400.000000"
    with (tmp_path / "home" / "events.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"television", "resident"} <= {row["from"] for row in rows}
    assert {row["made_up"] for row in rows} == {"yes", "no"}
    assert all(Path(row["clip"]).parts[0] in {"made_up", row["label"]} for row in rows)
