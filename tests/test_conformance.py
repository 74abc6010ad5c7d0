"""The conformance set of MCAP: valid files with and without each optional part of the format."""

import subprocess
from pathlib import Path

import pytest
from mcap.records import Attachment, Message, Metadata
from mcap.stream_reader import StreamReader
from test_typescript import FOLDER, need_node

from hearthlog.analyzer.doctor.examination import examine
from hearthlog.analyzer.export.merge import merge_logs
from hearthlog.analyzer.logs.selection import select
from hearthlog.analyzer.logs.summary import summarise
from hearthlog.schemas.salvage.recover import recover_log

# The set's statistics come before, or without, the channels they count; the format asks for these.
KNOWN_ERRORS = {"statistics-channels", "summary-copies"}


@pytest.fixture(scope="module")
def conformance(tmp_path_factory) -> list[Path]:
    """The 416 files of the set, byte for byte, by the writer that made them."""
    need_node(FOLDER / "node_modules")
    folder = tmp_path_factory.mktemp("conformance")
    subprocess.run(["node", FOLDER / "conformance.mjs", folder], check=True, timeout=120)
    files = sorted(folder.glob("*.mcap"))
    assert len(files) == 416
    return files


def content(path):
    """The messages, metadata and attachments of a file by the official reader, in its order.

    Without the record that rosbag2 looks for, which copies may get.
    """
    with path.open("rb") as stream:
        return [
            vars(record)
            for record in StreamReader(stream, validate_crcs=True).records
            if isinstance(record, Message | Metadata | Attachment)
            and getattr(record, "name", "") != "rosbag2"
        ]


def messages(path):
    return [record for record in content(path) if "sequence" in record]


def test_every_file_is_recovered_whole(conformance, tmp_path):
    copy = tmp_path / "copy.mcap"
    for path in conformance:
        recovery = recover_log(path, copy, copy.name)
        assert (recovery.damages, recovery.complete) == ([], True), path.name
        assert content(copy) == content(path), path.name


def test_info_counts_the_messages_of_every_file(conformance):
    for path in conformance:
        topics = summarise([path]).topics.values()
        assert sum(topic.messages for topic in topics) == len(messages(path)), path.name


def test_every_message_is_merged(conformance, tmp_path):
    copy = tmp_path / "copy.mcap"
    for path in conformance:
        if not (expected := messages(path)):
            continue
        merge_logs(select([path]), copy)
        expected.sort(key=lambda message: message["log_time"])
        assert messages(copy) == expected, path.name
        copy.unlink()


def test_the_doctor_finds_nothing_that_the_format_allows(conformance):
    for path in conformance:
        rules = {finding.rule for findings in examine(path) for finding in findings.shown}
        assert rules <= KNOWN_ERRORS, path.name
