"""When the labels of a model are known."""

from typing import NamedTuple

from hearthlog.models.classifiers.description import Description
from hearthlog.models.classifiers.names import BY_NAMES, NamesParameters
from hearthlog.models.embedding.embeddings import DELAY_FRAMES
from hearthlog.models.features.floor import BLOCK_FRAMES
from hearthlog.models.features.installed import feature_set


class LabelTiming(NamedTuple):
    """Which frames a label takes, and which it speaks of.

    Attributes
    ----------
    label_frame : int
        Frame of the window, from 0 on, which the label speaks of.
    needs_floor : bool
        Whether the floor of the room must be known at every frame of the window.
    ahead : int
        Frames behind the window that must be known, too: those of embeddings that begin in it.
    """

    window_frames: int
    label_frame: int
    needs_floor: bool
    ahead: int = 0

    @property
    def delay(self) -> int:
        """Frames from the one that a label speaks of to the one with which it is known."""
        return self.window_frames - 1 - self.label_frame + self.ahead

    def first_window_end(self, start: int) -> int:
        """Return the frame with which the first label of a sound is known."""
        if self.needs_floor:  # it is known with the last frame of the first whole block
            start += -start % BLOCK_FRAMES + BLOCK_FRAMES - 1
        return start + self.window_frames - 1 + self.ahead


def label_timing(description: Description) -> LabelTiming:
    """Return the timing of a model's labels.

    Raise `ModelError` if its feature set is not installed.
    """
    if description.kind == BY_NAMES:  # of each frame, by the windows around it
        parameters = NamesParameters.model_validate(description.parameters)
        return LabelTiming(1, 0, needs_floor=False, ahead=parameters.ahead)
    inputs = feature_set(description.feature_set).inputs[description.inputs]
    needs_floor = description.gate > 0.0 or inputs.needs_floor
    timing = LabelTiming(inputs.window_frames, description.label_frame, needs_floor)
    if description.embedding is None:
        return timing
    return timing._replace(ahead=max(DELAY_FRAMES - timing.delay, 0))
