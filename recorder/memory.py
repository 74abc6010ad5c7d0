"""Memory that is free in this process but not yet in the system."""

import ctypes
from contextlib import suppress


def give_back() -> None:
    """Give free memory back to the system, where the C library can: what grew once stays else."""
    with suppress(OSError, AttributeError):  # not every C library has it
        ctypes.CDLL(None).malloc_trim(0)
