"""One table of classes: what a sound is called, by others too, is the same for all that ask."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hearthlog.analyzer.report.wording import several_in_words
from hearthlog.analyzer.training.manifest import BUILTIN, LABELS, Scenario
from hearthlog.analyzer.training.train import (
    default_transitions,
    expected_durations,
)
from hearthlog.models.classes import (
    CLASS_NAME,
    CLASSES,
    class_name,
    colour,
    colour_on_paper,
    find_class,
    in_words,
    meant_by,
    ordered,
    translation,
)
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import MOST_CLASSES
from hearthlog.models.modelfile import load_model

DOCS = Path(__file__).parents[1] / "docs" / "models.md"
OF_0_1_0 = Path(__file__).parent / "golden" / "0.1.0" / "models" / "smoothed.safetensors"
AUDIOSET = {
    "Silence": "silence",
    "Speech": "speech",
    "Music": "music",
    "Telephone bell ringing": "phone_ring",
    "Ringtone": "phone_ring",
    "Cough": "coughing",
    "Crying, sobbing": "crying",
    "Shout": "yelling",
    "Yell": "yelling",
    "Laughter": "laughing",
    "Toilet flush": "flushing_water",
    "Water tap, faucet": "tap_water",
}
DURATIONS_OF_0_1_0 = {"silence": 60.0, "speech": 5.0, "coughing": 0.5, "phone_ring": 5.0}
ALIASES = [(alias, row.name) for row in CLASSES for alias in row.aliases]
OWN = st.from_regex(CLASS_NAME, fullmatch=True)


@pytest.mark.parametrize("label", sorted({*LABELS, *BUILTIN["bathroom"].classes, "unknown"}))
def test_every_label_has_a_colour_of_its_own_a_duration_and_words(label):
    row = find_class(label)
    assert row.name == label
    assert [other.name for other in CLASSES if other.colour == row.colour] == [label]
    assert all(0 <= part <= 255 for part in row.colour)
    assert row.seconds > 0
    assert row.words[0].isupper()
    assert CLASS_NAME.fullmatch(label)


def test_how_long_a_sound_is_expected_to_go_on_without_a_pause():
    seconds = {"silence": 2.5, "coughing": 1, "music": 20, "shower": 60}
    others = ("speech", "phone_ring", "crying", "yelling", "laughing", "objects_activity")
    others += (
        "flushing_water",
        "tap_water",
        "bathroom_other",
        "other_negative",
        "television",
        "other",
    )
    seconds |= dict.fromkeys((*others, "unknown"), 10)
    assert {row.name: row.seconds for row in CLASSES} == seconds


def test_no_name_is_of_two_classes():
    names = [name for row in CLASSES for name in (row.name, *row.aliases)]
    assert sorted(names) == sorted(set(names))
    assert [find_class(name) for name in names] == [
        row for row in CLASSES for _ in (row.name, *row.aliases)
    ]


def test_the_documented_names_are_those_of_the_table():
    lines = re.findall(r"^\| (`.*`) \| (`.*`) \|$", DOCS.read_text("utf-8"), re.MULTILINE)
    documented = {name.strip("`"): tuple(re.findall("`(.*?)`", names)) for name, names in lines}
    assert documented == {row.name: row.aliases for row in CLASSES if row.aliases}


@pytest.mark.parametrize(("name", "expected"), AUDIOSET.items())
def test_the_names_of_audioset_mean_our_classes_however_they_are_spelt(name, expected):
    spelt = name.replace(", ", "_").replace(" ", "_")
    for each in (name, spelt, spelt.lower(), name.replace(",", " and"), name.upper()):
        assert class_name(each) == expected


def test_control_characters_stand_for_nothing():
    for label in ("Crying\x1b sobbing", "crying\nsobbing", "crying\x00sobbing", "cough\n"):
        assert find_class(label) is None


@pytest.mark.parametrize("name", ["Screaming", "Giggle", "Baby cry, infant cry", "Whimper (dog)"])
def test_a_kind_of_a_sound_is_a_class_of_its_own(name):
    assert find_class(name) is None


@pytest.mark.parametrize(("alias", "name"), ALIASES)
def test_an_alias_is_drawn_told_and_expected_to_last_as_its_class(alias, name):
    assert colour(alias) == colour(name)
    assert (in_words(alias), several_in_words(alias)) == (in_words(name), several_in_words(name))
    assert expected_durations([alias]) == expected_durations([name])


def test_a_model_of_aliases_is_smoothed_as_one_of_our_names():
    one, other = (default_transitions(["silence", *names]) for names in zip(*ALIASES, strict=True))
    np.testing.assert_array_equal(one, other)


def test_a_model_of_0_1_0_keeps_the_durations_that_it_has_learned():
    model = load_model(OF_0_1_0)
    expected = 0.05 / (1 - model.transitions.diagonal())
    seconds = [DURATIONS_OF_0_1_0[name] for name in model.classes]
    np.testing.assert_allclose(expected, seconds)
    assert Classifier(model).transitions is model.transitions
    assert not np.array_equal(default_transitions(model.classes), model.transitions)


@given(OWN)
def test_a_class_of_ones_own_keeps_its_name_and_has_words_and_a_bright_colour_made_of_it(name):
    assume(find_class(name) is None)
    assert class_name(name) == name
    assert in_words(name) == several_in_words(name) == name.replace("_", " ").capitalize()
    assert all(70 <= part <= 255 for part in colour(name))
    assert expected_durations([name]).tolist() == [10.0]


def test_the_colour_of_a_class_of_ones_own_never_changes():
    assert colour("my_dog") == (70, 124, 100)


@given(st.text(max_size=20), st.lists(OWN | st.sampled_from([n for n, _ in ALIASES])))
def test_a_label_that_is_among_the_names_means_itself_alone(label, names):
    assert meant_by(label, [*names, label]) == [label]


def test_another_name_means_all_that_are_of_its_class():
    assert meant_by("Crying, sobbing", ["crying", "speech"]) == ["crying"]
    assert meant_by("crying", ["crying_sobbing", "speech"]) == ["crying_sobbing"]
    assert meant_by("yelling", ["yell", "shout", "speech"]) == ["yell", "shout"]
    assert meant_by("Yell", ["yell", "shout", "speech"]) == ["yell"]
    assert meant_by("my_dog", ["speech"]) == []


def test_labels_are_called_as_others_call_them_unless_these_tell_more_apart():
    labels = ["cough", "yelling", "my_dog", "speech"]
    assert translation(labels, ["speech", "coughing", "yell", "shout"]) == {
        "cough": "coughing",
        "yelling": "yelling",
        "my_dog": "my_dog",
        "speech": "speech",
    }


def with_unknown(labels, classes, sources=5, ignored=()):
    scenario = Scenario("x", {name: (name,) for name in classes}, frozenset(ignored))
    pairs = [(label, str(number)) for number in range(sources) for label in labels]
    return scenario.with_unknown(pairs).classes.get("unknown")


def test_labels_of_no_class_make_up_unknown_if_five_sources_have_them():
    assert with_unknown(["speech", "rain", "dog"], ["speech", "music"]) == ("dog", "rain")
    assert with_unknown(["speech", "rain"], ["speech", "music"], sources=4) is None
    assert with_unknown(["speech", "Speech"], ["speech", "music"]) is None


def test_what_is_left_out_is_not_learned_as_unknown():
    assert with_unknown(["Cough", "dog"], ["speech", "music"], ignored=["coughing"]) == ("dog",)
    assert with_unknown(["phone_ring"], ["ringtone", "telephone_bell_ringing"]) is None


def test_a_scenario_with_as_many_classes_as_a_model_may_have_has_no_unknown():
    names = [f"class_{number}" for number in range(MOST_CLASSES)]
    assert with_unknown(["dog"], names) is None
    assert with_unknown(["dog"], names[1:]) == ("dog",)


def test_every_class_is_seen_on_paper():
    assert all(min(colour_on_paper(row.name)) < 220 for row in CLASSES)


def test_classes_of_a_home_are_in_one_order_whatever_the_order_of_a_set():
    own = [f"pet_{number}" for number in range(100, 160)]
    assert ordered({*own, "silence", "coughing"}) == ["coughing", *own, "silence"]
    assert ordered(["zebra", "ant", "zebra"]) == ["zebra", "ant"]
