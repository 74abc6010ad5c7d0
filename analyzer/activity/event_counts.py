"""Events in labels, and the range of their true count from checked minutes."""

from dataclasses import dataclass
from math import exp, lgamma, log, log1p
from typing import NamedTuple, Self

import numpy as np

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, Spans, lengths, rows_at
from hearthlog.models.classes import (
    LAUGHING,
    MUSIC,
    SILENCE,
    SPEECH,
    WORRYING,
)
from hearthlog.schemas.arrays import Bool, Float32, Float64, Int64
from hearthlog.schemas.frames import NANOSECONDS

MINUTE = 60 * NANOSECONDS
AROUND = 10  # minutes before and after, in which a television would still be on
_ALONE = (SILENCE, *WORRYING)  # long crying is no television
_SHARE = 0.1  # of the time
_CHANGES = 2  # in a minute
_VOICES = (SPEECH, MUSIC, LAUGHING)  # of a television, however sparse
_VOICED = 0.4  # of the minutes


def events_of(labels: Labelling, name: str) -> Spans:
    """Return the events of a class: its spans, merged across pauses of at most ten seconds."""
    return labels.spans(labels.labels == name, EVENT_PAUSE)


def events_and_confidences(labels: Labelling, name: str) -> tuple[Spans, Float32]:
    """Return the events of a class, and the highest confidence of the segments of each."""
    own, events = labels.labels == name, events_of(labels, name)
    highest = np.zeros(len(events.starts), np.float32)
    np.maximum.at(highest, rows_at(events, labels.starts[own]), labels.confidences[own])
    return events, highest


def sounding_minutes(labels: Labelling, edges: Int64) -> Bool:
    """Return which of the minutes between n + 1 edges have any sound."""
    return lengths(labels.spans(labels.labels != SILENCE), edges) > 0


def television_minutes(labels: Labelling, edges: Int64) -> Bool:
    """Return which of the minutes between n + 1 edges resemble a television, a radio or company.

    In the ten minutes before and after, either talking, music or laughing sounds in more than two
    of five minutes; or two sounds a minute start, and sounds other than coughing, crying and
    shouting fill a tenth of the time. The classes of these do not matter, because a model may take
    a television for anything.
    """
    minutes = 2 * AROUND + 1

    def sounding(which: Bool) -> Int64:
        return lengths(labels.spans(which), edges)

    voiced = (sounding(np.isin(labels.labels, _VOICES)) > 0).astype(np.int64)
    begun = np.diff(np.searchsorted(labels.starts[labels.labels != SILENCE], edges))
    much = _around(sounding(~np.isin(labels.labels, _ALONE))) > _SHARE * minutes * MINUTE
    television: Bool = much & (_around(begun) > _CHANGES * minutes)
    return television | (_around(voiced) > _VOICED * minutes)


def _around(amounts: Int64) -> Int64:
    """Return the sum over each minute and the minutes around it."""
    return np.convolve(amounts, np.ones(2 * AROUND + 1, np.int64))[AROUND : AROUND + len(amounts)]


def overlapping(events: Spans, others: Spans) -> Bool:
    """Return which events overlap one of others."""
    after = np.searchsorted(others.ends, events.starts, side="right")
    begins = np.append(others.starts, np.iinfo(np.int64).max)[after]
    overlaps: Bool = begins < events.ends
    return overlaps


FEWEST = 5  # minutes
_DRAWS = 2000
_SEED = 20_261_123
_ENDS = (5.0, 95.0)  # percentiles: the limits of the 90 % range
# Prior: events, and minutes or labelled events, added to the checked ones, so that few minutes
# give a wide range.
_MISSED_IN_QUIET = (0.5, 60.0)  # of all classes together
_MISSED_IN_SOUND = (1.0, 5.0)  # of all classes together
_RIGHT, _WRONG = 0.3, 0.7
_PRECISION = 1e-15  # of a share of a beta distribution


class Strata(NamedTuple):
    """Label counts of a class in quiet minutes and in minutes with sound."""

    quiet: int = 0  # minutes
    sounding: int = 0  # minutes
    labelled: int = 0

    def combined_with(self, other: Self) -> "Strata":
        """Return the sums."""
        return Strata(*(a + b for a, b in zip(self, other, strict=True)))


NO_MINUTES = Strata()


def strata_of(labelled: Int64, sounding: Bool) -> Strata:
    """Count quiet minutes and minutes with sound, and the labelled events of a class in them."""
    return Strata(int((~sounding).sum()), int(sounding.sum()), int(labelled.sum()))


@dataclass(frozen=True, eq=False)
class CheckedRates:
    """Rates of correct labelled events and of missed events per minute of a class."""

    right: Float64  # [shape=(draws,)]; drawn shares of correct labelled events
    missed: Float64  # [shape=(draws, 2)]; in quiet minutes and in minutes with sound
    minutes: int
    occurs: bool

    def range_of(self, strata: Strata) -> tuple[int, int]:
        """Return the 90 % range of the number of events in unchecked minutes."""
        rng = np.random.default_rng(_SEED)
        minutes = np.array([strata.quiet, strata.sounding], np.float64)
        totals = rng.binomial(strata.labelled, self.right) + rng.poisson(self.missed @ minutes)
        low, high = np.percentile(totals, _ENDS)
        return int(np.floor(low)) if self.occurs else 0, int(np.ceil(high))


def checked_rates(
    labelled: Int64, true: Int64, sounding: Bool, share: float
) -> CheckedRates | None:
    """Draw rates of a class, given checked minutes [shape=(n,)]; None for fewer than five.

    Hot deck with a Bayesian prior: minutes are resampled with replacement, because events come in
    bouts; then the share of right events is drawn from a beta distribution, and rates of missed
    events from gamma distributions. Within quiet minutes and within minutes with sound, checked
    minutes must be drawn at random, but the sampled share of the two kinds may differ.

    `labelled` and `true` events start in each minute; `share` is that of the class among all
    labelled events, 0 to 1.
    """
    if len(labelled) < FEWEST:
        return None
    rng = np.random.default_rng(_SEED)
    drawn = rng.integers(0, len(labelled), (_DRAWS, len(labelled)))
    matched = np.minimum(labelled, true)

    def total(counts: Int64) -> Int64:
        sums: Int64 = counts[drawn].sum(axis=1)
        return sums

    missed = np.empty((_DRAWS, 2))
    kinds = (~sounding, _MISSED_IN_QUIET), (sounding, _MISSED_IN_SOUND)
    for each, (own, (events, minutes)) in enumerate(kinds):
        unlabelled, checked = total((true - matched) * own), total(own.astype(np.int64))
        missed[:, each] = rng.gamma(unlabelled + events * share) / (checked + minutes)
    right = rng.beta(total(matched) + _RIGHT, total(labelled - matched) + _WRONG)
    return CheckedRates(right, missed, len(labelled), bool(true.any()))


def beta_quantile(a: float, b: float, share: float) -> float:
    """Return a quantile of a beta distribution (a, b > 0), like `scipy.special.betaincinv`.

    `share` is the probability below it, 0 to 1. The recorder's machine uses this for label
    precision, and has no scipy.
    """
    low, high = 0.0, 1.0
    while low < (middle := (low + high) / 2) < high:
        if _beta_share(a, b, middle) < share:
            low = middle
        else:
            high = middle
    return middle


def _beta_share(a: float, b: float, x: float) -> float:
    """Return the beta distribution function at x, between 0 and 1 (continued fraction)."""
    if x > (a + 1) / (a + b + 2):  # the fraction converges slowly there
        return 1 - _beta_share(b, a, 1 - x)
    density = exp(lgamma(a + b) - lgamma(a) - lgamma(b) + a * log(x) + b * log1p(-x))
    numerator, denominator = 1.0, 1 / (1 - (a + b) * x / (a + 1))
    fraction, step, m = denominator, 0.0, 0
    while abs(step - 1) > _PRECISION:
        m += 1
        for term in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            denominator = 1 / (1 + term * denominator)
            numerator = 1 + term / numerator
            step = numerator * denominator
            fraction *= step
    return density * fraction / a
