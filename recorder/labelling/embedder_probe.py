"""Test of the embedding network in a child process at the start of a recorder.

A runtime that crashes, hangs or takes too much memory must not affect the recorder. The module is
also the child process: ``embedder_probe NAME FILE`` answers in one line of JSON.
"""

import json
import signal
import subprocess
import sys
import time
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES
from hearthlog.models.embedding.networks import (
    NETWORKS,
    YAMNET,
    Embedder,
    find_network,
    load_embedder,
    missing_modules,
)
from hearthlog.recorder.host import memory, module_command
from hearthlog.schemas.errors import ModelError, printable
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

NO_NETWORK = "none"  # instead of a network's name
DEFAULT_NETWORK = YAMNET.name
_HOP_SECONDS = HOP_FRAMES * FRAME_SAMPLES / SAMPLE_RATE
_MOST_SHARE = 0.5  # of the hop
_MOST_MEGABYTES = 300  # of the service's limit of 600
_PATIENCE_SECONDS = 30.0
_WINDOWS = 5
_MODULE = "hearthlog.recorder.labelling.embedder_probe"
_WITHOUT_NETWORK = "it is recorded without a network"
_SIGNALS: dict[int, str] = {
    signal.SIGILL: "this processor lacks instructions that its runtime needs",
    signal.SIGKILL: "perhaps there is too little memory",
}


class Probe(NamedTuple):
    """Result of a network test."""

    seconds: float
    megabytes: float  # peak memory of a process that only runs the network; 0 if unknown
    different_answers: list[str]

    @property
    def hop_seconds(self) -> float:
        """Shortest hop that this machine can sustain."""
        return self.seconds / _MOST_SHARE


def probe_network(name: str, path: Path) -> Probe:
    """Load and test a network in a child process.

    Raise `ModelError` if it is unusable, crashes, hangs, or takes too much memory.
    """
    network = NETWORKS.get(name)
    if missing_modules(network.suffix):
        extra = "embedding" if network.suffix == ".tflite" else "onnx"
        raise ModelError(
            f"{path}: its runtime is not installed; try: pip install '.[{extra}]' in a clone of "
            "hearthlog"
        )
    try:
        result = subprocess.run(  # noqa: S603  our own module
            [*module_command(_MODULE), name, str(path)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            cwd="/",
            timeout=_PATIENCE_SECONDS,
            start_new_session=True,  # Ctrl-C is for the recorder
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ModelError(
            f"{path}: the network hangs: no answer in {_PATIENCE_SECONDS:g} s; fetch it again: "
            f"hearthlog models fetch {name}"
        ) from error
    except OSError as error:
        raise ModelError(f"{path}: cannot be tried ({error.strerror or error})") from error
    if result.returncode < 0:
        raise ModelError(f"{path}: {_crash(-result.returncode)}")
    try:
        answer = json.loads(result.stdout.splitlines()[-1])
    except (ValueError, IndexError) as error:
        last = (result.stderr.decode(errors="replace").splitlines() or ["it says nothing"])[-1]
        raise ModelError(f"{path}: cannot be tried ({last[:200]})") from error
    if "error" in answer:
        raise ModelError(answer["error"])
    if answer["megabytes"] > _MOST_MEGABYTES:
        raise ModelError(
            f"{path}: the network takes {answer['megabytes']:.0f} MB of memory, and the limit is "
            f"{_MOST_MEGABYTES}"
        )
    return Probe(**answer)


def open_embedder(wanted: str = "", microphones: int = 1) -> tuple[Embedder | None, str]:
    """Load the recorder's embedding network, if this machine can run it, and the reason if not.

    `wanted` is a network's name, `none`, or empty for yamnet if it is installed. The reason is
    empty if there is nothing to report.
    """
    if wanted == NO_NETWORK:
        return None, ""
    name = wanted or DEFAULT_NETWORK
    try:
        path = network_path(name)
    except ModelError as error:
        return None, f"{error}; {_WITHOUT_NETWORK}" if wanted else ""
    try:
        check_pace(path, _probed(name, path, path.stat().st_mtime_ns), microphones)
        return load_embedder(name, path), ""
    except ModelError as error:
        return None, f"{error}; {_WITHOUT_NETWORK}"
    except Exception as error:  # noqa: BLE001  no runtime may prevent the start of a recorder
        return None, f"{path}: cannot be used ({printable(repr(error))[:200]}); {_WITHOUT_NETWORK}"


def likely_network(wanted: str = "") -> str:
    """Return the network to be used, if its file and runtime are installed; neither is tested."""
    name = wanted or DEFAULT_NETWORK
    if wanted == NO_NETWORK or not NETWORKS.has(name) or find_network(name) is None:
        return ""
    return "" if missing_modules(NETWORKS.get(name).suffix) else name


@lru_cache(maxsize=4)
def _probed(name: str, path: Path, _changed: int) -> Probe:
    """Test a file once per process."""
    return probe_network(name, path)


def check_network(wanted: str, microphones: int = 1) -> None:
    """Check the configured network, if any; raise `ModelError` if it is missing or unusable."""
    if wanted not in {"", NO_NETWORK}:
        path = network_path(wanted)
        check_pace(path, probe_network(wanted, path), microphones)


def network_path(name: str) -> Path:
    """Return the file of a network; raise `ModelError` if network or file does not exist."""
    path = find_network(name)
    if path is None:
        raise ModelError(
            f"the network {name} is not installed; hearthlog models fetch {name} installs it"
        )
    return path


def check_pace(path: Path, probe: Probe, microphones: int = 1) -> None:
    """Raise `ModelError` if a window takes a network more than half of the hop on this machine."""
    if microphones * probe.seconds > _MOST_SHARE * _HOP_SECONDS:
        of = f" of each of {microphones} microphones" if microphones > 1 else ""
        raise ModelError(
            f"{path}: too slow here: {probe.seconds:.2g} s for a window, every {_HOP_SECONDS:g} "
            f"s{of}; this machine manages one every {microphones * probe.hop_seconds:.2g} s"
        )


def _crash(number: int) -> str:
    try:
        name = signal.Signals(number).name
    except ValueError:
        name = f"signal {number}"
    why = _SIGNALS.get(number, "another version of its runtime may not: pip install --upgrade …")
    return f"the network crashes ({name}): {why}"


def main() -> None:
    """Test a network, and answer in JSON."""
    name, path = sys.argv[1], Path(sys.argv[2])
    try:
        embedder = load_embedder(name, path)
        answer = {
            "seconds": _window_seconds(embedder),
            "different_answers": embedder.different_answers(),
            "megabytes": (memory("VmHWM") or 0) / 1024**2,
        }
    except ModelError as error:
        answer = {"error": str(error)}
    sys.stdout.write(json.dumps(answer) + "\n")


def _window_seconds(embedder: Embedder) -> float:
    """Return the minimum time over some windows: the machine may be busy, as after a boot."""
    window = np.zeros((WINDOW_FRAMES, FRAME_SAMPLES), np.float32)
    times = []
    for _ in range(_WINDOWS):
        begin = time.perf_counter()
        embedder(window)
        times.append(time.perf_counter() - begin)
        if times[-1] > _HOP_SECONDS:
            break
    return min(times)


if __name__ == "__main__":
    main()
