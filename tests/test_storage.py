"""Logs in a store are read by ranges, and layers are put there, as on this machine."""

import json
import os
import pickle
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from conftest import HEARTHLOG, spread_files
from log_fixtures import raw_messages, run
from logreader import LogReader
from stores import account, put

from hearthlog.analyzer.logs.locations import location
from hearthlog.analyzer.logs.recorder_info import read_recorder_infos
from hearthlog.analyzer.logs.selection import select
from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, time_span, topic_counts
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.mcap.chunks import read_chunks
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.new_files import (
    check_new,
    create_file,
    hand_over,
    make_folders,
    new_file,
    new_folder,
    open_lock,
    private_folder,
    replaced_file,
)

START = 1_772_352_000 * NANOSECONDS


@pytest.fixture(scope="module")
def logs(all_household, model_file, tmp_path_factory) -> Path:
    """Eleven minutes of real sound, in logs of five."""
    folder = tmp_path_factory.mktemp("logs")
    settings = Settings(output=folder, model=model_file, max_bag_duration=300)
    sounds = spread_files(all_household, 175)
    record(settings, FileSource(sounds, START), threading.Event())
    assert len(find_logs(folder)) > 2
    return folder


@pytest.fixture(params=["bucket", "in_memory"])
def empty(request) -> Path:
    """A folder in a store, where folders are there when something is in them."""
    return request.getfixturevalue(request.param) / "home"


@pytest.fixture
def store(empty, logs) -> Path:
    """The same logs in a store."""
    return put(logs, empty)


@pytest.fixture
def fetched(monkeypatch):
    """Count what comes from a store: return the sizes of its answers."""

    def count(store: Path) -> list[int]:
        sizes: list[int] = []
        cat_file = store.fs.cat_file

        def counting(*arguments, **options):
            read = cat_file(*arguments, **options)
            sizes.append(len(read))
            return read

        monkeypatch.setattr(store.fs, "cat_file", counting)
        return sizes

    return count


@pytest.fixture
def hearthlog(capfd):
    return partial(run, capfd)


def messages(paths, *query) -> list[tuple]:
    return [
        (raw.channel.topic, time, raw.buffer[offset : offset + size].tobytes())
        for batch in iterate_messages(paths, *query)
        for raw in batch
        for offset, size, time in zip(raw.offsets, raw.sizes, raw.log_times, strict=True)
    ]


def test_logs_are_found_in_a_store_under_their_names(logs, store):
    names = [str(path.relative_to(logs)) for path in find_logs(logs)]
    assert [str(path) for path in find_logs(store)] == [f"{store}/{name}" for name in names]
    log = find_logs(store)[1]
    assert find_logs(log) == [log]
    assert log.name == find_logs(logs)[1].name


def test_messages_of_a_store_are_those_of_this_machine(logs, store):
    here, there = find_logs(logs), find_logs(store)
    assert messages(there) == messages(here)
    window = ["/mic/label"], START + 290 * NANOSECONDS, START + 310 * NANOSECONDS
    assert messages(there, *window) == messages(here, *window)
    assert [m.data for m in LogReader(there[0]).messages()] == [
        m.data for m in LogReader(here[0]).messages()
    ]


def test_columns_of_a_store_are_those_of_this_machine(logs, store):
    here, there = read_columns(find_logs(logs)), read_columns(find_logs(store))
    assert there.keys() == here.keys()
    for topic, columns in here.items():
        assert columns.fields.keys() == there[topic].fields.keys()
        for path, values in columns.fields.items():
            if values.dtype == object:
                assert str(values.tolist()) == str(there[topic][path].tolist())
            else:
                np.testing.assert_array_equal(there[topic][path], values)


def test_what_logs_of_a_store_say_of_themselves_is_read(logs, store):
    for here, there in zip(find_logs(logs), find_logs(store), strict=True):
        assert time_span(there) == time_span(here)
        assert topic_counts(there) == topic_counts(here)
        (one,), (other,) = (read_recorder_infos(path, "features") for path in (here, there))
        assert other.path == there
        assert (other.node, other.microphone, other.model_sha256, other.first_frame) == (
            one.node,
            one.microphone,
            one.model_sha256,
            one.first_frame,
        )
        with LogFile(here) as a, LogFile(there) as b:
            assert b.size == a.size
            assert b.complete
            np.testing.assert_array_equal(b.chunks, a.chunks)
            there_records = [b.record(location) for location in b.record_locations]
            assert there_records == [a.record(location) for location in a.record_locations]
            assert b.is_at(there)
            assert not b.is_at(there.with_name("other.mcap"))


def test_logs_of_this_machine_and_of_a_store_are_selected_together(logs, store):
    selection = select([logs, store, store / "2026"], ["/mic/segment"])
    assert len(selection.logs) == 2 * len(find_logs(logs))
    count = sum(len(raw) for batch in selection.messages() for raw in batch)
    assert count == 2 * topic_total(logs, "/mic/segment")


def topic_total(logs, topic):
    return sum(topic_counts(path)[topic] for path in find_logs(logs))


def test_an_unfinished_log_of_a_store_is_read_up_to_its_last_whole_chunk(store, logs, fetched):
    full = find_logs(logs)[0].read_bytes()
    cut = store / "cut.mcap.active"
    cut.fs.pipe_file(cut.path, full[: len(full) // 2])
    sizes = fetched(store)
    with LogFile(cut) as file:
        assert not file.complete
        assert len(file.chunks) > 5
        assert sum(len(raw) for raw in read_chunks(file, file.chunks))
    assert len(sizes) < 100  # there are thousands of records


def test_few_bytes_are_fetched_for_a_short_span(store, fetched):
    log = find_logs(store)[1]
    first, _ = time_span(log)
    sizes = fetched(store)
    begin = first + 100 * NANOSECONDS
    assert len(messages([log], ["/mic/label"], begin, begin + NANOSECONDS)) == 20
    assert len(sizes) <= 5
    assert max(sizes) <= 1 << 17


def test_only_the_ends_of_logs_are_fetched_to_know_their_spans(store, fetched):
    sizes = fetched(store)
    assert all(map(time_span, find_logs(store)))
    assert sum(sizes) <= len(find_logs(store)) * (1 << 18)


@pytest.mark.parametrize("verb", [["info"], ["info", "--json"]])
def test_info_says_the_same_of_a_bucket(hearthlog, logs, bucket, verb):
    home = put(logs, bucket / "home")
    here, there = hearthlog(*verb, logs), hearthlog(*verb, home)
    assert there.returncode == here.returncode == 0
    assert there.stdout.replace(str(home), str(logs)) == here.stdout
    one = hearthlog(*verb, find_logs(home)[0])
    assert one.stdout.replace(str(home), str(logs)) == hearthlog(*verb, find_logs(logs)[0]).stdout


@pytest.mark.parametrize("output", ["text", "ndjson", "csv"])
def test_cat_prints_the_same_of_a_bucket(hearthlog, logs, bucket, output):
    home = put(logs, bucket / "home")
    options = ["--topics", "/mic/label", "--start", "2026-03-01T08:04:50", "--format", output]
    here, there = hearthlog("cat", logs, *options), hearthlog("cat", home, *options)
    assert there == here
    assert there.stdout.count("\n") > 1000


def test_logs_of_a_bucket_are_merged_on_this_machine(hearthlog, logs, bucket, tmp_path):
    home = put(logs, bucket / "home")
    for source, name in ((logs, "here.mcap"), (home, "there.mcap")):
        result = hearthlog("merge", source, "--output", tmp_path / name)
        assert (result.returncode, result.stderr) == (0, "")
    assert raw_messages(tmp_path / "there.mcap") == raw_messages(tmp_path / "here.mcap")


def test_the_name_of_a_file_is_a_plain_path(tmp_path):
    assert type(location(str(tmp_path))) is type(tmp_path)
    assert location("logs/a b.mcap") == Path("logs/a b.mcap")
    assert location(f"file://{tmp_path}/a.mcap") == tmp_path / "a.mcap"
    assert str(location("s3://bucket/home")) == "s3://bucket/home"
    assert str(location("s3://bucket/home") / "a.mcap") == "s3://bucket/home/a.mcap"


def test_a_path_of_a_store_goes_to_other_processes(bucket, logs):
    log = find_logs(put(logs, bucket / "home"))[0]
    count = "import pickle, sys; from hearthlog.schemas.logs.files import topic_counts; "
    count += "print(topic_counts(pickle.load(sys.stdin.buffer))['/mic/label'])"
    command = [sys.executable, "-c", count]
    done = subprocess.run(command, input=pickle.dumps(log), capture_output=True, check=True)
    assert int(done.stdout) == topic_counts(log)["/mic/label"]


def test_reading_and_recording_logs_of_this_machine_needs_no_store():
    modules = ("schemas.logs.columns", "schemas.logs.files", "recorder.recording")
    imports = "import " + ", ".join(
        f"hearthlog.{module}" for module in (*modules, "tools.cli.main")
    )
    check = "import sys; assert not {'fsspec', 'upath', 's3fs'} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", f"{imports}; {check}"], check=True)


def test_a_file_is_put_in_a_store_when_it_is_written(empty):
    path = empty / "2026" / "new.relabel-m.mcap"
    with new_file(path) as temporary:
        temporary.write_bytes(b"layer")
        assert not path.exists()
    assert path.read_bytes() == b"layer"
    assert not temporary.parent.exists()


def test_a_file_that_could_not_be_written_is_not_put_in_a_store(empty):
    path = empty / "new.mcap"
    with suppress(RuntimeError), new_file(path) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert not path.exists()
    assert not temporary.parent.exists()


def test_nothing_in_a_store_is_overwritten(empty):
    path = empty / "there.mcap"
    path.write_bytes(b"there")
    with pytest.raises(LogError, match="exists already"):
        check_new(path)
    with pytest.raises(LogError, match="exists already"), new_file(path):
        pass
    late = empty / "late.mcap"
    with pytest.raises(LogError, match="exists already"), new_file(late):
        late.write_bytes(b"of another")
    assert path.read_bytes() == b"there"
    assert late.read_bytes() == b"of another"


def test_s3_itself_refuses_a_name_that_was_given_in_the_last_moment(bucket, monkeypatch):
    path = bucket / "late.mcap"
    path.write_bytes(b"of another")
    monkeypatch.setattr(path.fs, "exists", lambda *_: False)  # as it was when we looked
    with pytest.raises(LogError, match=r"late.mcap: exists already"), new_file(path) as temporary:
        temporary.write_bytes(b"mine")
    assert path.read_bytes() == b"of another"


def test_a_file_of_a_store_is_replaced_on_purpose(empty):
    path = empty / "review.mcap"
    for content in (b"one", b"two"):
        with replaced_file(path) as temporary:
            temporary.write_bytes(content)
    assert path.read_bytes() == b"two"


def test_what_others_put_in_a_bucket_is_seen_at_once(bucket, logs):
    home = put(find_logs(logs)[-1].parent, bucket / "home")
    before = find_logs(home)
    assert home.is_dir()
    layer = before[0].with_name("other.mcap")
    add = "import sys; from hearthlog.analyzer.logs.locations import location; "
    add += "location(sys.argv[1]).write_bytes(b'x')"
    subprocess.run([sys.executable, "-c", add, str(layer)], check=True)
    assert layer.exists()
    assert layer in find_logs(home)
    with pytest.raises(LogError, match="exists already"):
        check_new(layer)


def test_a_log_that_vanishes_while_it_is_read_is_one_line(store):
    log = find_logs(store)[0]
    with LogFile(log) as file:
        log.unlink()
        with pytest.raises(LogError, match=r"mcap: no such log"):
            read_chunks(file, file.chunks)
    with pytest.raises(LogError, match=r"mcap: no such log"):
        LogFile(log)


def test_a_log_that_becomes_shorter_while_it_is_read_is_one_line(store):
    log = find_logs(store)[0]
    with LogFile(log) as file:
        full = log.read_bytes()
        log.fs.pipe_file(log.path, full[: len(full) // 2])
        with pytest.raises(LogError, match=r"mcap: .*changed while it was read"):
            read_chunks(file, file.chunks)
        assert not file.is_at(log)


def test_what_is_no_log_is_said_of_a_store(empty):
    (empty / "text.mcap").write_bytes(b"no log at all")
    with pytest.raises(LogError, match=r"text.mcap: is not an MCAP file"):
        LogFile(empty / "text.mcap")
    with pytest.raises(LogError, match="none: no log"):
        find_logs(empty / "none")


@pytest.mark.parametrize(
    ("url", "line"),
    [
        ("nosuch://x/y", "nosuch://x/y: the store cannot be used (Unsupported filesystem"),
        ("gs://x/y", "pip install gcsfs"),
        ("s3://", "s3://: the store cannot be used"),
        ("s3://no-such-bucket/home", "s3://no-such-bucket/home: no such log, folder or bucket"),
        ("memory://nothing", "memory://nothing: no log"),
    ],
)
@pytest.mark.usefixtures("bucket")
def test_a_url_that_leads_nowhere_is_one_line(hearthlog, url, line):
    result = hearthlog("info", url)
    assert result.returncode == 1
    assert line in result.stderr
    assert result.stderr.count("\n") == 1


def failure(home, env, *verb, without=()):
    """Run the command where the store cannot be had; return the line that it says."""
    environment = {name: text for name, text in os.environ.items() if not name.startswith("AWS")}
    environment = {**environment, "HOME": str(home), **env}
    environment = {name: text for name, text in environment.items() if name not in without}
    command = [*HEARTHLOG, *verb]
    result = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 1, result
    assert result.stderr.count("\n") == 1, result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr


def test_a_server_that_is_not_there_is_one_line(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        env = account(f"http://127.0.0.1:{free.getsockname()[1]}")
        assert "Could not connect" in failure(tmp_path, env, "info", "s3://homes/1")


def test_a_server_that_says_nothing_is_given_up(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        env = account(f"http://127.0.0.1:{silent.getsockname()[1]}")
        options = {"read_timeout": 0.2, "retries": {"total_max_attempts": 1}}
        env["FSSPEC_S3"] = json.dumps({"config_kwargs": options})
        assert "s3://homes/1: the store" in failure(tmp_path, env, "cat", "s3://homes/1")


def test_credentials_that_are_missing_are_one_line(tmp_path, s3_account):
    keys = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")
    line = failure(tmp_path, s3_account, "info", "s3://homes/1", without=keys)
    assert "credentials" in line


def test_a_server_that_reads_no_ranges_is_one_line(logs):
    """The one of Python's library sends files whole."""
    handler = partial(SimpleHTTPRequestHandler, directory=logs)
    handler.log_message = lambda *_: None
    log = find_logs(logs)[0]
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            url = f"http://127.0.0.1:{server.server_port}/{log.relative_to(logs)}"
            with pytest.raises(LogError, match="does not read by ranges"):
                LogFile(location(url))
        finally:
            server.shutdown()


def test_a_new_file_is_private_under_any_umask_and_one_that_is_replaced_keeps_its_rights(tmp_path):
    os.umask(0)
    for name in ("new", "old"):
        with new_file(tmp_path / name) as temporary:
            temporary.write_text("1")
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o600
    (tmp_path / "old").chmod(0o644)
    with replaced_file(tmp_path / "old") as temporary:
        temporary.write_text("2")
    assert (tmp_path / "old").stat().st_mode & 0o777 == 0o644
    private_folder(tmp_path / "a/b")
    with new_folder(tmp_path / "c") as temporary:
        (temporary / "d").write_text("3")
    for name, mode in {"a": 0o700, "a/b": 0o700, "c": 0o700, "c/d": 0o600}.items():
        assert (tmp_path / name).stat().st_mode & 0o777 == mode


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone gives files away")
def test_what_root_writes_belongs_to_whom_the_folder_belongs_to(tmp_path):
    os.chown(tmp_path, 12345, 12345)
    with new_file(tmp_path / "judgement") as temporary:
        temporary.write_text("1")
    private_folder(tmp_path / "folder")
    make_folders(tmp_path / "2026/03/01")
    create_file(tmp_path / "2026/03/01/log").close()
    os.close(open_lock(tmp_path / ".lock"))
    owners = {path.stat().st_uid for path in tmp_path.rglob("*")}
    assert owners == {12345}
    os.chown(tmp_path, 0, 0)


def test_what_is_created_never_goes_where_a_link_leads(tmp_path):
    other, link, nowhere = (tmp_path / name for name in ("other", "link", "nowhere"))
    other.write_text("1")
    other.chmod(0o600)
    link.symlink_to(other)
    (tmp_path / "dangling").symlink_to(nowhere)
    for path in (link, tmp_path / "dangling"):
        with pytest.raises(FileExistsError):
            create_file(path)
        for use in (open_lock, partial(hand_over, mode=0o666)):
            with pytest.raises(OSError, match="symbolic link"):
                use(path)
    assert (other.read_text(), other.stat().st_mode & 0o777) == ("1", 0o600)
    assert not nowhere.exists()


def test_rights_of_a_file_that_has_another_name_stay(tmp_path):
    (tmp_path / "other").touch(0o600)
    (tmp_path / "name").hardlink_to(tmp_path / "other")
    hand_over(tmp_path / "name", 0o644)
    assert (tmp_path / "other").stat().st_mode & 0o777 == 0o600


def test_a_lock_is_a_regular_file_and_not_a_hard_link_that_root_follows(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="Not a regular file"):
        open_lock(tmp_path / "pipe")
    (tmp_path / "other").touch()
    (tmp_path / "linked").hardlink_to(tmp_path / "other")
    os.close(open_lock(tmp_path / "linked"))  # a backup of hard links
    if os.geteuid() == 0:
        os.chown(tmp_path, 12345, 12345)
        with pytest.raises(OSError, match="Not a regular file"):
            open_lock(tmp_path / "linked")
        os.chown(tmp_path, 0, 0)


@pytest.mark.skipif(os.geteuid() != 0, reason="root alone gives files away")
def test_what_root_writes_is_given_to_nobody_who_swaps_the_folder_meanwhile(tmp_path, monkeypatch):
    ours, theirs, folder = (tmp_path / name for name in ("ours", "theirs", "folder"))
    for each in (ours, theirs):
        each.mkdir()
    os.chown(theirs, 12345, 12345)
    folder.symlink_to(ours)
    change_rights = os.fchmod

    def swap(descriptor, mode):
        folder.unlink()
        folder.symlink_to(theirs)
        change_rights(descriptor, mode)

    monkeypatch.setattr(os, "fchmod", swap)
    with suppress(LogError), new_file(folder / "judgement") as temporary:
        temporary.write_text("1")
    assert {path.stat().st_uid for path in ours.iterdir()} <= {0}
    assert list(ours.iterdir()) != []
