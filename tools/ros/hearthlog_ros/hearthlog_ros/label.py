"""`ros2 run hearthlog_ros label`: labels of features that are published somewhere on the graph."""

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.events import Gap
from hearthlog.recorder.stream import EncodedMessage, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, nanoseconds
from hearthlog.schemas.messages.topics import check_microphone_name, topic
from hearthlog_ros.graph import (
    NodeError,
    TypeChecks,
    message_class,
    run,
    wait_for_subscribers,
)

_DEPTH = 1000  # features that wait while this node does not run: 50 seconds
_CHECK_SECONDS = 2.0
_SILENCE_SECONDS = 5.0  # without features, after which the sound has ended


class LabelNode(Node):
    """Labels the features of one microphone, as its recorder would.

    It subscribes to `/<microphone>/features`, and publishes `/<microphone>/label`, `…/segment` and,
    for those who come late, what the labels are in `…/label_info`.

    Parameters of the node: `microphone`; `model`, a file or the name of a starter model.
    """

    def __init__(self) -> None:
        super().__init__("hearthlog_label")
        microphone = self.declare_parameter("microphone", "mic").value
        name = self.declare_parameter("model", "").value
        if not name:
            raise NodeError("name a model: --ros-args -p model:=general, or a model file")
        try:
            self._microphone = check_microphone_name(microphone)
            self._model = load_model(Path(name))
            self._classifier = Classifier(self._model)
        except HearthlogError as error:
            raise NodeError(str(error)) from error
        self._check_embeddings()
        self._features = self._classifier.feature_set
        self._pipeline = Pipeline(self._microphone, self._features, self._classifier)
        self._waiting: list[Any] = []
        self._next: int | None = None  # number of the next frame, if the sound goes on
        self._end = 0
        self._last_arrival = time.monotonic()
        self._checks = TypeChecks(self)
        self._begin_publishing()
        self._subscribe()
        self.create_timer(_CHECK_SECONDS, self._check_alone)

    def _check_embeddings(self) -> None:
        """Say that a model gets no embeddings: no message says of which network they are."""
        if self._classifier.names is not None:
            raise NodeError(
                f"model {self._model.name} is for embeddings, which this node does not take; "
                "give it to the recorder: hearthlog record --model"
            )
        if self._model.description.embedding is not None:
            self.get_logger().warning(
                f"model {self._model.name} is for features and embeddings, and this node takes "
                "no embeddings: it labels by features only, less accurately"
            )

    def _begin_publishing(self) -> None:
        kinds = {"label": message_types.LABEL, "segment": message_types.SEGMENT}
        self._publishers_of = {
            topic(self._microphone, kind): self.create_publisher(
                message_class(name), topic(self._microphone, kind), QoSProfile(depth=10)
            )
            for kind, name in kinds.items()
        }
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._info = self.create_publisher(
            message_class(message_types.STREAM_INFO), topic(self._microphone, "label_info"), latched
        )
        info = stream_info(self._microphone, "", self._features, self._model)
        self._info.publish(encode(info))

    def _subscribe(self) -> None:
        name = topic(self._microphone, "features")
        kind = message_class(message_types.FEATURES)
        self.create_subscription(kind, name, self._take, QoSProfile(depth=_DEPTH))
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        info = message_class(message_types.STREAM_INFO)
        self.create_subscription(info, topic(self._microphone, "info"), self._check_info, latched)
        self._checks.expect(name, message_types.type_hash(message_types.FEATURES))

    def _take(self, message: Any) -> None:
        self._waiting.append(message)

    def _check_info(self, info: Any) -> None:
        if list(info.feature_names) != list(self._features.feature_names):
            raise NodeError(
                f"model {self._model.name} is for feature set {self._features.name}; "
                f"{topic(self._microphone, 'features')} has {info.feature_set}: "
                "choose another model"
            )

    def look(self) -> bool:
        """Label what has arrived; return whether to go on."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self._last_arrival = time.monotonic()
            self._label(waiting)
        elif self._next is not None and self._is_silent():
            self._end_sound()
        return True

    def _is_silent(self) -> bool:
        return time.monotonic() - self._last_arrival > _SILENCE_SECONDS

    def close(self) -> None:
        """End the open segment."""
        self._label(self._waiting)
        self._end_sound()
        wait_for_subscribers(self._publishers_of.values())

    def _check_alone(self) -> None:
        """Check that nobody else labels this microphone under the same name."""
        for publisher in self._publishers_of.values():
            for end in self.get_publishers_info_by_topic(publisher.topic_name):
                if end.node_name != self.get_name():
                    raise NodeError(
                        f"{publisher.topic_name} is published by {end.node_name} already; publish "
                        f"to another: --ros-args -r {publisher.topic_name}:=/another/name"
                    )

    def _label(self, messages: list[Any]) -> None:
        """Label features, run by run of frames that follow each other."""
        frames = [message.frame for message in messages]
        breaks = [row for row, (one, two) in enumerate(pairwise(frames), 1) if two != one + 1]
        for first, last in pairwise([0, *breaks, len(messages)]):
            if last > first:
                self._label_run(messages[first:last])

    def _label_run(self, messages: list[Any]) -> None:
        width = self._features.width
        if any(len(message.values) != width for message in messages):
            raise NodeError(
                f"model {self._model.name} is for feature set {self._features.name}; "
                f"{topic(self._microphone, 'features')} has {len(messages[0].values)} features "
                f"rather than {width}: choose another model"
            )
        values = np.array([message.values for message in messages], np.float32)
        stamps = np.array([nanoseconds(message.header.stamp) for message in messages], np.int64)
        first = messages[0].frame
        if self._next is not None and first != self._next:
            self._end_sound()
        self._publish(self._pipeline.push_features(values, first, stamps))
        self._next = first + len(messages)
        self._end = int(stamps[-1]) + FRAME_NANOSECONDS

    def _end_sound(self) -> None:
        """End the open segment; the next frame begins anew."""
        if self._next is not None:
            self._publish(self._pipeline.push(Gap(self._end, self._end, "", 0)))
        self._next = None

    def _publish(self, messages: list[EncodedMessage]) -> None:
        for message in messages:
            if message.topic in self._publishers_of:
                self._publishers_of[message.topic].publish(message.data)


def main() -> None:
    """Run the node."""
    run(LabelNode)
