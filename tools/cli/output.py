"""Standard output that may have no room, or whose reader may have seen enough."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hearthlog.schemas.errors import HearthlogError


class OutputClosedError(Exception):
    """Nobody reads standard output any more."""


@contextmanager
def checked_output() -> Iterator[None]:
    """Let what is printed in the block raise one of our errors where it cannot be written.

    Printing and flushing `sys.stdout` raise OutputClosedError if its reader is gone, and
    HearthlogError if it cannot be written; what is printed afterwards is thrown away.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started us
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
    plain = sys.stdout
    binary = io.BufferedWriter(_Output(plain.fileno(), "wb", closefd=False))
    sys.stdout = io.TextIOWrapper(
        binary, plain.encoding, plain.errors, line_buffering=plain.isatty()
    )
    try:
        yield
    finally:
        sys.stdout = plain


class _Output(io.FileIO):
    """A file whose errors are ours."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError as error:
            self._throw_away()
            raise OutputClosedError from error
        except OSError as error:
            self._throw_away()
            raise HearthlogError(
                f"standard output: cannot be written ({error.strerror})"
            ) from error

    def _throw_away(self) -> None:
        """Let what is still to be written go nowhere, or Python would try again when it ends."""
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, self.fileno())
        os.close(nothing)
