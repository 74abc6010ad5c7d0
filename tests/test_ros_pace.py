"""Messages that are written in blocks are published evenly."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "ros" / "hearthlog_ros"))
from hearthlog_ros.pace import PublicationDelay

pytestmark = pytest.mark.fast

MS = 1_000_000
START = 1_800_000_000_000_000_000


def published(delay, lateness):
    """When each message of blocks of twelve is published, after its log time, in ms.

    `lateness` is how long after its last message each block comes.
    """
    pace = PublicationDelay(delay * MS)
    delays, now = [], 0
    for block, late in enumerate(lateness):
        times = START + (600 * block + 50 * np.arange(12)) * MS
        now = max(now, int(times[-1]) + int(late) * MS)
        pace.add_block(int(times[0]), now)
        for time in times.tolist():
            now += pace.wait(time, now)
            delays.append((now - time) / MS)
    return np.array(delays)


def test_blocks_that_come_in_time_are_even():
    rng = np.random.default_rng(0)
    assert set(published(1200, rng.uniform(50, 600, 500))) == {1200}


def test_messages_that_are_wanted_at_once_do_not_wait():
    delays = published(0, [100] * 50).reshape(50, 12)
    assert (delays[:, -1] == 100).all()
    assert (delays[:, 0] == 650).all()


def test_blocks_that_always_come_late_become_even_at_their_own_delay():
    rng = np.random.default_rng(0)
    delays = published(1200, rng.uniform(2000, 2300, 1000))
    later = delays[len(delays) // 2 :]
    assert np.diff(later).min() > -10  # after the one before it: no two at once
    assert later.max() < 2300 + 550 + 50


def test_a_delay_that_was_needed_once_is_given_back_without_a_burst():
    lateness = [300.0] * 20 + [3300.0] + [300.0] * 1500
    delays = published(1200, lateness)
    assert delays.max() == pytest.approx(3850)
    assert set(delays[-500:]) == {1200}
    assert np.diff(delays).min() >= -2  # after the one before it: 48 ms


def test_a_log_of_another_clock_is_not_waited_for():
    assert PublicationDelay(1200 * MS).wait(START, START + 86_400_000 * MS) == 0
    assert PublicationDelay(1200 * MS).wait(START + 86_400_000 * MS, START) == 0
