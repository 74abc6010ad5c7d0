"""What a timeline reads of logs, and what a Rerun recording of it holds."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from datetime import UTC, date, datetime
from itertools import pairwise
from threading import Event as Flag
from zoneinfo import ZoneInfo

import numpy as np
import pytest
import rerun as rr
from blobs import blobs
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import run, write_log
from logs import features, read
from lossy_source import LossySource
from rerun.chunk import RrdReader
from viewers import rerun_home, shown, viewer

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.marks.marks import Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.review import timeline_reader as reading
from hearthlog.analyzer.review.lanes import (
    FEATURES,
    FLOOR,
    LEVEL,
    NOVELTY,
    PROBABILITIES,
    class_precision,
    differing_spans,
    reviewed_lane,
    timeline_lanes,
    timeline_plots,
    worded,
)
from hearthlog.analyzer.review.timeline import (
    GridMeans,
    LabelledSpans,
    LabellingTimeline,
    LogLines,
    MicrophoneTimeline,
    Timeline,
    TimelineGrid,
    home_clock,
    no_spans,
)
from hearthlog.analyzer.review.timeline_reader import MOST_SHARES, read_timeline
from hearthlog.analyzer.review.viewer.canvas import ROWS_HEIGHT, Canvas
from hearthlog.analyzer.review.viewer.drawing import LANES_HEIGHT, DrawnLane
from hearthlog.analyzer.review.viewer.recording import save_timeline
from hearthlog.analyzer.training.train import train_model
from hearthlog.models.classes import colour, in_words, ordered
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import LogError, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import audio_path, find_logs
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import header, message, nanoseconds
from hearthlog.schemas.messages.topics import Topic

__all__ = ["viewer"]  # a fixture

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
START = 1_772_348_370_123_456_789
LOST = {5: 7, 9: 400}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, model_file, day):
    """Logs of one recording with gaps, and a mark that reaches from one log into the next."""
    folder = tmp_path_factory.mktemp("logs")
    settings = Settings(output=folder, model=model_file, max_bag_duration=60)
    recording = record(settings, LossySource(FileSource([day], START), LOST), Flag())
    assert len(recording.logs) > 2
    edge = int(features(recording.logs[1])[1][0])
    write_marks(recording.logs[0], [Mark("mic", edge - SECOND, edge, "yelling", "Ann", 5, "live")])
    write_marks(recording.logs[1], [Mark("mic", edge, edge + SECOND, "my_own", "Ann", 6, "live")])
    return folder


@pytest.fixture(scope="module")
def timeline(folder):
    return read_timeline([folder])


@pytest.fixture(scope="module")
def recording(timeline, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "day.rrd"
    save_timeline(timeline, path)
    return path


def stamps_of(found):
    return np.array([nanoseconds(m.header.stamp) for m in found])


def spans_of(folder, kind, text):
    return [
        (start := nanoseconds(m.header.stamp), start + nanoseconds(m.duration), getattr(m, text))
        for m in read(folder, kind)
        if not kind.endswith("review")
    ]


def as_list(spans):
    return list(zip(spans.starts.tolist(), spans.ends.tolist(), spans.texts, strict=True))


def plot(timeline, kind, labelling=""):
    return timeline.microphones["mic"].plots[kind, labelling]


def line(timeline, kind, labelling=""):
    """The only column of a plot."""
    return plot(timeline, kind, labelling).values[:, 0]


def frames_of(timeline, kind, labelling=""):
    """Times and values of single frames."""
    parts = timeline.microphones["mic"].frames[kind, labelling]
    return (np.concatenate([getattr(part, name) for part in parts]) for name in ("times", "values"))


def slow_means(grid, times, values):
    """Means share by share; NaN where there is nothing."""
    parts = [values[(times >= a) & (times < b)] for a, b in pairwise(grid.edges.tolist())]
    nothing = np.full(values.shape[1], np.nan)
    return np.array([part.astype(float).mean(axis=0) if len(part) else nothing for part in parts])


# What is read


def test_the_timeline_begins_with_the_first_frame_and_ends_with_the_last(timeline, folder):
    _, stamps, _ = features(folder)
    assert timeline.grid.start == stamps[0]
    assert 1 <= (timeline.grid.end - stamps[-1]) / FRAME_NANOSECONDS <= 2
    assert 1000 < timeline.grid.count <= MOST_SHARES
    assert timeline.losses == []
    assert timeline.every == 1
    assert list(timeline.microphones) == ["mic"]


def test_features_and_level_are_means_of_what_is_logged_and_nothing_in_gaps(timeline, folder):
    _, stamps, values = features(folder)
    expected = slow_means(timeline.grid, stamps, values)
    features_ = plot(timeline, FEATURES)
    assert features_.names == tuple(read(folder, "info")[0].feature_names)
    np.testing.assert_allclose(features_.values, expected, rtol=1e-12)
    level = 10 * np.log10(np.maximum(expected[:, 0], 1e-10))
    found = line(timeline, LEVEL)
    np.testing.assert_allclose(found, level, rtol=1e-12)
    (lost,) = [span for span in spans_of(folder, "gap", "reason") if span[1] - span[0] > SECOND]
    edges = timeline.grid.edges
    inside = (edges[:-1] > lost[0]) & (edges[1:] < lost[1])
    assert inside.sum() > 100
    assert np.isnan(found[inside]).all()
    assert np.isnan(found).mean() < inside.mean() + 0.05


def test_probabilities_and_novelty_are_means_of_what_is_logged(timeline, folder, model_file):
    labels = read(folder, "label")
    assert timeline.microphones["mic"].labellings[0].name == "live"
    shares = plot(timeline, PROBABILITIES, "live")
    assert shares.names == load_model(model_file).classes
    values = np.array([m.probabilities for m in labels])
    expected = slow_means(timeline.grid, stamps_of(labels), values)
    np.testing.assert_allclose(shares.values, expected, rtol=1e-9)
    novelty = np.array([[m.novelty] for m in labels])
    expected = slow_means(timeline.grid, stamps_of(labels), novelty)
    np.testing.assert_allclose(line(timeline, NOVELTY, "live"), expected[:, 0], rtol=1e-6)


def test_every_frame_is_there_for_zooming_in(timeline, folder):
    labels = read(folder, "label")
    times, values = frames_of(timeline, PROBABILITIES, "live")
    assert times.tolist() == stamps_of(labels).tolist()
    np.testing.assert_array_equal(values, np.array([m.probabilities for m in labels], np.float32))
    _, stamps, values = features(folder)
    times, levels = frames_of(timeline, LEVEL)
    assert times.tolist() == stamps.tolist()
    expected = 10 * np.log10(np.maximum(values[:, 0], 1e-10))
    np.testing.assert_allclose(levels[:, 0], expected, rtol=1e-5)


def test_segments_gaps_and_marks_are_the_spans_of_the_log(timeline, folder):
    microphone = timeline.microphones["mic"]
    live, review = microphone.labellings
    own = [log for log in find_logs(folder) if ".review." not in log.name]
    segments = [span for log in own for span in spans_of(log, "segment", "label")]
    assert as_list(live.spans) == sorted(segments)
    gaps = [span for log in own for span in spans_of(log, "gap", "reason")]
    assert as_list(microphone.gaps) == gaps
    assert len(gaps) == 2
    edge = timeline.coverage["mic"].starts[1]
    assert as_list(review.spans) == [
        (edge - SECOND, edge, "yelling"),
        (edge, edge + SECOND, "my_own"),
    ]


def test_what_the_recorder_said_in_words_is_there(timeline, folder):
    lines = read(folder, "rosout")
    assert len(lines) > 2
    assert timeline.lines.texts.tolist() == [worded(line.msg) for line in lines]
    assert any(re.match(r"Quiet for [\d.]+ s \(\d+ %\)$", text) for text in timeline.lines.texts)
    assert timeline.lines.levels.tolist() == [line.level for line in lines]
    assert timeline.lines.times.tolist() == [nanoseconds(line.stamp) for line in lines]


def test_what_is_open_when_a_log_is_cut_off_is_labelled_by_its_frames(tmp_path, model_file, day):
    cut = []

    def copy_active():
        active = max((tmp_path / "logs").rglob("*.active"))  # the others get their names
        cut.append(shutil.copy(active, tmp_path / "cut.mcap.active"))

    settings = Settings(output=tmp_path / "logs", model=model_file)
    record(
        settings,
        LossySource(FileSource([day], START), {}, copy_active),
        Flag(),
    )
    live = read_timeline(cut).microphones["mic"].labellings[0]
    written = [
        nanoseconds(m.header.stamp) + nanoseconds(m.duration) for m in read(cut[0], "segment")
    ]
    labels = [m for m in read(cut[0], "label") if nanoseconds(m.header.stamp) >= max(written)]
    assert labels
    assert live.spans.ends[-1] == nanoseconds(labels[-1].header.stamp) + FRAME_NANOSECONDS
    classes = live.classes
    for m in labels:
        stamp = nanoseconds(m.header.stamp)
        (text,) = [t for a, b, t in as_list(live.spans) if a <= stamp < b]
        assert text == classes[int(np.argmax(m.probabilities))]


def test_a_span_of_time_is_cut_out_to_the_nanosecond(folder, timeline):
    start, end = START + 41_234_567_891, START + 95_000_000_003
    part = read_timeline([folder], start, end)
    assert (part.grid.start, part.grid.end) == (start, end)
    complete, cut = (t.microphones["mic"].labellings[0].spans for t in (timeline, part))
    expected = [
        (max(a, start), min(b, end), t) for a, b, t in as_list(complete) if a < end and b > start
    ]
    assert as_list(cut) == expected
    stamps = stamps_of(read(folder, "label"))
    times, _ = frames_of(part, PROBABILITIES, "live")
    assert times.tolist() == stamps[(stamps >= start) & (stamps < end)].tolist()
    lines = timeline.lines
    inside = (lines.times >= start) & (lines.times < end)
    assert part.lines.texts.tolist() == lines.texts[inside].tolist()


def test_a_span_that_ends_with_a_log_has_labels_to_its_end(tmp_path, day, model_file):
    settings, hour = Settings(output=tmp_path, model=model_file), -(-START // HOUR) * HOUR
    logs = record(settings, FileSource([day], START), Flag()).logs
    timeline = read_timeline(logs, end=hour)
    times, _ = frames_of(timeline, PROBABILITIES, "live")
    assert hour - FRAME_NANOSECONDS <= times.max() < hour
    assert list(timeline.coverage["mic"].logs) == logs[:1]


def test_a_span_in_which_there_is_nothing_is_one_line(folder):
    with pytest.raises(DataError, match="in this span of time; `hearthlog info` shows what"):
        read_timeline([folder], START + HOUR, START + 2 * HOUR)


def test_logs_are_read_in_the_order_of_time_whatever_their_order(folder, timeline):
    back = read_timeline(find_logs(folder)[::-1])
    assert (back.grid, back.coverage) == (timeline.grid, timeline.coverage)
    np.testing.assert_array_equal(plot(back, FEATURES).values, plot(timeline, FEATURES).values)
    one, other = back.microphones["mic"], timeline.microphones["mic"]
    for a, b in zip(one.labellings, other.labellings, strict=True):
        assert (a.name, as_list(a.spans)) == (b.name, as_list(b.spans))


def test_a_log_named_by_itself_comes_with_its_layers_and_no_others(folder):
    first, second, *_ = [log for log in find_logs(folder) if ".review." not in log.name]
    texts = [
        read_timeline([log]).microphones["mic"].labellings[-1].spans.texts
        for log in (first, second)
    ]
    assert [list(each) for each in texts] == [["yelling"], ["my_own"]]


def test_a_log_without_a_model_shows_its_features(tmp_path, day):
    logs = record(Settings(output=tmp_path), FileSource([day], START), Flag()).logs
    timeline = read_timeline(logs)
    assert timeline.microphones["mic"].labellings == []
    assert np.isfinite(line(timeline, LEVEL)).all()


def test_a_log_without_features_shows_its_labels(tmp_path):
    path = labels_log(tmp_path / "a.mcap", 1000)
    found = read_timeline([path]).microphones["mic"]
    assert [kind for kind, _ in found.plots] == [PROBABILITIES]
    assert as_list(found.labellings[0].spans) == [
        (START, START + 1000 * FRAME_NANOSECONDS, "speech")
    ]


def test_logs_of_models_with_other_classes_share_a_lane_and_keep_their_columns(
    tmp_path, folder, timeline, day, model_file
):
    data, scenario = blobs(3, 12)
    save_model(train_model(data, scenario, ignore_progress), tmp_path / "other.safetensors")
    settings = Settings(output=tmp_path / "logs", model=tmp_path / "other.safetensors")
    later = record(settings, FileSource([day], START + HOUR), Flag()).logs
    joint = read_timeline([*later, folder])
    classes = (*load_model(model_file).classes, *scenario.classes)
    assert plot(joint, PROBABILITIES, "live").names == classes
    values = plot(joint, PROBABILITIES, "live").values
    early = np.flatnonzero(~np.isnan(values[:, 0]))
    late = np.flatnonzero(~np.isnan(values[:, -1]))
    assert early.max() < late.min()
    assert np.isnan(values[early][:, -3:]).all()
    assert np.isnan(values[late][:, :-3]).all()
    expected = [span for log in (folder, *later) for span in spans_of(log, "segment", "label")]
    found = as_list(joint.microphones["mic"].labellings[0].spans)
    own = as_list(timeline.microphones["mic"].labellings[0].spans)
    assert found[: len(own)] == own
    assert Counter(found) >= Counter(span for span in expected if span[2] in scenario.classes)


def test_layers_are_labellings_of_their_own(tmp_path, folder, hearthlog, model_file):
    logs = shutil.copytree(folder, tmp_path / "logs")
    done = hearthlog("relabel", logs, "--model", model_file)
    assert done.returncode == 0, done.stderr
    found = read_timeline([logs]).microphones["mic"].labellings
    assert [one.name for one in found] == ["live", "relabel/simulated", "review"]
    assert read_timeline([logs]).losses == []
    layer = next(logs.rglob("*.relabel-*"))
    for size, words in ((0.99, "read up to the last whole chunk"), (0.1, "nothing of it is whole")):
        os.truncate(layer, int(layer.stat().st_size * size))
        (loss,) = read_timeline([logs]).losses
        assert loss.startswith(f"{layer}: unfinished, ")
        assert words in loss


TWO = {"probabilities": ["speech", "crying"]}


def labels_log(path, count, names=TWO, width=2, **about):
    """A log of labels, 50 ms apart, whose first class is the most probable."""
    times = START + np.arange(count) * FRAME_NANOSECONDS
    probabilities = np.tile(np.linspace(0.9, 0.1, width, dtype=np.float32), (count, 1))
    fields = {
        "header.stamp": times,
        "header.frame_id": "mic",
        "frame": np.arange(count, dtype=np.uint64),
        "label": ["speech"] * count,
        "confidence": np.ones(count, np.float32),
        "novelty": np.full(count, np.nan, np.float32),
        "probabilities": probabilities,
    }
    topic = Topic("/mic/label", message_types.LABEL, array_names=names)
    writer = LogWriter(path, [topic], about)
    writer.write_columns([TopicBatch("/mic/label", times, fields)])
    return writer.finish()


def test_a_model_without_novelty_has_none(tmp_path):
    path = labels_log(tmp_path / "a.mcap", 10)
    assert (NOVELTY, "live") not in read_timeline([path]).microphones["mic"].plots


@pytest.mark.parametrize(
    ("names", "width", "text"),
    [
        ({}, 2, "the channel does not name its values"),
        ({"probabilities": ["speech", "crying"]}, 3, "a value for each of 2 names"),
        ({"probabilities": ["speech", "speech"]}, 2, "not all different"),
        ({"probabilities": [f"class_{i}" for i in range(257)]}, 257, "257 names, more than 256"),
    ],
)
def test_labels_that_contradict_their_names_are_a_loss_of_one_line(tmp_path, names, width, text):
    path = labels_log(tmp_path / "a.mcap", 20, names, width)
    with pytest.raises(DataError, match=text) as caught:
        read_timeline([path])
    assert f"{path}: /mic/label: " in str(caught.value)


def test_names_of_classes_that_are_markup_or_paths_are_only_names(tmp_path):
    hostile = ["../../etc/passwd", "<script>alert(1)</script>\n\x1b[31m", "$origin/**"]
    path = labels_log(tmp_path / "a.mcap", 2000, {"probabilities": hostile}, 3)
    timeline = read_timeline([path])
    save_timeline(timeline, tmp_path / "a.rrd")
    strip = "/mic/lanes/live/00/1/000000"
    assert {*fixed(tmp_path / "a.rrd", strip, "SeriesLines:names")} == {in_words(hostile[0])}
    assert "/mic/live/shares" in entities(tmp_path / "a.rrd")


def test_a_damaged_log_is_a_loss_and_the_others_are_shown(tmp_path, folder):
    logs = shutil.copytree(folder, tmp_path / "logs")
    own = [log for log in find_logs(logs) if ".review." not in log.name]
    content = bytearray(own[1].read_bytes())
    content[len(content) // 3 : len(content) // 3 + 4000] = bytes(4000)
    own[1].write_bytes(content)
    (logs / "empty.mcap").write_bytes(b"not a log")
    timeline = read_timeline([logs])
    assert len(timeline.losses) == 2
    assert any(str(own[1]) in loss for loss in timeline.losses)
    assert any("empty.mcap: is not an MCAP file" in loss for loss in timeline.losses)
    _, stamps, _ = features(own[2])
    recorded = ~np.isnan(line(timeline, LEVEL))
    assert recorded[timeline.grid.find(stamps)].all()


def test_a_damaged_review_layer_is_a_loss_and_its_log_is_shown(tmp_path, folder, timeline):
    logs = shutil.copytree(folder, tmp_path / "logs")
    layer = next(log for log in find_logs(logs) if ".review." in log.name)
    layer.write_bytes(layer.read_bytes()[:-300])
    found = read_timeline([logs])
    assert len(found.losses) == 1
    assert str(layer) in found.losses[0]
    np.testing.assert_array_equal(line(found, LEVEL), line(timeline, LEVEL))


def test_of_logs_that_are_too_large_a_sample_is_read_and_said(folder, timeline, monkeypatch):
    size = sum(log.stat().st_size for log in find_logs(folder))
    monkeypatch.setattr(reading, "_COMPLETE_BYTES", size // 3)
    sample = read_timeline([folder])
    assert sample.every > 1
    assert not sample.microphones["mic"].frames
    one, other = line(sample, LEVEL), line(timeline, LEVEL)
    read_ = ~np.isnan(one)
    assert 0.1 < read_.mean() < 0.9
    far = np.abs(one[read_] - other[read_])
    assert np.median(far) < 1e-9


def test_the_floor_is_drawn_beside_the_level_as_the_diagnostics_tell_it(timeline, folder):
    expected, reported = np.full(timeline.grid.count, np.nan), 0
    for one in read(folder, "diagnostics"):
        for pair in one.status[0].values:
            if pair.key == "floor_dbfs":
                expected[timeline.grid.middles >= nanoseconds(one.header.stamp)] = float(pair.value)
                reported += 1
    assert reported > 5
    level, floor = line(timeline, LEVEL), line(timeline, FLOOR)
    expected[np.isnan(level)] = np.nan
    np.testing.assert_array_equal(floor, expected)
    assert np.nanmax(floor) < np.nanmax(level)
    kinds = {plot.kind.name: plot.kind.title for plot in timeline_plots(timeline)}
    assert kinds["floor"] == kinds["level"]  # one view


def health(stamp, *levels):
    status = [
        message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name="hearthlog: mic",
            message=f"level {level}",
            hardware_id="mic",
            values=[],
        )
        for level in levels
    ]
    return stamp, message(message_types.DIAGNOSTICS, header=header(stamp, "mic"), status=status)


def test_a_trouble_lasts_until_it_is_over_or_another_one_begins(tmp_path):
    labels = labels_log(tmp_path / "a.mcap", 2000)
    printed = [(0, ()), (1, (1,)), (11, (1,)), (21, (2, 0, 1)), (31, (0,)), (41, (1,))]
    rows = [health(START + second * SECOND, *levels) for second, levels in printed]
    write_log(tmp_path / "b.mcap", {"/diagnostics": rows})
    timeline = read_timeline([labels, tmp_path / "b.mcap"])
    assert as_list(timeline.microphones["mic"].troubles) == [
        (START + 1 * SECOND, START + 21 * SECOND, "level 1"),
        (START + 21 * SECOND, START + 31 * SECOND, "level 2; level 1"),
        (START + 41 * SECOND, timeline.grid.end, "level 1"),
    ]


def sound(start, samples, rate=16_000):
    data = (np.asarray(samples) * 32768).astype("<i2").tobytes()
    return start, message(
        "foxglove_msgs/msg/RawAudio",
        timestamp=header(start, "").stamp,
        data=np.frombuffer(data, np.uint8),
        format="pcm-s16",
        sample_rate=rate,
        number_of_channels=1,
    )


def test_kept_sound_is_chained_to_clips_that_are_heard_where_they_were(tmp_path):
    labels = labels_log(tmp_path / "a.mcap", 400)
    rng = np.random.default_rng(1)
    samples = rng.integers(-9000, 9000, 32_000) / 32768
    times = [START + k * SECOND for k in (2, 3, 9)]
    parts = samples[:16_000], samples[16_000:24_000], samples[24_000:]
    rows = [sound(time, part) for time, part in zip(times, parts, strict=True)]
    write_log(audio_path(labels), {"/mic/audio": rows})
    one, two = read_timeline([labels]).microphones["mic"].clips
    assert (one.start, one.end) == (times[0], times[1] + SECOND // 2)
    assert (two.start, two.rate) == (times[2], 16_000)
    np.testing.assert_array_equal(one.samples, samples[:24_000] * 32768)
    np.testing.assert_array_equal(two.samples, samples[24_000:] * 32768)


def test_of_more_sound_than_can_be_shown_the_first_is_shown_and_the_rest_a_loss(
    tmp_path, monkeypatch
):
    labels = labels_log(tmp_path / "a.mcap", 2000)
    write_log(
        audio_path(labels),
        {"/mic/audio": [sound(START + k * 10 * SECOND, np.zeros(16_000)) for k in range(5)]},
    )
    monkeypatch.setattr(reading, "MOST_CLIP_SECONDS", 3)
    timeline = read_timeline([labels])
    assert len(timeline.microphones["mic"].clips) == 3
    assert "is not shown; name a shorter span" in timeline.losses[0]


def test_the_time_zone_is_that_of_the_logs_unless_another_one_is_said(tmp_path):
    path = labels_log(tmp_path / "a.mcap", 10, timezone="Asia/Kolkata")
    assert read_timeline([path]).zone == "Asia/Kolkata"
    assert read_timeline([path], zone="Europe/Vienna").zone == "Europe/Vienna"
    with pytest.raises(DataError, match="'Nowhere' is no time zone"):
        read_timeline([path], zone="Nowhere")


# Shares of a grid, against what a loop would do


@st.composite
def grids(draw):
    start = draw(st.integers(0, 2**61))
    count = draw(st.integers(1, 50))
    return TimelineGrid(start, start + draw(st.integers(count, 40 * 86_400 * SECOND)), count)


@given(grids(), st.data())
def test_a_time_lies_in_the_share_whose_edges_are_around_it(grid, data):
    times = np.array(data.draw(st.lists(st.integers(grid.start, grid.end - 1), min_size=1)))
    found = grid.find(times)
    edges = grid.edges
    assert (edges[0], edges[-1]) == (grid.start, grid.end)
    assert (np.diff(edges) > 0).all()
    slack = 2 + (grid.end - grid.start) // 2**51  # ns, of arithmetic in floating point
    assert (times >= edges[found] - slack).all()
    assert (times <= edges[found + 1] + slack).all()


@given(grids(), st.data())
def test_means_are_those_of_the_rows_in_each_share_however_they_come(grid, data):
    times = np.sort(
        np.array(data.draw(st.lists(st.integers(grid.start, grid.end - 1), min_size=1)))
    )
    finite = st.floats(-1e6, 1e6, width=32)
    rows = data.draw(st.lists(finite, min_size=2 * len(times), max_size=2 * len(times)))
    values = np.array(rows, np.float32).reshape(-1, 2)
    cut = data.draw(st.integers(0, len(times)))
    means = GridMeans(grid, 2)
    for part in (slice(0, cut), slice(cut, None)):
        if len(times[part]):
            means.add(times[part], values[part])
    share = grid.find(times)
    for i in range(grid.count):
        own = values[share == i].astype(float)
        expected = own.mean(axis=0) if len(own) else [np.nan, np.nan]
        np.testing.assert_allclose(means.values[i], expected, rtol=1e-9, atol=1e-6)


@st.composite
def labelled(draw, grid, names="abc"):
    """Spans in the order of time that do not overlap, some beyond the grid."""
    margin = (grid.end - grid.start) // 5 + 1
    edge = st.integers(max(grid.start - margin, 0), grid.end + margin)
    edges = sorted(draw(st.sets(edge, max_size=16)))
    pairs = [pair for pair in pairwise(edges) if draw(st.booleans())]
    texts = [draw(st.sampled_from(names)) for _ in pairs]
    columns = (np.array([pair[i] for pair in pairs], np.int64) for i in (0, 1))
    return LabelledSpans(*columns, np.array(texts, object))


# Lanes


@given(grids(), st.data())
def test_labellings_differ_where_both_say_something_else(grid, data):
    one, other = data.draw(labelled(grid)), data.draw(labelled(grid))
    found = as_list(differing_spans(one, other))
    edges = sorted(
        {t for spans in (one, other) for t in (*spans.starts.tolist(), *spans.ends.tolist())}
    )
    for time in edges:
        printed = [[t for a, b, t in as_list(spans) if a <= time < b] for spans in (one, other)]
        expected = [b for a, b in zip(*printed, strict=False) if a != b]
        assert [text for a, b, text in found if a <= time < b] == expected
    assert all(a < b for a, b, _ in found)
    assert all(a[1] <= b[0] for a, b in pairwise(found))


def test_two_names_of_one_sound_are_no_difference():
    times = np.array([0, 10, 20, 30])
    one = LabelledSpans(times[:-1], times[1:], np.array(["crying", "speech", "music"], object))
    other = LabelledSpans(
        times[:-1], times[1:], np.array(["crying_sobbing", "shout", "music"], object)
    )
    assert as_list(differing_spans(one, other)) == [(10, 20, "shout")]


def spans_at(*rows):
    """Spans of (start, end, text), in seconds."""
    starts, ends, texts = zip(*rows, strict=True)
    times = (np.array(column) * SECOND for column in (starts, ends))
    return LabelledSpans(*times, np.array(texts, object))


def lanes_of(*labellings, **more):
    """The lanes of a microphone, as (labelling, name, spans)."""
    nothing = dict.fromkeys(("reviewed", "gaps", "troubles"), no_spans())
    empty = {"plots": {}, "frames": {}, "clips": []}
    microphone = MicrophoneTimeline("mic", list(labellings), **(nothing | empty | more))
    lines = LogLines(*(np.empty(0, kind) for kind in (np.int64, np.int64, object)))
    timeline = Timeline(TimelineGrid(0, 100 * SECOND, 10), {"mic": microphone}, lines, "UTC", {})
    return [(lane.labelling, lane.name, as_list(lane.spans)) for lane in timeline_lanes(timeline)]


def test_lanes_have_one_order_whatever_was_heard():
    spans = spans_at(
        (0, 30, "speech"), (30, 31, "coughing"), (31, 90, "silence"), (90, 95, "music")
    )
    classes = ("silence", "speech", "shower", "music", "coughing")
    found = lanes_of(LabellingTimeline("live", spans, classes))
    assert [name for _, name, _ in found] == ["Coughing", "Talking", "Music", "Shower", "Reviewed"]
    assert found[0][2] == [(30 * SECOND, 31 * SECOND, "Coughing")]
    assert found[3][2] == []


def test_two_spellings_of_a_class_share_a_lane():
    spans = spans_at((0, 1, "crying"), (2, 3, "crying_sobbing"), (4, 5, "my_own"))
    found = lanes_of(LabellingTimeline("live", spans))
    assert [(name, len(rows)) for _, name, rows in found[:2]] == [("Crying", 2), ("My own", 1)]


def test_a_candidate_has_lanes_of_its_own_and_one_for_where_it_differs():
    live = LabellingTimeline("live", spans_at((0, 10, "speech"), (10, 20, "music")))
    other = LabellingTimeline("candidate", spans_at((0, 10, "speech"), (10, 20, "crying")))
    found = lanes_of(live, other)
    assert ("candidate", "Crying", [(10 * SECOND, 20 * SECOND, "Crying")]) in found
    assert ("candidate", "Music", []) in found
    assert ("", "candidate differs", [(10 * SECOND, 20 * SECOND, "Crying")]) in found
    assert [name for mine, name, _ in found if mine == "live"] == ["Crying", "Talking", "Music"]


def test_marks_lie_in_the_lane_of_what_is_reviewed():
    marks = LabellingTimeline("review", spans_at((5, 6, "yelling")))
    found = lanes_of(marks, reviewed=spans_at((0, 60, "random")))
    rows = [(0, 60 * SECOND, "Reviewed"), (5 * SECOND, 6 * SECOND, "Shouting")]
    assert found == [("", "Reviewed", rows)]


def test_what_was_not_heard_has_a_lane_while_the_recorder_is_off_too(tmp_path, model_file, day):
    for hour in (7, 9):
        settings = Settings(output=tmp_path, model=model_file)
        start = at(2026, 3, 1, hour, zone="UTC")
        record(settings, LossySource(FileSource([day], start), {}), Flag())
    timeline = read_timeline([tmp_path], *(at(2026, 3, 1, hour, zone="UTC") for hour in (6, 12)))
    ends = timeline.coverage["mic"].ends
    off = [(6, 7), (ends[0], 9), (ends[1], 12)]
    expected = [tuple(t if t > 24 else at(2026, 3, 1, t, zone="UTC") for t in span) for span in off]
    (lane,) = [lane for lane in timeline_lanes(timeline) if lane.name == "Not heard"]
    assert [row[:2] for row in as_list(lane.spans)] == expected


# The clock of the home


def at(*moment, zone):
    return int(datetime(*moment, tzinfo=ZoneInfo(zone)).timestamp()) * SECOND


@pytest.mark.parametrize(
    ("zone", "day", "name"),
    [
        ("UTC", (2026, 3, 1), "clock of the home (UTC)"),
        ("Europe/Vienna", (2026, 3, 1), "clock of the home (UTC+01:00)"),
        ("Europe/Vienna", (2026, 7, 1), "clock of the home (UTC+02:00)"),
        ("Asia/Kolkata", (2026, 3, 29), "clock of the home (UTC+05:30)"),
        ("America/New_York", (2026, 1, 5), "clock of the home (UTC-05:00)"),
        ("Europe/Vienna", (2026, 3, 29), "clock of the home (UTC+02:00 throughout)"),
        ("Europe/Vienna", (2026, 10, 25), "clock of the home (UTC+01:00 throughout)"),
    ],
)
def test_the_axis_shows_the_clock_of_the_home_and_its_name_says_so(zone, day, name):
    start, end = day_span(date(*day), ZoneInfo(zone))
    clock = home_clock(ZoneInfo(zone), start, end)
    assert clock.name == name
    noon = at(*day, 12, zone=zone)
    shown = datetime.fromtimestamp(clock.shown(noon) // SECOND, UTC)
    assert (shown.year, shown.month, shown.day, shown.hour) == (*day, 12)
    assert clock.utc(clock.shown(noon)) == noon


# What is in the recording

AXIS = "clock of the home (UTC)"


def entities(path):
    found = {str(chunk.entity_path) for chunk in RrdReader(path).stream()}
    return {name for name in found if not name.startswith("/__")}


def column(path, entity, name):
    """Times (ns) and cells of one column, in the order of time."""
    times, cells = [], []
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            times += batch.column(AXIS).cast("int64").to_pylist()
            cells += batch.column(name).to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [cells[i] for i in order]


def fixed(path, entity, name):
    """The only cell of a static column."""
    chunks = (c for c in RrdReader(path).stream() if str(c.entity_path) == entity and c.is_static)
    batches = [chunk.to_record_batch() for chunk in chunks]
    ((cell,),) = (b.column(name).to_pylist() for b in batches if name in b.schema.names)
    return cell


def test_everything_is_in_the_recording_and_nothing_else(recording, timeline):
    expected = {"/mic/live/shares", "/mic/live/novelty", "/mic/level", "/mic/floor"}
    expected |= {"/mic/features", "/events", "/mic/frames/live", "/mic/frames/level"}
    lanes = list(timeline_lanes(timeline))
    expected |= {"/words/nothing"}
    expected |= {
        f"/mic/words/names/{lane.labelling or 'all'}/{number:02}"
        for number, lane in enumerate(lanes)
    }
    views = ("How_probable_each_class_is/live", "Level", "Novelty", "Features")
    expected |= {f"/mic/words/{view}" for view in views}
    found = {name for name in entities(recording) if "/lanes/" not in name}
    assert found == expected


def test_every_sound_is_a_strip_in_the_lane_of_its_class_and_in_its_colour(recording, timeline):
    strips = {name for name in entities(recording) if "/lanes/" in name}
    names = list(dict.fromkeys(lane.name for lane in timeline_lanes(timeline)))
    drawn = set()
    for entity in strips:
        _, _, labelling, number, _, _ = entity.strip("/").split("/")
        times, heights = column(recording, entity, "Scalars:scalars")
        (text,) = set(fixed(recording, entity, "SeriesLines:names"))
        (shade,) = set(fixed(recording, entity, "SeriesLines:colors"))
        red, green, blue = shade >> 24, shade >> 16 & 255, shade >> 8 & 255
        height = LANES_HEIGHT / len(names)
        place = (len(names) - int(number) - 0.5) * height
        for lines in heights[2:4]:
            assert np.mean(lines) == pytest.approx(place)
            assert 0.45 * height < np.ptp(lines) < 0.55 * height
        for start, end in zip(times[2::6].tolist(), times[3::6].tolist(), strict=True):
            drawn.add((labelling, names[int(number)], start, end, text, (red, green, blue)))
    expected = {
        (lane.labelling or "all", lane.name, start, end, text, lane.colours[text])
        for lane in timeline_lanes(timeline)
        for start, end, text in as_list(lane.spans)
    }
    assert drawn == expected
    assert {text for _, _, _, _, text, _ in drawn} >= {"Shouting", "My own", "Not heard"}


def test_beside_a_class_of_the_recorder_stands_how_many_of_its_sounds_were_right(
    tmp_path, folder, model_file, capfd
):
    home, output = tmp_path / "home", tmp_path / "day.rrd"
    shutil.copytree(folder, home)
    assert run(capfd, "relabel", home, "--model", model_file).returncode == 0
    (log, *_) = find_logs(home)
    complete = ReviewedSpan("mic", START, START + 600 * SECOND, chosen="random")
    write_marks(log, [], reviewed=[complete])
    assert run(capfd, "review", home, "--save", output).returncode == 0
    names = {}
    for chunk in RrdReader(output).stream():
        if (entity := str(chunk.entity_path)).startswith("/mic/words/names/"):
            names[entity] = chunk.to_record_batch().column("TextDocument:text").to_pylist()[-1][0]
    live = {entity: text for entity, text in names.items() if "/names/live/" in entity}
    reported = {text for text in live.values() if " · " in text}
    checked = class_precision(read_timeline([home]), find_home_logs([home]))
    assert reported == {
        f"{name} · {n.right}/{n.labelled} right" for (_, name), n in checked.items()
    }
    assert len(reported) < len(live)
    others = {text for entity, text in names.items() if entity not in live}
    assert others >= {"Talking", "Reviewed · class colours"}
    assert not any(text.endswith(" right") for text in others)


def test_what_is_not_in_a_lane_any_more_is_hidden_and_what_is_new_is_drawn(tmp_path):
    stream = rr.RecordingStream("test")
    sink = rr.binary_stream(stream)
    canvas = Canvas(stream, home_clock(UTC, 0, HOUR))
    drawn = DrawnLane("mic/lanes/all/00", 0.5, 0.05)
    first, second = (0, 20, "yelling"), (30, 31, "yelling")
    for marks in ((first,), (first, second), (second,)):
        drawn.show(reviewed_lane("mic", "", spans_at(*marks), no_spans()), canvas)
    path = tmp_path / "a.rrd"
    path.write_bytes(sink.read())
    root = "/mic/lanes/all/00/1/"
    assert entities(path) == {f"{root}000000", f"{root}000001"}
    hidden = [
        str(chunk.entity_path)
        for chunk in RrdReader(path).stream()
        if "SeriesLines:visible_series" in chunk.to_record_batch().schema.names
    ]
    assert hidden == [f"{root}000000"]
    assert column(path, f"{root}000001", "Scalars:scalars")[0][1] == 30 * SECOND


def test_texts_of_one_length_are_drawn_in_the_same_order_in_every_process(tmp_path):
    stream = rr.RecordingStream("test")
    sink = rr.binary_stream(stream)
    canvas = Canvas(stream, home_clock(UTC, 0, HOUR))
    names = ["yelling", "speech", "music", "coughing", "crying", "laughing"]
    marks = [(10 * n, 10 * n + 5, name) for n, name in enumerate(names)]
    drawn = DrawnLane("mic/lanes/all/00", 0.5, 0.05)
    drawn.show(reviewed_lane("mic", "", spans_at(*marks), no_spans()), canvas)
    path = tmp_path / "a.rrd"
    path.write_bytes(sink.read())
    roots = sorted(entities(path))
    texts = [fixed(path, root, "SeriesLines:names")[0] for root in roots]
    assert (len(texts), texts) == (6, sorted(texts))


def test_each_class_has_a_row_that_is_as_bright_as_it_was_probable(recording, timeline):
    names, values = (
        getattr(plot(timeline, PROBABILITIES, "live"), name) for name in ("names", "values")
    )
    rows = ordered(names)
    times, cells = column(recording, "/mic/live/shares", "SeriesLines:colors")
    heights = np.array(column(recording, "/mic/live/shares", "Scalars:scalars")[1])
    shades = np.array(cells, np.uint32).reshape(len(times), len(rows), -1)
    assert fixed(recording, "/mic/live/shares", "SeriesLines:names") == [
        in_words(name) for name in rows for _ in range(shades.shape[2])
    ]
    middles = np.nanmean(heights.reshape(shades.shape), axis=(0, 2))
    places = (len(rows) - np.arange(len(rows)) - 0.5) * ROWS_HEIGHT / len(rows)
    np.testing.assert_allclose(middles, places)
    recorded = ~np.isnan(values).any(axis=1)
    found = np.searchsorted(times, timeline.grid.middles[recorded], "right") - 1
    assert not np.isnan(heights[found]).any()
    missing = np.searchsorted(times, timeline.grid.middles[~recorded], "right") - 1
    assert np.isnan(heights[missing[missing >= 0]]).all()
    for number, name in enumerate(rows):
        share = values[recorded, names.index(name)]
        for shift, full in zip((24, 16, 8), colour(name), strict=True):
            # The viewer draws a piece in the colour of its end.
            seen = (shades[found + 1, number, 0] >> shift & 255).astype(float)
            step = abs(full - 13) / 10 / 2 + 1
            np.testing.assert_allclose(seen, 13 + share * (full - 13), atol=step)


def test_single_frames_are_those_of_the_log_and_lines_end_in_a_gap(recording, folder, model_file):
    labels = read(folder, "label")
    times, cells = column(recording, "/mic/frames/live", "Scalars:scalars")
    values = np.array(cells)
    hole = np.isnan(values).any(axis=1)
    stamps = stamps_of(labels)
    assert np.isin(times[~hole], stamps).all()
    for heights, printed in zip(
        values.T, np.array([m.probabilities for m in labels]).T, strict=True
    ):
        drawn = np.interp(stamps, times[~hole], heights[~hole])
        np.testing.assert_allclose(drawn, printed, atol=0.0101)
    after_gaps = stamps_of(labels)[1:][np.diff(stamps_of(labels)) > 2 * FRAME_NANOSECONDS]
    assert len(after_gaps) == 2
    for start in after_gaps:
        assert hole[np.searchsorted(times, start) - 1]
    names = fixed(recording, "/mic/frames/live", "SeriesLines:names")
    assert names == [*map(in_words, load_model(model_file).classes)]


def test_the_frames_of_a_long_time_are_read_when_they_are_needed(folder, timeline, monkeypatch):
    monkeypatch.setattr(reading, "MOST_FRAMES", 60 * SECOND)
    monkeypatch.setattr(reading, "_PART", 50 * SECOND)
    long = read_timeline([folder])
    one, before = (each.microphones["mic"] for each in (long, timeline))
    assert not one.frames
    for found, expected in zip(one.labellings, before.labellings, strict=True):
        assert as_list(found.spans) == as_list(expected.spans)
    parts = [part.microphones["mic"] for part in reading.read_frames(long)]
    assert len(parts) > 3
    frames = [each for part in parts for each in part.frames[PROBABILITIES, "live"]]
    for name in ("times", "values"):
        found = np.concatenate([getattr(each, name) for each in frames])
        expected = [getattr(each, name) for each in before.frames[PROBABILITIES, "live"]]
        expected = np.concatenate(expected)
        np.testing.assert_array_equal(found, expected)


def test_the_heat_map_is_brighter_where_a_feature_is_higher(recording, timeline):
    names, values = (getattr(plot(timeline, FEATURES), name) for name in ("names", "values"))
    times, cells = column(recording, "/mic/features", "SeriesPoints:colors")
    recorded = ~np.isnan(values[:, 0])
    size = -(-recorded.sum() // len(times))  # shares that are one column
    first = np.arange(0, recorded.sum(), size)
    assert 400 < len(first) == len(times)
    means = np.array([part.mean(axis=0) for part in np.split(values[recorded], first[1:])])
    colours = np.array(cells, np.uint32)
    light = sum((colours >> shift & 255).astype(int) for shift in (8, 16, 24))
    for feature in (1, 3, 8, 12):
        order = np.argsort(means[:, feature], kind="stable")
        assert (np.diff(light[order, feature]) >= -2).all()
        assert np.ptp(light[:, feature]) > 600
    assert fixed(recording, "/mic/features", "SeriesPoints:names") == list(names)


def test_the_layout_shows_every_entity_and_begins_with_the_whole_time(recording, timeline):
    (layout,) = RrdReader(recording).blueprints()
    rows = [
        (str(chunk.entity_path), chunk.to_record_batch().to_pylist()[0])
        for chunk in RrdReader(recording).stream(store=layout)
    ]
    origins = [
        r["ViewBlueprint:space_origin"][0] for _, r in rows if "ViewBlueprint:space_origin" in r
    ]
    queries = [q for _, r in rows for q in r.get("ViewContents:query") or [] if q != "$origin/**"]
    shown_ = {each.removesuffix("/**") for each in {*origins, *queries} - {"/"}}
    for entity in entities(recording):
        assert any(entity.lstrip("/").startswith(each.lstrip("/")) for each in shown_), entity
    ((path, row),) = [(p, r) for p, r in rows if r.get("TimeAxis:view_range")]
    assert path == "/view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"
    assert str(timeline.grid.start) in str(row["TimeAxis:view_range"])
    assert str(timeline.grid.end) in str(row["TimeAxis:view_range"])
    links = [r["TimeAxis:link"] for _, r in rows if r.get("TimeAxis:link")]
    assert len(links) >= 5
    assert len({str(link) for link in links}) == 1


# Saving it


def test_an_existing_file_is_left_alone(tmp_path, timeline):
    path = tmp_path / "mine.rrd"
    path.write_text("precious")
    with pytest.raises(DataError, match="exists already"):
        save_timeline(timeline, path)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_or_read_is_one_line_and_leaves_nothing(tmp_path, timeline):
    with pytest.raises(DataError, match=r"must end in \.rrd"):
        save_timeline(timeline, tmp_path / "a.mcap")
    with pytest.raises(DataError, match="there is no folder"):
        save_timeline(timeline, tmp_path / "none" / "a.rrd")
    (tmp_path / "b.mcap").write_bytes(b"not a log")
    with pytest.raises(DataError, match="is not an MCAP file"):
        read_timeline([tmp_path / "b.mcap"])
    with pytest.raises(LogError, match="no such log"):
        read_timeline([tmp_path / "c.mcap"])
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"]


_SAVE = """
import pathlib, resource, sys
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.local_time import day_span
from hearthlog.analyzer.review.lanes import class_precision
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.review.viewer.recording import save_timeline
timeline = read_timeline([pathlib.Path(sys.argv[1])])
if limit := int(sys.argv[3]): resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try: save_timeline(timeline, pathlib.Path(sys.argv[2]))
except DataError as error: print(error)
"""


@pytest.mark.parametrize("share", [0.05, 0.9])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, folder, timeline, share):
    output = tmp_path / "a.rrd"
    save_timeline(timeline, output)
    left = round(share * output.stat().st_size)
    output.unlink()
    command = [sys.executable, "-c", _SAVE, folder, output, str(left)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{output}: cannot be written (")
    assert done.stdout.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_writing_a_recording_collects_no_usage_statistics(tmp_path, folder):
    home = tmp_path / "home"
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if k != "CI"} | rerun_home(home)
    command = [sys.executable, "-c", _SAVE, folder, tmp_path / "a.rrd", "0"]
    subprocess.run(command, env=environment, check=True)
    assert (tmp_path / "a.rrd").exists()
    assert list(home.rglob("*")) == []


def test_the_command_prints_the_file_and_how_to_open_it(tmp_path, folder, capfd):
    output = tmp_path / "a day.rrd"
    done = run(capfd, "review", folder, "--save", output)
    assert done.returncode == 0
    name, how = done.stdout.splitlines()
    assert name == str(output)
    command = shlex.split(how.removeprefix("open it with: "))
    assert (command[:2], command[3], command[5:]) == (["rerun", "--bind"], "--port", [name])
    assert command[2].startswith("127.")
    assert command[2] != "127.0.0.1"  # which every web page would try
    assert output.stat().st_size > 100_000


def test_the_viewer_shows_every_view_without_complaint(viewer, recording):
    picture, state = shown(viewer, recording, views=5)
    shown_ = Counter(view.view_class for view in state.views)
    assert shown_.pop("TextDocument") > 5
    assert shown_ == {"TimeSeries": 7, "TextLog": 1}
    assert [report for view in state.views for report in view.reports] == []
    (loaded,) = state.recordings
    assert loaded.current_timeline == AXIS
    assert [(t.name, t.time_type) for t in loaded.timelines] == [(AXIS, "timestamp")]
    assert picture.startswith(b"\x89PNG")
