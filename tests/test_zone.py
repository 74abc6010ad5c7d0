"""The log says in which time zone its home is."""

import pytest
from logreader import LogReader

from hearthlog.recorder import pause_schedule
from hearthlog.recorder.config import load_settings
from hearthlog.schemas.errors import ConfigurationError


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Make a machine that says its zone in some of the ways there are."""

    def make(variable="", file="", link=""):
        monkeypatch.setenv("TZ", variable)
        monkeypatch.setattr(pause_schedule, "_NAME_FILE", tmp_path / "timezone")
        monkeypatch.setattr(pause_schedule, "_LINK", tmp_path / "localtime")
        if file:
            (tmp_path / "timezone").write_text(file)
        if link:
            (tmp_path / "localtime").symlink_to(link)
        return load_settings(None, {}, {}).timezone

    return make


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        ({"variable": "Asia/Tokyo", "file": "Europe/Rome\n"}, "Asia/Tokyo"),
        ({"variable": ":Asia/Tokyo"}, "Asia/Tokyo"),
        ({"variable": "CET-1CEST", "file": "Europe/Rome\n"}, "Europe/Rome"),
        ({"variable": "/etc/localtime", "link": "/usr/share/zoneinfo/Etc/GMT+3"}, "Etc/GMT+3"),
        ({"file": "no zone", "link": "../usr/share/zoneinfo/Europe/Rome"}, "Europe/Rome"),
        ({"link": "/somewhere/else"}, "UTC"),
        ({}, "UTC"),
    ],
)
def test_the_zone_is_that_of_the_machine(machine, output, expected):
    assert machine(**output) == expected


@pytest.mark.parametrize("name", ["Europe/Atlantis", "", "../../etc/passwd", "Europe", "a\0b"])
def test_a_zone_that_there_is_not_is_refused_by_name(name):
    with pytest.raises(ConfigurationError) as error:
        load_settings(None, {"timezone": name}, {})
    expected = f"command line: timezone: no time zone {name!r} on this machine; "
    assert str(error.value) == f"{expected}name one as Europe/Berlin, or UTC"


def test_every_log_says_the_zone(day, hearthlog, tmp_path):
    environment = {"HEARTHLOG_TIMEZONE": "America/Lima"}
    options = ["--start", "2026-03-01T07:59:00", "-o", tmp_path]
    assert hearthlog("record", day, *options, env=environment).returncode == 0
    logs = sorted(tmp_path.rglob("*.mcap"))
    assert len(logs) == 2
    for log in logs:
        assert LogReader(log).metadata["hearthlog"]["timezone"] == "America/Lima"
