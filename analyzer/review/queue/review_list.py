"""Lists of spans to be reviewed, as CSV."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import LabellingDifference
from hearthlog.analyzer.logs.labelling import NamedLabelling
from hearthlog.analyzer.logs.spans import Spans, one, pieces
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.analyzer.marks.marks import RANDOM
from hearthlog.analyzer.review.queue.ranking import USEFUL, ReviewQueue
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import read_time, time_text
from hearthlog.schemas.messages.topics import LABELLING, check_microphone_name
from hearthlog.schemas.new_files import new_file

MOST_SPANS = 100_000
_PARTS = ("uncertainty", "disagreement", "novelty")
CHANGE = "change"  # which another model would make
HINT = "hint"  # of a network, which has a name for the sound
REASONS = (*_PARTS, USEFUL, RANDOM, CHANGE, HINT)
_SIZE_LIMIT = 64 << 20
_LATEST = 1 << 62  # nanoseconds
_NUMBER = re.compile(r"[0-9]{1,4}(\.[0-9]{1,20})?")


class ReviewSpan(NamedTuple):
    """A span of time to be reviewed, and why.

    Attributes
    ----------
    b, label_b : str
        Another one; both are empty if there is none, the label where it has none.
    score : float or None
        None where spans are not ranked by one; of a change the minutes a day that change so, of a
        hint the logits above the threshold of the name.
    reason : str
        One of `REASONS`; `random` is a whole minute that was drawn at random.
    """

    microphone: str
    start: int
    end: int
    a: str
    label_a: str
    b: str
    label_b: str
    score: float | None
    reason: str

    @property
    def proposed_label(self) -> str:
        """The label that a reviewer may leave as it is."""
        return self.label_b if self.reason == HINT else self.label_a

    def as_text(self) -> dict[str, str | float | None]:
        """Return the fields by name, with the times as texts."""
        return self._asdict() | {"start": time_text(self.start), "end": time_text(self.end)}


def disagreements(difference: LabellingDifference, microphone: str) -> list[ReviewSpan]:
    """List where two labellings differ.

    Returns
    -------
    list of ReviewSpan
        The longest first, at most `MOST_SPANS`; without scores.
    """
    a, b, classes = difference.a, difference.b, difference.classes
    rows = zip(*(column[:MOST_SPANS].tolist() for column in difference.disagreements), strict=True)
    return [
        ReviewSpan(microphone, start, end, a, classes[i], b, classes[j], None, "disagreement")
        for start, end, i, j in rows
    ]


def queued(queue: ReviewQueue, microphone: str, a: str, b: str = "") -> list[ReviewSpan]:
    """List the spans of a queue, in its order.

    Parameters
    ----------
    b : str, optional
        The labelling that it was compared with; empty without one.

    Returns
    -------
    list of ReviewSpan
        With the score, to three digits, and as the reason what they are ranked by, or what weighs
        most in the score; `useful` ones have no score.
    """
    reasons = queue.reasons.tolist()
    columns = queue.spans.starts, queue.spans.ends, queue.scores.round(3)
    rows = zip(
        *(column.tolist() for column in columns), queue.labels, queue.others, reasons, strict=True
    )
    spans = [
        ReviewSpan(microphone, start, end, a, label, b, other, score, _PARTS[reason])
        for start, end, score, label, other, reason in rows
    ]
    if queue.ranking == USEFUL:
        return [span._replace(score=None, reason=USEFUL) for span in spans]
    return spans


def random_minutes(minutes: Spans, side: NamedLabelling, microphone: str) -> list[ReviewSpan]:
    """List minutes that were drawn at random, in their order."""
    spans = []
    for start, end in zip(minutes.starts.tolist(), minutes.ends.tolist(), strict=True):
        parts, rows, _ = pieces(side.labelling, one(start, end))
        labels, row = np.unique(side.labelling.labels[rows].astype(str), return_inverse=True)
        label = str(labels[np.bincount(row, parts.ends - parts.starts).argmax()])
        spans.append(ReviewSpan(microphone, start, end, side.name, label, "", "", None, RANDOM))
    return spans


def write_list(path: Path, spans: Sequence[ReviewSpan]) -> None:
    """Write spans as CSV, in their order, for `read_list`.

    Parameters
    ----------
    spans : sequence of ReviewSpan
        At most `MOST_SPANS`.

    Raises
    ------
    LogError
        If the file exists, or cannot be written.
    """
    assert len(spans) <= MOST_SPANS
    lines = [",".join(ReviewSpan._fields)]
    for span in spans:
        fields = span.as_text().values()
        lines.append(",".join("" if value is None else str(value) for value in fields))
    with new_file(path) as temporary:
        temporary.write_text("".join(f"{line}\n" for line in lines), "utf-8", newline="\n")


def read_list(path: Path) -> list[ReviewSpan]:
    """Read a list of spans.

    Returns
    -------
    list of ReviewSpan
        In the order of the file, at least one.

    Raises
    ------
    DataError
        If the file cannot be read, is no list of spans, or holds none; the message has the line.
    """
    header: list[str] = []
    spans: list[ReviewSpan] = []
    for number, record in csv_records(path, read_text(path, "list of spans", _SIZE_LIMIT)):
        where = f"{path}:{number}"
        if not header:
            header = [name.strip() for name in record]
            if header != list(ReviewSpan._fields):
                names = ",".join(ReviewSpan._fields)
                raise DataError(f"{where}: the first line must name the columns: {names}")
        elif len(record) != len(header):
            raise DataError(f"{where}: has {len(record)} fields, not {len(header)}")
        elif len(spans) == MOST_SPANS:
            raise DataError(f"{where}: has more than {MOST_SPANS} spans; nobody can review them")
        else:
            spans.append(_span(where, [field.strip() for field in record]))
    if not spans:
        raise DataError(f"{path}: is no list of spans, or an empty one")
    return spans


def _span(where: str, fields: Sequence[str]) -> ReviewSpan:
    microphone, start, end, a, label_a, b, label_b, score, reason = fields
    try:
        check_microphone_name(microphone if len(microphone) <= 100 else f"{microphone[:64]}…")
    except LogError as error:
        raise DataError(f"{where}: {error}") from error
    for labelling, label in ((a, label_a), *([(b, label_b)] if b or label_b else [])):
        if not LABELLING.fullmatch(labelling):
            raise DataError(f"{where}: {labelling[:64]!r} is no labelling")
        if not CLASS_NAME.fullmatch(label) and (labelling, label) != (b, ""):
            raise DataError(f"{where}: {label[:64]!r} cannot be the name of a class")
    if reason not in REASONS:
        raise DataError(f"{where}: {reason[:64]!r} is no reason: use {', '.join(REASONS)}")
    if score and not _NUMBER.fullmatch(score):
        raise DataError(f"{where}: {score[:64]!r} is no score")
    first, last = _time(where, start), _time(where, end)
    if not 0 <= first < last <= _LATEST:
        raise DataError(f"{where}: {start[:40]} to {end[:40]} is no span of time")
    return ReviewSpan(
        microphone, first, last, a, label_a, b, label_b, float(score) if score else None, reason
    )


def _time(where: str, text: str) -> int:
    try:
        return read_time(text)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{where}: {text[:64]!r} is no time such as 2026-03-01T07:00:00") from error
