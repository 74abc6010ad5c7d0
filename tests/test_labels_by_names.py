"""What a network has names for is labelled by these names alone, as the scenario `audioset`."""

import itertools
from contextlib import closing
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run
from logreader import LogReader
from test_scenarios_at_once import keep, renamed, replace_file

from hearthlog.analyzer.bridge.alerts.rule_checks import unknown_class
from hearthlog.analyzer.bridge.alerts.rules import MoreThan
from hearthlog.analyzer.training.adaptation import base_classes
from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import Auxiliary
from hearthlog.models.classifiers.network_names import AUDIOSET, without_classes
from hearthlog.models.embedding import WINDOW_FRAMES, Embeddings, read_projection
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.sound_names import audioset_names, named_sounds
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.labels.labeller import NamesLabeller
from hearthlog.models.modelfile import load_model
from hearthlog.models.registry import load, promote
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch, ReloadRequests
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import ModelError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.topics import EmbeddingSource

START = 1_772_348_400 * 1_000_000_000
PROJECTION = read_projection(YAMNET.projection)
SOURCE = EmbeddingSource(
    YAMNET.name, "a" * 64, PROJECTION.sha256, PROJECTION.names, tuple(PROJECTION.steps.tolist())
)
NAMES = {name.name: name for name in audioset_names()}
EVENTS = [name for name in audioset_names() if name.is_event]
TOPICS = [f"/mic/scenario/audioset/{kind}" for kind in ("label", "segment")]
TONES = {500: "dog", 1000: "rain", 2000: "speech"}  # Hz, by which the network of the tests goes


class Tones:
    """A network for which a tone is a sound, and noise is none."""

    source = SOURCE

    def __call__(self, window):
        samples = window.reshape(-1)
        spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples))))
        tone = int(spectrum.argmax()) * 16_000 // len(samples)
        named = next((name for hertz, name in TONES.items() if abs(tone - hertz) < 50), None)
        return output(*([] if named is None or np.abs(samples).max() < 0.05 else [named]))


def output(*names):
    """Return what is logged where some names are said, and no others."""
    values = np.full(len(PROJECTION.names), -127, np.int8)
    for name in names:
        values[PROJECTION.names.index(NAMES[name].group)] = 127
    return values


def logits_of(name, logits):
    """Return embeddings of successive windows; None where there was none."""
    column = PROJECTION.names.index(NAMES[name].group)
    numbers = [number for number, logit in enumerate(logits) if logit is not None]
    values = np.tile(output(), (len(numbers), 1))
    steps = [logits[number] / float(PROJECTION.steps[column]) for number in numbers]
    values[:, column] = np.clip(np.rint(steps), -127, 127)
    frames = 10 * np.array(numbers, np.int64)
    return Embeddings(frames, START + frames * FRAME_NANOSECONDS, values)


def windows_of(*names):
    """Return embeddings of successive windows, in each of which some names are said."""
    frames = 10 * np.arange(len(names), dtype=np.int64)
    values = np.stack([output(*each) for each in names])
    return Embeddings(frames, START + frames * FRAME_NANOSECONDS, values)


def classifier_of(*names):
    """Return a classifier of some names alone."""
    model = load_model(Path(AUDIOSET))
    return Classifier(without_classes(model, set(model.classes) - {SILENCE, *names}, DEFAULT))


def labelled(labeller, embeddings, count, sizes=(1000,)):
    """Push frames in pieces; return the class of each, and the segments."""
    classes, segments, begin, pieces = [], [], 0, itertools.cycle(sizes)
    while begin < count:
        stamps = START + np.arange(begin, min(begin + next(pieces), count)) * FRAME_NANOSECONDS
        labels, ended = pushed(labeller, embeddings, begin, stamps)
        classes += classes_of(labels)
        segments += ended
        begin += len(stamps)
    return classes, segments + labeller.close(int(stamps[-1]) + FRAME_NANOSECONDS)


def pushed(labeller, embeddings, first, stamps):
    known = Auxiliary(embeddings=embeddings.available_at(first, len(stamps)))
    return labeller.push(np.zeros((len(stamps), 1), np.float32), None, first, stamps, known)


def classes_of(labels):
    return [labels.classes[best] for best in labels.probabilities.argmax(axis=1)]


def spans_of(segments, labeller):
    """Return the first frame of each sound, the one behind its last, and its class."""
    return [
        (
            (segment.start - START) // FRAME_NANOSECONDS,
            (segment.end - START) // FRAME_NANOSECONDS,
            labeller.classes[segment.label],
        )
        for segment in segments
        if labeller.classes[segment.label] != SILENCE
    ]


def test_the_model_has_the_names_that_are_events_and_no_hint(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(AUDIOSET).mkdir()  # recordings that somebody has
    model = load_model(Path(AUDIOSET))
    assert model.classes == (SILENCE, *(name.name for name in EVENTS))
    assert load(tmp_path, AUDIOSET).sha256 == model.sha256
    with pytest.raises(ModelError, match="has learned nothing"):
        promote(tmp_path, AUDIOSET)


LOGITS = st.lists(st.one_of(st.none(), st.floats(-12, 12)), min_size=1, max_size=40)


@given(st.sampled_from([name for name in EVENTS if name.windows == 1]), LOGITS)
def test_sounds_are_those_that_the_thresholds_were_measured_with(name, logits):
    embeddings = logits_of(name.name, logits)
    labeller = NamesLabeller(classifier_of(name.name), SOURCE)
    count = 10 * len(logits) + 2 * WINDOW_FRAMES
    _, segments = labelled(labeller, embeddings, count)
    wanted = [(each.first, each.end) for each in named_sounds(embeddings, PROJECTION, [name])]
    assert [span[:2] for span in spans_of(segments, labeller)] == wanted


@given(st.sampled_from(EVENTS), LOGITS)
def test_a_sound_that_takes_long_to_be_certain_is_labelled_later_and_never_lost(name, logits):
    embeddings = logits_of(name.name, logits)
    labeller = NamesLabeller(classifier_of(name.name), SOURCE)
    _, segments = labelled(labeller, embeddings, 10 * len(logits) + 2 * WINDOW_FRAMES)
    wanted = named_sounds(embeddings, PROJECTION, [name])
    found = spans_of(segments, labeller)
    assert [end for _, end, _ in found] == [sound.end for sound in wanted]
    assert all(sound.first <= span[0] < span[1] for sound, span in zip(wanted, found, strict=True))


@given(LOGITS, st.lists(st.integers(1, 70), min_size=1, max_size=4))
def test_labels_are_the_same_in_pieces_of_any_size(logits, sizes):
    embeddings, count = logits_of("rain", logits), 10 * len(logits) + 60
    full = labelled(NamesLabeller(classifier_of("rain", "dog"), SOURCE), embeddings, count)
    parts = labelled(NamesLabeller(classifier_of("rain", "dog"), SOURCE), embeddings, count, sizes)
    assert parts == full


@given(st.lists(st.sampled_from([None, -3.0, -2.0, 3.0]), min_size=60, max_size=90))
def test_what_was_heard_before_leaves_no_trace_once_that_is_certain(logits):
    embeddings, count = logits_of("rain", logits), 10 * len(logits)
    classifier = classifier_of("rain")
    full, _ = labelled(NamesLabeller(classifier, SOURCE), embeddings, count)
    late = NamesLabeller(classifier, SOURCE)
    for begin in range(200, count, 10):
        stamps = START + (begin + np.arange(10)) * FRAME_NANOSECONDS
        labels, _ = pushed(late, embeddings, begin, stamps)
        if late.states_converged:
            assert classes_of(labels) == [full[frame] for frame in labels.frames.tolist()]


def test_of_two_names_at_once_that_of_the_shorter_sound_counts():
    both = [("rain",)] * 6 + [("rain", "dog")] + [("rain",)] * 6
    labeller = NamesLabeller(classifier_of("rain", "dog"), SOURCE)
    _, segments = labelled(labeller, windows_of(*both), 200)
    assert spans_of(segments, labeller) == [(5, 65, "rain"), (65, 75, "dog"), (75, 135, "rain")]


def test_embeddings_of_another_projection_say_nothing():
    other = SOURCE._replace(projection_sha256="b" * 64)
    classifier = classifier_of("dog")
    labeller = NamesLabeller(classifier, other)
    assert spans_of(labelled(labeller, windows_of(*[("dog",)] * 9), 100)[1], labeller) == []
    assert "another projection: it labels nothing" in classifier.lacking_embeddings(other)


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """Half a minute of noise with a dog, talking and rain, as the network of the tests hears it."""
    rng = np.random.default_rng(4)
    samples = rng.normal(0, 1e-3, 40 * 16_000)
    for start, end, hertz in ((10, 12, 500), (15, 19, 2000), (24, 34, 1000)):
        times = np.arange(start * 16_000, end * 16_000) / 16_000
        samples[start * 16_000 : end * 16_000] += 0.3 * np.sin(2 * np.pi * hertz * times)
    path = tmp_path_factory.mktemp("sound") / "tones.wav"
    soundfile.write(path, samples, 16_000)
    return path


def record(sound, logs, monkeypatch, **changes) -> Path:
    monkeypatch.setattr("hearthlog.recorder.recording.open_embedder", lambda *_: (Tones(), ""))
    settings = Settings(
        **{"output": logs, "model": GENERAL, "scenarios": {"audioset": AUDIOSET}, **changes}
    )
    (log,) = record_files(settings, FileSource([sound], START), Flag()).logs
    return log


def written(log: Path) -> list[tuple[str, int, bytes]]:
    return [(m.topic, m.log_time, m.data) for m in LogReader(log).messages(TOPICS)]


def recorded(log: Path, topic: str = TOPICS[1]) -> list[tuple[str, int, int]]:
    segments = [m.decode() for m in LogReader(log).messages([topic])]
    return [
        (one.label, (one.header.stamp.sec - START // 10**9), one.duration.sec)
        for one in segments
        if one.label != SILENCE
    ]


def test_a_recorder_labels_the_names_that_its_model_was_not_taught(
    sound, tmp_path, monkeypatch, capfd
):
    log = record(sound, tmp_path / "logs", monkeypatch)
    assert [label for label, _, _ in recorded(log)] == ["dog", "rain"]  # not speech: general has it
    assert run(capfd, "doctor", log).stdout == "1 file: 0 errors, 0 warnings\n"
    again = run(capfd, "replay", log, "-o", tmp_path / "again", "--scenario", "audioset=audioset")
    assert again.returncode == 0, again.stderr
    (other,) = find_logs(tmp_path / "again")
    assert written(other) == written(log)
    assert run(capfd, "doctor", other).returncode == 0


def test_a_relabelling_of_a_log_with_embeddings_gives_all_names(
    sound, tmp_path, monkeypatch, capfd
):
    log = record(sound, tmp_path / "logs", monkeypatch, scenarios={})
    assert written(log) == []
    assert run(capfd, "relabel", log, "--model", "audioset").returncode == 0
    (layer,) = (tmp_path / "logs").rglob("*.relabel-audioset.mcap")
    named = recorded(layer, "/mic/relabel/audioset/segment")
    assert [label for label, _, _ in named] == ["dog", "speech", "rain"]
    alone = record(sound, tmp_path / "alone", monkeypatch, model="none")
    assert recorded(alone) == named


def test_hours_that_are_relabelled_apart_have_the_names_of_one_long_recording(
    sound, tmp_path, monkeypatch, capfd
):
    log = record(sound, tmp_path / "logs", monkeypatch, model="none", max_bag_duration=86_400)
    parts = Settings(
        output=tmp_path / "parts", model="none", max_bag_duration=7, feature_set="home33"
    )
    record_files(parts, FileSource([sound], START), Flag())
    done = run(capfd, "relabel", tmp_path / "parts", "--model", "audioset", "--workers", "1")
    assert done.returncode == 0, done.stderr
    layers = sorted((tmp_path / "parts").rglob("*.relabel-audioset.mcap"))
    assert len(layers) > 4
    topics = [f"/mic/relabel/audioset/{kind}" for kind in ("label", "segment")]
    messages = [m for layer in layers for m in LogReader(layer).messages(topics)]
    for own, topic in zip(topics, TOPICS, strict=True):
        relabelled = [m.data for m in messages if m.topic == own]
        assert relabelled == [m.data for m in LogReader(log).messages([topic])]


def test_a_queue_of_hints_asks_for_what_the_network_names_and_no_event_is(
    sound, tmp_path, monkeypatch, capfd
):
    monkeypatch.setitem(TONES, 500, "door")
    monkeypatch.setitem(TONES, 1000, "sneeze")
    logs = tmp_path / "logs"
    record(sound, logs, monkeypatch)
    done = run(capfd, "review", logs, "--queue", "hint", "--save", tmp_path / "hints.txt")
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "hints.txt").read_text().splitlines()
    assert [line.split("\t")[2] for line in lines] == ["door", "sneeze"]
    imported = run(capfd, "annotate", "import", logs, tmp_path / "hints.txt")
    assert imported.returncode == 0, imported.stderr
    for number in (1, 2):  # the tone of ten seconds is two spans, of which one was asked for
        again = run(capfd, "review", logs, "--queue", "hint", "--save", tmp_path / f"{number}.txt")
        run(capfd, "annotate", "import", logs, tmp_path / f"{number}.txt")
    assert "no span is left in which the network gives a hint" in again.stderr


def test_a_queue_of_hints_needs_embeddings(sound, tmp_path, capfd):
    settings = Settings(output=tmp_path / "logs", model=GENERAL)
    record_files(settings, FileSource([sound], START), Flag())
    done = run(capfd, "review", tmp_path / "logs", "--queue", "hint", "--save", tmp_path / "a.txt")
    assert done.returncode == 1
    assert "hearthlog models fetch yamnet" in done.stderr


def test_where_somebody_may_be_talking_no_name_is_labelled_but_what_is_logged_says(
    sound, tmp_path, monkeypatch, capfd
):
    log = record(sound, tmp_path / "logs", monkeypatch, privacy=["speech"])
    free = record(sound, tmp_path / "free", monkeypatch)
    done = run(capfd, "replay", log, "-o", tmp_path / "again", "--scenario", "audioset=audioset")
    assert done.returncode in {0, 3}
    (again,) = find_logs(tmp_path / "again")
    assert written(again) == written(log)
    embeddings = [len(list(LogReader(one).messages(["/mic/embedding"]))) for one in (log, free)]
    assert embeddings[0] < embeddings[1]  # the starter takes some of these tones for talking
    assert run(capfd, "doctor", log).returncode == 0


def test_a_model_that_is_taught_a_class_takes_it_from_the_names(tmp_path, monkeypatch):
    monkeypatch.setattr("hearthlog.recorder.labelling.model_watch.LOOK_SECONDS", 0.02)
    path = keep(tmp_path / "models/home.safetensors", {}, GENERAL)
    requests = ReloadRequests()
    with (
        closing(ModelWatch(path, requests.queue(), "home")) as home,
        closing(ModelWatch(Path(AUDIOSET), requests.queue(), AUDIOSET)) as names,
    ):
        models = LabellingModels(scenarios={"home": home, AUDIOSET: names})
        before = models.in_use["scenario/audioset"].model.classes
        replace_file(renamed(load_model(starter_file(GENERAL)), {"yelling": "dog"}), path)
        for _ in range(500):
            assert not models.refusals()
            if models.may_change():
                break
            Flag().wait(0.02)
        changes = models.change()
    assert [change.labelling for change in changes] == ["scenario/home", "scenario/audioset"]
    assert set(before) - set(models.in_use["scenario/audioset"].model.classes) == {"dog"}


def test_a_scenario_of_names_without_a_network_says_so_and_is_silent(sound, tmp_path, capfd):
    settings = Settings(output=tmp_path, model=GENERAL, scenarios={"audioset": AUDIOSET})
    (log,) = record_files(settings, FileSource([sound], START), Flag()).logs
    assert recorded(log) == []
    assert "it labels nothing (hearthlog models fetch yamnet)" in capfd.readouterr().err


def test_names_alone_can_label_a_home_and_the_log_is_sound(sound, tmp_path, monkeypatch, capfd):
    log = record(sound, tmp_path, monkeypatch, model=AUDIOSET, scenarios={})
    assert [label for label, _, _ in recorded(log, "/mic/segment")] == ["dog", "speech", "rain"]
    assert run(capfd, "doctor", log).returncode == 0


def test_what_was_not_taught_is_neither_evaluated_nor_adapted(capfd):
    clips = Path(__file__).parents[1] / "tools/home/clips/manifest.csv"
    refused = run(capfd, "evaluate", "model", AUDIOSET, "--data", clips)
    assert refused.returncode == 1
    assert "audioset labels by the names of a network and has learned nothing" in refused.stderr
    with pytest.raises(ModelError, match="nor can it be adapted"):
        base_classes(load_model(Path(AUDIOSET)))


def test_an_alert_of_a_name_says_where_it_is_to_be_had():
    rule = MoreThan(rule="more_than", name="x", **{"class": "scream"}, count=0, window="1m")
    text = unknown_class(rule, {"mic": {"speech"}})
    assert text.endswith('scenarios = {audioset = "audioset"} brings it, with a network of sounds')
    assert unknown_class(rule, {"mic": {"speech"}, "mic-audioset": {"scream"}}) == ""
    hint = next(name.name for name in audioset_names() if not name.is_event)
    rule = rule.model_copy(update={"label": hint})
    assert unknown_class(rule, {"mic": {"speech"}}).endswith("hints and not counted")
