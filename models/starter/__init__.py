"""The models that come with hearthlog, which any command takes by their names."""

from pathlib import Path

GENERAL, BATHROOM = BY_FEATURES = ("general", "bathroom")
NETWORK = "yamnet"  # whose embeddings the others take


def with_network(name: str) -> str:
    """Name the starter model that takes embeddings, of one that goes by features alone.

    Parameters
    ----------
    name : str
        One of `BY_FEATURES`.
    """
    return f"{name}-embedding"


STARTERS = (*BY_FEATURES, *map(with_network, BY_FEATURES))
SHA256 = {  # of their files, as `sha256sum` prints it
    GENERAL: "d5f6f6cb0736ba4ab933943ebbef25d1d53f99de02f49ffa509d621747f2587f",
    BATHROOM: "0344b38fa1cf06a446ee491bbad6fe8b6dd73ec89296849baf7e7adae6cb6d75",
    with_network(GENERAL): "40f4e88a375706f1891633b97e0e1128a59710e21f19e11923896d1e0b62afda",
    with_network(BATHROOM): "7196f934d21562bdbef8bbfd12f262309cbbc5711150271c92bcb7ae63bcea3c",
}


def starter_file(name: str) -> Path:
    """Return the file of a starter model.

    Parameters
    ----------
    name : str
        One of `STARTERS`.
    """
    return Path(__file__).with_name(f"{name}.safetensors")
