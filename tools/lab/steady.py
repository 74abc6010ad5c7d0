"""`python -m hearthlog.tools.lab.steady SOUND …`: for how long a steady sound is no silence.

A minute of a faint room is followed by two minutes of a recording, which repeats itself, at several
levels. `hearthlog record` labels each; what it does not call silence is counted.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import soundfile
import typer

from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.logs.spans import intersection_rows, single_span
from hearthlog.models.classes import SILENCE
from hearthlog.models.starter import GENERAL
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.frames import NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.lab.command import run

LEVELS = -60.0, -50.0, -40.0, -36.0, -34.0, -25.0  # dBFS
_ROOM, _ROOM_SECONDS = -70.0, 60
_SECONDS = 120
_CROSSFADE = SAMPLE_RATE // 2
_NAME, _START = "20260301_000000.wav", 1_772_323_200  # the start that the name says


def _room() -> Float64:
    """Return three minutes of the noise of a faint room."""
    count = (_ROOM_SECONDS + _SECONDS) * SAMPLE_RATE
    spectrum = np.fft.rfft(np.random.default_rng(0).standard_normal(count))
    spectrum /= np.sqrt(np.maximum(np.fft.rfftfreq(count, 1 / SAMPLE_RATE), 20.0))
    return _at_level(np.fft.irfft(spectrum, count), _ROOM)


def _lasting(sound: Float64, count: int) -> Float64:
    """Repeat a sound, each time blended into the next, up to a number of samples."""
    fade = min(_CROSSFADE, len(sound) // 4)
    rise = np.sqrt(np.linspace(0.0, 1.0, fade))
    step = len(sound) - fade
    blended = sound.copy()
    blended[:fade] *= rise
    blended[-fade:] *= rise[::-1]
    lasts = np.zeros(count + step + len(sound))
    for start in range(0, count + step, step):
        lasts[start : start + len(sound)] += blended
    return lasts[step : step + count]


def sounding_seconds(sound: Float64, level: float, model: str = GENERAL) -> float:
    """Record a steady sound after a minute of a faint room; return its seconds of no silence.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,)], float64
    level : float
        In dBFS.
    model : str, optional
        That labels.
    """
    mix = _room()
    mix[_ROOM_SECONDS * SAMPLE_RATE :] += _at_level(_lasting(sound, _SECONDS * SAMPLE_RATE), level)
    with tempfile.TemporaryDirectory(prefix="hearthlog-steady-") as place:
        audio, logs = Path(place) / _NAME, Path(place) / "logs"
        soundfile.write(audio, mix, SAMPLE_RATE, "PCM_16")
        hearthlog = Path(sys.executable).with_name("hearthlog")
        words = ["record", str(audio), "-o", str(logs), "--model", model]
        subprocess.run([hearthlog, *words], check=True, capture_output=True)  # noqa: S603  ours
        labellings = find_labellings(logs)
        labels = labellings.read(labellings.microphone(None), LIVE).labelling
    begins = (_START + _ROOM_SECONDS) * NANOSECONDS
    inside, rows, _ = intersection_rows(
        labels, single_span(begins, begins + _SECONDS * NANOSECONDS)
    )
    sounds = labels.labels[rows] != SILENCE
    return float((inside.ends - inside.starts)[sounds].sum()) / NANOSECONDS


def _at_level(sound: Float64, level: float) -> Float64:
    return sound * 10 ** (level / 20) / np.sqrt(np.mean(sound**2))


def main(
    sounds: Annotated[list[Path], typer.Argument(help="Recordings of steady sounds.")],
    model: Annotated[str, typer.Option(help="That labels.")] = GENERAL,
) -> None:
    """Print seconds of 120 that are not silence, for each sound and level."""
    print(f"{'dBFS':32}{''.join(f'{level:7.0f}' for level in LEVELS)}")
    for path in sounds:
        sound = np.concatenate(list(read_audio(path))).astype(np.float64)
        row = (sounding_seconds(sound, level, model) for level in LEVELS)
        print(f"{path.stem[:31]:32}{''.join(f'{seconds:7.1f}' for seconds in row)}", flush=True)


if __name__ == "__main__":
    run(main)
