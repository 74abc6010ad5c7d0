"""Times on the command line: ISO 8601, UTC unless they say otherwise."""

import re
from datetime import UTC, datetime, timedelta

import typer

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_LAST = (1 << 63) - 1  # log time
_BEYOND_MICROSECONDS = re.compile(r"(?<=\.\d{6})\d{1,3}(?!\d)")


def parse_time(text: str, option: str) -> int:
    """Read a time, in nanoseconds of UTC.

    Raises
    ------
    typer.BadParameter
        If it is none.
    """
    rest = _BEYOND_MICROSECONDS.search(text)  # datetime has no room for them
    try:
        moment = datetime.fromisoformat(_BEYOND_MICROSECONDS.sub("", text))
    except ValueError as error:
        raise typer.BadParameter(f"{option} {text}: not a time such as 2026-03-01T07:00") from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    nanoseconds = (moment - _EPOCH) // timedelta(microseconds=1) * 1_000
    return nanoseconds + (int(rest.group().ljust(3, "0")) if rest else 0)


def parse_span(start: str | None, end: str | None) -> tuple[int | None, int | None]:
    """Read the options --start and --end.

    Raises
    ------
    typer.BadParameter
        If one of them is no time, or nothing can be between them.
    """
    first = None if start is None else min(max(parse_time(start, "--start"), 0), _LAST)
    last = None if end is None else min(max(parse_time(end, "--end"), 0), _LAST)
    if first is not None and last is not None and first >= last:
        raise typer.BadParameter(f"--end {end} is not after --start {start}")
    return first, last
