"""The sounds that recur, on the page of the home: what it says of them, and names for them."""

import json
import os
import shutil
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hypothesis import given, settings
from hypothesis import strategies as st
from recurring import record_recurring
from servedhome import PALE_TEXTS, serving
from viewers import patiently

from hearthlog.analyzer.bridge.corrections import REVIEWER
from hearthlog.analyzer.bridge.page import recurring as group_naming
from hearthlog.analyzer.bridge.page.recurring import (
    GroupNaming,
    Moment,
    RecurringSounds,
    recurring_list,
)
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.discover import (
    SUMMARY,
    Example,
    GroupsSummary,
    GroupSummary,
    load_summary,
    save_summary,
    summary_path,
)
from hearthlog.analyzer.discover.groups import GROUPS
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs

NOW = int(datetime(2026, 3, 3, 12, tzinfo=UTC).timestamp()) * NANOSECONDS
MOMENT = Moment(NOW, UTC)
KEY = "3 of 5b4e0d1c"
HOSTILE = '<img src=x onerror="document.title=1">'


def group(number, name="", times=84, *, microphones=("mic",), **changes):
    hours = [0] * 24
    hours[8] = times
    examples = [
        Example(
            log="a.mcap",
            microphone=microphones[0],
            start=f"2026-03-0{day}T08:07:5{day}Z",
            end=f"2026-03-0{day}T08:07:59Z",
        )
        for day in (3, 1, 2)
    ]
    fields = {
        "days": 2,
        "hours": hours,
        "seconds": 1.7,
        "alike": 0.74,
        "labels": {"yelling": 0.62, "phone_ring": 0.31, "music": 0.07},
        "microphones": list(microphones),
        "examples": examples,
    }
    return GroupSummary(number=number, name=name, times=times, **(fields | changes))


def summary_of(*groups, of="5b4e0d1c"):
    return GroupsSummary(
        id=of, sounds=1000, timezone="UTC", groups_file=GROUPS.file, groups=list(groups)
    )


def keep(folder, *groups, **options):
    folder.mkdir(exist_ok=True)
    save_summary(summary_of(*groups, **options), folder / SUMMARY)


# What is said of them


def test_a_sound_that_recurs_is_described_in_words():
    shown = recurring_list(
        summary_of(group(4)), NOW - 3600 * NANOSECONDS, {"4 of 5b4e0d1c": "so"}, MOMENT
    )
    assert shown["looked"] == "11:00"
    assert shown["groups"] == [
        {
            "id": "4 of 5b4e0d1c",
            "words": "Sound 4",
            "is_named": False,
            "about": "84 times on 2 days, mostly between 08 and 09 o'clock, 2 seconds each",
            "heard": "Heard as Shouting (62\N{NO-BREAK SPACE}%) or Telephone ringing "
            "(31\N{NO-BREAK SPACE}%)",
            "listen": "For instance 1 March 08:07:51, yesterday 08:07:52 and 08:07:53",
            "said": "so",
        }
    ]


def test_those_without_a_name_come_first_and_ten_of_them_at_a_time():
    named = [group(number, "kettle") for number in range(1, 4)]
    unnamed = [group(number) for number in range(4, 20)]
    shown = recurring_list(summary_of(*named, *unnamed), NOW, {}, MOMENT)
    words = [each["words"] for each in shown["groups"]]
    assert words == [*(f"Sound {number}" for number in range(4, 14)), *["Kettle"] * 3]
    assert shown["more"] == "6 more without a name will follow."


def test_rooms_are_named_where_there_are_several():
    home = summary_of(group(1), group(2, microphones=("bath_room",)))
    shown = recurring_list(home, NOW, {}, MOMENT)["groups"]
    assert "08:07:53 (Mic)" in shown[0]["listen"]
    assert "08:07:53 (Bath room)" in shown[1]["listen"]


def test_a_summary_from_the_future_is_of_now():
    for looked in (-(1 << 70), 1 << 80):
        assert recurring_list(summary_of(group(1)), looked, {}, MOMENT)["looked"]


def test_without_a_summary_there_is_nothing_and_a_new_one_is_seen(tmp_path):
    recurring = RecurringSounds(tmp_path)
    assert recurring.describe(MOMENT)["groups"] == []
    keep(tmp_path, group(1))
    assert [each["words"] for each in recurring.describe(MOMENT)["groups"]] == ["Sound 1"]
    keep(tmp_path, group(1, "door_bell"))
    assert [each["words"] for each in recurring.describe(MOMENT)["groups"]] == ["Door bell"]
    (tmp_path / SUMMARY).unlink()
    assert recurring.describe(MOMENT)["groups"] == []
    assert recurring.problem == ""


def test_the_summary_lies_beside_the_groups():
    assert summary_path(Path(GROUPS.file)).name == SUMMARY


# Files that are none


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"\xff",
        b"[" * 100_000,
        b" " * (5 << 20),
        summary_of(group(1)).model_dump_json().replace("0.62", "NaN").encode(),
        summary_of(group(1)).model_dump_json().replace("2026-03-01", "9999-12-31").encode(),
        summary_of(group(1)).model_dump_json().replace('"format":1', '"format":2').encode(),
        summary_of(group(1)).model_dump_json().replace('"name":""', '"name":"a\\u0000"').encode(),
    ],
    ids=range(9),
)
def test_a_file_that_is_no_summary_is_one_line_among_what_needs_a_look(tmp_path, content):
    (tmp_path / SUMMARY).write_bytes(content)
    recurring = RecurringSounds(tmp_path)
    assert recurring.describe(MOMENT)["groups"] == []
    assert recurring.problem.startswith(f"{tmp_path / SUMMARY}: ")
    assert "\n" not in recurring.problem
    keep(tmp_path, group(1))
    assert recurring.describe(MOMENT)["groups"]
    assert recurring.problem == ""


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_a_damaged_summary_is_shown_or_refused_and_nothing_else(tmp_path_factory, data):
    content = bytearray(summary_of(group(1), group(2, "kettle")).model_dump_json().encode())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("damaged")
    (folder / SUMMARY).write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    recurring = RecurringSounds(folder)
    shown = json.dumps(recurring.describe(MOMENT), allow_nan=False)
    assert bool(recurring.problem) == ("Sound 1" not in shown and "Kettle" not in shown)


def test_a_pipe_in_place_of_the_summary_holds_nobody_up(tmp_path):
    os.mkfifo(tmp_path / SUMMARY)
    recurring = RecurringSounds(tmp_path)
    recurring.describe(MOMENT)
    assert "Not a regular file" in recurring.problem


# The process that names


def acting(monkeypatch, text):
    """Let a few lines of Python stand for the command."""
    monkeypatch.setattr(group_naming, "module_command", lambda _: [sys.executable, "-c", text])


@pytest.mark.parametrize(
    ("acts", "states"),
    [
        (
            "print('hearthlog: group 3: 7 marks of a; 1 are marked'); print('hearthlog: next')",
            "7 marks of a; 1 are marked",
        ),
        (
            "print('hearthlog: group 3: 7 marks of a'); print('hearthlog: x: is cut'); sys.exit(3)",
            "7 marks of a; some logs could not be read: x: is cut",
        ),
        ("print('hearthlog: no group 3'); sys.exit(1)", "This failed: no group 3"),
        ("sys.exit(4)", "This failed: exit status 4"),
        ("print('x' * 100_000_000); sys.exit(1)", "This failed: xxx"),
        ("import os; os.kill(os.getpid(), 9)", "ended by signal 9"),
    ],
)
def test_what_came_of_a_name_is_one_line(tmp_path, monkeypatch, acts, states):
    acting(monkeypatch, f"import sys; sys.stdout = sys.stderr; {acts}")
    naming = GroupNaming(tmp_path)
    assert naming.start(KEY, 3, "kettle").startswith("Marking as Kettle.")
    answer = patiently(lambda: naming.outcomes[KEY], lambda text: "Marking as" not in text)
    assert states in answer
    assert len(answer) < 500


def test_one_group_is_named_at_a_time_and_an_end_of_the_bridge_is_one_of_that(
    tmp_path, monkeypatch
):
    acting(monkeypatch, "import time; time.sleep(600)")
    naming = GroupNaming(tmp_path)
    naming.start(KEY, 3, "")
    with pytest.raises(BridgeError, match="still marking another sound"):
        naming.start("4 of 5b4e0d1c", 4, "kettle")
    assert naming.outcomes.keys() == {KEY}
    naming.close()
    patiently(lambda: naming.outcomes[KEY], lambda text: "ended by signal 15" in text)
    acting(monkeypatch, "")
    naming.start("4 of 5b4e0d1c", 4, "kettle")


def test_what_came_of_a_name_is_not_said_of_a_group_of_another_file(tmp_path, monkeypatch):
    acting(monkeypatch, "import sys; sys.exit(4)")
    keep(tmp_path, group(3))
    recurring = RecurringSounds(tmp_path)
    recurring.describe(MOMENT)
    recurring.name(KEY, "kettle")

    def output():
        return [each["said"] for each in recurring.describe(MOMENT)["groups"]]

    patiently(output, lambda texts: texts == ["This failed: exit status 4"])
    keep(tmp_path, group(3), of="00c0ffee")
    assert output() == [""]
    keep(tmp_path, group(3))
    assert output() == ["This failed: exit status 4"]


def test_a_folder_that_may_only_be_read_is_said_to_be_so(tmp_path, monkeypatch):
    monkeypatch.setattr(group_naming.os, "access", lambda *_: False)
    with pytest.raises(BridgeError, match="may only read the folder of logs"):
        GroupNaming(tmp_path).start(KEY, 3, "kettle")


@pytest.mark.parametrize(
    ("key", "text", "states"),
    [
        ("1 of 00000000", "kettle", "regrouped"),
        ("2 of 5b4e0d1c", "kettle", "regrouped"),
        ("--undo", "", "regrouped"),
        ("1 of 5b4e0d1c", "silence", "cannot be named silence"),
        ("1 of 5b4e0d1c", "; rm -rf /", "letters a to z"),
        ("1 of 5b4e0d1c", " ", "letters a to z"),
    ],
)
def test_what_cannot_be_a_name_starts_nothing(tmp_path, monkeypatch, key, text, states):
    monkeypatch.setattr(group_naming, "module_command", pytest.fail)
    keep(tmp_path, group(1))
    recurring = RecurringSounds(tmp_path)
    recurring.describe(MOMENT)
    with pytest.raises(BridgeError, match=states):
        recurring.name(key, text)


# In a browser, with sounds


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Logs of some minutes in which sounds recur."""
    folder = tmp_path_factory.mktemp("recorded") / "logs"
    record_recurring(folder, 1_772_352_000 * NANOSECONDS, seed=0, seconds=300)
    return folder


def marks_of(folder):
    return [mark for log in find_logs(folder) for mark in read_marks(log)]


def recorded_once(home):
    home.log.write_segment("coughing", 10)
    home.log.hears("coughing")


def test_one_names_a_sound_on_the_page_and_takes_the_name_back(
    phone, recorded, tmp_path, hearthlog
):
    logs = shutil.copytree(recorded, tmp_path / "logs")
    assert hearthlog("discover", logs).returncode == 0
    before = load_summary(logs / SUMMARY)
    largest = before.groups[0]
    with serving(tmp_path) as home:
        recorded_once(home)
        phone.open(home)
        phone.shows("#recurring li:first-child .what", f"Sound {largest.number}")
        assert f"{largest.times} times on 1 day" in phone.text("#recurring li:first-child")
        phone.of('document.querySelector("#recurring summary").click()')
        phone.until('document.querySelector("#recurring input[type=text]")')
        phone.of('document.querySelector("#recurring input[type=text]").focus()')
        phone.write("Door bell")
        phone.press("Enter", "\r")
        phone.shows("#recurring li:last-child .what", "Door bell")
        phone.shows("#recurring li:last-child .said", f"{largest.times} marks of door_bell")
        marks = marks_of(logs)
        reason = f"group {largest.number} of {before.id}"
        assert {mark[3:5] + mark[7:] for mark in marks} == {("door_bell", REVIEWER, reason)}
        assert len(marks) == largest.times
        phone.of('document.querySelector("#recurring li:last-child .back").click()')
        phone.shows("#recurring li:first-child .what", f"Sound {largest.number}")
        phone.shows("#recurring li:first-child .said", f"{largest.times} marks taken back")
        assert marks_of(logs) == []
        assert load_summary(logs / SUMMARY) == before
        assert phone.of("seen") == []


@pytest.fixture(scope="module")
def listed(tmp_path_factory):
    """A home with a list of sounds that recur, of all kinds."""
    folder = tmp_path_factory.mktemp("listed")
    hostile = group(3, microphones=(HOSTILE,), labels={HOSTILE: 0.5, "w" * 200: 0.5})
    keep(folder / "logs", group(1), group(2, "k" * 64), hostile)
    with serving(folder) as home:
        recorded_once(home)
        yield home


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(390, 844), (1366, 768)], ids=str)
def test_the_list_fits_the_screen_and_is_text_whatever_it_has(phone, listed, size, scheme):
    phone.open(listed, *size, scheme)
    phone.until('document.querySelectorAll("#recurring li").length === 3')
    phone.of('document.querySelectorAll("#recurring summary").forEach((e) => e.click())')
    phone.until('document.querySelectorAll("#recurring fieldset").length === 3')
    assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    assert phone.of(PALE_TEXTS) == []
    assert HOSTILE.capitalize()[:20] in phone.text("#recurring")
    assert phone.of('document.querySelectorAll("img").length') == 0
    assert phone.of("seen") == []


def test_a_screen_reader_is_told_which_sound_each_button_is_of(phone, listed):
    phone.open(listed)
    phone.until('document.querySelectorAll("#recurring li").length === 3')
    tree = phone.tree()
    assert ("region", "Recurring sounds") in tree
    buttons = [name for role, name in tree if role in {"button", "DisclosureTriangle"}]
    assert len({*buttons}) == len(buttons)
    assert "That was … (Sound 1)" in buttons
    assert any(name.startswith("Take back the name Kkkk") for name in buttons)


def test_the_list_is_not_there_before_sounds_were_grouped_and_a_damaged_one_is_a_line(
    phone, tmp_path
):
    with serving(tmp_path) as home:
        recorded_once(home)
        phone.open(home)
        phone.of('document.querySelector("#working").open = true')
        phone.shows("#health", "Bridge: Good")
        assert phone.of('document.getElementById("recurs").hidden')
        (tmp_path / "logs" / SUMMARY).write_text("{")
        phone.shows("#health", "Recurring sounds: Needs a look (")
        assert "is no summary of groups; `hearthlog discover` writes it" in phone.text("#health")
        assert phone.of('document.getElementById("recurs").hidden')
        keep(tmp_path / "logs", group(1))
        phone.shows("#recurring", "Sound 1")


def test_a_form_that_somebody_fills_in_stays_when_sounds_are_grouped_anew(phone, tmp_path):
    keep(tmp_path / "logs", group(1), group(2))
    with serving(tmp_path) as home:
        recorded_once(home)
        phone.open(home)
        phone.until('document.querySelectorAll("#recurring li").length === 2')
        phone.of('document.querySelector("#recurring summary").click()')
        phone.until('document.querySelector("#recurring input[type=text]")')
        phone.of('document.querySelector("#recurring input[type=text]").focus()')
        phone.write("Kettle")
        keep(tmp_path / "logs", group(2), group(3), group(1))
        phone.until('document.querySelectorAll("#recurring li").length === 3')
        assert phone.focus() == "Kettle"


def test_another_page_names_nothing(listed):
    body = json.dumps({"group": "1 of 5b4e0d1c", "label": "kettle"})
    json_only = {"Content-Type": "application/json"}
    assert listed.request("POST", "/group", body, **json_only)[0] == 403
    foreign = {**json_only, "Origin": "http://evil.example"}
    assert listed.request("POST", "/group", body, **foreign)[0] == 403
    assert listed.post("/group", {"event": "1", "label": "kettle"})[0] == 400
    assert listed.post("/group", {"group": "9 of 5b4e0d1c", "label": "kettle"})[0] == 422
