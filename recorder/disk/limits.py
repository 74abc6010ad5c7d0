"""What a recorder keeps of its logs: how much, how long, and how much of each."""

from typing import NamedTuple


class Limits(NamedTuple):
    """What is kept at most; 0 for no limit.

    Attributes
    ----------
    days : int
        Days on which something was recorded.
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
    """After how many days with sound a log loses what; 0 for never."""

    statistics: int = 0
    features: int = 0
    rest: int = 0

    def step(self, age: int) -> int:
        """Return the step of thinning: a place in `hearthlog.schemas.salvage.recover.STEPS`.

        Parameters
        ----------
        age : int
            Days with sound since.
        """
        due = [step for step, days in enumerate(self, 1) if days and age >= days]
        return max(due, default=0)


class KeepingRules(NamedTuple):
    """What a recorder keeps of which logs."""

    root: str
    node: str
    limits: Limits
    thinning: ThinningDays = ThinningDays()
