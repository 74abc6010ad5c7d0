"""A network, checked when it is loaded: samples in, an embedding out."""

import hashlib
import warnings
from functools import lru_cache
from typing import Any

import numpy as np

from hearthlog.models.embedding.onnx_session import OnnxModel
from hearthlog.models.errors import ModelError
from hearthlog.models.features.network.card import MOST_VALUES, NetworkCard, read_network
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import HearthlogWarning, printable
from hearthlog.schemas.frames import SAMPLE_RATE

_LARGEST = 65_504.0  # of half precision, to which values are rounded
_SOUND_SEED = 20_261_125


class Network:
    """A network in memory.

    Attributes
    ----------
    of_silence : np.ndarray [shape=(width,)], float32
        Embedding of digital silence.

    Raises
    ------
    ModelError
        If the file is not the network of the card, or no network that takes and gives what the card
        says, or if onnxruntime is not installed.
    """

    def __init__(self, card: NetworkCard) -> None:
        self._card = card
        data = read_network(card.path)
        try:
            _check_digest(data, card)
            count = len(self._resampled(np.zeros(card.window, np.float32)))
            self._model = OnnxModel(data, count, card.input)
            self._output = self._model.chosen_output(card.output)
            self.of_silence = self._tried()
        except ModelError as error:
            raise ModelError(f"{card.path}: {printable(str(error))[:300]}") from error

    def embed(self, window: Float32) -> Float32:
        """Compute the embedding of a window of sound.

        Parameters
        ----------
        window : np.ndarray [shape=(window,)], float32
            Samples at 16 kHz, -1 to 1.

        Returns
        -------
        np.ndarray [shape=(width,)], float32
            In half precision; the mean where the network gives several. What is not finite is 0.
            That of silence where the network fails, with a `HearthlogWarning`.
        """
        try:
            (values,) = self._model.run(self._resampled(window), [self._output])
            self._check_shape(values)
        except Exception:  # noqa: BLE001  onnxruntime's are many; no sound may end a recording
            text = "the network fails at some sound, which counts as silence"
            warnings.warn(HearthlogWarning(text, self._card.path), stacklevel=2)
            return self.of_silence
        return _in_half_precision(values)

    def _resampled(self, window: Float32) -> Float32:
        if self._card.sample_rate == SAMPLE_RATE:
            return np.ascontiguousarray(window)
        import soxr  # noqa: PLC0415  takes time, and most networks hear at 16 kHz

        resampled: Float32 = soxr.resample(window, SAMPLE_RATE, self._card.sample_rate)
        return resampled

    def _tried(self) -> Float32:
        """Try it with noise and with silence; embed the silence."""
        noise = np.random.default_rng(_SOUND_SEED).uniform(-1.0, 1.0, self._card.window)
        windows = [
            self._resampled(window.astype(np.float32))
            for window in (noise, 0.1 * noise, np.zeros_like(noise))
        ]
        (values,) = self._model.tried(windows, [self._output], self._check)
        return _in_half_precision(values)

    def _check(self, outputs: list[Any]) -> None:
        (values,) = outputs
        self._check_shape(values)
        if not np.isfinite(values).all():
            raise ModelError(f"gives values that are not finite as {self._output}")

    def _check_shape(self, values: Any) -> None:
        width, output = len(self._card.names), self._output
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or not values.ndim:
            raise ModelError(f"gives no numbers as {output}")
        if values.shape[-1] != width or not values.size:
            what = f"gives {output} of shape {list(values.shape)}"
            most = f" (and {MOST_VALUES} are the most)" if values.shape[-1] > MOST_VALUES else ""
            raise ModelError(f"{what}; its card says that it has {width} values{most}")


@lru_cache(maxsize=4)
def load_network(card: NetworkCard) -> Network:
    """Load a network once, however many extractors are made.

    Raise `ModelError` as `Network`.
    """
    return Network(card)


def _check_digest(data: bytes, card: NetworkCard) -> None:
    digest = hashlib.sha256(data).hexdigest()
    if digest != card.sha256:
        raise ModelError(f"has sha256 {digest}, and its card is about {card.sha256}")


def _in_half_precision(values: Any) -> Float32:
    means = values.reshape(-1, values.shape[-1]).astype(np.float64).mean(axis=0)
    np.nan_to_num(means, copy=False, posinf=_LARGEST, neginf=-_LARGEST)
    half: Float32 = np.clip(means, -_LARGEST, _LARGEST).astype(np.float16).astype(np.float32)
    return half + np.float32(0.0)  # no -0, which is the same to a classifier
