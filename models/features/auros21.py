"""Feature set `auros21`: the paper's 21 values for every frame."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.batch_invariant import rowwise_matmul
from hearthlog.models.features import FeatureSet, WindowStatistics
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

MFCC_COUNT = 13
MEL_BANDS = 32  # bands from which the cepstra are computed

_FEATURES = (
    ("energy", "of full scale squared"),
    ("zero_crossing_rate", "per step"),
    ("energy_entropy", "bit"),
    ("spectral_centroid", "of 8 kHz"),
    ("spectral_spread", "of 8 kHz"),
    ("spectral_entropy", "bit"),
    ("spectral_flux", "1"),
    ("spectral_rolloff", "of 8 kHz"),
    *((f"mfcc_{i}", "dB") for i in range(1, MFCC_COUNT + 1)),
)
FEATURE_NAMES = tuple(name for name, _ in _FEATURES)
UNITS = tuple(unit for _, unit in _FEATURES)

ENERGY = FEATURE_NAMES.index("energy")
FLUX = FEATURE_NAMES.index("spectral_flux")
CEPSTRA = slice(FEATURE_NAMES.index("mfcc_1"), len(FEATURE_NAMES))


WINDOW_FRAMES = 20
_SCALARS, _WIDTH = CEPSTRA.start, len(FEATURE_NAMES)
VALUES = _WIDTH + MEL_BANDS
_FLOOR = 1e-7
_OVERSUBTRACTION = 1.5
_TINY = 1e-12
_NEPERS = np.log(10.0) / 10.0  # nepers of power in a decibel
_MOST_DB = 300.0  # above any real frame; keeps powers and their squares finite
LABEL_FRAMES = 8
# Means over quiet stretches of household recordings, in the order of the features before the
# cepstra, with the logarithm of the flux; the first is unused.
_OF_SILENCE = np.array([0.0, 0.17, 3.1, 0.24, 0.2, 1.28, -5.94, 0.26])


def band_values(features: Float32) -> Float64:
    """Compute the values of the inputs `bands` [shape=(n, 53)] from features [shape=(n, 21)].

    They are the features before the cepstra, with energy in dB and the natural logarithm of the
    flux, then 32 mel bands in dB, then the cepstra.
    """
    cepstra = features[:, CEPSTRA]
    values = np.empty((len(features), _WIDTH + MEL_BANDS))
    values[:, :_SCALARS] = features[:, :_SCALARS]
    values[:, ENERGY] = 10.0 * np.log10(np.maximum(values[:, ENERGY], 0.0) + _FLOOR)
    values[:, FLUX] = np.log(np.maximum(values[:, FLUX], 0.0) + _FLOOR)
    values[:, _SCALARS : _SCALARS + MEL_BANDS] = bands_of(cepstra)
    values[:, _SCALARS + MEL_BANDS :] = cepstra
    return values


def band_powers(features: Float32) -> Float64:
    """Compute powers of mel bands and frame [shape=(n, 33)] from features [shape=(n, 21)].

    They are the powers of the 32 bands that the cepstra represent, without the constant inside
    their logarithm, then the energy; not below 0.
    """
    powers = np.empty((len(features), MEL_BANDS + 1))
    level = np.minimum(bands_of(features[:, CEPSTRA]), _MOST_DB)
    powers[:, :MEL_BANDS] = np.exp(_NEPERS * level) - _FLOOR  # six times as fast as 10.0 ** …
    powers[:, MEL_BANDS] = features[:, ENERGY]
    return np.maximum(powers, 0.0, out=powers)


def values_above_floor(features: Float32, floors: Float64 | None) -> Float64:
    """Compute the values of the inputs `above_floor` [shape=(n, 53)], as from `band_values`.

    `features` has shape (n, 21); `floors` [shape=(n, 33)] are in the order of `band_powers`. Raise
    `TypeError` if there are no floors.
    """
    return above_floor(features, floors)[0]


def above_floor(features: Float32, floors: Float64 | None) -> tuple[Float64, Float64]:
    """Compute the values above the floor of the room, and the share of energy above it.

    They are those of `values_above_floor` [shape=(n, 53)], and 0 to 1 [shape=(n, 1)], of features
    [shape=(n, 21)] and floors [shape=(n, 33)] in the order of `band_powers`. The floor is
    subtracted from the powers (Berouti, Schwartz and Makhoul, "Enhancement of speech corrupted by
    acoustic noise", 1979). The other values allow no subtraction; the smaller the share of energy
    above the floor, the closer they are moved to the values of silence. Raise `TypeError` if there
    are no floors.
    """
    if floors is None:
        raise TypeError("these inputs need the floor of the room")
    powers = band_powers(features)
    energy, floor = powers[:, MEL_BANDS:], floors[:, MEL_BANDS:]
    share = np.maximum(energy - floor, 0.0) / np.maximum(energy, _TINY)
    level = 10.0 * np.log10(np.maximum(powers - _OVERSUBTRACTION * floors, 0.0) + _FLOOR)
    scalars = features[:, :_SCALARS].astype(np.float64)
    scalars[:, FLUX] = np.log(np.maximum(scalars[:, FLUX], 0.0) + _FLOOR)
    scalars = _OF_SILENCE + share * (scalars - _OF_SILENCE)
    scalars[:, ENERGY] = level[:, MEL_BANDS]
    bands = level[:, :MEL_BANDS]
    values = np.concatenate([scalars, bands, rowwise_matmul(bands, dct_weights())], axis=1)
    return values, share


def bands_of(cepstra: Float32) -> Float64:
    """Convert `mfcc_1` to `mfcc_13` [shape=(n, 13)], in dB, to mel bands [shape=(n, 32)], in dB.

    The bands are smooth because higher cepstra are missing.
    """
    return rowwise_matmul(cepstra.astype(np.float64), dct_weights().T)


@cache
def dct_weights() -> Float64:
    """Return the weights of an orthonormal DCT-II from mel bands to cepstra [shape=(32, 13)].

    The transpose converts cepstra to bands.
    """
    band = np.arange(MEL_BANDS)[:, np.newaxis]
    order = np.arange(_WIDTH - _SCALARS)
    weights = np.sqrt(2.0 / MEL_BANDS) * np.cos(np.pi / MEL_BANDS * (band + 0.5) * order)
    weights[:, 0] /= np.sqrt(2.0)
    return weights


# `statistics` are from the paper (section 3.2.1): mean and standard deviation of the features.
# `bands` derives more from the same features: logarithms of energy and flux, the smooth mel bands
# that the cepstra represent, and the mean change of all values from frame to frame.
INPUTS = {
    "statistics": WindowStatistics(WINDOW_FRAMES, np.asarray, _WIDTH),
    "bands": WindowStatistics(WINDOW_FRAMES, band_values, VALUES, changes=True),
    "above_floor": WindowStatistics(
        LABEL_FRAMES, values_above_floor, VALUES, changes=True, needs_floor=True
    ),
}


BINS = FRAME_SAMPLES // 2
_PARTS = 10  # sub-frames and sub-bands of the two entropies
_ROLLOFF_BANDS = 20
_ROLLOFF_SHARE = 0.90
_RUNNING_SUM = np.triu(np.ones((_ROLLOFF_BANDS, _ROLLOFF_BANDS)))
_EPSILON = np.finfo(np.float64).eps
_SANE_SAMPLE = 1e3  # full scale is 1
_SANE_ENERGY = _SANE_SAMPLE**2
_POWER_FLOOR = 1e-7  # about -70 dBFS: below it, a spectrum is an artefact of the codec
_FRAMES_AT_ONCE = 384  # more would exceed a core's cache, fewer cost more in calls


class FeatureExtractor:
    """Features of one stream of frames; the state is the last spectrum, for the flux.

    All values are computed in float64 over arrays of frames and rounded once, to float32. A frame's
    values do not depend on the batch, so a stream and a batch of the same samples agree bit for
    bit.
    """

    width = len(FEATURE_NAMES)

    def __init__(self) -> None:
        self._last_magnitude: Float64 | None = None
        # Scratch arrays: allocating arrays of this size costs more in page faults than the
        # transform.
        self._samples = np.empty((_FRAMES_AT_ONCE, FRAME_SAMPLES))
        self._spectrum = np.empty((_FRAMES_AT_ONCE, BINS + 1), np.complex128)
        self._magnitude = np.empty((_FRAMES_AT_ONCE + 1, BINS))

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._last_magnitude = None

    def __call__(self, frames: Float32) -> Float32:
        """Compute `FEATURE_NAMES` [shape=(n, 21)], in this order, of frames [shape=(n, 800)].

        Frames are in full scale, -1 to 1, at 16 kHz. The definitions follow the paper (section
        3.2.2) and, where the paper and its library differ, pyAudioAnalysis; see docs/features.md
        for the units. Samples that are not finite count as 0, those beyond +-1000 are clipped;
        features are always finite.
        """
        values = np.empty((len(frames), self.width), np.float32)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            block = slice(start, start + _FRAMES_AT_ONCE)
            self._compute(frames[block], values[block])
        return values

    def _compute(self, frames: Float32, out: Float32) -> None:
        self._paper_values(frames, out)

    def _paper_values(self, frames: Float32, out: Float32) -> Float64:
        """Compute the 21 values of frames; return the powers of their bins [shape=(n, 400)].

        A full-scale sine has `BINS` squared.
        """
        samples = self._samples[: len(frames)]
        np.copyto(samples, frames)
        part_energy = _energy_of_parts(samples, _PARTS)
        if not part_energy.max() < _SANE_ENERGY:  # a NaN compares as false
            np.nan_to_num(samples, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
            np.clip(samples, -_SANE_SAMPLE, _SANE_SAMPLE, out=samples)
            part_energy = _energy_of_parts(samples, _PARTS)
        energy = _sums(part_energy)
        out[:, 0] = energy / FRAME_SAMPLES
        out[:, 1] = zero_crossing_rate(frames)
        out[:, 2] = _entropy_of_shares(part_energy, energy)

        spectrum = np.fft.rfft(samples, axis=1, out=self._spectrum[: len(frames)])
        magnitude = self._magnitude[: len(frames) + 1]  # row 0 is the frame before
        np.abs(spectrum[:, :BINS], out=magnitude[1:])
        magnitude[0] = magnitude[1] if self._last_magnitude is None else self._last_magnitude
        self._last_magnitude = magnitude[-1].copy()

        moments = rowwise_matmul(magnitude, _moment_weights())
        total = np.maximum(moments[:, 0], _EPSILON)
        centroid = moments[1:, 1] / total[1:]
        out[:, 3] = centroid
        out[:, 4] = np.sqrt(np.maximum(moments[1:, 2] / total[1:] - centroid**2, 0.0))

        band_power = _energy_of_parts(magnitude, _ROLLOFF_BANDS)
        power_sum = _sums(band_power)
        parts = band_power[1:, ::2] + band_power[1:, 1::2]
        out[:, 5] = _entropy_of_shares(parts / BINS**2, power_sum[1:] / BINS**2)
        out[:, 6] = _flux(magnitude, total, power_sum)
        power = np.square(magnitude[1:], out=magnitude[1:])
        out[:, 7] = _rolloff(power, band_power[1:])
        mel_db = 10.0 * np.log10(rowwise_matmul(power, _mel_weights()) + _POWER_FLOOR)
        out[:, CEPSTRA] = rowwise_matmul(mel_db, dct_weights())
        return power


def zero_crossing_rate(frames: Float32) -> Float64:
    """Count sign changes per step from sample to sample [shape=(n, 800)]: 0 to 1 [shape=(n,)].

    A step to or from 0 counts half, and NaN counts as 0. The paper (section 3.2.2) divides by the
    samples of a frame; this divides by the steps, as pyAudioAnalysis does.
    """
    sign = (frames > 0).view(np.int8) - (frames < 0).view(np.int8)
    steps = sign[:, 1:] - sign[:, :-1]
    return np.abs(steps, out=steps).sum(axis=1, dtype=np.int16) / (2.0 * (FRAME_SAMPLES - 1))


def mel_bank() -> Float64:
    """Return triangular filters of peak 1 on the mel scale, 0 to 8 kHz [shape=(400, 32)].

    The scale is from Slaney's Auditory Toolbox; the weights of spectral bins are those of
    `librosa.filters.mel(norm=None)`.
    """
    frequency = np.arange(BINS) * (SAMPLE_RATE / FRAME_SAMPLES)
    corners = _mel_corners()
    width = np.diff(corners)
    distance = frequency[:, np.newaxis] - corners[np.newaxis, :]
    rising = distance[:, :-2] / width[:-1]
    falling = -distance[:, 2:] / width[1:]
    return np.maximum(0.0, np.minimum(rising, falling))


def mel_centres() -> Float64:
    """Return the frequencies at which the filters of `mel_bank` peak, in hertz [shape=(32,)]."""
    return _mel_corners()[1:-1]


def _mel_corners() -> Float64:
    return _mel_to_hertz(np.linspace(0.0, _hertz_to_mel(SAMPLE_RATE / 2), MEL_BANDS + 2))


# The scale of Slaney's Auditory Toolbox: linear below 1 kHz, logarithmic above.
_MEL_BREAK_HERTZ, _MEL_BREAK, _LOG_STEP = 1000.0, 15.0, np.log(6.4) / 27.0


def _hertz_to_mel(hertz: float) -> float:
    return float(_MEL_BREAK + np.log(hertz / _MEL_BREAK_HERTZ) / _LOG_STEP)


def _mel_to_hertz(mel: Float64) -> Float64:
    linear = mel * (_MEL_BREAK_HERTZ / _MEL_BREAK)
    return np.where(
        mel < _MEL_BREAK, linear, _MEL_BREAK_HERTZ * np.exp(_LOG_STEP * (mel - _MEL_BREAK))
    )


@cache
def _moment_weights() -> Float64:
    position = np.arange(1, BINS + 1) / BINS
    return np.stack([np.ones(BINS), position, position**2], axis=1)


@cache
def _mel_weights() -> Float64:
    """Return the mel bank for squared DFT magnitudes: a full-scale sine has power 1 (0 dB)."""
    return mel_bank() / BINS**2


def _energy_of_parts(rows: Float64, parts: int) -> Float64:
    pieces = rows.reshape(len(rows) * parts, -1)
    return np.vecdot(pieces, pieces).reshape(-1, parts)


def _sums(rows: Float64) -> Float64:
    return np.einsum("ij->i", rows)


def _entropy_of_shares(parts: Float64, total: Float64) -> Float64:
    shares = parts / (total + _EPSILON)[:, np.newaxis]
    return -np.vecdot(shares, np.log2(shares + _EPSILON))


def _flux(magnitude: Float64, total: Float64, power: Float64) -> Float64:
    """Return the squared distance of successive normalised spectra, as |a|^2 + |b|^2 - 2ab."""
    length = power / total**2
    common = np.vecdot(magnitude[1:], magnitude[:-1]) / (total[1:] * total[:-1])
    return np.maximum(length[1:] + length[:-1] - 2.0 * common, 0.0)


def _rolloff(power: Float64, band_power: Float64) -> Float64:
    """Find the bin in two steps, the band first: a running sum over all bins is slow."""
    row = np.arange(len(power))
    running = rowwise_matmul(band_power, _RUNNING_SUM)
    threshold = _ROLLOFF_SHARE * running[:, -1]
    band = np.argmax(running + _EPSILON > threshold[:, np.newaxis], axis=1)
    left = threshold - (running[row, band] - band_power[row, band])
    inside = rowwise_matmul(power.reshape(len(power), _ROLLOFF_BANDS, -1)[row, band], _RUNNING_SUM)
    bin_in_band = np.argmax(inside + _EPSILON > left[:, np.newaxis], axis=1)
    return (band * (BINS // _ROLLOFF_BANDS) + bin_in_band) / BINS


_SHARE = 0.6  # of the segments get each of gain, tilt and bump
_GAIN = 12.0  # dB, at most
_TILT = 3.0  # dB an octave
_BUMPS, _BUMP = 3, 6.0  # dB
_BUMP_OCTAVES = (0.3, 1.0)  # width
_NOISE_SHARE = 0.5
_NOISE = (-95.0, -55.0)  # dB in each band
_NEPER = 10.0 / np.log(10.0)  # dB of a factor e in power


def augmented(windows: Float32, rng: "np.random.Generator") -> Float32:
    """Return windows [shape=(n, 20, 21)] as another microphone in another room might capture them.

    Gain, tilt and bumps of the spectrum, and the noise of a microphone, act on the mel bands that
    the cepstra represent, so the sound itself is not needed. Energy and cepstra are changed; the
    other features hardly depend on a microphone.
    """
    gain, curve = _curves(len(windows), rng)
    cepstra = windows[:, :, CEPSTRA]
    before = bands_of(cepstra.reshape(-1, cepstra.shape[2])).reshape(*cepstra.shape[:2], -1)
    after = before + (gain + curve)[:, np.newaxis]
    noisy = rng.random((len(windows), 1, 1)) < _NOISE_SHARE
    noise = rng.uniform(*_NOISE, (len(windows), 1, 1))
    after = np.where(noisy, _power_sum(after, noise), after)
    changed = windows.astype(np.float64)
    changed[:, :, CEPSTRA] += (after - before) @ dct_weights()
    changed[:, :, ENERGY] *= 10.0 ** (gain / 10.0)
    return changed.astype(np.float32)


def _power_sum(first: Float64, second: Float64) -> Float64:
    """Add the powers of two levels in dB."""
    return np.logaddexp(first / _NEPER, second / _NEPER) * _NEPER


def _curves(count: int, rng: "np.random.Generator") -> tuple[Float64, Float64]:
    """Draw a gain, shape (n, 1), and a frequency response, shape (n, bands), in dB."""

    def some(values: Float64) -> Float64:
        return values * (rng.random((count, 1)) < _SHARE)

    octaves = np.log2(mel_centres() / 1000.0)
    gain = some(rng.normal(0.0, _GAIN / 2, (count, 1)).clip(-_GAIN, _GAIN))
    curve = some(rng.uniform(-_TILT, _TILT, (count, 1))) * octaves
    for _ in range(_BUMPS):
        height = some(rng.uniform(-_BUMP, _BUMP, (count, 1)))
        distance = octaves - rng.uniform(octaves[0], octaves[-1], (count, 1))
        curve += height * np.exp(-0.5 * (distance / rng.uniform(*_BUMP_OCTAVES, (count, 1))) ** 2)
    return gain, curve


def _energy(features: NDArray[Any]) -> NDArray[Any]:
    energy: NDArray[Any] = features[..., ENERGY]
    return energy


AUROS21 = FeatureSet(
    name="auros21",
    version=1,
    feature_names=FEATURE_NAMES,
    units=UNITS,
    window_frames=WINDOW_FRAMES,
    extractor=FeatureExtractor,
    inputs=INPUTS,
    power=_energy,
    band_powers=band_powers,
    augmented=augmented,
    method="room21",
)
