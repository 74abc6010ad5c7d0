"""The way from one frame of a microphone to the next: numbers, stamps, and gaps between them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS

# Behind a sound server stamps are steered by when blocks arrive, at first by up to 45 % (ns).
_STEP_TOLERANCE = FRAME_NANOSECONDS // 2
_GAP_TOLERANCE = 1_000_000  # ns

# Notes rows that break a rule: its name, which rows, their log times, and a text for one of them.
Report = Callable[[str, NDArray[np.bool_], Int64, Callable[[int], str]], None]


class Steps(NamedTuple):
    """The way to each frame from the one before it; arrays of one row a frame.

    Attributes
    ----------
    rows : np.ndarray [shape=(n, 3)]
        Log time, frame and stamp.
    has_previous : np.ndarray [shape=(n,)], bool
        Whether the frame before it was read.
    numbers, elapsed : np.ndarray [shape=(n,)], int64
        By how much the frame number and the stamp (ns) have grown.
    gaps, lost : np.ndarray [shape=(n,)], int64
        How many gaps lie between, and the frames that they lost.
    """

    rows: Int64
    has_previous: NDArray[np.bool_]
    numbers: Int64
    elapsed: Int64
    gaps: Int64
    lost: Int64


def check_steps(report: Report, steps: Steps) -> None:
    """Check that frame numbers and stamps go on, and that a gap explains every jump."""
    rows, has_previous, numbers, elapsed, gaps, lost = steps
    times, frames, _ = rows.T
    report(
        "frame-order",
        has_previous & (numbers <= 0),
        times,
        lambda i: f"frame {frames[i]} follows frame {frames[i] - numbers[i]}",
    )
    report(
        "frame-jump",
        has_previous & (numbers > 1) & (gaps == 0),
        times,
        lambda i: f"frame {frames[i]} comes after {numbers[i] - 1} others that no gap explains",
    )
    report(
        "gap-frames",
        has_previous & (gaps > 0) & (numbers > 0) & (numbers != lost + 1),
        times,
        lambda i: f"a gap of {lost[i]} frames where the numbers jump by {numbers[i] - 1}",
    )
    wrong = np.abs(elapsed - FRAME_NANOSECONDS) > _STEP_TOLERANCE
    report(
        "stamp-step",
        has_previous & (numbers == 1) & (gaps == 0) & wrong,
        times,
        lambda i: f"frame {frames[i]} comes {elapsed[i] / 1e6:.3f} ms after the one before",
    )


def check_gaps(report: Report, steps: Steps, gaps: Int64, following: NDArray[np.intp]) -> None:
    """Check that gaps begin where the frame before them ends, and end where the next begins.

    Parameters
    ----------
    gaps : np.ndarray [shape=(m, 3)], int64
        End and start (nanoseconds of UTC), and the number of frames that were lost.
    following : np.ndarray [shape=(m,)], int
        Rows of the frames behind the gaps.
    """
    alone = steps.gaps[following] == 1
    stamps = steps.rows[following, 2]
    early = stamps - steps.elapsed[following] + FRAME_NANOSECONDS - gaps[:, 1]
    wrong = steps.has_previous[following] & (np.abs(early) > _GAP_TOLERANCE)
    wrong |= np.abs(stamps - gaps[:, 0]) > _GAP_TOLERANCE
    report(
        "gap-times",
        alone & wrong,
        gaps[:, 0],
        lambda _: "a gap does not lie between the frames before and behind it",
    )
