"""Hours of sound as homes have them: recordings back to back, with pauses, or hardly any."""

from collections.abc import Iterator, Sequence
from itertools import chain, repeat
from pathlib import Path

import numpy as np

from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Int16
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.composition import Rooms
from hearthlog.tools.home.routine import LIVING_ROOM
from hearthlog.tools.lab.bench.timing import BenchError

DENSE, QUIET, NIGHT = KINDS = ("dense", "quiet", "night")
_SHARES = {QUIET: 0.5, NIGHT: 0.01}  # of the time in which something sounds
_PIECE = 20 * SAMPLE_RATE  # of a long recording, as one sound
_SEED = 1


def read_recordings(folder: Path, seconds: int) -> list[Int16]:
    """Read recordings of a folder, in the order of their paths, up to some length in all.

    Parameters
    ----------
    folder : Path
    seconds : int

    Returns
    -------
    list of np.ndarray [shape=(n,)], int16

    Raises
    ------
    BenchError
        If there is less than a second of it.
    SourceError
        If a recording cannot be read.
    """
    recordings: list[Int16] = []
    missing = seconds * SAMPLE_RATE
    for path in sorted(p for p in folder.rglob("*") if p.suffix in {".flac", ".wav"}):
        blocks = [np.empty(0, np.int16)]
        for block in read_audio(path):
            scaled = np.clip(np.rint(block * 32768), -32768, 32767).astype(np.int16)
            blocks.append(scaled[:missing])
            missing -= len(blocks[-1])
        recordings.append(np.concatenate(blocks))
        if missing == 0:
            break
    if sum(map(len, recordings)) < SAMPLE_RATE:
        raise BenchError(f"{folder}: holds no second of sound in files *.flac or *.wav")
    return recordings


def lay_out(recordings: Sequence[Int16], kind: str, count: int) -> Int16:
    """Compose sound of one kind; recordings that are too few come again.

    Parameters
    ----------
    recordings : sequence of np.ndarray, int16
        Some samples in all.
    kind : str
        `dense`: back to back, in their order. `quiet`: drawn at random, in half of the time, with
        pauses between them in which there is noise of a room; `night`: in a hundredth of it.
    count : int
        Samples.

    Returns
    -------
    np.ndarray [shape=(count,)], int16
    """
    if kind == DENSE:
        return np.resize(np.concatenate(recordings), count)
    rng = np.random.default_rng(_SEED)
    pieces = [r[at : at + _PIECE] for r in recordings for at in range(0, len(r), _PIECE)]
    order = [pieces[place] for place in rng.permutation(len(pieces))]
    chosen = list(_up_to(round(_SHARES[kind] * count), order))
    pauses = rng.dirichlet(np.full(len(chosen) + 1, 2.0)) * (count - sum(map(len, chosen)))
    sound = np.resize(np.rint(Rooms(LIVING_ROOM, _SEED).floor * 32768).astype(np.int16), count)
    end = 0
    for piece, pause in zip(chosen, pauses.astype(np.int64).tolist(), strict=False):
        start, end = end + pause, end + pause + len(piece)
        mixed = np.add(sound[start:end], piece, dtype=np.int32)
        sound[start:end] = np.clip(mixed, -32768, 32767)
    return sound


def _up_to(count: int, pieces: Sequence[Int16]) -> Iterator[Int16]:
    """Yield pieces, again and again, until there are so many samples."""
    for piece in chain.from_iterable(repeat(pieces)):
        if count <= 0:
            return
        yield piece[:count]
        count -= len(piece)
