"""Logs, layers and models of every released version are read for ever, and those of later ones.

`golden/<version>` has what that version wrote: `logs`, with a gap, clips, a reviewer's marks and a
relabelling by `merged`; `left`, the second log as it was before it was complete; `models`, of which
`smoothed` is the one that was recorded with. `golden_home.py` writes the folder of a version; add
what is in it to `EXPECTED`. These files never change: tests work on copies.
"""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from grown_schema import GROWN, NEXT, grown_definitions, plain, write_as_later
from log_fixtures import run as run_here
from readers import (
    READERS,
    Run,
    by_bags,
    by_cat,
    by_catalog,
    by_csv,
    by_diff,
    by_doctor,
    by_evaluate,
    by_follow,
    by_messages,
    by_npz,
    by_parquet,
    by_replay,
    by_text_and_sound,
    by_watching,
)

from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.analyzer.review.lanes import FEATURES
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.errors import HearthlogWarning
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import SCHEMA_VERSION

pytestmark = pytest.mark.fast

GOLDEN = sorted((Path(__file__).parent / "golden").iterdir())


class Expected(NamedTuple):
    """What a version wrote.

    `rules` are those of the doctor that it broke, `marks` and `live` seconds by label.
    """

    schema: int
    topics: dict[str, int]
    left: dict[str, int]
    live: dict[str, float]
    relabelled: dict[str, int]
    marks: list[tuple[str, float]]
    rules: set[str]


EXPECTED = {
    "0.1.0": Expected(
        schema=1,
        topics={
            "/diagnostics": 5,
            "/hall/audio": 12,
            "/hall/features": 960,
            "/hall/gap": 1,
            "/hall/info": 2,
            "/hall/label": 922,
            "/hall/relabel/merged/label": 922,
            "/hall/relabel/merged/segment": 12,
            "/hall/review/mark": 3,
            "/hall/review/segment": 3,
            "/hall/segment": 10,
            "/hall/statistics": 96,
            "/rosout": 13,
        },
        left={
            "/diagnostics": 2,
            "/hall/features": 369,
            "/hall/info": 1,
            "/hall/label": 369,
            "/hall/statistics": 37,
            "/rosout": 1,
        },
        live={"silence": 39.2, "coughing": 5.8, "phone_ring": 1.1},
        relabelled={"silence": 6, "coughing": 6},
        marks=[("coughing", 2.5), ("speech", 3.0), ("silence", 1.0)],
        rules={"gap"},
    ),
    "0.2.0": Expected(
        schema=3,
        topics={
            "/diagnostics": 5,
            "/hall/audio": 7,
            "/hall/features": 920,
            "/hall/gap": 2,
            "/hall/info": 2,
            "/hall/label": 876,
            "/hall/relabel/merged/label": 876,
            "/hall/relabel/merged/segment": 31,
            "/hall/review/mark": 6,
            "/hall/review/reviewed": 1,
            "/hall/review/segment": 6,
            "/hall/segment": 24,
            "/hall/statistics": 92,
            "/rosout": 28,
        },
        left={
            "/diagnostics": 2,
            "/hall/features": 329,
            "/hall/gap": 1,
            "/hall/info": 1,
            "/hall/label": 314,
            "/hall/segment": 8,
            "/hall/statistics": 33,
            "/rosout": 10,
        },
        live={"silence": 16.95, "coughing": 13.85, "phone_ring": 10.0, "speech": 3.0},
        relabelled={"silence": 14, "coughing": 10, "phone_ring": 4, "speech": 3},
        marks=[
            ("bell", 2.7),
            ("bell", 2.7),
            ("bell", 2.7),
            ("coughing", 1.8),
            ("phone_ring", 2.4),
            ("television", 2.9),
        ],
        rules={"gap"},
    ),
}


@pytest.fixture(params=GOLDEN, ids=lambda path: path.name)
def golden(request, tmp_path, monkeypatch) -> Path:
    """A copy of what a version wrote, as the current folder."""
    folder = tmp_path / "golden"
    shutil.copytree(request.param, folder)
    monkeypatch.chdir(folder)
    return request.param


@pytest.fixture
def expected(golden) -> Expected:
    assert golden.name in EXPECTED, f"say in EXPECTED what {golden} holds"
    return EXPECTED[golden.name]


@pytest.fixture(name="run")
def in_this_process(capfd) -> Run:
    return partial(run_here, capfd)


def test_info_counts_what_every_version_wrote(golden, expected, run):
    done = run("info", "logs", "--json")
    output = json.loads(done.stdout)
    assert {name: topic["messages"] for name, topic in output["topics"].items()} == expected.topics
    seconds = {label: minutes * 60 for label, minutes in output["labels"]["hall"].items()}
    assert seconds == pytest.approx(expected.live)
    assert output["segments"]["hall/relabel/merged"] == expected.relabelled
    assert len(output["layers"]) == len([p for p in find_logs(golden / "logs") if is_layer(p)])
    assert output["schema_versions"] == [str(expected.schema)]
    assert (done.returncode, done.stderr) == (3, "")  # for the gap
    left = json.loads(run("info", "left", "--json").stdout)
    assert {name: topic["messages"] for name, topic in left["topics"].items()} == expected.left


def test_every_message_of_every_version_is_printed(expected, run):
    assert Counter(line["topic"] for line in by_cat(run)) == expected.topics


def test_every_topic_of_every_version_is_read_as_columns(expected):
    columns = read_columns(find_logs(Path("logs")))
    assert {topic: len(each) for topic, each in columns.items()} == expected.topics
    for each in columns.values():
        assert all(len(values) == len(each) for values in each.fields.values())


def test_every_message_of_every_version_is_decoded_one_by_one(expected, run):
    decoded = by_messages(run)
    layers_too = (
        topic for name, each in decoded.items() if "active" not in name for topic, *_ in each
    )
    assert Counter(layers_too) == expected.topics


def test_the_doctor_finds_nothing_in_what_every_version_wrote(expected, run):
    assert {(rule, level) for _, level, rule, _ in by_doctor(run)} == {
        (rule, "warning") for rule in {*expected.rules, "unfinished"}
    }


def test_every_version_is_exported(expected, run):
    counts = sorted(n for topic, n in expected.topics.items() if topic != "/hall/audio")
    assert sorted(map(len, by_parquet(run).values())) == counts
    assert sorted(map(len, by_csv(run).values())) == counts
    assert len(by_npz(run)) == len(counts)
    track, clips = by_text_and_sound(run)
    assert len(track.splitlines()) == expected.topics["/hall/segment"]
    assert clips
    assert by_bags(run) == [expected.topics, expected.topics]


def test_a_replay_of_every_version_is_what_it_recorded(expected, run):
    output, again = by_replay(run)
    assert output["compared"]["labels"] == expected.topics["/hall/label"]
    assert output["compared"]["segments"] == expected.topics["/hall/segment"]
    recorded = {
        topic: plain(c.fields) for topic, c in read_columns(find_logs(Path("logs"))).items()
    }
    for topic in ("/hall/label", "/hall/segment", "/hall/statistics", "/hall/gap", "/rosout"):
        assert again[topic] == recorded[topic]


def test_a_relabelling_of_every_version_stays_and_would_be_the_same(expected, run):
    model = ["--model", "models/merged.safetensors", "--workers", "1"]
    layers = sorted(Path("logs").rglob("*.relabel-merged.mcap"))
    assert f"{len(layers)} layers there already" in run("relabel", "logs", *model).stdout
    before = plain(read_columns(layers))
    for layer in layers:
        layer.unlink()
    assert run("relabel", "logs", *model).returncode == 0
    again = read_columns(layers)
    assert plain(again) == before
    topics = {topic: n for topic, n in expected.topics.items() if "relabel" in topic}
    assert {topic: len(columns) for topic, columns in again.items()} == topics


def test_two_labellings_of_every_version_are_compared(expected, run):
    output, queue = by_diff(run)
    assert output["total"]["minutes"] == pytest.approx(sum(expected.live.values()) / 60, abs=0.01)
    assert queue


@pytest.mark.usefixtures("golden")
def test_every_version_is_reported(run):
    assert run("report", "logs", "--day", "2026-03-01", "-o", "day.html").returncode == 0
    assert run("report", "logs", "--day", "2026-03-01", "--labels", "merged", "-o", "m.html").stdout


def test_every_version_is_evaluated_against_its_reviewer(expected, run):
    output = by_evaluate(run)
    known = load_model(Path("models/smoothed.safetensors")).classes
    seconds = sum(seconds for label, seconds in expected.marks if label in known)
    assert output["frames"] * 0.05 == pytest.approx(seconds)


@pytest.mark.usefixtures("golden")
def test_the_home_of_every_version_is_learned_from(run):
    base = ["--base", "models/smoothed.safetensors", "--home", "logs"]
    done = run("train", *base, "--output", "home.safetensors")
    assert (done.returncode, done.stderr.count("segments of the home")) == (0, 1)
    assert load_model(Path("home.safetensors")).classes


def test_the_models_of_every_version_label_its_logs(expected, run):
    for name in ("smoothed", "merged", "adapted"):
        assert load_model(Path(f"models/{name}.safetensors")).name == name
        shown = run("models", "show", name, "--folder", "models")
        assert (shown.returncode, shown.stdout[:1]) == (0, "#")
    model = ["--model", "models/adapted.safetensors", "--workers", "1"]
    assert run("relabel", "logs", *model).returncode == 0
    labels = read_columns(sorted(Path("logs").rglob("*.relabel-adapted.mcap")))
    assert len(labels["/hall/relabel/adapted/label"]) == expected.topics["/hall/label"]


def test_every_version_is_shown_on_a_timeline(expected):
    timeline = read_timeline([Path("logs")])
    assert timeline.losses == []
    microphone = timeline.microphones["hall"]
    segments = {labelling.name: len(labelling.spans) for labelling in microphone.labellings}
    assert segments == {
        "live": expected.topics["/hall/segment"],
        "relabel/merged": expected.topics["/hall/relabel/merged/segment"],
        "review": len(expected.marks),
    }
    assert (FEATURES, "") in microphone.plots
    assert sum(len(clip.samples) for clip in microphone.clips) > 0
    assert (len(microphone.gaps), len(timeline.lines.texts)) == (
        expected.topics["/hall/gap"],
        expected.topics["/rosout"],
    )


@pytest.mark.usefixtures("golden")
def test_every_version_is_watched(run):
    assert by_watching(run)


def test_logs_of_every_version_are_followed(expected, run):
    frames, _ = by_follow(run)
    followed = {f"logs {topic}": count for topic, count in expected.topics.items()}
    assert frames == followed | {f"left {topic}": count for topic, count in expected.left.items()}


def test_the_marks_of_every_version_are_read_and_added_to(expected, run):
    marks = [mark for path in find_logs(Path("logs")) for mark in read_marks(path)]
    if not is_layer(path := find_logs(Path("logs"))[0]):
        marks = read_marks(path)
    lengths = sorted((mark.label, (mark.end - mark.start) / 1e9) for mark in {*marks})
    assert lengths == sorted(expected.marks)
    Path("more.csv").write_text(
        "start,end,label\n2026-03-01T06:59:31Z,2026-03-01T06:59:32Z,music\n"
    )
    assert run("annotate", "import", "logs", "more.csv").returncode == 0
    log = next(path for path in find_logs(Path("logs")) if not is_layer(path))
    assert {mark.label for mark in read_marks(log)} == {label for label, _ in expected.marks} | {
        "music"
    }


def test_what_a_version_left_unfinished_is_recovered(expected, run):
    done = run("recover", *find_logs(Path("left")), "-o", "recovered.mcap")
    assert done.returncode == 0
    by_topic = read_columns([Path("recovered.mcap")])
    assert {topic: len(columns) for topic, columns in by_topic.items()} == expected.left


def test_every_version_is_catalogued(expected, run):
    labels, rows = by_catalog(run)
    assert {row["state"] for row in rows} == {"finished"}
    assert sum(row["frames"] for row in rows) == expected.topics["/hall/features"]
    segments = sum(each["segments"] for each in labels if each["kind"] == "relabel")
    assert segments == expected.topics["/hall/relabel/merged/segment"]


@pytest.fixture(scope="module")
def read_before():
    """What readers made of golden files as they are, by reader and version."""
    return {}


@pytest.fixture
def unchanged(request, golden, run, read_before) -> tuple[Callable[[Run], Any], Any]:
    """A reader, and what it makes of golden files as they are."""
    reader = request.param
    if (golden.name, reader) not in read_before:
        read_before[golden.name, reader] = reader(run)
    return reader, read_before[golden.name, reader]


@pytest.fixture(scope="module")
def written_later(tmp_path_factory) -> dict[str, Path]:
    """Golden files as a later version would have written them, by version."""
    written: dict[str, Path] = {}
    for golden in GOLDEN:
        folder = tmp_path_factory.mktemp("later")
        with grown_definitions(folder):
            write_as_later(golden, folder / golden.name)
        written[golden.name] = folder / golden.name
    return written


@pytest.fixture
def later(golden, written_later, tmp_path) -> Path:
    """A copy of what a later version would have written."""
    shutil.copytree(written_later[golden.name], tmp_path / "later")
    return tmp_path / "later"


every_reader = pytest.mark.parametrize(
    "unchanged", READERS, ids=lambda reader: reader.__name__, indirect=True
)


@pytest.mark.filterwarnings("ignore:is of schema version")
@every_reader
def test_what_a_later_version_appended_changes_nothing(unchanged, later, run, monkeypatch):
    reader, before = unchanged
    monkeypatch.chdir(later)
    assert reader(run) == before


@every_reader
def test_what_was_appended_since_has_its_default(unchanged, golden, run, tmp_path, monkeypatch):
    reader, before = unchanged
    shutil.copytree(golden, tmp_path / "earlier")
    monkeypatch.chdir(tmp_path / "earlier")
    with grown_definitions(tmp_path):
        assert without_defaults(reader(run)) == without_defaults(before)


def without_defaults(value: Any) -> Any:
    """Leave out what was appended."""
    names = {growth.name for growth in GROWN.values()}
    if isinstance(value, dict):
        return {
            key: without_defaults(each)
            for key, each in value.items()
            if str(key).partition(".")[0] not in names
        }
    return list(map(without_defaults, value)) if isinstance(value, list | tuple) else value


def test_logs_of_two_versions_are_one_series_of_the_later(later, tmp_path):
    first, second = (path for path in find_logs(Path("logs")) if not is_layer(path))
    logs = [first, later / second]
    with grown_definitions(tmp_path):
        columns = read_columns(logs)
        segments, labels = columns["/hall/segment"], columns["/hall/label"]
        growth = GROWN[message_types.SEGMENT]
        old = len(read_columns([first], ["/hall/segment"])["/hall/segment"])
        assert np.isnan(segments[growth.name][:old]).all()
        assert (segments[growth.name][old:] == growth.value).all()
        assert {len(row) for row in labels[GROWN[message_types.LABEL].name]} == {0, 3}
        assert columns["/hall/statistics"]["formula"][[0, -1]].tolist() == [
            "of the paper",
            "in two passes",
        ]
        assert columns["/hall/info"]["last_gap.reason"].tolist() == ["", "overrun"]
        assert columns["/hall/info"]["last_gap.noticed"].tolist() == [0, 1_772_348_390_000_000_001]


def test_logs_of_two_versions_are_one_series_of_the_earlier(later, expected):
    first, second = (path for path in find_logs(Path("logs")) if not is_layer(path))
    with pytest.warns(HearthlogWarning, match=f"is of schema version '{NEXT}'"):
        metadata = select([first, later / second]).metadata
    own = None if expected.schema == 1 else str(expected.schema)
    assert [record.get("schema_version") for record in metadata] == [own, str(NEXT)]
    both, own = read_columns([first, later / second]), read_columns([first, second])
    assert {topic: plain(columns.fields) for topic, columns in both.items()} == {
        topic: plain(columns.fields) for topic, columns in own.items()
    }


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", "logs", "--json"],
        ["cat", "logs"],
        ["export", "logs", "-o", "tables", "--format", "parquet"],
        ["merge", "logs", "-o", "all.mcap"],
        ["diff", "logs", "live", "merged"],
        ["evaluate", "log", "logs", "--reference", "review"],
        ["replay", "logs", "--model", "models/smoothed.safetensors"],
        ["relabel", "logs", "--model", "models/smoothed.safetensors", "--workers", "1"],
        ["relabel", "logs", "--model", "models/smoothed.safetensors", "--workers", "2"],
        ["report", "logs", "--day", "2026-03-01", "-o", "day.html"],
        [
            "train",
            "--base",
            "models/smoothed.safetensors",
            "--home",
            "logs",
            "--output",
            "x.safetensors",
        ],
        ["review", "logs", "--save", "day.rrd"],
        ["catalog", "logs"],
    ],
    ids=lambda arguments: f"{arguments[0]} {arguments[-1]}",
)
def test_a_newer_log_is_named_once_and_what_is_done_is_done_with_3(
    later, run, monkeypatch, arguments
):
    monkeypatch.chdir(later)
    done = run(*arguments)
    lines = [line for line in done.stderr.splitlines() if "schema version" in line]
    assert len(lines) == 1
    assert lines[0].startswith("hearthlog: logs/2026/03/01/home_20260301T0")
    assert f"schema version '{NEXT}', and this hearthlog knows up to {SCHEMA_VERSION}" in lines[0]
    assert lines[0].endswith("update hearthlog")
    assert done.returncode == 3


def test_the_doctor_warns_of_every_newer_file(later, run, monkeypatch):
    monkeypatch.chdir(later)
    output = json.loads(run("doctor", "logs", "--json").stdout)
    newer = {each["path"] for each in output["findings"] if each["rule"] == "newer"}
    assert newer == {str(path) for path in find_logs(Path("logs"))}
    assert output["errors"] == 0
