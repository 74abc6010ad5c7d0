"""The sound and the model that the measurements share; each is made when first asked for."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import soundfile

from hearthlog.analyzer.training.dataset import Dataset, build_dataset
from hearthlog.analyzer.training.manifest import BUILTIN, Scenario, read_manifest
from hearthlog.analyzer.training.train import train_model
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile import save_model
from hearthlog.schemas.arrays import Float32, Int16
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.simulate import write_day, write_training_set
from hearthlog.tools.home.sounds import LABELS
from hearthlog.tools.lab.bench.hours import DENSE, lay_out, read_recordings
from hearthlog.tools.lab.bench.live_logs import LiveLogs, record_as_live, record_file
from hearthlog.tools.lab.home.copies import copy_logs

_MOST_SECONDS = 3600
_DAY = 86_400
_SEED = 1
# Simulated sounds hardly overlap, and would teach a machine of a third of the support vectors.
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
        models are trained from them too.
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
    def samples(self) -> Int16:
        """Up to an hour of sound at 16 kHz, mono, in whole frames: recordings are back to back.

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
            samples = np.concatenate(self._recordings)
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
        return _written(path, self.samples[: round(seconds * SAMPLE_RATE)])

    def wav_of(self, kind: str) -> Path:
        """Return as much sound of one of `KINDS`: of the recordings, or of the simulated clips."""
        if kind == DENSE and self.audio is not None:
            return self.wav
        path = self.folder / f"{kind}.wav"
        if not path.exists():
            _written(path, lay_out(self._recordings, kind, len(self.samples)))
        return path

    @cached_property
    def _recordings(self) -> list[Int16]:
        return read_recordings(self.audio or self._clips.parent, _MOST_SECONDS)

    @cached_property
    def _clips(self) -> Path:
        """Simulated clips, by their manifest."""
        return write_training_set(self.folder / "clips", self.clips_per_class, _SEED)

    @cached_property
    def training(self) -> tuple[Dataset, Scenario]:
        """Segments that the model is trained from, and its classes.

        Raises
        ------
        DataError
            If the manifest of the recordings is not one of a home.
        """
        if self.are_labelled:
            return self.labelled(BUILTIN["general"]), BUILTIN["general"]
        scenario = Scenario("simulated", {label: (label,) for label in LABELS})
        data = _segments(self._clips, scenario)
        noise = np.random.default_rng(_SEED).standard_normal((len(data), 1, data.windows.shape[2]))
        blurred = data.windows + _OVERLAP * noise * data.windows.std(axis=(0, 1))
        return dataclasses.replace(data, windows=blurred.astype(np.float32)), scenario

    @property
    def are_labelled(self) -> bool:
        """Whether there are recordings with a manifest."""
        return self.audio is not None and (self.audio / "manifest.csv").exists()

    def labelled(self, scenario: Scenario) -> Dataset:
        """Return segments of recordings with a manifest."""
        assert self.audio is not None
        return _segments(self.audio / "manifest.csv", scenario)

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
        return self._copies(self.live.finished, "finished")

    @cached_property
    def completed_day(self) -> Path:
        """The same of logs with chunks of half a second."""
        return self._copies(self.live.completed, "completed")

    def day_of(self, kind: str) -> Path:
        """Return such a folder of sound of one of `KINDS`."""
        wav = self.wav_of(kind)
        if wav == self.wav:
            return self.day
        if not (day := self.folder / f"day-{kind}").exists():
            self._copies(record_file(self.folder / f"logs-{kind}", wav, self.model_file), kind)
        return day

    def _copies(self, log: Path, name: str) -> Path:
        """Copy a log until there is a day of it."""
        day, period = self.folder / f"day-{name}", math.ceil(self.seconds)
        copy_logs(log.parents[3], day, max(round(_DAY / period), 1), period)
        return day


def _written(path: Path, samples: Int16) -> Path:
    soundfile.write(path, samples, SAMPLE_RATE, "PCM_16", format="WAV")
    return path


def _segments(manifest: Path, scenario: Scenario) -> Dataset:
    clips = read_manifest(manifest, scenario.labels)
    return build_dataset(clips, scenario, ignore_progress)
