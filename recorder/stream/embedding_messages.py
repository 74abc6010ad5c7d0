"""Embeddings of a microphone's frames, and their messages."""

import numpy as np

from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.embedding.projection import WINDOW_FRAMES, Embeddings
from hearthlog.models.embedding.stream import EmbeddingStream
from hearthlog.models.features.feature_set import SILENCE_POWER, FeatureSet
from hearthlog.models.features.floor import Floors, is_quiet
from hearthlog.recorder.stream.messages import EncodedMessage, encoded_messages
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import Column, encode_rows
from hearthlog.schemas.messages.topics import topic

_GATE, _GATE_FRAMES = 2.0, 8  # dB above the floor, and the window, as of the models


class MicrophoneEmbeddings:
    """Embeds what a microphone hears above the floor of the room."""

    def __init__(self, embedder: Embedder, features: FeatureSet) -> None:
        self._feature_set = features
        self._stream = EmbeddingStream(embedder)
        self.restart()

    def restart(self) -> None:
        """Forget the past: the next frame does not follow the last one."""
        self._stream.restart()
        self._features = np.empty((0, self._feature_set.width), np.float32)

    def push(
        self, frames: Float32, features: Float32, floors: Floors | None, first: int, stamps: Int64
    ) -> Embeddings:
        """Add successive frames.

        Parameters
        ----------
        frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        features : np.ndarray [shape=(n, d)], float32
        floors : Floors or None
            At the last of these frames; None if the feature set has no bands.
        stamps : np.ndarray [shape=(n,)], int64
            Starts of the frames in nanoseconds of UTC.
        """
        recent = np.concatenate([self._features, features])
        sound = np.zeros(len(frames), bool)
        count = min(len(recent) - _GATE_FRAMES + 1, len(frames))  # that end a whole window
        if count > 0:
            sound[-count:] = self._is_sound(recent[-count - _GATE_FRAMES + 1 :], floors)
        self._features = recent[1 - _GATE_FRAMES :].copy()
        return self._stream.push(frames, sound, first, stamps)

    def _is_sound(self, features: Float32, floors: Floors | None) -> Bool:
        """Return which windows are above the floor, or where there is none, above -60 dBFS."""
        count = len(features) - _GATE_FRAMES + 1
        powers_of = self._feature_set.band_powers
        if floors is None or powers_of is None:
            powers = self._feature_set.power(features).astype(np.float64)
            loud: Bool = np.convolve(powers > SILENCE_POWER, np.ones(_GATE_FRAMES), "valid") > 0
            return loud
        sound = np.zeros(count, bool)
        known = min(len(floors.room), count)
        if known:
            powers = powers_of(features[-known - _GATE_FRAMES + 1 :])
            sound[-known:] = ~is_quiet(powers, floors.room[-known:], _GATE_FRAMES, _GATE)
        return sound


def embedding_messages(
    microphone: str, embeddings: Embeddings, known: Int64
) -> list[EncodedMessage]:
    """Encode embeddings.

    Parameters
    ----------
    known : np.ndarray [shape=(m,)], int64
        Starts of the last frames of their windows, in nanoseconds of UTC.
    """
    if not len(known):
        return []
    columns: dict[str, Column] = {
        "header.stamp": embeddings.stamps,
        "header.frame_id": microphone,
        "frame": embeddings.frames,
        "frames": np.full(len(known), WINDOW_FRAMES, np.uint32),
        "values": embeddings.values,
    }
    rows = encode_rows(message_types.EMBEDDING, columns, len(known))
    name = topic(microphone, "embedding")
    return encoded_messages(name, known, rows)
