"""A composed home as its recorder leaves it: sound, or logs without any."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import soundfile

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.embedding.networks import Embedder, load_embedder
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.embedder_probe import network_path
from hearthlog.recorder.events import OK, Frames, SourceHealth
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream.messages import EncodedMessage, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.arrays import Int16
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, SAMPLE_RATE
from hearthlog.tools.home.composition import Composition, full_scale

_PUSHED_FRAMES = 200  # as `FileSource` yields them, with a report of health before
_COMPUTED_FRAMES = 12_000  # 10 minutes


def record_composition(
    composition: Composition,
    settings: Settings,
    start: int,
    device: str = "simulated home",
    progress: Progress = ignore_progress,
) -> list[Path]:
    """Write the logs that a recorder would leave of a home.

    Only for a model that takes embeddings all of the sound is composed; for others, most of it is
    not.

    Parameters
    ----------
    settings : Settings
        Its model labels the sound, by embeddings of its network if it takes any; clips are not
        kept.
    start : int
        Time of the first sample, in nanoseconds of UTC.

    Raises
    ------
    ModelError
        If the model cannot be used, or the network of its embeddings is not there.
    LogError
        If a log exists, or cannot be written.
    """
    model = None if settings.model is None else load_model(settings.model)
    classifier = None if model is None else Classifier(model)
    features = DEFAULT if classifier is None else classifier.feature_set
    microphone = settings.microphone[0].name
    embedder = embedder_of(model)
    pipeline = Pipeline(
        microphone, features, classifier, settings.statistics_every, embedder=embedder
    )
    info = stream_info(microphone, device, features, model)
    log = RollingLog(
        describe_log(settings, info, features, model, embedding=pipeline.embedding),
        settings.max_bag_duration,
        settings.flush_seconds,
        settings.sync_seconds,
    )
    for messages in _messages(composition, pipeline, start, device, progress):
        log.write(messages)
    log.finish(pipeline.finish())
    return log.finished


def embedder_of(model: Model | None) -> Embedder | None:
    """Load the network of the embeddings that a model takes, if it takes any.

    Raise `ModelError` if it is not there, or cannot be used.
    """
    space = None if model is None else model.description.embedding_space
    return None if space is None else load_embedder(space.network, network_path(space.network))


def write_sound(
    composition: Composition,
    path: Path,
    first: int,
    frames: int,
    progress: Progress = ignore_progress,
) -> None:
    """Write some of a composition as a FLAC file, 16 kHz mono.

    Raise `OSError` if the file exists or cannot be written. Raise `LibsndfileError` if it
    cannot be encoded.
    """
    with (
        path.open("xb") as file,
        soundfile.SoundFile(file, "w", SAMPLE_RATE, 1, "PCM_16", format="FLAC") as audio,
    ):
        for number, samples in _blocks(composition, first, frames):
            audio.write(samples.ravel())
            progress((number - first + len(samples)) / frames)


def _blocks(composition: Composition, first: int, frames: int) -> Iterator[tuple[int, Int16]]:
    for number in range(first, first + frames, _PUSHED_FRAMES):
        yield number, composition.samples(number, min(_PUSHED_FRAMES, first + frames - number))


def _messages(
    composition: Composition, pipeline: Pipeline, start: int, device: str, progress: Progress
) -> Iterator[list[EncodedMessage]]:
    """Yield what the pipeline makes of the sound, and of the health of its source."""
    frames = composition.plan.frames
    if pipeline.embedding is not None:
        for first, samples in _blocks(composition, 0, frames):
            stamps = start + np.arange(first, first + len(samples)) * FRAME_NANOSECONDS
            yield pipeline.push(SourceHealth(int(stamps[0]), OK, "reading", {"device": device}))
            yield pipeline.push(Frames(first, full_scale(samples), stamps))
            progress((first + len(samples)) / frames)
        return
    stream = composition.features(pipeline.feature_set)
    for block in range(0, frames, _COMPUTED_FRAMES):
        values = stream(block, min(_COMPUTED_FRAMES, frames - block))
        for offset in range(0, len(values), _PUSHED_FRAMES):
            part, first = values[offset : offset + _PUSHED_FRAMES], block + offset
            stamps = start + np.arange(first, first + len(part)) * FRAME_NANOSECONDS
            yield pipeline.push(SourceHealth(int(stamps[0]), OK, "reading", {"device": device}))
            yield pipeline.push_features(part, first, stamps)
        progress((block + len(values)) / frames)
