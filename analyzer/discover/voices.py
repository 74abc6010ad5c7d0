"""Voices: seconds of speech as points of a learned space, their similarity, and the voices file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from safetensors.numpy import load

from hearthlog.analyzer.discover import (
    MOST_CLUSTERS,
    NO_CLUSTER,
    ClusterId,
    ClusterKind,
    ClusterNames,
    Clusters,
    StrictModel,
    are_numbers,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64

_INDEPENDENT = 0.2  # share of a window: windows overlap, and speech is correlated
_MOST_CERTAIN = 4.0  # windows: a voice varies, however long the speech
_SMOOTHED = 1  # windows on each side
_ROUNDS = 2


class VoiceEvidence(NamedTuple):
    """Sums of points of speech."""

    counts: Float64  # [shape=(n,)]; number of points per row
    sums: Float64  # [shape=(n, d)]; sum of the points per row

    def rows(self, rows: Int64 | Bool) -> "VoiceEvidence":
        """Select rows."""
        return VoiceEvidence(self.counts[rows], self.sums[rows])


def summed(points: Float64, of: Int64, count: int) -> VoiceEvidence:
    """Sum points [shape=(n, d)] by row, 0 to `count`; points with `count` are dropped."""
    own = (of == np.arange(count)[:, np.newaxis]).astype(np.float64)
    return VoiceEvidence(own.sum(axis=1), own @ points)


def same_voice(one: VoiceEvidence, others: VoiceEvidence) -> Float64:
    """Return the log likelihood ratio of one voice over two.

    Evidence is a mean of points; points of one voice have variance 1 around the voice's mean, and
    voice means have the variance `spread` of the voice space (the two-covariance model of Brümmer
    and de Villiers, Odyssey 2010).
    """
    return _ratio(_weighed(one), _weighed(others))


class _Weighed(NamedTuple):
    """Evidence as independent points, with the log likelihood of one voice."""

    counts: Float64  # shape (n,)
    sums: Float64  # shape (d, n)
    likelihood: Float64

    def rows(self, rows: Int64 | slice) -> "_Weighed":
        return _Weighed(self.counts[rows], self.sums[:, rows], self.likelihood[rows])


def _weighed(evidence: VoiceEvidence) -> _Weighed:
    """Return evidence with equal means and the effective number of independent points."""
    counts = _INDEPENDENT * evidence.counts
    counts = counts / (1.0 + counts / _MOST_CERTAIN)
    sums = np.ascontiguousarray(evidence.sums.T) * (counts / evidence.counts)
    return _Weighed(counts, sums, _likelihood(counts, sums))


def _ratio(one: _Weighed, others: _Weighed) -> Float64:
    both = _likelihood(one.counts + others.counts, one.sums + others.sums)
    return both - one.likelihood - others.likelihood


def _likelihood(counts: Float64, sums: Float64) -> Float64:
    """Return the log likelihood of one voice, relative to the mean of all voices."""
    variance = voice_space().spread[:, np.newaxis]
    scale = 1.0 + counts * variance
    terms = (sums**2 * (variance / scale)).sum(axis=0)
    return 0.5 * (terms - np.log(scale.prod(axis=0)))


def merged_voices(evidence: VoiceEvidence) -> Int64:
    """Merge evidence that is likelier of one voice than of two, likeliest first; number from 0."""
    counts, sums = evidence.counts.copy(), evidence.sums.copy()
    size = len(counts)
    of = np.arange(size)
    weighed = _weighed(evidence)
    ratios = np.full((size, size), -np.inf)
    for row in range(size - 1):
        later = slice(row + 1, size)
        one = weighed.rows(slice(row, row + 1))
        ratios[row, later] = ratios[later, row] = _ratio(one, weighed.rows(later))
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
        now = _weighed(VoiceEvidence(counts[[row]], sums[[row]]))
        for kept, value in zip(weighed, now, strict=True):
            kept[..., row] = value[..., 0]
        ratios[row, there] = ratios[there, row] = _ratio(now, weighed.rows(there))
        stale[[row, other]] = True
        np.maximum(best, ratios[row], out=best)
        best[stale] = ratios[stale].max(axis=1)
    _, of = np.unique(of, return_inverse=True)
    return of.astype(np.int64)


def separate_voices(points: Float64, least: int) -> Int64:
    """Return the voice, from 0, of each window [shape=(n, d)] of a conversation, in time order."""
    of = merged_voices(VoiceEvidence(np.ones(len(points)), points))
    for _ in range(_ROUNDS):
        counts = np.bincount(of)
        kept = np.flatnonzero(counts >= min(least, counts.max()))
        voices = summed(points, of, len(counts)).rows(kept)
        of = _smoothed(_likeness(points, voices)).argmax(axis=1)
        _, of = np.unique(of, return_inverse=True)
    return of.astype(np.int64)


def _likeness(points: Float64, voices: VoiceEvidence) -> Float64:
    """Return the expected log likelihoods of points, up to a term common to all voices."""
    counts, sums = _INDEPENDENT * voices.counts, _INDEPENDENT * voices.sums
    spread = voice_space().spread
    variance = spread / (1.0 + counts[:, np.newaxis] * spread)
    mean = variance * sums
    return points @ mean.T - 0.5 * (mean**2 + variance).sum(axis=1)


def _smoothed(values: Float64) -> Float64:
    """Average each row with its neighbours."""
    width = 2 * _SMOOTHED + 1
    padded = np.pad(values, ((_SMOOTHED, _SMOOTHED), (0, 0)), "edge")
    return np.lib.stride_tricks.sliding_window_view(padded, width, 0).mean(axis=-1)


FILE = "voice_space.safetensors"
WINDOW_FRAMES = 30
HOP_FRAMES = 10
_NAMES = (
    *("zero_crossing_rate", "energy_entropy", "spectral_centroid", "spectral_spread"),
    *("spectral_entropy", "spectral_flux", "spectral_rolloff"),
    *(f"mfcc_{number}" for number in range(2, 14)),  # mfcc_1 is the level
)
ENERGY = "energy"
_LOUD_PERCENTILE = 90
_LOUD = 10 ** (-20 / 10)  # relative to the energy at that percentile
_LEAST_DEVIATION = 0.05
_TINY = 1e-9


class VoiceSpace(NamedTuple):
    """A space in which windows of one voice scatter equally in all directions."""

    mean: Float64  # [shape=(width,)]; of speech descriptors
    axes: Float64  # [shape=(d, width)]; the variance of one voice is 1 along each
    spread: Float64  # [shape=(d,)]; variance of voice means along each axis, descending

    def points(self, described: Float64) -> Float64:
        """Return the points of window descriptors, shape (n, d)."""
        return (described - self.mean) @ self.axes.T


@cache
def voice_space() -> VoiceSpace:
    """Return the voice space shipped with hearthlog."""
    arrays = load((files(__package__) / FILE).read_bytes())
    return VoiceSpace(*(arrays[name].astype(np.float64) for name in VoiceSpace._fields))


def has_voices(names: Sequence[str]) -> bool:
    """Return whether features of these names can separate voices."""
    return {ENERGY, *_NAMES} <= set(names)


def window_starts(frames: int) -> Int64:
    """Return the window starts for a number of frames; at least one window if there is a frame."""
    return np.arange(0, max(frames - WINDOW_FRAMES, 0) + 1, HOP_FRAMES)


def describe_speech(values: Float32, names: Sequence[str]) -> Float64:
    """Return window descriptors [shape=(windows, 38)] of features of speech [shape=(frames, f)].

    They are means, and logarithms of standard deviations, of the loud frames in each window of
    `window_starts`. There is at least one frame.
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


def no_evidence() -> VoiceEvidence:
    """Return the evidence of no voice."""
    return VoiceEvidence(np.empty(0), np.empty((0, len(voice_space().spread))))


_LEAST_WINDOWS = 20  # per voice of a home: ten seconds
_MOST = 2_000  # conversation voices among which home voices are searched


@dataclass(frozen=True)
class HomeVoices(Clusters):
    """Voices of a home."""

    evidence: VoiceEvidence


def recognised(evidence: VoiceEvidence, earlier: VoiceEvidence) -> Int64:
    """Return the existing voice of each row if one is likelier than two, else `NO_CLUSTER`."""
    best = np.zeros(len(evidence.counts))
    of = np.full(len(best), NO_CLUSTER)
    for row in range(len(earlier.counts)):
        ratio = same_voice(earlier.rows(np.array([row])), evidence)
        better = ratio > best
        best[better], of[better] = ratio[better], row
    return of


def with_new_voices(voices: HomeVoices, rest: VoiceEvidence) -> HomeVoices:
    """Add voices from unmatched evidence, if a voice speaks long enough."""
    largest = np.sort(np.argsort(-rest.counts, kind="stable")[:_MOST])
    rest = rest.rows(largest)
    if not len(rest.counts):
        return voices
    of = merged_voices(rest)
    own = (of == np.arange(of.max() + 1)[:, np.newaxis]).astype(np.float64)
    found = VoiceEvidence(own @ rest.counts, own @ rest.sums)
    order = np.argsort(-found.counts, kind="stable")
    order = order[found.counts[order] >= _LEAST_WINDOWS][: MOST_CLUSTERS - len(voices.numbers)]
    both = zip(voices.evidence, found.rows(order), strict=True)
    return voices.with_new(len(order), evidence=VoiceEvidence(*map(np.concatenate, both)))


_FORMAT: Final = 1
_LARGE = 1e9  # of counts and sums


class _Header(StrictModel):
    format: Annotated[int, Field(ge=1, le=_FORMAT)]
    id: ClusterId
    names: ClusterNames


VOICES: Final = ClusterKind("voice", "voices", "2=anna", _Header, 4 << 20)


def save_voices(voices: HomeVoices, path: Path) -> None:
    """Write the voices file, replacing an existing one.

    Raise `DataError` if the voice features are too large for the file to be read again. Raise
    `LogError` if the file cannot be written.
    """
    header = _Header(format=_FORMAT, id=voices.id, names=voices.names)
    arrays = {"numbers": voices.numbers, **voices.evidence._asdict()}
    if not _fits(header, arrays):
        raise DataError(
            f"{path}: not written, for some speech has features that no sound has; leave out logs "
            "that hearthlog did not record"
        )
    VOICES.write(path, arrays, header)


def load_voices(path: Path) -> HomeVoices | None:
    """Read the voices file; None if it does not exist.

    Raise `DataError` if it is not a voices file, or damaged.
    """
    found = VOICES.read(path)
    if found is None:
        return None
    arrays, header = found
    if not _fits(header, arrays):
        raise DataError(f"{path}: is damaged; move it away to begin anew")
    evidence = VoiceEvidence(arrays["counts"], arrays["sums"])
    return HomeVoices(arrays["numbers"], evidence, names=header.names, id=header.id)


def _fits(header: _Header, arrays: Mapping[str, NDArray[Any]]) -> bool:
    count, dimensions = len(header.names), len(voice_space().spread)
    expected = {
        "numbers": ("int64", count),
        "counts": ("float64", count),
        "sums": ("float64", count, dimensions),
    }
    return (
        {name: (array.dtype.name, *array.shape) for name, array in arrays.items()} == expected
        and are_numbers(arrays["numbers"], header.names)
        and bool(((arrays["counts"] >= 1.0) & (arrays["counts"] <= _LARGE)).all())
        and bool((np.abs(arrays["sums"]) <= _LARGE).all())
    )
