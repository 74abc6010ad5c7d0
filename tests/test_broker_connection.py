"""A connection to a real broker says what is wrong with it, and loses nothing that counts."""

import gc
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from brokers import Broker, Listener, settled_values
from certificates import Authority

from hearthlog.analyzer.bridge.mqtt import connection
from hearthlog.analyzer.bridge.mqtt.connection import Connection
from hearthlog.analyzer.bridge.settings import MqttSettings
from hearthlog.analyzer.bridge.state import BridgeError

ALIVE = "hearthlog/home/bridge"


@contextmanager
def connected(broker, client_id="hearthlog-home", **settings):
    """A connection, and the lines that it says."""
    output = []
    settings = MqttSettings(host="127.0.0.1", port=broker.port, **settings)
    connection = Connection(
        settings, client_id, ALIVE, output.append, subscriptions=(), received=print
    )
    try:
        yield connection, output
    finally:
        connection.close()


def flush_until(connection, holds, seconds=80.0):
    """Flush as the bridge does, until something holds."""
    until = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < until
        connection.flush()
        time.sleep(0.05)


def test_a_broker_that_forgot_everything_is_told_everything_again(broker):
    with connected(broker) as (connection, _):
        connection.keep("hearthlog/home/mic/class/coughing/on", "ON")
        with Listener(broker.port) as listener:
            flush_until(connection, lambda: ALIVE in listener.values)
            flush_until(connection, lambda: len(listener.values) == 2)
        broker.kill()
        connection.keep("hearthlog/home/mic/class/coughing/on", "OFF")
        connection.flush()
        broker.start()
        with Listener(broker.port) as listener:
            flush_until(connection, lambda: len(listener.values) == 2)
        assert settled_values(broker.port, seconds=0.3) == {
            ALIVE: "online",
            "hearthlog/home/mic/class/coughing/on": "OFF",
        }


def test_a_closed_connection_keeps_no_socket_open(broker):
    before = open_sockets()
    with connected(broker) as (connection, _):
        flush_until(connection, connection.is_ready)
        own = open_sockets() - before
        assert own
    assert not own & open_sockets()  # though the connection is still referred to


def test_a_connection_is_not_ready_before_all_that_the_broker_kept_has_come(broker):
    topics = [f"hearthlog/old/{number}" for number in range(8)]
    with Listener(broker.port) as listener:
        for topic in topics:
            listener.publish(topic, "x", retain=True)
    came = []

    def received(message):
        time.sleep(0.2)  # a machine that is busy
        came.append(message.topic)

    settings = MqttSettings(host="127.0.0.1", port=broker.port)
    subscriptions = ("hearthlog/old/#",)
    connection = Connection(
        settings, "x", ALIVE, print, subscriptions=subscriptions, received=received
    )
    try:
        flush_until(connection, connection.is_ready)
        assert sorted(came) == topics
    finally:
        connection.close()


def open_sockets() -> set[str]:
    """Return the sockets that this process has open."""
    files = [file for file in Path("/proc/self/fd").iterdir() if file.is_symlink()]
    return {name for file in files if (name := str(file.readlink())).startswith("socket:")}


def test_a_value_is_said_once_and_an_event_each_time(broker):
    with Listener(broker.port) as listener, connected(broker) as (connection, _):
        listener.publish("c", "3")  # it is told of what comes from now on
        for _ in range(3):
            connection.keep("a", "1")
            connection.send("b", "2")
            flush_until(connection, lambda: bool(listener.payloads("b")))
        flush_until(connection, lambda: len(listener.payloads("b")) == 3)
        assert listener.payloads("a") == ["1"]
        assert [kept for _, topic, _, kept in listener.messages if topic == "b"] == 3 * [False]


def test_an_event_that_is_too_old_when_the_broker_comes_is_no_news(broker, monkeypatch):
    monkeypatch.setattr(connection, "_TIMELY_SECONDS", 0.5)
    broker.kill()
    with connected(broker) as (link, _):
        link.send("old", "1")
        time.sleep(0.6)
        link.send("new", "2")
        monkeypatch.setattr(connection, "_TIMELY_SECONDS", 10.0)
        link._events[0] = (link._events[0][0] - 10.0, *link._events[0][1:])
        broker.start()
        with Listener(broker.port) as listener:
            flush_until(link, lambda: "new" in listener.values)
            assert "old" not in listener.values


def test_a_broker_that_is_not_there_is_said_in_one_line_and_found_when_it_comes(broker):
    broker.kill()
    with connected(broker) as (connection, output):
        flush_until(connection, lambda: bool(output))
        assert output[0] == f"127.0.0.1:{broker.port}: no broker (Connection refused); trying again"
        broker.start()
        with Listener(broker.port) as listener:
            flush_until(connection, lambda: listener.values.get(ALIVE) == "online")


def test_a_refused_password_is_said_in_one_line_and_no_other_reason_after_it(tmp_path):
    broker = Broker(tmp_path, "allow_anonymous false\n")
    try:
        with connected(broker) as (connection, output):
            flush_until(connection, lambda: len(output) > 1)  # it is tried again
    finally:
        broker.kill()
    assert all(": refused: Not authorized; see user, password_file" in line for line in output)


def test_a_second_bridge_of_the_same_name_is_said_to_be_one(broker):
    with (
        connected(broker) as (first, output),
        Listener(broker.port) as listener,
    ):
        flush_until(first, lambda: listener.values.get(ALIVE) == "online")
        with connected(broker):
            flush_until(first, lambda: any("another client named" in line for line in output))
    assert "hearthlog-home running, a second bridge? give one of them another" in output[-1]


@pytest.fixture
def authority(tmp_path):
    return Authority(tmp_path, "authority")


@pytest.fixture
def tls_broker(tmp_path, authority):
    """A broker that wants certificates of its authority, and lets `bridge` write below `home`."""
    certificate, key = authority.sign("broker")
    rules = tmp_path / "acl"
    rules.write_text("user bridge\ntopic readwrite hearthlog/home/#\n")
    broker = Broker(
        tmp_path,
        f"cafile {authority.file}\ncertfile {certificate}\nkeyfile {key}\n"
        f"require_certificate true\nuse_identity_as_username true\nacl_file {rules}\n",
    )
    yield broker
    broker.kill()


@pytest.mark.fast
def test_a_client_certificate_opens_an_encrypted_connection(tls_broker, authority):
    certificate, key = authority.sign("bridge")
    files = {"ca_file": authority.file, "certificate_file": certificate, "key_file": key}
    with connected(tls_broker, tls=True, **files) as (connection, output):
        connection.keep("hearthlog/home/mic/heard", "x")
        flush_until(connection, lambda: not connection._unsent)
        time.sleep(0.2)
        assert output == []
        connection.send("elsewhere", "x")  # what the broker forbids
        flush_until(connection, lambda: bool(output))
    assert (
        "a message was refused: Not authorized; the broker must let this client write" in output[0]
    )


def test_a_missing_client_certificate_is_guessed_where_the_broker_only_hangs_up(
    tls_broker, authority
):
    with connected(tls_broker, tls=True, ca_file=authority.file) as (connection, output):
        flush_until(connection, lambda: bool(output))
    assert "does it need a client certificate? see certificate_file and key_file" in output[0]


# The client leaves the socket to the garbage collector where a certificate is refused.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_broker_whose_certificate_nobody_vouches_for_is_refused(tls_broker, tmp_path):
    with connected(tls_broker, tls=True, ca_file=Authority(tmp_path, "other").file) as (
        connection,
        output,
    ):
        flush_until(connection, lambda: bool(output))
    gc.collect()
    assert "its certificate is refused: " in output[0]
    assert "see ca_file" in output[0]


@pytest.mark.parametrize("missing", ["ca_file", "certificate_file", "password_file"])
def test_a_file_that_is_missing_is_named(tmp_path, missing):
    settings = MqttSettings(host="127.0.0.1", tls=True, user="x", **{missing: tmp_path / "none"})
    with pytest.raises(BridgeError, match="none"):
        Connection(settings, "x", ALIVE, print, subscriptions=(), received=print)


def test_a_password_is_taken_from_a_file(tmp_path, broker):
    users = tmp_path / "users"
    users.write_text("home:$7$101$")  # no password matches
    password = tmp_path / "password"
    password.write_text("wrong\n")
    password.chmod(0o600)
    broker.kill()
    guarded = Broker(tmp_path, f"password_file {users}\nallow_anonymous false\n")
    with connected(guarded, user="home", password_file=password) as (connection, output):
        flush_until(connection, lambda: bool(output))
    guarded.kill()
    assert "refused: " in output[0]
    assert "see user, password_file and client_id" in output[0]


def test_a_broker_that_hung_is_not_told_of_what_is_old(broker, monkeypatch):
    monkeypatch.setattr(connection, "_ANSWER_SECONDS", 0.2)
    monkeypatch.setattr(connection, "_TIMELY_SECONDS", 1.0)
    with connected(broker) as (link, _), Listener(broker.port) as listener:
        flush_until(link, lambda: listener.values.get(ALIVE) == "online" and link.is_ready())
        broker.hang()
        link.send("a", "on its way")
        link.flush()
        time.sleep(0.3)
        link.send("b", "waits")
        link.flush()
        time.sleep(1.1)
        broker.go_on()
        flush_until(link, lambda: "a" in listener.values and not link._events)
        monkeypatch.setattr(connection, "_TIMELY_SECONDS", 60.0)
        link.send("c", "new")
        flush_until(link, lambda: "c" in listener.values)
        assert "b" not in listener.values


def test_what_must_arrive_is_told_to_have_once_the_broker_has_it(broker):
    broker.kill()
    with connected(broker) as (link, _):
        assert not link.deliver("alert", "1")
        broker.start()
        with Listener(broker.port) as listener:
            flush_until(link, lambda: link.deliver("alert", "1"))
            flush_until(link, lambda: "alert" in listener.values)
            assert listener.payloads("alert") == ["1"]
            flush_until(link, lambda: link.deliver("alert", "1"))  # another one with the same words
            flush_until(link, lambda: listener.payloads("alert") == ["1", "1"])
