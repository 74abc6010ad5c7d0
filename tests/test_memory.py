"""The recorder gives back the memory that it needed for a while."""

import subprocess
import sys

# a process of its own: what earlier tests took and freed would be taken first
SCRIPT = """
import ctypes
from pathlib import Path

from hearthlog.recorder.host import give_back

PIECES, BYTES = 400_000, 200  # such as the C library keeps


def anonymous():
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("Anonymous:")) * 1024


libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
before = anonymous()
pieces = [libc.malloc(BYTES) for _ in range(PIECES)]
last = libc.malloc(BYTES)  # keeps the heap from shrinking by itself
for piece in pieces:
    libc.free(piece)
held = anonymous() - before
del pieces
give_back()
assert held > PIECES * BYTES * 0.9, held
assert anonymous() - before < held - PIECES * BYTES * 0.8, anonymous() - before
"""


def test_what_many_small_pieces_took_goes_back_to_the_system():
    subprocess.run([sys.executable, "-c", SCRIPT], check=True, timeout=60)
