"""A log is followed while it is written, across files, restarts and kills of the recorder."""

import os
import shutil
import signal
import subprocess
from contextlib import closing
from itertools import count
from threading import Event, Thread
from time import monotonic, sleep

import numpy as np
import pytest
from conftest import HEARTHLOG
from logs import features

from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.stream import stream_info
from hearthlog.schemas import files
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import read_time
from hearthlog.schemas.logs.columns import decode
from hearthlog.schemas.logs.files import find_logs, log_path
from hearthlog.schemas.logs.follow import FolderChanges, follow, follow_messages
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.mcap.raw_messages import in_order_of_time
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import Topic

pytestmark = pytest.mark.fast

TOPIC = "/mic/features"


class Followed(Thread):
    """What a follower gives, frame numbers and batches, gathered while the test goes on."""

    def __init__(self, folder, **options):
        super().__init__(daemon=True)
        self.folder = folder
        self.options = options
        self.frames = []
        self.stop = Event()
        self.start()

    def run(self):
        for batch in follow(self.folder, [TOPIC], stop=self.stop, **self.options):
            for columns in batch:
                self.frames += columns["frame"].tolist()

    def wait_for(self, frames):
        """Wait until all these frames were given, and give what was."""
        until = monotonic() + 120
        while len(self.frames) < len(frames) and monotonic() < until:
            sleep(0.02)
        return self.frames

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop.set()
        self.join()


class Told(Followed):
    """A follower that is told what is wrong, and goes on."""

    def run(self):
        self.reported = []
        options = {"stop": self.stop, "damaged": lambda error: self.reported.append(str(error))}
        for _, messages in follow_messages(self.folder, [TOPIC], **options, **self.options):
            for columns in decode(messages):
                self.frames += columns["frame"].tolist()


def log(folder, name):
    return LogWriter(folder / name, [Topic(TOPIC, message_types.FEATURES)], {})


def write(writer, first, count=20):
    times = np.arange(first, first + count)
    fields = {
        "header.stamp": times,
        "header.frame_id": "mic",
        "frame": times,
        "values": np.zeros((count, 3), np.float32),
    }
    writer.write_columns([TopicBatch(TOPIC, times, fields)])
    writer.flush()


def test_every_flush_arrives_also_in_the_next_file(tmp_path):
    with Followed(tmp_path, start=0) as followed:
        for number in range(3):
            writer = log(tmp_path / f"{number}", f"home_{number}.mcap")
            for block in range(5):
                write(writer, 100 * number + 20 * block)
                expected = list(range(100 * number + 20 * block + 20))
                assert followed.wait_for(expected) == expected
            writer.finish()


def test_a_log_that_is_finished_before_it_was_seen_is_read_too(tmp_path):
    with Followed(tmp_path, start=0) as followed:
        for number in range(20):
            writer = log(tmp_path, f"home_{number:02}.mcap")
            write(writer, 20 * number)
            writer.finish()
        assert sorted(followed.wait_for(range(400))) == list(range(400))


def test_a_sound_that_is_enrolled_is_no_news_of_the_home(tmp_path):
    with Followed(tmp_path, start=0) as followed:
        for number, folder in enumerate(("enrolled/2026", "logs", "enrolled/2025", "logs")):
            writer = log(tmp_path / folder, f"home_{number}.mcap")
            write(writer, 20 * number)
            writer.finish()
            if folder == "logs":
                followed.wait_for(range(10 * number + 10))
        assert followed.frames == [*range(20, 40), *range(60, 80)]


def test_without_a_start_only_what_is_written_from_now_on_is_given(tmp_path):
    old = log(tmp_path, "home_0.mcap")
    write(old, 0)
    old.finish()
    writer = log(tmp_path, "home_1.mcap")
    write(writer, 100)
    with Followed(tmp_path) as followed:
        sleep(0.5)
        write(writer, 200)
        assert followed.wait_for(range(20)) == list(range(200, 220))
    writer.abandon()


def test_what_was_recorded_before_comes_first_from_the_start_that_is_asked_for(tmp_path):
    for number in range(3):
        writer = log(tmp_path, f"home_{number}.mcap")
        write(writer, 20 * number)
        writer.finish()
    writer = log(tmp_path, "home_3.mcap")
    write(writer, 60)
    with Followed(tmp_path, start=25) as followed:
        assert followed.wait_for(range(55)) == list(range(25, 80))
        write(writer, 80)
        assert followed.wait_for(range(75)) == list(range(25, 100))
    writer.abandon()


def test_two_recorders_in_one_folder_are_followed_at_once(tmp_path):
    kitchen, bedroom = log(tmp_path, "kitchen.mcap"), log(tmp_path, "bedroom.mcap")
    with Followed(tmp_path, start=0) as followed:
        for block in range(4):
            write(kitchen, 20 * block)
            write(bedroom, 1000 + 20 * block)
        expected = [*range(80), *range(1000, 1080)]
        assert sorted(followed.wait_for(expected)) == expected
    kitchen.abandon()
    bedroom.abandon()


def test_a_record_that_is_half_written_is_waited_for(tmp_path):
    writer = log(tmp_path, "home.mcap")
    write(writer, 0)
    half = len(writer.active_path.read_bytes())
    write(writer, 20)
    data = writer.finish().read_bytes()
    other = tmp_path / "slow" / "home.mcap.active"
    other.parent.mkdir()
    with Followed(other.parent, start=0) as followed, other.open("wb") as stream:
        for first, last, known in ((0, 5, 0), (5, half + 30, 20), (half + 30, len(data), 40)):
            stream.write(data[first:last])
            stream.flush()
            assert followed.wait_for(range(known)) == list(range(known))
            sleep(0.3)
            assert len(followed.frames) == known


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(LogError, match="no such folder"):
        next(follow(tmp_path / "nowhere"))


def test_a_folder_that_is_removed_and_made_again_is_followed(tmp_path):
    writer = log(tmp_path / "2026", "home_0.mcap")
    with Followed(tmp_path, start=0) as followed:
        write(writer, 0)
        assert followed.wait_for(range(20)) == list(range(20))
        writer.finish()
        sleep(0.5)
        shutil.rmtree(tmp_path / "2026")
        sleep(0.5)
        writer = log(tmp_path / "2026", "home_1.mcap")
        write(writer, 20)
        assert followed.wait_for(range(40)) == list(range(40))
        writer.abandon()


def test_a_recorder_is_followed_through_files_and_through_being_killed(tmp_path, day):
    """Real processes; what was followed is, frame by frame, what is in the logs at the end."""
    logs = tmp_path / "logs"
    logs.mkdir()
    command = [*HEARTHLOG, "record", str(day), "--realtime", "-o", str(logs), "-d", "3"]
    with Followed(logs, start=0) as followed:
        for minute, end in (("00", signal.SIGKILL), ("10", signal.SIGKILL), ("20", signal.SIGTERM)):
            start = ["--start", f"2026-03-01T07:{minute}"]
            with subprocess.Popen([*command, *start], stderr=subprocess.DEVNULL) as recorder:
                followed.wait_for(range(len(followed.frames) + 100))
                recorder.send_signal(end)
        recorded = features(logs)[0].tolist()
        assert followed.wait_for(recorded) == recorded
    assert recorded.count(0) == 3
    assert len(find_logs(logs)) > 4
    assert not list(logs.rglob("*.active"))


def info(writer, time):
    message = stream_info("mic", f"device at {time}", DEFAULT, None)
    writer.write("/mic/info", time, message_types.encode(message))
    writer.flush()


def test_a_follower_that_comes_late_is_told_first_of_the_streams(tmp_path):
    topics = [Topic(TOPIC, message_types.FEATURES), Topic("/mic/info", message_types.STREAM_INFO)]
    writer = LogWriter(tmp_path / "home.mcap", topics, {})
    info(writer, 5)
    for block in range(50):
        write(writer, 10 + 20 * block)
    info(writer, 2000)
    both = ["device at 5", "device at 2000"]
    for start, devices in ((None, both), (2005, both), (600, both[:1])):
        _, first = next(follow_messages(tmp_path, start=start, infos=True))
        (columns,) = decode(first)
        assert columns.topic == "/mic/info"
        assert columns["device"].tolist() == devices
    writer.abandon()


def test_messages_of_several_channels_are_put_in_order_of_time(tmp_path):
    topics = [Topic(f"/{name}/features", message_types.FEATURES) for name in ("one", "two")]
    writer = LogWriter(tmp_path / "home.mcap", topics, {})
    for topic, first in ((topics[0], 0), (topics[1], 1)):
        times = np.arange(first, 200, 2)
        fields = {
            "header.stamp": times,
            "header.frame_id": "mic",
            "frame": times,
            "values": np.zeros((100, 3), np.float32),
        }
        writer.write_columns([TopicBatch(topic.name, times, fields)])
    writer.finish()
    (parts,) = iterate_messages(find_logs(tmp_path))
    ordered = list(in_order_of_time(parts))
    assert [int(part.log_times[row]) for part, row in ordered] == list(range(200))
    part, row = ordered[150]
    message = message_types.decode(part.payload(row), part.schema.name)
    assert message.frame == 150
    assert list(in_order_of_time([])) == []


def test_topics_may_be_chosen_by_what_tells_one(tmp_path):
    topics = [Topic(f"/{name}/features", message_types.FEATURES) for name in ("one", "two", "six")]
    finished = LogWriter(tmp_path / "home_0.mcap", topics, {})
    growing = LogWriter(tmp_path / "home_1.mcap", topics, {})
    for writer in (finished, growing):
        for topic in topics:
            fields = {
                "header.stamp": np.arange(1),
                "header.frame_id": "mic",
                "frame": np.arange(1),
                "values": np.zeros((1, 3), np.float32),
            }
            writer.write_columns([TopicBatch(topic.name, np.arange(1), fields)])
        writer.flush()
    finished.finish()
    followed = follow(tmp_path, lambda name: name.startswith("/t"), start=0)
    names = [[columns.topic for columns in next(followed)] for _ in range(2)]
    assert names == [["/two/features"]] * 2
    growing.abandon()


def test_while_nothing_is_written_there_are_ticks_and_only_then(tmp_path):
    writer = log(tmp_path, "home.mcap")
    write(writer, 0)
    followed = follow_messages(tmp_path, start=0, ticks=True)
    path, messages = next(followed)
    assert (path.name, len(messages)) == ("home.mcap.active", 1)
    for first in (20, 40):
        assert next(followed) == (tmp_path, [])
        write(writer, first)
        (columns,) = decode(next(followed)[1])
        assert columns["frame"].tolist() == list(range(first, first + 20))
    writer.abandon()
    followed.close()


def test_a_file_system_that_tells_of_no_change_is_looked_at_again_and_again(tmp_path, monkeypatch):
    def wait(_self, seconds, stop):
        stop.wait(seconds)
        return False

    monkeypatch.setattr(FolderChanges, "wait", wait)
    with Followed(tmp_path, start=0) as followed:
        for number in range(2):
            writer = log(tmp_path / f"{number}", f"home_{number}.mcap")
            for block in range(4):
                write(writer, 80 * number + 20 * block)
                expected = list(range(80 * number + 20 * block + 20))
                assert followed.wait_for(expected) == expected
            writer.finish()


def test_a_tick_comes_while_a_file_is_written_again_and_again(tmp_path):
    writer, stop = log(tmp_path, "home_0.mcap"), Event()

    def write_on():
        for first in count(0, 20):
            if stop.wait(0.02):
                return
            write(writer, first)

    thread = Thread(target=write_on)
    thread.start()
    ticks = 0
    for path, _ in follow_messages(tmp_path, start=0, stop=stop, ticks=True):
        ticks += path == tmp_path
        if ticks == 5:
            stop.set()
    thread.join()
    writer.abandon()
    assert ticks == 5


def test_the_folder_may_go_away_and_come_back(tmp_path):
    logs, away = tmp_path / "logs", tmp_path / "away"
    finished, writer = log(logs / "2026", "home_0.mcap"), log(logs / "2026", "home_1.mcap")
    write(finished, 0)
    finished.finish()
    write(writer, 20)
    with Told(logs, start=0) as followed:
        assert followed.wait_for(range(40)) == list(range(40))
        for first in (40, 100):
            logs.rename(away)
            sleep(2.5)
            write(writer, first)
            away.rename(logs)
            write(writer, first + 20)
            other = log(logs / "2026", f"home_{first}.mcap")
            write(other, first + 40)
            assert sorted(followed.wait_for(range(first + 60))) == list(range(first + 60))
            other.finish()
        assert followed.reported == [f"{logs}: the folder is gone; waiting for it"] * 2
    writer.abandon()


def test_a_folder_of_the_same_name_is_watched_anew(tmp_path):
    logs = tmp_path / "logs"
    with closing(FolderChanges()) as changes:
        for number in range(3):
            logs.mkdir()
            changes.watch([logs])
            while changes.wait(0.1, Event()):
                pass
            (logs / "home.mcap").touch()
            assert changes.wait(5, Event()) == changes.has_events
            logs.rename(tmp_path / f"{number}")


def test_a_folder_that_may_not_be_read_is_told_once_and_tried_again(tmp_path, monkeypatch):
    closed, is_open, scandir = tmp_path / "closed", Event(), os.scandir

    def refuse(folder):
        if folder == closed and not is_open.is_set():
            raise PermissionError(13, "Permission denied", str(folder))
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", refuse)
    writer = log(closed, "home_0.mcap")
    write(writer, 0)
    with Told(tmp_path, start=0) as followed:
        sleep(2.5)
        is_open.set()
        assert followed.wait_for(range(20)) == list(range(20))
        problem = "may not be read (Permission denied); let the user of this process read it"
        assert followed.reported == [f"{closed}: {problem}"]
    writer.abandon()


@pytest.mark.parametrize(("start", "first"), [(0, 0), (None, 20)])
def test_a_log_that_cannot_be_opened_is_told_once_and_tried_again(
    tmp_path, monkeypatch, start, first
):
    is_free, open_regular = Event(), files.open_regular

    def refuse(path):
        if not is_free.is_set():
            raise OSError(24, "Too many open files", str(path))
        return open_regular(path)

    monkeypatch.setattr(files, "open_regular", refuse)
    writer = log(tmp_path, "home_0.mcap")
    write(writer, 0)
    with Told(tmp_path, start=start) as followed:
        sleep(2.5)
        is_free.set()
        sleep(2.5)
        write(writer, 20)
        assert followed.wait_for(range(first, 40)) == list(range(first, 40))
        assert followed.reported == [f"{writer.active_path}: cannot be read (Too many open files)"]
    writer.abandon()


def test_a_log_that_vanishes_before_it_is_opened_is_passed_over(tmp_path, monkeypatch):
    def vanish(path):
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr(files, "open_regular", vanish)
    writer = log(tmp_path, "home_0.mcap")
    with Told(tmp_path, start=0) as followed:
        sleep(1)
        assert followed.reported == []
    writer.abandon()


def of_day(folder, day):
    start = read_time(f"{day}T12:00")
    path = log_path(folder, "home", start)
    writer = log(path.parent, path.name)
    write(writer, start)
    return writer.finish()


def test_old_logs_are_not_opened_and_after_each_other_one_the_caller_has_a_turn(
    tmp_path, monkeypatch
):
    old, *others = [of_day(tmp_path, f"2026-03-{day:02}") for day in (1, 4, 5, 6)]
    opened, open_regular = [], files.open_regular
    monkeypatch.setattr(
        files, "open_regular", lambda path: opened.append(path) or open_regular(path)
    )
    stop, turns = Event(), []
    start = read_time("2026-03-05")
    for path, messages in follow_messages(tmp_path, start=start, stop=stop, ticks=True):
        turns.append((path, len(messages)))
        if len(turns) == 3 or path == tmp_path:
            stop.set()
    assert turns == [(others[0], 0), (others[1], 1), (others[1], 0)]
    assert old not in opened
    assert others[2] not in opened


def test_who_follows_columns_is_given_no_empty_lists(tmp_path):
    for number in range(2):
        writer = log(tmp_path, f"home_{number}.mcap")
        write(writer, 20 * number)
        writer.finish()
    followed = follow(tmp_path, start=20)
    assert [columns.topic for columns in next(followed)] == [TOPIC]
    followed.close()
