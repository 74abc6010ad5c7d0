"""A kind of classifier: the arrays it consists of, their checks, and how it decides."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel

from hearthlog.models.classifiers.model import Array, Model
from hearthlog.schemas.arrays import Float32, Float64


class Machine(Protocol):
    """Inference of one model."""

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Decide about some hundreds of windows at most.

        A row's result must not depend on the rows that are computed together with it, nor on
        threads; see `hearthlog.models.batch_invariant`.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.

        Returns
        -------
        decisions : np.ndarray [shape=(n, C)], float64
            Which, times the inverse temperature, are the logarithms of probabilities, but for a
            constant. They may be changed by the caller.
        novelty : np.ndarray [shape=(n,)], float64
            How unlike anything learned a window is, from 0 to 1; NaN where that is not known.
        """


class ClassifierKind(ABC):
    """What a model file of one kind consists of, and how it decides.

    Attributes
    ----------
    name : str
        In the field `kind` of a description.
    parameters : type of BaseModel
        What a description must say besides, as its field `parameters`.
    arrays, optional : mapping of str to np.dtype
        What a model must, and may, consist of. None of them is larger than 1e9.
    """

    name: str
    parameters: type[BaseModel]
    arrays: Mapping[str, np.dtype[Any]]
    optional: Mapping[str, np.dtype[Any]] = {}

    @abstractmethod
    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes that arrays must have.

        Parameters
        ----------
        classes : int
            C.
        width : int
            Of the inputs.
        arrays : mapping of str to np.ndarray
            Of types that may be anything, and of any shape.
        """

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Say what contradicts itself in arrays of the right types and shapes, all finite."""
        del classes, arrays
        return None

    @abstractmethod
    def machine(self, model: Model) -> Machine:
        """Make what decides."""

    @abstractmethod
    def summary(self, model: Model) -> str:
        """Say in a few words how large a model is."""

    def kept_inputs(self, model: Model) -> Sequence[Float32]:
        """Return inputs of windows that it has learned from, if they are among its arrays."""
        del model
        return ()
