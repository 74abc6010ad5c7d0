"""How our messages grow: what was appended to them, since when, and what stands for it in old logs.

Fields are only ever appended to `msg/*.msg`; none is renamed, moved, removed, or given another
type. Who appends one raises `SCHEMA_VERSION` and enters the field in `APPENDED`: docs/log.md.
"""

from typing import NamedTuple

SCHEMA_VERSION = 3  # of the messages and records that this version writes


class Appended(NamedTuple):
    """A field that messages did not have from the beginning.

    Its default is what a message without it says; None stands for a number of 0, no time, an empty
    text or sequence.
    """

    since: int  # the first schema version that has it
    default: float | str | None = None


# By type and name of the field.
APPENDED: dict[str, dict[str, Appended]] = {
    "hearthlog_msgs/msg/AudioMark": {"reason": Appended(since=3)},
}
