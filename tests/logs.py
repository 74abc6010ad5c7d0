"""Read logs in tests, field by field."""

from pathlib import Path

import numpy as np
from logreader import LogReader

from hearthlog.models.classifiers.classifier import LabelTiming
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import nanoseconds


def read(path: Path, kind: str) -> list:
    """Decode all messages of one kind (`features`, `gap` …) in a log or a folder of logs."""
    return [
        item.decode()
        for log in find_logs(path)
        for item in LogReader(log).messages()
        if item.topic.endswith("/" + kind)
    ]


def features(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame numbers, stamps (ns) and values of all features."""
    found = read(path, "features")
    width = len(found[0].values) if found else DEFAULT.width
    return (
        np.array([m.frame for m in found], np.int64),
        np.array([nanoseconds(m.header.stamp) for m in found], np.int64),
        np.array([m.values for m in found], np.float32).reshape(-1, width),
    )


def labelled_frames(recorded: np.ndarray, timing: LabelTiming) -> np.ndarray:
    """Numbers of the frames that get a label where these frames were heard."""
    runs = np.split(recorded, np.flatnonzero(np.diff(recorded) != 1) + 1)
    ends = [np.arange(timing.first_window_end(int(run[0])), int(run[-1]) + 1) for run in runs]
    return np.concatenate(ends) - timing.delay
