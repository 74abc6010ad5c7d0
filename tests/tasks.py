"""Tasks for workers: functions that another process can import."""

import os
import resource
import signal
import threading
import time
from pathlib import Path

import numpy as np

from hearthlog.schemas.errors import LogError


class PickyError(Exception):
    """An error that cannot be pickled."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def own_id(*_):
    return os.getpid()


def add(first, second):
    print("a task may print")  # noqa: T201  that is what is tried
    return first + second


def page_faults(arrays=1):
    """Count the pages that arrays of a megabyte, some at once, take of the system in 100 rounds."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        held = [np.zeros(1 << 17) for _ in range(arrays)]  # 256 pages each
        for array in held:
            array.fill(1.0)
        del array, held  # the last one, too: only what is free at the end of the heap is given back
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def fail(path):
    raise LogError(f"{path}: not a log")


def fail_pickily():
    raise PickyError("this", "that")


def divide(number):
    return number / 0


def return_lock():
    return threading.Lock()


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(path):
    if not Path(path).exists():
        Path(path).touch()
        die()
    return "done"


def fail_once(path):
    if not Path(path).exists():
        Path(path).touch()
        raise LogError(f"{path}: the store cannot be used (SlowDown)")
    return "done"


def total(values, number):
    return float(values.sum()) + number


def nap(seconds):
    time.sleep(seconds)
    return "done"


def touch_and_nap(path, seconds):
    Path(path).touch()
    time.sleep(seconds)


def write_slowly(folder):
    """Hold a file, named after the process, as long as it runs."""
    path = Path(folder, str(os.getpid()))
    path.touch()
    try:
        time.sleep(100)
    finally:
        path.unlink()
