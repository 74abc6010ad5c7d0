"""Matrix kernel of numpy's OpenBLAS, selected before numpy is imported."""

import os
from pathlib import Path

_VARIABLE = "OPENBLAS_CORETYPE"
_AVX512 = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
_CPU = Path("/proc/cpuinfo")
_READ_BYTES = 1 << 14  # covers the first processor in the file


def kernel_environment() -> dict[str, str]:
    """Return environment variables that select the fastest OpenBLAS kernel of this processor.

    For processors newer than itself, OpenBLAS selects one without AVX-512, at half the speed. They
    are empty if OpenBLAS should choose: if the user has set a kernel, or the processor has no
    AVX-512 or is unknown, as on systems other than Linux.
    """
    if _VARIABLE in os.environ or not _flags() >= _AVX512:
        return {}
    return {_VARIABLE: "SkylakeX"}


def _flags() -> set[str]:
    """Return the processor's feature flags, in the terms of Linux."""
    try:
        with _CPU.open(encoding="ascii", errors="replace") as file:
            lines = file.read(_READ_BYTES).splitlines()
    except OSError:
        return set()
    return {flag for line in lines if line.startswith("flags") for flag in line.split()}
