"""Marks that a reviewer makes at a viewer: in the layer at once, undone, never lost."""

import io
import json
import shutil
import signal
import socket
import subprocess
import time
import wave
from datetime import UTC
from http.client import HTTPConnection
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from conftest import HEARTHLOG
from hypothesis import given, settings
from hypothesis import strategies as st
from log_fixtures import run
from lossy_source import LossySource
from viewers import COARSE, Window, browsing, display, find_ruler, patiently, reviewing

from hearthlog.analyzer.activity.checked_minutes import UNSURE_BELOW
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, joined
from hearthlog.analyzer.marks.marks import RANDOM, Mark, read_marks, read_reviewed, write_marks
from hearthlog.analyzer.review.lanes import timeline_lanes
from hearthlog.analyzer.review.marking import Marking
from hearthlog.analyzer.review.review_list import ReviewSpan as Listed
from hearthlog.analyzer.review.review_list import write_spans
from hearthlog.analyzer.review.review_queue import ReviewItem, queue_spans, review_items
from hearthlog.analyzer.review.session import ReviewSession, length_text, sound_file
from hearthlog.analyzer.review.timeline import SoundClip, labelled_spans, sound_of
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.models.classes import colour
from hearthlog.recorder.config import Settings
from hearthlog.recorder.log.clips import ClipWriter, KeptSound
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer

__all__ = ["display"]  # a fixture

SECOND = 1_000_000_000
START = 1_772_348_370 * SECOND  # half a minute before a full hour: so there are four logs
LOST = {5: 7, 9: 400}
OLD = ("Bob", 7, "live")


@pytest.fixture(scope="module")
def recorded_home(tmp_path_factory, model_file, hmm_file, day):
    """Logs of three minutes, and a second labelling of them."""
    folder = tmp_path_factory.mktemp("home") / "logs"
    options = Settings(output=folder, model=model_file, max_bag_duration=60)
    recording = record(options, LossySource(FileSource([day], START), LOST), Flag())
    assert len(recording.logs) == 4
    command = [*HEARTHLOG, "relabel", str(folder), "--model", str(hmm_file)]
    subprocess.run(command, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def timeline(recorded_home):
    return read_timeline([recorded_home])


@pytest.fixture
def home(recorded_home, tmp_path):
    """A copy of the logs, to be reviewed."""
    return shutil.copytree(recorded_home, tmp_path / "home")


@pytest.fixture(scope="module")
def shared_home(recorded_home, tmp_path_factory):
    return shutil.copytree(recorded_home, tmp_path_factory.mktemp("shared") / "home")


def marking_of(folder, reviewer="Ann"):
    timeline = read_timeline([folder])
    spans = timeline.microphones["mic"].labellings[0].spans
    return Marking("mic", timeline.coverage["mic"], reviewer, "live", spans)


def layers(folder):
    """All marks that are in review layers."""
    return [m for log in find_logs(folder) if not is_layer(log) for m in read_marks(log)]


# Marking


CELL = 2 * FRAME_NANOSECONDS
CELLS = 2000
operations = st.tuples(
    st.sampled_from(["mark", "mark", "confirm", "delete", "undo"]),
    st.integers(0, CELLS - 1),
    st.integers(1, 900),
    st.sampled_from(["coughing", "yelling", "unknown"]),
)


def cells_of(spans):
    """What spans say in each cell; None where nothing."""
    middles = START + np.arange(CELLS) * CELL + CELL // 2
    found = np.full(CELLS, None, object)
    for start, end, text in zip(*spans, strict=True):
        found[(middles >= start) & (middles < end)] = text
    return found


@settings(max_examples=15, deadline=None)
@given(st.lists(operations, min_size=1, max_size=6))
def test_marks_are_what_was_said_last_and_undone_they_are_as_before(shared_home, done):
    for log in find_logs(shared_home):
        if ".review." in log.name:
            log.unlink()
    marking = marking_of(shared_home)
    edge = marking.coverage.starts[1]
    for log, start, end in ((0, edge - SECOND, edge), (1, edge + SECOND, edge + 2 * SECOND)):
        write_marks(marking.coverage.logs[log], [Mark("mic", start, end, "music", *OLD)])
    before = layers(shared_home)
    output = np.array(cells_of(marking.labelled))
    history = [cells_of(marking.marks())]
    last = int((marking.coverage.ends[-1] - START) // CELL)
    for kind, first, length, label in done:
        now = history[-1].copy()
        cells = slice(first, min(first + length, last))
        start, end = START + first * CELL, START + (first + length) * CELL
        if kind == "undo":
            assert (marking.undo() is not None) == (len(history) > 1)
            history = history[:-1] or history
            now = history[-1]
        else:
            extent = {"mark": label, "confirm": output[cells], "delete": None}[kind]
            arguments = (start, end, label) if kind == "mark" else (start, end)
            try:
                getattr(marking, kind)(*arguments)
            except DataError:
                assert kind == "confirm" or first >= last
            else:
                now[cells] = extent
                history.append(now)
        unsure = {last - 1, last}  # the last cell may end between two frames
        found = cells_of(marking.marks())
        assert [c for i, c in enumerate(found) if i not in unsure] == [
            c for i, c in enumerate(now) if i not in unsure
        ]
        assert as_rows(marking.marks()) == [(m.start, m.end, m.label) for m in layers(shared_home)]
    while marking.undo() is not None:
        pass
    assert layers(shared_home) == before


def as_rows(spans):
    return list(zip(spans.starts.tolist(), spans.ends.tolist(), spans.texts, strict=True))


def test_a_mark_says_who_made_it_when_and_what_it_corrects(home):
    began = time.time_ns()
    marking_of(home).mark(START + SECOND, START + 2 * SECOND, "yelling")
    (mark,) = layers(home)
    assert mark[:6] == ("mic", START + SECOND, START + 2 * SECOND, "yelling", "Ann", mark.made)
    assert began <= mark.made <= time.time_ns()
    assert mark.corrects == "live"


def test_what_the_model_doubts_is_paler_in_its_lane_unless_a_person_reviewed_it(home):
    segments = read_columns(find_logs(home))["/mic/segment"]
    doubted = segments["confidence"] < UNSURE_BELOW
    timeline = read_timeline([home])
    live = timeline.microphones["mic"].labellings[0]
    assert live.unsure.starts.tolist() == segments["header.stamp"][doubted].tolist()
    live.unsure = live.spans.where(live.spans.texts == "speech")
    start, end = int(live.unsure.starts[0]), int(live.unsure.ends[0])

    def lane():
        lanes = timeline_lanes(timeline)
        found = next(one for one in lanes if (one.labelling, one.name) == ("live", "Talking"))
        return [found.colours[text] for text in found.spans.texts]

    pale = tuple((part + 13) // 2 for part in colour("speech"))
    assert lane() == [pale] * len(live.unsure)
    timeline.microphones["mic"].reviewed = labelled_spans([(start, end, "person")])
    assert lane() == [colour("speech")] + [pale] * (len(live.unsure) - 1)
    timeline.microphones["mic"].reviewed = labelled_spans([])
    speech = live.unsure
    event = joined(*speech[:2], EVENT_PAUSE)  # the first one, as the report counts
    of_first = speech.starts < event.ends[0]
    assert of_first.sum() > 1
    live.unsure = speech.where(speech.starts != speech.starts[of_first][-1])
    shades = [colour("speech") if own else pale for own in of_first]
    assert lane() == shades, "one of its segments is sure, so the event is"


def test_a_span_across_logs_is_a_mark_in_each_of_them(home):
    marking = marking_of(home)
    first, second = marking.coverage.starts[1:3]
    marking.mark(first - SECOND, second + SECOND, "yelling")
    found = [read_marks(log) for log in marking.coverage.logs]
    assert [[(m.start, m.end) for m in marks] for marks in found] == [
        [(first - SECOND, first)],
        [(first, second)],
        [(second, second + SECOND)],
        [],
    ]


def test_what_was_not_recorded_cannot_be_marked_and_nothing_changes(home):
    full = marking_of(home)
    hole = Coverage(
        *(list(column[:1]) + list(column[2:]) for column in vars(full.coverage).values())
    )
    marking = Marking("mic", hole, "Ann", "live", full.labelled)
    for start, end in (
        (hole.ends[0] - SECOND, hole.starts[1] + SECOND),
        (hole.ends[0] + SECOND, hole.ends[0] + 2 * SECOND),
        (START - 2 * SECOND, START - SECOND),
        (hole.ends[-1] + SECOND, hole.ends[-1] + 2 * SECOND),
    ):
        with pytest.raises(DataError, match="part of this span was not recorded"):
            marking.mark(start, end, "yelling")
    assert layers(home) == []
    assert marking.undo() is None


def test_a_label_that_cannot_be_is_refused_and_nothing_changes(home):
    marking = marking_of(home)
    for label in ("", "a/b\n", "x" * 500):
        with pytest.raises(DataError, match="cannot be the name of a class"):
            marking.mark(START, START + SECOND, label)
    assert layers(home) == []
    assert marking.undo() is None


def test_marks_of_one_of_two_homes_in_a_folder_are_beside_its_own_logs(
    recorded_home, tmp_path, model_file, day
):
    shutil.copytree(recorded_home, tmp_path / "both")
    options = Settings(
        output=tmp_path / "both", model=model_file, node="other", microphone=[{"name": "bath"}]
    )
    others = record(options, FileSource([day], START + 7 * SECOND), Flag()).logs
    timeline = read_timeline([tmp_path / "both"])
    assert sorted(timeline.microphones) == ["bath", "mic"]
    assert timeline.coverage["bath"].logs == others
    marking = Marking(
        "bath",
        timeline.coverage["bath"],
        "Ann",
        "live",
        timeline.microphones["bath"].labellings[0].spans,
    )
    marking.mark(START + 40 * SECOND, START + 50 * SECOND, "yelling")
    assert [mark.microphone for log in others for mark in read_marks(log)] == ["bath"]
    assert len(layers(tmp_path / "both")) == 1


# Keys


class Screen:
    """A viewer that keeps what it is told."""

    def __init__(self):
        self.open = True
        self.marked = None
        self.at = None
        self.answers = self.draws = True
        self.shown = []
        self.requested = []
        self.played = []
        self.refreshed = 0
        self.lane = None

    def is_open(self):
        return self.open

    def selection(self):
        if not self.answers:
            raise TimeoutError
        return self.marked

    def cursor(self):
        return self.at

    def show(self, start, end, margin, *, select=True):
        self.marked = (start, end) if select else None
        self.shown.append((start, end, margin))

    def refresh(self):
        self.refreshed += 1

    def clear_question(self):
        self.requested.append(None)

    def show_question(self, start, end, question):
        self.requested.append((start, end, question))

    def play(self, start):
        self.played.append(start)

    def redraw_marks(self, microphone, scenario, marks, reviewed):
        assert (microphone, scenario) in {("mic", ""), ("mic", "water")}
        if not self.draws:
            raise TimeoutError
        self.lane, self.reviewed = as_rows(marks), as_rows(reviewed)


class Sitting:
    """A session, and what it says."""

    def __init__(self, home, items=()):
        self.screen = Screen()
        self.output = []
        self.closely = []
        self.played = []
        self.seconds = 3.0  # of each sound
        marking = marking_of(home)
        self.labelled = marking.labelled
        self.session = ReviewSession(
            self.screen,
            marking,
            ["silence", "speech", "coughing"],
            UTC,
            self.output.append,
            lambda start, end: self.closely.append((start, end)),
            lambda start, end: self.played.append((start, end)) or (self.seconds, "playing"),
            lambda: self.output.append("silence"),
            items,
        )

    def run(self, keys):
        queue = SimpleQueue()
        for key in keys:
            queue.put(key)
        queue.put("q")
        return self.session.run(queue)


def items_of(count):
    return [
        ReviewItem(START + k * 10 * SECOND, START + (k * 10 + 5) * SECOND, "music", f"item {k}")
        for k in range(count)
    ]


def test_a_key_names_the_span_that_is_marked_with_the_mouse(home):
    sitting = Sitting(home)
    sitting.screen.marked = span = (START + 10 * SECOND, START + 12 * SECOND)
    assert sitting.run("2") == 1
    assert [(m.start, m.end, m.label) for m in layers(home)] == [(*span, "speech")]
    assert sitting.screen.lane == [(*span, "speech")]
    assert sitting.output[1].startswith("marked as talking: ")
    assert sitting.output[-1].startswith("1 span reviewed in")


def test_correct_is_what_the_recorder_said_in_the_span(home):
    sitting = Sitting(home)
    sitting.screen.marked = start, end = (START + 10 * SECOND, START + 40 * SECOND)
    sitting.run("c")
    output = [
        (max(a, start), min(b, end), text)
        for a, b, text in as_rows(sitting.labelled)
        if a < end and b > start
    ]
    edge = marking_of(home).coverage.starts[1]
    found = [(m.start, m.end, m.label) for m in layers(home)]
    assert len({label for *_, label in found}) > 1
    assert [m for m in found if edge not in m[:2]] == [m for m in output if not m[0] < edge < m[1]]


def test_unknown_delete_and_undo(home):
    sitting = Sitting(home)
    sitting.screen.marked = (START + 10 * SECOND, START + 12 * SECOND)
    assert sitting.run("u") == 1
    assert [m.label for m in layers(home)] == ["unknown"]
    assert sitting.run("d") == 2
    assert layers(home) == []
    assert sitting.run("z") == 1
    assert [m.label for m in layers(home)] == ["unknown"]
    assert sitting.run("zz") == 0
    assert layers(home) == []
    assert "nothing to undo" in sitting.output


def test_the_ends_of_a_span_are_set_at_the_cursor(home):
    sitting = Sitting(home)
    sitting.screen.at = START + 10 * SECOND
    sitting.session.press("[")
    sitting.screen.at = START + 13 * SECOND
    sitting.session.press("]")
    assert sitting.screen.shown[-1][:2] == (START + 10 * SECOND, START + 13 * SECOND)
    sitting.session.press("3")
    assert [(m.start, m.end, m.label) for m in layers(home)] == [
        (START + 10 * SECOND, START + 13 * SECOND, "coughing")
    ]
    sitting.screen.at = START + 9 * SECOND
    sitting.session.press("[")
    sitting.screen.at = START + 8 * SECOND
    sitting.session.press("]")
    assert sitting.output[-1].startswith("put the time cursor on the start and press [")


@pytest.mark.parametrize(
    ("key", "output"),
    [
        ("2", "no span is selected: drag a span on the time ruler"),
        ("c", "no span is selected"),
        ("]", "click on the time ruler first"),
        ("?", "'?' does nothing: press one of these keys"),
        ("n", "'n' does nothing"),
    ],
)
def test_a_key_that_does_not_fit_is_explained_and_changes_nothing(home, key, output):
    sitting = Sitting(home)
    sitting.session.press(key)
    assert output in sitting.output[-1]
    assert layers(home) == []


def test_a_long_span_is_marked_by_a_second_press_of_the_same_key(home):
    sitting = Sitting(home)
    sitting.screen.marked = span = (START + 10 * SECOND, START + 110 * SECOND)
    for key, wanted in (("2", "talking"), ("3", "coughing")):
        sitting.session.press(key)
        line = f"1 min 40 s is long: press the key again to mark it as {wanted}"
        assert sitting.output[-1] == line
        assert layers(home) == []
    sitting.session.press("3")
    assert {mark.label for mark in layers(home)} == {"coughing"}
    assert sitting.output[-1].endswith(", 1 min 40 s")
    sitting.screen.marked = (span[0], span[0] + 59 * SECOND)
    sitting.session.press("2")
    assert sitting.output[-1].endswith(", 59.0 s")


def test_lengths_are_in_words():
    lengths = {3.25: "3.2 s", 60: "60.0 s", 3200: "53 min 20 s", 7320: "2 h 2 min", 86400: "24 h"}
    assert {each: length_text(round(each * SECOND)) for each in lengths} == lengths


def test_what_cannot_be_heard_is_said_and_not_offered_to_play(home):
    kept, lost = items_of(2)
    sitting = Sitting(home, [kept, lost._replace(is_audible=False)])
    sitting.run("n")
    (*_, first), (*_, second) = (one for one in sitting.screen.requested if one is not None)
    assert "p" in [key.key for key in first.keys]
    assert "p" not in [key.key for key in second.keys]
    assert second.place.endswith("; nothing to hear: its sound was not kept")
    assert "hear" not in first.place


def test_the_question_before_is_gone_until_the_next_span_is_drawn(home):
    sitting = Sitting(home, items_of(2))
    shown = []
    draw, show = sitting.session.look_closely, sitting.screen.show
    sitting.session.look_closely = lambda *span: (shown.append("draw"), draw(*span))
    sitting.screen.show = lambda *span, **more: (shown.append("show"), show(*span, **more))
    sitting.screen.clear_question = lambda: shown.append("clear")
    sitting.screen.show_question = lambda *_: shown.append("ask")
    sitting.session.announce = shown.append
    sitting.run("n")
    assert shown[1:5] == ["clear", "draw", "show", "ask"]
    assert shown[5].startswith("1 of 2: ")


def test_the_keys_are_three_lines_by_what_they_are_for(home):
    sitting = Sitting(home)
    sitting.session.press("?")
    answers, sounds, marks, _ = sitting.output[-4:]
    assert answers == "answers: c confirm the labels, Enter confirm the rest, q quit"
    assert sounds.startswith("sounds: 1 quiet, ")
    assert sounds.endswith("t television, u not recognised")
    assert marks.startswith("spans and marks: m move the mark, d delete the marks, z undo, Space ")


def test_a_span_that_was_not_recorded_is_explained_and_the_session_goes_on(home):
    sitting = Sitting(home)
    sitting.screen.marked = (START - 9 * SECOND, START - 5 * SECOND)
    sitting.session.press("2")
    assert "part of this span was not recorded" in sitting.output[-1]
    sitting.screen.marked = (START + 5 * SECOND, START + 9 * SECOND)
    sitting.session.press("2")
    assert len(layers(home)) == 1


def test_a_viewer_that_does_not_answer_costs_no_mark(home):
    sitting = Sitting(home)
    sitting.screen.marked = (START + 5 * SECOND, START + 9 * SECOND)
    sitting.screen.answers = False
    sitting.session.press("2")
    assert "did not answer" in sitting.output[-1]
    sitting.screen.answers = True
    sitting.session.press("2")
    assert len(layers(home)) == 1


def test_a_mark_that_cannot_be_shown_is_made_once_and_undone_once(home):
    sitting = Sitting(home)
    sitting.screen.marked = (START + 5 * SECOND, START + 9 * SECOND)
    sitting.session.press("2")
    sitting.screen.marked = (START + 15 * SECOND, START + 19 * SECOND)
    sitting.screen.draws = False
    sitting.session.press("3")
    assert sitting.output[-1] == "saved, but not shown, as the viewer did not answer"
    sitting.session.press("z")
    assert sitting.output[-1] == "undone, but not shown, as the viewer did not answer"
    assert [mark.label for mark in layers(home)] == ["speech"]


def test_before_the_first_key_nothing_is_called_saved_and_a_skip_saves_nothing(home):
    sitting = Sitting(home, items_of(2))

    def silent(*_):
        raise TimeoutError

    sitting.screen.draws, sitting.session.look_closely = False, silent
    sitting.run("n")
    loading, hint, first, skipped, second, _ = sitting.output
    assert loading == "The picture is still loading; you can answer already."
    assert hint.startswith("press a")
    assert skipped == "not shown, as the viewer did not answer"
    assert (first[:8], second[:8]) == ("1 of 2: ", "2 of 2: ")


def test_what_plays_plays_although_the_viewer_does_not_answer(home):
    def silent(_):
        raise TimeoutError

    sitting = Sitting(home)
    sitting.screen.marked = (START, START + SECOND)
    sitting.screen.play = silent
    sitting.session.press("p")
    assert sitting.output == ["playing"]


def test_a_queue_of_which_nothing_can_be_heard_says_so_once(home):
    sitting = Sitting(home, [one._replace(is_audible=False) for one in items_of(2)])
    sitting.run("n")
    first, *others = sitting.output
    assert first.startswith("None of these can be heard: record with `--keep-audio unsure` (see ")
    assert not any("hear" in line for line in others)
    assert all("hear" not in one[2].place for one in sitting.screen.requested if one)


def test_the_classes_come_first(home):
    day, queue = Sitting(home).session, Sitting(home, items_of(1)).session
    assert [one.key for one in day.keys][:7] == [*"123tuc", "."]
    assert [one.key for one in queue.keys][:7] == [*"a123tu", "."]


def test_a_queue_goes_on_by_itself_and_ends_after_the_last_span(home):
    items = items_of(3)
    sitting = Sitting(home, items)
    queue = SimpleQueue()
    for key in "23u":
        queue.put(key)
    assert sitting.session.run(queue) == 3
    assert [(start, end) for start, end, _ in sitting.screen.shown] == [item[:2] for item in items]
    assert [(m.start, m.end, m.label) for m in layers(home)] == [
        (*item[:2], label)
        for item, label in zip(items, ["speech", "coughing", "unknown"], strict=True)
    ]
    found = [line[:6] for line in sitting.output if line[1:5] == " of "]
    assert found == ["1 of 3", "2 of 3", "3 of 3"]
    assert all(
        a < item.start and b > item.end for (a, b), item in zip(sitting.closely, items, strict=True)
    )


def seconds_of(folder):
    """Labels with their starts and ends, in seconds from the start."""
    return [((m.start - START) / SECOND, (m.end - START) / SECOND, m.label) for m in layers(folder)]


def select(sitting, start, end):
    sitting.screen.marked = (START + round(start * SECOND), START + round(end * SECOND))


def test_the_ends_of_a_mark_are_moved_by_a_drag_over_it_and_undone(home):
    sitting = Sitting(home)
    for start, key in ((10, "2"), (14, "3")):
        select(sitting, start, start + 2)
        sitting.session.press(key)
    before = layers(home)
    select(sitting, 9.5, 14.5)  # over both, of the first one more
    sitting.session.press("m")
    assert seconds_of(home) == [(9.5, 14.5, "speech"), (14.5, 16, "coughing")]
    assert sitting.screen.lane == [(m.start, m.end, m.label) for m in layers(home)]
    assert sitting.output[-1].startswith("mark moved: talking: ")
    assert sitting.output[-1].endswith(", 5.0 s")
    sitting.session.press("z")
    assert layers(home) == before
    assert sitting.screen.lane == [(m.start, m.end, m.label) for m in before]


def test_the_last_mark_is_moved_to_a_span_without_a_mark_but_an_older_one_is_not(home):
    marking_of(home).mark(START + 60 * SECOND, START + 61 * SECOND, "music")
    sitting = Sitting(home)
    select(sitting, 20, 21)
    sitting.session.press("m")
    assert "no mark in the selection" in sitting.output[-1]
    sitting.session.press("2")
    sitting.session.press("m")
    assert "the mark has these ends" in sitting.output[-1]
    select(sitting, 22, 22.5)
    sitting.session.press("m")
    assert seconds_of(home) == [(22, 22.5, "speech"), (60, 61, "music")]


def test_a_mark_is_moved_into_the_next_log_and_back_and_marks_between_stay(home):
    marking = marking_of(home)
    edge = marking.coverage.starts[1]
    marking.mark(edge - SECOND, edge, "music")
    marking.mark(edge - 4 * SECOND, edge - 3 * SECOND, "yelling")
    history = [layers(home)]
    for start, end in (
        (edge + SECOND, edge + 2 * SECOND),
        (edge - SECOND // 4, edge + SECOND * 3 // 2),
    ):
        moved = marking.move(start, end)
        assert (moved[0].start, moved[-1].end) == (start, end)
        history.append(layers(home))
    texts = [[mark.label for mark in found] for found in history]
    assert texts == [["yelling", "music"], ["music", "yelling"], ["music", "yelling", "yelling"]]
    marking.move(edge - SECOND // 2, edge + 3 * SECOND)  # both parts of it
    assert [m.label for m in layers(home)] == ["music", "yelling", "yelling"]
    for before in reversed(history):
        marking.undo()
        assert layers(home) == before


def test_a_disk_that_fails_while_a_mark_is_moved_leaves_the_mark(home, monkeypatch):
    marking = marking_of(home)
    edge = marking.coverage.starts[1]
    marking.mark(edge - 4 * SECOND, edge - 3 * SECOND, "yelling")
    written = []

    def fail_at_the_second(*arguments, **options):
        written.append(arguments)
        if len(written) == 2:
            raise LogError("the disk is full")
        return write_marks(*arguments, **options)

    monkeypatch.setattr("hearthlog.analyzer.review.marking.write_marks", fail_at_the_second)
    with pytest.raises(LogError):
        marking.move(edge + SECOND, edge + 2 * SECOND)
    assert (edge + SECOND, edge + 2 * SECOND, "yelling") in [(m[1:4]) for m in layers(home)]
    monkeypatch.undo()
    marking = marking_of(home)
    marking.delete(edge - 4 * SECOND, edge - 3 * SECOND)
    marking.mark(edge + SECOND, edge + 2 * SECOND, "yelling")
    marking.move(edge - 4 * SECOND, edge - 3 * SECOND)
    written.clear()
    monkeypatch.setattr("hearthlog.analyzer.review.marking.write_marks", fail_at_the_second)
    with pytest.raises(LogError):
        marking.undo()
    assert "yelling" in [mark.label for mark in layers(home)]


def test_in_a_queue_what_is_reviewed_follows_the_mark_and_nothing_moves_without_a_drag(home):
    items = items_of(2)
    sitting = Sitting(home, items)
    sitting.run("2")
    sitting.session.press("m")  # the next item is selected by the queue, by nobody's hand
    assert sitting.output[-1].startswith("drag the new span of the mark first")
    select(sitting, 1, 3)
    sitting.session.press("m")
    assert seconds_of(home) == [(1, 3, "speech")]
    assert [(s.start - START, s.end - START, s.chosen) for s in reviewed(home)] == [
        (SECOND, 3 * SECOND, "queue")
    ]
    assert sitting.screen.shown[-1][0] == items[1].start
    sitting.session.press("z")
    assert [(s.start, s.end) for s in reviewed(home)] == [items[0][:2]]


def test_each_end_of_the_selected_span_is_moved_alone(home):
    sitting = Sitting(home)
    select(sitting, 10, 13)
    for second, key, expected in ((9, "[", (9, 13)), (12, "]", (9, 12)), (11, "[", (11, 12))):
        sitting.screen.at = START + second * SECOND
        sitting.session.press(key)
        assert sitting.screen.marked == tuple(START + each * SECOND for each in expected)


def test_in_a_queue_one_may_skip_go_back_and_accept(home):
    items = items_of(4)
    sitting = Sitting(home, items)
    assert sitting.run("nnba" + "bbbbb" + "1p") == 2
    starts = [item.start for item in items]
    visited = [starts.index(start) for start, _, _ in sitting.screen.shown]
    assert visited == [0, 1, 2, 1, 2, 1, 0, 0, 0, 0, 1]
    assert [(m.start, m.end, m.label) for m in layers(home)] == [
        (*items[0][:2], "silence"),
        (*items[1][:2], "music"),
    ]
    assert sitting.played == [items[1][:2]]
    assert sitting.screen.played == [items[1].start]


def test_in_a_queue_the_span_that_is_dragged_counts(home):
    sitting = Sitting(home, items_of(2))
    sitting.run("")
    sitting.screen.marked = (START + SECOND, START + 2 * SECOND)
    sitting.session.press("2")
    assert [(m.start, m.end) for m in layers(home)] == [(START + SECOND, START + 2 * SECOND)]


def test_undo_in_a_queue_goes_back_to_the_span_that_was_undone(home):
    items = items_of(4)
    sitting = Sitting(home, items)
    assert sitting.run("2n3z" + "1") == 2
    shown = [start for start, _, _ in sitting.screen.shown]
    assert shown == [items[k].start for k in (0, 1, 2, 3, 2, 3)]
    assert [(m.start, m.label) for m in layers(home)] == [
        (items[0].start, "speech"),
        (items[2].start, "silence"),
    ]
    start, end, question = [*filter(None, sitting.screen.requested)][-2]
    assert ((start, end), question.text) == (items[2][:2], "Music?")


def minute_of(start):
    return ReviewItem(start, start + 60 * SECOND, "speech", "a minute", RANDOM)


def reviewed(folder):
    """All spans that were looked at, as review layers say."""
    return [s for log in find_logs(folder) if not is_layer(log) for s in read_reviewed(log)]


def test_in_a_minute_one_marks_what_is_wrong_and_the_rest_is_right(home):
    minute, wrong = START + 30 * SECOND, (START + 40 * SECOND, START + 42 * SECOND)
    sitting = Sitting(home, [minute_of(minute), *items_of(1)])
    sitting.run("")
    sitting.screen.marked = wrong
    sitting.session.press("2")
    assert sitting.screen.shown[-1][0] == minute
    assert reviewed(home) == []
    sitting.session.press("\n")
    assert sitting.screen.shown[-1][0] == START
    assert [(m.start, m.end, m.label) for m in layers(home)] == [(*wrong, "speech")]
    (looked,) = reviewed(home)
    assert (looked.start, looked.end, looked.chosen) == (minute, minute + 60 * SECOND, "random")
    assert (looked.reviewer, looked.corrects) == ("Ann", "live")
    sitting.session.press("z")
    assert (reviewed(home), len(layers(home))) == ([], 1)
    sitting.session.press("z")
    assert layers(home) == []


@pytest.mark.parametrize("key", ["2", "u", "d"])
def test_in_a_minute_a_key_without_a_drag_names_nothing(home, key):
    sitting = Sitting(home, [minute_of(START + 30 * SECOND)])
    sitting.run("")
    assert sitting.screen.marked is None
    sitting.session.press(key)
    assert sitting.output[-1].startswith("drag over the sound first; Enter confirms the rest")
    assert (reviewed(home), layers(home)) == ([], [])
    sitting.session.press(" ")  # all of it is played
    assert sitting.played == [(START + 30 * SECOND, START + 90 * SECOND)]


def test_space_plays_and_stops(home):
    sitting = Sitting(home, items_of(1))
    sitting.run("")
    for _ in range(3):
        sitting.session.press(" ")
    assert sitting.played == [items_of(1)[0][:2]] * 2
    assert sitting.output[-4:] == ["playing", "silence", "stopped", "playing"]
    sitting.seconds = 0.0  # nothing was kept
    sitting.session.press("p")
    sitting.session.press("p")
    assert len(sitting.played) == 3
    assert len(sitting.screen.played) == 2


def test_what_is_skipped_is_not_reviewed_and_what_is_judged_is(home):
    items = items_of(4)
    sitting = Sitting(home, [minute_of(START + 90 * SECOND), *items])
    assert sitting.run("nn2a.") == 3
    assert [(s.start, s.end, s.chosen) for s in reviewed(home)] == [
        (*item[:2], "queue") for item in items[1:]
    ]
    assert [m.label for m in layers(home)] == ["speech", "music"]


def test_a_span_that_a_person_looked_at_by_her_own_choice_says_so(home):
    sitting = Sitting(home)
    sitting.screen.marked = span = (START + 10 * SECOND, START + 20 * SECOND)
    assert sitting.run(".") == 1
    (looked,) = reviewed(home)
    assert (looked.start, looked.end, looked.chosen) == (*span, "person")
    assert layers(home) == []


def test_where_marks_are_deleted_nothing_counts_as_reviewed_and_undone_it_does(home):
    marking = marking_of(home)
    at = START + 35 * SECOND
    marking.review(at, at + 20 * SECOND, "queue")
    marking.review(at, at + 20 * SECOND, RANDOM)
    marking.mark(at + SECOND, at + 3 * SECOND, "speech")
    before = reviewed(home)
    marking.delete(at, at + 5 * SECOND)
    assert [(s.start, s.end, s.chosen) for s in reviewed(home)] == [
        (at + 5 * SECOND, at + 20 * SECOND, "queue")
    ]
    marking.undo()
    assert reviewed(home) == before
    assert [mark.label for mark in layers(home)] == ["speech"]


def test_a_session_ends_when_the_viewer_is_closed(home):
    sitting = Sitting(home, items_of(2))
    sitting.screen.open = False
    assert sitting.session.run(SimpleQueue()) == 0


def test_every_key_is_offered_once_with_what_it_does(home):
    for items in ((), items_of(1)):
        keys = [one.key for one in Sitting(home, items).session.keys]
        assert len(set(keys)) == len(keys)
    many = Sitting(home)
    many.session.classes = [f"class_{i}" for i in range(60)]
    keys = [one.key for one in many.session.keys]
    assert len(set(keys)) == len(keys)


def test_a_reviewer_reads_the_names_that_the_lanes_have_and_one_key_means_not_sure(home):
    item = ReviewItem(START, START + 5 * SECOND, "yelling", "an item")
    sitting = Sitting(home, [item])
    sitting.session.classes = ["silence", "yelling", "unknown", "phone_ring"]
    named = [one for one in sitting.session.keys if one.key in "1234u"]
    classes = [one.text for one in named]
    assert [one.colour for one in named] == [
        colour(name) for name in ("silence", "yelling", "phone_ring", "unknown")
    ]
    assert classes == ["quiet", "shouting", "telephone ringing", "not recognised"]
    sitting.run("3")
    ((*span, question),) = filter(None, sitting.screen.requested)
    assert (tuple(span), question.text) == (item[:2], "Shouting?")
    assert [one.cap for one in question.keys] == [*"a13tun", "Space", "z"]  # 2 is what is asked
    assert sitting.output[2].startswith("marked as telephone ringing: ")
    assert [mark.label for mark in layers(home)] == ["phone_ring"]


# Sound


def test_the_sound_of_a_span_is_that_of_the_clips_in_it():
    clips = [
        SoundClip(START, 100, np.arange(500, dtype=np.int16)),
        SoundClip(START + 10 * SECOND, 100, np.arange(1000, 1500, dtype=np.int16)),
        SoundClip(START + 11 * SECOND, 44_100, np.zeros(5, np.int16)),
    ]
    rate, samples = sound_of(clips, START + 4 * SECOND, START + 12 * SECOND)
    assert rate == 100
    assert (samples * 32768).tolist() == [*range(400, 500), *range(1000, 1200)]
    assert len(sound_of(clips, START + 6 * SECOND, START + 7 * SECOND)[1]) == 0


# What is in the queue


def queue_items(*arguments):
    return review_items(queue_spans(*arguments))


@pytest.mark.parametrize("ranking", ["useful", "uncertain", "novel", "disagreeing"])
def test_a_queue_has_spans_of_the_labelling_that_do_not_overlap(recorded_home, timeline, ranking):
    sources = find_labellings(recorded_home)
    found = queue_items(ranking, sources, ("mic", "live"), (None, None), 8)
    assert 2 <= len(found) <= 8
    ordered = sorted(found)
    assert all(a.end <= b.start for a, b in pairwise(ordered))
    assert all(timeline.grid.start <= item.start < item.end <= timeline.grid.end for item in found)
    assert all(item.text.startswith("the recorder: ") for item in found)
    if ranking == "disagreeing":
        spans = [one.spans for one in timeline.microphones["mic"].labellings[:2]]
        for item in found:
            texts = [
                {t for a, b, t in as_rows(each) if a < item.end and b > item.start}
                for each in spans
            ]
            assert texts[0] != texts[1] or len(texts[0]) > 1
    again = queue_items(ranking, sources, ("mic", "live"), (None, None), 8)
    assert again == found


def test_what_was_reviewed_is_not_in_the_queue(home):
    (first, *_) = queue_items("uncertain", find_labellings(home), ("mic", "live"), (None, None), 5)
    marking_of(home).mark(first.start, first.end, "yelling")
    found = queue_items("uncertain", find_labellings(home), ("mic", "live"), (None, None), 5)
    assert all(item.end <= first.start or item.start >= first.end for item in found)


def test_a_list_of_diff_is_gone_through_in_its_order(recorded_home, tmp_path):
    spans = [
        Listed(
            "mic",
            START + k * SECOND,
            START + (k + 2) * SECOND,
            "live",
            "speech",
            "",
            "",
            None,
            "novelty",
        )
        for k in (50, 20, 90)
    ]
    other = spans[0]._replace(microphone="bath")
    write_spans(tmp_path / "list.csv", [other, *spans])
    arguments = (str(tmp_path / "list.csv"), find_labellings(recorded_home), ("mic", "live"))
    found = queue_items(*arguments, (None, None), 60)
    assert [item[:2] for item in found] == [span[1:3] for span in spans]
    part = queue_items(*arguments, (START + 21 * SECOND, START + 60 * SECOND), 60)
    assert [item.start for item in part] == [spans[0].start, spans[1].start]
    assert len(queue_items(*arguments, (None, None), 1)) == 1


# Bad input


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """A folder of its own, to be in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.mark.usefixtures("no_display")
@pytest.mark.parametrize(
    ("words", "count"), [(("--queue",), None), (("--queue", "useful", "--spans", "9"), 9)]
)
def test_without_a_display_a_queue_is_a_label_file_to_correct(home, tmp_path, capfd, words, count):
    path = tmp_path / "ten.txt"
    done = run(capfd, "review", home, *words, "--save", path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.endswith(f"as marks: hearthlog annotate import {home} {path}\n")
    items = queue_items("useful", find_labellings(home), ("mic", "live"), (None, None), count)
    lines = path.read_text().splitlines()
    assert len(lines) == len(done.stdout.splitlines()) - 1 >= len(items) > 3
    path.write_text("".join(f"{line.rpartition(chr(9))[0]}\tyelling\n" for line in lines))
    assert run(capfd, "annotate", "import", home, path).returncode == 0
    marks = layers(home)  # one that reaches into the next log is two
    assert sum(m.end - m.start for m in marks) == sum(item.end - item.start for item in items)
    assert {m.label for m in marks} == {"yelling"}


@pytest.mark.usefixtures("no_display")
def test_a_queue_without_a_value_is_one_of_useful_spans(home, capfd):
    for words in (("--queue", home), (home, "--queue"), (home, "--queue", "--spans", "3")):
        done = run(capfd, "review", *words)
        assert (done.returncode, "no display" in done.stderr) == (1, True)


@pytest.mark.usefixtures("no_display")
def test_without_a_display_it_says_what_else_there_is(recorded_home, capfd):
    done = run(capfd, "review", recorded_home)
    assert done.returncode == 1
    assert "no display: use --web for a browser, or --save FILE.rrd" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_port_that_is_in_use_is_said(recorded_home, capfd):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run(capfd, "review", recorded_home, "--web", "--port", port)
    assert done.returncode == 1
    assert f"port {port} is in use" in done.stderr
    assert "--port" in done.stderr


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--save", "a.rrd", "--web"], (2, "--save writes a file")),
        (["--save", "a.rrd", "--queue", "novel"], (2, "of a queue it is a label file")),
        (["--sound"], (2, "needs --web")),
        (["--day", "2026-03-01", "--start", "2026-03-01T07:00"], (2, "--day excludes --start")),
        (["--day", "someday", "--save", "a.rrd"], (2, "not a day such as 2026-03-01")),
        (["--day", "2020-01-01", "--save", "a.rrd"], (1, "in this span of time")),
        (["--start", "2026-03-01T08", "--end", "2026-03-01T07"], (2, "is not after --start")),
        (["--start", "2030-01-01T00:00", "--save", "a.rrd"], (1, "in this span of time")),
        (["--timezone", "Nowhere", "--save", "a.rrd"], (1, "is no time zone")),
        (["--save", "a.mcap"], (1, "must end in .rrd")),
        (["--save", "none/a.rrd"], (1, "there is no folder")),
        (["--web", "--microphone", "cellar"], (2, "--microphone cellar: there is mic")),
        (["--web", "--labels", "nobody"], (1, "no labelling 'nobody'")),
        (["--web", "--queue", "boring"], (1, "use useful, uncertain, disagreeing, novel, random")),
        (["--web", "--queue", "none.csv"], (1, "none.csv")),
        (["--web", "--reviewer", "a\nb"], (2, "")),
    ],
)
def test_what_cannot_be_is_one_clear_message(recorded_home, in_folder, capfd, options, expected):
    status, text = expected
    done = run(capfd, "review", recorded_home, *options)
    assert (done.returncode, done.stdout) == (status, "")
    assert text in " ".join(done.stderr.replace("│", " ").split())
    assert "Traceback" not in done.stderr
    assert list(in_folder.iterdir()) == []


def test_a_file_that_exists_is_left_alone(recorded_home, capfd, tmp_path):
    (tmp_path / "a.rrd").write_text("precious")
    done = run(capfd, "review", recorded_home, "--save", tmp_path / "a.rrd")
    assert (done.returncode, (tmp_path / "a.rrd").read_text()) == (1, "precious")
    assert "exists already" in done.stderr


def test_the_end_of_the_input_ends_a_review_whose_page_nobody_opened(recorded_home):
    command = [*HEARTHLOG, "review", str(recorded_home), "--queue", "--web"]
    done = subprocess.run(command, input="", capture_output=True, text=True, check=False)
    assert done.returncode in {0, 3}
    assert "the input ended before anybody opened the page" in done.stderr


def test_a_queue_of_logs_without_labels_is_refused(tmp_path, capfd, day):
    record(Settings(output=tmp_path / "logs"), FileSource([day], START), Flag())
    done = run(capfd, "review", tmp_path / "logs", "--web", "--queue", "novel")
    assert done.returncode == 1
    assert "no labelling 'live'" in done.stderr or "no segments" in done.stderr
    assert "Traceback" not in done.stderr


def test_logs_that_cannot_be_read_are_named_and_the_rest_is_saved(home, capfd, tmp_path):
    (home / "broken.mcap").write_bytes(b"not a log")
    done = run(capfd, "review", home, "--save", tmp_path / "a.rrd")
    assert done.returncode == 3
    assert "broken.mcap: is not an MCAP file" in done.stderr
    assert (tmp_path / "a.rrd").exists()


# In the real viewer


def one_mark(folder):
    """Wait until there is a mark, and return the only one."""
    return patiently(lambda: layers(folder), lambda found: len(found) == 1)[0]


def patiently_without_layer(folder):
    """Wait until there is no layer, without reading one: it may go while it is read."""
    patiently(lambda: list(folder.rglob("*.review.mcap")), lambda layers: layers == [])


def programs_of(review):
    """The command and the programs that it started."""
    process = psutil.Process(review.process.pid)
    return [process, *process.children(recursive=True)]


def listening(processes):
    """Addresses and ports at which processes listen."""
    return {
        (connection.laddr.ip, connection.laddr.port)
        for process in processes
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


def check_privacy(review):
    """Check that nothing is sent, and that only this machine is listened to."""
    processes = programs_of(review)
    (viewer,) = [process for process in processes if process.name() == "rerun"]
    (hidden,) = {address for address, _ in listening([viewer])}
    assert hidden.startswith("127.")
    assert hidden != "127.0.0.1"
    assert {address for address, _ in listening(processes)} <= {"127.0.0.1", hidden}
    configuration = Path(viewer.environ()["XDG_CONFIG_HOME"], "rerun", "analytics.json")
    assert json.loads(configuration.read_text())["analytics_enabled"] is False


def test_a_drag_with_the_mouse_in_the_window_ends_as_a_mark_in_the_layer(home, display):
    port = free_port()
    with reviewing(home, "--port", port, "--reviewer", "Ann", DISPLAY=display) as review:
        review.wait_for("drag a span")
        check_privacy(review)
        window = Window(display, port)
        x, y = find_ruler(window.picture)
        window.drag(y, x + 300, x + 500)
        selected = window.dragged()
        review.press("2")
        mark = one_mark(home)
        assert (mark.start, mark.end) == selected
        assert (mark.label, mark.reviewer, mark.corrects) == ("speech", "Ann", "live")
        review.press("z")
        patiently_without_layer(home)
        review.press("3")
        assert one_mark(home)[1:4] == (*selected, "music")
        window.drag(y, x + 500, x + 560)  # the end of the selection
        patiently(window.selection, lambda span: span != selected)
        moved = window.dragged()
        assert moved[0] == selected[0]
        assert moved[1] > selected[1]
        review.press("m")
        review.wait_for("mark moved: music")
        assert one_mark(home)[1:4] == (*moved, "music")
        assert review.quit() == 0
    assert review.lines[-2].startswith("2 spans reviewed in")
    assert review.lines[-1].endswith(f"hearthlog train --home {home}")


def test_a_drag_with_the_mouse_in_the_page_ends_as_a_mark_in_the_layer(home, tmp_path):
    options = ("--web", "--port", free_port(), "--reviewer", "Ann")
    with reviewing(home, *options, BROWSER="true") as review:
        line = review.wait_for("http://127.0.0.1:")
        address = line[line.index("http:") :].split()[0]
        with browsing(address, tmp_path / "browser") as page:
            review.wait_for("drag a span")
            check_privacy(review)
            patiently(page.text, lambda text: "drag a span" in text)
            x, y = find_ruler(page.picture, page.bar_height())
            page.drag(y, x + 200, x + 350)  # a part of the second log
            buttons = "[...document.querySelectorAll('button')]"
            page.evaluate(f"{buttons}.find(each => each.textContent == 'talking2').click()")
            mark = one_mark(home)
            assert (mark.label, mark.reviewer, mark.corrects) == ("speech", "Ann", "live")
            seconds = (mark.end - mark.start) / SECOND
            assert 25 < seconds < 45  # of 200 in about 870 pixels
            patiently(page.text, lambda text: text.startswith("marked as talking"))
            page.evaluate(f"{buttons}.find(each => each.textContent == 'undoz').click()")
            patiently_without_layer(home)
            page.evaluate(f"{buttons}.find(each => each.textContent == 'quitq').click()")
            assert review.process.wait(60) == 0


def test_the_page_shows_the_line_before_and_the_last_one_whole_above_the_buttons(home, tmp_path):
    options = ("--web", "--port", free_port(), "--queue", "uncertain")
    lines = """[...document.querySelectorAll("#lines p")].map((line) => {
        const box = line.getBoundingClientRect(), whole = document.createRange();
        whole.selectNodeContents(line);
        const text = whole.getBoundingClientRect();
        return [line.textContent, text.left >= 0 && text.right <= innerWidth && text.top >= box.top
            && text.bottom <= box.bottom + 1 && box.bottom <= innerHeight];
    })"""
    tops = """[...document.querySelectorAll("button")].filter((b) => b.offsetHeight)
        .map((b) => b.getBoundingClientRect().top
            - document.querySelector("#lines").getBoundingClientRect().bottom)"""
    with reviewing(home, *options, BROWSER="true") as review:
        line = review.wait_for("http://127.0.0.1:")
        address = line[line.index("http:") :].split()[0]
        with browsing(address, tmp_path / "browser", flags=COARSE) as page:
            review.wait_for("1 of ")
            for following, (width, height) in enumerate([(1366, 768), (390, 844)], start=2):
                page.call(
                    "Emulation.setDeviceMetricsOverride",
                    width=width, height=height, deviceScaleFactor=0.5, mobile=False,
                )  # fmt: skip
                review.press("u")
                requested = review.wait_for(f"{following} of ")
                patiently(page.text, lambda text, wanted=requested: text == wanted)
                (done, is_complete), (last, also) = page.evaluate(lines)
                assert done.startswith("marked as not recognised: ")
                assert (last, is_complete, also) == (requested, True, True)
                assert min(page.evaluate(tops)) >= 0


def test_on_a_phone_the_page_has_the_question_and_large_buttons_of_its_answers(home, tmp_path):
    buttons = """[...document.querySelectorAll("button")].filter((b) => b.offsetHeight)
        .map((b) => [b.dataset.key, b.offsetHeight, b.getBoundingClientRect().right])"""
    tops = """[...document.querySelectorAll("button")]
        .map((b) => b.getBoundingClientRect().top)"""
    options = ("--web", "--port", free_port(), "--queue", "uncertain")
    with reviewing(home, *options, BROWSER="true") as review:
        line = review.wait_for("http://127.0.0.1:")
        address = line[line.index("http:") :].split()[0]
        with browsing(address, tmp_path / "browser", "1366,768", COARSE) as page:
            review.wait_for("1 of ")
            patiently(page.text, lambda text: text.startswith("1 of "))
            every = page.evaluate(buttons)
            assert len(set(page.evaluate(tops))) <= 2, "rows"
            assert max(height for _, height, _ in every) <= 34
            assert max(right for *_, right in every) <= 1366
            names = "[...document.querySelectorAll('button .name')].map((one) => one.offsetWidth)"
            assert min(page.evaluate(names)) > 0
            ends = "canvas.clientHeight + document.getElementById('keys').offsetHeight"
            assert page.evaluate(f"{ends} - innerHeight") == 0
            page.call(
                "Emulation.setDeviceMetricsOverride",
                width=390, height=844, deviceScaleFactor=0.5, mobile=False,
            )  # fmt: skip
            found = patiently(
                lambda: page.evaluate(buttons), lambda each: max(right for *_, right in each) <= 390
            )
            keys = {key for key, *_ in found}
            assert {"a", "n", "z", "u"} <= keys
            assert not keys & set("md[]bq")
            assert min(height for _, height, _ in found) >= 56
            question = page.evaluate("document.getElementById('question').textContent")
            assert question == page.text().split(": ", 1)[1].split("?")[0] + "?"
            yes = page.evaluate("document.querySelector('button[data-key=a] .name').textContent")
            assert yes == f"Yes, {question.rstrip('?').lower()}"
            play = "document.querySelector('button[data-key=p]').disabled"
            assert page.evaluate(play) is True  # no sound of this home was kept


def request(port, path, **headers):
    """Status, kind and content of a request to the page."""
    connection = HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", path, headers={"Host": f"127.0.0.1:{port}", **headers})
    answer = connection.getresponse()
    return answer.status, answer.getheader("Content-Type"), answer.read()


def test_the_page_plays_the_kept_sound_of_the_span_and_nobody_else_gets_it(home, tmp_path):
    (log, *_) = [log for log in find_logs(home) if not is_layer(log)]
    clips = ClipWriter(Settings(output=home, keep_audio="always"), ["mic"], lambda at: (log, at))
    stamps = START + np.arange(100, 200) * FRAME_NANOSECONDS
    tone = np.round(8000 * np.sin(np.arange(100 * FRAME_SAMPLES) * 0.3)).astype(np.int16)
    assert clips.write("mic", [KeptSound(stamps, tone.reshape(100, -1))]) == []
    clips.finish()
    spans = tmp_path / "spans.csv"
    row = "mic", START + 6 * SECOND, START + 8 * SECOND, "live", "speech", "", "", None, "novelty"
    other = (*row[:1], START + 60 * SECOND, START + 62 * SECOND, *row[3:])
    write_spans(spans, [Listed(*row), Listed(*other)])
    port = free_port()
    options = ("--web", "--sound", "--port", port, "--queue", spans)
    with reviewing(home, *options, BROWSER="true") as review:
        line = review.wait_for("http://127.0.0.1:")
        address = line[line.index("http:") :].split()[0]
        secret = urlsplit(address).path
        flags = (*COARSE, "--autoplay-policy=no-user-gesture-required")
        with browsing(address, tmp_path / "browser", flags=flags) as page:
            review.wait_for("1 of 2")
            status, kind, content = request(port, f"{secret}sound")
            assert (status, kind) == (200, "audio/wav")
            with wave.open(io.BytesIO(content)) as file:
                assert (file.getframerate(), file.getnframes()) == (16_000, 32_000)
                recorded = np.frombuffer(file.readframes(32_000), "<i2")
            assert np.abs(recorded - tone[16_000:48_000]).max() <= 1
            for path, headers in (
                ("/sound", {}),
                (f"/{'x' * 22}/sound", {}),
                (f"{secret}sound", {"Host": "elsewhere.example"}),
                (f"{secret}sound", {"Origin": "http://elsewhere.example"}),
            ):
                assert request(port, path, **headers)[0] == 404
            button = (
                "[...document.querySelectorAll('button')].find(b => b.textContent.includes('▶'))"
            )
            page.evaluate(f"{button}.click()")
            patiently(page.text, lambda text: text == "playing 2.0 s; Space stops it")
            review.press("n")
            review.wait_for("2 of 2")
            found = patiently(lambda: request(port, f"{secret}sound"), lambda one: one[0] != 200)
            assert (found[0], found[2]) == (404, b"no sound of this span was kept\n")
            assert review.quit() == 0


def test_a_page_has_no_sound_unless_it_is_asked_for(home):
    port = free_port()
    with reviewing(home, "--web", "--port", port, BROWSER="true") as review:
        line = review.wait_for("http://127.0.0.1:")
        secret = urlsplit(line[line.index("http:") :].split()[0]).path
        assert request(port, f"{secret}sound")[0] == 404
        assert json.loads(request(port, f"{secret}description")[2])["sound"] is False


def test_a_page_is_sent_at_most_a_minute_of_sound():
    clip = SoundClip(START, 8_000, np.ones(8_000 * 100, np.int16))
    with wave.open(io.BytesIO(sound_file([clip], START, START + 100 * SECOND))) as file:
        assert file.getnframes() == 60 * 8_000


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_review_that_is_ended_ends_its_viewer(home, number):
    with reviewing(home, "--web", DISPLAY="", WAYLAND_DISPLAY="") as review:
        review.wait_for("open http://")
        viewers = programs_of(review)[1:]
        assert viewers
        review.process.send_signal(number)
        assert review.process.wait(60) == 128 + number
        gone, left = psutil.wait_procs(viewers, 20)
        assert (len(gone), left) == (len(viewers), [])


def test_marks_of_a_review_that_is_killed_are_in_the_layer(home, display):
    options = ("--port", free_port(), "--queue", "uncertain", "--spans", "6")
    with reviewing(home, *options, DISPLAY=display) as review:
        review.wait_for("1 of 6")
        for number in (2, 3, 4):
            review.press("u")
            review.wait_for(f"{number} of 6")
        viewers = programs_of(review)[1:]
        review.process.send_signal(signal.SIGKILL)
        review.process.wait()
        for process in viewers:
            process.kill()
    marks = layers(home)
    assert {mark.label for mark in marks} == {"unknown"}
    assert len({mark.made for mark in marks}) == 3
