"""For how long the scenarios of a recorder heard each of their classes, day by day."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.selection import select
from hearthlog.models.classes import OF_EVERY_SCENARIO, class_name
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import SCENARIO, is_scenario, parse_topic

_FIELDS = {"header.stamp", "duration", "label"}
_MINUTE = 60 * NANOSECONDS
_LATE = 12 * 3600 * NANOSECONDS  # a segment is in the log when it has ended, a long one late
_MOST_CLASSES = 256

# By the name of the scenario: of each day, the minutes of each class.
ScenarioMinutes = Mapping[str, Sequence[Mapping[str, float]]]


def read_scenario_minutes(
    logs: HomeLogs, days: Sequence[tuple[int, int]], lose: Callable[[str], None]
) -> ScenarioMinutes:
    """Read for how long scenarios heard each class, of all microphones together.

    Parameters
    ----------
    days : sequence of (int, int)
        Starts and ends, in nanoseconds of UTC, in the order of time.
    """
    found: dict[str, list[Counter[str]]] = {}
    start, end = days[0][0], days[-1][1]
    for entry in logs.between(start, end + _LATE):
        try:
            selection = select([entry.path])
            topics = [
                topic
                for topic in selection.topics_of(message_types.SEGMENT, _FIELDS)
                if (name := parse_topic(topic)) is not None and is_scenario(name.labelling)
            ]
            columns = read_columns([entry.path], topics, start, end + _LATE, _FIELDS)
        except LogError as error:
            lose(str(error))
            continue
        for topic in topics:
            scenario = topic.partition(f"/{SCENARIO}/")[2].partition("/")[0]
            own = found.setdefault(scenario, [Counter() for _ in days])
            if topic in columns:
                _add(own, columns[topic], days)
    return {name: found[name] for name in sorted(found)}


def _add(minutes: list[Counter[str]], columns: Columns, days: Sequence[tuple[int, int]]) -> None:
    starts, ends = columns["header.stamp"], columns["header.stamp"] + columns["duration"]
    names, numbers = np.unique(columns["label"], return_inverse=True)
    for counted, (begin, end) in zip(minutes, days, strict=True):
        lengths = np.maximum(np.minimum(ends, end) - np.maximum(starts, begin), 0)
        sums = np.bincount(numbers, lengths, len(names)) / _MINUTE
        for name, length in zip(names.tolist(), sums.tolist(), strict=True):
            is_known = name in counted or len(counted) < _MOST_CLASSES
            if length and is_known and class_name(name) not in OF_EVERY_SCENARIO:
                counted[name] += length
