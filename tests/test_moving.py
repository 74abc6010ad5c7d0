"""A home moves to another box, or comes back from a backup: what is missing is a gap."""

import shutil

from logs import features, read
from test_capture import wait_for_frames
from test_pauses import recording

from hearthlog.analyzer.doctor.examination import examine


def goes_on(labmic, logs):
    """Record where the copy of a home is, and return the reasons of its gaps."""
    before = len(features(logs)[0])
    with recording(labmic, logs):
        wait_for_frames(logs, before + 20)
    assert [str(one) for each in examine(logs) for one in each.shown if one.level == "error"] == []
    return [gap.reason for gap in read(logs, "gap")]


def test_a_home_that_moved_goes_on_with_a_gap(labmic, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    with recording(labmic, here):
        wait_for_frames(here, 30)
    shutil.copytree(here, there)
    assert goes_on(labmic, there) == ["the recorder was not running"]


def test_a_backup_of_a_folder_at_work_comes_back_up_to_its_last_second(labmic, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    with recording(labmic, here):
        wait_for_frames(here, 60)
        shutil.copytree(here, there)
    assert list(there.rglob("*.active"))
    count = len(features(there)[0])
    assert goes_on(labmic, there) == ["the recorder was not running"]
    assert len(features(there)[0]) >= count + 20
