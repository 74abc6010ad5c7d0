"""What the program draws, as a text and its hash, which is the same on every machine.

The texts are drawn from the logs of `tests/golden`, which never change: so they change when what is
drawn does, and not with libraries, processors, or the sounds of the simulated home.
"""

import hashlib
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa

from hearthlog import __version__
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import day_span, local_time
from hearthlog.analyzer.logs.spans import NONE
from hearthlog.analyzer.review.lanes import class_precision
from hearthlog.analyzer.review.timeline import Key, Question
from hearthlog.analyzer.review.timeline_reader import read_frames, read_timeline
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.analyzer.review.viewer.drawing import (
    RequestedSpan,
    draw,
    draw_close_up,
    draw_frames,
    review_layout,
    write_checked,
)
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.lab.pictures.pages import as_json, served_page, write_report

GOLDEN = Path("tests/golden/0.1.0/logs")
_ZONE = ZoneInfo("Europe/Vienna")
_FEW = 40  # values, of which each is in the text
_MARGIN = 20 * NANOSECONDS
_UUID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_PAGE_FILES = (
    "/page.css",
    "/page.js",
    "/elements.js",
    "/picture.js",
    "/sounds.js",
    "/words.js",
)


def content_of(root: Path) -> dict[str, str]:
    """Return the hash of what each kind of picture shows, drawn from the logs of a clone."""
    logs = root / GOLDEN
    texts = {
        "review": day_text(logs),
        "queue": queue_text(logs),
        "report": report_text(logs),
        "page": page_text(logs),
    }
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in texts.items()}


def day_text(logs: Path) -> str:
    """Return what a review of a day draws, without a viewer."""
    start, _ = _span(logs)
    timeline = read_timeline(
        [logs], *day_span(local_time(start, _ZONE).date(), _ZONE), zone="Europe/Vienna"
    )
    drawn = Drawn()
    canvas = Canvas(drawn, timeline.clock)
    drawn.add_layout(review_layout(timeline, marking=True))
    draw(timeline, canvas, marking=True)
    write_checked(timeline, class_precision(timeline, find_home_logs([logs])), canvas)
    for part in read_frames(timeline):
        draw_frames(part, canvas)
    return drawn.text()


def queue_text(logs: Path) -> str:
    """Return what an item of a queue draws, without a viewer."""
    timeline = read_timeline([logs])
    grid = timeline.grid
    start, end = grid.start + 10 * NANOSECONDS, grid.start + 13 * NANOSECONDS
    drawn = Drawn()
    canvas = Canvas(drawn, timeline.clock)
    drawn.add_layout(review_layout(timeline, marking=True, close_up=True, has_question=True))
    draw(timeline, canvas)
    draw_close_up(read_timeline([logs], start - _MARGIN, end + _MARGIN), NONE, canvas)
    question = Question("Music?", "1 of 10", [Key("a", "yes"), Key("n", "skip")])
    RequestedSpan().show_question(start, end, question, canvas)
    return drawn.text()


def report_text(logs: Path) -> str:
    """Return the page of a report, without the version."""
    start, _ = _span(logs)
    with TemporaryDirectory() as folder:
        page = Path(folder, "report.html")
        write_report(logs, _ZONE, local_time(start, _ZONE).date(), page)
        return page.read_text("utf-8").replace(__version__, "")


def page_text(logs: Path) -> str:
    """Return the page of the home and what it draws, in two languages."""
    start, end = _span(logs)
    lines = []
    with served_page(logs, _ZONE, end + NANOSECONDS) as page:
        for language in ("en", "de"):
            lines += [page.get(path, language).decode() for path in ("/", *_PAGE_FILES)]
            lines += [f"{k} {as_json(v)}" for k, v in sorted(page.parts(language).items())]
            day = local_time(start, _ZONE).date()
            lines += [as_json(page.get(path, language)) for path in ("/days", f"/day?{day}")]
    return "\n".join(lines)


def _span(logs: Path) -> tuple[int, int]:
    home = find_home_logs([logs])
    end = home.end()
    assert end is not None
    return home.between()[0].start, end


class Drawn:
    """Stands where a recording of Rerun does, and takes down what is logged."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add_layout(self, blueprint: Any) -> None:
        """Add a blueprint, whose views have random names."""
        layout = Drawn()
        blueprint._log_to_stream(layout)  # noqa: SLF001 - as its subclass does
        names: dict[str, str] = {}

        def number(match: re.Match[str]) -> str:
            return names.setdefault(match[0], f"#{len(names)}")

        lines = (line for line in layout._lines if ":root_container" not in line)
        self._lines += [_UUID.sub(number, line) for line in lines]

    def text(self) -> str:
        """Return all lines, in one order."""
        return "\n".join(sorted(self._lines))

    def log(self, entity: str, *archetypes: Any, static: bool = False, **_: Any) -> None:
        for archetype in archetypes:
            for batch in archetype.as_component_batches():
                self._add(
                    entity, str(batch.component_descriptor()), batch.as_arrow_array(), static=static
                )

    def send_columns(self, entity: str, indexes: Any, columns: Any) -> None:
        for index in indexes:
            self._add(entity, index.timeline_name(), index.as_arrow_array())
        for column in columns:
            self._add(entity, str(column.component_descriptor()), column.as_arrow_array())

    def set_time(self, name: str, **moment: Any) -> None:
        self._lines.append(f"at {name} {moment}")

    def reset_time(self) -> None:
        """Nothing is drawn by this."""

    def _add(self, entity: str, name: str, array: pa.Array, *, static: bool = False) -> None:
        when = "always" if static else "then"
        self._lines.append(f"{entity} {when} {name} {_in_text(array)}")


def _in_text(array: pa.Array) -> str:
    """Describe an array: few values exactly, many by their number, ends and mean.

    The last bits of floats, and compressed images and sound, differ between machines.
    """
    if pa.types.is_union(array.type):
        return f"{array.to_pylist()}"
    while pa.types.is_nested(array.type):
        if pa.types.is_struct(array.type):
            return "; ".join(_in_text(part) for part in array.flatten())
        array = array.flatten()
    kind = array.type
    if pa.types.is_uint8(kind) and len(array) > _FEW:
        return "bytes"
    if pa.types.is_temporal(kind):
        array = array.cast(pa.int64())
    elif pa.types.is_floating(kind):
        values = array.to_numpy(zero_copy_only=False)
        known = values[np.isfinite(values)].astype(float)
        ends = (known.min(), known.mean(), known.max()) if len(known) else ()
        return f"{len(known)} of {len(values)}: {[f'{end:.3g}' for end in ends]}"
    values = array.to_pylist()
    if len(values) <= _FEW:
        return f"{values}"
    return f"{len(values)}: {values[0]} to {values[-1]}"
