"""Evidence in addition to features: directions of an array, and embeddings of a network."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.model import EmbeddingMix, NamesHead
from hearthlog.models.embedding import (
    HOP_FRAMES,
    NO_EMBEDDINGS,
    WINDOW_FRAMES,
    Embeddings,
    FrameSpans,
    Int8,
)
from hearthlog.schemas.arrays import Float32, Float64, Indices, Int32, Int64

BLOCK_FRAMES = 4  # frames per direction: 0.2 s
SECTORS = 36  # sectors of the circle in a model
MEMORY_BLOCKS = 5  # number of last blocks used for a window: a second
MOST_EVIDENCE = 5.0  # limit of the log-likelihood ratio of a class given a direction


@dataclass(frozen=True, eq=False)
class Directions(FrameSpans):
    """Directions of the blocks of one stream of frames in which a sound was located."""

    LENGTH = BLOCK_FRAMES

    azimuths: Float32  # [shape=(m,)] in radians, -pi to pi, counter-clockwise from x
    # [shape=(m,)] agreement of the microphones on this direction relative to any direction, 0 to 1
    confidences: Float32


NOWHERE = Directions(
    np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32)
)


def sectors_of(azimuths: Float32) -> Indices:
    """Return the sectors [shape=(n,)], 0 to 35 counter-clockwise, of azimuths in radians.

    The middle of the first sector is ahead.
    """
    places = np.rint(azimuths.astype(np.float64) * (SECTORS / (2 * np.pi)))
    return places.astype(np.intp) % SECTORS


class DirectionEvidence:
    """Evidence of directions for the windows of one stream of frames.

    A window uses the blocks of the last second that are complete at its last frame. Their evidence
    is averaged, weighted by confidence, because the blocks of one sound are not independent.
    `weights` [shape=(C, S)] are log-likelihood ratios of each class in each sector.
    """

    def __init__(self, weights: Float64) -> None:
        self._weights = np.ascontiguousarray(weights.T)
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._recent = NOWHERE
        self._full_from: int | None = None

    def is_full(self, frame: int) -> bool:
        """Return whether evidence from a frame on needs no directions before the first frame."""
        return self._full_from is not None and frame >= self._full_from

    def push(self, directions: Directions, first: int, count: int, windows: int) -> Float64:
        """Add frames; return what is added to log-probabilities [shape=(windows, C)].

        It is 0 where no sound was located. The same frames give the same bits in blocks of any
        size.
        """
        if self._full_from is None:
            self._full_from = first + BLOCK_FRAMES * (MEMORY_BLOCKS + 1)
        recent = self._recent.followed_by(directions)
        end = first + count
        # The last block that is complete at the last frame of each window.
        newest = np.arange(end - windows + 1, end + 1) // BLOCK_FRAMES - 1
        evidence = self._of_blocks(recent, newest)
        oldest = (end // BLOCK_FRAMES - MEMORY_BLOCKS) * BLOCK_FRAMES
        self._recent = recent.rows(slice(np.searchsorted(recent.frames, oldest), None))
        return evidence

    def _of_blocks(self, recent: Directions, newest: Int64) -> Float64:
        """Return the evidence of the last second of blocks before each block number."""
        if not len(newest):
            return np.zeros((0, self._weights.shape[1]))
        count = int(newest[-1] - newest[0]) + 1
        places = recent.frames // BLOCK_FRAMES - newest[0] + MEMORY_BLOCKS - 1
        inside = (places >= 0) & (places < count + MEMORY_BLOCKS - 1)
        weights = self._weights[sectors_of(recent.azimuths[inside])]
        witnesses = np.zeros((count + MEMORY_BLOCKS - 1, self._weights.shape[1] + 1))
        witnesses[places[inside]] = np.pad(weights, ((0, 0), (0, 1)), constant_values=1.0)
        witnesses[places[inside]] *= recent.confidences[inside].astype(np.float64)[:, np.newaxis]
        total = np.zeros((count, witnesses.shape[1]))
        for age in range(MEMORY_BLOCKS):
            total += witnesses[age : age + count]
        means = total[:, :-1] / np.where(total[:, -1:] > 0, total[:, -1:], 1.0)
        return means[newest - newest[0]]


class Auxiliary(NamedTuple):
    """Directions of an array and embeddings of a network for one stream of frames."""

    directions: Directions = NOWHERE
    embeddings: Embeddings = NO_EMBEDDINGS

    def available_at(self, first: int, count: int) -> "Auxiliary":
        """Return the entries that become available with some successive frames."""
        return Auxiliary(
            self.directions.available_at(first, count), self.embeddings.available_at(first, count)
        )

    def followed_by(self, later: "Auxiliary") -> "Auxiliary":
        """Concatenate these entries and later entries."""
        return Auxiliary(
            self.directions.followed_by(later.directions),
            self.embeddings.followed_by(later.embeddings),
        )


NO_AUXILIARY = Auxiliary()


_MIDDLE = WINDOW_FRAMES // 2


class EmbeddingEvidence:
    """Interpolates the evidence of windows, one value per class, to frames.

    A frame lies between the middles of two windows; one or both may be missing. `of_windows` maps
    embeddings [shape=(m, W)] to values [shape=(m, C)].
    """

    def __init__(self, of_windows: Callable[[Int8], Float64], classes: int) -> None:
        self._evidence_of = of_windows
        self._classes = classes
        self.restart()

    def restart(self) -> None:
        """Reset the state; the next frame does not follow the previous frame."""
        self._windows = np.empty(0, np.int64)  # numbers of the windows, in order of time
        self._values = np.empty((0, self._classes))
        self._first: int | None = None

    def push(self, embeddings: Embeddings, first: int) -> None:
        """Add embeddings."""
        if self._first is None:
            self._first = first
        if not len(embeddings.frames):
            return
        values = self._evidence_of(embeddings.values)
        self._windows = np.append(self._windows, embeddings.frames // HOP_FRAMES)
        self._values = np.concatenate([self._values, values])

    def is_full(self, frame: int) -> bool:
        """Return whether evidence from a frame on needs no embeddings before the first frame."""
        begin = frame - frame % HOP_FRAMES - _MIDDLE
        return self._first is not None and begin >= self._first

    def at(self, first: int, count: int) -> Float64:
        """Return the evidence at frames [shape=(count, C)], NaN without window; discard earlier."""
        share = ((np.arange(first, first + count) - _MIDDLE) % HOP_FRAMES + 0.5) / HOP_FRAMES
        earlier, later = self._around(first, count)
        earlier = np.where(np.isnan(earlier), later, earlier)
        later = np.where(np.isnan(later), earlier, later)
        evidence: Float64 = (1.0 - share[:, np.newaxis]) * earlier + share[:, np.newaxis] * later
        return evidence

    def highest_at(self, first: int, count: int) -> Float64:
        """Return the higher evidence of the two windows, where `at` interpolates."""
        highest: Float64 = np.fmax(*self._around(first, count))
        return highest

    def _around(self, first: int, count: int) -> tuple[Float64, Float64]:
        """Return the values of the windows before and after frames, and discard earlier windows."""
        before = (np.arange(first, first + count) - _MIDDLE) // HOP_FRAMES
        earlier, later = self._of_windows(before), self._of_windows(before + 1)
        keep = np.searchsorted(self._windows, (first + count - _MIDDLE) // HOP_FRAMES)
        self._windows, self._values = self._windows[keep:], self._values[keep:]
        return earlier, later

    def _of_windows(self, numbers: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Float64:
        """Return the log-probabilities of windows; NaN for missing windows."""
        values = np.full((len(numbers), self._classes), np.nan)
        if len(self._windows):
            places = np.minimum(np.searchsorted(self._windows, numbers), len(self._windows) - 1)
            there = self._windows[places] == numbers
            values[there] = self._values[places[there]]
        return values


# Unit of weights and biases. A sum of 1024 products of 32 with 8 bits has fewer than 53 bits, so it
# is exact in a float64: independent of order and of the BLAS.
UNIT = 2.0**-22
LEAST = 1e-4  # minimum probability of a class in a head or classifier: none has a veto
UNTAUGHT = -(2**31)  # bias of a class that a head was not trained on
_OF_UNTAUGHT = -0.9  # log-probability of such a class: the average of a head for the correct class
_STEP = 2.0**-20  # of logarithms: finer digits depend on the processor
_ROWS_AT_ONCE = 4096


class EmbeddingHeads:
    """The heads of one model, linear heads and names, which are mixed with a classifier.

    A network trained on millions of clips recognises household sounds unknown to the model, but not
    their start. So the feature classifier decides on silence, and all of them together decide on
    the class of a sound. A window's result does not depend on other windows of the batch, nor on
    threads.

    The linear heads have `weights` [shape=(H, W, C), int32] and `bias` [shape=(H, C), int32], in
    units of `UNIT`; a bias of `UNTAUGHT` leaves a class to the other heads.
    """

    def __init__(
        self, mix: EmbeddingMix, weights: Int32, bias: Int32, classes: Sequence[str]
    ) -> None:
        self.network, self.projection_sha256 = mix.network, mix.projection_sha256
        self._classes = len(classes)
        self._sounds = sounds_of(classes)
        self._weights = weights[..., self._sounds].astype(np.float64)
        self._untaught = bias[:, self._sounds] == UNTAUGHT
        self._bias = UNIT * bias[:, self._sounds].astype(np.float64)
        self._of_heads, self._of_home = mix.head_weights, mix.of_home
        names = [classes[number] for number in self._sounds]
        self._names = [_Names(head, names) for head in mix.names]

    def log_probabilities(self, values: Int8) -> Float64:
        """Return the weighted log-probabilities [shape=(m, C)] of logged values [shape=(m, W)].

        They are sums of the logarithms of the heads' probabilities, times their weights in the mix,
        plus the head of a home; 0 for silence, which the heads do not cover.
        """
        result = np.zeros((len(values), self._classes))
        for start in range(0, len(values), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            result[rows, self._sounds] = self._of_sounds(values[rows])
        return result

    def _of_sounds(self, values: Int8) -> Float64:
        steps, total = values.astype(np.float64), np.zeros((len(values), len(self._sounds)))
        for number, weight in enumerate(self._of_heads):
            taught = ~self._untaught[number]
            by_heads = np.full(total.shape, _OF_UNTAUGHT)
            if taught.any():
                slopes, bias = self._weights[number][:, taught], self._bias[number, taught]
                by_heads[:, taught] = floored(UNIT * (steps @ slopes) + bias)
            total += weight * by_heads
        if self._of_home:
            total += UNIT * (steps @ self._weights[-1]) + self._bias[-1]
        for head in self._names:
            total += head.weight * floored(head.decide(values))
        return np.rint(total / _STEP) * _STEP


class _Names:
    """The scores of some classes from the names of a network."""

    def __init__(self, head: NamesHead, classes: Sequence[str]) -> None:
        self.weight, self._slope = head.weight, head.slope
        named = [number for number, name in enumerate(classes) if name in head.classes]
        lists = [head.classes[classes[number]] for number in named]
        self._values = np.array([value for one in lists for value in one], np.intp)
        self._starts = np.cumsum([0, *map(len, lists)])[:-1].astype(np.intp)
        self._named = np.array(named, np.intp)
        self._bias = np.array([head.bias.get(name, 0.0) for name in classes])[named]
        self._count = len(classes)

    def decide(self, values: Int8) -> Float64:
        """Return decision values; -inf for classes without names."""
        decisions = np.full((len(values), self._count), -np.inf)
        highest = np.maximum.reduceat(values[:, self._values], self._starts, axis=1)
        decisions[:, self._named] = self._slope * highest.astype(np.float64) + self._bias
        return decisions


def sounds_of(classes: Sequence[str]) -> Indices:
    """Return the indices of the classes other than silence."""
    sounds = [number for number, name in enumerate(classes) if name != SILENCE]
    return np.array(sounds, np.intp)


def floored(decisions: Float64) -> Float64:
    """Return log-probabilities [shape=(n, C)], limited to about `LEAST` from below.

    -inf is allowed, but not for a complete row.
    """
    grown = np.exp(decisions - decisions.max(axis=1, keepdims=True))
    logarithms: Float64 = np.log(grown / grown.sum(axis=1, keepdims=True) + LEAST)
    return logarithms


def mixed(
    decisions: Float64, by_heads: Float64, mix: EmbeddingMix, classes: Sequence[str]
) -> Float64:
    """Mix the outputs of classifier and heads to log-probabilities [shape=(n, C)].

    Silence keeps the classifier's probability; the other classes share the rest. `decisions` are
    logarithms of the classifier's probabilities, plus any constant per row; `by_heads` is from
    `EmbeddingHeads.log_probabilities`.
    """
    sounds = sounds_of(classes)
    of_sounds = decisions[:, sounds]
    total = mix.machine_weight * floored(of_sounds) + by_heads[:, sounds]
    total /= mix_weight(mix)
    total += np.array([mix.bias.get(classes[number], 0.0) for number in sounds])
    total *= mix.inverse_temperature
    result = np.empty_like(decisions)
    result[:, sounds] = total - _log_sum(total) + _log_sum(of_sounds) - _log_sum(decisions)
    if len(sounds) < len(classes):
        silence = list(classes).index(SILENCE)
        result[:, silence] = decisions[:, silence] - _log_sum(decisions)[:, 0]
    return result


def mix_weight(mix: EmbeddingMix) -> float:
    """Return the sum of all weights of a mix."""
    return sum(mix.head_weights) + sum(head.weight for head in mix.names) + mix.machine_weight


def _log_sum(values: Float64) -> Float64:
    """Return the logarithms of sums of exponentials, shape (n, 1)."""
    highest = values.max(axis=1, keepdims=True)
    total: Float64 = np.log(np.exp(values - highest).sum(axis=1, keepdims=True)) + highest
    return total
