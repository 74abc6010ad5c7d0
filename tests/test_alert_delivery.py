"""Rings wait on the disk until everybody was told of them, whatever happens."""

import signal
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from datetime import UTC
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from receivers import server
from waiting import wait_for

from hearthlog.analyzer.bridge.alerts import output
from hearthlog.analyzer.bridge.alerts.delivery import (
    UNREAD,
    Delivery,
    Outbox,
    find_targets,
    message,
)
from hearthlog.analyzer.bridge.alerts.output import AlertsOutput
from hearthlog.analyzer.bridge.alerts.rules import Notification
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.settings import DeliverySettings, RecorderAddress, page_token
from hearthlog.analyzer.bridge.state import BridgeState
from hearthlog.analyzer.http import free_port

# Apprise asks for it where there is one.
pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")
SECOND = 1_000_000_000
WAIT = 30  # seconds, for what comes at once


def state_in(folder):
    return BridgeState(folder, "home", pytest.fail)


def ring(number, due=0):
    return Notification("coughs", number * SECOND, f"alert {number}", is_known=True, due=due)


def addresses(folder, *lines):
    file = folder / "urls"
    file.write_text("\n".join(["# secret", *lines]))
    file.chmod(0o600)
    return file


def test_what_was_not_told_to_all_is_there_after_the_next_start(tmp_path):
    outbox = Outbox(state_in(tmp_path), ["a", "b"], pytest.fail)
    outbox.put([ring(1), ring(2, due=9), ring(1)])
    assert outbox.waiting_for("a", 8) == [ring(1)]
    outbox.record_delivery("a", ring(1))
    again = Outbox(state_in(tmp_path), ["a", "b"], pytest.fail)
    assert again.waiting_for("a", 10) == [ring(2, due=9)]
    assert again.waiting_for("b", 10) == [ring(1), ring(2, due=9)]
    again.record_delivery("b", ring(1))
    assert state_in(tmp_path).names("outbox") == [f"outbox/{ring(2).id}"]
    # Told meanwhile; evaluated once more, for the bridge had no time to remember.
    again.put([ring(1)])
    assert len(again) == 1


def test_a_full_outbox_drops_the_oldest_and_says_what_to_do(tmp_path):
    printed = []
    outbox = Outbox(state_in(tmp_path), ["a"], printed.append, most=3)
    outbox.put(ring(number) for number in range(1, 6))
    assert [each.time // SECOND for each in outbox.waiting_for("a", 1)] == [3, 4, 5]
    assert len(state_in(tmp_path).names("outbox")) == 3
    assert printed == [
        (
            "3 alerts are waiting, and the oldest are dropped; see above which "
            "target fails; repair it, or remove it from urls_file"
        )
    ]


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"rule": 1}', "\0" * 9, "[" * 100_000])
def test_a_file_that_is_no_ring_is_named_and_left_alone(content, tmp_path):
    printed, state = [], state_in(tmp_path)
    state.write("outbox/1-x", content)
    outbox = Outbox(state, ["a"], printed.append)
    assert len(outbox) == 0
    assert printed == [f"{state.path}, outbox/1-x: cannot be read; this alert is not delivered"]


def test_a_folder_that_takes_nothing_is_said_and_the_ring_told_all_the_same(tmp_path):
    printed = []
    state = state_in(tmp_path)
    outbox = Outbox(state, ["a"], printed.append)
    with closing(sqlite3.connect(state.path)) as other:
        other.execute("DROP TABLE entries")
    outbox.put([ring(1)])
    assert outbox.waiting_for("a", 1) == [ring(1)]
    assert len(printed) == 1
    assert "until it can, alerts are only kept in memory" in printed[0]


def test_a_target_that_is_away_is_told_when_it_is_back(tmp_path):
    port, printed = free_port(), []
    targets = find_targets(addresses(tmp_path, f"json://127.0.0.1:{port}"), printed.append).targets
    outbox = Outbox(state_in(tmp_path), [each.name for each in targets], printed.append)
    outbox.put([ring(1), ring(2)])
    delivery = Delivery(outbox, targets, "home", UTC, printed.append, first_pause=0.01)
    try:
        wait_for(lambda: len(printed) > 1)
        with server(port) as (_, texts):
            wait_for(lambda: not len(outbox))
            assert [text[-7:] for text in [t.removesuffix(" (delivered late)") for t in texts]] == [
                "alert 1",
                "alert 2",
            ]
    finally:
        delivery.close()
    assert len(set(printed)) == 1
    assert printed[0].startswith(
        "line 2, json://127.0.0.1: an alert could not be delivered (no connection)"
    )
    assert state_in(tmp_path).names("outbox") == []


def test_a_target_that_never_answers_holds_up_neither_the_others_nor_the_end(tmp_path):
    printed = []
    with socket.socket() as mute, server() as (port, texts):
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        dead = f"json://127.0.0.1:{mute.getsockname()[1]}?cto=1&rto=1"
        targets = find_targets(
            addresses(tmp_path, dead, f"json://127.0.0.1:{port}"), printed.append
        ).targets
        outbox = Outbox(state_in(tmp_path), [each.name for each in targets], printed.append)
        outbox.put([ring(1)])
        delivery = Delivery(outbox, targets, "home", UTC, printed.append, first_pause=60.0)
        wait_for(lambda: texts)
        wait_for(lambda: printed)
        delivery.close()
    assert len(texts) == 1
    assert outbox.waiting_for(targets[0].name, 1) == [ring(1)]
    assert outbox.waiting_for(targets[1].name, 1) == []


def test_the_pauses_after_a_failure_grow_to_a_quarter_of_an_hour_and_begin_anew(tmp_path):
    answers = ["down"] * 9 + [""] + ["down"] * 2

    class Failing:
        name = place = "a"

        def deliver(self, *_):
            return answers.pop(0)

    waits = []

    class Stop:
        def wait(self, seconds):
            waits.append(seconds)
            return not answers

        def is_set(self):
            return False

    outbox = Outbox(state_in(tmp_path), ["a"], pytest.fail)
    outbox.put([ring(1), ring(2)])
    delivery = Delivery(outbox, [], "home", UTC, lambda _: None)
    delivery._run(Failing(), Stop())
    pauses = [seconds for seconds in waits if seconds != 0.5]
    assert pauses == [5, 10, 20, 40, 80, 160, 320, 640, 900, 5, 10]


def test_a_ring_is_told_with_its_time_and_late_as_late():
    late = Notification(
        "it", 1_772_348_400 * SECOND, "None", is_known=True, due=1_772_348_400 * SECOND
    )
    assert message(late, UTC, late.due + SECOND) == "2026-03-01 07:00: None"
    assert message(late, UTC, late.due + 3600 * SECOND) == (
        "2026-03-01 07:00: None (delivered late)"
    )
    waited = late._replace(due=late.due + 3600 * SECOND)
    assert message(waited, UTC, waited.due + SECOND) == "2026-03-01 07:00: None"


def test_a_line_that_is_no_address_is_named_by_its_number_and_not_told(tmp_path):
    file = addresses(tmp_path, "json://127.0.0.1", "", "nosuch://user:hush@there")
    (problem,) = find_targets(file, pytest.fail).problems
    assert problem.startswith(f"{file}, line 4: no address that Apprise knows")
    assert "hush" not in problem


@pytest.mark.parametrize(
    ("encoding", "mark", "end"),
    [("utf-8", "\ufeff", "\r\n"), ("utf-16-le", "\ufeff", "\r\n"), ("utf-8", "", "\r")],
)
def test_a_file_of_addresses_is_read_as_editors_write_it(tmp_path, encoding, mark, end):
    file = tmp_path / "urls"
    lines = ["json://127.0.0.1/a", "", "# é", "  json://127.0.0.1/b  ", "json://127.0.0.1/a"]
    file.write_bytes(f"{mark}{end.join(lines)}{end}".encode(encoding))
    file.chmod(0o600)
    assert [each.place[:6] for each in find_targets(file, pytest.fail).targets] == [
        "line 1",
        "line 4",
    ]


def test_one_wrong_line_keeps_nobody_else_from_being_told_and_is_told_late_when_it_is_mended(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(output, "_LOOK_AT_FILE_SECONDS", 0.0)
    home, printed, broker = RecorderAddress(tmp_path / "logs", "home", UTC), [], []
    now = time.time_ns()
    rung = [Notification("it", now + n, f"ring {n}", is_known=True, due=now) for n in (1, 2)]

    def send(_name, text, _time):
        broker.append(text)
        return True

    with server() as (port, good), server() as (other, mended):
        right, typo = f"json://127.0.0.1:{port}", f"jsno://hush:hush@127.0.0.1:{other}"
        file = addresses(tmp_path, right, typo)
        settings = DeliverySettings(urls_file=file)
        for ring_now in rung:  # before and after a start of the bridge
            own = AlertsOutput([], settings, home, state_in(tmp_path), printed.append, send)
            own._outbox.put([ring_now])
            wait_for(partial(_is_told, own, broker))
            wait_for(lambda: len(good) == 1)
            assert broker[0].endswith(ring_now.text)
            assert good[0].endswith(ring_now.text)
            broker.clear()
            good.clear()
            assert mended == []
            if ring_now is rung[0]:
                own.close()
        addresses(tmp_path, right, typo.replace("jsno", "json"))
        wait_for(lambda: len(mended) == 2)
        wait_for(lambda: len(own._outbox) == 0)
        addresses(tmp_path, typo)  # nobody is left but the broker
        wait_for(lambda: UNREAD in own._outbox._targets)
        own._outbox.put([rung[0]._replace(text="alone", rule="other")])
        wait_for(partial(_is_told, own, broker))
        own.close()
    assert [text.partition(": ")[2] for text in mended] == ["ring 1", "ring 2"]
    assert good == []
    assert {line.partition(";")[0] for line in printed} == {
        f"alerts: {file}, line 3: no address that Apprise knows",
        f"alerts: {file}, line 2: no address that Apprise knows",
        f"alerts: {file}: every line of it can be read now",
    }


def test_who_is_on_a_line_that_is_edited_is_told_nothing_twice_while_another_line_is_wrong(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(output, "_LOOK_AT_FILE_SECONDS", 0.0)
    home, printed, now = RecorderAddress(tmp_path / "logs", "home", UTC), [], time.time_ns()
    with server() as (port, good), server() as (other, mended):
        right, typo = f"json://127.0.0.1:{port}", f"jsno://127.0.0.1:{other}"
        settings = DeliverySettings(urls_file=addresses(tmp_path, right, typo))
        own = AlertsOutput([], settings, home, state_in(tmp_path), printed.append)
        own._outbox.put([Notification("it", now, "first", is_known=True, due=now)])
        wait_for(lambda: len(good) == 1)
        before = own._lines
        addresses(tmp_path, "# anna", f"{right}/?verify=no", typo)  # while it runs
        wait_for(lambda: own._lines != before)
        own.close()
        addresses(tmp_path, f"{right}/?verify=yes", typo, "# and while it does not")
        own = AlertsOutput([], settings, home, state_in(tmp_path), printed.append)
        own._outbox.put([Notification("it", now + 1, "second", is_known=True, due=now)])
        wait_for(lambda: len(good) == 2)
        addresses(tmp_path, f"{right}/?rto=9", typo.replace("jsno", "json"))  # both at once
        wait_for(lambda: len(mended) == 2)
        own._outbox.put([Notification("it", now + 2, "third", is_known=True, due=now)])
        wait_for(lambda: len(own._outbox) == 0)
        own.close()
    for texts in (good, mended):
        assert [text.partition(": ")[2] for text in texts] == ["first", "second", "third"]


def test_addresses_are_read_again_when_the_package_that_was_missing_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(output, "_LOOK_AT_FILE_SECONDS", 0.0)
    home, printed, now = RecorderAddress(tmp_path / "logs", "home", UTC), [], time.time_ns()
    with server() as (port, texts):
        settings = DeliverySettings(urls_file=addresses(tmp_path, f"json://127.0.0.1:{port}"))
        with monkeypatch.context() as missing:
            missing.setitem(sys.modules, "apprise", None)
            own = AlertsOutput([], settings, home, state_in(tmp_path), printed.append)
            own._outbox.put([Notification("it", now, "first", is_known=True, due=now)])
            assert printed[0].startswith("alerts: apprise is not installed; try: ")
        wait_for(lambda: len(texts) == 1)
        own.close()
    assert printed[-1].endswith("every line of it can be read now")


def _is_told(own, broker):
    own.update(SimpleNamespace(state=HomeState(), columns=()))
    return len(broker) == 1


def test_what_waits_for_a_wrong_line_alone_is_dropped_after_a_day(tmp_path):
    now = time.time_ns()
    old, recent = (
        Notification("it", now - hours * 3600 * SECOND, "", is_known=True, due=0)
        for hours in (25, 23)
    )
    outbox = Outbox(state_in(tmp_path), ["a", UNREAD], pytest.fail)
    outbox.put([old, recent])
    for each in (old, recent):
        outbox.record_delivery("a", each)
    outbox.put([])
    outbox.set_targets(["b"], now)
    assert outbox.waiting_for("b", now) == [recent]


@pytest.mark.parametrize("content", [None, "", "# nothing\n"])
def test_without_an_address_the_broker_is_told_all_the_same(tmp_path, content):
    file, printed, reported = tmp_path / "urls", [], []
    if content is not None:
        file.write_text(content)
        file.chmod(0o600)
    settings, home = (
        DeliverySettings(urls_file=file),
        RecorderAddress(tmp_path / "logs", "home", UTC),
    )
    own = AlertsOutput(
        [],
        settings,
        home,
        state_in(tmp_path),
        printed.append,
        lambda *given: reported.append(given) or True,
    )
    own._outbox.put([ring(1)])
    own.update(SimpleNamespace(state=HomeState(), columns=()))
    own.close()
    assert len(reported) == 1
    assert printed[0].startswith(f"alerts: {file}: no ")


def test_a_file_without_an_address_and_one_that_is_not_there_are_refused(tmp_path):
    (empty,) = find_targets(addresses(tmp_path), pytest.fail).problems
    assert "no address in it" in empty
    (missing,) = find_targets(tmp_path / "none", pytest.fail).problems
    assert "no such file of addresses" in missing


def test_a_file_of_secrets_that_everybody_may_read_is_said(tmp_path):
    printed = []
    file = addresses(tmp_path, "json://127.0.0.1")
    file.chmod(0o644)
    (target,) = find_targets(file, printed.append).targets
    assert printed == [
        f"{file}: holds secrets, and everybody on this machine may read it: chmod 600 {file}"
    ]
    assert target.place == "line 2, json://127.0.0.1"


def test_files_of_secrets_are_looked_for_among_the_credentials_of_systemd(tmp_path, monkeypatch):
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    addresses(tmp_path, "json://127.0.0.1")
    (tmp_path / "token").write_text("abcdefghijklmnop\n")
    assert len(find_targets(Path("urls"), pytest.fail).targets) == 1
    assert page_token(Path("token"), tmp_path) == "abcdefghijklmnop"
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", "/nowhere")
    assert len(find_targets(tmp_path / "urls", pytest.fail).targets) == 1
    assert page_token(tmp_path / "token", tmp_path) == "abcdefghijklmnop"


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("ntfy://ntfy.sh/hush", "ntfy://ntfy.sh"),
        ("ntfys://hush:hush@ntfy.example.org:8443/hush?title=hush", "ntfys://ntfy.example.org"),
        ("mailto://hush:hush@example.org", "mailto://example.org"),
        ("json://[::1]:8080/hush", "json://[::1]"),
        ("ntfy://hush", "ntfy"),  # a topic
        ("ntfy://hush.hush", "ntfy"),
        ("json://hush/hush", "json"),
        ("pbul://o.hush", "pbul"),
        ("discord://4174216298/hush-hush", "discord"),
        ("https://discord.com/api/webhooks/4174216298/hush-hush", "https"),
        ("json://hush:hu@sh.hush@example.org", "json"),  # not escaped
        ("json://sh.hush/hush@example.org", "json"),
    ],
)
def test_a_target_is_named_by_its_line_and_at_most_its_scheme_and_host(address, place, tmp_path):
    (target,) = find_targets(addresses(tmp_path, address), pytest.fail).targets
    assert target.place == f"line 2, {place}"


def test_no_part_of_an_address_is_said_when_it_cannot_be_reached_or_refuses(tmp_path, capfd):
    printed = []
    with server(status=403) as (port, _):
        places = [f"127.0.0.1:{each}/hush-topic" for each in (port, free_port())]
        kinds = ("ntfy", "json", "xml", "form", "gotify", "mmost")
        lines = [f"{kind}://hush:hush@{place}" for kind in kinds for place in places]
        targets = find_targets(addresses(tmp_path, *lines), printed.append).targets
        outbox = Outbox(state_in(tmp_path), [each.name for each in targets], printed.append)
        outbox.put([ring(1)])
        delivery = Delivery(outbox, targets, "home", UTC, printed.append)
        wait_for(lambda: len(set(printed)) == len(lines))
        delivery.close()
    refused = {int(line.split(",")[0].split()[1]) for line in printed if "(error 403)" in line}
    away = {int(line.split(",")[0].split()[1]) for line in printed if "(no connection)" in line}
    assert (refused, away) == (set(range(2, 14, 2)), set(range(3, 14, 2)))
    assert capfd.readouterr() == ("", "")
    assert "hush" not in "".join(printed)


def test_the_password_of_an_address_is_in_no_line_and_no_file(tmp_path):
    printed = []
    file = addresses(tmp_path, f"json://user:hush@127.0.0.1:{free_port()}")
    targets = find_targets(file, printed.append).targets
    outbox = Outbox(state_in(tmp_path), ["x", *(each.name for each in targets)], printed.append)
    outbox.put([ring(1)])
    delivery = Delivery(outbox, targets, "home", UTC, printed.append)
    wait_for(lambda: printed)
    delivery.close()
    outbox.record_delivery(targets[0].name, ring(1))
    (kept,) = state_in(tmp_path).names("outbox")
    files = [path.read_bytes() for path in tmp_path.glob("state*")]
    assert any(kept.encode() in content for content in files)
    assert not any(b"hush" in content for content in files)
    assert "hush" not in "".join(printed)


DELIVERING = """
import sys, time
from datetime import UTC
from functools import partial
from pathlib import Path
from hearthlog.analyzer.bridge.alerts.delivery import Delivery
from hearthlog.analyzer.bridge.alerts.delivery import Outbox
from hearthlog.analyzer.bridge.alerts.rules import Notification
from hearthlog.analyzer.bridge.alerts.delivery import find_targets
from hearthlog.analyzer.bridge.state import BridgeState
folder = Path(sys.argv[1])
targets = find_targets(folder / "urls", print).targets
state = BridgeState(folder, "home", print)
outbox = Outbox(state, [each.name for each in targets], print)
outbox.put(Notification("coughs", n, f"alert {n}", True, 0) for n in map(int, sys.argv[2:]))
print("kept", flush=True)
delivery = Delivery(outbox, targets, "home", UTC, print, first_pause=0.01)
while len(outbox):
    time.sleep(0.01)
"""


def test_a_bridge_that_is_killed_again_and_again_tells_of_every_ring(tmp_path):
    """At most the one that was under way at a kill is told twice."""
    kills = 4
    with server() as (port, texts):
        addresses(tmp_path, f"json://127.0.0.1:{port}")
        everything = range(1, 121)
        for start in range(kills + 1):
            new = everything if start == 0 else ()
            command = [sys.executable, "-c", DELIVERING, tmp_path, *map(str, new)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            assert process.stdout.readline() == "kept\n"
            if start < kills:
                reported = len(texts)
                wait_for(lambda reported=reported: len(texts) >= reported + 5)
                process.send_signal(signal.SIGKILL)
            process.communicate(timeout=WAIT)
            assert process.returncode == (-signal.SIGKILL if start < kills else 0)
        numbers = [int(text.removesuffix(" (delivered late)").rpartition(" ")[2]) for text in texts]
    assert set(numbers) == set(everything)
    assert len(numbers) <= len(everything) + kills
    assert not list((tmp_path / "box").glob("*.json"))
