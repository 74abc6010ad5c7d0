"""`hearthlog doctor` and `hearthlog recover`: checks of logs, and recovery of damaged logs."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import LogError, abridged, printable, shortened
from hearthlog.schemas.new_files import new_file
from hearthlog.tools.cli.options import Json, LocalLogs, check_output
from hearthlog.tools.cli.terminal import number, print_lines, print_notice, share_done, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.doctor import Findings
    from hearthlog.schemas.salvage.recover import RecoveryReport


def doctor(
    paths: LocalLogs,
    *,
    live: Annotated[
        bool, typer.Option("--live", help="Check the recorders of the folder, not its logs.")
    ] = False,
    ping_url: Annotated[
        str | None,
        typer.Option(
            "--ping",
            help="With --live: request this address if all is well, and its /fail if not.",
        ),
    ] = None,
    ping_file: Annotated[
        Path | None,
        typer.Option(
            "--ping-file",
            help="File with the address of --ping in its only line, hidden from other accounts.",
        ),
    ] = None,
    bundle: Annotated[
        Path | None,
        typer.Option(help="ZIP file for a bug report; it contains nothing that was heard."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Check logs: container, messages, and sequence of logs; or check running recorders.

    Exit status 1: a log is damaged or violates the format, or nothing is being recorded; 3: a
    log has gaps or is unfinished, or a recorder has a problem.
    """
    if (ping_url is not None or ping_file is not None) and not live:
        wrong_use("--ping and --ping-file go with --live")
    if ping_url is not None and ping_file is not None:
        wrong_use("give either --ping or --ping-file")
    if (live or bundle is not None) and len(paths) > 1:
        wrong_use("--live and --bundle take one folder of logs")
    if bundle is not None:
        _write_bundle(bundle, paths[0])
        return
    if live:
        _examine_live(paths[0], ping_url, ping_file, as_json=as_json)
        return
    from hearthlog.analyzer.doctor.examination import examine

    missing: list[str] = []
    with share_done("reading logs") as progress:
        files = examine(paths, progress, missing)
    print_notice(*missing, *_network_changes(paths))
    if as_json:
        print(json.dumps(_as_json(files), indent=2))
    else:
        _print(files)
    levels = {level for findings in files for level, _ in findings.counts}
    if levels or missing:
        raise typer.Exit(1 if "error" in levels or missing else 3)


def _network_changes(paths: list[Path]) -> list[str]:
    """Return when a home gained, changed or lost a network, which is no fault of a log."""
    from hearthlog.analyzer.logs.home_logs import find_home_logs, network_changes
    from hearthlog.analyzer.logs.local_time import home_zone

    try:
        home = find_home_logs(paths)
    except LogError:  # already reported by the checks
        return []
    return network_changes(home.between(), home_zone(None, home.records()))


def _write_bundle(bundle: Path, folder: Path) -> None:
    from zipfile import ZIP_DEFLATED, ZipFile

    from hearthlog.analyzer.recorder_status import support_bundle

    check_output("--bundle", bundle, ".zip", "a bundle")
    with new_file(bundle) as temporary, ZipFile(temporary, "x", ZIP_DEFLATED) as archive:
        for name, content in support_bundle(folder):
            archive.writestr(name, content)
            print(f"{bundle}: {name}, {number(len(content), 'byte')}")


def _examine_live(
    folder: Path, ping_url: str | None, ping_file: Path | None, *, as_json: bool
) -> None:
    from hearthlog.analyzer.http import is_ping_address, ping, read_ping_address
    from hearthlog.analyzer.recorder_status import examine_live

    if ping_url is not None and not is_ping_address(ping_url):
        wrong_use("--ping needs an address such as https://hc-ping.com/your-uuid")
    if ping_file is not None:
        ping_url = read_ping_address(ping_file)
    states = examine_live(folder)
    if as_json:
        print(json.dumps([state._asdict() for state in states], indent=2))
    else:
        print_lines(f"{state.level}: {state.subject}: {state.text}" for state in states)
    levels = {state.level for state in states} - {"ok"}
    if ping_url is not None and (problem := ping(ping_url, is_well="error" not in levels)):
        print_notice(f"the ping did not arrive: {problem}")
    if levels:
        raise typer.Exit(1 if "error" in levels else 3)


def _print(files: "list[Findings]") -> None:
    for findings in files:
        for finding in findings.shown:
            print(finding)
        for (level, rule), count in findings.more().items():
            print(printable(f"{level}: {findings.path}: {count} more of this kind [{rule}]"))
    counts = [number(_count(files, level), level) for level in ("error", "warning")]
    print(f"{number(len(files), 'file')}: {', '.join(counts)}")


def _as_json(files: "list[Findings]") -> dict[str, Any]:
    return {
        "files": [str(findings.path) for findings in files],
        "errors": _count(files, "error"),
        "warnings": _count(files, "warning"),
        "findings": [
            finding._asdict() | {"path": str(finding.path)}
            for findings in files
            for finding in findings.shown
        ],
        "more": [
            {"path": str(findings.path), "level": level, "rule": rule, "count": count}
            for findings in files
            for (level, rule), count in findings.more().items()
        ],
    }


def _count(files: "list[Findings]", level: str) -> int:
    return sum(n for f in files for (kind, _), n in f.counts.items() if kind == level)


def recover(
    logs: Annotated[list[Path], typer.Argument(help="Truncated or damaged logs.", readable=False)],
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Name of the new log.", show_default="LOG.recovered.mcap"
        ),
    ] = None,
    in_place: Annotated[
        bool,
        typer.Option("--in-place", help="Replace the log; the damaged one is kept as *.damaged."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Recover the intact messages of a truncated or damaged log, and report the losses.

    The log itself is not changed. Exit status 3: something was lost.
    """
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
            print_notice(str(error))
            failed = True
            continue
        lost |= not recovery.lossless
        _report_recovery(log, recovery)
        report.append(_recovery_as_json(log, path, recovery))
        if not as_json:
            print(path)
    if as_json:
        print(json.dumps(report, indent=2))
    if failed or lost:
        raise typer.Exit(1 if failed else 3)


def _recover(log: Path, output: Path | None, *, in_place: bool) -> "tuple[Path, RecoveryReport]":
    from hearthlog.schemas.logs.files import SUFFIX, stem
    from hearthlog.schemas.salvage.recover import recover_in_place, recover_log

    with share_done(f"recovering {log.name}") as progress:
        if in_place:
            return recover_in_place(log, progress)
        path = output or log.with_name(f"{stem(log)}.recovered{SUFFIX}")
        with new_file(path) as temporary:
            return path, recover_log(log, temporary, path.name, progress)


def _report_recovery(log: Path, recovery: "RecoveryReport") -> None:
    expected = [topic.expected for topic in recovery.topics.values() if topic.expected is not None]
    of = f" of {sum(expected)}" if expected else ""
    end = "" if recovery.complete else "; the log had no end, or a damaged one"
    print_notice(f"{log}: {recovery.messages}{of} messages saved{end}")
    if recovery.escaped:
        what = "bytes that are not UTF-8 become \\xNN in the names or metadata of"
        print_notice(f"{log}: {what} {abridged([shortened(n, 60) for n in recovery.escaped], 5)}")
    texts = dict.fromkeys([*map(str, recovery.damages), *recovery.losses])
    print_notice(*(f"{log}: {text}" for text in texts))


def _recovery_as_json(log: Path, path: Path, recovery: "RecoveryReport") -> dict[str, Any]:
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
