"""What is heard reaches a real broker, and survives the loss of broker, recorder and bridge."""

import json
import random
import signal
import subprocess
from pathlib import Path

import pytest
from bridged import expected_values
from brokers import Broker, Listener, settled_values, start_bridge
from killed_bridge import ZONE, kill_at_random, start_recorder

ROOT = "hearthlog/home"
_CLIPS = Path(__file__).parent / "data" / "household"


@pytest.fixture
def sounds():
    """Real recordings, of some minutes."""
    return sorted(_CLIPS.glob("coughing/*.flac")) + sorted(_CLIPS.glob("*/*.flac"))


class Home:
    """A recorder that hears real recordings, a broker, and a bridge between them."""

    def __init__(self, folder: Path, broker: Broker, sounds: list[Path], settings: str = ""):
        self.folder = folder
        self.said = folder / "said"
        self.config = folder / "home.toml"
        self.config.write_text(
            f'output = "{folder}/logs"\ntimezone = "{ZONE}"\n'
            f'[bridge.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n{settings}'
        )
        self.model = "general"
        self.sounds = sounds
        self.recorder = self.start_recorder()
        self.bridge = self.start_bridge()

    def start_recorder(self) -> subprocess.Popen:
        return start_recorder(self.config, self.sounds, self.model, self.said)

    def start_bridge(self) -> subprocess.Popen:
        return start_bridge(self.config, self.said)

    def close(self):
        for process in (self.recorder, self.bridge):
            process.kill()
            process.wait()


@pytest.fixture
def home(tmp_path, broker, sounds):
    home = Home(tmp_path, broker, sounds)
    yield home
    home.close()


def test_a_broker_has_states_and_counts_after_random_kills_as_the_logs_have_them(
    tmp_path, sounds
):
    ending = kill_at_random(tmp_path, sounds, "general", 22, 2, random.Random(3))
    assert sum(topic.endswith("/last_heard") for topic in ending.expected) > 1
    assert ending.wrong == [], ending.said


def test_a_recorder_that_stops_and_a_bridge_that_is_killed_are_said_to_be_away(home, broker):
    with Listener(broker.port) as listener:
        listener.wait_for(f"{ROOT}/mic/listening", "online")
        listener.wait_for(f"{ROOT}/recorder", "online")
        home.recorder.terminate()
        listener.wait_for(f"{ROOT}/mic/listening", "offline")
        listener.wait_for(f"{ROOT}/recorder", "offline")
        home.recorder = home.start_recorder()
        listener.wait_for(f"{ROOT}/mic/listening", "online")
        home.bridge.kill()
        listener.wait_for(f"{ROOT}/bridge", "offline")


def test_a_bridge_that_was_stopped_for_long_does_not_say_that_the_recorder_was_away(home, broker):
    with Listener(broker.port) as listener:
        listener.wait_for(f"{ROOT}/mic/listening", "online")
        home.bridge.send_signal(signal.SIGSTOP)
        listener.wait_until(lambda: False) if False else None
        _wait(17)
        home.bridge.send_signal(signal.SIGCONT)
        listener.wait_until(lambda: "online" in listener.payloads(f"{ROOT}/bridge"))
        _wait(1)
        assert "offline" not in listener.payloads(f"{ROOT}/mic/listening")


def _wait(seconds):
    from threading import Event  # noqa: PLC0415

    Event().wait(seconds)
