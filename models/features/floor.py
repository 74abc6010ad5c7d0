"""The floor of a room: the background power in each band.

It falls with the tenth percentile of the last minute, as in minimum statistics (Martin, "Noise
power spectral density estimation based on optimal smoothing and minimum statistics", 2001), and
rises only while the sound is as steady as noise.
"""

from typing import NamedTuple

import numpy as np

from hearthlog.schemas.arrays import Bool, Float64

BLOCK_FRAMES = 8
SECTION_BLOCKS = 10  # 4 s
_MINUTE_BLOCKS = 150
_SECOND_FRAMES = 20  # no window is longer
_MEMORY_SECTIONS = 10_800  # 12 h; a relabelling reads back no further
_SHARE = 0.1  # share of the blocks of a minute that may be below the floor
_STANDS_OUT = 10 ** (2 / 10)  # relative to the floor: less is silence anyway
_STEADY_DB = 0.42  # noise is below 0.4; real showers, taps, music and speech are above
_LOUD = 10 ** (-35 / 10)  # power: fridges are below it, steady taps and alarm tones above
NOMINAL = 1e-7  # power, -70 dBFS: differences below it come from codecs


class Floors(NamedTuple):
    """Floors at successive frames."""

    powers: Float64  # [shape=(m, b)] powers of the bands; the last is of the complete frame
    # [shape=(m, b)] the same, including steady sound that continues and is not loud: sound not
    # above it is silence
    room: Float64
    sound: Float64  # [shape=(m, b)] band powers of the frames themselves
    # whether these floors, and the floors of the preceding second, are independent of frames before
    # the start of the stream
    converged: bool


class FloorTracker:
    """Tracks the floor of one stream of frames.

    A fan becomes part of the room, and ten minutes of a shower or of music do not. Steady sound no
    louder than a fridge belongs to the room at once; the floor, which is subtracted from sound,
    follows steady sound after a minute. Frames are averaged in blocks whose positions depend only
    on the frame numbers, so the same frames give the same bits in blocks of any size.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._converged_for: int | None = None  # number of frames
        self._partial: Float64 | None = None  # frames of an incomplete block
        self._blocks: Float64 | None = None  # of the last minute
        self._floor: Float64 | None = None
        self._steady: Float64 | None = None  # powers of continuing steady sound
        self._settled = False  # whether a complete section was processed
        self._unsteady = 0  # number of sections since the last steady one

    def __call__(self, powers: Float64, first: int) -> Floors:
        """Add powers of frames [shape=(n, b)], the last of the complete frame.

        `first` is the number of the first frame. Return the floors at the last m of these frames:
        the frames after the first complete block since the start or the last restart.
        """
        converged = self._converged_for is not None and self._converged_for >= _SECOND_FRAMES
        if self._converged_for is not None:
            self._converged_for += len(powers)
        floors, room = np.split(self._track(powers, first), 2, axis=1)
        return Floors(floors, room, powers[len(powers) - len(floors) :], converged)

    def _track(self, powers: Float64, first: int) -> Float64:
        """Return floor and room, side by side, at each frame that has them."""
        if self._partial is None:
            skipped = -first % BLOCK_FRAMES
            if skipped >= len(powers):
                return np.empty((0, 2 * powers.shape[1]))
            powers, first = powers[skipped:], first + skipped
            self._partial = powers[:0]
        begun, before = len(self._partial), self._now()
        frames = np.concatenate([self._partial, powers])
        count = len(frames) // BLOCK_FRAMES
        self._partial = frames[count * BLOCK_FRAMES :].copy()
        floors = self._add_blocks(_block_means(frames, count), (first - begun) // BLOCK_FRAMES)
        complete = (begun + 1 + np.arange(len(powers))) // BLOCK_FRAMES
        if before is None:
            return floors[complete[complete > 0] - 1]
        return np.concatenate([before[np.newaxis], floors])[complete]

    def _add_blocks(self, blocks: Float64, number: int) -> Float64:
        """Return floor and room after each of some blocks; `number` is the first block's number."""
        floors = np.empty((len(blocks), 2 * blocks.shape[1]))
        past = 0 if self._blocks is None else len(self._blocks)
        if self._blocks is not None:
            blocks = np.concatenate([self._blocks, blocks])
        ending = -(number + 1) % SECTION_BLOCKS  # the first block that ends a section
        if past + ending + 1 < SECTION_BLOCKS:
            ending += SECTION_BLOCKS
        are_steady = _are_steady(blocks[past + ending + 1 - SECTION_BLOCKS :])
        place = 0
        while place < len(floors):
            end = past + place + 1
            until_ending = (ending - place) % SECTION_BLOCKS
            if not until_ending and place >= ending:
                steady = are_steady[(place - ending) // SECTION_BLOCKS]
                self._end_section(
                    blocks[max(end - _MINUTE_BLOCKS, 0) : end], is_steady=bool(steady)
                )
            elif not self._settled:
                self._floor = _low(blocks[:end])
            # Then the floor is constant until the section ends.
            stop = place + ((until_ending or SECTION_BLOCKS) if self._settled else 1)
            self._write_floors(blocks[end - 1 : past + stop], floors[place:stop])
            place = stop
        self._blocks = blocks[-_MINUTE_BLOCKS:].copy()
        return floors

    def _write_floors(self, blocks: Float64, floors: Float64) -> None:
        """Write floor and room after each of some blocks with a constant floor."""
        floors[:] = self._now()
        if self._steady is None:
            return
        fainter = np.flatnonzero(_STANDS_OUT * blocks[:, -1] < self._steady[-1])
        if len(fainter):
            self._steady = None
            floors[fainter[0] :] = self._now()

    def _now(self) -> Float64 | None:
        if self._floor is None:
            return None
        room = self._floor if self._steady is None else np.maximum(self._floor, self._steady)
        return np.concatenate([self._floor, room])

    def _end_section(self, minute: Float64, *, is_steady: bool) -> None:
        """Update the floor at the end of a section, from the blocks of the last minute."""
        low, section = _low(minute), minute[-SECTION_BLOCKS:]
        self._settled = True
        self._unsteady += 1
        if is_steady:
            self._floor, self._unsteady = section.mean(axis=0), 0
            self._steady = self._floor if self._floor[-1] < _LOUD else None
        elif self._floor is None or self._unsteady >= _MEMORY_SECTIONS:
            self._floor, self._steady = low, None
        if low[-1] < self._floor[-1]:
            self._floor = np.minimum(self._floor, low)
        if self._steady is not None and not _stands_out(self._steady, self._floor):
            self._steady = None
        forgotten = self._unsteady in {0, _MEMORY_SECTIONS}
        if self._converged_for is None and forgotten and len(minute) == _MINUTE_BLOCKS:
            self._converged_for = 0


def decibels(powers: Float64) -> Float64:
    """Convert powers [shape=(..., b)] to levels in dB, not below -70."""
    return 10.0 * np.log10(powers + NOMINAL)


def is_quiet(powers: Float64, floors: Float64, window_frames: int, gate: float) -> Bool:
    """Return whether no band's mean power in a window is at least `gate`, in dB, above the floor.

    `powers` [shape=(n + window_frames - 1, b)] are those of successive frames, `floors` [shape=(n,
    b)] are at the last frame of each window; the result has shape (n,).
    """
    total = powers[: len(floors)].copy()
    for place in range(1, window_frames):
        total += powers[place : place + len(floors)]
    limit = 10.0 ** (gate / 10.0) * (floors + NOMINAL) - NOMINAL
    quiet: Bool = (total / window_frames < limit).all(axis=1)
    return quiet


def low_power(powers: Float64, share: float = 0.2) -> Float64:
    """Return the floor [shape=(b,)] of a recording that contains only the room.

    `powers` [shape=(n, b)] are of at least one frame, `share` of the blocks are below the floor.
    The floor is the mean of all frames if there is no complete block.
    """
    count = len(powers) // BLOCK_FRAMES
    if not count:
        mean: Float64 = powers.mean(axis=0)
        return mean
    return _low(_block_means(powers, count), share)


def _are_steady(blocks: Float64) -> Bool:
    """Return which complete sections of successive blocks are as steady as noise."""
    sections = blocks[: len(blocks) - len(blocks) % SECTION_BLOCKS, :-1]
    levels = decibels(sections.reshape(-1, SECTION_BLOCKS, sections.shape[1]))
    are_steady: Bool = levels.std(axis=1).mean(axis=1) < _STEADY_DB
    return are_steady


def _stands_out(steady: Float64, floor: Float64) -> bool:
    return bool((steady + NOMINAL > _STANDS_OUT * (floor + NOMINAL)).any())


def _low(blocks: Float64, share: float = _SHARE) -> Float64:
    place = round(share * (len(blocks) - 1))
    low: Float64 = np.partition(blocks, place, axis=0)[place]
    return low


def _block_means(frames: Float64, count: int) -> Float64:
    """Average frames in `count` blocks; the order of summation does not depend on `count`."""
    blocks = frames[: count * BLOCK_FRAMES].reshape(count, BLOCK_FRAMES, frames.shape[1])
    total = blocks[:, 0].copy()
    for place in range(1, BLOCK_FRAMES):
        total += blocks[:, place]
    return total / BLOCK_FRAMES
