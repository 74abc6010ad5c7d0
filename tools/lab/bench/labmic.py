"""A microphone for machines that have none: the ALSA device of the tests, hearing given sound."""

import ctypes.util
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.lab.bench.timing import BenchError

TYPE = "labmic"
DEVICES = TYPE, "second", "third", "fourth"
_SOURCE = Path(__file__).resolve().parents[3] / "tests" / "labmic" / "labmic.c"
_ALSA_CONFIGURATION = Path("/usr/share/alsa/alsa.conf")


def make_microphone(folder: Path, samples: NDArray[np.int16]) -> dict[str, str]:
    """Build a microphone that hears these samples, mono at 16 kHz, again and again.

    Returns
    -------
    dict of str to str
        Environment of a process that shall see it, as the `DEVICES`.

    Raises
    ------
    BenchError
        If something is missing to build it with.
    """
    needed = {
        "gcc": shutil.which("gcc"),
        "libportaudio2": ctypes.util.find_library("portaudio"),
        "alsa-lib": _ALSA_CONFIGURATION.exists(),
        str(_SOURCE): _SOURCE.exists(),
        "setpriv": shutil.which("setpriv"),
    }
    missing = [name for name, is_there in needed.items() if not is_there]
    if missing:
        raise BenchError(f"no microphone to record: {', '.join(missing)} missing")
    plugin = folder / "libasound_module_pcm_labmic.so"
    command = [
        "gcc",
        "-O2",
        "-fPIC",
        "-shared",
        "-DPIC",
        "-o",
        str(plugin),
        str(_SOURCE),
        "-lasound",
    ]
    built = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if built.returncode != 0:
        raise BenchError("no microphone to record: building it needs libasound2-dev")
    recording = folder / "labmic.s16"
    recording.write_bytes(samples.astype("<i2").tobytes())
    configuration = folder / "asound.conf"
    configuration.write_text(
        f"<{_ALSA_CONFIGURATION}>\n"
        f'pcm_type.{TYPE} {{ lib "{plugin}" }}\n'
        + "".join(
            f'pcm.{device} {{ type {TYPE} rate {SAMPLE_RATE} data "{recording}" }}\n'
            for device in DEVICES
        )
    )
    return {**os.environ, "ALSA_CONFIG_PATH": str(configuration)}
