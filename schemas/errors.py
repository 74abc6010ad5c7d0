"""Errors whose message is meant for the user: one line that says what is wrong and what to do."""


class HearthlogError(Exception):
    """Base of all of them; the command line prints the message and exits with 1."""


class LogError(HearthlogError):
    """A log, or the folder of one, cannot be read or written."""
