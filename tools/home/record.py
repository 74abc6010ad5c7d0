"""A composed home as its recorder leaves it: sound, or logs without any."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import soundfile

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import OK, SourceHealth
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream.messages import EncodedMessage, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.arrays import Int16
from hearthlog.schemas.frames import FRAME_NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.progress import Progress, ignore_progress
from hearthlog.tools.home.composition import Composition

_PUSHED_FRAMES = 200  # as `FileSource` yields them, with a report of health before
_COMPUTED_FRAMES = 12_000  # 10 minutes


def record_composition(
    composition: Composition,
    settings: Settings,
    start: int,
    device: str = "simulated home",
    progress: Progress = ignore_progress,
) -> list[Path]:
    """Write the logs that a recorder would leave of a home, without composing most of its sound.

    Parameters
    ----------
    composition : Composition
    settings : Settings
        Its model labels the sound; clips are not kept.
    start : int
        Time of the first sample, in nanoseconds of UTC.
    device : str
        Name of the source of sound in the logs.
    progress : callable
        Told the share that is done.

    Returns
    -------
    list of Path
        The logs.

    Raises
    ------
    ModelError
        If the model cannot be used.
    LogError
        If a log exists, or cannot be written.
    """
    model = None if settings.model is None else load_model(settings.model)
    classifier = None if model is None else Classifier(model)
    features = DEFAULT if classifier is None else classifier.feature_set
    microphone = settings.microphone[0].name
    pipeline = Pipeline(microphone, features, classifier, settings.statistics_every)
    info = stream_info(microphone, device, features, model)
    log = RollingLog(
        describe_log(settings, info, features, model),
        settings.max_bag_duration,
        settings.flush_seconds,
        settings.sync_seconds,
    )
    for messages in _messages(composition, pipeline, start, device, progress):
        log.write(messages)
    log.finish(pipeline.finish())
    return log.finished


def write_sound(
    composition: Composition,
    path: Path,
    first: int,
    frames: int,
    progress: Progress = ignore_progress,
) -> None:
    """Write some of a composition as a FLAC file, 16 kHz mono.

    Parameters
    ----------
    composition : Composition
    path : Path
        Must not exist.
    first, frames : int
        Number of the first frame, and how many.
    progress : callable
        Told the share that is done.

    Raises
    ------
    OSError
        If the file exists or cannot be written.
    LibsndfileError
        If it cannot be encoded.
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
    """Yield what the pipeline makes of the features, and of the health of a source of sound."""
    stream, frames = composition.features(pipeline.feature_set), composition.plan.frames
    for block in range(0, frames, _COMPUTED_FRAMES):
        values = stream(block, min(_COMPUTED_FRAMES, frames - block))
        for offset in range(0, len(values), _PUSHED_FRAMES):
            part, first = values[offset : offset + _PUSHED_FRAMES], block + offset
            stamps = start + np.arange(first, first + len(part)) * FRAME_NANOSECONDS
            yield pipeline.push(SourceHealth(int(stamps[0]), OK, "reading", {"device": device}))
            yield pipeline.push_features(part, first, stamps)
        progress((block + len(values)) / frames)
