"""Times on the command line: ISO 8601, UTC unless they say otherwise."""

import typer

_LAST = (1 << 63) - 1  # log time


def parse_time(text: str, option: str) -> int:
    """Read a time, in nanoseconds of UTC.

    Raises
    ------
    typer.BadParameter
        If it is none.
    """
    from hearthlog.schemas.times import read_time

    try:
        return read_time(text)
    except ValueError as error:
        raise typer.BadParameter(f"{option} {text}: not a time such as 2026-03-01T07:00") from error


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
