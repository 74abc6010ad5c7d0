"""What a network gives is logged where there is sound, and labels come from what is logged."""

import itertools
import json
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import NO_AUXILIARY, Auxiliary, EmbeddingEvidence
from hearthlog.models.embedding import NO_EMBEDDINGS, WINDOW_FRAMES, Embeddings
from hearthlog.models.embedding.networks import YAMNET, EmbeddingStream, SteadyNoise, load_embedder
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file, with_network
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.recorder.stream.privacy_filter import (
    NAMED_FRAMES,
    PRIVATE_LOGIT,
    EmbeddingPrivacyFilter,
    LoggedFrames,
    PrivateFrames,
)
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.messages.topics import EmbeddingSource

START = 1_772_000_000_000_000_000
SOURCE = EmbeddingSource("yamnet", "a" * 64, "b" * 64, ("one", "two"), (0.25, 0.5))


class Doubling:
    """An embedder that needs no network: the least and the greatest sample, in hundredths."""

    source = SOURCE

    def __call__(self, window):
        return np.rint(100 * np.array([window.min(), window.max()])).astype(np.int8)


def as_they_are(values):
    """Evidence that is the integers."""
    return values.astype(np.float64)


@pytest.fixture(scope="module")
def embedder():
    pytest.importorskip("ai_edge_litert")
    path = Path(__file__).parents[2] / "shared" / "data" / "networks" / "yamnet.tflite"
    if not path.exists():
        pytest.skip("needs the network, in ../shared/data/networks")
    return load_embedder(YAMNET.name, path)


def stamps_of(first, count):
    return START + np.arange(first, first + count) * FRAME_NANOSECONDS


def pushed(stream, frames, sound, first, sizes):
    """Push frames in pieces and join what comes."""
    parts, begin, sizes = [NO_EMBEDDINGS], 0, itertools.cycle(sizes)
    while begin < len(frames):
        rows = slice(begin, begin + next(sizes))
        stamps = stamps_of(first + begin, len(frames[rows]))
        parts.append(stream.push(frames[rows], sound[rows], first + begin, stamps))
        begin = rows.stop
    return reduce(lambda one, other: one.followed_by(other), parts)


def same(one, other):
    return all(np.array_equal(vars(one)[name], vars(other)[name]) for name in vars(one))


def embeddings_at(*frames):
    numbers = np.array(frames, np.int64)
    values = np.stack([numbers % 100, -(numbers % 100)], axis=1).astype(np.int8)
    return Embeddings(numbers, START + numbers * FRAME_NANOSECONDS, values)


@pytest.mark.parametrize("first", [0, 3, 10, 1237])
@pytest.mark.parametrize("sizes", [(1,), (7, 20, 3), (1000,)])
def test_windows_begin_at_tens_of_frames_and_are_the_same_in_pieces_of_any_size(first, sizes):
    frames = np.random.default_rng(first).uniform(-1, 1, (120, FRAME_SAMPLES)).astype(np.float32)
    sound = np.ones(120, bool)
    full = pushed(EmbeddingStream(Doubling()), frames, sound, first, (len(frames),))
    assert same(full, pushed(EmbeddingStream(Doubling()), frames, sound, first, sizes))
    begins = [n for n in range(first, first + 120 - WINDOW_FRAMES + 1) if n % 10 == 0]
    assert full.frames.tolist() == begins
    assert full.stamps.tolist() == [START + n * FRAME_NANOSECONDS for n in begins]


def test_only_windows_with_sound_within_half_a_second_of_their_middle_are_embedded():
    sound = np.zeros(200, bool)
    sound[100:108] = True
    frames = np.zeros((200, FRAME_SAMPLES), np.float32)
    windows = pushed(EmbeddingStream(Doubling()), frames, sound, 0, (200,))
    assert windows.frames.tolist() == [90, 100]  # 80 ends before it, 110 is half a second later
    assert not len(pushed(EmbeddingStream(Doubling()), frames, sound & False, 0, (200,)).frames)


def noise(count, level, seed=0):
    """White noise of a level in dBFS, in frames."""
    samples = np.random.default_rng(seed).standard_normal((count, FRAME_SAMPLES))
    return (10 ** (level / 20) * samples).astype(np.float32)


def level_of(frames):
    return 10 * np.log10(np.mean(np.square(frames, dtype=np.float64)))


def test_noise_of_a_room_is_fainter_by_some_decibels_and_faint_noise_is_left_alone():
    room = SteadyNoise()
    for window in noise(200, -50).reshape(10, WINDOW_FRAMES, FRAME_SAMPLES):
        room.learn(window)
    assert level_of(room.reduced(noise(WINDOW_FRAMES, -50, 1))) < -56
    room.restart()
    room.learn(noise(WINDOW_FRAMES, -74))
    assert level_of(room.reduced(noise(WINDOW_FRAMES, -74, 1))) > -75.5


def test_a_sound_far_above_the_noise_stays_what_it_is():
    room, times = SteadyNoise(), np.arange(WINDOW_FRAMES * FRAME_SAMPLES) / 16_000
    room.learn(noise(WINDOW_FRAMES, -50))
    tone = (0.3 * np.sin(2 * np.pi * 440 * times)).reshape(WINDOW_FRAMES, FRAME_SAMPLES)
    left = room.reduced(tone.astype(np.float32) + noise(WINDOW_FRAMES, -50, 1))
    assert level_of(left - tone) < level_of(tone) - 30


@pytest.mark.parametrize("room", [[], [-80], [-120]])
def test_next_to_no_noise_changes_no_sample(room):
    steady, window = SteadyNoise(), noise(WINDOW_FRAMES, -30)
    for level in room:
        steady.learn(noise(WINDOW_FRAMES, level, 1))
    assert steady.reduced(window) is window or np.array_equal(steady.reduced(window), window)


def test_the_noise_of_windows_without_sound_is_taken_out_of_those_with_sound_until_a_restart():
    frames = noise(100, -30)
    frames[80:90] += 0.3
    sound = np.zeros(100, bool)
    sound[80:95] = True
    stream = EmbeddingStream(Doubling())
    cleaned = pushed(stream, frames, sound, 0, [7])
    stream.restart()
    loud = np.ones(100, bool)  # nothing is known of the room
    as_it_is = pushed(stream, frames, loud, 0, [100])
    shared = np.isin(as_it_is.frames, cleaned.frames)
    assert cleaned.frames.tolist() == [70, 80]
    assert not np.array_equal(as_it_is.values[shared], cleaned.values)
    assert same(pushed(EmbeddingStream(Doubling()), frames, sound, 0, [100]), cleaned)


def test_a_restart_embeds_no_window_from_both_sides():
    stream, frames = EmbeddingStream(Doubling()), np.zeros((25, FRAME_SAMPLES), np.float32)
    pushed(stream, frames, np.ones(25, bool), 0, (25,))
    stream.restart()
    assert pushed(stream, frames, np.ones(25, bool), 25, (25,)).frames.tolist() == [30]


def test_frames_between_two_windows_have_both_in_proportion_and_others_the_only_one():
    evidence = EmbeddingEvidence(as_they_are, 2)
    evidence.push(embeddings_at(0, 10, 40), 0)
    output = evidence.at(0, 70)
    np.testing.assert_allclose(output[10:20, 0], np.arange(10) + 0.5)  # from 0 at 10 to 10 at 20
    np.testing.assert_allclose(output[0:10, 0], 0.0)  # before the middle of the first window
    np.testing.assert_allclose(output[20:30, 0], 10.0)
    assert np.isnan(output[30:40]).all()
    np.testing.assert_allclose(output[40:60, 0], 40.0)
    assert np.isnan(output[60:]).all()


def test_names_around_a_frame_count_as_the_higher_of_the_two_windows():
    evidence = EmbeddingEvidence(as_they_are, 2)
    evidence.push(embeddings_at(0, 10, 40), 0)
    highest = evidence.highest_at(0, 70)
    np.testing.assert_array_equal(highest[10:30, 0], 10.0)
    np.testing.assert_array_equal(highest[0:10, 0], 0.0)
    np.testing.assert_array_equal(highest[40:60, 0], 40.0)
    assert np.isnan(highest[30:40]).all()


@pytest.mark.parametrize("step", [1, 7, 30])
def test_what_is_said_of_frames_is_the_same_in_pieces_of_any_size(step):
    embeddings = embeddings_at(*range(0, 300, 10))
    full = EmbeddingEvidence(as_they_are, 2)
    full.push(embeddings, 0)
    expected = full.at(0, 300)
    parts, pieces = EmbeddingEvidence(as_they_are, 2), []
    for first in range(0, 300, step):
        parts.push(embeddings.available_at(first, step), first)
        begin, end = max(first - 19, 0), max(first + step - 19, 0)
        pieces.append(parts.at(begin, end - begin))
    joined = np.concatenate(pieces)
    np.testing.assert_array_equal(joined, expected[: len(joined)])


def test_private_frames_are_those_of_labels_that_wait_for_embeddings_too():
    """The same frames are private, whether a label is known at once or sixteen frames later."""
    from test_privacy_filter import labels_of  # noqa: PLC0415  its labels of speech

    output = np.zeros(200, np.float32)
    output[80:85] = 0.9
    at_once = PrivateFrames(["speech"], 20)
    early = np.concatenate([at_once.push(200, labels_of(output)), at_once.close()])
    waiting, late = PrivateFrames(["speech"], 20, 19), []
    for frame in range(200):
        known = labels_of(output[frame - 16 : frame - 15]) if frame >= 16 else None
        late.append(waiting.push(1, None if known is None else known._replace(ahead=16)))
    late = np.concatenate([*late, waiting.close()])
    count = 200 - 16 - 39  # beside the end: unlabelled
    np.testing.assert_array_equal(early[:count], late[:count])
    assert early[60:90].any()
    assert not early[20:50].any()


def private_frames(output, logit, *, elsewhere=True):
    """Which of 100 frames are private, of one probability of speech and one logit of its names."""
    from test_privacy_filter import labels_of  # noqa: PLC0415  its labels of speech

    labels = labels_of(np.full(100, output, np.float32))
    names = np.full(labels.probabilities.shape, logit)
    guard = PrivateFrames(["speech"], 20)
    decided = guard.push(100, labels._replace(by_names=names, calibrated_elsewhere=elsewhere))
    return decided[20:]


@pytest.mark.parametrize(
    ("output", "logit", "elsewhere", "private"),
    [
        (0.0, PRIVATE_LOGIT, True, True),  # the network alone may forbid
        (0.0, PRIVATE_LOGIT - 0.25, True, False),
        (0.05, PRIVATE_LOGIT - 0.25, True, False),  # both must be unsure
        (0.07, PRIVATE_LOGIT - 0.25, True, True),
        (0.05, np.nan, True, True),  # no embedding: as without a network
        (0.03, np.nan, True, False),
        (0.03, PRIVATE_LOGIT - 0.25, False, False),  # a model that is surer than it should be
        (0.05, PRIVATE_LOGIT - 0.25, False, True),
    ],
)
def test_names_of_a_network_forbid_and_where_they_do_not_features_may_be_less_sure(
    output, logit, elsewhere, private
):
    decided = private_frames(output, logit, elsewhere=elsewhere)
    assert len(decided)
    assert (decided == private).all()


@pytest.mark.parametrize("step", [1, 7, 200])
def test_names_of_speech_count_for_two_seconds_in_blocks_of_any_size(step):
    from test_privacy_filter import labels_of  # noqa: PLC0415  its labels of speech

    names = np.full((200, 2), -10.0)
    names[80:85] = PRIVATE_LOGIT
    guard, decided = PrivateFrames(["speech"], 20), []
    for first in range(0, 200, step):
        part = names[first : first + step]
        labels = labels_of(np.zeros(len(part), np.float32))._replace(by_names=part)
        decided.append(guard.push(len(part), labels))
    # A label is known with the last frame of its window, 19 frames after the first.
    private = np.flatnonzero(np.concatenate(decided)[20:]) + 20
    assert private.tolist() == list(range(80 - 19, 84 + NAMED_FRAMES + 12 + 1))


def test_embeddings_are_dropped_whose_windows_reach_into_what_is_private():
    veil = EmbeddingPrivacyFilter()
    veil.push(embeddings_at(*range(0, 100, 10)))
    private = np.zeros(100, bool)
    private[47] = True
    parts = [
        veil.release(
            LoggedFrames(np.zeros((10, 1), np.float32), n, stamps_of(n, 10), private[n : n + 10])
        )
        for n in range(0, 100, 10)
    ]
    frames = [number for part in parts for number in part.frames.tolist()]
    assert frames == [0, 10, 20, 50, 60, 70, 80]


def test_a_pipeline_logs_the_embeddings_of_sound_with_the_stamps_of_their_last_frames(real_frames):
    frames = np.concatenate([np.zeros((100, FRAME_SAMPLES), np.float32), real_frames[:400]])
    pipeline = Pipeline("mic", DEFAULT, embedder=Doubling())
    messages = pipeline.push(Frames(0, frames, stamps_of(0, 500)))
    embedded = [message for message in messages if message.topic == "/mic/embedding"]
    assert embedded
    lasts = [(message.log_time - START) // FRAME_NANOSECONDS for message in embedded]
    assert all(last % 10 == 9 for last in lasts)
    assert min(lasts) > 90
    assert [m.log_time for m in messages] == sorted(m.log_time for m in messages)


def test_a_gap_separates_windows(real_frames):
    pipeline = Pipeline("mic", DEFAULT, embedder=Doubling())
    pipeline.push(Frames(0, real_frames[:105], stamps_of(0, 105)))
    pipeline.push(Gap(START, START + FRAME_NANOSECONDS, "lost", 1))
    messages = pipeline.push(Frames(106, real_frames[106:206], stamps_of(106, 100)))
    embedded = [message for message in messages if message.topic == "/mic/embedding"]
    first = (embedded[0].log_time - START) // FRAME_NANOSECONDS
    assert first >= 110 + WINDOW_FRAMES - 1


def test_of_nothing_nothing_is_known():
    assert not len(NO_AUXILIARY.available_at(0, 100).embeddings.frames)
    joined = Auxiliary(embeddings=embeddings_at(10)).followed_by(NO_AUXILIARY)
    assert joined.embeddings.frames.tolist() == [10]


def test_the_integers_of_the_network_are_the_same_for_the_same_window(embedder, real_frames):
    windows = [real_frames[n : n + WINDOW_FRAMES] for n in range(0, 400, 40)]
    first = [embedder(window) for window in windows]
    again = [embedder(window) for window in reversed(windows)][::-1]
    np.testing.assert_array_equal(first, again)
    assert len(first[0]) == len(embedder.source.names) == len(embedder.source.steps)


def test_what_a_channel_says_of_its_embeddings_is_read_back_and_damage_is_nothing(embedder):
    source = embedder.source
    metadata = {**source.metadata(), "values_names": json.dumps(list(source.names))}
    assert EmbeddingSource.from_metadata(metadata) == source
    for key in metadata:
        damaged = {**metadata, key: "[1"}
        if key.startswith("values"):
            assert EmbeddingSource.from_metadata(damaged) is None
    assert EmbeddingSource.from_metadata({}) is None


def test_the_logit_of_speech_reaches_the_guard_with_the_labels_of_a_starter(embedder, household):
    """A second of each frame of speech is private by its name, whatever the features say."""
    clips = read_manifest(household / "manifest.csv", LABELS, [])
    spoken = [clip_frames(clip) for clip in clips if clip.label == "speech"][:4]
    frames = np.concatenate([np.zeros((100, FRAME_SAMPLES), np.float32), *spoken])
    classifier = Classifier(load_model(starter_file(with_network(GENERAL))))
    pipeline = Pipeline("mic", classifier.feature_set, classifier, embedder=embedder)
    pipeline.push(Frames(0, frames, stamps_of(0, len(frames))))
    labels = pipeline.last_labels
    speech = labels.by_names[:, labels.classes.index("speech")]
    assert np.isnan(speech[:60]).all()
    assert np.isnan(labels.by_names[:, labels.classes.index("unknown")]).all()
    assert (speech[120:] >= PRIVATE_LOGIT).mean() > 0.9
    silenced = labels._replace(by_features=np.zeros_like(labels.by_features))
    guard = PrivateFrames(["speech"], 20)
    private = guard.push(len(labels.frames), silenced)
    assert private[120:].mean() > 0.9
    assert not private[20:60].any()
