"""Frames in, encoded messages out: features, statistics, labels and segments. No I/O."""

from collections.abc import Mapping
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.labels.segments import Segment, Segmenter
from hearthlog.recorder import rosout
from hearthlog.recorder.clips.clip_choice import Labelled
from hearthlog.recorder.events import Event, Frames, Gap, Health
from hearthlog.recorder.statistics import RollingStatistics
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS, SAMPLE_RATE
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.message_types import (
    duration_message,
    encode,
    header,
    message,
    nanoseconds,
)
from hearthlog.schemas.messages.topics import DIAGNOSTICS, ROSOUT, topic

_ROW_TYPES = {
    "features": message_types.FEATURES,
    "statistics": message_types.STATISTICS,
    "label": message_types.LABEL,
}


class Record(NamedTuple):
    """One encoded message on its way into the log."""

    log_time: int
    topic: str
    data: bytes


def stream_info(microphone: str, device: str, features: FeatureSet, model: Model | None) -> Any:
    """Make the `AudioStreamInfo` of a microphone; its stamp is still zero."""
    return message(
        message_types.STREAM_INFO,
        header=header(0, microphone),
        device=device,
        sample_rate=SAMPLE_RATE,
        frame_seconds=FRAME_SECONDS,
        window_seconds=features.window_seconds,
        feature_set=features.name,
        feature_names=list(features.feature_names),
        model="" if model is None else model.name,
        model_sha256="" if model is None else model.sha256,
        labels=[] if model is None else list(model.classes),
    )


def opening(info: Any) -> list[Record]:
    """Return what every file begins with: its `AudioStreamInfo`, and the same in words."""
    stamp = nanoseconds(info.header.stamp)
    return [
        Record(stamp, topic(info.header.frame_id, "info"), encode(info)),
        Record(stamp, ROSOUT, rosout.of_info(info)),
    ]


class Pipeline:
    """Everything that is computed from one microphone's sound.

    Parameters
    ----------
    microphone : str
        Its name, which begins the topics and is the `frame_id` of every message.
    features : FeatureSet
        What is computed from each frame.
    classifier : Classifier or None
        Of this feature set. Without one there are no labels.
    statistics_every : int
        Frames from one statistics message to the next.

    Attributes
    ----------
    microphone : str
    feature_set : FeatureSet
    settled : bool
        Whether sound before the first frame would have left no trace in the segments to come.
    labelled : Labelled or None
        What was said of the last frames that were pushed last; None where they had no label.
    """

    def __init__(
        self,
        microphone: str,
        features: FeatureSet,
        classifier: Classifier | None = None,
        statistics_every: int = 1,
    ) -> None:
        self.microphone = microphone
        self.feature_set = features
        self.settled = False
        self.labelled: Labelled | None = None
        self._use(classifier)
        self._statistics_every = statistics_every
        self._features = features.extractor()
        self._statistics = RollingStatistics(features.window_frames)
        self._end = 0
        self._level = 0

    @property
    def classes(self) -> tuple[str, ...] | None:
        """What the model that speaks tells apart."""
        return None if self._classifier is None else self._classifier.classes

    def push(self, event: Event) -> list[Record]:
        """Turn what a source handed on into messages, in the order of their log times."""
        if isinstance(event, Frames):
            return self.push_features(self._features(event.samples), event.first, event.stamps)
        if isinstance(event, Gap):
            return self._push_gap(event)
        return self._push_health(event)

    def push_features(self, features: Float32, first: int, stamps: Int64) -> list[Record]:
        """Turn the features of successive frames into messages.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        first : int
            Number of the first frame.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
        """
        self.labelled = None
        mean, std = self._statistics(features)
        frames = np.arange(first, first + len(features))
        shown = np.flatnonzero(frames % self._statistics_every == 0)
        records = [
            *self._rows("features", frames, stamps, {"values": features}),
            *self._rows(
                "statistics", frames[shown], stamps[shown], {"mean": mean[shown], "std": std[shown]}
            ),
        ]
        if self._inputs is not None:
            inputs = self._inputs(features)  # at the last frames: labels are of a whole window
            heard = slice(len(frames) - len(inputs), None)
            records += self._labels(inputs, frames[heard], stamps[heard])
        records.sort(key=itemgetter(0))
        self._end = int(stamps[-1]) + FRAME_NANOSECONDS
        return records

    def finish(self) -> list[Record]:
        """Close what is open at the end of the sound."""
        return self._close(self._end)

    def change_model(
        self, model: Model | None, classifier: Classifier | None, frame: int, stamp: int
    ) -> tuple[list[Record], list[Record]]:
        """Let another model speak from a frame on; features and statistics go on.

        It must be for the same feature set.

        Parameters
        ----------
        model : Model or None
        classifier : Classifier or None
            Of that model.
        frame, stamp : int
            Number and time of the frame that follows.

        Returns
        -------
        closing, opening : list of Record
            What ends the log of the last model, and what begins that of this one.
        """
        closing = self._close(stamp)
        self._use(classifier)
        if self._inputs is not None and self._statistics.recent is not None:
            self._inputs(self._statistics.recent)
        who = "no model" if model is None else f"model {model.name} ({model.sha256[:12]})"
        return closing, self.report("model", stamp, 0, f"{who} from frame {frame} on")

    def report(self, what: str, stamp: int, level: int, text: str) -> list[Record]:
        """Say something about the model or the clips; the level is one of `diagnostic_msgs`."""
        return [
            self._diagnostics(stamp, level, f"hearthlog: {self.microphone} {what}", text, {}),
            Record(stamp, ROSOUT, rosout.of_report(self.microphone, stamp, level, text)),
        ]

    def _use(self, classifier: Classifier | None) -> None:
        self._classifier = classifier
        self._inputs = None if classifier is None else classifier.inputs.stream()
        self._segmenter = None if classifier is None else _segmenter(classifier)

    def _push_gap(self, gap: Gap) -> list[Record]:
        self._features.restart()
        self._statistics.restart()
        if self._inputs is not None:
            self._inputs.restart()
        closed = self._close(self._end)
        data = encode(
            message(
                message_types.GAP,
                header=header(gap.start, self.microphone),
                duration=duration_message(gap.end - gap.start),
                reason=gap.reason,
                frames_lost=gap.frames_lost,
            )
        )
        return [
            *closed,
            Record(gap.end, topic(self.microphone, "gap"), data),
            Record(gap.end, ROSOUT, rosout.of_gap(self.microphone, gap)),
        ]

    def _labels(self, inputs: Float32, frames: Int64, stamps: Int64) -> list[Record]:
        classifier, segmenter = self._classifier, self._segmenter
        if classifier is None or segmenter is None or not len(inputs):
            return []
        probabilities, novelty = classifier.classify(inputs)
        self.labelled = Labelled(classifier.classes, probabilities, novelty)
        best = probabilities.argmax(axis=1)
        confidence = probabilities[np.arange(len(best)), best]
        closed = segmenter.push(probabilities, stamps)
        self.settled |= segmenter.settled
        columns = {
            "label": [classifier.classes[i] for i in best],
            "confidence": confidence,
            "novelty": novelty,
            "probabilities": probabilities,
        }
        return self._segment_records(closed) + self._rows("label", frames, stamps, columns)

    def _rows(
        self, kind: str, frames: Int64, stamps: Int64, columns: Mapping[str, Column]
    ) -> list[Record]:
        common: dict[str, Column] = {
            "header.stamp": stamps,
            "header.frame_id": self.microphone,
            "frame": frames,
        }
        name = topic(self.microphone, kind)
        rows = encode_rows(_ROW_TYPES[kind], common | dict(columns), len(frames))
        return [Record(time, name, row) for time, row in zip(stamps.tolist(), rows, strict=True)]

    def _close(self, end: int) -> list[Record]:
        """End the segments at `end`; what comes next begins anew."""
        if self._segmenter is None:
            return []
        closed = self._segmenter.close(end)
        self.settled |= bool(closed)
        return self._segment_records(closed)

    def _segment_records(self, segments: list[Segment]) -> list[Record]:
        return [record for segment in segments for record in self._of_segment(segment)]

    def _of_segment(self, segment: Segment) -> list[Record]:
        assert self._classifier is not None
        label = self._classifier.classes[segment.label]
        data = encode(
            message(
                message_types.SEGMENT,
                header=header(segment.start, self.microphone),
                duration=duration_message(segment.end - segment.start),
                label=label,
                confidence=segment.confidence,
            )
        )
        return [
            Record(segment.known, topic(self.microphone, "segment"), data),
            Record(segment.known, ROSOUT, rosout.of_segment(self.microphone, segment, label)),
        ]

    def _push_health(self, health: Health) -> list[Record]:
        name = f"hearthlog: {self.microphone}"
        records = [
            self._diagnostics(health.stamp, health.level, name, health.summary, health.values)
        ]
        if health.level != self._level:
            self._level = health.level
            line = rosout.of_health(self.microphone, health)
            records.append(Record(health.stamp, ROSOUT, line))
        return records

    def _diagnostics(
        self, stamp: int, level: int, name: str, text: str, values: Mapping[str, str]
    ) -> Record:
        status = message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=name,
            message=text,
            hardware_id=self.microphone,
            values=[
                message("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                for key, value in values.items()
            ],
        )
        data = encode(
            message(
                message_types.DIAGNOSTICS, header=header(stamp, self.microphone), status=[status]
            )
        )
        return Record(stamp, DIAGNOSTICS, data)


def _segmenter(classifier: Classifier) -> Segmenter:
    return Segmenter(classifier.smoothing, classifier.transitions, FRAME_SECONDS)
