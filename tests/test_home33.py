"""Feature set `home33` has the paper's values and tells how the power of bands is spread."""

import librosa
import numpy as np
import pytest

from hearthlog.analyzer.training.dataset import segment_digests
from hearthlog.models.features.auros21 import AUROS21
from hearthlog.models.features.home33 import HOME33, rounded

pytestmark = pytest.mark.fast

BANDS = [slice(3, 13), slice(13, 25), slice(25, 50), slice(50, 100), slice(100, 200)]
BANDS.append(slice(200, 400))
PEAKINESS, FLATNESS = slice(21, 27), slice(27, 33)


def frames(sound):
    return sound[: len(sound) // 800 * 800].reshape(-1, 800).astype(np.float32)


def noise(seconds, level=0.1, seed=0):
    return frames(np.random.default_rng(seed).normal(0.0, level, int(16_000 * seconds)))


def tone(hertz, level=0.1):
    return frames(level * np.sin(2 * np.pi * hertz * np.arange(16_000) / 16_000))


@pytest.mark.parametrize("size", [1, 7, 60])
def test_frames_give_the_same_bits_in_blocks_of_any_size(size):
    sound = np.concatenate([noise(3), tone(440), noise(2, 1e-4)])
    extract = HOME33.extractor()
    blocks = [extract(sound[i : i + size]) for i in range(0, len(sound), size)]
    np.testing.assert_array_equal(np.concatenate(blocks), HOME33.extractor()(sound))


def test_the_first_values_are_those_of_the_paper_rounded(real_frames):
    values, exact = HOME33.extractor()(real_frames), AUROS21.extractor()(real_frames)
    np.testing.assert_allclose(values[:, :21], exact, rtol=2.0**-11, atol=2.0**-25)
    np.testing.assert_allclose(values[:, [0, 6]], exact[:, [0, 6]], rtol=2.0**-11, atol=1e-15)
    assert HOME33.feature_names[:21] == AUROS21.feature_names
    assert values.shape[1] == HOME33.width == len(HOME33.units) == 33


def test_values_have_11_of_the_24_binary_digits_of_a_float32(real_frames):
    bits = HOME33.extractor()(real_frames).view(np.uint32)
    assert not (bits % 2**13).any()
    assert (bits % 2**14).any(axis=0).all()


def test_what_is_left_of_the_cepstra_of_silence_by_rounding_is_nothing():
    values = HOME33.extractor()(np.zeros((4, 800), np.float32))
    assert not values[:, 9:21].any()


def test_models_of_exact_values_know_what_they_have_learned_from():
    exact = np.random.default_rng(0).normal(0.0, 100.0, (200, 20, 33)).astype(np.float32)
    values = rounded(exact.reshape(-1, 33)).reshape(exact.shape)
    np.testing.assert_array_equal(segment_digests(values), segment_digests(exact))


def test_flatness_is_that_of_librosa(real_frames):
    frames = real_frames[::16]  # librosa takes its time
    power = np.abs(np.fft.rfft(frames.astype(np.float64), axis=1)[:, :400] / 400) ** 2 + 1e-9
    values = HOME33.extractor()(frames)[:, FLATNESS]
    for number, band in enumerate(BANDS):
        theirs = librosa.feature.spectral_flatness(S=power[:, band].T, power=1.0, amin=1e-12)[0]
        expected = 10 * np.log10(theirs)
        np.testing.assert_allclose(values[:, number], expected, rtol=2.0**-11, atol=1e-4)


def test_a_tone_is_peaked_and_noise_is_flat():
    of_tone = HOME33.extractor()(tone(700))
    of_noise = HOME33.extractor()(noise(2))
    assert of_tone[:, PEAKINESS][:, 2].min() > 13.0  # of the 25 bins of its band
    assert of_tone[:, FLATNESS][:, 2].max() < -20.0
    assert of_noise[:, PEAKINESS].mean() < 7.0
    assert of_noise[:, FLATNESS].mean() > -3.5


def test_silence_and_samples_that_are_no_sound_give_finite_values():
    wild = np.zeros((4, 800), np.float32)
    wild[1], wild[2, ::2], wild[3] = np.nan, np.inf, 1e30
    values = HOME33.extractor()(wild)
    assert np.isfinite(values).all()
    np.testing.assert_allclose(values[0, 21:], 0.0, atol=1e-6)


def test_inputs_below_the_floor_are_those_of_silence():
    sound = noise(2)
    features = HOME33.extractor()(sound)
    loud = HOME33.band_powers(features).max(axis=0) * 2
    inputs = HOME33.inputs["above_floor"].stream()(features, np.tile(loud, (len(features), 1)))
    quiet = HOME33.inputs["above_floor"].stream()(
        HOME33.extractor()(np.zeros_like(sound)), np.tile(loud, (len(features), 1))
    )
    np.testing.assert_allclose(inputs, quiet, atol=1e-5)
