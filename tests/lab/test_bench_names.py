"""Which names may be events: what counts as right, how a threshold is chosen, the table."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.models.embedding import NO_EMBEDDINGS
from hearthlog.models.embedding.sound_names import NamedSound, SoundName, audioset_names
from hearthlog.tools.lab import names as bench
from hearthlog.tools.lab.names import KINDS, LIKE, Counts, Laid, Scene, count, table

DOCS = Path(__file__).parents[2] / "docs" / "audioset.md"
COUGH = SoundName("coughing", "Coughing", "cough", 1.0, 1)
SOURCES = {"a": 0, "b": 1}
SCENE = Scene(
    NO_EMBEDDINGS,
    [
        Laid("coughing/cough", "a", 40, 80),
        Laid("speech/speech", "b", 100, 200),
        Laid("other_negative/throat", "b", 240, 300),
    ],
    0.1,
)


def counted(*spans):
    sounds = [NamedSound(COUGH, first, end, 1.0) for first, end in spans]
    return [Counts(*row) for row in count(COUGH, sounds, SCENE, SOURCES).tolist()]


def test_a_sound_is_right_in_a_clip_of_its_kind():
    of_a, of_b = counted((45, 55), (60, 70))
    assert of_a == Counts(1, 1, 2, 0, 0)
    assert of_b[:4] == (0, 0, 0, 0)
    assert of_b.hours == pytest.approx(140 * 0.05 / 3600)


def test_a_sound_is_wrong_elsewhere_and_the_source_before_it_has_it():
    of_a, of_b = counted((120, 130))
    assert of_a == Counts(1, 0, 0, 0, 0)
    assert of_b[:4] == (0, 0, 0, 1)


def test_a_sound_in_a_clip_that_may_hold_it_is_neither():
    assert [each[:4] for each in counted((250, 260))] == [(1, 0, 0, 0), (0, 0, 0, 0)]


def test_a_sound_that_never_ends_is_wrong():
    assert [each.right for each in counted((0, 300))] == [0, 0]
    assert sum(each.wrong for each in counted((0, 300))) == 1


def test_a_clip_that_is_shorter_than_a_name_needs_does_not_count():
    counts = count(COUGH._replace(windows=5), [], SCENE, SOURCES)
    assert counts[:, 0].tolist() == [0, 0]


def test_the_threshold_is_above_the_lowest_that_would_do():
    rows = np.array([[10, 9, 9, 9, 1], [10, 8, 8, 1, 1], [10, 6, 6, 0, 1], [10, 1, 1, 0, 1]], float)
    assert bench._chosen(rows, 1) == 2
    assert bench._chosen(rows, 9) == 3
    assert bench._chosen(rows[:1], 1) is None


def many_sources(wrong):
    """Thresholds of which each is right in all ten sources of the name, and wrong in others."""
    counts = np.zeros((len(bench._THRESHOLDS), 40, 5))
    counts[:, :10, :3] = 1
    counts[:, :, 4] = 0.1
    counts[:, 10:, 3] = np.maximum(0, wrong - np.arange(len(counts)))[:, np.newaxis]
    return counts


def test_a_name_that_is_right_on_sources_left_out_is_an_event():
    name = bench._measured(COUGH, many_sources(wrong=4), times=1)
    assert (name.is_event, name.clips, name.sources) == (True, 10, 10)
    assert name.threshold == bench._THRESHOLDS[5]
    assert (name.precision, name.recall, name.false_an_hour) == (1, 1, 0)


def test_a_name_that_is_always_wrong_is_a_hint():
    name = bench._measured(COUGH, many_sources(wrong=99), times=1)
    assert not name.is_event
    assert name.threshold == bench._THRESHOLDS[-1]
    assert name.false_an_hour > 1


def test_a_name_of_few_sources_has_no_figures():
    counts = many_sources(wrong=0)
    counts[:, 3:10, :3] = 0
    name = bench._measured(COUGH, counts, times=1)
    assert (name.is_event, name.sources, name.threshold) == (False, 3, 0)
    assert np.isnan(name.precision)


def test_kinds_are_of_names_in_the_table():
    assert KINDS.keys() | LIKE.keys() <= {name.name for name in audioset_names()}


def test_the_documented_table_is_that_of_the_names():
    lines = re.findall(r"^\| .*\|$", DOCS.read_text("utf-8"), re.MULTILINE)
    rows = [line for line in lines if not line.startswith("|---")]
    written = [line for line in table(audioset_names()).splitlines() if line[1] != "-"]
    assert rows == written


def test_a_manifest_is_read_with_its_kinds(tmp_path):
    path = tmp_path / "manifest.csv"
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows(
            [["path", "label", "source_group", "detail"], ["a.wav", "speech", "a", "digit"]]
        )
    (kind,) = bench.read_kinds(path)
    assert (kind.kind, kind.clip.path, kind.clip.source_group) == (
        "speech/digit",
        tmp_path / "a.wav",
        "a",
    )
