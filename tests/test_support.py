"""A bundle for somebody who helps has what they need, and nothing of what was heard."""

import json
import re
import shutil
from zipfile import ZipFile

import pytest
from test_capture import wait_for_frames
from test_pauses import recording

from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs

FILES = {"machine.json", "live.json", "configuration.json", "logs.json"}


@pytest.fixture
def logs(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "logs")


@pytest.fixture
def bundle(hearthlog, logs, tmp_path):
    result = hearthlog("doctor", logs, "--bundle", tmp_path / "help.zip")
    assert (result.returncode, result.stderr) == (0, "")
    with ZipFile(tmp_path / "help.zip") as archive:
        return {name: archive.read(name).decode() for name in archive.namelist()}


def test_it_says_what_the_logs_and_the_machine_are(bundle, logs):
    assert bundle.keys() == FILES
    reported = json.loads(bundle["logs.json"])
    assert [each["name"] for each in reported] == [
        str(log.relative_to(logs)) for log in find_logs(logs)
    ]
    assert sum(sum(each["frames"].values()) for each in reported) > 1000
    assert {"numpy", "mcap"} < json.loads(bundle["machine.json"])["packages"].keys()
    assert json.loads(bundle["configuration.json"])["node"] == "home"


def test_no_label_is_in_it_nor_how_often_there_was_one(bundle, logs):
    labels = {
        str(label)
        for columns in read_columns(find_logs(logs), fields=["data", "label"]).values()
        for name in ("data", "label")
        if name in columns.fields and columns[name].dtype.kind in "UO"
        for label in columns[name]
    }
    assert len(labels) > 2
    reported = json.loads(bundle["configuration.json"])
    reported["never_keep"] = []
    everything = json.dumps(reported) + "".join(
        text for name, text in bundle.items() if name != "configuration.json"
    )
    everything = re.sub(r'"device": "[^"]*"', "", everything)  # here, names of files of sound
    assert [label for label in labels if label in everything] == []
    assert "/segment" not in everything
    assert "dbfs" not in everything


def test_the_health_of_a_recorder_at_work_is_in_it(labmic, tmp_path, hearthlog):
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 30)
        assert hearthlog("doctor", logs, "--bundle", tmp_path / "help.zip").returncode == 0
    with ZipFile(tmp_path / "help.zip") as archive:
        [log] = json.loads(archive.read("logs.json"))
        live = json.loads(archive.read("live.json"))
    assert {"subject": "mic", "level": "ok", "text": "listening"} in live
    health = {each["subject"]: each for each in log["health"]}
    assert health["mic"]["values"]["device"] == "labmic"
    assert "level_dbfs" not in health["mic"]["values"]
    assert int(health["machine"]["values"]["disk_free_bytes"]) > 0


def test_a_bundle_takes_the_place_of_no_file(refused, logs, tmp_path):
    (tmp_path / "help.zip").write_text("mine")
    message = refused("doctor", logs, "--bundle", tmp_path / "help.zip")
    assert "exists already" in message
    assert (tmp_path / "help.zip").read_text() == "mine"
    message = refused("doctor", logs, "--bundle", tmp_path / "help.txt", status=2)
    assert message == f"--bundle {tmp_path / 'help.txt'}: a bundle is named *.zip"
