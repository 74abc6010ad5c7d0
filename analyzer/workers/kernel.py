"""Which kernel numpy multiplies with."""


def kernel_in_use() -> str:
    """Return the library and the kernel of the products of this process.

    Returns
    -------
    str
        Such as "openblas SkylakeX"; empty if it is another library than OpenBLAS, or not known
        for want of threadpoolctl.
    """
    try:
        from threadpoolctl import threadpool_info  # noqa: PLC0415  part of the extra `headless`
    except ModuleNotFoundError:
        return ""
    kernels = (each.get("architecture") for each in threadpool_info())
    return next((f"openblas {kernel}" for kernel in kernels if kernel), "")
