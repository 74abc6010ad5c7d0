"""Whence the sound of an array comes: found, logged, checked."""

from dataclasses import fields
from functools import cache
from pathlib import Path
from threading import Event as Flag

import hypothesis
import numpy as np
import pytest
import soundfile
from arrays import SQUARE, array_frames, bursts, plane_wave
from hypothesis import given
from hypothesis import strategies as st
from logs import features, read
from scipy.signal import resample_poly
from test_capture import realtime_offset, recording, wait_for_frames

import hearthlog
from hearthlog.analyzer.doctor import Findings
from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.doctor.frame_sequence import FrameSequence
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.logs.sound_vectors import as_vectors, mean_bearings
from hearthlog.analyzer.review.lanes import DIRECTION, timeline_plots
from hearthlog.analyzer.review.live import LiveTimeline
from hearthlog.analyzer.review.timeline import Plot
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.models.classifiers.evidence import BLOCK_FRAMES
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import MicrophoneSettings, Settings, load_settings
from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.capture import _some_channels
from hearthlog.recorder.stream.directions import (
    ArrayDirections,
    BlockDirections,
    ChannelWatch,
    geometry_of,
)
from hearthlog.schemas.errors import ConfigurationError, LogError, SourceError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.schemas.logs.files import find_logs

START = 1_772_348_370_123_456_789
TRIANGLE = [[0.05, 0.0], [-0.025, 0.043], [-0.025, -0.043]]
PAIR = [[0.0, 0.05], [0.0, -0.05]]  # left, right


def finder(places):
    return BlockDirections(geometry_of(places))


def degrees_between(azimuths, azimuth):
    return np.abs(np.rad2deg(np.angle(np.exp(1j * (azimuths - azimuth)))))


@pytest.mark.parametrize("places", [SQUARE, TRIANGLE, [[*p, 0.1] for p in TRIANGLE]])
@pytest.mark.parametrize("degrees", [-179, -100, -1, 40, 91, 178])
def test_a_sound_is_located_on_every_side(places, degrees):
    azimuths = finder(places)(array_frames(places, np.deg2rad(degrees)), 0).azimuths
    assert len(azimuths) >= 5
    assert np.median(degrees_between(azimuths, np.deg2rad(degrees))) < 1.5


@pytest.mark.parametrize("degrees", [-80, 0, 33, 75])
def test_a_pair_that_is_named_from_left_to_right_tells_the_half_circle_before_it(degrees):
    azimuths = finder(PAIR)(array_frames(PAIR, np.deg2rad(degrees)), 0).azimuths
    assert np.median(degrees_between(azimuths, np.deg2rad(degrees))) < 3


def test_a_pair_takes_what_is_behind_it_for_its_mirror_image():
    azimuths = finder(PAIR)(array_frames(PAIR, np.deg2rad(180 - 40)), 0).azimuths
    assert np.median(degrees_between(azimuths, np.deg2rad(40))) < 3


def test_what_sounds_all_the_time_is_the_room_and_has_no_direction():
    fan = np.random.default_rng(5).normal(0, 0.1, 20 * SAMPLE_RATE)
    frames = plane_wave(SQUARE, 1.0, fan).astype(np.float32).reshape(-1, FRAME_SAMPLES, 4)
    frames += np.random.default_rng(6).normal(0, 1e-3, frames.shape).astype(np.float32)
    assert len(finder(SQUARE)(frames, 0).places) == 0


def test_a_fan_that_is_switched_on_becomes_the_room():
    rng = np.random.default_rng(5)
    fan = rng.normal(0, 0.1, 90 * SAMPLE_RATE) * (np.arange(90 * SAMPLE_RATE) > 10 * SAMPLE_RATE)
    frames = plane_wave(SQUARE, 1.0, fan).astype(np.float32).reshape(-1, FRAME_SAMPLES, 4)
    frames += rng.normal(0, 1e-3, frames.shape).astype(np.float32)
    places = finder(SQUARE)(frames, 0).places
    assert len(places)
    assert places.max() < 80 * 20


def test_noise_of_each_microphone_alone_has_no_direction():
    alone = np.random.default_rng(7).normal(0, 0.01, (400, FRAME_SAMPLES, 4))
    alone[100:] *= np.repeat(np.tile([1.0, 10.0], 15), 10)[:, np.newaxis, np.newaxis]
    assert len(finder(SQUARE)(alone.astype(np.float32), 0).places) == 0


def test_the_louder_of_two_sounds_is_located():
    frames = array_frames(SQUARE, 0.5) + 0.3 * array_frames(SQUARE, 2.5, seed=9)
    assert np.median(degrees_between(finder(SQUARE)(frames, 0).azimuths, 0.5)) < 5


@pytest.mark.parametrize(("snr", "most"), [(20, 5), (5, 15)])
def test_sounds_in_a_room_with_an_echo_of_a_third_of_a_second_are_located(snr, most):
    room = pytest.importorskip("hearthlog.tools.lab.direction_room", reason="not in the wheel")
    rng = np.random.default_rng(1)
    clips = [bursts(3, seed)[SAMPLE_RATE:] for seed in range(3)]
    scene = room.room_scene(clips, np.array(SQUARE), 0.3, rng)
    recorded_so = room.add_noise(scene, room.room_noise(scene, rng), snr)
    frames = recorded_so[: len(recorded_so) // FRAME_SAMPLES * FRAME_SAMPLES]
    directions = finder(SQUARE)(frames.reshape(-1, FRAME_SAMPLES, 4), 0)
    seconds = directions.places / 20
    errors = [
        degrees_between(directions.azimuths[(seconds >= start) & (seconds < end)], azimuth)
        for start, end, azimuth in scene.sounds
    ]
    assert all(map(len, errors))
    assert np.median(np.concatenate(errors)) <= most


@cache
def a_scene():
    return np.concatenate([array_frames(SQUARE, 0.5), array_frames(SQUARE, -2.0, seed=4)])


@given(st.integers(0, 9), st.lists(st.integers(1, 25), max_size=8))
@hypothesis.settings(max_examples=30, deadline=None)
def test_frames_in_pieces_of_any_size_give_the_same_bits(first, sizes):
    frames = a_scene()[:90]
    full = finder(SQUARE)(frames, first)
    one, at, parts = finder(SQUARE), 0, []
    for size in [*sizes, len(frames)]:
        part = one(frames[at : at + size], first + at)
        parts.append(part._replace(places=part.places + at))
        at += size
    for field, expected in zip(zip(*parts, strict=True), full, strict=True):
        np.testing.assert_array_equal(np.concatenate(field), expected)
    assert ((full.places + first) % BLOCK_FRAMES == 0).all()
    assert len(full.places) > 5


def test_a_restart_forgets_what_was_heard():
    frames, one = a_scene(), finder(SQUARE)
    one(20 * frames[::-1], 0)
    one.restart()
    for field, expected in zip(one(frames, 0), finder(SQUARE)(frames, 0), strict=True):
        np.testing.assert_array_equal(field, expected)


@pytest.mark.parametrize(
    ("places", "why"),
    [
        ([[0, 0]], "2 to 8 microphones, not 1"),
        ([[0.01 * n, 0] for n in range(9)], "2 to 8 microphones, not 9"),
        ([[0, 0], [0.1, 0, 0]], r"each place of an array is \[x, y\], or each is \[x, y, z\]"),
        ([[0], [1]], r"each place of an array is \[x, y\]"),
        ([[0, 0], [0, float("nan")]], "finite numbers, in metres"),
        ([[0, 0], [0.1, 0], [0.1, 0]], "channels 2 and 3 of the array are at the same place"),
        ([[3.2, 0], [-3.2, 0]], "these are 6.4 m: places are in metres"),
        ([[0, 0, 0], [0, 0, 0.1]], "seen from above; these are 0 m"),
    ],
)
def test_places_that_are_no_array_are_refused(places, why):
    with pytest.raises(ConfigurationError, match=why):
        geometry_of(places)


def test_an_address_in_the_network_has_no_array():
    with pytest.raises(ValueError, match="gives one channel, and has no array"):
        MicrophoneSettings(device="rtsp://camera/1", array=PAIR)


def test_channels_that_are_one_sound_are_told_after_ten_seconds():
    rng, watch = np.random.default_rng(1), ChannelWatch(3)
    frames = rng.normal(0, 0.1, (200, FRAME_SAMPLES, 3)).astype(np.float32)
    watch.add(frames)
    assert not watch.problem()
    frames[:, :, 2] = frames[:, :, 0]
    watch.add(frames[:199])
    assert not watch.problem()
    watch.add(frames[:1])
    assert watch.problem().startswith("channels 1 and 3 of the array are the same sound")
    watch.add(rng.normal(0, 0.1, (1, FRAME_SAMPLES, 3)).astype(np.float32))
    assert not watch.problem()


def test_a_channel_without_sound_is_told_and_silence_is_not():
    watch = ChannelWatch(2)
    watch.add(np.zeros((400, FRAME_SAMPLES, 2), np.float32))
    assert not watch.problem()
    frames = np.random.default_rng(1).normal(0, 0.1, (200, FRAME_SAMPLES, 2)).astype(np.float32)
    frames[:, :, 1] = 0.25
    watch.add(frames)
    assert watch.problem().startswith("channel 2 of the array gives no sound")


def test_a_gap_and_frames_of_a_fallback_begin_blocks_anew():
    frames, one = a_scene(), ArrayDirections(geometry_of(SQUARE))
    stamps = START + np.arange(len(frames)) * FRAME_NANOSECONDS
    expected = one(Frames(0, frames[:, :, 0], stamps, frames))
    one(Frames(0, frames[:7, :, 0], stamps[:7], frames[:7]))
    assert not len(one(Frames(7, frames[:2, :, 0], stamps[7:9])).frames)
    again = one(Frames(0, frames[:, :, 0], stamps, frames))
    for field in fields(expected):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(expected, field.name))
    assert len(expected.frames) > 10


def settings(folder, places=SQUARE):
    microphone = MicrophoneSettings(array=places)
    model = starter_file(GENERAL)
    return Settings(output=folder, microphone=[microphone], timezone="UTC", model=model)


def write(path, frames, rate=SAMPLE_RATE):
    soundfile.write(path, frames.reshape(-1, frames.shape[2]), rate, subtype="PCM_16")
    return path


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    return write(tmp_path_factory.mktemp("array") / "scene.wav", a_scene())


def test_a_file_of_all_channels_is_logged_with_directions_and_the_first_one_s_features(
    scene_file, tmp_path
):
    source = FileSource([scene_file], START, channels=4)
    record(settings(tmp_path / "array"), source, Flag())
    first = write(tmp_path / "first.wav", a_scene()[:, :, :1])
    record(Settings(output=tmp_path / "one"), FileSource([first], START), Flag())
    for ours, alone in zip(features(tmp_path / "array"), features(tmp_path / "one"), strict=True):
        np.testing.assert_array_equal(ours, alone)
    messages = read(tmp_path / "array", "direction")
    numbers = np.array([message.frame for message in messages])
    azimuths = np.array([message.azimuth for message in messages])
    assert np.median(degrees_between(azimuths[numbers < 120], 0.5)) < 1.5
    assert np.median(degrees_between(azimuths[numbers > 120], -2.0)) < 1.5
    assert not read(tmp_path / "one", "direction")
    for log in find_logs(tmp_path):
        assert not [rule for each in examine(log) for rule in each.counts]


@pytest.fixture(scope="module")
def array_log(scene_file, tmp_path_factory):
    logs = tmp_path_factory.mktemp("logs")
    (log,) = record(settings(logs), FileSource([scene_file], START, channels=4), Flag()).logs
    return log


def test_the_direction_of_a_span_is_the_mean_on_the_circle_by_confidence():
    azimuths = np.deg2rad(np.array([170, -170, 10, 40, 100], np.float32))
    vectors = as_vectors(azimuths, np.array([0.2, 0.2, 0.3, 0.1, 0.5], np.float32))
    spans = np.array([0, 20, 0, 50]), np.array([20, 40, 40, 60])
    azimuths, spreads, counts = mean_bearings(np.arange(5) * 10, vectors, *spans)
    assert counts.tolist() == [2, 2, 4, 0]
    np.testing.assert_allclose(np.abs(np.rad2deg(azimuths[0])), 180, atol=1e-4)
    assert 10 < np.rad2deg(azimuths[1]) < 25
    assert spreads[0] < spreads[1] < 0.3 < spreads[2]
    assert np.isnan([azimuths[3], spreads[3]]).all()


def test_segments_tell_whence_their_sound_came(array_log):
    logs = hearthlog.open_logs(array_log)
    came, spans = logs.directions(), logs.segments()
    assert len(came.azimuths) == len(spans.labels)
    is_recorded = came.counts > 0
    assert is_recorded.any()
    early = spans.starts < START + 5_500_000_000
    for rows, azimuth in ((is_recorded & early, 0.5), (is_recorded & ~early, -2.0)):
        assert degrees_between(came.azimuths[rows], azimuth).max() < 8


def test_a_log_of_a_single_microphone_says_that_it_has_no_directions(scene_file, tmp_path):
    record(settings(tmp_path, []), FileSource([scene_file], START), Flag())
    with pytest.raises(LogError, match="no topic /mic/direction"):
        hearthlog.open_logs(tmp_path).directions()


def test_the_review_shows_directions_as_points_where_something_was_located(array_log):
    timeline = read_timeline([array_log])
    (plot,) = (plot for plot in timeline_plots(timeline) if plot.kind is DIRECTION)
    seconds, degrees = (plot.times - START) / 1e9, plot.values[:, 0]
    located = np.isfinite(degrees)
    assert not located[seconds < 0.9].any()
    for part, azimuth in (((1, 6), 0.5), ((6, 12), -2.0)):
        rows = located & (seconds > part[0]) & (seconds < part[1])
        assert np.median(degrees_between(np.deg2rad(degrees[rows]), azimuth)) < 1.5


def test_a_watch_shows_each_direction_as_it_comes(array_log):
    batches = select([array_log]).messages()
    live = LiveTimeline()
    plots = [plot for batch in batches for plot in live.take(array_log, batch)]
    plots = [plot for plot in plots if isinstance(plot, Plot) and plot.kind is DIRECTION]
    degrees = np.concatenate([plot.values[:, 0] for plot in plots])
    messages = read(array_log, "direction")
    np.testing.assert_allclose(degrees, np.rad2deg([m.azimuth for m in messages]), rtol=1e-6)


def test_the_doctor_says_what_is_wrong_with_directions():
    findings = Findings(Path("home.mcap"))
    frames = FrameSequence(findings, "mic", 20, None)
    numbers = np.arange(12)
    stamps = START + numbers * FRAME_NANOSECONDS
    frames.add("features", np.stack([stamps, numbers, stamps], axis=1))
    rows = [[stamps[7], 4, stamps[4]], [stamps[11], 4, stamps[4]]]
    frames.add("direction", np.array(rows))
    frames.settle(None)
    assert {"frame-order", "frame-stamp"} <= {rule for _, rule in findings.counts}


def test_a_file_at_another_rate_has_the_same_directions(tmp_path):
    frames = a_scene()[:120].reshape(-1, 4)
    path = tmp_path / "fast.wav"
    soundfile.write(path, resample_poly(frames, 3, 1), 3 * SAMPLE_RATE, subtype="PCM_16")
    record(settings(tmp_path / "logs"), FileSource([path], START, channels=4), Flag())
    azimuths = np.array([message.azimuth for message in read(tmp_path / "logs", "direction")])
    assert np.median(degrees_between(azimuths, 0.5)) < 1.5


def test_a_gap_inside_a_block_leaves_that_block_without_a_direction(tmp_path):
    frames, logs = a_scene(), tmp_path / "logs"
    stamps = START + np.arange(len(frames) + 3) * FRAME_NANOSECONDS

    class Source:
        device = "array"

        def events(self, _):
            yield Frames(0, frames[:130, :, 0], stamps[:130], frames[:130])
            yield Gap(int(stamps[130]), int(stamps[133]), "lost", 3)
            yield Frames(133, frames[130:, :, 0], stamps[133:], frames[130:])

    record(settings(logs), Source(), Flag())
    numbers = [message.frame for message in read(logs, "direction")]
    assert 128 not in numbers
    assert 132 not in numbers
    assert max(numbers) > 140
    assert [found.rule for each in examine(logs) for found in each.shown] == ["gap"]


def test_a_file_without_a_channel_for_each_place_is_refused(scene_file):
    with pytest.raises(SourceError, match=r"scene.wav: has 4 channels, and `array` names places f"):
        FileSource([scene_file], START, channels=2)


def test_of_a_device_that_gives_all_its_channels_the_first_ones_are_taken():
    samples = np.arange(24, dtype=np.int16).reshape(4, 6)
    for wanted in (range(1), range(4), range(6), range(2, 3)):
        chosen = np.frombuffer(_some_channels(samples.tobytes(), 6, wanted), np.int16)
        np.testing.assert_array_equal(chosen.reshape(-1, len(wanted)), samples[:, wanted])


def test_a_configuration_with_a_wrong_array_is_refused_with_its_line(tmp_path):
    path = configuration(tmp_path, [[0.0, 0.0], [0.0, 6.4]])
    with pytest.raises(ConfigurationError, match=r"config.toml, line 2: microphone.0.array: the "):
        load_settings(path, {}, {})


def configuration(folder: Path, places) -> Path:
    path = folder / "config.toml"
    path.write_text(f"[[microphone]]\narray = {places}\n")
    return path


def test_an_array_is_heard_to_the_last_bit_of_its_file(labmic, tmp_path):
    data = np.round(a_scene().reshape(-1, 4) * 32767).astype(np.int16)
    labmic.configure(data=data)
    logs, config = tmp_path / "logs", configuration(tmp_path, SQUARE)
    with recording(labmic, logs, "--config", str(config)) as process:
        wait_for_frames(logs, 20 * 5, 40)
    assert process.returncode == 0, process.errors
    frames, stamps, _ = features(logs)
    guess = labmic.index_at(int(stamps[1]) - realtime_offset()) - FRAME_SAMPLES
    directions = read(logs, "direction")
    samples = data.astype(np.float32) / np.float32(32768)
    for offset in sorted(range(-1600, 1601), key=abs):  # a busy machine stamps late
        at = (guess + offset + np.arange(len(frames) * FRAME_SAMPLES)) % len(data)
        batch = finder(SQUARE)(samples[at].reshape(-1, FRAME_SAMPLES, 4)[:200], 0)
        if [m.confidence for m in directions[:3]] == batch.confidences[:3].tolist():
            break
    batch = finder(SQUARE)(samples[at].reshape(-1, FRAME_SAMPLES, 4), 0)
    assert [m.frame for m in directions] == batch.places.tolist()
    assert [m.azimuth for m in directions] == batch.azimuths.tolist()
    assert len(directions) > 3


def test_a_microphone_with_fewer_channels_than_places_ends_the_recorder_with_a_line(
    labmic, tmp_path
):
    labmic.configure(data=np.ones((1600, 2), np.int16))
    config = configuration(tmp_path, SQUARE)
    with recording(labmic, tmp_path / "logs", "--config", str(config)) as process:
        process.wait(timeout=30)
    assert process.returncode == 1
    assert process.errors.strip().endswith(
        "microphone 'labmic' has 2 channels, and `array` names places for 4: name one for each "
        "channel that it has"
    )
