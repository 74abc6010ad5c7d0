"""Borders of states: moved to where the level changes, and states that are too short left out."""

import numpy as np

from hearthlog.schemas.arrays import Float64, Indices

_QUIETEST = 1e-9  # power, -90 dBFS
_LEAST_STEP = 1e-6  # dB; below it are errors of rounding


class Borders:
    """Refines the states of one stream of frames, which come in pieces of any size.

    A border of silence is moved to the frame, within `reach` frames, that divides the level best
    into two constants, by least squares. After that a state of fewer than `shortest` frames gives
    way to the state before it.

    Parameters
    ----------
    reach, shortest : int
        Numbers of frames; 0 and 1 leave all as it is.
    """

    def __init__(self, silence: int, reach: int, shortest: int) -> None:
        self.delay = 2 * reach + shortest - 1
        self._silence = silence
        self._reach = reach
        self._shortest = shortest
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next state does not follow the last one."""
        self._states = np.empty(0, np.intp)
        self._levels = np.empty(0)  # in dB, from the first of `_states` on
        self._examined = 1  # changes before this place in `_states` have been moved
        self._moved: list[tuple[int, int]] = []  # places of moved borders, and the states behind
        self._before: int | None = None  # refined state at the first place
        self._held = np.empty(0, np.intp)  # moved states that may be too short
        self._last: int | None = None  # last state that was given away

    def push(self, states: Indices, powers: Float64) -> Indices:
        """Add successive states and powers.

        Parameters
        ----------
        states : np.ndarray [shape=(n,)], intp
        powers : np.ndarray [shape=(m,)], float64
            Mean squares of successive frames; there are never more states than powers so far.

        Returns
        -------
        np.ndarray [shape=(k,)], intp
            Refined states, up to `delay` frames before the last state.
        """
        self._states = np.concatenate([self._states, states])
        self._levels = np.concatenate([self._levels, 10.0 * np.log10(powers + _QUIETEST)])
        end = len(self._states) - self._reach
        moved = self._move(end, max(end - self._reach, 0))
        return self._without_short(moved, self._shortest - 1)

    def close(self) -> Indices:
        """Return the refined states of the remaining frames, and begin anew."""
        end = len(self._states)
        states = self._without_short(self._move(end, end), 0)
        self.restart()
        return states

    def _move(self, end: int, final: int) -> Indices:
        """Move the borders before `end`, and take away the states before `final`."""
        states = self._states
        if not self._reach or not len(states):
            self._states, self._levels = states[:0], self._levels[len(states) :]
            return states
        changes = np.flatnonzero(np.diff(states)) + 1
        behind = np.append(changes[1:], len(states))
        new = (changes >= self._examined) & (changes < end)
        for change, limit in zip(changes[new].tolist(), behind[new].tolist(), strict=True):
            self._moved.append((self._place(change, limit), int(states[change])))
        before = int(states[0]) if self._before is None else self._before
        passed = [(0, before), *(border for border in self._moved if border[0] < final)]
        places, values = zip(*passed, strict=True)
        self._moved = [(place - final, state) for place, state in self._moved if place >= final]
        self._states, self._levels = states[final:], self._levels[final:]
        self._examined, self._before = max(end, 1) - final, values[-1]
        return np.repeat(np.array(values, np.intp), np.diff([*places, final]))

    def _place(self, change: int, limit: int) -> int:
        """Return the place of a border whose states change at a place, and next at `limit`."""
        if self._silence not in self._states[change - 1 : change + 1]:
            return change
        last = self._moved[-1][0] if self._moved else -1
        first, limit = max(change - self._reach, last + 1), min(change + self._reach, limit)
        if limit - first < 3:
            return change
        sums = np.cumsum(self._levels[first:limit])
        count = np.arange(1, len(sums))
        rest = len(sums) - count
        gain = (sums[-1] - sums[:-1]) / rest - sums[:-1] / count
        gain *= np.sqrt(count * rest)
        if self._states[change] == self._silence:
            gain = -gain
        return first + 1 + int(gain.argmax()) if gain.max() > _LEAST_STEP else change

    def _without_short(self, states: Indices, held: int) -> Indices:
        """Add moved states; return all but the last `held`, too short ones replaced."""
        states = np.concatenate([self._held, states])
        count = max(len(states) - held, 0)
        refined, self._held = states[:count].copy(), states[count:]
        if not count:
            return refined
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        ends = np.append(starts[1:], len(states))
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            if start >= count:
                break
            if end - start >= self._shortest or self._last is None:
                self._last = int(states[start])
            else:
                refined[start:end] = self._last
        return refined
