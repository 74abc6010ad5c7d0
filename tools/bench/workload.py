"""The sound and the model that the measurements share; each is made when first asked for."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from hearthlog.analyzer.training.dataset import Dataset, build_dataset
from hearthlog.analyzer.training.manifest import read_manifest
from hearthlog.analyzer.training.scenario import BUILTIN, Scenario
from hearthlog.analyzer.training.train import train_model
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile.modelfile import save_model
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.schemas.progress import ignore_progress
from hearthlog.tools.bench.live_logs import LiveLogs, record_as_live
from hearthlog.tools.bench.timing import BenchError
from hearthlog.tools.home.copies import copy_logs
from hearthlog.tools.home.simulate import write_day, write_training_set
from hearthlog.tools.home.sounds import LABELS

_MOST_SECONDS = 3600
_DAY = 86_400
_SEED = 1
# Simulated sounds hardly overlap, and would need a third of the support vectors that real ones do.
_OVERLAP = 0.75  # standard deviations


@dataclass
class Workload:
    """What is measured.

    Parameters
    ----------
    folder : Path
        An empty one, for files on the way.
    audio : Path or None
        Folder of recordings to use instead of the simulated home; with a `manifest.csv` in it the
        model is trained from them too.
    minutes : float
        Length of the simulated day.
    clips_per_class : int
        Size of the simulated training set.
    """

    folder: Path
    audio: Path | None = None
    minutes: float = 60.0
    clips_per_class: int = 40

    @cached_property
    def samples(self) -> NDArray[np.int16]:
        """Up to an hour of sound at 16 kHz, mono, in whole frames.

        Raises
        ------
        BenchError
            If there is less than a second of it.
        SourceError
            If a recording cannot be read.
        """
        if self.audio is None:
            day = self.folder / "day.flac"
            write_day(day, self.minutes, _SEED + 1, manifest=None)
            samples, _ = soundfile.read(day, dtype="int16")
        else:
            samples = _recordings(self.audio)
        return samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES]

    @property
    def seconds(self) -> float:
        """Length of the sound."""
        return len(self.samples) / SAMPLE_RATE

    def frames(self, seconds: float) -> Float32:
        """Return the first seconds as frames of shape (n, 800) in full scale."""
        chosen = self.samples[: round(seconds * SAMPLE_RATE)]
        return (chosen.astype(np.float32) / np.float32(32768)).reshape(-1, FRAME_SAMPLES)

    @cached_property
    def wav(self) -> Path:
        """The sound as a file."""
        return self.write_wav("sound.wav", self.seconds)

    def write_wav(self, name: str, seconds: float) -> Path:
        """Write the first seconds of the sound to a file of this name."""
        path = self.folder / name
        samples = self.samples[: round(seconds * SAMPLE_RATE)]
        soundfile.write(path, samples, SAMPLE_RATE, "PCM_16", format="WAV")
        return path

    @cached_property
    def training(self) -> tuple[Dataset, Scenario]:
        """Segments that the model is trained from, and its classes.

        Raises
        ------
        DataError
            If the manifest of the recordings is not one of a home.
        """
        if self.audio is not None and (self.audio / "manifest.csv").exists():
            scenario = BUILTIN["general"]
            clips = read_manifest(self.audio / "manifest.csv", scenario.labels)
            return build_dataset(clips, scenario, ignore_progress), scenario
        manifest = write_training_set(self.folder / "clips", self.clips_per_class, _SEED)
        scenario = Scenario("simulated", {label: (label,) for label in LABELS})
        clips = read_manifest(manifest, scenario.labels)
        data = build_dataset(clips, scenario, ignore_progress)
        noise = np.random.default_rng(_SEED).standard_normal((len(data), 1, data.windows.shape[2]))
        blurred = data.windows + _OVERLAP * noise * data.windows.std(axis=(0, 1))
        return dataclasses.replace(data, windows=blurred.astype(np.float32)), scenario

    @cached_property
    def model(self) -> Model:
        """A model of realistic size; its labels of simulated sound are not to be trusted."""
        return train_model(*self.training, ignore_progress)

    @cached_property
    def model_file(self) -> Path:
        """The same as a file."""
        path = self.folder / "bench.safetensors"
        save_model(self.model, path)
        return path

    @cached_property
    def live(self) -> LiveLogs:
        """The sound, labelled by the model, as logs that the live recorder leaves."""
        return record_as_live(self.folder / "live", self.wav, self.model_file)

    @cached_property
    def day(self) -> Path:
        """A folder of a day of finished logs: the sound as often as it takes."""
        return self._copies("finished")

    @cached_property
    def completed_day(self) -> Path:
        """The same of logs with chunks of half a second."""
        return self._copies("completed")

    def _copies(self, state: str) -> Path:
        """Copy the logs of a folder of `live` until they are a day."""
        logs, day = self.live.finished.parents[4] / state, self.folder / f"day-{state}"
        period = math.ceil(self.seconds)
        copy_logs(logs, day, max(round(_DAY / period), 1), period)
        return day


def _recordings(folder: Path) -> NDArray[np.int16]:
    blocks: list[NDArray[np.int16]] = []
    missing = _MOST_SECONDS * SAMPLE_RATE
    for path in sorted(p for p in folder.rglob("*") if p.suffix in {".flac", ".wav"}):
        for block in read_audio(path):
            scaled = np.clip(np.rint(block * 32768), -32768, 32767).astype(np.int16)
            blocks.append(scaled[:missing])
            missing -= len(blocks[-1])
        if missing == 0:
            break
    if sum(map(len, blocks)) < SAMPLE_RATE:
        raise BenchError(f"{folder}: holds no second of sound in files *.flac or *.wav")
    return np.concatenate(blocks)
