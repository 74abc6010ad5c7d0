"""A report in a browser, as it opens: what one sees of a day without scrolling."""

import base64
import json
import re
from datetime import timedelta
from itertools import pairwise
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from homelife import GENERAL, HOUR, at, write_day
from shortsounds import DAY, SOUGHT, short_sounds
from viewers import browsing, pixels

from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.report.report import Period, make_report
from hearthlog.models.classes import colour

__all__ = ["short_sounds"]  # fixture

WHITE, NIGHT = (255, 255, 255), (0xE9, 0xEC, 0xF1)
SIZES = [(1366, 625), (1920, 937)]  # what a browser leaves of 1366 x 768, and of 1920 x 1080
_HALF = 0.4  # of a mark's colour, where the screen mixes it with what is beside it


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with browsing("about:blank", tmp_path_factory.mktemp("browser")) as page:
        yield page


def report_of(logs, folder, days=1, first=DAY):
    """Write a page, and return its address."""
    output = folder / "report.html"
    make_report(find_home_logs([logs]), Period(first, days, ZoneInfo("UTC")), output)
    return output.as_uri()


def set_size(browser, width, height, *, mobile=False):
    """Make the window of a browser as large as that of a device."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
    browser.call("Emulation.setDeviceMetricsOverride", **metrics)


class Report:
    """The opening view of a report on a day."""

    def __init__(self, browser, logs, size, folder):
        address = report_of(logs, folder)
        width, height = size
        set_size(browser, width, height)
        browser.open(address)
        png = browser.picture()
        (folder / "seen.png").write_bytes(png)
        self.image = pixels(png)
        assert self.image.shape == (height, width, 3)
        _, left, wide, _ = boxes(browser, ".day .row .strip")[0]
        self.start, self.end = round(left) + 1, round(left + wide) - 1
        assert self.end - self.start > width * 0.35

    def place(self, second):
        """The column of a second of the day."""
        return self.start + (second + 2 * HOUR) / (26 * HOUR) * (self.end - self.start)

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


def test_two_sounds_that_are_five_pixels_apart_are_two_marks(browser, size, tmp_path):
    times = [at("10:00:01"), at("10:11:12"), at("15:01:59"), at("15:13:10")]
    events = [(time, 1, "yelling", 0.9) for time in times]
    write_day(tmp_path / "logs", DAY, events, classes=GENERAL)
    report = Report(browser, tmp_path / "logs", size, tmp_path)
    for one, other in (times[:2], times[2:]):
        assert 5 <= report.place(other) - report.place(one) < 5.2
    columns = report.marks("yelling").any(axis=0)
    assert np.count_nonzero(np.diff(columns.astype(int)) == 1) == len(times)


def test_the_hours_of_a_day_are_written_below_it(browser, short_sounds, size, tmp_path):
    report = Report(browser, short_sounds, size, tmp_path)
    dark = report.image.max(axis=2) < 120
    bars = (report.image == NIGHT).all(axis=2)[:, int(report.place(HOUR))]
    rows = np.flatnonzero(bars)
    line = rows[np.argmax(np.diff(rows))]  # the next night is that of the bars
    below = dark[line + 2 : line + 20]
    places = [report.place(hour * HOUR) for hour in range(0, 24, 2)]
    for place in places:
        number = below[:, round(place) - 10 : round(place) + 11]
        rows, columns = np.nonzero(number)
        assert np.ptp(rows) >= 7, "as high as words on the page"
        assert 8 <= np.ptp(columns) <= 16, "two digits, and nothing at their sides"
    between = [round((one + other) / 2) for one, other in pairwise(places)]
    assert not below[:, between].any()


PHONE = 390, 844
_BOXES = """JSON.stringify([...document.querySelectorAll("%s")].filter(e => e.checkVisibility())
    .map(e => [e.textContent.trim(), e.getBoundingClientRect().left,
        e.getBoundingClientRect().width, parseFloat(getComputedStyle(e).fontSize)]))"""


def boxes(browser, selector):
    """Text, left edge, width and letter size of the elements that can be seen."""
    return json.loads(browser.evaluate(_BOXES % selector))


@pytest.mark.parametrize("days", [1, 7], ids=["day", "week"])
def test_on_a_phone_a_page_is_as_wide_as_the_screen_and_its_picture_can_be_read(
    browser, short_sounds, days, tmp_path
):
    set_size(browser, *PHONE, mobile=True)
    browser.open(report_of(short_sounds, tmp_path, days, DAY - timedelta(days=days - 1)))
    assert browser.evaluate("document.documentElement.scrollWidth") == PHONE[0]
    hours = boxes(browser, ".hours span")
    assert [text for text, *_ in hours] == ["00", "06", "12", "18"]
    names = boxes(browser, ".row .name")
    assert min(letters for *_, letters in hours + names if letters) >= 14
    assert len(boxes(browser, ".day > .row")) <= 14, "twelve lanes, hours and bars"
    assert all(width > PHONE[0] * 0.85 for _, _, width, _ in boxes(browser, ".strip"))


_TELEVISION = [(at("19:00") + 20 * n, 15, ("speech", "music")[n % 2], 0.9) for n in range(480)]
_DOUBTFUL = [
    (at("08:00") + 1200 * n, 2, name, 0.5 + 0.4 * (n % 3 == 0))
    for n in range(30)
    for name in ("coughing", "objects_activity")
]
_OUTSIDE = """JSON.stringify([...document.querySelectorAll("th, td, p, h1, h2, li, .name, .entry")]
    .filter(e => e.checkVisibility()).filter(e => {
        const range = document.createRange(), box = e.getBoundingClientRect();
        range.selectNodeContents(e);
        return [...range.getClientRects()].some(r => r.right > Math.min(innerWidth, box.right) + 1
            || r.left < box.left - 1 || r.bottom > box.bottom + 8);
    }).map(e => e.textContent.trim()))"""


@pytest.mark.parametrize("days", [1, 7], ids=["day", "week"])
def test_no_text_leaves_its_place_on_a_narrow_screen(browser, days, tmp_path):
    write_day(tmp_path / "logs", DAY, [*_TELEVISION, *_DOUBTFUL])
    address = report_of(tmp_path / "logs", tmp_path, days, DAY - timedelta(days=days - 1))
    for width in (360, 390, 600, 768):
        set_size(browser, width, 844, mobile=width < 600)
        browser.open(address)
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        assert json.loads(browser.evaluate(_OUTSIDE)) == [], width


def test_on_a_phone_a_week_has_its_days_once_above_columns_of_figures(browser, tmp_path):
    write_day(tmp_path / "logs", DAY, [*_TELEVISION, *_DOUBTFUL])
    write_day(tmp_path / "logs", DAY - timedelta(days=2), hours=range(22))
    set_size(browser, *PHONE, mobile=True)
    browser.open(report_of(tmp_path / "logs", tmp_path, 7, DAY - timedelta(days=6)))
    heads = boxes(browser, "table.wide:first-of-type thead th")
    days = [f"{day:%a} {day.day}" for day in (DAY - timedelta(days=n) for n in (2, 1, 0))]
    assert [text for text, *_ in heads][:4] == [*days, "All"]
    found = boxes(browser, "table.wide td")
    assert {round(left) for _, left, *_ in found} == {round(left) for _, left, *_ in heads}
    before = "getComputedStyle(document.querySelector('table.wide td'), '::before').content"
    assert browser.evaluate(before) == "none", "no day at each figure"
    names = boxes(browser, "table.wide tbody th")
    assert {round(width) for _, _, width, _ in names} == {PHONE[0] - 32}, "above its figures"
    text = browser.evaluate("document.body.textContent")
    assert "A dash: the box did not listen, or too little." in text


def test_a_phone_has_a_block_for_each_class_of_a_day_without_parts_in_which_there_was_none(
    browser, tmp_path
):
    write_day(tmp_path / "logs", DAY, [*_TELEVISION, *_DOUBTFUL])
    set_size(browser, *PHONE, mobile=True)
    browser.open(report_of(tmp_path / "logs", tmp_path))
    assert not boxes(browser, "table.sounds thead")
    lefts = {
        round(left)
        for _, left, *_ in boxes(
            browser, "table.sounds tbody th, table.sounds td:not(.count ~ .count)"
        )
    }
    assert not boxes(browser, "table.sounds td.zero"), "nothing to read"
    assert len(lefts) == 1, "below each other, but the counts of the parts of the day"


def test_no_table_of_a_printed_week_is_broken(browser, tmp_path):
    write_day(tmp_path / "logs", DAY, [*_TELEVISION, *_DOUBTFUL])
    browser.open(report_of(tmp_path / "logs", tmp_path, 7, DAY - timedelta(days=6)))
    browser.call("Emulation.setEmulatedMedia", media="print")
    try:
        breaks = "[...document.querySelectorAll('table')].map(e => getComputedStyle(e).breakInside)"
        assert {*json.loads(browser.evaluate(f"JSON.stringify({breaks})"))} == {"avoid"}
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")


def test_a_phone_shows_at_most_twelve_lanes(browser, tmp_path):
    classes = [*GENERAL, *(f"thing_{number}" for number in range(9))]
    names = [name for name in classes if name != "silence"]
    events = [(at("10:00") + 60 * n, 5, name, 0.9) for n, name in enumerate(names)]
    write_day(tmp_path / "logs", DAY, events, classes=classes)
    address = report_of(tmp_path / "logs", tmp_path)
    counts = []
    for width, height in (PHONE, SIZES[0]):
        set_size(browser, width, height)
        browser.open(address)
        names = [text for text, *_ in boxes(browser, ".day .row:not(.axis, .bars) .name")]
        counts.append(len(names))
    assert counts == [12, 17]


def test_only_sounds_that_were_heard_or_could_not_be_have_a_lane(browser, tmp_path):
    events = [(at("10:00"), 5, "coughing", 0.9), (at("12:00"), 5, "speech", 0.9)]
    write_day(tmp_path / "logs", DAY, events)
    browser.open(report_of(tmp_path / "logs", tmp_path))
    lanes = ".day .row:not(.axis, .bars) .name"
    assert [text for text, *_ in boxes(browser, lanes)] == ["Coughing", "Talking"]
    bath = {"classes": ["shower", "silence"], "microphone": "bath", "node": "bath"}
    write_day(tmp_path / "logs", DAY, hours=range(8), **bath)
    (tmp_path / "other").mkdir()
    browser.open(report_of(tmp_path / "logs", tmp_path / "other"))
    assert [text for text, *_ in boxes(browser, lanes)] == ["Coughing", "Talking", "Shower"]


def test_on_a_phone_no_number_of_minutes_touches_another_or_leaves_its_frame(browser, tmp_path):
    write_day(tmp_path / "logs", DAY, _TELEVISION)
    set_size(browser, *PHONE, mobile=True)
    browser.open(report_of(tmp_path / "logs", tmp_path))
    numbers = boxes(browser, ".bars b")
    assert numbers
    assert all(a + w < b for (_, a, w, _), (_, b, *_) in pairwise(numbers))
    top = "Math.min(...[...document.querySelectorAll('.bars b')].filter(e => e.checkVisibility())"
    top += ".map(e => e.getBoundingClientRect().top))"
    frame = "document.querySelector('.bars .strip').getBoundingClientRect().top"
    assert browser.evaluate(f"{top} - {frame}") >= 0
    set_size(browser, *SIZES[0])
    assert len(boxes(browser, ".bars b")) > len(numbers)


def test_the_minutes_of_sound_beside_a_television_are_pale_on_those_that_are_not(browser, tmp_path):
    other = [(at("19:10"), 600, "objects_activity", 0.9), (at("12:00"), 1200, "yelling", 0.9)]
    talking = [row for row in _TELEVISION if at("19:30") <= row[0] < at("20:00")]
    write_day(tmp_path / "logs", DAY, [*other, *talking])
    set_size(browser, *SIZES[0])
    browser.open(report_of(tmp_path / "logs", tmp_path))
    heights = "[...document.querySelectorAll('%s')].map(e => e.getBBox().height)"
    solid, pale = (
        json.loads(browser.evaluate(f"JSON.stringify({heights % selector})"))
        for selector in (".bar:not(.pale)", ".bar.pale")
    )
    assert solid[0] == pytest.approx(20, abs=0.2)
    assert len(pale) == 1, "the hour of the television"
    assert pale[0] >= 22.4
    assert sum(solid[1:]) + pale[0] == pytest.approx(32.5, abs=0.2)


@pytest.mark.parametrize("width", [390, 1366])
def test_a_short_sound_is_three_pixels_wide_and_a_long_one_as_long_as_it_was(
    browser, width, tmp_path
):
    events = [(at("03:00"), 1, "phone_ring", 0.9), (at("12:00"), 2 * HOUR, "phone_ring", 0.9)]
    write_day(tmp_path / "logs", DAY, events)
    set_size(browser, width, 1000)
    browser.open(report_of(tmp_path / "logs", tmp_path))
    (strip,) = {width for _, _, width, _ in boxes(browser, ".day .row:not(.axis, .bars) .strip")}
    image = pixels(browser.picture())
    yellow = (image[..., 0] > 180) & (image[..., 2] < 150) & (image[..., 1] > 180)
    row = yellow[:, int(width * 0.3) if width > 600 else 40 :]
    columns = row[np.argmax(row.sum(axis=1))]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], columns.astype(int), [0]])))
    short, long = np.diff(edges.reshape(-1, 2)).ravel()
    assert 2 <= short <= 4
    assert long == pytest.approx((strip - 2) * 2 / 26, abs=1.5)


def test_what_sounded_beside_a_television_is_pale_and_the_table_says_so(browser, tmp_path):
    talking = [(at("10:00") + 20 * i, 15, "speech", 0.9) for i in range(60)]
    coughs = [(at(t), 2, "coughing", 0.9) for t in ("10:05:16", "16:00:00")]
    write_day(tmp_path / "logs", DAY, [*talking, *coughs])
    report = Report(browser, tmp_path / "logs", SIZES[0], tmp_path)
    columns = np.flatnonzero(report.marks("coughing")[: report.image.shape[0]].any(axis=0))
    assert np.ptp(columns) <= 4, "only the cough that counts has the full colour"
    assert abs(columns.mean() - report.place(at("16:00"))) < 4
    text = browser.evaluate("document.body.textContent")
    assert "faint: beside a television, not counted" in text
    assert "1 beside a television" in text
    assert "Coughing once by day (16:00)." in text


@pytest.fixture(scope="module")
def evening(tmp_path_factory):
    """Logs of two hours and five minutes."""
    folder = tmp_path_factory.mktemp("evening") / "logs"
    gap = (at("20:05"), 55 * 60, "off")
    events = [(at("18:20"), 1, "phone_ring", 0.9), (at("19:00"), 1800, "phone_ring", 0.9)]
    write_day(folder, DAY, events, hours=[18, 19, 20], gaps=[gap])
    return folder


@pytest.mark.parametrize("width", [390, 1366])
def test_the_sounds_of_an_evening_are_drawn_as_wide_as_its_hours(browser, evening, width, tmp_path):
    set_size(browser, width, 1000, mobile=width < 600)
    browser.open(report_of(evening, tmp_path))
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    ticks = [text for text, *_ in boxes(browser, ".hours span")]
    assert ticks == (
        ["18:00", "19:00", "20:00"]
        if width < 600
        else [f"{hour}:{minute}" for hour in (18, 19, 20) for minute in ("00", "30")]
    )
    edges = boxes(browser, ".hours span")
    assert all(a + w < b for (_, a, w, _), (_, b, *_) in pairwise(edges)), "no tick over another"
    strip = boxes(browser, ".day .row:not(.axis, .bars) .strip")[0][2] - 2
    image = pixels(browser.picture())
    yellow = (image[..., 0] > 180) & (image[..., 2] < 150) & (image[..., 1] > 180)
    yellow[:, : 40 if width < 600 else int(width * 0.3)] = False  # names
    columns = yellow[np.argmax(yellow.sum(axis=1))]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], columns.astype(int), [0]]))).reshape(-1, 2)
    assert 2 <= np.diff(edges[0]) <= 4
    assert np.diff(edges[1]) == pytest.approx(strip / 6, abs=1.5)
    assert edges[1][0] - edges[0].mean() == pytest.approx(strip * 40 / 180, abs=2)
    (gap,) = {(left, width) for _, left, width, _ in boxes(browser, ".day .gap")}
    assert gap[1] == pytest.approx(strip * 55 / 180, abs=1)
    assert not boxes(browser, ".bars .gap"), "an hour of which five minutes were recorded"


def test_bars_stand_on_hatching_only_in_hours_without_a_record(browser, tmp_path):
    write_day(tmp_path / "logs", DAY, gaps=[(at("11:30"), 2.5 * HOUR, "off")])
    set_size(browser, *SIZES[0])
    browser.open(report_of(tmp_path / "logs", tmp_path))
    ((_, left, width, _),) = boxes(browser, ".bars .gap")
    (_, start, strip, _), *_ = boxes(browser, ".bars .strip")
    assert (left - start - 1) / (strip - 2) == pytest.approx(14 / 26, abs=0.002)
    assert width / (strip - 2) == pytest.approx(2 / 26, abs=0.002)


@pytest.mark.parametrize("logs", ["short_sounds", "evening"])
def test_a_printed_day_has_two_sheets_with_the_assessment(browser, logs, request, tmp_path):
    browser.open(report_of(request.getfixturevalue(logs), tmp_path))
    assert not boxes(browser, "details table")
    browser.call("Emulation.setEmulatedMedia", media="print")
    try:
        assert boxes(browser, "details table")
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")
    sheet = browser.call("Page.printToPDF", preferCSSPageSize=True)["data"]
    assert len(re.findall(rb"/Type\s*/Page\b", base64.b64decode(sheet))) == 2


_CONTRAST = """(() => {
    const channel = v => (v /= 255) <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
    const numbers = text => text.match(/[\\d.]+/g).map(Number);
    const light = ([r, g, b]) => .2126 * channel(r) + .7152 * channel(g) + .0722 * channel(b);
    const ground = e => {
        for (; e; e = e.parentElement) {
            const colour = numbers(getComputedStyle(e).backgroundColor);
            if (colour.length === 3) return colour;
        }
    };
    let least = 21;
    for (const e of document.querySelectorAll("h1, h2, p, td, th, small, b, .name, .hours span")) {
        const [a, b] = [numbers(getComputedStyle(e).color), ground(e)].map(light);
        least = Math.min(least, (Math.max(a, b) + .05) / (Math.min(a, b) + .05));
    }
    return least;
})()"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_words_of_a_page_stand_out_by_day_and_by_night(browser, short_sounds, scheme, tmp_path):
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.call("Emulation.setEmulatedMedia", features=[feature])
    try:
        browser.open(report_of(short_sounds, tmp_path))
        ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (ground == "rgb(255, 255, 255)") == (scheme == "light")
        assert browser.evaluate(_CONTRAST) >= 4.5
    finally:
        browser.call("Emulation.setEmulatedMedia", features=[])


def contrast_of(one, other):
    """The contrast of two colours, as WCAG has it."""
    shares = np.array([one, other]) / 255
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    low, high = sorted(linear @ (0.2126, 0.7152, 0.0722))
    return (high + 0.05) / (low + 0.05)


_PLACE = """(() => {
    const box = document.querySelector("%s").getBoundingClientRect();
    return JSON.stringify([box.left + box.width * %s, box.bottom - box.height * %s]);
})()"""


def colour_at(browser, image, selector, height=0.5, across=0.5):
    x, y = json.loads(browser.evaluate(_PLACE % (selector, across, height)))
    return image[int(y), int(x)]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_keys_and_swatches_have_the_colours_of_the_marks_by_day_and_by_night(
    browser, scheme, tmp_path
):
    things = [(at("12:00"), 1800, "objects_activity", 0.9), (at("20:10"), 180, "coughing", 0.9)]
    things += [(at("20:32"), 180, "objects_activity", 0.9), (at("09:00"), 900, "coughing", 0.6)]
    things += [(at("10:00"), 900, "coughing", 0.9)]
    talking = [(at("19:30") + 20 * i, 15, "speech", 0.9) for i in range(360)]
    talking = [row for row in talking if not any(a <= row[0] < a + b for a, b, *_ in things)]
    write_day(tmp_path / "logs", DAY, [*things, *talking])
    address = report_of(tmp_path / "logs", tmp_path)
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.call("Emulation.setEmulatedMedia", features=[feature])
    try:
        set_size(browser, 1366, 1000)
        browser.open(address)
        image = pixels(browser.picture())
        paper = image[2, 2]
        lane, household = ".row:nth-child(%d) g%s .long", 3
        swatches = ".row:nth-child(%d) .swatch"
        for row in (1, household):
            mark = colour_at(browser, image, lane % (row, ":not(.pale, .low)"))
            assert np.abs(colour_at(browser, image, swatches % row) - mark).max() <= 2
            pale = colour_at(browser, image, lane % (row, ".pale"))
            assert contrast_of(mark, pale) > 1.5, "told from what is not pale"
            if scheme == "dark":
                assert contrast_of(pale, paper) >= 3
        pale = colour_at(browser, image, lane % (1, ".pale"))
        assert np.abs(colour_at(browser, image, ".key.beside") - pale).max() <= 3
        low = colour_at(browser, image, lane % (1, ".low"))
        assert np.abs(colour_at(browser, image, ".key.low", 0.25, 0.8) - low).max() <= 3
    finally:
        browser.call("Emulation.setEmulatedMedia", features=[])
