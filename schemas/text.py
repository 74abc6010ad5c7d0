"""Texts that are shown, and may come from any file."""

from collections.abc import Sequence

_LONGEST = 100  # characters of a name in a list


def printable(text: object) -> str:
    """Return a text on one line, with spaces in the place of what would steer a terminal."""
    return "".join(c if c.isprintable() else " " for c in str(text))


def shortened(text: str, length: int) -> str:
    """Shorten a text to a number of characters, and make it printable.

    Parameters
    ----------
    length : int
        Characters that are returned at most, 1 or more; the last is `…` if the text has more.
    """
    return printable(text if len(text) <= length else text[: length - 1] + "…")


def abridged(names: Sequence[str], most: int = 20) -> str:
    """List names, of many the first: `a, b and 998 more`."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(shortened(name, _LONGEST) for name in names[:most]) + more


def listed(names: Sequence[str], last: str = "or") -> str:
    """List names in a sentence: `a, b or c`.

    Parameters
    ----------
    names : sequence of str
        Names in the order of the list; without any the list is an empty text.
    """
    return f" {last} ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))
