"""A summary of logs in words, and what to do next."""

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from hearthlog.analyzer.logs.summary import LogSummary
from hearthlog.models.classes import SILENCE, UNKNOWN, class_name, in_words
from hearthlog.models.starter import GENERAL
from hearthlog.schemas.logs.files import REVIEW_LAYER, log_name
from hearthlog.schemas.messages.topics import REVIEW
from hearthlog.tools.cli.options import models_folder
from hearthlog.tools.cli.text import JUDGED_BY, number


def gist(summary: LogSummary) -> Iterator[str]:
    """Say in words what was heard, how much of it is in doubt, and what was not heard."""
    for microphone, seconds in summary.segment_seconds.items():
        if "/" in microphone:  # of a layer
            continue
        segments = summary.segments.get(microphone, Counter())
        unsure = summary.unsure.get(microphone, Counter())
        known = [label for label, _ in seconds.most_common() if class_name(label) != UNKNOWN]
        amounts = (
            f"{in_words(label).lower()} {seconds[label] / 60:.1f} min"
            f"{f' ({segments[label]})' * (class_name(label) != SILENCE)}"
            for label in known
        )
        yield f"{microphone} heard, as labelled (segments): {', '.join(amounts)}"
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
    """Say what to do for better labels; None if these are no logs of a recorder."""
    if not summary.streams:
        return None
    place, latest = shlex.quote(str(path)), summary.streams[-1]
    if not latest["model"]:
        return f"nothing is labelled: hearthlog relabel {place} --model {GENERAL}"
    heard: Counter[str] = Counter()
    for counts in summary.segments.values():
        heard.update(map(class_name, counts))
    if not (heard or summary.label_seconds):
        return "nothing was heard, not even quiet: hearthlog devices lists the microphones"
    if not heard.keys() - {SILENCE}:
        return "nothing but quiet was heard yet: leave it recording, or try the microphone"
    marked = any(name.partition("/")[2] == REVIEW for name in summary.segments)
    if marked and latest["starter"] and not _has_learned(summary.layers):
        return (
            f"a model of this home, from what is marked ({JUDGED_BY}): "
            f"hearthlog train --home {place}"
        )
    return f"ten spans to go through: hearthlog review {place} --queue"


def _has_learned(layers: Sequence[Path]) -> bool:
    """Tell whether a model of the home was made after the last mark."""
    marks = [path.stat().st_mtime for path in layers if log_name(path).layer == REVIEW_LAYER]
    models = [path.stat().st_mtime for path in models_folder().glob("home-*.safetensors")]
    return max(models, default=0.0) > max(marks, default=0.0)
