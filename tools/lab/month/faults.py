"""The faults of a month: what happens when, by a seed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hearthlog.schemas.frames import NANOSECONDS

Kind = Literal[
    # to the recorder, done by whoever runs it
    "killed",
    "power cut",
    "restarted",
    "second recorder",
    # to the microphone
    "unplugged",
    "stalled",
    "capture crashes",
    "samples lost",
    "standstill",
    "muted",
    "stuck",
    "clipping",
    "no ADC clock",
    # to the clock of the machine
    "clock set",
    "clock in 1970",
    "clock ahead",
    "clock slewed",
    "suspended",
    # to the disk and the model
    "disk refuses",
    "model broken",
]

# How many of a hundred there are, and how long they last in seconds, at least and at most.
_KINDS: dict[Kind, tuple[int, float, float]] = {
    "killed": (9, 1.0, 600.0),
    "power cut": (7, 20.0, 1800.0),
    "restarted": (2, 1.0, 60.0),
    "second recorder": (2, 0.0, 0.0),
    "unplugged": (10, 1.0, 3600.0),
    "stalled": (6, 3.5, 60.0),
    "capture crashes": (4, 0.0, 30.0),
    "samples lost": (8, 0.02, 5.0),
    "standstill": (5, 2.0, 90.0),
    "muted": (4, 15.0, 300.0),
    "stuck": (3, 15.0, 300.0),
    "clipping": (3, 60.0, 300.0),
    "no ADC clock": (3, 60.0, 3600.0),
    "clock set": (9, 0.3, 7200.0),
    "clock in 1970": (3, 5.0, 900.0),
    "clock ahead": (4, 5.0, 1800.0),
    "clock slewed": (3, 600.0, 3600.0),
    "suspended": (4, 10.0, 20_000.0),
    "disk refuses": (6, 1.0, 2400.0),
    "model broken": (3, 60.0, 600.0),
}
KINDS = tuple(_KINDS)
# They end the process: all of them early, so that one then lives long enough to show what grows.
_ENDING: set[Kind] = {"killed", "power cut", "restarted"}
_ENDING_SHARE = 0.3  # of the month
_ALONE_SECONDS = 120.0  # after each fault


@dataclass(frozen=True)
class Fault:
    """Something that happens to a recorder.

    Attributes
    ----------
    kind : str
    start : int
        Nanoseconds since the month began.
    length : int
        Nanoseconds that it lasts; of `clock set`, by how much, negative for back.
    """

    kind: Kind
    start: int
    length: int

    @property
    def end(self) -> int:
        """When it is over, in nanoseconds since the month began."""
        return self.start + abs(self.length)


def plan_faults(days: float, count: int, seed: int, kinds: Sequence[Kind] = KINDS) -> list[Fault]:
    """Throw faults into a month at random, long ones seldom.

    Parameters
    ----------
    days : float
    count : int
    seed : int
    kinds : sequence of str

    Returns
    -------
    list of Fault
        In the order of time; in the last hour none begins. Of each kind there is one, if there are
        as many faults.
    """
    rng = np.random.default_rng(seed)
    weights = np.array([_KINDS[kind][0] for kind in kinds], float)
    drawn = rng.choice(len(kinds), max(count - len(kinds), 0), p=weights / weights.sum())
    chosen = [*rng.permutation(len(kinds))[:count].tolist(), *drawn.tolist()]
    seconds = days * 86_400.0
    longest = seconds / (2 * max(count, 1))  # together less than the month
    faults = [_fault(kinds[number], seconds, longest, rng) for number in chosen]
    return _one_after_the_other(sorted(faults, key=lambda fault: fault.start))


def _fault(kind: Kind, seconds: float, longest: float, rng: np.random.Generator) -> Fault:
    _, least, most = _KINDS[kind]
    share = _ENDING_SHARE if kind in _ENDING else 1.0
    last = share * (seconds - min(3600.0, seconds / 10))
    start = float(rng.uniform(30.0, last))
    if kind.startswith("clock") and rng.random() < 0.3:  # where files begin
        start = min(
            max(round(start / 3600.0) * 3600.0 + float(rng.uniform(-20.0, 20.0)), 30.0), last
        )
    length = least * (most / least) ** float(rng.random()) if least else most * float(rng.random())
    length = min(length, longest)
    sign = -1 if kind == "clock set" and rng.random() < 0.5 else 1
    return Fault(kind, int(start * NANOSECONDS), sign * int(length * NANOSECONDS))


def _one_after_the_other(faults: list[Fault]) -> list[Fault]:
    """Move faults that would begin before another one is over behind it."""
    moved: list[Fault] = []
    free = 0
    for fault in faults:
        start = max(fault.start, free)
        moved.append(Fault(fault.kind, start, fault.length))
        lasting = 0 if fault.kind == "clock set" else abs(fault.length)
        free = start + lasting + int(_ALONE_SECONDS * NANOSECONDS)
    return moved
