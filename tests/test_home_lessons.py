"""A home teaches by its marks and by what a review left alone, not by what was drawn at random."""

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from log_fixtures import run

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.dataset import CONFIRMED
from hearthlog.analyzer.training.home_recordings import (
    HOME,
    HOME_WEIGHT,
    MOST_OF_MARK,
    read_reviewed_sound,
    training_recordings,
)
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.analyzer.training.manifest import scenario_of
from hearthlog.analyzer.training.pseudo_labels import (
    chosen,
    confirmed_segments,
    labelled_segments,
    unreviewed_sounds,
)
from hearthlog.models.classifiers.model import Description
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.recording import record
from hearthlog.recorder.recording_session import RecordingSession
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer, review_path

MICROPHONE = SimpleNamespace(device="test")
SECOND = 10**9


@pytest.fixture(scope="module")
def recorded(day, model_file, tmp_path_factory):
    """Logs of the same minutes on two days, labelled by a model."""
    folder = tmp_path_factory.mktemp("recorded")
    settings = Settings(output=folder, model=model_file)
    for number in (1, 2):
        start = int(datetime(2026, 3, number, 7, tzinfo=UTC).timestamp()) * SECOND
        record(settings, FileSource([day], start), Event())
    return folder


@pytest.fixture
def two_days(recorded, tmp_path):
    """The same minutes on two days."""
    return shutil.copytree(recorded, tmp_path / "logs")


@pytest.fixture
def home(two_days):
    """A folder with a log of some minutes, labelled by a model."""
    logs_in(two_days)[1].unlink()
    return two_days


def logs_in(folder):
    return [log for log in find_logs(folder) if not is_layer(log)]


def segments(logs):
    """Start, end and label of what the recorder labelled, longest first."""
    found = read_columns(logs_in(logs)[:1], ["/mic/segment"])["/mic/segment"]
    starts, lengths = found["header.stamp"], found["duration"]
    each = zip(starts.tolist(), (starts + lengths).tolist(), found["label"].tolist(), strict=True)
    return sorted(each, key=lambda one: one[0] - one[1])


def write(logs, marks=(), reviewed=()):
    (log,) = logs_in(logs)
    write_marks(log, [Mark("mic", *each) for each in marks], reviewed=reviewed)


def full(logs, **changed):
    begin, end = min(one[0] for one in segments(logs)), max(one[1] for one in segments(logs))
    return ReviewedSpan("mic", begin, end)._replace(**changed)


def sound(logs):
    (found,) = read_reviewed_sound(logs, DEFAULT)
    return found


def test_what_a_review_left_alone_is_to_stay_as_it_was_labelled(home, model_file):
    model = load_model(model_file)
    marked = next(one for one in segments(home) if one[2] != "silence")
    write(home, [marked], [full(home)])
    found = confirmed_segments(sound(home), model.classes)
    assert len({one.label for one in found.recordings}) > 2
    for one in found.recordings:
        begin, end = one.span
        middle = (begin + end) // 2
        (label,) = {printed for a, b, printed in segments(home) if a <= middle < b}
        assert one.label == label
        assert end + SECOND // 2 <= marked[0] or begin - SECOND // 2 >= marked[1]


def test_what_a_review_left_alone_weighs_as_much_as_the_sounds_of_others(home, model_file):
    model = load_model(model_file)
    write(home, [next(one for one in segments(home) if one[2] != "silence")], [full(home)])
    lessons = read_home_training_set([home], model).segments
    confirmed = lessons.collection == lessons.collection_names.index(CONFIRMED)
    assert set(lessons.weight[confirmed]) == {1.0}
    assert set(lessons.weight[~confirmed]) == {HOME_WEIGHT}


def test_what_a_model_is_less_than_half_sure_of_confirms_nothing(home, model_file):
    write(home, reviewed=[full(home)])
    model = load_model(model_file)
    candidates = [confirmed_segments(sound(home), model.classes)]

    def kept(inverse_temperature, fewest):
        changes = {"inverse_temperature": inverse_temperature}
        other = replace(model, description=model.description.model_copy(update=changes))
        found = chosen(candidates, other, fewest=fewest)
        return [recording.span for recording in found if recording.label != "silence"]

    sure = kept(model.description.inverse_temperature, 0)
    assert sure
    assert kept(0.01, 0) == []
    assert 0 < len(kept(0.01, 1)) < len(sure), "the surest of each class"


def test_nothing_drawn_at_random_teaches_neither_a_mark_nor_a_confirmation(home, model_file):
    model = load_model(model_file)
    longest = next(one for one in segments(home) if one[2] != "silence")
    drawn = ReviewedSpan("mic", longest[0] - SECOND, longest[1] + SECOND, chosen=RANDOM)
    middle = (longest[0] + longest[1]) // 2
    halves = (longest[0], middle, "speech"), (middle, longest[1], "music")
    write(home, halves, [drawn, full(home)])
    assert not list(training_recordings(home))
    for found in (
        confirmed_segments(sound(home), model.classes),
        labelled_segments(sound(home), model.classes, model.classes),
    ):
        spans = [one.span for one in found.recordings]
        assert spans
        assert all(end <= drawn.start or start >= drawn.end for start, end in spans)
    lessons = read_home_training_set([home], model)
    assert not len(lessons.segments)
    assert lessons.nothing == "none of the marks can be learned from"
    assert "2 of 2 marks are not learned from" in lessons.notes[0]


def test_time_without_a_review_teaches_silence_and_what_a_model_is_very_sure_of(home, model_file):
    model = load_model(model_file)
    write(home, [next(one for one in segments(home) if one[2] != "silence")])
    segments_, notes, nothing = read_home_training_set([home], model)
    assert not nothing
    assert any(note.startswith("no time of this home was looked at") for note in notes)
    kept = segments_.collection == segments_.collection_names.index(CONFIRMED)
    names = {segments_.classes[number] for number in segments_.target[kept]}
    assert "silence" in names
    assert len(names) > 1
    assert not kept.all()


def test_a_class_that_a_review_left_alone_often_is_not_taken_from_other_time(home, model_file):
    model = load_model(model_file)
    names = {one[2] for one in segments(home)} - {"silence", "unknown"}
    sure = unreviewed_sounds([home], model, names)
    assert sure
    for one in sure:
        middle = (one.span[0] + one.span[1]) // 2
        assert one.label in {name for a, b, name in segments(home) if a <= middle < b} & names
    other = min(one.label for one in sure)
    assert all(one.label != other for one in unreviewed_sounds([home], model, names - {other}))
    assert unreviewed_sounds([home], model, set()) == []


def test_the_floor_begins_anew_behind_a_gap_as_that_of_the_recorder_did(tmp_path):
    """The blocks of the floor are counted from the first frame of the recorder."""
    begin, frame = 1_772_348_400 * SECOND, 50_000_000
    models = {"mic": LabellingModels()}
    session = RecordingSession(Settings(output=tmp_path), {"mic": MICROPHONE}, models)
    rng = np.random.default_rng(1)
    floors = []
    for first, loudness in ((7, 0.001), (900, 0.1)):
        samples = rng.normal(0, loudness, (800, FRAME_SAMPLES)).astype(np.float32)
        if first > 7:
            lost = first - 807
            start = begin + 807 * frame
            session.add("mic", Gap(start, start + lost * frame, "overrun", lost))
        session.add("mic", Frames(first, samples, begin + np.arange(first, first + 800) * frame))
        powers = DEFAULT.band_powers(DEFAULT.extractor()(samples))
        tracked = FloorTracker()(powers, first).powers
        floors += [np.zeros((len(powers) - len(tracked), DEFAULT.bands)), tracked]
    session.finish()
    (log,) = find_logs(tmp_path)
    write_marks(log, [Mark("mic", begin + SECOND, begin + 80 * SECOND, "speech")])
    found = sound(tmp_path).floors  # as far as there is something to learn from
    assert len(found) > 1500
    np.testing.assert_array_equal(found, np.concatenate(floors)[: len(found)])


@pytest.mark.parametrize("answer", ["unknown", "television", "tv"])
def test_a_mark_of_what_nobody_can_tell_teaches_nothing_and_confirms_nothing(
    home, model_file, answer
):
    one, other = [each for each in segments(home) if each[2] != "silence"][:2]
    write(home, [(*one[:2], answer), other], [full(home)])
    assert [each.label for each in training_recordings(home)] == [other[2]]
    found = confirmed_segments(sound(home), load_model(model_file).classes)
    assert all(b <= one[0] or a >= one[1] for a, b in (each.span for each in found.recordings))
    spans = read_home_training_set([home], load_model(model_file)).segments.spans
    assert len(spans) > 1
    assert all(b <= one[0] or a >= one[1] for a, b in spans.tolist())


def test_a_long_mark_is_not_more_than_a_few_short_ones(home, model_file):
    begin = min(one[0] for one in segments(home))
    write(home, [(begin + 10 * SECOND, begin + 70 * SECOND, "speech")], [full(home)])
    segments_ = read_home_training_set([home], load_model(model_file)).segments
    marked = segments_.collection == segments_.collection_names.index(HOME)
    assert 0 < marked.sum() <= MOST_OF_MARK


def test_a_pause_that_is_marked_as_silence_does_not_teach_the_sounds_around_it(home):
    begin, end, _ = segments(home)[0]
    write(home, [(begin, begin + SECOND // 2, "silence")])
    assert list(training_recordings(home)) == []
    write(home, [(begin, end, "silence")])
    (one,) = training_recordings(home)
    assert one.label == "silence"


def test_pauses_that_are_marked_as_silence_and_teach_nothing_are_counted(home, model_file):
    begin = segments(home)[0][0]
    loud = next(one for one in segments(home) if one[2] != "silence" and one[0] > begin)
    write(home, [(begin, begin + SECOND // 2, "silence"), loud])
    _, notes, _ = read_home_training_set([home], load_model(model_file))
    pauses = "1 of 2 marks are of silence for less than a second: not learned from"
    assert any(note.startswith(pauses) for note in notes)


def test_a_mark_of_time_that_was_not_recorded_is_left_out_and_counted(home):
    loud = next(one for one in segments(home) if one[2] != "silence")
    end = max(one[1] for one in segments(home))
    write(home, [loud, (end + 10 * SECOND, end + 12 * SECOND, "speech")])
    with pytest.warns(HearthlogWarning, match="^1 marks lie where nothing was recorded"):
        (found,) = training_recordings(home)
    assert found.label == loud[2]


def test_a_home_that_is_never_silent_is_refused_and_a_mark_of_silence_helps(
    home, model_file, monkeypatch
):
    model = load_model(model_file)
    quiet = next(one for one in segments(home) if one[2] == "silence")
    loud = next(one for one in segments(home) if one[2] != "silence")
    nowhere = "hearthlog.analyzer.training.home_training_set.unreviewed_silence"
    monkeypatch.setattr(nowhere, lambda *_: [])
    write(home, [loud])
    with pytest.raises(DataError, match="mark some seconds in which nothing sounds as silence"):
        read_home_training_set([home], model)
    (log,) = logs_in(home)
    write_marks(log, [Mark("mic", *quiet)])
    assert len(read_home_training_set([home], model).segments)


def test_a_model_says_from_which_time_of_the_home_it_has_learned(home, model_file):
    model = load_model(model_file)
    write(home, [next(one for one in segments(home) if one[2] != "silence")], [full(home)])
    lessons = read_home_training_set([home], model)
    training = adapt_model(model, lessons.segments).description.training_data
    spans = np.array(training.home_spans)
    for begin, end in lessons.segments.spans:
        assert ((spans[:, 0] <= begin) & (end <= spans[:, 1])).any()
    confirmed = lessons.segments.collection_names.index(CONFIRMED)
    count = int((lessons.segments.collection == confirmed).sum())
    assert sum(training.home_confirmed.values()) == count > 0


def kettle(logs, seconds, label="kettle"):
    """Mark so many seconds of the longest sound of each log as a kettle."""
    for log, length in zip(logs_in(logs), seconds, strict=True):
        (found,) = read_columns([log], ["/mic/segment"]).values()
        sounds = np.flatnonzero(found["label"] != "silence")
        longest = sounds[found["duration"][sounds].argmax()]
        begin = int(found["header.stamp"][longest])
        if length:
            write_marks(log, [Mark("mic", begin, begin + length * SECOND, label)])


def with_unknown(model_file, *labels):
    """Return a model in which laughing is called unknown, and so are some labels."""
    model = load_model(model_file)
    about = json.loads(model.description.model_dump_json().replace('"laughing"', '"unknown"'))
    about["scenario"]["unknown"] = list(labels)
    return replace(model, description=Description.model_validate(about))


@pytest.mark.parametrize(
    ("label", "name", "scenario"),
    [
        ("kettle", "kettle", (["kettle", "siren"], ["siren"])),
        ("water_tap", "tap_water", (["tap_water", "siren"], ["siren"])),
        ("kettle", "kettle", (["kettle"], ["other_negative"])),
    ],
)
def test_a_mark_makes_its_class_though_the_model_counts_that_sound_as_unknown(
    two_days, model_file, label, name, scenario
):
    before, after = scenario
    base = with_unknown(model_file, *before)
    kettle(two_days, (5, 5), label)
    lessons = read_home_training_set([two_days], base)
    assert lessons.notes[:-1] == []
    assert lessons.segments.classes == (*base.classes, name)
    number = base.classes.index("unknown")
    of_home = lessons.segments.collection == lessons.segments.collection_names.index(HOME)
    assert set(lessons.segments.target[of_home]) == {len(base.classes)}
    adapted = adapt_model(base, lessons.segments)
    assert adapted.description.scenario["unknown"] == after
    assert adapted.description.scenario[name] == [name]
    assert scenario_of(adapted).find(label) == name
    again = read_home_training_set([two_days], adapted).segments
    assert again.classes == adapted.classes
    assert number not in again.target[again.collection == again.collection_names.index(HOME)]
    for log in logs_in(two_days):
        review_path(log).unlink(missing_ok=True)
    write_marks(logs_in(two_days)[0], [Mark("mic", *segments(two_days)[5])])
    without = adapt_model(adapted, read_home_training_set([two_days], adapted).segments)
    assert without.classes == base.classes
    assert set(without.description.scenario["unknown"]) == {*before, *after}


def test_too_few_marks_of_what_counts_as_unknown_teach_that_and_it_is_said(two_days, model_file):
    base = with_unknown(model_file, "kettle", "other_negative")
    kettle(two_days, (5, 0))
    lessons = read_home_training_set([two_days], base)
    assert lessons.notes[0] == (
        "1 mark of kettle: 5 more seconds, from another day, make it a class; until then they "
        "count as unknown"
    )
    of_home = lessons.segments.collection == lessons.segments.collection_names.index(HOME)
    assert set(lessons.segments.target[of_home]) == {base.classes.index("unknown")}
    kettle(two_days, (5, 5), "other_negative")
    lessons = read_home_training_set([two_days], base)
    assert lessons.segments.classes == base.classes
    assert "2 marks of other_negative: learned as unknown, to which the model counts them" in (
        lessons.notes
    )


def test_a_class_of_two_days_and_ten_seconds_is_learned_and_stays_as_long_as_its_marks(
    two_days, model_file, tmp_path
):
    base = load_model(model_file)
    kettle(two_days, (5, 5))
    lessons = read_home_training_set([two_days], base)
    assert lessons.segments.classes == (*base.classes, "kettle")
    save_model(adapt_model(base, lessons.segments), tmp_path / "home.safetensors")
    adapted = load_model(tmp_path / "home.safetensors")
    assert adapted.classes[-1] == "kettle"
    again = adapt_model(adapted, read_home_training_set([two_days], adapted).segments)
    assert again.classes == adapted.classes
    logs = logs_in(two_days)
    for log in logs:
        review_path(log).unlink()
    write_marks(logs[0], [Mark("mic", *segments(two_days)[5])])
    without = adapt_model(adapted, read_home_training_set([two_days], adapted).segments)
    assert without.classes == base.classes
    save_model(without, tmp_path / "without.safetensors")


@pytest.mark.parametrize(
    ("seconds", "printed"),
    [
        ((5, 0), "1 mark of kettle: 5 more seconds, from another day, make it a class"),
        ((3, 3), "2 marks of kettle: 4 more seconds make it a class"),
        ((6, 3), "2 marks of kettle: 1 more second makes it a class"),
        ((12, 0), "1 mark of kettle: any, from another day, makes it a class"),
    ],
)
def test_what_lacks_of_a_new_class_is_said_before_learning(
    two_days, model_file, capfd, seconds, printed
):
    kettle(two_days, seconds)
    output = two_days / "x.safetensors"
    done = run(capfd, "train", "--base", model_file, "--home", two_days, "-o", output, "--json")
    lines = done.stderr.splitlines()
    assert lines[0] == f"hearthlog: {printed}"
    assert "none of the marks can be learned from" in done.stderr
    assert "nothing is marked" not in done.stderr
    if done.returncode == 0:
        assert json.loads(done.stdout)["classes"] == list(load_model(model_file).classes)
