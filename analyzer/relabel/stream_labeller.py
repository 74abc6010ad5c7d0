"""Labeller of recorded features, log by log, with as much earlier sound as the labels need."""

import shutil
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, check_model, read_recorder_infos
from hearthlog.analyzer.logs.spans import Spans, rows_at
from hearthlog.analyzer.relabel.recorded import Features, read_recorded
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.floor import Floors, FloorTracker
from hearthlog.models.labels import Segment, StateRun
from hearthlog.models.labels.labeller import FrameLabels, labeller_of
from hearthlog.recorder.events import Gap
from hearthlog.schemas.arrays import Float32, Indices, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.files import is_local
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import is_active
from hearthlog.schemas.messages.topics import EmbeddingSource
from hearthlog.schemas.salvage.recover import recover_log

_LARGEST_STEP = NANOSECONDS // 5  # maximum jump of a sound card's time between two frames


class StreamLabeller:
    """Labels the recording of one microphone, in time order.

    The name of the microphone selects the array directions that the model supports. Frames before
    `label_from`, in nanoseconds of UTC, are not labelled; there only the noise floor is tracked,
    which is much faster. `floor_converged` if sound before the first frame would not affect later
    floors.
    """

    def __init__(
        self,
        classifier: Classifier,
        label_from: int = 0,
        microphone: str = "",
        embedding: EmbeddingSource | None = None,
        *,
        from_start: bool = False,
    ) -> None:
        self.segments: list[Segment] = []
        self.floor_converged = from_start or not classifier.timing.needs_floor
        self._label_from = label_from
        self._labeller = labeller_of(classifier, microphone, embedding)
        self._powers = classifier.feature_set.band_powers
        self._floor = None if self._powers is None else FloorTracker()
        self._next: int | None = None  # number of the next frame
        self._end = 0  # end of the last frame, in nanoseconds of UTC
        self._from_start = False  # began at the start of the sound, or after a gap

    @property
    def states_converged(self) -> bool:
        """Whether sound before the first frame would not affect later states."""
        return self._from_start or self._labeller.states_converged

    @property
    def segments_converged(self) -> bool:
        """Whether sound before the first frame would not affect later segments."""
        return self._from_start or self._labeller.segments_converged

    @property
    def takes_auxiliary(self) -> bool:
        """Whether directions or embeddings affect its labels."""
        return self._labeller.takes_auxiliary

    @property
    def open_run(self) -> StateRun | None:
        """The open segment; None if there is none."""
        return self._labeller.segmenter.open_run

    def discard_open(self) -> None:
        """Set the counts of the open run to zero; its label and start stay."""
        self._labeller.segmenter.discard_open()

    def is_followed_by(self, frame: tuple[int, int]) -> bool:
        """Return whether a frame continues the sound: the next number, within 0.2 s of its time.

        A frame is its number and its start in nanoseconds of UTC.
        """
        return frame[0] == self._next and abs(frame[1] - self._end) <= _LARGEST_STEP

    def push(self, event: Features | Gap) -> FrameLabels | None:
        """Add features, at least one frame, or a gap, in time order; None for a gap.

        The labels are of the frames at which a window is complete, possibly none. Closed segments
        are added to `segments`. The open segment ends at a gap, and where features are not
        contiguous.
        """
        if isinstance(event, Gap):
            self.close()
            return None
        last = self._label_from - FRAME_NANOSECONDS
        unlabelled = int(np.searchsorted(event.stamps, last, side="right"))
        if 0 < unlabelled < len(event.stamps):
            self.push(event.part(slice(unlabelled)))
            return self.push(event.part(slice(unlabelled, None)))
        if self._next is not None and not self.is_followed_by((event.first, int(event.stamps[0]))):
            self.close()
        self._from_start |= event.first == 0
        self._next = event.first + len(event.stamps)
        self._end = int(event.stamps[-1]) + FRAME_NANOSECONDS
        floors = self._track_floor(event)
        if self._end <= self._label_from:
            self._from_start = False
            return None
        sound = event.values, floors, event.first, event.stamps, event.auxiliary
        labels, segments = self._labeller.push(*sound)
        self.segments += segments
        return labels

    def _track_floor(self, event: Features) -> Floors | None:
        if self._floor is None or self._powers is None:
            return None
        floors = self._floor(self._powers(event.values), event.first)
        self.floor_converged |= floors.converged or event.first == 0
        return floors._replace(converged=self.floor_converged)

    def close(self) -> None:
        """End the open segment at the end of the last frame; the next frame starts anew."""
        self.segments += self._labeller.close(self._end)
        if self._floor is not None:
            self._floor.restart()
        self._next = None
        self._from_start = self.floor_converged = True


_WARM_UP = 30 * NANOSECONDS
_FLOOR_WARM_UP = 150 * NANOSECONDS  # a minute, plus the four seconds of steadiness that follow
_SETTLING = 5 * NANOSECONDS  # before a span until labels settle, after it until they are decided
_NEVER = (1 << 63) - 1
_FRAMES = 12_000  # ten minutes at once: the process keeps the memory of their arrays
_LONGEST_LOSS_TEXT = 1000  # characters


class UnreadableError(LogError):
    """A log, or a part of it, is damaged."""

    def __init__(self, log: Path, what: object) -> None:
        super().__init__(str(what))
        self.log = log

    def __reduce__(self) -> tuple[type["UnreadableError"], tuple[Path, str]]:
        return UnreadableError, (self.log, str(self))


def infos_for_model(
    path: Path, model: Model, log: Path
) -> tuple[list[RecorderInfo], dict[str, str]]:
    """Find the microphones of a log, sorted by name, whose features the model supports.

    There is at least one. Raise `LogError` if none has features of the model's set; an
    `UnreadableError` if the log is damaged.
    """
    infos = [info for info in _read_infos(path) if info.first_frame is not None]
    if not infos:
        raise LogError(f"{log}: has no features; there is nothing to label")
    suited, left_out, errors = [], {}, []
    for info in infos:
        try:
            check_model(replace(info, path=log), model)
            suited.append(info)
        except LogError as error:
            left_out[info.microphone] = info.feature_set
            errors.append(error)
    if not suited:
        raise errors[0]
    return suited, left_out


def read_sound(
    info: RecorderInfo, start: int, end: int = _NEVER, *, auxiliary: bool = False
) -> Iterator[Features | Gap]:
    """Read the features and gaps of a log between log times (ns of UTC), the end excluded.

    Raise `UnreadableError` if it is damaged, or was not written by a recorder, or its feature set
    is not installed.
    """
    try:
        sound = read_recorded(info, start, end, sound_only=True, auxiliary=auxiliary)
        for batch in sound:
            for event in batch.events:
                if isinstance(event, Gap):
                    yield event
                elif isinstance(event, Features):
                    for begin in range(0, len(event.stamps), _FRAMES):
                        yield event.part(slice(begin, begin + _FRAMES))
    except LogError as error:
        raise UnreadableError(info.path, error) from error


def recover_copy(log: Path, folder: Path) -> tuple[Path, str]:
    """Save the intact parts of a damaged log to a folder; return the unsaved parts as text, if any.

    Raise `LogError` if nothing can be saved, or the copy cannot be written.
    """
    source, copy = log, folder / log.name
    if not is_local(log):
        source = folder / f"damaged-{log.name}"
        with log.open("rb") as stream, source.open("xb") as out:
            shutil.copyfileobj(stream, out)
    try:
        recovery = recover_log(source, copy, log.name)
    except OSError as error:
        raise LogError(f"{log}: what is whole cannot be copied ({error.strerror})") from error
    return copy, "; ".join(recovery.losses)[:_LONGEST_LOSS_TEXT]


def warm_up(
    info: RecorderInfo, earlier: Sequence[Path], classifier: Classifier, *, states_only: bool
) -> StreamLabeller:
    """Label as much of the sound before a log as its first labels depend on.

    With `states_only` converged states suffice: the open segment may then lack its beginning. The
    labeller is ready for the first frame of the log; without a past where the earlier logs do not
    lead up to it.
    """
    first, labels_back = info.first_frame, _WARM_UP
    floor_back = _FLOOR_WARM_UP if classifier.timing.needs_floor else labels_back
    while first is not None and earlier:
        back = max(floor_back, labels_back)
        starts = first[1] - back, first[1] - labels_back
        labeller, from_start = _label_earlier(earlier, info, starts, classifier)
        if not labeller.is_followed_by(first):
            break
        converged = labeller.states_converged and (states_only or labeller.segments_converged)
        if converged or (from_start and labels_back == back):
            return labeller
        if labeller.floor_converged:
            labels_back *= 4
        else:  # of sound without a quiet moment; to read it again costs more than to read far
            floor_back *= 8
    return StreamLabeller(classifier, microphone=info.microphone, embedding=info.embedding)


def _label_earlier(
    logs: Sequence[Path], info: RecorderInfo, starts: tuple[int, int], classifier: Classifier
) -> tuple[StreamLabeller, bool]:
    """Track the floor in earlier logs from one time on, and label them from another.

    Return also whether there is nothing before the first of these times.
    """
    copies: dict[Path, Path | None] = {}  # saved copies of damaged logs
    with TemporaryDirectory(prefix="hearthlog") as folder:
        while True:
            try:
                return _label_readable(logs, copies, info, starts, classifier)
            except UnreadableError as error:
                copy = None
                if error.log not in copies.values():
                    with suppress(LogError):
                        copy, _ = recover_copy(error.log, Path(folder))
                copies[next(log for log in logs if log.name == error.log.name)] = copy


def _label_readable(
    logs: Sequence[Path],
    copies: Mapping[Path, Path | None],
    info: RecorderInfo,
    starts: tuple[int, int],
    classifier: Classifier,
) -> tuple[StreamLabeller, bool]:
    start, label_from = starts
    chosen: deque[RecorderInfo] = deque()
    from_start = True
    for log in logs:
        path = copies.get(log, log)
        other = None if path is None else _of_microphone(_read_infos(path), info.microphone)
        if other is None or other.first_frame is None or not _same_sound(other, info):
            break
        chosen.appendleft(other)
        if other.first_frame[1] < start:
            from_start = False
            break
    labeller = StreamLabeller(
        classifier, label_from, info.microphone, info.embedding, from_start=from_start
    )
    for other in chosen:
        for event in read_sound(other, start, auxiliary=labeller.takes_auxiliary):
            labeller.push(event)
        labeller.segments.clear()
    return labeller, from_start


def continues_in(labeller: StreamLabeller, info: RecorderInfo, next_log: Path) -> bool | None:
    """Return whether the sound of a log continues in the next log.

    None while undecided: the next log is being written and has no frame.
    """
    other = None
    with suppress(LogError):
        other = _of_microphone(read_recorder_infos(next_log, "features"), info.microphone)
    if other is None or other.first_frame is None:
        return None if is_active(next_log) else False
    return _same_sound(other, info) and labeller.is_followed_by(other.first_frame)


class SpanLabels(NamedTuple):
    """Labels of the frames of a span that are in a segment."""

    stamps: Int64  # [shape=(n,)]; starts in nanoseconds of UTC
    classes: Indices  # [shape=(n,)]; of the segment around each frame
    probabilities: Float32  # [shape=(n, C)]


def label_span(
    info: RecorderInfo, classifiers: Sequence[Classifier], start: int, end: int
) -> list[SpanLabels]:
    """Label a span, in nanoseconds of UTC, with several classifiers, reading the features once.

    The end is excluded. The labels are those of a recorder as far as 150 s of sound before the
    span, of which 5 s are labelled, and 5 s after it decide them. Raise `LogError` if the log is
    damaged, or was not written by a recorder, or its feature set is not installed.
    """
    sound = list(read_sound(info, start - _FLOOR_WARM_UP, end + _SETTLING, auxiliary=True))
    label_from, microphone = start - _SETTLING, info.microphone
    labellers = (StreamLabeller(c, label_from, microphone, info.embedding) for c in classifiers)
    return [_labels_between(start, end, labeller, sound) for labeller in labellers]


def _labels_between(
    start: int, end: int, labeller: StreamLabeller, sound: Sequence[Features | Gap]
) -> SpanLabels:
    pieces = [piece for event in sound if (piece := labeller.push(event)) is not None]
    labeller.close()
    if not (pieces and labeller.segments):
        return SpanLabels(np.empty(0, np.int64), np.empty(0, np.intp), np.empty((0, 0), np.float32))
    starts, ends, labels = np.array([(s.start, s.end, s.label) for s in labeller.segments]).T
    stamps = np.concatenate([piece.stamps for piece in pieces])
    rows = rows_at(Spans(starts, ends), stamps)
    kept = (stamps >= start) & (stamps < end) & (rows >= 0)
    probabilities = np.concatenate([piece.probabilities for piece in pieces])
    return SpanLabels(stamps[kept], labels[rows[kept]], probabilities[kept])


def _read_infos(path: Path) -> list[RecorderInfo]:
    try:
        return read_recorder_infos(path, "features")
    except LogError as error:
        raise UnreadableError(path, error) from error


def _of_microphone(infos: Sequence[RecorderInfo], name: str) -> RecorderInfo | None:
    return next((info for info in infos if info.microphone == name), None)


def _same_sound(first: RecorderInfo, second: RecorderInfo) -> bool:
    one, other = (
        (info.node, info.microphone, info.feature_set, info.embedding) for info in (first, second)
    )
    return one == other
