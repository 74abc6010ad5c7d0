"""A ring of a rule, and what a rule remembers from one evaluation to the next."""

import hashlib
from typing import NamedTuple

_NEVER = -(1 << 62)


class Ring(NamedTuple):
    """What a rule has to tell.

    Attributes
    ----------
    time : int
        When it rang, by the time of the log, in nanoseconds of UTC.
    due : int
        From when on it is told: the time, or the end of quiet hours.
    """

    rule: str
    time: int
    text: str
    is_known: bool
    due: int

    @property
    def id(self) -> str:
        """What names the ring: the same one in every evaluation."""
        return f"{self.time}-{hashlib.sha256(self.rule.encode()).hexdigest()[:12]}"


class RuleState(NamedTuple):
    """What a rule remembers.

    Attributes
    ----------
    last : int
        When it rang last, in nanoseconds of UTC.
    since : int
        From when on it is in force, in nanoseconds of UTC: of the time before nobody knows whether
        there was a recorder.
    """

    last: int = _NEVER
    has_rung: bool = False
    since: int = _NEVER


class Alarm(NamedTuple):
    """A span of time in which what a rule looks for is the case.

    Attributes
    ----------
    start, end : int
        In nanoseconds of UTC; the end is not part of it.
    text : str
        In words; empty where they depend on when it rings.
    """

    start: int
    end: int
    text: str = ""
    is_known: bool = True
