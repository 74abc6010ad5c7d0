"""From the index of a sample to its time: a line through the times that the sound card reports."""

from collections import deque

import numpy as np

from hearthlog.schemas.arrays import Float64

_WINDOW_SECONDS = 2.0
_WINDOWS = 150  # five minutes: long enough for 1 ppm, short enough to follow the temperature
_PRIOR_PPM = 50.0  # expected error of a sound card's crystal, before it has been measured
_STEEPEST = 0.1  # seconds of steering a second: frames stay in order, whatever arrives
_PRIOR_NOISE = 100e-6  # seconds: expected lateness of the earliest observation of a window
_LATE = _PRIOR_NOISE  # what is later pulls the line no further: the machine was busy
_ROUNDS = 10  # of weighing the windows anew


class SampleClock:
    """Maps the index of a sample to the time at which it was taken.

    Observations are late, never early, by the delays of the sound card and the scheduler. So each
    window of two seconds counts by its earliest observation, and a line is fitted through these.
    A busy machine can be late all through a window: what lies above the line counts linearly (as in
    Huber's loss), what lies below it by its square. Behind a sound server the delays are a hundred
    times as long, and no line can be fitted: there the earliest observation of all windows counts.
    The time is steered towards each new line, never set to it: time does not jump.

    Parameters
    ----------
    rate : float
        Nominal samples per second.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._windows: deque[tuple[float, float]] = deque(maxlen=_WINDOWS)
        self._window_end = 0.0
        self._earliest: tuple[float, float] | None = None
        self._earliest_steered = 0.0
        # From `_anchor` (a nominal time) on, time = nominal + _late + _slope * (nominal - _anchor).
        self._origin: float | None = None
        self._anchor = 0.0
        self._late = 0.0
        self._slope = 0.0
        self._fitted_slope = 0.0
        self._is_exact = True

    @property
    def started(self) -> bool:
        """Whether there has been an observation."""
        return self._origin is not None

    @property
    def ppm(self) -> float:
        """How much faster than nominal the samples come, in parts per million."""
        return -self._fitted_slope * 1e6

    def observe(self, index: int, time: float, *, is_exact: bool = True) -> None:
        """Add an observation: a time by which a sample had been taken.

        Parameters
        ----------
        time : float
            Seconds of CLOCK_MONOTONIC.
        is_exact : bool
            Whether it is a time of the sound card, and not that of an arrival.
        """
        self._is_exact = is_exact
        nominal = index / self._rate
        if self._origin is None:
            self._origin = time - nominal
            self._anchor, self._window_end = nominal, nominal + _WINDOW_SECONDS
        late = time - self._origin - nominal
        if nominal >= self._window_end:
            self._close_window(nominal)
        steered = late - self._slope * (nominal - self._anchor)
        if self._earliest is None or steered < self._earliest_steered:
            self._earliest, self._earliest_steered = (nominal, late), steered

    def time(self, index: Float64 | float) -> Float64:
        """Compute the times at which samples were taken.

        Parameters
        ----------
        index : float or np.ndarray [shape=(n,)], float64
            Numbers of the samples, or places between them. There must have been an observation.

        Returns
        -------
        np.ndarray [shape=() or (n,)], float64
            Seconds of CLOCK_MONOTONIC.
        """
        assert self._origin is not None
        nominal = np.asarray(index) / self._rate
        return self._origin + nominal + self._late + self._slope * (nominal - self._anchor)

    def _close_window(self, nominal: float) -> None:
        if self._earliest is not None:
            self._windows.append(self._earliest)
        self._earliest = None
        self._window_end = nominal + _WINDOW_SECONDS
        now = self._late + self._slope * (nominal - self._anchor)
        self._fitted_slope, ahead = self._fit(nominal + _WINDOW_SECONDS)
        self._anchor, self._late = nominal, now
        slope = (ahead - now) / _WINDOW_SECONDS
        self._slope = min(max(slope, -_STEEPEST), _STEEPEST)

    def _fit(self, nominal: float) -> tuple[float, float]:
        """Return how fast the observations grow late, and how late they are at a nominal time."""
        at, late = np.array(self._windows).T
        if not self._is_exact:
            return 0.0, float(late.min())
        weight = np.ones(len(at))
        for _ in range(_ROUNDS):
            center, mean = np.average([at, late], axis=1, weights=weight)
            spread = (weight * (at - center) ** 2).sum()
            spread += (_PRIOR_NOISE / (_PRIOR_PPM * 1e-6)) ** 2
            slope = float((weight * (at - center) * (late - mean)).sum() / spread)
            above = late - mean - slope * (at - center)
            weight = _LATE / np.maximum(above, _LATE)
        return slope, float(mean + slope * (nominal - center))
