"""Memory that is free in this process but not yet in the system."""

import ctypes
import gc
from contextlib import suppress

_ARENA_MAX = -8  # of malloc.h


def keep_one_heap() -> None:
    """Let all threads use one heap, where the C library can: others are never given back."""
    with suppress(OSError, AttributeError):  # not every C library has it
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def give_back() -> None:
    """Free what only refers to itself, and give free memory back, where the C library can."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
