"""Probabilities from inputs, ours and scikit-learn's; and what the models cost that homes have."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from sklearn.calibration import CalibratedClassifierCV
from sklearn.frozen import FrozenEstimator

from hearthlog.analyzer.relabel.recorded import Features
from hearthlog.analyzer.relabel.stream_labeller import StreamLabeller
from hearthlog.analyzer.training.adaptation import adapt_model
from hearthlog.analyzer.training.dataset import Dataset
from hearthlog.analyzer.training.manifest import BUILTIN
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.train import train_model
from hearthlog.analyzer.training.window_methods import ROOM, SVM
from hearthlog.models.classifiers.classifier import Classifier, classifier_kind
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.starter import BATHROOM, GENERAL, starter_file
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import ignore_progress
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import best_of
from hearthlog.tools.lab.bench.workload import Workload

_SECONDS = 200.0
_BLOCK = 10  # frames, as from a microphone
_HUNDRED_TIMES = Target(100)
_KILOBYTES = Target(1000, at_most=True)
_TOPIC = "/mic/features"
_PIECE = 12_000  # frames that are labelled at once, as of a log in chunks


def measure(work: Workload) -> Table:
    """Measure both on the sound, and each model on an hour of its features."""
    ours, machine = Classifier(work.model).probabilities, Classifier(_svm_of(work)).probabilities
    theirs = fit_scikit_learn(work.training[0]).predict_proba
    rows = _inputs(work)
    rows_as_theirs = rows.astype(np.float64)
    measured = []
    for count in (len(rows), _BLOCK):
        best = best_of(
            {
                "ours": partial(ours, rows[:count]),
                "machine": partial(machine, rows[:count]),
                "theirs": partial(theirs, rows_as_theirs[:count]),
            }
        )
        mine, svm, other = (seconds / (count / 1e6) for seconds in best.values())
        unit, target = "µs a row", _HUNDRED_TIMES if count > _BLOCK else None
        measured += [
            Row(f"landmarks, {count} rows a call", mine.cpu, unit, elapsed=mine.elapsed),
            Row(
                f"support vectors, {count} rows a call",
                svm.cpu,
                unit,
                svm.cpu / mine.cpu,
                elapsed=svm.elapsed,
            ),
            Row(
                f"scikit-learn, {count} rows a call",
                other.cpu,
                unit,
                other.cpu / mine.cpu,
                target,
                elapsed=other.elapsed,
            ),
        ]
    size, classes = (
        classifier_kind(work.model.description.kind).summary(work.model),
        len(work.model.classes),
    )
    measured += _of_models(work)
    return Table(f"inference: {size}, {classes} classes, CPU time", measured)


def _of_models(work: Workload) -> list[Row]:
    """Measure files and times of models: features that were read, to labels and segments."""
    hour, rows = read_columns([work.live.finished], [_TOPIC])[_TOPIC], []
    for name, model in _models(work):
        path = work.folder / f"{name}.safetensors"
        save_model(model, path)
        loaded = load_model(path)
        classifier = Classifier(loaded)
        best = best_of({name: partial(_label, classifier, hour)}, 2)[name]
        kernels = classifier_kind(loaded.description.kind).summary(loaded)
        note = f"{kernels}, {len(loaded.classes)} classes"
        kilobytes = path.stat().st_size / 1e3
        rows += [
            Row(
                f"{name}: {len(hour):,} frames labelled",
                best.cpu,
                "s",
                None,
                None,
                note,
                best.elapsed,
            ),
            Row(f"{name}: its file", kilobytes, "kB", target=_KILOBYTES),
        ]
    return rows


def _models(work: Workload) -> Iterator[tuple[str, Model]]:
    """Yield that of the workload, of bathrooms, adapted, and the starter.

    For the time that an adapted model takes any marks will do: it is adapted to what it knows.
    """
    scenario = work.training[1]
    yield scenario.name, work.model
    if work.are_labelled:
        bathroom = BUILTIN[BATHROOM]
        yield BATHROOM, train_model(work.labelled(bathroom), bathroom, ignore_progress)
    yield "adapted", adapt_model(work.model, work.training[0])
    yield "starter", load_model(starter_file(GENERAL))


def _label(classifier: Classifier, hour: Columns) -> None:
    labeller, frames = StreamLabeller(classifier, from_start=True), hour["frame"]
    for at in range(0, len(hour), _PIECE):
        rows = slice(at, at + _PIECE)
        values, stamps = hour["values"][rows], hour["header.stamp"][rows]
        labeller.push(Features(int(frames[at]), values, stamps))
    labeller.close()


def contests(work: Workload) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Return our probabilities of some rows, and scikit-learn's."""
    rows = _inputs(work)
    theirs = fit_scikit_learn(work.training[0]).predict_proba
    ours = Classifier(work.model).probabilities
    as_theirs = rows.astype(np.float64)
    return {"inference: scikit-learn": (partial(ours, rows), partial(theirs, as_theirs))}


def fit_scikit_learn(data: Dataset) -> CalibratedClassifierCV:
    """Fit the support vector machine of `svm`, and calibrate it as scikit-learn does."""
    examples = prepare(SVM, data)
    machine = SVM.fit(examples).machine.pipeline
    machine[-1].decision_function_shape = "ovr"  # the default, which its calibration needs
    calibrated = CalibratedClassifierCV(
        FrozenEstimator(machine), method="temperature", ensemble=False
    )
    return calibrated.fit(examples.inputs[0, :, 0].astype(np.float64), data.target)


def _svm_of(work: Workload) -> Model:
    """Return the model with a support vector machine in the place of its landmarks."""
    learned = SVM.fit(prepare(SVM, work.training[0]))
    update = {"kind": SVM.kind, "parameters": learned.parameters()}
    described = work.model.description.model_copy(update=update)
    return replace(work.model, description=described, arrays=learned.arrays())


def _inputs(work: Workload) -> Float32:
    features = ROOM.features.extractor()(work.frames(_SECONDS))
    return inputs_above_floor(ROOM.features, features)


def inputs_above_floor(described: FeatureSet, features: Float32) -> Float32:
    """Compute the inputs of a model from the features of successive frames, the first being 0."""
    assert described.band_powers is not None
    floors = FloorTracker()(described.band_powers(features), 0).powers
    heard = features[len(features) - len(floors) :]
    return described.inputs[ROOM.inputs].stream()(heard, floors)
