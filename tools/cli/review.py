"""`hearthlog review`: logs on one time axis, with marking."""

import signal
import sys
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer
from typer.core import TyperCommand

from hearthlog.analyzer.marks.formats import PATTERNS, find_format
from hearthlog.schemas.errors import HearthlogError, printable
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import check_new, new_file
from hearthlog.tools.cli.discover import add_groups, add_voices
from hearthlog.tools.cli.options import (
    End,
    LocalLogs,
    Microphone,
    Start,
    Timezone,
    models_folder,
    parse_span,
    read_day,
    reviewer_name,
)
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    print_notice,
    print_recording,
    print_table,
    read_keys,
    share_done,
    show_page,
    suggest_training,
    wrapped,
    wrong_use,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hearthlog.analyzer.logs.labelling import Labellings
    from hearthlog.analyzer.logs.spans import Spans
    from hearthlog.analyzer.review.marking import Marking
    from hearthlog.analyzer.review.review_list import ReviewSpan, SoundFile
    from hearthlog.analyzer.review.review_queue import ReviewItem
    from hearthlog.analyzer.review.session import ReviewSession
    from hearthlog.analyzer.review.timeline import SoundClip, Timeline
    from hearthlog.analyzer.review.viewer.viewer import Viewer

_QUEUE = "--queue"


def review(
    logs: LocalLogs,
    day: Annotated[
        str | None, typer.Option(help="Day of the home, such as 2026-03-01, today or yesterday.")
    ] = None,
    start: Start = None,
    end: End = None,
    *,
    save: Annotated[
        Path | None,
        typer.Option(
            "--save",
            "--output",
            "-o",
            help="Write a Rerun recording, *.rrd, instead; with --queue a label file of the "
            "spans, and a folder of their sound.",
        ),
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Use a browser.")] = False,
    sound: Annotated[
        bool, typer.Option("--sound", help="With --web: play kept sound in the browser.")
    ] = False,
    queue: Annotated[
        str | None,
        typer.Option(
            help="Review a queue: useful spans and minutes drawn at random (without a value), "
            "or uncertain, novel, disagreeing or random ones, sounds that the network can "
            "name (hint), a list of `hearthlog diff --list`, or what a model such as "
            "home-1 would change."
        ),
    ] = None,
    spans: Annotated[
        int | None,
        typer.Option(min=1, help="Number of spans.", show_default="10; a list: all"),
    ] = None,
    labels: Annotated[
        str,
        typer.Option(
            help="Labelling to correct: live, a scenario, or the model of a relabel layer."
        ),
    ] = "live",
    microphone: Microphone = None,
    reviewer: Annotated[
        str | None, typer.Option(help="Name of the reviewer.", show_default="the login name")
    ] = None,
    groups: Annotated[
        Path | None,
        typer.Option(help="File of `hearthlog discover`, shown as a lane."),
    ] = None,
    voices: Annotated[
        Path | None, typer.Option(help="File of `hearthlog voices`, shown as a lane.")
    ] = None,
    timezone: Timezone = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port of the viewer.")] = None,
) -> None:
    """Show a day or another span in Rerun, and mark its sounds.

    Drag a span on the time ruler and press a key in the terminal. Every mark is saved in the
    review layer at once. Exit status 3: some logs could not be read or shown completely.
    """
    if save is not None and (web or port):
        wrong_use("--save writes a file and excludes --web and --port")
    if sound and not web:
        wrong_use("--sound plays kept sound in the browser and needs --web")
    if day is not None and (start or end):
        wrong_use("--day excludes --start and --end")
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.review.lanes import class_precision
    from hearthlog.analyzer.review.timeline_reader import read_timeline

    limits = parse_span(start, end) if day is None else _day(logs, day, timezone)

    def read() -> "Timeline":
        with share_done("reading logs") as progress:
            timeline = read_timeline(logs, *limits, zone=timezone, progress=progress)
        if groups is not None:
            add_groups(timeline, logs, groups)
        if voices is not None:
            add_voices(timeline, logs, voices)
        return timeline

    chosen = _Choice(labels, microphone, reviewer_name(reviewer), queue, spans, limits)
    if save is not None and queue is not None:
        _save_queue(save, logs, chosen, timezone)
        return
    _require_viewer(queue)
    if save is not None:
        from hearthlog.analyzer.review.viewer.recording import check_output, save_timeline

        check_output(save)
        timeline = read()
        save_timeline(timeline, save, class_precision(timeline, find_home_logs(logs)))
        print_recording(save)
    else:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, _end)  # otherwise the viewer would keep running, and listening
        with _open(web=web, port=port) as viewer:
            timeline = read()
            _show(viewer, timeline, logs, chosen, sound=sound)
    end_with_warnings(timeline.losses)


def _require_viewer(queue: str | None) -> None:
    from hearthlog.analyzer.errors import require

    try:
        require("rerun", "rerun_cli")
    except HearthlogError as error:
        if queue is None:
            raise
        raise HearthlogError(f"{error}; or, as a text file: --queue --save ten.txt") from error


class ReviewCommand(TyperCommand):
    """The `review` command; its option --queue may have no value."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """Parse arguments; a missing ranking gets the default."""
        from hearthlog.analyzer.review.ranking import USEFUL

        if _QUEUE in args:
            following = args.index(_QUEUE) + 1
            value = args[following] if following < len(args) else "-"
            if value.startswith("-") or Path(value).is_dir() or value.endswith(".mcap"):
                args = [*args[:following], USEFUL, *args[following:]]
        return super().parse_args(ctx, args)


COMMAND_CLASS = ReviewCommand


def _end(number: int, _frame: object) -> None:
    raise SystemExit(128 + number)


def _day(logs: list[Path], text: str, timezone: str | None) -> tuple[int, int]:
    """Parse the option --day: local midnight to midnight."""
    from hearthlog.analyzer.logs.layers import zone_of
    from hearthlog.analyzer.logs.local_time import day_span

    zone = zone_of(logs, timezone)
    return day_span(read_day("--day", text, zone), zone)


def _open(*, web: bool, port: int | None) -> "Viewer":
    """Start the viewer before logs are read, since its start takes time, too."""
    if web:
        from hearthlog.analyzer.review.viewer.web import open_page

        return open_page(port)
    from hearthlog.analyzer.review.viewer.viewer import open_window

    return open_window(port)


class _Choice(NamedTuple):
    """What to correct, the reviewer, and the order."""

    labels: str
    microphone: str | None
    reviewer: str
    queue: str | None
    spans: int | None
    limits: tuple[int | None, int | None]


def _show(
    viewer: "Viewer", timeline: "Timeline", logs: list[Path], choice: _Choice, *, sound: bool
) -> None:
    """Show a timeline until the reviewer ends."""
    from hearthlog.analyzer.logs.clips import stop_sound
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.analyzer.review.lanes import class_precision
    from hearthlog.analyzer.review.session import ReviewSession, listen
    from hearthlog.analyzer.review.timeline import no_spans
    from hearthlog.analyzer.review.timeline_reader import (
        MOST_FRAMES,
        read_frames,
        read_timeline,
    )

    microphone = _microphone(timeline, choice.microphone)
    items, marking = _work(timeline, logs, choice, microphone)
    shown = timeline.microphones[microphone]
    if marking.scenario:
        shown.reviewed_scenarios.setdefault(marking.scenario, no_spans())  # else it has no lane

    def announce(text: str) -> None:
        print(wrapped(printable(text), sys.stdout), flush=True)
        viewer.announce(text)

    def look_closely(start: int, end: int) -> None:
        if not items:
            for part in read_frames(timeline, start, end):
                viewer.draw_frames(part, start, end)
            return
        coverage = timeline.coverage[microphone]
        spans = zip(coverage.logs, coverage.starts, coverage.ends, strict=True)
        near = [log for log, first, last in spans if first < end and last > start]
        viewer.draw_close_up(read_timeline(near, start, end, zone=timeline.zone))

    session = ReviewSession(
        viewer,
        marking,
        shown.classes_of(marking.scenario),
        home_zone(timeline.zone),
        announce,
        look_closely,
        lambda start, end: listen(shown.clips, start, end),
        stop_sound,
        items,
        lambda: _print_keys(session),
    )
    keys: SimpleQueue[str] = SimpleQueue()
    audio = partial(_playable, session, shown.clips)
    viewer.offer(session.keys, keys.put, audio if sound else None)
    viewer.draw(timeline, close_up=bool(items))
    show_page(viewer.address)
    with read_keys(keys) as ended, suppress(KeyboardInterrupt):
        if viewer.wait_until_drawn(lambda: ended.is_set() and keys.qsize() <= 1) is None:
            print_notice("the input ended before anybody opened the page")
            return
        grid = timeline.grid
        if not items and grid.end - grid.start <= MOST_FRAMES:
            look_closely(grid.start, grid.end)
        viewer.write_checked(timeline, class_precision(timeline, find_home_logs(logs)))
        _print_keys(session)
        if session.run(keys):
            suggest_training(logs, marking.scenario, "what is marked")
    if not marking.scenario:
        _report_accuracy(logs)


def _playable(session: "ReviewSession", clips: "Sequence[SoundClip]") -> bytes:
    """Return the sound that the page plays."""
    from hearthlog.analyzer.review.session import sound_file

    return sound_file(clips, *session.span_to_play())


def _print_keys(session: "ReviewSession") -> None:
    """Print the keys: on a terminal in columns, with the colours of their classes."""
    if not sys.stdout.isatty():
        print(*map(printable, session.key_lines), sep="\n", flush=True)
        return
    from rich.columns import Columns
    from rich.console import Console
    from rich.text import Text

    cells = [
        Text.assemble(
            (f" {one.cap} ", "reverse" if one.colour is None else f"black on rgb{one.colour}"),
            f" {printable(one.text)}",
        )
        for one in session.keys
    ]
    Console(highlight=False).print(Columns(cells, equal=True, column_first=True, padding=(0, 3)))


def _report_accuracy(logs: list[Path]) -> None:
    """Print the accuracy from the randomly drawn minutes so far."""
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.tools.cli.info_summary import Accuracy

    accuracy = Accuracy(find_home_logs(logs))
    if len(accuracy.minutes):
        print(*map(printable, accuracy.lines()), sep="\n")


def _work(
    timeline: "Timeline", logs: list[Path], choice: _Choice, microphone: str
) -> "tuple[list[ReviewItem], Marking]":
    """Return the review items and the marking of a labelling."""
    import numpy as np

    from hearthlog.analyzer.logs.labelling import find_labellings
    from hearthlog.analyzer.logs.spans import Spans
    from hearthlog.analyzer.review.marking import Marking
    from hearthlog.analyzer.review.review_list import corrected_name
    from hearthlog.analyzer.review.review_queue import review_items
    from hearthlog.analyzer.review.timeline import no_spans
    from hearthlog.schemas.messages.topics import LIVE, scenario_name

    segments = {one.name: one.spans for one in timeline.microphones[microphone].labellings}
    labelling, items = choice.labels, []
    if choice.queue is not None or labelling != LIVE:
        sources = find_labellings(*logs)
        labelling = sources.find(microphone, choice.labels)
        if choice.queue is not None:
            clips = timeline.microphones[microphone].clips
            edges = np.array([(one.start, one.end) for one in clips], np.int64).reshape(-1, 2)
            audible = Spans(edges[:, 0], edges[:, 1])
            of = microphone, labelling
            items = review_items(_queue_spans(sources, of, choice, audible), audible)
            _report_fewer(len(items), choice)
    marking = Marking(
        microphone,
        timeline.coverage[microphone],
        choice.reviewer,
        corrected_name(labelling),
        segments.get(labelling, no_spans()),
        scenario_name(labelling),
    )
    return items, marking


def _save_queue(path: Path, logs: list[Path], choice: _Choice, timezone: str | None) -> None:
    """Write the spans of a queue and their kept audio, for use without a viewer."""
    from hearthlog.analyzer.logs.labelling import find_labellings
    from hearthlog.analyzer.logs.layers import find_coverage, zone_of
    from hearthlog.analyzer.marks.formats import AUDACITY
    from hearthlog.analyzer.marks.label_files import write_labels
    from hearthlog.analyzer.review.review_list import (
        drawn_minutes,
        find_kept_sound,
        label_lines,
        labels_of,
        queue_file,
        sound_files,
        sounds_folder,
        write_sounds,
        write_spans,
    )
    from hearthlog.schemas.messages.topics import scenario_name

    if find_format(path) is None:
        wrong_use(f"--save {path}: of a queue it is a label file, {PATTERNS}")
    if len(logs) > 1:
        wrong_use("--save --queue: name one log or folder, as `hearthlog annotate import` takes it")
    queue, folder = queue_file(path), sounds_folder(path)
    for new in (path, queue, folder):
        check_new(new)
    zone = zone_of(logs, timezone)
    sources = find_labellings(*logs)
    microphone = sources.microphone(choice.microphone)
    labelling = sources.find(microphone, choice.labels)
    kept = find_kept_sound(logs[0], microphone, choice.limits, sources.losses)
    spans = _queue_spans(sources, (microphone, labelling), choice, kept.time)
    segments = sources.read(microphone, labelling, *choice.limits).labelling
    marks = sorted(mark for span in spans for mark in labels_of(span, segments))
    files = sound_files(marks, spans, kept)
    if files:
        write_sounds(folder, files, len(marks), kept)
    if find_format(path) == AUDACITY:
        with new_file(path) as temporary:
            text = label_lines(marks, spans, files, folder.name, zone)
            temporary.write_text(text, "utf-8")
    else:
        write_labels(path, marks, find_coverage(logs[0]))
    write_spans(queue, spans)
    clock = [datetime.fromtimestamp(one.start // NANOSECONDS, zone) for one in marks]
    minutes = {one.first: f"a minute, to {one.last}" for one in drawn_minutes(spans, marks)}
    print_table(
        ("line", "from", "seconds", "label", "sound", "drawn at random"),
        [
            (
                str(line),
                f"{begin:%Y-%m-%d %H:%M:%S}",
                f"{(one.end - one.start) / NANOSECONDS:.1f}",
                one.label,
                "kept" if any(file.first == file.last == line for file in files) else "",
                minutes.get(line, ""),
            )
            for line, (begin, one) in enumerate(zip(clock, marks, strict=True), 1)
        ],
    )
    _report_fewer(len(spans), choice)
    _report_sounds(files, folder, len(marks))
    scenario = scenario_name(labelling)
    of = f" --scenario {scenario}" if scenario else ""
    print_notice(
        f"{path}: correct the labels, delete lines that you cannot judge, and import the rest as "
        f"marks: hearthlog annotate import {logs[0]} {path}{of}"
    )
    end_with_warnings(sources.losses)


def _report_sounds(files: "Sequence[SoundFile]", folder: Path, lines: int) -> None:
    if not files:
        print_notice(
            "no sound of these lines is kept; `hearthlog record --keep-audio unsure` keeps some"
        )
        return
    kept = sum(file.first == file.last for file in files)
    others = "" if kept == lines else "; the others have no sound"
    print_notice(f"{folder}: the sound of {kept} of {lines} lines, numbered as they are{others}")


def _queue_spans(
    sources: "Labellings", labelled: tuple[str, str], choice: _Choice, audible: "Spans | None"
) -> "list[ReviewSpan]":
    from hearthlog.analyzer.review.review_queue import queue_spans

    assert choice.queue is not None
    limits, count, folder = choice.limits, choice.spans, models_folder()
    with share_done("choosing spans") as progress:
        return queue_spans(
            choice.queue, sources, labelled, limits, count, folder, progress, audible
        )


def _report_fewer(count: int, choice: _Choice) -> None:
    if choice.spans is not None and count < choice.spans:
        print_notice(f"{count} of the {choice.spans} requested; no more are left to review")


def _microphone(timeline: "Timeline", name: str | None) -> str:
    """Return the microphone to mark; the first by default."""
    names = ", ".join(timeline.microphones)
    if name is not None and name not in timeline.microphones:
        wrong_use(f"--microphone {name}: there is {names}")
    if name is None and len(timeline.microphones) > 1:
        others = f"marks are for the first microphone of {names}; --microphone chooses another"
        print(printable(others))
    return name or next(iter(timeline.microphones))
