"""Texts that are shown, and may come from any file."""


def printable(text: object) -> str:
    """Return a text on one line, with spaces in the place of what would steer a terminal."""
    return "".join(c if c.isprintable() else " " for c in str(text))
