"""Support bundle: health and configuration of recorders, without anything they heard."""

import json
import os
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from hearthlog._version import __version__
from hearthlog.analyzer.doctor.examination import examine_file
from hearthlog.analyzer.logs.recorder_info import CONFIGURATION, attachments_of
from hearthlog.analyzer.recorder_status import examine_live
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer, log_name
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.message_types import GAP
from hearthlog.schemas.messages.topics import DIAGNOSTICS

_LOGS = 48  # the newest ones
_OF_SOUND = ("clips", "model")  # subjects whose texts may name sounds
# Values of diagnostics that do not depend on the sound.
_VALUES = {
    *("device", "frames_lost", "overruns", "clock_ppm", "block_age_seconds"),
    *("clock_synchronized", "temperature_celsius", "throttled", "memory_bytes"),
    *("disk_free_bytes", "free_bytes", "disk_bytes", "logs"),
}
_RELEASE = Path("/etc/os-release")


def support_bundle(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Collect the support bundle of a folder's recorders.

    Yields
    ------
    name : str
    content : bytes
        JSON: recording times, configuration, gaps, health of microphones and machine, and findings
        of the doctor, but no labels, features or levels.

    Raises
    ------
    LogError
        If the folder does not exist.
    """
    yield "machine.json", _json(_machine())
    states = [state for state in examine_live(folder) if _is_shareable(state.subject)]
    yield "live.json", _json([state._asdict() for state in states])
    logs: list[Path] = []
    with suppress(LogError):
        logs = [log for log in find_logs(folder) if not is_layer(log)][-_LOGS:]
    configuration = next(filter(None, map(_configuration, reversed(logs))), b"{}")
    yield CONFIGURATION, configuration
    yield "logs.json", _json([_log(log, folder) for log in logs])


def _machine() -> dict[str, Any]:
    names = [re.split(r"[ ;<>=!\[(~]", each)[0] for each in requires("hearthlog") or ()]
    versions = {}
    for name in sorted(set(names)):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    release = ""
    with suppress(OSError):
        release = _RELEASE.read_text(encoding="utf-8", errors="replace")[:4096]
    return {
        "hearthlog": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "release": release,
        "packages": versions,
    }


def _configuration(log: Path) -> bytes:
    """Return the configuration that a log was recorded with; it contains no passwords."""
    with suppress(LogError), LogFile(log) as file:
        found = [each.data for each in attachments_of(file) if each.name == CONFIGURATION]
        return bytes(found[0]) if found else b""
    return b""


def _log(log: Path, folder: Path) -> dict[str, Any]:
    findings = examine_file(log).findings
    told: dict[str, Any] = {
        "name": str(log.relative_to(folder)) if log.is_relative_to(folder) else log.name,
        "bytes": log.stat().st_size if log.exists() else 0,
        "findings": [
            {"level": level, "rule": rule, "count": count}
            for (level, rule), count in findings.counts.items()
        ],
    }
    with suppress(LogError):
        with LogFile(log) as file:
            topics = {number: channel.topic for number, channel in file.channels.items()}
            counts = file.statistics.channel_message_counts if file.statistics else {}
        told["frames"] = {
            topics[number]: count
            for number, count in counts.items()
            if topics.get(number, "").endswith("/features")
        }
        gaps = [topic for topic in topics.values() if topic.endswith("/gap")]
        columns = read_columns([log], [*gaps, DIAGNOSTICS])
        told["gaps"] = [gap for each in columns.values() for gap in _gaps(each)]
        if DIAGNOSTICS in columns:
            told["health"] = list(_health(columns[DIAGNOSTICS], log_name(log).node))
    return told


def _gaps(columns: Columns) -> Iterator[dict[str, Any]]:
    if columns.type != GAP:
        return
    rows = zip(columns.log_times.tolist(), columns["duration"].tolist(), columns["reason"],
               strict=True)  # fmt: skip
    for end, duration, reason in rows:
        yield {"topic": columns.topic, "end": end, "nanoseconds": duration, "reason": str(reason)}


def _health(columns: Columns, node: str) -> Iterator[dict[str, Any]]:
    """Yield the health of each subject whenever it changes."""
    before: dict[str, tuple[int, str]] = {}
    for time, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
        for status in statuses:
            subject = status["name"].removeprefix("hearthlog: ").removeprefix(f"{node} ")
            state = int(status["level"]), status["message"]
            if before.get(subject) == state:
                continue
            before[subject] = state
            yield {
                "time": time,
                "subject": subject,
                "level": state[0],
                "text": state[1] if _is_shareable(subject) else "",
                "values": _values(status),
            }


def _values(status: Mapping[str, Any]) -> dict[str, str]:
    return {pair["key"]: pair["value"] for pair in status["values"] if pair["key"] in _VALUES}


def _is_shareable(subject: str) -> bool:
    return subject.rpartition(" ")[2] not in _OF_SOUND


def _json(content: Any) -> bytes:
    return json.dumps(content, indent=1).encode()
