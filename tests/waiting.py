"""Waiting for what another process or thread does."""

import time


def wait_for(condition, seconds=120.0, what="", pause=0.05):
    """Poll a condition until it is true, and return what it gave; fail after so many seconds."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        last = what() if callable(what) else what
        assert time.monotonic() < deadline, f"not within {seconds} s{last and f': {last}'}"
        time.sleep(pause)
    return found
