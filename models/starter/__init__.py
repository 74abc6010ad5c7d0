"""The models that come with hearthlog, which any command takes by their names."""

from pathlib import Path

GENERAL, BATHROOM = STARTERS = ("general", "bathroom")
SHA256 = {  # of their files, as `sha256sum` prints it
    GENERAL: "d5f6f6cb0736ba4ab933943ebbef25d1d53f99de02f49ffa509d621747f2587f",
    BATHROOM: "0344b38fa1cf06a446ee491bbad6fe8b6dd73ec89296849baf7e7adae6cb6d75",
}


def starter_file(name: str) -> Path:
    """Return the file of a starter model.

    Parameters
    ----------
    name : str
        One of `STARTERS`.
    """
    return Path(__file__).with_name(f"{name}.safetensors")
