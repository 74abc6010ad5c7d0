"""The features of one microphone, labelled log after log."""

from hearthlog.analyzer.replay.recorded import Features
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.floor import Floors, FloorTracker
from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.models.labels.names_labeller import labeller_of
from hearthlog.models.labels.segments import Segment, StateRun
from hearthlog.recorder.events import Gap
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.messages.topics import EmbeddingSource

_LARGEST_STEP = NANOSECONDS // 5  # by which the time of a sound card may jump between two frames


class StreamLabeller:
    """Labels what one microphone recorded, in the order of time.

    Parameters
    ----------
    label_from : int
        Time before which frames are not labelled, in nanoseconds of UTC; of these only the floor of
        the room is tracked, which is much quicker.
    microphone : str
        Its name; the directions of an array that the model knows count.

    Attributes
    ----------
    floor_converged : bool
        Whether sound before the first frame would leave no trace in the floors to come.
    """

    def __init__(
        self,
        classifier: Classifier,
        label_from: int = 0,
        microphone: str = "",
        embedding: EmbeddingSource | None = None,
        *,
        from_start: bool = False,
    ) -> None:
        self.segments: list[Segment] = []
        self.floor_converged = from_start or not classifier.timing.needs_floor
        self._label_from = label_from
        self._labeller = labeller_of(classifier, microphone, embedding)
        self._powers = classifier.feature_set.band_powers
        self._floor = None if self._powers is None else FloorTracker()
        self._next: int | None = None  # number of the next frame
        self._end = 0  # end of the last frame, in nanoseconds of UTC
        self._from_start = False  # whether it began where the sound began, or after a gap

    @property
    def states_converged(self) -> bool:
        """Whether sound before the first frame would leave no trace in the states to come."""
        return self._from_start or self._labeller.states_converged

    @property
    def segments_converged(self) -> bool:
        """Whether sound before the first frame would leave no trace in the segments to come."""
        return self._from_start or self._labeller.segments_converged

    @property
    def takes_auxiliary(self) -> bool:
        """Whether directions or embeddings change its labels."""
        return self._labeller.takes_auxiliary

    @property
    def open_run(self) -> StateRun | None:
        """The segment that has not ended; None if there is none."""
        return self._labeller.segmenter.open_run

    def discard_open(self) -> None:
        """Set the counts of the open run to zero; its label and start stay."""
        self._labeller.segmenter.discard_open()

    def is_followed_by(self, frame: tuple[int, int]) -> bool:
        """Tell whether the sound goes on with a frame: the next one, within 0.2 s of its time.

        Parameters
        ----------
        frame : (int, int)
            Number and start of the frame, in nanoseconds of UTC.
        """
        return frame[0] == self._next and abs(frame[1] - self._end) <= _LARGEST_STEP

    def push(self, event: Features | Gap) -> FrameLabels | None:
        """Add features or a gap.

        Segments that end are added to `segments`. The open segment ends at a gap, and where the
        features do not follow the last ones.

        Parameters
        ----------
        event : Features or Gap
            Of at least one frame, in the order of time.

        Returns
        -------
        FrameLabels or None
            Of the frames at which a whole window is complete, perhaps none; None for a gap.
        """
        if isinstance(event, Gap):
            self.close()
            return None
        if self._next is not None and not self.is_followed_by((event.first, int(event.stamps[0]))):
            self.close()
        self._from_start |= event.first == 0
        self._next = event.first + len(event.stamps)
        self._end = int(event.stamps[-1]) + FRAME_NANOSECONDS
        floors = self._track_floor(event)
        if self._end <= self._label_from:
            self._from_start = False
            return None
        sound = event.values, floors, event.first, event.stamps, event.auxiliary
        labels, segments = self._labeller.push(*sound)
        self.segments += segments
        return labels

    def _track_floor(self, event: Features) -> Floors | None:
        if self._floor is None or self._powers is None:
            return None
        floors = self._floor(self._powers(event.values), event.first)
        self.floor_converged |= floors.converged or event.first == 0
        return floors._replace(converged=self.floor_converged)

    def close(self) -> None:
        """End the open segment where the last frame ends; the next frame begins anew."""
        self.segments += self._labeller.close(self._end)
        if self._floor is not None:
            self._floor.restart()
        self._next = None
        self._from_start = self.floor_converged = True
