"""Features of sound: ours, and those of the libraries of the field."""

from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version

import numpy as np

from hearthlog.models.features.auros21 import FeatureExtractor
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import Seconds, best_of
from hearthlog.tools.lab.bench.workload import Workload

_SECONDS = 120.0
_CONTEST_SECONDS = 20.0
_SINGLE_FRAMES = 2000
_FAST = Target(10_000)
_DEFAULT_FAST = Target(5_000)
_FASTER_THAN_THE_PAPERS_LIBRARY = Target(50)
_UNIT = "x real time"

Peer = Callable[[Float32], Callable[[], object]]
Speed = tuple[float, float]  # times real time, of CPU and by the clock


def measure(work: Workload) -> Table:
    """Measure ours and theirs on the same samples."""
    frames = work.frames(_SECONDS)
    single = frames[:_SINGLE_FRAMES]
    seconds = frames.size / SAMPLE_RATE
    runs: dict[str, Callable[[], object]] = {
        "all": lambda: FeatureExtractor()(frames),
        "default": lambda: DEFAULT.extractor()(frames),
        "200": lambda: _in_blocks(frames, 200),
        "10": lambda: _in_blocks(frames, 10),
        "1": lambda: _in_blocks(single, 1),
    }
    missing: dict[str, str] = {}
    for name, (_, _, prepare) in _PEERS.items():
        try:
            runs[name] = prepare(frames.ravel())
        except ImportError as error:
            missing[name] = f"not installed ({error})"
    best = best_of(runs)
    speeds = {name: (seconds / one.cpu, seconds / one.elapsed) for name, one in best.items()}
    rows = [*_own_rows(speeds, best["1"] / (len(single) / 1e6)), *_peer_rows(speeds, missing)]
    return Table(f"features: {seconds:.0f} s of sound, CPU time", rows)


def _own_rows(speeds: Mapping[str, Speed], frame: Seconds) -> Iterator[Row]:
    """Return our speeds, and the time of a single frame in microseconds."""
    for name, what, target in (
        ("all", "21 values, in one call", _FAST),
        ("default", f"{DEFAULT.width} values", _DEFAULT_FAST),
    ):
        value, elapsed = speeds[name]
        yield Row(f"hearthlog, {what}", value, _UNIT, target=target, elapsed=elapsed)
    for name, note in (("200", "as from a file"), ("10", "as from a microphone")):
        value, elapsed = speeds[name]
        yield Row(f"hearthlog, {name} frames a call", value, _UNIT, note=note, elapsed=elapsed)
    yield Row("hearthlog, frame by frame", frame.cpu, "µs a frame", elapsed=frame.elapsed)


def _peer_rows(speeds: Mapping[str, Speed], missing: Mapping[str, str]) -> Iterator[Row]:
    ours, _ = speeds["all"]
    for name, (what, target, _) in _PEERS.items():
        if name in missing:
            yield Row(name, None, target=target, note=missing[name])
        else:
            value, elapsed = speeds[name]
            title = f"{name} {version(name)}"
            yield Row(title, value, _UNIT, ours / value, target, what, elapsed)


def contests(work: Workload) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Return our features of some sound, and those of the paper's library."""
    frames = work.frames(_CONTEST_SECONDS)
    theirs = _pyaudioanalysis(frames.ravel())
    return {"features: pyAudioAnalysis": (lambda: FeatureExtractor()(frames), theirs)}


def _in_blocks(frames: Float32, size: int) -> None:
    extract = FeatureExtractor()
    for start in range(0, len(frames), size):
        extract(frames[start : start + size])


def _pyaudioanalysis(samples: Float32) -> Callable[[], object]:
    from pyAudioAnalysis import ShortTermFeatures  # noqa: PLC0415  a peer may be missing

    return lambda: ShortTermFeatures.feature_extraction(
        samples, SAMPLE_RATE, FRAME_SAMPLES, FRAME_SAMPLES
    )


def _librosa(samples: Float32) -> Callable[[], object]:
    import librosa  # noqa: PLC0415  a peer may be missing

    feature = librosa.feature

    def run() -> None:
        spectrum = np.abs(
            librosa.stft(samples, n_fft=FRAME_SAMPLES, hop_length=FRAME_SAMPLES, center=False)
        )
        mel = feature.melspectrogram(S=spectrum**2, sr=SAMPLE_RATE, n_mels=32)
        feature.mfcc(S=librosa.power_to_db(mel), n_mfcc=13)
        feature.spectral_centroid(S=spectrum, sr=SAMPLE_RATE)
        feature.spectral_rolloff(S=spectrum, sr=SAMPLE_RATE, roll_percent=0.9)
        feature.zero_crossing_rate(
            samples, frame_length=FRAME_SAMPLES, hop_length=FRAME_SAMPLES, center=False
        )

    run()  # it imports its parts, and compiles some, when they are first used
    return run


def _opensmile(samples: Float32) -> Callable[[], object]:
    import opensmile  # noqa: PLC0415  a peer may be missing

    smile = opensmile.Smile(
        opensmile.FeatureSet.eGeMAPSv02, opensmile.FeatureLevel.LowLevelDescriptors
    )
    return lambda: smile.process_signal(samples, SAMPLE_RATE)


_PEERS: dict[str, tuple[str, Target | None, Peer]] = {
    "pyAudioAnalysis": (
        "34 values a frame, among them the 21",
        _FASTER_THAN_THE_PAPERS_LIBRARY,
        _pyaudioanalysis,
    ),
    "librosa": ("16 of the 21 from one spectrum: computes less", None, _librosa),
    "opensmile": ("eGeMAPS: 25 other values every 10 ms", None, _opensmile),
}
