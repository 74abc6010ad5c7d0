"""A simulated person, who reviews what a home recorded and knows what is true of it."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hearthlog.analyzer.logs.labelling import Labelling, find_labellings
from hearthlog.analyzer.logs.layers import Coverage, find_coverage
from hearthlog.analyzer.logs.spans import intersection_rows, overlay, single_span
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.review.ranking import USEFUL
from hearthlog.analyzer.review.review_queue import ReviewItem, queue_spans, review_items
from hearthlog.models.classes import OTHER_NEGATIVE, UNKNOWN, class_name
from hearthlog.models.registry import DEFAULT_FOLDER
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.home.simulate import LabelledSpan
from hearthlog.tools.home.sounds import generator

_LOOK_SECONDS = 5.0  # to look at a span and press a key, besides the time to hear it
_MARK_SECONDS = 10.0  # to set the borders of a mark in a minute
_MINUTE = 30.0  # what is longer is gone through sound by sound
_MOST_ITEMS = 200
_HEARD = NANOSECONDS // 5  # shorter than this is not noticed
_WRONG = NANOSECONDS // 2  # wrong for so long, or for half of a sound, is corrected


@dataclass(frozen=True)
class Review:
    """What a person did.

    Attributes
    ----------
    marks : list of Mark
    reviewed : list of ReviewedSpan
    seconds : float
        That it took.
    """

    marks: list[Mark]
    reviewed: list[ReviewedSpan]
    seconds: float


@dataclass(frozen=True)
class Person:
    """A person who hears what is true, and corrects labels accordingly.

    Attributes
    ----------
    truth : Labelling
        In nanoseconds of UTC, one label at a time, as of `true_labelling`.
    name : str
        The reviewer.
    wrong : float
        Share of the marks, drawn at random, that have the label after the right one, in the order
        of the alphabet.
    seed : int
        Not negative; it draws those.
    models : Path
        Folder of models, in which the one of the labels is looked for.
    """

    truth: Labelling
    name: str = "Ann"
    wrong: float = 0.0
    seed: int = 0
    models: Path = DEFAULT_FOLDER

    def review(
        self,
        logs: Path,
        minutes: float,
        made: int,
        limits: tuple[int | None, int | None] = (None, None),
        queue: str = USEFUL,
    ) -> Review:
        """Go through the queue of a labelling of logs, and write marks beside them.

        A span takes 5 s and its length, a whole minute its length and 10 s for each mark. The
        person stops before the item that would take too long.

        Parameters
        ----------
        logs : Path
            Folder of logs with the recorder's labels, of one microphone.
        minutes : float
            That there are.
        made : int
            When this is done, in nanoseconds of UTC.
        limits : (int or None, int or None)
            Start and end of what is reviewed, in nanoseconds of UTC.
        queue : str
            As of `hearthlog review --queue`.

        Raises
        ------
        DataError
            If there is nothing to review.
        LogError
            If logs or layers cannot be read, or marks cannot be written.
        """
        sources = find_labellings(logs)
        labelled = sources.microphone(None), LIVE
        spans = queue_spans(queue, sources, labelled, limits, _MOST_ITEMS, self.models)
        return self.go_through(review_items(spans), logs, made, minutes)

    def go_through(
        self, items: Iterable[ReviewItem], logs: Path, made: int, minutes: float = math.inf
    ) -> Review:
        """Go through some items in their order, as `review` does.

        Parameters
        ----------
        items : iterable of ReviewItem
        logs, made, minutes
            As of `review`.

        Raises
        ------
        LogError
            If logs or layers cannot be read, or marks cannot be written.
        """
        sources = find_labellings(logs)
        microphone = sources.microphone(None)
        labelled = sources.read(microphone, LIVE)
        coverage = find_coverage(logs)[microphone]
        rng = generator(self.seed, made % (1 << 32))
        done = Review([], [], 0.0)
        for item in items:
            labels = self.corrections(item.start, item.end, labelled.labelling, rng)
            seconds = done.seconds + _seconds(item, len(labels))
            if seconds > 60.0 * minutes:
                break
            origin = (self.name, made, LIVE)
            marks = [Mark(microphone, *label, *origin) for label in labels]
            reviewed = ReviewedSpan(microphone, item.start, item.end, *origin, item.chosen)
            write_review(coverage, marks, reviewed)
            done = Review([*done.marks, *marks], [*done.reviewed, reviewed], seconds)
        return done

    def corrections(
        self, start: int, end: int, labelled: Labelling, rng: np.random.Generator
    ) -> list[tuple[int, int, str]]:
        """Return the sounds in a span, with their true borders, that are not labelled rightly.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC.
        labelled : Labelling
            By the recorder.
        rng : numpy.random.Generator
            Draws which of them get a wrong label.

        Returns
        -------
        list of (int, int, str)
            Start, end and label, in the order of time; those of silence, too.
        """
        inside, row, _ = intersection_rows(self.truth, single_span(start, end))
        labels = self.truth.labels[row]
        parts = overlay([inside, labelled]).in_all()
        true, own = labels[parts.rows[0]], labelled.labels[parts.rows[1]]
        differs = np.array([not _same(a, b) for a, b in zip(true, own, strict=True)], bool)
        wrong = np.bincount(
            parts.rows[0], (parts.ends - parts.starts) * differs, minlength=len(labels)
        )
        lengths = inside.ends - inside.starts
        marked = (lengths >= _HEARD) & (wrong >= np.minimum(_WRONG, lengths / 2))
        return [
            (int(inside.starts[i]), int(inside.ends[i]), self._mark_label(labels[i], rng))
            for i in np.flatnonzero(marked)
        ]

    def _mark_label(self, label: str, rng: np.random.Generator) -> str:
        if rng.random() < self.wrong:
            names = sorted(set(self.truth.labels))
            label = names[(names.index(label) + 1) % len(names)]
        return UNKNOWN if label == OTHER_NEGATIVE else label


def true_labelling(spans: list[LabelledSpan], start: int) -> Labelling:
    """Return the truth of a composition at the times of its logs.

    Parameters
    ----------
    spans : list of LabelledSpan
    start : int
        Time of the first sample, in nanoseconds of UTC.
    """
    seconds = np.array([span[:2] for span in spans])
    times = start + np.rint(seconds / FRAME_SECONDS).astype(np.int64) * FRAME_NANOSECONDS
    return Labelling(times[:, 0], times[:, 1], np.array([span[2] for span in spans], object))


def read_truth(home: Path, start: int) -> Labelling:
    """Read the truth of a composed home.

    Parameters
    ----------
    home : Path
        Folder with a file `truth.txt`.
    start : int
        As of `true_labelling`.

    Raises
    ------
    OSError
        If there is no truth.
    """
    rows = (line.split("\t") for line in (home / "truth.txt").read_text("utf-8").splitlines())
    return true_labelling([(float(a), float(b), label) for a, b, label in rows], start)


def _same(true: str, label: str) -> bool:
    if true == OTHER_NEGATIVE:
        return label in {OTHER_NEGATIVE, UNKNOWN}
    return class_name(true) == class_name(label)


def _seconds(item: ReviewItem, marks: int) -> float:
    length = (item.end - item.start) / NANOSECONDS
    return length + (_MARK_SECONDS * marks if length >= _MINUTE else _LOOK_SECONDS)


def write_review(coverage: Coverage, marks: Sequence[Mark], reviewed: ReviewedSpan) -> None:
    """Write what came of a span to the layers of the logs that it is in.

    Parameters
    ----------
    coverage : Coverage
        Of the microphone.
    marks : sequence of Mark
    reviewed : ReviewedSpan

    Raises
    ------
    LogError
        If marks cannot be written.
    """
    for log, first, last in coverage.split(reviewed.start, reviewed.end):
        inside = [mark for mark in marks if mark.start < last and mark.end > first]
        cut = [m._replace(start=max(m.start, first), end=min(m.end, last)) for m in inside]
        write_marks(log, cut, reviewed=[reviewed._replace(start=first, end=last)])
