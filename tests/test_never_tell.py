"""A class that its owner hides is shown by no output, alert or report, backwards too."""

import json
import re
from datetime import UTC, date
from functools import partial
from threading import Event

import pytest
from homelife import at, write_day
from livehome import rule
from log_fixtures import run
from servedhome import serving

from hearthlog.analyzer.activity.segments import read_activity
from hearthlog.analyzer.bridge.alerts.delivery import Outbox
from hearthlog.analyzer.bridge.alerts.output import RuleProgressStore, RuleWatch
from hearthlog.analyzer.bridge.home_state import HomeState, LiveMicrophone
from hearthlog.analyzer.bridge.output import Totals
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.logs.hidden_classes import (
    NEVER_TELL_FILE,
    read_hidden_classes,
    write_hidden_classes,
)
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs

DAY = date(2026, 3, 2)
MINUTE = 60 * 10**9


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def logs(tmp_path):
    events = [
        (at("09:00"), 60.0, "music", 0.9),
        (at("10:00"), 2.0, "coughing", 0.8),
        (at("11:00"), 30.0, "music", 0.9),
    ]
    write_day(tmp_path / "logs", DAY, events)
    return tmp_path / "logs"


def test_a_list_beside_the_logs_hides_a_class_from_report_and_events(logs, hearthlog, tmp_path):
    page = tmp_path / "a.html"
    assert hearthlog("report", logs, "--day", DAY, "-o", page).returncode == 0
    assert "Music" in page.read_text()
    write_hidden_classes(logs, ["music"])
    assert hearthlog("report", logs, "--day", DAY, "-o", tmp_path / "b.html").returncode == 0
    page = (tmp_path / "b.html").read_text()
    assert "usic" not in re.sub(r"base64,[^\"]*", "", page)
    assert "Coughing" in page
    assert "Time with sound" in page
    listed = json.loads(hearthlog("events", logs, "--day", DAY, "--json").stdout)
    assert {event["label"] for event in listed["events"]} == {"coughing"}
    refused = hearthlog("events", logs, "--day", DAY, "--label", "music")
    assert refused.returncode == 1
    assert "music is hidden: never_tell, or the page of the home, says so" in refused.stderr
    write_hidden_classes(logs, [])
    listed = json.loads(hearthlog("events", logs, "--day", DAY, "--json").stdout)
    assert {event["label"] for event in listed["events"]} == {"coughing", "music"}


@pytest.mark.parametrize("content", ["", "{", '{"music": 1}', "[1]", "[" * 70_000])
def test_a_list_that_is_damaged_is_said_and_hides_nothing(logs, hearthlog, content):
    (logs / NEVER_TELL_FILE).write_text(content)
    with pytest.raises(LogError, match=NEVER_TELL_FILE):
        read_hidden_classes(logs)
    result = hearthlog("events", logs, "--day", DAY)
    assert result.returncode == 3
    assert NEVER_TELL_FILE in result.stderr
    assert "Music" in result.stdout


def test_the_classes_of_the_configuration_are_in_the_logs(tmp_path, model_file, day):
    settings = Settings(output=tmp_path / "logs", model=model_file, never_tell=["music", "shout"])
    record(settings, FileSource([day], 1_772_348_400 * 10**9), Event())
    assert find_home_logs([tmp_path / "logs"]).hidden_classes() == {"music", "yelling"}


def test_a_rule_of_a_hidden_class_never_notifies(logs, tmp_path, hearthlog):
    start, end = day_span(DAY, UTC)
    rules = [
        rule("more_than", name, count=0, window="1h", **{"class": name})
        for name in ("music", "coughing")
    ]
    home = find_home_logs([logs])
    recorded = read_activity(home, "home", start, end, pytest.fail)
    for hidden, reported in (((), {"music", "coughing"}), (("music",), {"coughing"})):
        folder = tmp_path / f"{len(hidden)}"
        state = BridgeState(folder, "home", pytest.fail)
        box = Outbox(state, ["x"], pytest.fail)
        memory = RuleProgressStore(state, pytest.fail)
        watch = RuleWatch(rules, UTC, box, memory, pytest.fail, start + MINUTE)
        watch.hidden_classes = frozenset(hidden)
        rang = watch.evaluate(lambda: recorded, pytest.fail, end - MINUTE, end - MINUTE)
        assert {each.rule for each in rang} == reported
    write_hidden_classes(logs, ["music"])
    config = tmp_path / "home.toml"
    config.write_text(
        f'output = "{logs}"\nnode = "home"\n'
        '[[bridge.alert]]\nname = "loud"\nrule = "more_than"\nclass = "music"\ncount = 0\n'
        'window = "1h"\n'
    )
    replayed = hearthlog("alerts", "replay", logs, "--config", config, "--json")
    assert "loud: music is hidden (never_tell, or the page of the home)" in replayed.stderr
    assert json.loads(replayed.stdout)["rules"] == {"loud": []}


def test_the_page_hides_a_class_for_all_and_shows_it_again(tmp_path):
    with serving(tmp_path) as served, served.stream() as part:
        served.log.write_segment("music", 30)
        served.log.write_segment("coughing", 20)
        served.log.hears("music")

        def labels(day):
            return {lane["label"] for room in day["rooms"] for lane in room["lanes"]}

        part("day", lambda day: {"music", "coughing"} <= labels(day))
        status, answer = served.post("/show", {"show": "no", "label": "music"})
        assert (status, json.loads(answer)) == (200, {"said": "Music is now hidden everywhere."})
        assert read_hidden_classes(served.home.folder) == {"music"}
        part("now", lambda now: now["rooms"][0]["words"] == "A sound")
        last = part("events", lambda last: last["hidden"])
        assert last["hidden"] == [["music", "Music"]]
        assert {event["label"] for event in last["events"]} == {"coughing"}
        assert "music" not in {label for label, _ in last["classes"]}
        part("day", lambda day: "music" not in labels(day))
        _, answer = served.post("/show", {"show": "yes", "label": "music"})
        assert json.loads(answer) == {"said": "Music is shown again."}
        assert {"music", "coughing"} <= labels(part("day", lambda day: "music" in labels(day)))
        assert served.post("/show", {"show": "no", "label": "silence"})[0] == 422


def test_what_the_configuration_hides_the_page_does_not_show(tmp_path):
    with serving(tmp_path, never_tell={"music"}) as served:
        status, answer = served.post("/show", {"show": "yes", "label": "music"})
        assert status == 422
        assert "The configuration of the box hides this sound" in answer


def test_totals_go_on_for_a_class_that_is_hidden_for_a_while(logs, tmp_path):
    (columns,) = read_columns(find_logs(logs), ["/mic/segment"]).values()
    state = HomeState()
    own = state.microphones["mic"] = LiveMicrophone("mic")
    state.hidden_classes = frozenset({"music"})
    assert {event.label for event in own.push_segments(columns)} == {"coughing"}
    assert own.labels() == ["coughing"]
    assert {event.label for event in own.ended_events()} == {"coughing"}
    totals = Totals(BridgeState(tmp_path, "home", pytest.fail), 0, pytest.fail)
    totals.keep(state, day_span(DAY, UTC)[1])
    state.hidden_classes = frozenset()
    counts = {total.label: total.events for total in totals.count(state)}
    assert (counts["music"], counts["coughing"]) == (2, 1)
