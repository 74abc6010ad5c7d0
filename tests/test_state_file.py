"""What a bridge has to remember is in one file, which survives whatever happens to it."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing, suppress

import pytest
from log_fixtures import small_disk

from hearthlog.analyzer.bridge import state as bridge_state
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState, StateEntry

pytestmark = pytest.mark.fast


def state_in(folder, node="home", say=pytest.fail):
    return BridgeState(folder, node, say)


def entry_of(state, say=pytest.fail):
    return StateEntry(state, "list", list[int], say, "starts over", "kept in memory")


def test_an_entry_is_there_after_the_next_start_and_nobody_else_may_read_the_file(tmp_path):
    old = os.umask(0)
    try:
        with closing(state_in(tmp_path / "bridge")) as state:
            assert entry_of(state).load() is None
            assert entry_of(state).save([1, 2])
            files = list((tmp_path / "bridge").iterdir())
            assert {path.stat().st_mode & 0o77 for path in files} == {0}
            assert {path.name for path in files} > {"state.sqlite3"}
    finally:
        os.umask(old)
    assert entry_of(state_in(tmp_path / "bridge")).load() == [1, 2]
    assert entry_of(state_in(tmp_path / "bridge", "attic")).load() is None


def test_files_of_earlier_versions_are_taken_over_once(tmp_path):
    box = tmp_path / "alerts" / "outbox"
    box.mkdir(parents=True)
    files = {
        "totals.json": {"time": 1, "totals": []},
        "alerts/rules.json": {"a": {}},
        "alerts/lines.json": ["x"],
        "alerts/outbox/7-coughs.json": {"rule": "coughs"},
        "mqtt-home.json": {"muted": ["music"]},
        "mqtt-attic.json": {"muted": ["speech"]},
    }
    for name, content in files.items():
        (tmp_path / name).write_text(json.dumps(content))
    (tmp_path / ".mqtt-home.lock").touch()
    (tmp_path / "page-token").write_text("a token")
    with closing(state_in(tmp_path)) as state:
        own = {name: json.loads(state.read(name)) for name in state.names("")}
    assert own == {
        "totals": files["totals.json"],
        "rules": files["alerts/rules.json"],
        "addresses": files["alerts/lines.json"],
        "outbox/7-coughs": files["alerts/outbox/7-coughs.json"],
        "mqtt": files["mqtt-home.json"],
    }
    with closing(state_in(tmp_path, "attic")) as state:
        assert json.loads(state.read("mqtt")) == files["mqtt-attic.json"]
    assert {path.name for path in tmp_path.iterdir()} == {"page-token", "state.sqlite3"}
    (tmp_path / "totals.json").write_text("[1]")  # of an earlier version that ran meanwhile
    assert state_in(tmp_path).read("totals") == "[1]"


def test_a_file_of_an_earlier_version_that_cannot_be_read_is_named_and_takes_no_other(tmp_path):
    output = []
    (tmp_path / "totals.json").write_bytes(b"\xff\xfe")
    (tmp_path / "mqtt-home.json").write_text("{}")
    assert state_in(tmp_path, say=output.append).names("") == ["mqtt"]
    (line,) = output
    assert line.startswith(f"{tmp_path}/totals.json: cannot be read (")
    assert (tmp_path / "totals.json").exists()


@pytest.mark.parametrize("damage", ["text", "page", "cut"])
def test_a_damaged_file_is_set_aside_and_the_bridge_starts_over(tmp_path, damage):
    with closing(state_in(tmp_path)) as state:
        for number in range(200):
            state.write(f"outbox/{number}", json.dumps({"text": "x" * 100}))
    path = tmp_path / "state.sqlite3"
    content = path.read_bytes()
    changed = {
        "text": b"this was a file",
        "page": content[:4096] + bytes(4096) + content[8192:],
        "cut": content[: len(content) // 2],
    }
    path.write_bytes(changed[damage])
    output = []
    with closing(state_in(tmp_path, say=output.append)) as state:
        assert state.names("") == []
        state.write("list", "[1]")
    (line,) = output
    assert line.startswith(f"{path}: is damaged (")
    (aside,) = tmp_path.glob("state.sqlite3.damaged-*")
    assert aside.name in line
    assert aside.read_bytes() == changed[damage]
    assert entry_of(state_in(tmp_path)).load() == [1]


def test_a_damaged_entry_is_named_and_takes_no_other(tmp_path):
    output, state = [], state_in(tmp_path)
    state.write("list", '{"a": 1}')
    state.write("other", "[3]")
    assert entry_of(state, output.append).load() is None
    assert output == [f"{tmp_path}/state.sqlite3, list: starts over"]
    assert StateEntry(state, "other", list[int], pytest.fail, "", "").load() == [3]


def test_a_file_of_a_later_version_is_refused_and_not_changed(tmp_path):
    with closing(state_in(tmp_path)) as state:
        entry_of(state).save([1])
    path = tmp_path / "state.sqlite3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 2")
    before = path.read_bytes()
    with pytest.raises(BridgeError, match="written by a later version of hearthlog; update"):
        state_in(tmp_path).claim(tmp_path)
    assert path.read_bytes() == before


def test_two_bridges_of_a_recorder_do_not_share_a_state_but_those_of_two_do(tmp_path):
    tmp_path = tmp_path / "bridge"  # made by the first
    first = state_in(tmp_path)
    first.claim(tmp_path)
    with pytest.raises(BridgeError, match=r"is used by another bridge of home; stop that bridge"):
        state_in(tmp_path).claim(tmp_path)
    other = state_in(tmp_path, "attic")
    other.claim(tmp_path)
    assert entry_of(first).save([1])
    assert entry_of(other).save([2])
    assert [entry_of(each).load() for each in (first, other)] == [[1], [2]]
    first.close()
    state_in(tmp_path).claim(tmp_path)


def test_the_entries_of_a_former_name_are_adopted_but_not_those_of_a_bridge_that_runs(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(bridge_state, "is_renamed", lambda *_, **__: True)
    for node in ("attic", "cellar"):
        with closing(state_in(tmp_path, node)) as state:
            for name in ("mqtt", "rules", f"outbox/{node}"):
                state.write(name, f'"{node}"')
    running = state_in(tmp_path, "cellar")
    monkeypatch.setattr(bridge_state, "is_renamed", lambda *_, **__: False)
    running.claim(tmp_path)
    monkeypatch.setattr(bridge_state, "is_renamed", lambda *_, **__: True)
    with closing(state_in(tmp_path)) as state:
        state.write("rules", '"home"')
        state.claim(tmp_path)
        own = {name: json.loads(state.read(name)) for name in state.names("")}
    assert own == {"mqtt/attic": "attic", "outbox/attic": "attic", "rules": "home"}
    assert running.names("") == ["mqtt", "outbox/cellar", "rules"]
    assert state_in(tmp_path, "attic").names("") == []


WRITING = """
import sys
from pathlib import Path
from hearthlog.analyzer.bridge.state import BridgeState
state = BridgeState(Path(sys.argv[1]), "home", print)
number = int(state.read("b") or 0)
while True:
    number += 1
    state.write("a", str(number))
    state.write("b", str(number), [f"outbox/{number - 1}"])
    state.write(f"outbox/{number}", "{}")
    print(number, flush=True)
"""


def test_a_kill_at_any_moment_loses_nothing_that_was_written(tmp_path):
    for count in range(6):
        command = [sys.executable, "-c", WRITING, tmp_path]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for _ in range(5 + 7 * count):
                done = process.stdout.readline()
            process.send_signal(signal.SIGKILL)
            done = (process.stdout.read().splitlines() or [done])[-1]
        with closing(state_in(tmp_path)) as state:
            a, b, box = int(state.read("a")), int(state.read("b")), state.names("outbox/")
        assert b >= int(done)
        assert a - b in {0, 1}
        assert box in ([f"outbox/{b}"], [])


def test_a_file_that_cannot_be_used_for_a_while_is_read_and_written_later(tmp_path, monkeypatch):
    """A folder in the place of the log of SQLite: nothing can be opened, as on a broken disk."""
    with closing(state_in(tmp_path)) as state:
        for name in ("list", "gone"):
            state.write(name, "[1]")
    (tmp_path / "state.sqlite3-wal").mkdir()
    monkeypatch.setattr(bridge_state, "_AGAIN_SECONDS", 0.0)
    output = []
    state = state_in(tmp_path, say=output.append)
    state.claim(tmp_path)
    assert "cannot be used (" in output[0]
    assert entry_of(state).load() == [1]
    entry_of(state).save([1, 2])
    state.remove(["gone"])
    (tmp_path / "state.sqlite3-wal").rmdir()
    assert entry_of(state).load() == [1, 2]  # and the file is open again
    state.close()
    with closing(state_in(tmp_path)) as later:
        assert entry_of(later).load() == [1, 2]
        assert later.names("") == ["list"]


def test_what_cannot_be_carried_into_the_file_stays_in_memory_and_is_carried_later(
    tmp_path, monkeypatch
):
    with closing(state_in(tmp_path)) as state:
        state.write("list", "[1]")
    monkeypatch.setattr(bridge_state, "_AGAIN_SECONDS", 0.0)
    (tmp_path / "state.sqlite3-wal").mkdir()
    output = []
    state = state_in(tmp_path, say=output.append)
    entry_of(state).save([1, 2])
    (tmp_path / "state.sqlite3-wal").rmdir()
    with closing(sqlite3.connect(tmp_path / "state.sqlite3")) as database:
        database.execute(
            "CREATE TRIGGER refuse BEFORE INSERT ON entries BEGIN SELECT RAISE(FAIL, 'no'); END"
        )
        database.commit()
        assert entry_of(state).load() == [1, 2]
        assert output[-1].endswith("(no); entries stay in memory until it can be")
        database.execute("DROP TRIGGER refuse")
        database.commit()
    assert entry_of(state).load() == [1, 2]
    state.close()
    assert entry_of(state_in(tmp_path)).load() == [1, 2]


def fill(path):
    with suppress(OSError), path.open("wb", buffering=0) as stream:
        while True:
            stream.write(bytes(4096))


def test_a_full_disk_loses_nothing_that_was_written_before(tmp_path):
    output, saved = [], [1]
    with small_disk(tmp_path / "disk", "400k") as disk:
        with closing(state_in(disk)) as state:
            entry_of(state).save(saved)
            fill(disk / "filling")
            for number in range(200):  # until the log of SQLite no longer fits
                if not entry_of(state, output.append).save([number] * 500):
                    break
                saved = [number] * 500
        (line,) = output
        assert line == f"{state.path}: cannot be written (database or disk is full); kept in memory"
        with closing(state_in(disk, say=output.append)) as state:
            assert entry_of(state).load() == saved
            (disk / "filling").unlink()
            assert entry_of(state).save([7])
        with closing(state_in(disk)) as state:
            assert entry_of(state).load() == [7]
