"""Directions of an array's frames, and their messages."""

import numpy as np

from hearthlog.models.classifiers.evidence import BLOCK_FRAMES, NOWHERE, Directions
from hearthlog.recorder.direction.channel_watch import ChannelWatch
from hearthlog.recorder.direction.geometry import ArrayGeometry
from hearthlog.recorder.direction.srp_phat import DirectionFinder
from hearthlog.recorder.events import Frames
from hearthlog.recorder.stream.messages import EncodedMessage, encoded_messages
from hearthlog.schemas.arrays import Int64
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.topics import topic


class ArrayDirections:
    """Finds whence the sound of an array comes, and watches its channels."""

    def __init__(self, geometry: ArrayGeometry) -> None:
        self._finder = DirectionFinder(geometry)
        self._watch = ChannelWatch(len(geometry.positions))
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._finder.restart()
        self._stamps = np.empty(0, np.int64)  # of the frames of a block that is not complete

    def problem(self) -> str:
        """Return what is wrong with the channels and what to do; empty if nothing is."""
        return self._watch.problem()

    def __call__(self, frames: Frames) -> Directions:
        """Find the directions of the blocks that these frames complete.

        Parameters
        ----------
        frames : Frames
            The next ones. Without channels, as of a microphone that is heard in place of the array,
            they have no direction.
        """
        if frames.channels is None:
            self.restart()
            return NOWHERE
        self._watch.add(frames.channels)
        places, azimuths, confidences = self._finder(frames.channels, frames.first)
        held = len(self._stamps)
        stamps = np.concatenate([self._stamps, frames.stamps])
        self._stamps = stamps[1 - BLOCK_FRAMES :]
        return Directions(frames.first + places, stamps[held + places], azimuths, confidences)


def direction_messages(
    microphone: str, directions: Directions, known: Int64
) -> list[EncodedMessage]:
    """Encode directions.

    Parameters
    ----------
    known : np.ndarray [shape=(m,)], int64
        Starts of the last frames of their blocks, in nanoseconds of UTC.
    """
    columns: dict[str, Column] = {
        "header.stamp": directions.stamps,
        "header.frame_id": microphone,
        "frame": directions.frames,
        "azimuth": directions.azimuths,
        "confidence": directions.confidences,
    }
    rows = encode_rows(message_types.DIRECTION, columns, len(known))
    name = topic(microphone, "direction")
    return encoded_messages(name, known, rows)
