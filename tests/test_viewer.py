"""Pictures of a real day in Rerun: headless, in a window, and in a browser."""

import os
import shutil
from contextlib import suppress

import numpy as np
import pytest
from realday import START
from viewers import (
    Window,
    browsing,
    display,
    free_port,
    patiently,
    pixels,
    reviewing,
    shown,
    viewer,
)

from hearthlog.analyzer.colours import GAP, colour
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.review.timeline.overview import overview
from hearthlog.analyzer.review.timeline.read_timeline import read_timeline
from hearthlog.analyzer.review.viewer.file import save_timeline
from hearthlog.analyzer.review.viewer.web import open_page
from hearthlog.schemas.logs.files import find_logs

__all__ = ["display", "viewer"]  # fixtures

HOUR = 3600 * 1_000_000_000
MARKED = (START + 2 * HOUR, START + 3 * HOUR)
_NEAR = 14  # of 255: how far a colour may be off
_LANE, _BAND = 0.7, 0.4  # how much of a colour is left where the viewer draws it darker
_LONG = 900 * 1_000_000_000  # a block that is seen at any size


@pytest.fixture(scope="module")
def reviewed_day(real_day, tmp_path_factory):
    """The real day, with an hour that was marked."""
    folder = tmp_path_factory.mktemp("day") / "logs"
    shutil.copytree(real_day, folder, copy_function=os.link)
    log = find_logs(folder)[2]
    write_marks(log, [Mark("mic", *MARKED, "yelling", "Ann", 5, "live")])
    return folder


@pytest.fixture(scope="module")
def timeline(reviewed_day):
    return read_timeline([reviewed_day])


class Picture:
    """What is seen of a timeline, whose lanes are as wide as the picture."""

    def __init__(self, png, timeline):
        self._image = pixels(png)
        self._grid = timeline.grid
        self._left = 0

    def begin_right_of_scale(self, row):
        """Take the place from which on something is drawn in a row for the first time."""
        self._left = int(np.argmax((self._image[row] > 40).any(axis=1)))

    def column(self, time):
        """The colours of a column, from above."""
        share = (time - self._grid.start) / (self._grid.end - self._grid.start)
        width = self._image.shape[1] - self._left
        return self._image[:, self._left + int(share * width)]

    def is_coloured(self, time, wanted, darkest):
        """For each row, whether it has a colour at a time, mixed with black to some extent."""
        found, wanted = self.column(time), np.array(wanted)
        light = found @ wanted / (wanted @ wanted)
        off = np.abs(found - light[:, np.newaxis] * wanted).max(axis=1)
        return (off <= _NEAR) & (light > darkest) & (light < 1.1)


def blocks_of(timeline):
    """Long blocks of the lane seen from afar: their middles, and what they say."""
    live = overview(timeline.microphones["mic"].labellings[0], timeline.grid)
    rows = zip(live.starts.tolist(), live.ends.tolist(), live.texts, strict=True)
    return [((start + end) // 2, text) for start, end, text in rows if end - start > _LONG]


def lanes_are_right(png, timeline):
    """Whether there is a row in which every long block has its colour, and so on."""
    picture = Picture(png, timeline)
    blocks = blocks_of(timeline)
    live = np.all([picture.is_coloured(time, colour(text), _LANE) for time, text in blocks], axis=0)
    ((start, end),) = zip(*timeline.microphones["mic"].gaps[:2], strict=True)
    missing = picture.is_coloured((start + end) // 2, GAP, _LANE)
    review = picture.is_coloured(sum(MARKED) // 2, colour("yelling"), _LANE)
    elsewhere = picture.is_coloured(MARKED[1] + HOUR, colour("yelling"), _LANE)
    rows = [np.flatnonzero(rows) for rows in (live, review & ~elsewhere, missing)]
    # From above: what the recorder says, the review, what was not heard.
    return all(len(each) for each in rows) and rows[0][0] < rows[1][0] < rows[2][-1]


def check_bands(png, timeline):
    """Check that bands are as high as classes were probable where one of them was for long."""
    names, values = timeline.microphones["mic"].labellings[0].probabilities
    found = []
    for time, text in blocks_of(timeline):
        place = int(timeline.grid.find(np.array([time]))[0])
        found.append((time, text, values[place - 1 : place + 2, names.index(text)].mean()))
    picture = Picture(png, timeline)
    night = START + 5 * HOUR  # when it is silent for hours
    silence = max((share, time) for time, text, share in found if time < night)[0]
    rows = np.flatnonzero(picture.is_coloured(night, colour("silence"), _BAND))
    run = max(np.split(rows, np.flatnonzero(np.diff(rows) > 3) + 1), key=len)
    height = len(run) / silence
    assert height > 30
    plot = slice(int(run[-1] - height), run[-1] + 1)
    picture.begin_right_of_scale(run[len(run) // 2])
    checked = set()
    for time, text, share in found:
        if share > 0.4 and time < START + 17 * HOUR:  # the legend is over the evening
            seen = picture.is_coloured(time, colour(text), _BAND)[plot].sum() / height
            assert abs(seen - share) < 0.2, (text, seen, share)
            checked.add(text)
    assert len(checked) >= 4


def picture_of(take, timeline, path):
    """Take pictures until one shows all, as it was heard; keep the last one for people."""

    def is_right(png):
        path.write_bytes(png)
        with suppress(AssertionError):
            check_bands(png, timeline)
            return lanes_are_right(png, timeline)
        return False

    patiently(take, is_right)


def test_a_saved_day_is_drawn_as_it_was_heard(timeline, viewer, tmp_path):
    save_timeline(timeline, tmp_path / "day.rrd")
    _, state = shown(viewer, tmp_path / "day.rrd", views=5)
    assert [report for view in state.views for report in view.reports] == []
    assert all(view.visible for view in state.views)
    picture_of(viewer.take_screenshot, timeline, tmp_path / "saved.png")


def test_the_window_shows_a_day_as_it_was_heard(reviewed_day, timeline, display, tmp_path):
    port = free_port()
    with reviewing(reviewed_day, "--port", port, DISPLAY=display) as review:
        review.wait_for("drag a span")
        window = Window(display, port)
        picture_of(window.picture, timeline, tmp_path / "window.png")
        assert [report for view in window.state().views for report in view.reports] == []
        assert review.quit() == 0


def test_the_page_shows_a_day_as_it_was_heard(timeline, tmp_path):
    browser = tmp_path / "browser"
    with open_page() as viewer, browsing(viewer.address, browser, "1500,1100") as page:
        viewer.draw(timeline, close_up=False)
        assert viewer.wait_until_drawn().errors == []
        picture_of(page.picture, timeline, tmp_path / "page.png")
        assert viewer.state().errors == []
