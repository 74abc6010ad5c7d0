"""Old logs are thinned as configured: what is left of them is as it was, and read as before."""

import fcntl
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from log_fixtures import run
from logreader import LogReader
from logs import read

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.recorder.disk_keeper import keep_disk
from hearthlog.recorder.retention import KeepingRules, Limits, ThinningDays
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs, log_path
from hearthlog.schemas.logs.metadata import provenance_records
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.message_types import nanoseconds
from hearthlog.schemas.salvage.recover import STEPS, thin_log, thinned_step


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


DAY = 86_400 * NANOSECONDS
DROPPED = (
    set(),
    {"/mic/statistics"},
    {"/mic/statistics", "/mic/features"},
    {"/mic/statistics", "/mic/features", "/diagnostics", "/rosout"},
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, day, model_file):
    """Three minutes with labels, in files of a minute, with a gap of a killed recorder."""
    folder = tmp_path_factory.mktemp("recorded")
    command = [sys.executable, "-m", "hearthlog.tools.cli.main", "record", day, "-o", folder]
    options = ["--start", "2026-03-01T08:00", "--model", model_file, "-d", "60"]
    subprocess.run([*command, *options], check=True)
    return find_logs(folder)


@pytest.fixture
def logs(recorded, tmp_path):
    """The same in a folder of one's own, and a log of each of the next three days."""
    root = tmp_path / "logs"
    shutil.copytree(recorded[0].parents[3], root)
    paths = [root / path.relative_to(recorded[0].parents[3]) for path in recorded]
    start = nanoseconds(read(recorded[0], "info")[0].header.stamp)
    for number in range(1, 4):
        path = log_path(root, "home", start + number * DAY)
        path.parent.mkdir(parents=True)
        shutil.copy(recorded[0], path)
        paths.append(path)
    return paths


def messages(log, without=frozenset()):
    found = LogReader(log).messages()
    return [(m.topic, m.log_time, m.data) for m in found if m.topic not in without]


def keep(logs, limits=None, **days):
    rules = KeepingRules(str(logs[0].parents[3]), "home", limits or Limits(), ThinningDays(**days))
    return keep_disk(rules)


def thinned(logs):
    return [thinned_step(log) for log in logs]


@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_step_drops_what_it_says_and_leaves_all_else_in_its_order(recorded, tmp_path, step):
    for log in recorded:
        copy = tmp_path / log.name
        thin_log(log, copy, step)
        assert messages(copy) == messages(log, DROPPED[step])
        before, after = LogReader(log), LogReader(copy)
        assert before.attachments == after.attachments
        with LogFile(copy) as file, LogFile(log) as original:
            assert {c.topic for c in file.channels.values()} == {
                c.topic for c in original.channels.values()
            }
            (record,) = provenance_records(file)
            (old,) = provenance_records(original)
        assert record.items() > old.items()
        assert record["thinned"] == STEPS[step]
        assert copy.stat().st_size < log.stat().st_size


@pytest.mark.parametrize("step", [1, 2, 3])
def test_the_doctor_finds_nothing_wrong_with_thinned_logs_among_others(logs, step):
    days = dict(zip(("statistics", "features", "rest"), [0, 0, 0], strict=True))
    days[list(days)[step - 1]] = 3
    assert not any(each.counts for each in examine(logs[0].parent))
    report = keep(logs, **days)
    assert thinned(logs) == [step] * 3 + [0] * 3
    assert report.done.startswith("3 logs thinned")
    assert not any(each.counts for each in examine(logs[0].parent))
    assert find_logs(logs[0].parents[3]) == logs


def test_each_step_comes_in_its_time(logs):
    keep(logs, statistics=1, features=2, rest=3)
    assert thinned(logs) == [3, 3, 3, 2, 1, 0]
    again = keep(logs, statistics=1, features=2, rest=3)
    assert not again.done
    keep(logs, features=1)
    assert thinned(logs) == [3, 3, 3, 2, 2, 0]


def test_what_is_reviewed_keeps_its_features_and_what_is_locked_keeps_all(logs):
    start = nanoseconds(read(logs[0], "info")[0].header.stamp)
    write_marks(logs[0], [Mark("mic", start, start + NANOSECONDS, "speech")])
    logs[1].with_name(logs[1].name + ".keep").touch()
    keep(logs, features=1)
    assert thinned(logs) == [1, 0, 2, 2, 2, 0]


def test_a_damaged_log_is_left_as_it_is_and_the_others_are_thinned(logs):
    data = bytearray(logs[1].read_bytes())
    with LogFile(logs[1]) as file:
        data[int(file.chunks["offset"][1]) + 5000] ^= 0xFF
    logs[1].write_bytes(data)
    report = keep(logs, statistics=1)
    assert logs[1].read_bytes() == data
    assert thinned([logs[0], *logs[2:]]) == [1, 1, 1, 1, 0]
    assert f"{logs[1]}: is damaged, and not thinned" in report.problem


def test_layers_stay_valid_and_labels_of_old_logs_are_read_as_before(logs, model_file, hearthlog):
    folder = logs[0].parent
    assert hearthlog("relabel", folder, "--model", model_file).returncode == 0
    layers = [path.read_bytes() for path in sorted(folder.glob("*.relabel-*"))]
    before = hearthlog("export", folder, "-o", folder / "a.csv", "--topics", "/mic/label")
    report = json.loads(hearthlog("info", folder, "--json").stdout)
    keep(logs, statistics=3)
    keep(logs, features=3)
    result = hearthlog("relabel", folder, "--model", model_file)
    assert result.returncode == 0, result.stderr
    assert [path.read_bytes() for path in sorted(folder.glob("*.relabel-*"))] == layers
    after = hearthlog("export", folder, "-o", folder / "b.csv", "--topics", "/mic/label")
    assert before.returncode == after.returncode == 0
    assert (folder / "a.csv").read_bytes() == (folder / "b.csv").read_bytes()
    thin_report = json.loads(hearthlog("info", folder, "--json").stdout)
    for figure in ("labels", "segments", "segment_minutes", "unsure"):
        assert thin_report[figure] == report[figure]


@pytest.mark.parametrize(
    "command",
    [
        "info {logs}",
        "doctor {logs}",
        "catalog {logs}",
        "report {logs} -o {out}/report.html",
        "review {logs} --save {out}/day.rrd",
        "cut {logs} --start 2026-03-01T08:00:10 --end 2026-03-01T08:01:30 -o {out}/cut.mcap",
        "merge {logs} -o {out}/merged.mcap",
    ],
)
@pytest.mark.parametrize("days", [{"features": 3}, {"rest": 3}])
def test_commands_read_thinned_logs(logs, command, days, tmp_path, hearthlog):
    for log in logs[3:]:  # copies of the first day
        shutil.rmtree(log.parents[0]) if log is not logs[-1] else None
    keep([logs[0], logs[-1]], **dict.fromkeys(days, 1))
    shutil.rmtree(logs[-1].parent)
    assert set(thinned(logs[:3])) == {2 if "features" in days else 3}
    words = [word.format(logs=logs[0].parent, out=tmp_path) for word in command.split()]
    result = hearthlog(*words)
    assert (result.returncode, result.stderr.count("Traceback")) == (0, 0), result.stderr


@pytest.mark.parametrize("seed", range(8))
def test_killed_in_the_middle_of_it_a_log_is_the_old_or_the_new_one(logs, seed):
    originals = [messages(log) for log in logs]
    rules = KeepingRules(str(logs[0].parents[3]), "home", Limits(), ThinningDays(features=1))
    command = [sys.executable, "-m", "hearthlog.recorder.disk_keeper", json.dumps([rules, True])]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        while not list(logs[0].parents[3].rglob("*.thinning")) and process.poll() is None:
            pass
        time.sleep(random.Random(seed).uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
    for log, original in zip(logs, originals, strict=True):
        lost = DROPPED[thinned_step(log)]
        assert messages(log) == [item for item in original if item[0] not in lost]
    keep(logs, features=1)
    assert thinned(logs) == [2, 2, 2, 2, 2, 0]
    assert [path for path in logs[0].parents[3].rglob("*.mcap*") if path.is_file()] == unordered(
        logs
    )
    assert not any(each.counts for each in examine(logs[0].parent))


class unordered(list):  # noqa: N801
    """A list that equals any with the same items."""

    def __eq__(self, other):
        return sorted(self) == sorted(other)

    __hash__ = None


def test_without_room_for_a_copy_a_log_stays_as_it_is_and_that_is_said(logs):
    before = [log.read_bytes() for log in logs]
    rules = KeepingRules(str(logs[0].parents[3]), "home", Limits(), ThinningDays(statistics=1))
    code = (
        "import resource, runpy; resource.setrlimit(resource.RLIMIT_FSIZE, (9_000, 9_000))\n"
        "runpy.run_module('hearthlog.recorder.disk_keeper', run_name='__main__')"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, json.dumps([rules, True])], capture_output=True, check=True
    )
    assert "cannot be thinned (File too large)" in json.loads(result.stdout)[1]
    assert [log.read_bytes() for log in logs] == before
    assert len(find_logs(logs[0].parents[3])) == len(logs)


def test_a_link_at_the_name_of_the_copy_is_not_followed_and_a_log_keeps_its_owner(logs, tmp_path):
    other, folder = tmp_path / "other", logs[0].parent
    other.write_text("1")
    logs[0].with_name(logs[0].name + ".thinning").symlink_to(other)
    if os.geteuid() == 0:
        os.chown(folder, 12345, 12345)
        os.chown(logs[0], 12345, 12345)
    logs[0].chmod(0o640)
    keep(logs, features=1)
    assert thinned(logs) == [2, 2, 2, 2, 2, 0]
    assert other.read_text() == "1"
    assert not logs[0].is_symlink()
    assert logs[0].stat().st_mode & 0o777 == 0o640
    assert logs[0].stat().st_uid == folder.stat().st_uid
    assert not list(folder.glob("*.thinning"))


def test_a_log_that_another_process_thins_is_left_to_it(logs):
    with logs[0].open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        keep(logs, features=1)
    assert thinned(logs) == [0, 2, 2, 2, 2, 0]


def test_a_dry_run_says_what_would_be_thinned(logs, tmp_path, hearthlog):
    config = tmp_path / "home.toml"
    config.write_text(f'output = "{logs[0].parents[3]}"\ndrop_statistics_days = 3\n')
    dry = hearthlog("retain", "--config", config, "--dry-run")
    assert dry.stdout.splitlines() == [f"{log}: would be thinned of statistics" for log in logs[:3]]
    assert thinned(logs) == [0] * 6
    wet = hearthlog("retain", "--config", config)
    assert wet.stdout == dry.stdout.replace("would be ", "")
    assert thinned(logs) == [1] * 3 + [0] * 3


def test_what_a_newer_version_has_thinned_is_left_alone(recorded, tmp_path, monkeypatch):
    copy = tmp_path / recorded[0].name
    monkeypatch.setattr("hearthlog.schemas.salvage.recover.STEPS", ("", "all that is silent"))
    thin_log(recorded[0], copy, 1)
    monkeypatch.undo()
    with pytest.raises(LogError, match="in a way that this version does not know"):
        thinned_step(copy)
