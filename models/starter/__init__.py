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
    GENERAL: "e8d9881ca23c612b1ac56bf9ffa98c5db140215caf77ea71e39f60d2d6e6028c",
    BATHROOM: "d3bb9a7f0a5a08a704e70744be52eedc9d07088c091022002e5d04c54458372e",
    with_network(GENERAL): "4327d3a56cc170dc1bd54cfd391633a347f51dece33c20045a683eea96014f6a",
    with_network(BATHROOM): "c0bb6c7efb362ea436b4ff9b97c079b9f0fcf01ddfe0931194c0966468bf79db",
}


def starter_file(name: str) -> Path:
    """Return the file of a starter model.

    Parameters
    ----------
    name : str
        One of `STARTERS`.
    """
    return Path(__file__).with_name(f"{name}.safetensors")
