"""A real broker of MQTT, Mosquitto, on a port of its own; and what it holds and says."""

import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import pytest
from microphones import DIES_WITH_PARENT

from hearthlog.analyzer.http import free_port

_SECONDS = 60.0
_SETTINGS = "allow_anonymous true\npersistence false\n"
_AS_WE = "user root\n"  # else it gives up the right to read its files, where root starts it


class Broker:
    """Mosquitto, which may be ended and started again on its port.

    Attributes
    ----------
    port : int
    said : Path
        What it writes to its log.
    """

    def __init__(self, folder: Path, settings: str = _SETTINGS):
        self.port = free_port()
        self.log_file = folder / "mosquitto.log"
        self._configuration = folder / "mosquitto.conf"
        self._configuration.write_text(f"{_AS_WE}listener {self.port} 127.0.0.1\n{settings}")
        self.start()

    def start(self):
        with self.log_file.open("ab") as log:
            self._process = subprocess.Popen(
                [*DIES_WITH_PARENT, _mosquitto(), "-c", str(self._configuration)],
                stdout=log,
                stderr=log,
            )
        until = time.monotonic() + _SECONDS
        while time.monotonic() < until:
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
            except OSError:
                time.sleep(0.02)
            else:
                return
        pytest.fail(f"Mosquitto did not start: {self.log_file.read_text()}")

    def hang(self):
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self):
        self._process.send_signal(signal.SIGCONT)

    def kill(self):
        self._process.kill()
        self._process.wait(timeout=5)


class SlowLink:
    """A way to a broker on which each mebibyte that the broker sends takes a while.

    Attributes
    ----------
    port : int
        Where it takes one client.
    """

    def __init__(self, port: int, seconds: float):
        self._broker, self._seconds = port, seconds
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)

    def _serve(self):
        client, _ = self._server.accept()
        with client, socket.create_connection(("127.0.0.1", self._broker)) as broker:
            back = threading.Thread(target=_forward, args=(client, broker))
            back.start()
            _forward(broker, client, self._seconds)
            back.join()

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._thread.join(_SECONDS)
        self._server.close()


def _forward(source: socket.socket, target: socket.socket, seconds: float = 0.0):
    count = 0
    while data := source.recv(1 << 14):
        target.sendall(data)
        if (count + len(data)) >> 20 > count >> 20:
            time.sleep(seconds)
        count += len(data)
    target.shutdown(socket.SHUT_WR)


class Listener:
    """A client of a broker that notes all that it is told.

    Attributes
    ----------
    values : dict of str to str
        The newest payload of each topic.
    messages : list of (float, str, str, bool)
        When it came (seconds of UTC), topic, payload, whether the broker had kept it.
    """

    def __init__(self, port: int, topics: str = "#"):
        import paho.mqtt.client as mqtt  # noqa: PLC0415  which the wheel is tested without

        self.values = {}
        self.messages = []
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._is_ready = threading.Event()
        self._client.on_connect = lambda client, *_: client.subscribe(topics, 1)
        self._client.on_subscribe = lambda *_: self._is_ready.set()
        self._client.on_message = self._note
        self._client.reconnect_delay_set(1, 1)
        self._client.connect_async("127.0.0.1", port)
        self._client.loop_start()

    def _note(self, _client, _data, message):
        payload = message.payload.decode()
        self.values[message.topic] = payload
        self.messages.append((time.time(), message.topic, payload, message.retain))

    def payloads(self, topic: str) -> list[str]:
        return [payload for _, name, payload, _ in list(self.messages) if name == topic]

    def publish(self, topic: str, payload: str, *, retain: bool = False):
        assert self._is_ready.wait(_SECONDS)
        self._client.publish(topic, payload, 1, retain).wait_for_publish(_SECONDS)

    def wait_for(self, topic: str, value: str | None = None, seconds: float = 120.0) -> str:
        """Wait until a topic has a value, any or this one, and return it."""
        return (
            self.wait_until(
                lambda: topic in self.values and value in {None, self.values[topic]},
                seconds,
            )
            and self.values[topic]
        )

    def wait_until(self, holds, seconds: float = 120.0) -> bool:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            if holds():
                return True
            time.sleep(0.05)
        newest = [(topic, payload[:80]) for _, topic, payload, _ in self.messages[-30:]]
        pytest.fail(f"it did not come; what came last: {newest}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._client.disconnect()
        self._client.loop_stop()
        self._client._reset_sockets()  # which it leaves to the garbage collector


@pytest.fixture
def broker(tmp_path):
    """A broker that lets everybody in; without persistence, so a kill empties it."""
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


def start_bridge(config: Path, output: Path, *options: str) -> subprocess.Popen:
    """Start `hearthlog bridge`; what it says goes to a file."""
    from conftest import HEARTHLOG  # noqa: PLC0415  which imports this module

    with output.open("ab") as log:
        return subprocess.Popen(
            [*DIES_WITH_PARENT, *HEARTHLOG, "bridge", "--config", str(config), *options],
            stdout=log,
            stderr=log,
        )


def settled_values(port: int, topics: str = "#", seconds: float = 1.0) -> dict[str, str]:
    """Return what a broker keeps, as a client finds it that comes now."""
    with Listener(port, topics) as listener:
        threading.Event().wait(seconds)
        return dict(listener.values)


def _mosquitto() -> str:
    found = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if found is None:
        reason = "a broker needs the Debian package mosquitto"
        if os.environ.get("TESTS_REQUIRE_BROKER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return found
