"""The values of a network: the level of each frame, and the last embedding before its end."""

import numpy as np

from hearthlog.models.features.network.card import NetworkCard
from hearthlog.models.features.network.session import load_network
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES

_FLOOR = 1e-10  # -100 dBFS


class NetworkExtractor:
    """Features of one stream of frames.

    Windows of the network end every hop after the start or the last restart; what was before that
    is silence to it. They are given to it one by one, so that blocks of any size give the same
    bits.

    Raise `ModelError` if the network is not that of the card, or not what the card says.
    """

    def __init__(self, card: NetworkCard) -> None:
        self._window, self._hop, self._width = card.window, card.hop, len(card.names)
        self._network = load_network(card)
        self._of_silence = self._network.of_silence
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._recent = np.zeros(self._window, np.float32)  # samples, up to the end of the last hop
        self._last = self._of_silence

    def __call__(self, frames: Float32) -> Float32:
        """Compute the features of successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
            Samples in full scale; those that are not finite count as 0, those beyond it are
            clipped.

        Returns
        -------
        np.ndarray [shape=(n, 1 + width)], float32
            In half precision: the level in dBFS, then the embedding.
        """
        samples = np.clip(np.nan_to_num(frames, posinf=0.0, neginf=0.0), -1.0, 1.0)
        values = np.empty((len(frames), 1 + self._width), np.float32)
        values[:, 0] = _levels(samples)
        if not len(frames):
            return values
        embeddings = [self._last]
        before = len(self._recent) - self._window  # samples since the end of the last hop
        sound = np.concatenate([self._recent, samples.ravel()])
        ends = range(self._window + self._hop, len(sound) + 1, self._hop)
        embeddings += [self._network.embed(sound[end - self._window : end]) for end in ends]
        heard = before + FRAME_SAMPLES * np.arange(1, len(frames) + 1)
        values[:, 1:] = np.stack(embeddings)[heard // self._hop]
        self._last = embeddings[-1]
        self._recent = sound[len(ends) * self._hop :].copy()
        return values


def _levels(samples: Float32) -> Float32:
    exact = samples.astype(np.float64)
    power = np.vecdot(exact, exact) / FRAME_SAMPLES
    levels: Float32 = (10.0 * np.log10(power + _FLOOR)).astype(np.float16).astype(np.float32)
    return levels
