"""Errors, warnings and progress for the user, and texts that are safe to print."""

from collections.abc import Callable, Sequence

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


class HearthlogError(Exception):
    """Base of hearthlog's errors; the command line prints the message and ends."""

    status = 1

    def __str__(self) -> str:
        return printable(super().__str__())  # it may quote a file


class LogError(HearthlogError):
    """A log, or the folder of one, cannot be read or written."""


class HearthlogWarning(UserWarning):
    """Something is read in part only; the command line prints a line, and exits with 3.

    Parameters
    ----------
    text : str
        Names no file, because Python shows each text once.
    where : object
        The file or the topic.
    each : bool
        Whether the command line names each file of which this is said, and not the first alone.
    """

    def __init__(self, text: str, where: object, *, each: bool = False) -> None:
        super().__init__(text)
        self.where = where
        self.each = each


Progress = Callable[[float], None]  # is told the share of the work that is done, from 0 to 1


def ignore_progress(_share: float) -> None:
    """Do nothing with a report of progress.

    Parameters
    ----------
    _share : float
        Share of the work that is done, 0 to 1.
    """
