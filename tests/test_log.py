"""The log rolls with the clock, and what was written is on the disk soon enough."""

from threading import Event as Flag

import numpy as np
import pytest
from logreader import LogReader
from logs import features

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.log.description import LogDescription, describe_log
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.recording import record
from hearthlog.recorder.stream import stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import nanoseconds

pytestmark = pytest.mark.fast

HOUR = 3600 * NANOSECONDS
START = 490_000 * HOUR
VALUES = np.random.default_rng(0).random((2000, DEFAULT.width)).astype(np.float32)


class Nowhere:
    device = "test"


class ClockSetBack:
    """Thirty seconds over a full hour; then the clock is set back, and sound goes on."""

    device = "test"

    def __init__(self, begin, seconds):
        self._begin, self._seconds = begin, seconds

    def events(self, _):
        stamps = self._begin + np.arange(1201) * FRAME_NANOSECONDS
        silence = np.zeros((600, FRAME_SAMPLES), np.float32)
        yield Frames(0, silence, stamps[:600])
        back = stamps[601:] - self._seconds * NANOSECONDS
        yield Gap(int(stamps[600]), int(back[0]), "the clock was set", 1)
        again = np.arange(1200) * FRAME_NANOSECONDS + back[0]
        for half in (slice(0, 600), slice(600, 1200)):
            yield Frames(601 + half.start, silence, again[half])


@pytest.fixture
def description(tmp_path) -> LogDescription:
    info = stream_info("mic", "test", DEFAULT, None)
    return describe_log(Settings(output=tmp_path), info, DEFAULT, None)


def records(first, count, start):
    stamps = start + np.arange(count) * FRAME_NANOSECONDS
    return Pipeline("mic", DEFAULT).push_features(VALUES[:count], first, stamps)


def test_files_begin_at_multiples_of_their_duration(description, tmp_path):
    log = RollingLog(description, 60, 1.0, 5.0)
    log.write(records(0, 2000, START + 50 * NANOSECONDS))
    log.finish()
    names = [path.name.partition("T")[2] for path in find_logs(tmp_path)]
    assert names == ["160050Z.mcap", "160100Z.mcap", "160200Z.mcap"]
    np.testing.assert_array_equal(features(tmp_path)[0], np.arange(2000))


def test_where_time_runs_backwards_another_file_begins(description):
    log = RollingLog(description, 3600, 1.0, 5.0)
    log.write(records(0, 40, START + 100 * NANOSECONDS))
    log.write(records(40, 40, START + 10 * NANOSECONDS))
    log.finish()
    late, early = log.finished
    assert features(late)[0].tolist() == list(range(40))
    assert features(early)[0].tolist() == list(range(40, 80))


@pytest.mark.parametrize(
    ("back", "names"),
    [
        (30, ["165940Z", "165940Z_2", "170000Z", "170000Z_2"]),
        (3600, ["160010Z", "165940Z", "170000Z"]),
    ],
)
def test_a_clock_that_is_set_back_over_a_full_hour_ends_nothing(tmp_path, back, names):
    source = ClockSetBack(START + HOUR - 20 * NANOSECONDS, back)
    settings = Settings(output=tmp_path)
    logs = record(settings, source, Flag()).logs
    assert sorted(path.stem.partition("T")[2] for path in logs) == names
    numbers = np.concatenate([features(log)[0] for log in logs])
    np.testing.assert_array_equal(numbers, np.delete(np.arange(1801), 600))
    assert {level for each in examine(tmp_path) for level, _ in each.counts} <= {"warning"}
    assert {log.node for log in find_home_logs([tmp_path]).entries} == {settings.node}


@pytest.mark.parametrize("block", [12, 200])
def test_every_block_is_written_when_it_comes(description, tmp_path, block):
    log = RollingLog(description, 3600, 1.0, 5.0)
    for first in range(0, 600, block):
        log.write(records(first, block, START + first * FRAME_NANOSECONDS))
        assert len(features(tmp_path)[0]) == first + block
    log.finish()


def test_blocks_wait_for_others_if_more_may_be_lost(description, tmp_path):
    log = RollingLog(description, 3600, 5.0, 60.0)
    behind = []
    for first in range(0, 600, 12):
        log.write(records(first, 12, START + first * FRAME_NANOSECONDS))
        behind.append(first + 12 - len(features(tmp_path)[0]))
    log.finish()
    assert 3.5 * 20 < max(behind) < 4.1 * 20


def test_a_file_says_what_it_is_from_its_first_message_on(description, tmp_path):
    log = RollingLog(description, 3600, 1.0, 5.0)
    log.write(records(0, 1, START))
    (active,) = tmp_path.rglob("*.active")
    topics = [item.topic for item in LogReader(active).messages()]
    log.finish()
    assert topics == ["/mic/info", "/rosout"]


def test_every_file_says_in_words_what_is_recorded(description):
    log = RollingLog(description, 60, 1.0, 5.0)
    log.write(records(0, 2000, START + 50 * NANOSECONDS))
    log.finish()
    for path in log.finished:
        (first,) = LogReader(path).messages(["/rosout"])
        output = first.decode()
        assert first.log_time == nanoseconds(output.stamp) == features(path)[1][0]
        assert (output.level, output.name) == (output.INFO, "hearthlog.mic")
        assert output.msg == "recording test: no model, no labels"


def test_another_file_begins_where_one_has_grown_large(description, tmp_path):
    log = RollingLog(description, 3600, 1.0, 5.0, file_bytes=60_000)
    for first in range(0, 2000, 10):
        log.write(records(first, 10, START + first * FRAME_NANOSECONDS))
    log.finish()
    assert len(log.finished) > 3
    sizes = [path.stat().st_size for path in log.finished[:-1]]
    assert 60_000 < min(sizes) < max(sizes) < 90_000  # with their indexes
    np.testing.assert_array_equal(features(tmp_path)[0], np.arange(2000))


def test_files_are_not_so_small_that_two_begin_in_a_second(tmp_path, hearthlog):
    result = hearthlog("record", "-o", tmp_path, "--max-bag-size", "900k")
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1)
    assert "max_bag_size: at least 1M" in result.stderr
