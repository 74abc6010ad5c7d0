"""Evaluate rules on what is heard, from where the last start of the bridge left off."""

from collections.abc import Callable, Sequence
from datetime import tzinfo
from functools import cache

from hearthlog.analyzer.bridge.alerts.daily import judged_days
from hearthlog.analyzer.bridge.alerts.duration import DAY, MINUTE, SECOND
from hearthlog.analyzer.bridge.alerts.evaluate import rings
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.memory import Memory, Progress
from hearthlog.analyzer.bridge.alerts.outbox import Outbox
from hearthlog.analyzer.bridge.alerts.ring import Ring, RuleState
from hearthlog.analyzer.bridge.alerts.rules import AlertRule, DailyRule, history, live_history

_OLDEST = DAY  # what rang longer ago is not told any more
_EVERY = SECOND  # of the log
_SAVE_EVERY = 5 * MINUTE
AHEAD = 5 * SECOND  # that make a clock one that was set back


class RuleWatch:
    """Evaluates rules, keeps what rings, and remembers how far it is.

    Attributes
    ----------
    start : int
        From when on what was heard has to be known, in nanoseconds of UTC.
    """

    def __init__(  # noqa: PLR0913, PLR0917
        self,
        rules: Sequence[AlertRule],
        zone: tzinfo,
        outbox: Outbox,
        memory: Memory,
        say: Callable[[str], None],
        now: int,
    ) -> None:
        self._rules = rules
        self._zone = zone
        self._outbox = outbox
        self._memory = memory
        self._say = say
        self._progress = memory.load(rules)
        self._saved = now
        self.set_right(now)
        self.start = self.needed_from(now)

    def set_right(self, now: int) -> None:
        """Let rules begin anew that are evaluated up to a time to come, or up to long ago."""
        is_ahead = any(own.until > now + AHEAD for own in self._progress.values())
        self._progress = {name: _as_of(own, now) for name, own in self._progress.items()}
        if is_ahead:
            self._say("alerts: the clock was ahead, and was set back; the rules begin anew")
            self._outbox.forget_after(now + AHEAD)
            self.save(now)

    def needed_from(self, now: int) -> int:
        """Return from when on what was heard has to be known, in nanoseconds of UTC."""
        return min(
            (self._progress[rule.name].until - live_history(rule) for rule in self._rules),
            default=now,
        )

    def evaluate(
        self,
        heard: Callable[[], HomeHeard],
        weeks: Callable[[int, int], HomeHeard],
        until: int,
        now: int,
    ) -> list[Ring]:
        """Evaluate the rules up to a time; what rings is on the disk on return.

        Parameters
        ----------
        until : int
            In nanoseconds of UTC: up to then all is known.
        """
        self.set_right(now)
        found: list[Ring] = []
        heard_once = cache(heard)
        for rule in self._rules:
            own = self._progress[rule.name]
            if until - own.until < _EVERY:
                continue
            if isinstance(rule, DailyRule):
                if not judged_days(rule, own.until, until, self._zone):
                    own.until = until
                    continue
                what = weeks(until - history(rule), until)
            else:
                what = heard_once()
            rang, state = rings(rule, what, own.until, until, self._zone, own.state)
            self._progress[rule.name] = Progress(until, state)
            found += rang
        self._outbox.put(found)
        if found or now - self._saved >= _SAVE_EVERY:
            self.save(now)
        return found

    def save(self, now: int) -> None:
        """Remember how far the rules are evaluated."""
        self._memory.save(self._rules, self._progress)
        self._saved = now


def _as_of(own: Progress, now: int) -> Progress:
    if own.until > now + AHEAD or not own.until:
        return Progress(now, RuleState(since=now))
    if own.until < now - _OLDEST:
        return Progress(now - _OLDEST, own.state._replace(has_rung=False))
    return own
