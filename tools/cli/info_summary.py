"""Text summaries of logs: contents, label accuracy, and the next step."""

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from hearthlog.analyzer.activity.checked_minutes import (
    CheckedMinutes,
    ClassCheck,
    checked_minutes,
    count_unchanged,
    quiet_weight,
    read_reviewed_labels,
)
from hearthlog.analyzer.activity.event_counts import FEWEST, SET_APART
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.summary import LogSummary
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name, in_words
from hearthlog.models.starter import GENERAL
from hearthlog.schemas.errors import listed
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_name
from hearthlog.schemas.messages.topics import LIVE, REVIEW
from hearthlog.tools.cli.options import models_folder
from hearthlog.tools.cli.terminal import JUDGED_BY, number


def gist(summary: LogSummary) -> Iterator[str]:
    """Yield sentences on what was recorded, how much is in doubt, and what is missing."""
    for microphone, seconds in summary.segment_seconds.items():
        if "/" in microphone:  # a layer's topic
            continue
        segments = summary.segments.get(microphone, Counter())
        unsure = summary.unsure.get(microphone, Counter())
        known = [label for label, _ in seconds.most_common() if class_name(label) != UNKNOWN]
        amounts = (
            f"{in_words(label).lower()} {seconds[label] / 60:.1f} min"
            f"{f' ({segments[label]})' * (class_name(label) != SILENCE)}"
            for label in known
        )
        yield f"{microphone}, as labelled (segments): {', '.join(amounts)}"
        other = seconds.keys() - set(known)
        yield (
            f"{microphone} is unsure of: {unsure['seconds'] / 60:.1f} min ({unsure['segments']}) "
            f"of these, and {sum(seconds[label] for label in other) / 60:.1f} min "
            f"({sum(segments[label] for label in other)}) of no class that it knows"
        )
    if summary.gaps:
        yield (
            f"not heard: {number(len(summary.gaps), 'gap')}, together {summary.gap_seconds:.3f} s"
        )


def next_step(summary: LogSummary, path: Path) -> str | None:
    """Return the next step towards better labels; None if these are not a recorder's logs."""
    if not summary.streams:
        return None
    place, latest = shlex.quote(str(path)), summary.streams[-1]
    if not latest["model"]:
        return f"nothing is labelled: hearthlog relabel {place} --model {GENERAL}"
    heard: Counter[str] = Counter()
    for counts in summary.segments.values():
        heard.update(map(class_name, counts))
    if not (heard or summary.label_seconds):
        return "no sound was recorded, not even silence: hearthlog devices lists the microphones"
    if not heard.keys() - {SILENCE}:
        return "only silence was recorded so far: leave it recording, or test the microphone"
    marked = any(name.partition("/")[2] == REVIEW for name in summary.segments)
    if marked and latest["starter"] and not _has_learned(summary.layers):
        return (
            f"train a model on the marks of this home ({JUDGED_BY}): hearthlog train --home {place}"
        )
    return f"review ten spans: hearthlog review {place} --queue"


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
        self.weight = quiet_weight(logs, LIVE, self.minutes.sounding)
        self.right, self.looked_at = count_unchanged(reviewed)

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
            if beside := int(self.minutes.television.sum()):
                names = listed([in_words(name).lower() for name in SET_APART], "and")
                yield (
                    f"{names} are left out of {beside} of these minutes, in which something like a "
                    "television, a radio or company sounded"
                )
        if 0 < len(self.minutes) < FEWEST:
            yield (
                f"{number(FEWEST - len(self.minutes), 'more minute')}, and the report says in "
                "which range the right numbers lie"
            )
        if self.looked_at:
            yield (
                f"of {number(self.looked_at, 'span')} of the review queue or chosen, "
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
            "spans": self.looked_at,
            "spans_right": self.right,
        }

    def _checks(self) -> Iterator[tuple[str, ClassCheck]]:
        for name in self.minutes.labelled:
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
