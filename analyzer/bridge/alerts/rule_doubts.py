"""Rules of alerts that cannot ring as they are configured, said before the bridge starts."""

from collections.abc import Iterator, Sequence

from hearthlog.analyzer.bridge.alerts.duration import MINUTE, duration_words
from hearthlog.analyzer.bridge.alerts.rules import (
    AlertRule,
    MoreThan,
    UnlikeUsual,
    UnusualDay,
    pause_of,
    unknown_microphone,
)
from hearthlog.analyzer.report.values import FEWEST as FEWEST_USUAL
from hearthlog.analyzer.routine.day_anomaly import FEWEST as FEWEST_ROUTINE
from hearthlog.recorder.config import Settings

_JUDGED_AND_TODAY = 2  # days, besides those that a day is compared with


def rule_doubts(
    rules: Sequence[AlertRule], settings: Settings, microphones: Sequence[str]
) -> Iterator[str]:
    """Say which rules cannot ring, whatever sounds, by what the recorder is configured to do.

    Parameters
    ----------
    microphones : sequence of str
        The names of those that are configured; without any nothing is known of them.
    """
    for rule in rules:
        lines = unknown_microphone(rule, microphones), impossible_amount(rule)
        yield from filter(None, (*lines, unkept_days(rule, settings)))


def impossible_amount(rule: AlertRule) -> str:
    """Say that a window cannot hold what a rule asks for; empty if it can."""
    if not isinstance(rule, MoreThan):
        return ""
    if rule.minutes is not None and rule.minutes * MINUTE >= rule.window:
        amount = f"{rule.minutes:g} minutes"
    # Events have more than a pause between them, and the first one may end as the window begins.
    elif rule.count is not None and rule.count > rule.window // pause_of(rule) + 1:
        amount = f"{rule.count} events"
    else:
        return ""
    return (
        f"{rule.name}: there cannot be more than {amount} in a window of "
        f"{duration_words(rule.window)}, so that it never rings"
    )


def unkept_days(rule: AlertRule, settings: Settings) -> str:
    """Say that logs are deleted before there are enough days to compare with; empty if not."""
    if isinstance(rule, UnlikeUsual):
        fewest = FEWEST_USUAL
    elif isinstance(rule, UnusualDay):
        fewest = FEWEST_ROUTINE
    else:
        return ""
    needed, kept = fewest + _JUDGED_AND_TODAY, settings.retention_days
    if not 0 < kept < needed:
        return ""
    return (
        f"{rule.name}: retention_days = {kept} leaves it no {fewest} days to compare with, so that "
        f"it never rings; keep {needed} or more"
    )
