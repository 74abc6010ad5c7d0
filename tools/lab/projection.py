"""Fix the projection of YAMNet: `python -m hearthlog.tools.lab.projection YAMNET MANIFEST -o FILE`.

The components are the directions of the embedding in which the network's last layer tells the names
of the groups apart: its singular vectors. Principal components of the licensed recordings, of which
one is music and none a telephone, know those sounds badly. The recordings give the mean and the
scale. Logs and models depend on the file: it is made once for a network.
"""

import argparse
from pathlib import Path

import numpy as np
from ai_edge_litert.interpreter import Interpreter

from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.model import may_be_shipped
from hearthlog.models.embedding import Projection, write_projection
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.session import TfliteSession
from hearthlog.models.embedding.sound_names import GROUPS
from hearthlog.schemas.arrays import Float32

_COMPONENTS = 64
_HOP = 8000  # samples
_PADDING = 75.0  # dB below full scale
_STEP_OF_COMPONENT = 0.5  # standard deviations: finer ones take bytes and give nothing
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
    embeddings = np.concatenate([_embeddings(options.network, one) for one in options.manifests])
    names = Path(__file__).parents[2] / "models" / "embedding" / "yamnet_names.txt"
    layer = _last_layer(options.network)
    projection = fixed_projection(layer, embeddings, names.read_text().splitlines())
    write_projection(projection, options.output)


def fixed_projection(layer: Float32, embeddings: Float32, names: list[str]) -> Projection:
    """Return the projection onto components of embeddings, and groups of names.

    Parameters
    ----------
    layer : np.ndarray [shape=(N, E)], float32
        Weights from the embedding to the scores.
    embeddings : np.ndarray [shape=(n, E)], float32
        Of sounds.
    names : list of str
        Of the network's scores.
    """
    mean = embeddings.mean(axis=0, dtype=np.float64)
    members = sorted({names.index(name) for group in GROUPS.values() for name in group})
    rows = layer[members].astype(np.float64)
    _, _, vectors = np.linalg.svd(rows - rows.mean(axis=0), full_matrices=False)
    components = vectors[:_COMPONENTS].T
    components /= np.std((embeddings - mean) @ components, axis=0)
    components *= np.where(components.sum(axis=0) < 0, -1.0, 1.0)  # a sign is free
    singles = len(GROUPS) - _CLASSES
    counts = (_COMPONENTS, _CLASSES, singles)
    steps = np.repeat([_STEP_OF_COMPONENT, _STEP_OF_CLASS, _STEP_OF_NAME], counts)
    lows = np.repeat([-127 * _STEP_OF_COMPONENT, _LOW_OF_CLASS, _LOW_OF_NAME], counts)
    return Projection(
        mean=mean.astype(np.float16).astype(np.float32),
        components=components.astype(np.float16).astype(np.float32),
        steps=steps.astype(np.float32),
        lows=lows.astype(np.float32),
        groups={
            group: [names.index(name) for name in members] for group, members in GROUPS.items()
        },
    )


def _last_layer(network: Path) -> Float32:
    """Return the weights of the last layer, which may be kept in eight bits."""
    interpreter = Interpreter(str(network))
    interpreter.allocate_tensors()
    shape = [YAMNET.names, YAMNET.width]
    (tensor,) = (
        each for each in interpreter.get_tensor_details() if each["shape"].tolist() == shape
    )
    scales = tensor["quantization_parameters"]["scales"]
    weights: Float32 = interpreter.get_tensor(tensor["index"]).astype(np.float32)
    return weights * scales[:, np.newaxis] if len(scales) else weights


def _embeddings(network: Path, manifest: Path) -> Float32:
    """Return the embeddings of the sounds of a manifest that may be learned from."""
    session = TfliteSession(network.read_bytes(), YAMNET.window, YAMNET.width, YAMNET.names)
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
