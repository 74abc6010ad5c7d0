"""Bad input gets one line that says what is wrong, the right exit status, and loses nothing."""

import os
import shutil
import subprocess
from functools import partial

import numpy as np
import pytest
import soundfile
from log_fixtures import run, small_disk
from logreader import LogReader
from logs import features

from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, save_model


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


@pytest.fixture
def sound(tmp_path):
    path = tmp_path / "sound.wav"
    soundfile.write(path, np.random.default_rng(0).normal(0, 0.1, 48_000), 16_000)
    os.utime(path, (1_772_348_400, 1_772_348_400))  # from a full hour on: it makes one log
    return path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "{}: holds no audio; the file is empty"),
        (b"no sound at all" * 99, "{}: cannot be read as audio (Format not recognised"),
        (None, "{}: no such file"),
    ],
    ids=["empty", "text", "missing"],
)
def test_a_file_that_is_no_audio(refused, tmp_path, content, message):
    path = tmp_path / "bad.wav"
    if content is not None:
        path.write_bytes(content)
    # The line ends otherwise where there is no ffmpeg.
    assert refused("record", path, "-o", tmp_path / "logs").startswith(message.format(path))
    assert not (tmp_path / "logs").exists()


def test_an_audio_file_without_samples(refused, tmp_path):
    path = tmp_path / "silent.wav"
    soundfile.write(path, np.empty(0), 16_000)
    assert refused("record", path, "-o", tmp_path / "logs") == f"{path}: holds no audio"


def test_a_bad_second_file_is_refused_before_the_first_is_recorded(refused, day, tmp_path):
    logs = tmp_path / "logs"
    assert "no such file" in refused("record", day, tmp_path / "missing.wav", "-o", logs)
    assert not logs.exists()


def test_a_sound_that_ends_before_the_first_window_has_no_labels(hearthlog, tmp_path, model_file):
    path = tmp_path / "short.wav"
    soundfile.write(path, np.random.default_rng(0).normal(0, 0.1, 11_999), 16_000)
    options = ("-o", tmp_path / "logs", "--start", "2026-03-01")
    result = hearthlog("record", path, "--model", model_file, *options)
    assert result.returncode == 0
    (log,) = (tmp_path / "logs").rglob("*.mcap")
    topics = [item.topic for item in LogReader(log).messages()]
    assert topics.count("/mic/features") == 14
    assert "/mic/label" not in topics


def test_a_sound_shorter_than_a_frame(refused, tmp_path):
    path = tmp_path / "click.wav"
    soundfile.write(path, np.ones(799), 16_000)
    message = refused("record", path, "-o", tmp_path / "logs")
    assert message == f"{path}: shorter than one frame of 50 ms"


def test_a_file_of_nan_and_infinity_in_8_channels_at_192_khz(hearthlog, tmp_path):
    samples = np.random.default_rng(0).normal(0, 0.1, (192_000 * 2, 8)).astype(np.float32)
    samples[1000:1100] = np.nan
    samples[2000:2100, 3] = np.inf
    path = tmp_path / "wild.wav"
    soundfile.write(path, samples, 192_000, subtype="FLOAT")
    result = hearthlog("record", path, "-o", tmp_path / "logs", "--start", "2026-03-01")
    assert result.returncode == 3
    line = "wild.wav: 0.05 s are left out: samples are not finite (NaN or infinity)"
    assert line in result.stderr
    _, _, values = features(tmp_path / "logs")
    assert len(values) in (38, 39)
    assert np.isfinite(values).all()


def test_a_log_that_exists_is_never_overwritten(refused, hearthlog, sound, tmp_path):
    options = ("record", sound, "-o", tmp_path / "logs", "--start", "2026-03-01T07:00:00")
    assert hearthlog(*options).returncode == 0
    (log,) = (tmp_path / "logs").rglob("*.mcap")
    before = log.read_bytes()
    expected = f"{log}: exists already; move it away or record into another folder"
    assert refused(*options) == expected
    assert log.read_bytes() == before


def test_an_output_folder_that_is_a_file(refused, sound, tmp_path):
    path = tmp_path / "file"
    path.write_text("mine")
    assert refused("record", sound, "-o", path) == f"{path}: cannot be written (Not a directory)"
    assert path.read_text() == "mine"


def test_an_output_folder_that_is_read_only(refused, sound, tmp_path):
    with small_disk(tmp_path / "disk", "1m") as disk:
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        expected = f"{disk}: cannot be written (Read-only file system)"
        assert refused("record", sound, "-o", disk) == expected


def test_a_full_disk_keeps_what_was_recorded_and_the_next_start_completes_it(
    refused, hearthlog, sound, tmp_path
):
    long = tmp_path / "long.wav"
    soundfile.write(long, np.random.default_rng(0).normal(0, 0.1, 16_000 * 900), 16_000)
    with small_disk(tmp_path / "disk", "1m") as disk:
        message = refused("record", long, "-o", disk, "--start", "2026-03-01T07:00:00")
        assert message == (
            f"{disk}: cannot be written (No space left on device); what was recorded is kept, "
            "and completed at the next start"
        )
        (left,) = disk.rglob("*.mcap.active")
        kept = features(left)[0]
        assert len(kept) > 2000
        still_full = refused("record", sound, "-o", disk, "--start", "2026-03-01T07:00:00")
        assert still_full.startswith(f"{left}: ")
        assert sorted(path.name for path in left.parent.iterdir()) == [left.name]
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        start = ("--start", "2030-01-01")
        assert hearthlog("record", sound, "-o", disk, *start).returncode == 0
        np.testing.assert_array_equal(features(left.with_suffix(""))[0], kept)


def test_a_model_that_is_missing(refused, sound, tmp_path):
    path = tmp_path / "none.safetensors"
    assert str(path) in refused("record", sound, "--model", path, "-o", tmp_path / "logs")
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize("length", [0, 7, 100, -1])
def test_a_model_that_is_truncated(refused, sound, model_file, tmp_path, length):
    path = tmp_path / "cut.safetensors"
    path.write_bytes(model_file.read_bytes()[:length])
    assert str(path) in refused("record", sound, "--model", path, "-o", tmp_path / "logs")


def test_a_model_of_another_feature_set(refused, sound, model_file, tmp_path):
    path = tmp_path / "other.safetensors"
    path.write_bytes(model_file.read_bytes().replace(DEFAULT.name.encode(), b"home99"))
    message = refused("record", sound, "--model", path, "-o", tmp_path / "logs")
    assert "home99" in message


def test_no_portaudio(refused, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import ctypes.util\nctypes.util.find_library = lambda name: None\n"
    )
    env = {"PYTHONPATH": str(tmp_path)}
    expected = "PortAudio is missing: install it (Debian: apt install libportaudio2)"
    assert refused("record", "-o", tmp_path / "logs", env=env) == expected
    assert refused("devices", env=env) == expected


def test_an_alsa_configuration_that_is_missing(refused, tmp_path):
    env = {"ALSA_CONFIG_PATH": str(tmp_path / "none.conf")}
    for command in (("record", "-o", tmp_path / "logs"), ("devices",)):
        assert refused(*command, env=env).startswith("PortAudio c")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('nodee = "flat"', "unknown key 'nodee'"),
        ("node = ", "cannot be read as TOML"),
        ('node = "a/b"', "node: node name 'a/b'"),
        ('[[microphone]]\nname = "Bad Room"', "microphone.0.name: microphone name 'Bad Room'"),
        ("[[microphone]]\nnoise = 1", "unknown key 'microphone.0.noise'"),
        (
            "flush_seconds = -1",
            "flush_seconds: -1 is not a number from 1.0 to 3600; write flush_seconds = 1.0",
        ),
        ("node = " + "[" * 100_000, "cannot be read as TOML (it is nested too deeply)"),
        ("a." * 400_000 + "a = 1", "cannot be read as TOML (it is nested too deeply)"),
        ("flush_seconds = " + "1" * 5000, "cannot be read as TOML"),
        ("#" * (1 << 20) + "#", "larger than 1 MB; this is no configuration"),
    ],
)
def test_a_configuration_that_makes_no_sense(refused, sound, tmp_path, content, words):
    path = tmp_path / "hearthlog.toml"
    path.write_text(content)
    message = refused("record", sound, "--config", path, "-o", tmp_path / "logs", status=2)
    assert words in message
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("/dev/zero", "cannot be read (Not a regular file)"),
        ("/dev/tty", "cannot be read (Not a regular file)"),
        ("/", "cannot be read (Is a directory)"),
        ("none.toml", "no such configuration"),
    ],
)
def test_a_configuration_that_is_no_regular_file(refused, sound, tmp_path, path, reason):
    message = refused("record", sound, "--config", path, "-o", tmp_path / "logs", status=2)
    assert message == f"{path}: {reason}"


def test_a_configuration_may_have_a_line_of_dots_in_a_comment(hearthlog, sound, tmp_path):
    path = tmp_path / "hearthlog.toml"
    path.write_text(f"# {'.' * 200}\nnode = 'flat'  # {'.' * 90}\n")
    result = hearthlog("record", sound, "--config", path, "-o", tmp_path / "logs")
    assert (result.returncode, "/flat_" in result.stdout) == (0, True)


OF_MICROPHONE = "environment, HEARTHLOG_MICROPHONE: "


@pytest.mark.parametrize(
    ("variable", "words"),
    [
        ("HEARTHLOG_NODEE=flat", "environment: unknown variable 'HEARTHLOG_NODEE'"),
        ("hearthlog_nodee=flat", "environment: unknown variable 'hearthlog_nodee'"),
        ("HEARTHLOG_=flat", "environment: unknown variable 'HEARTHLOG_'"),
        ("HEARTHLOG_MICROPHONE=mic", "environment: HEARTHLOG_MICROPHONE is not JSON (Expecting"),
        ("HEARTHLOG_NEVER_KEEP=" + "[" * 100_000, "environment: HEARTHLOG_NEVER_KEEP is not JSON"),
        ('HEARTHLOG_MICROPHONE=[{"noise": 1}]', f"{OF_MICROPHONE}unknown key"),
        (
            "HEARTHLOG_FLUSH_SECONDS=never",
            "environment, HEARTHLOG_FLUSH_SECONDS: flush_seconds: 'n",
        ),
    ],
)
def test_a_variable_of_the_environment_that_makes_no_sense(
    refused, sound, tmp_path, variable, words
):
    env = dict([variable.split("=")])
    message = refused("record", sound, "-o", tmp_path / "logs", status=2, env=env)
    assert message.startswith(words)
    assert not (tmp_path / "logs").exists()


def test_variables_of_other_programs_and_of_the_configuration_are_taken(hearthlog, sound, tmp_path):
    env = {"HEARTHLOGS": "1", "_HEARTHLOG": "1", "HEARTHLOG_NODE": "flat"}
    env |= {"HEARTHLOG_MICROPHONE": '[{"name": "hall"}]', "hearthlog_statistics_every": "7"}
    result = hearthlog("record", sound, "-o", tmp_path / "logs", env=env)
    assert (result.returncode, "/flat_" in result.stdout) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("record", "--realtime"), "--start, --start-pattern and --realtime go with files"),
        (("record", "x.wav", "--start", "yesterday"), "--start yesterday: not a time such as "),
        (("record", "--what"), "no such option: --what; see `hearthlog record --help`"),
        (("recover",), "missing argument 'logs'; see `hearthlog recover --help`"),
        (("models", "promote", "--to", "x"), "invalid value for '--to': "),
        (("demo", "--minutes", "0"), "invalid value for '--minutes': it must be at least 1; see"),
        (("demo", "--minutes", "2h"), "invalid value for '--minutes': it must be a number; see"),
        (("discover", "x", "--least", "2.5"), "invalid value for '--least': it must be a whole"),
        (("listen",), "no such command 'listen'; see `hearthlog --help`"),
    ],
)
def test_wrong_use_is_one_line_and_exit_status_2(hearthlog, arguments, words):
    result = hearthlog(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"hearthlog: {words}")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("verb", [(), ("models",)])
def test_a_command_without_words_shows_its_help(hearthlog, verb):
    result = hearthlog(*verb)
    assert (result.returncode, result.stderr) == (2, "")
    assert "Usage: hearthlog" in result.stdout


@pytest.mark.parametrize("content", [b"", b"RIFF", b"x" * 999])
def test_info_of_what_is_no_log(refused, tmp_path, content):
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    assert refused("info", path).startswith(f"{path}: is not an MCAP file")


@pytest.mark.parametrize("verb", ["info", "doctor", "cat", "record", "report", "watch"])
def test_a_name_that_no_file_can_have(refused, verb):
    assert refused(verb, "a" * 5000) == f"{'a' * 5000}: File name too long"


def test_info_of_an_empty_folder(refused, tmp_path):
    assert refused("info", tmp_path) == f"{tmp_path}: no log (*.mcap) in this folder"


def test_info_of_a_damaged_log(hearthlog, sound, tmp_path):
    assert hearthlog("record", sound, "-o", tmp_path / "logs").returncode == 0
    (log,) = (tmp_path / "logs").rglob("*.mcap")
    data = bytearray(log.read_bytes())
    data[-26] ^= 0xFF  # where its summary begins
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    result = hearthlog("info", damaged)
    assert result.returncode == 3
    assert f"{damaged}: its index is damaged, and messages may be missing" in result.stderr


def test_a_model_is_never_overwritten_by_training(refused, model_file, tmp_path):
    copy = tmp_path / "mine.safetensors"
    shutil.copy(model_file, copy)
    message = refused(
        "train", "--data", tmp_path / "x.csv", "--scenario", "general", "--output", copy
    )
    assert str(copy) in message
    assert copy.read_bytes() == model_file.read_bytes()


def test_a_saved_model_is_read_back_as_it_was(model_file, tmp_path):
    save_model(load_model(model_file), tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == model_file.read_bytes()
