"""Searching for cost and gamma."""

import dataclasses
import json
from functools import partial

import numpy as np
import pytest
from blobs import blobs
from clusters import two_threads_in
from log_fixtures import run, run_function

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.train import evaluate_method
from hearthlog.analyzer.training.window_methods import PAPER, ROOM
from hearthlog.analyzer.workers import fits_on
from hearthlog.schemas.errors import ignore_progress
from hearthlog.tools.home.simulate import write_training_set
from hearthlog.tools.lab import adaptation_curve, command, grid_search
from hearthlog.tools.lab.grid_search import search


def measured(capfd, *words):
    return run_function(capfd, lambda: command.run(grid_search.main), *words)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with two_threads_in(tmp_path_factory.mktemp("cluster")) as address:
        yield address


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_training_set(tmp_path_factory.mktemp("clips"), clips_per_class=2, seed=3)


def test_a_search_puts_first_what_tells_segments_apart_best():
    data, _ = blobs(3, 40, features=PAPER.features)
    useless = dataclasses.replace(
        PAPER, gamma=1e4
    )  # so sharp that it knows nothing but what it has seen
    tried = search(data, [useless, PAPER], "source", ignore_progress)
    assert [one.method for one in tried] == [PAPER, useless]
    assert tried[0].scores.macro_f1 > tried[1].scores.macro_f1 + 0.2


def test_a_search_finds_the_figures_that_cross_validation_finds():
    data, _ = blobs(3, 40, features=PAPER.features)
    steps = []
    methods = PAPER.variations()[:2]
    tried = search(data, methods, "source", steps.append)
    for method, scores in tried:
        assert scores == evaluate_method(data, method, "source", ignore_progress).scores
    assert steps == pytest.approx([done / 10 for done in range(1, 11)])


def test_a_search_over_segments_that_are_all_alike_is_refused():
    data, _ = blobs(2, 20, features=PAPER.features)
    flat = dataclasses.replace(data, windows=np.ones_like(data.windows))
    with pytest.raises(DataError, match="all segments are alike"):
        search(flat, PAPER.variations(), "source", ignore_progress)


def test_a_cluster_adapts_as_threads_do(cluster):
    data, _ = blobs(3, 400, spread=3.0)
    group = np.arange(len(data)) // 4
    data = dataclasses.replace(data, group=group, collection=group % 2, collection_names=("a", "b"))
    method = dataclasses.replace(ROOM, landmarks=60)
    here = adaptation_curve.adaptation_curve(data, method, ignore_progress)
    with fits_on(cluster):
        assert adaptation_curve.adaptation_curve(data, method, ignore_progress) == here


def test_what_a_search_found_can_be_trained_with(clips, tmp_path, capfd):
    words = ["--data", clips, "--scenario", "bathroom"]
    printed = measured(capfd, "paper", *words).stdout
    result = measured(capfd, "paper", *words, "--json")
    found = json.loads(result.stdout)["tried"]
    assert len(found) == 9
    assert found == sorted(found, key=lambda one: -one["macro_f1"])
    best = found[0]
    chosen = ["--cost", f"{best['cost']:g}", "--gamma", f"{best['gamma']:g}"]
    assert " ".join(chosen) in printed
    words += ["--method", "paper"]
    done = run(capfd, "train", *words, *chosen, "-o", tmp_path / "a.safetensors", "--json")
    assert json.loads(done.stdout)["metrics"]["macro_f1"] == pytest.approx(best["macro_f1"])


def test_a_method_that_takes_a_network_is_refused(capfd):
    for module in (grid_search, adaptation_curve):
        words = ("embedding", "--data", "d", "--scenario", "general")
        result = run_function(capfd, partial(command.run, module.main), *words)
        assert result.returncode == 2
        assert "such as room" in result.stderr
