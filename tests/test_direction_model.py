"""A home's model takes directions: learned from marks, and the same bits wherever it labels."""

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event as Flag

import hypothesis
import numpy as np
import pytest
import soundfile
from arrays import SQUARE, array_frames
from hypothesis import given
from hypothesis import strategies as st
from logs import read
from lossy_source import LossySource
from rewriting import Log
from safetensors.numpy import load, save

from hearthlog.analyzer.logs.recorder_info import read_recorder_infos
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.relabel.player import ReplayOptions
from hearthlog.analyzer.relabel.recorded import Features, read_recorded
from hearthlog.analyzer.relabel.relabel import relabel
from hearthlog.analyzer.relabel.replay import LogSet, replay
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.direction_samples import (
    DirectionSample,
    evidence_of,
    with_directions,
)
from hearthlog.analyzer.training.home_recordings import read_reviewed_sound
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.analyzer.training.pseudo_labels import chosen, confirmed_segments
from hearthlog.analyzer.workers import open_workers
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import (
    BLOCK_FRAMES,
    MEMORY_BLOCKS,
    SECTORS,
    DirectionEvidence,
    Directions,
    sectors_of,
)
from hearthlog.models.classifiers.model import FORMAT_OF_DIRECTIONS
from hearthlog.models.features.floor import Floors, FloorTracker
from hearthlog.models.labels.labeller import Labeller
from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.events import Gap
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer

START = 1_772_348_370_123_456_789  # half a minute before the hour
CORNER, DOOR = 0.5, -2.0  # radians
LOST = {3: 7, 9: 30}  # frames, before blocks of ten seconds
ALWAYS = (1 << 63) - 1


def taking(weights, microphone="mic"):
    """The starter model, with the weights of directions."""
    model = load_model(starter_file(GENERAL))
    update = {"format": FORMAT_OF_DIRECTIONS, "direction_microphones": [microphone]}
    description = model.description.model_copy(update=update)
    return replace(model, description=description, direction_weights=weights[np.newaxis])


def strong():
    """Weights by which the corner is music, and the door speech."""
    classes = load_model(starter_file(GENERAL)).classes
    weights = np.zeros((len(classes), SECTORS))
    near = np.cos(np.arange(SECTORS) * 2 * np.pi / SECTORS - CORNER)
    weights[classes.index("music")], weights[classes.index("speech")] = 5 * near, -5 * near
    return weights


@pytest.fixture(scope="module")
def model_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "corner.safetensors"
    save_model(taking(strong()), path)
    return path


@cache
def scene():
    parts = [(CORNER, 35, 1), (DOOR, 25, 4), (CORNER, 20, 5), (DOOR, 30, 6)]
    return np.concatenate(
        [array_frames(SQUARE, azimuth, length, seed) for azimuth, length, seed in parts]
    )


@pytest.fixture(scope="module")
def recorded(model_path, tmp_path_factory):
    """Logs of a minute of an array, with gaps, labelled live by a model that takes directions."""
    folder = tmp_path_factory.mktemp("recorded")
    path = folder / "scene.wav"
    soundfile.write(path, scene().reshape(-1, 4), SAMPLE_RATE, subtype="PCM_16")
    microphone = MicrophoneSettings(array=SQUARE)
    settings = Settings(
        output=folder / "logs", microphone=[microphone], model=model_path, max_bag_duration=60
    )
    record(settings, LossySource(FileSource([path], START, channels=4), LOST), Flag())
    return folder / "logs"


def rows(columns):
    return [columns.log_times.tolist(), *(columns[p].tolist() for p in sorted(columns.fields))]


def events(folder):
    """What a pipeline was given."""
    return [
        event
        for log in find_logs(folder)
        if not is_layer(log)
        for info in read_recorder_infos(log, "features")
        for batch in read_recorded(info, 0, ALWAYS, sound_only=True)
        for event in batch.events
    ]


def labels_of(model, sound, microphone="mic"):
    """Labels of a model that hears features and gaps, as bytes."""
    classifier = Classifier(model)
    pipeline = Pipeline(microphone, classifier.feature_set, classifier)
    messages = []
    for event in sound:
        if isinstance(event, Gap):
            messages += pipeline.push(event)
        else:
            part = event.values, event.first, event.stamps, event.auxiliary
            messages += pipeline.push_features(*part)
    return [one.data for one in messages if one.topic == f"/{microphone}/label"]


def test_a_replay_has_the_directions_and_labels_of_the_recording_bit_for_bit(
    recorded, model_path, tmp_path
):
    model = load_model(model_path)
    options = ReplayOptions(model=lambda _: model, output=tmp_path / "again")
    result = replay(LogSet(find_logs(recorded), "features"), options, Flag())
    assert result.compared.identical
    live, again = (read_columns(find_logs(folder)) for folder in (recorded, tmp_path / "again"))
    assert len(live["/mic/direction"]) > 100
    for kind in ("direction", "label", "segment", "features", "gap"):
        assert rows(again[f"/mic/{kind}"]) == rows(live[f"/mic/{kind}"])


def test_a_part_of_a_replay_has_the_labels_of_the_recording(recorded, model_path, tmp_path):
    model = load_model(model_path)
    options = ReplayOptions(
        model=lambda _: model, output=tmp_path / "part", start_offset=71.3, duration=20.0
    )
    result = replay(LogSet(find_logs(recorded), "features"), options, Flag())
    assert result.compared.identical
    live, part = (read(folder, "direction") for folder in (recorded, tmp_path / "part"))
    assert part == [one for one in live if one.frame in {other.frame for other in part}]
    assert len(part) > 15


@pytest.mark.parametrize("workers", [1, 2])
def test_a_relabelling_has_the_labels_of_the_recording(recorded, model_path, tmp_path, workers):
    logs = Path(shutil.copytree(recorded, tmp_path / "logs"))
    named = [logs] if workers > 1 else find_logs(logs)[::-1]
    with open_workers(workers) as pool:
        for paths in named:
            assert not relabel([paths], load_model(model_path), model_path, pool).failed
    columns = read_columns(find_logs(logs))
    for kind in ("label", "segment"):
        assert rows(columns[f"/mic/relabel/corner/{kind}"]) == rows(columns[f"/mic/{kind}"])


def test_directions_change_labels_of_their_microphone_and_weights_of_zero_change_no_bit(recorded):
    sound = [next(event for event in events(recorded) if isinstance(event, Features))]
    plain = labels_of(load_model(starter_file(GENERAL)), sound)
    assert labels_of(taking(np.zeros_like(strong())), sound) == plain
    assert labels_of(taking(strong(), "kitchen"), sound) == plain
    changed = labels_of(taking(strong()), sound)
    assert sum(a != b for a, b in zip(changed, plain, strict=True)) > 100


def test_after_a_gap_nothing_is_left_of_the_directions_before_it(recorded):
    model, (first, *_) = taking(strong()), [e for e in events(recorded) if isinstance(e, Features)]
    half = first.part(slice(0, 109))  # a burst ends with frame 107
    elsewhere = np.full(len(half.auxiliary.directions.azimuths), DOOR, np.float32)
    directions = replace(half.auxiliary.directions, azimuths=elsewhere)
    half = half._replace(auxiliary=half.auxiliary._replace(directions=directions))
    gap = Gap(int(first.stamps[109]), int(first.stamps[110]), "lost", 1)
    behind = first.part(slice(110, len(first.stamps)))
    together = labels_of(model, [half, gap, behind])
    assert together == labels_of(model, [half]) + labels_of(model, [behind])


def test_a_model_that_takes_over_knows_the_directions_of_the_second_before(recorded):
    first = next(event for event in events(recorded) if isinstance(event, Features))
    model, complete = taking(strong()), labels_of(taking(strong()), [first])
    general = load_model(starter_file(GENERAL))
    pipeline = Pipeline("mic", Classifier(general).feature_set, Classifier(general))
    messages = []
    for number, part in enumerate((first.part(slice(0, 118)), first.part(slice(118, None)))):
        if number:
            pipeline.change_model(model, Classifier(model), 118, int(part.stamps[0]))
        messages += pipeline.push_features(part.values, part.first, part.stamps, part.auxiliary)
    labels = [one.data for one in messages if one.topic == "/mic/label"]
    assert labels[-100:] == complete[-100:]
    assert labels[105:] == complete[105:]


def test_states_begin_to_converge_once_a_second_of_directions_is_known(recorded, monkeypatch):
    classifier = Classifier(taking(strong()))
    sound = next(one for one in events(recorded) if isinstance(one, Features))
    floors = FloorTracker()(classifier.feature_set.band_powers(sound.values), sound.first)
    labeller, forgotten = Labeller(classifier, "mic"), []
    monkeypatch.setattr(labeller.segmenter, "forget", lambda: forgotten.append(frame.first))
    for place in range(60):
        frame = sound.part(slice(place, place + 1))
        of_frame = Floors(*(each[place : place + 1] for each in floors[:3]), converged=True)
        labeller.push(frame.values, of_frame, frame.first, frame.stamps, frame.auxiliary)
    assert forgotten == [sound.first + BLOCK_FRAMES * (MEMORY_BLOCKS + 1)]


def of_blocks(blocks, seed):
    rng = np.random.default_rng(seed)
    azimuths = (np.rint(rng.uniform(-3.14, 3.14, len(blocks)) * 512) / 512).astype(np.float32)
    confidences = (np.rint(rng.uniform(0.1, 0.6, len(blocks)) * 512) / 512).astype(np.float32)
    frames = np.array(blocks, np.int64) * BLOCK_FRAMES
    return Directions(frames, START + frames * FRAME_NANOSECONDS, azimuths, confidences)


@given(st.sets(st.integers(0, 24)), st.lists(st.integers(1, 30), max_size=8), st.integers(0, 9))
@hypothesis.settings(max_examples=40, deadline=None)
def test_frames_in_pieces_of_any_size_give_the_same_evidence(blocks, sizes, seed):
    directions, weights = of_blocks(sorted(blocks), seed), strong()
    complete = DirectionEvidence(weights).push(directions, 0, 100, 93)
    one, parts, at = DirectionEvidence(weights), [], 0
    for size in [*sizes, 100]:
        count = min(size, 100 - at)
        windows = min(max(at + count - 7, 0), count)
        parts.append(one.push(directions.available_at(at, count), at, count, windows))
        at += count
    np.testing.assert_array_equal(np.concatenate(parts), complete)


def test_evidence_is_the_mean_of_the_last_second_and_none_without_a_direction():
    directions, weights = of_blocks([10], 1), strong()
    evidence = DirectionEvidence(weights).push(directions, 0, 100, 100)
    known = 10 * BLOCK_FRAMES + BLOCK_FRAMES - 1
    output = np.flatnonzero(evidence.any(axis=1))
    assert output.tolist() == list(range(known, known + MEMORY_BLOCKS * BLOCK_FRAMES))
    np.testing.assert_allclose(evidence[known], weights[:, sectors_of(directions.azimuths)[0]])


@given(st.sets(st.integers(0, 24)), st.integers(1, 60), st.integers(0, 9))
@hypothesis.settings(max_examples=40, deadline=None)
def test_evidence_is_full_once_nothing_depends_on_what_was_before(blocks, first, seed):
    directions, weights = of_blocks(sorted(blocks), seed), strong()
    complete, late = DirectionEvidence(weights), DirectionEvidence(weights)
    expected = complete.push(directions, 0, 100, 100)
    found = late.push(directions.available_at(first, 100 - first), first, 100 - first, 100 - first)
    full = next(frame for frame in range(first, 200) if late.is_full(frame))
    assert full <= first + 30
    np.testing.assert_array_equal(found[full - first :], expected[full:])


def seen(sector, hour):
    shares = np.zeros(SECTORS)
    shares[sector % SECTORS] = 1.0
    return DirectionSample(
        "mic", 24 * 3600 * NANOSECONDS + round(hour * 3600) * NANOSECONDS, shares
    )


def taught(*marks):
    general = load_model(starter_file(GENERAL))
    target = np.array([general.classes.index(name) for name, _ in marks])
    return with_directions(general, target, [one for _, one in marks])


def reported(*marks):
    """The weights that marks teach the starter model, by class."""
    model = taught(*marks)
    return dict(zip(model.classes, model.direction_weights[0], strict=True))


def test_a_class_that_comes_from_a_corner_again_and_again_is_likelier_there_and_less_elsewhere():
    corner = [("music", seen(3, hour)) for hour in range(12)]
    about = [("speech", seen(3 * hour + 1, hour)) for hour in range(12)]
    of = reported(*corner, *about, *(("silence", seen(30, hour)) for hour in range(12)))
    assert of["music"][3] > 0.5 > -2 > of["music"][20]
    assert of["speech"][3] < -2
    assert of["speech"][20] > 0.5
    assert not np.any([of["silence"], of["coughing"]])


def test_what_was_heard_in_one_hour_alone_is_not_taken_to_come_from_there_always():
    marks = [("speech", seen(3 * hour + 1, hour)) for hour in range(12)]
    marks += [("music", seen(3, minute / 60)) for minute in range(0, 24, 2)]
    assert not taught(*marks).description.direction_microphones


def test_many_marks_of_one_sound_are_one_sound():
    one, others = ("music", seen(3, 0)), [("speech", seen(9 * n, n)) for n in range(9)]
    others += [("music", seen(3 + n % 2, n)) for n in range(1, 9)]
    np.testing.assert_equal(reported(*[one] * 50, *others), reported(one, *others))


def test_marks_are_compared_by_whence_they_came_too():
    classifier = Classifier(taking(strong()))
    evidence = evidence_of(classifier, [seen(3, 0), None, seen(3, 0)._replace(microphone="door")])
    np.testing.assert_array_equal(evidence, [strong()[:, 3], *np.zeros((2, len(strong())))])
    assert evidence_of(classifier, []) is None


def test_what_was_left_alone_is_judged_by_whence_it_came_too(recorded, tmp_path):
    logs = Path(shutil.copytree(recorded, tmp_path / "logs"))
    for log in find_logs(logs):
        write_marks(log, [], reviewed=[ReviewedSpan("mic", START, START + 300 * NANOSECONDS)])
    model = taking(strong())
    sounds = read_reviewed_sound(logs, Classifier(model).feature_set)
    left_alone = [confirmed_segments(sound, model.classes) for sound in sounds]
    assert len(chosen(left_alone, model)) > len(chosen(left_alone, taking(0 * strong())))


def test_marks_in_logs_of_an_array_teach_directions_and_others_do_not(recorded, tmp_path):
    logs = Path(shutil.copytree(recorded, tmp_path / "logs"))
    before = taking(strong(), "hall")
    for log in find_logs(logs):
        (info,) = read_recorder_infos(log, "features")
        begin = info.first_frame[1]
        marks = [Mark("mic", begin, begin + NANOSECONDS, "silence")] if begin == START else []
        for one in read(log, "direction")[::5]:
            at = one.header.stamp.sec * NANOSECONDS + one.header.stamp.nanosec
            label = "music" if abs(one.azimuth - CORNER) < 0.3 else "speech"
            marks.append(Mark("mic", at, at + NANOSECONDS, label))
        write_marks(log, marks)
    adapted = adapt_model(before, read_home_training_set([logs], before).segments)
    assert adapted.description.direction_microphones == ["mic"]
    music = adapted.direction_weights[0][before.classes.index("music")]
    near = sectors_of(np.array([CORNER, DOOR], np.float32))
    assert music[near[0]] > 0.2 > -0.2 > music[near[1]]
    path = tmp_path / "home.safetensors"
    save_model(adapted, path)
    np.testing.assert_array_equal(load_model(path).direction_weights, adapted.direction_weights)
    assert "directions of mic" in model_card(load_model(path))


@pytest.mark.parametrize("value", [{"azimuth": np.nan}, {"confidence": np.inf}, {"frame": 1 << 63}])
def test_nothing_is_learned_from_directions_that_no_array_has(recorded, tmp_path, value):
    changed = Log(find_logs(recorded)[1])
    one = changed.messages("/mic/direction")[5]
    changed.change(one, **value)
    changed.write(path := tmp_path / "home_20260301T070000Z.mcap")
    write_marks(path, [Mark("mic", one.log_time, one.log_time + NANOSECONDS, "music")])
    with pytest.raises(LogError, match=f"{path.name}: /mic/direction: holds directions that no"):
        read_home_training_set([tmp_path], load_model(starter_file(GENERAL)))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda a, _: a.update(direction_weights=a["direction_weights"][:, :-1]), "has shape"),
        (lambda a, _: a["direction_weights"].fill(np.nan), "not finite"),
        (lambda a, _: a["direction_weights"].fill(1e6), "values beyond 5"),
        (
            lambda a, _: a.update(direction_weights=a["direction_weights"].astype(np.float32)),
            "of type float32",
        ),
        (lambda a, _: a.pop("direction_weights"), "direction_weights is missing"),
        (lambda _, d: d.update(direction_microphones=[], format=5), "is out of place"),
        (lambda _, d: d.update(direction_microphones=["mic", "mic"]), "name one twice"),
        (lambda _, d: d.update(direction_microphones=["a\nb"]), "direction_microphones"),
        (lambda _, d: d.update(format=5), "format: is 5; those with directions are 6"),
        (lambda _, d: d.update(format=8), "format 8, newer than this version"),
    ],
)
def test_a_hostile_model_is_refused_in_one_line(model_path, tmp_path, change, complaint):
    data = model_path.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    about, arrays = json.loads(header["__metadata__"]["hearthlog"]), load(data)
    change(arrays, about)
    path = tmp_path / "hostile.safetensors"
    path.write_bytes(save(arrays, {"hearthlog": json.dumps(about)}))
    with pytest.raises(ModelError, match=complaint) as caught:
        load_model(path)
    assert str(caught.value).isprintable()
