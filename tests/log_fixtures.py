"""Logs to cut, merge, print and export: some of one recording, and one of made-up messages."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event as Flag
from typing import Any, NamedTuple

import pytest
from lossy_source import LossySource
from mcap.reader import make_reader

from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.logs.metadata import rosbag2_channel
from hearthlog.schemas.mcap.chunk_writer import ChunkWriter
from hearthlog.schemas.messages.message_types import definition, encode, type_hash
from hearthlog.schemas.messages.topics import Quality
from hearthlog.tools.cli.main import main

START = 1_772_348_370_123_456_789
LOST = {5: 7, 9: 40}


class Result(NamedTuple):
    """What came of a command."""

    returncode: int
    stdout: str
    stderr: str


def run(
    capfd: pytest.CaptureFixture[str], *arguments: object, env: Mapping[str, str] | None = None
) -> Result:
    """Run the command in this process, which is faster than in one of its own."""
    return run_function(capfd, main, *arguments, env=env)


def run_function(
    capfd: pytest.CaptureFixture[str],
    function: Callable[[], object],
    *arguments: object,
    env: Mapping[str, str] | None = None,
) -> Result:
    """Run what takes its arguments from the command line."""
    capfd.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["hearthlog", *map(str, arguments)])
        for name, value in (env or {}).items():
            patch.setenv(name, value)
        try:
            function()
            status = 0
        except SystemExit as end:
            if isinstance(end.code, str):
                sys.stderr.write(f"{end.code}\n")
            status = 1 if isinstance(end.code, str) else int(end.code or 0)
    return Result(status, *capfd.readouterr())


def record_logs(paths: Sequence[Path], folder: Path, model: Path) -> Path:
    """Record sounds, with gaps, to logs of a minute in `logs`; return that folder.

    The last one is beside it as it was before it was complete, as `unfinished.mcap.active`.
    """

    def copy_active() -> None:
        active = max((folder / "logs").rglob("*.active"))  # the others get their names
        shutil.copy(active, folder / "unfinished.mcap.active")

    settings = Settings(output=folder / "logs", model=model, max_bag_duration=60)
    source = LossySource(FileSource(paths, START), LOST, copy_active)
    assert len(record(settings, source, Flag()).logs) > 1
    return folder / "logs"


def write_log(path: Path, topics: dict[str, Sequence[tuple[int, Any]]]) -> Path:
    """Write messages of any types, with their log times, by topic."""
    with path.open("xb") as stream:
        writer = ChunkWriter(stream)
        writer.start("ros2", "test")
        rows = []
        for topic, messages in topics.items():
            name = messages[0][1].__msgtype__
            schema = writer.register_schema(name, "ros2msg", definition(name).encode())
            about = rosbag2_channel(type_hash(name), Quality())
            channel = writer.register_channel(topic, "cdr", schema, about)
            rows += [(time, channel, encode(message)) for time, message in messages]
        for number, (time, channel, data) in enumerate(sorted(rows, key=lambda row: row[0])):
            writer.add_message(channel, time, data, publish_time=time + 5, sequence=number)
        writer.finish()
    return path


def raw_messages(path: Path) -> list[tuple[Any, ...]]:
    """Read all that MCAP knows of every message, in the order of log times, with `mcap`."""
    with path.open("rb") as stream:
        return [
            (
                channel.topic,
                schema.name,
                schema.data,
                tuple(sorted(channel.metadata.items())),
                message.log_time,
                message.publish_time,
                message.sequence,
                message.data,
            )
            for schema, channel, message in make_reader(stream).iter_messages()
        ]


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """Mount a disk that is soon full."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("only root can mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
