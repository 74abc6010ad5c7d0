"""Status of the recorders of a folder: process, microphones, disk, and suggested fixes."""

import json
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from hearthlog.analyzer.logs.recorder_info import read_recorder_infos
from hearthlog.models.modelfile.modelfile import DESCRIPTION, attachment_of
from hearthlog.recorder.log.folder_lock import NodeLock, node_locks
from hearthlog.recorder.pause_schedule import paused_until
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS, millisecond_text
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import check_allowed, find_logs, is_active, log_name
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
    locks = node_locks(folder)
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
                heard = info.embedding
                if heard is not None and heard.network == wanted:
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
    since = "" if newest is None else f" since {_moment(newest)}"
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
    if "device" in status.values and _LEVELS[status.level] == "error":
        joint = " " if status.text.endswith("?") else "; "
        advice = f"{joint}look at its cable and power; `hearthlog devices` lists what is there"
    yield State(_LEVELS[status.level], status.subject, status.text + advice)
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
            subject = status["name"].removeprefix("hearthlog: ").removeprefix(f"{node} ")
            level = min(int(status["level"]), len(_LEVELS) - 1)
            values = {pair["key"]: pair["value"] for pair in status["values"]}
            yield _Status(subject, stamp, level, status["message"], values)


def _folder(folder: Path) -> Iterator[State]:
    if (folder / ".pause").exists():
        end = paused_until(folder)
        until = "`hearthlog resume`" if end is None else _moment(int(end) * NANOSECONDS)
        if end is None or end > time.time():
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


def _moment(stamp: int) -> str:
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
