"""A whole small home, as the program in force writes it: `python tests/golden_home.py FOLDER`.

`tests/golden/VERSION` is the output of the last commit before the next version. It has

- `models`: `smoothed`, which recorded; `merged`, which relabelled; `adapted`, learned from the
  home, and now the champion;
- `logs`: two logs with a gap and clips, their layers, and the groups of recurring sounds;
- `left`: the second log as a killed recorder would have left it;
- `home`: an enrolled sound;
- `home.toml`, and the files that it names. The passwords are of this folder only;
- `bridge`: the state of the bridge, with an alert that one of two targets has received.
"""

import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from shutil import copy
from tempfile import TemporaryDirectory
from threading import Event as Flag
from threading import Thread
from unittest.mock import patch

import numpy as np
import soundfile
from brokers import Broker
from lossy_source import LossySource
from receivers import server
from waiting import wait_for

from hearthlog.analyzer.bridge.bridge import Bridge, ProblemReporter, open_outputs
from hearthlog.analyzer.bridge.settings import BridgeSettings, RecorderAddress, load_bridge_settings
from hearthlog.analyzer.bridge.state import BridgeState, state_folder
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, write_marks
from hearthlog.recorder.config import load_settings
from hearthlog.recorder.pause_schedule import time_zone
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.frames import NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.files import find_logs, is_layer

CONFIGURATION = Path("home.toml")
SECRETS = {
    "broker-password": "of-no-broker",
    "figures-token": "0123456789abcdef",
    "ping-url": "http://127.0.0.1:9/of-no-watchdog",
}
_REAL_TIME = time.time_ns
TARGETS = Path("targets")
_CLIPS = Path(__file__).parents[1] / "tools" / "home" / "clips"
_CLASSES = {"coughing": 6, "phone_ring": 2, "speech": 5}  # clips of each
_SCENARIO = "[classes]\n" + "".join(f'{name} = ["{name}"]\n' for name in (*_CLASSES, "silence"))
_BEGIN = 1_772_348_370_123_456_789  # 2026-03-01, 06:59:30 of UTC
_SECONDS = 46
_LOST = {1: 7, 3: 40}  # frames, before blocks of ten seconds
_SOUNDS = (  # second, clip
    (2.0, "phone_ring/phone_ring_01"),
    (7.0, "coughing/coughing_01"),
    (11.0, "coughing/coughing_02"),
    (14.0, "phone_ring/phone_ring_01"),
    (19.0, "coughing/coughing_01"),
    (22.0, "objects_activity/objects_activity_01"),
    (26.0, "phone_ring/phone_ring_01"),
    (31.0, "coughing/coughing_03"),
    (34.0, "speech/speech_01"),
    (38.0, "phone_ring/phone_ring_01"),
    (42.0, "coughing/coughing_01"),
)
_KEPT_SECONDS = 3.0  # of a clip
_SETTINGS = """\
node = "home"
output = "logs"
model = "models/champion.safetensors"
max_bag_duration = 3600
flush_seconds = 1.0
sync_seconds = 5.0
statistics_every = 10
timezone = "Europe/Vienna"
quiet_hours = ["02:00-02:10"]
readable_by = "owner"
privacy = []
never_tell = ["music"]
keep_audio = "events"
never_keep = ["speech"]
clip_pre_roll_seconds = 0.5
clip_minutes_a_day = 30
clip_retention_days = 30
retention_days = 400
max_record_size = "20G"
min_free_space = "1M"
drop_statistics_days = 90
drop_features_days = 180
labels_only_days = 365

[scenarios]

[[microphone]]
name = "hall"
device = "USB PnP Sound Device"
fallback = "default"
channel = 1

[bridge]
state = "bridge"

[bridge.mqtt]
host = "127.0.0.1"
port = 1883
user = "hearthlog"
password_file = "broker-password"
client_id = "home"
topic = "hearthlog"
home_assistant = true
discovery_topic = "homeassistant"
commands = false

[bridge.prometheus]
text_file = "home.prom"
port = 9177
token_file = "figures-token"

[bridge.page]
port = 8380
bind = "127.0.0.1"
names = ["box.local"]
frames = ["http://homeassistant.local:8123"]
sound = true
language = "de"

[bridge.ping]
url_file = "ping-url"
every_seconds = 60

[bridge.delivery]
urls_file = "targets"

[[bridge.alert]]
name = "a cough"
rule = "more_than"
class = "coughing"
count = 0
window = "1m"
cooldown = "1h"
urgent = true

[[bridge.alert]]
name = "telephone for long"
rule = "longer_than"
class = "phone_ring"
longer_than = "10m"

[[bridge.alert]]
name = "no telephone"
rule = "none_by"
class = "phone_ring"
since = "08:00"
by = "21:00"
microphone = "hall"

[[bridge.alert]]
name = "restless night"
rule = "unlike_usual"
of = "minutes"
part = "night"
which = "more"
at = "08:00"

[[bridge.alert]]
name = "an unusual day"
rule = "unusual_day"
once_in = 30

[[bridge.alert]]
name = "the recorder"
rule = "recorder_silent"
silent_for = "7d"
"""


def moment(text: str) -> int:
    """Read a time of UTC, such as `2026-03-01T07:00:00`, in nanoseconds."""
    return int(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()) * NANOSECONDS


class Following:
    """A bridge of the home in the current folder, which runs.

    Attributes
    ----------
    problems : list of str
    state : BridgeState
    """

    state: BridgeState

    def __init__(self, now: str) -> None:
        self.problems: list[str] = []
        self.set_clock(now)

    def set_clock(self, now: str) -> None:
        """Set the clock to a time of UTC."""
        self._ahead = moment(now) - _REAL_TIME()

    def time(self) -> int:
        """Return the time, in nanoseconds of UTC."""
        return _REAL_TIME() + self._ahead


@contextmanager
def following(now: str, broker: int) -> Iterator[Following]:
    """Run the bridge of the home in the current folder, as if it was a time of UTC.

    Parameters
    ----------
    broker : int
        Port of the MQTT broker; the ports of page and metrics are free ones.
    """
    own = Following(now)
    with patch("time.time_ns", own.time):
        settings, outputs_of = load_bridge_settings(CONFIGURATION)
        home = RecorderAddress(
            settings.output,
            settings.node,
            time_zone(settings.timezone),
            frozenset(settings.never_tell),
        )
        say, stop = ProblemReporter(own.problems.append), Flag()
        own.state = state = BridgeState(state_folder(outputs_of.state, home.folder), home.node, say)
        state.claim(home.folder)
        outputs, since = open_outputs(_with_ports(outputs_of, broker), home, state, say)
        bridge = Bridge(home, since, outputs, say)
        thread = Thread(target=bridge.run, args=(stop,))
        thread.start()
        try:
            yield own
        finally:
            stop.set()
            thread.join()
            state.close()


def _with_ports(own: BridgeSettings, broker: int) -> BridgeSettings:
    assert own.mqtt
    assert own.page
    assert own.prometheus
    return own.model_copy(
        update={
            "mqtt": own.mqtt.model_copy(update={"port": broker}),
            "page": own.page.model_copy(update={"port": free_port()}),
            "prometheus": own.prometheus.model_copy(update={"port": free_port()}),
        }
    )


def entries(folder: Path) -> dict[str, str]:
    """Read the state of a bridge that does not run, as any program that knows SQLite does."""
    database = sqlite3.connect(folder / "state.sqlite3")
    try:
        return dict(database.execute("SELECT name, content FROM entries"))
    finally:
        database.close()


def write_secrets(receives: int, receives_not: int) -> None:
    """Write the files that the configuration names, private, as Git does not keep them."""
    for name, content in SECRETS.items():
        Path(name).write_text(f"{content}\n")
    ports = {"one": receives, "two": receives_not}
    TARGETS.write_text("".join(f"json://127.0.0.1:{port}/{to}\n" for to, port in ports.items()))
    for path in (*map(Path, SECRETS), TARGETS):
        path.chmod(0o600)


def _run(*arguments: object) -> None:
    command = [sys.executable, "-m", "hearthlog.tools.cli.main", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    sys.stderr.write(f"{' '.join(command[3:])}: {done.returncode}\n{done.stdout}{done.stderr}")
    if done.returncode not in {0, 3}:
        raise SystemExit(done.returncode)


def _train() -> None:
    """Train on a few clips."""
    Path("models").mkdir()
    rows = (_CLIPS / "manifest.csv").read_text().splitlines()
    chosen = [f"{rows[0]}"]
    for name, count in _CLASSES.items():
        own = [row for row in rows if row.startswith(f"{name}/")]
        chosen += [f"{_CLIPS}/{row}" for row in own[:count]]
    for number, seed in enumerate((5, 6, 7)):
        quiet = f"silence_{number}.flac"
        soundfile.write(quiet, _noise(np.random.default_rng(seed), 4), SAMPLE_RATE)
        chosen.append(f"{Path.cwd()}/{quiet},silence,{quiet},made here,CC0,4.0,,,")
    Path("some.csv").write_text("\n".join(chosen) + "\n")
    Path("some.toml").write_text(_SCENARIO)
    about = ["--data", "some.csv", "--scenario", "some.toml", "--method", "room"]
    _run("train", *about, "--smoothing", "hmm", "--output", "models/smoothed.safetensors")
    _run("train", *about, "--smoothing", "merge", "--output", "models/merged.safetensors")
    _run("models", "promote", "smoothed", "--anyway")
    for path in (*Path().glob("silence_*.flac"), Path("some.csv"), Path("some.toml")):
        path.unlink()


def _noise(rng: np.random.Generator, seconds: int) -> Float64:
    return rng.normal(0.0, 10 ** (-60 / 20), seconds * SAMPLE_RATE)


def _record() -> None:
    rng = np.random.default_rng(3)
    sound = _noise(rng, _SECONDS)
    for second, clip in _SOUNDS:
        samples = soundfile.read(_CLIPS / f"{clip}.flac")[0][: int(_KEPT_SECONDS * SAMPLE_RATE)]
        at = int(second * SAMPLE_RATE)
        sound[at : at + len(samples)] += samples[: len(sound) - at]
    soundfile.write("sound.flac", sound.clip(-1, 1), SAMPLE_RATE)

    def keep_active() -> None:
        Path("left").mkdir()
        copy(max(Path("logs").rglob("*Z.mcap.active")), "left")

    settings = load_settings(CONFIGURATION, {}, {})
    record(
        settings, LossySource(FileSource([Path("sound.flac")], _BEGIN), _LOST, keep_active), Flag()
    )
    Path("sound.flac").unlink()


def _review() -> None:
    log = next(log for log in find_logs(Path("logs")) if not is_layer(log))

    def span(start: float, end: float) -> tuple[int, int]:
        return (_BEGIN + round(start * NANOSECONDS), _BEGIN + round(end * NANOSECONDS))

    who = ("anna", moment("2026-03-01T09:00:00"))
    marks = [
        Mark("hall", *span(11.5, 13.3), "coughing", *who),
        Mark("hall", *span(14.4, 16.8), "phone_ring", *who),
        Mark("hall", *span(22.4, 25.3), "television", *who),
    ]
    write_marks(log, marks, reviewed=[ReviewedSpan("hall", *span(18.0, 21.0), *who)])


def _follow() -> None:
    """Let a bridge remember all that it can.

    Its rules begin before the first sound, so that they ring. After midnight it saves the totals
    of the day before.
    """
    with TemporaryDirectory() as folder, server() as (port, received):
        broker = Broker(Path(folder))
        write_secrets(port, free_port())
        logs, aside = Path("logs"), Path("recorded")
        logs.rename(aside)
        logs.mkdir()
        with following("2026-03-01T06:59:00", broker.port) as bridge:
            wait_for(lambda: bridge.state.read("addresses"))
        logs.rmdir()
        aside.rename(logs)
        with following("2026-03-01T07:02:00", broker.port) as bridge:
            wait_for(lambda: received, what=lambda: bridge.problems)
            wait_for(lambda: "coughing" in (bridge.state.read("mqtt") or ""))
            bridge.set_clock("2026-03-01T23:10:00")
            wait_for(lambda: "coughing" in (bridge.state.read("totals") or ""))
        broker.kill()


def main(folder: str) -> None:
    """Write the home into a new folder."""
    Path(folder).mkdir(parents=True)
    with chdir(folder):
        CONFIGURATION.write_text(_SETTINGS)
        _train()
        _record()
        _run("relabel", "logs", "--model", "models/merged.safetensors", "--workers", "1")
        _review()
        _run("train", "--home", "logs", "--output", "models/adapted.safetensors")
        _run("models", "promote", "adapted", "--anyway")
        span = ["--start", "2026-03-01T06:59:38", "--end", "2026-03-01T06:59:41"]
        _run("enrol", "coughing", "--home", "home", "--log", "logs", *span)
        _run("discover", "logs", "--least", "2")
        _run("discover", "logs", "--name", "2=bell")
        _follow()


if __name__ == "__main__":
    main(*sys.argv[1:])
