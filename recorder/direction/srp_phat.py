"""Directions in the channels of an array: SRP-PHAT of what is above the floor of the room.

The phases of the cross-spectra of all pairs of microphones are steered to each direction and summed
(DiBiase, "A high-accuracy, low-latency technique for talker localization in reverberant
environments using microphone arrays", 2000). A band of a moment counts by how much of it is neither
the room's floor nor an echo: less than what sounded a moment before.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hearthlog.models.classifiers.evidence import BLOCK_FRAMES
from hearthlog.models.features.floor import FloorTracker
from hearthlog.recorder.direction.geometry import ArrayGeometry
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

_WINDOW, _HOP = 400, 200  # samples
_HOPS = FRAME_SAMPLES // _HOP  # of a frame
_LOWEST, _HIGHEST = 200.0, 7000.0  # Hz
# Where bands begin, in Hz. Narrower ones make noise look unsteady.
_EDGES = [200, 360, 520, 680, 840, 1000, 1200, 1440, 1720, 2080, 2520, 3040, 3680, 4480, 5600]
_GATE = 10 ** (2.0 / 10)  # times the floor, below which nothing counts
_ECHO_HOPS = 8  # after which what sounded is forgotten
_ECHO_DECAY = 0.8  # of its power with each hop: 60 dB in 0.8 s
_ECHO_SHARE = 0.5  # of its power then, which is taken for echo
_LEAST_WEIGHT = 0.03  # mean over a block
_LEAST_CONFIDENCE = 0.1  # below it, half of the directions are wrong
_STEPS = 512  # to a radian and to 1, to which both are rounded: noise does not compress
_TINY = np.float32(1e-20)

_FREQUENCIES = np.fft.rfftfreq(_WINDOW, 1 / SAMPLE_RATE)
_KEPT = slice(*np.searchsorted(_FREQUENCIES, [_LOWEST, _HIGHEST + 1.0]))
_BINS = len(_FREQUENCIES[_KEPT])
_TAPER = np.hanning(_WINDOW + 1)[:-1].astype(np.float32)
_STARTS = np.searchsorted(_FREQUENCIES[_KEPT], _EDGES)
_WIDTHS = np.diff([*_STARTS, _BINS])


class Located(NamedTuple):
    """Directions of the blocks in which something could be located.

    Attributes
    ----------
    places : np.ndarray [shape=(m,)], int64
        Where each block begins: frames after the first of those that were given, negative if it
        began before them.
    azimuths : np.ndarray [shape=(m,)], float32
        In radians, -pi to pi, counter-clockwise from x; in steps of 1/512.
    confidences : np.ndarray [shape=(m,)], float32
        By how much the phases agree on this direction more than on any, 0 to 1.
    """

    places: Int64
    azimuths: Float32
    confidences: Float32


_NOWHERE = Located(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))


class DirectionFinder:
    """Finds the direction of each block of one stream of frames.

    Blocks depend on the numbers of the frames only, so that the same frames give the same bits in
    pieces of any size.
    """

    def __init__(self, geometry: ArrayGeometry) -> None:
        self._channels = len(geometry.positions)
        self._pairs = geometry.pairs
        self._grid = geometry.grid()
        turns = 2 * np.pi * _FREQUENCIES[_KEPT] * geometry.delays(self._grid.azimuths).T[..., None]
        steering = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        self._steering = steering.reshape(len(steering), -1).astype(np.float32)
        self._floor = FloorTracker()
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._floor.restart()
        self._held: Float32 | None = None  # frames of a block that is not complete
        self._tail = np.zeros((_WINDOW - _HOP, self._channels), np.float32)
        self._past = np.zeros((_ECHO_HOPS, len(_STARTS)), np.float32)  # powers of the last hops

    def __call__(self, frames: Float32, first: int) -> Located:
        """Add successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, 800, c)], float32
            Samples of all channels in full scale, -1 to 1.
        """
        begin = 0
        if self._held is None:
            begin = -first % BLOCK_FRAMES
            if begin >= len(frames):
                return _NOWHERE
            self._held = frames[:0]
        begun = begin - len(self._held)
        frames = np.concatenate([self._held, frames[begin:]])
        blocks = len(frames) // BLOCK_FRAMES
        self._held = frames[blocks * BLOCK_FRAMES :].copy()
        if not blocks:
            return _NOWHERE
        steered = self._steered(frames[: blocks * BLOCK_FRAMES], first + begun)
        azimuths, confidences = self._peaks(steered)
        sure = np.flatnonzero(confidences >= _LEAST_CONFIDENCE)
        return _located(begun + sure * BLOCK_FRAMES, azimuths[sure], confidences[sure])

    def _steered(self, frames: Float32, first: int) -> Float32:
        """Return how well the phases of each block agree with each direction, -1 to 1."""
        spectra = self._spectra(frames)
        power = np.square(spectra.real) + np.square(spectra.imag)
        weights = self._weights(power.mean(axis=1), first)
        phases = spectra / np.maximum(np.sqrt(power), _TINY)
        weighted = phases * weights[:, np.newaxis]
        blocks = (-1, BLOCK_FRAMES * _HOPS)
        phases, weighted = (each.reshape(*blocks, *each.shape[1:]) for each in (phases, weighted))
        one, other = self._pairs.T
        crossed = (weighted.take(one, axis=2) * phases.take(other, axis=2).conj()).sum(axis=1)
        rows = crossed.view(np.float32).reshape(len(crossed), -1)
        total = weights.reshape(*blocks, _BINS).sum(axis=1).sum(axis=1, keepdims=True)
        is_heard = total >= _LEAST_WEIGHT * BLOCK_FRAMES * _HOPS * _BINS
        steered = np.einsum("bk,ak->ba", rows, self._steering)
        return np.where(is_heard, steered / np.maximum(total, _TINY) / len(self._pairs), 0)

    def _spectra(self, frames: Float32) -> NDArray[np.complex64]:
        """Return the spectrum of each channel at each hop: [shape=(h, c, f)]."""
        samples = np.concatenate([self._tail, frames.reshape(-1, self._channels)])
        self._tail = samples[_HOP - _WINDOW :].copy()
        windows = sliding_window_view(samples, _WINDOW, axis=0)[::_HOP]
        return np.fft.rfft(windows * _TAPER, axis=-1)[..., _KEPT].astype(np.complex64, copy=False)

    def _weights(self, power: Float32, first: int) -> Float32:
        """Return how much each bin of each hop counts, 0 to 1."""
        bands = np.add.reduceat(power, _STARTS, axis=1) + _TINY
        floor = np.repeat(self._floors(bands, first), _HOPS, axis=0)
        known = np.concatenate([self._past, bands])
        self._past = known[-_ECHO_HOPS:].copy()
        echo = np.zeros_like(bands)
        for age in range(1, _ECHO_HOPS + 1):
            before = known[_ECHO_HOPS - age : len(known) - age]
            echo = np.maximum(echo, before * np.float32(_ECHO_SHARE * _ECHO_DECAY**age))
        of_sound = np.maximum(1 - floor / bands, 0) * np.maximum(1 - echo / bands, 0)
        return np.repeat(of_sound.astype(np.float32), _WIDTHS, axis=1)

    def _floors(self, bands: Float32, first: int) -> Float64:
        """Return the powers of the bands of each frame below which nothing counts."""
        frames = bands.reshape(-1, _HOPS, len(_STARTS)).astype(np.float64)
        powers = (frames[:, 0] + frames[:, 1] + frames[:, 2] + frames[:, 3]) / _HOPS
        whole = powers.sum(axis=1, keepdims=True)
        floors = self._floor(np.concatenate([powers, whole], axis=1), first).powers
        unknown = np.full((len(powers) - len(floors), len(_STARTS)), np.inf)
        return np.concatenate([unknown, _GATE * floors[:, :-1]])

    def _peaks(self, steered: Float32) -> tuple[Float64, Float64]:
        """Return the best direction of each block, and by how much it is better than any."""
        grid, rows = self._grid, np.arange(len(steered))
        best = steered.argmax(axis=1)
        peak = steered[rows, best]
        before, after = steered[rows, grid.before[best]], steered[rows, grid.after[best]]
        bend = np.minimum(before - 2 * peak + after, -_TINY)
        azimuths = (
            grid.azimuths[best] + np.clip((before - after) / (2 * bend), -0.5, 0.5) * grid.step
        )
        return azimuths, peak - steered.mean(axis=1)


def _located(places: Int64, azimuths: Float64, confidences: Float64) -> Located:
    wrapped = np.pi - (np.pi - azimuths) % (2 * np.pi)
    rounded = (np.rint(each * _STEPS) / _STEPS for each in (wrapped, confidences))
    return Located(places, *(each.astype(np.float32) for each in rounded))
