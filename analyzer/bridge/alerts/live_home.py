"""What was heard up to now, from the log while it is written."""

from collections.abc import Collection, Mapping, Sequence

from hearthlog.analyzer.bridge.alerts.gathering import SEGMENT_FIELDS, Gathered
from hearthlog.analyzer.bridge.alerts.home_heard import HomeHeard
from hearthlog.analyzer.bridge.alerts.open_run import Label, OpenRun
from hearthlog.analyzer.bridge.alerts.rules import LONGEST_PAUSE
from hearthlog.analyzer.bridge.listeners import (
    is_of_scenario,
    listener_of,
    microphone_of_listener,
)
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import DIAGNOSTICS, LIVE, parse_topic

FIELDS = {
    message_types.SEGMENT: SEGMENT_FIELDS,
    message_types.GAP: ("header.stamp", "duration"),
    message_types.DIAGNOSTICS: (),
}
_GONE = 600_000_000_000  # ns without a label of a scenario, which another configuration has not
_CUT = 1_000_000_000  # ns of a run that no segment has, where a gap follows


def is_of_alerts(topic: str) -> bool:
    """Tell whether alerts need a topic."""
    if topic == DIAGNOSTICS:
        return True
    name = parse_topic(topic)
    if name is None or listener_of(name) is None:
        return False
    return name.kind == "segment" or (name.kind == "gap" and name.labelling == LIVE)


class LiveHome:
    """What the microphones of one recorder have heard up to now.

    Parameters
    ----------
    start : int
        From when on it is known, in nanoseconds of UTC.
    patience : int
        How late what a recorder writes may be read, in nanoseconds.
    """

    def __init__(self, start: int, patience: int) -> None:
        self._start = start
        self._patience = patience
        self._gathered = Gathered()
        self._runs: dict[str, OpenRun] = {}

    def push(self, columns: Sequence[Columns]) -> None:
        """Add messages, with the fields of `FIELDS`."""
        for part in (each for each in columns if len(each)):
            self._gathered.add_written(part.log_times)
            name = parse_topic(part.topic)
            listener = None if name is None else listener_of(name)
            if listener is None:
                continue
            if part.type == message_types.SEGMENT:
                self._gathered.add_segments(listener, part)
                self._run(listener).begin(int((part["header.stamp"] + part["duration"]).max()))
            elif part.type == message_types.GAP:
                rows = zip(part["header.stamp"].tolist(), part["duration"].tolist(), strict=True)
                for start, duration in rows:
                    self._add_gap(listener, start, start + max(duration, 0))

    def add_label(self, listener: str, label: Label, classes: Sequence[str]) -> None:
        """Add a label of a listener."""
        run = self._run(listener)
        if label.time > run.last:
            self._gathered.add_classes(listener, classes)
            self._gathered.add_written_span(label.time, label.time)
            run.add(label)
        if not run.start:
            run.begin(max(self._start, self._gathered.recorder_began or 0))

    def known_until(self, now: int) -> int:
        """Return up to when everything is known that can have been heard."""
        until = now
        for listener, open_run in self._runs.items():
            run = open_run.run()
            if is_of_scenario(listener) and 0 < open_run.last < now - _GONE:
                self._cut(listener, open_run.last)
                open_run.begin(open_run.last)
                continue
            known = open_run.start if run is None else run.end
            is_away = open_run.last < now - self._patience
            until = min(until, max(known, now - self._patience) if is_away else known)
        return until if self._runs else now - self._patience

    def heard(self) -> HomeHeard:
        """Return what was heard, with what goes on."""
        return self._gathered.heard(self.open_segments())

    @property
    def classes(self) -> Mapping[str, Collection[str]]:
        """By listener, the classes that its model knows."""
        return self._gathered.classes

    def open_segments(self) -> list[tuple[str, int, int, str, float]]:
        """Return what goes on and has no segment yet, as `Gathered.heard` takes it."""
        runs = ((name, each.run()) for name, each in self._runs.items())
        return [(name, *run) for name, run in runs if run is not None]

    def forget_before(self, time: int) -> None:
        """Forget what was over before a time, in nanoseconds of UTC."""
        self._gathered.forget_before(time, LONGEST_PAUSE)

    def _run(self, listener: str) -> OpenRun:
        return self._runs.setdefault(listener, OpenRun())

    def _add_gap(self, microphone: str, start: int, end: int) -> None:
        """Let all that listen by a microphone begin anew after a gap."""
        self._run(microphone)
        for listener, run in self._runs.items():
            if microphone_of_listener(listener) == microphone:
                self._cut(listener, start)
                run.begin(end)

    def _cut(self, listener: str, start: int) -> None:
        """Keep what was heard before a gap although its segment was never written."""
        run = self._run(listener).run()
        if run is not None and start - run.start > _CUT:
            end = min(run.end, start)
            self._gathered.add_segment(listener, run.start, end, run.label, run.confidence)
