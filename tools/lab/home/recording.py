"""Logs of a simulated home, most of them without composing its sound."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.embedding.networks import Embedder, load_embedder
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import OK, Frames, SourceHealth
from hearthlog.recorder.labelling.embedder_probe import network_path
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream import EncodedMessage, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.arrays import Bool, Float32, Int16
from hearthlog.schemas.errors import Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.tools.home.composition import PERIOD_FRAMES, Composition, audible_until, quantised
from hearthlog.tools.home.simulate import BLOCK_FRAMES, blocks_of

_COMPUTED_FRAMES = 12_000  # 10 minutes
_FRAMES_AT_ONCE = 384


def record_composition(
    composition: Composition,
    settings: Settings,
    start: int,
    device: str = "simulated home",
    progress: Progress = ignore_progress,
) -> list[Path]:
    """Write the logs of a simulated home as a recorder would, from a time in nanoseconds of UTC.

    The complete sound is composed only for a model that uses embeddings; for other models most of
    it is not. The model of the settings labels the sound; clips are not kept. Raise `ModelError` if
    the model cannot be used, or its embedding network is missing, `LogError` if a log exists, or
    cannot be written.
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
    """Load the embedding network of a model; None if the model uses none.

    Raise `ModelError` if the network is missing or cannot be used.
    """
    space = None if model is None else model.description.embedding_space
    return None if space is None else load_embedder(space.network, network_path(space.network))


def _messages(
    composition: Composition, pipeline: Pipeline, start: int, device: str, progress: Progress
) -> Iterator[list[EncodedMessage]]:
    """Yield the pipeline's messages for the sound, and the health of its source."""
    frames = composition.plan.frames
    if pipeline.embedding is not None:
        for first, samples in blocks_of(composition, 0, frames):
            stamps = start + np.arange(first, first + len(samples)) * FRAME_NANOSECONDS
            yield pipeline.push(SourceHealth(int(stamps[0]), OK, "reading", {"device": device}))
            yield pipeline.push(Frames(first, full_scale(samples), stamps))
            progress((first + len(samples)) / frames)
        return
    stream = FeatureStream(composition, pipeline.feature_set)
    for block in range(0, frames, _COMPUTED_FRAMES):
        values = stream(block, min(_COMPUTED_FRAMES, frames - block))
        for offset in range(0, len(values), BLOCK_FRAMES):
            part, first = values[offset : offset + BLOCK_FRAMES], block + offset
            stamps = start + np.arange(first, first + len(part)) * FRAME_NANOSECONDS
            yield pipeline.push(SourceHealth(int(stamps[0]), OK, "reading", {"device": device}))
            yield pipeline.push_features(part, first, stamps)
        progress((block + len(values)) / frames)


class FeatureStream:
    """The features of a composition, in the order of the frames.

    Features are looked up if a frame and its predecessor contain only steady noise, whose features
    are periodic. Other frames are composed and their features computed. A frame's features must
    depend only on the frame and its predecessor.
    """

    def __init__(self, composition: Composition, features: FeatureSet) -> None:
        self._composition = composition
        self._features = features
        self._extractor = features.extractor()
        self._tables: dict[tuple[str, ...], Float32] = {}

    def __call__(self, first: int, count: int) -> Float32:
        """Return features [shape=(count, d)], bit-identical to the features of the samples."""
        before = 1 if first else 0
        busy = busy_frames(self._composition, first - before, count + before)
        computed = busy[before:].copy()
        computed |= busy[:-1] if before else np.concatenate([[True], busy[:-1]])
        values = np.empty((count, self._features.width), np.float32)
        for begin, end in _runs(computed):
            values[begin:end] = self._compute(first + begin, first + end)
        for begin, end in _runs(~computed):
            table = self._table(_state(self._composition, first + begin))
            values[begin:end] = table[np.arange(first + begin, first + end) % PERIOD_FRAMES]
        return values

    def _compute(self, begin: int, end: int) -> Float32:
        self._extractor.restart()
        blocks = []
        before = 1 if begin else 0
        for start in range(begin - before, end, _FRAMES_AT_ONCE):
            count = min(_FRAMES_AT_ONCE, end - start)
            blocks.append(self._extractor(full_scale(self._composition.samples(start, count))))
        return np.concatenate(blocks)[before:]

    def _table(self, state: tuple[str, ...]) -> Float32:
        """Return the features of one period of steady noise, each frame after its predecessor."""
        if state not in self._tables:
            noise = full_scale(_steady(self._composition, state))
            extractor = self._features.extractor()
            extractor(noise[-1:])
            self._tables[state] = extractor(noise)
        return self._tables[state]


def full_scale(samples: Int16) -> Float32:
    """Convert samples to floats as an audio file reader does."""
    return samples.astype(np.float32) / np.float32(32768.0)


def _runs(flags: Bool) -> list[tuple[int, int]]:
    """Return the starts and ends of runs of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.view(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def busy_frames(composition: Composition, first: int, count: int) -> Bool:
    """Return which frames contain more than periodic noise [shape=(count,)]."""
    busy = np.zeros(count, bool)
    for sound in composition.sounds(first, first + count):
        busy[max(sound.start - first, 0) : max(audible_until(sound) - first, 0)] = True
    for gains in composition.gains(first, count).values():
        busy |= (gains[:-1] != gains[1:]) | ~np.isin(gains[1:], (0.0, 1.0))
    return busy


def _state(composition: Composition, frame: int) -> tuple[str, ...]:
    """Return the names of the active steady noises in a frame."""
    return tuple(name for name, gains in composition.gains(frame, 1).items() if gains[1] > 0.0)


def _steady(composition: Composition, state: tuple[str, ...]) -> Int16:
    """Compose a period of steady noise alone [shape=(PERIOD_FRAMES, FRAME_SAMPLES)]."""
    mix = composition.rooms.floor.copy()
    for name in state:
        mix += composition.rooms.steady[name]
    return quantised(mix)
