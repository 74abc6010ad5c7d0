"""Voices: seconds of speech as points of a learned space, and how alike they are."""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from safetensors.numpy import load

from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64

_INDEPENDENT = 0.2  # of a window: windows overlap, and what is said lasts
_MOST_CERTAIN = 4.0  # windows: nobody sounds the same twice, however long one speaks
_SMOOTHED = 1  # windows at either side
_ROUNDS = 2


class VoiceEvidence(NamedTuple):
    """Points of speech, taken together.

    Attributes
    ----------
    counts : np.ndarray [shape=(n,)], float64
        How many points there are of each.
    sums : np.ndarray [shape=(n, d)], float64
        Their sums.
    """

    counts: Float64
    sums: Float64

    def rows(self, rows: Int64 | Bool) -> "VoiceEvidence":
        """Return some of it."""
        return VoiceEvidence(self.counts[rows], self.sums[rows])


def summed(points: Float64, of: Int64, count: int) -> VoiceEvidence:
    """Take points together.

    Parameters
    ----------
    points : np.ndarray [shape=(n, d)], float64
    of : np.ndarray [shape=(n,)], int64
        What each is of, from 0 to `count`, which is left out.
    """
    own = (of == np.arange(count)[:, np.newaxis]).astype(np.float64)
    return VoiceEvidence(own.sum(axis=1), own @ points)


def same_voice(one: VoiceEvidence, others: VoiceEvidence, spread: Float64) -> Float64:
    """Return by how much likelier one voice is than two: the logarithm of the ratio.

    Both are means of points of which those of a voice have variance 1 around its own mean, and
    voices the variance `spread` (the two-covariance model of Brümmer and de Villiers, Odyssey
    2010).

    Parameters
    ----------
    spread : np.ndarray [shape=(d,)], float64

    Returns
    -------
    np.ndarray [shape=(n,)], float64
    """
    return _ratio(_weighed(one, spread), _weighed(others, spread), spread)


class _Weighed(NamedTuple):
    """Evidence as independent points, and how likely each is of one voice, as a logarithm."""

    counts: Float64  # shape (n,)
    sums: Float64  # shape (d, n)
    likelihood: Float64

    def rows(self, rows: Int64 | slice) -> "_Weighed":
        return _Weighed(self.counts[rows], self.sums[:, rows], self.likelihood[rows])


def _weighed(evidence: VoiceEvidence, spread: Float64) -> _Weighed:
    """Return evidence of the same means by as many independent points as it is worth."""
    counts = _INDEPENDENT * evidence.counts
    counts = counts / (1.0 + counts / _MOST_CERTAIN)
    sums = np.ascontiguousarray(evidence.sums.T) * (counts / evidence.counts)
    return _Weighed(counts, sums, _likelihood(counts, sums, spread))


def _ratio(one: _Weighed, others: _Weighed, spread: Float64) -> Float64:
    both = _likelihood(one.counts + others.counts, one.sums + others.sums, spread)
    return both - one.likelihood - others.likelihood


def _likelihood(counts: Float64, sums: Float64, spread: Float64) -> Float64:
    """Return the logarithm of how likely one voice is, beside the mean of all voices."""
    variance = spread[:, np.newaxis]
    scale = 1.0 + counts * variance
    terms = (sums**2 * (variance / scale)).sum(axis=0)
    likelihood: Float64 = 0.5 * (terms - np.log(scale.prod(axis=0)))
    return likelihood


def merged_voices(evidence: VoiceEvidence, spread: Float64) -> Int64:
    """Join what is likelier of one voice than of two, the likeliest first.

    Parameters
    ----------
    spread : np.ndarray [shape=(d,)], float64

    Returns
    -------
    np.ndarray [shape=(n,)], int64
        The voice of each row, from 0 on.
    """
    counts, sums = evidence.counts.copy(), evidence.sums.copy()
    size = len(counts)
    of = np.arange(size)
    weighed = _weighed(evidence, spread)
    ratios = np.full((size, size), -np.inf)
    for row in range(size - 1):
        later = slice(row + 1, size)
        one = weighed.rows(slice(row, row + 1))
        ratios[row, later] = ratios[later, row] = _ratio(one, weighed.rows(later), spread)
    best = ratios.max(axis=1, initial=-np.inf)
    while size and best.max() > 0.0:
        row = int(best.argmax())
        other = int(ratios[row].argmax())
        counts[row] += counts[other]
        sums[row] += sums[other]
        of[of == other] = row
        stale = np.isfinite(best) & ((ratios[row] == best) | (ratios[other] == best))
        ratios[other] = ratios[:, other] = -np.inf
        there = np.flatnonzero(np.isfinite(ratios[row]))
        now = _weighed(VoiceEvidence(counts[[row]], sums[[row]]), spread)
        for kept, value in zip(weighed, now, strict=True):
            kept[..., row] = value[..., 0]
        ratios[row, there] = ratios[there, row] = _ratio(now, weighed.rows(there), spread)
        stale[[row, other]] = True
        np.maximum(best, ratios[row], out=best)
        best[stale] = ratios[stale].max(axis=1)
    _, of = np.unique(of, return_inverse=True)
    return of.astype(np.int64)


def tell_apart(points: Float64, spread: Float64, least: int) -> Int64:
    """Tell the voices of a conversation apart.

    Parameters
    ----------
    points : np.ndarray [shape=(n, d)], float64
        Of its windows, in the order of time.
    spread : np.ndarray [shape=(d,)], float64

    Returns
    -------
    np.ndarray [shape=(n,)], int64
        The voice of each window, from 0 on.
    """
    of = merged_voices(VoiceEvidence(np.ones(len(points)), points), spread)
    for _ in range(_ROUNDS):
        counts = np.bincount(of)
        kept = np.flatnonzero(counts >= min(least, counts.max()))
        voices = summed(points, of, len(counts)).rows(kept)
        of = _smoothed(_likeness(points, voices, spread)).argmax(axis=1)
        _, of = np.unique(of, return_inverse=True)
    return of.astype(np.int64)


def _likeness(points: Float64, voices: VoiceEvidence, spread: Float64) -> Float64:
    """Return the expected log likelihoods of points, but for what all voices have in common."""
    counts, sums = _INDEPENDENT * voices.counts, _INDEPENDENT * voices.sums
    variance = spread / (1.0 + counts[:, np.newaxis] * spread)
    mean = variance * sums
    likeness: Float64 = points @ mean.T - 0.5 * (mean**2 + variance).sum(axis=1)
    return likeness


def _smoothed(values: Float64) -> Float64:
    """Take the mean of each row and its neighbours."""
    width = 2 * _SMOOTHED + 1
    padded = np.pad(values, ((_SMOOTHED, _SMOOTHED), (0, 0)), "edge")
    smoothed: Float64 = np.lib.stride_tricks.sliding_window_view(padded, width, 0).mean(axis=-1)
    return smoothed


FILE = "voice_space.safetensors"
WINDOW_FRAMES = 30
HOP_FRAMES = 10
_NAMES = (
    *("zero_crossing_rate", "energy_entropy", "spectral_centroid", "spectral_spread"),
    *("spectral_entropy", "spectral_flux", "spectral_rolloff"),
    *(f"mfcc_{number}" for number in range(2, 14)),  # the first one is the level
)
ENERGY = "energy"
_LOUD_PERCENTILE = 90
_LOUD = 10 ** (-20 / 10)  # of the energy at that percentile
_LEAST_DEVIATION = 0.05
_TINY = 1e-9


class VoiceSpace(NamedTuple):
    """A space in which seconds of one voice scatter alike in all directions.

    Attributes
    ----------
    mean : np.ndarray [shape=(width,)], float64
        Of descriptions of speech.
    axes : np.ndarray [shape=(d, width)], float64
        Along each of them the variance of one voice is 1.
    spread : np.ndarray [shape=(d,)], float64
        Variance of the means of voices along each axis, descending.
    """

    mean: Float64
    axes: Float64
    spread: Float64

    def points(self, described: Float64) -> Float64:
        """Return where described windows lie, shape (n, d)."""
        points: Float64 = (described - self.mean) @ self.axes.T
        return points


@cache
def voice_space() -> VoiceSpace:
    """Return the space that comes with hearthlog."""
    arrays = load((files(__package__) / FILE).read_bytes())
    return VoiceSpace(*(arrays[name].astype(np.float64) for name in VoiceSpace._fields))


def has_voices(names: Sequence[str]) -> bool:
    """Tell whether features of these names can tell voices apart."""
    return {ENERGY, *_NAMES} <= set(names)


def window_starts(frames: int) -> Int64:
    """Return where windows of some frames begin: one at least, if there is a frame."""
    return np.arange(0, max(frames - WINDOW_FRAMES, 0) + 1, HOP_FRAMES)


def describe_speech(values: Float32, names: Sequence[str]) -> Float64:
    """Describe windows of speech: means and deviations of its features, in its loud frames.

    Parameters
    ----------
    values : np.ndarray [shape=(frames, f)], float32
        Features of speech, at least one frame.

    Returns
    -------
    np.ndarray [shape=(windows, 38)], float64
        Means, and logarithms of standard deviations, of each window of `window_starts`.
    """
    columns = [list(names).index(name) for name in _NAMES]
    length = min(WINDOW_FRAMES, len(values))
    view = np.lib.stride_tricks.sliding_window_view(values, length, axis=0)
    windows = view[window_starts(len(values))].astype(np.float64)
    energy = windows[:, list(names).index(ENERGY)]
    loudest = np.percentile(energy, _LOUD_PERCENTILE, axis=1, keepdims=True)
    weights = (energy >= loudest * _LOUD)[:, np.newaxis]
    weights = weights / weights.sum(axis=2, keepdims=True)
    x = windows[:, columns]
    mean = (weights * x).sum(axis=2)
    variance = (weights * (x - mean[:, :, np.newaxis]) ** 2).sum(axis=2)
    deviation = np.log(np.sqrt(variance + _TINY) + _LEAST_DEVIATION)
    return np.concatenate([mean, deviation], axis=1)
