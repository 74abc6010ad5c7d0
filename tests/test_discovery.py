"""What Home Assistant is told of a microphone is what it was seen to take, and names are unique."""

import json
import re
from itertools import combinations
from pathlib import Path

import pytest

from hearthlog.analyzer.bridge.mqtt import Topics, identifier
from hearthlog.analyzer.bridge.mqtt.home_assistant import (
    command_discovery,
    device_id,
    discovery,
    home_id,
)
from hearthlog.models.modelfile import load_model

pytestmark = pytest.mark.fast

ACCEPTED = Path(__file__).parent / "data" / "home_assistant_discovery.json"
HOME = Topics("hearthlog", "home")
HOSTILE = [
    "silence",
    "a b",
    "a_20_b",
    "a_5f_20_b",
    "A_b",
    "a_b",
    "a/+#$b",
    "été",
    "🐈",
    "heard",
    "today_coughing",
    "coughing",
    "{{ 1 }}",
    "on_coughing",
    "x" * 200,
    "Cough",
    "tap_water",
    "water_tap",
]


def payload(classes, gone=(), *, topics=HOME, microphone="mic"):
    return json.loads(json.dumps(discovery(topics, microphone, classes, gone)))


def test_the_payload_is_the_one_that_home_assistant_has_taken():
    reported = payload(load_model(Path("general")).classes)
    reported["origin"]["sw_version"] = "VERSION"
    assert reported == json.loads(ACCEPTED.read_text()), (
        "if that is meant: have .ci/home-assistant pass, and then store the new payload"
    )


def test_every_component_has_a_name_of_its_own_whatever_the_classes_are_called():
    components = payload(HOSTILE)["components"]
    assert len(components) == 7 + 5 * (len(HOSTILE) - 1)
    names = [each["unique_id"] for each in components.values()]
    assert len({*names}) == len(names)
    for name in [*names, *components]:
        assert re.fullmatch("[a-zA-Z0-9_-]+", name)


def test_every_class_has_a_switch_of_its_own_and_one_that_is_gone_has_none():
    components = command_discovery(HOME, HOSTILE, ["a c"])["components"]
    assert components.pop("told_a_20_c") == {"p": "switch"}
    switches = [each for each in components.values() if each["p"] == "switch"]
    assert len({each["unique_id"] for each in switches}) == len(switches) == len(HOSTILE) - 1
    assert len({each["name"] for each in switches}) == len(switches)
    reported = [json.loads(each["payload_off"])["label"] for each in switches]
    assert sorted(reported) == sorted({*HOSTILE} - {"silence"})
    assert home_id("home") not in {device_id("home", name) for name in HOSTILE}


def test_no_two_triggers_are_called_the_same():
    components = payload(HOSTILE)["components"].values()
    triggers = [each for each in components if each["p"] == "device_automation"]
    called = {(each["type"], each["subtype"]) for each in triggers}
    assert len(called) == len(triggers) == len(HOSTILE) - 1
    assert ("heard", "Water tap (water_tap)") in called


@pytest.mark.parametrize(
    ("node", "microphone", "others"),
    [
        ("a", "b_c", [("a_b", "c"), ("a-b", "c"), ("A", "b_c"), ("a_", "b_c")]),
        ("home", "mic", [("home", "mic_2"), ("home2", "mic"), ("Home", "mic"), ("home_", "mic")]),
    ],
)
def test_microphones_of_several_recorders_are_devices_of_their_own(node, microphone, others):
    pairs = [(node, microphone), *others]
    assert len({device_id(*pair) for pair in pairs}) == len(pairs)
    ids = [
        {
            each["unique_id"]
            for each in payload(HOSTILE, topics=Topics("x", n), microphone=m)["components"].values()
        }
        for n, m in pairs
    ]
    for some, more in combinations(ids, 2):
        assert not some & more
    assert all(re.fullmatch("[a-zA-Z0-9_-]+", device_id(*pair)) for pair in pairs)


def test_a_text_can_be_told_from_its_identifier():
    texts = ["a+b", "a_2b_b", "a_5f_2b_b", "a_2b+b", "a_2b", "_", "__", "+", "_2b_", "a_b_c_d"]
    assert len({identifier(text) for text in texts}) == len(texts)
    assert identifier("phone_ring") == "phone_ring"


def test_a_class_that_went_is_named_with_nothing_but_its_platform():
    before, now = payload(["silence", "coughing", "music"]), payload(["silence", "music"])
    reported = payload(["silence", "music"], ["coughing"])
    removed = {
        key: {"p": component["p"]}
        for key, component in before["components"].items()
        if key not in now["components"]
    }
    assert len(removed) == 5
    assert reported["components"] == now["components"] | removed


def test_a_class_whose_name_looks_like_a_template_is_taken_as_it_is():
    components = payload(["silence", '{{ "a" }}', "{% b %}", "c"])["components"].values()
    wanted = [each["payload"] for each in components if each["p"] == "device_automation"]
    assert wanted == ['{{ "{{ \\"a\\" }}" }}', '{{ "{% b %}" }}', "c"]
