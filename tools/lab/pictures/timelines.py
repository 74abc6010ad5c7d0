"""The pictures of `hearthlog review`: a day, and a queue, in Rerun's viewer."""

import time
from collections.abc import Sequence
from pathlib import Path
from queue import SimpleQueue

import numpy as np

from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.local_time import home_zone
from hearthlog.analyzer.logs.spans import Spans
from hearthlog.analyzer.review.lanes import class_precision
from hearthlog.analyzer.review.marking import Marking
from hearthlog.analyzer.review.ranking import USEFUL
from hearthlog.analyzer.review.review_list import corrected_name
from hearthlog.analyzer.review.review_queue import ReviewItem, queue_spans, review_items
from hearthlog.analyzer.review.session import ReviewSession
from hearthlog.analyzer.review.timeline_reader import MOST_FRAMES, read_frames, read_timeline
from hearthlog.analyzer.review.viewer.viewer import WindowViewer, open_hidden
from hearthlog.models.registry import DEFAULT_FOLDER
from hearthlog.schemas.messages.topics import LIVE

_STILL_SECONDS = 3.0
_WAIT_SECONDS = 90.0
Limits = tuple[int | None, int | None]


def day_picture(logs: Path, limits: Limits, size: tuple[int, int]) -> bytes:
    """Return a picture of the review of a span, as PNG."""
    timeline = read_timeline([logs], *limits)
    with open_hidden(size=size) as viewer:
        viewer.draw(timeline, close_up=False)
        viewer.wait_until_drawn()
        grid = timeline.grid
        if grid.end - grid.start <= MOST_FRAMES:
            for part in read_frames(timeline, grid.start, grid.end):
                viewer.draw_frames(part, grid.start, grid.end)
        viewer.write_checked(timeline, class_precision(timeline, find_home_logs([logs])))
        return _still_picture(viewer)


def queue_picture(logs: Path, size: tuple[int, int]) -> bytes:
    """Return a picture of the first item of the queue, as PNG."""
    timeline = read_timeline([logs])
    microphone = next(iter(timeline.microphones))
    clips = timeline.microphones[microphone].clips
    edges = np.array([(one.start, one.end) for one in clips], np.int64).reshape(-1, 2)
    items = queue_of(logs, microphone, Spans(edges[:, 0], edges[:, 1]))
    with open_hidden(size=size) as viewer:
        viewer.draw(timeline, close_up=True)
        viewer.wait_until_drawn()
        heard = timeline.microphones[microphone]
        segments = {one.name: one.spans for one in heard.labellings}
        coverage = timeline.coverage[microphone]
        marking = Marking(microphone, coverage, "reviewer", corrected_name(LIVE), segments[LIVE])
        session = ReviewSession(
            viewer,
            marking,
            heard.classes_of(""),
            home_zone(timeline.zone),
            lambda _: None,
            lambda start, end: viewer.draw_close_up(
                read_timeline([logs], start, end, zone=timeline.zone)
            ),
            lambda *_: (0.0, ""),
            lambda: None,
            items,
        )
        keys: SimpleQueue[str] = SimpleQueue()
        keys.put("q")
        session.run(keys)
        return _still_picture(viewer)


def queue_of(logs: Path, microphone: str, audible: Spans) -> Sequence[ReviewItem]:
    """Return the items of the default queue, as `hearthlog review --queue` does."""
    sources, limits = find_labellings(logs), (None, None)
    labelled = microphone, LIVE
    spans = queue_spans(USEFUL, sources, labelled, limits, None, DEFAULT_FOLDER, audible=audible)
    return review_items(spans, audible)


def _still_picture(viewer: WindowViewer) -> bytes:
    """Wait until the viewer has drawn all, and return a picture."""
    deadline = time.monotonic() + _WAIT_SECONDS
    before, since = b"", time.monotonic()
    while True:
        viewer.refresh()
        picture = viewer.picture()
        if picture != before:
            before, since = picture, time.monotonic()
        now = time.monotonic()
        if now - since >= _STILL_SECONDS or now >= deadline:
            return picture
        time.sleep(0.3)
