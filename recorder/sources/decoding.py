"""Audio files as one stream of samples at 16 kHz: mono, or those of an array of microphones."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import soxr
from numpy.typing import NDArray

from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.sources.channels import ChannelMixer, finite_or_nan, missing_channel
from hearthlog.recorder.sources.open_audio import BLOCK_SECONDS, RATES, open_audio
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import SAMPLE_RATE


def read_audio(  # noqa: PLR0913
    path: Path,
    start: float = 0.0,
    end: float = math.inf,
    *,
    channels: int | None = None,
    channel: int | None = None,
    incomplete: Callable[[str], object] = str,
    chosen: Callable[[str], object] = str,
) -> Iterator[Float32]:
    """Read an audio file of any rate and channel count, block by block.

    Channels are averaged, unless they cancel or hide each other; then the best one is heard. Other
    rates are resampled. Samples that are not finite are NaN.

    Parameters
    ----------
    start, end : float
        The part to read, in seconds, as far as the file goes.
    channels : int or None
        Those of an array, as `check_channels` takes them, which are kept apart.
    channel : int or None
        The one to read, from 1 on.
    chosen : callable
        Told in a sentence which channels are heard and why, whenever others are; in an empty one,
        when all are heard again.

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
    mix = finite_or_nan if channels is not None else ChannelMixer(channel, chosen)
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
    mix = ChannelMixer()
    blocks = (mix(rows[start : start + size].astype(np.float32) / scale) for start in starts)
    return np.concatenate([np.empty(0, np.float32), *_resampled(blocks, rate)])


def check_channels(path: Path, channels: int | None, channel: int | None = None) -> None:
    """Check that an audio file has the channels of an array, or the one that is to be heard.

    Parameters
    ----------
    channels : int or None
        Of the array; None allows any.
    channel : int or None
        The one to hear, from 1 on; None allows any.

    Raises
    ------
    SourceError
        If it has more or fewer; as `open_audio`.
    """
    with open_audio(path) as audio:
        if channel is not None and channel > audio.channels:
            raise SourceError(f"{path}: {missing_channel(audio.channels, channel)}")
        if channels not in {None, audio.channels}:
            raise SourceError(
                f"{path}: has {audio.channels} channels, and `array` names places for {channels}: "
                "name one for each channel of the file, or leave `array` out"
            )


def _resampled(
    blocks: Iterator[Float32], rate: int, channels: int | None = None
) -> Iterator[Float32]:
    if rate == SAMPLE_RATE:
        yield from blocks
        return
    resampler = soxr.ResampleStream(rate, SAMPLE_RATE, channels or 1, dtype="float32")
    holes = _Holes(SAMPLE_RATE / rate)
    for block in blocks:
        yield holes.mark(resampler.resample_chunk(np.ascontiguousarray(holes.fill(block))))
    shape = () if channels is None else (channels,)
    last = resampler.resample_chunk(np.empty((0, *shape), np.float32), last=True)
    yield holes.mark(last)


class _Holes:
    """Where samples are NaN, before and after they are resampled."""

    def __init__(self, ratio: float) -> None:
        self._ratio = ratio
        self._before = self._after = 0  # samples so far
        self._edges: NDArray[np.float64] = np.empty((0, 2))  # of holes, in samples after

    def fill(self, block: Float32) -> Float32:
        """Note the samples that are NaN, and return the block with 0 in their place."""
        is_hole = np.isnan(block)
        if is_hole.any():
            rows = is_hole.reshape(len(block), -1).any(axis=1)
            edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.view(np.int8), [0]])))
            found = (self._before + edges.reshape(-1, 2)) * self._ratio
            self._edges = np.concatenate([self._edges, found])
            block = np.where(is_hole, np.float32(0.0), block)
        self._before += len(block)
        return block

    def mark(self, block: Float32) -> Float32:
        """Set the samples after to NaN that the holes touch."""
        if len(self._edges):
            places = np.stack([np.floor(self._edges[:, 0]), np.ceil(self._edges[:, 1])], axis=1)
            inside = np.clip(places - self._after, 0, len(block)).astype(np.intp)
            change = np.zeros(len(block) + 1, np.int64)
            np.add.at(change, inside[:, 0], 1)
            np.add.at(change, inside[:, 1], -1)
            block = block.copy()
            block[change[:-1].cumsum() > 0] = np.nan
            self._edges = self._edges[places[:, 1] > self._after + len(block)]
        self._after += len(block)
        return block
