"""Texts that are shown, and may come from any file."""


def printable(text: object) -> str:
    """Return a text on one line, with spaces in the place of what would steer a terminal."""
    return "".join(c if c.isprintable() else " " for c in str(text))


def shortened(text: str, length: int) -> str:
    """Return a text as it can be printed, of at most so many characters."""
    return printable(text if len(text) <= length else text[: length - 1] + "…")
