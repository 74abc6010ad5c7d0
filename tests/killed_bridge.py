"""Kill broker, recorder and bridge at random moments, and compare what they count in the end.

    python tests/killed_bridge.py SOUND MODEL MINUTES KILLS [SEED]

SOUND is an audio file, at whose end it begins anew. Each of the three is killed KILLS times. Says
whether states and counts at the broker, and the totals for Prometheus, are those computed from the
logs.
"""

import random
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from zoneinfo import ZoneInfo

from brokers import Broker, settled_values, start_bridge
from conftest import HEARTHLOG
from expected_outputs import expected_totals, expected_values
from microphones import DIES_WITH_PARENT
from prometheus_client.parser import text_string_to_metric_families

from hearthlog.schemas.errors import LogError

ZONE = "Europe/Vienna"
_ROOT = "hearthlog/home"
_KINDS = "on", "count_today", "count_night", "last_heard", "total"
_PATIENCE_SECONDS = 90.0  # on a busy machine a recorder or a bridge takes ten to begin


class Ending(NamedTuple):
    """What the bridge says of the classes in the end, and what the logs say."""

    found: dict[str, str]
    expected: dict[str, str]
    output: str

    @property
    def wrong(self) -> list[str]:
        """Topics whose value is another, or that should say nothing."""
        nothing = {"OFF", "0", "None"}
        return [
            topic
            for topic in self.found.keys() | self.expected.keys()
            if topic.rpartition("/")[2] in _KINDS
            and self.found.get(topic) != self.expected.get(topic)
            and not (topic not in self.expected and self.found[topic] in nothing)
        ]


def kill_at_random(  # noqa: PLR0913, PLR0917
    folder: Path, sounds: list[Path], model: str, seconds: float, kills: int, chance: random.Random
) -> Ending:
    """Let all three run, kill each so many times, and wait until what is left is told."""
    broker, output = Broker(folder), folder / "said"
    config = folder / "home.toml"
    config.write_text(
        f'output = "{folder}/logs"\ntimezone = "{ZONE}"\n'
        f'[bridge.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\n'
        f'[bridge.prometheus]\ntext_file = "{folder}/home.prom"\nreadable_by = "owner"\n'
    )
    start = {
        "recorder": lambda: start_recorder(config, sounds, model, output),
        "bridge": lambda: start_bridge(config, output),
    }
    running = {what: begin() for what, begin in start.items()}
    names = [what for what in ("broker", *running) for _ in range(kills)]
    due = sorted((chance.uniform(4, seconds - 4), what) for what in names)
    began = time.monotonic()
    for at, what in due:
        time.sleep(max(began + at - time.monotonic(), 0))
        if what == "broker":
            broker.kill()
            time.sleep(chance.uniform(0, 2))
            broker.start()
        else:
            running[what].kill()
            running[what].wait()
            time.sleep(chance.uniform(0, 2))
            running[what] = start[what]()
    time.sleep(max(began + seconds - time.monotonic(), 0))
    logs, zone = folder / "logs", ZoneInfo(ZONE)

    def is_recorded() -> bool:
        with suppress(LogError):  # on a busy machine there may be no log yet
            return any(each.endswith("/last_heard") for each in expected_values(logs, zone, _ROOT))
        return False

    _wait(is_recorded)
    running["recorder"].terminate()
    running["recorder"].wait()
    expected = expected_values(logs, zone, _ROOT) | expected_totals(logs)

    def ending() -> Ending:
        found = settled_values(broker.port, f"{_ROOT}/#") | _totals(folder / "home.prom")
        return Ending(found, expected, output.read_text())

    _wait(lambda: not ending().wrong)
    last = ending()
    running["bridge"].terminate()
    running["bridge"].wait()
    broker.kill()
    return last


def _totals(file: Path) -> dict[str, str]:
    if not file.exists():  # the bridge was killed, or begins
        return {}
    samples = [
        sample
        for family in text_string_to_metric_families(file.read_text())
        for sample in family.samples
        if sample.name == "hearthlog_events_total"
    ]
    return {f"{each.labels['label']}/total": str(int(each.value)) for each in samples}


def _wait(is_so: Callable[[], bool]) -> None:
    """Wait until something is so, or patience ends."""
    end = time.monotonic() + _PATIENCE_SECONDS
    while not is_so() and time.monotonic() < end:
        time.sleep(0.2)


def start_recorder(config: Path, sounds: list[Path], model: str, output: Path) -> subprocess.Popen:
    """Record files at the pace of real time, as if they were heard from now on."""
    now = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%S.%f}Z"
    options = ["--realtime", "--start", now, "--model", model, "--config", str(config)]
    with output.open("ab") as log:
        return subprocess.Popen(
            [*DIES_WITH_PARENT, *HEARTHLOG, "record", *map(str, sounds), *options],
            stdout=log,
            stderr=log,
        )


def main(sound: str, model: str, minutes: str, kills: str, seed: str = "0") -> None:
    """Run it, and say what came of it."""
    with TemporaryDirectory(prefix="hearthlog") as folder:
        chance, seconds = random.Random(int(seed)), 60 * float(minutes)
        sounds = 10 * [Path(sound)]
        ending = kill_at_random(Path(folder), sounds, model, seconds, int(kills), chance)
    sys.stdout.write(f"{ending.output}{len(ending.expected)} values, wrong: {ending.wrong}\n")
    for topic in ending.wrong:
        sys.stdout.write(f"{topic}: {ending.found.get(topic)}, not {ending.expected.get(topic)}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
