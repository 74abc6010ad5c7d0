"""The page of the home in a browser: its picture and table at each width, and the week."""

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest
from homelife import at, midnight, write_day
from servedhome import PALE_TEXTS

pytest.importorskip("hearthlog.tools.lab.pictures", reason="the wheel leaves the lab out")

from hearthlog.analyzer.bridge.page import translation_for
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.lab.pictures.pages import served_page

DAY = datetime(2026, 5, 5, tzinfo=UTC).date()
LATE = at("23:30")  # the current day has a count of its evening, too
HEIGHTS = """
((words, kind) => {
  const lane = [...document.querySelectorAll(".lane")]
    .find((e) => e.querySelector(".name").textContent.startsWith(words));
  return Math.round(lane.querySelector(kind).getBBox().height);
})
"""


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """A home late in the evening, with counts of three digits, and the day before."""
    folder = tmp_path_factory.mktemp("late")
    talking = [(at("19:00") + 60 * n, 3.0, "speech", 0.9) for n in range(60)]
    coughs = [(at(text), 1.0, "coughing", 0.9) for text in ("02:40", "11:28", "15:45", "23:04")]
    coughs += [(at("08:00") + 300 * n, 1.0, "coughing", 0.6) for n in range(19)]
    coughs += [(at(text), 1.0, "coughing", 0.6) for text in ("22:20", "22:50")]
    busy = [(at("12:00") + 20 * n, 2.0, "objects_activity", 0.6 + n % 5 / 10) for n in range(300)]
    rings = [(at("17:00"), 8.0, "phone_ring", 0.9), (at("19:30:30"), 4.0, "phone_ring", 0.9)]
    shout = [(at("19:40:30"), 2.0, "yelling", 0.9)]
    write_day(folder, DAY - timedelta(days=1), [*talking, *shout, *coughs[:3]])
    write_day(folder, DAY, [*talking, *coughs, *busy, *rings], hours=range(23))
    with served_page(folder, UTC, midnight(DAY) + round(LATE * NANOSECONDS)) as page:
        yield page


@pytest.fixture
def show(phone, late):
    def open_page(width, language="en", scheme="light"):
        agent = phone.of("navigator.userAgent")
        phone._browser.call(
            "Emulation.setUserAgentOverride", userAgent=agent, acceptLanguage=language
        )
        phone.open(SimpleNamespace(url=late.address), width, 844, scheme)
        phone.until("document.querySelectorAll('.lane').length > 2")
        phone.until("document.getElementById('dates').options.length > 1")

    yield open_page
    agent = phone.of("navigator.userAgent")
    phone._browser.call("Emulation.setUserAgentOverride", userAgent=agent, acceptLanguage="en")


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("width", [360, 390, 700])
def test_an_evening_with_its_own_column_fits(phone, show, width, language):
    show(width, language)
    heads = phone.of("[...document.querySelectorAll('thead th')].map((e) => e.innerText)")
    assert len(heads) == 5
    assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    # No text of a cell lies in the next one.
    over = phone.of(
        "[...document.querySelectorAll('th, td')].filter((cell) => { const own = new Range();"
        "const { right } = cell.getBoundingClientRect();"
        "const texts = [...cell.querySelectorAll('*:not(.hidden)')].flatMap((e) =>"
        "[...e.childNodes].filter((each) => each.nodeType === Node.TEXT_NODE));"
        "return texts.some((text) => { own.selectNodeContents(text);"
        "return own.getBoundingClientRect().right > right + 1; }); }).map((e) => e.innerText)"
    )
    assert over == []
    assert phone.of("seen") == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1366])
def test_what_is_not_sure_is_half_as_high_and_what_does_not_count_is_pale(
    phone, show, width, scheme
):
    show(width, scheme=scheme)
    full = 20 if width < 700 else 30
    kinds = (".marks:not(.pale, .unsure)", ".unsure")
    for words in ("Coughing", "Household"):
        sure, unsure = (phone.of(f"{HEIGHTS}('{words}', '{kind}')") for kind in kinds)
        assert (sure, unsure) == (full, full / 2)
    assert phone.of(f"{HEIGHTS}('Telephone', '.pale')") == full
    style = (
        "(({fill, fillOpacity}) => [fill, fillOpacity])(getComputedStyle(%s.querySelector('%s')))"
    )
    lane = "[...document.querySelectorAll('.lane')].find((e) => e.textContent.startsWith('%s'))"
    (solid, full_opacity), (other, _) = (phone.of(style % (lane % "Cou", each)) for each in kinds)
    assert solid == other
    assert float(full_opacity) == 1
    assert 0.2 < float(phone.of(style % (lane % "Tel", ".pale"))[1]) < 0.6
    widths = phone.of(
        "[...document.querySelectorAll('.lane path.marks')].flatMap((path) =>"
        "[...path.getAttribute('d').matchAll(/h([\\d.]+)/g)].map((each) => Number(each[1])))"
    )
    assert min(widths) >= 4
    assert not phone.of("document.getElementById('key-unsure').hidden")


@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("width", [700, 1366])
def test_on_a_screen_names_and_counts_are_left_of_the_picture(phone, show, width, language):
    show(width, language)
    left = phone.of("document.querySelector('.ground').getBoundingClientRect().left")
    texts = phone.of(
        "[...document.querySelectorAll('.lane text')].map((e) => e.getBoundingClientRect().right)"
    )
    assert len(texts) > 6
    assert max(texts) < left
    svg, hours = (
        phone.of(
            f"Math.max(...[...document.querySelectorAll('{each}')]"
            ".map((e) => e.getBoundingClientRect().right))"
        )
        for each in (".picture", ".hours text")
    )
    assert hours <= svg
    show(390, language)
    drawn = phone.of(
        "[...document.querySelectorAll('.lane')].map((e) =>"
        "['.name', '.count', '.marks:last-of-type']"
        ".map((each) => e.querySelector(each).getBoundingClientRect())"
        ".map(({ top, bottom, height }) => [top, bottom, height]))"
    )
    assert all(max(name[1], figure[1]) - 1 <= marks[0] for name, figure, marks in drawn if marks[2])


def test_a_day_of_the_week_is_marked_and_its_title_lies_above_its_sentence(phone, show):
    show(390)
    assert phone.of("document.getElementById('date').classList.contains('hidden')")
    phone.of("document.getElementById('show-week').click()")
    phone.until("document.querySelectorAll('#week .marks').length > 6")
    chosen = "document.querySelector('#week button[aria-current=true] .what').innerText"
    assert phone.of(chosen) == "Today"
    phone.of("document.querySelectorAll('#week button')[1].click()")
    phone.shows("#date", "Monday, 4 May")
    phone.until("document.activeElement.id === 'date'")
    assert phone.of(chosen) == "Mon, 4 May"
    assert phone.of("document.querySelectorAll('#week [aria-current=true]').length") == 1
    tops = phone.of(
        "['#week', '#date', '#day-sentence', '.picture'].map((each) =>"
        "document.querySelector(each).getBoundingClientRect().top)"
    )
    assert tops == sorted(tops)
    assert -1 <= tops[1] < 200, "one is taken there"
    below = phone.of(
        "(([from]) => { const all = [...document.querySelectorAll('#day p, #day .what, #day h2')]"
        ".filter((e) => e.getClientRects().length); return all[all.indexOf(from) + 1].innerText; })"
        "([document.getElementById('day-sentence')])"
    )
    assert "Today" not in below
    assert phone.of(PALE_TEXTS) == []
    assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    phone.of("document.getElementById('show-week').click()")
    assert phone.of("document.getElementById('date').classList.contains('hidden')")
    assert phone.of("seen") == []


def test_a_week_compares_nights_and_days_and_a_day_is_drawn_when_it_is_chosen(phone, show):
    show(390)
    phone.of("document.getElementById('show-week').click()")
    phone.until("document.querySelectorAll('#week .marks').length > 6")
    shown = (
        "['#day-sentence', '#rooms', '#counts', '#looked-at', '#sounds', '#dates']"
        ".map((e) => document.querySelector(e).offsetHeight > 0)"
    )
    assert phone.of(shown) == [False] * 6
    today = phone.text("#week .about").replace("\u2009", " ")
    assert "Coughing: night 1, day 2 (+19?), after 22:00 2?" in today
    assert "Something like a television, 18:58 to 20:02." in today
    assert phone.text("#week .note").startswith("2 days so far.")
    assert phone.text("#show-week") == "\N{SINGLE LEFT-POINTING ANGLE QUOTATION MARK} Back"
    phone.of("document.querySelectorAll('#week button')[1].click()")
    phone.shows("#date", "Monday, 4 May")
    assert phone.of(shown) == [True] * 6
    assert phone.of("document.querySelector('.picture').viewBox.baseVal.width") > 250
    phone.of("document.getElementById('show-week').click()")
    phone.of("document.getElementById('show-week').click()")
    assert phone.of(shown) == [False] * 6
    phone.resize(600, 844)  # what is not shown has no width to be drawn in
    phone.of("document.getElementById('show-week').click()")
    assert phone.of(shown) == [True] * 6
    assert phone.of("document.querySelector('.picture').viewBox.baseVal.width") > 450


def test_the_hours_of_a_week_lie_below_those_of_its_days(phone, show):
    show(390)
    phone.of("document.getElementById('show-week').click()")
    phone.until("document.querySelectorAll('#week .axis span').length")
    assert phone.of("document.querySelector('#week .axis').innerText.split(/\\s+/)") == [
        *("00", "06", "12", "18"),
    ]
    places = phone.of(
        "(({ left, width }) => [...document.querySelectorAll('#week .axis span')].map((each) => {"
        "const box = each.getBoundingClientRect();"
        "return (box.left + box.width / 2 - left) / width;"
        "}))(document.querySelector('#week svg').getBoundingClientRect())"
    )
    assert np.abs(np.array(places) - (np.array([0, 6, 12, 18]) + 2) / 26).max() < 0.01


def test_a_day_of_the_week_has_a_lane_for_each_class_in_the_order_of_the_key(phone, show):
    show(390)
    phone.of("document.getElementById('show-week').click()")
    phone.until("document.querySelectorAll('#week .axis span').length")
    phone.until("document.querySelectorAll('#week .about')[1].textContent")
    key = phone.of(
        "[...document.querySelectorAll('#week .note .entry:has(.swatch)')].map((e) => e.innerText)"
    )
    assert [text.strip() for text in key] == [
        *("Coughing", "Shouting", "Telephone ringing", "Talking", "Household sounds"),
    ]
    colours = "getComputedStyle({}).getPropertyValue('--class')"
    lanes = phone.of(
        "[...document.querySelectorAll('#week svg')].map((svg) =>"
        "[...svg.querySelectorAll('.marks')].filter((e) => e.getAttribute('d'))"
        f".map((e) => [Math.round(e.getBBox().y + e.getBBox().height), {colours.format('e')}]))"
    )
    of_key = phone.of(
        f"[...document.querySelectorAll('#week .swatch')].map((e) => {colours.format('e')})"
    )
    assert len(lanes) == 2
    for day in lanes:
        assert day
        for foot, colour in day:
            assert of_key.index(colour) == foot / 12 - 1


def test_a_class_with_marks_of_a_television_alone_has_a_count_of_0_and_says_so(phone, show):
    show(1366)
    phone.of("document.getElementById('day-before').click()")
    phone.until(
        "document.getElementById('day-sentence').dataset.date"
        " === document.getElementById('dates').options[1].value"
    )
    phone.shows("#tables", "TV: 1")
    phone.shows("#counts-key", "TV: beside something like a television, not counted")
    row = "[...document.querySelectorAll('tbody tr')].find((e) => e.innerText.startsWith('Shout'))"
    cells = phone.of(f"[...{row}.cells].map((e) => e.innerText.replaceAll('\\u00a0', ' '))")
    assert cells == ["Shouting\n, 1 beside a television\nTV: 1", "0", "0", "\N{EN DASH}"]
    lane = (
        "[...document.querySelectorAll('.lane')]"
        ".find((e) => e.querySelector('.name').textContent === 'Shouting')"
    )
    figure = phone.of(f"{lane}.querySelector('.count').textContent.replaceAll('\\u00a0', ' ')")
    assert figure == "0"
    phone.of(f"{lane}.dispatchEvent(new MouseEvent('click'))")
    phone.shows(".panel", "Not once. 1 beside a television, not counted (19:40).")
    names = phone.of("document.querySelector('button.zero').innerText")
    assert translation_for("en").class_words("unknown").lower() not in names
    assert phone.of("seen") == []


def test_what_is_not_sure_has_a_question_mark_in_the_folded_list_too(phone, show):
    show(390)
    phone.shows("#look .fold", "?) earlier")
    about = phone.text("#look .fold .about")
    assert "02:40" in about.split(", ")
    assert any(each.endswith("?") for each in about.split(", ")), about


def test_sounds_beside_a_television_are_behind_one_tap(phone, show):
    show(390)
    phone.shows(
        "#events .fold .what", "Beside something like a television · 61 sounds, not counted"
    )
    about = phone.text("#events .fold .about").replace("\u00a0", " ")
    assert about == "19:00 to 19:59 · Talking 60, Telephone ringing 1", about
    beside = (
        "[...document.querySelectorAll('#events > li')]"
        ".filter((e) => e.innerText.includes('beside a television')).length"
    )
    assert phone.of(beside) == 0
    button = "document.querySelector('#events button.fold')"
    phone.of(f"{button}.click()")
    assert phone.of(beside) == 3, "a bout has fifty sounds at most"
    assert phone.of(f"{button}.getAttribute('aria-expanded')") == "true"
    phone.of(f"{button}.click()")
    assert phone.of(beside) == 0
    assert phone.of("seen") == []


def test_a_screen_reader_has_counts_in_words_and_no_sign_of_an_empty_status(phone, show):
    show(390)
    names = phone.of(
        "[...document.querySelectorAll('td button[aria-label]')].map((e) => e.ariaLabel)"
    )
    coughing = [name for name in names if name.startswith("Coughing, ")]
    assert [name.rpartition(": ")[2] for name in coughing] == [
        "1",
        "2, perhaps 19 more",
        "perhaps 2",
    ]
    lanes = phone.of("[...document.querySelectorAll('.lane')].map((e) => e.ariaLabel)")
    (lane,) = (name for name in lanes if name.startswith("Coughing"))
    assert "3 times, perhaps 21 more since yesterday evening" in lane
    fold = phone.of("document.querySelector('#look button.fold').ariaLabel")
    assert "perhaps" in fold
    assert not set("()?+") & set("".join(names) + lane + fold)
    assert phone.of("document.querySelectorAll('[role=status]').length") == 0
    heads = phone.of(
        "[...document.querySelectorAll('tbody th')].map((e) => { const read = e.cloneNode(true);"
        "read.querySelectorAll('[aria-hidden]').forEach((each) => each.remove());"
        "return read.textContent; })"
    )
    assert "Talking, 60\u00a0beside a television" in heads


def test_an_evening_of_television_leaves_the_sounds_of_the_day_in_the_list(phone, tmp_path):
    bursts = [(at("18:00") + 300 * n, 170, ("speech", "music")[n % 2], 0.9) for n in range(46)]
    busy = [(at(f"{hour:02}:00"), 5, "objects_activity", 0.9) for hour in range(9, 15)]
    write_day(tmp_path, DAY, [*busy, *bursts], hours=range(22))
    now = midnight(DAY) + round(at("21:59") * NANOSECONDS)
    with served_page(tmp_path, UTC, now) as page:
        phone.open(SimpleNamespace(url=page.address), 390, 844, "light")
        phone.shows("#events .fold .what", "20 sounds, not counted")
        assert phone.text("#all-events").replace("\u00a0", " ") == "Show 2 more"


def test_a_telephone_that_may_have_rung_is_not_among_what_there_was_not_once(phone, tmp_path):
    sounds = [(at("10:00"), 4, "phone_ring", 0.6), (at("11:00"), 4, "coughing", 0.9)]
    write_day(tmp_path, DAY - timedelta(days=1), [(at("12:00"), 4, "crying", 0.9)])
    write_day(tmp_path, DAY, sounds, hours=range(14))
    with served_page(tmp_path, UTC, midnight(DAY) + round(at("13:59") * NANOSECONDS)) as page:
        phone.open(SimpleNamespace(url=page.address), 390, 844, "light")
        phone.shows("button.zero", "crying")
        assert phone.text("button.zero") == (
            "Not once: crying. Perhaps: telephone ringing; counted as not recognised"
        )
