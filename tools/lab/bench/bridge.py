"""The bridge beside a recorder of two microphones: how late it is, and what it takes."""

import shutil
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.activity import ANY_SOUND, ActiveClasses
from hearthlog.analyzer.http import free_port
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.topics import topic
from hearthlog.tools.lab.bench.labmic import DEVICES, make_microphone
from hearthlog.tools.lab.bench.live import most_sounding, running, usage, wait_for_log
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import HEARTHLOG, BenchError
from hearthlog.tools.lab.bench.workload import Workload

_SECONDS = 120.0
_SETTLE_SECONDS = 20.0
_START_SECONDS = 10.0
# Seconds: a sound is over ten seconds after it; the blocks of the recorder begin all over it.
_QUIET, _SOUND = 14.1, 2.0
_NOISE = 10.0  # of 32768
_MICROPHONES = "kitchen", "bath"
_ON = "ON"
_ONSET, _CPU, _MEMORY = (Target(value, at_most=True) for value in (1.0, 1.0, 60.0))
_MESSAGE, _LATE_MESSAGE = Target(0.5, at_most=True), Target(1.5, at_most=True)


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
    port, config = free_port(), folder / "home.toml"
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
    turned_on = [each for each in listener.turned_on if each.monotonic >= began]
    late = _since_onset(turned_on, len(samples))
    waited = _since_decision(turned_on, folder / "logs")
    if len(late) < _SECONDS / (_QUIET + _SOUND) - 1:
        raise BenchError("hardly a sound was told of: the machine was busy")
    percent = 100 * (after.cpu - before.cpu) / seconds
    count = f"{len(late)} sounds"
    return [
        Row("from a sound to ON at the client, median", float(np.median(late)), "s", None,
            _ONSET, count),
        Row("  99 %", float(np.percentile(late, 99)), "s"),
        Row("from the last frame that it takes, median", float(np.median(waited)), "s", None,
            _MESSAGE),
        Row("  99 %", float(np.percentile(waited, 99)), "s", None, _LATE_MESSAGE),
        Row("CPU", percent, "% of a core", None, _CPU),
        Row("memory (RSS)", memory / 1e6, "MB", None, _MEMORY),
        Row("  its share of it (PSS)", after.memory / 1e6, "MB"),
    ]  # fmt: skip


def _sounds(samples: NDArray[np.int16]) -> NDArray[np.int16]:
    """Make a loop: quiet, and then a sound that begins with its loudest frame."""
    quiet, sounding = round(_QUIET * SAMPLE_RATE), round(_SOUND * SAMPLE_RATE)
    noise = np.random.default_rng(0).normal(0, _NOISE, quiet + sounding)
    loop = noise.astype(np.int16)
    loud = most_sounding(samples)
    frames = loud[:-sounding].reshape(-1, FRAME_SAMPLES).astype(np.float64)
    first = int(np.vecdot(frames, frames).argmax()) * FRAME_SAMPLES
    loop[quiet:] = loud[first:][:sounding]
    return loop


class _TurnedOn(NamedTuple):
    """When any sound of a microphone was on, by the monotonic clock and by UTC, in seconds."""

    topic: str
    monotonic: float
    time: float


def _since_onset(turned_on: Sequence[_TurnedOn], loop: int) -> NDArray[np.float64]:
    """Tell how long after the beginning of its sound each `ON` came.

    Sample n is heard when the monotonic clock shows n / rate.
    """
    times = np.array([each.monotonic for each in turned_on])
    return (times - _QUIET) % (loop / SAMPLE_RATE)


def _since_decision(turned_on: Sequence[_TurnedOn], logs: Path) -> NDArray[np.float64]:
    """Tell how long after the end of the frame that decided it each `ON` came."""
    labels = read_columns(find_logs(logs), [topic(name, "label") for name in _MICROPHONES])
    decided = {name: _decisions(labels[topic(name, "label")]) for name in _MICROPHONES}
    waited = []
    for each in turned_on:
        times = decided[each.topic.split("/")[-2]]
        waited += [each.time - times[times < each.time].max()]
    return np.array(waited)


def _decisions(labels: Columns) -> NDArray[np.float64]:
    """Return when the frames ended with which any sound was on, in seconds of UTC."""
    names = labels["label"].tolist()
    heard = ActiveClasses(sorted({*names, SILENCE}))
    is_on = []
    for place, name in enumerate(names):
        heard.push([name], labels.log_times[place : place + 1])
        is_on.append(heard.is_active(ANY_SOUND))
    began = np.flatnonzero(np.diff(np.array([False, *is_on]).astype(np.int8)) > 0)
    return (labels.log_times[began] + FRAME_NANOSECONDS) / NANOSECONDS


def _configuration(folder: Path, model: Path, port: int) -> str:
    microphones = [
        f'[[microphone]]\nname = "{name}"\ndevice = "{device}"\n'
        for name, device in zip(_MICROPHONES, DEVICES, strict=False)
    ]
    bridge = f'[bridge.mqtt]\nhost = "127.0.0.1"\nport = {port}\n'
    head = f'output = "{folder}/logs"\nmodel = "{model}"\ntimezone = "UTC"\n'
    return "".join([head, *microphones, bridge])


def _resident(process: "subprocess.Popen[bytes]") -> int:
    """Return the bytes of a process that are in memory."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * 4096


class _Listener:
    """A client that notes when any sound is on, by the monotonic clock."""

    def __init__(self, port: int) -> None:
        import paho.mqtt.client as mqtt  # noqa: PLC0415  an extra, like the peers
        from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415

        self.turned_on: list[_TurnedOn] = []
        self._client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._client.on_connect = lambda client, *_: client.subscribe("hearthlog/+/+/sound", 1)
        self._client.on_message = self._note
        self._client.connect_async("127.0.0.1", port)
        self._client.loop_start()

    def _note(self, _client: Any, _data: Any, message: Any) -> None:
        if message.payload.decode() == _ON and not message.retain:
            self.turned_on.append(_TurnedOn(message.topic, time.monotonic(), time.time()))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()
