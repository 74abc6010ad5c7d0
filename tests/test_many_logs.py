"""What looks through all logs of a home holds little of each."""

import tracemalloc

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from conversations import START, record_conversation, two_voices

from hearthlog.analyzer.discover.sounds import ALL, discover, read_sounds
from hearthlog.analyzer.discover.speech import find_voices, read_speech
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.models.features.installed import DEFAULT
from hearthlog.tools.lab.home.copies import copy_logs

SECONDS, FEW, MANY = 60, 4, 16
FEATURES = SECONDS * 20 * DEFAULT.width * 4  # bytes of a log


def count_voices(logs):
    speech = read_speech(find_home_logs([logs]))
    voices, _ = find_voices(speech, None)
    return len(speech.logs), len(voices.numbers)


def count_groups(logs):
    with read_sounds(find_home_logs([logs]), ALL) as sounds:
        groups, _, _ = discover(sounds, None)
        return len(sounds.logs), len(groups.numbers)


@pytest.fixture(scope="module")
def homes(tmp_path_factory):
    """Logs of a minute in which two people talk: some of them, and four times as many."""
    folder = tmp_path_factory.mktemp("homes")
    logs, _ = record_conversation(two_voices(folder), folder, START, 1, SECONDS)
    for count in (FEW, MANY):
        copy_logs(logs, folder / str(count), count)
    return folder


@pytest.mark.parametrize("look", [count_voices, count_groups])
def test_a_further_log_takes_less_memory_than_a_quarter_of_its_features(homes, look):
    look(homes / str(FEW))  # what is loaded once
    peaks = []
    for count in (FEW, MANY):
        tracemalloc.start()
        read, found = look(homes / str(count))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert read == count
        assert found
    assert peaks[1] - peaks[0] < (MANY - FEW) * FEATURES / 4
