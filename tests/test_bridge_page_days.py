"""The page of the home: its sentence, past days, folded sounds, kept sound, and languages."""

import io
import json
import re
import time
import wave
from datetime import UTC, date, datetime, timedelta
from http.client import HTTPConnection
from types import SimpleNamespace
from urllib.parse import quote

import numpy as np
import pytest
from homelife import GENERAL, at, write_day
from livehome import LiveHome, midday_zone
from pydantic import ValidationError
from servedhome import JSON, PALE_TEXTS, proxying, serving
from viewers import patiently

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.activity.checked_minutes import Sureness
from hearthlog.analyzer.activity.doubtful_sounds import DoubtfulSound
from hearthlog.analyzer.activity.home_events import read_day_sounds
from hearthlog.analyzer.bridge.corrections import EventCorrections, user_error
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.page import languages, past_days, preferred_language, translation_for
from hearthlog.analyzer.bridge.page.day import HomeDay, picture_of
from hearthlog.analyzer.bridge.page.past_days import PastDays
from hearthlog.analyzer.bridge.page.sounds import (
    Bout,
    ShownBouts,
    bouts,
    events_between,
    events_to_review,
    needs_review,
    uncounted_ids,
)
from hearthlog.analyzer.bridge.settings import PageSettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import local_time, today
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.analyzer.report.report import Period, make_report
from hearthlog.models.classes import CLASSES, RUNNING_WATER, colour_on_paper
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import audio_path, find_logs
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, message, time_message
from hearthlog.schemas.messages.topics import audio_topic

MIDNIGHT = int(datetime(2026, 5, 5, tzinfo=UTC).timestamp()) * NANOSECONDS
HOUR, MINUTE = 3600 * NANOSECONDS, 60 * NANOSECONDS
GERMAN = {"Accept-Language": "de-AT,de;q=0.9,en;q=0.5"}


# The sentence


def tiled(hours, *sounds):
    """Segments of some hours of the day, silence between sounds.

    These are (hour, seconds, label), or with a confidence (hour, seconds, label, confidence).
    """
    rows, now = [], int(hours[0] * HOUR)
    for hour, seconds, *label in sorted(sounds):
        begin, end = int(hour * HOUR), int(hour * HOUR) + seconds * NANOSECONDS
        rows += [(now, begin, "silence"), (begin, end, *label)]
        now = end
    return [*rows, (now, int(hours[1] * HOUR), "silence")]


def home_at(hour, *parts, language="en"):
    """A home at an hour of the day, by the segments of its log."""
    return home_of_rooms(hour, {"mic": parts}, language)


def home_of_rooms(hour, rooms, language="en"):
    """A home with a microphone in each room, by the segments of its log."""
    state = HomeState()
    for name, parts in rooms.items():
        columns = segments_of(name, parts)
        state.push([columns])
        own = state.microphones[name]
        own.names, own.seen = ["silence", "coughing", "crying", "speech"], time.monotonic()
    moment = today(MIDNIGHT + int(hour * HOUR), UTC)
    microphones = [*state.microphones.values()]
    return HomeDay(microphones, moment, UTC, translation_for(language))


def segments_of(name, parts):
    rows = [row for part in parts for row in part]
    starts, ends = (MIDNIGHT + np.array([row[i] for row in rows]) for i in (0, 1))
    fields = {
        "header.stamp": starts,
        "duration": ends - starts,
        "label": np.array([row[2] for row in rows], object),
        "confidence": np.array([(*row, 1.0)[3] for row in rows], np.float32),
    }
    return Columns(f"/{name}/segment", message_types.SEGMENT, {}, ends, ends, ends, fields)


NIGHT = [(2.17, 3, "coughing"), (6.22, 3, "coughing")]


@pytest.mark.parametrize(
    ("hour", "hours", "sounds", "sentence"),
    [
        (9, (-3, 9), NIGHT, "A quiet night: coughing twice (02:10 and 06:13)."),
        (9, (-3, 9), [], "A quiet night."),
        (3, (-3, 3), NIGHT[:1], "A quiet night so far: coughing once (02:10)."),
        (
            9,
            (5, 9),
            NIGHT[1:],
            "Only part of last night was heard: coughing once (06:13).",
        ),
        (9, (5, 9), [], "Only part of last night was heard."),
        (
            9,
            (-3, 9),
            [(1 + number / 10, 3, "coughing") for number in range(9)],
            "Last night: coughing 9 times (01:00 to 01:48).",
        ),
        (9, (-3, 9), [(1, 400, "speech")], "Last night: talking once."),
        (
            9,
            (-3, 9),
            [(-2.9, 9200, "speech"), *NIGHT],
            (
                "Last night: coughing twice (02:10 and 06:13); something like a television until "
                "23:42."
            ),
        ),
        (
            9,
            (-3, 9),
            [(1, 1800, "speech"), (4, 30, "shower")],
            ("Last night: something like a television, 00:58 to 01:32; shower once."),
        ),
        (
            9,
            (-3, 9),
            [(hour, 1800, "music") for hour in (1, 3, 5)],
            (
                "Last night: something like a television for 1 hour 42 minutes in all, 00:58 to "
                "05:32."
            ),
        ),
        (
            3,
            (-3, 3),
            [(1, 7200, "music")],
            "Tonight: something like a television since 00:58.",
        ),
        (
            9,
            (-3, 9),
            [(-3, 3700, "speech")],
            "A quiet night.",
        ),
        (
            14,
            (-3, 14),
            [(10, 3, "coughing")],
            "Since 07:00: coughing once (10:00).",
        ),
        (14, (-3, 14), NIGHT, "Since 07:00: no coughing or crying."),
        (14, (9, 14), [], "Only part of today was heard."),
    ],
)
def test_the_sentence_is_true_and_calls_nothing_quiet_that_was_not_listened_to(
    hour, hours, sounds, sentence
):
    assert picture_of(home_at(hour, tiled(hours, *sounds)))["sentence"] == sentence


@pytest.mark.parametrize(
    ("hours", "sounds", "english", "german"),
    [
        (
            (-3, 22),
            [*NIGHT, (14, 3, "coughing")],
            ("In the night: coughing twice (02:10 and 06:13). By day: coughing once (14:00)."),
            ("In der Nacht: zweimal Husten (02:10 und 06:13). Am Tag: einmal Husten (14:00)."),
        ),
        (
            (-3, 22),
            NIGHT,
            "In the night: coughing twice (02:10 and 06:13).",
            "In der Nacht: zweimal Husten (02:10 und 06:13).",
        ),
        (
            (4, 14),
            [*NIGHT[1:], (9, 3, "coughing")],
            (
                "In the night, as far as listened to: coughing once (06:13). By day: coughing "
                "once (09:00)."
            ),
            (
                "In der Nacht, soweit mitgehört: einmal Husten (06:13). Am Tag: einmal Husten "
                "(09:00)."
            ),
        ),
        (
            (-3, 22),
            [
                (3, 3, "phone_ring"),
                *((hour, 3, "coughing") for hour in (9, 10, 11, 12)),
                *((hour, 3, "crying") for hour in (15, 16, 17)),
            ],
            "By day: coughing 4 times and crying 3 times.",
            ("Am Tag: 4\N{NON-BREAKING HYPHEN}mal Husten und 3\N{NON-BREAKING HYPHEN}mal Weinen."),
        ),
    ],
)
def test_the_sentence_of_a_past_day_has_the_night_first(hours, sounds, english, german):
    for language, sentence in (("en", english), ("de", german)):
        home = home_at(21.99, tiled(hours, *sounds), language=language)._replace(is_past=True)
        assert picture_of(home)["sentence"] == sentence


def test_below_the_sentence_are_the_morning_and_after_noon_the_television_and_the_night():
    busy = [
        *((hour, 5, "objects_activity", sure) for hour, sure in ((7.1, 0.9), (7.8, 0.6))),
        (7.4, 5, "unknown"),
    ]
    sounds = [*NIGHT, (9, 3, "coughing"), *busy]
    assert picture_of(home_at(6.9, tiled((-3, 6.9), *NIGHT)))["more"] == ""
    picture = picture_of(home_at(11, tiled((-3, 11), *sounds)))
    assert picture["sentence"] == "A quiet night: coughing twice (02:10 and 06:13)."
    assert picture["more"] == (
        "Since 07:00: coughing once (09:00); household sounds once, perhaps once more (07:06 to "
        "07:48)."
    )
    assert picture_of(home_at(11, tiled((-3, 11), *NIGHT)))["more"] == ""
    night = "A quiet night: coughing twice (02:10 and 06:13)."
    picture = picture_of(home_at(14, tiled((-3, 14), *sounds)))
    assert picture["sentence"] == "Since 07:00: coughing once (09:00)."
    assert picture["more"] == night
    talking = [(12 + n / 60, 3, "speech") for n in range(60)]
    picture = picture_of(home_at(16, tiled((-3, 16), *sounds, *talking)))
    assert picture["sentence"] == "Since 07:00: coughing once (09:00)."
    assert picture["more"] == f"Something like a television, 11:58 to 13:02. {night}"
    german = home_at(16, tiled((-3, 16), *sounds, *talking), language="de")
    assert picture_of(german)["more"].startswith("Etwas wie ein Fernseher, 11:58 bis 13:02. Eine ")
    past = home_at(21.99, tiled((-3, 22), *sounds))._replace(is_past=True)
    assert picture_of(past)["more"] == "", "its sentence has night and day"
    past = home_at(21.99, tiled((-3, 22), *sounds, *talking))._replace(is_past=True)
    assert "television" not in picture_of(past)["sentence"]
    assert picture_of(past)["more"] == "Something like a television, 11:58 to 13:02."


def test_times_of_doubtful_sounds_alone_would_be_taken_for_those_of_all():
    home = home_at(19, tiled((-3, 19), *coughs_at(8, 9, 10, 11, 12), *coughs_at(13, sure=False)))
    rings = [(14, 4, "phone_ring", 0.9)]
    assert picture_of(home)["sentence"].endswith(
        "5 times (08:00 to 12:00), perhaps once more (13:00)."
    )
    home = home_at(
        19, tiled((-3, 19), *coughs_at(8, 9, 10, 11, 12), *coughs_at(13, sure=False), *rings)
    )
    assert picture_of(home)["sentence"] == (
        "Since 07:00: coughing 5 times, perhaps once more; telephone ringing once (14:00)."
    )


def test_a_television_until_a_time_is_so_in_german():
    home = home_at(9, tiled((-3, 9), (-2.9, 9200, "speech")), language="de")
    assert picture_of(home)["sentence"] == ("Letzte Nacht: bis 23:42 etwas wie ein Fernseher.")


@pytest.mark.parametrize(
    ("language", "start", "and_once"),
    [
        ("en", "Since 07:00: coughing twice", "and 15:00), once"),
        ("de", "Seit 07:00: zweimal Husten", "und 15:00), einmal"),
    ],
)
def test_a_sound_that_two_rooms_may_have_heard_is_not_counted_twice(language, start, and_once):
    rooms = {
        "bath": [tiled((0, 16), (14, 2, "coughing"), (15, 2, "coughing"))],
        "kitchen": [tiled((0, 16), (14, 2, "coughing"))],
    }
    sentence = f"{start} (Bath: 14:00 {and_once} (Kitchen: 14:00)."
    assert picture_of(home_of_rooms(16, rooms, language))["sentence"] == sentence


def coughs_at(*hours, sure=True):
    return [(hour, 3, "coughing", 0.9 if sure else 0.6) for hour in hours]


@pytest.mark.parametrize(
    ("sounds", "english", "german"),
    [
        (
            [*coughs_at(3.62), *coughs_at(0.67, 6.44, sure=False)],
            "coughing once (03:37), perhaps twice more (00:40 and 06:26)",
            "einmal Husten (03:37), vielleicht noch zweimal (00:40 und 06:26)",
        ),
        (
            [*coughs_at(3.62, 4), *coughs_at(1, sure=False)],
            "coughing twice (03:37 and 04:00), perhaps once more (01:00)",
            "zweimal Husten (03:37 und 04:00), vielleicht noch einmal (01:00)",
        ),
        (
            [*coughs_at(0), *coughs_at(1, 2, 3, 4, sure=False)],
            "coughing once (00:00), perhaps 4 more times (01:00, 02:00, 03:00 and 04:00)",
            (
                "einmal Husten (00:00), vielleicht noch 4\N{NON-BREAKING HYPHEN}mal (01:00, 02:00, "
                "03:00 und 04:00)"
            ),
        ),
        (
            coughs_at(0.67, 6.44, sure=False),
            "perhaps coughing twice (00:40 and 06:26)",
            "vielleicht zweimal Husten (00:40 und 06:26)",
        ),
        (
            coughs_at(3, sure=False),
            "perhaps coughing once (03:00)",
            "vielleicht einmal Husten (03:00)",
        ),
        (
            [*coughs_at(3), *coughs_at(4, sure=False), (5, 3, "crying", 0.9)],
            "coughing once, perhaps once more; crying once",
            "einmal Husten, vielleicht noch einmal; einmal Weinen",
        ),
        (
            [*coughs_at(1, 2, 2.5, 3), (5, 3, "crying", 0.9)],
            "coughing 4 times and crying once (05:00)",
            "4\N{NON-BREAKING HYPHEN}mal Husten und einmal Weinen (05:00)",
        ),
        (
            [*coughs_at(3), (5, 3, "crying", 0.6)],
            "coughing once (03:00) and perhaps crying once (05:00)",
            "einmal Husten (03:00) und vielleicht einmal Weinen (05:00)",
        ),
    ],
)
def test_the_sentence_tells_what_is_sure_from_what_may_be(sounds, english, german):
    for language, what in (("en", english), ("de", german)):
        sentence = picture_of(home_at(9, tiled((-3, 9), *sounds), language=language))["sentence"]
        start, end = {
            "en": ("A quiet night: ", "."),
            "de": ("Eine ruhige Nacht: ", "."),
        }[language]
        assert sentence == f"{start}{what}{end}"


@pytest.mark.parametrize(
    ("sounds", "english", "german"),
    [
        (
            coughs_at(2.07, 2.08, 2.62),
            "coughing 3 times (02:04 twice, 02:37)",
            "3\N{NON-BREAKING HYPHEN}mal Husten (02:04 zweimal, 02:37)",
        ),
        (
            [*coughs_at(2.67), *coughs_at(1.07, 1.075, 1.08, sure=False)],
            "coughing once (02:40), perhaps 3 more times (01:04 3 times)",
            (
                "einmal Husten (02:40), vielleicht noch 3\N{NON-BREAKING HYPHEN}mal "
                "(01:04 3\N{NON-BREAKING HYPHEN}mal)"
            ),
        ),
        (
            [*coughs_at(1, 2, 3, 4), *coughs_at(1.5, 2.5, 3.5, sure=False)],
            (
                "coughing 4 times (01:00, 02:00, 03:00 and 04:00), perhaps 3 more (01:30, 02:30 "
                "and 03:30)"
            ),
            (
                "4\N{NON-BREAKING HYPHEN}mal Husten (01:00, 02:00, 03:00 und 04:00), vielleicht "
                "noch 3\N{NON-BREAKING HYPHEN}mal (01:30, 02:30 und 03:30)"
            ),
        ),
    ],
)
def test_the_sentence_names_a_minute_once_and_times_once(sounds, english, german):
    for language, what in (("en", english), ("de", german)):
        home = home_at(9, tiled((-3, 9), *sounds), language=language)
        assert what in picture_of(home)["sentence"]


def test_a_count_with_what_is_not_sure_is_one_grammar_in_the_day_and_beside_other_classes():
    rings = [(hour, 4, "phone_ring", 0.9) for hour in (9, 9.5, 10, 11.1)]
    coughs = [
        *coughs_at(8, 8.5, 9.1, 10.1),
        *coughs_at(*(12 + n / 2 for n in range(11)), sure=False),
    ]
    home = home_at(19, tiled((-3, 19), *coughs, *rings))
    assert picture_of(home)["sentence"] == (
        "Since 07:00: coughing 4 times (08:00, 08:30, 09:06 and 10:06), perhaps 11 more."
    )
    german = home._replace(words=translation_for("de"))
    assert picture_of(german)["sentence"] == (
        "Seit 07:00: 4\N{NON-BREAKING HYPHEN}mal Husten (08:00, 08:30, 09:06 und 10:06), "
        "vielleicht noch "
        "11\N{NON-BREAKING HYPHEN}mal."
    )


def test_the_picture_has_what_is_sure_apart_from_what_is_not_and_what_does_not_count():
    talking = [(13 + n / 60, 3, "speech") for n in range(60)]
    coughs = [*coughs_at(9.26), *coughs_at(10.51, sure=False), *coughs_at(13.409)]
    home = home_at(15, tiled((-3, 15), *talking, *coughs))
    (lane,) = (e for e in picture_of(home)["rooms"][0]["lanes"] if e["label"] == "coughing")
    marked = [
        [n // 30 for n, bar in enumerate(lane[key], -60) if bar != "0"]
        for key in ("bars", "sure_bars", "unsure_bars", "pale")
    ]
    assert marked == [[9, 10], [9], [10], [13]]
    assert (lane["uncounted"], lane["uncounted_times"]) == (1, "13:24")


def test_an_entry_says_in_few_words_how_many_of_it_are_not_sure_or_not_counted():
    home = home_at(9, tiled((-3, 9), *coughs_at(2, 2.01, sure=False), *coughs_at(2.02)))
    (bout,) = bouts(home.microphones[0].events("coughing", 0))
    for language, texts in {
        "en": ("2 not sure", "one beside a television, not counted"),
        "de": ("2 unsicher", "eines neben einem Fernseher, nicht mitgezählt"),
    }.items():
        shown = ShownBouts(home.moment.now, UTC, translation_for(language), lambda _: "", True)
        about = shown._replace(uncounted=[bout.first.id]).describe(bout)
        assert (about["sure"], about["beside"]) == texts
        assert about["unsure"] == 2


def test_an_entry_of_a_minute_or_more_has_its_end_and_a_short_one_only_its_start():
    home = home_at(9, tiled((-3, 9), (1.9999, 4, "coughing"), (3.99, 90, "speech")))
    shown = ShownBouts(home.moment.now, UTC, home.words, lambda _: "", True)
    times = {}
    for label in ("coughing", "speech"):
        (bout,) = bouts(home.microphones[0].events(label, 0))
        times[label] = shown.describe(bout)["time"]
    assert times == {"coughing": "01:59", "speech": "03:59 to 04:00"}


def test_a_ring_that_is_not_sure_is_listed_as_not_recognised_until_somebody_confirms_it():
    home = home_at(9, tiled((-3, 9), (2, 4, "phone_ring")))
    (ring,) = home.microphones[0].events("phone_ring", 0)
    ring = ring._replace(confidence=0.6)
    (bout,) = bouts([ring])
    shown = ShownBouts(home.moment.now, UTC, home.words, lambda _: "", True)
    about = shown.describe(bout)
    assert (about["sure"], about["look"]) == ("not sure, so counted as not recognised", False)
    assert about["words"] == "Perhaps telephone ringing"
    confirmed = shown._replace(correction=lambda _: "You said: Telephone ringing")
    assert confirmed.describe(bout)["sure"] == ""


@pytest.mark.parametrize("language", sorted(languages()))
def test_no_text_promises_that_the_box_learns_by_itself(language):
    texts = translation_for(language).texts
    promises = re.compile(r"\b(learns?|teach|lern\w*|beibring\w*|beizubringen)\b")
    assert [key for key, text in texts.items() if promises.search(text)] == []
    training = [key for key, text in texts.items() if re.search(r"[Tt]raining", text)]
    assert training == ["page.look hint", "page.recurring hint"]


def test_a_sentence_about_several_classes_is_short_and_begins_with_the_most_important():
    rings = [(hour, 4, "phone_ring", 0.6 if hour > 11 else 0.9) for hour in (9, 9.5, 10, 11.1)]
    sounds = [*coughs_at(8, 8.5, 9.1, 10.1), *coughs_at(12, sure=False), (11, 3, "yelling", 0.9)]
    home = home_at(23, tiled((-3, 23), *sounds, *rings))._replace(is_past=True)
    home.microphones[0].names = ["silence", "coughing", "yelling", "phone_ring"]
    assert picture_of(home)["sentence"] == (
        "By day: coughing 4 times, perhaps once more; shouting once (11:00)."
    )
    counts = {lane["label"]: lane["count"] for lane in picture_of(home)["rooms"][0]["lanes"]}
    assert counts["phone_ring"] == 3, "the rest is below"
    home = home_at(23, tiled((-3, 23), *sounds[:-1], *rings))._replace(is_past=True)
    home.microphones[0].names = ["silence", "coughing", "phone_ring"]
    assert picture_of(home)["sentence"] == (
        "By day: coughing 4 times (08:00, 08:30, 09:06 and 10:06), perhaps once more (12:00)."
    )
    crying = [(hour, 3, "crying", 0.9) for hour in (13, 14, 15)]
    home = home_at(23, tiled((-3, 23), *sounds, *crying))._replace(is_past=True)
    home.microphones[0].names = ["silence", "coughing", "crying", "yelling"]
    assert picture_of(home)["sentence"] == (
        "By day: coughing 4 times, perhaps once more; crying 3 times; shouting once (11:00)."
    ), "none that worries is left out"


def test_the_sentence_names_a_room_once_for_what_is_sure_and_what_may_be_there():
    rooms = {
        "bath": [tiled((-3, 9), *coughs_at(2), *coughs_at(3, sure=False))],
        "kitchen": [tiled((-3, 9), *coughs_at(2, sure=False))],
    }
    assert picture_of(home_of_rooms(9, rooms))["sentence"] == (
        "A quiet night: coughing once (Bath: 02:00), perhaps once more (03:00), "
        "perhaps once (Kitchen: 02:00)."
    )


def test_the_sentence_the_times_and_the_list_call_the_same_sounds_not_sure(tmp_path):
    sounds = [*coughs_at(2.2), *coughs_at(2.17, 5, 6.22, sure=False)]
    home = home_at(9, tiled((-3, 9), *sounds))
    (microphone,) = home.microphones
    events = microphone.events("coughing", 0)
    answer = Mark("mic", events[2].start, events[2].end, "coughing")
    home = home._replace(corrections=EventCorrections(tmp_path, "home").of_day([answer]))

    def shown():
        picture = picture_of(home)
        (lane,) = (e for e in picture["rooms"][0]["lanes"] if e["label"] == "coughing")
        correction = {events[2].id: "You said: Coughing"}
        entries = ShownBouts(
            home.moment.now,
            UTC,
            home.words,
            lambda event: correction.get(event.id, ""),
            True,
            home.sureness,
        )
        times = {
            clock: about.partition(" · ")[2] for clock, _, about, _ in lane["times"][0]["times"]
        }
        return picture["sentence"], times, [entries.describe(b)["sure"] for b in bouts(events)]

    sentence, times, entries = shown()
    assert "coughing twice (02:12 and 05:00), perhaps twice more (02:10 and 06:13)" in sentence
    assert times == {"06:13": "not sure", "05:00": "", "02:12": "", "02:10": "not sure"}
    assert entries == ["not sure", "", "one not sure"]
    home = home._replace(sureness=Sureness(0.55))  # as the checked minutes of the home have it
    sentence, times, entries = shown()
    assert "coughing 4 times (02:10, 02:12, 05:00 and 06:13)." in sentence
    assert times == {"06:13": "sure", "05:00": "", "02:12": "sure", "02:10": "sure"}
    assert entries[0] == entries[2] == "sure"


def test_a_night_is_quiet_if_it_is_so_in_each_room():
    coughs = [(1 + n / 2, 2, "coughing") for n in range(4)]
    rooms = {name: [tiled((-3, 9), *coughs)] for name in ("bath", "kitchen")}
    assert picture_of(home_of_rooms(9, rooms))["sentence"].startswith("A quiet night: ")


def test_rings_and_coughs_beside_a_television_are_not_counted_and_the_lane_says_so():
    talking = [(13 + n / 60, 3, "speech") for n in range(60)]
    rings = [(hour, 4, "phone_ring") for hour in (9.26, 13.409, 13.609)]
    picture = picture_of(home_at(15, tiled((-3, 15), *talking, *rings)))
    lanes = {lane["label"]: lane for lane in picture["rooms"][0]["lanes"]}
    ring = lanes["phone_ring"]
    assert (ring["count"], ring["counts"], len(ring["times"][2]["times"])) == (1, [0, 1], 1)
    assert ring["last"] == "09:15", "of what counts"
    assert ring["told"].endswith("; twice beside something like a television, not counted")
    assert picture["sentence"] == "Since 07:00: telephone ringing once (09:15)."
    assert picture["more"].startswith("Something like a television, 12:58 to 14:02. ")
    assert lanes["speech"]["counts"] == [0, 0]
    assert lanes["speech"]["uncounted"] == 60, "talking of a television is no talking of the home"


def test_the_counts_of_the_sentence_are_those_below_it():
    picture = picture_of(home_at(9, tiled((-3, 9), *NIGHT)))
    (lane,) = (each for each in picture["rooms"][0]["lanes"] if each["label"] == "coughing")
    assert (lane["count"], lane["counts"]) == (2, [2, 0])
    for times in lane["times"][:2]:
        assert [time for time, *_ in times["times"]] == ["06:13", "02:10"]
        assert times["times"][0][1].startswith("mic-coughing-")
    assert lane["times"][2] == {"times": [], "before": 0}


EVENINGS = coughs_at(-1.5, 0.67, 6.99, 7, 21.99, 22, 23)


@pytest.mark.parametrize(
    ("hour", "columns", "counts"),
    [
        (3, ["Since 22:00"], [2]),
        (7.5, ["Night 22\N{EN DASH}07", "Since 07:00"], [3, 1]),
        (21.995, ["Night 22\N{EN DASH}07", "Since 07:00"], [3, 2]),
        (22.5, ["Night 22\N{EN DASH}07", "Day 07\N{EN DASH}22", "Since 22:00"], [3, 2, 1]),
        (23.99, ["Night 22\N{EN DASH}07", "Day 07\N{EN DASH}22", "Since 22:00"], [3, 2, 2]),
    ],
)
def test_no_sound_counts_twice_and_each_count_lists_what_it_counts(hour, columns, counts):
    recorded = [each for each in EVENINGS if each[0] < hour]
    picture = picture_of(home_at(hour, tiled((-3, hour), *recorded)))
    (lane,) = (each for each in picture["rooms"][0]["lanes"] if each["label"] == "coughing")
    assert picture["columns"] == columns
    assert (lane["counts"], lane["count"]) == (counts, sum(counts))
    full, *each = [[own for _, own, *_ in times["times"]] for times in lane["times"]]
    assert [len(ids) for ids in each] == counts
    assert full == [own for ids in reversed(each) for own in ids]
    shown = {n / 30 - 2 for n, bar in enumerate(lane["bars"]) if bar != "0"}
    assert len(shown) == len(recorded)
    assert min(shown) == pytest.approx(-1.5, abs=1 / 30)


def test_the_hours_of_the_counts_are_there_in_german():
    picture = picture_of(home_at(22.5, tiled((-3, 22.5)), language="de"))
    assert picture["columns"] == ["Nacht 22\N{EN DASH}07", "Tag 07\N{EN DASH}22", "Seit 22:00"]


def test_what_people_say_of_a_sound_is_what_the_page_counts(tmp_path):
    talking = [(13 + n / 60, 3, "speech") for n in range(60)]
    coughs = [(hour, 4, "coughing") for hour in (9.26, 10.5, 11.5, 13.409, 13.609)]
    home = home_at(15, tiled((-3, 15), *talking, *coughs))
    corrections = EventCorrections(tmp_path, "home")
    (microphone,) = home.microphones
    events = microphone.events("coughing", 0)
    answers = ["television", "crying", "", "coughing", ""]  # the last two beside a television
    marks = [
        Mark("mic", event.start + 1, event.end, label)
        for event, label in zip(events, answers, strict=True)
        if label
    ]
    home = home._replace(corrections=corrections.of_day(marks))
    picture = picture_of(home)
    lanes = {lane["label"]: lane for lane in picture["rooms"][0]["lanes"]}
    assert [time for time, *_ in lanes["coughing"]["times"][0]["times"]] == ["13:24", "11:30"]
    assert [time for time, *_ in lanes["crying"]["times"][0]["times"]] == ["10:30"]
    assert picture["sentence"].startswith(
        "Since 07:00: coughing twice (11:30 and 13:24) and crying once (10:30)."
    )


def test_what_is_not_counted_is_drawn_pale_and_its_entry_says_so():
    talking = [(13 + n / 60, 3, "speech") for n in range(60)]
    coughs = [(hour, 4, "coughing") for hour in (9.26, 13.409, 13.45)]
    home = home_at(15, tiled((-3, 15), *talking, *coughs))
    (lane,) = (e for e in picture_of(home)["rooms"][0]["lanes"] if e["label"] == "coughing")
    marked = [
        {n / 30 for n, bar in enumerate(lane[key], -60) if bar != "0"} for key in ("bars", "pale")
    ]
    assert [{round(hour, 2) for hour in own} for own in marked] == [{9.23}, {13.4, 13.43}]
    events = events_between(home.microphones, MIDNIGHT, MIDNIGHT + 24 * HOUR)
    uncounted = uncounted_ids(home.microphones, events)
    shown = ShownBouts(MIDNIGHT + 15 * HOUR, UTC, translation_for("en"), lambda _: "", True)
    shown = shown._replace(uncounted=uncounted)
    texts = {bout.first.label: [] for bout in bouts(events)}
    for bout in bouts(events):
        about = shown.describe(bout)
        texts[bout.first.label].append((about["beside"], about["look"]))
    assert texts["coughing"] == [("beside a television, not counted", False), ("", True)]
    assert {*texts["speech"]} == {("beside a television, not counted", False)}
    corrected = shown._replace(correction=lambda _: "You said: Coughing")
    assert {corrected.describe(bout)["beside"] for bout in bouts(events)} == {""}


def test_the_page_says_which_sounds_that_people_ask_about_it_does_not_know():
    home = home_at(9, tiled((-3, 9)))
    (microphone,) = home.microphones
    microphone.hidden_classes = frozenset({"yelling"})
    note = picture_of(home)["missing"]
    assert ": telephone ringing, toilet flush, shower and water tap. Where one was heard" in note
    microphone.names = ["silence", "coughing", "crying", "speech", "phone_ring", "running_water"]
    assert picture_of(home)["missing"] == (
        "It does not tell toilet flush, shower and water tap apart: all of them are running water "
        "here."
    )
    microphone.names = []
    assert picture_of(home)["missing"] == "", "not known yet"


def test_times_of_the_first_class_are_there_though_a_telephone_rang():
    rings = [(hour, 4, "phone_ring", 0.9) for hour in (-1.7, -1.6)]
    coughs = coughs_at(-0.53, 1.86, 2.27, 6.02, sure=False)
    home = home_at(9, tiled((-3, 9), *rings, *coughs, (1, 400, "speech", 0.9)))
    assert picture_of(home)["sentence"] == (
        "Last night: perhaps coughing 4 times (23:28, 01:51, 02:16 and 06:01)."
    )


def test_hours_that_no_log_has_are_hatched_and_no_0_is_said_of_them():
    home = home_at(9, tiled((-3, -2)), tiled((7, 9)))
    (room,) = picture_of(home)["rooms"]
    assert room["gaps"] == [(0, round(9 / 24, 4))]
    assert room["unheard"] == "Not listening: 22:00 to 07:00."
    assert [lane["counts"] for lane in room["lanes"]] == [[None, 0]] * len(room["lanes"])
    assert {lane["count"] for lane in room["lanes"]} == {None}
    (microphone,) = home.microphones  # what MQTT publishes
    assert microphone.counts(home.moment)["coughing"] == (0, None)


# Sounds that are folded


def event(minute, label="speech", microphone="mic"):
    start = MIDNIGHT + round(minute * MINUTE)
    return SoundEvent(microphone, label, start, start + 5 * NANOSECONDS, 0.9, 5.0)


def test_sounds_of_one_class_within_five_minutes_are_one_entry():
    folded = bouts([event(0), event(4), event(4.5, "coughing"), event(9), event(15)])
    assert [(each.first.label, len(each.events)) for each in folded] == [
        ("speech", 1),
        ("speech", 3),
        ("coughing", 1),
    ]
    assert len(bouts([event(0), event(1, microphone="bath")])) == 2
    assert max(len(each.events) for each in bouts(event(minute) for minute in range(900))) == 50


def test_an_answer_to_folded_sounds_marks_each_of_them(tmp_path):
    with serving(tmp_path) as home:
        starts = [home.log.write_segment("speech", minutes) for minutes in (20, 18, 16)]
        home.log.hears("silence")
        with home.stream() as part:
            shown = part("events", lambda it: [len(one["ids"]) for one in it["events"]] == [3])[
                "events"
            ]
            (entry,) = shown
            assert entry["times"] == "3 times"
            assert home.mark(entry["id"], "music")[0] == 200
            part("events", lambda it: it["events"][0]["said"] == "You said: Music")
        assert sorted(mark.start for mark in home.marks()) == starts


# Past days, with the sound of one


def keep_sound(folder, microphone, start, seconds):
    """Write a tone into the audio layer of the log that has a time."""
    hour = f"{datetime.fromtimestamp(start // NANOSECONDS, UTC):%Y%m%dT%H%M%S}"
    log = max(each for each in find_logs(folder) if each.name[5:20] <= hour)
    writer = LogWriter(audio_path(log), [audio_topic(microphone)], {"version": "0", "node": "home"})
    tone = 8000 * np.sin(np.arange(16_000 * seconds))
    sound = message(
        message_types.RAW_AUDIO,
        timestamp=time_message(start),
        data=tone.astype("<i2").view("u1"),
        format="pcm-s16",
        sample_rate=16_000,
        number_of_channels=1,
    )
    writer.write(f"/{microphone}/audio", start, encode(sound))
    writer.finish()


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    """A home with two past days, of which the later one has kept sound, and a present."""
    folder = tmp_path_factory.mktemp("lived")
    now = datetime.now(UTC)
    days = [(now - timedelta(days=back)).date() for back in (4, 3)]
    # The zone of the home depends on the hour of the test: it is always 13:10 there.
    shift = int(midday_zone().utcoffset(now).total_seconds())
    cough, talk = ((at(clock) - shift) % 86_400 for clock in ("13:10", "13:40"))
    sounds = [(cough, 5.0, "coughing", 0.9), (talk, 90.0, "speech", 0.8)]
    for day in days:
        write_day(folder / "logs", day, sounds)
    begin = int(datetime(days[1].year, days[1].month, days[1].day, tzinfo=UTC).timestamp())
    start = round(begin + cough) * NANOSECONDS
    keep_sound(folder / "logs", "mic", start, 5)
    with serving(folder, {"sound": True}) as home:
        home.coughed = start
        home.log.write_segment("silence", 350, 60)
        home.log.write_segment("coughing", 40, 3)
        home.log.write_segment("music", 30, 3)
        home.log.hears("silence")
        with home.stream() as part:
            part("events", lambda events: len(events["events"]) == 2)
        home.date = local_time(start, home.home.zone).date().isoformat()
        yield home


DAY_MINUTES = 24 * 60


def got(home, path, **fields):
    status, _, text = home.request("GET", path, **fields)
    return status, json.loads(text)


def test_a_past_day_has_the_picture_the_counts_and_the_sounds_of_its_logs(lived):
    _, days = got(lived, "/days")
    dates = [date for date, _, _ in days]
    assert dates == sorted(dates, reverse=True)
    assert lived.date in dates
    status, day = got(lived, f"/day?{lived.date}")
    assert (status, day["now"]) == (200, None)
    lanes = {lane["label"]: lane for lane in day["rooms"][0]["lanes"]}
    assert {*lanes} == {*GENERAL} - {"silence"}
    assert (lanes["coughing"]["count"], lanes["crying"]["counts"][1]) == (1, 0)
    assert [each["label"] for each in day["events"]] == ["speech", "coughing"]
    assert f"mic-coughing-{lived.coughed}" in day["events"][1]["ids"]
    assert day["events"][1]["look"]


def test_the_evening_of_a_past_day_is_of_the_night_of_the_next_and_of_no_other(tmp_path):
    monday, tuesday = date(2026, 3, 2), date(2026, 3, 3)
    labels = [(at(clock), 2, "coughing", 0.9) for clock in ("03:00", "21:59:50", "22:00", "23:10")]
    write_day(tmp_path, monday, labels, node="home")
    past = PastDays(RecorderAddress(tmp_path, "home", UTC))
    assert past.dates() == [tuesday, monday]
    found = {}
    for day in (monday, tuesday):
        own = past.read(day, frozenset())
        home = HomeDay([*own.state.microphones.values()], own.moment, UTC, is_past=True)
        (cough,) = (e for e in picture_of(home)["rooms"][0]["lanes"] if e["label"] == "coughing")
        found[day] = cough["counts"], [time for time, *_ in cough["times"][0]["times"]]
    assert found == {
        monday: ([1, 1], ["21:59", "03:00"]),
        tuesday: ([2, None], ["23:10", "22:00"]),
    }
    assert home.when(own.moment.night) == "2 March 22:00", "which is not yesterday"


def test_the_night_and_the_day_have_the_counts_that_the_report_of_the_day_has(tmp_path):
    monday, evening = date(2026, 3, 2), [(at("22:30"), 2, "coughing", 0.9)]
    coughs = [(at(clock), 2, "coughing", 0.9) for clock in ("03:00", "12:00", "23:10")]
    unsure = [(at("12:30"), 2, "coughing", 0.6), (at("15:00"), 4, "phone_ring", 0.6)]
    talking = [(at("19:00") + 20 * n, 15, "speech", 0.9) for n in range(90)]
    logs = tmp_path / "logs"
    about = {"node": "home", "classes": [*GENERAL, "unknown"]}
    write_day(logs, monday - timedelta(days=1), evening, **about)
    write_day(logs, monday, [*coughs, *unsure, *talking], **about)
    past = PastDays(RecorderAddress(logs, "home", UTC)).read(monday, frozenset())
    home = HomeDay([*past.state.microphones.values()], past.moment, UTC, is_past=True)
    picture = picture_of(home)
    page = {
        lane["words"]: [
            {(0, 0): "0", (1, 1): "1?"}.get(pair, f"{pair[0] - pair[1]}" + " (+1?)" * pair[1])
            for pair in zip(lane["counts"], lane["unsure"][1:], strict=True)
        ]
        for lane in picture["rooms"][0]["lanes"]
        if any(lane["counts"]) or lane["uncounted"]
    }
    output = tmp_path / "monday.html"
    make_report(find_home_logs([logs]), Period(monday, 1, UTC), output)
    report = {}
    for row in re.findall(r'<tr><th scope="row">.*?</tr>', output.read_text()):
        counts = re.findall(r'data-head="(?:Night|Day)[^>]*><span class="unit">([^<]*)<', row)
        if counts:
            report[re.search(r"</span>([^<]*)<", row)[1]] = counts
    assert report == page
    assert page["Coughing"] == ["2", "1 (+1?)"]
    assert page["Not recognised"] == ["0", "1"], "a ring that may be something else"
    assert page["Talking"] == ["0", "0"]
    week = tmp_path / "week.html"
    make_report(find_home_logs([logs]), Period(monday, 7, UTC), week)
    assert '>Coughing</th><td data-head="How often">3 (+1?)</td>' in week.read_text()
    total = read_day_sounds(find_home_logs([logs]), monday, UTC).totals["coughing"]
    assert (total.counted, total.unsure) == (4, 1), "as info has it"


def test_what_is_beside_a_television_is_of_the_same_hours_in_the_day_the_week_and_info(tmp_path):
    monday, logs = date(2026, 3, 2), tmp_path / "logs"
    talking = [(at("21:00") + 30 * n, 15, "speech", 0.9) for n in range(240)]
    write_day(logs, monday, talking, classes=[*GENERAL, "unknown"])
    past = PastDays(RecorderAddress(logs, "home", UTC)).read(monday, frozenset())
    home = HomeDay([*past.state.microphones.values()], past.moment, UTC, is_past=True)
    (lane,) = (each for each in picture_of(home)["rooms"][0]["lanes"] if each["label"] == "speech")
    assert lane["uncounted"] == 120, "until 22:00, on the page"
    assert read_day_sounds(find_home_logs([logs]), monday, UTC).totals["speech"].television == 120
    rows = []
    for days in (1, 7):
        output = tmp_path / f"{days}.html"
        make_report(find_home_logs([logs]), Period(monday, days, UTC), output)
        text = output.read_text().replace("\N{NO-BREAK SPACE}", " ")
        each = re.findall(r"<tr>.*?</tr>", text)
        rows.append([" ".join(re.sub("<[^>]*>", " ", row).split()) for row in each])
    day, week = rows
    beside = "30 min beside a television"
    assert f"Talking 120 beside a television 0 0 0 120 beside a television 0 min {beside}" in day
    assert f"Talking 0 120 beside a television 0 min {beside}" in week
    assert "Time with sound 30 min 30 min of it beside a television 30 min" in day
    assert "Time with sound 30 min of it beside a television 30 min" in week
    assert "Last longer sounds a minute or more in ten 22:59" in day
    assert "Last longer sounds a minute or more in ten 22:59" in week


@pytest.mark.parametrize("text", ["2001-01-01", "", "../../etc/passwd", "9999-12-31", "%00", "x"])
def test_a_day_without_logs_is_one_line(lived, text):
    status, answer = got(lived, f"/day?{text}")
    assert (status, answer) == (422, {"error": "There are no logs of this day."})
    assert lived.request("GET", f"/day?{lived.date}", cookie=None)[0] == 403


def test_a_day_within_one_longer_log_is_one_of_the_days(tmp_path):
    home = LiveHome(tmp_path, minutes_ago=4 * DAY_MINUTES)
    for days in (4, 3, 2):
        home.write_segment("speech", days * DAY_MINUTES)
    home.close()
    logs = find_home_logs([tmp_path])
    assert len(logs.entries) == 1
    first, last = (local_time(time, UTC).date() for time in (home.start, logs.end() - 1))
    between = first + timedelta(days=1)
    assert last > between
    assert logs.days(UTC) == [first, between, last]


def test_a_day_is_read_once_and_only_some_are_kept(lived, monkeypatch):
    monkeypatch.setattr(past_days, "_MOST_DAYS", 1)
    days = PastDays(lived.home)
    dates = [day for day in days.dates() if day.isoformat() <= lived.date]
    first = days.read(dates[0], frozenset())
    assert days.read(dates[0], frozenset()) is first
    days.read(dates[1], frozenset())
    assert days.read(dates[0], frozenset()) is not first
    with pytest.raises(BridgeError, match="no logs"):
        days.read(datetime(2001, 1, 1, tzinfo=UTC).date(), frozenset())


def test_a_day_that_takes_long_to_read_holds_nobody_up(lived):
    with lived._page._past._lock, lived.connect() as requested:
        head = f"GET /day?{lived.date} HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {lived.cookie()}"
        requested.sendall(f"{head}\r\n\r\n".encode())
        with lived.stream() as part:
            start = lived.log.write_segment("laughing", 5)
            part("events", lambda it: str(start) in json.dumps(it))


def test_a_past_sound_can_be_called_by_its_name(lived):
    got(lived, f"/day?{lived.date}")
    identifier = f"mic-speech-{lived.coughed + 30 * MINUTE}"
    status, answer = lived.mark(identifier, "television")
    assert (status, json.loads(answer)) == (200, {"said": "You said: Television"})
    _, day = got(lived, f"/day?{lived.date}")
    assert day["events"][0]["said"] == "You said: Television"
    lived.restart()
    _, day = got(lived, f"/day?{lived.date}")
    assert day["events"][0]["said"] == "You said: Television"


def sound_of(home, identifier):
    connection = HTTPConnection("127.0.0.1", home.port, timeout=30)
    connection.request("GET", f"/sound?{quote(identifier)}", headers={"Cookie": home.cookie()})
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content


def test_kept_sound_is_played_only_of_an_event_that_has_it(lived):
    got(lived, f"/day?{lived.date}")
    coughed = f"mic-coughing-{lived.coughed}"
    spoken = f"mic-speech-{lived.coughed + 30 * MINUTE}"
    assert got(lived, f"/kept?{coughed}&{spoken}&none") == (200, [coughed])
    status, content = sound_of(lived, coughed)
    assert status == 200
    with wave.open(io.BytesIO(content)) as sound:
        assert (sound.getframerate(), sound.getnframes()) == (16_000, 80_000)
        assert np.frombuffer(sound.readframes(80_000), "<i2").any()
    for other in (spoken, "none", f"mic-coughing-{lived.coughed + 1}", "../x"):
        assert sound_of(lived, other)[0] == 422
    assert lived.request("GET", f"/sound?{coughed}", cookie=None)[0] == 403


def test_the_sound_of_a_hidden_class_is_never_played(lived):
    got(lived, f"/day?{lived.date}")
    coughed = f"mic-coughing-{lived.coughed}"
    lived.post("/show", {"show": "no", "label": "coughing"})
    patiently(lambda: sound_of(lived, coughed)[0], lambda status: status == 422)
    assert got(lived, f"/kept?{coughed}") == (200, [])
    assert "oughing" not in json.dumps(got(lived, f"/day?{lived.date}")[1])
    lived.post("/show", {"show": "yes", "label": "coughing"})
    patiently(lambda: sound_of(lived, coughed)[0], lambda status: status == 200)


def test_a_hidden_sound_within_a_sound_is_silence(lived):
    event = SoundEvent("mic", "coughing", lived.coughed, lived.coughed + 5 * NANOSECONDS, 1, 5)
    second = event.start + NANOSECONDS
    inside = SoundEvent("mic-water", "shower", second, second + NANOSECONDS, 1, 1)
    content = lived._page._sounds.wav(event, [inside])
    with wave.open(io.BytesIO(content)) as sound:
        samples = np.frombuffer(sound.readframes(80_000), "<i2").reshape(5, -1)
    assert [bool(each[1:].any()) for each in samples] == [True, False, True, True, True]


def test_no_sound_leaves_a_home_whose_owner_did_not_allow_it(tmp_path):
    with serving(tmp_path) as home:
        start = home.log.write_segment("coughing", 10, 3)
        home.log.hears("silence")
        with home.stream() as part:
            part("events", lambda events: events["events"])
        keep_sound(home.log.folder, "mic", start, 3)
        assert got(home, f"/kept?mic-coughing-{start}") == (200, [])
        assert sound_of(home, f"mic-coughing-{start}")[0] == 422


# Languages


def placeholders(text):
    return {*re.findall(r"\{(\w+)\}", text)}


def test_a_refusal_speaks_the_language_of_the_browser(lived):
    _, _, text = lived.request("GET", "/", cookie=None, **GERMAN)
    assert text.startswith("Diese Seite öffnet sich nur mit ihrer vollständigen Adresse")
    _, _, text = lived.request("GET", f"/?token={'x' * 20}", cookie=None, **GERMAN)
    assert text.startswith("Der Schlüssel (token) in dieser Adresse ist falsch. Diese Seite öffnet")
    _, _, text = lived.request("GET", "/", Host="box.local", **GERMAN)
    assert "unter dem Namen box.local, den" in text
    assert 'names = ["box.local"] in [bridge.page]' in text
    status, _, text = lived.request("POST", "/mark", "{}", **GERMAN, **JSON)
    assert (status, text) == (
        403,
        "Eine Anfrage, die etwas ändert, muss ihre Seite nennen (Origin).\n",
    )


def test_a_refusal_keeps_its_cause_in_another_language():
    words = translation_for("de")
    error = user_error(BridgeError("disk full"))
    assert words.translated(str(error)) == "Es wurde nicht gespeichert: disk full"
    assert words.translated("nothing of ours") == "nothing of ours"


@pytest.mark.parametrize("language", sorted(languages() - {"en"}))
def test_each_language_has_the_texts_of_english_with_their_placeholders(language):
    english, other = translation_for("en").texts, translation_for(language).texts
    own = {key for key in other if not key.startswith("class.")}
    assert own == english.keys()
    assert {key: placeholders(other[key]) for key in own} == {
        key: placeholders(text) for key, text in english.items()
    }
    assert {key for key in other if key.startswith("class.")} == {
        *(f"class.{c.name}" for c in CLASSES),
        f"class.{RUNNING_WATER}",
    }
    assert len(other["months"].split()) == 12
    assert len(other["weekdays"].split()) == 7


@pytest.mark.parametrize(
    ("header", "language"),
    [
        ("de-AT,de;q=0.9,en;q=0.5", "de"),
        ("xx,en;q=0.5,de;q=0.8", "de"),
        ("xx", "en"),
        ("", "en"),
        ("de;q=0", "en"),
        ("de;q=x, en", "en"),
        ("../../secret", "en"),
        ("d" * 9999, "en"),
    ],
)
def test_the_language_is_the_first_that_the_browser_wants_and_the_page_has(header, language):
    assert preferred_language(header) == language


def test_a_german_browser_gets_german_words_dates_and_errors(lived):
    _, _, page = lived.request("GET", "/", **GERMAN)
    assert '<html lang="de">' in page
    assert "Letzte Geräusche" in page
    assert "{{" not in page
    _, day = got(lived, f"/day?{lived.date}", **GERMAN)
    assert {"Husten", "Weinen", "Telefonklingeln"} <= {n["words"] for n in day["rooms"][0]["lanes"]}
    assert day["title"].split(",")[0] in translation_for("de").texts["weekdays"].split()
    assert got(lived, "/day?x", **GERMAN)[1]["error"].startswith("Von diesem Tag")
    origin = f"http://127.0.0.1:{lived.port}"
    for event, label, text in (
        (f"mic-coughing-{lived.coughed}", "Türglocke", "Dieser Name geht nicht"),
        ("none", "music", "Dieses Geräusch liegt für diese Seite zu lange zurück"),
    ):
        body = json.dumps({"event": event, "label": label})
        answer = lived.request("POST", "/mark", body, Origin=origin, **JSON, **GERMAN)
        assert (answer[0], json.loads(answer[2])["error"].startswith(text)) == (422, True)
    picture = picture_of(home_at(9, tiled((-3, 9), *NIGHT), language="de"))
    assert picture["sentence"] == ("Eine ruhige Nacht: zweimal Husten (02:10 und 06:13).")


def test_the_configured_language_holds_for_every_browser_and_a_missing_one_is_english(tmp_path):
    for language, title in (("de", "Zuhause"), ("xx", "The home")):
        with serving(tmp_path / language, {"language": language}) as home:
            assert f"<title>{title}</title>" in home.request("GET", "/", **GERMAN)[2]
    with pytest.raises(ValidationError):
        PageSettings(language="../../etc")


# On a phone's home screen, and behind a proxy


def test_the_page_can_be_installed_and_is_small(lived):
    page = lived.request("GET", "/")[2]
    own = re.findall(r'(?:href|src)="([^"]+)"', page)
    assert not any(each.startswith(("/", "http")) for each in own)
    manifest = json.loads(lived.request("GET", "/page.webmanifest")[2])
    assert (manifest["display"], manifest["start_url"]) == ("standalone", "./")
    assert {icon["src"] for icon in manifest["icons"]} == {"icon-512.png", "icon.svg"}
    scripts = ["picture.js", "sounds.js", "elements.js"]
    size = 0
    for name in {"", *own, *scripts, *(icon["src"] for icon in manifest["icons"])}:
        connection = HTTPConnection("127.0.0.1", lived.port, timeout=30)
        connection.request("GET", f"/{name}", headers={"Cookie": lived.cookie()})
        answer = connection.getresponse()
        assert answer.status == 200, name
        assert answer.headers["Cache-Control"] == "no-store"
        size += len(answer.read())
        connection.close()
    assert size < 200_000


def test_the_page_works_behind_the_ingress_of_home_assistant(phone, lived):
    path = "/api/hassio_ingress/abc123"
    with proxying(lived.port, path, {"X-Ingress-Path": path}) as address:
        phone.open(SimpleNamespace(url=f"{address}?token={lived.token}"))
        assert phone.of("location.href") == address
        phone.until("!document.getElementById('day-before').disabled")
        phone.of("document.getElementById('day-before').click()")
        phone.until("document.getElementById('day-sentence').innerText")
        assert phone.of("seen") == []
        assert phone.of("document.querySelector('[rel=manifest]').href.startsWith(location.href)")
    hostile = {"X-Ingress-Path": '"><script>alert(1)</script>'}
    assert "alert(1)" not in str(lived.request("GET", "/", **hostile))
    assert lived.request("GET", "/", cookie=None, **{"X-Ingress-Path": path})[0] == 403
    assert lived.request("GET", "/", Host="evil.example", **{"X-Ingress-Path": path})[0] == 403


def test_a_telephone_that_may_be_something_else_is_in_no_count_and_no_picture_and_needs_no_look(
    tmp_path,
):
    rings = [(8, 5, "phone_ring", 0.95), (8.2, 5, "phone_ring", 0.69)]
    home = home_at(9, tiled((-3, 9), *rings))
    (lane,) = (each for each in picture_of(home)["rooms"][0]["lanes"] if each["count"])
    assert (lane["label"], lane["counts"], lane["unsure"]) == ("phone_ring", [0, 1], [0, 0, 0])
    assert sum(bar != "0" for bar in lane["bars"]) == 1
    assert (lane["pale"], lane["uncounted"]) == ("", 0)
    (_, event) = home.microphones[0].events("phone_ring", 0)
    answer = Mark("mic", event.start, event.end, "phone_ring")
    home = home._replace(corrections=EventCorrections(tmp_path, "home").of_day([answer]))
    (lane,) = (each for each in picture_of(home)["rooms"][0]["lanes"] if each["count"])
    assert lane["counts"] == [0, 2], "a person confirmed it"
    sure, unsure = (
        Bout([SoundEvent("mic", "phone_ring", start, start + NANOSECONDS, confidence, 1.0)])
        for start, confidence in ((MIDNIGHT, 0.95), (MIDNIGHT + NANOSECONDS, 0.4))
    )
    assert [needs_review(bout, 0) for bout in (sure, unsure)] == [True, False]
    both = Bout([*sure.events, *unsure.events])
    cough = Bout([sure.first._replace(label="coughing", confidence=0.4)])
    assert needs_review(both, 0)
    assert needs_review(cough, 0)


SCREAM = 4.0, "music", 0.33, {"coughing": 0.05, "yelling": 0.12}, 48.0


def test_what_may_be_a_cough_next_to_one_is_no_second_entry_that_needs_a_look():
    def sound(seconds, label, microphone="mic"):
        start = MIDNIGHT + round(seconds * NANOSECONDS)
        return SoundEvent(microphone, label, start, start + NANOSECONDS, 0.4, 1.0)

    def doubt(event, level=10.0, **shares):
        return DoubtfulSound(event.label, event.start, event.end, level, shares)

    cough = sound(100, "coughing")
    before, after = sound(88.9, "objects_activity"), sound(95, "objects_activity")
    elsewhere = sound(101, "objects_activity", "bath")
    every = [before, after, cough, elsewhere]

    def looked_at(level=10.0, hidden=(), **shares):
        shares = {"coughing": 0.33, "crying": 0.0, "yelling": 0.0} | shares
        doubts = {e.id: doubt(e, level, **shares) for e in (before, after, elsewhere)}
        unsure = [before, after, elsewhere]
        return [
            unsure.index(e)
            for e in unsure
            if e.id in events_to_review(doubts, unsure, every, hidden)
        ]

    assert looked_at() == [0, 2], "ten seconds and more away, or in another room"
    assert looked_at(yelling=0.2) == [0, 1, 2], "it may be something else"
    assert looked_at(level=40.0) == [0, 1, 2], "it is loud"
    assert looked_at(hidden=("coughing",)) == []


def test_a_loud_sound_that_the_model_is_unsure_of_needs_a_look_on_its_day_and_later(tmp_path):
    yesterday = (datetime.now(UTC) - timedelta(hours=30)).replace(minute=2)
    sound = (3600.0 * yesterday.hour + 60 * yesterday.minute, *SCREAM)
    write_day(tmp_path / "logs", yesterday.date(), doubts=[sound])
    with serving(tmp_path) as served, served.stream() as part:
        served.log.write_segment("music", 62, 4, 0.95)
        served.log.doubts(60, 5.0, "objects_activity", 0.4, {"coughing": 0.05}, 20.0)
        scream = served.log.doubts(58, *SCREAM)
        events = part("events", lambda it: any(each["doubtful"] for each in it["events"]))["events"]
        (entry,) = (each for each in events if each["look"])
        assert (entry["words"], entry["sure"], entry["times"]) == (
            "Perhaps shouting",
            "loud, and the model is not sure",
            "",
        )
        assert [each["label"] for each in events if not each["look"]] == [
            "objects_activity",
            "music",
        ]
        assert served.mark(entry["id"], "yelling")[0] == 200
        assert [(mark.start, mark.label) for mark in served.marks()] == [(scream, "yelling")]
        date = yesterday.astimezone(served.home.zone).date().isoformat()
        past = json.loads(served.request("GET", f"/day?{date}")[2])
        (entry,) = past["events"]
        assert (entry["words"], entry["look"]) == ("Perhaps shouting", True)


def test_doubtful_sounds_of_one_moment_are_one_entry_that_names_their_classes():
    others = [event(12, "music"), event(20, "music")]
    moment = [event(0, "music"), event(0.1, "unknown"), event(0.5, "speech"), event(1.5, "music")]
    doubts = {each.id: DoubtfulSound(each.label, each.start, each.end, 40.0, {}) for each in moment}
    folded = bouts([*moment, *others], doubts)
    assert [[*bout.events] for bout in folded] == [others[1:], others[:1], moment]
    shown = ShownBouts(folded[0].end, UTC, translation_for("en"), lambda _: "", is_alone=True)
    entry = shown.describe(folded[-1])
    assert entry["words"] == "A loud sound"
    assert entry["sure"] == "loud, and the model is not sure: perhaps music or talking"
    assert (entry["times"], entry["length"]) == ("", ""), "they are parts of one sound"
    assert entry["colour"] == colour_on_paper("unknown"), "it is of no class"
    later = event(3, "speech")
    assert len(bouts([*moment, later], doubts | {later.id: doubts[moment[0].id]})) == 2


def test_at_most_four_doubtful_entries_need_a_look_and_these_are_the_loudest():
    events = [event(10 * number, "music") for number in range(9)]
    doubts = {
        each.id: DoubtfulSound("music", each.start, each.end, 30.0 + number, {})
        for number, each in enumerate(events)
    }
    folded = bouts(events, doubts)
    assert len(folded) == 9
    important = [bout.first for bout in folded if bout.is_important]
    assert important == events[:4:-1]


# In a browser


def lane(words):
    return (
        "[...document.querySelectorAll('.lane')]"
        f".find((e) => e.querySelector('.name').textContent === {words!r})"
    )


def test_the_first_screen_of_a_phone_has_the_sentence_and_the_whole_picture(phone, lived):
    lived.log.hears("silence")
    phone.open(lived)
    phone.until(lane("Coughing"))
    size = float(phone.of("getComputedStyle(document.querySelector('.sentence')).fontSize")[:-2])
    assert size >= 25
    assert phone.of("document.querySelector('.picture').getBoundingClientRect().bottom") < 844
    sounded = phone.of("[...document.querySelectorAll('.lane .name')].map((e) => e.textContent)")
    assert sounded[0] == "Coughing"
    assert "Crying" not in sounded


def test_a_lane_is_opened_by_keyboard_and_shows_its_times(phone, lived):
    phone.open(lived)
    phone.until(lane("Coughing"))
    phone.of(f"{lane('Coughing')}.focus()")
    phone.press("Enter", "\r")
    phone.shows(".panel", "Coughing · since yesterday evening")
    phone.shows(".panel", "Hide coughing everywhere")
    assert phone.of("document.querySelectorAll('.panel li').length") == 1
    assert phone.of(f"{lane('Coughing')}.getAttribute('aria-expanded')") == "true"
    phone.press("Enter", "\r")
    phone.until("!document.querySelector('.panel')")


def test_one_of_the_times_of_a_count_is_corrected_there_and_no_other(phone, tmp_path):
    with serving(tmp_path) as served:
        served.log.hears("silence")
        starts = [served.log.write_segment("coughing", minutes, 2) for minutes in (65, 63, 61)]
        phone.open(served)
        phone.until(lane("Coughing"))
        phone.of(f"{lane('Coughing')}.dispatchEvent(new MouseEvent('click', {{bubbles: true}}))")
        phone.until("document.querySelectorAll('.panel li').length === 3")
        phone.of("document.querySelectorAll('.panel li summary')[2].click()")
        phone.until("document.querySelector('.panel li fieldset')")
        phone.of(
            "document.querySelector('.panel input[value=laughing]').click();"
            "document.querySelector('.panel form button').click()"
        )
        count = f"{lane('Coughing')}.querySelector('.count').textContent"
        phone.until(f"{count}.startsWith('2')")
        phone.shows(".panel li:last-child", "Laughing")  # the answer stays in its place
        assert [(mark.start, mark.label) for mark in served.marks()] == [(starts[0], "laughing")]
        phone.until(lane("Laughing"))
        assert phone.of(PALE_TEXTS) == []
        assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
        assert phone.of("seen") == []


def test_a_past_day_and_the_week_are_one_tap_away_and_have_their_sound(phone, lived):
    phone.open(lived)
    phone.until("document.getElementById('dates').options.length > 2")
    phone.of("document.getElementById('show-week').click()")
    phone.until("document.querySelectorAll('#week .marks').length > 2")
    phone.of(
        "const dates = document.getElementById('dates');"
        f"dates.value = '{lived.date}'; dates.dispatchEvent(new Event('change'));"
    )
    phone.shows("#day-sentence", "coughing once")
    phone.shows("#events-heading", "Other sounds")
    phone.until("document.querySelector('#look .play:not([hidden])')")
    phone.of("document.querySelector('#look .play').click()")
    phone.until("document.querySelector('#look .play').textContent === '■'")
    assert phone.of(PALE_TEXTS) == []
    assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    phone.of("dates.value = dates.options[0].value; dates.dispatchEvent(new Event('change'));")
    phone.shows("#events-heading", "Other sounds")
    phone.shows("#day-sentence", "Today")
    assert phone.of("document.querySelector('#events .play:not([hidden])')") is None
    assert phone.of("seen") == []


def test_what_somebody_has_answered_is_grey(phone, lived):
    phone.open(lived)
    entry = next(each for each in lived.events() if each["label"] == "music")
    phone.until("document.querySelector('#events li')")
    assert phone.of("document.querySelectorAll('#events .reviewed').length") == 0
    lived.mark(entry["id"], "music")
    phone.shows("#events .reviewed", "You said: Music")
    assert phone.of(PALE_TEXTS) == []


def test_at_1366_the_sounds_stand_beside_the_picture(phone, lived):
    phone.open(lived, 1366, 768)
    phone.until(lane("Coughing"))
    edges = "document.querySelector('{}').getBoundingClientRect().{}"
    right = phone.of(edges.format(".picture", "right"))
    assert right < phone.of(edges.format("#sounds", "left"))


def test_a_long_list_begins_short_and_counts_lie_over_the_line_of_now(phone, tmp_path):
    with serving(tmp_path) as home:
        for number in range(8):
            home.log.write_segment(("music", "speech")[number % 2], 90 - 10 * number, 4)
        home.log.hears("silence")
        phone.open(home)
        phone.shows("#all-events", "Show 2 more")
        drawn = (
            "[...document.querySelectorAll('#events > li')].filter((e) => e.offsetHeight).length"
        )
        assert phone.of(drawn) == 6
        phone.of("document.getElementById('all-events').click()")
        assert phone.of(drawn) == 8
        assert phone.of("document.activeElement.closest('li').matches(':nth-child(7)')")
        order = "document.querySelector('.moment').compareDocumentPosition({}) & 4"
        assert phone.of(order.format("document.querySelector('.lane')"))
        assert phone.of("document.getElementById('key-beside').hidden"), "nothing is drawn so"
        pictures = [name for role, name in phone.tree() if name.startswith("Sounds, ")]
        assert len(pictures) == 1
        assert pictures[0].endswith("from 22:00 of the evening before.")
        phone.shows("#rooms .note", "Not listening: 22:00 to")


def test_of_each_class_the_newest_need_a_look_and_the_rest_is_behind_one_tap(phone, tmp_path):
    with serving(tmp_path) as home:
        for number in range(7):
            home.log.write_segment("coughing", 100 - 10 * number, 2)
        home.log.hears("silence")
        phone.open(home, 390, 560)
        phone.shows("#look .fold", "Coughing · 5 earlier")
        phone.shows("#look .fold .about", ", ")
        drawn = "[...document.querySelectorAll('#look > li')].filter((e) => e.offsetHeight).length"
        assert phone.of(drawn) == 3
        phone.of("document.querySelector('.fold button').click()")
        assert phone.of(drawn) == 8
        button = "document.querySelector('.fold button')"
        assert phone.of(f"{button}.getAttribute('aria-expanded')") == "true"
        assert phone.of(f"{button}.getAttribute('aria-label')") == "Hide: Coughing, 5 earlier"
        assert phone.of(PALE_TEXTS) == []
        phone.of("document.querySelector('#look summary').click()")
        phone.until("document.querySelector('#look form')")
        phone.of("document.querySelector('#look form').scrollIntoView()")
        save = phone.of("document.querySelector('.save button').getBoundingClientRect().bottom")
        assert save <= 560, "in sight while one chooses"
        assert phone.of(drawn) == 8
        phone.of("document.querySelector('.fold button').click()")
        assert phone.of(drawn) == 3


def test_classes_that_did_not_sound_are_one_row_that_opens(phone, lived):
    phone.open(lived)
    phone.until("document.getElementById('dates').options.length > 2")
    phone.of(
        "const chosen = document.getElementById('dates');"
        f"chosen.value = '{lived.date}'; chosen.dispatchEvent(new Event('change'));"
    )
    phone.until("document.querySelector('button.zero')?.offsetHeight")
    names = phone.text("button.zero").partition(": ")[2].split(", ")
    assert "music" in names
    assert "coughing" not in names
    rows = "[...document.querySelectorAll('tbody tr')].filter((e) => e.offsetHeight).length"
    few = phone.of(rows)
    phone.of("document.querySelector('button.zero').click()")
    assert phone.of(rows) == few + len(names)
    assert phone.of(PALE_TEXTS) == []
    phone.of("document.querySelector('button.zero').click()")
    assert phone.of(rows) == few


def test_one_tap_confirms_a_sound_and_its_row_folds_away_when_nobody_looks(phone, tmp_path):
    with serving(tmp_path) as home:
        home.log.write_segment("coughing", 40, 2, 0.6)
        home.log.write_segment("coughing", 20, 2, 0.6)
        home.log.hears("silence")
        phone.open(home)
        count = "document.querySelector('.lane .count').textContent.replaceAll('\\u2009', ' ')"
        phone.until(f"{count} === '2?'")
        yes = "document.querySelector('#look .yes')"
        assert phone.of(f"{yes}.textContent.startsWith('Yes (Coughing, ')")
        phone.of(f"{yes}.click()")
        phone.shows("#look .said", "You said: Coughing")
        assert phone.of(f"{yes}.hidden")
        assert [mark.label for mark in home.marks()] == ["coughing"]
        phone.until(f"{count} === '1 (+1?)'")
        assert phone.of("document.querySelectorAll('#look > li').length") == 2, "it stays in sight"
        phone.of("(() => { const now = Date.now; Date.now = () => now() + 60000; })()")
        phone.shows("#look .fold .what", "Done · 1")
        drawn = "[...document.querySelectorAll('#look > li')].filter((e) => e.offsetHeight)"
        assert phone.of(f"{drawn}.length") == 2
        phone.of("document.querySelector('#look .fold button').click()")
        assert phone.of(f"{drawn}.map((e) => e.matches('.reviewed'))") == [False, False, True]
        assert phone.of("[...document.querySelectorAll('#look .yes')].map((e) => e.hidden)") == [
            *(False, True),
        ]


def test_a_sound_of_which_nobody_knows_what_it_was_is_left_open_and_folds_away(phone, tmp_path):
    with serving(tmp_path) as home:
        home.log.write_segment("coughing", 40, 2, 0.6)
        home.log.write_segment("coughing", 20, 2, 0.6)
        home.log.hears("silence")
        phone.open(home)
        phone.until("document.querySelectorAll('#look > li').length === 2")
        phone.of("document.querySelector('#look summary').click()")
        leave = "[...document.querySelectorAll('#look form button')][2]"
        assert phone.of(f"{leave}.textContent") == "I don\N{RIGHT SINGLE QUOTATION MARK}t know"
        phone.of(f"{leave}.click()")
        phone.shows("#look .said", "Left open")
        assert home.marks() == []
        phone.open(home)  # again, by the same browser
        phone.shows("#look .fold .what", "Done · 1")
        drawn = "[...document.querySelectorAll('#look > li')].filter((e) => e.offsetHeight)"
        assert phone.of(f"{drawn}.length") == 2
        phone.of("document.querySelector('#look .fold button').click()")
        assert phone.of(f"{drawn}[2].querySelector('.yes').hidden") is False, "it can be answered"


def test_on_a_phone_the_questions_follow_the_picture_and_a_turned_tablet_keeps_an_answer(
    phone, lived
):
    tops = (
        "['#rooms', '#look', '#tables', '#events'].map((e) =>"
        "Math.round(document.querySelector(e).getBoundingClientRect().top))"
    )
    order = (
        "[...document.querySelectorAll('section[id]')]"
        ".filter((e) => e.offsetHeight).map((e) => e.id)"
    )
    phone.open(lived, 390)
    phone.until("document.querySelector('#look input, #look summary')")
    places = phone.of(tops)
    assert places == sorted(places)
    assert phone.of(order)[1:5] == ["day", "looked-at", "counts", "sounds"]
    phone.of("document.querySelector('#look summary').click()")
    phone.until("document.querySelector('#look input[type=text]')")
    phone.of("document.querySelector('#look input[type=text]').focus()")
    phone.write("Kettle")
    phone.resize(1366, 844)
    phone.until("document.getElementById('aside').contains(document.getElementById('looked-at'))")
    assert phone.focus() == "Kettle"
    picture, questions, counts, _ = phone.of(tops)
    assert questions < counts
    assert abs(questions - picture) < 300
    assert phone.of(order)[1:4] == ["day", "counts", "looked-at"]


def test_a_dark_class_is_lighter_on_a_dark_ground_and_what_does_not_count_is_pale(phone, lived):
    drawn = "getComputedStyle({}.querySelector('{}'))['{}']"
    for scheme in ("light", "dark"):
        phone.open(lived, 390, 844, scheme)
        phone.until(lane("Coughing"))
        element = lane("Coughing")
        fill = phone.of(drawn.format(element, ".marks:not(.pale, .unsure)", "fill"))
        assert fill == "rgb(210, 94, 1)"
        opacity = float(phone.of(drawn.format(element, ".pale", "fill-opacity")))
        assert opacity == 0.3
        phone.of(
            "import('./elements.js').then(({ swatch }) => { const it = swatch([139, 69, 19]);"
            "it.id = 'brown'; document.body.append(it); })"
        )
        phone.until("document.getElementById('brown')")
        brown = phone.of("getComputedStyle(document.getElementById('brown')).backgroundColor")
        assert brown == {"light": "rgb(139, 69, 19)", "dark": "rgb(209, 181, 161)"}[scheme]


_SHIFTS = """
window.moved = [];
new PerformanceObserver((list) => moved.push(...list.getEntries().map(({ value, sources }) =>
  [value, sources.map(({ node, previousRect, currentRect }) =>
    [node?.id || node?.className || node?.nodeName, previousRect.y, currentRect.y])])))
  .observe({ type: "layout-shift", buffered: true });
"""


def drawn_lanes(day):
    """The classes with a mark in the picture of a day."""
    lanes = (lane for each in day["rooms"] for lane in each["lanes"])
    return [lane["label"] for lane in lanes if lane["bars"]]


@pytest.mark.parametrize("width", [390, 1366])
def test_nothing_moves_while_the_page_loads_and_is_updated(phone, tmp_path, width):
    with serving(tmp_path) as home:
        home.log.write_segment("silence", 350, 60)
        for minutes, label in ((90, "coughing"), (60, "speech"), (30, "music")):
            home.log.write_segment(label, minutes, 30)
        home.log.hears("silence")
        with home.stream() as part:
            # The classes of the model come with the first labels, and a row for each of them.
            part("day", lambda day: len(drawn_lanes(day)) == 3 and day["missing"])
        added = phone._browser.call("Page.addScriptToEvaluateOnNewDocument", source=_SHIFTS)
        # Scroll bars of a phone lie above the page.
        phone._browser.call("Emulation.setScrollbarsHidden", hidden=width < 640)
        phone.open(home, width)
        for label, words in (("speech", "Talking"), ("silence", "Quiet")):
            home.log.write_segment(label, 0.05)
            with home.log.listening(label):
                phone.shows("#heard", words)
        home.log.write_status("mic", 1, "too loud for this microphone, in one second of five")
        phone.until("document.querySelector('.warning #attention')")
        phone.wait_until_drawn()
        assert sum(value for value, _ in phone.of("moved")) < 0.02, (
            phone.of("moved"),
            phone.of("document.querySelector('.sentence').innerText"),
        )
        phone._browser.call("Page.removeScriptToEvaluateOnNewDocument", **added)
        phone._browser.call("Emulation.setScrollbarsHidden", hidden=False)


def test_what_can_be_operated_has_a_name_of_its_own(phone, tmp_path):
    with serving(tmp_path, microphones=("bath", "kitchen")) as home:
        for name in ("bath", "kitchen"):
            home.log.write_segment("silence", 350, 60, microphone=name)
            home.log.write_segment("coughing", 60, 4, microphone=name)
            home.log.hears("silence", name)
        phone.open(home)
        phone.until("document.querySelectorAll('#look details').length === 2")
        nodes = phone._browser.call("Accessibility.getFullAXTree")["nodes"]
    operable = [
        (node["role"]["value"], node["name"]["value"])
        for node in nodes
        if not node["ignored"]
        and any(each["name"] == "focusable" for each in node.get("properties", []))
    ]
    assert len(operable) > 20
    assert all(name for _, name in operable)
    answers = [name for role, name in operable if role == "DisclosureTriangle"]
    assert len({*answers}) == len(answers) == 4


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_german_phone_is_shown_a_page_that_fits(phone, lived, scheme):
    agent = phone.of("navigator.userAgent")
    call = phone._browser.call
    call("Network.enable")
    call("Network.setUserAgentOverride", userAgent=agent, acceptLanguage="de")
    try:
        lived.log.hears("silence")  # a microphone listens for fifteen seconds after its last label
        phone.open(lived, 390, 844, scheme)
        phone.shows("#events-heading", "Andere Geräusche")
        phone.shows("#heard", "Ruhe")
        phone.of(f"{lane('Husten')}.dispatchEvent(new MouseEvent('click'))")
        phone.shows(".panel", "Husten überall ausblenden")
        names = phone.of("[...document.querySelectorAll('tbody th')].map((e) => e.textContent)")
        assert "Haushalts\N{SOFT HYPHEN}geräusche" in names
        assert phone.of(PALE_TEXTS) == []
        assert phone.of("document.scrollingElement.scrollWidth - innerWidth") <= 0
    finally:
        call("Network.setUserAgentOverride", userAgent=agent, acceptLanguage="en")


def test_a_phone_that_is_offline_says_so_in_one_line_and_keeps_what_it_shows(phone, tmp_path):
    with serving(tmp_path) as home:
        home.log.write_segment("coughing", 40, 3)
        home.log.hears("silence")
        phone.open(home)
        phone.until(lane("Coughing"))
        phone.of("Object.defineProperty(navigator, 'onLine', { get: () => false })")
        home.end()
        phone.shows("#trouble", "This device is offline. What you see is as of 12:")
        assert phone.of(f"{lane('Coughing')} !== undefined")
        home.restart()
        phone.until("document.getElementById('trouble').hidden")
