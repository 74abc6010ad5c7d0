"""Memory that is free in this process but not yet in the system."""

import ctypes
import gc
from contextlib import suppress
from functools import cache

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of malloc.h
_MMAP_BYTES = 32 << 20  # up to which glibc raises it by itself, if nobody sets either


def keep_one_heap() -> None:
    """Let all threads use one heap, where the C library can: others are never given back."""
    with suppress(OSError, AttributeError):  # not every C library has it
        ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


@cache
def keep_freed_blocks() -> None:
    """Let freed arrays be used again, instead of giving them back to the system.

    Of what is free above the last block in use, glibc keeps 64 MB then. Otherwise a tenth of the
    time of relabelling goes into having it again, and half where a nanny of Dask has set less.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _MMAP_BYTES)
        mallopt(_TRIM_THRESHOLD, 2 * _MMAP_BYTES)


def give_back() -> None:
    """Free what only refers to itself, and give free memory back, where the C library can."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
