"""The features of one microphone on their way through a model, a log or many at a time."""

from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.replay.recorded import Features
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.labels.segments import Run, Segment, Segmenter
from hearthlog.recorder.events import Gap
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS
from hearthlog.schemas.logs.log_stream import TopicBatch
from hearthlog.schemas.times import NANOSECONDS

_STEP = NANOSECONDS // 5  # what the line through a sound card's times may jump by


class Labels(NamedTuple):
    """What a model says of successive frames.

    Attributes
    ----------
    classes : tuple of str
    frames, stamps : np.ndarray [shape=(n,)], int64
    probabilities : np.ndarray [shape=(n, C)], float32
    novelty : np.ndarray [shape=(n,)], float32
    """

    classes: tuple[str, ...]
    frames: Int64
    stamps: Int64
    probabilities: Float32
    novelty: Float32

    def rows(self, topic: str, microphone: str) -> TopicBatch:
        """Make messages of them, as a recorder would."""
        best = self.probabilities.argmax(axis=1)
        fields = {
            "header.stamp": self.stamps,
            "header.frame_id": microphone,
            "frame": self.frames,
            "label": np.array(self.classes, object)[best],
            "confidence": self.probabilities[np.arange(len(best)), best],
            "novelty": self.novelty,
            "probabilities": self.probabilities,
        }
        return TopicBatch(topic, self.stamps, fields)


class Stream:
    """What was heard, in the order of time.

    Parameters
    ----------
    classifier : Classifier

    Attributes
    ----------
    segments : list of Segment
        Those that have ended.
    """

    def __init__(self, classifier: Classifier) -> None:
        self.segments: list[Segment] = []
        self._classifier = classifier
        self._inputs = classifier.inputs.stream()
        self._segmenter = Segmenter(classifier.smoothing, classifier.transitions, FRAME_SECONDS)
        self._next: int | None = None  # number of the frame that follows
        self._end = 0  # of the last frame
        self._from_start = False  # of the sound, or from a gap on

    @property
    def sure(self) -> bool:
        """Whether sound before the first frame would leave no trace in the states to come."""
        return self._from_start or self._segmenter.sure

    @property
    def settled(self) -> bool:
        """Whether it would leave none in the segments either."""
        return self._from_start or self._segmenter.settled

    @property
    def open(self) -> Run | None:
        """The segment that has not ended."""
        return self._segmenter.open

    def forget(self) -> None:
        """Count no frame of the segment that is open."""
        self._segmenter.forget()

    def is_followed_by(self, first: tuple[int, int]) -> bool:
        """Tell whether the sound goes on with a frame of some number and time."""
        return first[0] == self._next and abs(first[1] - self._end) <= _STEP

    def push(self, event: Features | Gap) -> Labels | None:
        """Go on; return the labels of the frames, if the event has some."""
        if isinstance(event, Gap):
            self.close()
            return None
        if self._next is not None and not self.is_followed_by((event.first, int(event.stamps[0]))):
            self.close()
        self._from_start |= event.first == 0
        count = len(event.stamps)
        inputs = self._inputs(event.values)
        self._next, self._end = event.first + count, int(event.stamps[-1]) + FRAME_NANOSECONDS
        heard = slice(count - len(inputs), None)  # labels are of a whole window
        probabilities, novelty = self._classifier.classify(inputs)
        frames, stamps = np.arange(event.first, event.first + count)[heard], event.stamps[heard]
        if len(inputs):
            self.segments += self._segmenter.push(probabilities, stamps)
        return Labels(self._classifier.classes, frames, stamps, probabilities, novelty)

    def close(self) -> None:
        """End what is open where the last frame ends; what comes next begins anew."""
        self.segments += self._segmenter.close(self._end)
        self._inputs.restart()
        self._next = None
        self._from_start = True
