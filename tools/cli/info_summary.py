"""Text summaries of logs: contents, label accuracy, and the next step."""

import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.activity.checked_minutes import (
    CheckedMinutes,
    ClassCheck,
    checked_minutes,
    count_unchanged,
    quiet_weight,
    read_reviewed_labels,
)
from hearthlog.analyzer.activity.event_counts import FEWEST
from hearthlog.analyzer.logs.hidden_classes import common_names_of
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.logs.summary import LogSummary
from hearthlog.models.classes import ON_TELEVISION, SILENCE, UNKNOWN, class_name, in_words, ordered
from hearthlog.models.starter import GENERAL
from hearthlog.schemas.errors import listed
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_name
from hearthlog.schemas.messages.topics import LIVE, REVIEW, is_scenario, topic
from hearthlog.tools.cli.options import models_folder
from hearthlog.tools.cli.tables import length_text
from hearthlog.tools.cli.terminal import JUDGED_BY, number

_DAY = 86_400  # seconds
TO_REVIEW = "to know how many labels are right in this home, review ten spans"


class ClassAmount(NamedTuple):
    """Time of a class; `share` is relative to the longest, 0 for silence."""

    words: str
    time: str
    share: float


class Overview:
    """First lines of `info` about logs: their health, home, time and labelled sounds.

    Parameters
    ----------
    hidden : collection of str
        Classes that no output shows.
    start : int or None
        When the first log begins, in nanoseconds of UTC: its first message may be later.
    """

    def __init__(
        self,
        summary: LogSummary,
        zone: tzinfo,
        hidden: Collection[str] = (),
        start: int | None = None,
    ) -> None:
        self._summary, self._zone, self._hidden = summary, zone, hidden
        self._start = start
        labels = {name for seconds in summary.segment_seconds.values() for name in seconds}
        logs = [path for path in summary.files if path not in summary.layers]
        self._common = common_names_of(logs[-1], labels) if logs else {}

    def lines(self) -> Iterator[str]:
        """Yield three lines: whether all is well; what this is; how much was listened to."""
        yield self._trouble() or "Everything is working"
        yield self._what()
        if self._microphones():
            yield self._coverage()

    def bars(self, *, microphones: bool) -> Iterator[tuple[str, list[ClassAmount]]]:
        """Yield the amounts of each class by scenario, and by microphone; silence has no bar."""
        of_scenarios = {
            name: self._in_common(each)
            for name, each in self._summary.segment_seconds.items()
            if _scenario(name)
        }
        for microphone, seconds in (
            (self._segments() if microphones else {}) | of_scenarios
        ).items():
            sounds = [name for name in seconds if class_name(name) != SILENCE]
            longest = max((seconds[name] for name in sounds), default=0.0)
            yield (
                _scenario(microphone) or microphone,
                [
                    ClassAmount(
                        in_words(name),
                        length_text(seconds[name] / 60),
                        seconds[name] / longest if name in sounds and longest else 0.0,
                    )
                    for name in ordered(seconds)
                    if class_name(name) not in self._hidden
                ],
            )

    def doubts(self) -> Iterator[str]:
        """Yield how much of the labels of each microphone another class may equal."""
        for microphone, seconds in self._segments().items():
            unsure = self._summary.unsure.get(microphone, Counter())
            if seconds:
                length = length_text(unsure["seconds"] / 60)
                yield (
                    f"Microphone {microphone}: {length} of these labels have less than half of the "
                    "probability: another sound may be likelier"
                )

    def local(self, time: int) -> str:
        """Format a time (ns of UTC) in the zone of the home."""
        return f"{local_time(time, self._zone):%Y-%m-%d %H:%M:%S}"

    def _what(self) -> str:
        names = self._microphones()
        nodes = (
            sorted({log_name(path).node for path in self._summary.files} - {""}) if names else []
        )
        subject = f"Home {listed(nodes, 'and')}" if nodes else "Logs"
        if nodes == ["home"]:  # the default name
            subject = "Home"
        if names:
            subject += (
                f", {'microphone' if len(names) == 1 else 'microphones'} {listed(names, 'and')}"
            )
        if (span := self._span()) is None:
            return f"{subject}: no messages"
        first, last = span
        length = _hours((last - first) / NANOSECONDS)
        begin, end = (f"{local_time(time, self._zone):%Y-%m-%d %H:%M}" for time in (first, last))
        return f"{subject}: {length}, {begin} to {end} ({zone_name(self._zone)})"

    def _span(self) -> tuple[int, int] | None:
        """Return when the logs begin and end."""
        if self._summary.span is None or self._start is None:
            return self._summary.span
        first, last = self._summary.span
        return min(first, self._start), last

    def _coverage(self) -> str:
        first, last = self._span() or (0, 0)
        span = (last - first) / NANOSECONDS
        # Two recorders may have microphones of one name.
        listened = {name: min(own, span) for name, own in self._listened().items()}
        hours = listed([f"{name} {_hours(listened[name])}" for name in sorted(listened)], "and")
        if len(listened) == 1 or len(set(map(_hours, listened.values()))) == 1:
            hours = _hours(next(iter(listened.values())))
        return f"Listened: {hours} of {_hours(span)}"

    def _trouble(self) -> str:
        summary = self._summary
        lost = (
            f"not heard: {number(len(summary.gaps), 'gap')}, together {summary.gap_seconds:.3f} s"
        )
        unfinished = number(len(summary.unfinished), "file")
        health = summary.latest_health
        troubles = [
            *[lost] * bool(summary.gaps),
            *[f"{number(len(summary.damaged), 'file')} damaged"] * bool(summary.damaged),
            *[f"{unfinished} still being written, or cut off"] * bool(summary.unfinished),
            *([f"the recorder reported: {health.message}"] if health and health.level else []),
        ]
        text = ", ".join(troubles)
        return text[:1].upper() + text[1:]

    def _microphones(self) -> list[str]:
        own = [stream["microphone"] for stream in self._summary.streams]
        return list(dict.fromkeys([*own, *self._segments()]))

    def _segments(self) -> dict[str, Counter[str]]:
        """Return the seconds in segments of the recorder's labels, by microphone and label."""
        seconds = self._summary.segment_seconds
        return {name: self._in_common(each) for name, each in seconds.items() if "/" not in name}

    def _in_common(self, seconds: "Counter[str]") -> "Counter[str]":
        """Add up classes that the model takes for one another."""
        sums: Counter[str] = Counter()
        for name in seconds:
            sums[self._common.get(name, name)] += seconds[name]
        return sums

    def _listened(self) -> dict[str, float]:
        lengths = {one["microphone"]: one["frame_seconds"] for one in self._summary.streams}
        found = {}
        for name in self._microphones():
            features = self._summary.topics.get(topic(name, "features"))
            frames = 0 if features is None else features.messages
            own = sum(self._segments().get(name, Counter()).values())
            found[name] = frames * lengths.get(name, FRAME_SECONDS) or own
        return found


def _scenario(labelling: str) -> str:
    """Return microphone and scenario of a labelling in words; empty if it is of no scenario."""
    microphone, _, rest = labelling.partition("/")
    return f"{microphone}, {rest.replace('/', ' ')}" if is_scenario(rest) else ""


def zone_name(zone: tzinfo) -> str:
    """Return the name of a time zone."""
    return "UTC" if str(zone) == "Etc/UTC" else str(zone)


def _hours(seconds: float) -> str:
    if seconds >= 2 * _DAY:
        return f"{seconds / _DAY:.1f} days"
    return f"{seconds / 3600:.1f} h" if seconds >= 2 * 3600 else length_text(seconds / 60)


def next_step(summary: LogSummary, path: Path) -> str | None:
    """Return the next step towards better labels; None if these are not a recorder's logs."""
    if not summary.streams:
        return None
    place, latest = shlex.quote(str(path)), summary.streams[-1]
    if not latest["model"]:
        return f"nothing is labelled: hearthlog relabel {place} --model {GENERAL}"
    labelled: Counter[str] = Counter()
    for counts in summary.segments.values():
        labelled.update(map(class_name, counts))
    if not (labelled or summary.label_seconds):
        return "no sound was recorded, not even silence: hearthlog devices lists the microphones"
    if not labelled.keys() - {SILENCE}:
        return "only silence was recorded so far: leave it recording, or test the microphone"
    marked = any(name.partition("/")[2] == REVIEW for name in summary.segments)
    if marked and latest["starter"] and not _has_learned(summary.layers):
        return (
            f"train a model on the marks of this home ({JUDGED_BY}): hearthlog train --home {place}"
        )
    return f"{TO_REVIEW}: hearthlog review {place} --queue"


def _has_learned(layers: Sequence[Path]) -> bool:
    """Return whether a home model was trained after the last mark."""
    marks = [path.stat().st_mtime for path in layers if log_name(path).layer == REVIEW_LAYER]
    models = [path.stat().st_mtime for path in models_folder().glob("home-*.safetensors")]
    return max(models, default=0.0) > max(marks, default=0.0)


_EVER = 1 << 61


class Accuracy:
    """Accuracy of the recorder's labels from reviews of a home."""

    def __init__(self, logs: HomeLogs) -> None:
        self.losses: list[str] = []
        reviewed = list(read_reviewed_labels(logs, LIVE, 0, _EVER, self.losses))
        self.minutes: CheckedMinutes = checked_minutes(reviewed)
        self.weight = quiet_weight(logs, self.minutes.sounding)
        self.right, self.reviewed = count_unchanged(reviewed)

    @property
    def is_known(self) -> bool:
        """Whether anything was reviewed."""
        return bool(len(self.minutes) or self.reviewed)

    def lines(self) -> Iterator[str]:
        """Yield what was checked, and how much of it was correct."""
        checked = number(len(self.minutes), "minute")
        if not len(self.minutes):
            yield (
                "not checked here: nobody has reviewed how many of these labels are right "
                "in this home"
            )
        else:
            classes = listed(list(self._classes()), "and") or "nothing in them"
            yield f"checked here, {checked} drawn at random: {classes}"
            yield (
                "sounds of one class with at most ten seconds between them count once; 90 % "
                "intervals in brackets"
            )
            if television := int(self.minutes.television.sum()):
                names = listed([in_words(name).lower() for name in ON_TELEVISION], "and")
                yield (
                    f"{names} are left out of {television} of these minutes, in which something "
                    "like a television, a radio or company sounded"
                )
        if 0 < len(self.minutes) < FEWEST:
            yield (
                f"{number(FEWEST - len(self.minutes), 'more minute')}, and the report says in "
                "which range the right numbers lie"
            )
        if self.reviewed:
            yield (
                f"of {number(self.reviewed, 'span')} of the review queue or chosen, "
                f"{self.right} had the right label (the queue prefers doubtful ones)"
            )

    def as_json(self) -> dict[str, object]:
        """Return the accuracy as a JSON object."""
        return {
            "minutes": len(self.minutes),
            "classes": {
                name: check._asdict()
                | {"precision": check.precision, "miss_rate": check.miss_rate(self.weight)}
                for name, check in self._checks()
            },
            "spans": self.reviewed,
            "spans_right": self.right,
        }

    def _checks(self) -> Iterator[tuple[str, ClassCheck]]:
        for name in self.minutes.events:
            check = self.minutes.check(name)
            if check.labelled or check.true:
                yield name, check

    def _classes(self) -> Iterator[str]:
        for name, check in self._checks():
            if name == UNKNOWN:  # no sound is truly `unknown`
                continue
            parts = []
            if check.precision is not None:
                shares = _percent(check.precision)
                parts.append(f"right in {check.right} of {check.labelled} ({shares})")
            missed = check.miss_rate(self.weight)
            if check.missed and missed is not None:
                parts.append(f"missed {check.missed} of {check.true} ({_percent(missed)})")
            yield f"{in_words(name).lower()} {listed(parts, 'and')}"


def _percent(shares: tuple[float, float]) -> str:
    low, high = (f"{100 * share:.0f}" for share in shares)
    return f"{low} to {high} %"
