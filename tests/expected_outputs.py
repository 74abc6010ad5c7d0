"""What a bridge has to say of a home, computed anew from its logs: with the report's events."""

from collections import Counter
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from hearthlog.analyzer.activity.event_counts import AROUND, MINUTE, events_of, television_minutes
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.models.classes import ON_TELEVISION
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer


def expected_values(folder: Path, zone, root: str) -> dict[str, str]:
    """Return topic and value of everything that a broker keeps of the classes of a home."""
    logs = [log for log in find_logs(folder) if not is_layer(log)]
    columns = read_columns(logs)
    names = sorted({topic.split("/")[1] for topic in columns if topic.endswith("/label")})
    values = {}
    for name in names:
        labels = columns[f"/{name}/label"]
        classes = np.unique(labels["label"])
        values |= {
            f"{root}/{name}/class/{label}/on": "ON" if is_on(labels, label) else "OFF"
            for label in classes
            if label != "silence"
        }
        if f"/{name}/segment" in columns:
            values |= _counts(columns[f"/{name}/segment"], zone, f"{root}/{name}")
    return values


def expected_totals(folder: Path) -> dict[str, str]:
    """Return the number of events of each class in the logs of a home, of all microphones."""
    columns = read_columns([log for log in find_logs(folder) if not is_layer(log)])
    totals = Counter()
    for topic, segments in columns.items():
        if topic.endswith("/segment"):
            labelling = _labelling(segments)
            for label in set(labelling.labels) - {"silence"}:
                totals[label] += len(events_of(labelling, label).starts)
    return {f"{label}/total": str(count) for label, count in totals.items()}


def is_on(labels, label: str) -> bool:
    """Tell whether eight of twenty successive labels, the last within ten seconds, are of a class.

    Labels of different runs of a recorder follow each other here as they do in its logs.
    """
    order = np.argsort(labels.log_times, kind="stable")
    times, own = labels.log_times[order], (labels["label"] == label)[order]
    for last in range(len(times) - 1, -1, -1):
        if times[-1] - times[last] > 10 * NANOSECONDS:
            return False
        if own[max(last - 19, 0) : last + 1].sum() >= 8:
            return True
    return False


def turned_on(folder: Path) -> dict[str, np.ndarray]:
    """Return by class when it turned on, in seconds of UTC: when the frame began that decided."""
    logs = [log for log in find_logs(folder) if not is_layer(log)]
    columns = read_columns(logs)
    turns = {}
    for topic in (topic for topic in columns if topic.endswith("/label")):
        labels = columns[topic]
        times = labels.log_times / NANOSECONDS
        for label in np.unique(labels["label"]):
            own = np.convolve(labels["label"] == label, np.ones(20, int))[: len(times)] >= 8
            recorded = times[own]
            turns[label] = recorded[np.diff(recorded, prepend=-np.inf) > 10]
    return turns


def _labelling(segments) -> Labelling:
    starts = segments["header.stamp"]
    order = np.argsort(starts, kind="stable")
    ends = starts + segments["duration"]
    return Labelling(starts[order], ends[order], segments["label"][order])


def _counts(segments, zone, root: str) -> dict[str, str]:
    labelling = _labelling(segments)
    first, last = labelling.starts[0] // MINUTE, labelling.ends.max() // MINUTE
    edges = np.arange(first - AROUND, last + AROUND + 2) * MINUTE
    television = edges[:-1][television_minutes(labelling, edges)] // MINUTE
    now = datetime.now(zone)
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    evening = midnight.replace(hour=22)
    night = evening if evening <= now else evening - timedelta(days=1)
    morning = (night + timedelta(days=1)).replace(hour=7)
    values = {}
    for label in np.unique(segments["label"]):
        if label == "silence":
            continue
        events = events_of(labelling, label)
        counted = events.starts[~np.isin(events.starts // MINUTE, television)]
        begun = [
            datetime.fromtimestamp(start / NANOSECONDS, zone)
            for start in (counted if label in ON_TELEVISION else events.starts)
        ]
        topic = f"{root}/class/{label}"
        values[f"{topic}/count_today"] = str(sum(start >= midnight for start in begun))
        # The homes here were heard for seconds: that there was nothing in a night is not known.
        of_night = sum(night <= start < morning for start in begun)
        values[f"{topic}/count_night"] = str(of_night or None)
        last = int(events.ends[-1]) // 1_000_000
        moment = datetime.fromtimestamp(last // 1000, zone).replace(microsecond=last % 1000 * 1000)
        values[f"{topic}/last_heard"] = moment.isoformat(timespec="milliseconds")
    return values
