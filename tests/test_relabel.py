"""Logs labelled anew: as the recorder would have, whole, in parts, and after whatever happens."""

import json
import os
import re
import shutil
import signal
import subprocess
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Event as Flag

import numpy as np
import pytest
import soundfile
from blobs import with_arrays
from clusters import scheduler_in, worker_of
from conftest import HEARTHLOG
from log_fixtures import run, small_disk
from logs import features, labelled_frames
from lossy_source import LossySource
from mcap.reader import make_reader
from mcap.records import Metadata
from rewriting import Log
from stores import put
from together import record_together
from waiting import wait_for

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.errors import WorkerError
from hearthlog.analyzer.logs.layers import find_chains
from hearthlog.analyzer.relabel import layer as labels
from hearthlog.analyzer.relabel.layer import Job, complete_layer, label_logs, read_layer_metadata
from hearthlog.analyzer.relabel.relabel import relabel
from hearthlog.analyzer.workers import InlineWorkers, open_workers
from hearthlog.models.classifiers.classifier import label_timing
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.frames import NANOSECONDS, SAMPLE_RATE
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer, relabel_path
from hearthlog.schemas.logs.metadata import log_digest
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.salvage.recover import recover_log

START = 1_772_348_370_123_456_789  # half a minute after the hour
EPOCH = {"SOURCE_DATE_EPOCH": "1772348400"}


@pytest.fixture(autouse=True)
def same_time(monkeypatch):
    """Layers of one log and model differ in the time at which they were made, and nowhere else."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", EPOCH["SOURCE_DATE_EPOCH"])


# What works on files, processes and machines, whatever the sounds and the labels are.
of_one_kind = pytest.mark.parametrize("model", ["smoothed"], indirect=True)


@pytest.fixture(scope="module", params=["merged", "smoothed"])
def model(request, model_file, hmm_file):
    return model_file if request.param == "merged" else hmm_file


@pytest.fixture(scope="module")
def recording(tmp_path_factory, sounds, model):
    """Logs of a minute with gaps, labelled by the model as they were recorded."""
    folder = tmp_path_factory.mktemp("recorded")
    settings = Settings(output=folder, model=model, max_bag_duration=60)
    record(
        settings,
        LossySource(FileSource(sounds, START), {5: 7, 90: 150}),
        Flag(),
    )
    return folder


@pytest.fixture
def logs(recording, tmp_path):
    return Path(shutil.copytree(recording, tmp_path / "logs"))


@pytest.fixture(scope="module")
def layers(recording, model, tmp_path_factory):
    """What a relabelling of the whole gives, byte for byte."""
    folder = Path(shutil.copytree(recording, tmp_path_factory.mktemp("whole") / "logs"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", EPOCH["SOURCE_DATE_EPOCH"])
        assert not relabelled(model, folder).failed
    return written(folder)


def relabelled(model, *paths, workers=1):
    with open_workers(workers) as pool:
        return relabel(paths, load_model(model), model, pool)


def written(folder):
    """Layers by name; nothing else has been left beside the logs."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert all(path.suffix == ".mcap" for path in files)
    return {path.name: path.read_bytes() for path in files if is_layer(path)}


def recorded_logs(folder):
    return [path for path in find_logs(folder) if not is_layer(path)]


def rows(columns):
    """Make all that columns hold comparable."""
    return [
        columns.log_times.tolist(),
        *(columns[path].tolist() for path in sorted(columns.fields)),
    ]


def test_the_model_of_the_recording_says_the_same_again(model, logs):
    relabelled(model, logs)
    columns = read_columns(find_logs(logs))
    name = load_model(model).name
    for kind in ("label", "segment"):
        live, anew = columns[f"/mic/{kind}"], columns[f"/mic/relabel/{name}/{kind}"]
        assert len(live) > 20
        assert rows(anew) == rows(live)
        assert anew.metadata.get("probabilities_names") == live.metadata.get("probabilities_names")


@of_one_kind
def test_the_logs_are_not_touched(recording, model, logs):
    relabelled(model, logs)
    for log in recorded_logs(recording):
        assert (logs / log.relative_to(recording)).read_bytes() == log.read_bytes()


def test_any_number_of_workers_gives_the_same_bytes(model, logs, layers):
    relabelled(model, logs, workers=3)
    assert written(logs) == layers


def test_logs_one_by_one_in_any_order_give_the_same_bytes(model, logs, layers):
    for log in reversed(recorded_logs(logs)):
        relabelled(model, log)
    assert written(logs) == layers


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Five minutes of next to nothing, in logs of a minute."""
    folder = tmp_path_factory.mktemp("night")
    noise = np.random.default_rng(5).standard_normal(5 * 60 * SAMPLE_RATE) / 3000
    soundfile.write(folder / "night.wav", noise, SAMPLE_RATE)
    settings = Settings(output=folder / "logs", max_bag_duration=60)
    record(settings, FileSource([folder / "night.wav"], START), Flag())
    return folder / "logs"


def test_a_silence_over_many_logs_is_one_segment(model, night, tmp_path):
    together, alone = (Path(shutil.copytree(night, tmp_path / name)) for name in "ab")
    relabelled(model, together, workers=2)
    for log in reversed(recorded_logs(alone)):
        relabelled(model, log)
    assert written(alone) == written(together)
    segments = read_columns(find_logs(alone))[f"/mic/relabel/{load_model(model).name}/segment"]
    assert segments["duration"].max() > 4 * 60 * NANOSECONDS


def test_logs_that_come_late_change_what_was_open_in_all_behind_them(model, night, tmp_path):
    full, late = (Path(shutil.copytree(night, tmp_path / name)) for name in "ab")
    relabelled(model, full)
    first = recorded_logs(late)[0]
    first.rename(tmp_path / "first")
    relabelled(model, late)
    (tmp_path / "first").rename(first)
    relabelled(model, late)
    assert written(late) == written(full)


@of_one_kind
def test_what_is_there_is_left_alone(model, logs, layers):
    relabelled(model, logs)
    times = {path: path.stat().st_mtime_ns for path in find_logs(logs)}
    again = relabelled(model, logs)
    assert (again.layers, again.frames, len(again.current)) == ([], 0, len(layers))
    assert {path: path.stat().st_mtime_ns for path in find_logs(logs)} == times


@of_one_kind
def test_what_is_missing_is_made(model, logs, layers):
    relabelled(model, logs)
    gone = [path for path in find_logs(logs) if is_layer(path)][1::2]
    for path in gone:
        path.unlink()
    again = relabelled(model, logs)
    assert sorted(again.layers) == sorted(gone)
    assert written(logs) == layers


@of_one_kind
def test_a_log_that_comes_later_has_the_layer_before_it_made_again(model, logs, layers, tmp_path):
    """Until then, what was open at its end had to be closed there."""
    later = recorded_logs(logs)[1:]
    for number, log in enumerate(later):
        log.rename(tmp_path / str(number))
    relabelled(model, logs)
    for number, log in enumerate(later):
        (tmp_path / str(number)).rename(log)
        relabelled(model, logs)
    assert written(logs) == layers


@of_one_kind
def test_a_log_behind_without_a_frame_does_not_end_what_is_open(model, logs, layers):
    """A recorder has begun the next log and not yet written into it."""
    log, behind, *_ = recorded_logs(logs)
    data = behind.read_bytes()
    active = behind.with_name(behind.name + ".active")
    behind.unlink()
    active.write_bytes(data[:300])
    relabelled(model, log)
    active.unlink()
    behind.write_bytes(data)
    relabelled(model, logs)
    assert written(logs) == layers


@of_one_kind
def test_layers_stay_when_logs_beside_theirs_are_deleted(model, logs, layers):
    relabelled(model, logs)
    for log in recorded_logs(logs)[:2]:
        log.unlink()
        relabel_path(log, load_model(model).name).unlink()
    kept = written(logs)
    again = relabelled(model, logs)
    assert (again.layers, len(again.current)) == ([], len(layers) - 2)
    assert written(logs) == kept


@of_one_kind
def test_a_run_that_is_killed_goes_on_where_it_was(model, logs, layers):
    command = [*HEARTHLOG, "relabel", str(logs), "--model", str(model), "--workers", "2"]
    for _ in range(3):
        process = subprocess.Popen(command, start_new_session=True)
        wait_for(lambda: begun(logs) or complete(logs, layers))
        process.send_signal(signal.SIGKILL)
        process.wait()
    wait_for(lambda: not busy(logs))
    found = relabelled(model, logs)
    assert not found.failed
    assert written(logs) == layers


@of_one_kind
def test_what_a_killed_worker_left_of_a_complete_layer_is_deleted_by_the_next_run(model, logs):
    (first, *_) = relabelled(model, logs).layers
    remains = [first.with_name(f".{first.name}.0123456789abcdef.{end}") for end in ("part", "tmp")]
    others = [first.with_name(".notes.part"), first.with_name(f".{first.name}.0123.txt")]
    for path in (*remains, *others):
        path.write_bytes(b"labels")
    again = relabelled(model, logs)
    assert first in again.current
    assert not any(path.exists() for path in remains)
    assert all(path.exists() for path in others)


def complete(folder, layers):
    return sum(map(is_layer, find_logs(folder))) == len(layers)


def begun(folder):
    return any(path.suffix == ".part" for path in folder.rglob("*"))


def busy(folder):
    """Tell whether a process still has a file of a folder open."""
    fds = (fd for process in Path("/proc").glob("[0-9]*") for fd in opened(process))
    return any(str(folder) in fd for fd in fds)


def opened(process):
    try:
        return [str(fd.readlink()) for fd in (process / "fd").iterdir()]
    except OSError:
        return []


@of_one_kind
def test_two_runs_at_once_do_not_hinder_each_other(model, logs, layers):
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda _: relabelled(model, logs, workers=2), range(2)))
    assert [one.failed for one in both] == [{}, {}]
    assert written(logs) == layers


@of_one_kind
def test_a_layer_says_what_made_it(model, logs):
    relabelled(model, logs)
    log, behind = recorded_logs(logs)[:2]
    loaded = load_model(model)
    about = read_layer_metadata(relabel_path(log, loaded.name))
    assert about.model_sha256 == loaded.sha256
    assert about.input_sha256 == log_digest(log)
    assert (about.before, about.behind) == ("", behind.stem)


@of_one_kind
def test_layers_are_sound(model, logs):
    relabelled(model, logs)
    kinds = {kind for findings in examine(logs) for kind in findings.counts}
    assert kinds <= {("warning", "gap")}


@of_one_kind
def test_layers_do_not_run_back_in_time(model, logs):
    relabelled(model, logs)
    layers = [path for path in find_logs(logs) if is_layer(path)]
    for path in layers:
        with path.open("rb") as stream:
            read = [
                (message.log_time, "segment" in channel.topic)
                for _, channel, message in make_reader(stream).iter_messages(log_time_order=False)
            ]
        assert read == sorted(read)  # of one time the label comes first
    assert any(segment for _, segment in read[:-1])


@of_one_kind
def test_a_chunk_of_a_layer_spans_a_minute_at_most(model, logs):
    relabelled(model, logs)
    for path in find_logs(logs):
        with LogFile(path) as file:
            if is_layer(path):
                spans = file.chunks["end"] - file.chunks["start"]
                assert (spans < 60 * NANOSECONDS).all()


@of_one_kind
def test_chunks_of_a_layer_are_cut_by_time(model, logs, monkeypatch):
    monkeypatch.setattr(labels, "_CHUNK_SPAN", 10 * NANOSECONDS)  # logs have a minute
    relabelled(model, logs)
    layer = relabel_path(recorded_logs(logs)[1], load_model(model).name)
    with LogFile(layer) as file:
        spans = file.chunks["end"] - file.chunks["start"]
    assert (spans < 10 * NANOSECONDS).all()
    assert len(spans) > 3


@of_one_kind
def test_labels_that_were_written_out_of_order_give_the_same_layer(model, logs, monkeypatch):
    monkeypatch.setattr(labels, "_PIECE_SPAN", NANOSECONDS)
    loaded, log = load_model(model), recorded_logs(logs)[1]
    layer = relabel_path(log, loaded.name)
    job = Job(log, layer, (), None, model, loaded.sha256, replaces=False, continues_layer=False)
    made = []
    for step in (1, -1):
        (labelled,) = label_logs([job])
        rows = np.fromfile(labelled.part, labels._row_type(len(loaded.classes)))
        rows[::step].tofile(labelled.part)
        complete_layer(job, labelled)
        made.append(layer.read_bytes())
        layer.unlink()
    assert made[0] == made[1]


@of_one_kind
def test_a_damaged_log_is_labelled_where_it_is_whole(model, logs, tmp_path, capfd):
    log = recorded_logs(logs)[1]
    with LogFile(log) as file:
        chunk = file.chunks[len(file.chunks) // 2]
    data = bytearray(log.read_bytes())
    data[int(chunk["offset"]) + 200] ^= 255
    log.write_bytes(data)

    done = run(capfd, "relabel", logs, "--model", model, "--workers", 1)

    assert done.returncode == 3
    assert f"partly relabelled: {log}" in done.stderr
    assert log.read_bytes() == data
    (tmp_path / "saved").mkdir()
    recover_log(log, tmp_path / "saved" / log.name, log.name)
    recorded = np.concatenate(
        [features(recorded_logs(logs)[0])[0], features(tmp_path / "saved")[0]]
    )
    full = labelled_frames(recorded, label_timing(load_model(model).description))
    frames = frames_of_layer(log, model)
    assert frames.tolist() == full[-len(frames) :].tolist()
    assert 200 < len(frames) < 1200 - 19
    again = run(capfd, "relabel", logs, "--model", model, "--workers", 1)
    assert again.returncode == 3


def frames_of_layer(log, model):
    name = load_model(model).name
    columns = read_columns([relabel_path(log, name)])[f"/mic/relabel/{name}/label"]
    return columns["frame"].astype(np.int64)


@of_one_kind
@pytest.mark.parametrize("place", [-1, 1])
def test_logs_behind_a_damaged_one_do_not_depend_on_how_they_are_done(model, logs, place, tmp_path):
    log = recorded_logs(logs)[0]
    with LogFile(log) as file:
        chunk = file.chunks[place]
    data = bytearray(log.read_bytes())
    data[int(chunk["offset"]) + 100] ^= 255
    log.write_bytes(data)
    other = Path(shutil.copytree(logs, tmp_path / "other"))
    relabelled(model, logs)
    for each in reversed(recorded_logs(other)):
        relabelled(model, each)
    assert written(other) == written(logs)


@of_one_kind
def test_a_log_that_is_cut_off_is_labelled_up_to_there(model, logs, capfd):
    log = recorded_logs(logs)[1]
    data = log.read_bytes()
    log.write_bytes(data[: len(data) * 2 // 3])
    done = run(capfd, "relabel", log, "--model", model, "--workers", 1)
    assert done.returncode == 3
    assert "cut off" in done.stderr
    assert len(frames_of_layer(log, model)) > 200


@of_one_kind
def test_a_log_that_is_being_written_is_left_for_later(model, logs, capfd):
    *_, last = recorded_logs(logs)
    last.rename(last.with_name(last.name + ".active"))
    done = run(capfd, "relabel", logs, "--model", model, "--workers", 1)
    assert done.returncode == 0
    assert "1 log still being written" in done.stdout


@of_one_kind
def test_one_that_is_no_log_costs_nothing_else(model, logs, layers, capfd):
    bad = recorded_logs(logs)[0].with_name("note.mcap")
    bad.write_bytes(b"this is no log" * 100)
    done = run(capfd, "relabel", logs, "--model", model, "--workers", 1)
    assert done.returncode == 3
    assert done.stderr.count("not relabelled") == 1
    assert f"not relabelled: {bad}" in done.stderr
    assert set(written(logs)) == set(layers)


@of_one_kind
def test_a_layer_of_another_model_of_that_name_is_kept(model, logs, tmp_path, capfd):
    relabelled(model, logs)
    before = written(logs)
    loaded = load_model(model)
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / model.name
    save_model(with_arrays(loaded, bias=-loaded.arrays["bias"]), other)
    done = run(capfd, "relabel", logs, "--model", other, "--workers", 1)
    assert done.returncode == 1
    assert "was made by another model of this name" in done.stderr
    assert written(logs) == before


@of_one_kind
def test_a_layer_of_another_log_of_that_name_is_kept(model, logs, capfd):
    first, second = recorded_logs(logs)[:2]
    relabelled(model, first)
    before = written(logs)
    shutil.copy(second, first)
    done = run(capfd, "relabel", first, "--model", model, "--workers", 1)
    assert done.returncode == 1
    assert "was made from another log of this name" in done.stderr
    assert written(logs) == before


@of_one_kind
def test_what_is_no_layer_is_kept(model, logs, capfd):
    log = recorded_logs(logs)[0]
    layer = relabel_path(log, load_model(model).name)
    shutil.copy(log, layer)
    data = layer.read_bytes()
    done = run(capfd, "relabel", log, "--model", model, "--workers", 1)
    assert done.returncode == 1
    assert f"{layer}: is no layer of `relabel`" in done.stderr
    assert layer.read_bytes() == data


@of_one_kind
def test_a_layer_is_no_log_to_label(model, logs, capfd):
    relabelled(model, logs)
    layer = relabel_path(recorded_logs(logs)[0], load_model(model).name)
    done = run(capfd, "relabel", layer, "--model", model, "--workers", 1)
    assert done.returncode == 1
    assert done.stderr.endswith(f"{layer}: is a layer; name the log that it speaks of\n")


@of_one_kind
def test_where_a_layer_cannot_be_made_those_behind_it_are_as_ever(model, logs, night):
    name = load_model(model).name
    for folder in (logs, Path(shutil.copytree(night, logs.parent / "night"))):
        full = Path(shutil.copytree(folder, folder.parent / f"{folder.name}-whole"))
        relabelled(model, full)
        bad = relabel_path(recorded_logs(folder)[1], name)
        bad.write_bytes(b"no layer")
        found = relabelled(model, folder, workers=2)
        assert len(found.failed) == 1
        assert written(folder) == written(full) | {bad.name: b"no layer"}


@of_one_kind
def test_logs_follow_each_other_by_name_or_else_by_time(recording, tmp_path):
    first, second = recorded_logs(recording)[:2]
    shutil.copy(first, tmp_path / "b.mcap")
    shutil.copy(second, tmp_path / "a.mcap")
    (chain,) = find_chains([tmp_path / "a.mcap"])
    assert ([path.name for path in chain.logs], list(chain.requested)) == (
        ["b.mcap", "a.mcap"],
        [1],
    )


@of_one_kind
def test_homes_are_apart_and_so_are_folders_that_only_look_like_days(recording, tmp_path):
    log = recorded_logs(recording)[0]
    places = ["anna/2026/03/01", "anna/2026/03/02", "berta/2026/03/01", "anna/20/3/1", "anna"]
    for place in places:
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        shutil.copy(log, tmp_path / place)
    folders = [
        sorted(path.relative_to(tmp_path).parent.as_posix() for path in chain.logs)
        for chain in find_chains([tmp_path])
    ]
    assert sorted(folders) == [
        ["anna", "anna/2026/03/01", "anna/2026/03/02"],
        ["anna/20/3/1"],
        ["berta/2026/03/01"],
    ]


@pytest.fixture(scope="module")
def two_rooms(tmp_path_factory, day):
    """What two microphones heard: in one log, and each in logs of its own."""
    folder = tmp_path_factory.mktemp("rooms")
    noise = np.random.default_rng(5).standard_normal(5 * 60 * SAMPLE_RATE) / 3000
    soundfile.write(folder / "night.wav", noise, SAMPLE_RATE)

    def sources():
        return {
            "kitchen": LossySource(FileSource([day], START), {5: 7, 90: 150}),
            "bath": FileSource([folder / "night.wav"], START + 7 * NANOSECONDS),
        }

    record_together(folder / "both", sources())
    for name, source in sources().items():
        record_together(folder / name, {name: source})
    return folder


@pytest.fixture
def rooms(two_rooms, tmp_path):
    return Path(shutil.copytree(two_rooms, tmp_path / "rooms"))


def test_each_microphone_of_a_log_is_labelled_as_if_it_were_alone(model, rooms):
    assert not relabelled(model, rooms / "both", workers=2).failed
    together = read_columns(find_logs(rooms / "both"))
    name = load_model(model).name
    for microphone in ("kitchen", "bath"):
        relabelled(model, rooms / microphone)
        alone = read_columns(find_logs(rooms / microphone))
        for kind in ("label", "segment"):
            topic = f"/{microphone}/relabel/{name}/{kind}"
            assert len(alone[topic]) > (20 if microphone == "kitchen" else 0)
            assert rows(together[topic]) == rows(alone[topic])


def test_logs_of_two_microphones_one_by_one_in_any_order_give_the_same_bytes(model, rooms):
    one_by_one = Path(shutil.copytree(rooms / "both", rooms / "again"))
    relabelled(model, rooms / "both", workers=2)
    for log in reversed(recorded_logs(one_by_one)):
        relabelled(model, log)
    assert written(one_by_one) == written(rooms / "both")
    again = relabelled(model, one_by_one)
    assert (again.layers, len(again.current)) == ([], len(recorded_logs(one_by_one)))


@of_one_kind
def test_layers_of_two_microphones_are_sound(model, rooms):
    relabelled(model, rooms / "both")
    kinds = {kind for findings in examine(rooms / "both") for kind in findings.counts}
    assert kinds <= {("warning", "gap")}


@of_one_kind
def test_a_layer_that_names_no_microphone_of_its_open_segments_is_current(model, rooms):
    """As layers were before a log could be of several microphones."""
    relabelled(model, rooms / "bath")
    rewritten = 0
    for layer in (path for path in find_logs(rooms / "bath") if is_layer(path)):
        found = Log(layer)
        record = next(
            r for r in found.records() if isinstance(r, Metadata) and "began" in r.metadata
        )
        for key in ("began", "ended"):
            if text := record.metadata[key]:
                record.metadata[key] = json.dumps(json.loads(text)["bath"])
                rewritten += 1
        layer.unlink()
        found.write(layer)
    assert rewritten > 4
    again = relabelled(model, rooms / "bath")
    assert (again.failed, again.layers) == ({}, [])
    assert len(again.current) == len(recorded_logs(rooms / "bath"))


@of_one_kind
def test_a_microphone_of_other_features_is_left_out_and_named(model, day, tmp_path, capfd):
    source = {name: FileSource([day], START) for name in ("kitchen", "bath")}
    logs = record_together(tmp_path / "logs", {"bath": source["bath"]})
    other = record_together(
        tmp_path / "other", {"kitchen": source["kitchen"]}, feature_set="auros21"
    )
    for log, second in zip(recorded_logs(logs), recorded_logs(other), strict=True):
        run(capfd, "merge", log, second, "-o", tmp_path / "merged.mcap")
        (tmp_path / "merged.mcap").replace(log)
    done = run(capfd, "relabel", logs, "--model", model, "--workers", 1)
    assert done.returncode == 0
    assert "needs other features: kitchen (features of auros21)\n" in done.stderr
    topics = {topic for path in find_logs(logs) if is_layer(path) for topic in read_columns([path])}
    assert {topic.split("/")[1] for topic in topics} == {"bath"}


@of_one_kind
def test_logs_without_features_are_named(model, tmp_path, recording, capfd):
    log = recorded_logs(recording)[0]
    done = run(capfd, "cut", log, "-o", tmp_path / "cut.mcap", "--topics", "/mic/segment")
    assert done.returncode == 0
    done = run(capfd, "relabel", tmp_path / "cut.mcap", "--model", model, "--workers", 1)
    assert done.returncode == 1
    assert "cut.mcap: has no features" in done.stderr
    assert written(tmp_path) == {}


@of_one_kind
def test_a_log_that_cannot_be_labelled_costs_nothing_but_its_own_layer(
    model, logs, layers, tmp_path, capfd
):
    log = recorded_logs(logs)[1]
    run(capfd, "cut", log, "-o", tmp_path / "cut.mcap", "--topics", "/mic/label")
    (tmp_path / "cut.mcap").replace(log)
    done = run(capfd, "relabel", logs, "--model", model, "--workers", 2)
    assert done.returncode == 3
    assert f"{log}: has no features" in done.stderr
    assert set(written(logs)) == set(layers) - {relabel_path(log, load_model(model).name).name}


class DeadlyWorkers(InlineWorkers):
    """Lose the worker of each task that has a certain log."""

    def __init__(self, victim):
        self.victim = victim

    def submit(self, function, *args):
        if function is label_logs and self.victim in {job.log for job in args[0]}:
            lost = Future()
            lost.set_exception(WorkerError("the task lost its worker 3 times"))
            return lost
        return super().submit(function, *args)


@of_one_kind
def test_a_log_that_kills_its_worker_costs_nothing_but_its_own_layer(model, night, tmp_path):
    logs = Path(shutil.copytree(night, tmp_path / "night"))
    full = Path(shutil.copytree(night, tmp_path / "whole"))
    relabelled(model, full)
    victim = recorded_logs(logs)[2]
    done = relabel([logs], load_model(model), model, DeadlyWorkers(victim))
    assert done.failed == {victim: "the task lost its worker 3 times"}
    layer = relabel_path(victim, load_model(model).name).name
    assert written(logs) == {k: v for k, v in written(full).items() if k != layer}


@of_one_kind
def test_a_full_disk_leaves_nothing_half_written(model, recording, tmp_path, capfd):
    with small_disk(tmp_path / "disk", "3m") as disk:
        for log in recorded_logs(recording)[:3]:
            shutil.copy(log, disk)
        space = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        (disk / "fill").write_bytes(b"x" * (space - 20_000))
        done = run(capfd, "relabel", disk, "--model", model, "--workers", 1)
        assert done.returncode == 1
        assert "No space left" in done.stderr
        assert "Traceback" not in done.stderr
        assert sorted(p.name for p in disk.iterdir() if "relabel" in p.name) == []


@of_one_kind
def test_logs_of_two_nodes_in_one_folder_are_two_sounds(model, logs, layers):
    for log in recorded_logs(logs):
        shutil.copy(log, log.with_name(log.name.replace("home_", "attic_")))
    assert [len(chain.logs) for chain in find_chains([logs])] == [len(layers)] * 2
    relabelled(model, logs)
    found = written(logs)
    assert {name: data for name, data in found.items() if name in layers} == layers


@of_one_kind
def test_no_logs_are_one_line(model, tmp_path, capfd):
    done = run(capfd, "relabel", tmp_path, "--model", model)
    assert (done.returncode, done.stderr.count("\n")) == (1, 2)
    assert f"{tmp_path}: no log" in done.stderr


@of_one_kind
@pytest.mark.parametrize("store", ["bucket", "in_memory"])
def test_logs_in_a_store_are_relabelled_where_they_are(request, recording, model, layers, store):
    folder = put(recording, request.getfixturevalue(store))
    found = relabelled(model, folder)
    assert not found.failed
    files = {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert {name: data for name, data in files.items() if ".relabel-" in name} == layers
    assert not [name for name in files if name.startswith(".")]
    again = relabelled(model, folder)
    assert (len(again.current), again.failed) == (len(layers), {})


@of_one_kind
def test_workers_find_logs_and_the_model_in_a_store(recording, model, layers, bucket, hearthlog):
    folder = put(recording, bucket)
    there = folder / "models" / model.name
    there.fs.pipe_file(there.path, model.read_bytes())
    done = hearthlog("relabel", folder, "--model", there, "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert {p.name for p in find_logs(folder) if is_layer(p)} == set(layers)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of a cluster of two workers."""
    folder = tmp_path_factory.mktemp("dask")
    with scheduler_in(folder) as (address, _), worker_of(address), worker_of(address):
        yield address


@of_one_kind
def test_a_cluster_gives_the_same_bytes(model, logs, layers, scheduler, hearthlog):
    done = hearthlog("relabel", logs, "--model", model, "--scheduler", scheduler, env=EPOCH)
    assert done.returncode == 0, done.stderr
    assert drop_made(written(logs)) == drop_made(layers)


def drop_made(layers):
    """The workers of a cluster have a time of their own."""
    return {
        name: re.sub(rb"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\dZ", b"", data)
        for name, data in layers.items()
    }


@of_one_kind
def test_a_scheduler_that_is_not_there_is_one_line(model, logs, hearthlog):
    done = hearthlog("relabel", logs, "--model", model, "--scheduler", "tcp://127.0.0.1:9")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "hearthlog: no Dask scheduler at tcp://127.0.0.1:9"
    )
    assert written(logs) == {}


@of_one_kind
def test_after_the_scheduler_went_away_a_run_completes_what_is_left(model, logs, layers, tmp_path):
    with scheduler_in(tmp_path) as (address, scheduler), worker_of(address):
        command = [*HEARTHLOG, "relabel", str(logs), "--model", str(model), "--scheduler", address]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            wait_for(lambda: begun(logs) or complete(logs, layers))
            scheduler.kill()
            _, output = process.communicate(timeout=60)
        assert process.returncode in {1, 3}
        assert "Traceback" not in output
        assert f"the Dask scheduler at {address} is gone" in output
    wait_for(lambda: not busy(logs))
    for layer in (path for path in find_logs(logs) if is_layer(path)):
        layer.unlink()
    assert not relabelled(model, logs).failed
    assert written(logs) == layers


def test_a_starter_model_relabels_by_its_name(hearthlog, household, tmp_path):
    sound = next(household.rglob("*.flac"))
    logs = tmp_path / "logs"
    hearthlog("record", sound, "--model", "bathroom", "-o", logs, "--start", "2026-03-01T07:00")
    result = hearthlog("relabel", logs, "--model", "general")
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("1 layer of")
