"""Report of a home: from logs to a page and a picture."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import date, timedelta, tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.checked_minutes import read_checked_minutes
from hearthlog.analyzer.activity.daily_metrics import (
    HOUR,
    DayMetrics,
    day_of,
    home_sound,
    metrics_of_home,
)
from hearthlog.analyzer.activity.day_anomaly import Routines
from hearthlog.analyzer.activity.day_profile import Profiles
from hearthlog.analyzer.activity.doubtful_sounds import (
    DoubtfulSound,
    doubtful_events,
    read_doubtful_sounds,
    read_steady_sound,
)
from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.activity.home_data import (
    HomeData,
    ScenarioMinutes,
    read_home,
    read_scenario_minutes,
)
from hearthlog.analyzer.activity.values import BASELINE_DAYS
from hearthlog.analyzer.logs.home_logs import HomeLog, HomeLogs, check_day, network_changes
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.layers import latest_records
from hearthlog.analyzer.logs.local_time import day_span, midnight
from hearthlog.analyzer.logs.recorder_info import Trouble
from hearthlog.analyzer.logs.spans import (
    EVENT_PAUSE,
    NONE,
    Spans,
    intersection,
    joined,
    rows_at,
    union,
)
from hearthlog.analyzer.report.page import day_page, week_page
from hearthlog.analyzer.report.report_data import ASSESSED_DAYS as ASSESSED
from hearthlog.analyzer.report.report_data import ReportData
from hearthlog.models.classes import SILENCE, WORRYING, class_name
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.logs.files import RELABEL_LAYER
from hearthlog.schemas.messages.topics import LIVE, labelling_topic, relabelling, topic
from hearthlog.schemas.new_files import check_new, new_file

WEEK = 7


Draw = Callable[[Path, Sequence[DayMetrics], Sequence[DayMetrics]], None]


class Period(NamedTuple):
    """One or seven local days."""

    first: date
    days: int
    zone: tzinfo


@dataclass(frozen=True)
class WrittenReport:
    """A written page, and the read errors."""

    page: Path
    picture: Path | None
    losses: Sequence[str]


def make_report(  # noqa: PLR0913
    logs: HomeLogs,
    period: Period,
    page: Path,
    labelling: str = LIVE,
    progress: Progress = ignore_progress,
    *,
    draw: Draw | None = None,
) -> WrittenReport:
    """Write the report of a day or a week.

    The HTML file, and the picture of the same path with suffix `.png`, may not exist. `draw` writes
    the picture, from the days of the report and those that they are compared with:
    `save_timelines`, which needs matplotlib; by default there is only the page. `progress` receives
    the share of the logs read, 0 to 1. Raise `DataError` if these days have no logs or no labels,
    or the labelling does not exist; `LogError` if segments are invalid, or a file exists or cannot
    be written.
    """
    picture = page.with_suffix(".png")
    if draw is not None and picture == page:
        raise LogError(f"{page}: that is the name of the picture; name the page *.html")
    paths = [page] if draw is None else [page, picture]
    for path in paths:
        check_new(path)
    data, losses = read_report_data(logs, period, labelling, progress)
    text = day_page(data) if period.days == 1 else week_page(data)
    with ExitStack() as files:
        html, *png = [files.enter_context(new_file(path)) for path in paths]
        html.write_text(text, "utf-8")
        if draw is not None:
            shown = data.from_evening
            draw(png[0], shown.days, shown.earlier)
    return WrittenReport(page, None if draw is None else picture, losses)


def read_report_data(
    logs: HomeLogs,
    period: Period,
    labelling: str = LIVE,
    progress: Progress = ignore_progress,
) -> tuple[ReportData, Sequence[str]]:
    """Read the data of a page, and the read errors.

    Raise `DataError` and `LogError` as `make_report` does.
    """
    first, count, zone = period
    days = [first + timedelta(days=number) for number in range(count)]
    check_day(logs, days[0], days[-1], zone)
    close = day_span(days[0], zone)[0], day_span(days[-1], zone)[1]
    earlier = [first - timedelta(days=number) for number in range(BASELINE_DAYS, 0, -1)]
    since = midnight(earlier[0] - timedelta(days=1), zone)  # for the night that ends on that day
    home = read_home(logs, labelling, since, close, progress)
    model = _model(logs, close) if labelling == LIVE else ""
    checked = read_checked_minutes(logs, labelling, since, close[1], home.losses)
    checks = checked.of_model(model)
    metrics = metrics_of_home(home, checks)
    if count == 1:
        metrics = replace(metrics, steady=_steady_sound(logs, home, close))
    routines = Routines(Profiles(home_sound(home, metrics), zone, night_after=False))
    past = [day_of(metrics, day, zone) for day in earlier]
    logged = _logged(logs, metrics.coverage)
    shown = [day_of(metrics, day, zone, logged) for day in days]
    span = int(shown[0].span.starts[0]), int(shown[-1].span.ends[0])
    data = ReportData(
        nodes=home.nodes,
        microphones=sorted({microphone for _, microphone in home.segments}),
        labelling=labelling,
        zone=zone,
        days=shown,
        before=past[-(ASSESSED - 1) :],
        earlier=[day for day in past if any(map(day.comparable, metrics.classes))],
        judged={day: routines.judge(day) for day in days},
        baseline_days={day: len(routines.earlier(day)) for day in days},
        uncovered=_unrecorded(home, [day.logged for day in shown]),
        gaps=_within(home.gaps, span),
        troubles=_within(home.troubles, span),
        doubts=_doubts(logs, home, labelling, shown),
        checks=checks,
        model=model,
        scenarios=_scenarios(logs, days, zone, home) if labelling == LIVE else {},
        unread=len(home.losses),
        networks=network_changes(logs.between(since, close[1]), zone),
        hidden=home.hidden,
    )
    return data, home.losses


def _steady_sound(logs: HomeLogs, home: HomeData, close: tuple[int, int]) -> Spans:
    """Return when any microphone of a home recorded steady sound on a day."""
    found = [NONE]
    for (node, microphone), labels in home.segments.items():
        paths = [entry.path for entry in logs.between(*close) if entry.node == node]
        quiet = labels.spans(labels.labels == SILENCE)
        found.append(read_steady_sound(paths, topic(microphone, "statistics"), quiet, *close))
    return union(*found)


def _logged(logs: HomeLogs, coverage: Spans) -> tuple[int, int]:
    """Return when the first log of a home begins, and its last one ends, in nanoseconds of UTC."""
    starts = [entry.start for entry in logs.between()]
    last = max(*starts, logs.end() or 0, int(coverage.ends[-1]))
    return min(*starts, int(coverage.starts[0])), last


def _model(logs: HomeLogs, close: tuple[int, int]) -> str:
    """Return the SHA-256 of the model of the last log of the period."""
    records = latest_records(entry.path for entry in logs.between(*close))
    return next(records, {}).get("model_sha256", "")


def _doubts(
    logs: HomeLogs, home: HomeData, labelling: str, days: Sequence[DayMetrics]
) -> list[DoubtfulSound]:
    """Return the doubtful sounds of the days that need review: none while a television is on."""
    start, end = int(days[0].span.starts[0]), int(days[-1].span.ends[0])
    close, name, layer = logs.between(start, end), LIVE, list[HomeLog]()
    if labelling != LIVE:
        name, layer = relabelling(labelling), logs.between(start, end, RELABEL_LAYER + labelling)
    minutes = [day.home.minutes for day in days]
    television = np.concatenate([each.starts[each.television] for each in minutes])
    found: list[DoubtfulSound] = []
    for (node, microphone), labels in home.labelled.items():
        events = doubtful_events(labels)
        own = (events.starts >= start) & (events.starts < end)
        own &= ~np.isin(events.starts // MINUTE * MINUTE, television)
        own &= rows_at(minutes[0].reviewed, events.starts) < 0
        own &= ~np.isin(events.labels, [*home.hidden])
        entries = [(e.path, e.start, e.end) for e in (*close, *layer) if e.node == node]
        topics = labelling_topic(microphone, name, "label"), f"/{microphone}/features"
        found += [
            sound
            for sound in read_doubtful_sounds(entries, topics, events.rows(own))
            if sound.needs_review(home.hidden, _near(labels, sound))
        ]
    return found


def _near(labels: Labelling, sound: DoubtfulSound) -> set[str]:
    """Return which worrying classes sound so close to a sound that both would be one event."""
    near = labels.starts <= sound.end + EVENT_PAUSE
    near &= labels.ends >= sound.start - EVENT_PAUSE
    return {name for label in {*labels.labels[near]} if (name := class_name(label)) in WORRYING}


def _scenarios(
    logs: HomeLogs, days: Sequence[date], zone: tzinfo, home: HomeData
) -> ScenarioMinutes:
    spans = [day_span(day, zone) for day in days]
    return read_scenario_minutes(logs, spans, home.lose, home.hidden)


def _unrecorded(home: HomeData, days: Sequence[Spans]) -> dict[str, float]:
    """Return the hours of some days without coverage of each microphone."""
    length = sum(day.length for day in days)
    hours: dict[str, float] = {}
    for (_, microphone), segments in home.segments.items():
        covered = joined(segments.starts, segments.ends)
        own = sum(intersection(covered, day).length for day in days)
        hours[microphone] = max(hours.get(microphone, 0.0), (length - own) / HOUR)
    return hours


def _within(troubles: Sequence[Trouble], span: tuple[int, int]) -> list[Trouble]:
    """Clip troubles to the reported days."""
    start, end = span
    cut = [t._replace(start=max(t.start, start), end=min(t.end, end)) for t in troubles]
    return [trouble for trouble in cut if trouble.start <= trouble.end]
