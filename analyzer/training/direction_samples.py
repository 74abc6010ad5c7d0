"""Likelihood of each direction for each class, estimated from the marks of a home."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from hearthlog.models.classes import SILENCE
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.evidence import SECTORS, Directions, sectors_of
from hearthlog.models.classifiers.model import FORMAT, FORMAT_OF_DIRECTIONS, MOST_ARRAYS, Model
from hearthlog.schemas.arrays import Float64, Indices, Int64
from hearthlog.schemas.frames import NANOSECONDS

_SPREAD = np.deg2rad(10.0)  # of a sound at a fixed place
_DOUBT = 2.0  # number of sounds that gives half the weight of many
_WITNESSES = 2.0  # equivalent number of independent blocks in a second
_MOST = 4.0
_ONE_SOUND = 10 * NANOSECONDS  # in which a class stays at one place
_HOUR = 3600 * NANOSECONDS
_AGAIN = np.linspace(0, 0.95, 20)  # shares of sounds from an earlier place


class DirectionSample(NamedTuple):
    """Directions of a recording from an array."""

    microphone: str
    start: int  # in nanoseconds of UTC
    shares: Float64  # [shape=(S,)]; of the sectors of the circle, with sum 1


def sighting_of(microphone: str, directions: Directions) -> DirectionSample | None:
    """Summarise the directions of a recording; None if it has none."""
    weight = directions.confidences.astype(np.float64)
    if not weight.sum() > 0:
        return None
    shares = np.bincount(sectors_of(directions.azimuths), weight, SECTORS)
    return DirectionSample(microphone, int(directions.stamps[0]), shares / weight.sum())


def with_directions(
    model: Model, target: Indices, sightings: Sequence[DirectionSample | None]
) -> Model:
    """Add the direction likelihoods of a home's arrays to a model without any.

    Silence in `target`, the classes of its training segments [shape=(n,)], is ignored; `sightings`
    is empty if no segment has a direction.
    """
    silence = model.classes.index(SILENCE) if SILENCE in model.classes else -1
    located = zip(target.tolist(), sightings, strict=False)
    placed = [(number, one) for number, one in located if one is not None and number != silence]
    arrays = sorted({one.microphone for _, one in placed})[:MOST_ARRAYS]
    weights = np.zeros((len(arrays), len(model.classes), SECTORS))
    for number, array in enumerate(arrays):
        classes, own = zip(*(each for each in placed if each[1].microphone == array), strict=True)
        weights[number] = _weights(np.array(classes), own, len(model.classes))
    if not weights.any():
        return model
    update: dict[str, Any] = {"direction_microphones": arrays}
    if model.description.format == FORMAT:
        update["format"] = FORMAT_OF_DIRECTIONS
    description = model.description.model_copy(update=update)
    return replace(model, description=description, direction_weights=weights)


def _weights(target: Indices, sightings: Sequence[DirectionSample], classes: int) -> Float64:
    """Return the log likelihood ratio of sectors: given a class against given any class."""
    of_sounds, hours, shares = _sounds(target, sightings)
    likely = np.full((classes, SECTORS), 1 / SECTORS)
    counts = np.bincount(of_sounds, minlength=classes)
    for number in np.flatnonzero(counts):
        own = of_sounds == number
        likely[number] = _likelihood(shares[own], hours[own])
    anything = likely[counts > 0].mean(axis=0)
    weights = np.clip(_WITNESSES * np.log(likely / anything), -_MOST, _MOST)
    return weights * (counts / (counts + _DOUBT))[:, np.newaxis]


def evidence_of(
    classifier: Classifier, sightings: Sequence[DirectionSample | None]
) -> Float64 | None:
    """Return the direction evidence [shape=(n, C)] of n segments for `Classifier.classify`.

    None without any direction; `sightings` is empty then.
    """
    evidence = np.zeros((len(sightings), len(classifier.classes)))
    for row, one in enumerate(sightings):
        weights = None if one is None else classifier.direction_weights(one.microphone)
        if one is not None and weights is not None:
            evidence[row] = weights @ one.shares
    return evidence if len(evidence) else None


def _sounds(
    target: Indices, sightings: Sequence[DirectionSample]
) -> tuple[Indices, Int64, Float64]:
    """Merge recordings of a class within ten seconds; marking style must not change the count.

    Return the class, the hour and the directions of each sound.
    """
    times = np.array([one.start for one in sightings], np.int64) // _ONE_SOUND
    joined, row = np.unique(np.stack([target, times]), axis=1, return_inverse=True)
    shares = np.zeros((joined.shape[1], SECTORS))
    np.add.at(shares, row.ravel(), np.stack([one.shares for one in sightings]))
    shares /= np.bincount(row.ravel())[:, np.newaxis]
    return joined[0], joined[1] * _ONE_SOUND // _HOUR, shares


def _likelihood(shares: Float64, hours: Int64) -> Float64:
    """Return the likelihood of each sector for a class.

    Cross-validation over hours estimates how often sounds return to earlier directions: nearly
    always for a television, nearly never for a person who walks about.
    """
    near = shares @ _smoothing()
    others = (hours[:, np.newaxis] != hours).astype(np.float64)
    tried = others.any(axis=1)
    if not tried.any():
        return np.full(SECTORS, 1 / SECTORS)
    left_out = (others @ near)[tried] / others.sum(axis=1, keepdims=True)[tried]
    again = _AGAIN[:, np.newaxis, np.newaxis]
    likelihoods = np.log(again * left_out + (1 - again) / SECTORS)
    best = _AGAIN[(likelihoods * shares[tried]).sum(axis=(1, 2)).argmax()]
    best *= len(shares) / (len(shares) + 1)
    return best * near.mean(axis=0) + (1 - best) / SECTORS


def _smoothing() -> Float64:
    """Return the von Mises smoothing matrix of the sectors; rows sum to 1."""
    turn = np.arange(SECTORS) * (2 * np.pi / SECTORS)
    near = np.exp((np.cos(turn - turn[:, np.newaxis]) - 1) / _SPREAD**2)
    return near / near.sum(axis=1, keepdims=True)
