"""A report in a browser, as it opens: what one sees of a day without scrolling."""

from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import GENERAL, HOUR, at, write_day
from shortsounds import DAY, SOUGHT, short_sounds
from viewers import browsing, pixels

from hearthlog.analyzer.colours import colour
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.report.report import Period, make_report

__all__ = ["short_sounds"]  # fixture

WHITE, NIGHT = (255, 255, 255), (0xE9, 0xEC, 0xF1)
SIZES = [(1366, 625), (1920, 937)]  # what a browser leaves of 1366 x 768, and of 1920 x 1080
_HALF = 0.4  # of a mark's colour, where the screen mixes it with what is beside it


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with browsing("about:blank", tmp_path_factory.mktemp("browser")) as page:
        yield page


class Report:
    """The opening view of a report on a day."""

    def __init__(self, browser, logs, size, folder):
        output = folder / "report.html"
        make_report(find_home_logs([logs]), Period(DAY, 1, ZoneInfo("UTC")), output)
        width, height = size
        browser.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        browser.open(output.as_uri())
        png = browser.picture()
        (folder / "seen.png").write_bytes(png)
        self.image = pixels(png)
        assert self.image.shape == (height, width, 3)
        shaded = np.flatnonzero((self.image == NIGHT).all(axis=2).sum(axis=0) > 100)
        self.start, self.end = shaded[0], shaded[-1] + 1  # the night at both ends of the day
        assert self.end - self.start > width * 0.35

    def place(self, second):
        """The column of a second of the day."""
        return self.start + second / (24 * HOUR) * (self.end - self.start)

    def marks(self, name):
        """Where the colour of a class is, at least mixed with the ground."""
        share = [self._mixed(np.array(ground), name) for ground in (WHITE, NIGHT)]
        found = np.maximum(*share) > _HALF
        found[:, : self.start] = False  # names
        return found

    def _mixed(self, ground, name):
        """How much of a colour is in each pixel, and no other colour."""
        to = colour(name) - ground
        share = (self.image - ground) @ to / (to @ to)
        off = np.abs(self.image - ground - share[:, :, np.newaxis] * to).max(axis=2)
        return np.where(off <= 12, share, 0)


@pytest.fixture(params=SIZES, ids=str)
def size(request):
    return request.param


def test_every_short_sound_of_a_day_is_seen_in_its_lane(browser, short_sounds, size, tmp_path):
    report = Report(browser, short_sounds, size, tmp_path)
    lanes = []
    for name, spans in SOUGHT.items():
        marks = report.marks(name)
        rows = np.flatnonzero(marks.any(axis=1))
        assert 8 <= len(rows) == np.ptp(rows) + 1 < 30, f"{name} is in one lane"
        lanes.append((rows[0], rows[-1]))
        elsewhere = marks.any(axis=0)
        for start, seconds in spans:
            first, last = int(report.place(start)), int(report.place(start + seconds))
            near = slice(first - 2, last + 3)
            assert marks[:, near].sum(axis=0).max() >= 8, f"{name} at {start / HOUR:.2f} h"
            elsewhere[near] = False
        assert not elsewhere.any(), f"{name} where there was none"
    lanes.sort()
    assert all(one[1] < other[0] for one, other in pairwise(lanes))


def test_two_sounds_that_are_two_pixels_apart_are_two_marks(browser, size, tmp_path):
    times = [at("10:00:01"), at("10:04:05"), at("15:01:59"), at("15:06:03")]
    events = [(time, 1, "yelling", 0.9) for time in times]
    write_day(tmp_path / "logs", DAY, events, classes=GENERAL)
    report = Report(browser, tmp_path / "logs", size, tmp_path)
    for one, other in (times[:2], times[2:]):
        assert 2 <= report.place(other) - report.place(one) < 2.1
    columns = report.marks("yelling").any(axis=0)
    assert np.count_nonzero(np.diff(columns.astype(int)) == 1) == len(times)


def test_the_hours_of_a_day_are_written_below_it(browser, short_sounds, size, tmp_path):
    report = Report(browser, short_sounds, size, tmp_path)
    dark = report.image.max(axis=2) < 120
    bars = (report.image == NIGHT).all(axis=2)[:, int(report.place(HOUR))]
    line = np.flatnonzero(bars)[-1]
    below = dark[line + 2 : line + 20]
    places = [report.place(hour * HOUR) for hour in range(0, 24, 2)]
    for place in places:
        number = below[:, round(place) - 10 : round(place) + 11]
        rows, columns = np.nonzero(number)
        assert np.ptp(rows) >= 7, "as high as words on the page"
        assert 8 <= np.ptp(columns) <= 16, "two digits, and nothing at their sides"
    between = [round((one + other) / 2) for one, other in pairwise(places)]
    assert not below[:, between].any()
