"""Pictures of a day in Rerun: headless and in a browser."""

import json
import socket
import struct
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress
from datetime import UTC
from itertools import pairwise
from urllib.parse import urlsplit

import numpy as np
import pytest
from homelife import GENERAL, midnight, write_day
from rerun.chunk import RrdReader
from shortsounds import DAY, SOUGHT, short_sounds
from viewers import (
    browsing,
    display,
    find_ruler,
    patiently,
    pixels,
    shown,
    viewer,
)

from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.review.lanes import PROBABILITIES, SELECTED_COLOUR
from hearthlog.analyzer.review.timeline import Key
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.review.viewer.drawing import SHARED_AXIS
from hearthlog.analyzer.review.viewer.process import ViewerProcess
from hearthlog.analyzer.review.viewer.recording import save_timeline
from hearthlog.analyzer.review.viewer.row_heights import TOP_BAR
from hearthlog.analyzer.review.viewer.viewer import ViewerSize, WindowViewer
from hearthlog.analyzer.review.viewer.web import _BLUEPRINT, _SET_BLUEPRINT, _field, open_page
from hearthlog.models.classes import GAP, colour, ordered
from hearthlog.schemas.logs.files import find_logs

__all__ = ["display", "short_sounds", "viewer"]  # fixtures

HOUR = 3600 * 1_000_000_000
START = midnight(DAY)
MARKED = (START + 2 * HOUR, START + 3 * HOUR)
_NEAR = 14  # of 255: how far a colour may be off
_CAP = 5  # pixels by which a strip is longer than its sound, and what is rounded
_WHITE = 110
_DARK = 13  # behind plots
_LONG = 300 * 1_000_000_000
_SAVING = """
import re, sys
from pathlib import Path
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.review.viewer.recording import save_timeline
save_timeline(read_timeline([Path(sys.argv[1])]), Path(sys.argv[2]))
print(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
"""


_HEARD = [  # from which hour until which one, and what; the rest of the day is silent
    (1.2, 1.3, "coughing"),
    (6.9, 7.0, "flushing_water"),
    (7.02, 7.3, "shower"),
    (7.3, 8.2, "objects_activity"),
    (8.2, 8.8, "music"),
    (9.2, 9.25, "phone_ring"),
    (9.25, 9.7, "speech"),
    (15.4, 15.8, "speech"),
    (16.9, 17.1, "crying"),
    (19.9, 20.1, "laughing"),
    (20.8, 21.4, "music"),
]


@pytest.fixture(scope="module")
def reviewed_day(tmp_path_factory):
    """A day with all of its frames, an hour of it marked, and ten minutes without sound."""
    folder = tmp_path_factory.mktemp("day") / "logs"
    events = [(3600 * one, 3600 * (end - one), name, 0.9) for one, end, name in _HEARD]
    gaps = [(12.3 * 3600, 600, "overrun")]
    classes = [*GENERAL, "flushing_water", "shower"]
    write_day(folder, DAY, events, classes=classes, gaps=gaps, timezone="UTC", all_frames=True)
    log = find_logs(folder)[2]
    write_marks(log, [Mark("mic", *MARKED, "yelling", "Ann", 5, "live")])
    return folder


@pytest.fixture(scope="module")
def timeline(reviewed_day):
    return read_timeline([reviewed_day])


_NAMES = 150  # pixels with names of lanes in each picture
_BESIDE_RULER = 30  # pixels at the right of the time ruler


class Picture:
    """What is seen of a timeline; each view begins where its scale ends."""

    def __init__(self, png, timeline):
        self.image = pixels(png)
        self._grid = timeline.grid
        self._width = 0
        self.begin_at_cursor(slice(0, self.image.shape[0] * 7 // 10))

    def begin_at_cursor(self, rows):
        """Take the column of the cursor, which is at the start, in these rows.

        Returns its ends: the first row of the view, and the one after the last.
        """
        columns = slice(_NAMES, self.image.shape[1] // 3)
        white = (self.image[rows, columns] > _WHITE).all(axis=2)
        column = int(white.sum(axis=0).argmax())
        self._left = _NAMES + column
        # Above the ruler all views have its scale, wherever they begin.
        is_above_ruler = self._left < self.image.shape[1] // 6
        right = self._left + self._width if is_above_ruler and self._width else self.image.shape[1]
        self._right = right - _BESIDE_RULER * (is_above_ruler and not self._width)
        self._width = self._right - self._left
        found = np.flatnonzero(white[:, column])
        cursor = max(np.split(found, np.flatnonzero(np.diff(found) > 4) + 1), key=len)
        return rows.start + int(cursor[0]), rows.start + int(cursor[-1]) + 1

    def place(self, time):
        """The number of a column."""
        share = (time - self._grid.start) / (self._grid.end - self._grid.start)
        return self._left + int(share * (self._right - self._left))

    def is_coloured(self, time, wanted, darkest):
        """For each row, whether it has a colour at a time, mixed with black to some extent."""
        found, wanted = self.image[:, self.place(time)], np.array(wanted)
        light = found @ wanted / (wanted @ wanted)
        off = np.abs(found - light[:, np.newaxis] * wanted).max(axis=1)
        return (off <= _NEAR) & (light > darkest) & (light < 1.1)

    def strip(self, start, end, wanted):
        """The rows and columns of a strip of a colour around a span of time."""
        first, last = self.place(start) - _CAP, self.place(end) + _CAP
        near = np.abs(self.image[:, max(first, 0) : last] - wanted).max(axis=2) <= _NEAR
        rows, columns = np.nonzero(near)
        return rows, columns


def blocks_of(timeline):
    """Where a class was the most probable one for long: times, and the class."""
    shares = timeline.microphones["mic"].plots[PROBABILITIES, "live"]
    names, values = shares.names, shares.values
    best = np.nan_to_num(values).argmax(axis=1)
    edges = np.flatnonzero(np.diff(best, prepend=-1, append=-1))
    for first, last in pairwise(edges.tolist()):
        if timeline.grid.edges[last] - timeline.grid.edges[first] > _LONG:
            yield int(timeline.grid.middles[(first + last) // 2]), names[best[first]]


def lanes_are_right(png, timeline):
    """Whether the longest sound of each class is in a lane of its own, and so on."""
    picture = Picture(png, timeline)
    microphone = timeline.microphones["mic"]
    live, bottoms = microphone.labellings[0].spans, []
    for name in sorted(set(live.texts) - {"silence"}):
        own = np.flatnonzero(live.texts == name)
        row = own[(live.ends - live.starts)[own].argmax()]
        rows, _ = picture.strip(live.starts[row], live.ends[row], colour(name))
        bottoms.append(rows.min() if len(rows) else -1)
    ((start, end),) = zip(*microphone.gaps[:2], strict=True)
    missing, _ = picture.strip(start, end, GAP)
    review, _ = picture.strip(*MARKED, colour("yelling"))
    elsewhere, _ = picture.strip(MARKED[1] + HOUR, MARKED[1] + 2 * HOUR, colour("yelling"))
    if min(bottoms) < 0 or not len(missing) or not len(review) or len(elsewhere):
        return False
    # From above: what the recorder says, the review, what was not heard.
    return max(bottoms) < review.min() < missing.max() and len(set(bottoms)) == len(bottoms)


def check_rows(png, timeline):
    """Check that the row of a class is as bright as it was probable, where it was for long."""
    shares = timeline.microphones["mic"].plots[PROBABILITIES, "live"]
    names, values = shares.names, shares.values
    rows = ordered(names)
    picture = Picture(png, timeline)
    night = START + 5 * HOUR  # when it is silent for hours
    silent = np.flatnonzero(picture.is_coloured(night, colour("silence"), 0.8))
    run = max(np.split(silent, np.flatnonzero(np.diff(silent) > 3) + 1), key=len)
    assert rows[-1] == "silence"
    assert len(run) > 8
    around = slice(run[-1] - len(run) * len(rows), run[-1] + 1)
    begin = picture.place(timeline.grid.start)
    top, bottom = picture.begin_at_cursor(around)
    assert abs(picture.place(timeline.grid.start) - begin) <= 1, "it has the scale of the lanes"
    height = (bottom - top) / len(rows)
    checked = set()
    for time, text in blocks_of(timeline):
        place = int(timeline.grid.find(np.array([time]))[0])
        shares = values[place - 1 : place + 2, names.index(text)]
        if shares.mean() > 0.4:
            above = len(rows) - rows.index(text) - 0.5  # rows to its middle, from below
            row = int(bottom - above * height)
            around = picture.image[row - 2 : row + 3, picture.place(time)].mean(axis=0)
            light = _DARK + np.outer(shares, np.array(colour(text)) - _DARK)  # a pixel more or less
            off = np.maximum(light.min(axis=0) - around, around - light.max(axis=0)).max()
            assert off < 0.25 * 255, (text, shares, around)
            checked.add(text)
    assert len(checked) >= 4


def picture_of(take, timeline, path):
    """Take pictures until one shows all, as it was heard; keep the last one for people."""

    def is_right(png):
        path.write_bytes(png)
        with suppress(AssertionError):
            check_rows(png, timeline)
            return lanes_are_right(png, timeline)
        return False

    patiently(take, is_right)


def test_a_saved_day_is_drawn_as_it_was_heard(timeline, viewer, tmp_path):
    save_timeline(timeline, tmp_path / "day.rrd")
    _, state = shown(viewer, tmp_path / "day.rrd", views=12)
    assert [report for view in state.views for report in view.reports] == []
    assert all(view.visible for view in state.views)
    picture_of(viewer.take_screenshot, timeline, tmp_path / "saved.png")


def test_a_day_is_saved_within_the_memory_and_the_space_of_a_small_machine(reviewed_day, tmp_path):
    path = tmp_path / "day.rrd"
    command = [sys.executable, "-c", _SAVING, str(reviewed_day), str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert int(done.stdout) < 330_000  # kilobytes; with every frame of the day it was 375,000
    assert path.stat().st_size < 10_000_000


def test_a_page_that_is_loaded_again_shows_what_it_showed_and_another_window_says_so(
    short_sounds, tmp_path
):
    timeline = read_timeline([short_sounds], *day_span(DAY, UTC))
    start = timeline.grid.start + 6 * HOUR
    path = tmp_path / "day.png"

    def drawn(page):
        def take():
            with suppress(ConnectionError, TimeoutError):
                viewer.refresh()
            return page.picture()

        is_hidden = "document.getElementById('canvas').classList.contains('waits')"
        patiently(lambda: page.evaluate(is_hidden), lambda hidden: hidden is False)
        patiently(take, lambda png: is_seen(png, timeline, path))

    with open_page() as viewer, browsing(viewer.address, tmp_path / "one", "1366,1000") as page:
        viewer.offer([Key("c", "confirm the labels")], lambda _: None)
        page.open(viewer.address)
        viewer.draw(timeline, close_up=False)
        viewer.wait_until_drawn()
        viewer.announce("drag a span")
        drawn(page)
        page.open(viewer.address)
        drawn(page)
        assert page.text() == "drag a span"
        assert page.evaluate("before.textContent") == "", "not that it loads"
        viewer.show(start, start + HOUR, HOUR)
        with browsing(viewer.address, tmp_path / "other", "1366,1000") as other:
            patiently(other.text, lambda text: text == "drag a span")
            patiently(lambda: [viewer.refresh(), viewer.selection()][1] == (start, start + HOUR))
            text = "open in another window: close this one, or reload it to go on here"
            patiently(page.text, lambda found: found == text)
            assert page.evaluate("document.querySelector('button').disabled") is True


def test_a_viewer_that_has_no_layout_yet_after_a_reload_is_aligned_later(short_sounds):
    timeline = read_timeline([short_sounds], *day_span(DAY, UTC))
    with hidden((768, 1024)) as viewer:
        viewer.draw(timeline, close_up=False)
        viewer.wait_until_drawn()
        viewer._show_again()
        assert viewer._align({}) is False
        assert viewer._align(viewer._blueprint()) is True


NAMES, ROOT, AXES = "/container/names", "/container/root", f"/{SHARED_AXIS}"
LAYOUT = {
    "/viewport": {"ViewportBlueprint": {"root_container": "root"}},
    ROOT: {"ContainerBlueprint": {"contents": ["container/hours", NAMES], "row_shares": [1, 9]}},
    NAMES: {"ContainerBlueprint": {"row_shares": [1, 1, 0.5]}},
}


@pytest.mark.parametrize(
    "sent",
    [
        b"[",
        b"[" * 100_000,
        b"3",
        *({**LAYOUT, path: {}} for path in LAYOUT),
        *({**LAYOUT, path: 3} for path in LAYOUT),
        {**LAYOUT, "/time_panel": {"TimePanelBlueprint": None}},
        {**LAYOUT, ROOT: {"ContainerBlueprint": {"contents": [3, None]}}},
        *({**LAYOUT, NAMES: {"ContainerBlueprint": {"row_shares": one}}} for one in ([], 1)),
        *({**LAYOUT, AXES: {"TimeAxis": {"view_range": one}}} for one in ([1], {"end": 1}, {})),
        *(
            {**LAYOUT, "/time_panel": {"TimePanelBlueprint": {"time_selection": one}}}
            for one in ({"min": 0, "max": 1 << 70}, {"min": "0"}, 3)
        ),
    ],
    ids=str,
)
def test_what_a_page_sends_never_ends_a_review(page_without_browser, sent):
    viewer = page_without_browser
    viewer._show_again()
    for content in (sent, LAYOUT):
        text = content if isinstance(content, bytes) else json.dumps(content).encode()
        answer = _field(_BLUEPRINT, _field(2, text)) + _field(_SET_BLUEPRINT, b"")
        viewer._relay.request = lambda _, answer=answer: answer
        viewer._size_due = 0.0
        with suppress(ConnectionError, TimeoutError):  # as a session does
            viewer.refresh()
    assert viewer._aligned is not None


def test_an_answer_that_is_no_message_is_none(page_without_browser):
    page_without_browser._relay.request = lambda _: b"\xff"
    with pytest.raises(ConnectionError):
        page_without_browser.state()


@pytest.fixture(scope="module")
def page_without_browser(short_sounds):
    with open_page() as viewer:
        viewer.draw(read_timeline([short_sounds], *day_span(DAY, UTC)), close_up=False)
        viewer._relay.size, viewer._names = ViewerSize(768, 885), [NAMES]
        viewer._latest = viewer._opening = {}
        viewer._page = viewer._relay.page
        yield viewer


LOW = [(1366, 500), (1366, 536), (1366, 650), (1000, 600)]  # a canvas above buttons; of a phone


@pytest.mark.parametrize("size", LOW)
@pytest.mark.parametrize("close_up", [False, True])
def test_names_of_lanes_are_legible_in_a_low_page(short_sounds, size, close_up):
    timeline = read_timeline([short_sounds], *day_span(DAY, UTC))
    width, height = size
    with hidden((width, height + round(TOP_BAR))) as viewer:
        viewer.draw(timeline, close_up=close_up)
        viewer.wait_until_drawn()
        found = patiently(lambda: [viewer.refresh(), viewer._blueprint()][1], bool)
        containers = [one.get("ContainerBlueprint", {}) for one in found.values()]
        (rows,) = [one for one in containers if one.get("container_kind") == "Vertical"
                   and len(one["contents"]) in {2, 3} and "row_shares" in one]  # fmt: skip
        is_folded = found["/time_panel"]["TimePanelBlueprint"]["state"] == "Collapsed"
        assert close_up or not is_folded, "one drags on the ruler"
        plots = found[rows["contents"][-1]]["ContainerBlueprint"]
        lanes = rows["row_shares"][2 if close_up else 1]
        count = max(
            len(one["row_shares"]) - 1
            for one in containers
            if isinstance(one.get("row_shares"), list) and one is not rows
        )
        assert plots["visible"] is (rows["row_shares"][-1] > 0)
        assert (lanes - 47) / count >= 26
        assert rows["row_shares"][0] == 62  # the question, or the hours, in every window


def test_a_page_that_is_closed_leaves_no_error_in_the_terminal(capfd):
    with open_page() as viewer:
        address = urlsplit(viewer.address)
        before = threading.active_count()
        with socket.create_connection((address.hostname, address.port)) as page:
            page.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            wanted = f"GET {address.path}text/0 HTTP/1.1\r\nHost: {address.netloc}\r\n\r\n"
            page.sendall(wanted.encode())
            patiently(threading.active_count, lambda count: count > before)
        viewer.announce("nobody reads this")
        patiently(threading.active_count, lambda count: count <= before)
    assert "Traceback" not in capfd.readouterr().err


# What one looks for: short sounds in a long day

SIZES = [(1366, 768), (1920, 1080)]


@contextmanager
def hidden(size):
    """A viewer without a screen, of some size."""
    size = "x".join(map(str, size))
    process = ViewerProcess(["--hide-welcome-screen", "--headless", "--window-size", size])
    with WindowViewer(process) as viewer:
        yield viewer


def check_seen(png, timeline):
    """Check that each sound is seen in the lane of its class, and that there is nothing else."""
    picture = Picture(png, timeline)
    lanes = {}
    for name, spans in SOUGHT.items():
        everywhere = np.abs(picture.image - colour(name)).max(axis=2) <= _NEAR
        for start, seconds in spans:
            begin = timeline.grid.start + round(start * 1e9)
            rows, columns = picture.strip(begin, begin + round(seconds * 1e9), colour(name))
            assert len(rows) >= 6, f"{name} at {start / 3600:.2f} h"
            assert np.ptp(columns) >= 2
            lanes.setdefault(name, set()).update(rows.tolist())
            everywhere[:, picture.place(begin) - _CAP : picture.place(begin) + _CAP + 1] = False
        assert 15 < max(lanes[name]) - min(lanes[name]) < 45, "one lane"
        lane = everywhere[min(lanes[name]) : max(lanes[name]) + 1]
        assert lane.sum() <= 12, f"{name} where there was none"
    tops = sorted((min(rows), max(rows)) for rows in lanes.values())
    assert all(one[1] < other[0] for one, other in pairwise(tops)), "lanes of their own"
    off = timeline.grid.start + 13 * HOUR
    rows, columns = picture.strip(off, off + HOUR, GAP)
    assert np.ptp(columns) > 40
    assert rows.min() > tops[-1][1]


def notches(png, shade):
    """By how many pixels each strip of the topmost lane of a colour is narrower in some row."""
    near = np.abs(pixels(png) - shade).max(axis=2) <= _NEAR
    rows = np.flatnonzero(near.any(axis=1))
    lane, *_ = np.split(rows, np.flatnonzero(np.diff(rows) > _CAP) + 1)
    inner = near[lane[0] + 2 : lane[-1] - 1]  # without the round ends
    columns = np.flatnonzero(inner.any(axis=0))
    strips = np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1)
    assert len(inner) > 6
    return [int(np.ptp(inner[:, strip].sum(axis=1))) for strip in strips]


@pytest.mark.parametrize("size", SIZES)
def test_a_strip_is_one_piece_without_beads_at_every_zoom(short_sounds, size):
    timeline = read_timeline([short_sounds], *day_span(DAY, UTC))
    begin, seconds = SOUGHT["yelling"][0]
    start = timeline.grid.start + round(begin * 1e9)
    with hidden(size) as viewer:
        viewer.draw(timeline, close_up=False)
        viewer.wait_until_drawn()
        for margin in (10 * HOUR, HOUR // 6, HOUR // 200):
            viewer.show(start, start + round(seconds * 1e9), margin, select=False)
            patiently(viewer.cursor, lambda cursor: cursor == start)

            def found(viewer=viewer):
                with suppress(AssertionError, ValueError, IndexError):
                    return notches(viewer.picture(), colour("yelling"))
                return [99]

            patiently(found, lambda each: max(each) <= 1)


def is_seen(png, timeline, path):
    path.write_bytes(png)
    with suppress(AssertionError):
        check_seen(png, timeline)
        return True
    return False


@pytest.mark.parametrize("size", SIZES)
def test_every_short_sound_of_a_day_is_seen_in_the_window(short_sounds, size, tmp_path):
    timeline = read_timeline([short_sounds], *day_span(DAY, UTC))
    with hidden(size) as viewer:
        viewer.draw(timeline, close_up=False)
        assert viewer.wait_until_drawn().errors == []
        path = tmp_path / "short.png"
        with suppress(AssertionError):
            patiently(viewer.picture, lambda png: is_seen(png, timeline, path))
        check_seen(path.read_bytes(), timeline)


def test_the_ruler_of_a_day_is_named_in_words(short_sounds, tmp_path):
    timeline = read_timeline([short_sounds], *day_span(DAY, UTC))
    save_timeline(timeline, tmp_path / "day.rrd")
    chunks = [*RrdReader(tmp_path / "day.rrd").stream()]
    assert {str(one.entity_path) for one in chunks} >= {"/Hour", "/words/hours"}
    (name,) = [one.to_record_batch() for one in chunks if str(one.entity_path) == "/words/hours"]
    assert name.column("TextDocument:text").to_pylist() == [["Hour of the day"]]


# What one does with the mouse


_LANES, _TITLES = 203, 130  # pixels at the left of the lanes, and above them


def rows_of(picture, name):
    """The rows in which a class is drawn as a strip."""
    return np.flatnonzero((np.abs(picture - colour(name)).max(axis=2) <= _NEAR).any(axis=1))


def columns_of(picture, shade):
    """The first and the last column in which a strip of a colour is drawn, without round ends."""
    lanes = picture[_TITLES : len(picture) * 6 // 10, _LANES:]
    columns = np.flatnonzero((np.abs(lanes - shade).max(axis=2) <= _NEAR).sum(axis=0) > 3)
    return (_LANES + columns[0] + 2, _LANES + columns[-1] - 2) if len(columns) else None


@contextmanager
def page_of(folder):
    """A page of 1366 x 768, with its viewer."""
    with open_page() as viewer, browsing(viewer.address, folder, "1366,768") as page:
        yield viewer, page


@pytest.fixture(scope="module")
def shared_page(tmp_path_factory):
    with page_of(tmp_path_factory.mktemp("browser")) as pair:
        yield pair


def with_a_day(folder, logs, viewer, page):
    """Let a page show a day; return its timeline, too."""
    timeline = read_timeline([logs], *day_span(DAY, UTC))
    viewer.draw(timeline, close_up=False)
    assert viewer.wait_until_drawn().errors == []
    patiently(page.picture, lambda png: is_seen(png, timeline, folder / "day.png"))
    return timeline, viewer, page


@pytest.fixture
def day_page(short_sounds, shared_page, tmp_path):
    """A page that tests share, which neither zoom nor scroll: it would stay so."""
    return with_a_day(tmp_path, short_sounds, *shared_page)


@pytest.fixture
def own_page(short_sounds, tmp_path):
    with page_of(tmp_path / "browser") as pair:
        yield with_a_day(tmp_path, short_sounds, *pair)


def test_every_short_sound_of_a_day_is_seen_in_the_page(day_page):
    timeline, _, page = day_page
    check_seen(page.picture(), timeline)


def test_where_a_double_click_showed_all_data_the_times_of_the_ruler_are_shown_again(day_page):
    timeline, viewer, _ = day_page
    before = viewer._blueprint()
    view, edges = before[f"/{SHARED_AXIS}"], (timeline.grid.start, timeline.grid.end)
    start, end = ({"Absolute": edge} for edge in edges)
    before[f"/{SHARED_AXIS}"] = {"TimeAxis": {"view_range": {"start": start, "end": end}}}
    viewer._set_blueprint(before)
    viewer.refresh()  # as a session does several times a second
    patiently(viewer._blueprint, lambda found: found[f"/{SHARED_AXIS}"] == view)


def test_what_is_dragged_on_the_ruler_is_selected_in_the_lanes_above_it(day_page):
    timeline, viewer, page = day_page
    x, y = find_ruler(page.picture, page.bar_height())
    page.drag(y, x + 200, x + 420)
    start, end = patiently(viewer.selection, bool)
    viewer.refresh()
    found = patiently(lambda: columns_of(pixels(page.picture()), SELECTED_COLOUR), bool)
    shares = [
        (time - timeline.grid.start) / (timeline.grid.end - timeline.grid.start)
        for time in (start, end)
    ]
    on_ruler = [x + share * (1366 - _BESIDE_RULER - x) for share in shares]
    assert np.abs(np.subtract(found, on_ruler)).max() <= 3
    assert abs(on_ruler[1] - (x + 420)) <= 3  # where the mouse was released
    viewer.show(start, end, 0, select=False)
    assert viewer.selection() is None
    viewer.refresh()
    patiently(
        lambda: columns_of(pixels(page.picture()), SELECTED_COLOUR), lambda found: found is None
    )


def test_the_wheel_moves_no_lane_away_from_its_name(own_page, tmp_path):
    """It zooms in time alone, and what it scrolls is put back."""
    timeline, viewer, page = own_page
    png = page.picture()
    before = pixels(png)
    first = timeline.grid.start + round(SOUGHT[next(iter(SOUGHT))][0][0] * 1e9)
    x = Picture(png, timeline).place(first)
    lanes = {name: set(rows_of(before, name)) for name in SOUGHT}
    view = viewer._blueprint()[f"/{SHARED_AXIS}"]
    for steps, zoom in ((-1, True), (1, False), (-2, False)):
        page.wheel(x, 200, steps, zoom=zoom)

        def is_in_place(png):
            viewer.refresh()  # as a session does several times a second
            (tmp_path / "wheel.png").write_bytes(png)
            now = pixels(png)
            found = {name: set(rows_of(now, name)) for name in SOUGHT}
            return any(found.values()) and all(found[name] <= lanes[name] for name in SOUGHT)

        patiently(page.picture, is_in_place)
    assert viewer._blueprint()[f"/{SHARED_AXIS}"] != view  # it did zoom
