"""The current sound of each microphone: its class, how sure, since when, and how loud."""

import math
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import tzinfo
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.logs.hidden_classes import read_hidden_classes, recorded_hidden_classes
from hearthlog.analyzer.logs.layers import latest_records
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.logs.selection import checked_array_names, decode_types
from hearthlog.analyzer.review.lanes import decibel
from hearthlog.models.classes import class_name, in_words
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.errors import LogError, printable, shortened
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.mcap.raw_messages import RawMessages
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import LIVE, parse_topic

AWAY_SECONDS = 15.0  # without labels, after which nobody listens
_FIELDS = {
    message_types.LABEL: ("header.stamp", "label", "confidence"),
    message_types.FEATURES: ("header.stamp", "values"),
}
_SECOND = 20  # frames that decide the class
_MOST_MICROPHONES = 64
_ENERGY = "energy"
_HIDDEN = "A sound"  # in place of a class that no output shows
_LONGEST_NAME = 40
_NOT_PLAIN = re.compile(r"[^\w\s.,'()%-]")  # markup in names of foreign logs


class CurrentSound:
    """Current sound of a microphone: the most probable class of the last second.

    `label` and its mean `confidence` are empty before the first label; `since` is the start of the
    sound, `time` the end of the newest label, in nanoseconds of UTC. `is_older` if the sound may
    have begun before: it was there in the first label. `level_dbfs` is the mean level of the last
    second; NaN if unknown.
    """

    def __init__(self, microphone: str) -> None:
        self.microphone = microphone
        self.label, self.confidence = "", 0.0
        self.since = self.time = 0
        self.is_older = True
        self.level_dbfs = math.nan
        self.seen = -math.inf  # of the newest label, by CLOCK_MONOTONIC
        self._times: Int64 = np.empty(0, np.int64)
        self._labels: NDArray[np.object_] = np.empty(0, object)
        self._confidences: Float32 = np.empty(0, np.float32)

    def is_listening(self) -> bool:
        """Whether labels have arrived in the last fifteen seconds."""
        return time.monotonic() - self.seen <= AWAY_SECONDS

    def push(self, times: Int64, labels: NDArray[np.object_], confidences: Float32) -> None:
        """Add labels, at least one; a pause, or a clock that was set back, begins a new sound."""
        times = np.concatenate([self._times, times])
        labels = np.concatenate([self._labels, labels])
        confidences = np.concatenate([self._confidences, confidences])
        new = len(self._times)
        steps = np.diff(times)
        breaks = np.flatnonzero((steps > NANOSECONDS) | (steps <= 0)) + 1
        if len(breaks):
            first = int(breaks[-1])
            self.label, self.is_older = "", False
            times, labels, confidences = times[first:], labels[first:], confidences[first:]
            new = max(new - first, 0)
        names, codes = np.unique(labels.astype(str), return_inverse=True)
        weights = np.zeros((len(times) + 1, len(names)))
        weights[np.arange(1, len(times) + 1), codes] = np.nan_to_num(confidences) + 1e-6
        sums = np.cumsum(weights, axis=0)
        starts = np.maximum(np.arange(1, len(times) + 1) - _SECOND, 0)
        best = (sums[1:] - sums[starts]).argmax(axis=1)
        if not self.label or names[best[-1]] != self.label or (best[new:] != best[-1]).any():
            changes = np.flatnonzero(best[:-1] != best[1:]) + 1
            run = int(changes[-1]) if len(changes) else 0
            window = slice(int(starts[run]), run + 1)
            self.is_older = self.is_older and not len(changes) and not self.label
            self.since = int(times[window][codes[window] == best[-1]][0])
            self.label = str(names[best[-1]])
        own = codes[starts[-1] :] == best[-1]
        self.confidence = float(confidences[starts[-1] :][own].mean())
        self.time = int(times[-1]) + FRAME_NANOSECONDS
        last = slice(1 - _SECOND, None)
        self._times, self._labels, self._confidences = times[last], labels[last], confidences[last]


class CurrentSounds:
    """Current sounds of the microphones of a folder of logs, within bounded memory.

    `lose` is called with a problem of the list of hidden classes.
    """

    def __init__(self, folder: Path, lose: Callable[[object], None]) -> None:
        self.microphones: dict[str, CurrentSound] = {}
        self.is_live = False  # whether all earlier messages have been read
        self._folder, self._lose = folder, lose
        self._log: Path | None = None
        self._recorded: frozenset[str] = frozenset()
        self._listed: frozenset[str] = frozenset()

    def push(self, path: Path, batch: Sequence[RawMessages]) -> None:
        """Add new messages of a log.

        Raise `LogError` if the messages are not of the types of their channels.
        """
        if not batch or is_layer(path):
            return
        if path != self._log:
            self._log = path
            self._recorded = recorded_hidden_classes(next(latest_records([path]), {}))
        for columns in decode_types(path, batch, _FIELDS):
            topic = parse_topic(columns.topic)
            if topic is None or topic.labelling != LIVE or not len(columns):
                continue
            if topic.microphone in self.microphones or len(self.microphones) < _MOST_MICROPHONES:
                own = self.microphones.setdefault(topic.microphone, CurrentSound(topic.microphone))
                self._add(path, columns, own)

    @property
    def hidden(self) -> frozenset[str]:
        """Classes that no output shows."""
        return self._recorded | self._listed

    def hide(self) -> None:
        """Read which classes no output shows; a damaged list hides what it hid before."""
        try:
            self._listed = read_hidden_classes(self._folder)
        except (LogError, OSError) as error:
            self._lose(error)

    def words(self, sound: CurrentSound) -> str:
        """Return the displayed name of the class."""
        is_hidden = class_name(sound.label) in self.hidden
        return _HIDDEN if is_hidden else plain(in_words(sound.label))

    def _add(self, path: Path, columns: Columns, sound: CurrentSound) -> None:
        if columns.type == message_types.FEATURES:
            with suppress(LogError):  # the timeline reports it
                names = checked_array_names(path, columns, "values")
                if _ENERGY in names:
                    energy = columns["values"][-_SECOND:, names.index(_ENERGY)]
                    sound.level_dbfs = float(decibel(np.nan_to_num(energy).mean()))
            return
        age = 0.0 if self.is_live else (time.time_ns() - int(columns.log_times[-1])) / NANOSECONDS
        sound.seen = max(sound.seen, time.monotonic() - max(age, 0.0))
        sound.push(columns["header.stamp"], columns["label"], columns["confidence"])


def plain(name: str) -> str:
    """Return a name of a log without markup."""
    return shortened(_NOT_PLAIN.sub("", printable(name)), _LONGEST_NAME)


def microphone_words(name: str) -> str:
    """Return the displayed name of a microphone: `Living room`."""
    return plain(name.replace("_", " ").capitalize())


def lasting(sound: CurrentSound) -> str:
    """Return how long the sound has lasted: `for 2 s`, `for over 5 min`."""
    seconds = max(round((sound.time - sound.since) / NANOSECONDS), 1)
    amount, unit = (seconds, "s") if seconds < 60 else (seconds // 60, "min")
    text = f"{amount} {unit}" if seconds < 3600 else f"{amount // 60} h {amount % 60} min"
    return f"for {'over ' * sound.is_older}{text}"


def silent_since(sound: CurrentSound, zone: tzinfo) -> str:
    """Return since when nobody listens; the date, too, if it is another day."""
    moment, now = local_time(sound.time, zone), local_time(time.time_ns(), zone)
    day = "" if moment.date() == now.date() else f"{moment:%Y-%m-%d} "
    return f"Nobody listens since {day}{moment:%H:%M}"
