"""What a home's marks add to the heads of a model.

The heads stay as they are; what a home teaches is a linear head of its own that is added to them,
so that nothing of the base's recordings is needed. It is learned by logistic regression, and pulled
to zero: where nothing is marked the base decides.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.training.dataset import EmbeddingWindows
from hearthlog.analyzer.training.heads import in_units, regressed
from hearthlog.models.classes import SILENCE, UNKNOWN
from hearthlog.models.classifiers.evidence import (
    UNIT,
    UNTAUGHT,
    EmbeddingHeads,
    sounds_of,
)
from hearthlog.models.classifiers.model import EmbeddingMix, Model, NamesHead
from hearthlog.schemas.arrays import Bool, Float64, Int32

_PULL = 10.0  # to zero, of weights of inputs of one standard deviation
_PULL_OF_NEW = 1.0  # of those of a class that the base has not: all of it is to be learned
_CONFIRMED_WEIGHT = 1 / 3  # of a window that a reviewer left as it was; a mark has 1
_SHARE = 0.5  # that counts of what is learned: marks are of few sources, and others lie between
_BELOW = 2.0  # the others on average, is a new class before anything is learned


class Heads(NamedTuple):
    """The mix of a model, the arrays of its heads, and how many of the last classes are new."""

    mix: EmbeddingMix
    weights: Int32
    bias: Int32
    scaler: Float64
    new: int


def base_heads(model: Model, classes: Sequence[str]) -> Heads:
    """Return the heads of a model as before it was ever adapted, with room for new classes."""
    mix = model.description.embedding
    assert mix is not None
    count = len(mix.head_weights)
    same = sum(name in model.classes for name in classes)
    inverse = mix.base_inverse_temperature or mix.inverse_temperature
    weights = model.embedding_weights[:count, :, :same]
    bias = model.embedding_bias[:count, :same]
    new = len(classes) - same
    if new:
        sounds = sounds_of(classes[:same])
        middle = bias[:, sounds] + np.einsum(
            "w,hws->hs", model.embedding_scaler[0], weights[..., sounds].astype(np.float64)
        )
        middle = np.ma.masked_array(middle, bias[:, sounds] == UNTAUGHT)
        constant = np.rint(middle.mean(axis=1).filled(0.0) - _BELOW / inverse / UNIT)
        constant = constant.astype(np.int32)
        weights = np.pad(weights, ((0, 0), (0, 0), (0, new)))
        bias = np.concatenate([bias, np.tile(constant[:, np.newaxis], (1, new))], axis=1)
    update = {
        "names": [_with_classes(head, classes) for head in mix.names],
        "bias": {name: value for name, value in mix.bias.items() if name in classes},
        "inverse_temperature": inverse,
        "base_inverse_temperature": None,
        "of_home": False,
    }
    return Heads(mix.model_copy(update=update), weights, bias, model.embedding_scaler, new)


def _with_classes(head: NamesHead, classes: Sequence[str]) -> NamesHead:
    """Return a head with the classes of a home, of which the names say what of unknown ones."""
    kept = {name: values for name, values in head.classes.items() if name in classes}
    bias = {name: value for name, value in head.bias.items() if name in classes}
    if UNKNOWN in head.classes:
        for name in classes:
            if name not in kept and name != SILENCE:
                kept[name] = head.classes[UNKNOWN]
                bias |= {name: head.bias[UNKNOWN]} if UNKNOWN in head.bias else {}
    return head.model_copy(update={"classes": kept, "bias": bias})


def learn_home(
    heads: Heads, windows: EmbeddingWindows, marked: Bool, classes: Sequence[str]
) -> Heads:
    """Add what a home teaches: one half of what is learned, for a class of the base.

    Where nobody has marked a sound of no class, and there is no new class, how likely that is
    against the others is not learned: by marks of what was wrongly called unknown alone nearly
    nothing would be unknown any more.

    Parameters
    ----------
    marked : np.ndarray [shape=(m,)], bool
        Whether somebody has said what it is; the others are as they were labelled.
    """
    sounds = sounds_of(classes)
    if UNKNOWN in classes and not heads.new:
        unknown = classes.index(UNKNOWN)
        if not (windows.target[marked] == unknown).any():
            sounds = sounds[sounds != unknown]
    own = np.isin(windows.target, sounds)
    if not own.any():
        return heads
    mix, values = heads.mix, windows.values[own]
    by_heads = EmbeddingHeads(mix, heads.weights, heads.bias, classes).log_probabilities(values)
    shares = sum(mix.head_weights) + sum(head.weight for head in mix.names)
    before = mix.inverse_temperature / shares * by_heads[:, sounds]
    used = np.flatnonzero(heads.weights.any(axis=(0, 2)))
    mean, scale = heads.scaler[:, used]
    inputs = (values[:, used] - mean) / scale
    # The windows of a mark are of one sound: many of them say no more than one.
    windows_of = np.bincount(windows.recording[own])[windows.recording[own]]
    weight = np.where(marked[own], 1.0 / windows_of, _CONFIRMED_WEIGHT)
    target = np.searchsorted(sounds, windows.target[own])
    pull = np.full(len(sounds), _PULL)
    pull[len(sounds) - heads.new :] = _PULL_OF_NEW
    truth = np.eye(len(sounds))[target]
    slopes, constants = regressed(inputs, truth, weight, before, pull, free=False)
    taken = np.where(np.arange(len(sounds)) < len(sounds) - heads.new, _SHARE, 1.0)
    slopes, constants = taken * slopes, taken * constants
    weights = np.zeros((1, *heads.weights.shape[1:]))
    bias = np.zeros((1, heads.bias.shape[1]))
    factor = shares / mix.inverse_temperature
    weights[0][np.ix_(used, sounds)] = factor * slopes / scale[:, np.newaxis]
    bias[0, sounds] = factor * (constants - (mean / scale) @ slopes)
    return heads._replace(
        mix=mix.model_copy(update={"of_home": True}),
        weights=np.concatenate([heads.weights, in_units(weights)]),
        bias=np.concatenate([heads.bias, in_units(bias)]),
    )
