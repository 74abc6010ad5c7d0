"""Messages of any ROS 2 type come out of their bytes as rosbags decodes them."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.cdr_codec import decode_rows
from hearthlog.schemas.messages.message_types import definition, typestore
from hearthlog.schemas.messages.type_definitions import message_type

pytestmark = pytest.mark.fast

TYPES = [
    "diagnostic_msgs/msg/DiagnosticArray",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Path",
    "rcl_interfaces/msg/ParameterEvent",
    "rcl_interfaces/msg/Log",
    "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/PointCloud2",
    "std_msgs/msg/Empty",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/String",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/MultiDOFJointTrajectory",
    message_types.LABEL,
    message_types.STREAM_INFO,
]
TEXT = st.text(st.characters(codec="utf-8"), max_size=9)
FORMATS = {
    "bool": "?", "byte": "u1", "char": "u1", "uint8": "u1", "int8": "i1",
    "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


@st.composite
def a_message(draw, typename):
    """Draw a message with any numbers, texts and lengths."""
    fields = {}
    for name, (node, kind) in typestore().fielddefs[typename][1]:
        if node is Nodetype.NAME:
            fields[name] = draw(a_message(kind))
        elif node is Nodetype.BASE:
            fields[name] = draw(TEXT) if kind[0] == "string" else draw(numbers(kind[0], 1))[0]
        else:
            element, count = kind
            count = count if node is Nodetype.ARRAY else draw(st.integers(0, 3))
            if element[0] is Nodetype.NAME:
                fields[name] = [draw(a_message(element[1])) for _ in range(count)]
            elif element[1][0] == "string":
                fields[name] = [draw(TEXT) for _ in range(count)]
            else:
                fields[name] = draw(numbers(element[1][0], count))
    if typename in {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}:
        fields["nanosec"] = fields["nanosec"] % NANOSECONDS
    return typestore().types[typename](**fields)


def numbers(base, count):
    size = np.dtype(FORMATS[base]).itemsize * count
    if base == "byte":  # rosbags takes it for signed
        return st.binary(min_size=count, max_size=count).map(
            lambda raw: np.frombuffer(raw, np.uint8) & 127
        )
    if base == "bool":
        return st.binary(min_size=count, max_size=count).map(
            lambda raw: np.frombuffer(raw, np.uint8) % 2 == 1
        )
    return st.binary(min_size=size, max_size=size).map(
        lambda raw: np.frombuffer(raw, FORMATS[base])
    )


def flat(value, prefix=""):
    """Return the fields of a decoded message by path, in bytes where they are numbers."""
    found = {}
    for name in value.__dataclass_fields__:
        part = getattr(value, name)
        if name == "__msgtype__" or name.isupper():
            continue
        if type(part).__name__.endswith(("msg__Time", "msg__Duration")):
            found[prefix + name] = part.sec * NANOSECONDS + part.nanosec
        elif hasattr(part, "__dataclass_fields__"):
            found |= flat(part, f"{prefix}{name}.")
        else:
            found[prefix + name] = plain(part)
    return found


def plain(value):
    if hasattr(value, "__dataclass_fields__"):
        return flat(value)
    if isinstance(value, list | np.ndarray):
        return [plain(part) for part in value]
    if isinstance(value, float | np.floating):
        return struct.pack("<d", value)
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    return value.item() if isinstance(value, np.generic) else value


def decoded(typename, payloads):
    sizes = np.array([len(payload) for payload in payloads])
    buffer = np.frombuffer(b"".join(payloads), np.uint8)
    return decode_rows(message_type(typename), buffer, np.cumsum(sizes) - sizes, sizes)


@pytest.mark.parametrize("typename", TYPES)
@settings(deadline=None, max_examples=25)
@given(st.data())
def test_messages_of_any_lengths_come_out_as_rosbags_decodes_them(typename, data):
    drawn = data.draw(st.lists(a_message(typename), min_size=1, max_size=4))
    payloads = [
        bytes(typestore().serialize_cdr(m, typename, little_endian=data.draw(st.booleans())))
        for m in drawn
    ]
    columns = decoded(typename, payloads)
    for row, payload in enumerate(payloads):
        expected = flat(typestore().deserialize_cdr(payload, typename))
        assert {path: plain(values[row]) for path, values in columns.items()} == expected


def test_a_definition_from_a_file_is_read_as_well_as_one_that_is_known():
    text = definition(message_types.SEGMENT).encode() + b"\n# and another word\n"
    kind = message_type(message_types.SEGMENT, "ros2msg", text)
    payload = message_types.encode(
        message_types.message(
            message_types.SEGMENT,
            header=message_types.header(5, "mic"),
            duration=message_types.duration_message(7),
            label="speech",
            confidence=0.5,
        )
    )
    rows = decode_rows(
        kind, np.frombuffer(payload, np.uint8), np.array([0]), np.array([len(payload)])
    )
    assert {path: values.tolist() for path, values in rows.items()} == {
        "header.stamp": [5],
        "header.frame_id": ["mic"],
        "duration": [7],
        "label": ["speech"],
        "confidence": [0.5],
    }


def test_idl_files_that_are_joined_as_the_registry_of_mcap_says_are_read():
    line = "=" * 80
    text = f"""{line}
IDL: demo/msg/Whole
// generated from rosidl_adapter/resource/msg.idl.em
// with input from demo/msg/Whole.msg

#include "demo/msg/Part.idl"

module demo {{
  module msg {{
    @verbatim (language="comment", text=
      "What it is" "\\n"
      "# and more")
    struct Whole {{
      @unit (value="m")
      demo::msg::Part part;
      string<10> name;
    }};
  }};
}};

{line}
IDL: demo/msg/Part
module demo {{
  module msg {{
    struct Part {{
      double value;
    }};
  }};
}};
"""
    kind = message_type("demo/msg/Whole", "ros2idl", text.encode())
    payload = b"\0\1\0\0" + struct.pack("<dI4s", 1.5, 4, b"abc\0")
    rows = decode_rows(kind, np.frombuffer(payload, np.uint8), np.array([0]), np.array([20]))
    assert {path: values.tolist() for path, values in rows.items()} == {
        "part.value": [1.5],
        "name": ["abc"],
    }


WIDE = """uint8 a
wstring text
uint8 b
wstring<=8 bounded
uint8 c
wstring[] several
float64 d
wstring[2] two
string narrow
wstring greeting "hi"
"""
WIDE_IDL = """module demo { module msg { struct Wide {
  uint8 a; wstring text; uint8 b; wstring<8> bounded; uint8 c; sequence<wstring> several;
  double d; wstring two[2]; string narrow; wstring greeting;
}; }; };"""
# What a subscriber of Jazzy and one of Kilted got, with Fast DDS.
WIDE_MESSAGE = bytes.fromhex(
    "00010000010000000500000061000000ac20000034d800001edd00007a000000020000000200000078000000"
    "7900000003000000030000000000000001000000710000000300000072000000730000007400000000000000"
    "0000f83f01000000750000000100000076000000020000006e000000020000006800000069000000"
)
WIDE_VALUES = {
    "a": 1, "text": "a€𝄞z", "b": 2, "bounded": "xy", "c": 3, "several": ["", "q", "rst"],
    "d": 1.5, "two": ["u", "v"], "narrow": "n", "greeting": "hi",
}  # fmt: skip


def decoded_wide(kind, payloads):
    sizes = np.array([len(payload) for payload in payloads])
    joined = np.frombuffer(b"".join(payloads), np.uint8)
    return decode_rows(kind, joined, np.cumsum(sizes) - sizes, sizes)


@pytest.mark.parametrize(("encoding", "text"), [("ros2msg", WIDE), ("ros2idl", WIDE_IDL)])
def test_texts_of_two_bytes_a_letter_are_read_as_ros_sends_them(encoding, text):
    kind = message_type("demo/msg/Wide", encoding, text.encode())
    rows = decoded_wide(kind, [WIDE_MESSAGE])
    assert {path: values.tolist()[0] for path, values in rows.items()} == WIDE_VALUES


@given(st.lists(st.text(max_size=9), min_size=1, max_size=9), st.sampled_from("<>"))
def test_any_texts_of_two_bytes_a_letter_come_out_as_they_went_in(texts, order):
    kind = message_type("demo/msg/One", "ros2msg", b"uint8 first\nwstring text\nuint8 last")
    start = {"<": b"\0\1\0\0", ">": b"\0\0\0\0"}[order]
    payloads = []
    for text in texts:
        utf16 = text.encode("utf-16-le")
        units = struct.unpack(f"<{len(utf16) // 2}H", utf16)
        fields = 7, len(units), *units, 9
        payloads.append(start + struct.pack(f"{order}B3xI{len(units)}IB", *fields))
    rows = decoded_wide(kind, payloads)
    assert rows["text"].tolist() == texts
    assert set(rows["first"]) == {7}
    assert set(rows["last"]) == {9}


@pytest.mark.parametrize(("unit", "what"), [(0x10000, "words of four bytes"), (0xD800, "UTF-16")])
def test_units_that_are_no_utf_16_are_refused(unit, what):
    kind = message_type("demo/msg/One", "ros2msg", b"wstring text")
    with pytest.raises(LogError, match=f"text: .*{what}"):
        decoded_wide(kind, [b"\0\1\0\0" + struct.pack("<II", 1, unit)])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (b"int32 a\nNowhere b", "cannot be read|not defined"),
        (b"float128 a", "cannot be read|not supported|not defined"),
        (b"wstring[4000000000] a", "too many"),
        (b"test/msg/Loop a\n" + b"=" * 80 + b"\nMSG: test/msg/Loop\ntest/msg/Loop a", "itself"),
        (b"uint8[4000000000] a", "ends before"),
        (b"std_msgs/Header[4000000000] a", "too many"),
        (b"string[4000000000] a", "too many"),
        (b"int32 a\n" * 100_000, "too long"),
        (b"\xff\xfe", "cannot be read"),
        (b"this is no definition", "cannot be read|not defined"),
        (b"=" * 200, "cannot be read"),
    ],
)
def test_a_hostile_definition_is_refused(text, what):
    payload = b"\0\1\0\0" + bytes(40)
    with pytest.raises(LogError, match=what):
        decode_rows(
            message_type("test/msg/Test", "ros2msg", text),
            np.frombuffer(payload, np.uint8),
            np.array([0]),
            np.array([len(payload)]),
        )


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_make_it_fail_otherwise(payload):
    for typename in (message_types.LABEL, message_types.DIAGNOSTICS, message_types.STREAM_INFO):
        try:
            decoded(typename, [b"\0\1\0\0" + payload])
        except LogError:
            continue


@pytest.mark.parametrize("damage", ["cut", "long", "no terminator", "not UTF-8", "XCDR2"])
def test_a_message_that_is_not_of_its_type_is_refused(damage):
    payload = bytearray(
        message_types.encode(
            message_types.message("std_msgs/msg/String", data="something long enough")
        )
    )
    if damage == "cut":
        payload = payload[:-3]
    elif damage == "long":
        payload += bytes(4)
    elif damage == "no terminator":
        payload[-1] = 1
    elif damage == "not UTF-8":
        payload[12] = 0xFF
    else:
        payload[1] = 7
    with pytest.raises(LogError):
        decoded("std_msgs/msg/String", [bytes(payload)])


def test_rows_of_more_layouts_than_are_tried_come_out_right():
    rng = np.random.default_rng(3)
    texts = ["x" * length for length in rng.permutation(100).repeat(2)]
    payloads = [
        message_types.encode(
            message_types.message(
                "diagnostic_msgs/msg/KeyValue", key=text, value="y" * (100 - len(text))
            )
        )
        for text in texts
    ]
    assert decoded("diagnostic_msgs/msg/KeyValue", payloads)["key"].tolist() == texts
