"""Audio files as one stream of samples at 16 kHz: mono, or those of an array of microphones."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import soxr
from numpy.typing import NDArray

from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.sources.open_audio import BLOCK_SECONDS, RATES, open_audio
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import SAMPLE_RATE


def read_audio(
    path: Path,
    start: float = 0.0,
    end: float = math.inf,
    *,
    channels: int | None = None,
    incomplete: Callable[[str], object] = str,
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
    incomplete : callable
        Told at the end that the file is damaged or cut short, if it is; what is there was yielded.

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
    with open_audio(path) as audio:
        first = round(start * audio.rate)
        last = math.inf if math.isinf(end) else round(end * audio.rate)
        blocks = (mix(block) for block in audio.blocks(first, last))
        yield from _resampled(blocks, audio.rate, channels)
        if fault := audio.fault():
            incomplete(f"{path}: {fault}")


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
    if rate not in RATES:
        raise SourceError(f"a sample rate of {rate} Hz cannot be recorded")
    scale = np.float32(1 << 8 * sound.itemsize - 1) if sound.dtype.kind == "i" else np.float32(1)
    size = int(rate * BLOCK_SECONDS)
    starts = range(0, len(sound), size)
    rows = sound if sound.ndim == 2 else sound[:, np.newaxis]
    blocks = (_mono(rows[start : start + size].astype(np.float32) / scale) for start in starts)
    return np.concatenate([np.empty(0, np.float32), *_resampled(blocks, rate)])


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
        If it has more or fewer; as `open_audio`.
    """
    with open_audio(path) as audio:
        if channels not in {None, audio.channels}:
            raise SourceError(
                f"{path}: has {audio.channels} channels, and `array` names places for {channels}: "
                "name one for each channel of the file, or leave `array` out"
            )


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
