"""Audio files as one stream of samples at 16 kHz: mono, or the channels of an array.

Several channels become one: their mean, or the first channel, or other channels where the mean or
first channel would hide sound.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import soxr
from numpy.typing import NDArray

from hearthlog.recorder.sources.open_audio import BLOCK_SECONDS, RATES, open_audio
from hearthlog.schemas.arrays import Bool, Float32, Float64
from hearthlog.schemas.errors import SourceError
from hearthlog.schemas.frames import SAMPLE_RATE

_BLOCK_SECONDS = 10
_PIECES = 25  # per block, like the blocks of a floor
_FIRST_PIECES = 2  # fewer cannot separate noise from sound
_SAMPLES = 2000  # analysed per piece
_REMEMBERED = 150  # pieces: a minute
_STEADY_DB = 0.42  # noise varies less, as in the room's noise floor
_FAINTER = 8.0  # times in power: 9 dB; one of two channels, or two that differ, lose 6 dB at most
_COVERS = 6.0  # times at most, for a return to the default channels
_CANCELLED = 4.0  # times fainter than a mix of uncorrelated channels
_STANDS_OUT = 2.0  # times the quietest tenth of ten seconds
_MODULATED_DB = 1.5  # spread of parts of 16 ms of a piece: less is noise, more speech or music
_AUDIBLE = 1e-8  # power
_DEAD = 1e-9  # power of a converter's noise
_LOST_SHARE = 0.5  # of the pieces of a block
_TINY = 1e-12
_INT16_FULL_SCALE = np.float32(32768.0)


def missing_channel(there: int, wanted: int) -> str:
    """Return the error text for a missing channel, counted from 1."""
    has = f"{there} channels" if there > 1 else "one channel"
    return f"has {has}, and `channel` asks for number {wanted}: take one from 1 to {there}"


_Samples = TypeVar("_Samples", Float32, Float64)


class ChannelMixer:
    """Mixes several channels to one, in blocks of ten seconds, or takes one `channel`, from 1."""

    def __init__(self, channel: int | None = None, chosen: Callable[[str], object] = str) -> None:
        self._fixed = None if channel is None else channel - 1
        self._choice: _Choice | None = None
        self._chosen = chosen

    def __call__(self, block: Float32) -> Float32:
        """Mix a block [shape=(n, c)] to one channel [shape=(n,)]; NaN where it is not finite."""
        block = finite_or_nan(block)
        count = block.shape[1]
        if count == 1 or self._fixed is not None:
            return block[:, self._fixed or 0]
        if self._choice is None:
            self._choice = _Choice(count, self._chosen)
        self._choice.look_at_block(block)
        size = len(block) // _PIECES
        if not size:
            return self._choice.mix(block)
        starts = [*range(0, size * _PIECES, size), len(block)]
        pieces = [block[start:end] for start, end in pairwise(starts)]
        mixed = []
        for piece in pieces:
            self._choice.look_at_piece(piece)
            mixed.append(self._choice.mix(piece))
        return np.concatenate(mixed)


class StreamMixer:
    """Mixes several channels of live sound to one, independent of the block size.

    The channels of a piece are selected before it starts, so mixing adds no delay. By default they
    are averaged, or the first one if `takes_first`. `news` holds the unreported change of channels
    and its reason; the reader clears it.
    """

    def __init__(self, *, takes_first: bool) -> None:
        self.news = ""
        self._takes_first = takes_first
        self._choice: _Choice | None = None
        self._piece: list[Float32] = []
        self._missing = 0  # samples of that piece
        self._recent: list[Float32] = []  # pieces
        self._begins = True

    def __call__(self, samples: NDArray[np.int16], rate: int) -> NDArray[np.int16]:
        """Mix the next samples [shape=(n, c)] at a rate in Hz."""
        block = samples.astype(np.float32) / _INT16_FULL_SCALE
        if self._choice is None:
            self._choice = _Choice(block.shape[1], self._choose, takes_first=self._takes_first)
        mixed = [np.empty(0, np.float32)]
        while len(block):
            self._missing = self._missing or rate * _BLOCK_SECONDS // _PIECES
            part, block = block[: self._missing], block[self._missing :]
            mixed.append(self._choice.mix(part))
            self._piece.append(part)
            self._missing -= len(part)
            if not self._missing:
                self._look(self._choice, np.concatenate(self._piece))
                self._piece = []
        scaled = np.rint(np.concatenate(mixed) * _INT16_FULL_SCALE)
        return np.clip(scaled, -32768, 32767).astype(np.int16)

    def _look(self, choice: "_Choice", piece: Float32) -> None:
        choice.look_at_piece(piece)
        self._recent.append(piece)
        is_full = len(self._recent) == _PIECES
        if is_full or (self._begins and len(self._recent) >= _FIRST_PIECES):
            choice.look_at_block(np.concatenate(self._recent), is_full=is_full)
        if is_full:
            self._recent, self._begins = [], False

    def _choose(self, sentence: str) -> None:
        usual = "the first channel" if self._takes_first else "the mean of all channels"
        self.news = sentence or f"{usual} is heard again: it hides no other one"


class _Choice:
    """Selection of channels, at two time scales.

    Every ten seconds all channels are compared, long enough to tell steady noise from sound. Every
    0.4 s the mixer switches if another channel holds sound and the selected channels do not, so a
    dead channel, or a talker near another microphone, costs less than a second of live sound. A
    channel that sounds again within a minute is mixed with the selected ones, so alternating
    talkers do not cause a switch every time.
    """

    def __init__(
        self, count: int, chosen: Callable[[str], object], *, takes_first: bool = False
    ) -> None:
        self._count = count
        self._usual = [0] if takes_first else [*range(count)]
        self._in_mix = self._usual
        self._instead: list[int] | None = None  # in this piece, because of NaN
        self._chosen = chosen
        self._usable = np.ones(count, bool)
        self._powers = np.empty((0, count))  # of the last pieces
        self._usual_covers = True  # for all sound since the last block
        self._piece = 0  # number
        self._left = np.full(count, -np.inf)  # number of the last piece in which it was selected
        self._sounded = np.zeros(count)  # last piece within 9 dB of the loudest channel

    def mix(self, samples: Float32) -> Float32:
        """Mix samples [shape=(n, c)] of the selected channels."""
        return self._mixed(samples, self._in_mix if self._instead is None else self._instead)

    def _mixed(self, samples: _Samples, channels: list[int], axis: int = -1) -> _Samples:
        if len(channels) == 1:
            return np.ascontiguousarray(samples.take(channels[0], axis))
        if channels == self._usual:
            return samples.mean(axis)
        chosen = samples.take(channels, axis)
        if self._is_mean():  # one of them has NaN
            return chosen.mean(axis)
        # Uncorrelated channels add up to the noise level of one channel.
        return chosen.sum(axis) / samples.dtype.type(math.sqrt(len(channels)))

    def _power(self, rows: Float64, powers: Float64, channels: list[int]) -> float:
        """Return the power of a mix of channels, which have these powers."""
        if len(channels) == 1:
            return float(powers[channels[0]])
        return float(self._mixed(rows, channels, axis=0).var(axis=-1).mean())

    def look_at_piece(self, piece: Float32) -> None:
        """Switch if, in a piece [shape=(n, c)], only channels that are not selected hold sound."""
        finite = _rows_of(piece, max(len(piece) // _SAMPLES, 1))
        is_lost = np.zeros(self._count, bool)
        if np.isnan(piece.sum()):  # much faster than a look at each sample
            is_lost = np.asarray(np.isnan(piece).any(axis=0))
            finite = _without_holes(finite)
        powers = finite.var(axis=-1)
        self._piece += 1
        self._powers = np.concatenate([self._powers[-_PIECES + 1 :], powers[np.newaxis]])
        is_sound = powers > _AUDIBLE
        rises = powers > _STANDS_OUT * _low_powers(self._powers)
        if (is_sound & ~rises).any():
            is_sound &= rises | (_level_spread(finite) > _MODULATED_DB)
        self._sounded[is_sound & (powers * _FAINTER > powers.max())] = self._piece
        candidates = is_sound & self._usable & ~is_lost
        best = int(np.where(candidates, powers, -1.0).argmax())
        if candidates[best]:
            usual = self._power(finite, powers, self._usual)
            self._usual_covers &= bool(usual * _COVERS > powers[best])
            if self._hides(best, powers[best], self._power(finite, powers, self._in_mix)):
                self._go_to(best, hides=False)
        self._instead = self._without(is_lost, powers) if is_lost[self._in_mix].any() else None

    def look_at_block(self, block: Float32, *, is_full: bool = True) -> None:
        """Select channels from ten seconds [shape=(n, c)], enough to recognise steady noise."""
        step = max(len(block) // (_PIECES * _SAMPLES), 1)
        rows = _rows_of(block, step)
        count = rows.shape[1] // _PIECES * _PIECES
        if not count:
            return
        pieces = rows[:, :count].reshape(self._count, _PIECES, -1)
        lost = np.zeros(self._count, bool)
        if np.isnan(pieces.sum()):
            lost = np.isnan(pieces).any(axis=-1).mean(axis=-1) > _LOST_SHARE
            pieces = _without_holes(pieces)
        powers = pieces.var(axis=-1)  # an offset is no sound
        total = powers.mean(axis=-1)
        levels = 10.0 * np.log10(powers + _TINY)
        steady = levels.std(axis=-1) < _STEADY_DB
        floors = _low_powers(powers.T)
        sounding = ~steady & (total > _AUDIBLE)
        # Steady noise in one channel, above the floor of a channel with sound, hides that sound.
        quietest = floors[sounding].min() if sounding.any() else np.inf
        noisy = steady & (total > _FAINTER * quietest)
        usable = ~noisy & ~(lost & ~lost.all())
        covers = is_full and self._usual_covers
        self._usual_covers = is_full or self._usual_covers
        best = int(np.where(usable, total, -1.0).argmax())
        if not total[best] > _AUDIBLE:
            return
        self._usable = usable
        usual = self._power(pieces, total, self._usual)
        is_usual_there = sounding.sum() > 1 or (self._usual == [best] and sounding[best])
        covers = covers and usable[self._usual].all() and usual * _COVERS > total[best]
        if self._in_mix != self._usual and covers and is_usual_there:
            self._on_samples(self._usual, "")
            return
        power = self._power(pieces, total, self._in_mix)
        # The steady noise of an unplugged socket is louder than a quiet room.
        hides = not usable[self._in_mix].all()
        if (self._is_mean() or sounding[best] or power < _DEAD) and (
            hides or self._hides(best, total[best], power)
        ):
            self._go_to(best, hides=hides)
        elif is_full and self._in_mix != self._usual:
            self._leave_silent()

    def _is_mean(self) -> bool:
        """Whether the mean of all channels is selected, as by default."""
        return self._in_mix == self._usual and len(self._usual) > 1

    def _hides(self, best: int, most: float, power: float) -> bool:
        """Whether a mix of this power hides the best channel."""
        count = len(self._in_mix)
        if self._in_mix != self._usual and best in self._in_mix:
            return power * max(_FAINTER, _CANCELLED * count) < most
        return power * _FAINTER < most

    def _go_to(self, best: int, *, hides: bool) -> None:
        """Select the best channel; keep the others if it was left less than a minute ago."""
        others = [i for i in self._in_mix if self._usable[i] and i != best]
        is_back = best not in self._in_mix and self._piece - self._left[best] < _REMEMBERED
        if is_back and others:
            self._on_samples(sorted([*others, best]), "sound comes from one or the other")
        elif self._is_mean():
            self._on_samples(
                [best], "the others hide it" if hides else "their mean is much fainter"
            )
        else:
            before = "the first one" if self._in_mix == [0] else _names(self._in_mix)
            verb = "is" if len(self._in_mix) == 1 else "are"
            why = "hides it" if hides else f"{verb} much fainter"
            self._on_samples([best], f"{before} {why}")

    def _leave_silent(self) -> None:
        """Drop selected channels that held no sound for a minute."""
        there = [i for i in self._in_mix if self._piece - self._sounded[i] < _REMEMBERED]
        if there and there != self._in_mix:
            silent = _names(i for i in self._in_mix if i not in there)
            self._on_samples(there, f"no more sound comes from {silent}")

    def _on_samples(self, channels: list[int], why: str) -> None:
        if channels == self._in_mix:
            return
        if not self._is_mean():
            self._left[self._in_mix] = self._piece
        self._in_mix = channels
        if channels == self._usual:
            self._chosen("")
            return
        remains = "is heard alone" if len(channels) == 1 else "are heard"
        self._chosen(f"{_names(channels)} of {self._count} {remains}: {why}")

    def _without(self, is_lost: Bool, powers: Float64) -> list[int] | None:
        """Return channels for a piece in which some selected channels have NaN."""
        most = powers[self._in_mix].max()
        held = [i for i in self._in_mix if not is_lost[i]]
        for others in (held, [int(np.where(is_lost, -1.0, powers).argmax())]):
            if others and not is_lost[others].any() and powers[others].max() * _FAINTER >= most:
                return others
        return None


def _names(channels: Iterable[int]) -> str:
    """Format channel numbers, counted from 1."""
    *more, last = (str(i + 1) for i in channels)
    return f"channels {', '.join(more)} and {last}" if more else f"channel {last}"


def _rows_of(samples: Float32, step: int) -> Float64:
    """Return every `step`-th sample, with a row per channel: numpy sums rows much faster."""
    return np.ascontiguousarray(samples[::step].T, np.float64)


def _low_powers(powers: Float64) -> Float64:
    """Return the 0.1 quantile of powers [shape=(n, c)] of each channel [shape=(c,)].

    `numpy.quantile` takes a hundred times as long for as few values.
    """
    ordered = np.sort(powers, axis=0)
    place, share = divmod(0.1 * (len(ordered) - 1), 1)
    low, high = ordered[int(place)], ordered[min(int(place) + 1, len(ordered) - 1)]
    result: Float64 = low + (high - low) * share
    return result


def _level_spread(rows: Float64) -> Float64:
    """Return the standard deviation of the level within a piece, in dB per channel."""
    count = rows.shape[1] // _PIECES * _PIECES
    if not count:
        return np.zeros(len(rows))
    powers = rows[:, :count].reshape(len(rows), _PIECES, -1).var(axis=-1)
    return (10.0 * np.log10(powers + _TINY)).std(axis=-1)


def _without_holes(rows: Float64) -> Float64:
    """Replace NaN by the mean of the other samples of the row."""
    is_hole = np.isnan(rows)
    count = np.maximum((~is_hole).sum(axis=-1, keepdims=True), 1)
    mean = np.where(is_hole, 0.0, rows).sum(axis=-1, keepdims=True) / count
    return np.where(is_hole, mean, rows)


def finite_or_nan(block: Float32) -> Float32:
    """Replace infinity by NaN."""
    if np.isinf(block).any():
        block = np.where(np.isfinite(block), block, np.float32(np.nan))
    return block


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
    """Yield blocks of an audio file of any rate, at 16 kHz [shape=(n,) or (n, channels)].

    Samples are in full scale, -1 to 1; those that are not finite are NaN. Channels are averaged,
    unless they cancel or hide each other; then the best channel is used. With `channels`, the
    number in an array, as in `check_channels`, they stay separate; `channel`, from 1, selects one.
    `start` and `end` are in seconds, limited to the length of the file. `chosen` receives which
    channels are selected and why on a change, and an empty text on return to the default.

    Raise `SourceError` if the file is missing, is not audio, is empty, or has a sample rate below 1
    kHz or above 768 kHz.
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
    """Convert sound [shape=(n,) or (n, channels)] as `read_audio` does, to [shape=(m,)].

    The result is bit-equal to that of a file. `sound` has signed integers of the full range of
    their type, or floats in full scale, -1 to 1; `rate` is in Hz, 1000 to 768,000. Raise
    `SourceError` if shape, type or rate is not supported.
    """
    sound = np.asarray(sound)
    if sound.ndim not in {1, 2} or sound.dtype.kind not in "if":
        raise SourceError(f"sound of shape {sound.shape} and type {sound.dtype} cannot be heard")
    if rate not in RATES:
        raise SourceError(f"a sample rate of {rate} Hz is not supported")
    scale = np.float32(1 << 8 * sound.itemsize - 1) if sound.dtype.kind == "i" else np.float32(1)
    size = int(rate * BLOCK_SECONDS)
    starts = range(0, len(sound), size)
    rows = sound if sound.ndim == 2 else sound[:, np.newaxis]
    mix = ChannelMixer()
    blocks = (mix(rows[start : start + size].astype(np.float32) / scale) for start in starts)
    return np.concatenate([np.empty(0, np.float32), *_resampled(blocks, rate)])


def check_channels(path: Path, channels: int | None, channel: int | None = None) -> None:
    """Check that an audio file has the channels of an array, or a channel, from 1; None for any.

    Raise `SourceError` if the channels do not match; also as `open_audio`.
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
    """Positions of NaN samples, before and after resampling."""

    def __init__(self, ratio: float) -> None:
        self._ratio = ratio
        self._before = self._after = 0  # samples so far
        self._edges: NDArray[np.float64] = np.empty((0, 2))  # of holes, in resampled samples

    def fill(self, block: Float32) -> Float32:
        """Record the NaN samples, and return the block with 0 in their place."""
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
        """Set resampled samples that touch a hole to NaN."""
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
