"""`hearthlog report`: a day or a week of a home, for a carer."""

from datetime import date, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.options import (
    NEAR,
    Day,
    Labels,
    Logs,
    Timezone,
    home_and_zone,
    read_date,
    read_day,
)
from hearthlog.tools.cli.terminal import end_with_warnings, share_done, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.logs.home_logs import HomeLogs


def report(
    logs: Logs,
    *,
    day: Day = None,
    week: Annotated[
        str | None, typer.Option(help="Such as 2026-W09, or a day in it: Monday to Sunday.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Page to write, *.html (by default NODE_DAY.html); its "
            "picture is written next to it.",
        ),
    ] = None,
    no_picture: Annotated[
        bool,
        typer.Option("--no-picture", help="Write no PNG; the page contains the picture anyway."),
    ] = False,
    labels: Labels = "live",
    timezone: Timezone = None,
) -> None:
    """Write a page about a day or a week, for a carer, and its picture.

    Exit status 3: a log is damaged or unfinished; the page shows its time as not recorded.
    """
    if day is not None and week is not None:
        wrong_use("--day and --week exclude each other")
    if output is not None and output.suffix != ".html":
        wrong_use(f"--output {output}: a page is named *.html")
    from hearthlog.analyzer.errors import require

    require("jinja2", *[] if no_picture else ["matplotlib"])
    first = None
    if week is not None:
        monday = read_date("--week", week)
        first = monday - timedelta(days=monday.weekday())
    elif day is not None and day not in NEAR:
        first = read_date("--day", day)
    from hearthlog.analyzer.report.report import WEEK, Period, make_report

    draw = None
    if not no_picture:
        from hearthlog.analyzer.report.timeline_plot import save_timelines

        draw = save_timelines
    home_logs, zone = home_and_zone(logs, timezone)
    if first is None:
        first = home_logs.last_complete_day(zone) if day is None else read_day("--day", day, zone)
    count = 1 if week is None else WEEK
    page = output or Path(_name(home_logs, first, count))
    with share_done("reading the labels") as progress:
        period = Period(first, count, zone)
        result = make_report(home_logs, period, page, labels, progress, draw=draw)
    print(result.page)
    if result.picture is not None:
        print(result.picture)
    end_with_warnings(result.losses)


def _name(home_logs: "HomeLogs", first: date, count: int) -> str:
    """Return a page name from the home and the day."""
    node = next((entry.node for entry in home_logs.entries if entry.node), "home")
    when = f"{first}" if count == 1 else f"{first:%G-W%V}"
    return f"{node}_{when}.html"
