"""What counts as damage to a home."""

from collections.abc import Iterator

import numpy as np

from hearthlog.analyzer.gate.changes import class_words, time_words
from hearthlog.analyzer.gate.evidence import Evidence, Right
from hearthlog.models.classes import SILENCE

_LEAST_MINUTES = 10.0  # of sound to judge by
_SILENCE_FALLS = 0.10  # of the time
_OF_THE_TIME = 0.01  # a class of which the champion is sure for so long
_KEPT = 0.75  # of what it is sure of


def damages(evidence: Evidence, champion: str) -> list[str]:
    """Say what a model would spoil.

    Parameters
    ----------
    evidence : Evidence
    champion : str
        Name of the model that labels now.

    Returns
    -------
    list of str
        A sentence for each damage, or that there is too little sound to tell; empty if there is no
        damage.
    """
    if not evidence.minutes and not evidence.losses:
        return ["there are no recent logs that it has not learned from: record for some hours"]
    if evidence.minutes < _LEAST_MINUTES:
        loss = f" ({evidence.losses[0]})" if evidence.losses else ""
        text = f"only {time_words(evidence.minutes)} of the last two weeks are in the logs and not "
        return [f"{text}learned from{loss}: record for some hours more, then promote it"]
    found = [*_silence_lost(evidence), *_fewer_right(evidence.random, champion)]
    if not clearly_better(evidence.random):
        found += _classes_lost(evidence, champion)
    return found


def clearly_better(right: Right) -> bool:
    """Tell whether the second model is right about more sounds, and chance hardly can be why."""
    return right.gained - right.lost > 2 * np.sqrt(right.gained + right.lost)


def _silence_lost(evidence: Evidence) -> Iterator[str]:
    changes = evidence.changes
    if SILENCE in changes.classes:
        i = changes.classes.index(SILENCE)
        before, after = float(changes.before[i]), float(changes.after[i])
        if before - after > _SILENCE_FALLS * changes.minutes.sum():
            yield f"silence falls from {time_words(before)} a day to {time_words(after)}"


def _fewer_right(right: Right, champion: str) -> Iterator[str]:
    if right.after < right.before:
        yield (
            f"of {right.sounds} sounds of the minutes that were drawn at random it is right about "
            f"{right.after}, {champion} about {right.before}"
        )


def _classes_lost(evidence: Evidence, champion: str) -> Iterator[str]:
    total = evidence.changes.minutes.sum()
    for i, name in enumerate(evidence.changes.classes):
        sure, kept = float(evidence.sure[i].sum()), float(evidence.sure[i, i])
        if sure >= _OF_THE_TIME * total and kept < _KEPT * sure:
            others = evidence.sure[i].copy()
            others[i] = 0
            most = class_words(evidence.changes.classes[int(others.argmax())])
            yield (
                f"of {time_words(sure)} a day of {class_words(name)} of which {champion} is sure "
                f"{time_words(kept)} are left, most becomes {most}"
            )
