"""Labels and segments of one model, as messages."""

from collections.abc import Mapping

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import Auxiliary
from hearthlog.models.features.floor import Floors
from hearthlog.models.labels.labeller import FrameLabels, segment_columns
from hearthlog.models.labels.names_labeller import labeller_of
from hearthlog.models.labels.segments import Segment
from hearthlog.recorder.stream import rosout
from hearthlog.recorder.stream.messages import EncodedMessage, encoded_messages
from hearthlog.schemas.arrays import Float32, Float64, Int64
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.topics import (
    LIVE,
    ROSOUT,
    EmbeddingSource,
    labelling_topic,
)


class LabelStream:
    """What one model says of a stream of frames.

    Attributes
    ----------
    classes : tuple of str
        Names behind the columns of the probabilities.
    segments_converged : bool
        Whether sound before the first frame would leave no trace in the segments to come.
    last : FrameLabels or None
        Labels of the frames that were pushed last; None if they have none.
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
        self._labeller = labeller_of(classifier, microphone, embedding)

    @property
    def delay(self) -> int:
        """Frames from one to that at which its label is known."""
        return self._labeller.timing.delay

    def follow(  # noqa: PLR0913, PLR0917
        self,
        features: Float32,
        floors: Float64 | None,
        stamps: Int64,
        frame: int,
        unlabelled: int,
        auxiliary: Auxiliary,
    ) -> None:
        """Take the place of another stream before a frame; as `Labeller.follow`.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
            Of the last frames before it.
        floors : np.ndarray [shape=(m, b)], float64, or None
        stamps : np.ndarray [shape=(n,)], int64
        auxiliary : Auxiliary
            Of the last second before it, or more.
        """
        self._labeller.follow(features, floors, stamps, frame, unlabelled, auxiliary)

    def push(
        self,
        features: Float32,
        floors: Floors | None,
        first: int,
        stamps: Int64,
        auxiliary: Auxiliary,
    ) -> list[EncodedMessage]:
        """Turn successive frames into messages.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
        """
        self.last = None
        labels, segments = self._labeller.push(features, floors, first, stamps, auxiliary)
        if not len(labels.frames):
            return []
        self.last = labels
        self.segments_converged |= self._labeller.segments_converged
        columns = labels.columns(self._microphone)
        return [
            *self._segment_messages(segments),
            *self._messages("label", message_types.LABEL, labels.known_at, columns),
        ]

    def close(self, end: int) -> list[EncodedMessage]:
        """End the segments of a sound; the next frame begins anew.

        Parameters
        ----------
        end : int
            End of the sound, in nanoseconds of UTC.
        """
        segments = self._labeller.close(end)
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
            line = rosout.segment_line(self._microphone, segment, self.classes[segment.label])
            messages += [one, EncodedMessage(segment.decided_at, ROSOUT, line)]
        return messages

    def _messages(
        self, kind: str, typename: str, log_times: Int64, columns: Mapping[str, Column]
    ) -> list[EncodedMessage]:
        name = labelling_topic(self._microphone, self._labelling, kind)
        rows = encode_rows(typename, columns, len(log_times)) if len(log_times) else []
        return encoded_messages(name, log_times, rows)
