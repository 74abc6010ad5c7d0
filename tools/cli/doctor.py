"""`hearthlog doctor`: whether logs are what they should be."""

import json
import sys
from typing import TYPE_CHECKING, Any

import typer

from hearthlog.schemas.text import printable
from hearthlog.tools.cli.options import Json, LocalLog

if TYPE_CHECKING:
    from hearthlog.analyzer.doctor import Findings


def doctor(path: LocalLog, *, as_json: Json = False) -> None:
    """Check logs: MCAP, the contract, and how they follow each other.

    Exit status 1: a log is damaged, or not as hearthlog writes them; 3: one has gaps, or is
    unfinished.
    """
    from hearthlog.analyzer.doctor import examine
    from hearthlog.tools.cli.progress import share_done

    with share_done("reading logs") as progress:
        files = examine(path, progress)
    if as_json:
        print(json.dumps(_as_json(files), indent=2))
    else:
        _print(files)
    levels = {level for findings in files for level, _ in findings.counts}
    if levels:
        raise typer.Exit(1 if "error" in levels else 3)


def _print(files: "list[Findings]") -> None:
    errors, warnings = _count(files, "error"), _count(files, "warning")
    for findings in files:
        for finding in findings.shown:
            print(finding)
        for (level, rule), count in findings.more().items():
            print(printable(f"{level}: {findings.path}: {count} more of this kind [{rule}]"))
    # Nobody who reads the findings with a program wants this among them.
    print(f"{len(files)} files: {errors} errors, {warnings} warnings", file=sys.stderr)


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
