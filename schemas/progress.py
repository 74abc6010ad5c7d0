"""Progress of work that takes long."""

from collections.abc import Callable

Progress = Callable[[float], None]  # is told the share of the work that is done, from 0 to 1


def ignore_progress(_share: float) -> None:
    """Do nothing with a report of progress.

    Parameters
    ----------
    _share : float
        Share of the work that is done, 0 to 1.
    """
