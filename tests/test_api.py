"""What is public: every example of it runs, and it gives what a recorder would have logged."""

import doctest
import inspect
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from arrays import SQUARE, array_frames

import hearthlog
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import convert_sound, read_audio
from hearthlog.schemas.errors import HearthlogError, HearthlogWarning
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs

pytestmark = pytest.mark.fast

START = 1_772_348_400_000_000_000
SECOND = 1_000_000_000
PUBLIC = [name for name in hearthlog.__all__ if not name.startswith("_")]
FUNCTIONS = [name for name in PUBLIC if inspect.isfunction(getattr(hearthlog, name))]


def make_logs(folder, model, sounds, **options):
    settings = Settings(output=folder, model=model, **options)
    record(settings, FileSource(sounds, START), Flag())
    return folder


def make_array_logs(folder, model):
    sound = array_frames(SQUARE, np.deg2rad(45)).reshape(-1, 4)
    soundfile.write(folder / "array.wav", sound, 16_000, subtype="PCM_16")
    microphone = MicrophoneSettings(array=SQUARE)
    settings = Settings(output=folder / "array", model=model, microphone=[microphone])
    record(settings, FileSource([folder / "array.wav"], START, channels=4), Flag())


@pytest.fixture(scope="module")
def folder(tmp_path_factory, day, model_file, training_set) -> Path:
    """Where the examples run: logs with a mark, their model and sound, and clips to learn from."""
    folder = tmp_path_factory.mktemp("api")
    (folder / "clips").symlink_to(training_set.parent)
    (folder / "sound.flac").symlink_to(day)
    (folder / "home.safetensors").symlink_to(model_file)
    (log,) = find_logs(make_logs(folder / "logs", model_file, [day]))
    make_array_logs(folder, model_file)
    write_marks(log, [Mark("mic", START + SECOND, START + 2 * SECOND, "coughing", "ada")])
    return folder


def examples_of(name):
    """The examples of a public function, or of a class and its public methods."""
    finder = doctest.DocTestFinder(recurse=inspect.isclass(getattr(hearthlog, name)))
    tests = finder.find(getattr(hearthlog, name), name, globs={"hearthlog": hearthlog})
    return [test for test in tests if test.examples]


@pytest.mark.parametrize("name", PUBLIC)
def test_the_examples_run_and_show_what_they_say(name, folder, tmp_path, monkeypatch):
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    for test in examples_of(name):
        report = []
        doctest.DocTestRunner(verbose=False).run(test, out=report.append)
        assert not report, "".join(report)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_what_it_takes_gives_and_raises_with_an_example(name):
    text = inspect.getdoc(getattr(hearthlog, name))
    sections = {line for line, rule in pairwise(text.split("\n")) if rule.startswith("---")}
    assert {"Parameters", "Raises", "Examples"} <= sections
    assert {"Returns", "Yields"} & sections or "-> None" in str(
        inspect.signature(getattr(hearthlog, name))
    )
    assert examples_of(name)


def test_the_methods_of_logs_say_it_too():
    methods = [
        name
        for name, method in inspect.getmembers(hearthlog.Logs, inspect.isfunction)
        if not name.startswith("_")
    ]
    assert {test.name.partition(".")[2] for test in examples_of("Logs")} == set(methods)


def test_every_public_name_is_on_the_page_of_the_api():
    page = (Path(__file__).parents[1] / "docs" / "api.md").read_text("utf-8")
    assert set(re.findall(r"^\.\. auto\w+:: (\w+)$", page, re.MULTILINE)) == set(PUBLIC)


def test_importing_it_imports_nothing_that_is_heavy():
    code = "import sys, hearthlog; print(*{name.partition('.')[0] for name in sys.modules})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "hearthlog" in run.stdout.split()
    assert not {"numpy", "mcap", "rosbags", "pydantic", "typer"} & set(run.stdout.split())


def test_sound_is_labelled_without_what_only_training_or_tables_need(folder):
    code = (
        "import sys, soundfile, hearthlog\n"
        "sound = soundfile.read('sound.flac', dtype='int16')\n"
        "hearthlog.classify(hearthlog.load_model('home.safetensors'), *sound)\n"
        "hearthlog.open_logs('logs').segments()\n"
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=folder
    )
    assert not {"sklearn", "scipy", "pyarrow", "pandas", "rerun"} & set(run.stdout.split())


def test_a_name_that_is_not_public_is_no_attribute():
    assert set(hearthlog.__all__) <= set(dir(hearthlog))
    with pytest.raises(AttributeError, match="no attribute 'read_columns'"):
        _ = hearthlog.read_columns


@pytest.mark.parametrize("model", ["model_file", "hmm_file"])
@pytest.mark.parametrize("form", [(16_000, 1), (44_100, 2)], ids=["16 kHz", "44.1 kHz, stereo"])
def test_an_array_of_sound_gives_the_bits_that_a_recorder_logs(model, form, day, request, tmp_path):
    rate, channels = form
    path = request.getfixturevalue(model)
    sound, _ = soundfile.read(day, dtype="int16", frames=60 * 16_000)
    file = tmp_path / "sound.wav"
    soundfile.write(file, np.stack([sound, sound // 2][:channels], axis=1), rate)
    logged = read_columns(find_logs(make_logs(tmp_path / "logs", path, [file])))

    samples, rate = soundfile.read(file, dtype="int16")
    features = hearthlog.extract_features(samples, rate, start=START)
    labels = hearthlog.classify(hearthlog.load_model(path), samples, rate, START)

    label, segment = logged["/mic/label"], logged["/mic/segment"]
    assert features.values.tobytes() == logged["/mic/features"]["values"].tobytes()
    assert features.times.tolist() == logged["/mic/features"]["header.stamp"].tolist()
    assert labels.probabilities.tobytes() == label["probabilities"].tobytes()
    assert labels.novelty.tobytes() == label["novelty"].tobytes()
    assert labels.times.tolist() == label["header.stamp"].tolist()
    assert labels.labels.tolist() == label["label"].tolist()
    assert labels.segments.starts.tolist() == segment["header.stamp"].tolist()
    assert (labels.segments.ends - labels.segments.starts).tolist() == segment["duration"].tolist()
    assert labels.segments.labels.tolist() == segment["label"].tolist()


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32", "float64"])
def test_sound_of_any_type_is_that_of_the_file(dtype, day):
    samples, rate = soundfile.read(day, dtype=dtype)
    np.testing.assert_array_equal(convert_sound(samples, rate), np.concatenate([*read_audio(day)]))


@pytest.mark.parametrize(
    ("sound", "rate"),
    [
        (np.zeros(799, np.int16), 16_000),
        (np.zeros(0), 16_000),
        (np.zeros((2, 2, 2)), 16_000),
        (np.zeros(16_000, complex), 16_000),
        (np.zeros(16_000), 100),
    ],
)
def test_what_is_no_sound_is_refused(sound, rate):
    with pytest.raises(HearthlogError):
        hearthlog.extract_features(sound, rate)


def test_sound_shorter_than_a_window_has_no_label(model_file):
    labels = hearthlog.classify(hearthlog.load_model(model_file), np.zeros(8000), 16_000)
    assert len(labels.times) == len(labels.labels) == len(labels.segments) == 0


def test_arrays_tables_and_frames_hold_the_same(folder):
    logs = hearthlog.open_logs(folder / "logs")
    for topic in logs.topics:  # of which /mic/gap has no message
        columns, table = logs.columns(topic), logs.arrow(topic)
        assert table["log_time"].to_numpy().astype("i8").tolist() == columns.log_times.tolist()
        frame = logs.pandas(topic)
        assert frame.index.as_unit("ns").asi8.tolist() == columns.log_times.tolist()
    label, frame = logs.columns("/mic/label"), logs.pandas("/mic/label")
    own = [name for name in frame.columns if name.startswith("probabilities.")]
    assert own[0] == "probabilities.silence"
    np.testing.assert_array_equal(frame[own].to_numpy(), label["probabilities"])
    assert frame["label"].tolist() == label["label"].tolist()


def test_a_span_of_time_is_what_is_read(folder):
    logs = hearthlog.open_logs(folder / "logs", START + 60 * SECOND, START + 90 * SECOND)
    times = logs.columns("/mic/features").log_times
    assert (int(times[0]), len(times)) == (START + 60 * SECOND, 600)
    spans = logs.segments()
    assert (spans.starts[0], spans.ends[-1]) == (logs.start, logs.end)
    with pytest.raises(HearthlogError, match="no topic /mic/other; there are /diagnostics, "):
        logs.columns("/mic/other")


@pytest.mark.parametrize(
    ("span", "topic"),
    [((None, None), "/mic/gap"), ((0, START), "/mic/features"), ((0, START), "/mic/gap")],
    ids=["no message at all", "no log of the span", "neither"],
)
def test_a_topic_without_messages_is_a_table_without_rows(span, topic, folder):
    logs, full = hearthlog.open_logs(folder / "logs", *span), hearthlog.open_logs(folder / "logs")
    columns = logs.columns(topic)
    assert (len(columns), columns.type) == (0, full.topics[topic])
    assert columns["header.stamp"].dtype == np.int64
    assert logs.columns(topic, ["header.frame_id"]).fields.keys() == {"header.frame_id"}
    assert logs.arrow(topic).num_rows == 0
    assert logs.arrow(topic).schema.types == full.arrow(topic).schema.types
    assert len(logs.pandas(topic)) == 0
    assert logs.pandas(topic).columns.equals(full.pandas(topic).columns)
    assert logs.pandas(topic).index.dtype == full.pandas(topic).index.dtype
    with pytest.raises(HearthlogError, match="no topic /mic/other; there are /diagnostics, "):
        logs.columns("/mic/other")


def test_marks_are_those_of_the_span_of_time(folder):
    first = hearthlog.open_logs(folder / "logs", end=START + 2 * SECOND)
    rest = hearthlog.open_logs(folder / "logs", START + 2 * SECOND)
    assert ([mark.label for mark in first.marks()], rest.marks()) == (["coughing"], [])


def test_what_a_reviewer_says_is_a_labelling(folder):
    logs = hearthlog.open_logs(folder / "logs")
    assert logs.segments("review").labels.tolist() == ["coughing"]
    with pytest.raises(HearthlogError, match="no labelling 'later'; there is live, review"):
        logs.segments("later")


def test_a_log_brings_the_layers_beside_it(folder):
    (path,) = (path for path in find_logs(folder / "logs") if "review" not in path.name)
    assert hearthlog.open_logs(path).labellings == {"mic": ["live", "review"]}


@pytest.mark.parametrize(("method", "module"), [("arrow", "pyarrow"), ("pandas", "pandas")])
def test_a_package_that_is_missing_is_named(method, module, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    logs = hearthlog.open_logs(folder / "logs")
    with pytest.raises(
        HearthlogError, match=rf"{module} is not installed; try: .*\[headless\]"
    ) as it:
        getattr(logs, method)("/mic/label")
    assert isinstance(it.value, ModuleNotFoundError)  # as it was said once


def test_learning_without_its_packages_names_them():
    code = """if True:
        import sys
        sys.modules["sklearn"] = None
        import hearthlog
        try:
            hearthlog.train
        except hearthlog.HearthlogError as error:
            print(error)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert re.fullmatch(r"scikit-learn is not installed; try: .*\[headless\].*\n", done.stdout)
    assert done.stderr == ""


def test_a_damaged_log_is_left_out_of_the_segments_with_a_warning(day, model_file, tmp_path):
    make_logs(tmp_path / "logs", model_file, [day], max_bag_duration=60)
    (first, *_) = find_logs(tmp_path / "logs")
    data = bytearray(first.read_bytes())
    half = len(data) // 2
    data[half // 2 : half] = bytes(half - half // 2)  # several chunks
    first.write_bytes(data)
    logs = hearthlog.open_logs(tmp_path / "logs")
    with pytest.warns(HearthlogWarning, match="damaged"):
        assert logs.segments().starts[0] >= START + 50 * SECOND
