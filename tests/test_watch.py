"""What is being recorded is seen live, and the recorder does not notice who looks."""

import io
import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC
from itertools import islice, pairwise, takewhile

import numpy as np
import psutil
import pytest
import rerun as rr
from conftest import HEARTHLOG
from PIL import Image
from rerun.experimental import ViewerClient
from viewers import Window, address_of, display
from waiting import wait_for

from hearthlog.analyzer.activity.checked_minutes import UNSURE_BELOW
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.hidden_classes import write_hidden_classes
from hearthlog.analyzer.review.lanes import (
    FEATURES,
    FLOOR,
    GAP_STATE,
    GAPS,
    LEVEL,
    NOVELTY,
    PROBABILITIES,
    RECORDER,
    StateLane,
)
from hearthlog.analyzer.review.live import (
    AWAY_SECONDS,
    CurrentSound,
    CurrentSounds,
    LiveTimeline,
    last_time,
)
from hearthlog.analyzer.review.timeline import LogLines, Plot
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.analyzer.review.viewer.drawing import plot_entity
from hearthlog.analyzer.review.viewer.process import ViewerProcess
from hearthlog.analyzer.review.viewer.recording import LiveServer, _stack_plots
from hearthlog.models.classes import colour, ordered
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.follow import follow_messages

__all__ = ["display"]  # a fixture

SECOND = 1_000_000_000
MINUTES = 3


@pytest.fixture(scope="module")
def logs(day, model_file, tmp_path_factory):
    """Three minutes of a home, recorded."""
    folder = tmp_path_factory.mktemp("watched") / "logs"
    subprocess.run([*HEARTHLOG, "record", day, "--model", model_file, "-o", folder], check=True)
    return folder


@pytest.fixture(scope="module")
def other_model(model_file, tmp_path_factory):
    """The model with another name for one of its classes."""
    model = load_model(model_file)
    text = model.description.model_dump_json().replace('"speech"', '"talk"')
    path = tmp_path_factory.mktemp("other") / "other.safetensors"
    save_model(replace(model, description=type(model.description).model_validate_json(text)), path)
    return path


@contextmanager
def watching(folder, *options):
    """Run `hearthlog watch --serve` and yield its process and the URL for viewers."""
    port = free_port()
    command = [*HEARTHLOG, "watch", folder, "--serve", "--port", str(port), *options]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: address_of(port) or process.poll() is not None)
        yield process, f"rerun+http://{address_of(port)}:{port}/proxy"
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


@contextmanager
def looking(url):
    """Run a viewer without a screen that connects to a server."""
    with ViewerProcess(["--headless", "--window-size", "1600x900", "--connect", url]) as run:
        try:
            run.wait_until_it_listens()
        except DataError as error:
            if os.environ.get("TESTS_REQUIRE_AUDIO") == "1":
                raise
            pytest.skip(f"Rerun's viewer does not run here: {error}")
        yield Eye(run)


class Eye:
    """Looks at what a viewer shows."""

    def __init__(self, process):
        self.pid = psutil.Process(process._process.pid)
        self._client = ViewerClient.connect(process.url)

    def views(self, count=1):
        """Wait until so many views are there."""

        def enough():
            state = answer(self._client.get_state)
            return state.views if state and len(state.views) >= count else None

        return wait_for(enough)

    def newest(self):
        """The time of the newest data; None if there is none."""
        state = answer(self._client.get_state)
        ends = [line.end for each in state.recordings for line in each.timelines] if state else []
        return max((end for end in ends if end), default=None)

    def picture(self):
        png = wait_for(lambda: answer(self._client.take_screenshot))
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def answer(operation):
    """Ask a viewer, which paints slowly on a busy machine."""
    try:
        return operation()
    except (TimeoutError, ConnectionError):
        return None


def is_there(picture, tint, column):
    """Tell whether a colour, which the viewer darkens, is in a column of the lanes."""
    strip = picture[: len(picture) // 5, column]
    bright = strip[strip.max(axis=1) > 100]
    likeness = bright @ tint / np.linalg.norm(bright, axis=1) / np.linalg.norm(tint)
    return bool((likeness > 0.9995).any())


def news(folder, live=None, **options):
    """Give what is new to one who follows finished logs to their end."""
    live = live or LiveTimeline()
    count = sum(1 for _ in batches(folder, **options))
    found = islice(follow_messages(folder, start=0, **options), count)
    return [each for path, batch in found for each in live.take(path, batch)]


def batches(folder, **options):
    """All that a folder has."""
    followed = follow_messages(folder, start=0, ticks=True, **options)
    return takewhile(lambda read: read[0] != folder, followed)


def lane_states(found, kind):
    """Give a lane as it stands in the end: what came last of each time counts."""
    states = {}
    for each in found:
        if isinstance(each, StateLane) and each.kind is kind:
            states.update(zip(each.times.tolist(), each.states, strict=True))
    times = np.array(sorted(states))
    return times, [states[time] for time in times.tolist()]


def test_a_lane_has_the_colour_of_what_is_heard_where_it_is_heard(logs):
    segments = read_columns(find_logs(logs))["/mic/segment"]
    durations = np.where(segments["label"] == "silence", 0, segments["duration"])
    longest = int(durations.argmax())
    middle = segments["header.stamp"][longest] + segments["duration"][longest] // 2
    with watching(logs, "--minutes", str(MINUTES)) as (watcher, url), looking(url) as eye:
        eye.views(6)
        tint = colour(segments["label"][longest])
        share = 1 - (last_time(logs) - middle) / (MINUTES * 60 * SECOND)
        wait_for(lambda: is_there(eye.picture(), tint, round(share * 1599)))
        assert not any(view.reports for view in eye.views(7))
        for process in (psutil.Process(watcher.pid), eye.pid):
            found = [c.laddr.ip for c in process.net_connections() if c.status == "LISTEN"]
            assert [ip.split(".")[0] for ip in found] == ["127"]
            assert found != ["127.0.0.1"]  # which a page in a browser would try
        watcher.terminate()
        assert watcher.wait(30) == 0


def test_a_recorder_does_not_notice_who_looks(logs, day, model_file, tmp_path):
    watched = tmp_path / "watched"
    watched.mkdir()
    with watching(watched) as (watcher, url), looking(url) as first:
        command = [*HEARTHLOG, "record", day, "--model", model_file, "-o", watched, "--realtime"]
        recorder = subprocess.Popen(command)
        first.views()
        first.pid.kill()
        with looking(url) as second:
            second.views()
            watcher.kill()
            time.sleep(1)
        assert recorder.poll() is None
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(60) == 0
    alone, seen = (read_columns(find_logs(folder)) for folder in (logs, watched))
    for topic, field in {"/mic/features": "values", "/mic/label": "probabilities"}.items():
        count = len(seen[topic])
        assert count > 0
        assert np.array_equal(alone[topic]["frame"][:count], seen[topic]["frame"])
        assert np.array_equal(alone[topic][field][:count], seen[topic][field])


def test_a_viewer_that_comes_when_the_first_was_dropped_still_knows_names_and_colours():
    port = free_port()
    names = (*map(str, range(8)), "phone_ring")
    seconds = 1_772_348_400 * SECOND + np.arange(500) * SECOND
    values = np.random.default_rng(1).dirichlet(np.ones(9), 500)
    taken = []
    with LiveServer(port, "127.0.0.1", MINUTES, memory="5MB") as server:
        for number in range(1200):  # six days
            times = seconds + number * 500 * SECOND
            shares = Plot(PROBABILITIES, "mic", "live", names, times, values)
            server.show([shares, StateLane(RECORDER, "mic", times, ["phone_ring"] * 500)])
            taken.append(psutil.Process().memory_info().rss)
        assert taken[-1] - taken[100] < 120_000_000, "200 MB if all of it is kept"
        with looking(server.url) as eye:
            eye.views()
            wait_for(lambda: is_there(eye.picture(), colour("phone_ring"), 1580))


BEGIN = 1_772_348_400 * SECOND


class Drawn(Canvas):
    """Keeps what is drawn."""

    def __init__(self):
        self.rows, self.states, self.names = [], [], {}

    def add_rows(self, _entity, times, _shares, length, _colours):
        self.rows += [(time - length // 2, time + length // 2) for time in times.tolist()]

    def configure_states(self, _entity, colours, names=None):
        self.names = dict(zip(colours, zip(names, colours.values(), strict=True), strict=True))

    def change_states(self, _entity, _times, states):
        self.states += states

    def configure(self, *_):
        pass

    write = draw_lines = write_lines = configure


def test_pieces_of_a_row_that_came_in_parts_of_a_second_do_not_overlap():
    canvas, server = Drawn(), LiveServer(free_port(), "127.0.0.1", MINUTES)
    middles = [0.5, 1.5, 2.2, 2.7, 3.5, 4.2, 4.7, 5.5, 6.2, 6.7, 7.5, 8.5, 9.1, 9.6, 10.5, 11.5]
    with server:
        for part in np.split(np.array(middles), [3, 6, 9, 13]):
            times = BEGIN + (part * SECOND).astype(np.int64)
            values = np.tile([[0.9, 0.1]], (len(part), 1))
            plot = Plot(PROBABILITIES, "mic", "live", ("silence", "speech"), times, values)
            server._show_plot(plot, canvas)
    assert [start - BEGIN for start, _ in canvas.rows] == [k * SECOND for k in range(11)]
    assert all(one[1] == other[0] for one, other in pairwise(canvas.rows))


def test_a_state_too_short_for_its_word_has_none_and_quiet_and_doubt_are_faint():
    canvas, server = Drawn(), LiveServer(free_port(), "127.0.0.1", 5)
    times = BEGIN + np.arange(43) * SECOND
    states = ["silence"] * 20 + ["speech"] * 3 + ["speech?"] * 20
    with server:
        server._show_lane(StateLane(RECORDER, "mic", times, states), canvas)
    names = [canvas.names[state][0] for state in canvas.states]
    assert names == ["Quiet"] * 20 + [" "] * 3 + ["Talking?"] * 20
    quiet, talking, doubtful = (canvas.names[canvas.states[k]][1] for k in (0, 20, 30))
    assert max(quiet) < 60
    assert talking == colour("speech")
    assert doubtful == tuple((part + 13) // 2 for part in colour("speech"))


def test_the_axes_begin_with_what_is_there_until_they_are_full():
    layouts = []
    with LiveServer(free_port(), "127.0.0.1", 5) as server:
        server._recording.send_blueprint = lambda layout, **_: layouts.append(layout)
        for second in (0, 60, 299, 300, 400):
            times = np.array([BEGIN + second * SECOND])
            server.show([Plot(LEVEL, "mic", "", ("level",), times, np.array([[-40.0]]))])
    first, later = (repr(one._range.start) for one in layouts)
    assert str(BEGIN) in first
    assert str(300 * SECOND) in later


def test_the_table_of_events_is_in_the_last_tab_and_novelty_begins_as_far_right_as_other_plots():
    times = np.array([BEGIN])
    plots = {
        plot_entity(one): [one]
        for one in (
            Plot(LEVEL, "mic", "", ("level",), times, np.array([[-40.0]])),
            Plot(NOVELTY, "mic", "live", ("novelty",), times, np.array([[0.5]])),
        )
    }
    *_, details = _stack_plots("mic", plots).contents
    assert [view.name for view in details.contents] == [NOVELTY.title, "Events"]
    _, novelty = details.contents[0].contents
    assert novelty.name == NOVELTY.title
    assert sum(details.contents[0].column_shares) == 1366


def test_lanes_are_sent_at_once_and_plots_every_few_seconds():
    begin = 1_772_348_400 * SECOND

    def level(second):
        times = np.array([begin + second * SECOND])
        return Plot(LEVEL, "mic", "", ("level",), times, np.array([[-40.0]]))

    with LiveServer(free_port(), "127.0.0.1", MINUTES) as server, looking(server.url) as eye:
        server.show([level(0)])
        wait_for(lambda: eye.newest() == begin)
        for second in (1, 2, 3):
            server.show([level(second)])
        lane = StateLane(RECORDER, "mic", np.array([begin + 2 * SECOND]), ["speech"])
        server.show([lane])
        wait_for(lambda: eye.newest() == begin + 2 * SECOND)
        server.show([level(5)])
        wait_for(lambda: eye.newest() == begin + 5 * SECOND)


class Letters(list):
    """The texts that a server shows in large letters."""

    def __init__(self, monkeypatch):
        send = rr.RecordingStream.send_columns

        def note(recording, entity, indexes, columns):
            columns = [*columns]
            if entity.startswith("current/"):
                texts = (each for each in columns if "text" in str(each.component_descriptor()))
                self.append(next(texts).as_arrow_array().to_pylist()[0][0])
            return send(recording, entity, indexes, columns)

        monkeypatch.setattr(rr.RecordingStream, "send_columns", note)


def recorded_now(sounds, label, begin, count, **about):
    """Add labels of now."""
    microphone, confidence = about.get("microphone", "mic"), about.get("confidence", 0.87)
    own = sounds.microphones.setdefault(microphone, CurrentSound(microphone))
    own.seen = time.monotonic()
    times = begin + FRAME_NANOSECONDS * np.arange(count)
    own.push(times, np.full(count, label, object), np.full(count, confidence, np.float32))
    return own


def test_large_letters_say_what_is_heard_now_how_sure_and_since_when(tmp_path, monkeypatch):
    letters, sounds = Letters(monkeypatch), CurrentSounds(tmp_path, pytest.fail)
    begin = 1_772_348_400 * SECOND
    with LiveServer(free_port(), "127.0.0.1", MINUTES) as server:
        recorded_now(sounds, "silence", begin, 100)
        recorded_now(sounds, "coughing", begin + 5 * SECOND, 40)
        server.show_current(sounds, UTC)
        other = recorded_now(sounds, "music", begin, 1, microphone="living_room [](x:/y)")
        other.seen -= AWAY_SECONDS + 1
        server.show_current(sounds, UTC)
        write_hidden_classes(tmp_path, ["coughing"])
        sounds.hide()
        server.show_current(sounds, UTC)
    assert letters[0] == "# Coughing · 87 % · for 2 s"
    assert letters[1] == "# Living room (xy) · Nobody listens since 2026-03-01 07:00"
    assert letters[2] == "# Mic · A sound · 87 % · for 2 s"
    assert len(letters) == 3


def test_where_nobody_listens_the_lane_ends_with_the_last_label(tmp_path, monkeypatch):
    lanes, sounds = [], CurrentSounds(tmp_path, pytest.fail)
    change = Canvas.change_states

    def note(canvas, entity, times, states):
        lanes.append((entity, *times.tolist(), *states))
        change(canvas, entity, times, states)

    monkeypatch.setattr(Canvas, "change_states", note)
    begin = 1_772_348_400 * SECOND
    with LiveServer(free_port(), "127.0.0.1", MINUTES) as server:
        server.show([StateLane(RECORDER, "mic", np.array([begin]), ["coughing"])])
        sound = recorded_now(sounds, "coughing", begin, 40)
        server.show_current(sounds, UTC)
        assert len(lanes) == 1
        sound.seen -= AWAY_SECONDS + 1
        server.show_current(sounds, UTC)
        server.show_current(sounds, UTC)
    assert lanes[1:] == [("lanes/mic/Heard", begin + 2 * SECOND, None)]


def test_large_letters_change_once_a_minute_while_the_sound_does_not(tmp_path, monkeypatch):
    letters, sounds = Letters(monkeypatch), CurrentSounds(tmp_path, pytest.fail)
    begin = 1_772_348_400 * SECOND
    with LiveServer(free_port(), "127.0.0.1", MINUTES) as server:
        for second in range(3600):
            confidence = 0.87 + 0.04 * (second % 2)
            recorded_now(sounds, "silence", begin + second * SECOND, 20, confidence=confidence)
            server.show_current(sounds, UTC)
    assert 60 <= len(letters) <= 80
    assert letters[-1] == "# Quiet · 91 % · for over 1 h 0 min"


def test_a_window_hardly_grows_with_what_it_paints(display, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    names, shades = tuple(map(str, range(9))), np.random.default_rng(1).random((180, 9))
    seconds = 1_772_348_400 * SECOND + np.arange(180) * SECOND
    memory = []
    with (
        LiveServer(free_port(), "127.0.0.1", MINUTES) as server,
        ViewerProcess(["--hide-welcome-screen", "--connect", server.url]) as run,
    ):
        server.show([Plot(FEATURES, "mic", "", names, seconds, shades)])
        window, process = Window(display, run.port), psutil.Process(run._process.pid)
        for number in range(1, 61):
            later = seconds[-1:] + number * SECOND
            server.show([Plot(FEATURES, "mic", "", names, later, shades[number : number + 1])])
            window.mouse(f"mousemove {300 + number} 300")
            memory.append(process.memory_info().rss)
    assert memory[-1] - memory[19] < 50_000_000


def test_a_lane_ends_as_the_segments_say_and_is_filled_until_they_do(logs):
    found = news(logs)
    times, states = lane_states(found, RECORDER)
    segments = read_columns(find_logs(logs))["/mic/segment"]
    starts = segments["header.stamp"]
    ends = starts + segments["duration"]
    within = np.searchsorted(starts, times, side="right") - 1
    for time_, state, at in zip(times.tolist(), states, within.tolist(), strict=True):
        if at >= 0 and time_ < ends[at]:
            is_sure = segments["confidence"][at] >= UNSURE_BELOW
            assert state == segments["label"][at] + "?" * (not is_sure)
    assert np.isin(starts, times).all()
    first = next(each for each in found if isinstance(each, StateLane) and each.kind is RECORDER)
    assert None not in first.states
    assert np.diff(times).max() <= SECOND


def test_means_are_those_of_the_frames_of_a_second(logs, model_file):
    found = [each for each in news(logs) if isinstance(each, Plot)]
    columns = read_columns(find_logs(logs))
    stamps, values = (columns["/mic/label"][name] for name in ("header.stamp", "probabilities"))
    shares = [each for each in found if each.kind is PROBABILITIES]
    times = np.concatenate([each.times for each in shares])
    means = np.concatenate([each.values for each in shares])
    names = load_model(model_file).classes
    assert list(shares[0].names) == ordered(names)
    values = values[:, [names.index(name) for name in shares[0].names]]
    second = times[40] // SECOND
    assert np.allclose(means[40], values[stamps // SECOND == second].mean(axis=0), atol=1e-6)
    assert len(times) < len(stamps) / 15
    assert {each.kind for each in found} == {PROBABILITIES, LEVEL, FLOOR, NOVELTY, FEATURES}
    floor = np.concatenate([each.values for each in found if each.kind is FLOOR])[:, 0]
    assert -65 < floor[-1] < -55  # the noise between the sounds of the day
    heat = np.concatenate([each.values for each in found if each.kind is FEATURES])
    assert heat.min() >= 0
    assert heat.max() <= 1
    assert (heat.std(axis=0) > 0.05).all()


def test_what_was_not_heard_is_a_hole_in_lanes_and_lines(recorded):
    found = news(recorded)
    gaps = read_columns(find_logs(recorded))["/mic/gap"]
    times, states = lane_states(found, GAPS)
    assert len(gaps)
    assert np.array_equal(times[::2], gaps["header.stamp"])
    assert states == [GAP_STATE, None] * len(gaps)
    live_times, live_states = lane_states(found, RECORDER)
    level = [each for each in found if isinstance(each, Plot) and each.kind is LEVEL]
    holes = np.concatenate([each.times[np.isnan(each.values[:, 0])] for each in level])
    for start in gaps["header.stamp"]:
        assert np.abs(holes - start).min() <= FRAME_NANOSECONDS
        assert live_states[np.abs(live_times - start).argmin()] is None


def test_events_are_told_in_words(logs):
    lines = [text for each in news(logs) if isinstance(each, LogLines) for text in each.texts]
    assert len(lines) == len(read_columns(find_logs(logs))["/rosout"])


def test_another_model_and_none_are_drawn_too(day, model_file, other_model, tmp_path):
    for number, model in enumerate((["--model", model_file], ["--model", other_model], [])):
        start = f"2026-03-01T0{number}:00"
        subprocess.run(
            [*HEARTHLOG, "record", day, "-o", tmp_path, "--start", start, *model], check=True
        )
    found = news(tmp_path)
    shares = dict.fromkeys(
        e.names for e in found if isinstance(e, Plot) and e.kind is PROBABILITIES
    )
    assert len(shares) == 2
    levels = [each.times for each in found if isinstance(each, Plot) and each.kind is LEVEL]
    assert np.concatenate(levels)[-1] > lane_states(found, RECORDER)[0][-1] + 3_000 * SECOND
    with LiveServer(free_port(), "127.0.0.1", MINUTES) as server:
        server.show(found)


def test_a_class_that_no_output_shows_is_in_no_lane_and_no_plot(logs):
    live = LiveTimeline()
    _, states = lane_states(news(logs, live), RECORDER)
    hidden = next(name for name in states if name not in {None, "silence", "unknown"})
    live = LiveTimeline()
    live.hidden = {hidden}
    found = news(logs, live)
    assert hidden not in lane_states(found, RECORDER)[1]
    assert len(lane_states(found, RECORDER)[1]) == len(states)
    shares = [each for each in found if isinstance(each, Plot) and each.kind is PROBABILITIES]
    assert all(hidden not in each.names for each in shares)
    assert all(each.values.shape[1] == len(each.names) for each in shares)


def test_what_is_kept_does_not_grow_with_what_was_watched(logs):
    live = LiveTimeline()
    news(logs, live)
    before = len(str(live.__dict__))
    for _ in range(3):
        news(logs, live)
    assert len(str(live.__dict__)) < 1.1 * before


@pytest.mark.parametrize("name", ["home_1.mcap", "home_1.mcap.active"])
def test_a_damaged_log_is_told_and_the_others_are_shown(logs, tmp_path, name):
    (log,) = find_logs(logs)
    data = bytearray(log.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2_000] = os.urandom(2_000)
    (tmp_path / name).write_bytes(data)
    shutil.copy(log, tmp_path / name.replace("1", "2"))
    with watching(tmp_path) as (watcher, url), looking(url) as eye:
        assert eye.views()
        watcher.send_signal(signal.SIGINT)
        _, output = watcher.communicate(timeout=30)
    assert watcher.returncode == 3
    assert output.count("home_1.mcap") == 1
    assert "home_2.mcap" not in output
    assert output.count("\n") == 3


def test_an_empty_folder_is_waited_for(day, model_file, tmp_path):
    with watching(tmp_path) as (watcher, url), looking(url) as eye:
        command = [*HEARTHLOG, "record", day, "--model", model_file, "-o", tmp_path]
        subprocess.run(command, check=True)
        eye.views(6)
        watcher.terminate()
        _, output = watcher.communicate(timeout=30)
    assert f"no log in {tmp_path} yet; waiting for a recorder" in output


def test_a_folder_that_is_not_there_is_told(hearthlog, tmp_path):
    result = hearthlog("watch", tmp_path / "nowhere", "--serve")
    assert result.returncode == 1
    assert (
        "nowhere: no such folder; name the one that `hearthlog record` writes to" in result.stderr
    )


def test_a_port_that_is_in_use_is_told(hearthlog, tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        result = hearthlog("watch", tmp_path, "--serve", "--bind", "127.0.0.1", "--port", port)
    assert result.returncode == 1
    assert f"port {port} is in use" in result.stderr
    assert "--port" in result.stderr


def test_an_address_that_is_not_of_this_machine_is_told(hearthlog, tmp_path):
    result = hearthlog("watch", tmp_path, "--serve", "--bind", "192.0.2.1", "--port", free_port())
    assert result.returncode == 1
    assert "cannot listen on 192.0.2.1" in result.stderr


def test_without_a_display_it_is_said_what_else_there_is(hearthlog, tmp_path):
    result = hearthlog("watch", tmp_path, env={"DISPLAY": "", "WAYLAND_DISPLAY": ""})
    assert result.returncode == 1
    assert "--web" in result.stderr
    assert "--serve" in result.stderr


def test_who_listens_to_the_network_is_warned(tmp_path):
    with watching(tmp_path, "--bind", "0.0.0.0") as (watcher, _):
        watcher.terminate()
        _, output = watcher.communicate(timeout=30)
    assert (
        "anybody who reaches this port, even a web page in a browser, sees everything shown"
        in output
    )


def test_options_that_exclude_each_other_are_wrong_use(hearthlog, tmp_path):
    assert hearthlog("watch", tmp_path, "--serve", "--web").returncode == 2
    assert hearthlog("watch", tmp_path, "--bind", "0.0.0.0").returncode == 2
