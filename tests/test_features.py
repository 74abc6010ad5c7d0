"""Features are the paper's, agree with the peers, and never depend on how they are called."""

import librosa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyAudioAnalysis import ShortTermFeatures
from scipy.fftpack import fft

from hearthlog.models.features.auros21 import FEATURE_NAMES, MFCC_COUNT, FeatureExtractor, mel_bank
from hearthlog.schemas.frames import FRAME_SAMPLES

pytestmark = pytest.mark.fast

RATE = 16_000
NOISE = np.random.default_rng(7).standard_normal((600, FRAME_SAMPLES)).astype(np.float32) * 0.1


def of_peer(frames):
    """The eight scalar features of pyAudioAnalysis's per-frame functions."""
    values, before = [], None
    for frame in frames.astype(np.float64):
        spectrum = np.abs(fft(frame))[: FRAME_SAMPLES // 2] / (FRAME_SAMPLES // 2)
        values.append(
            [
                ShortTermFeatures.energy(frame),
                ShortTermFeatures.zero_crossing_rate(frame),
                ShortTermFeatures.energy_entropy(frame),
                *ShortTermFeatures.spectral_centroid_spread(spectrum, RATE),
                ShortTermFeatures.spectral_entropy(spectrum),
                ShortTermFeatures.spectral_flux(spectrum, spectrum if before is None else before),
                ShortTermFeatures.spectral_rolloff(spectrum, 0.90),
            ]
        )
        before = spectrum
    return np.array(values)


def in_blocks(frames, sizes):
    extract = FeatureExtractor()
    ends = np.minimum(np.cumsum(sizes), len(frames))
    return np.concatenate([extract(block) for block in np.split(frames, ends) if len(block)])


def test_the_eight_scalar_features_equal_those_of_pyaudioanalysis_on_real_sound(real_frames):
    ours, theirs = FeatureExtractor()(real_frames)[:, :8], of_peer(real_frames)
    for column, name in enumerate(FEATURE_NAMES[:8]):
        np.testing.assert_allclose(
            ours[:, column], theirs[:, column], rtol=1e-5, atol=1e-12, err_msg=name
        )


def test_mfcc_equal_those_of_librosa_for_the_same_mel_bank_on_real_sound(real_frames):
    ours = FeatureExtractor()(real_frames)[:, 8:]
    power = np.abs(np.fft.rfft(real_frames.astype(np.float64))[:, :400] / 400) ** 2
    mel = power @ mel_bank() + 1e-7
    theirs = librosa.feature.mfcc(
        S=librosa.power_to_db(mel.T, amin=1e-30, top_db=None), n_mfcc=MFCC_COUNT
    ).T
    level = np.abs(theirs).max(axis=1, keepdims=True)
    assert (np.abs(ours - theirs) <= 1e-5 * np.maximum(np.abs(theirs), 1e-2 * level)).all()


def test_the_mel_bank_is_librosas():
    theirs = librosa.filters.mel(sr=RATE, n_fft=FRAME_SAMPLES, n_mels=32, norm=None, dtype=float)
    np.testing.assert_allclose(mel_bank(), theirs[:, :400].T, atol=1e-12)


def test_a_stream_of_single_frames_and_a_batch_agree_bit_for_bit_on_real_sound(real_frames):
    frames = real_frames[:1500]
    single = in_blocks(frames, [1] * len(frames))
    np.testing.assert_array_equal(single, FeatureExtractor()(frames))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 290), max_size=40))
def test_blocks_of_any_size_agree_bit_for_bit(sizes):
    np.testing.assert_array_equal(in_blocks(NOISE, sizes), FeatureExtractor()(NOISE))


def test_after_a_restart_the_past_does_not_matter():
    extract = FeatureExtractor()
    extract(NOISE[:7])
    extract.restart()
    np.testing.assert_array_equal(extract(NOISE[7:20]), FeatureExtractor()(NOISE[7:20]))


@pytest.mark.parametrize(
    "frame",
    [
        np.zeros(FRAME_SAMPLES),
        np.full(FRAME_SAMPLES, 0.25),
        np.sign(np.sin(np.arange(FRAME_SAMPLES) * 0.3)),
        np.full(FRAME_SAMPLES, np.nan),
        np.where(np.arange(FRAME_SAMPLES) % 9, 0.1, np.inf),
        np.full(FRAME_SAMPLES, -3e38),
        np.where(np.arange(FRAME_SAMPLES) == 400, 1e-42, 0.0),
    ],
    ids=["zeros", "DC", "clipping", "NaN", "infinite", "huge", "denormal"],
)
def test_any_frame_gives_finite_values(frame):
    frames = np.stack([NOISE[0], frame, frame, NOISE[1]]).astype(np.float32)
    assert np.isfinite(FeatureExtractor()(frames)).all()


def test_a_full_scale_sine_has_half_the_energy_and_its_frequency_as_centroid():
    sine = np.sin(2 * np.pi * 1000 * np.arange(FRAME_SAMPLES) / RATE)[np.newaxis]
    values = dict(zip(FEATURE_NAMES, FeatureExtractor()(sine.astype(np.float32))[0], strict=True))
    assert values["energy"] == pytest.approx(0.5, rel=1e-4)
    assert values["zero_crossing_rate"] == pytest.approx(2 * 1000 / RATE, abs=2 / FRAME_SAMPLES)
    assert values["spectral_centroid"] * RATE / 2 == pytest.approx(1020, abs=1)
    assert values["spectral_rolloff"] * RATE / 2 == pytest.approx(1000, abs=1)


def test_no_frames_give_no_values():
    assert FeatureExtractor()(NOISE[:0]).shape == (0, len(FEATURE_NAMES))
