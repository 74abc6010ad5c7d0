"""The microphones of one device: where they are, and how sound of each direction meets them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hearthlog.recorder.errors import ConfigurationError
from hearthlog.schemas.arrays import Float64, Indices

SPEED_OF_SOUND = 343.0  # m/s, in air of 20 °C
MOST_MICROPHONES = 8
_STEP = np.deg2rad(3.0)
_LEAST_METRES, _MOST_METRES = 0.02, 1.0  # from the first microphone to the last
_SAME_PLACE = 0.001  # metres
_LINE = 0.02  # of its length, which a line may be broad


class Grid(NamedTuple):
    """Directions that are tried.

    Attributes
    ----------
    azimuths : np.ndarray [shape=(a,)], float64
        In radians, counter-clockwise from x, in equal steps.
    before, after : np.ndarray [shape=(a,)], intp
        Where the neighbours of each are.
    step : float
        In radians.
    """

    azimuths: Float64
    before: Indices
    after: Indices
    step: float


@dataclass(frozen=True)
class ArrayGeometry:
    """Where the microphones of an array are.

    Attributes
    ----------
    positions : np.ndarray [shape=(c, 3)], float64
        Of the microphone of each channel, in metres: x forward, y to the left, z up.
    """

    positions: Float64

    @property
    def is_line(self) -> bool:
        """Whether a sound and its mirror image at the line sound the same."""
        flat = self.positions[:, :2] - self.positions[:, :2].mean(axis=0)
        length, breadth = np.linalg.svd(flat, compute_uv=False)
        return bool(breadth < _LINE * length)

    @property
    def pairs(self) -> Indices:
        """The two channels of each pair: [shape=(p, 2)]."""
        return np.array(list(combinations(range(len(self.positions)), 2)))

    def grid(self) -> Grid:
        """Return the directions that the array can tell apart.

        Those of a line are the half circle that begins where the last microphone is, as seen from
        the first, and goes on counter-clockwise.
        """
        if not self.is_line:
            count = round(2 * np.pi / _STEP)
            places = np.arange(count)
            return Grid(places * _STEP, (places - 1) % count, (places + 1) % count, _STEP)
        x, y, _ = _farthest(self.positions) - self.positions[0]
        last = round(np.pi / _STEP)
        places = np.arange(last + 1)
        # What lies beyond an end is the mirror image of what lies before it.
        after = last - np.abs(last - places - 1)
        return Grid(np.arctan2(y, x) + places * _STEP, np.abs(places - 1), after, _STEP)

    def delays(self, azimuths: Float64) -> Float64:
        """Compute how much later sound from far away meets the second microphone of each pair.

        Parameters
        ----------
        azimuths : np.ndarray [shape=(a,)], float64
            Whence it comes, in the plane of x and y; in radians.

        Returns
        -------
        np.ndarray [shape=(p, a)], float64
            In seconds.
        """
        towards = np.stack([np.cos(azimuths), np.sin(azimuths)])
        first, second = self.positions[self.pairs.T, :2]
        delays: Float64 = (first - second) @ towards / SPEED_OF_SOUND
        return delays


def array_geometry(positions: Sequence[Sequence[float]]) -> ArrayGeometry:
    """Check the places of the microphones of an array.

    Parameters
    ----------
    positions : sequence of sequence of float
        [x, y] or [x, y, z] of each channel's microphone, in metres.

    Raises
    ------
    ConfigurationError
        If there are too few or too many of them, if one is no place or that of another, or if they
        are nearer together or farther apart than directions can be told by.
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
    """Return the place that is farthest from the first one."""
    distances = np.linalg.norm(positions[:, :2] - positions[0, :2], axis=1)
    place: Float64 = positions[distances.argmax()]
    return place
