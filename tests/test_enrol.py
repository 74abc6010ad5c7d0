"""A sound that was enrolled is a log of its features, all of it marked, and holds no audio."""

import math
import shutil
import subprocess
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import soundfile
from conftest import HEARTHLOG
from log_fixtures import run
from stores import put

from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.marks.enrol import enrol_file
from hearthlog.analyzer.marks.marks import Mark, read_marks, write_marks
from hearthlog.analyzer.training.home_recordings import home_recordings
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.frames import FRAME_SAMPLES, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.messages.topics import topic

RATE = 16_000
FEATURES = topic("mic", "features")


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def home(tmp_path):
    return tmp_path / "home"


@pytest.fixture
def cough(household, tmp_path):
    """Two seconds of a real sound, as another file."""
    (samples, *_) = read_audio(min(household.glob("cough*/*.flac")))
    path = tmp_path / "cough.wav"
    soundfile.write(path, np.resize(samples, 2 * RATE), RATE, subtype="FLOAT")
    return path


def enrolled(home):
    return [path for path in find_logs(home / "enrolled") if not is_layer(path)]


def values(log):
    return read_columns([log], {FEATURES})[FEATURES]["values"]


def features_of(path, seconds):
    samples = np.concatenate(list(read_audio(path)))[: round(seconds * RATE)]
    return DEFAULT.extractor()(samples[: len(samples) // 800 * 800].reshape(-1, FRAME_SAMPLES))


def check_marked(log, label, seconds):
    """All of the log has one mark."""
    (mark,) = read_marks(log)
    labelled = find_coverage(log)["mic"]
    assert (mark.label, mark.start, mark.end) == (label, labelled.starts[0], labelled.ends[0])
    assert mark.end - mark.start == pytest.approx(seconds * NANOSECONDS, abs=1e6)


def test_of_several_files_those_that_cannot_be_read_are_named(hearthlog, cough, home, tmp_path):
    bad, cut = tmp_path / "bad.wav", tmp_path / "cut.wav"
    bad.write_text("no sound")
    cut.write_bytes(cough.read_bytes()[:-20_000])
    files = ("--file", bad, "--file", cough, "--file", cut)
    result = hearthlog("enrol", "coughing", "--home", home, *files)
    assert result.returncode == 3
    assert len(enrolled(home)) == result.stdout.count("\n") == 2
    refused, short = result.stderr.splitlines()
    assert refused.startswith(f"hearthlog: {bad}: cannot be read as audio")
    assert short.startswith(f"hearthlog: {cut}: is cut short")
    result = hearthlog("enrol", "coughing", "--home", home, "--file", bad, "--file", bad)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)


def test_a_file_that_says_when_it_begins_is_enrolled_with_that_time(hearthlog, cough, home):
    named = cough.rename(cough.with_name("20260301T070000Z.wav"))
    for _ in range(2):
        assert hearthlog("enrol", "coughing", "--home", home, "--file", named).returncode == 0
    assert sorted(log.name for log in enrolled(home)) == [
        "coughing_20260301T065958Z.mcap",
        "coughing_20260301T070000Z.mcap",
    ]


def test_a_file_is_enrolled_as_its_features_and_doctor_is_content(hearthlog, cough, home):
    result = hearthlog("enrol", "coughing", "--home", home, "--file", cough)
    (log,) = enrolled(home)
    assert result == (0, f"{log}: 2.00 s of coughing\n", "")
    assert log.name.startswith("coughing_20")
    assert np.array_equal(values(log), features_of(cough, 2))
    check_marked(log, "coughing", 2)
    assert {name for name in read_columns([log]) if "audio" in name} == set()
    doctor = hearthlog("doctor", home)
    assert doctor.returncode == 0
    assert doctor.stdout.endswith(": 0 errors, 0 warnings\n")
    assert {path.parent for path in home.rglob("*") if path.is_file()} == {log.parent}


def test_how_a_recorder_is_configured_does_not_matter(cough, home, monkeypatch, hearthlog):
    monkeypatch.setenv("HEARTHLOG_MODEL", "none.safetensors")
    monkeypatch.setenv("HEARTHLOG_NODE", "attic")
    monkeypatch.setenv("HEARTHLOG_STATISTICS_EVERY", "7")
    assert hearthlog("enrol", "cry", "--home", home, "--file", cough).returncode == 0
    (log,) = enrolled(home)
    check_marked(log, "cry", 2)
    monkeypatch.setenv("HEARTHLOG_SYNC_SECONDS", "never")
    result = hearthlog("enrol", "cry", "--home", home, "--file", cough)
    assert (result.returncode, "sync_seconds" in result.stderr) == (2, True)


def test_of_a_file_only_the_first_seconds_are_taken(hearthlog, cough, home):
    assert (
        hearthlog("enrol", "cry", "--home", home, "--file", cough, "--seconds", 1.2).returncode == 0
    )
    (log,) = enrolled(home)
    assert np.array_equal(values(log), features_of(cough, 1.2))
    check_marked(log, "cry", 1.2)


def test_many_files_in_a_moment_become_logs_that_do_not_overlap(hearthlog, cough, home):
    logs = [enrol_file(home, "coughing", cough)[0].log for _ in range(4)]
    assert len(set(logs)) == 4
    spans = sorted((read_marks(log)[0].start, read_marks(log)[0].end) for log in logs)
    assert all(end <= start for (_, end), (start, _) in pairwise(spans))
    assert hearthlog("doctor", home).returncode == 0


def test_a_span_of_logs_is_enrolled_as_it_was_recorded(hearthlog, recorded, home):
    labelled = find_coverage(recorded)["mic"]
    border = labelled.starts[1]
    start, end = (np.datetime64(border + n * 10**9, "ns") for n in (-2, 3))
    command = ("enrol", "speech", "--home", home, "--log", recorded, "--start", start, "--end", end)
    result = hearthlog(*command)
    (log,) = enrolled(home)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == f"{log}: 5.00 s of speech\n"
    wanted = read_columns(labelled.logs, {FEATURES}, int(start.astype(int)), int(end.astype(int)))
    assert np.array_equal(values(log), wanted[FEATURES]["values"])
    assert set(read_columns([log])) == {FEATURES, topic("mic", "info")}
    check_marked(log, "speech", 5)
    assert hearthlog("doctor", home).returncode == 0
    before = log.read_bytes()
    again = hearthlog(*command)
    assert (again.returncode, "exists already" in again.stderr) == (1, True)
    assert log.read_bytes() == before


@pytest.fixture
def logs(recorded, tmp_path):
    """Logs of a home, without its enrolled sounds."""
    return shutil.copytree(recorded, tmp_path / "logs")


def test_enrolled_sounds_are_no_time_of_the_home(hearthlog, logs, cough):
    verbs = (
        ("info", logs, "--json"),
        ("cat", logs, "--format", "ndjson", "--topics", "/mic/info"),
        ("evaluate", "log", logs, "--reference", "review"),
    )
    first = find_coverage(logs)["mic"].starts[0]
    write_marks(find_logs(logs)[0], [Mark("mic", first, first + 2 * NANOSECONDS, "speech")])
    before = find_coverage(logs), [hearthlog(*verb) for verb in verbs]
    at = ("--start", "2026-03-01T06:59:40", "--end", "2026-03-01T06:59:42")
    assert hearthlog("enrol", "silence", "--home", logs, "--log", logs, *at).returncode == 0
    assert hearthlog("enrol", "coughing", "--home", logs, "--file", cough).returncode == 0
    assert len(enrolled(logs)) == 2
    assert (find_coverage(logs), [hearthlog(*verb) for verb in verbs]) == before


def test_a_home_is_learned_from_with_its_enrolled_sounds(logs, cough):
    first = find_coverage(logs)["mic"].starts[0]
    write_marks(find_logs(logs)[0], [Mark("mic", first, first + 2 * NANOSECONDS, "speech")])
    enrol_file(logs, "coughing", cough)
    assert {recording.label for recording in home_recordings(logs)} == {"speech", "coughing"}


def test_two_recordings_enrolled_on_one_day_make_a_class_and_one_of_them_twice_does_not(
    household, home
):
    base = load_model(starter_file(GENERAL))
    first, second = sorted((household / "crying").glob("*.flac"))[:2]
    for path in (first, first):
        enrol_file(home, "crying", path)
    assert read_home_training_set([home], base).segments.classes == base.classes
    enrol_file(home, "crying", second)
    lessons = read_home_training_set([home], base)
    assert lessons.segments.classes == (*base.classes, "crying")
    assert lessons.segments.amounts["crying"].sources == 2


def test_a_home_may_have_nothing_but_enrolled_sounds(hearthlog, cough, home):
    enrol_file(home, "coughing", cough)
    assert [recording.label for recording in home_recordings(home)] == ["coughing"]
    result = hearthlog("info", home)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == (
        f"hearthlog: {home}: no log (*.mcap) in this folder but enrolled sounds; name their folder "
        "'enrolled' to read those\n"
    )
    assert hearthlog("info", home / "enrolled").returncode == 0


def test_enrolled_sounds_are_checked_by_the_doctor(hearthlog, logs, cough):
    (made,) = enrol_file(logs, "coughing", cough)
    made.log.write_bytes(made.log.read_bytes()[:-100])
    result = hearthlog("doctor", logs)
    assert (result.returncode, str(made.log) in result.stdout) == (1, True)


def test_enrolled_sounds_in_a_store_are_no_time_of_the_home(logs, cough, in_memory):
    names = [path.relative_to(logs).as_posix() for path in find_logs(logs)]
    enrol_file(logs, "coughing", cough)
    put(logs, in_memory / "anna")
    for folder in (in_memory, in_memory / "anna"):
        assert [str(path) for path in find_logs(folder)] == [
            str(in_memory / "anna" / name) for name in names
        ]
        assert len(find_logs(folder, enrolled=True)) == len(names) + 2
    assert len(find_logs(in_memory / "anna" / "enrolled")) == 2


def test_what_is_no_sound_to_learn_from_is_refused(hearthlog, recorded, cough, home, tmp_path):
    short, quiet = tmp_path / "short.wav", tmp_path / "quiet.wav"
    soundfile.write(short, np.full(RATE - 1, 0.1), RATE)
    noise = np.random.default_rng(1).normal(0, 10 ** (-70 / 20), 2 * RATE)
    soundfile.write(quiet, noise, RATE)
    dead = tmp_path / "dead.wav"
    soundfile.write(dead, 0.02 + np.random.default_rng(1).integers(-1, 2, 2 * RATE) / 32768, RATE)
    at = ("--start", "2026-03-01T06:59:40", "--end", "2026-03-01T06:59:40.9")
    for options, reason in (
        (("cry", "--file", short), "only 0.95 s of sound; enrol at least 1 s"),
        (("cry", "--file", quiet), "all of it is below -60 dBFS: this is silence, not cry"),
        (("cry", "--file", dead), "all of it is below -60 dBFS: this is silence, not cry"),
        (("Cry!", "--file", cough), "'Cry!' cannot be the name of a class"),
        (("cry", "--file", tmp_path / "no.wav"), f"{tmp_path}/no.wav: no such file"),
        (("cry", "--log", recorded, *at), "only 0.90 s of sound"),
        (
            ("cry", "--log", recorded, "--start", "2020-01-01", "--end", "2020-01-02"),
            "only 0.00 s of sound",
        ),
    ):
        label, *rest = options
        result = hearthlog("enrol", label, "--home", home, *rest)
        assert (result.returncode, result.stdout) == (1, "")
        assert result.stderr.startswith(f"hearthlog: {reason}")
        assert result.stderr.count("\n") == 1
        assert not home.exists()
    assert hearthlog("enrol", "silence", "--home", home, "--file", quiet).returncode == 0


def test_a_log_of_several_microphones_is_refused(hearthlog, recorded, home, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(recorded, logs)
    hearthlog(
        "record",
        "--name",
        "attic",
        "-o",
        logs / "attic",
        _tone(tmp_path),
        "--start",
        "2026-03-01T07:00",
    )
    at = ("--start", "2026-03-01T07:00:00", "--end", "2026-03-01T07:00:02")
    result = hearthlog("enrol", "cry", "--home", home, "--log", logs, *at)
    assert (result.returncode, result.stdout) == (1, "")
    assert "is of several microphones (attic, mic)" in result.stderr


def _tone(folder):
    path = folder / "tone.wav"
    soundfile.write(path, 0.1 * np.sin(math.tau * 440 * np.arange(3 * RATE) / RATE), RATE)
    return path


def test_wrong_use_is_told_from_what_failed(hearthlog, cough, recorded, home):
    for options in (
        (),
        ("--file", cough, "--log", recorded),
        ("--file", cough, "--seconds", "0.5"),
        ("--file", cough, "--seconds", "nan"),
        ("--file", cough, "--start", "2026-03-01"),
        ("--log", recorded),
        ("--log", recorded, "--start", "2026-03-01"),
        ("--log", recorded, "--start", "2026-03-02", "--end", "2026-03-01"),
        ("--log", recorded, "--start", "2026-03-01", "--end", "2026-03-02", "--seconds", "3"),
    ):
        assert hearthlog("enrol", "cry", "--home", home, *options).returncode == 2
    assert not home.exists()


def test_a_microphone_is_listened_to_for_so_long(labmic, home):
    rng = np.random.default_rng(3)
    labmic.configure(data=rng.normal(0, 3000, 7 * RATE).astype(np.int16))
    command = [*HEARTHLOG, "enrol", "running_water", "--home", str(home)]
    command += ["--microphone", labmic.device, "--seconds", "2"]
    result = subprocess.run(
        command, env=labmic.env, capture_output=True, text=True, timeout=60, check=False
    )
    (log,) = enrolled(home)
    assert result.stderr == "hearthlog: listening for 2 s\n"
    assert (result.returncode, result.stdout) == (0, f"{log}: 2.00 s of running_water\n")
    assert len(values(log)) == 40
    check_marked(log, "running_water", 2)


CLIP_SECONDS = np.arange(4 * RATE) / RATE
UNFIT = {
    "integers as floats": (lambda cough: cough * 32768, "the file clips"),
    "far beyond full scale": (lambda cough: cough * 1e30, "the file clips"),
    "the mains": (lambda _: 0.1 * np.sin(2 * np.pi * 50 * CLIP_SECONDS), "hums at 50 Hz"),
    "an offset that steps": (lambda _: 0.02 * (CLIP_SECONDS // 1 % 2), "gives one value only"),
    "an offset, and silence": (lambda _: -0.1 * (CLIP_SECONDS > 3), "gives one value only"),
    "a cough and silence": (lambda cough: cough * (CLIP_SECONDS < 1), ""),
    "a cough that reaches full scale once": (lambda cough: np.clip(cough * 1.02, -1, 1), ""),
}


@pytest.mark.parametrize("case", UNFIT)
@pytest.mark.filterwarnings("error")
def test_what_is_wrong_with_an_enrolled_sound_is_said(case, cough, home, tmp_path):
    make, problem = UNFIT[case]
    samples = np.resize(soundfile.read(cough)[0], len(CLIP_SECONDS))
    path = tmp_path / "unfit.wav"
    sound = make(samples / np.abs(samples).max()).astype(np.float32)
    soundfile.write(path, sound, RATE, subtype="FLOAT")
    (log,) = enrol_file(home, "coughing", path)
    assert problem in log.warning
    assert log.warning.startswith(f"{path}: ") if problem else not log.warning
