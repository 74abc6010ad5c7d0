from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from blobs import blobs, with_arrays
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC
from threadpoolctl import threadpool_limits

from hearthlog.analyzer.training.calibration import softmax
from hearthlog.analyzer.training.train import train_model
from hearthlog.analyzer.training.window_methods import PAPER, LearnedSvm, rounded, rounded_to_steps
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.rbf_machines import (
    SVM_RBF,
    RoundedDistances,
    UnroundedDistances,
    in_steps,
)
from hearthlog.schemas.errors import ignore_progress

pytestmark = pytest.mark.fast

ROWS = 600
HALF_A_STEP = 2.0**-17


@cache
def trained(classes, count=60, spread=1.5):
    data, scenario = blobs(classes, count, spread=spread, features=PAPER.features)
    return train_model(data, scenario, ignore_progress, PAPER)


def statistics(data):
    return PAPER.features.inputs["statistics"].of_windows(data.windows)


@cache
def unseen(classes):
    rng = np.random.default_rng(7)
    rows = statistics(blobs(classes, 60, features=PAPER.features)[0])
    chosen = rows[rng.integers(0, len(rows), ROWS)]
    return (chosen * rng.uniform(0.8, 1.2, chosen.shape)).astype(np.float32)


@pytest.mark.parametrize(
    ("classes", "count", "spread"), [(2, 60, 1.5), (3, 60, 1.5), (9, 60, 1.5), (3, 300, 9.0)]
)
def test_probabilities_are_those_of_scikit_learn(classes, count, spread):
    data, _ = blobs(classes, count, spread=spread, features=PAPER.features)
    model = trained(classes, count, spread)
    machine = SVC(
        C=model.description.parameters["cost"],
        gamma=model.description.parameters["gamma"],
        class_weight="balanced",
        decision_function_shape="ovo",
    )
    fitted = make_pipeline(rounded_to_steps(StandardScaler(), PAPER.steps), machine).fit(
        rounded(statistics(data)).astype(np.float64), data.target
    )
    decision, _ = LearnedSvm(fitted).decide(unseen(classes))
    expected = softmax(model.description.inverse_temperature * decision)

    ours = Classifier(model).probabilities(unseen(classes))

    assert ours.dtype == np.float32
    assert ours.shape == (ROWS, classes)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=HALF_A_STEP + 1e-6)
    assert len(np.unique(ours.argmax(axis=1))) == classes


def judged(model, rows):
    """Probabilities, and before their rounding the decisions behind them."""
    decisions, _ = SVM_RBF.machine(model).decide(rows)
    return np.concatenate([Classifier(model).probabilities(rows), decisions], axis=1)


@settings(deadline=None)
@given(
    classes=st.sampled_from([2, 3, 9]),
    cuts=st.sets(st.integers(1, ROWS - 1), max_size=40),
)
def test_a_row_is_judged_the_same_in_any_company(classes, cuts):
    model = trained(classes)
    full = judged(model, unseen(classes))
    parts = np.split(unseen(classes), sorted(cuts))
    assert np.array_equal(np.concatenate([judged(model, p) for p in parts]), full)


@pytest.mark.parametrize("classes", [2, 3])
def test_the_number_of_blas_threads_changes_nothing(classes):
    model = trained(classes, 300, spread=9.0)
    assert model.arrays["support_counts"].max() > 256  # more than are multiplied at once
    results = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            results.append(judged(model, unseen(classes)))
    assert np.array_equal(*results)


@example(seed=1, width=195, spread=5.0)  # exact one by one, not together
@given(seed=st.integers(0, 1 << 32), width=st.integers(1, 300), spread=st.floats(1e-3, 1e4))
def test_the_order_of_sums_changes_no_bit_of_a_distance(seed, width, spread):
    rng = np.random.default_rng(seed)
    rows, vectors = spread * rng.standard_normal((2, 40, width))
    distances = RoundedDistances(0.5 / width, 50)
    one, other = (
        distances.between(distances.rows(rows[:, order]), distances.vectors(vectors[:, order]))
        for order in (np.arange(width), rng.permutation(width))
    )
    np.testing.assert_array_equal(one, other)
    full = in_steps(rows, 50).astype(int), in_steps(vectors, 50).astype(int)
    squares = ((full[0][:, np.newaxis] - full[1]) ** 2).sum(axis=-1)
    np.testing.assert_allclose(one, -0.5 / width * squares / 50**2, rtol=1e-9)


@pytest.mark.parametrize("distances", [RoundedDistances(0.1, 50), UnroundedDistances(0.1)])
def test_nothing_is_nearer_than_itself(distances):
    same = np.random.default_rng(5).standard_normal((200, 42))
    exponents = distances.between(distances.rows(same), distances.vectors(same))
    assert exponents.max() == 0.0


@pytest.mark.parametrize("spread", [1.0, 100.0])
def test_a_row_far_away_changes_no_bit_of_the_others(spread):
    rows, vectors = spread * np.random.default_rng(5).standard_normal((2, 40, 195))
    distances = RoundedDistances(0.5 / 195, 50)
    near, by = distances.rows(rows[1:]), distances.vectors(vectors)
    rows[0] *= 1000.0
    together = distances.between(distances.rows(rows), by)
    np.testing.assert_array_equal(together[1:], distances.between(near, by))


def test_every_row_sums_to_one_however_far_from_what_was_learned():
    rows = unseen(9) * np.geomspace(1e-30, 1e30, ROWS, dtype=np.float32)[:, np.newaxis]
    result = Classifier(trained(9)).probabilities(rows)
    np.testing.assert_allclose(result.sum(axis=1), 1.0, rtol=0, atol=9 * HALF_A_STEP)


def test_probabilities_come_in_steps_and_novelty_is_of_the_same():
    probabilities, novelty = Classifier(trained(9)).classify(unseen(9))
    assert ((probabilities > 0.0) & (probabilities < 1.0)).mean() > 0.5
    for values in (probabilities, novelty):
        steps = values / (2 * HALF_A_STEP)
        np.testing.assert_array_equal(steps, np.round(steps))


def test_support_vectors_beyond_all_precision_still_give_probabilities():
    far = trained(3).arrays["support_vectors"] * np.float32(1e20)
    result = Classifier(with_arrays(trained(3), support_vectors=far)).probabilities(far)
    np.testing.assert_allclose(result.sum(axis=1), 1.0, rtol=0, atol=3 * HALF_A_STEP)


def test_no_rows_give_no_probabilities():
    assert Classifier(trained(3)).probabilities(np.empty((0, 42), np.float32)).shape == (0, 3)


def test_a_class_without_support_vectors_is_no_obstacle():
    model = trained(3)
    counts = model.arrays["support_counts"].copy()
    counts[1] += counts[0]
    counts[0] = 0
    result = Classifier(with_arrays(model, support_counts=counts)).probabilities(unseen(3))
    assert np.isfinite(result).all()


def of_older_format(model):
    """Return a model whose novelty is that of formats 2 and 3, which did not round inputs."""
    parameters = {n: v for n, v in model.description.parameters.items() if n != "steps"}
    older = {"novelty": "machine", "parameters": parameters}
    return replace(model, description=model.description.model_copy(update=older))


def test_novelty_is_how_likely_the_label_is_wrong():
    rows = unseen(3)
    probabilities, novelty = Classifier(trained(3)).classify(rows)
    np.testing.assert_array_equal(novelty, 1 - probabilities.max(axis=1))
    np.testing.assert_array_equal(probabilities, Classifier(trained(3)).probabilities(rows))


def test_what_is_unknown_is_novel_however_sure_that_is():
    model, rows = trained(3), unseen(3)
    names = ["class_0", "class_1", "unknown"]
    scenario = {name: [] for name in names}
    renamed = model.description.model_copy(update={"classes": names, "scenario": scenario})
    probabilities, novelty = Classifier(replace(model, description=renamed)).classify(rows)
    np.testing.assert_array_equal(novelty, 1 - probabilities[:, :2].max(axis=1))
    assert novelty[probabilities[:, 2] > 0.9].min() > 0.9


def test_novelty_of_older_models_is_what_the_nearest_support_vector_leaves():
    model, rows = of_older_format(trained(3)), unseen(3)
    about = model.description
    here, there = (
        (x.astype(np.float64) - model.arrays["scaler_mean"]) / model.arrays["scaler_scale"]
        for x in (rows, model.arrays["support_vectors"])
    )
    nearest = rbf_kernel(here, there, gamma=about.parameters["gamma"]).max(axis=1)

    _, novelty = Classifier(model).classify(rows)

    np.testing.assert_allclose(novelty, 1 - nearest, atol=1e-6)


def test_to_older_models_what_was_learned_is_not_novel_and_what_is_far_from_it_is():
    model = of_older_format(trained(3))
    _, of_learned = Classifier(model).classify(model.arrays["support_vectors"])
    _, of_far = Classifier(model).classify(model.arrays["support_vectors"] * 100)
    assert of_learned.max() < 1e-6
    assert of_far.min() > 0.99
