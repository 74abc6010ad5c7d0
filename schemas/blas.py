"""The kernel with which numpy's OpenBLAS multiplies, chosen before numpy is imported."""

import os
from pathlib import Path

_VARIABLE = "OPENBLAS_CORETYPE"
_AVX512 = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
_CPU = Path("/proc/cpuinfo")
_READ_BYTES = 1 << 14  # its first processor


def kernel_environment() -> dict[str, str]:
    """Return variables with which OpenBLAS takes the fastest kernel that this processor can run.

    On processors that are newer than itself it takes one without AVX-512, which is half as fast.

    Returns
    -------
    dict of str to str
        Empty if the choice is left to OpenBLAS: if the user has chosen, if the processor has no
        AVX-512, or if that is unknown, as on systems other than Linux.
    """
    if _VARIABLE in os.environ or not _flags() >= _AVX512:
        return {}
    return {_VARIABLE: "SkylakeX"}


def _flags() -> set[str]:
    """Return what the processor can, in the words of Linux."""
    try:
        with _CPU.open(encoding="ascii", errors="replace") as file:
            lines = file.read(_READ_BYTES).splitlines()
    except OSError:
        return set()
    return {flag for line in lines if line.startswith("flags") for flag in line.split()}
