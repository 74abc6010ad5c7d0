"""Audio files as one stream of samples at 16 kHz: mono, or those of an array of microphones."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
import soxr
from numpy.typing import NDArray

from hearthlog.recorder.errors import SourceError
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import SAMPLE_RATE

_BLOCK_SECONDS = 10.0
_RATES = range(1_000, 768_001)  # Hz: all that recordings have, and soxr converts in bounded memory


def read_audio(
    path: Path, start: float = 0.0, end: float = math.inf, *, channels: int | None = None
) -> Iterator[Float32]:
    """Read an audio file of any rate and channel count, block by block.

    Channels are averaged, other rates resampled; samples that are not finite become 0.

    Parameters
    ----------
    path : Path
    start, end : float
        The part to read, in seconds, as far as the file goes.
    channels : int or None
        Those of an array, as `check_channels` takes them, which are kept apart.

    Yields
    ------
    np.ndarray [shape=(n,) or (n, channels)], float32
        Samples in full scale, -1 to 1, at 16 kHz.

    Raises
    ------
    SourceError
        If the file is missing, is not audio, holds none, or has a sample rate below 1 kHz or above
        768 kHz.
    """
    mix = _mono if channels is None else _finite
    with _opened(path) as audio:
        first, last = (round(min(time * audio.samplerate, audio.frames)) for time in (start, end))
        if first:
            audio.seek(first)
        blocks = (mix(block) for block in _blocks(audio, last - first))
        yield from _resampled(blocks, audio.samplerate, channels)


def convert_sound(sound: NDArray[Any], rate: int) -> Float32:
    """Convert samples of any rate and channel count, to the same bits as those of an audio file.

    Parameters
    ----------
    sound : np.ndarray [shape=(n,) or (n, channels)]
        Integers of the full range of their type, signed, or floats in full scale, -1 to 1.
    rate : int
        Samples per second, 1000 to 768,000.

    Returns
    -------
    np.ndarray [shape=(m,)], float32
        As `read_audio` gives it, in one piece.

    Raises
    ------
    SourceError
        If the array has another shape or type, or the rate lies beyond its limits.
    """
    sound = np.asarray(sound)
    if sound.ndim not in {1, 2} or sound.dtype.kind not in "if":
        raise SourceError(f"sound of shape {sound.shape} and type {sound.dtype} cannot be heard")
    if rate not in _RATES:
        raise SourceError(f"a sample rate of {rate} Hz cannot be recorded")
    scale = np.float32(1 << 8 * sound.itemsize - 1) if sound.dtype.kind == "i" else np.float32(1)
    size = int(rate * _BLOCK_SECONDS)
    starts = range(0, len(sound), size)
    rows = sound if sound.ndim == 2 else sound[:, np.newaxis]
    blocks = (_mono(rows[start : start + size].astype(np.float32) / scale) for start in starts)
    return np.concatenate([np.empty(0, np.float32), *_resampled(blocks, rate)])


def audio_seconds(path: Path) -> float:
    """Return the length of an audio file in seconds, as its header says.

    Raises
    ------
    SourceError
        If the file is missing, is not audio, holds none, or has a sample rate below 1 kHz or above
        768 kHz.
    """
    with _opened(path) as audio:
        return float(audio.frames / audio.samplerate)


def check_channels(path: Path, channels: int | None) -> None:
    """Check that an audio file has the channels of an array.

    Parameters
    ----------
    path : Path
    channels : int or None
        None allows any.

    Raises
    ------
    SourceError
        If it has more or fewer; as `audio_seconds`.
    """
    with _opened(path) as audio:
        if channels not in {None, audio.channels}:
            raise SourceError(
                f"{path}: has {audio.channels} channels, and `array` names places for {channels}: "
                "name one for each channel of the file, or leave `array` out"
            )


@contextmanager
def _opened(path: Path) -> Iterator[soundfile.SoundFile]:
    if not path.exists():
        raise SourceError(f"{path}: no such file")
    if not path.is_file():
        raise SourceError(f"{path}: cannot be read as audio (Not a regular file)")
    try:
        with soundfile.SoundFile(path) as audio:
            if audio.samplerate not in _RATES:
                message = f"{path}: a sample rate of {audio.samplerate} Hz cannot be recorded"
                raise SourceError(message)
            if audio.frames == 0:
                raise SourceError(f"{path}: holds no audio")
            yield audio
    except soundfile.LibsndfileError as error:
        reason = error.error_string.rstrip(".")
        raise SourceError(f"{path}: cannot be read as audio ({reason})") from error


def _blocks(audio: soundfile.SoundFile, frames: int) -> Iterator[Float32]:
    size = int(audio.samplerate * _BLOCK_SECONDS)
    while len(block := audio.read(min(size, frames), dtype="float32", always_2d=True)):
        frames -= len(block)
        yield block


def _mono(block: Float32) -> Float32:
    block = _finite(block)
    return block[:, 0] if block.shape[1] == 1 else block.mean(axis=1)


def _finite(block: Float32) -> Float32:
    if not np.isfinite(block).all():
        np.nan_to_num(block, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    return block


def _resampled(
    blocks: Iterator[Float32], rate: int, channels: int | None = None
) -> Iterator[Float32]:
    if rate == SAMPLE_RATE:
        yield from blocks
        return
    resampler = soxr.ResampleStream(rate, SAMPLE_RATE, channels or 1, dtype="float32")
    for block in blocks:
        yield resampler.resample_chunk(np.ascontiguousarray(block))
    shape = () if channels is None else (channels,)
    yield resampler.resample_chunk(np.empty((0, *shape), np.float32), last=True)
