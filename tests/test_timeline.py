"""What a Rerun recording of some logs shows."""

import os
import subprocess
import sys
from threading import Event as Flag

import numpy as np
import pytest
from blobs import blobs, ignore_progress
from logs import features, read
from lossy import LossySource
from rerun.chunk import RrdReader
from viewers import rerun_home, shown, viewer

from analyzer.errors import DataError
from analyzer.timeline import save_timeline
from analyzer.tracks import read_tracks
from analyzer.train import train_model
from models.modelfile import load_model, save_model
from recorder.config import Settings
from recorder.service import record
from recorder.sources.replayed import FileSource
from recorder.stream import FRAME_NANOSECONDS
from schemas import messages
from schemas.errors import LogError
from schemas.files import find_logs
from schemas.messages import nanoseconds
from schemas.topics import Topic
from schemas.writer import LogWriter, Rows
from tools.cli.review import review

__all__ = ["viewer"]  # a fixture

START = 1_772_348_370_123_456_789
LOST = {5: 7, 9: 400}
CONTENTS = {
    "/mic/label",
    "/mic/label/probabilities",
    "/mic/segment",
    "/mic/gap",
    "/mic/features/level",
    "/mic/features/heat_map",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, model_file, day):
    """Logs of one recording with gaps."""
    folder = tmp_path_factory.mktemp("logs")
    settings = Settings(output=folder, model=model_file, max_bag_duration=60)
    recording = record(settings, LossySource(FileSource([day], START), LOST), Flag())
    assert len(recording.logs) > 2
    return folder


@pytest.fixture(scope="module")
def recording(folder, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "day.rrd"
    save_timeline(find_logs(folder), path)
    return path


def column(path, entity, name):
    """Times (ns) and cells of one column, in the order of time."""
    times, cells = [], []
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            times += batch.column("time").cast("int64").to_pylist()
            cells += batch.column(name).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [cells[i] for i in order]


def fixed(path, entity, name):
    """The only cell of a static column."""
    chunks = (c for c in RrdReader(path).stream() if str(c.entity_path) == entity and c.is_static)
    batches = [chunk.to_record_batch() for chunk in chunks]
    ((cell,),) = (b.column(name).to_pylist() for b in batches if name in b.schema.names)
    return cell


def lane(path, entity):
    """States as (time, text), None where nothing is."""
    times, cells = column(path, entity, "StateChange:state")
    return [(int(time), cell[0]) for time, cell in zip(times, cells, strict=True)]


def test_everything_is_in_the_recording_and_nothing_else(recording):
    found = {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}
    assert {name for name in found if not name.startswith("/__")} == CONTENTS


def test_the_probabilities_are_those_of_the_log_and_nothing_stands_in_a_gap(
    recording, folder, model_file
):
    labels = read(folder, "label")
    times, cells = column(recording, "/mic/label/probabilities", "Scalars:scalars")
    values = np.array(cells)
    gap = np.isnan(values).any(axis=1)
    stamps = [nanoseconds(m.header.stamp) for m in labels]
    np.testing.assert_array_equal(times[~gap], stamps)
    np.testing.assert_array_equal(values[~gap], [m.probabilities for m in labels])
    starts = [nanoseconds(m.header.stamp) for m in read(folder, "gap")]
    assert times[gap].tolist() == starts
    names = fixed(recording, "/mic/label/probabilities", "SeriesLines:names")
    assert names == list(load_model(model_file).classes)


def test_the_lane_of_labels_has_the_label_of_every_frame_and_is_empty_in_gaps(recording, folder):
    changes = lane(recording, "/mic/label")
    times = np.array([time for time, _ in changes])
    labels = read(folder, "label")
    stamps = np.array([nanoseconds(m.header.stamp) for m in labels])
    for part in (0, FRAME_NANOSECONDS - 1):
        places = np.searchsorted(times, stamps + part, side="right") - 1
        assert [changes[i][1] for i in places] == [m.label for m in labels]
    empty = [i for i, (_, text) in enumerate(changes) if text is None]
    assert [changes[i][0] for i in empty] == [
        *(nanoseconds(m.header.stamp) for m in read(folder, "gap")),
        stamps[-1] + FRAME_NANOSECONDS,
    ]
    assert len(changes) < len(labels) / 5


@pytest.mark.parametrize(("kind", "text"), [("segment", "label"), ("gap", "reason")])
def test_the_lanes_of_segments_and_gaps_begin_and_end_with_them(recording, folder, kind, text):
    spans = [
        (start := nanoseconds(m.header.stamp), start + nanoseconds(m.duration), getattr(m, text))
        for m in read(folder, kind)
    ]
    expected = [(start, name) for start, _, name in spans]
    starts = {start for start, _, _ in spans}
    expected += [(end, None) for _, end, _ in spans if end not in starts]
    assert lane(recording, f"/mic/{kind}") == sorted(expected, key=lambda change: change[0])


def test_the_level_is_the_energy_in_decibel(recording, folder):
    _, stamps, values = features(folder)
    times, cells = column(recording, "/mic/features/level", "Scalars:scalars")
    levels = np.array(cells)[:, 0]
    heard = ~np.isnan(levels)
    np.testing.assert_array_equal(times[heard], stamps)
    expected = 10 * np.log10(np.maximum(values[:, 0], 1e-10))
    np.testing.assert_allclose(levels[heard], expected, atol=1e-4)
    assert (~heard).sum() == len(LOST)


def test_the_heat_map_is_brighter_where_a_feature_is_higher(recording, folder):
    _, stamps, values = features(folder)
    times, cells = column(recording, "/mic/features/heat_map", "SeriesPoints:colors")
    assert 1500 < len(times) < 2100
    colours = np.array(cells, np.uint32)
    light = sum((colours >> shift & 255).astype(int) for shift in (8, 16, 24))
    edges = np.searchsorted(stamps, times)
    assert np.array_equal(stamps[edges], times)
    sizes = np.diff(edges, append=len(stamps))
    means = np.add.reduceat(values.astype(float), edges) / sizes[:, np.newaxis]
    for feature in (1, 3, 8, 12):
        order = np.argsort(means[:, feature], kind="stable")
        assert (np.diff(light[order, feature]) >= -2).all()
        assert np.ptp(light[:, feature]) > 600
    names = fixed(recording, "/mic/features/heat_map", "SeriesPoints:names")
    assert names == read(folder, "info")[0].feature_names


def test_the_layout_shows_every_entity_and_begins_with_the_whole_time(recording, folder):
    (layout,) = RrdReader(recording).blueprints()
    tables = [
        (str(chunk.entity_path), chunk.to_record_batch().to_pylist()[0])
        for chunk in RrdReader(recording).stream(store=layout)
    ]
    origins = [
        row["ViewBlueprint:space_origin"]
        for _, row in tables
        if "ViewBlueprint:space_origin" in row
    ]
    queries = [row["ViewContents:query"] for _, row in tables if "ViewContents:query" in row]
    shown = {name for (name,) in origins} | {line for query in queries for line in query}
    assert shown >= CONTENTS
    ((shared,),) = [
        row["TimeAxis:view_range"] for _, row in tables if row.get("TimeAxis:view_range")
    ]
    _, stamps, _ = features(folder)
    assert str(START) in str(shared)
    assert str(stamps[-1] + FRAME_NANOSECONDS) in str(shared)


def test_a_log_without_a_model_shows_its_features(tmp_path, day):
    settings = Settings(output=tmp_path / "logs")
    logs = record(settings, FileSource([day], START), Flag()).logs
    save_timeline(logs, tmp_path / "a.rrd")
    found = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "a.rrd").stream()}
    shown = {name for name in found if not name.startswith("/__")}
    assert shown == {"/mic/features/level", "/mic/features/heat_map"}


def test_logs_of_models_with_other_classes_share_a_lane_and_keep_their_columns(
    tmp_path, folder, day, model_file
):
    data, scenario = blobs(3, 12)
    save_model(train_model(data, scenario, ignore_progress), tmp_path / "other.safetensors")
    settings = Settings(output=tmp_path / "logs", model=tmp_path / "other.safetensors")
    later = record(settings, FileSource([day], START + 3600 * 10**9), Flag()).logs
    earlier = read_tracks(find_logs(folder)).rows[messages.LABEL]["/mic/label"]
    both = read_tracks([*later, *find_logs(folder)]).rows[messages.LABEL]["/mic/label"]
    count = len(earlier.times)
    assert (np.diff(both.times) > 0).all()
    assert both.names == (*scenario.classes, *load_model(model_file).classes)
    np.testing.assert_array_equal(both.values[:count, 3:], earlier.values)
    assert np.isnan(both.values[:count, :3]).all()
    assert np.isnan(both.values[count:, 3:]).all()
    expected = [m.label for path in (folder, *later) for m in read(path, "label")]
    assert [both.names[i] for i in both.labels] == expected


def labels_log(path, names, labels, width=2):
    """A log of labels, 50 ms apart."""
    count = len(labels)
    times = START + np.arange(count) * FRAME_NANOSECONDS
    fields = {
        "header.stamp": times,
        "header.frame_id": "mic",
        "frame": np.arange(count, dtype=np.uint64),
        "label": labels,
        "confidence": np.ones(count, np.float32),
        "novelty": np.ones(count, np.float32),
        "probabilities": np.ones((count, width), np.float32),
    }
    topic = Topic("/mic/label", messages.LABEL, array_names=names)
    writer = LogWriter(path, [topic], {})
    writer.write_columns([Rows("/mic/label", times, fields)])
    return writer.finish()


@pytest.mark.parametrize(
    ("names", "width", "message"),
    [
        ({}, 2, "the channel does not name its values"),
        ({"probabilities": ["speech", "crying"]}, 3, "a value for each of 2 names"),
        ({"probabilities": ["speech", "music"]}, 2, "label 'crying' is none of its classes"),
    ],
)
def test_labels_that_contradict_their_names_are_one_line(tmp_path, names, width, message):
    path = labels_log(tmp_path / "a.mcap", names, ["speech", "crying"], width)
    with pytest.raises(LogError, match=message) as caught:
        read_tracks([path])
    assert str(caught.value).startswith(f"{path}: /mic/label: ")


def test_logs_are_read_in_the_order_of_time_whatever_their_order(folder):
    logs = find_logs(folder)
    there, back = read_tracks(logs), read_tracks(logs[::-1])
    assert there.range == back.range
    for kind, topics in there.rows.items():
        for topic, rows in topics.items():
            for name in ("times", "frames", "values", "labels"):
                np.testing.assert_array_equal(
                    getattr(back.rows[kind][topic], name), getattr(rows, name)
                )
    for kind, topics in there.spans.items():
        for topic, spans in topics.items():
            assert back.spans[kind][topic].starts.tolist() == spans.starts.tolist()
            assert back.spans[kind][topic].texts.tolist() == spans.texts.tolist()


def test_an_existing_file_is_left_alone(tmp_path, folder):
    path = tmp_path / "mine.rrd"
    path.write_text("precious")
    with pytest.raises(DataError, match="exists already"):
        save_timeline(find_logs(folder), path)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_or_read_is_one_line_and_leaves_nothing(tmp_path, folder):
    with pytest.raises(DataError, match=r"must end in \.rrd"):
        save_timeline(find_logs(folder), tmp_path / "a.mcap")
    with pytest.raises(DataError, match="there is no folder"):
        save_timeline(find_logs(folder), tmp_path / "none" / "a.rrd")
    with pytest.raises(DataError, match="nothing to show"):
        save_timeline([], tmp_path / "a.rrd")
    (tmp_path / "b.mcap").write_bytes(b"not a log")
    with pytest.raises(LogError, match="is no MCAP file"):
        save_timeline([tmp_path / "b.mcap"], tmp_path / "a.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"]


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, folder):
    code = (
        "import resource, sys, pathlib\n"
        "from analyzer.errors import DataError\n"
        "from analyzer.timeline import save_timeline\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))\n"
        "try: save_timeline([pathlib.Path(sys.argv[1])], pathlib.Path(sys.argv[2]))\n"
        "except DataError as error: print(error)"
    )
    output = tmp_path / "a.rrd"
    command = [sys.executable, "-c", code, find_logs(folder)[0], output]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{output}: cannot be written (")
    assert done.stdout.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_command_prints_the_file_and_how_to_open_it(tmp_path, folder, capsys):
    output = tmp_path / "a day.rrd"
    review(folder, output)
    assert capsys.readouterr().out.splitlines() == [
        str(output),
        f"open it with: rerun --bind 127.0.0.1 '{output}'",
    ]
    assert output.stat().st_size > 100_000


def test_writing_a_recording_collects_no_usage_statistics(tmp_path, folder):
    code = (
        "import sys, pathlib; from analyzer.timeline import save_timeline; "
        "save_timeline([pathlib.Path(sys.argv[1])], pathlib.Path(sys.argv[2]))"
    )
    home = tmp_path / "home"
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "CI"} | rerun_home(home)
    command = [sys.executable, "-c", code, find_logs(folder)[0], tmp_path / "a.rrd"]
    subprocess.run(command, env=environment, check=True)
    assert (tmp_path / "a.rrd").exists()
    assert list(home.rglob("*")) == []


def test_the_viewer_shows_every_view_without_complaint(viewer, recording):
    picture, state = shown(viewer, recording, views=4)
    assert sorted(view.view_class for view in state.views) == ["StateTimeline", *["TimeSeries"] * 3]
    assert all(view.visible for view in state.views)
    assert [report for view in state.views for report in view.reports] == []
    (loaded,) = state.recordings
    assert loaded.current_timeline == "time"
    assert [(t.name, t.time_type) for t in loaded.timelines] == [("time", "timestamp")]
    assert picture.startswith(b"\x89PNG")
