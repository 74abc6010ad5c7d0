"""A kind of classifier: the arrays it consists of, their checks, and how it decides."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict

from hearthlog.models.classifiers.model import Array, Model
from hearthlog.schemas.arrays import Float32, Float64


class Machine(Protocol):
    """Inference of one model."""

    def decide(self, inputs: Float32) -> tuple[Float64, Float64]:
        """Compute decision values and novelty of some hundreds of windows at most.

        A row's result must not depend on the rows that are computed together with it, nor on
        threads; see `hearthlog.models.batch_invariant`.

        Parameters
        ----------
        inputs : np.ndarray [shape=(n, width)], float32
            Finite.

        Returns
        -------
        decisions : np.ndarray [shape=(n, C)], float64
            Times the inverse temperature, they are the logarithms of probabilities plus a constant.
            The caller may change them.
        novelty : np.ndarray [shape=(n,)], float64
            From 0 to 1, where 1 is unlike anything learned; NaN if there is none.
        """


class NoParameters(BaseModel):
    """Parameters of a kind that has none: all is in its arrays."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class ClassifierKind(ABC):
    """The arrays of the models of one kind, their checks, and inference.

    Attributes
    ----------
    name : str
        The field `kind` of a description.
    parameters : type of BaseModel
        The field `parameters` of a description.
    arrays, optional : mapping of str to np.dtype
        Arrays that a model must have, and may have. No value is larger than 1e9.
    """

    name: str
    parameters: type[BaseModel]
    arrays: Mapping[str, np.dtype[Any]]
    optional: Mapping[str, np.dtype[Any]] = {}

    @abstractmethod
    def shapes(
        self, classes: int, width: int, arrays: Mapping[str, Array]
    ) -> dict[str, tuple[int, ...]]:
        """Return the shapes that the arrays of a model must have.

        Parameters
        ----------
        classes, width : int
            Number of classes, and of inputs.
        arrays : mapping of str to np.ndarray
            Those of the model, by name; they may be of any type and shape.

        Returns
        -------
        dict of str to tuple of int
            By name of the array; other arrays of this kind must be absent.
        """

    def problem(self, classes: int, arrays: Mapping[str, Array]) -> str | None:
        """Return what is wrong with the arrays of a model; None if nothing is.

        Parameters
        ----------
        classes : int
            Number of classes.
        arrays : mapping of str to np.ndarray
            By name; of the right types and shapes, and finite.

        Returns
        -------
        str or None
            The rest of a sentence that begins with the file.
        """
        del classes, arrays
        return None

    @abstractmethod
    def machine(self, model: Model) -> Machine:
        """Prepare a model for inference."""

    @abstractmethod
    def summary(self, model: Model) -> str:
        """Return the size of a model in a few words."""
