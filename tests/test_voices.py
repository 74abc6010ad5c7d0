"""Voices are told apart where somebody speaks, are known again, and get a name."""

import csv
import json
import shutil
from threading import Event

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

import numpy as np
import soundfile
from conversations import (
    ALLISON,
    DAY,
    START,
    THEO,
    record_conversation,
    two_spoken_days,
    two_voices,
)
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import save_file

from hearthlog.analyzer.discover import NO_CLUSTER
from hearthlog.analyzer.discover.speech import (
    HomeSpeech,
    SpeechFrames,
    find_voices,
    louder_elsewhere,
    may_be_speech,
    read_speech,
    speech_spans,
    speech_voices,
    spoken_spans,
)
from hearthlog.analyzer.discover.voices import (
    VOICES,
    HomeVoices,
    VoiceEvidence,
    describe_speech,
    has_voices,
    load_voices,
    merged_voices,
    same_voice,
    save_voices,
    separate_voices,
    summed,
    voice_space,
    window_starts,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.export.merge import merge_logs
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.review.lanes import timeline_lanes
from hearthlog.analyzer.review.timeline import LabelledSpans
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.training.speakers import speaker_recordings
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import NANOSECONDS, read_time
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.lab.conversations import converse

SPREAD = voice_space().spread


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return two_voices(tmp_path_factory.mktemp("clips"))


@pytest.fixture(scope="module")
def two_days(tmp_path_factory):
    return two_spoken_days(tmp_path_factory.getbasetemp())


@pytest.fixture
def home(two_days, tmp_path):
    """A copy of the logs."""
    return shutil.copytree(two_days[0], tmp_path / "logs")


def reported(logs, known=None):
    """Tell voices apart; return them, and when each speaks."""
    speech = read_speech(find_home_logs([logs]))
    voices, of = find_voices(speech, known)
    return voices, of[speech.voice], speech


def seconds_by(voice, of, speech, turns, start):
    """How long each voice that was found speaks in the turns of a person."""
    sums = dict.fromkeys(set(of.tolist()), 0.0)
    for first, last, found in zip(speech.starts, speech.ends, of, strict=True):
        for turn in turns:
            if turn.voice == voice:
                times = ((each - start) / NANOSECONDS for each in (first, last))
                begin, end = max(next(times), turn.start), min(next(times), turn.end)
                sums[int(found)] += max(end - begin, 0.0)
    return sums


def run(hearthlog, *arguments):
    done = hearthlog("voices", *arguments)
    assert done.returncode == 0, done.stderr
    return done


def as_json(hearthlog, *arguments):
    return json.loads(run(hearthlog, *arguments, "--json").stdout)


def test_two_people_who_talk_are_two_voices_on_both_days(two_days):
    logs, days = two_days
    voices, of, speech = reported(logs)
    assert voices.numbers.tolist() == [1, 2]
    whose = set()
    for day, turns in enumerate(days):
        for person in (THEO, ALLISON):
            sums = seconds_by(person, of, speech, turns, START + day * DAY)
            voice = max(sums, key=sums.get)
            assert sums[voice] > 0.8 * sum(sums.values())
            whose.add((person, voice))
    assert len(whose) == 2, "each has the same voice on both days, and no two have one"


def test_one_person_is_one_voice(clips, tmp_path):
    logs, _ = record_conversation({ALLISON: clips[ALLISON]}, tmp_path, START, 3)
    voices, of, _ = reported(logs)
    assert voices.numbers.tolist() == [1]
    assert set(of.tolist()) == {0}


def test_the_voices_of_one_day_are_known_again_on_the_next(clips, two_days, tmp_path):
    first, _ = record_conversation(clips, tmp_path, START - DAY, 5)
    known, _, _ = reported(first)
    voices, of, _ = reported(two_days[0], known)
    assert voices.numbers.tolist() == [1, 2]
    assert np.array_equal(voices.evidence.sums, known.evidence.sums)
    assert NO_CLUSTER not in of


def speech_with(voices):
    """Speech of which the voices alone are known."""
    none = np.empty(0, np.int64)
    return HomeSpeech([], [], none, none, none, none, [], 0, none, voices)


def test_each_voice_of_a_conversation_is_the_one_that_is_like_it():
    where, of = points(3, 3, 40)
    likes = summed(where[::2], of[::2], 3)
    evidence = likes.rows(np.array([0, 1]))
    known = HomeVoices(np.array([4, 7]), evidence, names=["anna", ""], id="0" * 8)
    recorded = summed(where[1::2], of[1::2], 3).rows(np.array([1, 2, 0]))
    voices, found = find_voices(speech_with(recorded), known)
    assert voices.numbers[found].tolist() == [7, 8, 4]
    assert voices.names == ["anna", "", ""]
    few = summed(where[80:100:2], of[80:100:2], 3).rows(np.array([2]))
    _, found = find_voices(speech_with(few), known)
    assert found.tolist() == [NO_CLUSTER], "of five seconds nobody new is made"


def test_turns_lie_where_the_labels_say_speech(two_days):
    _, _, speech = reported(two_days[0])
    starts, ends = speech.starts, speech.ends
    assert (starts[1:] >= ends[:-1]).all()
    assert 60 < speech.seconds < 110, "of two minutes with pauses"


def columns_of(kind, names, **fields):
    stamps = fields["header.stamp"]
    metadata = {"probabilities_names": json.dumps(names)}
    return Columns(f"/mic/{kind}", "", metadata, stamps, stamps, stamps, fields)


def test_what_may_well_be_speech_is_speech_whatever_its_label():
    seconds = np.arange(4) * NANOSECONDS
    names = ["coughing", "silence", "speech"]
    segments = columns_of(
        "segment",
        names,
        **{
            "header.stamp": seconds,
            "duration": np.full(4, NANOSECONDS),
            "label": np.array(["coughing", "silence", "coughing", "speech"], object),
        },
    )
    likely = np.repeat([0.4, 0.9, 0.2, 0.1], 20)
    stamps = np.arange(80) * NANOSECONDS // 20
    probabilities = np.stack([1 - likely, 0 * likely, likely], axis=1)
    order = np.roll(np.arange(80), 30)  # as of a clock that was set back
    fields = {"header.stamp": stamps[order], "probabilities": probabilities[order]}
    labels = columns_of("label", names, **fields)
    assert may_be_speech(segments).tolist() == [True, False, True, False]
    assert speech_spans(segments, labels).starts.tolist() == [0, 3 * NANOSECONDS]
    assert speech_spans(segments).starts.tolist() == [3 * NANOSECONDS]
    for others in (names[:2], ["a", "b", "c"]):
        labels = columns_of("label", others, **fields)
        assert speech_spans(segments, labels).starts.tolist() == [3 * NANOSECONDS]


def test_a_voice_gets_a_name_is_enrolled_and_loses_the_name_again(home, hearthlog, tmp_path):
    enrolled = tmp_path / "voices"
    done = run(hearthlog, home, "--name", "1=Anna", "--home", enrolled)
    assert "s of anna enrolled in" in done.stderr
    logs = [path for path in enrolled.rglob("anna_*.mcap") if "review" not in path.name]
    assert len(logs) > 1
    listed = as_json(hearthlog, home)["voices"]
    assert [each["name"] for each in listed] == ["anna", ""]
    undone = as_json(hearthlog, home, "--undo", "1")["voices"]
    assert [each["name"] for each in undone] == ["", ""]
    assert not list(home.rglob("*.review.mcap")), "no mark corrects the labels of the home"


def enrolled_logs(folder):
    return sorted(each for each in folder.rglob("*.mcap") if "review" not in each.name)


def test_a_voice_is_enrolled_of_both_days_and_a_second_time_without_a_change(
    home, hearthlog, tmp_path
):
    voices = tmp_path / "voices"
    options = "--name", "1=anna", "--home", voices
    first = run(hearthlog, home, *options)
    logs = enrolled_logs(voices)
    assert {each.parent.name for each in logs} == {"01", "02"}
    sources = {each.group for each in speaker_recordings([voices], DEFAULT)}
    assert len(sources) == 2 < len(logs), "turns of one conversation are one source"
    logs[0].unlink()
    again = run(hearthlog, home, *options)
    assert enrolled_logs(voices) == logs
    assert again.stderr == first.stderr


@pytest.fixture(scope="module")
def rooms(clips, tmp_path_factory):
    """Logs of one time: people in the kitchen, whom the hall hears as well, and in the bath."""
    folder = tmp_path_factory.mktemp("rooms")
    kitchen, _ = converse(clips, 40.0, 1)
    bath, _ = converse(clips, 40.0, 9)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, len(kitchen))
    hall = (0.4 * np.roll(kitchen, 1200) + noise).astype(np.float32)
    for name, samples in (("kitchen", kitchen), ("hall", hall), ("bath", bath)):
        path = folder / f"{name}.flac"
        soundfile.write(path, samples, 16_000)
        microphone = MicrophoneSettings(name=name)
        settings = Settings(
            output=folder / name, model=starter_file(GENERAL), microphone=[microphone], node=name
        )
        record(settings, FileSource([path], START), Event())
    return folder


def speech_of(*logs):
    return read_speech(find_home_logs(logs))


def test_what_two_microphones_hear_is_of_the_louder_one_alone(rooms):
    alone = speech_of(rooms / "kitchen")
    for logs in ((rooms / "kitchen", rooms / "hall"), (rooms / "hall", rooms / "kitchen")):
        both = speech_of(*logs)
        names = np.array(both.microphones)[both.microphone]
        seconds = (both.ends - both.starts)[names == "kitchen"].sum() / NANOSECONDS
        assert seconds > 0.95 * alone.seconds > 15
        assert both.seconds < 1.05 * alone.seconds
        assert len(both.voices.counts) == len(np.unique(both.voice))
    assert speech_of(rooms / "hall").seconds > 0.8 * alone.seconds


def test_people_who_speak_at_once_in_two_rooms_are_both_heard(rooms):
    kitchen, bath = (speech_of(rooms / name).seconds for name in ("kitchen", "bath"))
    assert speech_of(rooms / "kitchen", rooms / "bath").seconds > 0.95 * (kitchen + bath)


def test_what_is_said_when_the_time_asked_for_begins_and_ends_is_heard_as_in_the_whole(rooms):
    home = find_home_logs([rooms / "kitchen"])
    full = read_speech(home)
    for cut in [START + second * NANOSECONDS for second in range(5, 40, 5)]:
        parts = read_speech(home, None, cut), read_speech(home, cut, None)
        assert sum(part.seconds for part in parts) == pytest.approx(full.seconds, abs=0.5)


@pytest.mark.parametrize("late", [-3, 0, 3])
def test_what_was_left_out_leaves_nothing_out(late):
    frames, turn = np.arange(200), np.zeros(200, np.int64)
    loudness = np.random.default_rng(1).normal(-40.0, 10.0, 200)
    moved = (np.arange(200) >= 140).astype(np.int64)  # away from the other microphone
    one = SpeechFrames(frames, loudness, turn)
    other = SpeechFrames(frames + late, loudness + np.where(moved, -3.0, 6.0), moved)
    assert [each.tolist() for each in louder_elsewhere([one, other])] == [[True], [False, False]]


def test_a_log_that_is_there_twice_counts_once(rooms, tmp_path):
    alone = speech_of(rooms / "kitchen")
    shutil.copytree(rooms / "kitchen", tmp_path / "again")
    both = speech_of(rooms / "kitchen", tmp_path / "again")
    assert both.seconds == alone.seconds
    assert np.array_equal(both.voices.sums, alone.voices.sums)


def test_a_voice_in_a_log_of_two_microphones_is_enrolled(rooms, hearthlog, tmp_path):
    both = tmp_path / "logs"
    both.mkdir()
    sources = find_logs(rooms / "kitchen") + find_logs(rooms / "bath")
    merge_logs(select(sources), both / "both.mcap")
    done = hearthlog("voices", both, "--name", "1=anna", "--home", tmp_path / "voices")
    assert done.returncode == 0, done.stderr
    logs = enrolled_logs(tmp_path / "voices")
    assert logs
    assert all(len(find_coverage(each)) == 1 for each in logs)


def test_a_voice_that_cannot_be_enrolled_gets_no_name(home, hearthlog, tmp_path):
    (tmp_path / "file").touch()
    done = hearthlog("voices", home, "--name", "1=anna", "--home", tmp_path / "file")
    assert done.returncode == 1
    assert not (home / VOICES.file).exists()


def test_who_speaks_when_is_a_table(home, hearthlog, tmp_path):
    table = tmp_path / "turns.csv"
    run(hearthlog, home, "--name", "2=ben", "--output", table)
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["voice"] for row in rows} == {"voice 1", "ben"}
    assert {row["microphone"] for row in rows} == {"mic"}
    starts = [read_time(row["start"]) for row in rows]
    assert starts == sorted(starts)
    again = hearthlog("voices", home, "--output", table)
    assert again.returncode == 1
    assert "exists already" in again.stderr


def test_the_review_shows_who_speaks(home, hearthlog, tmp_path):
    drawing = tmp_path / "day.rrd"
    run(hearthlog, home, "--name", "2=ben")
    shown = hearthlog("review", home, "--voices", home / VOICES.file, "--save", drawing)
    assert shown.returncode == 0, shown.stderr
    timeline = read_timeline([home])
    speech = read_speech(find_home_logs([home]))
    spans = spoken_spans(speech, *find_voices(speech, load_voices(home / VOICES.file)))["mic"]
    timeline.microphones["mic"].spoken = LabelledSpans(*spans)
    (lane,) = [each for each in timeline_lanes(timeline) if each.name == "Voices"]
    assert set(lane.spans.texts) == {"Voice 1", "Ben"}


def test_too_little_speech_is_told(clips, tmp_path, hearthlog):
    logs, _ = record_conversation(clips, tmp_path, START, 1, seconds=20)
    done = hearthlog("voices", logs)
    assert done.returncode == 1
    assert "s of speech are too few to tell voices apart: it takes 20 s" in done.stderr
    assert not (logs / VOICES.file).exists()


@pytest.mark.parametrize(
    ("options", "status", "reason"),
    [
        (("--name", "1=speech"), 2, "speech is a class of sound; give a person's name"),
        (("--home", "voices"), 2, "--home goes with --name"),
        (("--output", "turns.txt"), 2, "a table is named *.csv"),
    ],
)
def test_wrong_use_is_told(home, hearthlog, options, status, reason):
    done = hearthlog("voices", home, *options)
    assert done.returncode == status
    assert reason in done.stderr
    assert not (home / VOICES.file).exists()


def points(draw_seed, voices, each):
    """Points of voices, each of which differs along an axis of its own."""
    rng = np.random.default_rng(draw_seed)
    means = 8 * np.eye(voices, len(SPREAD))
    of = np.repeat(np.arange(voices), each)
    return means[of] + rng.standard_normal((len(of), len(SPREAD))), of


@given(seed=st.integers(0, 999), voices=st.integers(1, 4))
def test_voices_far_apart_are_told_apart_whatever_their_order(seed, voices):
    where, of = points(seed, voices, 20)
    order = np.random.default_rng(seed).permutation(len(of))
    found = merged_voices(VoiceEvidence(np.ones(len(of)), where[order]))
    pairs = set(zip(found.tolist(), of[order].tolist(), strict=True))
    assert len(pairs) == len(np.unique(found)) == voices


@given(seed=st.integers(0, 999))
def test_one_voice_with_another_is_as_likely_as_the_other_with_it(seed):
    where, of = points(seed, 2, 8)
    evidence = summed(where, of, 2)
    one, other = evidence.rows(np.array([0])), evidence.rows(np.array([1]))
    assert same_voice(one, other) == pytest.approx(same_voice(other, one))
    assert same_voice(one, one) > same_voice(one, other)


def test_a_few_words_of_nobody_else_go_to_who_else_speaks():
    where, _ = points(1, 2, 40)
    where[40:] = where[:40].mean(axis=0)
    where[60:64] += 12.0
    assert separate_voices(where, 10).max() == 0
    assert separate_voices(where, 2).max() == 1


def test_a_louder_voice_is_the_same_voice(clips):
    frames = np.concatenate(clips[ALLISON])
    frames = frames[: len(frames) // 800 * 800].reshape(-1, 800)
    names = DEFAULT.feature_names
    soft, loud = (
        voice_space().points(describe_speech(DEFAULT.extractor()(frames * gain), names))
        for gain in (0.3, 0.9)
    )
    away = np.linalg.norm(soft - loud, axis=1)
    steps = np.linalg.norm(np.diff(loud, axis=0), axis=1)
    assert np.median(away) < 0.4 * np.median(steps)


def test_every_frame_of_speech_is_in_a_turn(clips):
    samples, _ = converse(clips, 30.0, 2)
    values = DEFAULT.extractor()(samples[:480_000].reshape(-1, 800))
    stamps = np.arange(len(values)) * 50_000_000
    starts, ends, *_ = speech_voices(stamps, values, DEFAULT.feature_names)
    assert starts[0] == 0
    assert ends[-1] == len(values) * 50_000_000
    assert np.array_equal(starts[1:], ends[:-1])


@given(frames=st.integers(1, 500))
def test_windows_cover_speech_of_any_length(frames):
    starts = window_starts(frames)
    assert starts[0] == 0
    assert frames < 30 or 0 <= frames - (starts[-1] + 30) < 10
    values = np.random.default_rng(frames).random((frames, DEFAULT.width), np.float32)
    assert len(describe_speech(values, DEFAULT.feature_names)) == len(starts)


def test_features_of_other_sets_have_no_voices():
    assert has_voices(DEFAULT.feature_names)
    assert not has_voices(["energy", "octave_1"])


def a_file(tmp_path):
    numbers, counts = np.array([1, 2]), np.array([30.0, 20.0])
    voices = HomeVoices(
        numbers, VoiceEvidence(counts, np.ones((2, len(SPREAD)))), names=["anna", ""], id="0" * 8
    )
    path = tmp_path / VOICES.file
    save_voices(voices, path)
    return path


def test_a_file_of_voices_is_read_as_it_was_written(tmp_path):
    voices = load_voices(a_file(tmp_path))
    assert voices.names == ["anna", ""]
    assert voices.evidence.counts.tolist() == [30.0, 20.0]
    assert load_voices(tmp_path / "none") is None


@pytest.mark.parametrize(
    "spoilt",
    [
        {"numbers": np.array([1, 1])},
        {"numbers": np.array([0, 1])},
        {"counts": np.array([np.nan, 1.0])},
        {"counts": np.array([0.0, 1.0])},
        {"sums": np.full((2, len(SPREAD)), np.inf)},
        {"sums": np.ones((2, 3))},
        {"counts": np.ones(2, np.float32)},
        {"more": np.ones(2)},
    ],
)
def test_a_file_of_voices_that_cannot_be_is_refused(tmp_path, spoilt):
    path = tmp_path / VOICES.file
    arrays = {
        "numbers": np.array([1, 2]),
        "counts": np.ones(2),
        "sums": np.ones((2, len(SPREAD))),
    }
    head = json.dumps({"format": 1, "id": "0" * 8, "names": ["anna", ""]})
    save_file(arrays, path, {"hearthlog_voices": head})
    assert load_voices(path) is not None
    save_file(arrays | spoilt, path, {"hearthlog_voices": head})
    with pytest.raises(DataError, match="is damaged; move it away to begin anew"):
        load_voices(path)


@pytest.mark.parametrize("sums", [np.nan, np.inf, 2e9])
def test_voices_that_could_not_be_read_are_not_written(tmp_path, sums):
    evidence = VoiceEvidence(np.ones(1), np.full((1, len(SPREAD)), sums))
    path = tmp_path / VOICES.file
    with pytest.raises(DataError, match="not written, for some speech has features that no sound"):
        save_voices(HomeVoices(np.array([1]), evidence, names=[""], id="0" * 8), path)
    assert not path.exists()


@pytest.mark.parametrize(
    ("name", "value"), [("energy", -1.0), ("mfcc_2", 3e38), ("mfcc_2", np.nan), ("energy", np.inf)]
)
def test_frames_that_no_sound_can_have_are_of_no_voice(two_days, monkeypatch, name, value):
    spoilt = DEFAULT.feature_names.index(name)
    full = read_speech(find_home_logs([two_days[0]])).seconds

    def read_spoilt(*arguments, **options):
        columns = read_columns(*arguments, **options)
        if "/mic/features" in columns:
            columns["/mic/features"]["values"][:400, spoilt] = value
        return columns

    monkeypatch.setattr("hearthlog.analyzer.discover.speech.read_columns", read_spoilt)
    speech = read_speech(find_home_logs([two_days[0]]))
    assert 10 < full - speech.seconds <= 40, "of twenty seconds in each of two logs"
    assert np.isfinite(speech.voices.sums).all()
    assert np.abs(speech.voices.sums).max() < 1e5


def test_conversations_have_the_turns_that_they_say(clips):
    samples, turns = converse(clips, 40.0, 4)
    power = (samples[: len(samples) // 800 * 800].reshape(-1, 800) ** 2).mean(axis=1)
    inside = np.zeros(len(power), bool)
    for turn in turns:
        inside[int(turn.start * 20) : int(turn.end * 20) + 1] = True
    assert power[inside].mean() > 20 * power[~inside].mean()
    assert {turn.voice for turn in turns} == {THEO, ALLISON}
    again, _ = converse(clips, 40.0, 4)
    assert np.array_equal(samples, again)
