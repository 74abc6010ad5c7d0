"""Texts that are shown, and may come from any file."""

from collections.abc import Sequence


def printable(text: object) -> str:
    """Return a text on one line, with spaces in the place of what would steer a terminal."""
    return "".join(c if c.isprintable() else " " for c in str(text))


def shortened(text: str, length: int) -> str:
    """Return a text as it can be printed, of at most so many characters."""
    return printable(text if len(text) <= length else text[: length - 1] + "…")


def listed(names: Sequence[str]) -> str:
    """List alternatives: `a, b or c`."""
    return " or ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))
