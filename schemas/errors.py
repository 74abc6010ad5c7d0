"""Errors and warnings for the user: one line that says what is wrong and what to do."""

from hearthlog.schemas.text import printable


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
