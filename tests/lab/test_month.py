"""A recorder on a fast clock, with faults thrown in, and the coverage of its logs."""

import re
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.month", reason="the wheel leaves the simulated month out")

from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Gap
from hearthlog.recorder.log.description import describe_log
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream import stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.lab.month.faults import KINDS, plan_faults
from hearthlog.tools.lab.month.log_coverage import holes, read_log_coverage

START = 1_772_348_390 * NANOSECONDS  # ten seconds before a full hour


def test_a_day_with_a_fault_of_each_kind_loses_nothing_that_is_not_in_a_gap(tmp_path):
    command = [sys.executable, "-m", "hearthlog.tools.lab.month", str(tmp_path / "month")]
    command += ["--days", "0.12", "--faults", "25"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 holes that are in no gap, 0 errors of the doctor" in done.stdout
    assert re.search(r"^power cut: \d times, lost at most", done.stdout, re.MULTILINE)


@pytest.fixture
def logs(tmp_path):
    """Three logs: ten seconds of frames, a gap of five, and frames over a full hour."""
    info = stream_info("mic", "test", DEFAULT, None)
    about = describe_log(Settings(output=tmp_path), info, DEFAULT, None)
    log, pipeline = RollingLog(about, 5, 1.0, 5.0), Pipeline("mic", DEFAULT)
    values = np.zeros((100, DEFAULT.width), np.float32)
    stamps = START + np.arange(100) * FRAME_NANOSECONDS
    log.write(pipeline.push_features(values, 0, stamps))
    end, begin = int(stamps[-1]) + FRAME_NANOSECONDS, START + 10 * NANOSECONDS
    log.write(pipeline.push(Gap(end, begin, "the microphone went silent", 100)))
    log.write(pipeline.push_features(values, 200, stamps + 10 * NANOSECONDS))
    log.write(pipeline.push_features(values, 300, stamps + 15 * NANOSECONDS))
    log.finish()
    return find_logs(tmp_path)


def test_time_in_a_gap_is_no_hole(logs):
    coverages = [read_log_coverage(log) for log in logs]
    assert sum(coverage.frames for coverage in coverages) == 300
    assert not holes(coverages)


def test_a_log_that_is_missing_is_a_hole(logs):
    first, _, last = [read_log_coverage(log) for log in logs]
    assert holes([first, last]) == [f"{last.path.name}: 10.000 s before frames"]


def test_the_same_seed_makes_the_same_month_and_no_fault_begins_in_another():
    faults = plan_faults(30.0, 200, 7)
    assert faults == plan_faults(30.0, 200, 7) != plan_faults(30.0, 200, 8)
    assert len(faults) == 200
    assert len({fault.kind for fault in faults}) == len(KINDS)
    lasting = [fault for fault in faults if fault.kind != "clock set"]
    assert all(one.end < other.start for one, other in pairwise(lasting))
    assert faults[-1].end < 30 * 86_400 * NANOSECONDS
