"""Old logs are deleted as configured, the oldest first, and never what somebody still needs."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from itertools import count
from threading import Event as Flag

import numpy as np
import pytest
from log_fixtures import small_disk
from logs import read

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, write_marks
from hearthlog.recorder.config import Settings
from hearthlog.recorder.disk_keeper import DiskKeeper, keep_disk
from hearthlog.recorder.events import Frames
from hearthlog.recorder.host import Disk
from hearthlog.recorder.recording import record
from hearthlog.recorder.retention import (
    KeepingRules,
    Limits,
    RecordedDays,
    plan_retention,
    recorded_logs,
)
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS
from hearthlog.schemas.logs.files import active_path, find_logs, log_path

DAY = 86_400 * NANOSECONDS
HOUR = 3600 * NANOSECONDS
START = int(datetime(2026, 3, 1, 8, tzinfo=UTC).timestamp()) * NANOSECONDS
EVERYTHING = "would delete all but the newest"


class Sound:
    """Quiet seconds from a time on, in blocks, until something is so."""

    device = "test"

    def __init__(self, begin, enough):
        self._begin, self._enough = begin, enough

    def events(self, _):
        for block in range(1200):
            numbers = np.arange(10 * block, 10 * block + 10)
            samples = np.full((10, FRAME_SAMPLES), 1e-3, np.float32)
            yield Frames(10 * block, samples, self._begin + numbers * FRAME_NANOSECONDS)
            if block >= 4 and self._enough():
                return
            time.sleep(0.02)
        raise AssertionError("nothing came of it")


def recorded(root, begin=START, **changes):
    """Record two seconds at a time."""
    about = Settings(output=root, model="none", min_free_space=0, **changes)
    (log,) = record(about, Sound(begin, lambda: True), Flag()).logs
    return log


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """A log of two seconds."""
    return recorded(tmp_path_factory.mktemp("one"))


@pytest.fixture
def logs(one, tmp_path):
    """Five days with three logs each, the oldest first."""
    paths = [
        log_path(tmp_path / "logs", "home", START + day * DAY + hour * HOUR)
        for day in range(5)
        for hour in range(3)
    ]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(one, path)
    return paths


def left(logs):
    return [path for path in logs if path.exists()]


def keep(logs, *, node="home", **limits):
    return keep_disk(KeepingRules(str(logs[0].parents[3]), node, Limits(**limits)))


def reviewed(log, *, empty=False):
    marks = [] if empty else [Mark("mic", START, START + NANOSECONDS, "speech")]
    write_marks(log, marks, [] if empty else [ReviewedSpan("mic", START, START + NANOSECONDS)])


def size(log):
    return log.stat().st_blocks * 512


def free(folder):
    return shutil.disk_usage(folder).free


@pytest.mark.parametrize(
    ("limit", "gone"),
    [("days", 6), ("files", 5), ("size", 4)],
)
def test_the_oldest_logs_go_as_each_limit_asks(logs, limit, gone):
    limits = {
        "days": lambda: 3,
        "files": lambda: 10,
        "size": lambda: 11 * size(logs[0]),
    }
    report = keep(logs, **{limit: limits[limit]()})
    assert left(logs) == logs[gone:]
    assert report.done.startswith(f"{gone} logs deleted")
    assert not report.problem
    assert not any(path.parent.exists() for path in logs[: gone // 3 * 3])
    assert int(report.values["logs"]) == 15 - gone


def test_without_a_limit_nothing_goes(logs):
    report = keep(logs)
    assert (report.done, report.problem, report.values["deleted_logs"]) == ("", "", "0")
    assert not keep(logs).done
    assert left(logs) == logs


def test_layers_go_with_their_log_and_stay_with_those_that_stay(logs):
    for log in (logs[0], logs[5]):
        for layer in ("audio", "relabel-home-1"):
            shutil.copy(log, log.with_name(f"{log.stem}.{layer}.mcap"))
        reviewed(log, empty=True)
    keep(logs, files=14)
    assert left(logs) == logs[1:]
    assert not [path for path in logs[0].parent.iterdir() if path.name.startswith(logs[0].stem)]
    assert len(list(logs[5].parent.glob(f"{logs[5].stem}*"))) == 3


def spoil(path):
    path.write_bytes(b"no log at all")


def lock(path):
    path.with_name(path.name + ".keep").touch()


@pytest.mark.parametrize("protect", [reviewed, lock, spoil])
def test_what_is_reviewed_locked_or_no_log_is_never_deleted(logs, protect):
    protect(logs[1])
    report = keep(logs, files=3)
    assert left(logs) == [logs[1], *logs[13:]]
    assert report.values["kept_logs"] == "1"


def test_a_review_layer_that_cannot_be_read_protects_its_log(logs):
    logs[0].with_name(f"{logs[0].stem}.review.mcap").write_bytes(b"?")
    keep(logs, files=12)
    assert left(logs) == [logs[0], *logs[4:]]


def test_what_is_not_a_finished_log_of_this_node_is_not_touched(logs, tmp_path):
    folder, elsewhere = logs[0].parent, tmp_path / "elsewhere" / "01"
    shutil.copytree(folder, elsewhere)
    others = [
        active_path(folder / "home_20260301T010000Z.mcap"),
        folder / "home_20260301T020000Z.mcap.damaged",
        folder / "home_20260301T030000Z.mcap.recovering",
        folder / "attic_20260301T010000Z.mcap",
        folder / "home_2_20260301T010000Z.mcap",
        folder / "home_20269901T010000Z.mcap",
        folder / "recording.mcap",
        folder / "enrolled" / logs[0].name,
    ]
    others[-1].parent.mkdir()
    for path in others:
        shutil.copy(logs[0], path)
    link = folder / "home_20260301T040000Z.mcap"
    link.symlink_to(elsewhere / logs[0].name)
    (folder.parents[1] / "02").symlink_to(elsewhere.parent)
    keep(logs, files=1, days=1)
    keep(logs, files=2)
    assert left(logs) == logs[-2:]
    assert all(path.exists() for path in [*others, link, *elsewhere.iterdir()])


@pytest.mark.parametrize("ahead", [60, 3000])
def test_a_clock_that_is_ahead_deletes_nothing_for_its_age(logs, ahead):
    recorded(logs[0].parents[3], START + ahead * DAY)
    keep(logs, days=6)
    assert left(logs) == logs


def test_what_was_recorded_without_a_clock_is_not_the_oldest(logs):
    unset = recorded(logs[0].parents[3], 5 * HOUR)
    assert unset.name.startswith("home_1970")
    keep(logs, files=10)
    assert left(logs) == logs[6:]
    assert unset.exists()


def test_a_floor_that_no_disk_has_deletes_nothing_and_is_said(logs):
    report = keep(logs, free=1 << 60)
    assert left(logs) == logs
    assert report.problem.startswith("min_free_space: the disk has only")


@pytest.mark.parametrize(("missing", "gone"), [(-1, 0), (0, 0), (2.5, 3), (14, 14), (15, 0)])
def test_only_as_many_logs_go_for_the_floor_as_it_takes_and_none_in_vain(logs, missing, gone):
    found = recorded_logs(logs[0].parents[3], "home", [])
    disk = Disk(1000 * size(logs[0]), 20 * size(logs[0]))
    limits = Limits(free=disk.free + int(missing * size(logs[0])))
    plan = plan_retention(found, RecordedDays([]), limits, disk)
    assert [log.path for log, _ in plan.deletions] == logs[:gone]
    assert ["without all older logs less than" in each for each in plan.problems] == (
        [True] if missing == 15 else []
    )


def test_limits_that_would_leave_only_the_newest_log_are_not_followed_but_said(logs, hearthlog):
    report = keep(logs, files=1)
    assert left(logs) == logs
    assert EVERYTHING in report.problem
    result = hearthlog("retain", "-o", logs[0].parents[3], "--max-bag-files", 1)
    assert result.returncode == 0
    assert left(logs) == logs[-1:]


def test_a_dry_run_says_what_would_go_and_why_and_deletes_nothing(logs, hearthlog):
    reviewed(logs[0])
    folder = logs[0].parents[3]
    command = ["retain", "-o", folder, "--retention-days", 4, "--min-free-space", 0]
    result = hearthlog(*command, "--dry-run")
    assert result.returncode == 0
    output = result.stdout.splitlines()
    assert [line.partition(":")[0] for line in output] == [
        str(log) for log in (*logs[1:3], logs[0])
    ]
    assert all("4 days were recorded since" in line for line in output[:2])
    assert output[2].endswith("is kept: reviewed")
    assert "2 logs would be deleted" in result.stderr
    assert left(logs) == logs
    parsed = json.loads(hearthlog(*command, "--json").stdout)
    assert [item["log"] for item in parsed["deleted"]] == [str(log) for log in logs[1:3]]
    assert left(logs) == [logs[0], *logs[3:]]


@pytest.mark.parametrize("value", ["much", "-1", "5 apples", "1e9"])
def test_a_size_that_is_none_is_refused_with_one_line(tmp_path, hearthlog, value):
    result = hearthlog("retain", "-o", tmp_path, f"--max-record-size={value}")
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert line.endswith(" is not a size; write bytes, such as 500M or 20G")


@pytest.mark.parametrize(
    ("text", "size"), [("500M", 500_000_000), ("1.5 GB", 1_500_000_000), ("42", 42), (42, 42)]
)
def test_sizes_are_read_as_people_write_them(text, size):
    assert Settings(max_record_size=text).max_record_size == size


def test_a_recorder_deletes_at_its_start_and_says_so_in_its_log(logs):
    folder = logs[0].parents[3]
    about = Settings(output=folder, model="none", max_bag_files=12)

    def output():  # of the log that is written: the others may go at any moment
        newest = find_logs(folder)[-1]
        return [item.msg for item in read(newest, "rosout") if "deleted" in item.msg]

    begin = START + 5 * DAY
    new = record(about, Sound(begin, output), Flag()).logs
    assert left(logs) == logs[3:]
    assert find_logs(folder) == [*logs[3:], *new]
    (line,) = output()
    assert line.startswith("3 logs deleted")
    (status,) = [
        status
        for item in read(new[0], "diagnostics")
        for status in item.status
        if status.name == "hearthlog: home disk"
    ]
    values = {pair.key: int(pair.value) for pair in status.values}
    assert (values["deleted_logs"], values["logs"]) == (3, 12)
    assert values["free_bytes"] > 0
    assert not examine(new[0])[0].counts


def test_a_recorder_says_once_what_cannot_be_done(logs):
    folder = logs[0].parents[3]
    keeper = DiskKeeper(KeepingRules(str(folder), "home", Limits(files=1)))
    news = []
    for hour in range(3):
        messages = []
        while not messages:
            messages, problems = keeper.tick(START + hour * HOUR)
            news += problems
            time.sleep(0.01)
    keeper.close()
    (problem,) = news
    assert EVERYTHING in problem
    assert left(logs) == logs


@pytest.mark.parametrize("seed", range(6))
def test_killed_in_the_middle_of_it_every_log_is_there_or_not(logs, seed):
    for log in logs:
        for name in ("audio", "relabel-x", "relabel-y"):
            shutil.copy(log, log.with_name(f"{log.stem}.{name}.mcap"))
    rules = KeepingRules(str(logs[0].parents[3]), "home", Limits(files=2))
    command = [sys.executable, "-m", "hearthlog.recorder.disk_keeper", json.dumps(rules)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        kill_while_deleting(process, logs[0], random.Random(seed).uniform(0, 0.004))
    kept = recorded_logs(logs[0].parents[3], "home", [])
    assert [log.path for log in kept] == logs[15 - len(kept) :]
    assert all(len(log.layers) == 3 for log in kept[1:])
    keep(logs, files=2)
    assert left(logs) == logs[-2:]
    assert len(list(logs[-1].parents[2].rglob("*.mcap"))) == 8


def kill_while_deleting(process, first, seconds):
    layer = first.with_name(f"{first.stem}.audio.mcap")
    while layer.exists() and process.poll() is None:
        pass
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)


def test_on_a_small_disk_the_floor_is_kept(one, tmp_path):
    with small_disk(tmp_path / "disk", "2M") as disk:
        for hour in count():
            path = log_path(disk, "home", START + hour * HOUR)
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(one, path)
            if free(disk) < 500_000:
                break
        keep_disk(KeepingRules(str(disk), "home", Limits(free=1_000_000)))
        assert free(disk) >= 1_000_000
        assert free(disk) - size(one) < 1_000_000 + size(one)


def test_what_cannot_be_deleted_is_said_and_the_others_go(logs):
    if os.geteuid():
        pytest.skip("only root can make a file immutable")
    stuck = logs[0]
    if subprocess.run(["chattr", "+i", stuck], check=False, capture_output=True).returncode:
        pytest.skip("this file system has no immutable files")
    try:
        report = keep(logs, files=13)
    finally:
        subprocess.run(["chattr", "-i", stuck], check=True)
    assert left(logs) == [logs[0], *logs[2:]]
    assert "cannot be listed or deleted (Operation not permitted)" in report.problem
