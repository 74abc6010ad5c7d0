"""The recorder tells how its machine is: in the log, and on standard error when that changes."""

import numpy as np
import pytest
from logs import read
from test_capture import wait_for_frames
from test_pauses import recording

from hearthlog.recorder.events import OK, WARNING
from hearthlog.recorder.host import machine_health

THROTTLED = "devices/platform/soc/soc:firmware/get_throttled"
ZONE = "class/thermal/thermal_zone{}/temp"


@pytest.fixture
def sys(tmp_path):
    """A tree such as /sys of a small board."""

    def write(path, text):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
        return tmp_path

    write(ZONE.format(0), "51200\n")
    write(ZONE.format(1), "48000\n")
    write(THROTTLED, "0x0\n")
    return write


def test_the_hottest_part_counts(sys, tmp_path):
    health = machine_health(7, tmp_path, sys("version", "6"))
    assert (health.stamp, health.level, health.summary) == (7, OK, "well")
    assert health.values["temperature_celsius"] == "51.2"
    assert health.values["throttled"] == "0x0"
    assert health.values["clock_synchronized"] in {"yes", "no"}
    assert int(health.values["disk_free_bytes"]) > 0
    assert int(health.values["memory_bytes"]) > 1e6


@pytest.mark.parametrize(
    ("path", "text", "words"),
    [
        (THROTTLED, "0x50005\n", "the power supply is too weak"),
        (THROTTLED, "0x4\n", "the board is throttled"),
        (ZONE.format(1), "81900\n", "the machine is 82 degrees hot: improve its cooling"),
    ],
)
def test_what_is_wrong_with_the_machine_is_a_warning(sys, tmp_path, path, text, words):
    health = machine_health(7, tmp_path, sys(path, text))
    assert health.level == WARNING
    assert health.summary.startswith(words)


@pytest.mark.parametrize("text", ["", "hot", "\xff", "1" * 5000])
def test_what_the_machine_cannot_tell_is_left_out(sys, tmp_path, text):
    for zone in (0, 1):
        place = sys(ZONE.format(zone), text)
    health = machine_health(7, tmp_path, place)
    assert (health.level, "temperature_celsius" in health.values) == (OK, False)
    assert machine_health(7, tmp_path, tmp_path / "nothing").level == OK


def test_the_log_tells_of_the_machine_and_of_each_microphone(labmic, tmp_path):
    logs = tmp_path / "logs"
    noise = np.random.default_rng(0).normal(0.0, 3000.0, 16_000)
    labmic.configure(data=noise.astype(np.int16))
    with recording(labmic, logs):
        wait_for_frames(logs, 250)
    reported = [status for each in read(logs, "diagnostics") for status in each.status]
    machine = [each for each in reported if each.name == "hearthlog: home machine"]
    assert 1 <= len(machine) <= 3
    microphone = [each for each in reported if each.name == "hearthlog: mic"][-1]
    values = {pair.key: pair.value for pair in microphone.values}
    assert float(values["level_dbfs"]) <= float(values["peak_dbfs"]) <= 0.0
    assert values["overruns"] == "0"
    assert 0.0 <= float(values["block_age_seconds"]) < 60.0  # however busy the machine is
    assert values["device"] == "labmic"
