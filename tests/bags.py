"""Small bags as other programs write them, byte for byte as a test wants them."""

import struct

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

T0 = 1_700_000_000_000_000_000
INT32, STRING = "std_msgs/msg/Int32", "std_msgs/msg/String"
_STORE = get_typestore(Stores.ROS2_HUMBLE)


def definition(name: str) -> str:
    return _STORE.generate_msgdef(name, ros_version=2)[0]


def int32(value: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<i", value)


def string(text: str | bytes) -> bytes:
    data = text.encode() if isinstance(text, str) else text
    return b"\0\1\0\0" + struct.pack("<I", len(data) + 1) + data + b"\0"


class Bag:
    """A bag that is written by the library of MCAP; `close` completes it."""

    def __init__(self, path, compression=CompressionType.ZSTD, **options):
        self.path = path
        self._file = path.open("wb")
        self.writer = Writer(self._file, compression=compression, **options)
        self.writer.start("ros2", "somebody")

    def channel(self, topic, name, text=None, encoding="ros2msg", message_encoding="cdr"):
        text = definition(name) if text is None else text
        data = text if isinstance(text, bytes) else text.encode()
        schema = self.writer.register_schema(name, encoding, data)
        return self.writer.register_channel(topic, message_encoding, schema, {})

    def add(self, channel, data, time, publish_time=None):
        published = time if publish_time is None else publish_time
        self.writer.add_message(channel, time, data, published)

    def close(self):
        self.writer.finish()
        self._file.close()
        return self.path
