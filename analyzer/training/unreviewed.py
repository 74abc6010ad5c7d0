"""What a recorder labelled and nobody has looked at, where a model may forget it otherwise."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import SEGMENT_FIELDS, labelling_of
from hearthlog.analyzer.logs.recorder_info import read_recorder_infos
from hearthlog.analyzer.training.confirmed import Candidates, chosen, labelled_segments
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.marked_sound import read_sound_of, with_embeddings
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.installed import feature_set
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.messages.topics import LIVE, labelling_topic, scenario_labelling

_RECENT = 14 * 86_400 * NANOSECONDS
_SILENT_LOGS = 4  # that are read for silence
_SILENT_PART = 900 * NANOSECONDS  # of each
_LOGS = 6  # that are read for other classes
_PART = 3600 * NANOSECONDS
_VERY_SURE = 0.8  # with less a model that is often wrong here would learn its mistakes


def unreviewed_silence(
    folders: Sequence[Path], model: Model, scenario: str = ""
) -> Iterator[Candidates]:
    """Cut silence out of some logs of the last two weeks.

    Parameters
    ----------
    scenario : str, optional
        For which it labels; empty for the sounds of the home.

    Raises
    ------
    LogError
        If there is no log.
    """
    recent = _recent(folders)
    for place in np.linspace(len(recent) - 1, 0, min(len(recent), _SILENT_LOGS)).round():
        log = recent[int(place)]
        yield from _labelled(log, model, {SILENCE}, _SILENT_PART, scenario)


def unreviewed_sounds(
    folders: Sequence[Path], model: Model, names: Collection[str], scenario: str = ""
) -> list[Recording]:
    """Choose sounds of some classes of which a model is very sure.

    They are from the logs of the last two weeks in which most of these classes was labelled.

    Parameters
    ----------
    scenario : str, optional
        For which it labels; empty for the sounds of the home.

    Returns
    -------
    list of Recording
        A second each, at most 60 of a class.

    Raises
    ------
    LogError
        If there is no log.
    """
    recent = _recent(folders)
    amounts = np.array([_labelled_time(log, names, scenario) for log in recent], np.int64)
    most = np.argsort(-amounts, kind="stable")[:_LOGS]
    candidates = [
        one
        for place in most[amounts[most] > 0]
        for one in _labelled(recent[place], model, names, _PART, scenario)
    ]
    return chosen(candidates, model, least=_VERY_SURE, fewest=0)


def _recent(folders: Sequence[Path]) -> list[Path]:
    entries = find_home_logs(folders).between()
    newest = max((entry.start for entry in entries), default=0)
    return [entry.path for entry in entries if newest - entry.start <= _RECENT]


def _labelled(
    log: Path, model: Model, names: Collection[str], length: int, scenario: str
) -> Iterator[Candidates]:
    """Cut classes out of the beginning of a log."""
    with suppress(LogError):  # why it cannot be read is said when it is labelled
        features = feature_set(model.description.feature_set)
        for info in read_recorder_infos(log, "features"):
            if info.first_frame is not None:
                begin = info.first_frame[1]
                part = begin, begin + length
                for one in read_sound_of(log, features, {info.microphone}, part, scenario):
                    sound = with_embeddings(one, part, model.description.embedding_space)
                    yield labelled_segments(sound, model.classes, names, features.window_frames)


def _labelled_time(log: Path, names: Collection[str], scenario: str) -> int:
    """Return for how long classes were labelled in a log, in nanoseconds."""
    amount = 0
    with suppress(LogError):
        infos = read_recorder_infos(log, "features")
        labelling = scenario_labelling(scenario) if scenario else LIVE
        topics = {labelling_topic(info.microphone, labelling, "segment") for info in infos}
        for columns in read_columns([log], topics, fields=SEGMENT_FIELDS).values():
            labels = labelling_of(columns)
            own = np.isin(labels.labels.astype(str), sorted(names))
            amount += int((labels.ends - labels.starts)[own].sum())
    return amount
