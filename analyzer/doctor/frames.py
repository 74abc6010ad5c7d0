"""Frame numbers, stamps and gaps of one microphone: what the messages must say together."""

import numpy as np
from numpy.typing import NDArray

from analyzer.doctor.findings import DISTRUST, Findings
from recorder.statistics import WINDOW_FRAMES
from recorder.stream import FRAME_NANOSECONDS
from schemas.rows import Int64

# Behind a sound server stamps are steered by when blocks arrive, at first by up to 45 % (ns).
_STEP_TOLERANCE = FRAME_NANOSECONDS // 2
_RATE_TOLERANCE = 2e-3  # of a sound card's clock
_DELAY = 1_000_000_000  # ns; of a block that comes late
_GAP_TOLERANCE = 1_000_000  # ns
_NONE = np.empty((0, 3), np.int64)

FEATURES, STATISTICS, LABEL, SEGMENT, GAP = "features", "statistics", "label", "segment", "gap"


class Frames:
    """Follows one microphone through a file.

    Messages are added as rows of three numbers: log time, frame and stamp; of segments and gaps
    log time (their end), start, and the frames that a gap lost.

    Parameters
    ----------
    findings : Findings
    microphone : str
    statistics_every : int or None
        Frames from one statistics message to the next, if that is known.
    labelled : bool
        Whether there is a model.

    Attributes
    ----------
    first, last : tuple of int, or None
        Frame and stamp of the first and the last frame.
    lost_before : int
        Frames that gaps before the first frame lost.
    gap_before : tuple of int, or None
        Start and end of the first of these gaps.
    """

    def __init__(
        self, findings: Findings, microphone: str, statistics_every: int | None, *, labelled: bool
    ) -> None:
        self.first: tuple[int, int] | None = None
        self.last: tuple[int, int] | None = None
        self.lost_before = 0
        self.gap_before: tuple[int, int] | None = None
        self._findings = findings
        self._name = microphone
        self._every = statistics_every
        self._labelled = labelled
        self._pending: dict[str, list[Int64]] = {}
        self._previous: tuple[int, int] | None = None
        self._run: tuple[int, int] | None = None  # the first frame since the last gap
        self._heard = 0  # frames since then
        self._segment_end: int | None = None
        self._gap_ends: Int64 = np.empty(0, np.int64)

    def add(self, kind: str, rows: Int64) -> None:
        """Add messages of one kind [shape=(n, 3)], in the order of their log times."""
        self._pending.setdefault(kind, []).append(rows)

    def interrupt(self) -> None:
        """Take note that messages are missing here, because the file is damaged."""
        self.finish()
        self._pending.clear()
        self._previous = self._run = self._segment_end = None

    def finish(self) -> None:
        """Check the last frame; what a killed recorder did not write of it is not missed."""
        self._check_features(self._take(FEATURES, None), self._take(GAP, None))
        self._check_segments(self._take(SEGMENT, None))

    def settle(self, until: int | None) -> None:
        """Check everything before some log time, of which nothing more will come."""
        features, statistics, labels, segments, gaps = (
            self._take(kind, until) for kind in (FEATURES, STATISTICS, LABEL, SEGMENT, GAP)
        )
        runs = self._check_features(features, gaps)
        self._check_same(features, statistics, STATISTICS, self._with_statistics(features))
        if self._labelled:
            self._check_same(features, labels, LABEL, self._with_label(features, labels, runs))
        self._check_segments(segments)

    def _take(self, kind: str, until: int | None) -> Int64:
        parts = self._pending.pop(kind, None)
        if not parts:
            return _NONE
        rows = np.concatenate(parts)
        if until is None:
            return rows
        done = rows[:, 0] < until
        if not done.all():
            self._pending[kind] = [rows[~done]]
        return rows[done]

    def _check_features(self, rows: Int64, gaps: Int64) -> NDArray[np.bool_]:
        """Compare frame numbers, stamps and gaps; return at which frames a known gap ends."""
        if not len(rows):
            if len(gaps):  # of the next frame
                self._pending[GAP] = [gaps, *self._pending.get(GAP, [])]
            return np.empty(0, bool)
        times, frames, stamps = rows.T
        following = np.searchsorted(stamps, gaps[:, 0])
        waiting = following == len(rows)
        if waiting.any():
            self._pending[GAP] = [gaps[waiting], *self._pending.get(GAP, [])]
        gaps, following = gaps[~waiting], following[~waiting]
        count = np.bincount(following, minlength=len(rows))
        lost = np.zeros(len(rows), np.int64)
        np.add.at(lost, following, gaps[:, 2])
        self._gap_ends = np.concatenate([self._gap_ends, gaps[:, 0]])
        if self.first is None:
            self.first = int(frames[0]), int(stamps[0])
            self.lost_before = int(lost[0])
            if count[0]:
                self.gap_before = int(gaps[0, 1]), int(gaps[0, 0])
        before = (int(frames[0]) - 1, int(stamps[0])) if self._previous is None else self._previous
        steps = np.diff(frames, prepend=before[0])
        elapsed = np.diff(stamps, prepend=before[1])
        known = np.ones(len(rows), bool)
        known[0] = self._previous is not None
        report = self._findings.rows
        report(
            "frame-order",
            known & (steps <= 0),
            times,
            lambda i: f"{self._name}: frame {frames[i]} follows frame {frames[i] - steps[i]}",
        )
        report(
            "frame-jump",
            known & (steps > 1) & (count == 0),
            times,
            lambda i: (
                f"{self._name}: {steps[i] - 1} frames are missing before frame {frames[i]}, and no "
                "gap says so"
            ),
        )
        report(
            "gap-frames",
            known & (count > 0) & (steps > 0) & (steps != lost + 1),
            times,
            (
                lambda i: (
                    f"{self._name}: a gap says that {lost[i]} frames were lost, and the numbers "
                    f"jump by {steps[i] - 1}"
                )
            ),
        )
        wrong = known & (steps == 1) & (count == 0)
        wrong &= np.abs(elapsed - FRAME_NANOSECONDS) > _STEP_TOLERANCE
        report(
            "stamp-step",
            wrong,
            times,
            lambda i: (
                f"{self._name}: frame {frames[i]} comes {elapsed[i] / 1e6:.3f} ms after the one before"
            ),
        )
        alone = count[following] == 1
        early = stamps[following] - elapsed[following] + FRAME_NANOSECONDS - gaps[:, 1]
        late = stamps[following] - gaps[:, 0]
        wrong = (np.abs(early) > _GAP_TOLERANCE) & known[following]
        wrong = alone & (wrong | (np.abs(late) > _GAP_TOLERANCE))
        report(
            "gap-times",
            wrong,
            gaps[:, 0],
            lambda i: f"{self._name}: a gap does not lie between the frames before and behind it",
        )
        begins = (count > 0) | (steps != 1)
        begins[0] |= self._previous is None
        self._check_rate(rows, begins)
        self._begins, known_start = begins, (count > 0) | (frames == 0)
        self._previous = self.last = int(frames[-1]), int(stamps[-1])
        return known_start

    def _check_rate(self, rows: Int64, begins: NDArray[np.bool_]) -> None:
        """Compare stamps with frame numbers, from the last gap on."""
        times, frames, stamps = rows.T
        starts = np.flatnonzero(begins)
        if len(starts):
            self._run = int(frames[starts[-1]]), int(stamps[starts[-1]])
        if self._run is None:
            return
        heard = (int(frames[-1]) - self._run[0]) * FRAME_NANOSECONDS
        elapsed = int(stamps[-1]) - self._run[1]
        if abs(elapsed - heard) > _RATE_TOLERANCE * heard + _DELAY:
            what = (
                f"{self._name}: {heard / 1e9:.2f} s of frames lie {elapsed / 1e9:.2f} s apart "
                "by their stamps"
            )
            self._findings.error("stamp-rate", what, DISTRUST, time=int(times[-1]))
            self._run = int(frames[-1]), int(stamps[-1])

    def _with_statistics(self, features: Int64) -> NDArray[np.bool_] | None:
        if self._every is None:
            return None
        return features[:, 1] % self._every == 0

    def _with_label(
        self, features: Int64, labels: Int64, known_start: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Tell which frames end a second that was heard as a whole."""
        heard = np.empty(len(features), np.int64)
        if not len(features):
            return heard > 0
        starts = np.flatnonzero(self._begins).tolist()
        for start, end in zip([0, *starts], [*starts, len(features)], strict=True):
            if start == end:
                continue
            if self._begins[start]:
                first = int(features[start, 1])
                self._heard = 0 if known_start[start] else self._guess(first, labels)
            heard[start:end] = self._heard + np.arange(1, end - start + 1)
            self._heard = min(int(heard[end - 1]), WINDOW_FRAMES)
        return heard >= WINDOW_FRAMES

    @staticmethod
    def _guess(frame: int, labels: Int64) -> int:
        """Guess how many frames were heard before one of which that is not known."""
        first = np.searchsorted(labels[:, 1], frame)
        if first == len(labels):
            return 0
        return int(max(WINDOW_FRAMES - 1 - (labels[first, 1] - frame), 0))

    def _check_same(
        self, features: Int64, rows: Int64, kind: str, wanted: NDArray[np.bool_] | None
    ) -> None:
        """Compare messages of another kind with the features of the same frames."""
        report = self._findings.rows
        frames, stamps = rows[:, 1], rows[:, 2]
        report(
            "frame-order",
            np.diff(frames, prepend=frames[:1] - 1) <= 0,
            rows[:, 0],
            lambda i: f"{self._name}: {kind} of frame {frames[i]} follow a later frame",
        )
        expected = features if wanted is None else features[wanted]
        extra = ~np.isin(frames, expected[:, 1])
        report(
            f"{kind}-frames",
            extra,
            rows[:, 0],
            lambda i: f"{self._name}: there should be no {kind} of frame {frames[i]}",
        )
        if wanted is not None:
            missing = ~np.isin(expected[:, 1], frames)
            report(
                f"{kind}-frames",
                missing,
                expected[:, 0],
                lambda i: f"{self._name}: there is no {kind} of frame {expected[i, 1]}",
            )
        order = np.argsort(expected[:, 1], kind="stable")
        same = np.flatnonzero(~extra)
        at = order[np.searchsorted(expected[order, 1], frames[same])]
        wrong = np.zeros(len(rows), bool)
        wrong[same] = expected[at, 2] != stamps[same]
        report(
            "frame-stamp",
            wrong,
            rows[:, 0],
            lambda i: (
                f"{self._name}: {kind} of frame {frames[i]} have another stamp than its features"
            ),
        )

    def _check_segments(self, rows: Int64) -> None:
        """Segments follow each other, with nothing but gaps between them."""
        if not len(rows):
            return
        ends, starts = rows[:, 0], rows[:, 1]
        first = int(starts[0]) if self._segment_end is None else self._segment_end
        before = np.concatenate([[first], ends[:-1]])
        report = self._findings.rows
        report(
            "segment-overlap",
            starts < before,
            ends,
            lambda i: (
                f"{self._name}: a segment begins {(before[i] - starts[i]) / 1e9:.3f} s before the last "
                "one has ended"
            ),
        )
        gaps = np.searchsorted(self._gap_ends, starts, "right")
        gaps -= np.searchsorted(self._gap_ends, before, "right")
        report(
            "segment-hole",
            (starts > before) & (gaps <= 0),
            ends,
            lambda i: (
                f"{self._name}: nothing is said of {(starts[i] - before[i]) / 1e9:.3f} s before a segment"
            ),
        )
        self._segment_end = int(ends[-1])
        self._gap_ends = self._gap_ends[self._gap_ends > self._segment_end]
