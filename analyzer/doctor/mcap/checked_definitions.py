"""The schemas and channels of a file, and what the specification and its profile ask of them."""

import re

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema

from hearthlog.analyzer.doctor.findings import RECOVER, Findings
from hearthlog.schemas.logs.columns import definition_fault
from hearthlog.schemas.logs.writer import ENCODING, PROFILE, SCHEMA_ENCODING
from hearthlog.schemas.mcap.records import HEAD, Definitions, encode, parse

ROS_ENCODINGS = (SCHEMA_ENCODING, "ros2idl")
_SIZE_LIMIT = 16 << 20  # bytes of a record that is neither chunk nor attachment
_TOTAL_LIMIT = 64 << 20  # bytes of all schemas and channels of a file
_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*){1,2}")


def parse_strictly(
    findings: Findings, opcode: int, offset: int, content: bytes
) -> McapRecord | None:
    """Parse a record, and report one that is damaged or too large.

    Damaged are records that are too short, have a text that is not UTF-8, or a key of a map twice.

    Parameters
    ----------
    offset : int
        Byte of the file at which the record begins, or the chunk that it is in.

    Returns
    -------
    McapRecord or None
        None if it cannot be parsed, is larger than hearthlog reads, or is of an unknown kind.
    """
    if len(content) > _SIZE_LIMIT and opcode != Opcode.ATTACHMENT:
        what = f"{name_of(opcode)} of {len(content)} bytes is larger than hearthlog reads"
        findings.error("too-large", what, RECOVER, offset=offset)
        return None
    try:
        record = parse(opcode, content)
    except (McapError, UnicodeDecodeError) as error:
        findings.error("fields", f"{name_of(opcode)}: {error}", RECOVER, offset=offset)
        return None
    if record is None or opcode == Opcode.ATTACHMENT:
        return record
    if not content.startswith(encode(record)[HEAD.size :]):  # later versions may append fields
        what = f"{name_of(opcode)}: a map in it has a key twice, or another length than it says"
        findings.error("fields", what, RECOVER, offset=offset)
    return record


def name_of(opcode: int) -> str:
    """Name a kind of record, such as `Chunk index`."""
    try:
        return Opcode(opcode).name.capitalize().replace("_", " ")
    except ValueError:
        return f"record of opcode {opcode}"


class CheckedDefinitions(Definitions):
    """The schemas and channels that were defined so far, each checked when it was added.

    Parameters
    ----------
    ours : bool
        Whether hearthlog made this file: then breaches of its profile are errors, not warnings.
    """

    def __init__(self, findings: Findings, *, ours: bool) -> None:
        super().__init__()
        self.ours = ours  # whether hearthlog made this file
        self.profile = ""  # of the header
        self.incomplete = False  # whether there may be more, in what was too large to be checked
        self._size = 0
        self._findings = findings

    def read(self, opcode: int, offset: int, content: bytes) -> int | None:
        """Read and check a schema or a channel.

        Parameters
        ----------
        offset : int
            Byte of the file at which the record begins, or the chunk that it is in.
        """
        record = parse_strictly(self._findings, opcode, offset, content)
        if isinstance(record, Schema):
            self._add_schema(record, offset, len(content))
        elif isinstance(record, Channel) and self._add_channel(record, offset, len(content)):
            return record.id
        return None

    def _keeps(self, size: int, offset: int) -> bool:
        """Tell whether there is room for another definition."""
        self._size += size
        if self._size > _TOTAL_LIMIT:
            what = "more schemas and channels than hearthlog reads"
            self._findings.error("too-large", what, RECOVER, offset=offset)
        return self._size <= _TOTAL_LIMIT

    def _add_schema(self, schema: Schema, offset: int, size: int) -> None:
        """Check a schema, and keep the first of its number."""
        error = self._findings.error
        if schema.id == 0:
            error("schema-id", f"schema {schema.name} has the number 0", RECOVER, offset=offset)
            return
        if schema.id in self.schemas:
            if not self.add(schema):
                what = f"schema {schema.id} ({schema.name}) differs from the first of its number"
                error("redefined", what, RECOVER, offset=offset)
            return
        if not self._keeps(size, offset):
            return
        self.add(schema)
        if not schema.encoding and schema.data:
            what = f"schema {schema.name} has data, but no encoding"
            error("schema-encoding", what, RECOVER, offset=offset)
        if schema.encoding in ROS_ENCODINGS:
            self._check_definition(schema, offset)
        elif self.profile == PROFILE:
            what = f"schema {schema.name} is {schema.encoding!r}, neither ros2msg nor ros2idl"
            self._profile("profile-schema", what, offset)

    def _add_channel(self, channel: Channel, offset: int, size: int) -> bool:
        """Check a channel, and keep the first of its number; tell whether it is that."""
        error = self._findings.error
        topic = f"channel {channel.id} ({channel.topic})"
        if channel.id in self.channels:
            if not self.add(channel):
                what = f"{topic} differs from the first of its number"
                error("redefined", what, RECOVER, offset=offset)
            return False
        if not self._keeps(size, offset):
            return False
        self.add(channel)
        is_defined = channel.schema_id in {0, *self.schemas}
        if not is_defined and not self.incomplete:
            what = f"{topic} has schema {channel.schema_id}, which is not defined before it"
            error("schema-missing", what, RECOVER, offset=offset)
        if not channel.message_encoding:
            error("channel-encoding", f"{topic} has no message encoding", RECOVER, offset=offset)
        elif self.profile == PROFILE:
            if channel.message_encoding != ENCODING:
                what = f"{topic} is encoded as {channel.message_encoding!r}, not as {ENCODING}"
                self._profile("profile-channel", what, offset)
            elif not channel.schema_id:
                self._profile("profile-channel", f"{topic} has no schema", offset)
        if self.profile == PROFILE and "offered_qos_profiles" not in channel.metadata:
            self._profile("profile-qos", f"{topic} has no offered_qos_profiles", offset)
        return True

    def _profile(self, rule: str, what: str, offset: int) -> None:
        """Say what the profile asks for: it only should be followed, in a file that is not ours."""
        report = self._findings.error if self.ours else self._findings.warning
        report(rule, what, "its profile, ros2, asks for that", offset=offset)

    def _check_definition(self, schema: Schema, offset: int) -> None:
        error = self._findings.error
        if not _TYPE_NAME.fullmatch(schema.name):
            what = f"schema {schema.name!r} is not named as a ROS message type"
            error("schema-name", what, RECOVER, offset=offset)
        if fault := definition_fault(schema.name, schema.encoding, schema.data):
            error("schema-definition", fault, "its messages can be copied only", offset=offset)
