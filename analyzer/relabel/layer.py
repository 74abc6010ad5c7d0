"""Relabel layers: job, labels and segments, metadata."""

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.recorder_info import RecorderInfo
from hearthlog.analyzer.relabel.stream_labeller import (
    StreamLabeller,
    UnreadableError,
    continues_in,
    infos_for_model,
    read_sound,
    recover_copy,
    warm_up,
)
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.labels import Segment, StateRun
from hearthlog.models.labels.labeller import FrameLabels, label_columns, segment_columns
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.errors import HearthlogError, LogError, ModelError
from hearthlog.schemas.files import store_errors
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import stem
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
_INPUTS = ("model", "model_sha256", "input_sha256", "before", "behind")


class LayerMetadata(NamedTuple):
    """Content of the `hearthlog` record of a layer; equal inputs give equal labels and segments.

    The inputs are the first five. `before` and `behind` are stems of the previous and next log;
    empty if there is none, or if it was not decided yet whether the sound continues there.
    """

    model: str
    model_sha256: str  # of the model file
    input_sha256: str  # `log_digest` of the log
    before: str
    behind: str
    open_at_start: OpenRuns  # the segments open at the start of the log
    open_at_end: OpenRuns
    loss: str  # unreadable parts of the log


def layer_topics(microphone: str, model: str, classes: Sequence[str]) -> tuple[Topic, Topic]:
    """Return the topics of a layer; classes are in the order of the model's probabilities."""
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
            microphones = {channel.topic.split("/")[1] for channel in file.channels.values()}
        inputs = (record[name] for name in _INPUTS)
        open_runs = (_read_runs(record[name], microphones) for name in ("began", "ended"))
        return LayerMetadata._make([*inputs, *open_runs, record["lost"]])
    except (KeyError, ValueError, TypeError, ArithmeticError, RecursionError, LogError) as error:
        why = error if isinstance(error, LogError) else f"{layer}: is no layer of `relabel`"
        raise LogError(f"{why}; move it away, and run again") from error


def _now() -> str:
    """Return the time, or SOURCE_DATE_EPOCH, which makes builds reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%SZ}"


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


def is_current(job: Job, metadata: LayerMetadata, log_sha256: str) -> bool:
    """Return whether a layer is up to date; its segment open at the start is not compared.

    Raise `LogError` if the layer is of another model, or of another log.
    """
    if metadata.model_sha256 != job.model_sha256:
        raise LogError(
            f"{job.layer}: was made by another model of this name ({metadata.model_sha256[:12]}, "
            f"not {job.model_sha256[:12]}); move it away, or give the model another name"
        )
    digest = metadata.input_sha256
    if digest != log_sha256 and digest not in earlier_digests(job.log):
        raise LogError(
            f"{job.layer}: was made from another log of this name; move it away, and run again"
        )
    # If a neighbouring log was deleted since, the layer has more context than a new one would.
    same_before = not job.earlier or stem(job.earlier[0]) == metadata.before
    same_behind = job.next_log is None or stem(job.next_log) == metadata.behind
    return same_before and same_behind and not metadata.loss


_CHUNK_SPAN = 60 * NANOSECONDS  # readers of segments read only the minutes in which a segment ends
_PIECE_SPAN = 600 * NANOSECONDS  # labels encoded at once


class UnfinishedLayer(NamedTuple):
    """Labels of a log, and the segments of its microphones as far as known without other layers.

    If the segments open at the start come from the previous layer, `open_at_start` of `metadata` is
    empty until their earlier frames, which are counted there, are added.
    """

    part: Path  # file of labels of type `_row_type`, one microphone after the other
    metadata: LayerMetadata
    node: str
    provenance: Mapping[str, str]  # the `hearthlog` record of the log
    segments: Mapping[str, Sequence[Segment]]  # by microphone
    frames: Mapping[str, int]  # number of labels by microphone
    lacks_start: Sequence[str]  # microphones whose open segment lacks its earlier frames
    left_out: Mapping[str, str]  # feature sets of microphones that the model does not support
    lacks_embeddings: bool  # embeddings that the model requires

    def with_starts(self, open_at_start: OpenRuns) -> "UnfinishedLayer":
        """Add the missing segments that are open at the end of the previous layer."""
        if not self.lacks_start:
            return self
        segments, open_at_end = dict(self.segments), dict(self.metadata.open_at_end)
        for name in self.lacks_start:
            earlier = open_at_start.get(name)
            if segments[name]:
                first, *others = segments[name]
                segments[name] = [first._replace(run=first.run.prepend(earlier)), *others]
            elif name in open_at_end:
                open_at_end[name] = open_at_end[name].prepend(earlier)
        starts = {name: open_at_start[name] for name in self.lacks_start if name in open_at_start}
        metadata = self.metadata._replace(open_at_start=starts, open_at_end=open_at_end)
        return self._replace(metadata=metadata, segments=segments, lacks_start=())

    def delete(self) -> None:
        """Delete the file of labels, if it exists."""
        with suppress(OSError):
            self.part.unlink()


_Labellers = dict[str, StreamLabeller]  # by microphone


def label_logs(jobs: Sequence[Job]) -> list[UnfinishedLayer | None]:
    """Write the labels of consecutive logs of one chain, and find their segments.

    The intact parts of a damaged log are labelled. The labels are in the file `part` of a layer,
    which the caller must delete. None if one of several logs failed; a single log raises its error.

    Raise `LogError` if the log has no features, or a feature set other than the model's; if the log
    has no intact part; if the labels cannot be written. Raise `ModelError` if the file of the model
    is missing or damaged, or holds another model.
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
    with TemporaryDirectory(prefix="hearthlog") as folder:
        try:
            return _label(job, job.log, before)
        except UnreadableError:
            copy, loss = recover_copy(job.log, Path(folder))
        try:
            layer, _ = _label(job, copy, {})
        except UnreadableError as error:
            raise LogError(str(error).replace(str(copy), str(job.log))) from error
        return layer._replace(metadata=layer.metadata._replace(loss=loss)), {}


@lru_cache(2)
def _loaded(path: Path, sha256: str) -> tuple[Model, Classifier]:
    model = load_model(path)
    if model.sha256 != sha256:
        raise ModelError(f"{path}: is another model here ({model.sha256[:12]}, not {sha256[:12]})")
    return model, Classifier(model)


def _label(job: Job, log: Path, before: _Labellers) -> tuple[UnfinishedLayer, _Labellers]:
    """Label a log, or its saved copy, with the labellers from the end of the previous log."""
    model, classifier = _loaded(job.model, job.model_sha256)
    infos, left_out = infos_for_model(log, model, job.log)
    labellers = {
        info.microphone: _labeller_at(job, info, before.get(info.microphone), classifier)
        for info in infos
    }
    open_at_start = _open_runs(labellers)
    if job.continues_layer:  # which has counted their earlier frames
        for name in open_at_start:
            labellers[name].discard_open()
    part = job.layer.with_name(f".{job.layer.name}.{os.urandom(8).hex()}.part")
    frames = _write_labels(part, job, infos, labellers)
    undecided = False
    for info in infos:
        labeller, continues = labellers[info.microphone], None
        if job.next_log is not None:
            continues = continues_in(labeller, info, job.next_log)
            undecided |= continues is None
        if not continues:
            labeller.close()
    metadata = LayerMetadata(
        model=model.name,
        model_sha256=model.sha256,
        input_sha256=log_digest(job.log),
        before=stem(job.earlier[0]) if job.earlier else "",
        behind="" if job.next_log is None or undecided else stem(job.next_log),
        open_at_start={} if job.continues_layer else open_at_start,
        open_at_end=_open_runs(labellers),
        loss="" if infos[0].complete else "it is cut off",
    )
    layer = UnfinishedLayer(
        part=part,
        metadata=metadata,
        node=infos[0].node,
        provenance=infos[0].metadata,
        segments={name: each.segments for name, each in labellers.items()},
        frames=frames,
        lacks_start=list(open_at_start) if job.continues_layer else (),
        left_out=left_out,
        lacks_embeddings=any(classifier.lacking_embeddings(info.embedding) for info in infos),
    )
    return layer, labellers


def _labeller_at(
    job: Job, info: RecorderInfo, before: StreamLabeller | None, classifier: Classifier
) -> StreamLabeller:
    """Return the labeller from the end of the previous log, or one that gives the same labels."""
    if before is not None and info.first_frame and before.is_followed_by(info.first_frame):
        before.segments = []  # drop those of the previous log
        return before
    return warm_up(info, job.earlier, classifier, states_only=job.continues_layer)


def _open_runs(labellers: _Labellers) -> OpenRuns:
    runs = {name: labeller.open_run for name, labeller in labellers.items()}
    return {name: run for name, run in runs.items() if run is not None}


def _write_labels(
    part: Path, job: Job, infos: Sequence[RecorderInfo], labellers: _Labellers
) -> dict[str, int]:
    """Write the labels of a log to a new file; return their number by microphone."""
    frames = dict.fromkeys(labellers, 0)
    try:
        with part.open("xb") as out:
            for info in infos:
                labeller = labellers[info.microphone]
                for event in read_sound(info, 0, auxiliary=labeller.takes_auxiliary):
                    labels = labeller.push(event)
                    if labels is not None:
                        out.write(_rows_of(labels).tobytes())
                        frames[info.microphone] += len(labels.frames)
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise LogError(f"{job.layer}: cannot be written ({error.strerror})") from error
        raise
    return frames


def _rows_of(labels: FrameLabels) -> NDArray[np.void]:
    rows = np.empty(len(labels.frames), _row_type(len(labels.classes)))
    for name in rows.dtype.names or ():
        rows[name] = getattr(labels, name)
    return rows


def _row_type(classes: int) -> np.dtype[np.void]:
    """Return the row type of a label in the part file."""
    times = [(name, np.int64) for name in ("frames", "stamps", "decided_at")]
    return np.dtype([*times, ("probabilities", np.float32, (classes,)), ("novelty", np.float32)])


def complete_layer(job: Job, labelled: UnfinishedLayer) -> None:
    """Append the segments to the labels and rename the file to the layer.

    The layer must not lack starts; its file `part` is deleted once it is complete. Raise `LogError`
    if the layer cannot be written, or there is another one that may not be replaced; `ModelError`
    if the file of the model is missing or damaged, or holds another model.
    """
    model, classifier = _loaded(job.model, job.model_sha256)
    metadata, smoothing = labelled.metadata, model.description.smoothing
    record = provenance(
        labelled.node,
        log=job.log.name,
        feature_set=model.description.feature_set,
        method=f"{smoothing.method}, lag {smoothing.lag_seconds:g} s",
        **{name: getattr(metadata, name) for name in _INPUTS},
        began=_runs_text(metadata.open_at_start),
        ended=_runs_text(metadata.open_at_end),
        lost=metadata.loss,
        made=_now(),
    )
    topics = {name: layer_topics(name, model.name, classifier.classes) for name in labelled.frames}
    put = replaced_file if job.replaces else new_file
    try:
        with put(job.layer, readers=readers_of(job.log)) as temporary, temporary.open("xb") as out:
            writer = LogStreamWriter(out, list(chain.from_iterable(topics.values())), _CHUNK_SPAN)
            for batch in _in_pieces(_batches(labelled, topics, classifier.classes)):
                writer.write_columns(batch)
            writer.add_metadata(HEARTHLOG_METADATA, record)
            writer.end(job.layer.name)
    except LogError:
        if read_layer_metadata(job.layer) != metadata:  # otherwise another run was quicker
            raise
    labelled.delete()


def delete_remains(layers: Iterable[Path]) -> None:
    """Delete the files that killed workers left of complete layers.

    Each folder is listed once, since a store answers each request after some time.
    """
    names = {(layer.parent, layer.name) for layer in layers}
    for folder in {folder for folder, _ in names}:
        with suppress(LogError), store_errors(folder):
            for path in folder.glob(".*"):
                name, _, suffix = path.name.removeprefix(".").rpartition(".")
                if suffix in {"part", "tmp"} and (folder, name.rpartition(".")[0]) in names:
                    with suppress(OSError):
                        path.unlink()


def _batches(
    labelled: UnfinishedLayer, topics: Mapping[str, tuple[Topic, Topic]], classes: Sequence[str]
) -> list[TopicBatch]:
    """Return the labels of each microphone, from the part file, and then the segments."""
    stored, first = labelled.part.read_bytes(), 0
    labels, segments = [], []
    for name, (label, segment) in topics.items():
        rows = np.frombuffer(stored, _row_type(len(classes)), labelled.frames[name], first)
        first += rows.nbytes
        rows = rows[rows["decided_at"].argsort(kind="stable")]  # a sound card's time may jump back
        fields = label_columns(rows, classes, name)
        labels.append(TopicBatch(label.name, rows["decided_at"].copy(), fields))
        own = labelled.segments[name]
        times = np.array([each.decided_at for each in own], np.int64)
        segments.append(TopicBatch(segment.name, times, segment_columns(own, classes, name)))
    return [*labels, *segments]


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
