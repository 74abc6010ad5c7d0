"""Classifiers of other systems: as scikit-learn has them, without it, whatever the file says."""

import os
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from blobs import blobs, with_arrays
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import (
    ExtraTreesClassifier,
    GradientBoostingClassifier,
    RandomForestClassifier,
)
from sklearn.linear_model import LogisticRegression
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC, OneClassSVM
from test_blas import runnable
from threadpoolctl import threadpool_limits

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.adaptation import adapt_model, base_classes, is_moved
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.train import method_named, train_model
from hearthlog.analyzer.training.window_methods import ROOM, balanced, rounded, rounded_to_steps
from hearthlog.models.classifiers.classifier import Classifier, classifier_kind
from hearthlog.models.classifiers.rbf_machines import weakest_pairs
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.schemas.errors import ModelError, ignore_progress

EXAMPLE = Path(__file__).parents[1] / "examples" / "classifiers"
sys.path.insert(0, str(EXAMPLE))
from hearthlog_classifiers.neighbours import NeighboursMachine, NeighboursParameters  # noqa: E402
from hearthlog_classifiers.shares import LEAST_SHARE  # noqa: E402
from hearthlog_classifiers.tree_methods import _not_above  # noqa: E402
from hearthlog_classifiers.trees import MOST_LEVELS, TREES, TreesMachine  # noqa: E402

LANDMARKS = ROOM.name
BROUGHT = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"]
NAMES = [LANDMARKS, "svm", *BROUGHT["hearthlog.methods"]]
FORGETTING = sorted(set(NAMES) - {LANDMARKS, "svm", "neighbours"})  # have no windows as they were
SMALLER = {
    LANDMARKS: {"landmarks": 60},
    "forest": {"trees": 12},
    "extra-trees": {"trees": 12},
    "boosting": {"rounds": 10},
    "perceptron": {"units": 16, "improvement": 0.03},
}
ROWS = 300


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    """Let commands, and what runs here, find the example installed."""
    folder = tmp_path_factory.mktemp("extension")
    source = shutil.copytree(EXAMPLE, folder / "source")  # a build leaves its traces in it
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", folder / "site", source], check=True, capture_output=True)
    path = os.pathsep.join(filter(None, [str(folder / "site"), os.environ.get("PYTHONPATH")]))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder / "site")
        patch.setenv("PYTHONPATH", path)
        yield


def method_of(name):
    return replace(method_named(name), **SMALLER.get(name, {}))


@cache
def data_of(classes, count=40):
    return blobs(classes, count, spread=2.5)


@cache
def trained(name, classes=3):
    return train_model(*data_of(classes), ignore_progress, method_of(name))


@cache
def unseen(classes=3):
    rows = prepare(method_of("forest"), data_of(classes)[0]).inputs[0].reshape(-1, 195)
    rng = np.random.default_rng(7)
    chosen = rows[rng.integers(0, len(rows), ROWS)]
    return (chosen * rng.uniform(0.8, 1.2, chosen.shape)).astype(np.float32)


def judged(model, rows):
    """Probabilities, and before their rounding the decisions behind them."""
    decisions, _ = classifier_kind(model.description.kind).machine(model).decide(rows)
    return np.concatenate([Classifier(model).probabilities(rows), decisions], axis=1)


def of_scikit_learn(name, inputs, target, rows):
    """Decisions of scikit-learn itself."""
    method, weight = method_of(name), balanced(target, np.ones(len(target)))
    seed, single, many = {"random_state": method.random_state}, inputs, rows
    inputs, rows = inputs.astype(np.float64), rows.astype(np.float64)
    if name in {"forest", "extra-trees"}:
        kind = RandomForestClassifier if name == "forest" else ExtraTreesClassifier
        limits = {"max_depth": method.levels, "min_samples_leaf": method.leaf_windows}
        forest = kind(method.trees, **limits, **seed).fit(single, target, weight)
        return np.log(np.maximum(forest.predict_proba(many), LEAST_SHARE))
    if name == "boosting":
        limits = {"max_depth": method.levels, "subsample": method.share, "max_features": "sqrt"}
        boosted = GradientBoostingClassifier(
            n_estimators=method.rounds, learning_rate=method.rate, init="zero", **limits, **seed
        )
        return of_both(boosted.fit(single, target, weight).decision_function(many))
    scaler = StandardScaler()
    if name in {"neighbours", "one-class"}:
        scaler = rounded_to_steps(scaler, method.steps)
    scaled, rows = scaler.fit_transform(inputs), scaler.transform(rows)
    if name == "neighbours":
        nearest = KNeighborsClassifier(method.neighbours, algorithm="brute").fit(scaled, target)
        *_, last, next_one = nearest.kneighbors(rows, method.neighbours + 1)[0].T
        votes = np.maximum(nearest.predict_proba(rows), LEAST_SHARE)
        return np.where((next_one - last > 1e-9)[:, np.newaxis], np.log(votes), np.nan)
    if name == "one-class":
        machine = OneClassSVM(nu=method.outside, gamma=method.gamma / 195)
        of_each = [
            machine.fit(scaled[target == one]).decision_function(rows) for one in set(target)
        ]
        return np.stack(of_each, axis=1)
    if name == "logistic":
        machine = LogisticRegression(C=method.cost / len(target), max_iter=method.iterations)
        return of_both(machine.fit(scaled, target, weight).decision_function(rows))
    network = MLPClassifier(
        method.units, alpha=method.decay, tol=method.improvement, max_iter=method.passes, **seed
    )
    return np.log(network.fit(scaled, target, weight).predict_proba(rows))


def of_landmarks(method, scaler, inputs, target, rows):
    """Logarithms of the probabilities of scikit-learn, given the landmarks."""
    classes = len(set(target))
    landmarks = trained(LANDMARKS, classes).arrays["landmarks"].astype(np.float64)
    scaler = rounded_to_steps(scaler, method.steps)
    scaled, landmarks, rows = (
        scaler.fit_transform(inputs),
        *map(scaler.transform, (landmarks, rows)),
    )
    kernels = partial(rbf_kernel, Y=landmarks, gamma=method.gamma / landmarks.shape[1])
    values, vectors = np.linalg.eigh(kernels(landmarks))
    map_ = vectors / np.sqrt(values)
    # Of two classes it pulls the difference of both, not each.
    cost = (2 if classes == 2 else 1) * method.cost
    machine = LogisticRegression(C=cost, max_iter=10_000, tol=1e-7)
    machine.fit(kernels(scaled) @ map_, target, balanced(target, np.ones(len(target))))
    return np.log(machine.predict_proba(kernels(rows) @ map_))


def of_support_vectors(method, inputs, target, rows):
    """Decisions of scikit-learn's pairs of classes, each class by its weakest."""
    scaler = rounded_to_steps(StandardScaler(), method.steps)
    scaled, rows = scaler.fit_transform(inputs), scaler.transform(rows)
    machine = SVC(C=method.cost, gamma=method.gamma / 195, decision_function_shape="ovo")
    pairs = machine.fit(scaled, target, balanced(target, np.ones(len(target))))
    values = pairs.decision_function(rows)
    classes = len(set(target))
    return weakest_pairs(-values[:, np.newaxis] if values.ndim == 1 else values, classes)


def of_both(decisions):
    """Decisions of each class, where scikit-learn has one number for two."""
    return decisions if decisions.ndim == 2 else np.stack([0 * decisions, decisions], axis=1)


def as_probabilities(decisions):
    grown = np.exp(decisions - decisions.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("classes", [2, 3, 9])
@pytest.mark.parametrize("name", NAMES)
def test_decisions_are_those_of_scikit_learn(name, classes):
    method, (data, _) = method_of(name), data_of(classes)
    examples = prepare(method, data)
    inputs, target, _ = examples.windows(slice(None))
    as_given = rounded(inputs).astype(np.float64), target, unseen(classes)
    if name == LANDMARKS:
        theirs = of_landmarks(method, StandardScaler(), *as_given)
    elif name == "svm":
        theirs = of_support_vectors(method, *as_given)
    else:
        theirs = of_scikit_learn(name, rounded(inputs), target, unseen(classes))
    ours = method.fit(examples).decide(unseen(classes), classes)
    reported = ~np.isnan(theirs[:, 0])  # it draws among those that are as far as the last neighbour
    assert reported.mean() > 0.98
    ours, theirs = ours[reported], theirs[reported]
    assert len(np.unique(theirs.argmax(axis=1))) == classes
    if name in {LANDMARKS, "perceptron"}:  # a softmax forgets what is added to all
        ours, theirs = as_probabilities(ours), as_probabilities(theirs)
    # Both go on until what is won is little, by other steps.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-3 if name == LANDMARKS else 1e-5)


@pytest.mark.parametrize("name", NAMES)
@settings(deadline=None, max_examples=15)
@given(cuts=st.sets(st.integers(1, ROWS - 1), max_size=40))
def test_a_row_is_judged_the_same_in_any_company(name, cuts):
    full = judged(trained(name), unseen())
    parts = [judged(trained(name), unseen()[a:b]) for a, b in pairwise(sorted({0, ROWS, *cuts}))]
    np.testing.assert_array_equal(np.concatenate(parts), full)


@pytest.mark.parametrize("name", NAMES)
def test_the_number_of_blas_threads_changes_nothing(name):
    results = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            results.append(judged(trained(name), unseen()))
    np.testing.assert_array_equal(*results)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Files of models of all methods."""
    folder = tmp_path_factory.mktemp("models")
    for name in NAMES:
        save_model(trained(name), folder / f"{name}.safetensors")
    return folder


ALONE = """
import hashlib, sys
from pathlib import Path
import numpy as np
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.modelfile import load_model
rows = np.load(sys.argv[2])
for path in sorted(Path(sys.argv[1]).iterdir()):
    probabilities = Classifier(load_model(path)).probabilities(rows)
    print(path.stem, hashlib.sha256(probabilities.tobytes()).hexdigest())
assert not {"sklearn", "scipy", "joblib"} & sys.modules.keys(), "numpy alone"
"""


def probabilities_alone(models, rows, kernel=None):
    """Digests of the probabilities of a process with numpy alone, by the name of the method."""
    environment = os.environ | ({"OPENBLAS_CORETYPE": kernel} if kernel else {})
    command = [sys.executable, "-c", ALONE, models, rows]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return dict(line.split() for line in done.stdout.splitlines())


def test_whatever_the_kernel_and_with_numpy_alone_probabilities_have_the_same_bits(
    models, tmp_path
):
    kernels = {runnable()[0], runnable()[-1]} if runnable() else {None}
    np.save(tmp_path / "rows.npy", unseen())
    ways = [probabilities_alone(models, tmp_path / "rows.npy", kernel) for kernel in kernels]
    assert all(ways[0].keys() == set(NAMES) and way == ways[0] for way in ways)


@pytest.mark.parametrize("name", NAMES)
def test_what_was_saved_decides_the_same(name, models):
    loaded = load_model(models / f"{name}.safetensors")
    assert loaded.description.method == name
    np.testing.assert_array_equal(judged(loaded, unseen()), judged(trained(name), unseen()))


@pytest.mark.parametrize("name", NAMES)
def test_the_same_sounds_give_the_same_arrays(name):
    again = method_of(name).fit(prepare(method_of(name), data_of(3)[0])).arrays()
    assert again.keys() == trained(name).arrays.keys()
    for array, values in again.items():
        np.testing.assert_array_equal(values, trained(name).arrays[array])


def of_home(classes, of):
    """Segments of a home, whose sounds are those of other blobs."""
    data, _ = blobs(9, 4)  # too few to find a temperature by
    kept = np.isin(data.target, of)
    arrays = {
        name: getattr(data, name)[kept]
        for name in ("windows", "target", "group", "collection", "weight", "floor")
    }
    names = tuple(f"class_{number}" for number in range(classes))
    return replace(data, **arrays, copy_floor=data.copy_floor[:, kept], classes=names,
                   copies=data.copies[:, kept], seconds=dict.fromkeys(names, 4.0))  # fmt: skip


def with_windows(name):
    """A model as earlier versions learned it, with the windows that it learned from."""
    inputs, target, _ = prepare(method_of(name), data_of(3)[0]).windows(slice(None))
    return with_arrays(
        trained(name), learned_inputs=rounded(inputs), learned_target=target.astype(np.int64)
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_home_teaches_and_what_it_taught_goes_with_it(name, tmp_path):
    base = with_windows(name) if name in FORGETTING else trained(name)
    home = of_home(4, [1, 3])
    adapted = adapt_model(base, home)
    assert is_moved(adapted)
    inputs = prepare(method_of(name), home).inputs[0].reshape(-1, 195)
    target = np.repeat(home.target, len(inputs) // len(home))
    right = (judged(adapted, inputs)[:, :4].argmax(axis=1) == target).mean()
    before = (judged(base, inputs)[:, :3].argmax(axis=1) == target).mean()
    assert right > before + 0.03  # much stays as the base has it
    save_model(adapted, tmp_path / "adapted.safetensors")
    loaded = load_model(tmp_path / "adapted.safetensors")
    assert base_classes(loaded) == base.classes
    of_other = of_home(3, [0])
    np.testing.assert_array_equal(
        judged(adapt_model(loaded, of_other), inputs)[:, 3:],
        judged(adapt_model(base, of_other), inputs)[:, 3:],
    )


@pytest.mark.parametrize("name", FORGETTING)
def test_a_model_without_windows_is_not_adapted(name):
    base = replace(trained(name), name="bare")
    assert base_classes(base) == base.classes
    with pytest.raises(DataError, match="bare: has not kept what it learned from; train it anew"):
        adapt_model(base, of_home(4, [1, 3]))


@pytest.mark.parametrize("name", FORGETTING)
def test_a_model_without_the_windows_of_a_class_is_not_adapted(name):
    base = with_windows(name)
    kept = base.arrays["learned_target"] != 1
    windows = {one: base.arrays[one][kept] for one in ("learned_inputs", "learned_target")}
    base = replace(with_arrays(base, **windows), name="holed")
    with pytest.raises(DataError, match="holed: has kept nothing of class_1; train it anew"):
        adapt_model(base, of_home(4, [0, 3]))


def stumps():
    """The arrays of two small trees of two classes."""
    return {
        "roots": np.array([0, 3], np.int32),
        "feature": np.array([0, -1, -1, 1, 0, -1, -1, -1], np.int16),
        "threshold": np.array([0.5, 0, 0, -1, 2, 0, 0, 0], np.float32),
        "children": np.array(
            [[1, 2], [0, 0], [0, 0], [4, 7], [5, 6], [0, 0], [0, 0], [0, 0]], np.int32
        ),
        "values": np.array([[1, 0], [0, 1], [0.5, 0.5], [0.25, 0.75], [0, 1]], np.float32),
        "importances": np.array([0.7, 0.3]),
    }


def test_an_input_up_to_the_threshold_goes_to_the_first_child():
    rows = np.array([[0.5, -1], [0.6, -1], [2.5, -1], [0.5, 0]], np.float32)
    decisions, novelty = TreesMachine(stumps()).decide(rows)
    shares = [[0.75, 0.25], [0.25, 0.75], [0.125, 0.875], [0.5, 0.5]]
    np.testing.assert_allclose(decisions, np.log(shares))
    assert np.isnan(novelty).all()


HOSTILE_TREES = {
    "a node is its own child": ("children", 0, [0, 2], "behind their parent"),
    "a child is before its parent": ("children", 3, [2, 7], "behind their parent"),
    "a child is in another tree": ("children", 0, [1, 4], "behind their parent"),
    "a child is nowhere": ("children", 4, [5, 8], "behind their parent"),
    "a child is negative": ("children", 4, [5, -1], "behind their parent"),
    "an input that is not there": ("feature", 0, 2, "inputs that there are not"),
    "no tree begins at the first node": ("roots", 0, 1, "roots are not"),
    "trees out of order": ("roots", 1, 0, "roots are not"),
    "a tree behind the end": ("roots", 1, 8, "roots are not"),
    "a negative share": ("values", 0, [2, -1], "no probabilities"),
    "shares that add up to more": ("values", 0, [1, 1], "no probabilities"),
    "a class that is not there": ("learned_target", 0, 2, "classes that the model has not"),
}


@pytest.mark.parametrize("why", HOSTILE_TREES)
def test_trees_that_make_no_sense_are_refused(why):
    name, place, value, complaint = HOSTILE_TREES[why]
    windows = {"learned_inputs": np.zeros((1, 2), np.float32), "learned_target": np.zeros(1, int)}
    arrays = stumps() | windows
    assert TREES.problem(2, arrays) is None
    arrays[name][place] = value
    assert complaint in (TREES.problem(2, arrays) or "")


def test_roots_so_far_apart_that_their_difference_overflows_are_refused():
    far = {"roots": np.array([0, 2**31 - 1, -2, 5], np.int32)}
    assert "roots are not" in (TREES.problem(2, stumps() | far) or "")


def chain(levels):
    """A tree that asks so many questions, one after the other."""
    count = 2 * levels + 1
    feature, children = np.full(count, -1, np.int16), np.zeros((count, 2), np.int32)
    feature[:-1:2] = 0
    children[:-1:2] = np.arange(0, count - 1, 2)[:, np.newaxis] + [1, 2]
    values = np.tile(np.array([[0.5, 0.5]], np.float32), (levels + 1, 1))
    alone = {"roots": np.zeros(1, np.int32), "threshold": np.zeros(count, np.float32)}
    return stumps() | alone | {"feature": feature, "children": children, "values": values}


def test_a_tree_without_end_is_refused():
    assert TREES.problem(2, chain(MOST_LEVELS)) is None
    assert "levels" in TREES.problem(2, chain(MOST_LEVELS + 1))
    assert "levels" in TREES.problem(2, chain(20_000))


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_trees_of_any_numbers_are_refused_or_decide(data):
    nodes = data.draw(st.integers(1, 12))
    few = st.integers(-2, nodes)
    feature = np.array(data.draw(st.lists(st.integers(-1, 2), min_size=nodes, max_size=nodes)))
    pairs = st.lists(st.tuples(few, few), min_size=nodes, max_size=nodes)
    arrays = {
        "roots": np.array(data.draw(st.lists(few, max_size=3)), np.int32),
        "feature": feature.astype(np.int16),
        "threshold": np.zeros(nodes, np.float32),
        "children": np.array(data.draw(pairs), np.int32),
        "values": np.full(((feature < 0).sum(), 2), 0.5, np.float32),
        "importances": np.ones(2),
    }
    if TREES.problem(2, arrays) is None:
        decisions, _ = TreesMachine(arrays).decide(np.zeros((3, 2), np.float32))
        np.testing.assert_allclose(decisions, np.log(0.5))


@given(
    threshold=st.floats(-1e6, 1e6),
    nearby=st.integers(-2, 2),
)
def test_a_threshold_of_half_the_length_divides_inputs_as_before(threshold, nearby):
    value = np.float32(threshold)
    for _ in range(abs(nearby)):
        value = np.nextafter(value, np.float32(np.sign(nearby) * np.inf))
    [short] = _not_above(np.array([threshold]))
    assert (value <= short) == (np.float64(value) <= threshold)


MISFITS = {
    "a scaler of zeros": ("logistic", {"scaler_scale": np.zeros(195)}, "not positive"),
    "half a hidden layer": ("perceptron", {"hidden_weights": None}, "hidden_weights is missing"),
    "no hidden units": (
        "perceptron",
        {
            "hidden_bias": np.zeros(0),
            "hidden_weights": np.zeros((195, 0)),
            "output_weights": np.zeros((0, 3)),
        },
        "no unit",
    ),
    "hidden units without end": (
        "perceptron",
        {
            "hidden_bias": np.zeros(1025),
            "hidden_weights": np.zeros((195, 1025)),
            "output_weights": np.zeros((1025, 3)),
        },
        "more than 1024",
    ),
    "a layer too narrow": ("logistic", {"output_weights": np.zeros((9, 3))}, "has shape"),
    "nobody votes": (
        "neighbours",
        {"vectors": np.zeros((0, 195), np.float32), "vectors_target": np.zeros(0, np.int64)},
        "no vectors",
    ),
    "a vote for no class": ("neighbours", {"vectors_target": 3}, "classes that the model has not"),
    "a machine of no class": ("one-class", {"support_target": -1}, "classes that the model has"),
    "an offset too many": ("one-class", {"offsets": np.zeros(4)}, "has shape"),
    "landmarks of no class": (LANDMARKS, {"landmark_counts": 0}, "do not add up"),
    "weights of other landmarks": (LANDMARKS, {"weights": np.zeros((9, 3))}, "has shape"),
    "landmarks of a home without weights": (
        LANDMARKS,
        {"home_landmarks": np.zeros((2, 195), np.float32)},
        "weights has shape",
    ),
    "a base of other classes": (
        LANDMARKS,
        {"base_weights": np.zeros((60, 4)), "base_bias": np.zeros(4)},
        "without landmarks",
    ),
    "windows without classes": (
        "forest",
        {"learned_inputs": np.zeros((1, 195), np.float32)},
        "learned_target is missing",
    ),
    "windows of no class": (
        "boosting",
        {"learned_inputs": np.zeros((1, 195), np.float32), "learned_target": np.full(1, 3)},
        "classes that the model has not",
    ),
    "intercepts of other classes": ("boosting", {"intercepts": np.zeros(2)}, "has shape"),
    "leaves without values": ("forest", {"values": np.zeros((3, 3), np.float32)}, "has shape"),
}


@pytest.mark.parametrize("why", MISFITS)
def test_arrays_that_do_not_fit_are_refused(why, tmp_path):
    name, changed, complaint = MISFITS[why]
    model = trained(name)
    arrays = {
        one: np.full_like(model.arrays[one], value) if isinstance(value, int) else value
        for one, value in changed.items()
    }
    broken = with_arrays(model, **arrays)
    kept = {one: array for one, array in broken.arrays.items() if array is not None}
    with pytest.raises(ModelError, match=complaint):
        save_model(replace(broken, arrays=kept), tmp_path / "broken.safetensors")


@pytest.mark.filterwarnings("error")
def test_the_same_sound_many_times_makes_one_landmark_of_each_of_its_windows():
    data, scenario = data_of(3)
    windows = data.windows.copy()
    windows[data.target == 0] = windows[0]
    data, method = replace(data, windows=windows), method_of(LANDMARKS)
    inputs, target, _ = prepare(method, data).windows(slice(None))
    different = len(np.unique(rounded(inputs)[target == 0], axis=0))
    counts = train_model(data, scenario, ignore_progress, method).arrays["landmark_counts"]
    assert counts[0] == different < counts[1] == counts[2] == 20


def test_fewer_landmarks_than_classes_are_refused():
    method = replace(method_of(LANDMARKS), landmarks=2)
    with pytest.raises(DataError, match="2 landmarks for 3 classes; each needs one"):
        train_model(*data_of(3), ignore_progress, method)


def votes_of(vectors, target, row, neighbours):
    arrays = {
        "scaler_mean": np.zeros(2),
        "scaler_scale": np.ones(2),
        "vectors": np.array(vectors, np.float32),
        "vectors_target": np.array(target),
    }
    parameters = NeighboursParameters(neighbours=neighbours, steps=50)
    decisions, _ = NeighboursMachine(arrays, parameters, 2).decide(np.array([row], np.float32))
    return np.exp(decisions[0])


def test_those_that_are_as_far_as_the_last_neighbour_vote_too_in_whatever_order():
    vectors, target = [[0, 1], [1, 0], [0, -1], [-1, 0], [5, 5]], [0, 1, 1, 1, 0]
    for order in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [1, 0, 3, 2, 4]):
        votes = votes_of([vectors[n] for n in order], [target[n] for n in order], [0, 0], 2)
        np.testing.assert_allclose(votes, [0.25, 0.75])


def test_a_class_without_a_vote_counts_as_a_hundredth():
    votes = votes_of([[0, 0], [0.1, 0], [9, 9]], [0, 0, 1], [0, 0], 2)
    np.testing.assert_allclose(votes, [1.0, LEAST_SHARE])


def test_what_a_person_marked_weighs_in_votes_as_in_all_else():
    data, scenario = data_of(2)
    heavy = replace(data, weight=np.where(data.target == 1, 3.0, 1.0))
    method = method_of("neighbours")
    counts = [
        np.bincount(method.fit(prepare(method, one)).arrays()["vectors_target"])
        for one in (data, heavy)
    ]
    np.testing.assert_array_equal(counts[1], counts[0] * [1, 3])
    assert scenario.classes


def test_the_comparison_counts_the_bytes_of_the_file(models):
    bench = pytest.importorskip("hearthlog.tools.lab.classifiers", reason="not in the wheel")
    for path in models.iterdir():
        model, data = load_model(path), path.read_bytes()
        others = model.transitions.nbytes + model.training_digests.nbytes
        header = 8 + int.from_bytes(data[:8], "little")
        assert len(data) == header + bench.stored_bytes(model.arrays) + others


def test_the_comparison_tries_what_was_not_learned(monkeypatch):
    bench = pytest.importorskip("hearthlog.tools.lab.classifiers", reason="not in the wheel")
    data, _ = data_of(3)
    group, names = np.arange(len(data)) // 4, ("one", "two", "three")
    data = replace(data, group=group, collection=group % 3, collection_names=names)
    examples = prepare(method_of("neighbours"), data)
    nearest = replace(method_of("neighbours"), neighbours=1)
    of_sources, of_collections = bench.tried(nearest, data, examples, 2)
    for one in (of_sources, of_collections):
        assert one.probabilities.shape == (2, len(data), 3)
        assert 0.5 < one.macro_f1.min() < 1.0  # one that it had learned would be its own neighbour
    assert of_sources.macro_f1[0] != of_sources.macro_f1[1]
    monkeypatch.setattr(bench, "best_of", partial(bench.best_of, turns=1, least=0.01))
    cost = bench.cost_of(nearest, data, examples)
    assert cost.stored_bytes > 195 * 3 * len(data)
    assert min(cost.seconds, cost.live_seconds, cost.fit_seconds) > 0.0


def test_a_method_without_cost_has_none_to_choose():
    with pytest.raises(DataError, match="method forest has no cost to choose"):
        method_of("forest").with_parameters({"cost": 4.0})


def test_the_command_learns_one_of_them_and_records_with_it(hearthlog, training_set, day, tmp_path):
    model = tmp_path / "layers.safetensors"
    requested = ["--data", training_set, "--scenario", "bathroom", "--method", "logistic"]
    done = hearthlog("train", *requested, "-o", model)
    assert done.returncode == 0, done.stderr
    assert "weights" in done.stdout
    done = hearthlog("record", day, "--model", model, "-o", tmp_path / "logs")
    assert done.returncode == 0, done.stderr
