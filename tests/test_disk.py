"""A disk that is full, fails or goes away never ends a recorder, and costs no more than it must."""

import errno
import os
import select
import shutil
import signal
import subprocess
import time
from contextlib import closing, suppress
from queue import SimpleQueue

import numpy as np
import pytest
from conftest import HEARTHLOG
from logs import features, read
from test_capture import recording, sound, wait_for_frames
from waiting import wait_for

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch
from hearthlog.recorder.log import rolling_log
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.recorder.recording_session import RecordingSession
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages.message_types import nanoseconds

START = 490_000 * 3600 * NANOSECONDS
BLOCK = 12  # frames


class Nowhere:
    device = "test"


def record(settings, before_block, blocks=100):
    """Record a minute of noise in blocks; before each one something may happen."""
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 0.1, (BLOCK, FRAME_SAMPLES)).astype(np.float32)
    with closing(ModelWatch(settings.model, SimpleQueue())) as watch:
        session = RecordingSession(settings, {"mic": Nowhere()}, {"mic": LabellingModels(watch)})
        for number in range(blocks):
            before_block(number)
            first = number * BLOCK
            stamps = START + (first + np.arange(BLOCK)) * FRAME_NANOSECONDS
            session.add("mic", Frames(first, noise, stamps))
        session.finish()


@pytest.fixture
def settings(tmp_path, model_file):
    return Settings(output=tmp_path / "logs", model=model_file, sync_seconds=1.0)  # of work


@pytest.fixture
def at_once(monkeypatch):
    monkeypatch.setattr(rolling_log, "_RETRY_SECONDS", 0.0)


def errors(folder):
    found = [str(one) for each in examine(folder) for one in each.shown]
    return [line for line in found if line.startswith("error")]


def is_every_frame_there(folder, count):
    frames, _, _ = features(folder)
    return sorted(frames.tolist()) == list(range(count))


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("operation", ["flush", "sync", "complete"])
def test_a_disk_that_fails_for_a_while_loses_nothing(settings, monkeypatch, operation):
    failing = False
    good = getattr(LogWriter, operation)

    def act(self):
        if failing:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return good(self)

    def before(number):
        nonlocal failing
        failing = 30 <= number < 60

    monkeypatch.setattr(LogWriter, operation, act)
    settings = settings.model_copy(update={"max_bag_duration": 7})
    record(settings, before)
    assert is_every_frame_there(settings.output, 100 * BLOCK)
    assert not errors(settings.output)
    assert not list(settings.output.rglob("*.active"))
    # Once, or anew at each file that could not be completed.
    output = [m.msg for m in read(settings.output, "rosout") if "held in memory" in m.msg]
    assert output
    assert all("Input/output error" in line for line in output)


@pytest.mark.usefixtures("at_once")
def test_a_folder_that_is_deleted_is_made_again_at_the_next_sync(settings):
    def before(number):
        if number == 50:
            time.sleep(0.2)
            shutil.rmtree(settings.output)

    record(settings, before)
    frames, _, _ = features(settings.output)
    assert frames[-1] == 100 * BLOCK - 1
    assert frames[0] < 80 * BLOCK
    assert not errors(settings.output)
    assert any("deleted or moved away" in m.msg for m in read(settings.output, "rosout"))


@pytest.mark.usefixtures("at_once")
def test_what_the_memory_cannot_hold_is_a_gap(settings, monkeypatch):
    monkeypatch.setattr(rolling_log, "_HELD_BYTES", 100_000)
    failing = False
    good = LogWriter.flush

    def flush(self):
        if failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        good(self)

    def before(number):
        nonlocal failing
        failing = 20 <= number < 90

    monkeypatch.setattr(LogWriter, "flush", flush)
    record(settings, before)
    frames, stamps, _ = features(settings.output)
    (gap,) = read(settings.output, "gap")
    assert gap.reason == "the disk took no more"
    (jump,) = np.flatnonzero(np.diff(frames) > 1)
    assert gap.frames_lost == frames[jump + 1] - frames[jump] - 1
    assert nanoseconds(gap.header.stamp) == stamps[jump] + FRAME_NANOSECONDS
    assert len(frames) + gap.frames_lost == 100 * BLOCK
    assert frames[jump] > 21 * BLOCK
    assert not errors(settings.output)


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 4 MB, in memory."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)]
    if os.geteuid() or subprocess.run(mounted, check=False, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("a disk is mounted by root only")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def wait_for_text(process, text, seconds=120):
    """Wait for a line on standard error."""
    deadline = time.monotonic() + seconds
    output = ""
    while time.monotonic() < deadline:
        if select.select([process.stderr], [], [], 0.5)[0]:
            output += os.read(process.stderr.fileno(), 65536).decode()
        if text in output:
            return
    pytest.fail(f"{text!r} was not said, but {output!r}")


def test_a_disk_that_was_full_is_written_again_when_there_is_room(labmic, small_disk):
    labmic.configure(data=sound())
    logs, filler = small_disk / "logs", small_disk / "filler"
    with recording(labmic, logs, "--model", "general") as process:
        wait_for_frames(logs, 60)
        with suppress(OSError):
            filler.write_bytes(b"\0" * 5_000_000)
        wait_for_text(process, "No space left on device")
        time.sleep(5)
        filler.unlink()
        wait_for_text(process, "can be written again")
        wait_for_frames(logs, 200)
    frames, _, _ = features(logs)
    assert frames.tolist() == list(range(len(frames)))
    assert not errors(logs)


def test_a_recorder_starts_on_a_full_disk_and_writes_when_there_is_room(labmic, small_disk):
    labmic.configure(data=sound())
    logs, filler = small_disk / "logs", small_disk / "filler"
    with suppress(OSError):
        filler.write_bytes(b"\0" * 5_000_000)
    with recording(labmic, logs) as process:
        wait_for_text(process, "No space left on device")
        filler.unlink()
        wait_for_text(process, "can be written again")
        wait_for_frames(logs, 60)
    frames, _, _ = features(logs)
    assert frames.tolist() == list(range(len(frames)))
    assert not errors(logs)


def test_a_second_recorder_of_a_folder_is_refused_with_the_number_of_the_first(
    labmic, hearthlog, tmp_path
):
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 20)
        second = hearthlog("record", "--device", labmic.device, "-o", logs, env=labmic.env)
        other = [*HEARTHLOG, "record", "--device", labmic.device, "--node", "other", "-o", logs]
        with subprocess.Popen(other, env=labmic.env) as third:
            wait_for(lambda: list(logs.rglob("other_*")))
            third.send_signal(signal.SIGTERM)
    assert second.returncode == 1
    assert f"is in use by the recorder 'home' already (process {process.pid})" in second.stderr
    assert process.returncode == 0, process.errors
    assert {path.name[:5] for path in logs.rglob("*.mcap")} == {"home_", "other"}


def test_a_folder_that_was_moved_away_and_made_again_is_locked_again(labmic, hearthlog, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 20)
        logs.rename(tmp_path / "away")
        wait_for_text(process, "can be written again")
        second = hearthlog("record", "--device", labmic.device, "-o", logs, env=labmic.env)
    assert second.returncode == 1
    assert f"is in use by the recorder 'home' already (process {process.pid})" in second.stderr


def test_a_folder_that_is_gone_at_the_end_is_no_failure(tmp_path):
    with FolderLock(tmp_path / "logs", "home"):
        shutil.rmtree(tmp_path / "logs")
    assert not (tmp_path / "logs").exists()


def test_the_disk_behind_a_link_is_the_one_that_must_be_mounted(small_disk, tmp_path):
    (tmp_path / "link").symlink_to(small_disk)
    assert rolling_log._mount_of(tmp_path / "link" / "logs") == small_disk
