"""Classifiers: what a kind of classifier is, its arrays, their validation, and inference."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict

from hearthlog.models.classifiers.model import Array, Model
from hearthlog.schemas.arrays import Float32, Float64

LEARNED: Mapping[str, np.dtype[Any]] = {
    "learned_inputs": np.dtype(np.float32),
    "learned_target": np.dtype(np.int64),
}


def learned_shapes(width: int, arrays: Mapping[str, Array]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays `LEARNED`; empty if a model keeps no windows."""
    inputs = arrays.get("learned_inputs", np.empty(0))
    if not inputs.ndim or not len(inputs):
        return {}
    return {"learned_inputs": (len(inputs), width), "learned_target": (len(inputs),)}


def target_problem(classes: int, arrays: Mapping[str, Array], *names: str) -> str | None:
    """Return an error in the class arrays; None if they are valid or absent.

    `arrays` are finite, with valid types and shapes.
    """
    for name in names:
        target = arrays.get(name, np.empty(0, np.int64))
        if ((target < 0) | (target >= classes)).any():
            return f"{name} has classes that the model has not"
    return None


class Machine(Protocol):
    """Inference of one model."""

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Compute decision values and novelty of up to a few hundred windows.

        A row's result must not depend on other rows of the batch, nor on threads; see
        `hearthlog.models.batch_invariant`.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.

        Returns
        -------
        decisions : np.ndarray [shape=(n, C)], float64
            Multiplied by the inverse temperature: logarithms of probabilities plus a constant.
            The caller may change them.
        novelty : np.ndarray [shape=(n,)], float64
            From 0 to 1, where 1 is unlike all training data; NaN if the kind computes none.
        """


class NoParameters(BaseModel):
    """Parameters of a kind that has only arrays."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class ClassifierKind(ABC):
    """The arrays of the models of one kind, their validation, and inference.

    Attributes
    ----------
    name : str
        The field `kind` of a description.
    parameters : type of BaseModel
        The field `parameters` of a description.
    arrays, optional : mapping of str to np.dtype
        Required and optional arrays of a model. No value may be larger than 1e9.
    """

    name: str
    parameters: type[BaseModel]
    arrays: Mapping[str, np.dtype[Any]]
    optional: Mapping[str, np.dtype[Any]] = {}

    @abstractmethod
    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the required shapes of a model's arrays.

        Parameters
        ----------
        classes, width : int
            Number of classes and of inputs.
        arrays : mapping of str to np.ndarray
            Arrays of the model by name, of any type and shape.

        Returns
        -------
        dict of str to tuple of int
            By array name; the model must not have other arrays of this kind.
        """

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return an error in a model's arrays; None if there is none.

        Parameters
        ----------
        classes : int
            Number of classes.
        arrays : mapping of str to np.ndarray
            By name; finite, with valid types and shapes.

        Returns
        -------
        str or None
            The rest of a sentence that begins with the file name.
        """
        del classes, arrays
        return None

    @abstractmethod
    def machine(self, model: Model) -> Machine:
        """Prepare a model for inference."""

    @abstractmethod
    def summary(self, model: Model) -> str:
        """Return the size of a model in a few words."""
