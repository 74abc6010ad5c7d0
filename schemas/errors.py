"""Errors, warnings and progress for the user, and printable texts."""

from collections.abc import Callable, Sequence

_LONGEST = 100  # maximum characters of a name in a list


def printable(text: object) -> str:
    """Return a text on one line, with terminal control characters replaced by spaces."""
    return "".join(c if c.isprintable() else " " for c in str(text))


def shortened(text: str, length: int) -> str:
    """Truncate a text to at most `length` characters, at least 1, and make it printable.

    The last character is `…` if the text was longer.
    """
    return printable(text if len(text) <= length else text[: length - 1] + "…")


def abridged(names: Sequence[str], most: int = 20) -> str:
    """List names, truncated to the first: `a, b and 998 more`."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(shortened(name, _LONGEST) for name in names[:most]) + more


def listed(names: Sequence[str], last: str = "or") -> str:
    """List names, in their order, in a sentence: `a, b or c`; empty without names."""
    return f" {last} ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


class HearthlogError(Exception):
    """Base of hearthlog's errors; the command line prints the message and exits."""

    status = 1

    def __str__(self) -> str:
        return printable(super().__str__())  # may contain text of a file


class LogError(HearthlogError):
    """Log or folder of logs that cannot be read or written."""


class ModelError(HearthlogError):
    """A model file is missing, damaged, or incompatible."""


class SourceError(HearthlogError):
    """An unreadable audio file, or a microphone that cannot be opened."""


class ConfigurationError(HearthlogError):
    """An unknown, invalid or contradictory configuration."""

    status = 2

    def __init__(self, *lines: str) -> None:
        super().__init__("; ".join(lines))
        self.lines = lines


class DeviceError(SourceError):
    """A missing microphone, or one that cannot be opened now."""


class HearthlogWarning(UserWarning):
    """Partially read data; the command line prints a line, and exits with 3.

    Parameters
    ----------
    text : str
        Without file names, because Python shows each text once.
    where : object
        File or topic.
    each : bool
        Whether the command line names every affected file, rather than only the first.
    """

    def __init__(self, text: str, where: object, *, each: bool = False) -> None:
        super().__init__(text)
        self.where = where
        self.each = each


Progress = Callable[[float], None]  # called with the completed share, from 0 to 1


def ignore_progress(_share: float) -> None:
    """Ignore a progress report of a share, 0 to 1."""
