"""A network of an ONNX file in memory, by onnxruntime: checked, then samples in and arrays out."""

import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from hearthlog.models.embedding.session import NetworkOutput
from hearthlog.models.errors import ModelError
from hearthlog.schemas.arrays import Float32

_FATAL_ONLY = 4
_PATIENCE_SECONDS = 20.0
_LONGEST_LIST = 64  # characters of names in a message


class OnnxModel:
    """A network of one input, which takes the samples of a window.

    Parameters
    ----------
    input_name : str, optional
        Name of the input; empty for the only one.

    Raises
    ------
    ModelError
        If onnxruntime is not installed, or the file is no such network.
    """

    def __init__(
        self, data: bytes, window: int, input_name: str = "", whose: str = "its card"
    ) -> None:
        self._runtime = _runtime()
        _check_file(data)
        options = self._runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = _FATAL_ONLY
        try:
            self._session = self._runtime.InferenceSession(
                data, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a dozen, of no common kind
            raise ModelError(f"is no network that onnxruntime takes ({error})") from error
        self._input, self._shape = self._only_input(window, input_name, whose)
        self.outputs = {each.name: list(each.shape) for each in self._session.get_outputs()}

    def run(self, samples: Float32, outputs: Sequence[str], options: Any = None) -> list[Any]:
        """Compute outputs for a window; onnxruntime raises errors of many kinds.

        Parameters
        ----------
        samples : np.ndarray [shape=(window,)], float32
        """
        return self._session.run(
            list(outputs), {self._input: samples.reshape(self._shape)}, options
        )

    def chosen_output(self, wanted: str) -> str:
        """Return the name of the output that is wanted, or of the only one if that is empty.

        Raise `ModelError` if there is none, or there are several.
        """
        name = wanted or next(iter(self.outputs), "")
        if name not in self.outputs or (not wanted and len(self.outputs) > 1):
            raise ModelError(f"gives {_listed(self.outputs)}; its card must say which as output")
        return name

    def tried(
        self,
        windows: Sequence[Float32],
        outputs: Sequence[str],
        check: Callable[[list[Any]], None],
    ) -> list[Any]:
        """Try it with some windows, for some seconds at most; return the outputs of the last.

        Raise `ModelError` if it fails, takes too long, or an output cannot be.
        """
        options = self._runtime.RunOptions()
        watch = threading.Timer(_PATIENCE_SECONDS, lambda: setattr(options, "terminate", True))
        watch.daemon = True
        watch.start()
        values: list[Any] = []
        try:
            for window in windows:
                values = self.run(window, outputs, options)
                check(values)
        except ModelError:
            raise
        except Exception as error:  # as above
            late = f"takes more than {_PATIENCE_SECONDS:.0f} s for a window"
            raise ModelError(late if options.terminate else f"fails ({error})") from error
        finally:
            watch.cancel()
        return values

    def _only_input(self, window: int, input_name: str, whose: str) -> tuple[str, tuple[int, ...]]:
        """Return the name of the input, and the shape of the samples for it."""
        inputs = {each.name: each for each in self._session.get_inputs()}
        wanted = input_name or next(iter(inputs), "")
        if list(inputs) != [wanted]:
            wants = f"it is given only {input_name or 'samples'}"
            raise ModelError(f"takes {_listed(inputs)}; {wants}")
        kind, dims = inputs[wanted].type, inputs[wanted].shape
        shape = (*(1 for _ in dims[1:]), window)
        fits = all(not isinstance(dim, int) or dim == size for dim, size in zip(dims, shape))  # noqa: B905  a network without dimensions has none
        if kind != "tensor(float)" or not dims or not fits:
            what = f"{wanted}: {kind} of shape {dims}"
            raise ModelError(f"takes {what}; the window of {whose} has {window} samples")
        return wanted, shape


class OnnxSession:
    """A network of an ONNX file among whose outputs are embedding and logits, as `Session`.

    They are told apart by their widths. Where it gives several rows of them for a window, their
    mean counts.

    Raise `ModelError` if onnxruntime is not installed, or the file is no such network.
    """

    def __init__(self, data: bytes, window: int, embedding: int, names: int) -> None:
        self._model = OnnxModel(data, window, whose="this network")
        self._outputs = [self._output(width) for width in (embedding, names)]

    def _output(self, width: int) -> str:
        widths = {name: shape[-1] for name, shape in self._model.outputs.items() if shape}
        found = [name for name, each in widths.items() if each == width]
        if len(found) != 1:
            raise ModelError(f"gives {_listed(widths)}; of these one must have {width} values")
        return found[0]

    def __call__(self, window: Float32) -> NetworkOutput:
        """Compute the output for a window.

        Parameters
        ----------
        window : np.ndarray [shape=(window,)], float32
            Samples, -1 to 1.
        """
        values = self._model.run(window, self._outputs)
        means = (each.reshape(-1, each.shape[-1]).mean(axis=0) for each in values)
        return NetworkOutput(*(each.astype(np.float32) for each in means))


def _runtime() -> Any:
    try:
        import onnx  # noqa: F401, PLC0415
        import onnxruntime  # noqa: PLC0415  where there is a network
    except ImportError as error:
        raise ModelError(
            f"needs {error.name}, which is not installed; try: pip install '.[onnx]' in a clone of "
            "hearthlog"
        ) from error
    onnxruntime.disable_telemetry_events()
    return onnxruntime


def _check_file(data: bytes) -> None:
    """Refuse what is no network, and one whose weights are in other files."""
    import onnx  # noqa: PLC0415  only where there is a network

    try:
        network = onnx.load_model_from_string(data)
    except Exception as error:  # protobuf's, which is no dependency of ours
        raise ModelError(f"is no ONNX file ({error})") from error
    if not network.graph.node:
        raise ModelError("is no ONNX file (there is nothing in it)")
    if any(getattr(each, "data_location", 0) for each in _messages(network)):
        raise ModelError("keeps weights in other files: save it as one file")


def _messages(message: Any) -> Iterator[Any]:
    """Walk through a message of protobuf, and all that are in it."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for each in [value] if hasattr(value, "ListFields") else value:
                yield from _messages(each)


def _listed(names: Any) -> str:
    return ", ".join(names)[:_LONGEST_LIST] or "nothing"
