"""The logs of a home: layers, spans, days, models and embedding networks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta, tzinfo
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.hidden_classes import hidden_classes_of_log, recorded_hidden_classes
from hearthlog.analyzer.logs.layers import find_with_layers, latest_records, readable_span
from hearthlog.analyzer.logs.local_time import day_span, local_time
from hearthlog.analyzer.logs.recorder_info import (
    NO_MODEL,
    LabelledBy,
    embedding_source,
    microphones_of,
    models_of,
)
from hearthlog.analyzer.logs.spans import NEVER
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import AUDIO_LAYER, RELABEL_LAYER, log_name, time_span
from hearthlog.schemas.logs.metadata import recorded_scenarios
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import EmbeddingSpace

_TAIL = 60 * NANOSECONDS  # a complete day may lack this much at its end
_RECENT = 14 * 86_400 * NANOSECONDS
_MOST_DAYS = 366  # of a log


class HomeLog(NamedTuple):
    """A log or a layer."""

    path: Path
    node: str
    layer: str  # empty for a log, else `review` or `relabel-<model>`
    start: int  # time span (ns of UTC) of the contents; messages that end later may begin in it
    end: int


@dataclass(frozen=True)
class HomeLogs:
    """The logs of a home with their layers, in order of time."""

    entries: Sequence[HomeLog]
    losses: Sequence[str]  # errors of unreadable files

    def between(
        self, start: int | None = None, end: int | None = None, layer: str = ""
    ) -> list[HomeLog]:
        """List the logs, or the layers of one name, that may cover a span of time.

        The span is from `start` on, before `end`, in nanoseconds of UTC; None is no limit. `layer`
        is `review` or `relabel-<model>`; empty for logs.
        """
        return [
            entry
            for entry in self.entries
            if entry.layer == layer
            and (start is None or entry.end > start)
            and (end is None or entry.start < end)
        ]

    def recent(self) -> list[HomeLog]:
        """List the logs that begin at most two weeks before the last one."""
        logs = self.between()
        newest = max((log.start for log in logs), default=0)
        return [log for log in logs if newest - log.start <= _RECENT]

    def latest_models(self) -> list[LabelledBy]:
        """List the models that labelled the latest log of each recorder, without duplicates.

        They are of all microphones of a recorder; empty texts for a microphone without a model.
        """
        by_node: dict[str, list[Path]] = {}
        for entry in self.between():
            by_node.setdefault(entry.node, []).append(entry.path)
        found: dict[LabelledBy, None] = {}
        for logs in by_node.values():
            latest = next(filter(None, map(models_of, reversed(logs))), {"": NO_MODEL})
            found |= dict.fromkeys(latest.values())
        return list(found)

    def latest_scenario_models(self, scenario: str) -> list[LabelledBy]:
        """List the latest models of each recorder for a scenario, without duplicates."""
        found: dict[str, dict[LabelledBy, None]] = {}
        for record in self.records():
            own = [one for one in recorded_scenarios(record) if one.name == scenario]
            models = dict.fromkeys(LabelledBy(one.model, one.sha256) for one in own)
            if models:
                found.setdefault(record.get("node", ""), models)
        return list(dict.fromkeys(model for models in found.values() for model in models))

    def first_model(self) -> str:
        """Return the SHA-256 of the model of the first labelled log; empty if there is none."""
        logs = [entry.path for entry in reversed(self.between())]
        records = (one.get("model_sha256", "") for one in latest_records(logs))
        return next(filter(None, records), "")

    @property
    def layers(self) -> list[str]:
        """Names of the models with relabel layers."""
        layers = {entry.layer for entry in self.entries if entry.layer.startswith(RELABEL_LAYER)}
        return sorted(layer.removeprefix(RELABEL_LAYER) for layer in layers)

    def hidden_classes(self) -> frozenset[str]:
        """Return the hidden classes: those of the configuration in the last log, and the list.

        Raise `LogError` if the list is damaged.
        """
        logs = self.between()
        last = next(self.records(), {})
        return recorded_hidden_classes(last) | (
            hidden_classes_of_log(logs[-1].path) if logs else frozenset()
        )

    def records(self) -> Iterator[Mapping[str, str]]:
        """Yield the `hearthlog` records of the logs, latest log first."""
        return latest_records(entry.path for entry in self.between())

    def days(self, zone: tzinfo) -> list[date]:
        """List the days from the first to the last message of each log, ascending."""
        begun = {local_time(entry.start, zone).date() for entry in self.between()}
        days = set(begun)
        for entry in self.between():
            first = local_time(entry.start, zone).date()
            following = first if entry.end == NEVER else local_time(entry.end - 1, zone).date()
            if entry.end == NEVER or not begun.issuperset(_dates(first, following)):
                days |= _dates(first, local_time(_last_time(entry), zone).date())
        return sorted(days)

    def last_complete_day(self, zone: tzinfo) -> date:
        """Return the last complete day, or the last day if none is complete.

        A day counts as complete if at most its last minute is missing.

        Raise `LogError` if no log has a readable message.
        """
        days = self.days(zone)
        if not days:
            raise LogError(self.losses[0] if self.losses else "there is no message in these logs")
        end = self.end() or 0
        complete = [day for day in days if day_span(day, zone)[1] - _TAIL <= end]
        return complete[-1] if complete else days[-1]

    def end(self) -> int | None:
        """Return the log time of the last readable message in nanoseconds of UTC, if any."""
        span = readable_span(entry.path for entry in reversed(self.between()))
        return None if span is None else span[1]


def _dates(first: date, last: date) -> set[date]:
    """Return the dates of a span; only both ends if it is too long for a log."""
    count = (last - first).days + 1
    if count > _MOST_DAYS:
        return {first, last}
    return {first + timedelta(days=number) for number in range(count)}


def _last_time(entry: HomeLog) -> int:
    """Return the time just before the end of a log; its start if it cannot be read."""
    span = readable_span([entry.path])
    return entry.start if span is None else max(entry.start, min(span[1], entry.end) - 1)


def find_home_logs(paths: Iterable[Path]) -> HomeLogs:
    """Find the logs and layers of a home by name; only files with other names are opened.

    Raise `LogError` if there is no such log, or none in a folder.
    """
    losses: list[str] = []
    entries: list[HomeLog] = []
    for path in find_with_layers(paths):
        try:
            entries += _entries(path)
        except LogError as error:
            losses.append(str(error))
    return HomeLogs(
        sorted(_closed(entries), key=lambda entry: (entry.start, entry.path.name)), losses
    )


def days_in_words(days: Sequence[date]) -> str:
    """Format ascending days, with runs joined: `2026-03-01 to 2026-03-04, 2026-03-09`.

    Of more than five runs, the text has the first and the last four.
    """
    numbered = enumerate(days)
    runs = [list(run) for _, run in groupby(numbered, lambda pair: pair[1].toordinal() - pair[0])]
    texts = [f"{run[0][1]}" if len(run) == 1 else f"{run[0][1]} to {run[-1][1]}" for run in runs]
    return ", ".join(texts[-5:]) if len(texts) <= 5 else f"{texts[0]} … {', '.join(texts[-4:])}"


def check_day(logs: HomeLogs, first: date, last: date, zone: tzinfo) -> None:
    """Raise `DataError` if there is no log on any of the days from `first` to `last`, included."""
    days = logs.days(zone)
    if any(first <= day <= last for day in days):
        return
    when = f"{first}" if first == last else f"{first} to {last}"
    there = f"there are {days_in_words(days)}" if days else "nor of any other day"
    loss = f"; {logs.losses[0]}" if logs.losses else ""
    raise DataError(f"no logs of {when} in the home's time zone, {zone}; {there}{loss}")


def _entries(path: Path) -> Iterator[HomeLog]:
    """Yield the entry of a file, by its name where possible; none for audio or no messages."""
    _, layer, node, time = log_name(path)
    if layer == AUDIO_LAYER:
        return
    try:
        moment = datetime.strptime(time.partition("_")[0], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
        yield HomeLog(path, node, layer, int(moment.timestamp()) * NANOSECONDS, NEVER)
    except ValueError:
        if (span := time_span(path)) is not None:
            yield HomeLog(path, "", layer, span[0], span[1] + 1)


def _closed(entries: Iterable[HomeLog]) -> Iterator[HomeLog]:
    """End each log where the next log of its kind begins."""
    by_kind: dict[tuple[str, str], list[HomeLog]] = {}
    for entry in entries:
        by_kind.setdefault((entry.node, entry.layer), []).append(entry)
    for same in by_kind.values():
        same.sort(key=lambda entry: entry.start)
        starts = sorted({entry.start for entry in same})
        following = dict(zip(starts, [*starts[1:], NEVER], strict=True))
        for entry in same:
            yield entry if entry.end < NEVER else entry._replace(end=following[entry.start])


_MOST = 4  # maximum number of changes in a text


def network_changes(logs: Iterable[HomeLog], zone: tzinfo) -> list[str]:
    """Describe, a line each, when the embedding network of each microphone changed, if it did."""
    spaces: dict[tuple[str, str], list[tuple[int, EmbeddingSpace | None]]] = {}
    for log in logs:
        with suppress(LogError), LogFile(log.path) as file:
            for microphone in sorted(microphones_of(file, "features")):
                source = embedding_source(file, microphone)
                space = None if source is None else source.space
                spaces.setdefault((log.node, microphone), []).append((log.start, space))
    return [
        f"{microphone}: {_changes(times, zone)}"
        for (_, microphone), times in sorted(spaces.items())
        if len({space for _, space in times}) > 1
    ]


def _changes(times: list[tuple[int, EmbeddingSpace | None]], zone: tzinfo) -> str:
    parts = [f"heard {_with(times[0][1], None)}"]
    for (_, before), (start, space) in pairwise(times):
        if space != before:
            moment = f"{local_time(start, zone):%Y-%m-%d %H:%M}"
            parts.append(f"from {moment} {_with(space, before)}")
    if len(parts) > _MOST:
        parts = [parts[0], "…", *parts[1 - _MOST :]]
    text = ", ".join(parts)
    return f"{text}; only what one network heard is compared, all else by features"


def _with(space: EmbeddingSpace | None, before: EmbeddingSpace | None) -> str:
    if space is None:
        return "without a network"
    same = before is not None and before.network == space.network
    return f"with another projection of {space.network}" if same else f"with {space.network}"
