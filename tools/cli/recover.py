"""`hearthlog recover`: a log that was cut or damaged, to a valid one."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import abridged, shortened
from hearthlog.tools.cli.options import Json
from hearthlog.tools.cli.text import tell, wrong_use

if TYPE_CHECKING:
    from hearthlog.schemas.salvage.recover import Recovery


def recover(
    logs: Annotated[
        list[Path], typer.Argument(help="Logs that were cut or damaged.", readable=False)
    ],
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Name of the new log.", show_default="LOG.recovered.mcap"
        ),
    ] = None,
    in_place: Annotated[
        bool,
        typer.Option(
            "--in-place", help="Give it the log's own name; that one is kept as *.damaged."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Save what is whole in a log that was cut or damaged, and say what is lost.

    The log itself is not touched. Exit status 3: something was lost.
    """
    from hearthlog.schemas.errors import LogError

    if output is not None and (len(logs) > 1 or in_place):
        wrong_use("--output goes with one log, and not with --in-place")
    report = []
    failed = lost = False
    for log in logs:
        try:
            path, recovery = _recover(log, output, in_place=in_place)
        except LogError as error:
            if len(logs) == 1:
                raise
            tell(str(error))
            failed = True
            continue
        lost |= not recovery.lossless
        _say(log, recovery)
        report.append(_as_json(log, path, recovery))
        if not as_json:
            print(path)
    if as_json:
        print(json.dumps(report, indent=2))
    if failed or lost:
        raise typer.Exit(1 if failed else 3)


def _recover(log: Path, output: Path | None, *, in_place: bool) -> "tuple[Path, Recovery]":
    from hearthlog.schemas.logs.files import SUFFIX, stem
    from hearthlog.schemas.new_files import new_file
    from hearthlog.schemas.salvage.recover import recover_in_place, recover_log
    from hearthlog.tools.cli.progress import share_done

    with share_done(f"recovering {log.name}") as progress:
        if in_place:
            return recover_in_place(log, progress)
        path = output or log.with_name(f"{stem(log)}.recovered{SUFFIX}")
        with new_file(path) as temporary:
            return path, recover_log(log, temporary, path.name, progress)


def _say(log: Path, recovery: "Recovery") -> None:
    expected = [topic.expected for topic in recovery.topics.values() if topic.expected is not None]
    of = f" of {sum(expected)}" if expected else ""
    end = "" if recovery.complete else "; the log had no end, or a damaged one"
    tell(f"{log}: {recovery.messages}{of} messages saved{end}")
    if recovery.escaped:
        what = "bytes that are not UTF-8 are written as \\xNN in the names or metadata of"
        tell(f"{log}: {what} {abridged([shortened(n, 60) for n in recovery.escaped], 5)}")
    for text in dict.fromkeys([*map(str, recovery.damages), *recovery.losses]):
        tell(f"{log}: {text}")


def _as_json(log: Path, path: Path, recovery: "Recovery") -> dict[str, Any]:
    return {
        "log": str(log),
        "recovered": str(path),
        "lossless": recovery.lossless,
        "topics": {
            name: {"type": topic.type, "messages": topic.messages, "expected": topic.expected}
            for name, topic in recovery.topics.items()
        },
        "damages": [
            {
                "start_byte": damage.start,
                "end_byte": damage.end,
                "why": damage.why,
                "cut": damage.cut,
                "messages": damage.messages,
                "exact": damage.exact,
                "first_log_time": None if damage.times is None else damage.times[0],
                "last_log_time": None if damage.times is None else damage.times[1],
                "others": damage.others,
            }
            for damage in recovery.damages
        ],
    }
