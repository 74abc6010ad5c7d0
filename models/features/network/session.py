"""A network, checked when it is loaded: samples in, an embedding out."""

import hashlib
import threading
import warnings
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from hearthlog.models.errors import ModelError
from hearthlog.models.features.network.card import MOST_VALUES, NetworkCard, read_network
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.schemas.text import printable

_LARGEST = 65_504.0  # of half precision, to which values are rounded
_FATAL_ONLY = 4
_PATIENCE_SECONDS = 20.0
_SOUND_SEED = 20_261_125
_LONGEST_LIST = 64  # characters of names in a message


class Network:
    """A network in memory.

    Parameters
    ----------
    card : NetworkCard

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
        digest = hashlib.sha256(data).hexdigest()
        if digest != card.sha256:
            raise self._refused(f"has sha256 {digest}, and its card is about {card.sha256}")
        runtime = _runtime(card)
        self._check_file(data)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = _FATAL_ONLY
        try:
            self._session = runtime.InferenceSession(
                data, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a dozen, of no common kind
            raise self._refused(f"is no network that onnxruntime takes ({error})") from error
        self._input, self._shape = self._only_input()
        self._output = self._chosen_output()
        self.of_silence = self._tried(runtime.RunOptions())

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
            values = self._run(window, None)
            self._check_shape(values)
        except Exception:  # noqa: BLE001  as above; no sound may end a recording
            text = "the network fails at some sound, which counts as silence"
            warnings.warn(HearthlogWarning(text, self._card.path), stacklevel=2)
            return self.of_silence
        return _in_half_precision(values)

    def _run(self, window: Float32, options: Any) -> Any:
        samples = self._resampled(window).reshape(self._shape)
        return self._session.run([self._output], {self._input: samples}, options)[0]

    def _resampled(self, window: Float32) -> Float32:
        if self._card.sample_rate == SAMPLE_RATE:
            return np.ascontiguousarray(window)
        import soxr  # noqa: PLC0415  takes time, and most networks hear at 16 kHz

        resampled: Float32 = soxr.resample(window, SAMPLE_RATE, self._card.sample_rate)
        return resampled

    def _refused(self, why: str) -> ModelError:
        return ModelError(f"{self._card.path}: {printable(why)[:300]}")

    def _check_file(self, data: bytes) -> None:
        """Refuse what is no network, and one whose weights are in other files."""
        import onnx  # noqa: PLC0415  only where there is a network

        try:
            network = onnx.load_model_from_string(data)
        except Exception as error:  # protobuf's, which is no dependency of ours
            raise self._refused(f"is no ONNX file ({error})") from error
        if not network.graph.node:
            raise self._refused("is no ONNX file (there is nothing in it)")
        if any(getattr(each, "data_location", 0) for each in _messages(network)):
            raise self._refused("keeps weights in other files: save it as one file")

    def _only_input(self) -> tuple[str, tuple[int, ...]]:
        """Return the name of the input, and the shape of the samples for it."""
        inputs = {each.name: each for each in self._session.get_inputs()}
        wanted = self._card.input or next(iter(inputs), "")
        if list(inputs) != [wanted]:
            wants = f"it is given only {self._card.input or 'samples'}"
            raise self._refused(f"takes {_listed(inputs)}; {wants}")
        count = len(self._resampled(np.zeros(self._card.window, np.float32)))
        kind, dims = inputs[wanted].type, inputs[wanted].shape
        shape = (*(1 for _ in dims[1:]), count)
        fits = all(not isinstance(dim, int) or dim == size for dim, size in zip(dims, shape))  # noqa: B905  a network without dimensions has none
        if kind != "tensor(float)" or not dims or not fits:
            what = f"{wanted}: {kind} of shape {dims}"
            raise self._refused(f"takes {what}; the window of its card has {count} samples")
        return wanted, shape

    def _chosen_output(self) -> str:
        outputs = {each.name: each for each in self._session.get_outputs()}
        wanted = self._card.output or next(iter(outputs), "")
        if wanted not in outputs or (not self._card.output and len(outputs) > 1):
            raise self._refused(f"gives {_listed(outputs)}; its card must say which as output")
        return wanted

    def _tried(self, options: Any) -> Float32:
        """Try it with noise and with silence, for some seconds at most; embed the silence."""
        noise = np.random.default_rng(_SOUND_SEED).uniform(-1.0, 1.0, self._card.window)
        watch = threading.Timer(_PATIENCE_SECONDS, lambda: setattr(options, "terminate", True))
        watch.daemon = True
        watch.start()
        try:
            for window in (noise, 0.1 * noise, np.zeros_like(noise)):
                values = self._run(window.astype(np.float32), options)
                self._check_shape(values)
                self._check_finite(values)
        except ModelError:
            raise
        except Exception as error:  # as above
            late = f"takes more than {_PATIENCE_SECONDS:.0f} s for a window"
            raise self._refused(late if options.terminate else f"fails ({error})") from error
        finally:
            watch.cancel()
        return _in_half_precision(values)

    def _check_shape(self, values: Any) -> None:
        width, output = len(self._card.names), self._output
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f" or not values.ndim:
            raise self._refused(f"gives no numbers as {output}")
        if values.shape[-1] != width or not values.size:
            what = f"gives {output} of shape {list(values.shape)}"
            most = f" (and {MOST_VALUES} are the most)" if values.shape[-1] > MOST_VALUES else ""
            raise self._refused(f"{what}; its card says that it has {width} values{most}")

    def _check_finite(self, values: Float32) -> None:
        if not np.isfinite(values).all():
            raise self._refused(f"gives values that are not finite as {self._output}")


@lru_cache(maxsize=4)
def load_network(card: NetworkCard) -> Network:
    """Load a network once, however many extractors are made.

    Parameters
    ----------
    card : NetworkCard

    Raises
    ------
    ModelError
        As `Network`.
    """
    return Network(card)


def _messages(message: Any) -> Iterator[Any]:
    """Walk through a message of protobuf, and all that are in it."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for each in [value] if hasattr(value, "ListFields") else value:
                yield from _messages(each)


def _in_half_precision(values: Any) -> Float32:
    means = values.reshape(-1, values.shape[-1]).astype(np.float64).mean(axis=0)
    np.nan_to_num(means, copy=False, posinf=_LARGEST, neginf=-_LARGEST)
    half: Float32 = np.clip(means, -_LARGEST, _LARGEST).astype(np.float16).astype(np.float32)
    return half + np.float32(0.0)  # no -0, which is the same to a classifier


def _runtime(card: NetworkCard) -> Any:
    try:
        import onnx  # noqa: F401, PLC0415
        import onnxruntime  # noqa: PLC0415
    except ImportError as error:
        raise ModelError(
            f"{card.path}: needs {error.name}, which is not installed; try: pip install '.[onnx]' "
            "in a clone of hearthlog"
        ) from error
    onnxruntime.disable_telemetry_events()
    return onnxruntime


def _listed(names: Any) -> str:
    return ", ".join(names)[:_LONGEST_LIST] or "nothing"
