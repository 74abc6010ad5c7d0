"""Relabel layers: job, labels and segments, metadata."""

import glob
import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.layers import Chain
from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.relabel.stream_labeller import (
    StreamLabeller,
    UnreadableError,
    goes_on_in,
    infos_for_model,
    read_sound,
    recover_copy,
    warm_up,
)
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.errors import ModelError
from hearthlog.models.labels.labeller import FrameLabels, label_columns, segment_columns
from hearthlog.models.labels.segments import Segment, StateRun
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import relabel_path, stem
from hearthlog.schemas.logs.metadata import (
    HEARTHLOG_METADATA,
    earlier_digests,
    log_digest,
    provenance,
    read_provenance,
)
from hearthlog.schemas.logs.writer import LogStreamWriter, TopicBatch
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import Topic, label_topics, relabelling
from hearthlog.schemas.new_files import new_file, readers_of, replaced_file

OpenRuns = Mapping[str, StateRun]  # open segments by microphone
_RUN = ("label", "start", "frames", "confidence")


class LayerInputs(NamedTuple):
    """Inputs of a layer; equal inputs give equal labels and segments.

    `before` and `behind` are stems of the previous and next log; empty if there is none, or if it
    was not decided yet whether the sound continues there.
    """

    model: str
    model_sha256: str  # of the model file
    input_sha256: str  # `log_digest` of the log
    before: str
    behind: str


class LayerMetadata(NamedTuple):
    """Content of the `hearthlog` record of a layer."""

    inputs: LayerInputs
    open_at_start: OpenRuns  # the segments open at the start of the log
    open_at_end: OpenRuns
    loss: str  # unreadable parts of the log


def layer_topics(microphone: str, model: str, classes: Sequence[str]) -> tuple[Topic, Topic]:
    """Return the topics of a layer.

    Parameters
    ----------
    classes : sequence of str
        In the order of the model's probabilities.
    """
    return label_topics(microphone, relabelling(model), classes)


def read_layer_metadata(layer: Path) -> LayerMetadata | None:
    """Read the metadata of a layer; None if there is no layer.

    Raise `LogError` if the layer is damaged, or was not made by `relabel`.
    """
    if not layer.exists():
        return None
    try:
        with LogFile(layer) as file:
            record = {key: text for each in read_provenance(file) for key, text in each.items()}
            microphones = {_microphone(channel.topic) for channel in file.channels.values()}
        return LayerMetadata(
            LayerInputs(*(record[name] for name in LayerInputs._fields)),
            _read_runs(record["began"], microphones),
            _read_runs(record["ended"], microphones),
            record["lost"],
        )
    except (KeyError, ValueError, TypeError, ArithmeticError, RecursionError, LogError) as error:
        why = error if isinstance(error, LogError) else f"{layer}: is no layer of `relabel`"
        raise LogError(f"{why}; move it away, and run again") from error


def part_path(layer: Path) -> Path:
    """Return a path for an unfinished layer: hidden, next to the layer, and unique."""
    return layer.with_name(f".{layer.name}.{os.urandom(8).hex()}.part")


def delete_parts(layer: Path) -> None:
    """Delete the unfinished files of a layer left by this and other runs."""
    for part in layer.parent.glob(f".{glob.escape(layer.name)}.*"):
        with suppress(OSError):
            part.unlink()


def layer_record(
    metadata: LayerMetadata, log: str, node: str, more: Mapping[str, str]
) -> dict[str, str]:
    """Make the `hearthlog` record of a layer."""
    return provenance(
        node,
        log=log,
        **more,
        **metadata.inputs._asdict(),
        began=_runs_text(metadata.open_at_start),
        ended=_runs_text(metadata.open_at_end),
        lost=metadata.loss,
        made=_now(),
    )


def _now() -> str:
    """Return the time, or SOURCE_DATE_EPOCH, which makes builds reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%SZ}"


def _microphone(topic: str) -> str:
    return topic.split("/")[1]


def _runs_text(runs: OpenRuns) -> str:
    """Write open segments as JSON; empty if there are none."""
    return json.dumps({name: run._asdict() for name, run in runs.items()}) if runs else ""


def _read_runs(text: str, microphones: Collection[str]) -> OpenRuns:
    """Parse open segments; older layers have one microphone and no names."""
    if not text:
        return {}
    fields = json.loads(text)
    if not isinstance(fields, dict) or not fields:
        raise ValueError
    if set(fields) == set(_RUN):
        (microphone,) = microphones
        fields = {microphone: fields}
    return {name: StateRun(*(int(run[key]) for key in _RUN)) for name, run in fields.items()}


_MOST_EARLIER = 1000  # logs: within so many a floor is forgotten, even if each has only a minute


class Job(NamedTuple):
    """A log to label."""

    log: Path
    layer: Path
    earlier: tuple[Path, ...]  # previous logs, the latest first
    next_log: Path | None
    model: Path
    model_sha256: str
    replaces: bool  # whether a replaceable layer exists
    continues_layer: bool  # whether the segment open at the start comes from the previous layer


def make_job(
    chain: Chain, place: int, model: Model, model_path: Path, *, continues_layer: bool
) -> Job:
    """Make the job of one log of a chain, as if it had no layer.

    Parameters
    ----------
    continues_layer : bool
        Whether the segment open at the start comes from the previous layer.
    """
    log = chain.logs[place]
    first = max(place - _MOST_EARLIER, 0) if continues_layer else 0
    return Job(
        log=log,
        layer=relabel_path(log, model.name),
        earlier=tuple(reversed(chain.logs[first:place])),
        next_log=chain.logs[place + 1] if place + 1 < len(chain.logs) else None,
        model=model_path,
        model_sha256=model.sha256,
        replaces=False,
        continues_layer=continues_layer,
    )


def is_current(job: Job, metadata: LayerMetadata, log_sha256: str) -> bool:
    """Return whether a layer is up to date; its segment open at the start is not compared.

    Raise `LogError` if the layer is of another model, or of another log.
    """
    inputs = metadata.inputs
    if inputs.model_sha256 != job.model_sha256:
        raise LogError(
            f"{job.layer}: was made by another model of this name ({inputs.model_sha256[:12]}, not "
            f"{job.model_sha256[:12]}); move it away, or give the model another name"
        )
    digest = inputs.input_sha256
    if digest != log_sha256 and digest not in earlier_digests(job.log):
        raise LogError(
            f"{job.layer}: was made from another log of this name; move it away, and run again"
        )
    # If a neighbouring log was deleted since, the layer has more context than a new one would.
    same_before = not job.earlier or stem(job.earlier[0]) == inputs.before
    same_behind = job.next_log is None or stem(job.next_log) == inputs.behind
    return same_before and same_behind and not metadata.loss


_CHUNK_SPAN = 60 * NANOSECONDS  # readers of segments read only the minutes in which a segment ends
_PIECE_SPAN = 600 * NANOSECONDS  # labels encoded at once


class LabelledSound(NamedTuple):
    """Segments of a microphone in a log, as far as they are known without other layers.

    `lacks_start` is true if a segment is open at the start of the log and its earlier frames,
    counted in the previous layer, are not added yet; `open_at_start` is None until then.
    """

    microphone: str
    segments: list[Segment]
    open_at_start: StateRun | None
    open_at_end: StateRun | None
    lacks_start: bool
    frames: int  # number of labelled frames

    def with_start(self, open_at_start: StateRun | None) -> "LabelledSound":
        """Add the segment open at the end of the previous layer, if it is still missing.

        Parameters
        ----------
        open_at_start : Run or None
            The segment; None if none is open there.

        Returns
        -------
        LabelledSound
            This object if it does not lack its start; otherwise a new, complete one.
        """
        if not self.lacks_start:
            return self
        segments, open_at_end = list(self.segments), self.open_at_end
        if segments:
            segments[0] = segments[0]._replace(run=segments[0].run.prepend(open_at_start))
        elif open_at_end is not None:
            open_at_end = open_at_end.prepend(open_at_start)
        return self._replace(
            segments=segments,
            open_at_start=open_at_start,
            open_at_end=open_at_end,
            lacks_start=False,
        )


class UnfinishedLayer(NamedTuple):
    """Labels of a log, and the segments of each of its microphones."""

    part: Path  # file of labels of type `_row_type`, one microphone after the other
    inputs: LayerInputs
    node: str
    provenance: Mapping[str, str]  # the `hearthlog` record of the log
    sounds: Sequence[LabelledSound]
    left_out: Mapping[str, str]  # feature sets of microphones that the model does not support
    loss: str  # unreadable parts of the log
    lacks_embeddings: bool  # embeddings that the model requires

    @property
    def lacks_starts(self) -> bool:
        """Whether the earlier frames of an open segment are still to be added."""
        return any(sound.lacks_start for sound in self.sounds)

    @property
    def open_at_start(self) -> OpenRuns:
        """The segments open at the start of the log."""
        return {s.microphone: s.open_at_start for s in self.sounds if s.open_at_start is not None}

    @property
    def open_at_end(self) -> OpenRuns:
        """The segments open at the end of the log."""
        return {s.microphone: s.open_at_end for s in self.sounds if s.open_at_end is not None}

    @property
    def frames(self) -> int:
        """Number of labelled frames."""
        return sum(sound.frames for sound in self.sounds)

    def with_starts(self, open_at_start: OpenRuns) -> "UnfinishedLayer":
        """Add the missing segments that are open at the end of the previous layer."""
        sounds = [sound.with_start(open_at_start.get(sound.microphone)) for sound in self.sounds]
        return self._replace(sounds=sounds)

    def delete(self) -> None:
        """Delete the file of labels, if it exists."""
        with suppress(OSError):
            self.part.unlink()


_Labellers = dict[str, StreamLabeller]  # by microphone


def label_logs(jobs: Sequence[Job]) -> list[UnfinishedLayer | None]:
    """Write the labels of logs, and find their segments.

    The intact parts of a damaged log are labelled.

    Parameters
    ----------
    jobs : sequence of Job
        Consecutive logs of one chain.

    Returns
    -------
    list of UnfinishedLayer or None
        One for each log. The labels are in the file `part` of a layer, which the caller must
        delete. None if one of several logs failed; a single log raises its error.

    Raises
    ------
    LogError
        If the log has no features, or a feature set other than the model's; if the log has no
        intact part; if the labels cannot be written.
    ModelError
        If the file of the model is missing or damaged, or holds another model.
    """
    layers: list[UnfinishedLayer | None] = []
    labellers: _Labellers = {}
    try:
        for job in jobs:
            try:
                layer, labellers = _label_log(job, labellers)
                layers.append(layer)
            except HearthlogError:
                if len(jobs) == 1:
                    raise
                layers.append(None)
                labellers = {}
    except BaseException:
        for unclaimed in layers:
            if unclaimed is not None:
                unclaimed.delete()
        raise
    return layers


def _label_log(job: Job, before: _Labellers) -> tuple[UnfinishedLayer, _Labellers]:
    """Label a log; return also the labellers at its end, if the next log may continue with them."""
    model, classifier = _loaded(job.model, job.model_sha256)
    with TemporaryDirectory(prefix="hearthlog") as folder:
        try:
            return _label(job, job.log, before, model, classifier)
        except UnreadableError:
            copy, loss = recover_copy(job.log, Path(folder))
        try:
            layer, _ = _label(job, copy, {}, model, classifier)
            return layer._replace(loss=loss), {}
        except UnreadableError as error:
            raise LogError(str(error).replace(str(copy), str(job.log))) from error


def complete_layer(job: Job, labelled: UnfinishedLayer) -> None:
    """Append the segments to the labels and rename the file to the layer.

    Parameters
    ----------
    labelled : UnfinishedLayer
        Must not lack starts. Its file `part` is deleted once the layer is complete.

    Raises
    ------
    LogError
        If the layer cannot be written, or there is another one that may not be replaced.
    ModelError
        If the file of the model is missing or damaged, or holds another model.
    """
    model, classifier = _loaded(job.model, job.model_sha256)
    metadata = LayerMetadata(
        labelled.inputs, labelled.open_at_start, labelled.open_at_end, labelled.loss
    )
    smoothing = model.description.smoothing
    more = {
        "feature_set": model.description.feature_set,
        "method": f"{smoothing.method}, lag {smoothing.lag_seconds:g} s",
    }
    topics = [layer_topics(s.microphone, model.name, classifier.classes) for s in labelled.sounds]
    segments = [
        _segments_of(segments.name, sound, classifier.classes)
        for (_, segments), sound in zip(topics, labelled.sounds, strict=True)
    ]
    put = replaced_file if job.replaces else new_file
    try:
        with put(job.layer, readers=readers_of(job.log)) as temporary, temporary.open("xb") as out:
            writer = LogStreamWriter(out, list(chain.from_iterable(topics)), _CHUNK_SPAN)
            labels = _read_labels(labelled, [topic.name for topic, _ in topics], classifier.classes)
            for batch in _in_pieces([*labels, *segments]):
                writer.write_columns(batch)
            record = layer_record(metadata, job.log.name, labelled.node, more)
            writer.add_metadata(HEARTHLOG_METADATA, record)
            writer.end(job.layer.name)
    except LogError:
        if read_layer_metadata(job.layer) != metadata:  # otherwise another run was quicker
            raise
    delete_parts(job.layer)


def _in_pieces(batches: Sequence[TopicBatch]) -> Iterator[list[TopicBatch]]:
    """Split messages of several topics at the same times."""
    times = np.concatenate([batch.log_times for batch in batches])
    begins = np.unique(times // _PIECE_SPAN)[1:] * _PIECE_SPAN
    places = [batch.log_times.searchsorted(begins).tolist() for batch in batches]
    for parts in zip(*(pairwise([0, *each, None]) for each in places), strict=True):
        yield [_part(batch, slice(*part)) for batch, part in zip(batches, parts, strict=True)]


def _part(batch: TopicBatch, rows: slice) -> TopicBatch:
    fields = {
        path: column if isinstance(column, str) else column[rows]
        for path, column in batch.fields.items()
    }
    return TopicBatch(batch.topic, batch.log_times[rows], fields)


def _read_labels(
    labelled: UnfinishedLayer, topics: Sequence[str], classes: Sequence[str]
) -> list[TopicBatch]:
    """Read the labels of each microphone from the part file."""
    stored, first = labelled.part.read_bytes(), 0
    batches = []
    for topic, sound in zip(topics, labelled.sounds, strict=True):
        rows = np.frombuffer(stored, _row_type(len(classes)), sound.frames, first)
        first += rows.nbytes
        rows = rows[rows["known_at"].argsort(kind="stable")]  # a sound card's time may jump back
        fields = label_columns(rows, classes, sound.microphone)
        batches.append(TopicBatch(topic, rows["known_at"].copy(), fields))
    return batches


def _segments_of(topic: str, sound: LabelledSound, classes: Sequence[str]) -> TopicBatch:
    times: Int64 = np.array([segment.decided_at for segment in sound.segments], np.int64)
    return TopicBatch(topic, times, segment_columns(sound.segments, classes, sound.microphone))


@lru_cache(2)
def _loaded(path: Path, sha256: str) -> tuple[Model, Classifier]:
    model = load_model(path)
    if model.sha256 != sha256:
        raise ModelError(f"{path}: is another model here ({model.sha256[:12]}, not {sha256[:12]})")
    return model, Classifier(model)


class _Begun(NamedTuple):
    """State of a microphone in a log, before its first frame."""

    info: RecorderInfo
    labeller: StreamLabeller
    open_at_start: StateRun | None
    lacks_start: bool


def _label(
    job: Job, log: Path, before: _Labellers, model: Model, classifier: Classifier
) -> tuple[UnfinishedLayer, _Labellers]:
    """Label a log, or its saved copy."""
    infos, left_out = infos_for_model(log, model, job.log)
    begun = [_begin(job, info, before.get(info.microphone), classifier) for info in infos]
    part = part_path(job.layer)
    frames = _write_labels(part, job, begun)
    following = [_goes_on(job, each) for each in begun]
    ends = zip(begun, frames, following, strict=True)
    sounds = [_end(each, count, goes_on=bool(goes_on)) for each, count, goes_on in ends]
    earlier = stem(job.earlier[0]) if job.earlier else ""
    behind = "" if job.next_log is None or None in following else stem(job.next_log)
    layer = UnfinishedLayer(
        part=part,
        inputs=LayerInputs(model.name, model.sha256, log_digest(job.log), earlier, behind),
        node=infos[0].node,
        provenance=infos[0].metadata,
        sounds=sounds,
        left_out=left_out,
        loss="" if infos[0].complete else "it is cut off",
        lacks_embeddings=any(classifier.lacking_embeddings(info.embedding) for info in infos),
    )
    return layer, {each.info.microphone: each.labeller for each in begun}


def _begin(
    job: Job, info: RecorderInfo, before: StreamLabeller | None, classifier: Classifier
) -> _Begun:
    """Return the labeller from the end of the previous log, or one that gives the same labels."""
    first = info.first_frame
    if before is not None and first is not None and before.is_followed_by(first):
        labeller = before
        labeller.segments = []  # drop those of the previous log
    else:
        labeller = warm_up(info, job.earlier, classifier, states_only=job.continues_layer)
    open_at_start = labeller.open_run
    lacks_start = job.continues_layer and open_at_start is not None
    if lacks_start:
        labeller.discard_open()
        open_at_start = None
    return _Begun(info, labeller, open_at_start, lacks_start)


def _goes_on(job: Job, begun: _Begun) -> bool | None:
    return None if job.next_log is None else goes_on_in(begun.labeller, begun.info, job.next_log)


def _end(begun: _Begun, frames: int, *, goes_on: bool) -> LabelledSound:
    if not goes_on:
        begun.labeller.close()
    return LabelledSound(
        microphone=begun.info.microphone,
        segments=begun.labeller.segments,
        open_at_start=begun.open_at_start,
        open_at_end=begun.labeller.open_run,
        lacks_start=begun.lacks_start,
        frames=frames,
    )


def _write_labels(part: Path, job: Job, begun: Sequence[_Begun]) -> list[int]:
    """Write the labels of a log to a new file; return the number of each microphone."""
    try:
        with part.open("xb") as out:
            return [_write_sound(out, each) for each in begun]
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise LogError(f"{job.layer}: cannot be written ({error.strerror})") from error
        raise


def _write_sound(out: BinaryIO, begun: _Begun) -> int:
    """Write the labels of one microphone, and count them."""
    frames = 0
    for event in read_sound(begun.info, 0, auxiliary=begun.labeller.takes_auxiliary):
        labels = begun.labeller.push(event)
        if labels is not None:
            out.write(_rows_of(labels).tobytes())
            frames += len(labels.frames)
    return frames


def _rows_of(labels: FrameLabels) -> NDArray[np.void]:
    rows = np.empty(len(labels.frames), _row_type(len(labels.classes)))
    for name in rows.dtype.names or ():
        rows[name] = getattr(labels, name)
    return rows


def _row_type(classes: int) -> np.dtype[np.void]:
    """Return the row type of a label in the part file."""
    times = [(name, np.int64) for name in ("frames", "stamps", "known_at")]
    return np.dtype([*times, ("probabilities", np.float32, (classes,)), ("novelty", np.float32)])
