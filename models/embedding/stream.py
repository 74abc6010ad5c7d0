"""The embeddings of one stream of frames: of the windows in which there is sound."""

import numpy as np

from hearthlog.models.embedding.embeddings import (
    HOP_FRAMES,
    NO_EMBEDDINGS,
    WINDOW_FRAMES,
    Embeddings,
)
from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.embedding.steady_noise import SteadyNoise
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import FRAME_SAMPLES

_SOUND_FROM = 4  # frame of a window; what ends before it is more than half a second from the middle


class EmbeddingStream:
    """Embeds the windows of one stream of frames in which there is sound.

    Windows begin at frames whose number is a multiple of ten. One is embedded if there is sound
    within half a second of its middle, without the noise of windows in which there is none.
    """

    def __init__(self, embedder: Embedder) -> None:
        self._embedder = embedder
        self._noise = SteadyNoise()
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._noise.restart()
        self._frames = np.empty((0, FRAME_SAMPLES), np.float32)
        self._sound = np.empty(0, bool)
        self._stamps = np.empty(0, np.int64)

    def push(self, frames: Float32, sound: Bool, first: int, stamps: Int64) -> Embeddings:
        """Add successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        sound : np.ndarray [shape=(n,)], bool
            Whether what ends with each frame, 0.4 s at most, is above the floor of the room.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
        """
        samples = np.clip(np.nan_to_num(frames, posinf=0.0, neginf=0.0), -1.0, 1.0)
        samples = np.concatenate([self._frames, samples])
        sound = np.concatenate([self._sound, sound])
        stamps = np.concatenate([self._stamps, stamps])
        first -= len(self._frames)
        begins = np.arange(-first % HOP_FRAMES, len(samples) - WINDOW_FRAMES + 1, HOP_FRAMES)
        chosen, values = [], []
        for begin in begins.tolist():
            window, above = samples[begin : begin + WINDOW_FRAMES], sound[begin:][:WINDOW_FRAMES]
            if above[_SOUND_FROM:].any():
                chosen.append(begin)
                values.append(self._embedder(self._noise.reduced(window)))
            elif not above.any():
                self._noise.learn(window)
        self._frames = samples[1 - WINDOW_FRAMES :].copy()
        self._sound, self._stamps = sound[1 - WINDOW_FRAMES :], stamps[1 - WINDOW_FRAMES :]
        if not chosen:
            return NO_EMBEDDINGS
        places = np.array(chosen, np.int64)
        return Embeddings(first + places, stamps[places], np.stack(values))
