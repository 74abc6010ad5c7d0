"""A day or a night that is judged by weeks of logs while what was heard last goes on."""

import time
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from livehome import MINUTE, LiveHome, following, rule

from hearthlog.analyzer.bridge.alerts.output import AlertsOutput, RuleProgressStore
from hearthlog.analyzer.bridge.alerts.rules import RuleState
from hearthlog.analyzer.bridge.settings import DeliverySettings, RecorderAddress
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.models.features.auros21 import FEATURE_NAMES
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import log_path
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages.topics import topics_of

HOUR = 60 * MINUTE
NIGHTS, SOUNDS = 10, 5


def write_nights(root, classes, evening):
    """Write days with five sounds each, up to the last evening, from which on it is silent."""
    topics = topics_of("mic", FEATURE_NAMES, classes)
    for night in range(NIGHTS, 0, -1):
        begin = evening - night * 24 * HOUR
        sounds = begin + HOUR * np.arange(1, SOUNDS + 1)
        starts = np.sort(np.concatenate([[begin], sounds, sounds + 30 * NANOSECONDS]))
        ends = np.append(starts[1:], begin + 24 * HOUR)
        fields = {
            "header.stamp": starts,
            "header.frame_id": "mic",
            "duration": ends - starts,
            "label": ["silence", *["speech", "silence"] * SOUNDS],
            "confidence": np.full(len(starts), 0.9, np.float32),
        }
        path = log_path(root, "home", int(begin))
        writer = LogWriter(path, topics, {"version": "0", "node": "home"})
        writer.write_columns([TopicBatch("/mic/segment", ends, fields)])
        writer.finish()


@pytest.mark.parametrize("part", ["night", "day"])
def test_a_silence_that_goes_on_when_it_is_judged_was_heard(part, tmp_path):
    """At 8:00 nothing was heard since 22:00, or since 12:00 of the day before."""
    now = time.time_ns()
    clock = datetime.now(UTC)
    zone = timezone(timedelta(minutes=8 * 60 + 10 - clock.hour * 60 - clock.minute))
    silent_since = now - (10 if part == "night" else 20) * HOUR - 10 * MINUTE
    quiet = rule("unlike_usual", "quiet", part=part, which="less")
    state, reported, output = BridgeState(tmp_path / "state", "home", pytest.fail), [], []
    until = now - 20 * MINUTE
    progress = {"quiet": RuleState(since=until, until=until)}
    RuleProgressStore(state, pytest.fail).save([quiet], progress)
    home = LiveHome(tmp_path / "logs")
    write_nights(home.folder, home.classes, silent_since)

    def send(*ring):
        reported.append(ring)
        return True

    try:
        place = RecorderAddress(home.folder, "home", zone)
        own = AlertsOutput([quiet], DeliverySettings(), place, state, output.append, send)
        end = time.monotonic() + 120
        with following(place, {"alerts": own}, output):
            while not reported and time.monotonic() < end:
                home.hears("silence")
                time.sleep(0.2)
    finally:
        home.close()
    assert output == []
    ((name, text, _),) = reported
    assert name == "quiet"
    assert ": 0 times, usually 5" in text
