"""Errors whose message is meant for the user: one line that says what is wrong and what to do."""

from hearthlog.schemas.text import printable


class HearthlogError(Exception):
    """Base of all of them; the command line prints the message and exits with 1."""

    def __str__(self) -> str:
        return printable(super().__str__())  # it may quote a file


class LogError(HearthlogError):
    """A log, or the folder of one, cannot be read or written."""
