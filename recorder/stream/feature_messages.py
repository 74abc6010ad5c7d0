"""Features and their statistics, as messages."""

from collections.abc import Mapping

import numpy as np

from hearthlog.recorder.stream.messages import EncodedMessage, encoded_messages
from hearthlog.recorder.stream.statistics import RollingStatistics
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.topics import topic


class FeatureMessages:
    """Encodes the features of one stream of frames, and their statistics."""

    def __init__(
        self, microphone: str, statistics: RollingStatistics, statistics_every: int
    ) -> None:
        self._microphone = microphone
        self._statistics = statistics
        self._every = statistics_every

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._statistics.restart()

    def __call__(self, features: Float32, first: int, stamps: Int64) -> list[EncodedMessage]:
        """Encode the features of successive frames.

        Parameters
        ----------
        features : np.ndarray [shape=(n, d)], float32
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
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
        name, rows = topic(self._microphone, kind), encode_rows(typename, columns, len(stamps))
        return encoded_messages(name, stamps, rows)
