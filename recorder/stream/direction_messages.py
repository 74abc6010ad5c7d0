"""Directions, as messages."""

import numpy as np

from hearthlog.recorder.direction.channel_watch import ChannelWatch
from hearthlog.recorder.direction.geometry import ArrayGeometry
from hearthlog.recorder.direction.srp_phat import BLOCK_FRAMES, DirectionFinder
from hearthlog.recorder.events import Frames
from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.topics import topic


class DirectionMessages:
    """Finds whence the sound of an array comes, and encodes it.

    Parameters
    ----------
    microphone : str
        Its name.
    geometry : ArrayGeometry
    """

    def __init__(self, microphone: str, geometry: ArrayGeometry) -> None:
        self._microphone = microphone
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

    def __call__(self, frames: Frames) -> list[EncodedMessage]:
        """Encode the directions of the blocks that these frames complete.

        Parameters
        ----------
        frames : Frames
            The next ones. Without channels, as of a microphone that is heard in place of the array,
            they have no direction.

        Returns
        -------
        list of EncodedMessage
            In the order of their log times: each is known with the last frame of its block.
        """
        if frames.channels is None:
            self.restart()
            return []
        self._watch.add(frames.channels)
        directions = self._finder(frames.channels, frames.first)
        held = len(self._stamps)
        stamps = np.concatenate([self._stamps, frames.stamps])
        self._stamps = stamps[1 - BLOCK_FRAMES :]
        begin = stamps[held + directions.places]
        columns: dict[str, Column] = {
            "header.stamp": begin,
            "header.frame_id": self._microphone,
            "frame": frames.first + directions.places,
            "azimuth": directions.azimuths,
            "confidence": directions.confidences,
        }
        rows = encode_rows(message_types.DIRECTION, columns, len(begin))
        known = stamps[held + directions.places + BLOCK_FRAMES - 1]
        name = topic(self._microphone, "direction")
        return [
            EncodedMessage(time, name, row) for time, row in zip(known.tolist(), rows, strict=True)
        ]
