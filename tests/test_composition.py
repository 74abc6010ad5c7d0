"""Sounds of a home are composed of real clips in its rooms, with known truth."""

import csv
import shutil

import numpy as np
import pytest
import soundfile

from hearthlog.models.classifiers.model import may_be_shipped
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.clips import SHIPPED, ClipLibrary, frame_powers
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import (
    HomePlan,
    PlannedSound,
    plan_short_day,
)
from hearthlog.tools.home.simulate import truth_of


@pytest.mark.parametrize(("level", "labelled"), [(-15.0, True), (-55.0, False)])
def test_of_two_sounds_the_louder_one_is_true(clip_library, living_room, level, labelled):
    speech, cough = clip_library.of("speech")[0], clip_library.of("coughing")[0]
    sounds = [
        PlannedSound(100, 400, speech, "television", "living_room", -35.0, "television"),
        PlannedSound(200, 20, cough, "resident", "living_room", level, "day"),
    ]
    truth = truth_of(Composition(HomePlan(600, sounds, ()), clip_library, living_room))
    here = {name for start, end, name in truth.spans if start < 220 / 20 and end > 200 / 20}
    assert ("coughing" in here) is labelled
    assert {name for *_, name in truth.spans} >= {"speech", "silence"}
    assert [event.plan.origin for event in truth.events] == ["television", "resident"]
    assert bool(truth.events[1].audible_frames) is labelled


def test_what_is_not_heard_through_a_wall_is_silence(clip_library):
    tap = clip_library.of("tap_water")[0]
    sound = PlannedSound(20, 100, tap, "resident", "bathroom", -62.0, "washing")
    for room, labelled in (("bathroom", True), ("living_room", False)):
        rooms = Rooms(room, seed=0)
        rooms.floor *= 1e-2 ** (room == "bathroom")
        truth = truth_of(Composition(HomePlan(200, [sound], ()), clip_library, rooms))
        assert bool(truth.events[0].audible_frames) is labelled
        assert (len(truth.spans) > 1) is labelled


def test_walls_take_level_and_the_high_frequencies_first(clip_library):
    sound = clip_library.sound(clip_library.of("coughing")[0], 20)
    near, far = (Rooms(room, seed=0).received(sound, "bedroom") for room in ("bedroom", "bathroom"))
    assert 11 < 10 * np.log10(frame_powers(near).mean() / frame_powers(far).mean()) < 25
    bright = [np.abs(np.fft.rfft(one))[len(one) // 4 :].std() for one in (near, far)]
    dark = [np.abs(np.fft.rfft(one))[: len(one) // 16].std() for one in (near, far)]
    assert bright[0] / bright[1] > 2 * dark[0] / dark[1]


def test_a_clip_is_cut_or_repeated_to_a_length_as_loud_as_every_other(clip_library):
    for label in ("coughing", "music", "shower"):
        for clip in clip_library.of(label):
            for frames in (clip.frames, 10, 400):
                sound = clip_library.sound(clip, frames)
                assert sound.shape == (frames * FRAME_SAMPLES,)
                assert abs(sound[0]) < 0.01 > abs(sound[-1])
            assert 0.2 < frame_powers(clip_library.sound(clip, clip.frames)).max() < 200


def test_every_shipped_clip_may_be_given_away_and_says_whose_it_is():
    with SHIPPED.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = "path label source_group source licence seconds detail credit url"
    assert list(rows[0]) == columns.split()
    for row in rows:
        assert may_be_shipped(row["licence"])
        assert row["source"]
        assert row["credit"]
        assert row["url"].startswith("https://")
        info = soundfile.info(SHIPPED.parent / row["path"])
        assert (info.format, info.samplerate, info.channels) == ("FLAC", SAMPLE_RATE, 1)
        assert float(row["seconds"]) == pytest.approx(info.duration, abs=0.001)
        assert info.duration <= 10.0
    found = [path for path in SHIPPED.parent.rglob("*") if path.is_file()]
    assert len(found) == len(rows) + 1
    assert sum(path.stat().st_size for path in found) <= 4_000_000


def test_what_a_manifest_lacks_is_made_up_and_the_table_says_so(tmp_path):
    clips = tmp_path / "clips"
    clips.mkdir()
    shutil.copy(SHIPPED.parent / "coughing" / "coughing_01.flac", clips / "cough.flac")
    manifest = clips / "manifest.csv"
    manifest.write_text("path,label,source_group\ncough.flac,coughing,me\n")
    library = ClipLibrary(manifest)
    assert [clip.name for clip in library.of("coughing")] == ["cough.flac"]
    assert all(clip.path is None for clip in library.of("speech"))
    assert library.of("other_negative") == []
    assert "speech" in library.made_up
    assert "coughing" not in library.made_up
    assert plan_short_day(10, library, 1).sounds


@pytest.mark.parametrize(
    ("rows", "output"),
    [
        ("gone.flac,coughing,me", "no such file"),
        ("broken.flac,coughing,me", "take it out of"),
        ("short.flac,coughing,me", "shorter than a frame"),
        ("long.flac,silence,me", "no sound but silence"),
        ("", "lists no clips"),
    ],
)
def test_clips_that_cannot_be_used_are_named_in_one_line(tmp_path, rows, output):
    (tmp_path / "broken.flac").write_bytes(b"no audio")
    for name, samples in (("short", 300), ("long", 9000)):
        soundfile.write(tmp_path / f"{name}.flac", np.zeros(samples), SAMPLE_RATE)
    manifest = tmp_path / "manifest.csv"
    manifest.write_text(f"path,label,source_group\n{rows}\n")
    with pytest.raises(HearthlogError, match=output) as error:
        ClipLibrary(manifest)
    assert "\n" not in str(error.value)
