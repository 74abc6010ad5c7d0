"""The values of `auros21` for every frame.

Everything is computed in float64 over whole arrays of frames and rounded once, to float32.
A frame's values do not depend on how many frames are computed together with it, so a stream
and a batch of the same samples agree bit for bit.
"""

from functools import cache

import numpy as np

from hearthlog.models.batch_invariant import rowwise_matmul
from hearthlog.models.features.auros21.inputs import dct_weights
from hearthlog.models.features.auros21.names import CEPSTRA, FEATURE_NAMES, MEL_BANDS
from hearthlog.schemas.arrays import Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

BINS = FRAME_SAMPLES // 2
_PARTS = 10  # sub-frames, and sub-bands, of the two entropies
_ROLLOFF_BANDS = 20
_ROLLOFF_SHARE = 0.90
_RUNNING_SUM = np.triu(np.ones((_ROLLOFF_BANDS, _ROLLOFF_BANDS)))
_TINY = np.finfo(np.float64).eps
_SANE_SAMPLE = 1e3  # full scale is 1
_SANE_ENERGY = _SANE_SAMPLE**2
_POWER_FLOOR = 1e-7  # about -70 dBFS: below it a spectrum is that of the codec
_FRAMES_AT_ONCE = 384  # more would leave a core's cache, fewer cost more in calls


class FeatureExtractor:
    """Features of one stream of frames; the state is the last spectrum, for the flux."""

    width = len(FEATURE_NAMES)

    def __init__(self) -> None:
        self._last_magnitude: Float64 | None = None
        # Scratch arrays: fresh ones of this size cost more in page faults than the transform.
        self._samples = np.empty((_FRAMES_AT_ONCE, FRAME_SAMPLES))
        self._spectrum = np.empty((_FRAMES_AT_ONCE, BINS + 1), np.complex128)
        self._magnitude = np.empty((_FRAMES_AT_ONCE + 1, BINS))

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._last_magnitude = None

    def __call__(self, frames: Float32) -> Float32:
        """Compute the features of successive frames.

        The definitions are those of the paper (section 3.2.2) and, where the paper and its library
        differ, of pyAudioAnalysis; see docs/features.md.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, 800)], float32
            Samples in full scale, -1 to 1, at 16 kHz. Those that are not finite count as 0, those
            beyond +-1000 are clipped.

        Returns
        -------
        np.ndarray [shape=(n, 21)], float32
            In the order and the units of `FEATURE_NAMES` (see docs/features.md); always finite.
        """
        values = np.empty((len(frames), self.width), np.float32)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            block = slice(start, start + _FRAMES_AT_ONCE)
            self._compute(frames[block], values[block])
        return values

    def _compute(self, frames: Float32, out: Float32) -> None:
        self._paper_values(frames, out)

    def _paper_values(self, frames: Float32, out: Float32) -> Float64:
        """Compute the 21 values of frames; return the powers of their bins.

        Those have shape (n, 400); a full-scale sine has `BINS` squared.
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
        total = np.maximum(moments[:, 0], _TINY)
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
    """Count sign changes per step from sample to sample; a step to or from 0 counts half.

    The paper (section 3.2.2) divides by the samples of a frame; this divides by the steps, as
    pyAudioAnalysis does.

    Parameters
    ----------
    frames : np.ndarray [shape=(n, 800)], float32
        Samples; one that is NaN counts as 0.

    Returns
    -------
    np.ndarray [shape=(n,)], float64
        From 0 to 1.
    """
    sign = (frames > 0).view(np.int8) - (frames < 0).view(np.int8)
    steps = sign[:, 1:] - sign[:, :-1]
    return np.abs(steps, out=steps).sum(axis=1, dtype=np.int16) / (2.0 * (FRAME_SAMPLES - 1))


def mel_bank() -> Float64:
    """Return triangular filters of peak 1 on the mel scale, 0 to 8 kHz.

    The scale is that of Slaney's Auditory Toolbox.

    Returns
    -------
    np.ndarray [shape=(400, 32)], float64
        Weight of each spectral bin in each band; as `librosa.filters.mel(norm=None)`.
    """
    frequency = np.arange(BINS) * (SAMPLE_RATE / FRAME_SAMPLES)
    corners = _mel_corners()
    width = np.diff(corners)
    distance = frequency[:, np.newaxis] - corners[np.newaxis, :]
    rising = distance[:, :-2] / width[:-1]
    falling = -distance[:, 2:] / width[1:]
    return np.maximum(0.0, np.minimum(rising, falling))


def mel_centres() -> Float64:
    """Return the frequencies at which the filters of `mel_bank` peak.

    Returns
    -------
    np.ndarray [shape=(32,)], float64
        In hertz.
    """
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
    shares = parts / (total + _TINY)[:, np.newaxis]
    return -np.vecdot(shares, np.log2(shares + _TINY))


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
    band = np.argmax(running + _TINY > threshold[:, np.newaxis], axis=1)
    left = threshold - (running[row, band] - band_power[row, band])
    inside = rowwise_matmul(power.reshape(len(power), _ROLLOFF_BANDS, -1)[row, band], _RUNNING_SUM)
    bin_in_band = np.argmax(inside + _TINY > left[:, np.newaxis], axis=1)
    return (band * (BINS // _ROLLOFF_BANDS) + bin_in_band) / BINS
