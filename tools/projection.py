"""Fix the projection of YAMNet: `python -m hearthlog.tools.projection YAMNET MANIFEST -o FILE`.

The components are the singular vectors of the network's last layer, of the rows of the names that
are logged: no sound decides what they are. Licensed recordings decide only the mean and the
deviation of each. Logs and models depend on the file: it is made once for a network.
"""

import argparse
from pathlib import Path

import numpy as np

from hearthlog.analyzer.training.clip_sound import clip_frames
from hearthlog.analyzer.training.manifest import read_manifest
from hearthlog.analyzer.training.scenario import LABELS
from hearthlog.models.classes import SILENCE
from hearthlog.models.embedding.audioset import GROUPS
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.projection import Projection, write_projection
from hearthlog.models.embedding.session import TfliteSession
from hearthlog.models.licences import may_be_shipped
from hearthlog.schemas.arrays import Float32

_COMPONENTS = 64
_HOP = 8000  # samples
_PADDING = 75.0  # dB below full scale
_STEP_OF_COMPONENT = 0.25  # standard deviations: finer ones took bytes and gave nothing
_STEP_OF_CLASS, _LOW_OF_CLASS = 0.25, -12.5  # logits
_STEP_OF_NAME, _LOW_OF_NAME = 0.5, -5.0  # what is less likely says nothing
_CLASSES = tuple(GROUPS).index("outside") + 1  # those before are of a name each


def main() -> None:
    """Compute it and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("network", type=Path)
    parser.add_argument("manifests", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    data = options.network.read_bytes()
    embeddings = np.concatenate([_embeddings(data, one) for one in options.manifests])
    names = Path(__file__).parents[1] / "models" / "embedding" / "yamnet_names.txt"
    fixed = fixed_projection(last_layer(data), embeddings, names.read_text().splitlines())
    write_projection(fixed, options.output)


def last_layer(network: bytes) -> Float32:
    """Return the weights from the embedding to the scores, shape (names, width).

    Parameters
    ----------
    network : bytes
        A TFLite file, in which these are 8 bit and a scale.
    """
    from ai_edge_litert.interpreter import Interpreter  # noqa: PLC0415  not everybody has it

    interpreter = Interpreter(model_content=network)
    shape = [YAMNET.names, YAMNET.width]
    (tensor,) = (
        each for each in interpreter.get_tensor_details() if each["shape"].tolist() == shape
    )
    interpreter.allocate_tensors()
    scales = np.atleast_1d(tensor["quantization_parameters"]["scales"])
    weights: Float32 = interpreter.get_tensor(tensor["index"]) * scales[:, np.newaxis]
    return weights


def fixed_projection(weights: Float32, embeddings: Float32, names: list[str]) -> Projection:
    """Return the projection onto components of embeddings, and groups of names.

    Parameters
    ----------
    weights : np.ndarray [shape=(N, E)], float32
        Of the network's last layer.
    embeddings : np.ndarray [shape=(n, E)], float32
        Of sounds.
    names : list of str
        Of the network's scores.
    """
    members = {group: [names.index(name) for name in each] for group, each in GROUPS.items()}
    rows = weights[sorted({row for each in members.values() for row in each})].astype(np.float64)
    _, _, vectors = np.linalg.svd(rows - rows.mean(axis=0), full_matrices=False)
    components = vectors[:_COMPONENTS].T
    components /= (embeddings @ components).std(axis=0)
    components *= np.where(components.sum(axis=0) < 0, -1.0, 1.0)  # a sign is free
    counts = (_COMPONENTS, _CLASSES, len(GROUPS) - _CLASSES)
    steps = np.repeat([_STEP_OF_COMPONENT, _STEP_OF_CLASS, _STEP_OF_NAME], counts)
    lows = np.repeat([-127 * _STEP_OF_COMPONENT, _LOW_OF_CLASS, _LOW_OF_NAME], counts)
    return Projection(
        mean=embeddings.mean(axis=0, dtype=np.float64).astype(np.float16).astype(np.float32),
        components=components.astype(np.float16).astype(np.float32),
        steps=steps.astype(np.float32),
        lows=lows.astype(np.float32),
        groups=members,
    )


def _embeddings(network: bytes, manifest: Path) -> Float32:
    """Return the embeddings of the sounds of a manifest that may be learned from."""
    session = TfliteSession(network, YAMNET.window, YAMNET.width, YAMNET.names)
    noise = np.random.default_rng(1)
    found = []
    for clip in read_manifest(manifest, LABELS):
        if not may_be_shipped(clip.licence) or clip.label == SILENCE:
            continue
        samples = clip_frames(clip).ravel()
        padded = np.pad(samples, YAMNET.window // 2)
        padded += noise.normal(0.0, 10 ** (-_PADDING / 20), len(padded)).astype(np.float32)
        starts = range(0, len(padded) - YAMNET.window + 1, _HOP)
        found += [session(padded[start : start + YAMNET.window]).embedding for start in starts]
    return np.stack(found)


if __name__ == "__main__":
    main()
