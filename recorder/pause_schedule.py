"""Pause schedule of a recorder: quiet hours, requested pauses, and time zones."""

import os
import re
import stat
import time
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

from hearthlog.schemas.errors import ConfigurationError, LogError, shortened
from hearthlog.schemas.logs.files import log_readers
from hearthlog.schemas.messages.message_types import PAUSED, QUIET_HOURS
from hearthlog.schemas.new_files import replaced_file

_FORM = re.compile(r"([01]\d|2[0-3]):([0-5]\d)-([01]\d|2[0-3]):([0-5]\d)")
_DAY = 24 * 60
_PAUSE_FILE = ".pause"
_LONGEST = 600  # bytes read from the file
_LONGEST_NAME = 100  # characters of the requester's name
_LAST = 1 << 32  # seconds of UTC: in 2106


class QuietHours(NamedTuple):
    """Daily hours in minutes of the local day; the end may be on the next day."""

    start: int
    end: int

    def minutes_left(self, minute: int) -> int:
        """Return the minutes left at a minute of the day; 0 outside of the hours."""
        length = (self.end - self.start) % _DAY or _DAY
        return max(length - (minute - self.start) % _DAY, 0)


_DASHES = frozenset("\N{HYPHEN}\N{NON-BREAKING HYPHEN}\N{EN DASH}\N{EM DASH}\N{MINUS SIGN}")


def quiet_hours(text: str) -> QuietHours:
    """Parse hours such as `22:00-06:30`; raise `ConfigurationError` for another format."""
    found = _FORM.fullmatch(text)
    if found is None:
        hyphen = ", with a plain hyphen" if _DASHES & set(text) else ""
        raise ConfigurationError(
            f"{text[:64]!r} is not a span of hours; write it as 22:00-06:30{hyphen}"
        )
    hour, minute, last_hour, last_minute = map(int, found.groups())
    return QuietHours(60 * hour + minute, 60 * last_hour + last_minute)


def check_quiet_hours(text: str) -> str:
    """Return hours if valid; raise `ConfigurationError` as `quiet_hours`."""
    quiet_hours(text)
    return text


class PauseSchedule:
    """Schedule of the times at which microphones are closed."""

    def __init__(self, hours: list[QuietHours], zone: tzinfo, folder: Path) -> None:
        self._hours = hours
        self._zone = zone
        self._folder = folder

    def reason(self) -> str:
        """Return why the microphones are closed now; empty if they are open."""
        if is_paused(self._folder):
            return PAUSED
        return QUIET_HOURS if self._minutes_left() else ""

    def describe(self) -> str:
        """Format the reason and end of the current pause."""
        if is_paused(self._folder):
            end = paused_until(self._folder)
            until = "hearthlog resume" if end is None else self._local(end)
            who = _paused_by(self._folder)
            by = f" by {who}" if who else ""
            return f"{PAUSED}{by} until {until}: the microphone is closed"
        until = self._local(time.time() + 60 * self._minutes_left())
        return f"{QUIET_HOURS} until {until}: the microphone is closed"

    def _minutes_left(self) -> int:
        if not self._hours:
            return 0
        now = datetime.fromtimestamp(time.time(), self._zone)
        return max(each.minutes_left(60 * now.hour + now.minute) for each in self._hours)

    def _local(self, seconds: float) -> str:
        return f"{datetime.fromtimestamp(seconds, self._zone):%H:%M}"


def pause(folder: Path, duration: timedelta | None, who: str = "") -> None:
    """Request the recorders of a folder to close their microphones; by default until `resume`.

    Raise `LogError` if the folder is not writable.
    """
    end = "" if duration is None else str(int(time.time() + duration.total_seconds()))
    # A recorder of another account must be able to read the end.
    is_own = folder.stat().st_uid == os.geteuid()
    readers = log_readers(folder) if is_own else stat.S_IRGRP | stat.S_IROTH
    with replaced_file(folder / _PAUSE_FILE, readers=readers) as temporary:
        temporary.write_text(f"{end}\n{who}" if who else end, encoding="utf-8")


def resume(folder: Path) -> bool:
    """End a pause, if there is one; raise `OSError` if the folder is not writable."""
    was_paused = is_paused(folder)
    (folder / _PAUSE_FILE).unlink(missing_ok=True)
    return was_paused


def paused_until(folder: Path) -> float | None:
    """Return the end of a pause in seconds of UTC; None for a pause without an end."""
    try:
        end = int(_read_pause(folder).partition(b"\n")[0])
    except (OSError, ValueError):  # in doubt the microphones stay closed
        return None
    return float(end) if end < _LAST else None


def _paused_by(folder: Path) -> str:
    """Return who requested a pause; empty if unknown."""
    try:
        name = _read_pause(folder).partition(b"\n")[2].decode(errors="replace")
    except OSError:
        return ""
    return shortened(name, _LONGEST_NAME)


def _read_pause(folder: Path) -> bytes:
    path = folder / _PAUSE_FILE
    if not path.is_file():  # reading a pipe would block
        return b""
    with path.open("rb") as file:
        return file.read(_LONGEST)


def is_paused(folder: Path) -> bool:
    """Whether somebody has paused the recorders of a folder."""
    if not os.path.exists(f"{folder}/{_PAUSE_FILE}"):  # noqa: PTH110  at each block of sound
        return False
    end = paused_until(folder)
    return end is None or time.time() < end


DEFAULT = "UTC"
_NAME_FILE = Path("/etc/timezone")
_LINK = Path("/etc/localtime")
_DATABASE = "zoneinfo/"


def time_zone(name: str) -> tzinfo:
    """Return a time zone by its name in the IANA database, such as "Europe/Berlin", or "UTC".

    Raise `LogError` if this machine has no such zone.
    """
    if name == DEFAULT:
        return UTC  # available without a database
    try:
        return ZoneInfo(name)
    except (KeyError, ValueError, OSError) as error:
        raise LogError(
            f"no time zone {name[:64]!r} on this machine; name one as Europe/Berlin, or UTC"
        ) from error


def check_time_zone(name: str) -> str:
    """Return the name of a time zone; raise `LogError` if this machine has no such zone."""
    time_zone(name)
    return name


def machine_zone() -> str:
    """Return the name of this machine's time zone; UTC if unset or unknown."""
    for name in (os.environ.get("TZ", "").removeprefix(":"), _name_in_file(), _name_of_link()):
        if name and not name.startswith("/"):
            try:
                return check_time_zone(name)
            except LogError:  # TZ may also hold rules, such as CET-1CEST
                continue
    return DEFAULT


def _name_in_file() -> str:
    try:
        return _NAME_FILE.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _name_of_link() -> str:
    try:
        return str(_LINK.readlink()).rpartition(_DATABASE)[2]
    except OSError:
        return ""
