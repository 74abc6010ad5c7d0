"""Channels that cannot be those of an array: dead ones, and copies of each other."""

from itertools import combinations

import numpy as np

from hearthlog.schemas.arrays import Bool, Float32, Int64

_FRAMES = 200  # ten seconds of sound


class ChannelWatch:
    """Watches the channels of an array."""

    def __init__(self, channels: int) -> None:
        self._pairs = np.array(list(combinations(range(channels), 2)))
        self._same = np.zeros(len(self._pairs), np.int64)  # frames in a row, with sound
        self._dead = np.zeros(channels, np.int64)

    def add(self, frames: Float32) -> None:
        """Add successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, 800, c)], float32
        """
        moving = (frames != frames[:, :1]).any(axis=1)
        sounding = moving.any(axis=1)
        frames, moving = frames[sounding], moving[sounding]
        one, other = self._pairs.T
        same = (frames[:, :, one] == frames[:, :, other]).all(axis=1)
        self._dead = _in_a_row(self._dead, ~moving)
        self._same = _in_a_row(self._same, same)

    def problem(self) -> str:
        """Return what is wrong and what to do; empty if nothing is."""
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
    """Return for how many of the last rows each column was true."""
    if not len(flags):
        return before
    since = np.where(flags.all(axis=0), len(flags), flags[::-1].argmin(axis=0))
    return np.where(flags.all(axis=0), before + since, since)
