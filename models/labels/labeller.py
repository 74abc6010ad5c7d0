"""From the features of one stream to labels and segments."""

from typing import NamedTuple

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.labels.segments import Segment, Segmenter
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_SECONDS


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


class Labeller:
    """Labels one stream of frames.

    Parameters
    ----------
    classifier : Classifier

    Attributes
    ----------
    classes : tuple of str
    segmenter : Segmenter
    """

    def __init__(self, classifier: Classifier) -> None:
        self.classes = classifier.classes
        self.segmenter = Segmenter(classifier.smoothing, classifier.transitions, FRAME_SECONDS)
        self._classifier = classifier
        self._inputs = classifier.inputs.stream()

    def fill_window(self, features: Float32) -> None:
        """Put the features of successive frames into the window, and label none of them."""
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
        """Return the remaining segments of a sound that ends at `end`, and begin anew."""
        self._inputs.restart()
        return self.segmenter.close(end)
