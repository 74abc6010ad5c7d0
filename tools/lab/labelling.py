"""The labels that models would have given to logs."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller, infos_for_model, read_sound
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model


def label_logs(models: Sequence[Model], logs: Sequence[Path]) -> Iterator[Labelling]:
    """Label logs as recorders with each of some models would have, reading them once.

    Parameters
    ----------
    models : sequence of Model
        Of one feature set.
    logs : sequence of Path
        In the order of time.

    Yields
    ------
    Labelling
        Of each model.

    Raises
    ------
    LogError
        If a log cannot be read.
    """
    infos = [infos_for_model(log, models[0], log)[0][0] for log in logs]
    name = infos[0].microphone
    source = infos[0].embedding
    labellers = [
        StreamLabeller(Classifier(model), microphone=name, embedding=source) for model in models
    ]
    for info in infos:
        for event in read_sound(info, 0, auxiliary=True):
            for labeller in labellers:
                labeller.push(event)
    for labeller, model in zip(labellers, models, strict=True):
        labeller.close()
        rows = labeller.segments
        yield Labelling(
            np.array([row.start for row in rows]),
            np.array([row.end for row in rows]),
            np.array([model.classes[row.run.label] for row in rows], object),
        )
