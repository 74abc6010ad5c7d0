"""What a label file was made to ask, in a list beside it: so an import knows what was looked at."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import one, pieces
from hearthlog.analyzer.marks.formats.formats import find_format
from hearthlog.analyzer.marks.marks import QUEUE, RANDOM, Mark, ReviewedSpan
from hearthlog.analyzer.review.queue.review_list import ReviewSpan
from hearthlog.schemas.messages.topics import RELABEL, scenario_name

_SUFFIX = ".queue.csv"


def asked_path(labels: Path) -> Path:
    """Return the path of the list beside a label file: `ten.queue.csv` beside `ten.txt`.

    Parameters
    ----------
    labels : Path
    """
    format_ = find_format(labels)
    suffix = "" if format_ is None else format_.suffix
    return labels.with_name(labels.name.removesuffix(suffix) + _SUFFIX)


def chosen_as(span: ReviewSpan) -> str:
    """Return how a span was chosen, as `ReviewedSpan` says it.

    Parameters
    ----------
    span : ReviewSpan
    """
    return RANDOM if span.reason == RANDOM else QUEUE


def corrected_name(labelling: str) -> str:
    """Return the name of a labelling, as marks say it: that of a model without `relabel/`.

    Parameters
    ----------
    labelling : str
        `live`, or `scenario/` and a name, or `relabel/` and a model.
    """
    return labelling.removeprefix(f"{RELABEL}/")


def check_scenario(path: Path, spans: Iterable[ReviewSpan], scenario: str, option: str) -> None:
    """Check that all spans of a list are of one scenario.

    Parameters
    ----------
    path : Path
        Of the list, for errors.
    spans : iterable of ReviewSpan
    scenario : str
        Its name; empty for the sounds of the home.
    option : str
        By which a user names it, for errors.

    Raises
    ------
    DataError
        If a span is of another one.
    """
    for span in spans:
        other = scenario_name(span.a)
        if other != scenario:
            do = f"give {option} {other}" if other else f"leave out {option} {scenario}"
            what = f"scenario {other}" if other else "the sounds of the home"
            raise DataError(f"{path}: asks for {what}: {do}")


def labels_of(span: ReviewSpan, labelling: Labelling) -> list[Mark]:
    """Return the labels of a span for a label file: one, or of a whole minute all.

    Parameters
    ----------
    span : ReviewSpan
    labelling : Labelling
        The one that is reviewed.
    """
    if span.reason != RANDOM:
        return [Mark(span.microphone, span.start, span.end, span.label_a)]
    parts, rows, _ = pieces(labelling, one(span.start, span.end))
    times = zip(parts.starts.tolist(), parts.ends.tolist(), strict=True)
    return [
        Mark(span.microphone, *each, label)
        for each, label in zip(times, labelling.labels[rows].tolist(), strict=True)
    ]


def looked_at(
    asked: Iterable[ReviewSpan],
    marks: Sequence[Mark],
    coverage: Mapping[str, Coverage],
    reviewer: str,
    made: int,
) -> dict[Path, list[ReviewedSpan]]:
    """Return which of the spans that were asked a person has looked at: those with a label.

    Parameters
    ----------
    asked : iterable of ReviewSpan
    marks : sequence of Mark
        All that the label file has.
    coverage : mapping of str to Coverage
        By microphone; spans of others are left out.
    reviewer : str
    made : int
        In nanoseconds of UTC.

    Returns
    -------
    dict of Path to list of ReviewedSpan
        By log.
    """
    reviewed: dict[Path, list[ReviewedSpan]] = {}
    for span in asked:
        if span.microphone in coverage and any(_answers(mark, span) for mark in marks):
            origin = reviewer, made, corrected_name(span.a), chosen_as(span)
            for log, first, last in coverage[span.microphone].split(span.start, span.end):
                part = ReviewedSpan(span.microphone, first, last, *origin)
                reviewed.setdefault(log, []).append(part)
    return reviewed


def unasked(asked: Sequence[ReviewSpan], marks: Iterable[Mark]) -> list[Mark]:
    """Return the marks that lie in no span that was asked.

    Parameters
    ----------
    asked : sequence of ReviewSpan
    marks : iterable of Mark
    """
    return [mark for mark in marks if not any(_answers(mark, span) for span in asked)]


def _answers(mark: Mark, span: ReviewSpan) -> bool:
    return mark.microphone == span.microphone and mark.start < span.end and mark.end > span.start
