"""Joint checks of one microphone's frame numbers, stamps, gaps, labels and segments."""

from collections.abc import Callable, Collection

import numpy as np

from hearthlog.analyzer.doctor import DISTRUST, Findings
from hearthlog.analyzer.doctor.column_checks import (
    DIRECTION,
    EMBEDDING,
    FEATURES,
    GAP,
    LABEL,
    SEGMENT,
    STATISTICS,
)
from hearthlog.models.classifiers.classifier import LabelTiming
from hearthlog.models.classifiers.evidence import BLOCK_FRAMES
from hearthlog.models.embedding import WINDOW_FRAMES
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS

# ns. Behind a sound server, stamps follow block arrival, with up to 45 % error at first.
_STEP_TOLERANCE = FRAME_NANOSECONDS // 2
_GAP_TOLERANCE = 1_000_000  # ns

_RATE_TOLERANCE = 2e-3  # of a sound card's clock
_DELAY = 1_000_000_000  # ns; delay of a late block
_NONE = np.empty((0, 3), np.int64)


class FrameSequence:
    """Checks of one microphone's messages throughout a file.

    Messages are added as rows of three numbers: log time, frame and stamp; for segments log time,
    start and end; for gaps log time (their end), start, and number of lost frames. The timing of
    the labels is None if there are no labels or it is unknown.
    """

    def __init__(
        self,
        findings: Findings,
        microphone: str,
        statistics_every: int | None,
        timing: LabelTiming | None,
        thinned: Collection[str] = (),
    ) -> None:
        self.first: tuple[int, int] | None = None  # frame and stamp of the first and the last frame
        self.last: tuple[int, int] | None = None
        self.lost_before = 0  # frames lost in gaps before the first frame
        self.lost_behind = 0  # frames lost in gaps after the last frame
        self.gap_before: tuple[int, int] | None = None  # of the first gap before that: start, end
        self._findings = findings
        self._name = microphone
        self._every = statistics_every
        self._timing = timing
        self._thinned = thinned
        self._pending: dict[str, list[Int64]] = {}
        self._previous: tuple[int, int] | None = None
        self._run: tuple[int, int] | None = None  # first frame since the last gap
        self._unlabelled = _NONE  # features of the last frames, which have no label yet
        self._first_end = 0  # last frame of the first window since that gap
        self._segment: tuple[int, int] | None = None  # log time and end of the last segment
        self._gap_ends: Int64 = np.empty(0, np.int64)
        self._damages = _NONE  # gaps where the log is damaged
        self._begins = np.empty(0, bool)  # which of the settled frames begin a run

    def add(self, kind: str, rows: Int64) -> None:
        """Add rows [shape=(n, 3)] of one kind, as described in the class; times are ns of UTC.

        They are in order of log time, after earlier rows of this kind.
        """
        self._pending.setdefault(kind, []).append(rows)

    def add_damages(self, gaps: Int64) -> None:
        """Mark gaps (rows as for `add`), added before or now, as losses of a damaged log.

        The sound itself has no gap there: labels continue, and segments extend across it.
        """
        self._damages = np.concatenate([self._damages, gaps])

    def interrupt(self) -> None:
        """Record that messages are missing here, because the file is damaged."""
        self.finish()
        self._pending.clear()
        self._forget()

    def begin_anew(self, time: int) -> None:
        """Start another recording, or its next log, at a log time."""
        self.settle(time)
        self._forget()

    def _forget(self) -> None:
        """Start anew: nothing before the next message is compared with it."""
        self._previous = self._run = self._segment = None
        self._unlabelled = _NONE

    def finish(self) -> None:
        """Check the last frame; messages that a killed recorder did not write are not reported."""
        self._check_features(self._take(FEATURES, None), self._take(GAP, None))
        self.lost_behind = sum(int(gaps[:, 2].sum()) for gaps in self._pending.get(GAP, []))
        self._check_segments(self._take(SEGMENT, None))

    def settle(self, until: int | None) -> None:
        """Check all messages before a log time (nanoseconds of UTC), or all for None.

        No more messages of that time may follow.
        """
        kinds = FEATURES, STATISTICS, DIRECTION, EMBEDDING, LABEL, SEGMENT, GAP
        features, statistics, directions, embeddings, labels, segments, gaps = (
            self._take(kind, until) for kind in kinds
        )
        if FEATURES in self._thinned:  # labels have no counterpart to compare with
            self._gap_ends = np.concatenate([self._gap_ends, gaps[:, 0]])
            self._check_segments(segments)
            return
        runs = self._check_features(features, gaps)
        if STATISTICS not in self._thinned:
            expects = None if self._every is None else features[:, 1] % self._every == 0
            self._check_same(features, statistics, STATISTICS, expects)
        ends = _at_ends(directions, BLOCK_FRAMES - 1)
        self._check_same(features, ends, DIRECTION, None)
        ends = _at_ends(embeddings, WINDOW_FRAMES - 1)
        self._check_same(features, ends, EMBEDDING, None)
        if self._timing is not None:
            self._check_labels(features, labels, runs, self._timing)
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

    def _check_features(self, rows: Int64, gaps: Int64) -> Bool:
        """Compare frame numbers, stamps and gaps; return at which frames the sound starts anew."""
        following = np.searchsorted(rows[:, 2], gaps[:, 0])
        waiting = following == len(rows)
        if waiting.any():  # gaps before the next frame
            self._pending[GAP] = [gaps[waiting], *self._pending.get(GAP, [])]
        if not len(rows):
            self._begins = np.empty(0, bool)
            return self._begins
        gaps, following = gaps[~waiting], following[~waiting]
        self._gap_ends = np.concatenate([self._gap_ends, gaps[:, 0]])
        count = np.bincount(following, minlength=len(rows))
        lost = np.zeros(len(rows), np.int64)
        np.add.at(lost, following, gaps[:, 2])
        if self.first is None:
            self.first = int(rows[0, 1]), int(rows[0, 2])
            self.lost_before = int(lost[0])
            if count[0]:
                self.gap_before = int(gaps[0, 1]), int(gaps[0, 0])
        # The first frame without a read predecessor gets a synthetic one.
        before = self._previous or (int(rows[0, 1]) - 1, int(rows[0, 2]))
        has_previous = np.ones(len(rows), bool)
        has_previous[0] = self._previous is not None
        numbers = np.diff(rows[:, 1], prepend=before[0])
        elapsed = np.diff(rows[:, 2], prepend=before[1])
        self._check_steps(rows, has_previous, np.stack([numbers, elapsed, count, lost]))
        # Gaps reach from the end of the frame before them to the start of the next.
        behind = rows[following, 2]
        early = behind - elapsed[following] + FRAME_NANOSECONDS - gaps[:, 1]
        wrong = has_previous[following] & (np.abs(early) > _GAP_TOLERANCE)
        wrong |= np.abs(behind - gaps[:, 0]) > _GAP_TOLERANCE
        self._report(
            "gap-times",
            (count[following] == 1) & wrong,
            gaps[:, 0],
            lambda _: "a gap does not lie between the frames before and behind it",
        )
        self._begins = (count > 0) | (numbers != 1) | ~has_previous
        self._check_rate(rows)
        self._previous = self.last = int(rows[-1, 1]), int(rows[-1, 2])
        last = np.zeros(len(rows), np.int64)
        last[following] = gaps[:, 0]
        return ((count > 0) & ~np.isin(last, self._damages[:, 0])) | (rows[:, 1] == 0)

    def _check_steps(self, rows: Int64, has_previous: Bool, steps: Int64) -> None:
        """Check that frame numbers and stamps are continuous, and that gaps explain every jump.

        `steps` [shape=(4, n)] are increments of the frame number and of the stamp (ns), number of
        gaps since the previous frame, and frames lost in them; `has_previous` if that frame was
        read.
        """
        numbers, elapsed, gaps, lost = steps
        times, frames, _ = rows.T
        self._report(
            "frame-order",
            has_previous & (numbers <= 0),
            times,
            lambda i: f"frame {frames[i]} follows frame {frames[i] - numbers[i]}",
        )
        self._report(
            "frame-jump",
            has_previous & (numbers > 1) & (gaps == 0),
            times,
            lambda i: f"frame {frames[i]} comes after {numbers[i] - 1} others that no gap explains",
        )
        self._report(
            "gap-frames",
            has_previous & (gaps > 0) & (numbers > 0) & (numbers != lost + 1),
            times,
            lambda i: f"a gap of {lost[i]} frames where the numbers jump by {numbers[i] - 1}",
        )
        wrong = np.abs(elapsed - FRAME_NANOSECONDS) > _STEP_TOLERANCE
        self._report(
            "stamp-step",
            has_previous & (numbers == 1) & (gaps == 0) & wrong,
            times,
            lambda i: f"frame {frames[i]} comes {elapsed[i] / 1e6:.3f} ms after the one before",
        )

    def _are_damaged(self, times: Int64) -> Bool:
        """Whether the log is damaged at, or right after, each log time."""
        ends, starts, _ = self._damages.T
        place = np.searchsorted(ends, times, "right")
        begins = np.append(starts, np.iinfo(np.int64).max)[place] - FRAME_NANOSECONDS
        return begins <= times

    def _check_rate(self, rows: Int64) -> None:
        """Compare stamps with frame numbers since the last gap."""
        times, frames, stamps = rows.T
        starts = np.flatnonzero(self._begins)
        if len(starts):
            self._run = int(frames[starts[-1]]), int(stamps[starts[-1]])
        if self._run is None:
            return
        duration = (int(frames[-1]) - self._run[0]) * FRAME_NANOSECONDS
        elapsed = int(stamps[-1]) - self._run[1]
        if abs(elapsed - duration) > _RATE_TOLERANCE * duration + _DELAY:
            what = (
                f"{self._name}: {duration / 1e9:.2f} s of frames lie {elapsed / 1e9:.2f} s apart "
                "by their stamps"
            )
            self._findings.error("stamp-rate", what, DISTRUST, time=int(times[-1]))
            self._run = int(frames[-1]), int(stamps[-1])

    def _with_label(
        self,
        features: Int64,
        labels: Int64,
        has_start: Bool,
        timing: LabelTiming,
    ) -> Bool:
        """Return which frames end a window without a gap.

        Rows of `labels` must have the numbers of window ends, not of the labelled frames.
        """
        first_end = np.full(len(features), self._first_end)
        for start in np.flatnonzero(self._begins).tolist():
            frame = int(features[start, 1])
            self._first_end = timing.first_window_end(frame)
            later = labels[labels[:, 1] >= frame, 1]
            if len(later) and not has_start[start]:  # the sound may have begun before the file
                self._first_end = min(self._first_end, int(later[0]))
            first_end[start:] = self._first_end
        return features[:, 1] >= first_end

    def _check_labels(
        self, features: Int64, labels: Int64, runs: Bool, timing: LabelTiming
    ) -> None:
        self._check_label_stamps(features, labels, timing.delay)
        ends = _at_ends(labels, timing.delay)
        self._check_same(features, ends, LABEL, self._with_label(features, ends, runs, timing))

    def _check_label_stamps(self, features: Int64, labels: Int64, delay: int) -> None:
        """Compare the stamps of labels with the features of the same frames."""
        unlabelled = np.concatenate([self._unlabelled, features])
        self._unlabelled = unlabelled[max(len(unlabelled) - delay, 0) :]
        self._report(
            "frame-stamp",
            _has_other_stamp(labels, unlabelled),
            labels[:, 0],
            lambda i: f"the label of frame {labels[i, 1]} has another stamp than its features",
        )

    def _check_same(self, features: Int64, rows: Int64, kind: str, expects: Bool | None) -> None:
        """Compare messages of another kind with the features of the same frames."""
        times, frames, _ = rows.T
        expected = features if expects is None else features[expects]
        extra = ~np.isin(frames, expected[:, 1])
        report = self._report
        report(
            "frame-order",
            np.diff(frames, prepend=frames[:1] - 1) <= 0,
            times,
            lambda i: f"{kind} of frame {frames[i]} follow a later frame",
        )
        report(
            f"{kind}-frames",
            extra & ~self._are_damaged(times),
            times,
            lambda i: f"there should be no {kind} of frame {frames[i]}",
        )
        if expects is not None:
            report(
                f"{kind}-frames",
                ~np.isin(expected[:, 1], frames) & ~self._are_damaged(expected[:, 0]),
                expected[:, 0],
                lambda i: f"there is no {kind} of frame {expected[i, 1]}",
            )
        report(
            "frame-stamp",
            _has_other_stamp(rows, expected),
            times,
            lambda i: f"{kind} of frame {frames[i]} have another stamp than its features",
        )

    def _check_segments(self, rows: Int64) -> None:
        """Check that segments are contiguous, except for gaps.

        Segments that were decided while the log was damaged are lost.
        """
        if not len(rows):
            return
        times, starts, ends = rows.T
        first = (int(times[0]), int(starts[0])) if self._segment is None else self._segment
        decided = np.concatenate([[first[0]], times[:-1]])
        before = np.concatenate([[first[1]], ends[:-1]])
        late = starts - before
        self._report(
            "segment-overlap",
            late < 0,
            times,
            lambda i: f"a segment begins {-late[i] / 1e9:.3f} s before the last one has ended",
        )
        gaps = np.searchsorted(self._gap_ends, starts, "right")
        gaps -= np.searchsorted(self._gap_ends, before, "right")
        damages = np.searchsorted(self._damages[:, 1], times)
        damages -= np.searchsorted(self._damages[:, 0], decided, "right")
        self._report(
            "segment-hole",
            (late > 0) & (gaps <= 0) & (damages <= 0),
            times,
            lambda i: f"nothing is said of the {late[i] / 1e9:.3f} s before a segment",
        )
        self._segment = int(times[-1]), int(ends[-1])
        self._gap_ends = self._gap_ends[self._gap_ends > ends[-1]]

    def _report(self, rule: str, wrong: Bool, times: Int64, what: Callable[[int], str]) -> None:
        self._findings.rows(rule, wrong, times, lambda row: f"{self._name}: {what(row)}")


def _at_ends(rows: Int64, delay: int) -> Int64:
    """Move rows to the last frames of their windows, whose stamps are the log times."""
    return np.stack([rows[:, 0], rows[:, 1] + delay, rows[:, 0]], axis=1)


def _has_other_stamp(rows: Int64, features: Int64) -> Bool:
    """Whether each row has another stamp than the features of its frame, if there are some."""
    order = np.argsort(features[:, 1], kind="stable")
    found = np.flatnonzero(np.isin(rows[:, 1], features[:, 1]))
    at = order[np.searchsorted(features[order, 1], rows[found, 1])]
    wrong = np.zeros(len(rows), bool)
    wrong[found] = features[at, 2] != rows[found, 2]
    return wrong
