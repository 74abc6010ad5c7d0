"""Runtimes of networks of sounds, LiteRT and onnxruntime: samples in, embedding and scores out."""

import os
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Protocol

import numpy as np

from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import ModelError

# Field numbers of the tables in the TFLite schema.
_SUBGRAPHS, _TENSORS, _OUTPUTS, _OPERATORS = 2, 0, 2, 3
_SHAPE, _OPERATOR_INPUTS, _OPERATOR_OUTPUTS = 0, 1, 2
_MOST_STEPS = 64
_NOTICE = b"XNNPACK delegate"  # in the line that LiteRT prints about its delegate
_loading = threading.Lock()


class NetworkOutput(NamedTuple):
    """The output of a network for a window."""

    embedding: Float32  # [shape=(E,)]
    logits: Float32  # [shape=(N,)] of the classes with names


class NetworkSession(Protocol):
    """A loaded network."""

    def __call__(self, window: Float32) -> NetworkOutput:
        """Compute the output for a window.

        Parameters
        ----------
        window : np.ndarray [shape=(window,)], float32
            Samples, -1 to 1.
        """


class TfliteSession:
    """A network from a TFLite file, as `NetworkSession`.

    Its embedding and logits need not be among its outputs. The file is not unpacked: an extended
    list of outputs is appended, because the library that rewrites such files takes 50 MB. Raise
    `ModelError` if LiteRT is not installed, or the file is not such a network.
    """

    def __init__(self, data: bytes, window: int, embedding: int, names: int) -> None:
        interpreter_type = _interpreter_type()
        try:
            data, places = _with_outputs(data, embedding, names)
        except (struct.error, ValueError, IndexError) as error:
            raise ModelError(f"is no TFLite file that can be used ({error})") from error
        try:
            with _without_notice():
                self._interpreter = interpreter_type(model_content=data, num_threads=1)
                self._interpreter.allocate_tensors()
            (given,) = self._interpreter.get_input_details()
        except (ValueError, RuntimeError) as error:
            raise ModelError(f"is no network that LiteRT takes ({error})") from error
        shape, dtype = given["shape"].tolist(), given["dtype"]
        if int(np.prod(shape)) != window or dtype is not np.float32:
            raise ModelError(f"takes {np.dtype(dtype)} of shape {shape}, not {window} samples")
        self._input, self._shape = given["index"], shape
        self._embedding, self._logits = places

    def __call__(self, window: Float32) -> NetworkOutput:
        """Compute the output for a window of samples [shape=(window,)], -1 to 1."""
        self._interpreter.set_tensor(self._input, window.reshape(self._shape))
        self._interpreter.invoke()
        tensors = (self._interpreter.get_tensor(each) for each in (self._embedding, self._logits))
        return NetworkOutput(*(each.reshape(-1) for each in tensors))


@contextmanager
def _without_notice() -> Iterator[None]:
    """Suppress the line that LiteRT prints to standard error about its delegate, without a switch.

    Other output in the meantime, from any thread, appears when the block ends.
    """
    with _loading, ExitStack() as stack:
        try:
            error = os.dup(2)
            stack.callback(os.close, error)
            lines = stack.enter_context(tempfile.TemporaryFile(buffering=0))
        except OSError:  # no standard error, or no space: then do not suppress the line
            yield
            return
        os.dup2(lines.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(error, 2)
            lines.seek(0)
            kept = [line for line in lines.read().splitlines(keepends=True) if _NOTICE not in line]
            if kept:
                os.write(2, b"".join(kept))


def _interpreter_type() -> Any:
    try:
        from ai_edge_litert.interpreter import Interpreter  # noqa: PLC0415  where there is a network
    except ImportError as error:
        raise ModelError(
            "needs LiteRT, which is not installed; try: pip install '.[embedding]' in a clone of "
            "hearthlog"
        ) from error
    return Interpreter


def _with_outputs(data: bytes, embedding: int, names: int) -> tuple[bytes, tuple[int, int]]:
    """Add the tensors of embedding and logits to a network's outputs; return their numbers."""
    model = _Table(data, *struct.unpack_from("<I", data))
    graph = model.tables(_SUBGRAPHS)[0]
    tensors, operators = graph.tables(_TENSORS), graph.tables(_OPERATORS)
    maker = {number: each for each in operators for number in each.numbers(_OPERATOR_OUTPUTS)}
    scores = graph.numbers(_OUTPUTS)[0]
    found: dict[int, int] = {}
    for number in _upstream(scores, maker):
        width = (tensors[number].numbers(_SHAPE) or [0])[-1]
        if width == names:
            found[names] = number  # the last tensor found is the input of the logistic function
        if width == embedding:
            found[embedding] = number
            break
    if found.keys() != {names, embedding} or found[names] == scores:
        raise ValueError(f"there is no embedding of {embedding} values before {names} scores")
    places = found[embedding], found[names]
    field = graph.place(_OUTPUTS)
    data += bytes(-len(data) % 4)
    outputs = struct.pack("<4i", 3, scores, *places)
    redirected = struct.pack("<I", len(data) - field)
    return data[:field] + redirected + data[field + 4 :] + outputs, places


def _upstream(number: int, maker: "dict[int, _Table]") -> Iterator[int]:
    """Iterate over the tensors from which a tensor is computed, by each operator's first input."""
    for _ in range(_MOST_STEPS):
        yield number
        if number not in maker:
            return
        number = maker[number].numbers(_OPERATOR_INPUTS)[0]


class _Table:
    """A table of a FlatBuffers file: https://flatbuffers.dev/internals."""

    def __init__(self, data: bytes, place: int) -> None:
        self._data, self._place = data, place
        back = struct.unpack_from("<i", data, place)[0]
        self._fields = place - back
        self._size = struct.unpack_from("<H", data, self._fields)[0]

    def place(self, field: int) -> int:
        """Return the position of a field; 0 if it is absent."""
        entry = 4 + 2 * field
        if entry >= self._size:
            return 0
        offset = struct.unpack_from("<H", self._data, self._fields + entry)[0]
        return self._place + offset if offset else 0

    def numbers(self, field: int) -> list[int]:
        """Return the vector of a field."""
        place, count = self._vector(field)
        return list(struct.unpack_from(f"<{count}i", self._data, place))

    def tables(self, field: int) -> "list[_Table]":
        """Return the tables in the vector of a field."""
        place, _ = self._vector(field)
        offsets = self.numbers(field)
        return [_Table(self._data, place + 4 * i + each) for i, each in enumerate(offsets)]

    def _vector(self, field: int) -> tuple[int, int]:
        place = self.place(field)
        if not place:
            return 0, 0
        place += struct.unpack_from("<I", self._data, place)[0]
        count = struct.unpack_from("<I", self._data, place)[0]
        if 4 * count > len(self._data):
            raise ValueError("it is damaged")
        return place + 4, count


_FATAL_ONLY = 4
_PATIENCE_SECONDS = 20.0
_LONGEST_LIST = 64  # characters of names in a message


class OnnxModel:
    """A network with one input, the samples of a window; `input_name` is empty for the only input.

    Raise `ModelError` if onnxruntime is not installed, or the file is not such a network.
    """

    def __init__(
        self, data: bytes, window: int, input_name: str = "", owner: str = "its card"
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
        except Exception as error:  # onnxruntime raises a dozen types without a common base
            raise ModelError(f"is no network that onnxruntime takes ({error})") from error
        self._input, self._shape = self._only_input(window, input_name, owner)
        self.outputs = {each.name: list(each.shape) for each in self._session.get_outputs()}

    def run(self, samples: Float32, outputs: Sequence[str], options: Any = None) -> list[Any]:
        """Compute outputs for samples [shape=(window,)]; onnxruntime raises various errors."""
        return self._session.run(
            list(outputs), {self._input: samples.reshape(self._shape)}, options
        )

    def chosen_output(self, wanted: str) -> str:
        """Return the name of the wanted output, or of the only output if `wanted` is empty.

        Raise `ModelError` if there is no such output, or several.
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
        """Run the network on some windows, for at most some seconds; return the last outputs.

        Raise `ModelError` if the network fails, takes too long, or an output is invalid.
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

    def _only_input(self, window: int, input_name: str, owner: str) -> tuple[str, tuple[int, ...]]:
        """Return the name of the input, and the shape of its samples."""
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
            raise ModelError(f"takes {what}; the window of {owner} has {window} samples")
        return wanted, shape


class OnnxSession:
    """A network from an ONNX file whose outputs include embedding and logits, as `Session`.

    They are identified by their widths. Several rows per window are averaged. Raise `ModelError` if
    onnxruntime is not installed, or the file is not such a network.
    """

    def __init__(self, data: bytes, window: int, embedding: int, names: int) -> None:
        self._model = OnnxModel(data, window, owner="this network")
        self._outputs = [self._output(width) for width in (embedding, names)]

    def _output(self, width: int) -> str:
        widths = {name: shape[-1] for name, shape in self._model.outputs.items() if shape}
        found = [name for name, each in widths.items() if each == width]
        if len(found) != 1:
            raise ModelError(f"gives {_listed(widths)}; of these one must have {width} values")
        return found[0]

    def __call__(self, window: Float32) -> NetworkOutput:
        """Compute the output for a window of samples [shape=(window,)], -1 to 1."""
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
    """Refuse files that are not networks, and networks with weights in other files."""
    import onnx  # noqa: PLC0415  only where there is a network

    try:
        network = onnx.load_model_from_string(data)
    except Exception as error:  # protobuf's error, and protobuf is not our dependency
        raise ModelError(f"is no ONNX file ({error})") from error
    if not network.graph.node:
        raise ModelError("is no ONNX file (there is nothing in it)")
    if any(getattr(each, "data_location", 0) for each in _messages(network)):
        raise ModelError("keeps weights in other files: save it as one file")


def _messages(message: Any) -> Iterator[Any]:
    """Iterate over a protobuf message and all nested messages."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for each in [value] if hasattr(value, "ListFields") else value:
                yield from _messages(each)


def _listed(names: Any) -> str:
    return ", ".join(names)[:_LONGEST_LIST] or "nothing"
