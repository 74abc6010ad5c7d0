"""Start times of audio files: from their names, their metadata, or a guess."""

import re
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import BinaryIO, NamedTuple

from hearthlog.recorder.sources.open_audio import audio_seconds, text_fields
from hearthlog.schemas.errors import ConfigurationError, SourceError
from hearthlog.schemas.frames import NANOSECONDS, millisecond_text, read_time

NAME, METADATA, GUESS = "its name", "its metadata", "a guess"

# Date and time formats of recorders, telephones and other programs. BirdNET-Pi puts its name
# between date and time, macOS and WhatsApp "at", Song Meter a dollar sign.
_IN_NAME = re.compile(
    r"""(?<!\d)
    (?P<year>\d{4})(?P<dash>[-_.]?)(?P<month>\d\d)(?P=dash)(?P<day>\d\d)
    (?P<between>T|[ _$-]{1,3}|[ _-]at[ _-]|-birdnet-(?:[A-Za-z]\w{0,40}-)?|(?<=\d{8}))
    (?P<hour>\d\d|\d(?=[-_.:]\d\d[-_.:]))
    (?:(?P<colon>[-_.:]?)(?P<minute>\d\d)(?:(?P=colon)(?P<second>\d\d))?
      |h(?P<minute_h>\d\d)m(?P<second_h>\d\d)s?)
    (?!\d)
    (?:[.,](?P<fraction>\d{1,9})(?![0-9A-Za-z]|$)|[.,](?P<fraction_z>\d{1,9})(?=Z|$))?
    (?:[ _\u00a0\u202f]?(?P<half>[AaPp])(?:[Mm]|\.[ _\u00a0\u202f]?[Mm]\.?)(?![0-9A-Za-z])
      |(?P<zone>Z|[ _]?(?:UTC|GMT)(?:[+-]\d\d?(?::?\d\d)?)?|[+-]\d\d:?\d\d|\+\d\d)
       (?![0-9A-Za-z]))?
    """,
    re.VERBOSE | re.ASCII,
)
_HALF = re.compile(  # AM or PM in other languages and programs
    r"[ _\u00a0\u202f-]{0,2}(?:[AaPp]\.? ?[Mm](?![A-Za-z])|nachm|vorm|[μπ]\.?μ"
    r"|上午|下午|午前|午後|오전|오후)",
)
_ZONE_NAME = re.compile(  # has no unique offset: three countries use IST
    r"[ _-]{0,2}\(?(?:[CEW]ES?T|MES?Z|[ACEMP][SD]T|[BIJK]ST|A[CEW][SD]T|NZ[SD]T)(?![A-Za-z])"
)
_DASH_DIGITS = re.compile(r"-\d{4}")
_HEXADECIMAL = re.compile(r"[0-9A-F]{8}")  # old AudioMoths: seconds since 1970
_AUDIOMOTH = re.compile(
    r"Recorded at (\d\d:\d\d:\d\d(?:\.\d{3})?) (\d\d)/(\d\d)/(\d{4}) "
    r"\(UTC(?:([+-])(\d{1,2})(?::(\d\d))?)?\)"
)
_GUANO = re.compile(r"^Timestamp: *(\S{19,40})", re.MULTILINE)
_FIRST_YEAR = 1990  # an unset clock shows 1970 or 1980
_UNSET = (2000, 1, 1)  # or this day
_FIRST_AUDIOMOTH = 1_388_534_400  # 2014
_DAY = 86_400
_MOST_CHUNKS = 1000
_MOST_BYTES = 65_536  # of a chunk
_DIRECTIVES = {
    "Y": r"\d{4}",
    "m": r"\d\d",
    "d": r"\d\d",
    "H": r"\d\d",
    "M": r"\d\d",
    "S": r"\d\d",
    "y": r"\d\d",
    "I": r"\d\d",
    "j": r"\d{3}",
    "f": r"\d{1,6}",
    "p": "[AaPp][Mm]",
    "b": "[A-Za-z]{3}",
    "B": "[A-Za-z]{3,9}",
    "z": r"(?:Z|[+-]\d\d:?\d\d)",
    "%": "%",
}


class FileTime(NamedTuple):
    """Start of an audio file."""

    start: int
    step: int  # resolution of the start, in nanoseconds
    origin: str
    remark: str = ""  # why the start may be wrong; empty if there is no doubt


class _Moment(NamedTuple):
    time: datetime  # naive if the text has no zone
    step: int  # ns


def file_time(
    path: Path, zone: tzinfo, pattern: str = "", *, has_zone: bool | None = None
) -> FileTime:
    """Determine the start of an audio file; `zone` is that of times without one.

    The sources are, in this order: the name of the file, its metadata (AudioMoth's comment, GUANO,
    Broadcast Wave), its modification time minus its length, as recorders close a file at its end.
    `pattern` is the name's format, as for `strptime`; empty for the built-in formats. `has_zone`
    states whether a dash and four digits after a time are a zone, unless the name decides it; None
    (unknown): a number. Raise `SourceError` if the file is unreadable, or its name does not match.
    """
    if not path.exists():
        raise SourceError(f"{path}: no such file")
    if pattern:
        return _placed(path, _by_pattern(path, pattern), zone, NAME)
    refused: list[str] = []
    moments = _in_name(path, refused, has_zone=has_zone is True)
    if moments:
        found = _by_name(path, moments, zone)
        return found._replace(remark=found.remark or _doubt(path, has_zone))
    for moment in _in_metadata(path):
        if reason := _implausible(path, moment.time):
            refused.append(f"{moment.time:%Y-%m-%d %H:%M:%S} in its metadata {reason}")
        else:
            return _placed(path, moment, zone, METADATA)
    length = int(audio_seconds(path) * NANOSECONDS)
    start = max(path.stat().st_mtime_ns - length, 0)
    why = "; ".join(refused) or "neither its name nor its metadata say when it begins"
    return FileTime(start, 0, GUESS, why)


def arrange(
    paths: Sequence[Path], zone: tzinfo, pattern: str = "", start: int | None = None
) -> tuple[list[Path], list[FileTime | None]]:
    """Sort audio files by time, and return the start of each, or None if it follows without a gap.

    `zone` is that of times without one. `start`, in nanoseconds of UTC, overrides that of the first
    file; the others keep their distance from it. Raise `SourceError` as `file_time`.
    """
    placed: list[tuple[FileTime, list[Path]]] = []
    if start is not None and len(paths) == 1:
        return list(paths), [FileTime(start, 0, GUESS)]
    has_zone = _have_zone(paths) if len(paths) > 1 else None
    for path in paths:
        found = file_time(path, zone, pattern, has_zone=has_zone)
        if found.origin == GUESS and placed:
            placed[-1][1].append(path)  # it follows the previous path
        else:
            placed.append((found, [path]))
    placed.sort(key=lambda one: one[0].start)
    shift = 0 if start is None else start - placed[0][0].start
    ordered: list[Path] = []
    times: list[FileTime | None] = []
    for found, group in placed:
        ordered += group
        times += [found._replace(start=found.start + shift), *[None] * (len(group) - 1)]
    return ordered, times


def check_pattern(pattern: str) -> None:
    """Raise `ConfigurationError` if a pattern lacks a date or a time of day."""
    found = re.findall("%(.)", pattern)
    used = set(found)
    unknown = sorted(used - _DIRECTIVES.keys())
    dated = used & {"Y", "y"} and ((used & {"m", "b", "B"} and "d" in used) or "j" in used)
    timed = "M" in used and ("H" in used or {"I", "p"} <= used)
    if unknown or pattern.replace("%%", "").endswith("%"):
        directives = ", ".join(f"%{name}" for name in _DIRECTIVES)
        raise ConfigurationError(f"{pattern[:80]!r}: a pattern of names has {directives}")
    if again := [name for name in sorted(used - {"%"}) if found.count(name) > 1]:
        raise ConfigurationError(f"{pattern[:80]!r}: a pattern of names has %{again[0]} once only")
    if not (dated and timed):
        raise ConfigurationError(
            f"{pattern[:80]!r}: a pattern of names says date and time, as %Y%m%d_%H%M%S"
        )


def _by_pattern(path: Path, pattern: str) -> _Moment:
    """Parse the time in a name by a pattern, which may match a part of the name."""
    places = re.split("(%.)", pattern)
    text = "".join(
        _DIRECTIVES[part[1]] if part.startswith("%") else re.escape(part) for part in places
    )
    folders = pattern.count("/")
    name = "/".join(path.absolute().parts[-1 - folders :])
    refusal = SourceError(
        f"{path}: its name does not fit {pattern[:80]!r}, by which it should say when it begins"
    )
    edges = (rf"(?<!\d){text}(?!\d)", text)
    found = next(filter(None, (re.search(each, name, re.ASCII) for each in edges)), None)
    if found is None:
        raise refusal
    try:
        moment = datetime.strptime(found.group(), pattern)  # noqa: DTZ007  the zone is added
    except ValueError as error:
        raise refusal from error
    if reason := _implausible(path, moment):
        raise SourceError(f"{path}: {found.group()!r} in its name {reason}")
    step = NANOSECONDS if "%S" in pattern else 60 * NANOSECONDS
    return _Moment(moment, 1_000_000 if "%f" in pattern else step)


def _dash_digits(path: Path) -> str:
    """Return a dash and four digits after the time in a name: a zone or a part number."""
    for found in _IN_NAME.finditer(path.name):
        is_iso = found["between"] == "T" or found["colon"] == ":"
        if not is_iso and _DASH_DIGITS.fullmatch(found["zone"] or ""):
            return found["zone"]
    return ""


def _have_zone(paths: Sequence[Path]) -> bool:
    """Return whether the digits after the times are one zone, or one zone and its summer time."""
    numbers = {_dash_digits(path) for path in paths}
    if len(numbers) == 1:
        return numbers != {""}
    zones = [zone for number in numbers if (zone := _offset(number)) is not None]
    if not len(zones) == len(numbers) == 2:
        return False
    one, other = (datetime.now(zone).utcoffset() or timedelta() for zone in zones)
    return abs(one - other) == timedelta(hours=1)


def _doubt(path: Path, has_zone: bool | None) -> str:  # noqa: FBT001
    """Return why the time in a name may be misread; empty if there is no doubt."""
    if has_zone is not True and _offset(_dash_digits(path)) is not None:
        return (
            "the digits behind the time in its name are taken for a number "
            "(a zone is read by --start-pattern with %z)"
        )
    found = _IN_NAME.search(path.name)
    if (
        found
        and not found["half"]
        and int(found["hour"]) <= 12
        and _HALF.match(path.name, found.end())
    ):
        return "what follows the time in its name may be a half of the day, and was not read"
    if found and _ZONE_NAME.match(path.name, found.end()):
        return (
            "what follows the time in its name may be a zone, and was not read "
            "(a zone is read by --start-pattern with %z, as +0100)"
        )
    return ""


def _in_name(path: Path, refused: list[str], *, has_zone: bool) -> list[_Moment]:
    """Parse the distinct times in a name; append rejected candidates to `refused`."""
    moments: list[_Moment] = []
    for found in _IN_NAME.finditer(path.name):
        with_seconds = found["second"] or found["second_h"]
        if not with_seconds and found["between"] != "T" and found["colon"] != ":":
            refused.append(f"{found.group()!r} in its name may be a time, or a number")
            continue
        is_number = not has_zone and (found["zone"] or "?") == _dash_digits(path)
        moment = _moment(found, zone=None if is_number else found["zone"])
        reason = "is no date" if moment is None else _implausible(path, moment.time)
        if moment is None or reason:
            refused.append(f"{found.group()!r} in its name {reason}")
        elif moment not in moments:
            moments.append(moment)
    if not moments and _HEXADECIMAL.fullmatch(path.stem) and not path.stem.isdecimal():
        seconds = int(path.stem, 16)
        moment = _Moment(datetime.fromtimestamp(seconds, UTC), NANOSECONDS)
        if seconds >= _FIRST_AUDIOMOTH and not _implausible(path, moment.time):
            moments.append(moment)
    return moments


def _moment(found: re.Match[str], zone: str | None) -> _Moment | None:
    """Return the matched time; None if it is not a valid date and time."""
    hour = int(found["hour"])
    if half := found["half"]:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + (12 if half in "pP" else 0)
    minute = found["minute"] or found["minute_h"]
    second = found["second"] or found["second_h"]
    fraction = found["fraction"] or found["fraction_z"] or ""
    try:
        moment = datetime(  # noqa: DTZ001  the zone is added
            int(found["year"]),
            int(found["month"]),
            int(found["day"]),
            hour,
            int(minute),
            int(second or 0),
            int(fraction.ljust(6, "0")[:6]) if fraction else 0,
        )
    except ValueError:
        return None
    step = NANOSECONDS // 10 ** len(fraction) if second else 60 * NANOSECONDS
    return _Moment(moment.replace(tzinfo=_offset(zone)), step)


def _offset(text: str | None) -> tzinfo | None:
    """Parse a zone; None if the text is no zone, such as a part number."""
    if not text:
        return None
    found = re.search(r"([+-])(\d\d?):?(\d\d)?$", text)
    if found is None:
        return UTC
    minutes = int(found[2]) * 60 + int(found[3] or 0)
    if minutes > 14 * 60 or 0 < minutes < 60 or minutes % 60 not in {0, 30, 45}:
        return None
    return timezone(timedelta(minutes=-minutes if found[1] == "-" else minutes))


def _by_name(path: Path, moments: list[_Moment], zone: tzinfo) -> FileTime:
    """Take the first time of a name, in the zone that the metadata has for it, if any."""
    moment, *others = moments
    remark = ""
    if moment.time.tzinfo is None:
        same = (
            one.time
            for one in _in_metadata(path)
            if one.time.tzinfo is not None
            and one.time.replace(tzinfo=None, microsecond=0) == moment.time.replace(microsecond=0)
        )
        found = next(same, None)
        moment = (
            moment
            if found is None
            else moment._replace(time=moment.time.replace(tzinfo=found.tzinfo))
        )
    if others and not _is_end(path, moment, others):
        remark = "its name has several times, of which the first was taken"
    elif _HEXADECIMAL.fullmatch(path.stem) and not any(
        "AudioMoth" in text for text in text_fields(path)
    ):
        remark = "its name was read as those of old AudioMoths, seconds in hexadecimal digits"
    placed = _placed(path, moment, zone, NAME)
    return placed._replace(remark=placed.remark or remark)


def _is_end(path: Path, moment: _Moment, others: list[_Moment]) -> bool:
    """Whether the second of two times is the end of the file."""
    if len(others) > 1 or (moment.time.tzinfo is None) != (others[0].time.tzinfo is None):
        return False
    seconds = (others[0].time - moment.time).total_seconds()
    return abs(seconds - audio_seconds(path)) < 2


def _implausible(path: Path, moment: datetime) -> str:
    """Return why a time cannot be that of a recording; empty if it can."""
    if moment.year < _FIRST_YEAR or moment.timetuple()[:3] == _UNSET:
        return "is of a clock that was not set"
    written = path.stat().st_mtime if path.exists() else 0.0  # this clock may be wrong, too
    try:
        seconds = moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
    except (OverflowError, ValueError):
        seconds = float("inf")
    return "is in the future" if seconds > max(time.time(), written) + _DAY else ""


def _placed(path: Path, moment: _Moment, zone: tzinfo, origin: str) -> FileTime:
    """Return the start of a file, in `zone` if its time has none."""
    remark = ""
    local = moment.time
    if local.tzinfo is None:
        both = [local.replace(tzinfo=zone, fold=fold) for fold in (0, 1)]
        local = both[0]
        if both[0].utcoffset() != both[1].utcoffset() and _exists(both[0]):
            local, remark = _of_twice(path, both)
    start = read_time(local.astimezone(UTC).isoformat())
    return FileTime(start, moment.step, origin, remark)


def _exists(local: datetime) -> bool:
    """Whether a local time exists in its zone."""
    there = local.astimezone(UTC).astimezone(local.tzinfo)
    return there.replace(tzinfo=None) == local.replace(tzinfo=None)


def _of_twice(path: Path, both: list[datetime]) -> tuple[datetime, str]:
    """Choose one of two equal local times when the clock is put back."""
    ends = path.stat().st_mtime - audio_seconds(path)
    near = [each for each in both if abs(each.timestamp() - ends) < 300]
    if near:
        return near[0], ""
    return both[0], f"its clock showed {both[0]:%H:%M} twice that day; the first was taken"


def _in_metadata(path: Path) -> Iterator[_Moment]:
    """Yield the times in a file's metadata, the most trusted first."""
    for text in text_fields(path):
        if found := _AUDIOMOTH.search(text):
            clock, day, month, year, sign, hours, minutes = found.groups()
            offset = timedelta(hours=int(hours or 0), minutes=int(minutes or 0))
            with suppress(ValueError):
                moment = datetime.fromisoformat(f"{year}-{month}-{day}T{clock}")
                place = timezone(-offset if sign == "-" else offset)
                yield _Moment(moment.replace(tzinfo=place), NANOSECONDS)
    for name, content in _chunks(path):
        if name == b"guan" and (found := _GUANO.search(content.decode("utf-8", "replace"))):
            with suppress(ValueError):
                yield _Moment(datetime.fromisoformat(found[1]), NANOSECONDS)
        elif name == b"bext" and len(content) >= 338:
            date = re.sub(r"\D", "-", content[320:330].decode("latin-1"))
            clock = re.sub(r"\D", ":", content[330:338].decode("latin-1"))
            with suppress(ValueError):
                yield _Moment(datetime.fromisoformat(f"{date}T{clock}"), NANOSECONDS)


def _chunks(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield the chunks of a WAV file that hold its start."""
    with suppress(OSError, struct.error), path.open("rb") as file:
        head = file.read(12)
        if head[:4] in {b"RIFF", b"RF64", b"BW64"} and head[8:] == b"WAVE":
            yield from _wav_chunks(file)


def _wav_chunks(file: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    for _ in range(_MOST_CHUNKS):
        name, size = struct.unpack("<4sI", file.read(8))
        end = file.tell() + size + size % 2
        if name in {b"guan", b"bext"}:
            yield name, file.read(min(size, _MOST_BYTES))
        file.seek(end)


def doubts(paths: Sequence[Path], times: Sequence[FileTime | None]) -> list[str]:
    """Return a warning line for each group of uncertain starts, with the remedy."""
    lines: dict[str, list[tuple[Path, str]]] = {}
    follows = 0
    for path, found in zip(paths, times, strict=True):
        if found is None:
            follows += 1
        elif found.origin == GUESS:
            text = (
                f"the start {millisecond_text(found.start)} is a guess, the time of its last "
                f"change less its length, for {found.remark}; say --start or --start-pattern"
            )
            lines.setdefault(GUESS, []).append((path, text))
        elif found.remark:
            lines.setdefault(found.remark, []).append((path, f"{found.remark}; say --start"))
    warnings = []
    for (first, text), *others in lines.values():
        more = f" (and so of {len(others)} more)" if others else ""
        warnings.append(f"{first}: {text}{more}")
    if follows:
        warnings.append(f"{follows} of {len(paths)} files say no time: they follow without a gap")
    return warnings
