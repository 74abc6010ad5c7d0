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
    with_network(GENERAL): "7abe988c8b6c189234cbdc9ce17ea13723e1390205ab9a035852e55a38fc7523",
    with_network(BATHROOM): "337e4fb2e18247bc01fd9ce9fa0653e57fbfd75225f0ec450e1c381c6328fe00",
}


def starter_file(name: str) -> Path:
    """Return the file of a starter model.

    Parameters
    ----------
    name : str
        One of `STARTERS`.
    """
    return Path(__file__).with_name(f"{name}.safetensors")
