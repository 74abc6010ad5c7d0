"""Directions of arrival at an array: SRP-PHAT of the sound above the noise floor of the room.

The phases of the cross-spectra of all microphone pairs are steered to each direction and summed
(DiBiase, "A high-accuracy, low-latency technique for talker localization in reverberant
environments using microphone arrays", 2000).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hearthlog.models.classifiers.evidence import BLOCK_FRAMES, NOWHERE, Directions
from hearthlog.models.features.floor import FloorTracker
from hearthlog.recorder.events import Frames
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import ConfigurationError
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

SPEED_OF_SOUND = 343.0  # m/s, in air of 20 °C
MOST_MICROPHONES = 8
_STEP = np.deg2rad(3.0)
_LEAST_METRES, _MOST_METRES = 0.02, 1.0  # from the first microphone to the last
_SAME_PLACE = 0.001  # metres
_LINE = 0.02  # maximum breadth of a line, relative to its length


class DirectionGrid(NamedTuple):
    """Grid of candidate directions."""

    azimuths: Float64  # [shape=(a,)] in radians, counter-clockwise from x, in equal steps
    before: Indices  # [shape=(a,)] index of each direction's neighbour
    after: Indices  # [shape=(a,)] index of the other neighbour
    step: float  # in radians


@dataclass(frozen=True)
class ArrayGeometry:
    """Microphone positions of an array."""

    # [shape=(c, 3)] each channel's microphone, in metres: x forward, y to the left, z up
    positions: Float64

    @property
    def is_line(self) -> bool:
        """Whether the microphones are in a line: a source and its mirror image are ambiguous."""
        flat = self.positions[:, :2] - self.positions[:, :2].mean(axis=0)
        length, breadth = np.linalg.svd(flat, compute_uv=False)
        return bool(breadth < _LINE * length)

    @property
    def pairs(self) -> Indices:
        """The two channels of each pair: [shape=(p, 2)]."""
        return np.array(list(combinations(range(len(self.positions)), 2)))

    def direction_finder(self) -> "ArrayDirections":
        """Return a finder of the directions of this array's sound."""
        return ArrayDirections(self)

    def grid(self) -> DirectionGrid:
        """Return the directions that the array can distinguish.

        For a line they are a half circle, counter-clockwise, that begins at the direction from the
        first microphone to the last.
        """
        if not self.is_line:
            count = round(2 * np.pi / _STEP)
            places = np.arange(count)
            return DirectionGrid(places * _STEP, (places - 1) % count, (places + 1) % count, _STEP)
        x, y, _ = _farthest(self.positions) - self.positions[0]
        last = round(np.pi / _STEP)
        places = np.arange(last + 1)
        # A direction beyond an end is the mirror image of one before the end.
        after = last - np.abs(last - places - 1)
        return DirectionGrid(np.arctan2(y, x) + places * _STEP, np.abs(places - 1), after, _STEP)

    def delays(self, azimuths: Float64) -> Float64:
        """Compute delays in seconds [shape=(p, a)] of far-field sound from azimuths in radians.

        They are those at the second microphone of each pair; azimuths [shape=(a,)] are in the plane
        of x and y.
        """
        towards = np.stack([np.cos(azimuths), np.sin(azimuths)])
        first, second = self.positions[self.pairs.T, :2]
        delays: Float64 = (first - second) @ towards / SPEED_OF_SOUND
        return delays


def geometry_of(positions: Sequence[Sequence[float]]) -> ArrayGeometry:
    """Check microphone positions: [x, y] or [x, y, z] of each channel, in metres.

    Raise `ConfigurationError` if the number of microphones is out of range, a position is invalid
    or used twice, or the distances are too small or too large for direction finding.
    """
    count = len(positions)
    if not 2 <= count <= MOST_MICROPHONES:
        raise ConfigurationError(
            f"an array has 2 to {MOST_MICROPHONES} microphones, not {count}: name a place [x, y] "
            "for each channel"
        )
    if {len(place) for place in positions} not in ({2}, {3}):
        raise ConfigurationError("each place of an array is [x, y], or each is [x, y, z]")
    places = np.zeros((count, 3))
    places[:, : len(positions[0])] = positions
    if not np.isfinite(places).all():
        raise ConfigurationError("the places of an array are finite numbers, in metres")
    for one, other in combinations(range(count), 2):
        if np.linalg.norm(places[one] - places[other]) < _SAME_PLACE:
            raise ConfigurationError(
                f"channels {one + 1} and {other + 1} of the array are at the same place"
            )
    flat = np.linalg.norm(places[:, np.newaxis, :2] - places[:, :2], axis=2).max()
    if not _LEAST_METRES <= flat <= _MOST_METRES:
        raise ConfigurationError(
            f"the microphones of an array are {_LEAST_METRES:g} to {_MOST_METRES:g} m apart, seen "
            f"from above; these are {flat:.3g} m: places are in metres"
        )
    return ArrayGeometry(places)


def _farthest(positions: Float64) -> Float64:
    """Return the position farthest from the first one."""
    distances = np.linalg.norm(positions[:, :2] - positions[0, :2], axis=1)
    place: Float64 = positions[distances.argmax()]
    return place


_WINDOW, _HOP = 400, 200  # samples
_HOPS = FRAME_SAMPLES // _HOP  # of a frame
_LOWEST, _HIGHEST = 200.0, 7000.0  # Hz
# Lower band edges in Hz. In narrower bands noise looks unsteady.
_EDGES = [200, 360, 520, 680, 840, 1000, 1200, 1440, 1720, 2080, 2520, 3040, 3680, 4480, 5600]
_GATE = 10 ** (2.0 / 10)  # times the floor; weaker sound has no weight
_ECHO_HOPS = 8  # hops remembered by the echo estimate
_ECHO_DECAY = 0.8  # power ratio per hop: 60 dB in 0.8 s
_ECHO_SHARE = 0.5  # share of the decayed power that counts as echo
_LEAST_WEIGHT = 0.03  # mean over a block
_LEAST_CONFIDENCE = 0.1  # of a block: below it, half of the directions were wrong
_STEPS = 512  # rounding steps per radian, and per 1 of confidence: digits below are noise
_TINY = np.float32(1e-20)

_FREQUENCIES = np.fft.rfftfreq(_WINDOW, 1 / SAMPLE_RATE)
_KEPT = slice(*np.searchsorted(_FREQUENCIES, [_LOWEST, _HIGHEST + 1.0]))
_BINS = len(_FREQUENCIES[_KEPT])
_TAPER = np.hanning(_WINDOW + 1)[:-1].astype(np.float32)
_STARTS = np.searchsorted(_FREQUENCIES[_KEPT], _EDGES)
_WIDTHS = np.diff([*_STARTS, _BINS])


class Located(NamedTuple):
    """Directions of the blocks in which a source was located."""

    # [shape=(m,)] start of each block in frames relative to the first pushed frame; negative if the
    # block began earlier
    places: Int64
    # [shape=(m,)] in radians, -pi to pi, counter-clockwise from x; in steps of 1/512
    azimuths: Float32
    # [shape=(m,)] excess of the phase agreement in this direction over the mean of all directions,
    # 0 to 1
    confidences: Float32


_NO_BLOCKS = Located(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))


class BlockDirections:
    """Finds the direction of each block of one stream of frames.

    Each band and time step is weighted by its share that is neither noise floor nor echo: an echo
    is weaker than the sound a moment before. Blocks are aligned to the frame numbers, so results
    are bit-equal for pieces of any size.
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
        """Reset: the next frame does not follow the last one."""
        self._floor.restart()
        self._held: Float32 | None = None  # frames of the incomplete block
        self._tail = np.zeros((_WINDOW - _HOP, self._channels), np.float32)
        self._past = np.zeros((_ECHO_HOPS, len(_STARTS)), np.float32)  # powers of the last hops

    def __call__(self, frames: Float32, first: int) -> Located:
        """Add successive frames [shape=(n, 800, c)] of all channels in full scale, -1 to 1."""
        begin = 0
        if self._held is None:
            begin = -first % BLOCK_FRAMES
            if begin >= len(frames):
                return _NO_BLOCKS
            self._held = frames[:0]
        begun = begin - len(self._held)
        frames = np.concatenate([self._held, frames[begin:]])
        blocks = len(frames) // BLOCK_FRAMES
        self._held = frames[blocks * BLOCK_FRAMES :].copy()
        if not blocks:
            return _NO_BLOCKS
        steered = self._steered(frames[: blocks * BLOCK_FRAMES], first + begun)
        azimuths, confidences = self._peaks(steered)
        sure = np.flatnonzero(confidences >= _LEAST_CONFIDENCE)
        return _located(begun + sure * BLOCK_FRAMES, azimuths[sure], confidences[sure])

    def _steered(self, frames: Float32, first: int) -> Float32:
        """Return the phase agreement of each block with each direction, -1 to 1."""
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
        is_loud = total >= _LEAST_WEIGHT * BLOCK_FRAMES * _HOPS * _BINS
        steered = np.einsum("bk,ak->ba", rows, self._steering)
        return np.where(is_loud, steered / np.maximum(total, _TINY) / len(self._pairs), 0)

    def _spectra(self, frames: Float32) -> NDArray[np.complex64]:
        """Return the spectrum of each channel at each hop: [shape=(h, c, f)]."""
        samples = np.concatenate([self._tail, frames.reshape(-1, self._channels)])
        self._tail = samples[_HOP - _WINDOW :].copy()
        windows = sliding_window_view(samples, _WINDOW, axis=0)[::_HOP]
        return np.fft.rfft(windows * _TAPER, axis=-1)[..., _KEPT].astype(np.complex64, copy=False)

    def _weights(self, power: Float32, first: int) -> Float32:
        """Return the weight of each bin of each hop, 0 to 1."""
        bands = np.add.reduceat(power, _STARTS, axis=1) + _TINY
        floor = np.repeat(self._floors(bands, first), _HOPS, axis=0)
        spectra = np.concatenate([self._past, bands])
        self._past = spectra[-_ECHO_HOPS:].copy()
        echo = np.zeros_like(bands)
        for age in range(1, _ECHO_HOPS + 1):
            before = spectra[_ECHO_HOPS - age : len(spectra) - age]
            echo = np.maximum(echo, before * np.float32(_ECHO_SHARE * _ECHO_DECAY**age))
        of_sound = np.maximum(1 - floor / bands, 0) * np.maximum(1 - echo / bands, 0)
        return np.repeat(of_sound.astype(np.float32), _WIDTHS, axis=1)

    def _floors(self, bands: Float32, first: int) -> Float64:
        """Return the gate of each frame and band: powers below it have no weight."""
        frames = bands.reshape(-1, _HOPS, len(_STARTS)).astype(np.float64)
        powers = (frames[:, 0] + frames[:, 1] + frames[:, 2] + frames[:, 3]) / _HOPS
        sums = powers.sum(axis=1, keepdims=True)
        floors = self._floor(np.concatenate([powers, sums], axis=1), first).powers
        unknown = np.full((len(powers) - len(floors), len(_STARTS)), np.inf)
        return np.concatenate([unknown, _GATE * floors[:, :-1]])

    def _peaks(self, steered: Float32) -> tuple[Float64, Float64]:
        """Return the best direction of each block, and its excess over the mean."""
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


_FRAMES = 200  # ten seconds of sound


class ChannelWatch:
    """Detects dead and identical channels of an array."""

    def __init__(self, channels: int) -> None:
        self._pairs = np.array(list(combinations(range(channels), 2)))
        self._same = np.zeros(len(self._pairs), np.int64)  # frames in a row, with sound
        self._dead = np.zeros(channels, np.int64)

    def add(self, frames: Float32) -> None:
        """Add successive frames [shape=(n, 800, c)]."""
        moving = (frames != frames[:, :1]).any(axis=1)
        sounding = moving.any(axis=1)
        frames, moving = frames[sounding], moving[sounding]
        one, other = self._pairs.T
        same = (frames[:, :, one] == frames[:, :, other]).all(axis=1)
        self._dead = _in_a_row(self._dead, ~moving)
        self._same = _in_a_row(self._same, same)

    def problem(self) -> str:
        """Return the fault and its remedy; empty if there is none."""
        if (self._dead >= _FRAMES).any():
            channel = int(self._dead.argmax()) + 1
            return f"channel {channel} of the array gives no sound: no direction can be trusted"
        if (self._same >= _FRAMES).any():
            one, other = self._pairs[self._same.argmax()] + 1
            return (
                f"channels {one} and {other} of the array are the same sound: name the device "
                "itself, not one that mixes its channels, or leave `array` out"
            )
        return ""


def _in_a_row(before: Int64, flags: Bool) -> Int64:
    """Return the length of the final run of true rows in each column."""
    if not len(flags):
        return before
    since = np.where(flags.all(axis=0), len(flags), flags[::-1].argmin(axis=0))
    return np.where(flags.all(axis=0), before + since, since)


class ArrayDirections:
    """Finds the directions of an array's sound, and checks its channels."""

    def __init__(self, geometry: ArrayGeometry) -> None:
        self._finder = BlockDirections(geometry)
        self._watch = ChannelWatch(len(geometry.positions))
        self.restart()

    def restart(self) -> None:
        """Reset: the next frame does not follow the last one."""
        self._finder.restart()
        self._stamps = np.empty(0, np.int64)  # of the frames of the incomplete block

    def problem(self) -> str:
        """Return the fault of the channels and its remedy; empty if there is none."""
        return self._watch.problem()

    def __call__(self, frames: Frames) -> Directions:
        """Find the directions of the blocks that these frames complete.

        Frames without channels, as from a fallback microphone, have no direction.
        """
        if frames.channels is None:
            self.restart()
            return NOWHERE
        self._watch.add(frames.channels)
        places, azimuths, confidences = self._finder(frames.channels, frames.first)
        held = len(self._stamps)
        stamps = np.concatenate([self._stamps, frames.stamps])
        self._stamps = stamps[1 - BLOCK_FRAMES :]
        return Directions(frames.first + places, stamps[held + places], azimuths, confidences)
