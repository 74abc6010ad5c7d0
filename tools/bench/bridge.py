"""The bridge beside a recorder of two microphones: how late it is, and what it takes."""

import shutil
import socket
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.bench.labmic import DEVICE, SECOND_DEVICE, make_microphone
from hearthlog.tools.bench.live import most_sounding, running, usage, wait_for_log
from hearthlog.tools.bench.table import Row, Table, Target
from hearthlog.tools.bench.timing import HEARTHLOG, BenchError
from hearthlog.tools.bench.workload import Workload

_SECONDS = 120.0
_SETTLE_SECONDS = 20.0
_START_SECONDS = 10.0
_QUIET, _SOUND = 14, 2  # seconds: a sound is over ten seconds after it
_NOISE = 10.0  # of 32768
_ON, _TARGETS = "ON", (Target(1.0, at_most=True), Target(1.0, at_most=True))
_MEMORY = Target(60.0, at_most=True)


def measure(work: Workload) -> Table:
    """Let two microphones hear a sound every sixteen seconds, and a bridge tell a broker."""
    classes = len(work.model.classes)
    title = f"bridge: two microphones for {_SECONDS:.0f} s, {classes} classes, MQTT"
    try:
        return Table(title, _measured(work))
    except (BenchError, ImportError) as error:
        return Table(title, [Row("hearthlog bridge", None, note=str(error))])


def _measured(work: Workload) -> list[Row]:
    broker_program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
    if broker_program is None:
        raise BenchError("no broker: mosquitto is missing")
    folder = work.folder / "bridge"
    folder.mkdir()
    samples = _sounds(work.samples)
    env = make_microphone(folder, samples)
    port, config = _free_port(), folder / "home.toml"
    config.write_text(_configuration(folder, work.model_file, port))
    broker = folder / "mosquitto.conf"
    broker.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    with ExitStack() as stack:
        stack.enter_context(running([broker_program, "-c", broker], env))
        recorder = stack.enter_context(running([*HEARTHLOG, "record", "--config", config], env))
        wait_for_log(folder / "logs", recorder)
        bridge = stack.enter_context(running([*HEARTHLOG, "bridge", "--config", config], env))
        listener = stack.enter_context(_Listener(port))
        time.sleep(_SETTLE_SECONDS)
        before, began = usage(bridge)[bridge.pid], time.monotonic()
        Event().wait(_SECONDS)
        after, seconds = usage(bridge)[bridge.pid], time.monotonic() - began
        memory = _resident(bridge)
    late = _lateness([t for t in listener.turned_on if t >= began], len(samples))
    if len(late) < _SECONDS / (_QUIET + _SOUND):
        raise BenchError("hardly a sound was told of: the machine was busy")
    percent = 100 * (after.cpu - before.cpu) / seconds
    count = f"{len(late)} sounds"
    return [
        Row("from a sound to ON at the client, median", float(np.median(late)), "s", None,
            _TARGETS[0], count),
        Row("  99 %", float(np.percentile(late, 99)), "s"),
        Row("CPU", percent, "% of a core", None, _TARGETS[1]),
        Row("memory (RSS)", memory / 1e6, "MB", None, _MEMORY),
        Row("  its share of it (PSS)", after.memory / 1e6, "MB"),
    ]  # fmt: skip


def _sounds(samples: NDArray[np.int16]) -> NDArray[np.int16]:
    """Make a loop: quiet, and then a sound that begins with its loudest frame."""
    noise = np.random.default_rng(0).normal(0, _NOISE, (_QUIET + _SOUND) * SAMPLE_RATE)
    loop = noise.astype(np.int16)
    loud = most_sounding(samples)
    frames = loud[: -_SOUND * SAMPLE_RATE].reshape(-1, FRAME_SAMPLES).astype(np.float64)
    first = int(np.vecdot(frames, frames).argmax()) * FRAME_SAMPLES
    loop[_QUIET * SAMPLE_RATE :] = loud[first:][: _SOUND * SAMPLE_RATE]
    return loop


def _lateness(turned_on: list[float], loop: int) -> NDArray[np.float64]:
    """Tell how long after the beginning of its sound each `ON` came.

    Sample n is heard when the monotonic clock shows n / rate.
    """
    times = np.array(turned_on)
    return (times - _QUIET) % (loop / SAMPLE_RATE)


def _configuration(folder: Path, model: Path, port: int) -> str:
    microphones = [
        f'[[microphone]]\nname = "{name}"\ndevice = "{device}"\n'
        for name, device in (("kitchen", DEVICE), ("bath", SECOND_DEVICE))
    ]
    bridge = f'[bridge.mqtt]\nhost = "127.0.0.1"\nport = {port}\n'
    head = f'output = "{folder}/logs"\nmodel = "{model}"\ntimezone = "UTC"\n'
    return "".join([head, *microphones, bridge])


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def _resident(process: "subprocess.Popen[bytes]") -> int:
    """Return the bytes of a process that are in memory."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * 4096


class _Listener:
    """A client that notes when any sound is on, by the monotonic clock."""

    def __init__(self, port: int) -> None:
        import paho.mqtt.client as mqtt  # noqa: PLC0415  an extra, like the peers
        from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415

        self.turned_on: list[float] = []
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._client.on_connect = lambda client, *_: client.subscribe("hearthlog/+/+/sound", 1)
        self._client.on_message = self._note
        self._client.connect_async("127.0.0.1", port)
        self._client.loop_start()

    def _note(self, _client: Any, _data: Any, message: Any) -> None:
        if message.payload.decode() == _ON and not message.retain:
            self.turned_on.append(time.monotonic())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()
