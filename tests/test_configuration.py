"""`hearthlog config`: what is in force, from where, whether it can be used, and what could be."""

import json
import tomllib
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spliced import run

from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.config_origins import key_lines
from hearthlog.tools.reference import configuration_page


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


FILE = """\
# my home
node = "flat"
max_bag_size = "50M"

quiet_hours = [
    "22:00-06:30",
]

[[microphone]]
name = "kitchen"

[[microphone]]
name = "bath"
device = "rtsp://me:secret@camera/1"
model = "none"
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "home.toml"
    path.write_text(FILE)
    return path


def test_what_is_printed_is_in_force_and_says_where_it_comes_from(hearthlog, file):
    result = hearthlog("config", "--config", file, env={"HEARTHLOG_SYNC_SECONDS": "4"})
    assert (result.returncode, result.stderr) == (0, "")
    lines = dict(line.split(" = ") for line in result.stdout.splitlines() if " = " in line)
    assert lines["max_bag_size"] == f"50000000  # {file}, line 3"
    assert lines["quiet_hours"] == f'["22:00-06:30"]  # {file}, line 5'
    assert lines["sync_seconds"] == "4.0  # environment, HEARTHLOG_SYNC_SECONDS"
    assert lines["flush_seconds"] == "1.0  # default"
    assert lines["device"] == f'"rtsp://camera/1"  # {file}, line 14'
    assert "secret" not in result.stdout
    printed = tomllib.loads(result.stdout)
    assert printed["node"] == "flat"
    assert [each["name"] for each in printed["microphone"]] == ["kitchen", "bath"]
    assert printed.keys() | {"model"} == Settings.model_fields.keys()


def test_what_is_printed_can_be_configured_again(hearthlog, file, tmp_path):
    again = tmp_path / "again.toml"
    again.write_text(hearthlog("config", "--config", file).stdout)
    first, second = (
        tomllib.loads(hearthlog("config", "--config", path).stdout) for path in (file, again)
    )
    assert first == second


def test_a_configuration_is_checked_before_a_restart(hearthlog, file, tmp_path):
    result = hearthlog("config", "check", file)
    assert (result.returncode, result.stdout) == (0, f"{file}: can be used\n")
    assert list(tmp_path.iterdir()) == [file], "and nothing was made"


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        (("node", "nodee"), 2, "FILE, line 2: unknown key 'nodee'"),
        (('"50M"', '"50X"'), 2, "FILE, line 3: max_bag_size: say how many bytes, such as 50"),
        (("06:30", "6:30"), 2, "FILE, line 5: quiet_hours.0: '22:00-6:30' are no hours"),
        (('"bath"', '"kitchen"'), 2, "FILE, line 12: two microphones have name 'kitchen'"),
        (('"bath"', '"ba/th"'), 2, "FILE, line 13: microphone.1.name: "),
        (('model = "none"', "noise = 1"), 2, "FILE, line 15: unknown key 'microphone.1.noise'"),
        (('"flat"', '"flat'), 2, "FILE: cannot be read as TOML ("),
        (("rtsp://me", "rtsp://me me"), 1, "the address of a microphone has a space"),
        (('model = "none"', 'model = "x.safetensors"'), 1, "x.safetensors: "),
        (('node = "flat"', 'keep_audio = "always"\nmodel = "none"'), 2, ""),
        (('node = "flat"', 'output = "/dev/null/logs"'), 1, "/dev/null/logs: cannot be written"),
    ],
)
def test_what_is_wrong_in_a_configuration_is_said_with_its_line(
    refused, file, change, status, words
):
    old, new = change
    file.write_text(FILE.replace(old, new))
    message = refused("config", "check", file, status=status)
    assert message.startswith(words.replace("FILE", str(file)))


def test_a_variable_that_is_wrong_is_named(refused):
    message = refused("config", status=2, env={"HEARTHLOG_NODE": "a/b"})
    assert message.startswith("environment, HEARTHLOG_NODE: node: node name 'a/b'")


def test_the_schema_has_every_key(hearthlog):
    schema = json.loads(hearthlog("config", "schema").stdout)
    assert schema["properties"].keys() == Settings.model_fields.keys() | {"bridge"}
    of_microphone = schema["$defs"]["MicrophoneSettings"]["properties"]
    assert of_microphone.keys() == MicrophoneSettings.model_fields.keys()
    assert all("description" in each for each in schema["properties"].values())
    assert {"type": "string"} in schema["properties"]["max_bag_size"]["anyOf"]


@given(st.text(max_size=400))
def test_any_text_has_lines_of_keys_or_none(text):
    count = text.count("\n") + 1
    assert all(1 <= line <= count for line in key_lines(text).values())


def test_the_page_of_the_keys_is_that_of_this_version():
    page = Path(__file__).parents[1] / "docs/configuration.md"
    assert page.read_text("utf-8") == configuration_page(), "python -m hearthlog.tools.reference"
