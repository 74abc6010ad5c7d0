"""Labels and segments from the embeddings of one stream, by the names of a network alone.

The rule is that of `hearthlog.models.embedding.sound_names`; here the delay is bounded and each
frame has one name.
"""

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import NO_AUXILIARY, Auxiliary
from hearthlog.models.classifiers.network_names import MARGIN_FRAMES
from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES, Embeddings
from hearthlog.models.features.floor import Floors
from hearthlog.models.labels import Segment, Segmenter, SegmenterInput
from hearthlog.models.labels.labeller import FrameLabels, Labeller
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.messages.topics import EmbeddingSource

_PAUSE = 2  # hops between windows of one sound, at most
_DONE = -1  # replaces a window number: everything has converged
_STEPS = 1 << 16  # steps of a probability, as in the classifiers


class NamesLabeller:
    """Labels one stream of frames by names; the counterpart of `Labeller`.

    A sound begins with a window whose logged value is above the threshold of a name. It continues
    while windows at most a second apart are above the threshold or slightly below, and is labelled
    once enough windows were above. All frames are silence if network or projection of the
    embeddings differ from the model's.
    """

    def __init__(self, classifier: Classifier, embedding: EmbeddingSource | None = None) -> None:
        assert classifier.names is not None
        self.classes = classifier.classes
        self.timing = classifier.timing
        self.takes_auxiliary = classifier.takes_embeddings(embedding)
        self.segmenter = Segmenter(classifier.classes, classifier.smoothing, classifier.transitions)
        self._calibrated_elsewhere = classifier.calibrated_elsewhere
        rules = classifier.names.rules if self.takes_auxiliary else {}
        # Of simultaneous names the first wins: the shorter a sound, the less of it would remain.
        names = sorted(rules, key=lambda name: rules[name].seconds)
        own = [rules[name] for name in names]
        self._labels = np.array([self.classes.index(name) for name in names], np.intp)
        self._columns = np.array([rule.value for rule in own], np.intp)
        self._begins = np.array([rule.begins for rule in own], np.int64)
        self._goes_on = np.array([rule.goes_on for rule in own], np.int64)
        self._least = np.array([rule.windows for rule in own], np.int64)
        precisions = np.array([rule.precision for rule in own])
        self._nothing = np.full(len(own), -(1 << 15))
        self._precision = (np.rint(_STEPS * precisions) / _STEPS).astype(np.float32)
        self._silence = self.classes.index(SILENCE)
        self._later = (self.timing.ahead - WINDOW_FRAMES + 1 + MARGIN_FRAMES) // HOP_FRAMES
        self._restart()

    def _restart(self) -> None:
        count = len(self._labels)
        self._stamps = np.empty(0, np.int64)  # of the unlabelled frames
        self._end: int | None = None  # number of the next frame
        self._window = 0  # number of the next window: a tenth of the number of its first frame
        self._open = np.zeros(count, bool)  # whether a sound continues
        self._first = np.zeros(count, np.int64)  # first and latest window of the sound
        self._last = np.zeros(count, np.int64)
        self._above = np.zeros(count, np.int64)  # number of windows above the threshold
        # Whether the last windows lie in labelled sounds.
        self._named = np.zeros((self._later + 1, count), bool)
        self._below = np.zeros(count, np.int64)  # successive windows without a continuing sound
        self._independent = np.zeros(
            count, bool
        )  # whether a sound is independent of earlier windows
        self._converged: int | None = None  # from this window on, all sounds are

    @property
    def states_converged(self) -> bool:
        """Whether the states to come are independent of frames before the first frame."""
        return self._converged == _DONE and self.segmenter.states_converged

    @property
    def segments_converged(self) -> bool:
        """Whether the segments to come are independent of frames before the first frame."""
        return self._converged == _DONE and self.segmenter.segments_converged

    def follow(  # noqa: PLR0913, PLR0917
        self,
        features: Float32,
        floors: Float64 | None,
        stamps: Int64,
        frame: int,
        unlabelled: int,
        auxiliary: Auxiliary = NO_AUXILIARY,
    ) -> None:
        """Take over from another labeller; earlier sound is ignored."""

    def push(
        self,
        features: Float32,
        floors: Floors | None,
        first: int,
        stamps: Int64,
        auxiliary: Auxiliary = NO_AUXILIARY,
    ) -> tuple[FrameLabels, list[Segment]]:
        """Add successive frames."""
        del features, floors
        if self._end is None:
            self._window = -(-first // HOP_FRAMES)
        self._end = end = first + len(stamps)
        window, named = self._add_windows(auxiliary.embeddings)
        pending = np.append(self._stamps, stamps)
        count = max(len(pending) - self.timing.ahead, 0)
        frames = np.arange(end - len(pending), end - len(pending) + count)
        labelled = SegmenterInput(
            self._probabilities(frames, window, named),
            np.zeros(count),
            pending[:count],
            pending[self.timing.ahead :],
        )
        self._stamps = pending[count:]
        labels = FrameLabels(
            self.classes,
            frames,
            labelled.stamps,
            labelled.decided_at,
            labelled.probabilities,
            labelled.probabilities,
            np.full(count, np.nan, np.float32),
            self._calibrated_elsewhere,
            self.timing.ahead,
        )
        return labels, self._segments(labelled, end - len(pending))

    def close(self, end: int) -> list[Segment]:
        """Return the remaining segments at the end, in nanoseconds of UTC, and reset."""
        segments: list[Segment] = []
        count = len(self._stamps)
        if self._end is not None and count:  # only segments: these labels are not returned
            frames = np.arange(self._end - count, self._end)
            window = self._window - len(self._named)
            nothing = np.zeros((1, len(self._labels)), bool)  # an incomplete window has no names
            labelled = SegmenterInput(
                self._probabilities(frames, window, np.concatenate([self._named, nothing])),
                np.zeros(count),
                self._stamps,
                np.full(count, end),
            )
            segments = self._segments(labelled, self._end - count)
        segments += self.segmenter.close(end)
        self._restart()
        self._converged = _DONE
        return segments

    def _add_windows(self, embeddings: Embeddings) -> tuple[int, Bool]:
        """Add windows now complete; return the first one's number and the names active in each."""
        assert self._end is not None
        begin = self._window
        self._window = max((self._end - WINDOW_FRAMES) // HOP_FRAMES + 1, begin)
        named = np.concatenate(
            [self._named, np.zeros((self._window - begin, len(self._labels)), bool)]
        )
        first = begin - len(self._named)
        logged = embeddings.values[:, self._columns] if len(embeddings.frames) else None
        numbers = (embeddings.frames // HOP_FRAMES).tolist()
        rows = dict(zip(numbers, () if logged is None else logged, strict=True))
        for window in range(begin, self._window):
            row = rows.get(window)
            if row is None and self._converged is not None and not self._open.any():
                continue
            active = self._add(window, self._nothing if row is None else row.astype(np.int64))
            place = window - first
            recent = np.arange(place - self._later, place + 1)
            named[recent] |= active & (recent[:, np.newaxis] >= self._first - first)
        self._named = named[len(named) - len(self._named) :]
        return first, named

    def _add(self, window: int, values: Int64) -> Bool:
        """Add a window; return the labelled sounds that continue in the window."""
        self._open &= window - self._last <= _PAUSE
        above, goes_on = values >= self._begins, values >= self._goes_on
        begins = above & ~self._open
        self._first[begins], self._above[begins] = window, 0
        self._open |= above
        goes_on_here = goes_on & self._open
        self._last[goes_on_here] = window
        self._above[above] += 1
        counts = self._open & (self._above >= self._least)
        self._below = np.where(goes_on, 0, self._below + 1)
        self._independent |= counts | (self._below > _PAUSE)
        if self._converged is None and self._independent.all():
            self._converged = window
        active: Bool = goes_on_here & counts
        return active

    def _probabilities(self, frames: Int64, window: int, named: Bool) -> Float32:
        """Return the probabilities of frames, each from the window centred on the frame."""
        result = np.zeros((len(frames), len(self.classes)), np.float32)
        if not named.any() or not len(frames):
            result[:, self._silence] = 1.0
            return result
        of_frames = named[(frames - MARGIN_FRAMES) // HOP_FRAMES - window]
        chosen, rows = of_frames.argmax(axis=1), np.arange(len(frames))
        sure = np.where(of_frames.any(axis=1), self._precision[chosen], np.float32(0.0))
        result[rows, self._labels[chosen]] = sure
        result[:, self._silence] = 1.0 - sure
        return result

    def _segments(self, labelled: SegmenterInput, first: int) -> list[Segment]:
        """Return the segments whose end is decided by frames; `first` is the first frame number."""
        segments: list[Segment] = []
        if self._converged not in {None, _DONE}:
            doubtful = (self._converged + 1) * HOP_FRAMES + MARGIN_FRAMES - first
            if doubtful < len(labelled.stamps):
                before = labelled.part(slice(max(doubtful, 0)))
                labelled = labelled.part(slice(max(doubtful, 0), None))
                segments = self.segmenter.push(before) if len(before.stamps) else []
                self.segmenter.forget()
                self._converged = _DONE
        return segments + (self.segmenter.push(labelled) if len(labelled.stamps) else [])


def labeller_of(
    classifier: Classifier, microphone: str = "", embedding: EmbeddingSource | None = None
) -> Labeller | NamesLabeller:
    """Return the labeller for a stream of frames and a classifier."""
    if classifier.names is not None:
        return NamesLabeller(classifier, embedding)
    return Labeller(classifier, microphone, embedding)
