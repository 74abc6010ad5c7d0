"""A filter of offsets, drifts and rumbles below hearing, which raise the floor of the room.

Polynomials are fitted to each frame separately, so a step leaves no trace in later frames. Frames
in which infrasound does not stand out stay unchanged to the last bit, as models expect.
"""

from functools import cache

import numpy as np

from hearthlog.models.batch_invariant import rowwise_matmul
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

_TERMS = 5  # number of terms of the polynomials: attenuates 12 Hz by 40 dB, 50 Hz by 1 dB
_PROBES = (8.0, 16.0)  # Hz, in addition to 0: each covers about 20 Hz around it
_LEAST_POWER = 10 ** (-65 / 10)
_STANDS_OUT = 4.0  # relative to the power of the rest of a frame
_IS_PLAIN = 16.0  # the same in the first frame, without history
_WINDOW, _MOST = 20, 10  # frames: half of a second; a thump is shorter
_HELD = 200  # frames: ten seconds of speech or music may hide it
_STEPS = 1 << 15  # per 1: 16-bit samples stay 16-bit
_TINY = 1e-20
_LEAST_ENERGY = _LEAST_POWER * FRAME_SAMPLES
_ROUNDING = 1e-3  # share of the energy of a frame: above the rounding error of float32
_MOST_GAIN = 1.1  # upper bound of the power by probes, relative to the polynomials of two frames


class InfrasoundFilter:
    """Removes infrasound below about 20 Hz from one stream of frames, while it stands out.

    Infrasound raises the floor of the room and hides the sound above it. The same frames give the
    same bits in blocks of any size. `is_active`: the last frame was changed.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self.is_active = False
        self._last: Float64 | None = None  # coefficients of the last frame
        self._offset, self._wave = _Persistence(), _Persistence()

    def __call__(self, frames: Float32) -> Float32:
        """Filter finite frames [shape=(n, FRAME_SAMPLES)]; return them if nothing stands out."""
        if not len(frames):
            return frames
        places = np.flatnonzero(self._may_stand_out(frames))
        below, waves, rest = self._powers(frames, places)
        wavy = self._wave(waves, rest)
        removed = self._offset(below, rest) | wavy
        self.is_active = bool(removed[-1])
        if not removed.any():
            return frames
        coefficients = _coefficients(frames[removed])
        coefficients[~wavy[removed], 1:] = 0.0
        baseline = np.rint(_STEPS * rowwise_matmul(coefficients, _curves().T)) / _STEPS
        filtered = frames.copy()
        filtered[removed] -= baseline.astype(np.float32)
        return filtered

    def _may_stand_out(self, frames: Float32) -> Bool:
        """Find the frames that need a closer look, by bounds that are cheaper than the powers."""
        with np.errstate(over="ignore", invalid="ignore"):
            energy = np.vecdot(frames, frames)
            coefficients = frames @ _rough_curves()
            slow = np.vecdot(coefficients, coefficients) + _ROUNDING * energy
            before = slow[:1] if self._last is None else np.square(self._last).sum(axis=1)
            both = slow + np.concatenate([before, slow[:-1]])
            rest = (1.0 - _ROUNDING) * energy - slow
            is_clear = _MOST_GAIN * both < np.maximum(_STANDS_OUT * rest, _LEAST_ENERGY)
        return ~is_clear

    def _powers(self, frames: Float32, places: Indices) -> tuple[Float64, Float64, Float64]:
        """Return the power below 20 Hz at frame starts, the same without offsets, and the rest.

        They are 0 where nothing stands out.
        """
        below, waves, rest = np.zeros((3, len(frames)))
        pairs = np.empty((len(places), 2 * _TERMS))
        if len(places):
            samples = frames[places].astype(np.float64)
            pairs[:, _TERMS:] = rowwise_matmul(samples, _curves())
            pairs[:, :_TERMS] = _coefficients(frames[places - 1])
            if places[0] == 0:
                pairs[0, :_TERMS] = pairs[0, _TERMS:] if self._last is None else self._last[0]
            values = np.square(rowwise_matmul(pairs, _probes()))
            powers = np.maximum(
                np.maximum(values[:, 0::5], values[:, 1::5] + values[:, 2::5]),
                values[:, 3::5] + values[:, 4::5],
            )
            below[places], waves[places] = powers[:, 0], powers[:, 1]
            slow = np.ascontiguousarray(pairs[:, _TERMS:])
            rest[places] = np.maximum(_power(samples) - _power(slow), _TINY)
        self._last = _coefficients(frames[-1:])
        return below, waves, rest


class _Persistence:
    """Finds the frames of a stream in which something persistent stands out."""

    def __init__(self) -> None:
        self._recent: Bool | None = None  # whether it stood out in the last frames
        self._held = 0  # number of frames for which it still counts

    def __call__(self, powers: Float64, rest: Float64) -> Bool:
        out = powers > np.maximum(_STANDS_OUT * rest, _LEAST_POWER)
        loud = out if self._recent is None else np.concatenate([self._recent, out])
        if not self._held and not loud.any():
            self._recent = loud[-_WINDOW:].copy()
            return out
        count = np.cumsum(np.concatenate([np.zeros(_WINDOW, np.intp), loud]))
        begins = (count[_WINDOW:] - count[:-_WINDOW] >= _MOST)[len(loud) - len(out) :]
        if self._recent is None:
            begins[0] |= bool(out[0]) and powers[0] > _IS_PLAIN * rest[0]
        self._recent = loud[-_WINDOW:].copy()
        if not self._held and not begins.any():
            return begins
        lasting = np.zeros(len(out), bool)
        for place, (begin, again) in enumerate(zip(begins, out, strict=True)):
            if begin or (again and self._held):
                self._held = _HELD
            lasting[place] = self._held > 0
            self._held = max(self._held - 1, 0)
        return lasting


def _coefficients(frames: Float32) -> Float64:
    return rowwise_matmul(frames.astype(np.float64), _curves())


def _power(rows: Float64) -> Float64:
    return np.vecdot(rows, rows) / FRAME_SAMPLES


@cache
def _curves() -> Float64:
    """Return orthonormal polynomials over a frame, one per column."""
    place = (np.arange(FRAME_SAMPLES) + 0.5) / FRAME_SAMPLES * 2.0 - 1.0
    powers = np.polynomial.legendre.legvander(place, _TERMS - 1)
    curves: Float64 = powers / np.linalg.norm(powers, axis=0)
    return curves


@cache
def _rough_curves() -> Float32:
    return np.ascontiguousarray(_curves(), np.float32)


@cache
def _probes() -> Float64:
    """Return the map from the coefficients of two frames to their spectrum below 20 Hz.

    The second half of the columns excludes the frame means.
    """
    count = 2 * FRAME_SAMPLES
    taper = np.hanning(count + 2)[1:-1]
    turns = 2 * np.pi * (np.arange(count) + 0.5) / SAMPLE_RATE
    waves = [np.ones(count)]
    for frequency in _PROBES:
        waves += [np.sqrt(2) * np.cos(frequency * turns), np.sqrt(2) * np.sin(frequency * turns)]
    weights = np.stack(waves, axis=1) * (taper / taper.sum())[:, np.newaxis]
    curves = _curves()
    all_waves = np.concatenate(
        [curves.T @ weights[:FRAME_SAMPLES], curves.T @ weights[FRAME_SAMPLES:]]
    )
    waves_only = all_waves.copy()
    waves_only[::_TERMS] = 0.0
    return np.concatenate([all_waves, waves_only], axis=1)
