"""Several channels become one in which everything is heard; what is no number is a gap."""

from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from logs import features, read
from streams import LiveServer
from test_capture import recording, wait_for_frames
from test_network import Address

from hearthlog import classify, extract_features, load_model
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import WARNING, Frames, Gap, SourceHealth
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import StreamMixer, read_audio
from hearthlog.schemas.errors import SourceError

RATE = 16_000
START = 1_772_348_400_000_000_000
RNG = np.random.default_rng(5)


def noise(level, seconds=25):
    return RNG.normal(0, level, seconds * RATE)


def knocks(level=0.05):
    """Knocks, one every two seconds, in a quiet room."""
    sound = noise(3e-4)
    for at in range(RATE, len(sound) - RATE, 2 * RATE):
        sound[at : at + RATE // 4] += level * noise(1.0)[: RATE // 4]
    return sound


def written(path, *channels, rate=RATE):
    soundfile.write(path, np.stack(channels, axis=1), rate, subtype="FLOAT")
    return path


def labelled(path, **options):
    return np.concatenate([*read_audio(path, **options)])


SOUND, NOTHING = knocks(), np.zeros(25 * RATE)
ONE_GOOD = {
    "a sound and its negative": (SOUND, -SOUND),
    "its negative, and a bit louder": (SOUND, -0.9 * SOUND),
    "one of eight": (SOUND, *[NOTHING] * 7),
    "noise in another one": (SOUND, noise(0.02)),
    "noise and an offset": (SOUND, noise(0.02), NOTHING + 0.1),
    "no numbers in another one": (SOUND, NOTHING * np.nan),
}


@pytest.mark.parametrize("case", ONE_GOOD)
def test_the_best_channel_is_heard_where_the_mean_hides_sound(case, tmp_path):
    for place in (0, 1):
        channels = [*ONE_GOOD[case]]
        channels[0], channels[place] = channels[place], channels[0]
        reported = []
        path = written(tmp_path / f"{place}.wav", *channels)
        samples = labelled(path, chosen=reported.append)
        best = 0 if case == "a sound and its negative" else place
        np.testing.assert_array_equal(samples, channels[best].astype(np.float32))
        (line,) = reported
        number = best + 1
        assert line.startswith(f"channel {number} of {len(channels)} is heard alone: ")


FINE = {
    "the same twice": (SOUND, SOUND),
    "one of two": (SOUND, NOTHING),
    "two microphones of a room": (SOUND + noise(3e-4), np.roll(SOUND, 50) * 0.6 + noise(3e-4)),
    "unlike sounds": (SOUND, np.roll(knocks(), RATE)),
    "noise": (noise(0.01), noise(0.01)),
    "a voice in the middle of five": (SOUND, SOUND * 0.7, SOUND * 0.7, noise(3e-4), noise(3e-4)),
}


@pytest.mark.parametrize("case", FINE)
def test_other_channels_are_averaged_to_the_last_bit(case, tmp_path):
    reported = []
    path = written(tmp_path / "stereo.wav", *FINE[case])
    samples = labelled(path, chosen=reported.append)
    mean = np.stack(FINE[case], axis=1).astype(np.float32).mean(axis=1)
    np.testing.assert_array_equal(samples, mean)
    assert reported == []


def test_a_channel_is_kept_while_the_others_are_only_quiet(tmp_path):
    pause = noise(3e-4)
    path = written(
        tmp_path / "pause.wav",
        np.concatenate([SOUND[: 20 * RATE], pause, SOUND]),
        np.concatenate([noise(0.02, 20), noise(0.02), noise(0.02)]),
    )
    reported = []
    samples = labelled(path, chosen=reported.append)
    assert len(reported) == 1
    assert samples[20 * RATE : 45 * RATE].std() < 4e-4


def test_the_choice_is_told_in_the_log_and_at_the_end(tmp_path):
    path = written(tmp_path / "anti.wav", SOUND, -SOUND)
    source = FileSource([path], START)
    about = Settings(output=tmp_path / "logs", model="none", timezone="UTC")
    record_files(about, source, Flag())
    problem = "channel 1 of 2 is heard alone: their mean is much fainter"
    assert source.warnings == [f"{path}: {problem}"]
    states = [status for m in read(tmp_path / "logs", "diagnostics") for status in m.status]
    assert {(state.level, state.message) for state in states} == {(WARNING, problem)}


def test_a_channel_is_chosen_by_its_number(tmp_path):
    path = written(tmp_path / "two.wav", SOUND, noise(0.02))
    for number, channel in ((1, SOUND), (2, soundfile.read(path)[0][:, 1])):
        np.testing.assert_array_equal(labelled(path, channel=number), channel.astype(np.float32))
    with pytest.raises(SourceError) as error:
        FileSource([path], START, channel=3)
    assert str(error.value) == (
        f"{path}: has 2 channels, and `channel` asks for number 3: take one from 1 to 2"
    )


def test_a_channel_of_a_microphone_is_chosen_by_its_number(labmic, tmp_path):
    left, right = np.zeros(RATE, np.int16), np.round(noise(0.1, 1) * 32767).astype(np.int16)
    labmic.configure(data=np.stack([left, right], axis=1))
    with recording(labmic, tmp_path / "logs", "--channel", "2") as process:
        wait_for_frames(tmp_path / "logs", 40)
    assert process.returncode == 0, process.errors
    assert features(tmp_path / "logs")[2][:, 0].min() > 0.005
    with recording(labmic, tmp_path / "no", "--channel", "3") as process:
        process.wait(30)
    assert process.returncode == 1
    assert process.errors.strip().endswith(
        "microphone 'labmic' has 2 channels, and `channel` asks for number 3: take one from 1 to 2"
    )


INT16 = np.round(SOUND * 32767).astype(np.int16)
HISS = np.round(noise(0.02) * 32767).astype(np.int16)


@pytest.mark.parametrize(
    ("sounds", "takes_first", "number", "why"),
    [
        ([INT16, -INT16], False, 1, "their mean is much fainter"),
        ([INT16, HISS], False, 1, "the others hide it"),
        ([INT16, -INT16, INT16 // 2], True, 1, ""),
        ([INT16, HISS], True, 1, ""),
        ([HISS, INT16], True, 2, "the first one hides it"),
        ([INT16 // 8, INT16], True, 2, "the first one is much fainter"),
        ([INT16 // 2, INT16], True, 1, ""),
    ],
)
@pytest.mark.parametrize("size", [9600, 19_200])
def test_of_a_stream_too_the_best_channel_is_heard_and_told_once(
    sounds, takes_first, number, why, size
):
    mixer, mixed, news = StreamMixer(takes_first=takes_first), [], []
    for first in range(0, len(INT16), size):
        block = np.stack([each[first : first + size] for each in sounds], axis=1)
        mixed.append(mixer(block, RATE))
        news, mixer.news = [*news, mixer.news], ""
    best, late = sounds[number - 1], 2 * RATE
    np.testing.assert_array_equal(np.concatenate(mixed)[late:], best[late:])
    expected = [f"channel {number} of {len(sounds)} is heard alone: {why}"] if why else []
    assert [each for each in news if each] == expected


def test_channels_of_a_stream_that_do_not_hide_each_other_are_averaged():
    mixer = StreamMixer(takes_first=False)
    mixed = mixer(np.stack([INT16, INT16 // 2], axis=1), RATE)
    mean = (INT16.astype(float) + INT16 // 2) / 2
    assert np.abs(mixed - mean).max() <= 0.5
    assert not mixer.news


def test_a_sound_card_whose_first_channel_is_dead_is_heard_by_another_and_says_so(labmic, tmp_path):
    dead, sound = np.zeros(RATE, np.int16), np.round(noise(0.1, 1) * 32767).astype(np.int16)
    labmic.configure(data=np.stack([dead, sound, -sound, dead], axis=1))
    with recording(labmic, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 60)
    reported = "channel 2 of 4 is heard alone: the first one is much fainter"
    assert process.errors.count(reported) == 1
    states = [status for m in read(tmp_path / "logs", "diagnostics") for status in m.status]
    assert [state.message for state in states if state.level == WARNING] == [reported]
    assert features(tmp_path / "logs")[2][20:, 0].min() > 0.005


def test_a_server_whose_channels_cancel_is_heard_and_says_which_it_is(tmp_path):
    sound = np.round(noise(0.1, 3) * 32767).astype(np.int16)
    server = LiveServer(np.stack([sound, -sound], axis=1))
    try:
        with recording(Address(server.address), tmp_path / "logs") as process:
            wait_for_frames(tmp_path / "logs", 60)
    finally:
        server.close()
    assert process.errors.count("channel 1 of 2 is heard alone: their mean is much fainter") == 1
    assert features(tmp_path / "logs")[2][20:, 0].min() > 0.005


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("rate", [RATE, 44_100, 8000])
def test_what_is_no_number_is_a_gap_of_the_frames_that_hold_it(tmp_path, rate, value):
    sound = RNG.normal(0, 0.1, 25 * rate)
    hole = np.array([5.02, 17.03]) * rate
    broken = sound.copy()
    broken[slice(*hole.astype(int))] = value
    events = events_of(written(tmp_path / "broken.wav", broken, rate=rate))
    (gap,) = [event for event in events if isinstance(event, Gap)]
    assert (gap.start, gap.end) == (START + 5_000_000_000, START + 17_050_000_000)
    assert (gap.frames_lost, gap.reason) == (
        241,
        "samples are not finite (NaN or infinity)",
    )
    full = dict(frames_of(events))
    assert [*full] == [*range(100), *range(341, 500)]
    same = dict(frames_of(events_of(written(tmp_path / "whole.wav", sound, rate=rate))))
    for number in (0, 50, 345, 499):  # the zeros in the hole are heard some samples around it
        np.testing.assert_array_equal(full[number], same[number])


def events_of(path):
    return [e for e in FileSource([path], START).events(Flag()) if not isinstance(e, SourceHealth)]


def frames_of(events):
    return [
        (event.first + place, frame)
        for event in events
        if isinstance(event, Frames)
        for place, frame in enumerate(event.samples)
    ]


def test_holes_at_both_ends_are_gaps_and_a_file_of_nothing_else_is_refused(tmp_path):
    broken = noise(0.1)
    broken[:1000] = broken[-1] = np.nan
    first, sound, *more, last = events_of(written(tmp_path / "ends.wav", broken))
    assert (first.start, first.frames_lost, sound.first) == (START, 2, 2)
    assert (last.end, last.frames_lost) == (START + 25_000_000_000, 1)
    assert not any(isinstance(event, Gap) for event in more)
    path = written(tmp_path / "none.wav", noise(0.1) * np.nan)
    with pytest.raises(SourceError, match=r"none.wav: samples are not finite"):
        events_of(path)
    with pytest.raises(SourceError, match=r"none.wav: samples are not finite"):
        clip_frames(LabelledClip(path, "speech", "a", "b", "c"))
    with pytest.raises(SourceError, match="the samples are not finite"):
        extract_features(noise(0.1) * np.nan, RATE)


def test_the_api_labels_what_is_there_as_a_recorder_does_around_a_gap(tmp_path):
    sound = SOUND.copy()
    sound[10 * RATE : 12 * RATE] = np.nan
    labels = classify(load_model("general"), sound.astype(np.float32), RATE, START)
    about = Settings(output=tmp_path / "logs", model="general", timezone="UTC")
    record_files(about, FileSource([written(tmp_path / "a.wav", sound)], START), Flag())
    logged = read(tmp_path / "logs", "label")
    assert [m.label for m in logged] == labels.labels.tolist()
    recorded = np.array([m.probabilities for m in logged])
    np.testing.assert_array_equal(recorded, labels.probabilities)
    assert np.diff(labels.times).max() > 2_000_000_000


def talking(is_on, seconds=40):
    """Sound in bursts of an eighth of a second while a talker talks, in a quiet room."""
    times = np.arange(seconds * RATE) / RATE
    rng = np.random.default_rng(int(1e6 * is_on(times).mean()) + seconds)
    bursts = np.abs(np.sin(4 * np.pi * times)) * is_on(times)
    return rng.normal(0, 0.05, len(times)) * bursts + rng.normal(0, 3e-4, len(times))


TALK = talking(np.ones_like)
SECONDS = np.arange(len(TALK)) / RATE
QUIET = RNG.normal(0, 3e-4, len(TALK))
CHANGES = {  # what two channels hold, whether the first one is usual, and how often it changes
    "a wire of two with opposite phase breaks": (TALK * (SECONDS < 20) + QUIET, -TALK, False, 2),
    "the first one dies": (TALK * (SECONDS < 20), TALK, True, 1),
    "the first one fades": (TALK * np.clip(2 - SECONDS / 15, 0, 1) + QUIET, -TALK, True, 1),
    "the first one fades to noise": (
        TALK * (SECONDS < 20) + RNG.normal(0, 2e-3, len(TALK)),
        TALK,
        True,
        1,
    ),
    "talkers in turn, each at one": (
        talking(lambda times: times % 2 < 1),
        talking(lambda times: times % 2 >= 1.001),
        True,
        2,
    ),
    "talkers in long turns": (
        talking(lambda times: times % 14 < 7),
        talking(lambda times: times % 14 >= 7.001),
        True,
        2,
    ),
}


@pytest.mark.parametrize("case", CHANGES)
def test_sound_in_one_channel_alone_is_heard_within_a_second_and_seldom_changes_it(case):
    *channels, takes_first, most = CHANGES[case]
    sound = np.round(np.stack(channels, axis=1) * 32767).astype(np.int16)
    streams, news = [], []
    for size in (9600, 997, len(sound)):
        mixer, mixed = StreamMixer(takes_first=takes_first), []
        for first in range(0, len(sound), size):
            mixed.append(mixer(sound[first : first + size], RATE))
            news, mixer.news = [*news, mixer.news], ""
        streams.append(np.concatenate(mixed))
        if size == 9600:
            changes = [each for each in news if each]
    assert 1 <= len(changes) <= most
    for other in streams[1:]:
        np.testing.assert_array_equal(other, streams[0])
    assert longest_deafness(sound, streams[0]) <= 0.8


@pytest.mark.parametrize("case", CHANGES)
def test_of_a_file_sound_in_one_channel_alone_is_heard_from_its_beginning(case, tmp_path):
    channels = CHANGES[case][:2]
    reported = []
    samples = labelled(written(tmp_path / "two.wav", *channels), chosen=reported.append)
    assert len(reported) <= 2
    assert longest_deafness(np.stack(channels, axis=1) * 32767, samples * 32767) <= 0.1


def longest_deafness(sound, mixed):
    """Return for how many seconds at most a mix is 12 dB fainter than the loudest channel."""
    powers = sound.reshape(-1, RATE // 10, 2).astype(float).var(axis=1).max(axis=1)
    is_deaf = (mixed.reshape(-1, RATE // 10).astype(float).var(axis=1) * 16 < powers) & (
        powers > (0.005 * 32767) ** 2
    )
    return max(len(run) for run in "".join(" x"[int(deaf)] for deaf in is_deaf).split(" ")) / 10


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("other", ["noise", "the sound", "nothing"])
def test_one_sample_that_is_no_number_makes_no_channel_deaf(other, value, tmp_path):
    sound = TALK.copy()
    sound[12 * RATE] = value
    channels = {"noise": QUIET, "the sound": TALK * 0.8, "nothing": QUIET * 0}
    reported = []
    samples = labelled(
        written(tmp_path / "hole.wav", sound, channels[other]), chosen=reported.append
    )
    assert reported == []
    assert np.isnan(samples).sum() == (other != "the sound")
    assert longest_deafness(np.stack([TALK, TALK], axis=1), np.nan_to_num(samples) * 2) == 0


def test_a_microphone_goes_to_the_channel_that_holds_the_sound_and_says_so_live(labmic, tmp_path):
    sound = np.round(TALK[: RATE * 8] * 32767).astype(np.int16)
    labmic.configure(data=np.stack([np.zeros_like(sound), sound], axis=1))
    with recording(labmic, tmp_path / "logs") as process:
        wait_for_frames(tmp_path / "logs", 120)
    reported = "mic: channel 2 of 2 is heard alone: the first one is much fainter"
    assert process.errors.count(reported) == 1
    states = [status for m in read(tmp_path / "logs", "diagnostics") for status in m.status]
    assert reported.removeprefix("mic: ") in {s.message for s in states if s.level == WARNING}
