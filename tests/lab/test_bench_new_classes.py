"""What marks of new classes teach is measured with sources that nothing was learned from."""

import csv

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.tools.home.clips import SHIPPED
from hearthlog.tools.lab.new_classes import PLAYED, Outcome, compose, lines_of


def test_a_home_is_composed_of_halves_that_share_no_source_and_that_no_starter_has_heard(tmp_path):
    home = compose([SHIPPED], None, 1, tmp_path, minutes=2.0)
    assert len(home.logs) == 3
    assert len({log.start // 86_400_000_000_000 for log in home.logs}) == 3
    assert {"silence", "speech", "crying"} <= {*home.truth.labels} <= {"silence", *PLAYED[GENERAL]}
    with starter_file(GENERAL).with_name("sources.csv").open(encoding="utf-8") as file:
        recorded = {row["source_group"] for row in csv.DictReader(file)}
    halves = []
    for half in range(2):
        with (tmp_path / f"half-{half}.csv").open(encoding="utf-8") as file:
            halves.append({row["source_group"] for row in csv.DictReader(file)})
    assert all(halves)
    assert not halves[0] & halves[1]
    assert not (halves[0] | halves[1]) & recorded


def test_nothing_is_played_of_which_there_are_no_recordings(tmp_path):
    with SHIPPED.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["label"] != "music"]
    manifest = tmp_path / "no-music.csv"
    with manifest.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("path", "label", "source_group"))
        for row in rows:
            writer.writerow((SHIPPED.parent / row["path"], row["label"], row["source_group"]))
    home = compose([manifest], None, 1, tmp_path, minutes=2.0)
    assert "music" not in home.truth.labels
    assert {"speech", "crying"} <= {*home.truth.labels}


def test_what_marks_taught_is_a_row_with_the_words_of_train_and_of_the_gate():
    before, after = {"silence": 0.9, "speech": 0.5, "crying": 0.0}, {"silence": 0.9, "speech": 0.4}
    reasons = "silence falls from 9 min to 2 min", "music rises from 1 min to 9 min"
    outcome = Outcome(10, ["crying"], before, after | {"crying": 0.5}, reasons, ["2 marks of tap"])
    assert list(lines_of(outcome)) == [
        "   10  0.467 0.600  crying 0.00 0.50; least speech 0.50 -0.100",
        "       train: 2 marks of tap",
        "       gate: silence falls from 9 min to 2 min; music rises from 1 min to 9 min",
    ]
    assert list(lines_of(outcome._replace(reasons=(), notes=[])))[1:] == ["       gate: may label"]
