"""How right labels are in this home, in words."""

from collections.abc import Iterator

from hearthlog.analyzer.accuracy.checked_minutes import (
    CheckedMinutes,
    ClassCheck,
    checked_minutes,
    count_unchanged,
    quiet_weight,
    read_reviewed_labels,
)
from hearthlog.analyzer.accuracy.event_counts import FEWEST, SET_APART
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.models.classes import UNKNOWN, in_words
from hearthlog.schemas.errors import listed
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.cli.text import number

_EVER = 1 << 61


class Accuracy:
    """What reviews of a home say of the recorder's labels."""

    def __init__(self, logs: HomeLogs) -> None:
        self.losses: list[str] = []
        reviewed = list(read_reviewed_labels(logs, LIVE, 0, _EVER, self.losses))
        self.minutes: CheckedMinutes = checked_minutes(reviewed)
        self.weight = quiet_weight(logs, LIVE, self.minutes.sounding)
        self.right, self.looked_at = count_unchanged(reviewed)

    def lines(self) -> Iterator[str]:
        """Say what was checked, and how much of it was right."""
        checked = number(len(self.minutes), "minute")
        if not len(self.minutes):
            yield "not checked here: how many of these labels are right in this home is not known"
        else:
            classes = listed(list(self._classes()), "and") or "nothing in them"
            yield f"checked here, {checked} drawn at random: {classes}"
            yield (
                "sounds of one kind with at most ten seconds between them count once here; in "
                "brackets the share of all, nine times in ten"
            )
            if beside := int(self.minutes.television.sum()):
                names = listed([in_words(name).lower() for name in SET_APART], "and")
                yield (
                    f"{names} are left out of {beside} of these minutes, in which something like a "
                    "television, a radio or company sounded"
                )
        if 0 < len(self.minutes) < FEWEST:
            yield (
                f"{number(FEWEST - len(self.minutes), 'more minute')}, and the report says in "
                "which range the right numbers lie"
            )
        if self.looked_at:
            yield (
                f"of {number(self.looked_at, 'span')} that were asked for or chosen, "
                f"{self.right} had the right label (the queue asks for doubtful ones)"
            )

    def as_json(self) -> dict[str, object]:
        """Return the same for a program."""
        return {
            "minutes": len(self.minutes),
            "classes": {
                name: check._asdict()
                | {"precision": check.precision, "miss_rate": check.miss_rate(self.weight)}
                for name, check in self._checks()
            },
            "spans": self.looked_at,
            "spans_right": self.right,
        }

    def _checks(self) -> Iterator[tuple[str, ClassCheck]]:
        for name in self.minutes.labelled:
            check = self.minutes.check(name)
            if check.labelled or check.true:
                yield name, check

    def _classes(self) -> Iterator[str]:
        for name, check in self._checks():
            if name == UNKNOWN:  # which nothing is truly
                continue
            parts = []
            if check.precision is not None:
                shares = _percent(check.precision)
                parts.append(f"right in {check.right} of {check.labelled} ({shares})")
            missed = check.miss_rate(self.weight)
            if check.missed and missed is not None:
                parts.append(f"missed {check.missed} of {check.true} ({_percent(missed)})")
            yield f"{in_words(name).lower()} {listed(parts, 'and')}"


def _percent(shares: tuple[float, float]) -> str:
    low, high = (f"{100 * share:.0f}" for share in shares)
    return f"{low} to {high} %"
