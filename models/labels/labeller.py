"""Labels and segments of one stream, from features or by the names of a network; their columns."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import (
    NO_AUXILIARY,
    Auxiliary,
    DirectionEvidence,
    EmbeddingEvidence,
)
from hearthlog.models.classifiers.network_names import MARGIN_FRAMES
from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES, Embeddings, Int8
from hearthlog.models.features.floor import Floors, is_quiet
from hearthlog.models.labels import Segment, Segmenter, SegmenterInput
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.messages.cdr_codec import Column
from hearthlog.schemas.messages.topics import EmbeddingSource


class FrameLabels(NamedTuple):
    """Classifier results of successive frames, each from the window around the frame."""

    classes: tuple[str, ...]  # names behind the columns of the probabilities
    frames: Int64  # [shape=(n,)] numbers of the frames
    stamps: Int64  # [shape=(n,)] starts of the frames in nanoseconds of UTC
    # [shape=(n,)] starts of the last frames of the windows, which complete the labels
    decided_at: Int64
    probabilities: Float32  # [shape=(n, C)]
    # [shape=(n, C)] probabilities from the features alone, which the privacy filter uses
    by_features: Float32
    novelty: Float32  # [shape=(n,)] from 0 to 1; NaN if the classifier computes none
    calibrated_elsewhere: bool
    ahead: int = 0
    # [shape=(n, C)] highest network logit of the names of each class around the frame; NaN without
    # an embedding, or for a class without names
    by_names: Float64 | None = None

    def columns(self, microphone: str) -> dict[str, Column]:
        """Return the fields of one `AudioLabel` per frame."""
        return label_columns(self._asdict(), self.classes, microphone)


def label_columns(
    labels: Mapping[str, Any] | NDArray[np.void], classes: Sequence[str], microphone: str
) -> dict[str, Column]:
    """Return the fields of one `AudioLabel` per frame.

    `labels` has the fields `frames`, `stamps`, `probabilities` and `novelty` of `FrameLabels`.
    """
    probabilities = labels["probabilities"]
    best = probabilities.argmax(axis=1)
    return {
        "header.stamp": labels["stamps"],
        "header.frame_id": microphone,
        "frame": labels["frames"],
        "label": np.array(classes, object)[best],
        "confidence": probabilities[np.arange(len(best)), best],
        "novelty": labels["novelty"],
        "probabilities": probabilities,
    }


class Labeller:
    """Labels one stream of frames and divides the stream into segments.

    `microphone` selects the direction weights of the model; `embedding` is ignored unless network
    and projection match the model.
    """

    def __init__(
        self,
        classifier: Classifier,
        microphone: str = "",
        embedding: EmbeddingSource | None = None,
    ) -> None:
        self.classes = classifier.classes
        self.segmenter = Segmenter(classifier.classes, classifier.smoothing, classifier.transitions)
        self.timing = classifier.timing
        self._classifier = classifier
        self._window: _Frames | None = None  # the last frames, one less than a window
        weights = classifier.direction_weights(microphone)
        self._evidence = None if weights is None else DirectionEvidence(weights)
        self._embedded: EmbeddingEvidence | None = None
        self._named: EmbeddingEvidence | None = None
        if embedding and classifier.embedding_heads and classifier.takes_embeddings(embedding):
            heads = classifier.embedding_heads.log_probabilities
            logits = partial(_logits_of_names, source=embedding, classes=self.classes)
            self._embedded = EmbeddingEvidence(heads, len(self.classes))
            self._named = EmbeddingEvidence(logits, len(self.classes))
        self._window_evidence = [one for one in (self._embedded, self._named) if one is not None]
        self._pending: SegmenterInput | None = None  # frames that wait for embeddings
        self._pending_evidence: Float64 | None = None  # direction evidence of the pending frames
        self._inputs_converged = (
            not self.timing.needs_floor and self._evidence is None and self._embedded is None
        )
        self._first_label = self._first_segment = 0  # frame numbers

    @property
    def states_converged(self) -> bool:
        """Whether the states to come are independent of frames before the first frame."""
        return self._inputs_converged and self.segmenter.states_converged

    @property
    def segments_converged(self) -> bool:
        """Whether the segments to come are independent of frames before the first frame."""
        return self._inputs_converged and self.segmenter.segments_converged

    @property
    def takes_auxiliary(self) -> bool:
        """Whether directions or embeddings affect the labels."""
        return self._evidence is not None or self._embedded is not None

    def follow(  # noqa: PLR0913, PLR0917
        self,
        features: Float32,
        floors: Float64 | None,
        stamps: Int64,
        frame: int,
        unlabelled: int,
        auxiliary: Auxiliary = NO_AUXILIARY,
    ) -> None:
        """Take over from another labeller before a frame, at which segments begin.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
            Of the last n frames before that frame.
        floors : np.ndarray [shape=(m, b)], float64, or None
            Floors at the last m of these frames, m <= n; None if the feature set has no bands.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of these frames in nanoseconds of UTC.
        frame : int
            Number of the frame.
        unlabelled : int
            Number of the first frame not labelled by the other labeller.
        auxiliary : Auxiliary, optional
            Of at least the last second before the frame.
        """
        self._first_label, self._first_segment = unlabelled, frame
        powers, replayed = self._classifier.feature_set.band_powers, None
        if self.timing.needs_floor and floors is not None and powers is not None:
            sound = powers(features[len(features) - len(floors) :])
            replayed = Floors(floors, floors, sound, converged=False)
        self._advance(features, replayed, stamps)
        if self._evidence is not None:
            before = frame - len(features), len(features)
            self._evidence.push(auxiliary.directions, *before, 0)
        for each in self._window_evidence:
            each.push(auxiliary.embeddings, frame - len(features))

    def push(
        self,
        features: Float32,
        floors: Floors | None,
        first: int,
        stamps: Int64,
        auxiliary: Auxiliary = NO_AUXILIARY,
    ) -> tuple[FrameLabels, list[Segment]]:
        """Add successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        floors : Floors or None
            Floors at the last of these frames; frames without a floor are not labelled. None if the
            feature set has no bands.
        first : int
            Number of the first frame.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
        auxiliary : Auxiliary, optional
            Directions and embeddings that become available with these frames.

        Returns
        -------
        labels : FrameLabels
            Of the frames whose windows and embeddings are now complete.
        segments : list of Segment
            Segments whose end is decided by these frames.
        """
        self._converge(floors, first)
        window = self._advance(features, floors if self.timing.needs_floor else None, stamps)
        count = max(len(window.stamps) - self.timing.window_frames + 1, 0)
        evidence = None
        if self._evidence is not None:
            evidence = self._evidence.push(auxiliary.directions, first, len(features), count)
        ahead = self.timing.ahead
        room = None if floors is None else floors.room
        probabilities, novelty = self._classify(window, count, room, None if ahead else evidence)
        spoken = self.timing.label_frame
        by_features = SegmenterInput(
            probabilities,
            window.powers[spoken:][:count],
            window.stamps[spoken:][:count],
            window.stamps[self.timing.window_frames - 1 :],
        )
        labelled, end = by_features, first + len(features) - self.timing.delay
        if ahead:
            for each in self._window_evidence:
                each.push(auxiliary.embeddings, first)
            by_features, evidence = self._complete(by_features, evidence)
            labelled, novelty = self._mixed(by_features, end - len(by_features.stamps), evidence)
        count, first = len(labelled.stamps), end - len(labelled.stamps)
        by_names = None if self._named is None else self._named.highest_at(first, count)
        again = max(self._first_label - first, 0)  # frames already labelled
        labels = FrameLabels(
            self.classes,
            np.arange(first, first + count)[again:],
            labelled.stamps[again:],
            labelled.decided_at[again:],
            labelled.probabilities[again:],
            by_features.probabilities[again:],
            novelty[again:],
            self._classifier.calibrated_elsewhere,
            self.timing.ahead,
            None if by_names is None else by_names[again:],
        )
        labelled = labelled.part(slice(max(self._first_segment - first, 0), None))
        return labels, self.segmenter.push(labelled) if len(labelled.stamps) else []

    def close(self, end: int) -> list[Segment]:
        """Return the remaining segments at the end, in nanoseconds of UTC, in order, and reset."""
        if self._evidence is not None:
            self._evidence.restart()
        for each in self._window_evidence:
            each.restart()
        self._pending = self._pending_evidence = None
        self._window, self._first_label, self._first_segment = None, 0, 0
        return self.segmenter.close(end)

    def _converge(self, floors: Floors | None, first: int) -> None:
        """Record the frame from which the inputs do not depend on sound before the first frame."""
        if self._inputs_converged or (
            self.timing.needs_floor and not (floors and floors.converged)
        ):
            return
        full = self._evidence is None or self._evidence.is_full(first)
        if full and (self._embedded is None or self._embedded.is_full(first - self.timing.delay)):
            self._inputs_converged = True
            self.segmenter.forget()

    def _complete(
        self, frames: SegmenterInput, evidence: Float64 | None
    ) -> tuple[SegmenterInput, Float64 | None]:
        """Add frames labelled by features; return the frames whose embeddings are complete."""
        ahead = self.timing.ahead
        pending = frames if self._pending is None else self._pending.followed_by(frames)
        if evidence is not None and self._pending_evidence is not None:
            evidence = np.concatenate([self._pending_evidence, evidence])
        count = max(len(pending.stamps) - ahead, 0)
        self._pending = pending.part(slice(count, None))
        complete = pending.part(slice(count))._replace(decided_at=pending.decided_at[ahead:])
        if evidence is not None:
            evidence, self._pending_evidence = evidence[:count], evidence[count:]
        return complete, evidence

    def _mixed(
        self, frames: SegmenterInput, first: int, evidence: Float64 | None
    ) -> tuple[SegmenterInput, Float32]:
        """Combine the feature probabilities of frames with embeddings; return also the novelty."""
        count = len(frames.stamps)
        by_heads = np.full((count, len(self.classes)), np.nan)
        if self._embedded is not None:
            by_heads = self._embedded.at(first, count)
        probabilities, novelty = self._classifier.mix(frames.probabilities, by_heads, evidence)
        return frames._replace(probabilities=probabilities), novelty

    def _advance(self, features: Float32, floors: Floors | None, stamps: Int64) -> "_Frames":
        """Return the frames of the windows that are complete now or pending."""
        count = len(features) if floors is None else len(floors.powers)
        features, stamps = features[len(features) - count :], stamps[len(stamps) - count :]
        frames = _Frames(features, self._classifier.feature_set.power(features), stamps)
        if floors is not None:
            frames = frames._replace(floors=floors.powers, bands=floors.sound)
        if self._window is not None:
            frames = self._window.followed_by(frames)
        self._window = frames.last(self.timing.window_frames - 1)
        return frames

    def _classify(
        self, frames: "_Frames", count: int, room: Float64 | None, evidence: Float64 | None
    ) -> tuple[Float32, Float32]:
        """Classify `count` windows; windows below the gate above the room floor are silence."""
        length, gate = self.timing.window_frames, self._classifier.gate
        loud = np.ones(count, bool)
        if gate and room is not None and frames.bands is not None and count:
            loud = ~is_quiet(frames.bands, room[len(room) - count :], length, gate)
        probabilities = np.zeros((count, len(self.classes)), np.float32)
        novelty = np.zeros(count, np.float32)
        if not loud.all():
            probabilities[~loud, self.classes.index(SILENCE)] = 1.0
        if loud.any():
            inputs = self._inputs_of(frames, loud)
            of_loud = None if evidence is None else evidence[loud]
            probabilities[loud], novelty[loud] = self._classifier.classify(inputs, of_loud)
        return probabilities, novelty

    def _inputs_of(self, frames: "_Frames", wanted: Bool) -> Float32:
        """Compute the inputs of the wanted windows, from only the frames inside those windows."""
        within = np.zeros(len(frames.stamps), bool)
        for place in range(self.timing.window_frames):
            within[place : place + len(wanted)] |= wanted
        floors = None if frames.floors is None else frames.floors[within]
        inputs = self._classifier.inputs.stream()(frames.features[within], floors)
        begins = np.cumsum(within)[: len(wanted)] - 1
        return inputs[begins[wanted]]


def _logits_of_names(values: Int8, source: EmbeddingSource, classes: Sequence[str]) -> Float64:
    """Return the highest logit of each class's names per window; NaN for a class without names."""
    logits = np.full((len(values), len(classes)), np.nan)
    for number, name in enumerate(classes):
        if name in source.names:
            column = source.names.index(name)
            logits[:, number] = source.steps[column] * values[:, column].astype(np.float64)
    return logits


class _Frames(NamedTuple):
    """Successive frames, with the floor and band powers at each frame if the model needs them."""

    features: Float32
    powers: NDArray[Any]
    stamps: Int64
    floors: Float64 | None = None
    bands: Float64 | None = None

    def followed_by(self, others: "_Frames") -> "_Frames":
        return _Frames(
            np.concatenate([self.features, others.features]),
            np.concatenate([self.powers, others.powers]),
            np.concatenate([self.stamps, others.stamps]),
            _both(self.floors, others.floors),
            _both(self.bands, others.bands),
        )

    def last(self, count: int) -> "_Frames":
        begin = max(len(self.stamps) - count, 0)
        return _Frames(
            self.features[begin:].copy(),
            self.powers[begin:].copy(),
            self.stamps[begin:].copy(),
            None if self.floors is None else self.floors[begin:].copy(),
            None if self.bands is None else self.bands[begin:].copy(),
        )


def _both(before: Float64 | None, after: Float64 | None) -> Float64 | None:
    return None if before is None or after is None else np.concatenate([before, after])


def segment_columns(
    segments: Sequence[Segment], classes: Sequence[str], microphone: str
) -> dict[str, Column]:
    """Return the fields of one `AudioSegment` per segment."""
    starts = np.array([segment.start for segment in segments], np.int64)
    ends = np.array([segment.end for segment in segments], np.int64)
    return {
        "header.stamp": starts,
        "header.frame_id": microphone,
        "duration": ends - starts,
        "label": [classes[segment.label] for segment in segments],
        "confidence": np.array([segment.confidence for segment in segments], np.float32),
    }


_PAUSE = 2  # hops between windows of one sound, at most
_DONE = -1  # replaces a window number: everything has converged
_STEPS = 1 << 16  # steps of a probability, as in the classifiers


class NamesLabeller:
    """Labels one stream of frames by names; the counterpart of `Labeller`.

    The rule is that of `hearthlog.models.embedding.sound_names`; here the delay is bounded and each
    frame has one name.

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
