"""The task of a worker: the labels and segments of one log."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.recorder_info import Origin
from hearthlog.analyzer.relabel.layer import (
    About,
    Source,
    delete_parts,
    digest,
    metadata_of,
    part_path,
    read_about,
    topics_of,
)
from hearthlog.analyzer.relabel.reading import (
    UnreadableError,
    heard,
    is_followed,
    origin_of,
    recovered,
    warmed_up,
)
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.errors import ModelError
from hearthlog.models.labels.segments import Run, Segment
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import stem
from hearthlog.schemas.logs.log_stream import LogStreamWriter, TopicBatch
from hearthlog.schemas.logs.provenance import METADATA
from hearthlog.schemas.messages.cdr_codec import Column
from hearthlog.schemas.storage.new_files import new_file, replaced_file


class Job(NamedTuple):
    """A log to label.

    Attributes
    ----------
    log, layer : Path
    before : tuple of Path
        Logs before it, the last first.
    behind : Path or None
        The log behind it.
    model : Path
    model_sha256 : str
    replaces : bool
        Whether there is a layer that may be replaced.
    carried : bool
        Whether what is open when the log begins is known from the layer before.
    """

    log: Path
    layer: Path
    before: tuple[Path, ...]
    behind: Path | None
    model: Path
    model_sha256: str
    replaces: bool
    carried: bool


class Labelled(NamedTuple):
    """A log that is labelled, its layer not yet complete.

    Attributes
    ----------
    part : Path
        The beginning of the layer.
    content : LogStreamWriter
        That has written it.
    source : Source
    microphone, node : str
    provenance : mapping of str to str
        What the log says of what made it.
    segments : list of Segment
    began : Run or None
        What was open when the log began.
    begins : bool
        That is known from the layer before, and neither counted here nor in `began`.
    ended : Run or None
        What is open when the log ends, and goes on in the log behind.
    frames : int
    lost : str
        What of the log could not be read.
    """

    part: Path
    content: LogStreamWriter
    source: Source
    microphone: str
    node: str
    provenance: Mapping[str, str]
    segments: list[Segment]
    began: Run | None
    begins: bool
    ended: Run | None
    frames: int
    lost: str

    def joined(self, began: Run | None) -> "Labelled":
        """Put what the layer before has counted before what began there."""
        if not self.begins:
            return self
        segments, ended = list(self.segments), self.ended
        if segments:
            segments[0] = segments[0]._replace(run=segments[0].run.behind(began))
        elif ended is not None:
            ended = ended.behind(began)
        return self._replace(segments=segments, began=began, begins=False, ended=ended)


def label_log(job: Job) -> Labelled:
    """Write the labels of a log, and find its segments.

    What is whole in a damaged log is labelled.

    Raises
    ------
    LogError
        If the log has no features, or of another set than the model, or nothing of it is whole;
        if the labels cannot be written.
    ModelError
        If the model is not the one that was asked for.
    """
    model, classifier = _loaded(job.model, job.model_sha256)
    with TemporaryDirectory(prefix="hearthlog") as folder:
        try:
            return _label(job, job.log, model, classifier)
        except UnreadableError:
            copy, lost = recovered(job.log, Path(folder))
        try:
            return _label(job, copy, model, classifier)._replace(lost=lost)
        except UnreadableError as error:
            raise LogError(str(error).replace(str(copy), str(job.log))) from error


@lru_cache(2)
def _loaded(path: Path, sha256: str) -> tuple[Model, Classifier]:
    model = load_model(path)
    if model.sha256 != sha256:
        raise ModelError(f"{path}: is another model here ({model.sha256[:12]}, not {sha256[:12]})")
    return model, Classifier(model)


def _label(job: Job, log: Path, model: Model, classifier: Classifier) -> Labelled:
    """Label a log, or what was saved of it."""
    origin = _origin(log, job.log, model)
    stream = warmed_up(origin, job.before, classifier, states_only=job.carried)
    began = stream.open
    begins = job.carried and began is not None
    if begins:
        stream.forget()
    topics = topics_of(origin.microphone, model.name, classifier.classes)
    part = part_path(job.layer)
    try:
        with part.open("xb") as out:
            content = LogStreamWriter(out, topics)
            frames = 0
            for event in heard(origin, 0):
                labels = stream.push(event)
                if labels is not None:
                    content.write_columns([labels.rows(topics[0].name, origin.microphone)])
                    frames += len(labels.stamps)
            content.flush()
    except BaseException as error:
        with suppress(OSError):
            part.unlink()
        if isinstance(error, OSError):
            raise LogError(f"{job.layer}: cannot be written ({error.strerror})") from error
        raise
    followed = None if job.behind is None else is_followed(stream, origin, job.behind)
    if not followed:
        stream.close()
    before = stem(job.before[0]) if job.before else ""
    behind = "" if job.behind is None or followed is None else stem(job.behind)
    return Labelled(
        part=part,
        content=content,
        source=Source(model.name, model.sha256, digest(job.log), before, behind),
        microphone=origin.microphone,
        node=origin.node,
        provenance=origin.metadata,
        segments=stream.segments,
        began=None if begins else began,
        begins=begins,
        ended=stream.open,
        frames=frames,
        lost="" if origin.complete else "it is cut off",
    )


def _origin(path: Path, log: Path, model: Model) -> Origin:
    """Read what a log says of itself, and compare it with what the model is for."""
    origin = origin_of(path)
    if origin is None or origin.first_frame is None:
        raise LogError(f"{log}: has no features; there is nothing to label")
    if origin.feature_set not in {"", model.description.feature_set}:
        raise LogError(
            f"{log}: has features of set {origin.feature_set!r}; model {model.name} is for "
            f"{model.description.feature_set}"
        )
    return origin


def complete_layer(job: Job, labelled: Labelled) -> None:
    """Put the segments behind the labels, and give the layer its name.

    Parameters
    ----------
    job : Job
    labelled : Labelled
        With all that its segments have in the logs before.

    Raises
    ------
    LogError
        If it cannot be written, or there is another one that may not be replaced.
    """
    model, classifier = _loaded(job.model, job.model_sha256)
    about = About(labelled.source, labelled.began, labelled.ended, labelled.lost)
    smoothing = model.description.smoothing
    more = {
        "feature_set": model.description.feature_set,
        "method": f"{smoothing.method}, lag {smoothing.lag_seconds:g} s",
    }
    topics = topics_of(labelled.microphone, model.name, classifier.classes)
    put = replaced_file if job.replaces else new_file
    try:
        with put(job.layer) as temporary, temporary.open("xb") as out:
            with labelled.part.open("rb") as stream:
                shutil.copyfileobj(stream, out, 1 << 20)
            content = labelled.content
            content.continue_on(out)
            content.write_columns([_rows(topics[1].name, labelled, classifier.classes)])
            content.add_metadata(METADATA, metadata_of(about, job.log.name, labelled.node, more))
            content.finish(job.layer.name)
    except LogError:
        if read_about(job.layer) != about:  # or else another run was quicker
            labelled.part.unlink(missing_ok=True)
            raise
    delete_parts(job.layer)


def _rows(topic: str, labelled: Labelled, classes: Sequence[str]) -> TopicBatch:
    """Make messages of segments."""
    segments = labelled.segments
    starts = np.array([segment.start for segment in segments], np.int64)
    ends = np.array([segment.end for segment in segments], np.int64)
    fields: dict[str, Column] = {
        "header.stamp": starts,
        "header.frame_id": labelled.microphone,
        "duration": ends - starts,
        "label": [classes[segment.label] for segment in segments],
        "confidence": np.array([segment.confidence for segment in segments], np.float32),
    }
    return TopicBatch(topic, np.array([segment.known for segment in segments], np.int64), fields)
