"""A folder of models that differ, made of one without learning anew."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from hearthlog.models.classifiers.model import Model, Smoothing
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.registry import override_judgement


def keep_models(folder: Path, model_file: Path) -> Path:
    """Make the models `one`, `two` and `broad`, the first of them the champion; each may label."""
    folder.mkdir()
    one = load_model(model_file)
    rng = np.random.default_rng(6)
    bias = one.arrays["bias"]
    moved = bias + 2.0 * rng.standard_normal(bias.shape)
    two = replace(
        one,
        description=one.description.model_copy(update={"smoothing": Smoothing(method="merge")}),
        arrays={**one.arrays, "bias": moved},
        transitions=np.empty((0, 0)),
    )
    save_model(one, folder / "one.safetensors")
    save_model(two, folder / "two.safetensors")
    save_model(_of_a_second(one), folder / "broad.safetensors")
    (folder / "champion.safetensors").symlink_to("one.safetensors")
    for name in ("one", "two", "broad"):
        override_judgement(folder, load_model(folder / f"{name}.safetensors").sha256)
    return folder


def put_by_hand(folder: Path, name: str) -> None:
    """Point the champion to a file without a check."""
    link = folder / ".by_hand"
    link.symlink_to(name)
    link.replace(folder / "champion.safetensors")


def _of_a_second(model: Model) -> Model:
    """Make a model that looks at the same sounds in another way, and smooths what it sees."""
    rng = np.random.default_rng(4)
    count = len(model.arrays["landmarks"])
    width, classes = DEFAULT.inputs["statistics"].width, len(model.classes)
    description = model.description.model_copy(
        update={
            "inputs": "statistics",
            "window_seconds": 1.0,
            "label_frame": 10,
            "gate": 0.0,
            "parameters": model.description.parameters | {"gamma": 0.5 / width},
            "smoothing": Smoothing(method="hmm", lag_seconds=0.7),
        }
    )
    arrays = {
        **model.arrays,
        "scaler_mean": rng.standard_normal(width),
        "scaler_scale": rng.uniform(10.0, 20.0, width),
        "landmarks": rng.normal(0, 15, (count, width)).astype(np.float32),
    }
    transitions = np.full((classes, classes), 0.02 / classes) + 0.98 * np.eye(classes)
    return replace(model, description=description, arrays=arrays, transitions=transitions)
