"""`hearthlog doctor --live` says what is wrong with a recorder now, and what to do."""

import json
import os
import shutil
import signal
import subprocess
import time
from contextlib import closing, suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from socket import create_server
from threading import Thread

import pytest
from conftest import HEARTHLOG
from test_capture import wait_for_frames
from test_disk import small_disk
from test_model_changes import wait_for
from test_pauses import recording

from hearthlog.analyzer import http
from hearthlog.analyzer.recorder_status import examine_live
from hearthlog.recorder.log.folder_lock import FolderLock
from hearthlog.schemas.logs.files import active_path, find_logs, log_path

__all__ = ["small_disk"]


def states(logs):
    return {state.subject: (state.level, state.text) for state in examine_live(logs)}


def doctor(*arguments):
    return subprocess.run([*HEARTHLOG, "doctor", "--live", *map(str, arguments)], check=False,
                          capture_output=True, text=True)  # fmt: skip


def test_what_is_well_is_said_too(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 30)
        assert states(logs)["recorder"] == ("ok", f"home runs (process {process.pid})")
        assert states(logs)["mic"] == ("ok", "listening")
        result = doctor(logs, "--json")
    levels = {state["subject"]: state["level"] for state in json.loads(result.stdout)}
    assert (levels["mic"], levels["machine"]) == ("ok", "ok")
    assert "error" not in levels.values()
    assert result.returncode in {0, 3}, "3 where nothing keeps the clock of this machine right"


def test_a_microphone_that_is_gone_is_an_error_until_it_is_back(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 30)
        labmic.unplug()
        wait_for(lambda: states(logs)["mic"][0] == "error")
        assert "`hearthlog devices` lists what is there" in states(logs)["mic"][1]
        wait_for(lambda: "waiting for it" in states(logs)["mic"][1])
        assert doctor(logs).returncode == 1
        labmic.restore()
        wait_for(lambda: states(logs)["mic"] == ("ok", "listening"))


def test_a_recorder_that_does_not_run_is_an_error(labmic, tmp_path):
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 10)
    level, text = states(logs)["recorder"]
    assert level == "error"
    assert text.startswith("home does not run since 20")
    assert "start it" in text


def test_a_recorder_that_hangs_is_an_error(labmic, tmp_path, monkeypatch):
    monkeypatch.setattr("hearthlog.analyzer.recorder_status._SPEAKS_SECONDS", 2.0)
    logs = tmp_path / "logs"
    with recording(labmic, logs) as process:
        wait_for_frames(logs, 30)
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.5)
        found = [state for state in examine_live(logs) if state.level == "error"]
        process.send_signal(signal.SIGCONT)
    assert [state.subject for state in found] == ["recorder"]
    assert "or restart it" in found[0].text


def test_a_full_disk_is_an_error(small_disk):
    logs = small_disk / "logs"
    logs.mkdir(mode=0o700)
    with suppress(OSError):
        (small_disk / "rest").write_bytes(bytes(1 << 30))
    assert states(logs)["disk"][0] == "error"
    assert "No space left on device" in states(logs)["disk"][1]
    assert "make room" in states(logs)["disk"][1]
    (small_disk / "rest").unlink()
    assert "disk" not in states(logs)
    assert list(logs.iterdir()) == []


def test_a_folder_into_which_files_were_recorded_has_no_recorder(recorded, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(recorded, logs)
    assert states(logs)["recorder"][0] == "error"


def recorders(logs):
    return [(s.level, s.text) for s in examine_live(logs) if s.subject == "recorder"]


def add_node(logs, node, start, *, unfinished=False):
    """Copy a log of `home` to another node, with the lock that such a recorder leaves."""
    path = log_path(logs, node, start)
    path.parent.mkdir(parents=True, exist_ok=True)
    log = next(log for log in find_logs(logs) if log.name.startswith("home_"))
    shutil.copy(log, active_path(path) if unfinished else path)
    (logs / f".{node}.lock").write_text("4194305\n")


def test_a_file_that_ends_in_lock_is_a_recorder_only_if_one_has_written_it(recorded, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(recorded, logs)
    for name in (".groups.safetensors.lock", ".voices.safetensors.lock", ".empty.lock"):
        (logs / name).touch()
    (logs / ".text.lock").write_text("not a process")
    (logs / ".folder.lock").mkdir()
    os.mkfifo(logs / ".pipe.lock")
    (logs / ".link.lock").symlink_to(logs / ".home.lock")
    with FolderLock(logs, "home"):
        found = recorders(logs)
        assert found[0] == ("ok", f"home runs (process {os.getpid()})")
        assert all(text.startswith("home ") for _, text in found)


def test_a_recorder_that_was_renamed_is_no_alarm_and_one_that_was_killed_is(recorded, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(recorded, logs)
    add_node(logs, "former", 1_700_000_000 * 10**9)
    add_node(logs, "killed", 1_700_000_000 * 10**9, unfinished=True)
    with FolderLock(logs, "home"):
        found = {text.split()[0]: (level, text) for level, text in recorders(logs)}
    level, text = found["former"]
    assert level == "warning"
    assert text.endswith(f"or delete {logs}/.former.lock if no recorder has this name any more")
    level, text = found["killed"]
    assert (level, text.startswith("killed does not run since 20")) == ("error", True)
    (logs / ".former.lock").unlink()
    assert all("former" not in text for _, text in recorders(logs))
    assert ("error", "home does not run") in [(lv, text[:17]) for lv, text in recorders(logs)]


def test_a_folder_that_others_may_look_into_is_a_warning(tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir(mode=0o755)
    logs.chmod(0o755)
    level, text = states(logs)["rights"]
    assert (level, text.endswith(f"`chmod -R go= {logs}`")) == ("warning", True)
    logs.chmod(0o700)
    assert "rights" not in states(logs)


def test_there_is_no_such_folder():
    result = doctor("nowhere")
    assert result.returncode == 1
    assert result.stderr.startswith("hearthlog: nowhere: no such folder; name the one that the re")


@pytest.fixture
def watchdog():
    """A server that remembers what it was asked for."""
    requested = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requested.append(self.path)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            """Say nothing."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/mine", requested
    server.shutdown()
    server.server_close()


def test_a_watchdog_is_told_whether_all_is_well(labmic, tmp_path, watchdog):
    url, requested = watchdog
    logs = tmp_path / "logs"
    with recording(labmic, logs):
        wait_for_frames(logs, 30)
        doctor(logs, "--ping", url)
    (tmp_path / "url").write_text(f"{url}\n")
    doctor(logs, "--ping-file", tmp_path / "url")
    assert requested == ["/mine", "/mine/fail"]


def test_a_watchdog_that_hangs_is_waited_for_a_while(monkeypatch):
    monkeypatch.setattr(http, "_PING_SECONDS", 0.5)
    with closing(create_server(("127.0.0.1", 0))) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}/"
        assert http.ping(url, is_well=True) in {"no answer within 0 s", "timed out"}
    assert http.ping(url, is_well=True) == "Connection refused"


@pytest.mark.parametrize("url", ["file:///etc/passwd", "watchdog", "https://", "ftp://a/b"])
def test_what_is_no_address_of_a_watchdog_is_refused(tmp_path, url):
    result = doctor(tmp_path, "--ping", url)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("hearthlog: --ping needs an address")
    (tmp_path / "url").write_text(url)
    result = doctor(tmp_path, "--ping-file", tmp_path / "url")
    assert (result.returncode, result.stdout) == (1, "")
    assert "has no web address" in result.stderr
    output = result.stderr.replace(str(tmp_path / "url"), "").replace("https://hc-ping.com", "")
    assert url not in output
