"""Which kernel numpy multiplies with."""

from threadpoolctl import threadpool_info


def kernel_in_use() -> str:
    """Return the library and the kernel of the products of this process.

    Returns
    -------
    str
        Such as "openblas SkylakeX"; empty if it is another library than OpenBLAS.
    """
    kernels = (each.get("architecture") for each in threadpool_info())
    return next((f"openblas {kernel}" for kernel in kernels if kernel), "")
