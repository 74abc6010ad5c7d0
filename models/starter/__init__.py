"""The models that come with hearthlog, which any command takes by their names."""

from pathlib import Path

GENERAL, BATHROOM = STARTERS = ("general", "bathroom")


def starter_file(name: str) -> Path:
    """Return the file of a starter model.

    Parameters
    ----------
    name : str
        One of `STARTERS`.
    """
    return Path(__file__).with_name(f"{name}.safetensors")
