"""What follows what in a home, and how long it goes on."""

from collections.abc import Sequence
from dataclasses import replace

from hearthlog.analyzer.training.hidden_markov import learn_transitions
from hearthlog.analyzer.training.transitions import count_transitions
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.arrays import Float32, Int64


def adapt_transitions(model: Model, sequences: Sequence[Int64], sound: Sequence[Float32]) -> Model:
    """Learn what follows what in a home, and how long it goes on.

    Parameters
    ----------
    model : Model
        With transitions.
    sequences : sequence of np.ndarray [shape=(n,)], int64
        Indices of the classes of successive frames, by marks.
    sound : sequence of np.ndarray [shape=(n, C)], float32
        Probabilities of successive frames by this model, without marks.

    Returns
    -------
    Model
        The same one if there are neither marks nor sound.
    """
    if not (sequences or sound):
        return model
    counts = count_transitions(sequences, model.classes)
    description, training = model.description, model.description.training_data
    update = {
        "home_frames": sum(map(len, sound)),
        "base_sha256": training.base_sha256 or model.sha256,
    }
    training = training.model_copy(update=update)
    return replace(
        model,
        description=description.model_copy(update={"training_data": training}),
        transitions=learn_transitions(sound, counts, description.smoothing.weight),
    )
