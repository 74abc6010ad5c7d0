"""One channel of several: their mean, or the best one where the mean would hide sound."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hearthlog.schemas.arrays import Float32

_SAMPLES = 50_000  # of a block that are looked at
_PIECES = 25  # of a block of 10 s: as the blocks of a floor
_STEADY_DB = 0.42  # noise is below it, as in the floor of a room
_FAINTER = 8.0  # times in power: 9 dB; one of two channels, or two that differ, lose 6 dB at most
_AUDIBLE = 1e-8  # power
_DEAD = 1e-9  # power: of the noise of a converter
_TINY = 1e-12
_DECIDED_SECONDS = 10  # of a stream, after which the channel to hear is chosen again
_INT16_FULL_SCALE = np.float32(32768.0)


def missing_channel(there: int, wanted: int) -> str:
    """Say that there is no such channel.

    Parameters
    ----------
    there : int
        How many there are.
    wanted : int
        From 1 on.
    """
    has = f"{there} channels" if there > 1 else "one channel"
    return f"has {has}, and `channel` asks for number {wanted}: take one from 1 to {there}"


class ChannelMixer:
    """Makes one channel of several: their mean, or the best one where that would hide sound.

    It decides by each block, and stays with a channel until there is sound in several again.

    Parameters
    ----------
    channel : int or None
        The one to hear whatever they hold, from 1 on.
    chosen : callable
        As of `read_audio`.
    takes_first : bool
        Whether the first channel is heard, and not the mean, where that hides no sound.
    """

    def __init__(
        self,
        channel: int | None = None,
        chosen: Callable[[str], object] = str,
        *,
        takes_first: bool = False,
    ) -> None:
        self._fixed = None if channel is None else channel - 1
        self._usual = 0 if takes_first else None  # None: the mean
        self._heard = self._usual
        self._chosen = chosen

    def __call__(self, block: Float32) -> Float32:
        """Mix a block of all channels.

        Parameters
        ----------
        block : np.ndarray [shape=(n, c)], float32

        Returns
        -------
        np.ndarray [shape=(n,)], float32
            Samples that are not finite are NaN.
        """
        block = finite_or_nan(block)
        count = block.shape[1]
        if count == 1 or self._fixed is not None:
            return block[:, self._fixed or 0]
        self.decide(block)
        return self.mix(block)

    def mix(self, block: Float32) -> Float32:
        """Mix a block as it was decided.

        Parameters
        ----------
        block : np.ndarray [shape=(n, c)], float32
        """
        heard = self._fixed if self._fixed is not None else self._heard
        return block.mean(axis=1) if heard is None else np.ascontiguousarray(block[:, heard])

    def decide(self, block: Float32) -> None:
        """Choose what is heard of a block and the next ones.

        Parameters
        ----------
        block : np.ndarray [shape=(n, c)], float32
        """
        some = slice(0, None, max(len(block) // _SAMPLES, 1))
        count = len(block[some]) // _PIECES * _PIECES
        if not count:
            return
        rows = block[some][:count].astype(np.float64)
        pieces = np.nan_to_num(rows).reshape(_PIECES, -1, block.shape[1])
        powers = pieces.var(axis=1)  # an offset is no sound
        total = powers.mean(axis=0)
        lost = np.isnan(block).any(axis=0)
        levels = 10.0 * np.log10(powers + _TINY)
        steady = levels.std(axis=0) < _STEADY_DB
        floors = np.quantile(powers, 0.1, axis=0)
        sounding = ~steady & (total > _AUDIBLE)
        # Steady noise in one channel, above the quiet of one that holds sound, hides that.
        quietest = floors[sounding].min() if sounding.any() else np.inf
        noisy = steady & (total > _FAINTER * quietest)
        usable = ~noisy & ~(lost & ~lost.all())
        best = int(np.where(usable, total, -1.0).argmax())
        if not total[best] > _AUDIBLE:
            return
        if self._usual is None:
            hides, usual = not usable.all(), pieces.mean(axis=2).var(axis=1).mean()
            reasons, is_known = ("their mean is much fainter", "the others hide it"), True
        else:
            hides, usual = not usable[self._usual], total[self._usual]
            reasons = "the first one is much fainter", "the first one hides it"
            # Steady noise of a socket in which nothing is plugged is louder than a quiet room.
            is_known = bool(sounding[best]) or usual < _DEAD
        if is_known and (hides or usual * _FAINTER < total[best]):
            if best != self._heard:
                why = reasons[int(hides)]
                self._chosen(f"channel {best + 1} of {block.shape[1]} is heard alone: {why}")
            self._heard = best
        elif sounding.sum() > 1 or (best == self._usual and sounding[best]):
            self._heard = self._usual


class StreamMixer:
    """Makes one channel of several of a stream, in blocks of any size.

    It decides by each block at first, and then every ten seconds, as of a file.

    Parameters
    ----------
    takes_first : bool
        As of `ChannelMixer`.

    Attributes
    ----------
    news : str
        Which channel is heard alone now, and why, if that is not known yet; to be emptied by who
        reads it.
    """

    def __init__(self, *, takes_first: bool) -> None:
        self.news = ""
        self._mixer = ChannelMixer(chosen=self._choose, takes_first=takes_first)
        self._recent: list[Float32] = []
        self._samples = 0  # of them
        self._begins = True

    def __call__(self, samples: NDArray[np.int16], rate: int) -> NDArray[np.int16]:
        """Mix the next samples.

        Parameters
        ----------
        samples : np.ndarray [shape=(n, c)], int16
        rate : int
            Samples per second.
        """
        block = samples.astype(np.float32) / _INT16_FULL_SCALE
        self._recent.append(block)
        self._samples += len(block)
        is_full = self._samples >= _DECIDED_SECONDS * rate
        if self._begins and not is_full:
            self._mixer.decide(block)
        if is_full:
            self._mixer.decide(np.concatenate(self._recent))
            self._recent, self._samples, self._begins = [], 0, False
        mixed = np.rint(self._mixer.mix(block) * _INT16_FULL_SCALE)
        return np.clip(mixed, -32768, 32767).astype(np.int16)

    def _choose(self, sentence: str) -> None:
        self.news = sentence


def finite_or_nan(block: Float32) -> Float32:
    """Replace infinity by NaN.

    Parameters
    ----------
    block : np.ndarray, float32
    """
    if np.isinf(block).any():
        block = np.where(np.isfinite(block), block, np.float32(np.nan))
    return block
