"""Days of a home as logs, written without sound: only what a report reads of them."""

from collections.abc import Iterable, Mapping
from datetime import UTC, date, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hearthlog.models.features.auros21 import FEATURE_NAMES
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import log_path
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import duration_message, encode, header, message
from hearthlog.schemas.messages.topics import DIAGNOSTICS, topics_of

GENERAL = [
    "silence",
    "speech",
    "music",
    "phone_ring",
    "coughing",
    "crying",
    "yelling",
    "laughing",
    "objects_activity",
]
BATHROOM = ["silence", "flushing_water", "shower", "tap_water", "other"]
HOUR = 3600

Event = tuple[float, float, str, float]  # second of the day (UTC), seconds, label, confidence


# second of the day (UTC), seconds, label, confidence, probabilities, dB above the quiet around
Doubt = tuple[float, float, str, float, Mapping[str, float], float]


def at(text: str) -> float:
    """Read a time of day, `07:30` or `07:30:15`, in seconds."""
    hours, minutes, *seconds = map(int, text.split(":"))
    return hours * HOUR + 60 * minutes + sum(seconds)


def midnight(day: date) -> int:
    """Return the nanoseconds at which a day of UTC begins."""
    return int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()) * NANOSECONDS


def write_day(  # noqa: PLR0913
    root: Path,
    day: date,
    events: Iterable[Event] = (),
    *,
    node: str = "home",
    microphone: str = "mic",
    classes: Iterable[str] = GENERAL,
    hours: Iterable[int] = range(24),
    gaps: Iterable[tuple[float, float, str]] = (),
    health: Iterable[tuple[float, int, str]] = (),
    timezone: str | None = None,
    file_hours: int = 1,
    others: Mapping[str, Iterable[Event]] = MappingProxyType({}),
    doubts: Iterable[Doubt] = (),
    all_frames: bool = False,
    steady: Iterable[tuple[float, float, float]] | None = None,
) -> list[Path]:
    """Write the logs of a day: events, and silence where there is no gap, both in UTC.

    The recorder may have other microphones, with events of their own and no gap. Only of `doubts`
    there are frames, those of the quiet around each of them too; they are events as well. With
    `all_frames` there are those of the whole day instead. With `steady`, even if empty, there are
    statistics, louder by some dB in its spans: second of the day, seconds, dB.
    """
    doubts = list(doubts)
    events = [*events, *((second, seconds, *about[:2]) for second, seconds, *about in doubts)]
    begin, gaps, hours, step = midnight(day), list(gaps), list(hours), file_hours
    rooms = {microphone: list(_tiled(sorted(events), gaps, hours))}
    rooms |= {name: list(_tiled(sorted(own), [], hours)) for name, own in others.items()}
    return [
        _write_hour(
            log_path(root, node, begin + hour * HOUR * NANOSECONDS),
            microphone,
            list(classes),
            begin,
            {
                name: [row for row in rows if hour * HOUR < sum(row[:2]) <= (hour + step) * HOUR]
                for name, rows in rooms.items()
            },
            [gap for gap in gaps if hour * HOUR < gap[0] + gap[1] <= (hour + step) * HOUR],
            [output for output in health if hour * HOUR <= output[0] < (hour + step) * HOUR],
            [each for each in doubts if hour * HOUR <= each[0] < (hour + step) * HOUR],
            all_frames,
            None if steady is None else (hour, hour + step, list(steady)),
            {"version": "0", "node": node} | ({"timezone": timezone} if timezone else {}),
        )
        for hour in hours[::step]
    ]


def write_life(root: Path, first: date, count: int, seed: int = 1, **about: Any) -> None:
    """Write plausible days of a flat with microphones in two rooms."""
    rng = np.random.default_rng(seed)
    about = {"file_hours": 6, **about}
    for number in range(count):
        day = first + timedelta(days=number)
        write_day(root, day, _living_room(rng), node="flat", microphone="living_room", **about)
        bathroom = {"node": "bathroom", "microphone": "bathroom", "classes": BATHROOM}
        write_day(root, day, _bathroom(rng), **bathroom, **about)


def _living_room(rng: np.random.Generator) -> list[Event]:
    found: list[Event] = []
    plan = [
        ("coughing", 0, 7, 3, (0.5, 3)),
        ("objects_activity", 7, 9, 30, (10, 60)),
        ("speech", 8, 21, 12, (30, 400)),
        ("objects_activity", 11.5, 13, 25, (10, 60)),
        ("coughing", 8, 22, 6, (0.5, 3)),
        ("phone_ring", 9, 20, 2, (4, 12)),
        ("music", 15, 17, 6, (300, 900)),
        ("laughing", 15, 21, 3, (2, 7)),
        ("objects_activity", 18, 19.5, 25, (10, 60)),
        ("speech", 19.5, 21.5, 9, (200, 500)),
    ]
    for label, start, end, mean, (short, long) in plan:
        for second in rng.uniform(start * HOUR, end * HOUR, rng.poisson(mean)):
            how_sure = rng.uniform(0.5, 0.99)
            found.append((second, rng.uniform(short, long), label, how_sure))
    return found


def _bathroom(rng: np.random.Generator) -> list[Event]:
    found: list[Event] = []
    for hour in [*rng.uniform(1, 6, rng.poisson(1.5)), 7, 10, 13, 16, 19, 21.8]:
        second = (hour + rng.uniform(0, 0.4)) * HOUR
        found.append((second, 12.0, "flushing_water", rng.uniform(0.8, 0.99)))
        found.append((second + 20, rng.uniform(5, 20), "tap_water", rng.uniform(0.6, 0.99)))
    if rng.random() < 0.6:
        found.append((7.5 * HOUR, rng.uniform(240, 600), "shower", 0.97))
    return found


def frames_of(  # noqa: PLR0913, PLR0917
    microphone, classes, start, seconds, label, confidence, shares, level_db, around=200
) -> list[TopicBatch]:
    """Return the labels and features of a sound, and of ten seconds of quiet before and after."""
    count = round(seconds * 20)
    stamps = start + (np.arange(count + 2 * around) - around) * (NANOSECONDS // 20)
    is_sound = (stamps >= start) & (stamps < start + count * NANOSECONDS // 20)
    probabilities = np.zeros((len(stamps), len(classes)), np.float32)
    probabilities[~is_sound, classes.index("silence")] = 1.0
    for name, share in {label: confidence, **shares}.items():
        if name in classes:
            probabilities[is_sound, classes.index(name)] = share
    values = np.zeros((len(stamps), len(FEATURE_NAMES)), np.float32)
    values[:, FEATURE_NAMES.index("energy")] = np.where(is_sound, 10 ** (level_db / 10), 1.0) * 1e-6
    head = {
        "header.stamp": stamps,
        "header.frame_id": microphone,
        "frame": np.arange(len(stamps)),
    }
    labels = {
        "label": np.where(is_sound, label, "silence").tolist(),
        "confidence": probabilities.max(axis=1),
        "novelty": np.zeros(len(stamps), np.float32),
        "probabilities": probabilities,
    }
    return [
        TopicBatch(f"/{microphone}/label", stamps, head | labels),
        TopicBatch(f"/{microphone}/features", stamps, head | {"values": values}),
    ]


def _tiled(events: list[Event], gaps: list[tuple[float, float, str]], hours: list[int]):
    """Cut events so that they do not overlap, and put silence between them, hour by hour."""
    blocks = [(start, start + seconds) for start, seconds, _ in gaps]
    cuts = [hour * HOUR for hour in hours] + [(hour + 1) * HOUR for hour in hours]
    now = 0.0
    spans: list[Event] = []
    for start, seconds, label, confidence in events:
        begin, end = max(start, now), min(start + seconds, 24 * HOUR)
        if end > begin:
            spans.append((begin, end - begin, label, confidence))
            now = end
    edges = sorted({*cuts, *(t for s in spans for t in (s[0], s[0] + s[1])), *sum(blocks, ())})
    index = 0
    for a, b in pairwise(edges):
        middle = (a + b) / 2
        while index < len(spans) and spans[index][0] + spans[index][1] <= middle:
            index += 1
        if int(middle // HOUR) not in hours or any(x <= middle < y for x, y in blocks):
            continue
        inside = index < len(spans) and spans[index][0] <= middle
        label, confidence = spans[index][2:] if inside else ("silence", 0.99)
        yield a, b - a, label, confidence


def _statistics_of(microphone, begin, first, last, steady) -> TopicBatch:
    """Return the statistics of some hours: of a quiet that is louder in some spans."""
    seconds = np.arange(first * HOUR, last * HOUR)
    level = np.full(len(seconds), -60.0)
    for start, length, louder in steady:
        level[(seconds >= start) & (seconds < start + length)] += louder
    mean = np.zeros((len(seconds), len(FEATURE_NAMES)), np.float32)
    mean[:, FEATURE_NAMES.index("energy")] = 10 ** (level / 10)
    stamps = begin + seconds * NANOSECONDS
    head = {"header.stamp": stamps, "header.frame_id": microphone, "frame": seconds * 20}
    fields = head | {"mean": mean, "std": np.zeros_like(mean)}
    return TopicBatch(f"/{microphone}/statistics", stamps, fields)


def _write_hour(  # noqa: PLR0913, PLR0917
    path, microphone, classes, begin, rooms, gaps, health, doubts, all_frames, steady, about
) -> Path:
    topics = [each for name in rooms for each in topics_of(name, FEATURE_NAMES, classes)]
    writer = LogWriter(path, [*{each.name: each for each in topics}.values()], about)
    written = []
    batches = []
    for name, rows in rooms.items():
        starts = begin + np.array([round(row[0] * 1000) for row in rows], np.int64) * 1_000_000
        ends = begin + np.array([round((r[0] + r[1]) * 1000) for r in rows], np.int64) * 1_000_000
        if rows:
            fields = {
                "header.stamp": starts,
                "header.frame_id": name,
                "duration": ends - starts,
                "label": [row[2] for row in rows],
                "confidence": np.array([row[3] for row in rows], np.float32),
            }
            batches.append(TopicBatch(f"/{name}/segment", ends, fields))
    for second, *doubt in doubts:
        first = begin + round(second * NANOSECONDS)
        batches += frames_of(microphone, classes, first, *doubt)
    for second, *row in rooms[microphone] if all_frames else ():
        first = begin + round(second * NANOSECONDS)
        batches += frames_of(microphone, classes, first, *row, {}, 0.0, around=0)
    if steady is not None:
        batches.append(_statistics_of(microphone, begin, *steady))
    if batches:
        writer.write_columns(batches)
    for start, seconds, reason in gaps:
        stamp = begin + round(start * NANOSECONDS)
        length = round(seconds * NANOSECONDS)
        gap = message(
            message_types.GAP,
            header=header(stamp, microphone),
            duration=duration_message(length),
            reason=reason,
            frames_lost=round(seconds * 20),
        )
        written.append((stamp + length, f"/{microphone}/gap", encode(gap)))
    for second, level, text in health:
        stamp = begin + round(second * NANOSECONDS)
        status = message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"hearthlog: {microphone}",
            message=text,
            hardware_id=microphone,
            values=[],
        )
        output = message(
            message_types.DIAGNOSTICS, header=header(stamp, microphone), status=[status]
        )
        written.append((stamp, DIAGNOSTICS, encode(output)))
    for time, topic, data in sorted(written):
        writer.write(topic, time, data)
    return writer.finish()
