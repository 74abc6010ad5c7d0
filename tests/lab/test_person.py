"""A simulated person reviews a simulated home as it is true."""

import shutil

import numpy as np
import pytest

from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.spans import intersection_rows, overlay, single_span
from hearthlog.analyzer.marks.marks import read_marks, read_reviewed
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import plan_short_day
from hearthlog.tools.home.simulate import truth_of
from hearthlog.tools.lab.home.person import Person, true_labelling
from hearthlog.tools.lab.home.recording import record_composition

START = 1_772_323_200_000_000_000
SUNDAY = START + 86_400 * NANOSECONDS


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Twelve minutes as the starter labels them, and what is true of them."""
    library = ClipLibrary()
    composition = Composition(plan_short_day(12, library, 3), library, Rooms("living_room", 3))
    logs = tmp_path_factory.mktemp("home") / "logs"
    settings = Settings(output=logs, model=starter_file(GENERAL), timezone="UTC")
    record_composition(composition, settings, START)
    return logs, true_labelling(truth_of(composition).spans, START)


@pytest.fixture
def home(recorded, tmp_path):
    logs, truth = recorded
    return shutil.copytree(logs, tmp_path / "logs"), truth


def written(logs, read):
    return [row for log in find_logs(logs) for row in read(log)]


def labels_of(truth, mark):
    _, rows, _ = intersection_rows(truth, single_span(mark.start, mark.end))
    return set(truth.labels[rows])


def test_a_person_marks_what_is_true_and_leaves_what_is_right(home):
    logs, truth = home
    output = find_labellings(logs).read("mic", "live").labelling
    done = Person(truth).review(logs, 60, SUNDAY)
    marks = sorted(done.marks)
    assert marks == written(logs, read_marks)
    assert sorted(done.reviewed) == written(logs, read_reviewed)
    assert {mark.made for mark in marks} == {SUNDAY}
    for mark in marks:
        assert {m.replace("other_negative", "unknown") for m in labels_of(truth, mark)} == {
            mark.label
        }
    for span in done.reviewed:
        parts = overlay([truth, output, single_span(span.start, span.end)]).in_all()
        unlike = truth.labels[parts.rows[0]] != output.labels[parts.rows[1]]
        marked = [any(m.start <= t < m.end for m in marks) for t in parts.starts.tolist()]
        left = unlike & ~np.array(marked) & (truth.labels[parts.rows[0]] != "other_negative")
        assert ((parts.ends - parts.starts)[left] < NANOSECONDS / 2).all()


def test_a_person_stops_when_the_time_is_over_and_does_not_see_an_item_twice(home):
    logs, truth = home
    first = Person(truth).review(logs, 4, SUNDAY)
    assert 180 < first.seconds <= 240
    second = Person(truth).review(logs, 4, SUNDAY)
    assert not {*first.marks} & {*second.marks}


def test_a_wrong_person_marks_the_same_spans_as_something_else(home):
    logs, truth = home
    right = Person(truth).review(logs, 2, SUNDAY).marks
    for log in logs.rglob("*.review.mcap"):
        log.unlink()
    wrong = Person(truth, wrong=1.0).review(logs, 2, SUNDAY).marks
    assert [mark[:3] for mark in right] == [mark[:3] for mark in wrong]
    assert all(a.label != b.label for a, b in zip(right, wrong, strict=True))
