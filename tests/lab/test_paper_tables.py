"""The figures of the paper beside those of its method and ours, on clips of anyone."""

import csv
import json

import numpy as np
import pytest
from log_fixtures import run_function

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import BUILTIN, LABELS, read_manifest
from hearthlog.analyzer.training.train import evaluate_method
from hearthlog.analyzer.training.window_methods import PAPER
from hearthlog.schemas.errors import ignore_progress
from hearthlog.tools.home.simulate import write_training_set
from hearthlog.tools.lab import paper
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.paper import print_reproduction, reproduce, share_right

KINDS = ["segment", "source", "collection"]


def measured(capfd, *words):
    return run_function(capfd, lambda: run(paper.main), *words)


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    """Two clips of each label, one of either of two collections."""
    path = write_training_set(tmp_path_factory.mktemp("clips"), clips_per_class=2, seed=5)
    return rewritten(path, path, lambda n, row: row | {"source": f"collection {n % 2}"})


def rewritten(path, copy, change):
    """Write a manifest with other rows; those that become None are left out."""
    rows = list(csv.DictReader(path.read_text("utf-8").splitlines()))
    changed = [row for row in map(change, range(len(rows)), rows) if row is not None]
    with copy.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(changed)
    return copy


@pytest.fixture(scope="module")
def unmusical(manifest):
    return rewritten(
        manifest,
        manifest.with_name("unmusical.csv"),
        lambda _, row: None if row["label"] == "music" else row,
    )


@pytest.fixture(scope="module")
def tables(manifest):
    steps = []
    found = reproduce(read_manifest(manifest, LABELS), ["bathroom", "general"], steps.append)
    assert steps == sorted(steps)
    assert steps[-1] == 1.0
    return found


def test_both_scenarios_are_learned_by_the_papers_method_and_ours_by_all_folds(tables):
    assert [(one.scenario, one.paper_f1) for one in tables] == [
        ("bathroom", 0.89),
        ("general", 0.81),
    ]
    for one in tables:
        assert list(one.results) == [(name, kind) for name in ("paper", "room") for kind in KINDS]
        assert list(one.sound) == list(BUILTIN[one.scenario].classes)
        for result in one.results.values():
            assert result.scores.classes == tuple(BUILTIN[one.scenario].classes)


def test_all_methods_and_folds_are_tried_on_the_same_segments(tables):
    for one in tables:
        supports = {
            tuple(scores.support for scores in result.scores.per_class.values())
            for result in one.results.values()
        }
        assert supports == {tuple(sound.segments for sound in one.sound.values())}


def test_the_figures_are_those_of_evaluate_method_where_no_clip_is_unknown(tables, manifest):
    clips = read_manifest(manifest, LABELS)
    data = build_dataset(clips, BUILTIN["bathroom"], ignore_progress, features=PAPER.features)
    for kind in KINDS:
        result = evaluate_method(data, PAPER, kind, ignore_progress)
        assert tables[0].results["paper", kind] == result


def test_it_is_counted_where_the_segments_of_a_class_come_from(tables, manifest):
    clips = read_manifest(manifest, LABELS)
    data = build_dataset(clips, BUILTIN["general"], ignore_progress, features=PAPER.features)
    for number, one in enumerate(tables[1].sound.values()):
        first = np.count_nonzero(data.collection[data.target == number] == 0)
        share = first / one.segments
        assert (one.sources, one.collections) == (2, 2)
        assert one.largest == pytest.approx(max(share, 1.0 - share))
    assert (tables[1].sources, tables[1].collections) == (18, 2)


def test_the_share_that_is_right_counts_segments_and_not_classes():
    assert share_right([[9, 1], [1, 1]]) == pytest.approx(10 / 12)


def test_a_table_has_a_row_for_each_class_and_folds_and_names_what_is_thin(tables, capsys):
    print_reproduction(tables[0])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("bathroom: ")
    assert lines[0].endswith(" in 2 collections")
    assert ["the", "paper", "reports", "0.89"] in [line.split() for line in lines]
    [at] = [n for n, line in enumerate(lines) if line.startswith("shower") and "segment" in line]
    assert [line.split()[-9] for line in lines[at : at + 3]] == KINDS
    assert "fewer than 20 sources: silence, flushing_water, shower, tap_water, other" in lines


def test_one_scenario_needs_the_clips_of_its_own_classes_only(capfd, unmusical):
    result = measured(capfd, "--data", unmusical, "--scenario", "bathroom", "--json")
    [(name, found)] = json.loads(result.stdout).items()
    assert (name, found["paper_f1"], found["collections"]) == ("bathroom", 0.89, 2)
    assert set(found["methods"]) == {"paper", "room"}
    for by_kind in found["methods"].values():
        assert list(by_kind) == KINDS
        for one in by_kind.values():
            confusion = np.array(one["confusion"])
            assert confusion.shape == (5, 5)
            assert one["share_right"] == pytest.approx(np.trace(confusion) / confusion.sum())
            low, high = one["macro_f1_interval"]
            assert low <= high
            assert {"precision", "recall", "f1", "f1_interval"} <= one["per_class"]["shower"].keys()


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda n, row: None if row["label"] == "shower" and n % 2 else row,
            "scenario bathroom: class shower has 1 source group",
        ),
        (
            lambda _, row: row | {"source": "one"},
            "scenario bathroom: all recordings are of one coll",
        ),
        (
            lambda _, row: row | {"source_group": "one"} if row["label"] == "crying" else row,
            "scenario general: class crying has 1 source group",
        ),
    ],
)
def test_clips_that_cannot_be_divided_are_refused_before_anything_is_learned(
    manifest, change, problem
):
    clips = read_manifest(rewritten(manifest, manifest.with_name("other.csv"), change), LABELS)
    steps = []
    with pytest.raises(DataError, match=problem):
        reproduce(clips, ["bathroom", "general"], steps.append)
    assert max(steps) < 0.1


def test_a_class_without_clips_is_named_in_one_line(capfd, unmusical):
    result = measured(capfd, "--data", unmusical)
    assert result.returncode == 1
    problem = "class music has no segments: no usable clip is labelled music"
    assert result.stderr.splitlines()[1:] == [f"hearthlog: scenario general: {problem}"]
