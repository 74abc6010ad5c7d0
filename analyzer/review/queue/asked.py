"""The label file of a queue: its lines, and beside it the sounds and a list of the spans.

By the list an import knows what was looked at.
"""

import os
import wave
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.clips import SAMPLE_BYTES, kept_sound, kept_time
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.spans import NONE, Spans, cut, joined, one, pieces
from hearthlog.analyzer.marks.formats.formats import find_format
from hearthlog.analyzer.marks.marks import QUEUE, RANDOM, Mark, ReviewedSpan
from hearthlog.analyzer.review.queue.review_list import ReviewSpan
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import AUDIO_LAYER, find_logs, log_name
from hearthlog.schemas.messages.topics import LIVE, RELABEL, labelling_topic, scenario_name
from hearthlog.schemas.new_files import new_folder

_SUFFIX = ".queue.csv"
_EVER = 1 << 62  # nanoseconds
_SHORTEST = NANOSECONDS // 10  # sound that is worth a file
_FULL_SCALE = 32767.0


def asked_path(labels: Path) -> Path:
    """Return the path of the list beside a label file: `ten.queue.csv` beside `ten.txt`."""
    return labels.with_name(_stem(labels) + _SUFFIX)


def sounds_folder(labels: Path) -> Path:
    """Return the path of the folder of sounds beside a label file: `ten` beside `ten.txt`."""
    return labels.with_name(_stem(labels))


def _stem(labels: Path) -> str:
    format_ = find_format(labels)
    return labels.name.removesuffix("" if format_ is None else format_.suffix)


class KeptSound(NamedTuple):
    """The kept sound of a microphone."""

    layers: dict[Path, Spans]
    topic: str
    time: Spans


class SoundFile(NamedTuple):
    """The kept sound of a line of a label file, or of the lines of a minute.

    Attributes
    ----------
    first, last : int
        Numbers of the lines, from 1.
    """

    first: int
    last: int
    start: int
    end: int

    def name(self, lines: int) -> str:
        """Name the file: `07.wav`, or `12-31.wav` for a minute."""
        width = max(len(str(lines)), 2)
        last = f"-{self.last:0{width}}" if self.last > self.first else ""
        return f"{self.first:0{width}}{last}.wav"


def find_kept_sound(
    logs: Path, microphone: str, limits: tuple[int | None, int | None], losses: list[str]
) -> KeptSound:
    """Find what sound of a microphone was kept.

    Parameters
    ----------
    limits : (int or None, int or None)
        Start and end in nanoseconds of UTC; None for all that there is.

    Raises
    ------
    LogError
        If there is no log.
    """
    topic = labelling_topic(microphone, LIVE, "audio")
    start, end = 0 if limits[0] is None else limits[0], _EVER if limits[1] is None else limits[1]
    layers: dict[Path, Spans] = {}
    near = logs if logs.is_dir() else logs.parent
    for layer in find_logs(near):
        if log_name(layer).layer != AUDIO_LAYER:
            continue
        try:
            layers[layer] = kept_time([layer], topic, start, end)
        except LogError as error:
            losses.append(str(error))
    times = zip(NONE, *layers.values(), strict=True)
    starts, ends = (np.concatenate(each) for each in times)
    return KeptSound(layers, topic, joined(starts, ends))


def sound_files(
    marks: Sequence[Mark], asked: Iterable[ReviewSpan], kept: KeptSound
) -> list[SoundFile]:
    """List the lines of a label file of which sound was kept, and the minutes."""
    lines = [SoundFile(n, n, mark.start, mark.end) for n, mark in enumerate(marks, 1)]
    files = [*lines, *(one for one in drawn_minutes(asked, marks) if one.last > one.first)]
    return [one for one in files if cut(kept.time, one.start, one.end).length >= _SHORTEST]


def write_sounds(folder: Path, files: Sequence[SoundFile], lines: int, kept: KeptSound) -> None:
    """Write sounds as WAV files into a new folder, for the user alone; where there is none silence.

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
            with os.fdopen(descriptor, "wb") as stream, wave.open(stream, "wb") as sound:
                sound.setparams((1, SAMPLE_BYTES, rate, 0, "NONE", ""))
                sound.writeframes((samples * _FULL_SCALE).astype("<i2").tobytes())


def label_lines(
    marks: Sequence[Mark],
    asked: Iterable[ReviewSpan],
    files: Iterable[SoundFile],
    folder: str,
    zone: tzinfo,
) -> str:
    """Write labels for people with an editor: times of the clock, and which file to listen to.

    An import reads the first three columns.
    """
    notes: dict[int, list[str]] = {}
    for minute in drawn_minutes(asked, marks):
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
    """Write a time of the clock on the wall, with its offset: no moment is meant twice."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    text = datetime.fromtimestamp(seconds, zone).isoformat()
    decimals = f"{rest:09}".rstrip("0")
    return f"{text[:19]}.{decimals}{text[19:]}" if decimals else text


def drawn_minutes(asked: Iterable[ReviewSpan], marks: Sequence[Mark]) -> Iterator[SoundFile]:
    """Yield the minutes that were drawn at random; one whose log is gone has no lines."""
    for span in asked:
        lines = [number for number, mark in enumerate(marks, 1) if _answers(mark, span)]
        if span.reason == RANDOM and lines:
            yield SoundFile(lines[0], lines[-1], span.start, span.end)


def chosen_as(span: ReviewSpan) -> str:
    """Return how a span was chosen, as `ReviewedSpan` says it."""
    return RANDOM if span.reason == RANDOM else QUEUE


def corrected_name(labelling: str) -> str:
    """Return the name of a labelling, as marks say it: that of a model without `relabel/`."""
    return labelling.removeprefix(f"{RELABEL}/")


def check_scenario(path: Path, spans: Iterable[ReviewSpan], scenario: str, option: str) -> None:
    """Check that all spans of a list are of one scenario.

    Parameters
    ----------
    scenario : str
        Its name; empty for the sounds of the home.

    Raises
    ------
    DataError
        If a span is of another one.
    """
    for span in spans:
        other = scenario_name(span.a)
        if other != scenario:
            do = f"give {option} {other}" if other else f"leave out {option} {scenario}"
            what = f"scenario {other}" if other else "the sounds of the home"
            raise DataError(f"{path}: asks for {what}: {do}")


def labels_of(span: ReviewSpan, labelling: Labelling) -> list[Mark]:
    """Return the labels of a span for a label file: one, or of a whole minute all."""
    if span.reason != RANDOM:
        return [Mark(span.microphone, span.start, span.end, span.proposed_label)]
    parts, rows, _ = pieces(labelling, one(span.start, span.end))
    times = zip(parts.starts.tolist(), parts.ends.tolist(), strict=True)
    return [
        Mark(span.microphone, *each, label)
        for each, label in zip(times, labelling.labels[rows].tolist(), strict=True)
    ]


def looked_at(
    asked: Iterable[ReviewSpan],
    marks: Sequence[Mark],
    coverage: Mapping[str, Coverage],
    reviewer: str,
    made: int,
) -> dict[Path, list[ReviewedSpan]]:
    """Return which of the spans that were asked a person has looked at: those with a label."""
    reviewed: dict[Path, list[ReviewedSpan]] = {}
    for span in asked:
        if span.microphone in coverage and any(_answers(mark, span) for mark in marks):
            origin = reviewer, made, corrected_name(span.a), chosen_as(span)
            for log, first, last in coverage[span.microphone].split(span.start, span.end):
                part = ReviewedSpan(span.microphone, first, last, *origin)
                reviewed.setdefault(log, []).append(part)
    return reviewed


def unasked(asked: Sequence[ReviewSpan], marks: Iterable[Mark]) -> list[Mark]:
    """Return the marks that lie in no span that was asked."""
    return [mark for mark in marks if not any(_answers(mark, span) for span in asked)]


def _answers(mark: Mark, span: ReviewSpan) -> bool:
    return mark.microphone == span.microphone and mark.start < span.end and mark.end > span.start
