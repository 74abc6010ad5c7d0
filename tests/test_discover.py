"""Sounds that recur are grouped whatever their labels say, are known again, and get a name."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

import log_fixtures
import numpy as np
from conftest import HEARTHLOG
from hypothesis import given, settings
from hypothesis import strategies as st
from recurring import RECURRING, names_of, two_recurring_days
from sklearn.metrics import adjusted_rand_score

from hearthlog.analyzer.discover import NO_CLUSTER, busiest_hours, groups, summary_path
from hearthlog.analyzer.discover import sounds as sounds_module
from hearthlog.analyzer.discover.groups import (
    GROUPS,
    add_groups,
    describe,
    descriptor_width,
    load_groups,
    make_space,
    new_groups,
    save_groups,
)
from hearthlog.analyzer.discover.sounds import discover, group_spans, read_sounds
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, read_marks, write_marks
from hearthlog.analyzer.recorder_status import examine_live
from hearthlog.analyzer.review.lanes import timeline_lanes
from hearthlog.analyzer.review.timeline import LabelledSpans
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.schemas.frames import NANOSECONDS, read_time
from hearthlog.schemas.logs.columns import Columns
from hearthlog.schemas.logs.files import find_logs, is_layer, review_path
from hearthlog.schemas.messages import message_types
from hearthlog.tools.lab.recurring_scene import OTHER


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(log_fixtures.run, capfd)


@pytest.fixture(scope="module")
def two_days(tmp_path_factory):
    return two_recurring_days(tmp_path_factory.getbasetemp())


@pytest.fixture
def home(two_days, tmp_path):
    """A copy of the logs."""
    return shutil.copytree(two_days[0], tmp_path / "logs")


@pytest.fixture(scope="module")
def two_grouped_days(two_days, tmp_path_factory):
    """A copy of the logs, grouped."""
    folder = shutil.copytree(two_days[0], tmp_path_factory.mktemp("grouped") / "logs")
    subprocess.run([*HEARTHLOG, "discover", folder], check=True, capture_output=True)
    return folder


@pytest.fixture
def grouped_home(two_grouped_days, tmp_path):
    """A copy of the logs and their groups."""
    return shutil.copytree(two_grouped_days, tmp_path / "logs")


def logs_of(folder):
    return [log for log in find_logs(folder) if not is_layer(log)]


def grouped(logs, groups=None):
    """Group the sounds of logs; return the groups, and of each sound its group and span."""
    with read_sounds(find_home_logs(logs), "all") as sounds:
        found, of, _ = discover(sounds, groups)
    return found, of, sounds


def run(hearthlog, *arguments):
    done = hearthlog("discover", *arguments)
    assert done.returncode == 0, done.stderr
    return done


def as_json(hearthlog, *arguments):
    return json.loads(run(hearthlog, *arguments, "--json").stdout)


def test_the_lock_of_the_groups_is_not_taken_for_a_recorder(grouped_home):
    assert (grouped_home / ".groups.safetensors.lock").exists()
    reported = [state.text for state in examine_live(grouped_home) if state.subject == "recorder"]
    assert reported == [f"nothing was ever recorded in {grouped_home}"]


def test_each_sound_that_recurs_is_a_group_of_its_own(two_days):
    folder, (first, second) = two_days
    _, of, sounds = grouped([folder])
    names = names_of(sounds, [*first, *second])
    recurs = names != OTHER
    assert adjusted_rand_score(names[recurs], of[recurs]) > 0.7
    rows = set()
    for name in RECURRING:
        own = of[names == name]
        row = np.bincount(own[own != NO_CLUSTER]).argmax()
        assert (own == row).mean() > 0.7
        assert (names[of == row] == name).mean() > 0.7
        rows.add(row)
    assert len(rows) == len(RECURRING)


def test_groups_of_one_day_are_known_again_on_the_next(two_days):
    folder, (_, second) = two_days
    early, late = logs_of(folder)
    groups, _, _ = grouped([early])
    later, of, sounds = grouped([late], groups)
    assert later.numbers[: len(groups.numbers)].tolist() == groups.numbers.tolist()
    names = names_of(sounds, second)
    for name in RECURRING:
        own = of[names == name]
        row = np.bincount(own[own != NO_CLUSTER]).argmax()
        assert row < len(groups.numbers)
        assert (own == row).mean() > 0.6


def test_a_group_gets_a_name_and_each_of_its_sounds_a_mark_which_undo_takes_back(home, hearthlog):
    largest = as_json(hearthlog, home)["groups"][0]
    example = largest["examples"][0]
    start = read_time(example["start"])
    own = Mark("mic", start, start + NANOSECONDS // 10, "kettle", "Berta")
    write_marks(Path(example["log"]), [own])
    name = f"{largest['number']}=Front door"
    done = run(hearthlog, home, "--name", name, "--reviewer", "Anna")
    count = largest["times"] - 1
    assert (
        f"group {largest['number']}: {count} marks of front_door; 1 are marked or looked at"
        in done.stderr
    )
    marks = [mark for log in logs_of(home) for mark in read_marks(log)]
    assert own in marks
    output = [mark for mark in marks if mark != own]
    reason = f"group {largest['number']} of {load_groups(home / GROUPS.file).id}"
    assert {mark[3:5] + mark[6:] for mark in output} == {("front_door", "Anna", "live", reason)}
    assert len(output) == count
    assert as_json(hearthlog, home)["groups"][0]["name"] == "front_door"
    done = run(hearthlog, home, "--undo", largest["number"])
    assert f"{count} marks taken back" in done.stderr
    assert [mark for log in logs_of(home) for mark in read_marks(log)] == [own]
    assert as_json(hearthlog, home)["groups"][0]["name"] == ""
    layers = [review_path(log) for log in logs_of(home) if str(log) != example["log"]]
    assert not any(layer.exists() for layer in layers)


def test_naming_again_marks_what_is_new(home, hearthlog):
    early, late = logs_of(home)
    file = home / GROUPS.file
    number = as_json(hearthlog, early, "--groups", file)["groups"][0]["number"]
    run(hearthlog, early, "--groups", file, "--name", f"{number}=bell")
    before = read_marks(early)
    assert before
    assert not read_marks(late)
    run(hearthlog, home, "--name", f"{number}=bell")
    assert [mark[:4] for mark in read_marks(early)] == [mark[:4] for mark in before]
    assert read_marks(late)


def test_another_name_renames_all_marks_of_a_group_whatever_is_looked_at_now(home, hearthlog):
    number = as_json(hearthlog, home)["groups"][0]["number"]
    run(hearthlog, home, "--name", f"{number}=dish")
    before = [mark for log in logs_of(home) for mark in read_marks(log)]
    run(hearthlog, home, "--name", f"{number}=glass", "--start", "2026-03-02")
    after = [mark for log in logs_of(home) for mark in read_marks(log)]
    assert [mark[:3] for mark in after] == [mark[:3] for mark in before]
    assert {mark.label for mark in after} == {"glass"}


def test_what_somebody_has_looked_at_is_not_marked(home, hearthlog):
    largest = as_json(hearthlog, home)["groups"][0]
    example = largest["examples"][0]
    span = ReviewedSpan("mic", read_time(example["start"]), read_time(example["end"]), "Berta")
    write_marks(Path(example["log"]), [], reviewed=[span])
    done = run(hearthlog, home, "--name", f"{largest['number']}=dish")
    assert "; 1 are marked or looked at by a reviewer already" in done.stderr


_WITHOUT = """
import sys
from importlib.abc import MetaPathFinder
class Missing(MetaPathFinder):
    def find_spec(self, name, *_):
        if name in {"sklearn", "scipy", "matplotlib", "joblib", "pyarrow"}:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Missing())
from hearthlog.tools.cli.main import main
main()
"""


def test_a_box_without_the_analyzer_names_what_another_one_has_grouped(grouped_home):
    for requested, status, states in (
        (["--name", "1=dish"], 0, "marks of dish"),
        (["--undo", "1"], 0, "marks taken back"),
        ([], 1, "scikit-learn is not installed; try: "),
    ):
        arguments = [sys.executable, "-c", _WITHOUT, "discover", grouped_home, *requested]
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=500, check=False)
        assert done.returncode == status, done.stderr
        assert states in done.stderr


def test_a_name_adds_no_group(grouped_home, hearthlog):
    file = grouped_home / GROUPS.file
    groups = load_groups(file)
    space, own = groups.space, groups.space.of == 0
    first = replace(space, examples=space.examples[own], of=space.of[own], radii=space.radii[:1])
    save_groups(replace(groups, space=first, numbers=groups.numbers[:1], names=[""]), file)
    run(hearthlog, grouped_home, "--name", f"{groups.numbers[0]}=dish")
    assert load_groups(file).names == ["dish"]


def test_what_is_printed_for_programs_is_kept_beside_the_groups(grouped_home, hearthlog):
    kept = json.loads(summary_path(grouped_home / GROUPS.file).read_text())
    named = as_json(hearthlog, grouped_home, "--name", "1=dish")
    for each in kept["groups"]:
        each["name"] = "dish" if each["number"] == 1 else ""
    assert named == kept
    assert named == json.loads(summary_path(grouped_home / GROUPS.file).read_text())


def test_nothing_is_marked_beside_a_summary_that_is_damaged(grouped_home, hearthlog):
    summary_path(grouped_home / GROUPS.file).write_text("{}")
    done = hearthlog("discover", grouped_home, "--name", "1=dish")
    assert done.returncode == 1
    assert "is no summary of groups; `hearthlog discover` writes it anew" in done.stderr
    assert not any(review_path(log).exists() for log in logs_of(grouped_home))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 1 << 30), st.integers(0, 2100), st.integers(1, 4), st.floats(1e-3, 1e3))
def test_a_point_is_of_the_group_with_the_nearest_example_by_its_radius(seed, count, k, scale):
    rng = np.random.default_rng(seed)
    of = np.repeat(np.arange(k), 20)
    examples = scale * rng.normal(size=(len(of), 3))
    space = replace(
        make_space(rng.normal(size=(9, 3)).astype(np.float32)),
        examples=examples,
        of=of,
        radii=scale * rng.uniform(0.05, 1.0, k),
    )
    points = np.concatenate([scale * rng.normal(size=(count, 3)), examples])
    away = np.array(
        [np.sqrt(((points[:, None] - examples[of == row]) ** 2).sum(2)).min(1) for row in range(k)]
    )
    away /= space.radii[:, None]
    expected = np.where(away.min(0) <= 1.0, away.argmin(0), NO_CLUSTER)
    assert space.find(points).tolist() == expected.tolist()


def test_groups_of_another_file_are_other_groups(home, hearthlog, tmp_path):
    first = as_json(hearthlog, home)["groups"][0]["number"]
    run(hearthlog, home, "--name", f"{first}=dish")
    count = sum(len(read_marks(log)) for log in logs_of(home))
    other = ["--groups", tmp_path / "other.safetensors", "--least", 10]
    run(hearthlog, home, *other)
    done = run(hearthlog, home, *other, "--undo", first)
    assert f"group {first}: 0 marks taken back" in done.stderr
    assert sum(len(read_marks(log)) for log in logs_of(home)) == count


def test_nothing_is_marked_by_groups_that_cannot_be_kept(home, hearthlog, tmp_path):
    options = ["--groups", tmp_path / "none" / "x", "--name", "1=dish"]
    done = hearthlog("discover", home, *options)
    assert done.returncode == 1
    assert "cannot be written (No such file or directory)" in done.stderr
    assert not any(review_path(log).exists() for log in logs_of(home))


def test_two_who_name_groups_at_once_wait_for_each_other(home, hearthlog):
    run(hearthlog, home)
    naming = [*HEARTHLOG, "discover", str(home), "--name"]
    both = [subprocess.Popen([*naming, name]) for name in ("1=one", "2=two")]
    assert [each.wait(120) for each in both] == [0, 0]
    assert load_groups(home / GROUPS.file).names[:2] == ["one", "two"]


def test_logs_that_were_joined_have_their_sounds_where_they_were(home, hearthlog, tmp_path):
    joined = tmp_path / "joined"
    joined.mkdir()
    done = hearthlog("merge", *logs_of(home), "-o", joined / "both.mcap")
    assert done.returncode == 0, done.stderr
    spans = []
    for folder in (home, joined):
        with read_sounds(find_home_logs([folder]), "all") as sounds:
            spans.append(sorted(zip(sounds.starts, sounds.ends, strict=True)))
    assert spans[0] == spans[1]


def test_sounds_are_read_in_the_order_of_time_where_a_clock_was_set_back():
    stamps = np.array([50, 60, 10, 20])
    fields = {"header.stamp": stamps, "label": np.array(list("cdab"), object)}
    columns = Columns("/mic/label", message_types.LABEL, {}, stamps, stamps, stamps, fields)
    times, labels = sounds_module._by_time(columns, "label")
    assert times.tolist() == [10, 20, 50, 60]
    assert labels.tolist() == list("abcd")


def test_what_lies_about_a_known_group_is_no_new_one():
    rng = np.random.default_rng(0)
    near, far = rng.normal(0, 1, (120, 3)), rng.normal(40, 1, (60, 3))
    points = np.concatenate([near, far])
    space = new_groups(("a",), points.astype(np.float32))
    of = np.zeros(len(points), np.int64)
    of[100:120] = NO_CLUSTER  # the others of the first cluster are known
    assert len(add_groups(space, points, of).numbers) == 0
    of[:120] = NO_CLUSTER
    assert len(add_groups(space, points, of).numbers) == 1


def test_features_that_are_no_numbers_are_left_out_and_said(home, monkeypatch):
    real = sounds_module.read_columns

    def with_nan(*arguments, **options):
        found = real(*arguments, **options)
        found["/mic/features"].fields["values"][2000:2400] = np.nan
        return found

    monkeypatch.setattr(sounds_module, "read_columns", with_nan)
    with read_sounds(find_home_logs([home]), "all") as sounds:
        assert np.isfinite(sounds.descriptors).all()
    assert "with features that are no numbers; left out" in sounds.losses[0]


def test_a_review_shows_what_recurs_as_a_lane(home, hearthlog):
    run(hearthlog, home)
    groups = load_groups(home / GROUPS.file)
    groups.names[1] = "rooster"
    spans, _ = group_spans(find_home_logs([home]), groups)
    assert {"rooster", "group 1"} <= set(spans["mic"].texts)
    assert (spans["mic"].starts[1:] >= spans["mic"].ends[:-1]).all()
    timeline = read_timeline([home])
    assert "Recurs" not in [lane.name for lane in timeline_lanes(timeline)]
    timeline.microphones["mic"].recurring = LabelledSpans(*spans["mic"])
    (lane,) = [lane for lane in timeline_lanes(timeline) if lane.name == "Recurs"]
    assert {"Rooster", "Group 1"} <= set(lane.spans.texts)


def test_only_what_the_model_does_not_know_is_grouped_if_that_is_asked_for(two_days):
    folder, _ = two_days
    counts = {}
    for choice in ("all", "unsure", "unknown"):
        with read_sounds(find_home_logs([folder]), choice) as sounds:
            counts[choice] = len(sounds.descriptors)
            if choice == "unknown":
                assert set(sounds.labels) <= {"unknown"}
    assert counts["all"] > counts["unsure"] >= counts["unknown"]


@pytest.mark.parametrize(
    ("options", "status", "states"),
    [
        (["--name", "1=silence"], 2, "give the number of a group and a class"),
        (["--name", f"{'9' * 5000}=door"], 2, "give the number of a group and a class"),
        (["--of", "loud"], 2, "it is one of all, unsure, unknown"),
        (["--end", "2026-03-01T08:00:20"], 1, "and it takes 16"),
        (["--end", "2026-01-01"], 1, "no log has features and labels"),
    ],
)
def test_what_makes_no_sense_is_one_line(home, hearthlog, options, status, states):
    done = hearthlog("discover", home, *options)
    assert done.returncode == status
    assert states in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (home / GROUPS.file).exists()


def test_groups_of_other_features_are_refused(two_days):
    groups, _, _ = grouped([two_days[0]])
    other = replace(groups, features=("a",))
    with pytest.raises(DataError, match="of 1 features, the logs have 33 others"):
        grouped([two_days[0]], other)


@pytest.fixture(scope="module")
def groups_file(two_days, tmp_path_factory):
    path = tmp_path_factory.mktemp("groups") / GROUPS.file
    save_groups(grouped([two_days[0]])[0], path)
    return path


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_a_damaged_file_of_groups_is_one_line_or_a_file_of_groups(groups_file, data):
    content = bytearray(groups_file.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = groups_file.with_name("damaged")
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    output = f"{path}: is well"
    try:
        assert np.isfinite(load_groups(path).space.examples).all()
    except DataError as error:
        output = str(error)
    assert output.startswith(f"{path}: is ")
    assert "\n" not in output


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scale", 1e-300),
        ("mean", 1e308),
        ("examples", np.nan),
        ("radii", 5e-324),
        ("numbers", -1),
        ("numbers", 1 << 62),
    ],
)
def test_a_file_of_groups_with_hostile_numbers_is_refused(two_days, tmp_path, name, value):
    groups, _, _ = grouped([two_days[0]])
    place = groups if name == "numbers" else groups.space
    getattr(place, name)[0] = value
    save_groups(groups, tmp_path / GROUPS.file)
    with pytest.raises(DataError, match="is damaged"):
        load_groups(tmp_path / GROUPS.file)


def test_a_file_of_more_examples_than_a_group_has_is_refused(two_days, tmp_path):
    groups, _, _ = grouped([two_days[0]])
    space = groups.space
    examples = np.concatenate([space.examples, np.repeat(space.examples[-1:], 300, axis=0)])
    of = np.append(space.of, np.full(300, space.of[-1]))
    more = replace(space, examples=examples, of=of)
    save_groups(replace(groups, space=more), tmp_path / GROUPS.file)
    with pytest.raises(DataError, match="do not fit each other"):
        load_groups(tmp_path / GROUPS.file)


@settings(deadline=None)
@given(st.integers(0, 1 << 30), st.integers(4, 60), st.floats(0.01, 100.0))
def test_a_description_does_not_depend_on_the_level_nor_on_what_is_around(seed, count, level):
    rng = np.random.default_rng(seed)
    names = ("energy", "centroid", "rolloff")
    values = rng.normal(size=(count + 40, 3)).astype(np.float32)
    values[:, 0] = rng.uniform(0.1, 1.0, len(values))
    first, last = np.array([2, 20 + count // 2]), np.array([2 + count // 2, 20 + count])
    both = describe(values, names, first, last)
    assert both.shape == (2, descriptor_width(names))
    for row in range(2):
        alone = values[first[row] : last[row]] * np.float32([level, 1.0, 1.0])
        again = describe(alone, names, np.array([0]), np.array([len(alone)]))
        np.testing.assert_allclose(both[row], again[0], rtol=1e-4, atol=1e-5)


def test_descriptions_are_the_same_in_blocks_of_any_size(monkeypatch):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(5000, 3)).astype(np.float32)
    names, first = ("energy", "centroid", "rolloff"), np.arange(0, 4800, 60)
    last = first + rng.integers(4, 60, len(first))
    full = describe(values, names, first, last)
    for size in (1, 100, 1 << 30):
        monkeypatch.setattr(groups, "_DESCRIBED_AT_ONCE", size)
        assert np.array_equal(describe(values, names, first, last), full)


def test_a_description_is_what_it_says():
    values = np.float32([[1.0, 0.0], [1.0, 2.0], [1.0, 4.0], [1.0, 2.0]])
    (described,) = describe(values, ("energy", "a"), np.array([0]), np.array([4]))
    np.testing.assert_allclose(described, [2.0, np.sqrt(2.0), 2.0, 2.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("hours", "text"),
    [
        ({7: 9, 8: 1}, "07 to 08"),
        ({23: 5, 0: 5}, "23 to 01"),
        (dict.fromkeys(range(24), 3), ""),
    ],
)
def test_the_usual_hours_are_the_shortest_span_with_four_fifths(hours, text):
    assert busiest_hours([hours.get(hour, 0) for hour in range(24)]) == text
