"""What a recorder keeps of its logs: how much, how long, and how much of each."""

from typing import NamedTuple


class Limits(NamedTuple):
    """What is kept at most; 0 for no limit.

    Attributes
    ----------
    days : int
        Days on which something was recorded.
    files : int
        Finished logs.
    size : int
        Bytes of finished logs and their layers.
    free : int
        Bytes that should be free on the disk.
    """

    days: int = 0
    files: int = 0
    size: int = 0
    free: int = 0


class ThinningDays(NamedTuple):
    """After how many days with sound a log loses what; 0 for never.

    Attributes
    ----------
    statistics : int
    features : int
        These, and the statistics.
    rest : int
        All but labels, segments and gaps.
    """

    statistics: int = 0
    features: int = 0
    rest: int = 0

    def step(self, age: int) -> int:
        """Return how far a log is to be thinned: a place in `hearthlog.schemas.salvage.thin.STEPS`.

        Parameters
        ----------
        age : int
            Days with sound since.
        """
        due = [step for step, days in enumerate(self, 1) if days and age >= days]
        return max(due, default=0)


class KeepingRules(NamedTuple):
    """What a recorder keeps of which logs.

    Attributes
    ----------
    root : str
        Folder of logs.
    node : str
        Name of the node.
    limits : Limits
    thinning : ThinningDays
    """

    root: str
    node: str
    limits: Limits
    thinning: ThinningDays = ThinningDays()
