"""The topics of a log and the types that are not of ROS 2 itself."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_msg

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.writer import LogWriter
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, message, time_message, typestore
from hearthlog.schemas.messages.topics import Topic, check_microphone_name, topics_of

pytestmark = pytest.mark.fast

# The fields of `ros/src/foxglove_msgs/ros2/RawAudio.msg` in Foxglove's SDK.
RAW_AUDIO = """
builtin_interfaces/Time timestamp
uint8[] data
string format
uint32 sample_rate
uint32 number_of_channels
"""


def test_without_classes_there_are_no_labels_and_all_else_is_there():
    every = {item.name: item for item in topics_of("hall", ["energy"], ["speech", "silence"])}
    fewer = {item.name: item for item in topics_of("hall", ["energy"], None)}
    assert every.keys() - fewer.keys() == {"/hall/label", "/hall/segment"}
    assert fewer.items() <= every.items()
    assert {"/hall/info", "/hall/features", "/hall/gap", "/diagnostics", "/rosout"} < fewer.keys()
    assert every["/hall/label"].array_names == {"probabilities": ["speech", "silence"]}


def test_every_topic_has_a_type_with_a_definition():
    for item in topics_of("hall", ["energy"], ["speech"]):
        assert item.type in typestore().types
        assert message_types.definition(item.type)


@pytest.mark.parametrize("name", ["hall", "mic2", "living_room", "a"])
def test_a_microphone_name_begins_its_topics(name):
    assert check_microphone_name(name) == name


@pytest.mark.parametrize("name", ["", "Hall", "2nd", "a__b", "a_", "_a", "a/b", "ü", "a b", "a\n"])
def test_a_name_that_ros_refuses_in_a_topic_is_refused(name):
    with pytest.raises(LogError, match="use lower-case letters"):
        check_microphone_name(name)


def test_raw_audio_is_as_foxglove_defines_it():
    theirs = get_types_from_msg(RAW_AUDIO, message_types.RAW_AUDIO)[message_types.RAW_AUDIO]
    assert message_types.RAW_AUDIO == "foxglove_msgs/msg/RawAudio"
    assert typestore().fielddefs[message_types.RAW_AUDIO] == theirs


def test_raw_audio_in_a_log_is_read_with_the_types_of_the_file(tmp_path):
    samples = np.random.default_rng(3).integers(-32768, 32767, 800, np.int16)
    clip = message(
        message_types.RAW_AUDIO,
        timestamp=time_message(1_772_348_400_123_456_789),
        data=samples.view(np.uint8),
        format="pcm-s16",
        sample_rate=16_000,
        number_of_channels=1,
    )
    log = LogWriter(tmp_path / "log.mcap", [Topic("/mic/audio", message_types.RAW_AUDIO)], {})
    log.write("/mic/audio", 1_772_348_400_123_456_789, encode(clip))
    with AnyReader([log.finish()]) as reader:
        ((connection, _, data),) = reader.messages()
        found = reader.deserialize(data, connection.msgtype)
    np.testing.assert_array_equal(found.data.view(np.int16), samples)
    assert (found.format, found.sample_rate, found.number_of_channels) == ("pcm-s16", 16_000, 1)
    assert (found.timestamp.sec, found.timestamp.nanosec) == (1_772_348_400, 123_456_789)
