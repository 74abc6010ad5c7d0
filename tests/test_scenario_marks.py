"""What a reviewer says of a scenario: marks of its own, from which its model learns."""

import json
import shutil
from datetime import UTC
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from test_review import Screen
from test_scenarios_at_once import START, record, sound

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.catalog import read_catalog
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import LabelledFile, Labellings, find_labellings
from hearthlog.analyzer.marks.marks import (
    PERSON,
    RANDOM,
    Mark,
    MarkedSpan,
    ReviewedSpan,
    read_marks,
    read_review,
    write_marks,
)
from hearthlog.analyzer.promotion.recent_time import reference
from hearthlog.analyzer.review.lanes import timeline_lanes
from hearthlog.analyzer.review.marking import Marking
from hearthlog.analyzer.review.review_queue import queue_spans
from hearthlog.analyzer.review.session import ReviewSession
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.training.home_recordings import training_recordings
from hearthlog.analyzer.training.speakers import SPEAKERS, speaker_recordings
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.starter import BATHROOM
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import review_path
from hearthlog.schemas.mcap.logfile import LogFile

__all__ = ["sound"]  # a fixture

SECOND = 1_000_000_000
WATER = "scenario/water"


def mark(start: float, end: float, label: str, **output: str) -> Mark:
    span = START + round(start * SECOND), START + round(end * SECOND)
    return Mark("mic", *span, label, **output)


@pytest.fixture(scope="module")
def log(sound, tmp_path_factory) -> Path:
    """The log of a recorder with the scenario `water`, at the end of which nothing sounds."""
    folder = tmp_path_factory.mktemp("marked")
    samples, rate = soundfile.read(sound, dtype="float32")
    quiet = np.random.default_rng(3).normal(0, 3e-4, 4 * rate).astype(np.float32)
    soundfile.write(folder / "home.wav", np.concatenate([samples, quiet]), rate)
    return record(folder / "home.wav", folder / "logs", scenarios={"water": BATHROOM})


@pytest.fixture
def home(log, tmp_path) -> Path:
    """A folder with a log of its own to be marked."""
    copy = tmp_path / "logs" / log.relative_to(log.parents[3])
    copy.parent.mkdir(parents=True)
    shutil.copy(log, copy)
    return copy


def test_marks_of_a_scenario_and_of_the_home_leave_each_other_alone(home):
    speech, tap = mark(1, 4, "speech"), mark(2, 3, "tap_water", corrects=WATER)
    seen = ReviewedSpan("mic", speech.start, speech.end, "Ann", 7, WATER, PERSON)
    write_marks(home, [speech])
    write_marks(home, [tap], reviewed=[seen], scenario="water")
    assert read_review(home) == {"": ([speech], []), "water": ([tap], [seen])}
    assert (read_marks(home), read_marks(home, "water")) == ([speech], [tap])
    with LogFile(review_path(home)) as file:
        topics = {channel.topic for channel in file.channels.values()}
    assert "/mic/review/scenario/water/mark" in topics
    write_marks(home, [], [MarkedSpan(*speech[:3])])
    assert read_review(home) == {"water": ([tap], [seen])}
    write_marks(home, [], [MarkedSpan(*speech[:3])], not_reviewed=[seen], scenario="water")
    assert not review_path(home).exists()
    with pytest.raises(LogError, match="scenario name 'Water/1' cannot be part of a topic"):
        write_marks(home, [tap], scenario="Water/1")


def test_a_review_marks_the_classes_of_a_scenario_in_a_lane_of_their_own(home):
    write_marks(home, [mark(0, 9, "speech")])
    timeline = read_timeline([home])
    recorded = timeline.microphones["mic"]
    segments = {one.name: one.spans for one in recorded.labellings}
    classes = recorded.classes_of("water")
    assert ("tap_water" in classes, "speech" in classes) == (True, False)
    assert ("tap_water" in recorded.classes, "speech" in recorded.classes) == (False, True)
    marking = Marking("mic", timeline.coverage["mic"], "Ann", WATER, segments[WATER], "water")
    screen = Screen()
    session = ReviewSession(screen, marking, classes, UTC, print, print, print, print)
    screen.marked = span = START + 2 * SECOND, START + 4 * SECOND
    key = {one.text: one.key for one in session.keys}["water tap"]

    def press(*keys: str) -> None:
        queue: SimpleQueue[str] = SimpleQueue()
        for each in (*keys, "q"):
            queue.put(each)
        session.run(queue)

    press(key, ".")
    (made,) = read_marks(home, "water")
    assert made[1:5] + made[6:7] == (*span, "tap_water", "Ann", WATER)
    lanes = {lane.name: lane.spans for lane in timeline_lanes(read_timeline([home]))}
    assert lanes["Water reviewed"].texts.tolist() == ["Reviewed", "Water tap"]
    assert lanes["Reviewed"].texts.tolist() == ["Talking"]
    press("z", "z")
    assert read_review(home).keys() == {""}
    assert "Water reviewed" not in {lane.name for lane in timeline_lanes(read_timeline([home]))}


def test_a_queue_of_a_scenario_asks_for_what_is_not_reviewed_of_it(home):
    sources, limits = find_labellings(home), (None, None)
    (first, *_) = queue_spans("uncertain", sources, ("mic", WATER), limits, None)
    write_marks(home, [mark(0, 1000, "speech")])
    assert queue_spans("uncertain", sources, ("mic", WATER), limits, None)[0] == first
    span = ReviewedSpan("mic", first.start, first.end, corrects=WATER)
    write_marks(home, [], reviewed=[span], scenario="water")
    left = queue_spans("uncertain", sources, ("mic", WATER), limits, None)
    assert all(one.end <= first.start or one.start >= first.end for one in left)
    assert all((one.a, one.b) == (WATER, "") for one in left)
    with pytest.raises(DataError, match="--queue random: of a scenario use useful, uncertain"):
        queue_spans(RANDOM, sources, ("mic", WATER), limits, None)


def test_a_scenario_that_is_called_like_something_else_is_not_taken_for_it(home, capfd):
    write_marks(home, [mark(1, 2, "tap_water")], scenario="review")
    assert "review ten spans" in run(capfd, "info", home.parent).stdout
    lab = pytest.importorskip(
        "hearthlog.tools.lab.home.shifted_log", reason="the wheel leaves the lab out"
    )
    assert not lab.ShiftedLog(review_path(home)).first_starts, "these are marks, and not cut off"
    drawn = ReviewedSpan("mic", START, START + 9 * SECOND, corrects="water", chosen=RANDOM)
    write_marks(home, [], reviewed=[drawn])
    with pytest.raises(DataError, match="no labelling 'relabel/water'"):
        reference(home)
    topics = frozenset(f"/mic/{name}/segment" for name in (WATER, "relabel/water"))
    sources = Labellings([LabelledFile(home, 0, 0, True, topics, {})])
    with pytest.raises(DataError, match=f"which 'water'. There is relabel/water and {WATER}"):
        sources.find("mic", "water")
    assert [sources.find("mic", name) for name in (WATER, "relabel")] == [WATER, "relabel/water"]


def test_label_files_are_of_the_scenario_that_is_named(home, tmp_path, capfd):
    labels = tmp_path / "water.txt"
    labels.write_text(
        "1.000000000\t2.500000000\ttap_water\n3.000000000\t4.000000000\tflushing_water\n"
    )
    done = run(capfd, "annotate", "import", home, labels, "--scenario", "water")
    assert done.returncode == 0, done.stderr
    assert f"hearthlog train --home {home} --scenario water" in done.stderr
    assert not read_marks(home)
    assert [one.label for one in read_marks(home, "water")] == ["tap_water", "flushing_water"]
    exported = tmp_path / "exported.txt"
    assert run(capfd, "annotate", "export", home, "-o", exported).returncode == 1
    run(capfd, "annotate", "export", home, "-o", exported, "--scenario", "water")
    assert exported.read_text() == labels.read_text()
    requested = "asks for scenario water: give --labels water"
    spans = tmp_path / "spans.csv"
    run(capfd, "diff", home, "water", "--queue", "--list", spans)
    with pytest.raises(DataError, match=requested):
        queue_spans(str(spans), find_labellings(home), ("mic", "live"), (None, None), None)


def test_an_evaluation_takes_the_marks_of_the_scenario_for_its_reference(home, capfd):
    topic = ("--topic", "/mic/scenario/water/segment")
    write_marks(home, [mark(1, 9, "speech")])
    done = run(capfd, "evaluate", "log", home, "--reference", "review", *topic)
    assert "nothing of water of mic is reviewed; `hearthlog annotate import --sc" in done.stderr
    labelling = find_labellings(home).read("mic", WATER).labelling
    spans = zip(labelling.starts.tolist(), labelling.ends.tolist(), labelling.labels, strict=True)
    write_marks(home, [Mark("mic", *span) for span in spans], scenario="water")
    done = run(capfd, "evaluate", "log", home, "--reference", "review", *topic, "--json")
    assert json.loads(done.stdout)["frames"] > 100
    assert json.loads(done.stdout)["macro_f1"] == 1.0


def test_a_catalogue_has_the_labels_of_scenarios_in_a_column_of_their_own(home, tmp_path, capfd):
    write_marks(home, [mark(1, 2, "tap_water")], scenario="water")
    done = run(capfd, "catalog", tmp_path / "logs", "--json")
    catalog = read_catalog(tmp_path / "logs")
    rows = {row.kind: row for row in catalog.rows()}
    of_log = rows["log"].scenarios
    assert {(one["scenario"], one["model"]) for one in of_log} == {("water", "bathroom")}
    labels = find_labellings(home).read("mic", WATER).labelling.labels.tolist()
    assert {one["label"]: one["segments"] for one in of_log} == {
        name: labels.count(name) for name in labels
    }
    assert "tap_water" not in {one["label"] for one in rows["log"].labels}
    (marked,) = rows["review"].scenarios
    assert (marked["label"], marked["segments"], list(rows["review"].labels)) == (
        "tap_water",
        1,
        [],
    )
    output = json.loads(done.stdout)
    assert {one["scenario"] for one in output["scenarios"]} == {"water"}
    assert {one["scenario"] for one in output["labels"]} == {""}


def test_who_is_marked_as_a_speaker_is_learned_like_who_is_enrolled(home, tmp_path):
    write_marks(home, [mark(2.5, 4.5, "speech")])
    write_marks(home, [mark(2.5, 4.5, "anna")], scenario=SPEAKERS)
    (one,) = speaker_recordings([tmp_path / "logs"], DEFAULT)
    assert one.label == "anna", "that somebody speaks says nothing of a guest"
    assert [one.label for one in training_recordings(tmp_path / "logs")] == ["speech"]


def test_the_model_of_a_scenario_learns_from_its_marks_and_no_other_does(
    home, tmp_path, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "logs"
    write_marks(home, [mark(2.5, 4, "tap_water", corrects=WATER)], scenario="water")
    done = run(capfd, "train", "--home", folder)
    assert "nothing is marked" in done.stderr
    done = run(capfd, "train", "--home", folder, "--scenario", "water", "--json")
    assert done.returncode == 0, done.stderr
    learned = json.loads(done.stdout)
    assert learned["model"] == "models/scenario-water-1.safetensors"
    assert learned["scenario_name"] == "bathroom"
    assert "judgement" not in learned
    home_data = learned["training_data"]["home"]
    assert home_data["tap_water"]["segments"] > 0
    assert home_data["flushing_water"]["segments"] == 0
    assert find_home_logs([folder]).latest_scenario_models("voices") == []
    done = run(capfd, "train", "--home", folder, "--scenario", "voices")
    assert (done.returncode, "no log has its labels" in done.stderr) == (2, True)
