import csv
from itertools import groupby, pairwise

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.routine import plan_short_day
from hearthlog.tools.home.simulate import write_day, write_training_set
from hearthlog.tools.home.sounds import LABELS, SimulationError, synthesize

GENERAL = {
    "silence",
    "speech",
    "music",
    "phone_ring",
    "coughing",
    "crying",
    "yelling",
    "laughing",
    "objects_activity",
}

MADE_UP = ClipLibrary(None)


def decibels(samples, block=FRAME_SAMPLES):
    """RMS of successive blocks in dBFS."""
    blocks = samples[: len(samples) // block * block].reshape(-1, block).astype(np.float64)
    return 20.0 * np.log10(np.sqrt(np.mean(blocks**2, axis=1)))


def one_line(error):
    return str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("label", LABELS)
def test_a_sound_is_repeated_exactly_by_its_seed_and_by_no_other(label):
    first = synthesize(label, 2.0, seed=1)
    assert first.dtype == np.float32
    assert first.shape == (2 * SAMPLE_RATE,)
    assert np.array_equal(first, synthesize(label, 2.0, seed=1))
    assert not np.array_equal(first, synthesize(label, 2.0, seed=2))


@pytest.mark.parametrize("label", LABELS)
def test_every_second_of_a_sound_stands_above_the_room_and_below_full_scale(label):
    for seed in range(8):
        sound = synthesize(label, 5.0, seed)
        assert np.abs(sound).max() < 1.0
        assert decibels(sound).min() > -68.0  # a room is never digitally silent
        seconds = decibels(sound, SAMPLE_RATE)
        if label == "silence":
            assert -66.0 < seconds.min() <= seconds.max() < -59.0
        else:
            assert seconds.min() > -59.0


@given(label=st.sampled_from(LABELS), samples=st.integers(1, 5000), seed=st.integers(0, 2**64 - 1))
@settings(deadline=None, max_examples=150)
def test_a_sound_of_any_length_is_finite(label, samples, seed):
    sound = synthesize(label, samples / SAMPLE_RATE, seed)
    assert sound.shape == (samples,)
    assert np.isfinite(sound).all()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("snoring", 1.0, 0), "'snoring'"),
        (("speech", 0.0, 0), "0.0"),
        (("speech", float("nan"), 0), "nan"),
        (("speech", 301.0, 0), "301"),
        (("speech", 1.0, -1), "-1"),
    ],
)
def test_a_sound_that_cannot_be_is_refused_in_one_line(arguments, named):
    with pytest.raises(SimulationError) as error:
        synthesize(*arguments)
    assert named in str(error.value)
    assert one_line(error)


def test_the_training_set_is_what_its_manifest_says(tmp_path):
    manifest = write_training_set(tmp_path / "new" / "clips", clips_per_class=2, seed=3)
    assert manifest == tmp_path / "new" / "clips" / "manifest.csv"
    with manifest.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["path", "label", "source_group", "source", "licence", "seconds"]
    assert [row["label"] for row in rows] == [label for label in LABELS for _ in range(2)]
    assert set(LABELS) == GENERAL | {"flushing_water", "shower", "tap_water"}
    assert len({row["source_group"] for row in rows}) == len(rows)
    assert {row["licence"] for row in rows} == {"CC0"}
    assert {row["source"] for row in rows} == {"hearthlog simulated home"}
    for row in rows:
        info = soundfile.info(manifest.parent / row["path"])
        assert (info.format, info.samplerate, info.channels) == ("FLAC", SAMPLE_RATE, 1)
        assert 3.0 <= info.duration <= 5.0
        assert float(row["seconds"]) == pytest.approx(info.duration, abs=0.001)
    assert sum(1 for _ in manifest.parent.rglob("*.flac")) == len(rows)


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def test_a_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    for name, seed in [("first", 5), ("again", 5), ("other", 6)]:
        write_training_set(tmp_path / name / "clips", 1, seed)
        write_day(tmp_path / name / "day.flac", 2.0, seed)
    first = contents(tmp_path / "first")
    assert first == contents(tmp_path / "again")
    other = contents(tmp_path / "other")
    assert first.keys() == other.keys()
    assert not [path for path in first if first[path] == other[path]]


def test_a_training_set_never_overwrites(tmp_path):
    kept = tmp_path / "notes.txt"
    kept.write_text("mine")
    with pytest.raises(SimulationError) as error:
        write_training_set(tmp_path, 1, 0)
    assert str(tmp_path) in str(error.value)
    assert one_line(error)
    with pytest.raises(SimulationError, match="cannot be written"):
        write_training_set(kept / "clips", 1, 0)
    assert contents(tmp_path) == {kept.relative_to(tmp_path): b"mine"}


def test_a_training_set_needs_a_clip_of_each_class(tmp_path):
    with pytest.raises(SimulationError, match="at least 1"):
        write_training_set(tmp_path / "clips", 0, 0)


def test_the_truth_of_a_day_covers_it_without_holes_and_stands_beside_it(tmp_path):
    truth = write_day(tmp_path / "day.flac", 6.0, seed=1)
    info = soundfile.info(tmp_path / "day.flac")
    assert (info.format, info.samplerate, info.channels) == ("FLAC", SAMPLE_RATE, 1)
    assert info.frames == 6 * 60 * SAMPLE_RATE
    starts, ends, labels = zip(*truth.spans, strict=True)
    assert (starts[0], ends[-1]) == (0.0, 360.0)
    assert starts[1:] == ends[:-1]
    assert all(one != other for one, other in pairwise(labels))
    track = (tmp_path / "day.txt").read_text(encoding="utf-8").splitlines()
    read = [line.split("\t") for line in track]
    assert [label for *_, label in read] == list(labels)
    assert [float(start) for start, *_ in read] == pytest.approx(starts, abs=1e-6)
    assert [float(end) for _, end, _ in read] == pytest.approx(ends, abs=1e-6)
    with (tmp_path / "day.csv").open(newline="") as file:
        assert [row["label"] for row in csv.DictReader(file)] == [
            event.plan.clip.label for event in truth.events
        ]


def test_a_clip_that_cannot_be_read_completely_is_refused_in_one_line(tmp_path):
    noise = np.random.default_rng(1).normal(0, 0.1, 2 * SAMPLE_RATE)
    soundfile.write(tmp_path / "cut.flac", noise, SAMPLE_RATE)
    data = (tmp_path / "cut.flac").read_bytes()
    (tmp_path / "cut.flac").write_bytes(data[: len(data) // 2])
    noise[100] = np.nan
    soundfile.write(tmp_path / "nan.wav", noise, SAMPLE_RATE, subtype="FLOAT")
    rows = "cut.flac,speech,a,train\nnan.wav,yelling,b,train\n"
    (tmp_path / "m.csv").write_text(f"path,label,source_group,split\n{rows}")
    library = ClipLibrary(tmp_path / "m.csv")
    for label, why in (("speech", "cut short after"), ("yelling", "not finite")):
        (clip,) = library.of(label)
        with pytest.raises(SimulationError, match=f"{why}.*; take it out of the manifest"):
            library.sound(clip, 20)


def test_no_two_made_up_sounds_of_a_label_are_the_same():
    clips = MADE_UP.of("tap_water")
    alike = np.corrcoef([MADE_UP.sound(clip, 60) for clip in clips])
    assert np.abs(alike - np.eye(len(alike))).max() < 0.5


def test_a_day_of_24_minutes_holds_every_sound_in_a_plausible_order():
    library = ClipLibrary()
    for seed in range(10):
        plan = plan_short_day(24.0, library, seed)
        order = [label for label, _ in groupby(sound.clip.label for sound in plan.sounds)]
        assert set(order) == set(LABELS) - {"silence"}
        assert order[0] == order[-1] == "coughing"  # at night
        assert order[1:4] == ["flushing_water", "tap_water", "shower"]
        assert order[order.index("phone_ring") + 1] == "speech"
        assert order.index("laughing") < order.index("yelling")


@given(minutes=st.floats(1e-3, 1440.0), seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=100)
def test_a_day_of_any_length_is_planned(minutes, seed):
    plan = plan_short_day(minutes, MADE_UP, seed)
    assert plan.frames == round(minutes * 1200)
    assert all(0 <= sound.start < sound.end <= plan.frames for sound in plan.sounds)
    assert all(one.end <= other.start for one, other in pairwise(plan.sounds))


@pytest.mark.parametrize("existing", ["day.flac", "day.txt", "day.csv"])
def test_a_day_never_overwrites(tmp_path, existing):
    (tmp_path / existing).write_text("mine")
    with pytest.raises(SimulationError, match=existing):
        write_day(tmp_path / "day.flac", 1.0, 0)
    assert contents(tmp_path) == {(tmp_path / existing).relative_to(tmp_path): b"mine"}


@pytest.mark.parametrize(
    ("name", "minutes", "seed", "named"),
    [
        ("day.wav", 1.0, 0, "day.wav"),
        ("day.flac", 0.0, 0, "not 0.0"),
        ("day.flac", float("inf"), 0, "not inf"),
        ("day.flac", 1.0, -1, "not -1"),
        ("file/day.flac", 1.0, 0, "cannot be written"),
    ],
)
def test_a_day_that_cannot_be_is_refused_in_one_line(tmp_path, name, minutes, seed, named):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(SimulationError) as error:
        write_day(tmp_path / name, minutes, seed)
    assert named in str(error.value)
    assert one_line(error)
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]
