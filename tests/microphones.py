"""Microphones for the tests of capture: real ALSA devices on machines without sound hardware.

`labmic` counts its samples, so loss, drift and outages are exact. `pulse_microphone` is a private
PulseAudio daemon whose null sink is recorded, as on a desktop. Both live in child processes of the
tests only: PortAudio never returns from a device that has vanished.
"""

import contextlib
import ctypes.util
import os
import shutil
import subprocess
import tempfile
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

_SOURCE = Path(__file__).parent / "labmic" / "labmic.c"
_PLUGIN = "libasound_module_pcm_labmic.so"
_HEADERS = "#include <alsa/asoundlib.h>\n#include <alsa/pcm_external.h>\n"
_ALSA_CONFIGURATION = Path("/usr/share/alsa/alsa.conf")
_RATE = 16_000
_SECONDS_TO_START = 10.0
# Nothing a test starts outlives a pytest that is killed; without the daemon the player ends too.
DIES_WITH_PARENT = ["setpriv", "--pdeathsig", "KILL"]


class LabMicrophone:
    """A microphone whose sample n is taken at CLOCK_MONOTONIC = n / (rate · (1 + ppm · 1e-6)).

    Its samples say their index, ``n mod 65536 - 32768``, or are an array heard in a loop.

    Attributes
    ----------
    env : dict[str, str]
        Environment for a process that shall see the microphone.
    device : str
        The name PortAudio lists it under.
    """

    def __init__(self, plugin: Path, folder: Path, device: str = "labmic"):
        self.device = device
        self.env = _environment(folder)
        self._plugin = plugin
        self._folder = folder
        self._control = folder / f"{device}.control"
        self.configure()

    def configure(
        self,
        rate: int = _RATE,
        ppm: float = 0.0,
        data: np.ndarray | None = None,
        burst: float = 0.0,
    ):
        """Set what the next process to open the microphone finds.

        `data` is int16, mono, or has an axis of channels. Samples come in pieces of so many seconds
        as `burst` says.
        """
        self._rate = rate * (1 + Fraction(str(ppm)) / 1_000_000)
        fields = f'type labmic rate {rate} ppm {float(ppm):.6f} ctl "{self._control}"'
        fields += f" burst {max(round(burst * rate), 1)}"
        if data is not None:
            samples = self._folder / f"{self.device}.s16"
            _write_samples(samples, data)
            fields += f' data "{samples}"'
            fields += f" channels {data.shape[1]}" if data.ndim == 2 else ""
        (self._folder / f"{self.device}.pcm").write_text(f"pcm.{self.device} {{ {fields} }}\n")
        self._write_configuration()

    def add_device(self, device: str) -> "LabMicrophone":
        """Add a second microphone, on the same clock, to what the same processes see."""
        return LabMicrophone(self._plugin, self._folder, device)

    def index_at(self, monotonic_ns: int) -> int:
        """Index of the last sample taken at this reading of CLOCK_MONOTONIC."""
        return int(monotonic_ns * self._rate / 1_000_000_000)

    def unplug(self):
        self._become("unplug")

    def occupy(self):
        """Let it be in use by another program; who has it keeps it."""
        self._become("busy")

    def freeze(self):
        self._become("freeze")

    def restore(self):
        self._become("")

    def _become(self, condition: str):
        # Replaced in one step: a file emptied before it is written would say "normal" in between.
        fresh = self._control.with_suffix(".new")
        fresh.write_text(condition)
        fresh.replace(self._control)

    def _write_configuration(self):
        lines = [f"<{_ALSA_CONFIGURATION}>", f'pcm_type.labmic {{ lib "{self._plugin}" }}']
        lines += [f"<{definition}>" for definition in sorted(self._folder.glob("*.pcm"))]
        Path(self.env["ALSA_CONFIG_PATH"]).write_text("\n".join(lines) + "\n")


class PulseMicrophone:
    """The monitor of a PulseAudio null sink, 16 kHz mono int16, recorded through ALSA.

    Attributes
    ----------
    env : dict[str, str]
        Environment for a process that shall see the microphone.
    device : str
        The name PortAudio lists it under.
    """

    # A name of our own: distributions define `pcm.pulse` themselves, and ALSA merges a second
    # definition into theirs.
    device = "nullsink"

    def __init__(self, folder: Path):
        self._folder = folder
        self._player: list[subprocess.Popen] = []
        server = f"unix:{folder / 'native'}"
        self.env = _environment(folder) | {"PULSE_SERVER": server}
        (folder / "asound.conf").write_text(
            f"<{_ALSA_CONFIGURATION}>\n"
            f'pcm.{self.device} {{ type pulse server "{server}" device "microphone.monitor" }}\n'
        )

    def play(self, samples: np.ndarray):
        """Let the microphone hear these int16 samples, mono at 16 kHz, again and again."""
        self.stop()
        path = self._folder / "playing.s16"
        _write_samples(path, samples)
        quiet = {"env": self.env, "stderr": subprocess.DEVNULL}
        again = ["sh", "-c", 'while cat "$0"; do :; done', str(path)]
        samples_again = subprocess.Popen(again, stdout=subprocess.PIPE, **quiet)
        command = ["pacat", "--raw", "--format=s16le", f"--rate={_RATE}", "--channels=1"]
        player = subprocess.Popen(command, stdin=samples_again.stdout, **quiet)
        samples_again.stdout.close()
        self._player = [player, samples_again]

    def speaker_env(self) -> dict[str, str]:
        """Return the environment for a process whose speaker is what this microphone hears."""
        file = self._folder / "speaker.conf"
        server = f"unix:{self._folder / 'native'}"
        file.write_text(
            f'<{_ALSA_CONFIGURATION}>\npcm.!default {{ type pulse server "{server}" }}\n'
        )
        return self.env | {"ALSA_CONFIG_PATH": str(file)}

    @contextlib.contextmanager
    def recorded(self):
        """Record what the microphone hears; yield a function that returns the samples so far."""
        file = self._folder / "recorded.s16"
        command = [*DIES_WITH_PARENT, "parec", "--raw", "--format=s16le", f"--rate={_RATE}"]
        command += ["--channels=1", "--latency-msec=50", "-d", "microphone.monitor"]
        with file.open("wb") as stream:
            recorder = subprocess.Popen(command, env=self.env, stdout=stream)
        try:
            yield lambda: np.fromfile(file, "<i2")
        finally:
            recorder.kill()
            recorder.wait(timeout=5)

    def stop(self):
        """Stop playing: PulseAudio then delivers silence, up to 2 s late."""
        if self._player:
            self._player[0].kill()  # the other then writes to nobody, and ends
        for process in self._player:
            process.wait(timeout=5)
        self._player = []


@pytest.fixture(scope="session")
def labmic_plugin(tmp_path_factory) -> Path:
    _need("gcc", shutil.which("gcc"))
    _need("libportaudio2", ctypes.util.find_library("portaudio"))
    _need("libasound2-dev", _gcc("-E", "-x", "c", "-", input=_HEADERS).returncode == 0)
    plugin = tmp_path_factory.mktemp("labmic") / _PLUGIN
    built = _gcc("-O2", "-fPIC", "-shared", "-DPIC", "-o", plugin, _SOURCE, "-lasound")
    assert built.returncode == 0, built.stderr
    return plugin


@pytest.fixture
def labmic(labmic_plugin, tmp_path_factory) -> LabMicrophone:
    """A microphone that counts its samples; see `LabMicrophone`."""
    return LabMicrophone(labmic_plugin, tmp_path_factory.mktemp("microphone"))


@pytest.fixture(scope="session")
def pulse_daemon():
    _need("pulseaudio", shutil.which("pulseaudio"))
    _need("pulseaudio-utils", shutil.which("pacat") and shutil.which("pactl"))
    _need("libportaudio2", ctypes.util.find_library("portaudio"))
    _need("libasound2-plugins", _alsa_plugin("pulse"))
    # Not pytest's folder: the path of a Unix socket has room for 107 bytes.
    with tempfile.TemporaryDirectory(prefix="pulse") as folder:
        microphone = PulseMicrophone(Path(folder))
        daemon = _start_pulseaudio(Path(folder), microphone.env)
        try:
            _wait_for_server(daemon, microphone.env)
            yield microphone
        finally:
            microphone.stop()
            daemon.kill()
            daemon.wait(timeout=5)


@pytest.fixture
def pulse_microphone(pulse_daemon):
    """A microphone of PulseAudio, hearing silence at first; see `PulseMicrophone`."""
    # A sink nobody plays to delivers its first block up to 2 s late.
    pulse_daemon.play(np.zeros(_RATE, np.int16))
    yield pulse_daemon
    pulse_daemon.stop()


def _environment(folder: Path) -> dict[str, str]:
    """Keep the sound server and the ALSA settings of whoever runs the tests out of them."""
    foreign = ("LABMIC_PPM", "PULSE_SERVER", "PULSE_SOURCE", "DBUS_SESSION_BUS_ADDRESS")
    kept = {name: value for name, value in os.environ.items() if name not in foreign}
    homes = ("HOME", "XDG_RUNTIME_DIR", "XDG_CONFIG_HOME", "PULSE_RUNTIME_PATH")
    return {
        **kept,
        **dict.fromkeys(homes, str(folder)),
        "ALSA_CONFIG_PATH": str(folder / "asound.conf"),
    }


def _need(package: str, present: object):
    if present:
        return
    reason = f"sound without hardware needs the Debian package {package}"
    if os.environ.get("TESTS_REQUIRE_AUDIO") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


def _gcc(*arguments, **options) -> subprocess.CompletedProcess:
    command = ["gcc", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, **options
    )


def _alsa_plugin(name: str) -> bool:
    folders = Path("/usr").glob(f"lib*/**/alsa-lib/libasound_module_pcm_{name}.so")
    return next(folders, None) is not None


def _start_pulseaudio(folder: Path, env: dict[str, str]) -> subprocess.Popen:
    sink = f"sink_name=microphone format=s16le rate={_RATE} channels=1 channel_map=mono"
    command = [*DIES_WITH_PARENT, "pulseaudio", "-n", "--daemonize=no", "--use-pid-file=no"]
    command += ["--exit-idle-time=-1", "--disable-shm=yes", "--realtime=no", "--high-priority=no"]
    command += ["--load", f"module-null-sink {sink}"]
    command += ["--load", f"module-native-protocol-unix socket={folder / 'native'}"]
    with (folder / "log").open("w") as log:
        return subprocess.Popen(
            command,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )


def _wait_for_server(daemon: subprocess.Popen, env: dict[str, str]):
    deadline = time.monotonic() + _SECONDS_TO_START
    while time.monotonic() < deadline and daemon.poll() is None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            requested = subprocess.run(
                ["pactl", "info"], env=env, capture_output=True, timeout=2, check=False
            )
            if requested.returncode == 0:
                return
        time.sleep(0.05)
    pytest.fail("PulseAudio did not start: " + Path(env["HOME"], "log").read_text())


def _write_samples(path: Path, samples: np.ndarray):
    assert samples.dtype == np.int16
    assert samples.size
    path.write_bytes(samples.astype("<i2").tobytes())
