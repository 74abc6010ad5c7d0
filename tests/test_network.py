"""A microphone in the network is heard at the time it sounds; what is wrong with one is said."""

import os
import signal
import socket
import subprocess
import threading
import time
from contextlib import closing, suppress
from dataclasses import dataclass, field

import numpy as np
import psutil
import pytest
import soundfile
from conftest import HEARTHLOG
from logs import features, read
from mcap.reader import make_reader
from streams import RATE, noise
from test_capture import (
    FRAME,
    ROUNDING,
    SECONDS,
    batch,
    realtime_offset,
    recording,
    wait_for_frames,
)

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.recorder.addresses import check_address, public_name
from hearthlog.recorder.config import MicrophoneSettings
from hearthlog.recorder.events import SourceHealth
from hearthlog.recorder.sources.capture import ArrivalPace
from hearthlog.recorder.sources.microphone import MicrophoneSource
from hearthlog.schemas.errors import DeviceError, SourceError
from hearthlog.schemas.frames import FRAME_SAMPLES
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import nanoseconds

CAPTURE = "hearthlog.recorder.sources.ffmpeg"
USER = "listener:pass%40word@"


@dataclass
class Address:
    """What `recording` wants of a microphone."""

    device: str
    env: dict = field(default_factory=lambda: dict(os.environ))


def sample_at(data, values):
    """Return which sample of the looping data is the first of these frames."""
    power = np.cumsum(np.concatenate([[0.0], np.tile(data.astype(np.float64) / 32768, 2) ** 2]))
    frame_power = (power[FRAME_SAMPLES:] - power[:-FRAME_SAMPLES])[: len(data)] / FRAME_SAMPLES
    (start,) = (
        int(at)
        for at in np.flatnonzero(
            np.isclose(frame_power, values[1][0], rtol=ROUNDING)
            & np.isclose(np.roll(frame_power, -FRAME_SAMPLES), values[2][0], rtol=ROUNDING)
        )
        if np.array_equal(batch(data, int(at) - FRAME_SAMPLES, 2)[1], values[1])
    )
    return (start - FRAME_SAMPLES) % len(data)


@pytest.mark.parametrize("burst", [0.0, 5.0])
def test_a_live_server_is_heard_to_the_last_sample_at_the_time_it_sounds(
    live_server, tmp_path, burst
):
    live_server.burst = burst
    logs, data = tmp_path / "logs", live_server.data
    called = time.time_ns()
    with recording(Address(live_server.address), logs) as process:
        wait_for_frames(logs, 200)
    assert process.returncode == 0, process.errors
    frames, stamps, values = features(logs)
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    start = sample_at(data, values)
    np.testing.assert_array_equal(values, batch(data, start, len(frames)))
    epoch = live_server.epoch * SECONDS + realtime_offset()
    laps = round((stamps[0] - epoch) / SECONDS * RATE - start, -3) // len(data)
    true = epoch + (start + laps * len(data) + frames * FRAME_SAMPLES) * SECONDS / RATE
    assert np.abs(stamps - true).max() < 0.2 * SECONDS
    assert called < stamps[0]
    assert np.abs(np.diff(stamps) - FRAME).max() < FRAME / 5


@pytest.mark.parametrize("path", ["sound", "film"])
def test_a_camera_is_heard(camera, tmp_path, path):
    logs = tmp_path / "logs"
    with recording(Address(camera.address(path)), logs) as process:
        wait_for_frames(logs, 100)
    assert process.returncode == 0, process.errors
    frames, _, values = features(logs)
    np.testing.assert_array_equal(frames, np.arange(len(frames)))
    assert {info.device for info in read(logs, "info")} == {camera.address(path)}
    if path == "sound":
        np.testing.assert_array_equal(
            values, batch(noise(120), sample_at(noise(120), values), len(frames))
        )


def test_a_source_that_comes_ends_and_comes_back_is_in_one_log_without_its_password(
    live_server, tmp_path
):
    live_server.condition = "html"
    logs = tmp_path / "logs"
    address = live_server.address.replace("//", f"//{USER}")
    with recording(Address(address), logs) as process:
        output = process.stderr.readline()
        live_server.condition = "locked"
        wait_for_frames(logs, 60)
        live_server.condition = "ends"
        output += process.stderr.readline() + process.stderr.readline()
        live_server.condition = "locked"
        recorded = len(features(logs)[0])
        wait_for_frames(logs, recorded + 60)
    name = live_server.address
    assert f"mic: {name} sends no sound of a known format;" in output
    assert f"mic: {name} has stopped sending" in output
    (log,) = find_logs(logs)
    (gap,) = read(log, "gap")
    assert gap.reason == f"{name} has stopped sending"
    frames, stamps, _ = features(log)
    jump = int(np.flatnonzero(np.diff(frames) > 1)[0])
    assert nanoseconds(gap.header.stamp) == stamps[jump] + FRAME
    assert nanoseconds(gap.header.stamp) + nanoseconds(gap.duration) == stamps[jump + 1]
    assert {info.device for info in read(log, "info")} == {name}
    assert not [line for one in examine(log) for line in one.shown if line.level == "error"]
    everything = output + process.errors + process.output + contents(log)
    assert "listener" not in everything
    assert "pass" not in everything.replace("passed", "")


def contents(log):
    with log.open("rb") as file:
        reader = make_reader(file)
        texts = [item.data for item in reader.iter_attachments()]
        texts += [str(item.metadata).encode() for item in reader.iter_metadata()]
        texts += [message.data for *_, message in reader.iter_messages()]
    return "\n".join(text.decode(errors="replace") for text in texts)


def test_a_camera_that_freezes_is_heard_again(camera, tmp_path):
    logs = tmp_path / "logs"
    with recording(Address(camera.address("sound")), logs):
        wait_for_frames(logs, 60)
        camera.freeze()
        time.sleep(13)
        camera.restore()
        wait_for_frames(logs, len(features(logs)[0]) + 60, 60)
    (gap,) = read(logs, "gap")
    assert gap.reason == f"{camera.address('sound')} has stopped sending"
    assert not [line for one in examine(logs) for line in one.shown if line.level == "error"]


@pytest.mark.parametrize(
    ("condition", "reason"),
    [
        ("html", "sends no sound of a known format; check the part after the host"),
        ("playlist", "sends no sound of a known format"),
        ("locked", "needs a user name and a password"),
        ("silent", "does not answer"),
        ("ends", "sends no sound of a known format"),
        ("fast", "sends sound faster than real time; use the address of a live source"),
    ],
)
def test_what_is_wrong_with_a_server_is_said(live_server, tmp_path, condition, reason):
    live_server.secret = tmp_path / "secret.mp3"
    soundfile.write(live_server.secret, noise(5), RATE)
    live_server.speed, live_server.condition = (
        (3.0, "") if condition == "fast" else (1.0, condition)
    )
    assert reason in why(live_server.address)


def why(address):
    """Return why a source is not heard, or is no more."""
    try:
        with closing(MicrophoneSource(address, waits=False)) as source:
            for event in source.events(threading.Event()):
                if isinstance(event, SourceHealth) and event.level:
                    return event.summary
    except DeviceError as error:
        return str(error)


def test_what_is_wrong_with_a_camera_is_said(camera):
    assert "does not exist (404 Not Found)" in why(camera.address("no"))
    assert "has no sound" in why(camera.address("mute"))
    locked = f"127.0.0.1:{camera.locked_port}/sound"
    assert why(f"rtsp://{locked}").startswith(f"rtsp://{locked} needs a user name and a password")
    refused = why(f"rtsp://listener:wrong@{locked}")
    assert refused == f"rtsp://{locked} refuses the user name or the password"
    MicrophoneSource(f"rtsp://{USER}{locked}", waits=False).close()


def test_a_host_that_is_not_there_is_told_from_one_that_refuses():
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        assert "refuses the connection" in why(f"rtsp://127.0.0.1:{held.getsockname()[1]}/mic")
    assert "has an unknown host" in why("http://camera.invalid/mic")


@pytest.mark.parametrize("killed", ["record", "capture"])
def test_ffmpeg_ends_with_what_it_was_started_for_and_its_address_is_no_argument(
    live_server, tmp_path, killed
):
    settings = tmp_path / "home.toml"
    address = live_server.address.replace("//", f"//{USER}")
    settings.write_text(f'output = "{tmp_path}/logs"\n[[microphone]]\ndevice = "{address}"\n')
    process = subprocess.Popen([*HEARTHLOG, "record", "--config", str(settings)])
    try:
        wait_for_frames(tmp_path / "logs", 20)
        recorder = psutil.Process(process.pid)
        arguments = {one: one.cmdline() for one in (recorder, *children(recorder))}
        (ffmpeg,) = (one for one, words in arguments.items() if "ffmpeg" in words[0])
        live_server.condition = "stalls"  # ffmpeg writes no more, and would not notice
        (recorder if killed == "record" else ffmpeg.parent()).send_signal(signal.SIGKILL)
        ffmpeg.wait(timeout=8)  # it would give up by itself after ten seconds
    finally:
        process.kill()
        process.wait()
    assert not [words for words in arguments.values() if "pass%40word" in " ".join(words)]


def children(recorder):
    """The capture process and ffmpeg, without what looks after the disk and may end just now."""
    found = []
    for one in recorder.children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            found += [one] if {"-nostdin", CAPTURE} & set(one.cmdline()) else []
    return found


@pytest.mark.parametrize(
    "address",
    [
        "rtmp://camera/stream",
        "RTSP camera://x",
        "rtsp:///stream",
        "http://",
        "http://camera:99999/",
        "rtsp://user:pa/ss@camera/stream",
        "rtsp://user:12/3@camera/stream",
        "rtsp://camera/a\nb",
        "http://[::1/",
    ],
)
def test_what_can_be_no_address_is_refused_at_the_start(address, hearthlog, tmp_path):
    with pytest.raises(SourceError):
        check_address(address)
    if address == "rtsp://user:pa/ss@camera/stream":
        result = hearthlog("record", "--device", address, "-o", tmp_path / "logs")
        assert result.returncode == 1
        assert "in a password / as %2F" in result.stderr
        assert "pa/ss" not in result.stderr
        assert not (tmp_path / "logs").exists()


def test_without_ffmpeg_the_recorder_says_how_to_get_it(hearthlog, tmp_path):
    result = hearthlog("record", "--device", "rtsp://camera/x", env={"PATH": str(tmp_path)})
    assert result.returncode == 1
    assert "install it (Debian: apt install ffmpeg)" in result.stderr


@pytest.mark.parametrize(
    ("address", "name"),
    [
        ("rtsp://u:p@camera:554/live", "rtsp://camera:554/live"),
        ("http://camera/audio/in.cgi?user=u&pwd=p", "http://camera/audio/…"),
        ("rtsp://camera/user=u&password=p&channel=1.sdp", "rtsp://camera/…"),
        ("rtsp://u:12/3@camera/live", "rtsp://…"),
        ("http://camera?pwd=p", "http://camera…"),
        ("Blue Yeti", "Blue Yeti"),
    ],
)
def test_logs_have_the_address_without_what_is_secret_in_it(address, name):
    assert public_name(address) == name
    assert MicrophoneSettings(device=address).model_dump(mode="json")["device"] == name


def test_two_microphones_of_one_address_are_refused_without_its_password(hearthlog, tmp_path):
    settings = tmp_path / "home.toml"
    table = '[[microphone]]\nname = "{}"\ndevice = "rtsp://u:secret@camera/x"\n'
    settings.write_text(table.format("hall") + table.format("kitchen"))
    result = hearthlog("record", "--config", settings)
    assert "two microphones have device 'rtsp://camera/x'" in result.stderr
    assert "secret" not in result.stderr


def test_sound_that_a_server_had_kept_is_told_from_live_sound():
    pace = ArrivalPace(100.0)
    pace.add(4 * RATE, 100.5)  # four seconds at once, half a second after the call
    for second in range(1, 4):
        pace.add(RATE, 100.5 + second)
    older, now = pace.settle()
    assert (older, now) == (3.5 * RATE, 103.5)


def test_sound_that_is_delayed_is_not_lost_and_sound_that_is_lost_is_noticed():
    pace = ArrivalPace(0.0)
    pace.add(RATE, 1.0)
    pace.settle()
    found = []
    for second in range(2, 400):
        delay = 8.0 if 50 < second < 58 else 0.0
        drift = second * 200e-6
        lost = 3.0 if second > 200 else 0.0
        pace.add(RATE, second + delay + drift + lost)
        found.append((second, pace.trouble()))
    troubles = [(second, trouble) for second, trouble in found if trouble]
    assert troubles[0][1] == "lost 3.0 s of sound on the way"
    assert 200 < troubles[0][0] < 262
