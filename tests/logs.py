"""Read logs in tests, field by field."""

from pathlib import Path

import numpy as np
from logreader import LogReader

from hearthlog.models.features.auros21.names import FEATURE_NAMES
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
    return (
        np.array([m.frame for m in found], np.int64),
        np.array([nanoseconds(m.header.stamp) for m in found], np.int64),
        np.array([m.values for m in found], np.float32).reshape(-1, len(FEATURE_NAMES)),
    )
