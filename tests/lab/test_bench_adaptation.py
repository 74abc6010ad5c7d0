"""What marks of wrong sounds teach is measured on time of the home that they are not from."""

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.analyzer.promotion.recent_time import recent_logs
from hearthlog.recorder.config import Settings
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import plan_short_day
from hearthlog.tools.home.simulate import truth_of
from hearthlog.tools.lab.adaptation import Outcome, adaptation, line_of, wrong_sounds
from hearthlog.tools.lab.home.person import true_labelling
from hearthlog.tools.lab.home.recording import record_composition

START = 1_772_323_200  # midnight


@pytest.fixture(scope="module")
def home(tmp_path_factory, model_file):
    """Four logs of three minutes, an hour apart, labelled by a model."""
    folder, library, lines = tmp_path_factory.mktemp("home"), ClipLibrary(), []
    settings = Settings(output=folder / "logs", model=model_file, timezone="UTC")
    for hour in range(4):
        room = Rooms("living_room", 3)
        composition = Composition(plan_short_day(3, library, hour), library, room)
        record_composition(composition, settings, (START + 3600 * hour) * NANOSECONDS)
        spans = truth_of(composition).spans
        lines += [f"{a + 3600 * hour}\t{b + 3600 * hour}\t{label}\n" for a, b, label in spans]
    (folder / "truth.txt").write_text("".join(lines))
    return folder


def test_a_home_is_corrected_learned_and_scored_before_and_after(home, model_file):
    [few, wrong] = adaptation(home, model_file, ((4, 0.0), (4, 1.0)))
    assert few.marks == wrong.marks == 4
    assert few.before == wrong.before
    assert few.before.keys() == few.after.keys() >= {"silence", "speech"}
    assert few.after not in (few.before, wrong.after)
    assert not any(read_marks(log.path) for log in recent_logs([home / "logs"]))


def test_marks_are_true_of_whole_sounds_that_were_wrong_and_never_of_silence(home):
    logs = recent_logs([home / "logs"])
    rows = [line.split("\t") for line in (home / "truth.txt").read_text().splitlines()]
    truth = true_labelling([(float(a), float(b), c) for a, b, c in rows], START * NANOSECONDS)
    marks = wrong_sounds(logs, truth, logs[2].start)
    assert len(marks) > 4
    assert marks == sorted(marks)
    true = set(zip(truth.starts.tolist(), truth.ends.tolist(), truth.labels, strict=True))
    for mark in marks:
        assert mark.label != "silence"
        assert (mark.start, mark.end, mark.label) in true
        assert mark.end <= logs[2].start
    output = true_labelling([(0.0, 14400.0, "silence")], START * NANOSECONDS)
    assert wrong_sounds(logs, output, logs[2].start) == []


def test_the_worst_class_is_one_that_was_right_before():
    before = {"silence": 0.9, "speech": 0.5, "music": 0.2}
    outcome = Outcome(10, 0.0, before, {"silence": 0.91, "speech": 0.4, "music": 0.0}, 20.0, 5.0)
    assert outcome.worst == ("speech", 0.5, 0.4)
    assert line_of(outcome).split() == [
        *("10", "0%", "0.533", "0.437", "0.9000", "+0.0100"),
        *("20", "5", "speech", "0.500", "-0.100"),
    ]
