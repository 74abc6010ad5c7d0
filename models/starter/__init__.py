"""The models that come with hearthlog, available by name in any command."""

from pathlib import Path

GENERAL, BATHROOM = BY_FEATURES = ("general", "bathroom")
NETWORK = "yamnet"  # network of the models with embeddings


def with_network(name: str) -> str:
    """Return the name of the variant with embeddings of a features-only starter model."""
    return f"{name}-embedding"


STARTERS = (*BY_FEATURES, *map(with_network, BY_FEATURES))
SHA256 = {  # of the files, as printed by `sha256sum`
    GENERAL: "e3e7ee19f6e4d72ad2d96a0a542f73523909a01a732fd954673926946d2d50f9",
    BATHROOM: "02858ba08481e7d780603cd9a21f00618e8dcb82b36e30f5bf5f895bf058a926",
    with_network(GENERAL): "61f1c3a65b0bffd4529fb979a073452ce095a1ed4968fdbbe6e7336fdd784103",
    with_network(BATHROOM): "75b6aa4555823e11bb8c640d20f7bc662aa0524b1542a49220528364f608e60b",
}


def starter_file(name: str) -> Path:
    """Return the file of a starter model."""
    return Path(__file__).with_name(f"{name}.safetensors")
