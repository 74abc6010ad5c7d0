"""What the recorder of a fast month and the one who watches it both know: a few numbers."""

import ctypes
import mmap
from pathlib import Path


class SharedState(ctypes.Structure):
    """Numbers in a file that is mapped into memory: they outlive a process that is killed.

    Attributes
    ----------
    now : int
        Since the month began; like all of these in nanoseconds.
    boot : int
        When CLOCK_MONOTONIC was 0; later by each time that the machine was suspended.
    clock_error : int
        CLOCK_REALTIME less the true time.
    next_fault : int
        Number of the first fault that has not happened.
    request : int
        Number of the fault that is to be done to the recorder, plus 1; 0 for none.
    first_sound, last_sound : int
        Start of the first sample that this process was given and end of the last one, by
        CLOCK_MONOTONIC.
    """

    _fields_ = tuple(
        (name, ctypes.c_int64)
        for name in (
            "now",
            "boot",
            "clock_error",
            "next_fault",
            "request",
            "first_sound",
            "last_sound",
        )
    )


def shared_state(path: Path) -> SharedState:
    """Map the file of the numbers, which is made if it is not there, all of them 0.

    Parameters
    ----------
    path : Path
    """
    size = ctypes.sizeof(SharedState)
    with path.open("a+b") as file:
        file.truncate(size)
        return SharedState.from_buffer(mmap.mmap(file.fileno(), size))
