"""Labels of frames, smoothed, and their segments: runs of one state with refined borders."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.model import Smoothing
from hearthlog.models.labels.smoothing import ClassesApart, FixedLagSmoother
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int64
from hearthlog.schemas.frames import FRAME_SECONDS

_QUIETEST = 1e-9  # power, -90 dBFS
_LEAST_STEP = 1e-6  # dB; smaller steps are rounding errors


class Borders:
    """Refines the states of one stream of frames, in blocks of any size.

    A border of silence moves, within `reach` frames, to the frame that best divides the level into
    two constants, by least squares. Then a state of fewer than `shortest` frames is replaced by the
    state before it. 0 and 1 disable this.
    """

    def __init__(self, silence: int, reach: int, shortest: int) -> None:
        self.delay = 2 * reach + shortest - 1
        self._silence = silence
        self._reach = reach
        self._shortest = shortest
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next state does not follow the previous state."""
        self._states = np.empty(0, np.intp)
        self._levels = np.empty(0)  # in dB, aligned with `_states`
        self._examined = 1  # changes before this index of `_states` have been moved
        self._moved: list[tuple[int, int]] = []  # indices of moved borders, and states after
        self._before: int | None = None  # refined state at the first index
        self._held = np.empty(0, np.intp)  # moved states that may be too short
        self._last: int | None = None  # last state returned

    def push(self, states: Indices, powers: Float64) -> Indices:
        """Add states [shape=(n,)] and mean squares [shape=(m,)]; return refined ones [shape=(k,)].

        There are never more states than powers in total. Refined states go up to `delay` frames
        before the last state.
        """
        self._states = np.concatenate([self._states, states])
        self._levels = np.concatenate([self._levels, 10.0 * np.log10(powers + _QUIETEST)])
        end = len(self._states) - self._reach
        moved = self._move(end, max(end - self._reach, 0))
        return self._without_short(moved, self._shortest - 1)

    def close(self) -> Indices:
        """Return the refined states of the remaining frames, and reset."""
        end = len(self._states)
        states = self._without_short(self._move(end, end), 0)
        self.restart()
        return states

    def _move(self, end: int, final: int) -> Indices:
        """Move the borders before `end`, and remove the states before `final`."""
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
        """Return the refined index of the border at `change`; the next change is at `limit`."""
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
        """Add moved states; return all but the last `held`, with short states replaced."""
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


_UNITS = 1 << 30  # to 1: finer than the resolution of a float32 below 1


class StateRun(NamedTuple):
    """Successive frames of one state; the run may continue."""

    label: int
    start: int  # start of the first frame in nanoseconds of UTC
    frames: int
    # sum of the probabilities of the class in units of 2**-30: integer sums do not depend on order
    confidence: int

    def prepend(self, earlier: "StateRun | None") -> "StateRun":
        """Prepend a run, if any, of the same label that ends where this run starts."""
        if earlier is None:
            return self
        frames, confidence = earlier.frames + self.frames, earlier.confidence + self.confidence
        return earlier._replace(frames=frames, confidence=confidence)


class Segment(NamedTuple):
    """A run that has ended."""

    run: StateRun
    end: int  # end of the last frame in nanoseconds of UTC
    # start of the frame that decided the end, in nanoseconds of UTC; at the end of the sound, that
    # end
    decided_at: int

    @property
    def start(self) -> int:
        """Start of the first frame in nanoseconds of UTC."""
        return self.run.start

    @property
    def label(self) -> int:
        """Index of the class."""
        return self.run.label

    @property
    def confidence(self) -> float:
        """Mean probability of the class, 0 to 1."""
        return self.run.confidence / self.run.frames / _UNITS


class SegmenterInput(NamedTuple):
    """Successive frames with class probabilities."""

    probabilities: Float32  # [shape=(n, C)]
    powers: NDArray[Any]  # [shape=(n,)] mean squares of the samples
    stamps: Int64  # [shape=(n,)] starts of the frames in nanoseconds of UTC
    decided_at: Int64  # [shape=(n,)] starts of the frames that completed the probabilities

    def followed_by(self, later: "SegmenterInput") -> "SegmenterInput":
        """Concatenate these frames and later frames."""
        return SegmenterInput(
            np.concatenate([self.probabilities, later.probabilities]),
            np.concatenate([self.powers, later.powers]),
            np.concatenate([self.stamps, later.stamps]),
            np.concatenate([self.decided_at, later.decided_at]),
        )

    def part(self, frames: slice) -> "SegmenterInput":
        """Return a slice of the frames."""
        return SegmenterInput(
            self.probabilities[frames],
            self.powers[frames],
            self.stamps[frames],
            self.decided_at[frames],
        )


class Segmenter:
    """Divides one stream of frames into segments, by a model's smoothing.

    `transitions` [shape=(C, C)] are those of the hidden Markov model, unused if the smoothing
    merges segments. `segments_converged`: the segments to come are independent of frames before the
    first frame.
    """

    def __init__(self, classes: Sequence[str], smoothing: Smoothing, transitions: Float64) -> None:
        self._smoother, lag = None, 0
        silence = classes.index(SILENCE) if SILENCE in classes else -1
        if smoothing.method == "hmm":
            lag, exponent = _frames(smoothing.lag_seconds), smoothing.class_exponent
            apart = (
                ClassesApart(silence, exponent) if exponent is not None and silence >= 0 else None
            )
            self._smoother = FixedLagSmoother(transitions, lag, smoothing.weight, apart)
        self._reach = _frames(smoothing.reach_seconds) if silence >= 0 else 0
        shortest = max(_frames(smoothing.shortest_seconds), 1)
        self._borders = Borders(silence, self._reach, shortest)
        self._forgetting = 2 * self._reach + shortest  # equal states until borders converge
        self._delay = lag + self._borders.delay
        self.segments_converged = False
        self.open_run: StateRun | None = None
        self._restart()

    def _restart(self) -> None:
        self._undecided: SegmenterInput | None = None
        self._decided = 0  # number of frames with decided states
        self._states = 0  # number of states so far, before border refinement
        self._doubtful = 0  # number of frames that may depend on frames before the first frame
        self._same = -1, 0  # value and length of the last run of converged states
        self._converged_at: int | None = None  # stamp from which states have converged

    @property
    def states_converged(self) -> bool:
        """Whether the states to come are independent of frames before the first frame."""
        if self._undecided is None or self._converged_at is None:
            return False
        stamps = self._undecided.stamps
        return not len(stamps) or self._converged_at <= int(stamps[0])

    def discard_open(self) -> None:
        """Set the counts of the open run to zero; keep its label and start."""
        if self.open_run is not None:
            self.open_run = self.open_run._replace(frames=0, confidence=0)

    def forget(self) -> None:
        """Mark all frames so far as unconverged for `segments_converged`."""
        undecided = 0 if self._undecided is None else len(self._undecided.stamps)
        self._doubtful = self._decided + undecided
        self._same, self._converged_at, self.segments_converged = (-1, 0), None, False
        if self._smoother is not None:
            self._smoother.forget()

    def push(self, frames: SegmenterInput) -> list[Segment]:
        """Add at least one frame; return the segments whose end is now decided."""
        states = frames.probabilities.argmax(axis=1)
        if self._smoother is not None:
            states = self._smoother.push(frames.probabilities)
        refined = self._borders.push(states, frames.powers)
        if self._undecided is not None:
            frames = self._undecided.followed_by(frames)
        self._note_convergence(states, frames.stamps)
        count = len(refined)
        self._decided += count
        self._undecided = frames.part(slice(count, None))
        segments = self._merge(refined, frames.part(slice(count)), frames.decided_at[self._delay :])
        converged_at = self._converged_at
        self.segments_converged |= converged_at is not None and any(
            segment.end > converged_at for segment in segments
        )
        return segments

    def close(self, end: int) -> list[Segment]:
        """Return the remaining segments at the end, in nanoseconds of UTC, and reset."""
        segments = []
        if self._undecided is not None:
            states = np.empty(0, np.intp) if self._smoother is None else self._smoother.close()
            early = self._borders.push(states, np.empty(0))
            refined = np.concatenate([early, self._borders.close()])
            decided_at = np.full(len(refined), end)
            segments = self._merge(refined, self._undecided, decided_at)
        self._restart()
        segments += self._end_run(end, end)
        self.segments_converged |= bool(segments)
        return segments

    def _note_convergence(self, states: Indices, stamps: Int64) -> None:
        """Record when states converged; `stamps` covers all undecided frames.

        Borders converge after enough equal converged states.
        """
        first = self._states
        self._states += len(states)
        after = self._doubtful + 1 if self._smoother is None else self._smoother.converged_after
        if self._converged_at is not None or after is None:
            return
        states, first = states[max(after - 1 - first, 0) :], max(after - 1, first)
        if not len(states):
            return
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        lengths = np.diff(starts, append=len(states))
        value, before = self._same
        if states[0] == value:
            starts[0] -= before
            lengths[0] += before
        enough = np.flatnonzero(lengths >= self._forgetting)
        if len(enough):
            frame = first + int(starts[enough[0]]) + self._reach
            self._converged_at = int(stamps[frame - self._decided])
        self._same = int(states[-1]), int(lengths[-1])

    def _merge(self, states: Indices, frames: SegmenterInput, decided_at: Int64) -> list[Segment]:
        """Add the states of successive frames, decided at these times, to the open run."""
        segments: list[Segment] = []
        starts = np.flatnonzero(np.diff(states, prepend=-1))
        if not len(starts):
            return segments
        confidences = frames.probabilities[np.arange(len(states)), states].astype(np.float64)
        columns = (
            states[starts],
            frames.stamps[starts],
            np.diff(starts, append=len(states)),
            np.add.reduceat(np.rint(confidences * _UNITS).astype(np.int64), starts),
        )
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for run, time in zip(map(StateRun._make, rows), decided_at[starts].tolist(), strict=True):
            last = self.open_run
            if last is not None and last.label == run.label:
                self.open_run = run.prepend(last)
            else:
                segments += self._end_run(run.start, time)
                self.open_run = run
        return segments

    def _end_run(self, end: int, decided_at: int) -> list[Segment]:
        run, self.open_run = self.open_run, None
        return [] if run is None else [Segment(run, end, decided_at)]


def _frames(seconds: float) -> int:
    return round(seconds / FRAME_SECONDS)
