"""Water that a model does not tell apart is running water to people, and what it was in files."""

from datetime import UTC, date

import numpy as np
import pytest

from hearthlog.models.classes import WATER

pytest.importorskip("hearthlog.tools.lab.home", reason="the wheel leaves the lab out")

from hearthlog.analyzer.activity.home_data import read_home
from hearthlog.analyzer.bridge.page import translation_for
from hearthlog.analyzer.bridge.page.day import HomeDay, picture_of
from hearthlog.analyzer.bridge.page.past_days import PastDays
from hearthlog.analyzer.bridge.settings import RecorderAddress
from hearthlog.analyzer.logs.hidden_classes import common_names, common_names_of
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.report.report import Period, make_report, read_report_data
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import BATHROOM, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import plan_short_day
from hearthlog.tools.lab.home.recording import record_composition

START = 1_772_323_200_000_000_000
DAY = date(2026, 3, 1)
AS_WATER = {"flushing_water": "running_water", "tap_water": "running_water"}


def description(name="bathroom"):
    return load_model(starter_file(name)).description.model_dump()


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Twelve minutes of a bathroom, as its starter labels them."""
    library = ClipLibrary()
    composition = Composition(plan_short_day(12, library, 3), library, Rooms("bathroom", 3))
    folder = tmp_path_factory.mktemp("home") / "logs"
    settings = Settings(output=folder, model=starter_file(BATHROOM), timezone="UTC")
    record_composition(composition, settings, START)
    return folder


def test_a_model_does_not_tell_water_apart_of_which_it_finds_less_than_half():
    assert common_names(description()) == AS_WATER
    assert common_names(description("bathroom-embedding")) == {}
    assert common_names(description("general")) == {}


def test_a_home_that_taught_two_kinds_of_water_is_shown_them():
    taught = description()
    for count, names in ((1, AS_WATER), (2, {})):
        own = {name: {"segments": 5} for name in ["tap_water", "flushing_water"][:count]}
        taught["training_data"]["home"] = own
        assert common_names(taught) == names


@pytest.mark.parametrize("wrong", [{}, {"classes": 3}, {"classes": ["shower"], "metrics": None}])
def test_a_description_that_is_none_changes_no_name(wrong):
    assert common_names(wrong) == {}


def test_logs_keep_their_labels_and_reports_show_running_water(logs, tmp_path):
    labelled = set(find_labellings(logs).read("mic", "live").labelling.labels)
    assert labelled & {*WATER}
    (log,) = find_logs(logs)
    assert common_names_of(log, labelled) == AS_WATER
    data = read_home(find_home_logs([logs]), "live", 0, day_span(DAY, UTC))
    (classes,), (segments,) = data.classes.values(), data.segments.values()
    shown = {*classes, *segments.labels}
    assert "running_water" in shown
    assert not shown & {*WATER}
    make_report(find_home_logs([logs]), Period(DAY, 1, UTC), tmp_path / "day.html")
    text = (tmp_path / "day.html").read_text()
    assert "Running water" in text
    assert (
        "does not tell these sounds apart, and they are running water here: toilet flush," in text
    )


def test_the_page_has_one_lane_of_running_water_and_counts_what_the_report_counts(logs):
    past = PastDays(RecorderAddress(logs, "home", UTC)).read(DAY, frozenset())
    home = HomeDay([*past.state.microphones.values()], past.moment, UTC, is_past=True)
    (room,) = picture_of(home)["rooms"]
    lanes = {lane["label"]: lane for lane in room["lanes"]}
    assert lanes["running_water"]["words"] == "Running water"
    assert not lanes.keys() & {*WATER}
    data, _ = read_report_data(find_home_logs([logs]), Period(DAY, 1, UTC))
    (day,) = data.days
    begun = np.concatenate([day.night_events("running_water"), day.events("running_water")])
    assert lanes["running_water"]["count"] == len({*begun.tolist()}) > 0
    assert translation_for("de").class_words("running_water") == "Fließendes Wasser"
