"""A log that was recorded live gets its name when it was written anew in chunks of ten seconds."""

import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logreader import LogReader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from waiting import wait_for

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.recovery import LogFinisher, finish_log, recover_active
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.recording import record
from hearthlog.recorder.stream import EncodedMessage, stream_info
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.metadata import ROSBAG2_METADATA
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import Topic

HOUR = 3600 * NANOSECONDS
START = 490_000 * HOUR
FINISH = [sys.executable, "-m", "hearthlog.recorder.log.recovery"]


class Live:
    """Seconds of noise in blocks of half a second."""

    device = "test"

    def __init__(self, begin, seconds):
        self._begin, self._blocks = begin, 2 * seconds

    def events(self, _):
        random = np.random.default_rng(0)
        for block in range(self._blocks):
            numbers = np.arange(10 * block, 10 * block + 10)
            samples = random.normal(scale=0.1, size=(10, FRAME_SAMPLES)).astype(np.float32)
            yield Frames(10 * block, samples, self._begin + numbers * FRAME_NANOSECONDS)


def content(path):
    """Everything in a file but its chunks and indexes, in the order of the file."""
    found = []
    with path.open("rb") as stream:
        for item in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            found += breakup_chunk(item, validate_crc=True) if isinstance(item, Chunk) else [item]
    parts = {kind: [r for r in found if isinstance(r, kind)] for kind in (Message, Attachment)}
    parts[Metadata] = [r for r in found if isinstance(r, Metadata) and r.name != ROSBAG2_METADATA]
    parts[Schema] = {r.id: r for r in found if isinstance(r, Schema)}
    parts[Channel] = {r.id: r for r in found if isinstance(r, Channel)}
    return parts


def spans(path):
    with LogFile(path) as file:
        return (file.chunks["end"] - file.chunks["start"]) / NANOSECONDS


def complete(path, blocks, topics=2):
    """Write a log that is complete but not named; a chunk for each block of log times."""
    names = [Topic(f"/mic{number}/gap", message_types.GAP) for number in range(topics)]
    writer = LogWriter(path, names, {"node": "home"})
    for number, times in enumerate(blocks):
        for place, log_time in enumerate(times):
            data = np.random.default_rng([number, place]).bytes(40)
            writer.write(names[(number + place) % topics].name, log_time, data)
        writer.flush()
    writer.complete()
    return writer.active_path


@pytest.fixture(scope="module")
def live_hour(tmp_path_factory):
    """A complete log of twenty minutes in chunks of half a second, and its content."""
    folder = tmp_path_factory.mktemp("live")
    about = Settings(output=folder, model="none")
    info = stream_info("mic", "test", DEFAULT, None)
    held = []

    class Held(LogFinisher):
        def add(self, active):
            held.extend(active)

    log = RollingLog(describe_log(about, info, DEFAULT, None), 3600, 1.0, 5.0, finisher=Held())
    data = np.random.default_rng(0).bytes(1 << 16)
    for block in range(2400):
        stamp = START + block * NANOSECONDS // 2
        log.write([EncodedMessage(stamp, "/mic/features", data[block : block + 400])] * 10)
    log.finish()
    return held[0], content(held[0])


@settings(deadline=None, max_examples=60)
@given(st.lists(st.lists(st.integers(0, 40 * NANOSECONDS), min_size=1, max_size=5), max_size=30))
def test_all_messages_are_kept_in_their_order_whatever_their_times(tmp_path_factory, blocks):
    path = tmp_path_factory.mktemp("log") / "home_20260301T000000Z.mcap"
    active = complete(path, [[START], *([START + time for time in block] for block in blocks)])
    before, chunks = content(active), len(blocks) + 1
    finish_log(active)
    assert content(path) == before
    assert not active.exists()
    assert len(spans(path)) <= chunks
    indexed = [(message.log_time, message.data) for message in LogReader(path).messages()]
    assert indexed == [(message.log_time, message.data) for message in before[Message]]


def test_a_log_that_was_recorded_live_has_chunks_of_ten_seconds(tmp_path):
    about = Settings(output=tmp_path, model="none")
    logs = record(about, Live(START + HOUR - 25 * NANOSECONDS, 60), Flag()).logs
    assert find_logs(tmp_path) == logs
    for log, seconds in zip(logs, (25, 35), strict=True):
        assert spans(log).max() <= 10
        assert len(spans(log)) == np.ceil(seconds / 10)
    assert not any(counts for counts in (each.counts for each in examine(tmp_path)))


def test_while_it_is_recorded_a_log_has_chunks_of_half_a_second(live_hour):
    assert spans(live_hour[0]).max() <= 1


@pytest.mark.parametrize("seed", range(8))
def test_killed_at_any_moment_a_rewriting_loses_nothing(live_hour, tmp_path, seed):
    active, expected = live_hour
    copy = shutil.copy(active, tmp_path / active.name)
    with subprocess.Popen([*FINISH, copy], stdin=subprocess.PIPE) as process:
        time.sleep(random.Random(seed).uniform(0.1, 1.0))
        process.send_signal(signal.SIGKILL)
    (left,) = find_logs(tmp_path)  # one at any moment
    assert content(left) == expected
    recover_active(tmp_path, "home")
    (log,) = tmp_path.iterdir()
    assert log.name == "home_" + log.name.removeprefix("home_")
    assert log.suffix == ".mcap"
    assert content(log) == expected
    assert len(spans(log)) == 120


def test_a_rewriting_ends_with_the_recorder_and_the_next_start_does_it(live_hour, tmp_path):
    active, expected = live_hour
    copy = shutil.copy(active, tmp_path / active.name)
    code = (
        "import os, sys; from pathlib import Path\n"
        "from hearthlog.recorder.log.recovery import LogFinisher\n"
        "finisher = LogFinisher(); finisher.add([Path(sys.argv[1])])\n"
        "print(finisher._processes[0].pid, flush=True); os.kill(os.getpid(), 9)"
    )
    recorder = subprocess.run(
        [sys.executable, "-c", code, copy], check=False, capture_output=True, text=True
    )
    state = Path(f"/proc/{int(recorder.stdout)}/stat")
    while state.exists() and ") Z " not in state.read_text():
        time.sleep(0.01)
    (recovered,) = recover_active(tmp_path, "home")
    assert content(recovered.path) == expected


def test_without_memory_for_a_thread_a_log_gets_its_name_when_the_recorder_ends(
    live_hour, tmp_path, monkeypatch
):
    copy = Path(shutil.copy(live_hour[0], tmp_path / live_hour[0].name))

    def refuse(_):
        raise RuntimeError("can't start new thread")

    finisher = LogFinisher()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        finisher.add([copy])
    finisher.close()
    (log,) = tmp_path.iterdir()
    assert log.suffix == ".mcap"


def test_without_room_for_a_copy_a_log_gets_its_name_as_it_is(live_hour, tmp_path):
    active, _ = live_hour
    copy = shutil.copy(active, tmp_path / active.name)
    code = (
        "import resource, runpy; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "runpy.run_module('hearthlog.recorder.log.recovery', run_name='__main__')"
    )
    with subprocess.Popen([sys.executable, "-c", code, copy], stdin=subprocess.PIPE) as process:
        assert process.wait() == 0
    (log,) = tmp_path.iterdir()
    assert log.suffix == ".mcap"
    assert log.read_bytes() == active.read_bytes()


def test_what_a_process_left_is_done_by_the_next_one(live_hour, tmp_path):
    first = shutil.copy(live_hour[0], tmp_path / live_hour[0].name)
    finisher = LogFinisher()
    finisher.add([first])
    finisher._processes[0].kill()
    second = complete(tmp_path / "home_20260301T000000Z.mcap", [[START]])
    finisher.add([second])
    finisher.close()
    assert [path.suffix for path in find_logs(tmp_path)] == [".mcap", ".mcap"]


def test_a_rewriting_that_has_ended_leaves_no_process(live_hour, tmp_path):
    finisher = LogFinisher()
    finisher.add([shutil.copy(live_hour[0], tmp_path / live_hour[0].name)])
    process = Path(f"/proc/{finisher._processes[0].pid}")
    wait_for(lambda: not process.exists())
    assert [path.suffix for path in find_logs(tmp_path)] == [".mcap"]
    finisher.close()
