"""When a day, with the night after it, was unlike the four weeks before it."""

from datetime import timedelta, tzinfo

import numpy as np

from hearthlog.analyzer.bridge.alerts.daily import judged_days
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.ring import Alarm
from hearthlog.analyzer.bridge.alerts.rules import ANY_SOUND, UnusualDay
from hearthlog.analyzer.bridge.listeners import is_of_scenario
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.report.wording import differences_text, rarity_text, short_day
from hearthlog.analyzer.routine.day_anomaly import Routines
from hearthlog.analyzer.routine.day_profile import HomeSegments, Profiles
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.arrays import Int64


def unusual_alarms(
    rule: UnusualDay, heard: HomeHeard, start: int, end: int, zone: tzinfo
) -> list[Alarm]:
    """Find the days that were unlike the four weeks before them, each in the morning after it.

    Parameters
    ----------
    heard : HomeHeard
        From 34 days before the start on.
    """
    mornings = judged_days(rule, start, end, zone)
    if not mornings:
        return []
    routines = Routines(Profiles(home_sound(heard), zone, night_after=True))
    alarms = []
    for morning, time in mornings:
        judged = routines.judge(morning - timedelta(days=1))
        if judged is not None and judged.once_in >= rule.once_in:
            day = short_day(judged.day)
            why = differences_text(judged)
            text = f"{day} and the night after it, {rarity_text(judged)}: {why}"
            alarms.append(Alarm(time, time + 1, text))
    return alarms


def home_sound(heard: HomeHeard) -> HomeSegments:
    """Return what routines are learned from."""
    coverage = heard.listened(ANY_SOUND, "")
    parts = [_labelled(SILENCE, coverage.starts, coverage.ends)]
    parts += [_labelled(name, own.starts, own.ends) for name, own in heard.sounds.items()]
    starts, ends, labels = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("starts", "ends", "labels")
    )
    order = np.argsort(starts, kind="stable")
    of_home = [own for name, own in heard.classes.items() if not is_of_scenario(name)]
    known = dict.fromkeys(sorted(set(heard.sounds).union(*of_home)))
    return HomeSegments(
        Labelling(starts[order], ends[order], labels[order]),
        {name: heard.listened(name, "") for name in known},
    )


def _labelled(name: str, starts: Int64, ends: Int64) -> Labelling:
    return Labelling(starts, ends, np.full(len(starts), name, object))
