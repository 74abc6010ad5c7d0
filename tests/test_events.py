"""`hearthlog events`: one line a sound, as many as the report counts."""

import json
import re
import subprocess
from collections import Counter
from datetime import date, timedelta
from functools import partial
from itertools import takewhile
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
import sounddevice
import soundfile
from conftest import HEARTHLOG
from homelife import BATHROOM, GENERAL, at, midnight, write_day
from log_fixtures import run
from waiting import wait_for

from hearthlog.analyzer.activity.daily_metrics import day_of, metrics_of_home
from hearthlog.analyzer.activity.home_data import read_home
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.review.session import listen
from hearthlog.analyzer.review.timeline import SoundClip
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs, is_layer

DAY = date(2026, 3, 2)
ZONE = ZoneInfo("Europe/Vienna")
_CLIPS = Path(__file__).parent / "data" / "household"


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


def found(hearthlog, *words):
    result = hearthlog("events", *words, "--json")
    assert result.returncode in {0, 3}, result.stderr
    return json.loads(result.stdout)


def rows(lines):
    """Return the cells of the table of totals, by sound, without bars."""
    (head,) = (place for place, line in enumerate(lines) if re.match(r"sound +length", line))
    table = {}
    for line in takewhile(lambda line: re.search(r" {2,}", line), lines[head + 1 :]):
        name, *cells = re.split(r" {2,}", re.sub(r"[█▏▎▍▌▋▊▉░]", " ", line))
        table[name] = cells
    return table


@pytest.fixture
def home(tmp_path):
    """Two days of two rooms: coughs at night, a television, gaps, a review."""
    logs = tmp_path / "logs"
    rng = np.random.default_rng(5)
    for day in (DAY - timedelta(days=1), DAY):
        evening = [
            (at("18:00") + 11 * n + rng.uniform(0, 3), rng.uniform(2, 6), label, 0.8)
            for n, label in enumerate(rng.choice(["speech", "music", "laughing", "yelling"], 300))
        ]
        kitchen = [
            (at("02:10:09"), 1.5, "coughing", 0.7),
            (at("02:10:20"), 2.0, "coughing", 0.9),
            (at("06:13"), 1.0, "coughing", 0.6),
            (at("09:00"), 40.0, "speech", 0.95),
            *evening,
            (at("23:59:58"), 4.0, "crying", 0.8),
        ]
        hall = [(at("09:00:30"), 30.0, "speech", 0.5), (at("12:00"), 3.0, "phone_ring", 0.99)]
        gaps = [(at("14:00"), 1800, "quiet hours")]
        write_day(logs, day, kitchen, microphone="kitchen", gaps=gaps, timezone="Europe/Vienna")
        write_day(logs, day, hall, node="hall", microphone="hall", timezone="Europe/Vienna")
    (log,) = [
        path for path in find_logs(logs) if not is_layer(path) and "home_20260302T06" in path.name
    ]
    begin = midnight(DAY) + int(at("06:00")) * NANOSECONDS
    cough = begin + 13 * 60 * NANOSECONDS
    mark = Mark("kitchen", cough, cough + NANOSECONDS, "crying")
    write_marks(log, [mark], reviewed=[ReviewedSpan("kitchen", begin, begin + 1800 * NANOSECONDS)])
    return logs


def day_metrics(logs, day=DAY):
    start, end = day_span(day, ZONE)
    before = day_span(day - timedelta(days=1), ZONE)[0]
    return day_of(
        metrics_of_home(read_home(find_home_logs([logs]), "live", before, (start, end))), day, ZONE
    )


def test_each_sound_that_the_report_counts_is_a_line(home, hearthlog):
    day = day_metrics(home).with_night
    listed = found(hearthlog, home, "--day", DAY)
    lines = Counter((event["label"], event["television"]) for event in listed["events"])
    assert {"coughing", "crying", "speech", "music", "phone_ring"} <= {name for name, _ in lines}
    assert lines["yelling", True] > 50
    for name in day.home.classes:
        if name != SILENCE:
            counts = listed["counts"].get(name, {"counted": 0, "television": 0, "unsure": 0})
            of_lines = {"counted": lines[name, False], "television": lines[name, True]}
            assert counts == {**of_lines, "unsure": day.count(name).unsure}
            assert counts["counted"] == day.count(name).labelled, name
            assert counts["television"] == day.uncounted_events(name), name
            seconds = {True: 0.0, False: 0.0}
            for event in listed["events"]:
                if event["label"] == name:
                    seconds[event["television"]] += event["seconds"]
            assert seconds[False] == pytest.approx(60 * day.minutes(name).minutes, abs=10), name
            assert seconds[True] == pytest.approx(60 * day.uncounted_minutes(name), abs=10), name
    assert listed["listened"] == pytest.approx(1, abs=1e-4), "the hall was listened to"


def test_lines_name_the_clock_of_the_home_and_end_their_figures_below_each_other(home, hearthlog):
    head, *lines = hearthlog("events", home, "--day", DAY).stdout.splitlines()
    assert re.match(r"when \(CET\) +sound ", head)
    rows = [line for line in lines if re.match(r"\d\d:\d\d:\d\d ", line)]
    lengths = {re.search(r"\d (s|min|h)\b(?= +\d+ %)", line).end() for line in rows}
    assert lengths == {head.index("length") + len("length")}
    ends = {line.index(" %") + len(" %") for line in rows}
    assert ends == {head.index("score") + len("score") - 1}, "a place for the question mark"


def test_lines_are_parted_by_night_and_day_and_say_what_an_unknown_sound_may_be(
    tmp_path, hearthlog
):
    before = DAY - timedelta(days=1)
    rings = [(at("08:00"), 5.0, "phone_ring", 0.6), (at("09:00"), 5.0, "phone_ring", 0.9)]
    coughs = [(at(text), 2.0, "coughing", 0.9) for text in ("03:00", "12:00", "22:30")]
    write_day(tmp_path, before, [(at("22:10"), 90.0, "coughing", 0.9)], classes=GENERAL)
    write_day(tmp_path, DAY, [*rings, *coughs], classes=[*GENERAL, "unknown"])
    lines = hearthlog("events", tmp_path, "--day", DAY).stdout.splitlines()[1:]
    assert [" ".join(line.split()[:5]) for line in lines[:13]] == [
        "Night to Mon 2 March,",
        "22:10:00 Coughing 2 min 90",
        "03:00:00 Coughing 2 s 90",
        "",
        "Mon 2 March, 07:00 to",
        *("08:00:00 Not recognised 5 s", "09:00:00 Telephone ringing 5 s"),
        "12:00:00 Coughing 2 s 90",
        "",
        "After 22:00",
        "22:30:00 Coughing 2 s 90",
        "",
        "The 24 hours to 22:00",
    ]
    assert lines[0] == "Night to Mon 2 March, 22:00 to 07:00"
    assert lines[4] == "Mon 2 March, 07:00 to 22:00"
    assert lines[5].endswith("  60 %   perhaps telephone ringing")
    assert "perhaps" not in lines[6]
    assert rows(lines) == {
        "Coughing": ["2 min", "3"],
        "Telephone ringing": ["5 s", "1"],
        "Not recognised": ["5 s", "1"],
    }
    assert lines[-1] == "After 22:00: coughing 1"
    words = "--start", f"{before}T12:00", "--end", f"{DAY}T23:00", "--label", "coughing"
    titles = hearthlog("events", tmp_path, *words).stdout.splitlines()
    assert [line for line in titles if " March, " in line] == [
        "Night to Mon 2 March, 22:00 to 07:00",
        "Mon 2 March, 07:00 to 22:00",
        "Night to Tue 3 March, 22:00 to 23:00",
    ]
    assert "From 2026-03-01 12:00 to 2026-03-02 23:00, as labelled" in titles
    assert rows(titles) == {"Coughing": ["2 min", "4"]}


def test_the_totals_of_events_are_those_of_report_page_and_info(home, hearthlog):
    day = day_metrics(home).to_evening
    listed = found(hearthlog, home, "--day", DAY)["day"]
    assert listed == json.loads(hearthlog("info", home, "--json").stdout)["day"]
    assert listed["counts"]["coughing"]["counted"] == day.count("coughing").labelled
    assert listed["minutes"]["speech"] == pytest.approx(day.minutes("speech").minutes)
    lines = hearthlog("events", home, "--day", DAY).stdout.splitlines()
    shown = rows(lines)
    assert shown["Coughing"][1] == str(day.count("coughing").labelled)
    assert shown["Shouting"][-2:] == [
        str(day.uncounted_events("yelling")),
        f"{day.uncounted_minutes('yelling'):.0f} min",
    ]
    title = f"The 24 hours to 22:00 of {DAY:%A}, {DAY}, as labelled"
    assert title in lines
    about = hearthlog("info", home).stdout.splitlines()
    assert title in about
    assert rows(about) == shown, "the bars stand between"


def test_a_night_is_that_of_the_report(home, hearthlog):
    day = day_metrics(home)
    night = found(hearthlog, home, "--night", "--day", DAY)
    for name in day.home.classes:
        if name != SILENCE:
            assert (
                night["counts"].get(name, {"counted": 0})["counted"]
                == day.night_count(name).labelled
            )
    coughs = [event for event in night["events"] if event["label"] == "coughing"]
    assert [event["start"][11:16] for event in coughs] == ["03:10"]
    assert coughs[0]["confidence"] == 0.9
    assert coughs[0]["seconds"] == 3.5
    lines = hearthlog("events", home, "--night", "--label", "cough").stdout.splitlines()
    assert "The night to Monday, 2026-03-02, as labelled" in lines
    assert rows(lines) == {"Coughing": ["4 s", "1"]}


def test_a_review_corrects_what_is_listed(home, hearthlog):
    listed = found(hearthlog, home, "--day", DAY, "--label", "crying", "--label", "coughing")
    corrected = [event for event in listed["events"] if event["start"][11:16] == "07:13"]
    assert [(e["label"], e["confidence"], e["reviewed"]) for e in corrected] == [
        ("crying", 1.0, False)  # only the kitchen was gone through
    ]


def test_a_class_that_only_people_marked_is_listed_apart_from_the_counts(home, hearthlog):
    (log,) = [
        path for path in find_logs(home) if not is_layer(path) and "home_20260302T09" in path.name
    ]
    begin = midnight(DAY) + int(at("09:30")) * NANOSECONDS
    for start in (begin, begin + 60 * NANOSECONDS):
        write_marks(log, [Mark("kitchen", start, start + 2 * NANOSECONDS, "doorbell")])
    bells = found(hearthlog, home, "--day", DAY, "--label", "Doorbell")
    assert [event["start"][11:16] for event in bells["events"]] == ["10:30", "10:31"]
    assert (bells["counts"], bells["marked"]) == ({}, {"doorbell": 2})
    day = found(hearthlog, home, "--day", DAY)
    assert day["marked"] == {"doorbell": 2}
    assert "doorbell" not in day["counts"]
    lines = hearthlog("events", home, "--day", DAY).stdout.splitlines()
    assert "Doorbell: only what people marked: the model does not know it" in lines
    assert rows(lines)["Doorbell"] == ["4 s", "2"]


def test_a_cough_from_the_television_is_counted_no_more(home, hearthlog):
    (log,) = [
        path for path in find_logs(home) if not is_layer(path) and "home_20260302T02" in path.name
    ]
    begin = midnight(DAY) + int(at("02:10")) * NANOSECONDS
    write_marks(log, [Mark("kitchen", begin, begin + 60 * NANOSECONDS, "television")])
    night = found(hearthlog, home, "--night", "--day", DAY)
    assert "coughing" not in night["counts"]
    assert "television" not in night["counts"], "no model has it"


def test_a_sound_that_two_rooms_hear_is_one_and_names_both(home, hearthlog):
    words = "--start", "2026-03-02T08:00", "--end", "2026-03-02T10:00"
    (speech,) = found(hearthlog, home, *words, "--label", "Talking")["events"]
    assert speech["microphones"] == ["hall", "kitchen"]
    assert (speech["seconds"], speech["confidence"]) == (60.0, 0.95)


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["--label", "cugh"], "no class 'cugh' in these logs; there is coughing"),
        (["--label", "cugh"], "No model here has it: mark some of these sounds"),
        (
            ["--label", "shower"],
            "bathroom-embedding labels it in what is recorded with",
        ),
        (["--label", "flushing_water"], "bathroom-embedding labels it in"),  # not by bathroom
        (["--day", "2026-04-01"], "no logs of 2026-04-01"),
        (["--day", "soon"], "--day soon: not a day such as 2026-03-01"),
        (["--labels", "none"], "no labelling 'none' beside these logs"),
        (["--night", "--start", "2026-03-02T00:00"], "--start and --end exclude --day and --night"),
        (["--start", "2027-01-01"], "no log has a message after 2027-01-01"),
        (["--play", "--json"], "--play and --json exclude each other"),
    ],
)
def test_bad_input_is_one_line(home, hearthlog, words, output):
    result = hearthlog("events", home, *words)
    assert result.returncode in {1, 2}
    assert output in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not result.stdout


def test_a_class_that_another_model_has_can_be_relabelled(tmp_path, hearthlog):
    about = {"node": "bathroom", "microphone": "bathroom", "classes": BATHROOM}
    write_day(tmp_path, DAY, [(at("09:00"), 40.0, "shower", 0.95)], **about)
    result = hearthlog("events", tmp_path, "--label", "cough")
    assert "`hearthlog relabel LOGS --model general` labels it" in result.stderr


def test_sound_that_was_not_kept_cannot_be_played_and_is_said_so(home, hearthlog):
    result = hearthlog("events", home, "--day", DAY, "--label", "phone_ring", "--play")
    assert result.returncode == 0
    assert "no sound was kept of 1 of these: keep_audio" in result.stderr


def test_what_the_model_is_not_sure_of_is_counted_apart(tmp_path, hearthlog):
    coughs = [(at("08:00"), 5, "coughing", 0.95), (at("09:00"), 5, "coughing", 0.4)]
    rings = [(at("10:00"), 5, "phone_ring", 0.95), (at("11:00"), 5, "phone_ring", 0.69)]
    others = [(at("12:00"), 2, "yelling", 0.5), (at("13:00"), 5, "unknown", 0.9)]
    write_day(tmp_path, DAY, [*coughs, *rings, *others], classes=[*GENERAL, "unknown"])
    found = hearthlog("events", tmp_path, "--day", DAY, "--label", "coughing")
    lines = found.stdout.splitlines()
    assert rows(lines) == {"Coughing": ["10 s", "1", "1"]}
    assert [line[-5:] for line in lines[2:4]] == [" 95 %", "40 %?"]
    assert lines[-1] == "? less than 70 %: perhaps"
    found = hearthlog("events", tmp_path, "--day", DAY, "--json")
    counts = json.loads(found.stdout)["counts"]
    assert counts["coughing"] == {"counted": 2, "television": 0, "unsure": 1}
    assert counts["phone_ring"] == {"counted": 1, "television": 0, "unsure": 0}
    about = rows(hearthlog("info", tmp_path).stdout.splitlines())
    assert about["Coughing"] == ["10 s", "1", "1"]
    assert about["Shouting"] == ["2 s", "none", "1"]
    assert about["Not recognised"] == ["10 s", "2"], "also the ring of which the model is not sure"
    sure = [(at("08:00"), 5, "coughing", 0.95)]
    write_day(tmp_path / "sure", DAY, sure, classes=GENERAL)
    assert "perhaps" not in hearthlog("events", tmp_path / "sure").stdout


def test_a_telephone_of_which_the_model_is_not_sure_counts_where_a_person_reviewed_it(
    tmp_path, hearthlog
):
    log = write_day(tmp_path, DAY, [(at("11:00"), 5, "phone_ring", 0.6)])[11]
    counts = json.loads(hearthlog("events", tmp_path, "--day", DAY, "--json").stdout)["counts"]
    assert "phone_ring" not in counts
    begin = midnight(DAY) + int(at("11:00")) * NANOSECONDS
    write_marks(log, [Mark("mic", begin, begin + 5 * NANOSECONDS, "phone_ring")])
    counts = json.loads(hearthlog("events", tmp_path, "--day", DAY, "--json").stdout)["counts"]
    assert counts["phone_ring"] == {"counted": 1, "television": 0, "unsure": 0}


def test_time_that_nobody_listened_to_is_said(tmp_path, hearthlog):
    write_day(
        tmp_path,
        DAY,
        [(at("03:00"), 2, "coughing", 0.8)],
        hours=range(6),
        gaps=[(at("01:00"), 1200, "quiet hours"), (at("02:00"), 60, "overrun")],
        classes=GENERAL,
    )
    result = hearthlog("events", tmp_path, "--day", DAY, "--label", "coughing")
    lines = result.stdout.splitlines()
    assert lines[1] == "Night to Mon 2 March, 22:00 to 07:00, listened to 5 h 39 min of 9 h 00 min"
    assert rows(lines) == {"Coughing": ["2 s", "1"]}
    assert result.stderr == (
        "hearthlog: 22 % of that time was listened to, not: Sun 22:00 to Mon 00:00, Mon 01:00 to "
        "Mon 01:20 and Mon 06:00 to Tue 00:00\n"
    )
    missing = found(hearthlog, tmp_path, "--day", DAY)["not_listened"]
    (before, first, short, last) = missing
    assert (before["start"][11:16], before["end"][11:16]) == ("22:00", "00:00")
    assert (first["start"][11:16], first["end"][11:16]) == ("01:00", "01:20")
    assert (short["start"][11:16], last["end"][11:16]) == ("02:00", "00:00")


@pytest.fixture
def kept(tmp_path, capfd):
    """The log of a cough and a pause, with the sound of both."""
    clip = _CLIPS / "coughing" / "coughing_003.flac"
    cough, rate = soundfile.read(clip, dtype="float32")
    soundfile.write(tmp_path / "cough.wav", np.append(cough, np.zeros(2 * rate)), rate)
    words = "--output", tmp_path / "logs", "--model", "general", "--start", "2026-03-02T08:00"
    config = tmp_path / "home.toml"
    config.write_text('keep_audio = "always"\nnever_keep = []\n')
    run(capfd, "record", tmp_path / "cough.wav", "--config", config, *words)
    return tmp_path / "logs"


def test_the_kept_sound_is_played(kept, pulse_microphone):
    """PulseAudio records the signal that a speaker would get."""
    pulse_microphone.stop()
    env = pulse_microphone.speaker_env()
    words = "--start", "2026-03-02T08:00", "--label", "coughing", "--play"
    with pulse_microphone.recorded() as samples:
        result = subprocess.run(
            [*HEARTHLOG, "events", kept, *words],
            env=env,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert result.returncode == 0, result.stderr
        own = [line for line in result.stderr.splitlines() if not line.startswith("ALSA lib")]
        assert len(own) == 1, "ALSA complains on a busy machine"
        assert re.fullmatch(r"hearthlog: playing 0\d:00:0\d Coughing", own[0])
        wait_for(lambda: np.abs(samples()).max(initial=0) > 1000)


def test_without_a_speaker_a_line_says_so(kept):
    if any(each["max_output_channels"] for each in sounddevice.query_devices()):
        pytest.skip("this machine has a speaker")
    words = "--start", "2026-03-02T08:00", "--label", "coughing", "--play"
    result = subprocess.run(
        [*HEARTHLOG, "events", kept, *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr.splitlines()[-1] == (
        "hearthlog: the sound cannot be played here (Error querying device -1); is there a speaker?"
    )


def test_a_review_says_so_too():
    if any(each["max_output_channels"] for each in sounddevice.query_devices()):
        pytest.skip("this machine has a speaker")
    clip = SoundClip(0, 16_000, np.zeros(16_000, np.int16))
    assert listen([clip], 0, NANOSECONDS) == (
        0.0,
        "the sound cannot be played here (Error querying device -1); is there a speaker?",
    )
