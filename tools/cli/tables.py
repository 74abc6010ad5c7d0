"""Tables of scores, labelling differences, spans to review, and the sounds of a day."""

from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from typing import TYPE_CHECKING, NamedTuple

from hearthlog.schemas.errors import listed, printable, shortened
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.cli.terminal import (
    GAP,
    NAME_WIDTH,
    dim,
    moment,
    pale_block,
    print_table,
    terminal_width,
    two_part_bar,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.activity.home_events import DaySounds
    from hearthlog.analyzer.evaluation import Amounts, Detections, LabellingDifference
    from hearthlog.analyzer.evaluation.log_scores import EventCount
    from hearthlog.analyzer.evaluation.scenes import SceneScores, SingleCoughs
    from hearthlog.analyzer.review.ranking import ReviewQueue
    from hearthlog.analyzer.training.scores import Bin, Interval, Scores


_CLASS = ("class", "support", "precision", "recall", "F1", "95 %")
_EVENTS = ("1-s F1", "event F1")


def print_scores(scores: "Scores", detections: "Detections | None" = None, hours: int = 24) -> None:
    """Print scores by class and confusions; false alarms are per number of hours."""
    from hearthlog.models.classes import ordered

    rows = [
        (
            _words(name),
            str(one.support),
            *map(share, (one.precision, one.recall, one.f1)),
            between(one.f1_interval),
            *_events(detections, name, hours),
        )
        for name in ordered(scores.per_class)
        for one in (scores.per_class[name],)
    ]
    macro = map(share, (scores.macro_precision, scores.macro_recall, scores.macro_f1))
    interval = between(scores.macro_f1_interval)
    events = _events(detections, None, hours)
    rows.append(("macro", str(scores.segments), *macro, interval, *events))
    alarms = "alarms/day" if hours == 24 else "alarms/h"
    print_table((*_CLASS, *_EVENTS, alarms) if detections else _CLASS, rows)
    print()
    print_counts(scores.classes, scores.confusion)


def _events(detections: "Detections | None", name: str | None, hours: int) -> tuple[str, ...]:
    """Format the event scores of a class, or of all."""
    if detections is None:
        return ()
    both = detections.segment_based, detections.event_based
    alarms = {name: n * hours / 24 for name, n in detections.false_alarms_per_day.items()}
    if name is None:
        return *(share(one.macro_f1) for one in both), f"{sum(alarms.values()):.1f}"
    return *(share(one.per_class[name].f1) for one in both), f"{alarms[name]:.1f}"


def print_event_counts(events: "Mapping[str, EventCount]") -> None:
    """Print how many events of each class the report would count, and how many there were."""
    from hearthlog.models.classes import ordered

    rows = [(_words(name), *map(str, events[name])) for name in ordered(events)]
    print()
    print_table(("events", "reference", "labelled"), rows)


def print_counts(classes: Sequence[str], confusion: Sequence[Sequence[int]]) -> None:
    """Print a confusion matrix of counts."""
    counts = [[str(count) for count in row] for row in confusion]
    _print_confusion(classes, counts, "confusion: true class in rows, predicted in columns")


def _print_confusion(classes: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
    """Print a confusion matrix, unless it is too wide."""
    from hearthlog.models.classes import ordered

    widths = [max(map(len, column)) + GAP for column in zip(*rows, strict=True)]
    if NAME_WIDTH + sum(widths) > terminal_width():
        print("confusion: too many classes for a table; --json has it")
        return
    print(title)
    places = [classes.index(name) for name in ordered(classes)]
    print_table((), [(_words(classes[row]), *(rows[row][i] for i in places)) for row in places])


def _words(name: str, width: int = NAME_WIDTH) -> str:
    from hearthlog.models.classes import in_words

    return shortened(in_words(name), width)


def print_reliability(bins: "Sequence[Bin]", error: float) -> None:
    """Print confidence against accuracy."""
    print(f"\nexpected calibration error {error:.3f}")
    rows = [(f"{one.confidence:.2f}", f"{one.accuracy:.2f}", str(one.count)) for one in bins]
    print_table(("sure", "right", "segments"), rows, words=0)


def print_scenes(scenes: "Sequence[SceneScores]") -> None:
    """Print the scores of each scene, and their means and ranges."""
    figures = [(one.macro_f1, one.event_f1, one.false_alarms_per_hour) for one in scenes]
    rows = [(f"seed {one.seed}", *_scene(row)) for one, row in zip(scenes, figures, strict=True)]
    if len(scenes) > 1:
        columns = list(zip(*figures, strict=True))
        rows.append(("mean", *_scene([sum(column) / len(column) for column in columns])))
        rows.append(("lowest", *_scene([min(column) for column in columns])))
        rows.append(("highest", *_scene([max(column) for column in columns])))
    print_table(("scene", "macro F1", "event F1", "alarms/h"), rows)


def _scene(figures: Sequence[float]) -> tuple[str, str, str]:
    macro_f1, event_f1, alarms = figures
    return share(macro_f1), share(event_f1), f"{alarms:.1f}"


def print_coughs(coughs: "SingleCoughs") -> None:
    """Print the results for single coughs."""
    seconds = coughs.median_seconds
    length = "" if seconds is None else f", median label {seconds:.2f} s"
    print(
        f"\n{coughs.coughs} single coughs of 0.3 s: {coughs.found:.3f} found{length}; "
        f"{coughs.others:.2f} other labels a cough"
    )


def print_skipped(skipped: Mapping[str, int], what: str = "recordings") -> None:
    """Print the number of skipped recordings by reason."""
    if skipped:
        print(f"\n{what} left out")
        print_table((), [(str(count), reason) for reason, count in skipped.items()], words=2)


def share(value: float | None) -> str:
    """Format a share; - for None."""
    return "-" if value is None else f"{value:.3f}"


def between(interval: "Interval | None") -> str:
    """Format an interval; - for None."""
    return "-" if interval is None else f"{interval[0]:.3f}-{interval[1]:.3f}"


_AMOUNTS = "minutes a", "minutes b", "both", "events a", "events b", "agreement", "kappa"


def print_difference(difference: "LabellingDifference", spans: int) -> None:
    """Print agreement, amounts, confusion, and the longest disagreements."""
    from hearthlog.models.classes import ordered

    a, b, days = difference.a, difference.b, list(difference.days)
    span = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    print(f"a: {a}, {difference.minutes_a:.1f} minutes")
    print(f"b: {b}, {difference.minutes_b:.1f} minutes")
    print(f"compared where both have a label; days are those of UTC, {span}")
    for name, only in ((a, difference.only_a), (b, difference.only_b)):
        if only:
            print(f"only {name} has: {', '.join(map(_words, ordered(only)))}")
    rows = list(_amounts("all", difference.total))
    if len(days) > 1:
        for day, amounts in difference.days.items():
            rows += [("",) * (1 + len(_AMOUNTS)), *_amounts(day, amounts)]
    print()
    print_table(("", *_AMOUNTS), rows)
    print()
    minutes = [[f"{value:.1f}" for value in row] for row in difference.confusion]
    title = "confusion in minutes: classes of a in rows, of b in columns"
    _print_confusion(difference.classes, minutes, title)
    print()
    _print_disagreements(difference, spans)


def _amounts(title: str, amounts: "Amounts") -> Iterator[tuple[str, ...]]:
    from hearthlog.models.classes import ordered

    classes = amounts.per_class.values()
    yield (
        title,
        *(f"{amounts.minutes:.1f}",) * 2,
        f"{amounts.minutes * amounts.agreement:.1f}",
        str(sum(one.events_a for one in classes)),
        str(sum(one.events_b for one in classes)),
        f"{amounts.agreement:.1%}",
        "-" if amounts.kappa is None else f"{amounts.kappa:.3f}",
    )
    for name in ordered(amounts.per_class):
        one = amounts.per_class[name]
        minutes = (f"{value:.1f}" for value in (one.minutes_a, one.minutes_b, one.minutes_both))
        events = str(one.events_a), str(one.events_b)
        yield f"  {_words(name, NAME_WIDTH - 2)}", *minutes, *events, "", ""


def _print_disagreements(difference: "LabellingDifference", spans: int) -> None:
    count = len(difference.disagreements.starts)
    if not count:
        print("there are no disagreements")
        return
    which = "" if count <= spans else f": {spans} of them"
    print(f"{count} disagreements, longest first{which}")
    names = [_words(name) for name in difference.classes]
    columns = (column[:spans].tolist() for column in difference.disagreements)
    rows = [
        (*_span(start, end), names[a], names[b]) for start, end, a, b in zip(*columns, strict=True)
    ]
    print_table(("start", "seconds", "a", "b"), rows, words=4)


def print_queue(queue: "ReviewQueue") -> None:
    """Print a row for each span, the most useful first."""
    spans = queue.spans
    figures = (queue.scores, queue.uncertainty, queue.disagreement, queue.novelty)
    rows = [
        (*_span(start, end), *map(_words, names), *values)
        for start, end, names, values in zip(
            spans.starts.tolist(),
            spans.ends.tolist(),
            zip(queue.labels, queue.others, strict=True),
            zip(*([f"{value:.2f}" for value in column] for column in figures), strict=True),
            strict=True,
        )
    ]
    head = "start", "seconds", "label", "other label", "score", "unsure", "differ", "novel"
    print_table(head, rows, words=4)


def _span(start: int, end: int) -> tuple[str, str]:
    """Format the start of a span, and its length in seconds."""
    return str(moment(start)), f"{(end - start) / NANOSECONDS:7.2f}"


class SoundRow(NamedTuple):
    """A class in the table of the sounds of a day."""

    name: str
    minutes: float  # counted
    uncounted: float  # minutes beside something like a television
    cells: tuple[str, str, str, str, str]  # below `_SOUND_HEADS`; empty for nothing


_SOUND_HEADS = "length", "times", "perhaps", "times", "length"
_NO = "none"
_COUNTED, _ALWAYS = 3, 2  # of these columns, the first ones
_APART = "beside a television"  # above the other ones
_BAR_WIDTHS = 6, 24
_PLAIN_COLUMNS = 80  # of a table with bars, on a wider terminal


def day_title(day: date) -> str:
    """Return the title of the table of a day."""
    from hearthlog.analyzer.logs.local_time import EVENING

    return f"The 24 hours to {EVENING}:00 of {day:%A, %Y-%m-%d}"


AS_LABELLED = "as labelled"  # in the title of a table of sounds


def counts_text(sounds: "DaySounds") -> str:
    """Return how often each sound occurred: `coughing 4 (+3?) and talking 1; …`."""
    from hearthlog.models.classes import in_words

    counted, apart = [], []
    for row in sound_rows(sounds):
        _, sure, unsure, television, _ = row.cells
        name = in_words(row.name).lower()
        if sounds.totals.get(row.name, (0,))[0]:
            number = f"{sure} (+{unsure}?)" if unsure and sure != _NO else f"{unsure}?"
            counted.append(f"{name} {number if unsure else sure}")
        apart += [f"{name} {television}"] * bool(television)
    parts = [listed(counted, "and")] * bool(counted)
    parts += [f"{_APART} {listed(apart, 'and')}"] * bool(apart)
    return "; ".join(parts)


def sound_rows(sounds: "DaySounds", names: Sequence[str] = ()) -> list[SoundRow]:
    """Return a row for each sound of a span, and for some classes; in the order of classes."""
    from hearthlog.models.classes import ordered

    rows = []
    for name in ordered({*names, *sounds.totals, *sounds.minutes, *sounds.uncounted}):
        counted, television, unsure = sounds.totals.get(name, (0, 0, 0))
        minutes, apart = sounds.minutes.get(name, 0.0), sounds.uncounted.get(name, 0.0)
        cells = (
            length_text(minutes) if minutes else "",
            str(counted - unsure or _NO),
            str(unsure or ""),
            str(television or ""),
            length_text(apart) if apart else "",
        )
        rows.append(SoundRow(name, minutes, apart, cells))
    return rows


def print_sounds(rows: Sequence[SoundRow], *, bars: bool = False) -> None:
    """Print the table of the sounds of a day, with a bar for each where there is room."""
    if not rows:
        return
    names = [printable(_words(row.name)) for row in rows]
    cells = [row.cells for row in rows]
    columns = [[*column] for column in zip(_SOUND_HEADS, *cells, strict=True)]
    shown = [place for place, (_, *cells) in enumerate(columns) if place < _ALWAYS or any(cells)]
    table = [_padded(["sound", *names], "<"), *(_padded(columns[place], ">") for place in shown)]
    used = sum(len(column[0]) + GAP for column in table) - GAP
    if used > terminal_width():
        heads = [f"{_SOUND_HEADS[i]}{f' {_APART}' * (i >= _COUNTED)}" for i in shown]
        rest = zip(*(columns[place][1:] for place in shown), strict=True)
        print_table(("sound", *heads), [(n, *own) for n, own in zip(names, rest, strict=True)])
        return
    least, most = _BAR_WIDTHS
    width = min(min(terminal_width(), _PLAIN_COLUMNS) - used - GAP, most)
    title = _APART
    if bars and width >= least:
        table.insert(1, [" " * width, *_bars(rows, width)])
        used += width + GAP
        title = f"{pale_block()} {_APART}"
    if shown[-1] >= _COUNTED:
        print(f"{title:>{used}}")
    for line in zip(*table, strict=True):
        print((" " * GAP).join(line).rstrip())


def _padded(cells: Sequence[str], side: str) -> list[str]:
    width = max(map(len, cells))
    return [f"{cell:{side}{width}}" for cell in cells]


def _bars(rows: Sequence[SoundRow], width: int) -> Iterator[str]:
    """Yield a bar for each row: of what is counted, and pale, of what is beside a television."""
    longest = max(row.minutes + row.uncounted for row in rows) or 1.0
    for row in rows:
        bar, pale = two_part_bar(row.minutes / longest, row.uncounted / longest, width)
        yield f"{bar}{dim(pale)}{' ' * (width - len(bar + pale))}"


def length_text(minutes: float) -> str:
    """Format a length of time in minutes: `36 s`, `5 min`, `1 h 05 min`."""
    from hearthlog.analyzer.activity.values import Duration

    if minutes < 1:
        return f"{60 * minutes:.0f} s" if not minutes or round(60 * minutes) else "under 1 s"
    return f"{minutes:.0f} min" if round(minutes) < _HOUR else Duration.show(minutes)


_HOUR = 60  # minutes
