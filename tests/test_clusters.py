"""Groups of sounds and voices are numbered, named and kept in a file in the same way."""

import shutil
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

import log_fixtures
from conversations import two_spoken_days
from recurring import two_recurring_days

from hearthlog.analyzer.discover import ClusterKind
from hearthlog.analyzer.discover.groups import GROUPS, load_groups
from hearthlog.analyzer.discover.voices import VOICES, load_voices
from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.logs.files import find_logs, is_layer


class Home(NamedTuple):
    """Logs of two days in which something recurs, and how it is found."""

    logs: Path
    kind: ClusterKind
    file: Path


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(log_fixtures.run, capfd)


@pytest.fixture(params=[GROUPS, VOICES], ids=lambda kind: kind.plural)
def home(request, tmp_path_factory, tmp_path):
    days = {GROUPS: two_recurring_days, VOICES: two_spoken_days}[request.param]
    logs = shutil.copytree(days(tmp_path_factory.getbasetemp())[0], tmp_path / "logs")
    return Home(logs, request.param, logs / request.param.file)


def find(hearthlog, home, *options):
    done = hearthlog(home.kind.verb, home.logs, *options)
    assert done.returncode == 0, done.stderr
    return done


def test_the_same_logs_give_the_same_clusters_again_and_again(home, hearthlog):
    first = find(hearthlog, home)
    content = home.file.read_bytes()
    again = find(hearthlog, home)
    assert again.stdout == first.stdout
    assert home.file.read_bytes() == content


def test_the_hint_names_the_file_that_was_given(home, hearthlog, tmp_path):
    option, file = f"--{home.kind.plural}", tmp_path / "my file"
    hint = find(hearthlog, home, option, file).stderr
    name = home.kind.example.split("=")[1]
    assert f"{home.kind.verb} {home.logs} {option} '{file}' --name 1={name}" in hint


def test_several_logs_want_a_place_for_their_file(home, hearthlog):
    logs = [log for log in find_logs(home.logs) if not is_layer(log)]
    done = hearthlog(home.kind.verb, *logs)
    assert done.returncode == 2
    assert f"--{home.kind.plural}: say in which file " in done.stderr


def test_a_review_with_a_file_that_is_not_there_is_one_line(home, hearthlog, tmp_path):
    options = [f"--{home.kind.plural}", home.file, "--save", tmp_path / "day.rrd"]
    done = hearthlog("review", home.logs, *options)
    assert done.returncode == 1
    makes = f"no such file of {home.kind.plural}; `hearthlog {home.kind.verb}` makes one"
    assert makes in done.stderr


@pytest.mark.parametrize(
    ("options", "status", "states"),
    [
        (["--name", "rex"], 2, "give the number of a {0.noun} and a "),
        (["--name", f"{'9' * 5000}=rex"], 2, "give the number of a {0.noun} and a "),
        (["--name", "1=rex", "--name", "1=max"], 2, "{0.noun} 1 has another name already"),
        (["--name", "99=rex"], 1, "there is no {0.noun} 99; `hearthlog {0.verb} LOGS` lists"),
        (["--undo", "99"], 1, "there is no {0.noun} 99; `hearthlog {0.verb} LOGS` lists"),
    ],
)
def test_a_name_that_makes_no_sense_is_one_line(home, hearthlog, options, status, states):
    done = hearthlog(home.kind.verb, home.logs, *options)
    assert done.returncode == status
    assert states.format(home.kind) in done.stderr
    assert done.stderr.count("\n") == 1
    assert not home.file.exists()


def load(home):
    return {GROUPS: load_groups, VOICES: load_voices}[home.kind](home.file)


def test_a_file_is_read_as_it_was_written_unless_a_bit_has_changed(home, hearthlog):
    assert load(home) is None
    find(hearthlog, home)
    find(hearthlog, home, "--name", "1=rex")
    assert load(home).numbers[0] == 1
    assert load(home).names[0] == "rex"
    content = bytearray(home.file.read_bytes())
    content[-9] ^= 1
    home.file.write_bytes(content)
    with pytest.raises(DataError, match=r"is not as it was written \(digest .* backup"):
        load(home)


@pytest.mark.parametrize("content", [b"", b"RIFF", b"\xff" * 64, b"\x08" + bytes(7) + b"{}" * 4])
def test_another_file_is_no_file_of_clusters(home, content):
    home.file.write_bytes(content)
    with pytest.raises(DataError, match=f"is no file of {home.kind.plural}"):
        load(home)
