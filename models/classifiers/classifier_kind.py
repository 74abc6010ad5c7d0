"""A kind of classifier: its arrays, their validation, and inference."""

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
