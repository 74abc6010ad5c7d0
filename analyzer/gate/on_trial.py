"""A candidate that labels beside the champion: what it says otherwise, and how right it is."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hearthlog.analyzer.accuracy.count_range import beta_quantile
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.difference import compare_labellings
from hearthlog.analyzer.gate.changes import Changes, changes_of_labellings
from hearthlog.analyzer.gate.evidence import NOTHING_KNOWN, Right
from hearthlog.analyzer.gate.reference import Sound, reference
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings, unified
from hearthlog.analyzer.logs.spans import joined, lengths
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name
from hearthlog.schemas.arrays import Bool, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.logs.metadata import read_provenance
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import CANDIDATE, LIVE

_ENDS = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class Trial:
    """A champion and a candidate on the same time of a home.

    Attributes
    ----------
    random, marks : Right
        Known sounds of the minutes that were drawn at random, and other marks.
    quiet : Right
        The silences of the minutes that were drawn at random.
    """

    champion: str
    candidate: str
    candidate_sha256: str
    minutes: float
    changes: Changes
    random: Right
    marks: Right
    losses: list[str]
    quiet: Right = NOTHING_KNOWN


def compare_on_trial(folders: Sequence[Path], microphone: str | None = None) -> Trial:
    """Compare the latest candidate with the champion beside which it labelled last.

    Raise `DataError` if no candidate labelled in these logs, or both models not long enough for
    a segment, or there are several microphones. Raise `LogError` if there is no log.
    """
    losses: list[str] = []
    records = list(_records(folders, losses))
    tried = [(log, record) for log, record in records if record.get("candidate_sha256")]
    if not tried:
        raise DataError(
            "no candidate labelled in these logs: `hearthlog models promote NAME --to candidate` "
            "lets a model label beside the champion of a running recorder"
        )
    last = tried[-1][1]
    key = ("model_sha256", "candidate_sha256")
    logs = [log for log, one in tried if all(one.get(k) == last.get(k) for k in key)]
    sources = find_labellings(*logs)
    name = sources.microphone(microphone)
    try:
        live, candidate = (sources.read(name, each) for each in (LIVE, CANDIDATE))
    except LogError as error:
        names = f"{last.get('candidate', '')} with {last.get('model', '')}"
        raise DataError(f"nothing to compare {names} by yet: {error}") from error
    difference = compare_labellings(live, candidate)
    known: list[Sound] = []
    for place, log in enumerate(logs, 1):
        try:
            sounds = reference(log, logs[place:])
            known += [sound for sound in sounds if sound.microphone == name]
        except LogError as error:
            losses.append(str(error))
    sounding = [sound for sound in known if class_name(sound.label) != SILENCE]
    sides = [unified(side.labelling) for side in (live, candidate)]
    return Trial(
        champion=last.get("model", ""),
        candidate=last.get("candidate", ""),
        candidate_sha256=last.get("candidate_sha256", ""),
        minutes=difference.total.minutes,
        changes=changes_of_labellings(difference),
        random=_right([one for one in sounding if one.random], *sides),
        marks=_right([one for one in sounding if not one.random], *sides),
        losses=[*sources.losses, *losses],
        quiet=_right([one for one in known if one.random and one not in sounding], *sides),
    )


def gain_interval(right: Right) -> tuple[float, float]:
    """Return the 95 % interval of how often the second model is the one that is right.

    Of the sounds on which one model alone is right; by a beta distribution with the prior of
    Jeffreys. 0.5 is no difference.
    """
    low, high = (beta_quantile(right.gained + 0.5, right.lost + 0.5, share) for share in _ENDS)
    return low, high


def _records(folders: Sequence[Path], losses: list[str]) -> Iterable[tuple[Path, dict[str, str]]]:
    for folder in folders:
        for log in find_logs(folder):
            if is_layer(log):
                continue
            try:
                with LogFile(log) as file:
                    for record in read_provenance(file):
                        yield log, dict(record)
            except LogError as error:
                losses.append(str(error))


def _right(sounds: Sequence[Sound], before: Labelling, after: Labelling) -> Right:
    """Count the sounds whose label a model gives to most of their time, as far as it labelled."""
    first, second = (_agrees(sounds, labels) for labels in (before, after))
    both = _labelled(sounds, before) & _labelled(sounds, after)
    first, second = first[both], second[both]
    return Right(
        int(both.sum()),
        int(first.sum()),
        int(second.sum()),
        int((second & ~first).sum()),
        int((first & ~second).sum()),
    )


def _agrees(sounds: Sequence[Sound], labels: Labelling) -> Bool:
    agrees = np.zeros(len(sounds), bool)
    names = np.array([class_name(sound.label) for sound in sounds], object)
    for name in set(names):
        own = labels.labels == name
        rows = np.flatnonzero(names == name).tolist()
        agrees[rows] = _mostly([sounds[row] for row in rows], labels.starts[own], labels.ends[own])
    return agrees


def _labelled(sounds: Sequence[Sound], labels: Labelling) -> Bool:
    names = [class_name(sound.label) != UNKNOWN for sound in sounds]
    return _mostly(sounds, labels.starts, labels.ends) & np.array(names, bool)


def _mostly(sounds: Sequence[Sound], starts: Int64, ends: Int64) -> Bool:
    """Tell whether spans cover more than half of each sound."""
    spans = joined(starts, ends)
    covered = [
        int(lengths(spans, np.array([sound.start, sound.end]))[0]) if len(spans.starts) else 0
        for sound in sounds
    ]
    whole = [sound.end - sound.start for sound in sounds]
    mostly: Bool = 2 * np.array(covered, np.int64) > np.array(whole, np.int64)
    return mostly
