"""Shares of votes as decision values."""

import numpy as np

from hearthlog.schemas.arrays import Float64

LEAST_SHARE = 0.01  # a class without a vote is not impossible


def log_shares(shares: Float64) -> Float64:
    """Return the logarithms of shares, of which none counts as less than a hundredth.

    Parameters
    ----------
    shares : np.ndarray [shape=(n, C)], float64
        From 0 to 1.

    Returns
    -------
    np.ndarray [shape=(n, C)], float64
    """
    logarithms: Float64 = np.log(np.maximum(shares, LEAST_SHARE))
    return logarithms
