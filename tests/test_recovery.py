"""What a killed recorder leaves is completed whatever its length, and nothing else is touched."""

import json
import random
import shutil
import struct
from threading import Event

import numpy as np
import pytest
from logreader import LogReader
from logs import features

from hearthlog.recorder.config import load_settings
from hearthlog.recorder.log.recovery import end_of_sound, recover_active
from hearthlog.recorder.recording import record_files
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import active_path
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages.topics import topics_of

pytestmark = pytest.mark.fast

CHUNK = 0x06


@pytest.fixture(scope="module")
def log(tmp_path_factory, day, model_file):
    """A finished log of three minutes."""

    folder = tmp_path_factory.mktemp("whole")
    settings = load_settings(None, {"output": folder, "model": model_file}, {})
    (path,) = record_files(settings, FileSource([day], 10**18), Event()).logs
    return path


def content(path):
    return [(m.topic, m.log_time, m.data) for m in LogReader(path).messages()]


def left_behind(log, folder, data):
    path = folder / log.name
    active_path(path).write_bytes(data)
    return path


@pytest.mark.parametrize("seed", range(12))
def test_a_log_cut_anywhere_is_completed_with_all_that_is_whole(log, tmp_path, seed):
    data = log.read_bytes()
    length = random.Random(seed).randrange(20_000, len(data))
    path = left_behind(log, tmp_path, data[:length])
    kept = content(active_path(path))
    (recovered,) = recover_active(tmp_path, "home")
    assert recovered.path == path
    end = features(path)[1][-1] + FRAME_NANOSECONDS
    assert end_of_sound(tmp_path, "home", "mic", 2 * 10**18) == end
    assert content(path) == kept == content(log)[: len(kept)]
    reader = LogReader(path)
    list(reader.messages())
    assert reader.complete
    assert "hearthlog" in reader.metadata
    about = json.loads(reader.metadata["rosbag2"]["serialized_metadata"])
    assert about["message_count"] == len(kept)
    assert sum(t["message_count"] for t in about["topics_with_message_count"]) == len(kept)
    assert set(reader.attachments) == {"configuration.json", "model.json", "model_card.md"}
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("length", [3, 60, 700])
def test_a_log_without_a_message_is_kept_under_another_name(log, tmp_path, length):
    path = left_behind(log, tmp_path, log.read_bytes()[:length])
    assert recover_active(tmp_path, "home") == []
    assert [p.name for p in tmp_path.iterdir()] == [path.name + ".damaged"]


def test_an_empty_file_is_deleted_and_named(log, tmp_path):
    path = left_behind(log, tmp_path, b"")
    (recovered,) = recover_active(tmp_path, "home")
    assert not recovered.completed
    assert recovered.damage == f"{active_path(path)}: was empty, and is deleted"
    assert not list(tmp_path.iterdir())


def test_the_end_of_the_sound_is_that_of_the_newest_log_with_sound(log, tmp_path):
    later = log.name.replace("T014640Z", "T024640Z")
    assert later != log.name
    LogWriter(tmp_path / later, topics_of("mic", ["a"], None), {}).finish()
    (tmp_path / later.replace("T02", "T03")).write_bytes(b"no log")
    shutil.copy(log, tmp_path)
    end = features(log)[1][-1] + FRAME_NANOSECONDS
    assert end_of_sound(tmp_path, "home", "mic", 2 * 10**18) == end
    assert end_of_sound(tmp_path, "home", "hall", 2 * 10**18) == 0
    assert end_of_sound(tmp_path, "hom", "mic", 2 * 10**18) == 0
    assert end_of_sound(tmp_path, "home", "mic", 10**18 - 10**9) == 0  # made with a wrong clock


@pytest.mark.parametrize("length", [0, 5, 8])
def test_a_log_that_has_just_been_opened_has_no_messages_yet(log, tmp_path, length):
    path = left_behind(log, tmp_path, log.read_bytes()[:length])
    assert content(active_path(path)) == []


def test_of_a_damaged_log_the_whole_chunks_are_recovered_and_the_original_kept(log, tmp_path):
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 0x55
    path = left_behind(log, tmp_path, data)
    (recovered,) = recover_active(tmp_path, "home")
    assert "damaged at byte" in recovered.damage
    kept = [item for item in content(path) if item[0] != "/mic/gap"]  # the log has none
    everything = content(log)
    lost = set(everything) - set(kept)
    assert kept == [item for item in everything if item not in lost]
    assert 0 < len(lost) < 1000 < len(kept)
    assert kept[-1] == everything[-1]
    assert path.with_name(path.name + ".damaged").read_bytes() == bytes(data)


def test_a_length_that_would_swallow_the_rest_is_damage_and_loses_nothing(log, tmp_path):
    data = bytearray(log.read_bytes())
    lengths = [start + 1 for start, opcode in records(data) if opcode == CHUNK]
    data[lengths[len(lengths) // 2] + 2] ^= 0x70  # seven megabytes more
    path = left_behind(log, tmp_path, data)
    (recovered,) = recover_active(tmp_path, "home")
    assert "damaged at byte" in recovered.damage
    assert content(path) == content(log)
    assert path.with_name(path.name + ".damaged").read_bytes() == bytes(data)


def records(data):
    """Offset and opcode of the records of a file, those inside chunks left out."""
    offset = 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        yield offset, opcode
        offset += 9 + length


def test_a_recovery_that_was_itself_cut_short_is_done_again(log, tmp_path):
    path = left_behind(log, tmp_path, log.read_bytes()[:90_000])
    path.with_name(path.name + ".recovering").write_bytes(b"half of it")
    assert len(recover_active(tmp_path, "home")) == 1
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_recovery_that_only_lacked_its_last_step_is_ended(log, tmp_path):
    path = left_behind(log, tmp_path, log.read_bytes()[:90_000])
    shutil.copy(active_path(path), tmp_path / "again")
    recover_active(tmp_path, "home")
    done = path.read_bytes()
    (tmp_path / "again").rename(active_path(path))
    recover_active(tmp_path, "home")
    assert path.read_bytes() == done
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_log_that_was_finished_under_the_same_name_is_not_overwritten(log, tmp_path):
    path = left_behind(log, tmp_path, log.read_bytes()[:90_000])
    path.write_bytes(log.read_bytes())
    (recovered,) = recover_active(tmp_path, "home")
    assert not recovered.completed
    assert "it is left as it is" in recovered.damage
    assert path.read_bytes() == log.read_bytes()
    assert active_path(path).exists()


def test_a_log_that_is_being_written_is_left_alone(tmp_path):
    writer = LogWriter(tmp_path / "home_20260301T000000Z.mcap", topics_of("mic", ["a"], None), {})
    assert recover_active(tmp_path, "home") == []
    assert writer.finish().exists()


def test_logs_of_other_nodes_are_left_alone(log, tmp_path):
    path = left_behind(log, tmp_path, log.read_bytes()[:90_000])
    assert recover_active(tmp_path, "kitchen") == []
    assert active_path(path).exists()
    assert np.size(features(active_path(path))[0]) > 0
