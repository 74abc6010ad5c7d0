"""From the features of one stream to labels and segments, and to columns of their messages."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.labels.segments import Segment, Segmenter
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.schemas.messages.cdr_codec import Column


class FrameLabels(NamedTuple):
    """What a classifier says of successive frames, each by the window that ends with it.

    Attributes
    ----------
    classes : tuple of str
        Names behind the columns of the probabilities.
    frames : np.ndarray [shape=(n,)], int64
        Numbers of the frames.
    stamps : np.ndarray [shape=(n,)], int64
        Starts of the frames in nanoseconds of UTC.
    probabilities : np.ndarray [shape=(n, C)], float32
    novelty : np.ndarray [shape=(n,)], float32
        From 0 to 1; NaN where the classifier has none.
    """

    classes: tuple[str, ...]
    frames: Int64
    stamps: Int64
    probabilities: Float32
    novelty: Float32

    def columns(self, microphone: str) -> dict[str, Column]:
        """Return the fields of one `AudioLabel` for each frame.

        Parameters
        ----------
        microphone : str
            Its name.

        Returns
        -------
        dict of str to column
            By field path, as `encode_groups` takes them.
        """
        best = self.probabilities.argmax(axis=1)
        return {
            "header.stamp": self.stamps,
            "header.frame_id": microphone,
            "frame": self.frames,
            "label": np.array(self.classes, object)[best],
            "confidence": self.probabilities[np.arange(len(best)), best],
            "novelty": self.novelty,
            "probabilities": self.probabilities,
        }


class Labeller:
    """Labels one stream of frames, and divides it into segments.

    Parameters
    ----------
    classifier : Classifier

    Attributes
    ----------
    classes : tuple of str
        Names behind the columns of the probabilities.
    segmenter : Segmenter
    """

    def __init__(self, classifier: Classifier) -> None:
        self.classes = classifier.classes
        self.segmenter = Segmenter(classifier.smoothing, classifier.transitions, FRAME_SECONDS)
        self._classifier = classifier
        self._inputs = classifier.inputs.stream()

    def fill_window(self, features: Float32) -> None:
        """Put the features of successive frames into the window, and label none of them.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        """
        self._inputs(features)

    def push(
        self, features: Float32, first: int, stamps: Int64
    ) -> tuple[FrameLabels, list[Segment]]:
        """Add successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        first : int
            Number of the first frame.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.

        Returns
        -------
        labels : FrameLabels
            Of the last frames: those at which a whole window is complete.
        segments : list of Segment
            Those whose end these frames decide.
        """
        inputs = self._inputs(features)
        labelled = slice(len(features) - len(inputs), None)
        probabilities, novelty = self._classifier.classify(inputs)
        frames, stamps = np.arange(first, first + len(features))[labelled], stamps[labelled]
        segments = self.segmenter.push(probabilities, stamps) if len(inputs) else []
        return FrameLabels(self.classes, frames, stamps, probabilities, novelty), segments

    def close(self, end: int) -> list[Segment]:
        """Return the remaining segments of a sound that ends, and begin anew.

        Parameters
        ----------
        end : int
            End of the sound, in nanoseconds of UTC.

        Returns
        -------
        list of Segment
            In the order of time.
        """
        self._inputs.restart()
        return self.segmenter.close(end)


def segment_columns(
    segments: Sequence[Segment], classes: Sequence[str], microphone: str
) -> dict[str, Column]:
    """Return the fields of one `AudioSegment` for each segment.

    Parameters
    ----------
    segments : sequence of Segment
    classes : sequence of str
        Names behind the labels of the segments.
    microphone : str
        Its name.

    Returns
    -------
    dict of str to column
        By field path, as `encode_groups` takes them.
    """
    starts = np.array([segment.start for segment in segments], np.int64)
    ends = np.array([segment.end for segment in segments], np.int64)
    return {
        "header.stamp": starts,
        "header.frame_id": microphone,
        "duration": ends - starts,
        "label": [classes[segment.label] for segment in segments],
        "confidence": np.array([segment.confidence for segment in segments], np.float32),
    }
