"""`hearthlog review`: logs on one time axis, and marks made where they are seen."""

import signal
from contextlib import suppress
from datetime import date, datetime, timedelta
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from hearthlog.schemas.text import printable
from hearthlog.schemas.times import NANOSECONDS
from hearthlog.tools.cli.browser import print_recording, show_page
from hearthlog.tools.cli.keys import read_keys
from hearthlog.tools.cli.options import End, Microphone, Start, Timezone, parse_span, reviewer_name
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.text import end_with_warnings, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.review.session.marking import Marking
    from hearthlog.analyzer.review.session.session import ReviewItem
    from hearthlog.analyzer.review.timeline.model import Timeline
    from hearthlog.analyzer.review.viewer.viewer import Viewer

_ALL_FRAMES = 3 * 3600 * NANOSECONDS  # of more, the viewer would take a gigabyte


def review(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of logs.")],
    day: Annotated[
        str | None, typer.Option(help="A day of the home, as 2026-03-01, today or yesterday.")
    ] = None,
    start: Start = None,
    end: End = None,
    *,
    save: Annotated[
        Path | None,
        typer.Option("--save", "--output", "-o", help="Make a Rerun recording, *.rrd, instead."),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Look in a browser.")] = False,
    queue: Annotated[
        str | None,
        typer.Option(
            help="Go through spans that are uncertain, novel, disagreeing or random, or through "
            "a list of `hearthlog diff --list`."
        ),
    ] = None,
    spans: Annotated[int, typer.Option(min=1, help="How many to go through.")] = 60,
    labels: Annotated[
        str, typer.Option(help="Labelling to correct: live, or the model of a relabel layer.")
    ] = "live",
    microphone: Microphone = None,
    reviewer: Annotated[
        str | None, typer.Option(help="Who makes the marks.", show_default="the login name")
    ] = None,
    timezone: Timezone = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port of the viewer.")] = None,
) -> None:
    """Show a day or any other span in Rerun, and mark what was heard.

    Drag a span on the time ruler and press a key in the terminal. Every mark is in the review
    layer at once. Exit status 3: some logs could not be read, or not all of them could be shown.
    """
    if save is not None and (web or queue or port):
        wrong_use("--save makes a file: --web, --queue and --port go without it")
    if day is not None and (start or end):
        wrong_use("--day is a span of its own: leave out --start and --end")
    from hearthlog.analyzer.review.timeline.read_timeline import read_timeline
    from hearthlog.analyzer.review.viewer.file import check_output, save_timeline

    limits = parse_span(start, end) if day is None else _day(logs, day, timezone)

    def read() -> "Timeline":
        with share_done("reading logs") as progress:
            return read_timeline(logs, *limits, zone=timezone, progress=progress)

    if save is not None:
        check_output(save)
        timeline = read()
        save_timeline(timeline, save)
        print_recording(save)
    else:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, _end)  # or the viewer would stay, and listen
        with _open(web=web, port=port) as viewer:
            timeline = read()
            chosen = _Choice(labels, microphone, reviewer_name(reviewer), queue, spans, limits)
            _show(viewer, timeline, logs, chosen)
    end_with_warnings(timeline.losses)


def _end(number: int, _frame: object) -> None:
    raise SystemExit(128 + number)


def _day(logs: list[Path], text: str, timezone: str | None) -> tuple[int | None, int | None]:
    """Read the option --day: from midnight to midnight, at home."""
    from hearthlog.analyzer.logs.layers import zone_of
    from hearthlog.analyzer.logs.local_time import day_span

    zone = zone_of(logs, timezone)
    today = datetime.now(zone).date()
    near = {"today": today, "yesterday": today - timedelta(days=1)}
    try:
        return day_span(near.get(text) or date.fromisoformat(text), zone)
    except (ValueError, OverflowError):
        wrong_use(f"--day {text}: not a day such as 2026-03-01, today or yesterday")


def _open(*, web: bool, port: int | None) -> "Viewer":
    """Start the viewer before logs are read: it takes its time as well."""
    if web:
        from hearthlog.analyzer.review.viewer.web import open_page

        return open_page(port)
    from hearthlog.analyzer.review.viewer.window import open_window

    return open_window(port)


class _Choice(NamedTuple):
    """What is to be corrected, by whom, and in which order."""

    labels: str
    microphone: str | None
    reviewer: str
    queue: str | None
    spans: int
    limits: tuple[int | None, int | None]


def _show(viewer: "Viewer", timeline: "Timeline", logs: list[Path], choice: _Choice) -> None:
    """Show a timeline until the reviewer is done."""
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.analyzer.review.session.session import Session
    from hearthlog.analyzer.review.session.sound import listen
    from hearthlog.analyzer.review.timeline.read_timeline import read_timeline

    microphone = _microphone(timeline, choice.microphone)
    items, marking = _work(timeline, logs, choice, microphone)

    def say(text: str) -> None:
        print(printable(text), flush=True)
        viewer.say(text)

    def look_closely(start: int, end: int) -> None:
        if not items:
            viewer.draw_frames(timeline, start, end)
            return
        coverage = timeline.coverage[microphone]
        spans = zip(coverage.logs, coverage.starts, coverage.ends, strict=True)
        near = [log for log, first, last in spans if first < end and last > start]
        viewer.draw_close_up(read_timeline(near, start, end, zone=timeline.zone))

    session = Session(
        viewer,
        marking,
        timeline.microphones[microphone].classes,
        home_zone(timeline.zone),
        say,
        look_closely,
        lambda start, end: listen(timeline.microphones[microphone].clips, start, end),
        items,
    )
    keys: SimpleQueue[str] = SimpleQueue()
    viewer.offer(session.keys, keys.put)
    viewer.draw(timeline, close_up=bool(items))
    if viewer.address:
        show_page(viewer.address)
    viewer.wait_until_drawn()
    grid = timeline.grid
    if not items and grid.end - grid.start <= _ALL_FRAMES:
        look_closely(grid.start, grid.end)
    print(printable(", ".join(f"{key} {text}" for key, text in session.keys)), flush=True)
    with read_keys(keys), suppress(KeyboardInterrupt):
        session.run(keys)


def _work(
    timeline: "Timeline", logs: list[Path], choice: _Choice, microphone: str
) -> "tuple[list[ReviewItem], Marking]":
    """Find what is to be gone through, and what is corrected."""
    from hearthlog.analyzer.logs.labellings import find_labellings
    from hearthlog.analyzer.review.session.marking import Marking
    from hearthlog.analyzer.review.session.queue_items import queue_items
    from hearthlog.analyzer.review.timeline.model import no_spans
    from hearthlog.schemas.messages.topics import LIVE

    segments = {one.name: one.spans for one in timeline.microphones[microphone].labellings}
    labelling, items = choice.labels, []
    if choice.queue is not None or labelling != LIVE:
        sources = find_labellings(*logs)
        labelling = sources.find(microphone, choice.labels)
        if choice.queue is not None:
            items = queue_items(
                choice.queue, sources, (microphone, labelling), choice.limits, choice.spans
            )
    marking = Marking(
        microphone,
        timeline.coverage[microphone],
        choice.reviewer,
        labelling.removeprefix("relabel/"),
        segments.get(labelling, no_spans()),
    )
    return items, marking


def _microphone(timeline: "Timeline", name: str | None) -> str:
    """Return the microphone whose marks are made; of several the first."""
    names = ", ".join(timeline.microphones)
    if name is not None and name not in timeline.microphones:
        wrong_use(f"--microphone {name}: there is {names}")
    if name is None and len(timeline.microphones) > 1:
        line = f"marks are of the first microphone of {names}; --microphone chooses another one"
        print(printable(line))
    return name or next(iter(timeline.microphones))
