"""A replayed log is the recorded one again, and says so where it is not."""

import json
import math
import os
import shutil
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
import typer
from blobs import blobs
from conftest import HEARTHLOG, spread_files
from logreader import LogReader
from logs import features, labelled_frames, read
from lossy_source import LossySource
from mcap.records import Metadata
from rewriting import Log
from together import record_together
from waiting import wait_for

from hearthlog.analyzer.relabel.player import ReplayOptions
from hearthlog.analyzer.relabel.replay import LogSet, find_recorded_model
from hearthlog.analyzer.relabel.replay import replay as replay_logs
from hearthlog.analyzer.training.train import train_model
from hearthlog.models.classifiers.classifier import Classifier, label_timing
from hearthlog.models.features.auros21 import FEATURE_NAMES
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Frames, Gap, SourceHealth
from hearthlog.recorder.log.recovery import recover_active
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import HearthlogError, LogError, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import Attachment, LogWriter
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import (
    encode,
    header,
    message,
    nanoseconds,
    time_message,
)
from hearthlog.schemas.messages.topics import Topic, topics_of
from hearthlog.tools.cli.relabel import replay as verb

SECOND = 1_000_000_000
START = 1_772_350_200 * SECOND  # half past seven
LOST = {5: 7, 12: 150}  # frames, before blocks of ten seconds


def record_day(folder, day, model, **settings):
    """Record three minutes with gaps, stop, and go on two minutes later; a file a minute."""
    requested = Settings(output=folder, model=model, max_bag_duration=60, **settings)
    record(requested, LossySource(FileSource([day], START), LOST), Flag())
    record(requested, FileSource([day], START + 300 * SECOND), Flag())
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory, model_file, day):
    return record_day(tmp_path_factory.mktemp("recorded"), day, model_file)


@pytest.fixture(scope="module")
def other_model(tmp_path_factory):
    """A model of other classes."""
    path = tmp_path_factory.mktemp("other") / "other.safetensors"
    save_model(train_model(*blobs(3, 12), ignore_progress), path)
    return path


def replay(source, output=None, model=None, **wanted):
    loaded = None if model is None else load_model(model)
    kind = wanted.get("kind", "features")
    logs = LogSet(find_logs(source), kind)
    return replay_logs(logs, ReplayOptions(model=lambda _: loaded, output=output, **wanted), Flag())


def is_of_disk(message):
    """Whether it is the health of the disk: told when that was looked at, and not replayed."""
    return b"hearthlog: home disk" in message.data


def content(folder):
    """Messages of a folder of logs, as written, by the names of the logs."""
    return {
        log.relative_to(folder).as_posix(): [
            (m.topic, m.log_time, m.data) for m in LogReader(log).messages() if not is_of_disk(m)
        ]
        for log in find_logs(folder)
    }


def kept(folder, start, end):
    """The messages of some span of time by topic, but for what every file begins with."""
    found = {}
    for log in find_logs(folder):
        for m in LogReader(log).messages():
            is_start = m.topic == "/rosout" and b"recording" in m.data
            if start <= m.log_time < end and not is_start and not is_of_disk(m):
                found.setdefault(m.topic, []).append((m.log_time, m.data))
    found.pop("/mic/info", None)
    return found


def test_with_its_model_a_recording_comes_out_again_message_for_message(
    folder, model_file, tmp_path
):
    result = replay(folder, tmp_path / "again", model_file)
    recorded = content(folder)
    assert len(recorded) == 7
    assert content(tmp_path / "again") == recorded
    topics = {topic for log in recorded.values() for topic, _, _ in log}
    assert topics == {t.name for t in topics_of("mic", DEFAULT.feature_names, ["silence"])}
    assert result.compared.identical
    assert result.compared.labels == result.labels == len(read(folder, "label"))
    assert result.compared.segments == result.segments == len(read(folder, "segment"))
    assert (result.frames, result.gaps, result.missing) == (7200, 2, [])


def test_so_does_each_microphone_of_a_log_with_its_own_model(
    day, model_file, other_model, tmp_path, hearthlog
):
    sources = {
        "kitchen": LossySource(FileSource([day], START), LOST),
        "bath": FileSource([day], START + 7 * SECOND),
    }
    models = {"kitchen": model_file, "bath": other_model}
    recorded = record_together(tmp_path / "logs", sources, models)
    refused = hearthlog("replay", recorded)
    assert refused.returncode == 1
    (line,) = refused.stderr.splitlines()
    assert "(home/bath, home/kitchen); replay one at a time, with --microphone" in line
    for name, model in models.items():
        done = hearthlog(
            "replay", recorded, "--microphone", name, "--model", model, "-o", tmp_path / name
        )
        assert done.returncode == 0
        again, full = by_topic(tmp_path / name), by_topic(recorded)
        for kind in ("features", "statistics", "label", "segment"):
            assert again[f"/{name}/{kind}"]
            assert again[f"/{name}/{kind}"] == full[f"/{name}/{kind}"]
        (other,) = set(models) - {name}
        assert not any(topic.startswith(f"/{other}/") for topic in again)
        about = LogReader(find_logs(tmp_path / name)[0])
        assert about.metadata["hearthlog"]["model_sha256"] == load_model(model).sha256
        assert set(about.attachments) == {"configuration.json", "model_card.md", "model.json"}


def test_a_microphone_goes_on_where_the_model_of_another_one_changes(day, model_file, tmp_path):
    """Whose the `hearthlog` record names, as that of the first microphone."""
    sources = {name: FileSource([day], START) for name in ("kitchen", "bath")}
    logs = record_together(tmp_path / "logs", sources, dict.fromkeys(sources, model_file))
    for log in find_logs(logs)[1:]:
        found = Log(log)
        record = next(
            r for r in found.records() if isinstance(r, Metadata) and "node" in r.metadata
        )
        record.metadata |= {"model": "another", "model_sha256": "0" * 64}
        log.unlink()
        found.write(log)
    wanted = ReplayOptions(model=lambda _: load_model(model_file))
    result = replay_logs(LogSet(find_logs(logs), "features", "bath"), wanted, Flag())
    assert result.compared.identical


def by_topic(folder):
    found = {}
    for log in content(folder).values():
        for topic, *rest in log:
            found.setdefault(topic, []).append(rest)
    return found


def test_a_microphone_that_is_not_there_is_one_line_that_names_the_others(folder, hearthlog):
    result = hearthlog("replay", folder, "--microphone", "attic")
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "no microphone is called 'attic' there; choose mic" in line


def test_so_does_real_sound(household, model_file, tmp_path):
    files = spread_files(household, 26)
    settings = Settings(output=tmp_path / "recorded", model=model_file, max_bag_duration=60)
    record(settings, LossySource(FileSource(files, START), LOST), Flag())
    result = replay(tmp_path / "recorded", tmp_path / "again", model_file)
    assert result.seconds > 60
    assert content(tmp_path / "again") == content(tmp_path / "recorded")


class Trouble:
    """A microphone whose clock is set back, and which is unplugged for a while."""

    device = "trouble"

    def __init__(self, file):
        samples = np.concatenate(list(read_audio(file)))
        self._frames = samples[: 1200 * 800].reshape(3, 400, 800)

    def events(self, _stop):
        first, stamp = 0, START
        for number, samples in enumerate(self._frames):
            stamps = stamp + np.arange(400) * FRAME_NANOSECONDS
            yield Frames(first, samples, stamps)
            yield SourceHealth(int(stamps[-1]), 0, "listening", {"device": self.device})
            end = int(stamps[-1]) + FRAME_NANOSECONDS
            stamp, lost = (end - 9 * SECOND, 1) if number == 0 else (end + 30 * SECOND, 600)
            if number == 1:
                yield SourceHealth(end + 3 * SECOND, 2, "the microphone went silent")
                yield SourceHealth(end + 13 * SECOND, 2, "no such microphone")
            if number < 2:
                yield Gap(end, stamp, "trouble", lost)
            first += 400 + lost


def test_so_does_a_microphone_that_was_unplugged_and_a_clock_that_was_set_back(
    day, model_file, tmp_path
):
    settings = Settings(output=tmp_path / "recorded", model=model_file)
    record(settings, Trouble(day), Flag())
    recorded = content(tmp_path / "recorded")
    assert len(recorded) == 2
    result = replay(tmp_path / "recorded", tmp_path / "again", model_file)
    assert content(tmp_path / "again") == recorded
    assert result.compared.identical
    assert result.missing == []


def test_statistics_come_as_often_as_they_were_recorded(day, tmp_path):
    record_day(tmp_path / "recorded", day, None, statistics_every=7)
    replay(tmp_path / "recorded", tmp_path / "again")
    assert content(tmp_path / "again") == content(tmp_path / "recorded")


def test_with_another_model_it_is_as_if_that_had_recorded(folder, day, other_model, tmp_path):
    result = replay(folder, tmp_path / "again", other_model)
    record_day(tmp_path / "recorded", day, other_model)
    assert content(tmp_path / "again") == content(tmp_path / "recorded")
    assert result.compared.labels == result.labels
    assert (result.compared.same_labels, result.compared.identical_segments) == (0, 0)


def test_agreement_counts_the_labels_of_the_same_name(folder, model_file, tmp_path):
    names = {"music": "tune", "speech": "talk"}
    model = load_model(model_file)
    text = model.description.model_dump_json()
    for old, new in names.items():
        text = text.replace(f'"{old}"', f'"{new}"')
    renamed = tmp_path / "renamed.safetensors"
    description = type(model.description).model_validate_json(text)
    save_model(replace(model, description=description), renamed)
    compared = replay(folder, model=renamed).compared
    recorded = [m.label for m in read(folder, "label")]
    assert compared.labels == len(recorded)
    assert compared.same_labels == sum(label not in names for label in recorded) > 0
    assert compared.same_labels < compared.labels
    assert compared.identical_labels == compared.same_labels


def test_the_new_log_says_what_it_is_a_replay_of_and_keeps_the_configuration(
    folder, model_file, other_model, tmp_path
):
    same, other = tmp_path / "same", tmp_path / "other"
    shutil.copy(model_file, tmp_path / "copy.safetensors")
    replay(folder, same, tmp_path / "copy.safetensors")
    replay(folder, other, other_model)
    recorded, again, changed = (LogReader(find_logs(path)[0]) for path in (folder, same, other))
    assert again.attachments == recorded.attachments
    assert changed.attachments["model_card.md"] == model_card(load_model(other_model)).encode()
    assert changed.attachments["configuration.json"] == recorded.attachments["configuration.json"]
    first, last = (find_logs(folder)[i].name for i in (0, -1))
    assert again.metadata["hearthlog"] == recorded.metadata["hearthlog"] | {
        "replay_of": f"{first} … {last} (7 logs)",
        "replay_from": "features",
    }
    assert changed.metadata["hearthlog"]["model"] == "other"


@pytest.mark.parametrize(
    ("offset", "duration"),
    [(0.02, 1.0), (33.33, 20.0), (58.9, 60.0), (121.0, 10.0), (131.0, None), (299.0, 40.0)],
)
def test_a_part_is_as_in_the_whole(folder, model_file, tmp_path, offset, duration):
    result = replay(folder, tmp_path / "part", model_file, start_offset=offset, duration=duration)
    start = START + round(offset * SECOND)
    end = START + (10_000 * SECOND if duration is None else round((offset + duration) * SECOND))
    recorded, part = kept(folder, start, end), kept(tmp_path / "part", 0, 1 << 62)
    assert result.missing == []
    assert result.compared.identical
    for topic in ("features", "statistics", "label"):
        assert part[f"/mic/{topic}"] == recorded[f"/mic/{topic}"]
    assert part.get("/mic/gap") == recorded.get("/mic/gap")
    assert part.get("/diagnostics") == recorded.get("/diagnostics")
    closed_here = 0 if duration is None else 1
    for topic in ("/mic/segment", "/rosout"):
        assert part[topic][: len(part[topic]) - closed_here] == recorded.get(topic, [])


def test_a_segment_that_began_long_before_the_start_is_as_recorded(day, model_file, tmp_path):
    sound = np.concatenate(list(read_audio(day)))[: 20 * 16_000]
    sound = np.concatenate([sound, np.zeros(200 * 16_000, np.float32)])
    soundfile.write(tmp_path / "still.wav", sound, 16_000)
    settings = Settings(output=tmp_path / "recorded", model=model_file)
    record(settings, FileSource([tmp_path / "still.wav"], START), Flag())
    result = replay(tmp_path / "recorded", tmp_path / "part", model_file, start_offset=190)
    assert read(tmp_path / "recorded", "segment")[-1:] == read(tmp_path / "part", "segment")
    assert (result.compared.segments, result.compared.identical_segments) == (1, 1)


def from_the_middle(folder, model_file, hearthlog, output):
    """Labels replayed from the second log alone, recorded in it, and of what it alone has."""
    middle = find_logs(folder)[1]
    result = hearthlog("replay", middle, "--model", model_file, "-o", output)
    assert result.returncode == 3
    assert result.stderr.splitlines()[-1].startswith(
        "hearthlog: sound before 2026-03-01T07:31:00.000Z is not in these logs"
    )
    frames, stamps, values = features(middle)
    np.testing.assert_array_equal(frames, np.arange(1200, 2400))
    pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_file)))
    alone = pipeline.push_features(values, 1200, stamps)
    replayed = [encode(m) for m in read(output, "label")]
    recorded = [encode(m) for m in read(middle, "label")]
    return replayed, recorded, [m.data for m in alone if m.topic == "/mic/label"]


def test_a_log_from_the_middle_of_a_recording_starts_without_labels_and_says_so(
    folder, model_file, hearthlog, tmp_path
):
    again = tmp_path / "again"
    replayed, recorded, alone = from_the_middle(folder, model_file, hearthlog, again)
    assert len(recorded) - len(replayed) == 7 + 7  # a block for the floor, and a window
    assert replayed == alone  # how quiet the room was before is not known, either
    assert [m.frame for m in read(again, "label")] == [
        m.frame for m in read(find_logs(folder)[1], "label")[14:]
    ]


def test_a_model_that_needs_no_floor_labels_a_log_from_the_middle_as_it_was_labelled(
    second_file, day, hearthlog, tmp_path
):
    folder = record_day(tmp_path / "recorded", day, second_file)
    replayed, recorded, alone = from_the_middle(folder, second_file, hearthlog, tmp_path / "again")
    assert len(recorded) - len(replayed) == 19
    assert replayed == recorded[19:] == alone


def test_a_log_that_is_missing_in_between_is_a_gap(folder, model_file, tmp_path):
    shutil.copytree(folder, tmp_path / "recorded")
    find_logs(tmp_path / "recorded")[1].unlink()
    result = replay(tmp_path / "recorded", tmp_path / "again", model_file)
    gap = read(tmp_path / "again", "gap")[1]
    assert nanoseconds(gap.header.stamp) == START + 60 * SECOND
    assert nanoseconds(gap.duration) == 60 * SECOND
    assert gap.reason == "the log that was replayed does not have it"
    assert result.missing == [START + 120 * SECOND]
    frames, stamps, _ = features(tmp_path / "again")
    assert 1200 + gap.frames_lost == frames[np.searchsorted(stamps, START + 120 * SECOND)]


def test_a_recording_that_was_killed_comes_out_with_the_segment_that_was_open(
    day, model_file, tmp_path
):
    killed = tmp_path / "killed"

    def keep():
        shutil.copytree(tmp_path / "logs", killed)

    settings = Settings(output=tmp_path / "logs", model=model_file)
    record(
        settings,
        LossySource(FileSource([day], START), {}, at_end=keep),
        Flag(),
    )
    (recovered,) = recover_active(killed, "home")
    recorded = read(killed, "segment")
    result = replay(killed, tmp_path / "again", model_file)
    assert recovered.path.exists()
    assert result.compared.identical
    assert result.segments == len(recorded) + 1 == result.compared.segments + 1
    assert read(tmp_path / "again", "segment")[:-1] == recorded


def test_an_unfinished_log_is_replayed_up_to_its_end(folder, model_file, hearthlog, tmp_path):
    full = find_logs(folder)[0]
    cut = tmp_path / (full.name + ".active")
    cut.write_bytes(full.read_bytes()[:100_000])
    result = hearthlog("replay", cut, "--model", model_file, "-o", tmp_path / "again")
    assert result.returncode == 3
    assert f"unfinished, replayed up to the last whole chunk: {cut}" in result.stderr
    assert "bit for bit" in result.stderr
    again, recorded = features(tmp_path / "again"), features(full)
    assert 0 < len(again[0]) < len(recorded[0])
    np.testing.assert_array_equal(again[2], recorded[2][: len(again[2])])


def test_without_an_output_what_came_of_it_is_told(folder, model_file, hearthlog):
    result = hearthlog("replay", folder, "--model", model_file)
    assert (result.returncode, result.stderr) == (0, "")
    labelled, labels, segments, gaps = result.stdout.splitlines()
    count = len(read(folder, "label"))
    assert labelled.startswith("360.0 s of sound in ")
    assert labels == (
        f"{count} labels, {count} of the {count} recorded ones again (100.00%); bit for bit"
    )
    assert segments.endswith("again (100.00%); bit for bit")
    assert gaps == "2 gaps"
    found = json.loads(hearthlog("replay", folder, "--model", model_file, "--json").stdout)
    assert found["seconds"] == 360
    assert found["compared"]["bit_for_bit"] is True


def test_a_starter_model_is_found_where_it_was_recorded_with(day, hearthlog, tmp_path):
    logs = tmp_path / "logs"
    assert hearthlog("record", day, "--model", "general", "-o", logs).returncode == 0
    replayed = hearthlog("replay", logs)
    assert (replayed.returncode, replayed.stderr) == (0, "")
    assert "bit for bit" in replayed.stdout


def test_the_recorded_model_is_found_beside_the_logs_and_asked_for_by_name_if_not(
    folder, model_file, other_model, hearthlog, tmp_path
):
    logs = tmp_path / "logs"
    shutil.copytree(folder, logs)
    missing = hearthlog("replay", logs, "-o", tmp_path / "bare")
    assert missing.returncode == 3
    digest = load_model(model_file).sha256[:12]
    recorded = f"hearthlog: recorded with model 'simulated' (sha256 {digest})"
    what = "which was not found, so there are no labels: name it, or another, with --model"
    assert missing.stderr.splitlines()[0] == f"{recorded}, {what}"
    assert read(tmp_path / "bare", "label") == []
    assert len(read(tmp_path / "bare", "statistics")) == 7200 / 20
    shutil.copy(other_model, logs / "simulated.safetensors")  # of that name, but not the one
    assert hearthlog("replay", logs).returncode == 3
    shutil.copy(model_file, logs / "simulated.safetensors")
    found = hearthlog("replay", logs)
    assert (found.returncode, found.stderr) == (0, "")
    assert "bit for bit" in found.stdout
    other = hearthlog("replay", logs, "--model", other_model)
    assert other.returncode == 0
    assert other.stderr.startswith(f"{recorded}, replayed with 'other' (sha256 ")


def test_a_replay_can_go_to_rerun(folder, model_file, hearthlog, tmp_path):
    output = tmp_path / "again.rrd"
    result = hearthlog("replay", folder, "--model", model_file, "-o", output)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[0] == str(output)
    assert output.stat().st_size > 100_000
    assert list(tmp_path.iterdir()) == [output]


def test_at_a_rate_it_takes_the_time_of_the_sound(folder, model_file, tmp_path):
    began = time.monotonic()
    result = replay(folder, tmp_path / "again", model_file, duration=4.0, rate=8.0)
    assert time.monotonic() - began >= 4.0 / 8.0
    assert result.frames == 80
    (written,) = content(tmp_path / "again").values()
    assert [m for m in written if m[0] == "/mic/label"] == [
        (m.topic, m.log_time, m.data)
        for m in LogReader(find_logs(folder)[0]).messages(["/mic/label"])
        if m.log_time < START + 4 * SECOND
    ]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_and_completes_the_log(folder, model_file, tmp_path, number):
    options = ["--model", model_file, "-o", tmp_path / "again", "--rate", "1"]
    process = start("replay", folder, *options)
    active = wait_for(lambda: next(tmp_path.rglob("*.active"), None))
    wait_for(lambda: read(active, "features"))
    process.send_signal(number)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 3
    assert "interrupted after " in errors
    (log,) = find_logs(tmp_path / "again")
    assert LogReader(log).complete
    assert len(read(log, "features")) > 0


def test_a_loop_goes_on_until_it_is_stopped(folder, model_file):
    stop, shares = Flag(), []

    def progress(share):
        shares.append(share)
        if shares.count(1.0) == 2:
            stop.set()

    loaded = load_model(model_file)
    wanted = ReplayOptions(model=lambda _: loaded, loop=True)
    log = find_logs(folder)[0]
    result = replay_logs(LogSet([log], "features"), wanted, stop, progress)
    assert result.frames == 2 * len(read(log, "features"))
    assert result.compared.labels == result.compared.identical_labels
    assert not result.interrupted


def start(*arguments):
    command = [*HEARTHLOG, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def write_clips(path, clips, rate=16_000, kind="pcm-s16"):
    """Write a log of clips: (time of the first sample, int16 samples of shape (n, channels))."""
    topics = [Topic("/mic/audio", message_types.RAW_AUDIO)]
    log = LogWriter(path, topics, {"node": "home"})
    for stamp, samples in clips:
        clip = message(
            message_types.RAW_AUDIO,
            timestamp=time_message(stamp),
            data=np.frombuffer(samples.astype("<i2").tobytes(), np.uint8),
            format=kind,
            sample_rate=rate,
            number_of_channels=samples.shape[1],
        )
        log.write("/mic/audio", stamp, encode(clip))
    return log.finish()


def pieces(samples, rate, lengths):
    """Cut sound into clips of so many samples, one after the other."""
    at = 0
    for length in lengths:
        yield START + at * SECOND // rate, samples[at : at + length]
        at += length


def payloads(path, *kinds):
    return [
        (m.topic, m.log_time, m.data)
        for log in find_logs(path)
        for m in LogReader(log).messages([f"/mic/{kind}" for kind in kinds])
    ]


KINDS = ("features", "statistics", "label", "segment")


@pytest.mark.parametrize(("rate", "channels"), [(16_000, 1), (44_100, 2), (8_000, 1)])
def test_clips_of_a_recording_give_what_the_recording_gave(
    real_frames, model_file, tmp_path, rate, channels
):
    sound = (real_frames.ravel()[: 30 * rate] * 32767).astype(np.int16)
    sound = np.stack([sound, sound[::-1]][:channels], axis=1)
    soundfile.write(tmp_path / "sound.wav", sound, rate, subtype="PCM_16")
    settings = Settings(output=tmp_path / "recorded", model=model_file)
    record(settings, FileSource([tmp_path / "sound.wav"], START), Flag())
    lengths = [rate * 7, 12_345, 11, *[rate] * 30]
    clips = write_clips(tmp_path / "clips.mcap", pieces(sound, rate, lengths), rate)
    replay(clips, tmp_path / "again", model_file, kind="audio")
    assert len(read(tmp_path / "again", "label")) > 500
    assert payloads(tmp_path / "again", *KINDS) == payloads(tmp_path / "recorded", *KINDS)


def test_a_hole_between_clips_is_a_gap(real_frames, model_file, tmp_path):
    sound = (real_frames.ravel()[: 30 * 16_000] * 32767).astype(np.int16)[:, np.newaxis]
    first, second = sound[:160_100], sound[160_100:]
    later = START + 25 * SECOND
    clips = write_clips(tmp_path / "clips.mcap", [(START, first), (later, second)])
    replay(clips, tmp_path / "again", model_file, kind="audio")
    (gap,) = read(tmp_path / "again", "gap")
    assert (gap.reason, gap.frames_lost) == ("no clip holds it", 300)
    assert nanoseconds(gap.header.stamp) == START + 10 * SECOND
    frames, stamps, values = features(tmp_path / "again")
    assert frames[200] == 500
    assert stamps[200] == later
    write_clips(tmp_path / "second.mcap", [(later, second)])
    replay(tmp_path / "second.mcap", tmp_path / "alone", model_file, kind="audio")
    np.testing.assert_array_equal(values[200:], features(tmp_path / "alone")[2])
    labels = [m for m in read(tmp_path / "again", "label") if m.frame >= 500]
    timing = label_timing(load_model(model_file).description)
    assert [m.frame for m in labels] == labelled_frames(frames[200:], timing).tolist()
    # A block for the floor begins at 504 and ends at 511; the first window behind ends at 518.
    assert labels[0].frame == 515
    assert len(labels) == len(read(tmp_path / "alone", "label")) - 4


def test_clips_of_a_sound_card_that_runs_slow_are_one_sound_on_their_clock(tmp_path):
    sound = np.ones((16_000, 1), np.int16)
    slow = SECOND + 50_000  # 50 ppm
    clips = write_clips(tmp_path / "clips.mcap", [(START + i * slow, sound) for i in range(30)])
    replay(clips, tmp_path / "again", kind="audio")
    assert read(tmp_path / "again", "gap") == []
    frames, stamps, _ = features(tmp_path / "again")
    assert len(frames) == 600
    assert np.abs(stamps - START - frames * slow / 20).max() < 50_000


def test_a_part_of_clips_is_as_in_the_whole(real_frames, model_file, tmp_path):
    sound = (real_frames.ravel()[: 30 * 16_000] * 32767).astype(np.int16)[:, np.newaxis]
    clips = write_clips(tmp_path / "clips.mcap", pieces(sound, 16_000, [70_001] * 8))
    full, part = tmp_path / "whole", tmp_path / "part"
    replay(clips, full, model_file, kind="audio")
    replay(clips, part, model_file, kind="audio", start_offset=7.0, duration=9.5)
    inside = [
        m
        for m in payloads(full, "features", "statistics", "label")
        if START + 7 * SECOND <= m[1] < START + 16.5 * SECOND
    ]
    assert payloads(part, "features", "statistics", "label") == inside
    assert len(inside) == 2 * 190 + 10  # every 20th has statistics


@pytest.mark.parametrize(
    ("kind", "rate", "channels", "words"),
    [
        ("mp3", 16_000, 1, "its format is 'mp3', not 'pcm-s16'"),
        ("pcm-s16", 5, 1, "5 samples a second"),
        ("pcm-s16", 16_000, 300, "300 channels"),
    ],
)
def test_clips_of_another_format_are_refused(tmp_path, kind, rate, channels, words):
    sound = np.zeros((1000, channels), np.int16)
    log = write_clips(tmp_path / "clips.mcap", [(START, sound)], rate, kind)
    with pytest.raises(LogError, match=rf"a clip cannot be read \({words}\)"):
        replay(log, kind="audio")


def write_log(path, values, *, metadata=None, configuration=b"{}", microphones=("mic",), **info):
    """Write a log of features by hand."""
    topics = [t for name in microphones for t in topics_of(name, FEATURE_NAMES, None)]
    unique = list({t.name: t for t in topics}.values())
    attachment = Attachment("configuration.json", "application/json", configuration)
    log = LogWriter(path, unique, metadata or {}, [attachment])
    empty = {"device": "", "feature_set": "auros21", "model": "", "model_sha256": ""} | info
    about = message(
        message_types.STREAM_INFO,
        header=header(START, "mic"),
        sample_rate=16_000,
        frame_seconds=0.05,
        window_seconds=1.0,
        feature_names=list(FEATURE_NAMES),
        labels=[],
        **empty,
    )
    log.write("/mic/info", START, encode(about))
    for frame, row in enumerate(values):
        stamp = START + frame * FRAME_NANOSECONDS
        data = message(
            message_types.FEATURES,
            header=header(stamp, "mic"),
            frame=frame,
            values=np.asarray(row, np.float32),
        )
        log.write("/mic/features", stamp, encode(data))
    return log.finish()


SOUND = np.ones((30, 21))


@pytest.mark.parametrize(("configuration", "every"), [(b"{}", 1), (b'{"statistics_every": 7}', 7)])
def test_a_log_that_does_not_say_how_often_has_statistics_of_every_frame(
    tmp_path, configuration, every
):
    replay(write_log(tmp_path / "log.mcap", SOUND, configuration=configuration), tmp_path / "again")
    assert [m.frame for m in read(tmp_path / "again", "statistics")] == list(range(0, 30, every))


@pytest.mark.parametrize(
    ("values", "about", "complaint"),
    [
        (SOUND * np.nan, {}, "values that no sound has"),
        (SOUND * 1e35, {}, "values that no sound has"),
        (SOUND[:, :20], {}, "not of 21 values"),
        (SOUND[:0], {}, "no features to replay"),
        (SOUND, {"feature_set": "mel64"}, "feature set 'mel64' is not installed"),
        (SOUND, {"microphones": ("mic", "hall")}, "several microphones"),
        (SOUND, {"metadata": {"node": "../../etc"}}, "node name"),
        (SOUND, {"configuration": b'{"statistics_every": 0}'}, "configuration.json.statistics_"),
        (SOUND, {"configuration": b'{"statistics_every": "7"}'}, "configuration.json.statistics_"),
        (SOUND, {"configuration": b"[" * 100_000}, "configuration.json"),
        (SOUND, {"configuration": b"\xff"}, "configuration.json"),
    ],
)
def test_a_log_that_no_recorder_wrote_is_refused(tmp_path, values, about, complaint):
    log = write_log(tmp_path / "log.mcap", values, **about)
    with pytest.raises(LogError) as error:
        replay(log, tmp_path / "again")
    (line,) = str(error.value).splitlines()
    assert complaint in line
    assert len(line) < 400
    assert not (tmp_path / "again").exists()


def test_the_model_that_a_log_names_is_looked_for_nowhere_else(model_file, tmp_path):
    digest = load_model(model_file).sha256
    shutil.copy(model_file, tmp_path / "outside.safetensors")
    (tmp_path / "logs").mkdir()
    for name in ("../outside", str(tmp_path / "outside"), "outside\0", "x" * 10_000):
        assert find_recorded_model(name, digest, [tmp_path / "logs"]) is None
    assert find_recorded_model("outside", digest, [tmp_path / "logs", tmp_path]) is not None


def test_layers_are_no_part_of_a_recording(folder, model_file, tmp_path):
    shutil.copytree(folder, tmp_path / "recorded")
    log = find_logs(tmp_path / "recorded")[0]
    layer = log.with_name(log.stem + ".review.mcap")
    LogWriter(layer, [Topic("/mic/review/segment", message_types.SEGMENT)], {}).finish()
    result = replay(tmp_path / "recorded", tmp_path / "again", model_file)
    assert content(tmp_path / "again") == content(folder)
    assert len(result.sources) == 7


def test_logs_of_two_recorders_are_not_mixed(folder, day, hearthlog, tmp_path):
    shutil.copytree(folder, tmp_path / "recorded")
    requested = Settings(output=tmp_path / "recorded", node="flat")
    record(requested, FileSource([day], START), Flag())
    result = hearthlog("replay", tmp_path / "recorded")
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "several microphones (flat/mic, home/mic)" in line


def test_a_log_and_its_copy_are_not_one_recording(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "recorded")
    log = find_logs(tmp_path / "recorded")[2]
    shutil.copy(log, tmp_path / "recorded" / "copy.mcap")
    with pytest.raises(LogError, match="hold the same; leave out one"):
        replay(tmp_path / "recorded")


def test_a_label_that_the_recorded_model_does_not_give_is_told(
    folder, model_file, hearthlog, tmp_path
):
    reader = LogReader(find_logs(folder)[0])
    classes = load_model(model_file).classes
    topics, about = topics_of("mic", DEFAULT.feature_names, classes), reader.metadata["hearthlog"]
    log = LogWriter(tmp_path / "changed.mcap", topics, about)
    changed = 0
    for m in reader.messages():
        data = m.data
        if m.topic == "/mic/label" and changed < 3:
            label = m.decode()
            label.label = "unheard"
            data = encode(label)
            changed += 1
        log.write(m.topic, m.log_time, data)
    count = len(read(log.finish(), "label"))
    result = hearthlog("replay", log.path, "--model", model_file)
    assert result.returncode == 3
    assert f"{count - 3} of the {count} recorded ones again" in result.stdout
    assert "the same model gives other results than recorded" in result.stderr


def test_a_damaged_log_is_replayed_up_to_the_damage(folder, model_file, hearthlog, tmp_path):
    shutil.copytree(folder, tmp_path / "recorded")
    damaged = find_logs(tmp_path / "recorded")[1]
    data = bytearray(damaged.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = os.urandom(2000)
    damaged.write_bytes(data)
    result = hearthlog(
        "replay", tmp_path / "recorded", "--model", model_file, "-o", tmp_path / "again"
    )
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert f"{damaged}: damaged at byte" in line
    assert line.endswith(f"up to there it is in {tmp_path / 'again'}")
    (again,) = find_logs(tmp_path / "again")
    assert LogReader(again).complete
    recorded, replayed = (next(iter(content(path).values())) for path in (folder, again.parent))
    assert replayed[: len(recorded)] == recorded


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"output": "{full}"}, 1),
        ({"output": "{inside}"}, 1),
        ({"output": "{full}/new.mcap"}, 2),
        ({"output": "{full}/there.rrd"}, 1),
        ({"output": "{full}/new", "loop": True}, 2),
        ({"rate": "fast"}, 2),
        ({"rate": "0"}, 2),
        ({"rate": "nan"}, 2),
        ({"start_offset": math.nan}, 2),
        ({"start_offset": -1.0}, 2),
        ({"start_offset": 1e6}, 1),
        ({"playback_duration": 0.0}, 2),
        ({"source": "clips"}, 1),
        ({"model": "{full}/there.rrd"}, 1),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(folder, tmp_path, capsys, options, status):
    (tmp_path / "there.rrd").write_text("kept")
    places = {"full": tmp_path, "inside": folder / "again"}
    before = sorted(folder.rglob("*"))
    options = {
        key: Path(value.format(**places)) if key in {"output", "model"} else value
        for key, value in options.items()
    }
    with pytest.raises((typer.Exit, HearthlogError)) as refusal:
        verb(folder, **options)
    assert getattr(refusal.value, "exit_code", 1) == status
    printed = capsys.readouterr().err if status == 2 else str(refusal.value)
    assert len(printed.splitlines()) == 1
    assert (tmp_path / "there.rrd").read_text() == "kept"
    assert list(tmp_path.iterdir()) == [tmp_path / "there.rrd"]
    assert sorted(folder.rglob("*")) == before
