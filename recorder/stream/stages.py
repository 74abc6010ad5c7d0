"""Stages of the pipeline: statistics, embeddings, directions and labels, and their messages."""

from collections.abc import Mapping

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import Auxiliary, Directions
from hearthlog.models.embedding import WINDOW_FRAMES, Embeddings
from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.features import SILENCE_POWER, FeatureSet, mean_and_std
from hearthlog.models.features.floor import Floors, is_quiet
from hearthlog.models.labels import Segment
from hearthlog.models.labels.labeller import FrameLabels, labeller_of, segment_columns
from hearthlog.recorder.stream import EncodedMessage, column_messages, segment_line
from hearthlog.schemas.arrays import Bool, Float32, Indices, Int64
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column
from hearthlog.schemas.messages.topics import (
    LIVE,
    EmbeddingSource,
    labelling_topic,
    topic,
)


class RollingStatistics:
    """Statistics of one stream over its last frames.

    Every window is summed from its own frames, as running sums would drift over months.
    """

    def __init__(self, window_frames: int, width: int) -> None:
        self._length, self._width = window_frames, width
        self.restart()

    def restart(self) -> None:
        """Empty the window: the next frame does not follow the last one."""
        self._recent: Float32 = np.empty((0, self._width), np.float32)

    def __call__(self, features: Float32, places: Indices | None = None) -> tuple[Float32, Float32]:
        """Compute mean and standard deviation [shape=(m, d)] at some frames, by default all.

        `features` have [shape=(n, d)], `places` [shape=(m,)] are ascending indices from 0.
        Statistics are over the last window, or all frames since the start or the last restart if
        these are fewer; the deviation divides by the number of frames.
        """
        frames = np.concatenate([self._recent, features])
        places = np.arange(len(features)) if places is None else places
        begins = places + len(self._recent) + 1 - self._length
        filling = int(np.count_nonzero(begins < 0))
        mean, std = np.empty((2, len(places), self._width), np.float32)
        for row, begin in enumerate(begins[:filling].tolist()):
            first = [*frames[: begin + self._length, np.newaxis]]
            (mean[row],), (std[row],) = mean_and_std(first)
        windows = [frames[begins[filling:] + place] for place in range(self._length)]
        mean[filling:], std[filling:] = mean_and_std(windows)
        self._recent = frames[max(len(frames) - self._length + 1, 0) :].copy()
        return mean, std


class FeatureMessages:
    """Encodes the features of one stream of frames, and their rolling statistics."""

    def __init__(self, microphone: str, window_frames: int, width: int, every: int) -> None:
        self._microphone = microphone
        self._statistics = RollingStatistics(window_frames, width)
        self._every = every  # frames between messages of statistics

    def restart(self) -> None:
        """Empty the window: the next frame does not follow the last one."""
        self._statistics.restart()

    def __call__(self, features: Float32, first: int, stamps: Int64) -> list[EncodedMessage]:
        """Encode features [shape=(n, d)] of successive frames.

        `stamps` [shape=(n,)] are their starts in nanoseconds of UTC.
        """
        if not len(features):
            return []
        frames = np.arange(first, first + len(features))
        logged = np.flatnonzero(frames % self._every == 0)
        mean, std = self._statistics(features, logged)
        statistics = {"mean": mean, "std": std}
        return [
            *self._encode("features", frames, stamps, {"values": features}),
            *self._encode("statistics", frames[logged], stamps[logged], statistics),
        ]

    def _encode(
        self, kind: str, frames: Int64, stamps: Int64, arrays: Mapping[str, Float32]
    ) -> list[EncodedMessage]:
        columns: dict[str, Column] = {
            "header.stamp": stamps,
            "header.frame_id": self._microphone,
            "frame": frames,
            **arrays,
        }
        typename = message_types.FEATURES if kind == "features" else message_types.STATISTICS
        return column_messages(topic(self._microphone, kind), typename, stamps, columns)


_GATE, _GATE_FRAMES = 2.0, 8  # dB above the floor, and the window, as in the models


class MicrophoneEmbeddings:
    """Computes embeddings of sound above the noise floor."""

    def __init__(self, embedder: Embedder, features: FeatureSet) -> None:
        from hearthlog.models.embedding.networks import (  # noqa: PLC0415  only with a network
            EmbeddingStream,
        )

        self._feature_set = features
        self._stream = EmbeddingStream(embedder)
        self.restart()

    def restart(self) -> None:
        """Reset: the next frame does not follow the last one."""
        self._stream.restart()
        self._features = np.empty((0, self._feature_set.width), np.float32)

    def push(
        self, frames: Float32, features: Float32, floors: Floors | None, first: int, stamps: Int64
    ) -> Embeddings:
        """Add frames [shape=(n, FRAME_SAMPLES)] and their features [shape=(n, d)].

        `stamps` [shape=(n,)] are their starts in nanoseconds of UTC. `floors` are those at the last
        of these frames; None if the feature set has no bands.
        """
        recent = np.concatenate([self._features, features])
        sound = np.zeros(len(frames), bool)
        count = min(len(recent) - _GATE_FRAMES + 1, len(frames))  # frames that complete a window
        if count > 0:
            sound[-count:] = self._is_sound(recent[-count - _GATE_FRAMES + 1 :], floors)
        self._features = recent[1 - _GATE_FRAMES :].copy()
        return self._stream.push(frames, sound, first, stamps)

    def _is_sound(self, features: Float32, floors: Floors | None) -> Bool:
        """Return which windows are above the floor, or without a floor, above -60 dBFS."""
        count = len(features) - _GATE_FRAMES + 1
        powers_of = self._feature_set.band_powers
        if floors is None or powers_of is None:
            powers = self._feature_set.power(features).astype(np.float64)
            loud: Bool = np.convolve(powers > SILENCE_POWER, np.ones(_GATE_FRAMES), "valid") > 0
            return loud
        sound = np.zeros(count, bool)
        tracked = min(len(floors.room), count)
        if tracked:
            powers = powers_of(features[-tracked - _GATE_FRAMES + 1 :])
            sound[-tracked:] = ~is_quiet(powers, floors.room[-tracked:], _GATE_FRAMES, _GATE)
        return sound


def embedding_messages(
    microphone: str, embeddings: Embeddings, times: Int64
) -> list[EncodedMessage]:
    """Encode embeddings; `times` [shape=(m,)] are the log times.

    They are the starts of the last frames of the windows, in nanoseconds of UTC.
    """
    columns: dict[str, Column] = {
        "header.stamp": embeddings.stamps,
        "header.frame_id": microphone,
        "frame": embeddings.frames,
        "frames": np.full(len(times), WINDOW_FRAMES, np.uint32),
        "values": embeddings.values,
    }
    name = topic(microphone, "embedding")
    return column_messages(name, message_types.EMBEDDING, times, columns)


def direction_messages(
    microphone: str, directions: Directions, times: Int64
) -> list[EncodedMessage]:
    """Encode directions; `times` [shape=(m,)] are the log times.

    They are the starts of the last frames of the blocks, in nanoseconds of UTC.
    """
    columns: dict[str, Column] = {
        "header.stamp": directions.stamps,
        "header.frame_id": microphone,
        "frame": directions.frames,
        "azimuth": directions.azimuths,
        "confidence": directions.confidences,
    }
    name = topic(microphone, "direction")
    return column_messages(name, message_types.DIRECTION, times, columns)


class LabelStream:
    """Labels and segments of one model, named by `classes`, for one stream of frames.

    `labeller` follows another stream. `segments_converged`: sound before the first frame would no
    longer change the segments to come. `last` has the labels of the last push, if any.
    """

    def __init__(
        self,
        microphone: str,
        labelling: str,
        classifier: Classifier,
        embedding: EmbeddingSource | None = None,
    ) -> None:
        self.classes = classifier.classes
        self.by_names = classifier.names is not None
        self.segments_converged = False
        self.last: FrameLabels | None = None
        self._microphone = microphone
        self._labelling = labelling
        self.labeller = labeller_of(classifier, microphone, embedding)

    def push(
        self,
        features: Float32,
        floors: Floors | None,
        first: int,
        stamps: Int64,
        auxiliary: Auxiliary,
    ) -> list[EncodedMessage]:
        """Convert features [shape=(n, d)] of successive frames to messages.

        `stamps` [shape=(n,)] are their starts in nanoseconds of UTC.
        """
        self.last = None
        labels, segments = self.labeller.push(features, floors, first, stamps, auxiliary)
        if not len(labels.frames):
            return []
        self.last = labels
        self.segments_converged |= self.labeller.segments_converged
        columns = labels.columns(self._microphone)
        return [
            *self._segment_messages(segments),
            *self._messages("label", message_types.LABEL, labels.decided_at, columns),
        ]

    def close(self, end: int) -> list[EncodedMessage]:
        """End the segments at the end of the sound, in nanoseconds of UTC, and reset."""
        segments = self.labeller.close(end)
        self.segments_converged |= bool(segments)
        return self._segment_messages(segments)

    def _segment_messages(self, segments: list[Segment]) -> list[EncodedMessage]:
        times = np.array([segment.decided_at for segment in segments], np.int64)
        columns = segment_columns(segments, self.classes, self._microphone)
        encoded = self._messages("segment", message_types.SEGMENT, times, columns)
        if self._labelling != LIVE:
            return encoded
        messages = []
        for one, segment in zip(encoded, segments, strict=True):
            messages += [
                one,
                segment_line(self._microphone, segment, self.classes[segment.label]),
            ]
        return messages

    def _messages(
        self, kind: str, typename: str, log_times: Int64, columns: Mapping[str, Column]
    ) -> list[EncodedMessage]:
        name = labelling_topic(self._microphone, self._labelling, kind)
        return column_messages(name, typename, log_times, columns)
