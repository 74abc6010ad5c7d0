"""CSV lists of spans to review, and the label files and sounds made from them."""

import csv
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError, collect_errors
from hearthlog.analyzer.evaluation import LabellingDifference
from hearthlog.analyzer.logs.clips import kept_sound, kept_time, wav_bytes
from hearthlog.analyzer.logs.labelling import Labelling, NamedLabelling
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.spans import NEVER, Spans, cut, intersection_rows, single_span, union
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.analyzer.marks.formats import find_format
from hearthlog.analyzer.marks.marks import QUEUE, RANDOM, Mark, ReviewedSpan
from hearthlog.analyzer.review.ranking import USEFUL, ReviewQueue
from hearthlog.models.classes import CLASS_NAME
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS, read_time, time_text
from hearthlog.schemas.logs.files import AUDIO_LAYER, find_logs, log_name
from hearthlog.schemas.messages.topics import (
    LABELLING,
    LIVE,
    RELABEL,
    check_microphone_name,
    labelling_topic,
    scenario_name,
)
from hearthlog.schemas.new_files import new_file, new_folder

MOST_SPANS = 100_000
_PARTS = ("uncertainty", "disagreement", "novelty")
CHANGE = "change"  # a label that another model would change
HINT = "hint"  # a sound named by a network
REASONS = (*_PARTS, USEFUL, RANDOM, CHANGE, HINT)
_SIZE_LIMIT = 64 << 20
_NUMBER = re.compile(r"[0-9]{1,4}(\.[0-9]{1,20})?")


class ReviewSpan(NamedTuple):
    """A span of time to review, and the reason.

    The score is None for unranked spans; for a change, the minutes a day with the same change; for
    a hint, the logits above the threshold of the name.
    """

    microphone: str
    start: int
    end: int
    a: str
    label_a: str
    b: str  # the other labelling; empty if there is none
    label_b: str  # empty where it has none
    score: float | None
    reason: str  # of `REASONS`; `random` is a complete minute drawn at random

    @property
    def proposed_label(self) -> str:
        """The label that a reviewer may leave unchanged."""
        return self.label_b if self.reason == HINT else self.label_a

    def as_text(self) -> dict[str, str | float | None]:
        """Return the fields by name, with times as text."""
        return self._asdict() | {"start": time_text(self.start), "end": time_text(self.end)}


def disagreements_to_review(difference: LabellingDifference, microphone: str) -> list[ReviewSpan]:
    """List the spans in which two labellings differ, without scores.

    They are at most `MOST_SPANS`, the longest first.
    """
    a, b, classes = difference.a, difference.b, difference.classes
    rows = zip(*(column[:MOST_SPANS].tolist() for column in difference.disagreements), strict=True)
    return [
        ReviewSpan(microphone, start, end, a, classes[i], b, classes[j], None, "disagreement")
        for start, end, i, j in rows
    ]


def queued(queue: ReviewQueue, microphone: str, a: str, b: str = "") -> list[ReviewSpan]:
    """List the spans of a queue, in its order; `b` is the other labelling, or empty.

    They have the score, to three digits; the reason is the ranking, or the part with the largest
    weight in the score. `useful` spans have no score.
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
    """List minutes drawn at random, in their order."""
    spans = []
    for start, end in minutes.pairs():
        parts, rows, _ = intersection_rows(side.labelling, single_span(start, end))
        labels, row = np.unique(side.labelling.labels[rows].astype(str), return_inverse=True)
        label = str(labels[np.bincount(row, parts.ends - parts.starts).argmax()])
        spans.append(ReviewSpan(microphone, start, end, side.name, label, "", "", None, RANDOM))
    return spans


def write_spans(path: Path, spans: Sequence[ReviewSpan]) -> None:
    """Write up to `MOST_SPANS` spans as CSV, in their order, for `read_spans`.

    Raise `LogError` if the file exists, or cannot be written.
    """
    assert len(spans) <= MOST_SPANS
    with new_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(ReviewSpan._fields)
        writer.writerows(span.as_text().values() for span in spans)


def read_spans(path: Path) -> list[ReviewSpan]:
    """Read a list of spans in file order, at least one.

    Raise `DataError` if the file cannot be read, is no list of spans, or is empty; the message has
    the line.
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
            raise DataError(f"{where}: has more than {MOST_SPANS} spans; too many to review")
        else:
            spans.append(_span(where, [field.strip() for field in record]))
    if not spans:
        raise DataError(f"{path}: is no list of spans, or an empty one")
    return spans


read_list = read_spans  # its name in the documents of 0.2


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
    if not 0 <= first < last <= NEVER:
        raise DataError(f"{where}: {start[:40]} to {end[:40]} is no span of time")
    return ReviewSpan(
        microphone, first, last, a, label_a, b, label_b, float(score) if score else None, reason
    )


def _time(where: str, text: str) -> int:
    try:
        return read_time(text)
    except (ValueError, OverflowError) as error:
        raise DataError(f"{where}: {text[:64]!r} is no time such as 2026-03-01T07:00:00") from error


_SUFFIX = ".queue.csv"
_SHORTEST = NANOSECONDS // 10  # minimum sound for a file


def queue_file(labels: Path) -> Path:
    """Return the path of the list next to a label file: `ten.queue.csv` for `ten.txt`."""
    return labels.with_name(_stem(labels) + _SUFFIX)


def sounds_folder(labels: Path) -> Path:
    """Return the folder of sounds next to a label file: `ten` for `ten.txt`."""
    return labels.with_name(_stem(labels))


def _stem(labels: Path) -> str:
    format_ = find_format(labels)
    return labels.name.removesuffix("" if format_ is None else format_.suffix)


class KeptSoundLayers(NamedTuple):
    """Layers with kept sound of a microphone."""

    layers: dict[Path, Spans]
    topic: str
    time: Spans


class SoundFile(NamedTuple):
    """Kept sound of a line of a label file, or of the lines of a minute."""

    first: int  # line number, from 1
    last: int  # likewise
    start: int
    end: int

    def name(self, lines: int) -> str:
        """Return the file name: `07.wav`, or `12-31.wav` for a minute."""
        width = max(len(str(lines)), 2)
        last = f"-{self.last:0{width}}" if self.last > self.first else ""
        return f"{self.first:0{width}}{last}.wav"


def find_kept_sound(
    logs: Path, microphone: str, limits: tuple[int | None, int | None], losses: list[str]
) -> KeptSoundLayers:
    """Find the kept sound of a microphone within limits in nanoseconds of UTC; None for no limit.

    Raise `LogError` if there is no log.
    """
    topic = labelling_topic(microphone, LIVE, "audio")
    start, end = limits[0] or 0, NEVER if limits[1] is None else limits[1]
    layers: dict[Path, Spans] = {}
    near = logs if logs.is_dir() else logs.parent
    for layer in find_logs(near):
        if log_name(layer).layer != AUDIO_LAYER:
            continue
        with collect_errors(losses, LogError):
            layers[layer] = kept_time([layer], topic, start, end)
    return KeptSoundLayers(layers, topic, union(*layers.values()))


def sound_files(
    marks: Sequence[Mark], requested: Iterable[ReviewSpan], kept: KeptSoundLayers
) -> list[SoundFile]:
    """List the lines of a label file that have kept sound, then the minutes."""
    lines = [SoundFile(n, n, mark.start, mark.end) for n, mark in enumerate(marks, 1)]
    files = [*lines, *(one for one in drawn_minutes(requested, marks) if one.last > one.first)]
    return [one for one in files if cut(kept.time, one.start, one.end).length >= _SHORTEST]


def write_sounds(
    folder: Path, files: Sequence[SoundFile], lines: int, kept: KeptSoundLayers
) -> None:
    """Write sounds as WAV files into a new private folder; holes become silence.

    Raise `LogError` if the folder exists or cannot be written, or the sound cannot be read.
    """
    with new_folder(folder) as temporary:
        temporary.chmod(0o700)
        for file in files:
            near = [
                layer
                for layer, time in kept.layers.items()
                if cut(time, file.start, file.end).length
            ]
            rate, samples = kept_sound(near, kept.topic, file.start, file.end)
            path = temporary / file.name(lines)
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(wav_bytes(samples, rate))


def label_lines(
    marks: Sequence[Mark],
    requested: Iterable[ReviewSpan],
    files: Iterable[SoundFile],
    folder: str,
    zone: tzinfo,
) -> str:
    """Format labels for people with an editor: local times, and the file to listen to.

    An import reads the first three columns.
    """
    notes: dict[int, list[str]] = {}
    for minute in drawn_minutes(requested, marks):
        text = f"a minute drawn at random, to line {minute.last}"
        notes.setdefault(minute.first, []).append(text)
    for file in files:
        notes.setdefault(file.first, []).append(f"{folder}/{file.name(len(marks))}")
    return "".join(
        "\t".join(
            [_clock(mark.start, zone), _clock(mark.end, zone), mark.label]
            + ([", ".join(notes[number])] if number in notes else [])
        )
        + "\n"
        for number, mark in enumerate(marks, 1)
    )


def _clock(nanoseconds: int, zone: tzinfo) -> str:
    """Format a local time with its UTC offset, so that it is unambiguous."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    text = datetime.fromtimestamp(seconds, zone).isoformat()
    decimals = f"{rest:09}".rstrip("0")
    return f"{text[:19]}.{decimals}{text[19:]}" if decimals else text


def drawn_minutes(requested: Iterable[ReviewSpan], marks: Sequence[Mark]) -> Iterator[SoundFile]:
    """Yield the minutes drawn at random; a minute whose log is gone has no lines and is skipped."""
    for span in requested:
        lines = [number for number, mark in enumerate(marks, 1) if _answers(mark, span)]
        if span.reason == RANDOM and lines:
            yield SoundFile(lines[0], lines[-1], span.start, span.end)


def chosen_as(span: ReviewSpan) -> str:
    """Return how a span was chosen, as in `ReviewedSpan`."""
    return RANDOM if span.reason == RANDOM else QUEUE


def corrected_name(labelling: str) -> str:
    """Return the name of a labelling as in marks: a model without `relabel/`."""
    return labelling.removeprefix(f"{RELABEL}/")


def check_scenario(path: Path, spans: Iterable[ReviewSpan], scenario: str, option: str) -> None:
    """Raise `DataError` if a span of a list does not belong to a scenario.

    The scenario is empty for the sounds of the home.
    """
    for span in spans:
        other = scenario_name(span.a)
        if other != scenario:
            do = f"give {option} {other}" if other else f"leave out {option} {scenario}"
            what = f"scenario {other}" if other else "the sounds of the home"
            raise DataError(f"{path}: asks for {what}: {do}")


def labels_of(span: ReviewSpan, labelling: Labelling) -> list[Mark]:
    """Return the labels of a span for a label file: one, or all of a complete minute."""
    if span.reason != RANDOM:
        return [Mark(span.microphone, span.start, span.end, span.proposed_label)]
    parts, rows, _ = intersection_rows(labelling, single_span(span.start, span.end))
    return [
        Mark(span.microphone, *each, label)
        for each, label in zip(parts.pairs(), labelling.labels[rows].tolist(), strict=True)
    ]


def reviewed_spans(
    requested: Iterable[ReviewSpan],
    marks: Sequence[Mark],
    coverage: Mapping[str, Coverage],
    reviewer: str,
    made: int,
) -> dict[Path, list[ReviewedSpan]]:
    """Return the requested spans that a person has reviewed: those with a label."""
    reviewed: dict[Path, list[ReviewedSpan]] = {}
    for span in requested:
        if span.microphone in coverage and any(_answers(mark, span) for mark in marks):
            origin = reviewer, made, corrected_name(span.a), chosen_as(span)
            for log, first, last in coverage[span.microphone].split(span.start, span.end):
                part = ReviewedSpan(span.microphone, first, last, *origin)
                reviewed.setdefault(log, []).append(part)
    return reviewed


def outside_requests(requested: Sequence[ReviewSpan], marks: Iterable[Mark]) -> list[Mark]:
    """Return the marks outside all requested spans."""
    return [mark for mark in marks if not any(_answers(mark, span) for span in requested)]


def _answers(mark: Mark, span: ReviewSpan) -> bool:
    return mark.microphone == span.microphone and mark.start < span.end and mark.end > span.start
