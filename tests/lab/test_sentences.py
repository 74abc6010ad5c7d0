"""The statements about a composed day are compared with the truth."""

from datetime import date

import pytest
from homelife import at, write_day

pytest.importorskip("hearthlog.tools.lab.sentences", reason="the wheel leaves the lab out")

from hearthlog.analyzer.errors import DataError
from hearthlog.tools.lab.sentences import statements
from hearthlog.tools.lab.statements import (
    FALSE,
    HOLDS,
    INFO,
    LABELLED,
    PAGE,
    REPORT,
    judge_count,
    read_count,
    read_minutes,
)

DAY = date(2026, 3, 2)
LABELS = [
    (at("03:00"), 2, "coughing", 0.9),
    (at("09:00"), 2, "coughing", 0.9),
    (at("09:30"), 8, "phone_ring", 0.95),
    (at("14:00"), 120, "speech", 0.8),
]


def found(tmp_path, labels, sounds):
    """The statements about a day with labels, of which some sounds are true."""
    write_day(tmp_path / "logs", DAY, labels, node="home")
    rows = "".join(
        f"{start},{start + length},{label},resident\n" for start, length, label in sounds
    )
    (tmp_path / "events.csv").write_text("start,end,label,from\n" + rows)
    ((day, own),) = statements(tmp_path)
    assert day == DAY
    return own


def true(labels):
    return [row[:3] for row in labels]


def test_statements_of_a_day_that_is_labelled_rightly_hold_on_every_surface(tmp_path):
    own = found(tmp_path, LABELS, true(LABELS))
    assert [each for each in own if each.verdict != HOLDS] == []
    assert {each.surface for each in own} == {REPORT, PAGE, INFO}


def test_a_count_of_what_was_not_there_is_false_or_as_labelled(tmp_path):
    rings = [(at("10:00") + 600 * n, 8, "phone_ring", 0.95) for n in range(9)]
    own = found(tmp_path, [*LABELS, *rings], true(LABELS))
    assert {each.verdict for each in own if each.surface == PAGE} == {HOLDS, LABELLED}
    text = "Telephone ringing, Day 07\N{EN DASH}22: 10"
    rows = {each.surface: each for each in own if each.text == text}
    assert {*rows} == {PAGE, REPORT}, "the same count on both"
    assert {(row.truth, row.verdict) for row in rows.values()} == {("1", LABELLED)}


def test_a_quiet_stretch_with_a_sound_in_it_is_only_as_labelled(tmp_path):
    own = found(tmp_path, LABELS, [*true(LABELS), (at("17:00"), 20, "crying")])
    (quiet,) = [each for each in own if "longest quiet stretch" in each.text]
    assert quiet.verdict == LABELLED
    assert quiet.truth.startswith("1 sound")


def test_what_is_told_without_a_word_of_doubt_is_false_if_it_is_not_so():
    day = [
        ("coughing", (1, 1), 3, False),
        ("coughing", (1, 1), 3, True),
        ("coughing", (1, 4), 3, False),
    ]
    verdicts = [judge_count(PAGE, *row[:3], modest=row[3]).verdict for row in day]
    assert verdicts == [FALSE, LABELLED, HOLDS]


def test_a_wrong_time_of_a_rare_sound_does_not_hold(tmp_path):
    early = [(at("08:50"), 2, "coughing"), *(row for row in true(LABELS) if row[0] != at("09:00"))]
    own = found(tmp_path, LABELS, early)
    wrong = [each for each in own if each.verdict != HOLDS and each.surface == REPORT]
    assert wrong
    assert all("09:00" in each.text for each in wrong)


def test_a_table_that_is_not_one_of_sounds_is_refused_by_name(tmp_path):
    write_day(tmp_path / "logs", DAY, LABELS, node="home")
    (tmp_path / "events.csv").write_text("begin,end\n1,2\n")
    with pytest.raises(DataError, match=r"events\.csv: cannot be read"):
        list(statements(tmp_path))


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("4 to 9 (12 labelled)", (4, 9)),
        ("8", (8, 8)),
        ("Twice", (2, 2)),
        ("no", (0, 0)),
        ("often", None),
    ],
)
def test_counts_are_read_as_they_are_written(text, count):
    assert read_count(text) == count


@pytest.mark.parametrize(
    ("text", "minutes"),
    [("1 h 05 min", 65), ("12.5 min", 12.5), ("30 s", 0.5), ("under 1 min", 0.5)],
)
def test_lengths_are_read_as_they_are_written(text, minutes):
    assert read_minutes(text) == minutes
