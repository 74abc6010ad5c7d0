"""`hearthlog config`: what is in force, from where, whether it can be used, and what could be."""

import json
import re
import sys
import tomllib
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from shutil import copyfile
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run

from hearthlog.analyzer.bridge.alerts.rules import AlertRule
from hearthlog.analyzer.bridge.settings import (
    DeliverySettings,
    MqttSettings,
    PageSettings,
    PingSettings,
    PrometheusSettings,
    load_bridge_settings,
)
from hearthlog.models.starter import BATHROOM, starter_file
from hearthlog.recorder.config import MicrophoneSettings, Settings
from hearthlog.recorder.config_problems import key_lines
from hearthlog.recorder.disk_keeper import keep_disk
from hearthlog.schemas.errors import ConfigurationError


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
    path.chmod(0o600)
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
    assert (result.returncode, result.stdout) == (0, f"{file}: valid\n")
    assert list(tmp_path.iterdir()) == [file], "and nothing was made"


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        (("node", "nodee"), 2, "FILE, line 2: unknown key 'nodee'"),
        (('"50M"', '"50X"'), 2, "FILE, line 3: max_bag_size: '50X' is not a size; write bytes"),
        (("06:30", "6:30"), 2, "FILE, line 5: quiet_hours.0: '22:00-6:30' is not a span of hours"),
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


TABLES = {  # every table, by its head, with the keys that it cannot be without
    "": (Settings, ""),
    "[[microphone]]": (MicrophoneSettings, ""),
    "[bridge.mqtt]": (MqttSettings, 'host = "x"'),
    "[bridge.prometheus]": (PrometheusSettings, ""),
    "[bridge.page]": (PageSettings, ""),
    "[bridge.ping]": (PingSettings, 'url = "https://x"'),
    "[bridge.delivery]": (DeliverySettings, ""),
} | {
    f"[[bridge.alert]]\nrule = {kind.model_fields['rule'].annotation.__args__[0]!r}": (kind, "")
    for kind in get_args(get_args(AlertRule)[0])
}
OF_A_LIBRARY = re.compile(
    r"[Ii]nput|valid|pattern|pars|instance|required|tag|discriminat|regex|expect|dictionary|<class"
)


def keys_of(model):
    names = [field.alias or name for name, field in model.model_fields.items()]
    return [name for name in names if name not in {"microphone", "rule"} or model not in RULED]


RULED = {Settings, *(model for head, (model, _) in TABLES.items() if "rule" in head)}


def everywhere(value):
    """Write a value for every key of every table."""
    return "\n".join(
        "\n".join([head, *(f"{key} = {value}" for key in keys_of(model))])
        for head, (model, _) in TABLES.items()
    )


def slips(path, text):
    path.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_bridge_settings(path)
    return error.value.lines


@pytest.mark.parametrize(
    "value", ["5", "'x'", "[1]", "{a = 1}", "true", "1.5", "''", "1e300", "2020-01-01", "['x']"]
)
def test_every_slip_is_told_in_words_that_say_what_to_write(tmp_path, monkeypatch, value):
    monkeypatch.delenv("HEARTHLOG_MODEL", raising=False)
    monkeypatch.delenv("HEARTHLOG_EMBEDDING", raising=False)
    lines = slips(tmp_path / "c.toml", everywhere(value))
    for line in lines:
        assert not OF_A_LIBRARY.search(line.removeprefix(str(tmp_path))), line
        assert re.match(rf"{re.escape(str(tmp_path))}/c.toml, line \d+: [\w.]+: .", line), line
    if value == "{a = 1}":  # which no key takes
        keys = [key for model, _ in TABLES.values() for key in keys_of(model)]
        refused = [line.split(": ")[1].removesuffix(".a").rpartition(".")[2] for line in lines]
        assert sorted(refused) == sorted(keys)
        assert all(re.search("write|such as", line) for line in lines)


def test_what_is_to_be_kept_for_ever_may_be_said_in_large_numbers(tmp_path):
    settings = Settings(
        output=tmp_path,
        retention_days=100_000,
        drop_features_days=700_000,
        max_bag_files=1_000_000_000,
        statistics_every=100_000_000,
    )
    (tmp_path / "home_20260301T070000Z.mcap").touch()
    assert not keep_disk(settings.keeping_rules()).problem
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "-1e300", "9" * 40, "-" + "9" * 40])
def test_every_number_has_bounds(tmp_path, value):
    lines = slips(tmp_path / "c.toml", everywhere(value))
    refused = {re.search(r": ([\w.]+): ", line)[1].rpartition(".")[2] for line in lines}
    for model, _ in TABLES.values():
        about = model.model_json_schema()["properties"]
        for name, kind in about.items():
            kinds = {kind.get("type"), *(each.get("type") for each in kind.get("anyOf", ()))}
            assert not kinds & {"integer", "number"} or name in refused, name


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[microphone]\nname = 'x'", "microphone: write [[microphone]], with two brackets"),
        ("[bridge.alert]\nname = 'x'", "bridge.alert: write [[bridge.alert]], with two"),
        ("[[bridge.mqtt]]\nhost = 'x'", "bridge.mqtt: is a table; write [bridge.mqtt] with one"),
        ("quiet_hours = '22:00-06:30'", 'not a list of texts; write quiet_hours = ["22:00-06:30"]'),
        ("max_bag_duration = '1h'", "write max_bag_duration = 3600, without a unit"),
        ("flush_seconds = '2 min'", "write flush_seconds = 120, without a unit"),
        ("max_bag_duration = '1 hour'", "write max_bag_duration = 3600, without a unit"),
        ("retention_days = '2 weeks'", "write retention_days = 14, without a unit"),
        ("retention_days = '6 months'", "write retention_days = 180, without a unit"),
        ("retention_days = '1 year'", "write retention_days = 365, without a unit"),
        ("retention_days = '36h'", "write retention_days = 2, without a unit"),
        ("clip_minutes_a_day = '1h'", "write clip_minutes_a_day = 60, without a unit"),
        ("clip_minutes_a_day = '90 s'", "write clip_minutes_a_day = 2, without a unit"),
        ("clip_min_free_space = '2G'", "write clip_min_free_space = 2000, without a unit"),
        ("clip_min_free_space = '500 MiB'", "write clip_min_free_space = 500, without a unit"),
        ("clip_min_free_space = '2h'", "write clip_min_free_space = 500"),
        ("quiet_hours = '10pm-6am'", 'write quiet_hours = ["22:00-06:30"]'),
        ("quiet_hours = '8:00-9:00'", 'write quiet_hours = ["22:00-06:30"]'),
        ("privacy = 'talking'", 'write privacy = ["talking"]'),
        ("microphone = ['kitchen']", "microphone.0: is a table; write [[microphone]], with two"),
        ("[bridge]\nalert = ['a']", "bridge.alert.0: "),
        ('output = "a\\u0000b"', "'a\\x00b': no path has the character"),
        ('[bridge]\nstate = "\\u0000"', "no path has the character"),
        ("statistics_every = '5 s'", "write statistics_every = 20"),
        ("output = ''", "output: is empty; write a path, or leave the key out"),
        ("[[microphone]]\nmodel = ' '", "model: is empty; write a path"),
        ("[bridge.mqtt]\nhost='x'\npassword_file=''", "password_file: is empty; write a path"),
        ("output = '~/logs'", "'~/logs': ~ and $ are not expanded; write the full path"),
        ("[bridge]\nstate = '$HOME/state'", "~ and $ are not expanded; write the full path"),
        ("[scenarios]\nbath = '~/bath.safetensors'", "scenarios.bath: '~/bath.safetensors': ~ and"),
        ("quiet_hours = ['22:00\u201306:30']", "as 22:00-06:30, with a plain hyphen"),
        ("quiet_hours = ['22:00-06:00' '12:00-13:00']", "closed, or a comma is missing"),
        ("node = 7", 'node: 7 is not a text in quotes; write node = "7"'),
        ("quiet_hour = ['22:00-06:30']", "unknown key 'quiet_hour'; is quiet_hours meant?"),
        (
            "[[microphone]]\nnode = 'x'",
            "unknown key 'microphone.0.node'; it belongs above the first",
        ),
        ("[bridge.page]\nquiet_hours = []", "; it belongs above the first table"),
        ("[bridge.page]\nzzz = 1", "the keys of this table are port, bind, token_file, names, fr"),
        ("[bridge.mqtt]\nhost='x'\npassword='geheim'", 'write password_file = "/etc/hearthlog/'),
        ("[bridge.mqtt]\nhost='x'\ntopic='a/#'", "'a/#' cannot begin topics; write 1 to 200"),
        ("[[bridge.alert]]\nname='x'\nrule='more'", 'rule is one of "longer_than", "more_than"'),
        ("[bridge.page]\nbind = 'evil.example'", "'evil.example' is not an IP address"),
        ("node = flat", 'a text stands in quotes, as node = "home"'),
        ('output = "C:\\Users\\me"', "a text with a backslash stands in single quotes"),
        ("node = 'a'\nnode = 'b'", "(at line 2, the last one); a key or table is given twice"),
    ],
)
def test_a_slip_is_told_with_what_to_write(tmp_path, text, words):
    (line,) = slips(tmp_path / "c.toml", text)
    assert words in line
    assert "geheim" not in line


def test_a_file_of_an_editor_of_windows_is_read_or_named(tmp_path):
    path = tmp_path / "c.toml"
    path.write_bytes('node = "flat"\r\n'.encode("utf-8-sig"))
    assert load_bridge_settings(path)[0].node == "flat"
    path.write_bytes('node = "flat"\n'.encode("utf-16"))
    with pytest.raises(ConfigurationError, match="it is UTF-16\\); save it as UTF-8"):
        load_bridge_settings(path)
    path.write_bytes('node = "flat"\n'.encode("utf-16-be"))  # without a mark
    with pytest.raises(ConfigurationError, match="it is UTF-16\\); save it as UTF-8"):
        load_bridge_settings(path)
    path.write_bytes('\nnode = "M\xfcller"\n'.encode("latin-1"))
    with pytest.raises(ConfigurationError, match="at line 2\\); save it as UTF-8"):
        load_bridge_settings(path)


of_apprise = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")
BRIDGE = """\
model = "none"
output = "FOLDER/logs"
[[microphone]]
device = "rtsp://me:secret@camera/1"
[bridge.mqtt]
host = "x"
user = "me"
password_file = "FOLDER/password"
[bridge.page]
token_file = "FOLDER/token"
[bridge.delivery]
urls_file = "FOLDER/urls"
"""
SECRETS = {"password": "geheim", "token": "abcdefghijklmnop", "urls": "json://127.0.0.1:9"}


@of_apprise
def test_secrets_that_everybody_may_read_are_named_each(hearthlog, tmp_path):
    for name, secret in SECRETS.items():
        (tmp_path / name).write_text(secret)
        (tmp_path / name).chmod(0o640)  # for a group is well
    file = tmp_path / "home.toml"
    file.write_text(BRIDGE.replace("FOLDER", str(tmp_path)))
    file.chmod(0o600)
    result = hearthlog("config", "check", file)
    assert (result.returncode, result.stderr) == (0, "")
    exposed = [file, *(tmp_path / name for name in SECRETS)]
    for path in exposed:
        path.chmod(0o666)
    result = hearthlog("config", "check", file)
    assert (result.returncode, result.stdout) == (3, f"{file}: valid\n")
    assert sorted(result.stderr.splitlines()) == sorted(
        f"hearthlog: {path}: holds secrets, and everybody on this machine may read it: "
        f"chmod 600 {path}"
        for path in exposed
    )


@of_apprise
def test_what_the_bridge_refuses_at_its_start_is_refused_all_at_once(hearthlog, tmp_path):
    (tmp_path / "logs").touch()
    (tmp_path / "password").mkdir()
    file = tmp_path / "home.toml"
    text = BRIDGE.replace("FOLDER/urls", "/dev/zero").replace("FOLDER", str(tmp_path))
    tables = {
        "page": 'bind = "192.0.2.1"\n',
        "mqtt": 'tls = true\nca_file = "none.pem"\n',
    }
    for name, more in tables.items():
        text = text.replace(f"[bridge.{name}]\n", f"[bridge.{name}]\n{more}")
    figures = 'text_file = "/dev/null/home.prom"\nreadable_by = "owner"\n'
    file.write_text(f"{text}[bridge.prometheus]\n{figures}")
    file.chmod(0o600)
    result = hearthlog("config", "check", file)
    assert (result.returncode, result.stdout) == (1, "")
    expected = [
        f"{tmp_path}/logs: cannot be written",
        f"{tmp_path}/password: cannot be read (Is a directory)",
        f"{tmp_path}/token: no such file of a token",
        "/dev/zero: cannot be read (Not a regular file)",
        "none.pem: no such certificate",
        "cannot listen on 192.0.2.1",
        "/dev/null: cannot be written",
    ]
    lines = result.stderr.splitlines()
    assert len(lines) == len(expected)
    assert len(lines) == len(expected)
    for words in expected:
        assert any(line.startswith(f"hearthlog: {words}") for line in lines), words


ALERT = """
[[microphone]]
name = "mic"
[bridge.mqtt]
host = "x"
[[bridge.alert]]
name = "a"
rule = "more_than"
class = "coughing"
count = 3
window = "1h"
microphone = "kitchn"
"""
DAILY = "[bridge.mqtt]\nhost = 'x'\n[[bridge.alert]]\nname = 'a'\n"


@pytest.mark.parametrize(
    ("text", "status", "words"),
    [
        (
            '[[bridge.alert]]\nname = "a"\nrule = "recorder_silent"\nsilent_for = "1m"\n',
            1,
            "bridge.alert: alerts have no target; set urls_file",
        ),
        (
            "[bridge.page]\nport = 9380\n[bridge.prometheus]\nport = 9380\ntoken_file = 'token'\n",
            1,
            "bridge.prometheus: port 9380 is that of [bridge.page]",
        ),
        (
            "[bridge.mqtt]\nhost = 'x'\nca_file = 'ca.pem'\n",
            1,
            "bridge.mqtt: ca_file is for an encrypted connection; write tls = true, or leave",
        ),
        (
            "[bridge.prometheus]\ntext_file = '/tmp'\n",
            1,
            "bridge.prometheus: text_file: /tmp is a folder; name a file in it",
        ),
        (
            ALERT,
            3,
            "a: there is no microphone 'kitchn'; there is mic",
        ),
        (
            ALERT.replace("kitchn", "mic"),
            3,
            "a: the microphone 'mic' has no model, so that no sound of it has a class",
        ),
        (
            "[bridge.prometheus]\ntext_file = '/tmp/home.txt'\n",
            3,
            'home.txt does not end in .prom, so that node_exporter does not read it; write "/tmp/h',
        ),
        (
            ALERT.replace("count = 3", "minutes = 60"),
            3,
            "a: there cannot be more than 60 minutes in a window of 1 h, so it never notifies",
        ),
        (
            ALERT.replace("count = 3", "count = 362"),
            3,
            "a: there cannot be more than 362 events in a window of 1 h, so it never notifies",
        ),
        (
            f"retention_days = 8\n{DAILY}rule = 'unlike_usual'\n",
            3,
            "a: retention_days = 8 leaves it no 7 days to compare with, so it never notifies; ke",
        ),
        (
            f"retention_days = 15\n{DAILY}rule = 'unusual_day'\n",
            3,
            "days to compare with, so it never notifies; keep 16 or more",
        ),
    ],
)
def test_what_the_bridge_could_not_tell_of_is_named_before_it_starts(
    hearthlog, tmp_path, text, status, words
):
    file = tmp_path / "home.toml"
    file.write_text(f'model = "none"\noutput = "{tmp_path}/logs"\n{text}')
    result = hearthlog("config", "check", file)
    assert result.returncode == status
    assert words in result.stderr


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "coughng",
            "a: no model here has the class 'coughng'; there",
        ),
        (
            "silent cough",
            "there are coughing, music, objects_activity, phone_ring, speech, unknown",
        ),
        ("cough", ""),
        ("tap_water", ""),  # of a model that may be promoted
        ("doorbell", "'doorbell'"),
    ],
)
def test_a_class_that_no_model_knows_is_named_before_the_bridge_starts(
    hearthlog, tmp_path, monkeypatch, name, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL", raising=False)
    rule = ALERT.replace('"coughing"', f'"{name}"').replace("kitchn", "mic")
    (tmp_path / "models").mkdir()
    if name == "tap_water":
        copyfile(starter_file(BATHROOM), tmp_path / "models" / "other.safetensors")
    file = tmp_path / "home.toml"
    file.write_text(f'output = "{tmp_path}/logs"\n{rule}')
    result = hearthlog("config", "check", file)
    assert result.returncode == (3 if words else 0)
    lines = [line for line in result.stderr.splitlines() if " a: " in line]
    assert len(lines) == bool(words)
    assert words in "".join(lines)


def test_a_class_that_nothing_hears_is_known_for_a_scenario(hearthlog, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL", raising=False)
    rule = ALERT.replace('"coughing"', '"flushing_water"').replace("kitchn", "mic")
    file = tmp_path / "home.toml"
    file.write_text(f'output = "{tmp_path}/logs"\nscenarios = {{water = "bathroom"}}\n{rule}')
    assert hearthlog("config", "check", file).returncode == 0


@pytest.mark.parametrize(("absent", "name"), [("paho", "paho-mqtt"), ("prometheus_client",) * 2])
def test_a_package_that_an_output_lacks_is_named_with_all_else(
    hearthlog, tmp_path, monkeypatch, absent, name
):
    def find(module):
        return None if module == absent else find_spec(module)

    monkeypatch.setattr("hearthlog.analyzer.bridge.bridge.find_spec", find)
    for module in [each for each in sys.modules if each.partition(".")[0] == absent]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, absent, None)
    monkeypatch.delitem(sys.modules, "hearthlog.analyzer.bridge.mqtt.connection", raising=False)
    file = tmp_path / "home.toml"
    file.write_text(
        f'model = "none"\noutput = "{tmp_path}/logs"\n'
        '[bridge.mqtt]\nhost = "x"\nuser = "x"\npassword_file = "/dev/null"\ntls = true\n'
        '[bridge.prometheus]\ntext_file = "/tmp"\n'
    )
    result = hearthlog("config", "check", file)
    assert result.returncode == 1
    assert f"hearthlog: {name} is not installed; try: " in result.stderr
    assert "text_file: /tmp is a folder" in result.stderr


@pytest.mark.parametrize("tables", ["", "node = 'flat'\n", "[bridge.page]\n"])
def test_a_configuration_without_microphones_says_of_none_that_it_is_not_there(
    hearthlog, tmp_path, tables
):
    file = tmp_path / "home.toml"
    rule = ALERT.partition('name = "mic"')[2]
    file.write_text(f'model = "none"\noutput = "{tmp_path}/logs"\n{tables}{rule}')
    result = hearthlog("config", "check", file)
    assert (result.returncode, result.stderr) == (0, "")


def test_secrets_that_the_page_keeps_and_an_address_with_a_password_are_named(hearthlog, tmp_path):
    for name in ("page-token", "page-cookies", "page-address"):
        (tmp_path / name).write_text("0123456789abcdef0123")
        (tmp_path / name).chmod(0o644)
    file = tmp_path / "home.toml"
    file.write_text(
        f'model = "none"\noutput = "{tmp_path}/logs"\n[bridge]\nstate = "{tmp_path}"\n'
        '[bridge.page]\n[bridge.ping]\nurl = "https://user:word@127.0.0.1:9/a"\n'
    )
    file.chmod(0o644)
    result = hearthlog("config", "check", file)
    assert result.returncode == 3
    for name in ("page-token", "page-cookies", "page-address", "home.toml"):
        assert f"{tmp_path}/{name}: holds secrets, and everybody" in result.stderr
    assert "word@" not in result.stderr


def test_a_credential_of_the_service_is_not_missed(hearthlog, tmp_path):
    file = tmp_path / "home.toml"
    file.write_text(
        'model = "none"\n[bridge.mqtt]\nhost = "x"\nuser = "x"\npassword_file = "mqtt"\n'
    )
    result = hearthlog("config", "check", file)
    assert result.returncode == 3
    assert "mqtt: missing; it must be a credential of the service" in result.stderr


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
    lab = pytest.importorskip(
        "hearthlog.tools.lab.reference", reason="the wheel leaves the lab out"
    )
    assert page.read_text("utf-8") == lab.configuration_page(), (
        "python -m hearthlog.tools.lab.reference"
    )
