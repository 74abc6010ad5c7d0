"""Small networks for tests: an ONNX file, and its card."""

import hashlib
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

WIDTH = 16
_KERNEL, _STEP = 512, 256


def spectral_network(shape=(1, 15_600), rate=16_000) -> bytes:
    """A network that gives the mean level of sixteen bands: filters of cosines, and a logarithm."""
    hertz = np.geomspace(100.0, 0.45 * rate, WIDTH)[:, np.newaxis]
    filters = np.cos(2 * np.pi * hertz / rate * np.arange(_KERNEL)) * np.hanning(_KERNEL)
    constants = {
        "filters": filters.astype(np.float32)[:, np.newaxis],
        "tiny": np.array([1e-5], np.float32),
        "row": np.array([1, 1, -1], np.int64),
    }
    return model(
        [
            helper.make_node("Reshape", ["waveform", "row"], ["samples"]),
            helper.make_node("Conv", ["samples", "filters"], ["filtered"], strides=[_STEP]),
            helper.make_node("Abs", ["filtered"], ["sizes"]),
            helper.make_node("ReduceMean", ["sizes"], ["means"], axes=[2], keepdims=0),
            helper.make_node("Add", ["means", "tiny"], ["positive"]),
            helper.make_node("Log", ["positive"], ["embedding"]),
        ],
        constants,
        shape,
        {"embedding": [1, WIDTH]},
    )


def model(nodes, constants, shape, outputs, kind=TensorProto.FLOAT) -> bytes:
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("waveform", kind, shape)],
        [
            helper.make_tensor_value_info(*(name, TensorProto.FLOAT, dims))
            for name, dims in outputs.items()
        ],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    return made.SerializeToString()


def write_network(folder: Path, name: str, network: bytes | None = None, **card) -> Path:
    """Write a network and its card into a folder of data; return the card."""
    networks = folder / "hearthlog" / "networks"
    networks.mkdir(parents=True, exist_ok=True)
    network = spectral_network() if network is None else network
    networks.joinpath(f"{name}.onnx").write_bytes(network)
    content = {
        "sha256": hashlib.sha256(network).hexdigest(),
        "sample_rate": 16_000,
        "window_seconds": 0.975,
        "hop_seconds": 0.5,
        "width": WIDTH,
    } | card
    lines = [f"{key} = {value!r}" for key, value in content.items() if value is not None]
    path = networks / f"{name}.toml"
    path.write_text("\n".join(lines) + "\n")
    return path
