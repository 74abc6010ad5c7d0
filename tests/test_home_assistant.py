"""A real Home Assistant shows what a recorder hears, and its automations act on it."""

import json
import re
import signal
import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
import yaml
from brokers import Broker, Listener
from homeassistant import HomeAssistant, Household, end, hass_of, versions
from waiting import wait_for

pytestmark = pytest.mark.timeout(600)

DEVICE = "Hearthlog home mic"
ON, SENSOR = "binary_sensor.hearthlog_home_mic_", "sensor.hearthlog_home_mic_"
EVENT = "event.hearthlog_home_mic_event"
GENERAL = {
    "music": "music",
    "speech": "talking",
    "phone_ring": "telephone_ringing",
    "coughing": "coughing",
    "yelling": "shouting",
    "objects_activity": "household_sounds",
    "unknown": "not_sure",
}
BATHROOM = {
    "flushing_water": "toilet_flush",
    "tap_water": "water_tap",
    "other": "other_sounds",
    "unknown": "not_sure",
}
ALWAYS = {f"{ON}{name}" for name in ("listening", "recorder", "problem")}
PAGE = Path(__file__).parents[1] / "docs" / "home-assistant.md"
HARMLESS = (  # of a Home Assistant without all of its packages
    "homeassistant.bootstrap",
    "aiohttp_fast_zlib",
    "homeassistant.components.camera.img_util",
    "homeassistant.setup",
)
LATE = "Invalid event type other"  # said of a class just gone, by the bridge that came after it


def entities_of(classes):
    """Name the entities of a microphone whose model has these classes."""
    always = {*ALWAYS, f"{ON}any_sound", f"{SENSOR}heard", f"{SENSOR}level", EVENT}
    counts = "today", "last_night", "last_heard"
    return (
        always
        | {f"{ON}{name}" for name in classes.values()}
        | {f"{SENSOR}{name}_{kind}" for name in classes.values() for kind in counts}
    )


@pytest.fixture(scope="module", params=versions())
def home(request, tmp_path_factory):
    """A Home Assistant, and a home in which somebody coughs every half minute."""
    hass = hass_of(request.param)
    folder = tmp_path_factory.mktemp("home_assistant")
    with ExitStack() as ends:
        broker = Broker(folder)
        ends.callback(broker.kill)
        home = HomeAssistant(hass, folder / "ha")
        home.broker = broker
        ends.callback(home.stop)
        home.household = Household(folder / "home", broker.port)
        ends.callback(home.household.close)
        home.start()
        home.household.record()
        home.household.start_bridge()
        home.connect(broker.port)
        home.listener = Listener(broker.port, "lab/#")
        ends.callback(home.listener._client._reset_sockets)
        ends.enter_context(home.listener)
        wait_for(lambda: home.state(f"{SENSOR}coughing_today") not in {None, "unknown"}, 60)
        yield home


def is_well(home):
    """Tell whether all entities of the general model are there, and available."""
    states = home.states()
    return states.keys() == entities_of(GENERAL) and not any(
        each["state"] == "unavailable" for each in states.values()
    )


def device_id(home):
    """Return what Home Assistant calls the device."""
    devices = home.query(type="config/device_registry/list")
    (found,) = [each for each in devices if each["name"] == DEVICE]
    assert found["manufacturer"] == "hearthlog"
    return found["id"]


def triggers(home):
    """Return what the device offers as a trigger of MQTT: type and subtype."""
    offered = home.query(type="device_automation/trigger/list", device_id=device_id(home))
    return {(each["type"], each["subtype"]) for each in offered if each["domain"] == "mqtt"}


def publishes(topic, payload):
    """Return an action that says something to the broker."""
    return [{"action": "mqtt.publish", "data": {"topic": topic, "payload": payload}}]


def test_everything_that_is_heard_is_an_entity_of_one_device(home):
    wait_for(lambda: is_well(home), 60)
    wait_for(lambda: home.state(f"{SENSOR}coughing_today").strip("0").isdigit(), 60)
    device = device_id(home)
    registry = home.query(type="config/entity_registry/list")
    assert {each["entity_id"] for each in registry if each["device_id"] == device} == entities_of(
        GENERAL
    )
    states = home.states()
    assert states[f"{ON}recorder"]["state"] == states[f"{ON}listening"]["state"] == "on"
    assert states[f"{ON}problem"]["state"] == "off"
    assert states[f"{ON}music"]["state"] == "off"
    assert states[f"{SENSOR}music_today"]["state"] == "0"
    count = states[f"{SENSOR}music_today"]["attributes"]
    assert count["state_class"] == "total"  # which may fall
    reset = datetime.fromisoformat(count["last_reset"])
    assert timedelta() < datetime.now(UTC) - reset < timedelta(hours=25)
    assert states[f"{SENSOR}music_last_heard"]["state"] == "unknown"
    assert states[f"{SENSOR}heard"]["state"] in {"silence", *GENERAL}
    last = datetime.fromisoformat(states[f"{SENSOR}coughing_last_heard"]["state"])
    assert timedelta() < datetime.now(UTC) - last < timedelta(seconds=60)
    event = states[EVENT]["attributes"]
    assert event["event_type"] in GENERAL
    assert {"id", "start", "end", "seconds", "confidence"} < event.keys()
    assert event["event_types"] == classes(home)


def classes(home):
    return home.states()[EVENT]["attributes"]["event_types"]


def test_a_sound_can_be_chosen_as_a_trigger_of_the_device_and_it_fires(home):
    recorded = {("heard", name.replace("_", " ").capitalize()) for name in GENERAL.values()}
    assert triggers(home) == recorded
    wanted = {"trigger": "device", "domain": "mqtt", "device_id": device_id(home)}
    home.automate(
        "device_trigger",
        triggers=[wanted | {"type": "heard", "subtype": "Coughing"}],
        actions=publishes("lab/device", "{{ trigger.payload }}"),
    )
    home.automate(
        "other_trigger",
        triggers=[wanted | {"type": "heard", "subtype": "Music"}],
        actions=publishes("lab/music", "{{ trigger.payload }}"),
    )
    event = json.loads(home.listener.wait_for("lab/device", seconds=60))
    assert event["event_type"] == "coughing"
    assert "lab/music" not in home.listener.values


def test_automations_on_the_event_and_on_the_sound_fire(home):
    home.automate(
        "event",
        triggers=[{"trigger": "state", "entity_id": EVENT}],
        conditions="{{ trigger.to_state.attributes.event_type == 'coughing' }}",
        actions=publishes("lab/event", "{{ trigger.to_state.attributes.start }}"),
    )
    home.automate(
        "sound",
        triggers=[
            {"trigger": "state", "entity_id": f"{ON}coughing", "from": "off", "to": "on"},
        ],
        actions=publishes("lab/sound", "{{ trigger.to_state.state }}"),
    )
    started = datetime.fromisoformat(home.listener.wait_for("lab/event", seconds=60))
    assert timedelta() < datetime.now(UTC) - started < timedelta(seconds=30)
    assert home.listener.wait_for("lab/sound", seconds=60) == "on"


def test_counts_and_times_are_numbers_and_times_for_long_term_statistics(home):
    listed = home.query(type="recorder/list_statistic_ids")
    kept = {each["statistic_id"]: each for each in listed}
    for name in GENERAL.values():
        for kind in ("today", "last_night"):
            assert kept[f"{SENSOR}{name}_{kind}"]["has_sum"]
    assert home.query(type="recorder/validate_statistics") == {}


def test_a_class_is_switched_off_and_on_and_a_pause_is_asked_for_by_a_button(home):
    switch = "switch.hearthlog_home_tell_of_coughing"
    assert home.any_state(switch) == "on"
    home.act("switch", "turn_off", switch)
    wait_for(lambda: home.any_state(switch) == "off", 10)
    wait_for(lambda: home.state(f"{ON}coughing") == "off", 5)
    time.sleep(40)  # a cough
    assert home.state(f"{ON}coughing") == "off"
    home.act("switch", "turn_on", switch)
    wait_for(lambda: home.state(f"{ON}coughing") == "on", 60)
    with Listener(home.broker.port, "hearthlog/home/command/answer") as listener:
        home.act("button", "press", "button.hearthlog_home_pause_for_an_hour")
        answer = json.loads(listener.wait_for("hearthlog/home/command/answer"))
        assert answer == {"done": True, "text": "paused for 60 minutes by Home Assistant"}
        home.act("button", "press", "button.hearthlog_home_listen_again")
        listener.wait_until(lambda: "it listens again" in str(listener.values))
    wait_for(lambda: is_well(home), 60)


def test_a_blueprint_notifies_of_a_sound_that_is_heard_again_and_again(home):
    if home.version < "2025.4":
        pytest.skip("the blueprint is for Home Assistant 2025.4 and later")
    use = {"path": "hearthlog/notify_on_sound.yaml"}
    often = {"sound": f"{ON}coughing", "times": 2, "minutes": 2, "cooldown": 1}
    rare = often | {"times": 4, "minutes": 1}
    for name, given in (("often", often), ("rare", rare)):
        notify = publishes(f"lab/{name}", "{{ message }}")
        home.automate(name, use_blueprint=use | {"input": given | {"notify": notify}})
    text = home.listener.wait_for("lab/often", seconds=120)
    assert text == "Hearthlog home mic Coughing: 2 times within 2 minutes"
    time.sleep(50)  # two coughs that are of the cooldown
    assert len(home.listener.payloads("lab/often")) == 1
    home.listener.wait_until(lambda: len(home.listener.payloads("lab/often")) == 2, 120)
    assert "lab/rare" not in home.listener.values
    for name in ("often", "rare"):
        home.forget(name)


def test_a_blueprint_notifies_of_a_sound_that_is_not_heard(home):
    now = datetime.now(ZoneInfo("Europe/Vienna"))
    times = {"since": f"{now - timedelta(minutes=2):%H:%M:%S}"}
    times["by"] = f"{now + timedelta(seconds=10):%H:%M:%S}"
    use = {"path": "hearthlog/not_heard_by.yaml"}
    for name in ("coughing", "music"):
        given = {"last_heard": f"{SENSOR}{name}_last_heard", "listening": f"{ON}listening"}
        notify = publishes(f"lab/no_{name}", "{{ message }}")
        home.automate(name, use_blueprint=use | {"input": given | times | {"notify": notify}})
    text = home.listener.wait_for("lab/no_music")
    since = times["since"][:5]
    assert text.startswith(f"Hearthlog home mic Music last heard: not since {since}.")
    time.sleep(2)
    assert "lab/no_coughing" not in home.listener.values
    for name in ("coughing", "music"):
        home.forget(name)


def blocks_of_page(start):
    """Return the YAML of the page that begins so: its text and what it says."""
    blocks = re.findall(r"^```yaml\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    return [(text, yaml.safe_load(text)) for text in blocks if text.startswith(start)]


def test_the_automation_of_the_page_fires(home):
    ((_, automation),) = blocks_of_page("triggers:")
    home.automate("page", **automation)

    def output():
        reported = home.query(type="persistent_notification/get")
        return [each["message"] for each in reported if each["message"].startswith("Coughing at ")]

    (message,) = wait_for(output, 60)
    assert datetime.fromisoformat(message.removeprefix("Coughing at ")).tzinfo is not None
    home.forget("page")


def test_the_card_of_the_page_shows_entities_that_are_there(home):
    ((text, card),) = blocks_of_page("type:")
    home.query(
        type="lovelace/config/save",
        config={"title": "Home", "views": [{"title": "Sounds", "cards": [card]}]},
    )
    shown = set(re.findall(r"\b[a-z_]+\.hearthlog_[a-z_]+", text))
    assert shown
    assert shown <= home.states().keys()


def test_all_is_unavailable_while_the_recorder_is_not_running_but_for_that_it_is_not(home):
    wait_for(lambda: is_well(home), 60)
    assert end(home.household.recorder) == 0
    stopped = time.monotonic()
    wait_for(lambda: home.state(f"{ON}coughing") == "unavailable", 20)
    assert time.monotonic() - stopped > 5
    for name in ("listening", "recorder"):
        wait_for(lambda name=name: home.state(f"{ON}{name}") == "off", 2)
    states = home.states()
    available = {name for name, each in states.items() if each["state"] != "unavailable"}
    assert available == ALWAYS
    home.household.record()
    wait_for(lambda: is_well(home), 30)
    assert home.state(f"{ON}listening") == "on"


def test_a_microphone_also_has_a_level(home, labmic):
    assert home.state(f"{SENSOR}level") == "unknown"  # files have none
    end(home.household.recorder)
    home.household.listen(labmic)
    wait_for(lambda: home.state(f"{SENSOR}level") not in {"unknown", "unavailable"}, 60)
    level = home.states()[f"{SENSOR}level"]
    assert -80 < float(level["state"]) < 0
    assert level["attributes"]["unit_of_measurement"] == "dBFS"
    kept = {each["statistic_id"]: each for each in home.query(type="recorder/list_statistic_ids")}
    assert kept[f"{SENSOR}level"]["has_mean"]
    end(home.household.recorder)
    home.household.record()
    wait_for(lambda: is_well(home), 60)


def test_all_is_unavailable_when_the_bridge_is_killed_until_there_is_one_again(home):
    count = int(home.state(f"{SENSOR}coughing_today"))
    end(home.household.bridge, signal.SIGKILL)
    wait_for(lambda: {each["state"] for each in home.states().values()} == {"unavailable"}, 5)
    home.household.start_bridge()
    wait_for(lambda: is_well(home), 30)
    assert int(home.state(f"{SENSOR}coughing_today")) >= count


def test_a_home_assistant_that_starts_again_shows_everything_and_its_automations_fire(home):
    home.stop()
    before = len(home.listener.payloads("lab/device"))
    home.start()
    wait_for(lambda: is_well(home), 30)
    assert home.state(f"{ON}recorder") == "on"
    assert triggers(home) == {("heard", name) for name in words(GENERAL)}
    home.listener.wait_until(lambda: len(home.listener.payloads("lab/device")) > before, 60)


def words(names):
    return {name.replace("_", " ").capitalize() for name in names.values()}


def test_classes_that_go_with_another_model_are_gone_and_new_ones_are_there(home):
    wait_for(lambda: home.state(f"{SENSOR}heard") == "coughing", 60, pause=0.05)
    end(home.household.recorder)
    home.household.record("bathroom")
    wait_for(lambda: home.states().keys() == entities_of(BATHROOM), 40)
    assert triggers(home) == {("heard", name) for name in words(BATHROOM)}
    assert classes(home) == list(BATHROOM)
    wait_for(lambda: home.state(f"{ON}toilet_flush") == "off", 20)
    wait_for(lambda: home.any_state("switch.hearthlog_home_tell_of_coughing") is None, 20)
    assert home.any_state("switch.hearthlog_home_tell_of_toilet_flush") == "on"


def test_classes_that_went_while_there_was_no_bridge_are_gone_too(home):
    wait_for(lambda: home.state(f"{SENSOR}heard") == "other", 60, pause=0.05)
    end(home.household.recorder)
    end(home.household.bridge, signal.SIGKILL)
    home.household.record()
    time.sleep(5)
    home.household.start_bridge()
    wait_for(lambda: is_well(home), 60)
    assert triggers(home) == {("heard", name) for name in words(GENERAL)}
    before = len(home.listener.payloads("lab/device"))
    home.listener.wait_until(lambda: len(home.listener.payloads("lab/device")) > before, 60)


def test_what_is_gone_does_not_come_back_when_home_assistant_starts_again(home):
    home.stop()
    home.start()
    wait_for(lambda: is_well(home), 30)


def is_of_ours(line):
    return re.search("mqtt|hearthlog|recorder", line, re.IGNORECASE)


def test_home_assistant_has_nothing_to_complain_of(home):
    complaints = [
        line
        for line in home.log.splitlines()
        if re.search(r" (WARNING|ERROR|CRITICAL) ", line)
        and LATE not in line
        and (is_of_ours(line) or not any(f"[{name}]" in line for name in HARMLESS))
    ]
    assert complaints == []
    assert home.addresses() == {"127.0.0.1"}


def test_a_broker_that_starts_again_without_its_values_is_told_everything(home):
    home.broker.kill()
    wait_for(lambda: {each["state"] for each in home.states().values()} == {"unavailable"}, 10)
    home.broker.start()
    wait_for(lambda: is_well(home), 60)
