"""Status of a recorder from its logs, and the support bundle of its health and configuration."""

import json
import os
import platform
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal, NamedTuple

from hearthlog._version import __version__
from hearthlog.analyzer.doctor.examination import examine_file
from hearthlog.analyzer.logs.recorder_info import CONFIGURATION, attachments_of, read_recorder_infos
from hearthlog.models.modelfile import DESCRIPTION, attachment_of
from hearthlog.recorder.log.folder_lock import NodeLock, node_locks
from hearthlog.recorder.pause_schedule import is_paused, paused_until
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS, millisecond_text
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import check_allowed, find_logs, is_active, is_layer, log_name
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.message_types import GAP, status_subject
from hearthlog.schemas.messages.topics import DIAGNOSTICS

Level = Literal["ok", "warning", "error"]
_LEVELS: tuple[Level, ...] = ("ok", "warning", "error")  # index: level of diagnostics
_SPEAKS_SECONDS = 30.0  # the recorder writes diagnostics every ten seconds
_OTHERS = 0o077  # permission bits of group and others
_NOT_SET = "clock_synchronized", "no"


class _Status(NamedTuple):
    """The latest diagnostics of a recorder on one subject."""

    subject: str
    time: int  # in nanoseconds of UTC
    level: int
    text: str
    values: Mapping[str, str]


class State(NamedTuple):
    """Status line of one subject."""

    level: Level
    subject: str
    text: str


def examine_live(folder: Path) -> list[State]:
    """Check a folder of logs, its disk, and the diagnostics of its recorders.

    Raise `LogError` if the folder does not exist.
    """
    check_allowed(folder)
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; name the one that the recorder writes to")
    locks = list(node_locks(folder))
    logs: dict[str, list[Path]] = {lock.node: [] for lock in locks}
    with suppress(LogError):
        for log in find_logs(folder):
            name = log_name(log)
            if name.node in logs and not name.layer:
                logs[name.node].append(log)
    states = [state for lock in locks for state in _recorder(lock, locks, logs)]
    if not states:
        states.append(State("error", "recorder", f"nothing was ever recorded in {folder}"))
    return [*states, *_folder(folder)]


def _recorder(
    lock: NodeLock, locks: Sequence[NodeLock], logs: Mapping[str, Sequence[Path]]
) -> Iterator[State]:
    node, own = lock.node, logs[lock.node]
    if not (lock.is_held or lock.process or own):
        return  # no recorder has used this name
    statuses = _last_statuses(own, node)
    newest = max((status.time for status in statuses), default=None)
    silent = None if newest is None else time.time() - newest / NANOSECONDS
    speaks = silent is not None and abs(silent) <= _SPEAKS_SECONDS
    if lock.is_held is False or (lock.is_held is None and not speaks):
        yield _stopped(lock, newest, locks, logs)
        return
    process = f"process {lock.process}" if lock.process else "its lock may not be read by you"
    yield State("ok", "recorder", f"{node} runs ({process})")
    if not speaks:
        since = "nothing yet" if silent is None else f"nothing for {abs(silent):.0f} s"
        text = f"{node} wrote {since}: see the disk below, or restart it"
        yield State("error", "recorder", text)
    for status in statuses:
        yield from _of_status(status)
    yield from _networks(own)


def _networks(logs: Sequence[Path]) -> Iterator[State]:
    """Yield which networks the models of the newest log need, and whether they are installed."""
    for log in logs[-1:]:
        with suppress(LogError, ValueError):
            for info in read_recorder_infos(log, "features"):
                data = {each.name: each.data for each in info.attachments}
                own = attachment_of(DESCRIPTION, info.microphone)
                about = json.loads(data.get(own) or data.get(DESCRIPTION) or b"{}")
                wanted = (about.get("embedding") or {}).get("network")
                if not wanted:
                    continue
                what = f"{info.model} takes what the network {wanted} hears"
                space = info.embedding
                if space is not None and space.network == wanted:
                    yield State("ok", info.microphone, f"{what}, which is there")
                    continue
                remedy = f"hearthlog models fetch {wanted}, and restart the recorder"
                text = f"{what}, and it is not there: labels by features alone; {remedy}"
                yield State("warning", info.microphone, text)


def _stopped(
    lock: NodeLock,
    newest: int | None,
    locks: Sequence[NodeLock],
    logs: Mapping[str, Sequence[Path]],
) -> State:
    """Describe a recorder that does not run.

    A recorder that completed its last log, and after which another recorder wrote to the folder,
    was stopped or renamed: a warning only. A killed recorder leaves an unfinished log.
    """
    since = "" if newest is None else f" since {_minute_text(newest)}"
    others = [other for other in locks if other.node != lock.node]
    end = _last_start(logs[lock.node])
    is_followed = any(other.is_held or _last_start(logs[other.node]) > end for other in others)
    is_complete = not any(is_active(log) for log in logs[lock.node])
    gone = f"delete {lock.path} if no recorder has this name any more"
    if is_followed and is_complete:
        text = f"{lock.node} was stopped{since}, others record here: start it, or {gone}"
        return State("warning", "recorder", text)
    text = f"{lock.node} does not run{since}: start it, or see `journalctl -u hearthlog` for why"
    return State("error", "recorder", f"{text}; {gone}" if is_followed else text)


def _last_start(logs: Sequence[Path]) -> str:
    return max((log_name(log).time for log in logs), default="")


def _of_status(status: _Status) -> Iterator[State]:
    advice = ""
    level = _LEVELS[min(status.level, len(_LEVELS) - 1)]
    if "device" in status.values and level == "error":
        joint = " " if status.text.endswith("?") else "; "
        advice = f"{joint}look at its cable and power; `hearthlog devices` lists what is there"
    yield State(level, status.subject, status.text + advice)
    if status.values.get(_NOT_SET[0]) == _NOT_SET[1]:
        text = "is not synchronized: connect the machine to the network, or give it a clock module"
        yield State("warning", "clock", text)


def _last_statuses(logs: Sequence[Path], node: str) -> list[_Status]:
    """Return the latest status of each subject, from the newest log with diagnostics."""
    for log in reversed(logs[-3:]):  # the newest may have no diagnostics yet
        with suppress(LogError):
            columns = read_columns([log], [DIAGNOSTICS], fields=["status"]).values()
            statuses = [status for each in columns for status in _statuses(each, node)]
            if last := {each.subject: each for each in statuses}:
                return [last[subject] for subject in sorted(last)]
    return []


def _statuses(columns: Columns, node: str) -> Iterator[_Status]:
    for stamp, statuses in zip(columns.log_times.tolist(), columns["status"], strict=True):
        for status in statuses:
            values = {pair["key"]: pair["value"] for pair in status["values"]}
            subject = status_subject(status["name"], node)
            yield _Status(subject, stamp, int(status["level"]), status["message"], values)


def _folder(folder: Path) -> Iterator[State]:
    if is_paused(folder):
        end = paused_until(folder)
        until = "`hearthlog resume`" if end is None else _minute_text(int(end) * NANOSECONDS)
        yield State("ok", "pause", f"nobody is listened to until {until}")
    problem = _write_problem(folder)
    if problem:
        text = (
            f"{folder} cannot be written ({problem}): what is heard is held in memory for a while"
        )
        yield State("error", "disk", f"{text}; make room, or mend the disk")
    if folder.stat().st_mode & _OTHERS:
        text = f"others on this machine may look into {folder}: `chmod -R go= {folder}`"
        yield State("warning", "rights", text)


def _minute_text(stamp: int) -> str:
    return f"{millisecond_text(stamp)[:16].replace('T', ' ')} UTC"


def _write_problem(folder: Path) -> str:
    """Write a test block to the disk; return the error, or an empty text."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error.strerror or str(error)
    return ""


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

    Raise `LogError` if the folder does not exist.

    Yields
    ------
    name : str
    content : bytes
        JSON: recording times, configuration, gaps, health of microphones and machine, and findings
        of the doctor, but no labels, features or levels.
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
    status: dict[str, Any] = {
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
        status["frames"] = {
            topics[number]: count
            for number, count in counts.items()
            if topics.get(number, "").endswith("/features")
        }
        gaps = [topic for topic in topics.values() if topic.endswith("/gap")]
        columns = read_columns([log], [*gaps, DIAGNOSTICS])
        status["gaps"] = [gap for each in columns.values() for gap in _gaps(each)]
        if DIAGNOSTICS in columns:
            status["health"] = list(_health(columns[DIAGNOSTICS], log_name(log).node))
    return status


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
    for status in _statuses(columns, node):
        state = status.level, status.text
        if before.get(status.subject) == state:
            continue
        before[status.subject] = state
        yield {
            "time": status.time,
            "subject": status.subject,
            "level": status.level,
            "text": status.text if _is_shareable(status.subject) else "",
            "values": {key: value for key, value in status.values.items() if key in _VALUES},
        }


def _is_shareable(subject: str) -> bool:
    return subject.rpartition(" ")[2] not in _OF_SOUND


def _json(content: Any) -> bytes:
    return json.dumps(content, indent=1).encode()
