"""What is written of the sound does not depend on the blocks it comes in, and is said in words."""

import numpy as np
import pytest

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile.modelfile import load_model
from hearthlog.recorder import rosout
from hearthlog.recorder.events import Frames, Gap, SourceHealth
from hearthlog.recorder.pipeline import Pipeline
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream_messages import opening_messages
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.messages.message_types import (
    LOG,
    SEGMENT,
    STREAM_INFO,
    decode,
    header,
    message,
    nanoseconds,
)

pytestmark = pytest.mark.fast

START = 1_772_348_370_123_456_789
LOST = 40


@pytest.fixture(scope="module")
def frames(day):
    samples = np.concatenate(list(read_audio(day)))
    return samples.reshape(-1, FRAME_SAMPLES)[:1200]


def said(records):
    """The lines among some records, decoded, each with its log time."""
    return [(r.log_time, decode(r.data, LOG)) for r in records if r.topic == "/rosout"]


def in_blocks(frames, size, model_file):
    """All records of a minute with a gap in its middle, and of microphones that fell ill."""
    pipeline = Pipeline("mic", DEFAULT, Classifier(load_model(model_file)))
    stamps = START + np.arange(len(frames) + LOST) * FRAME_NANOSECONDS
    middle = len(frames) // 2
    records = pipeline.push(SourceHealth(START, 0, "listening"))
    for half, late in ((range(middle), 0), (range(middle, len(frames)), LOST)):
        if late:
            start = int(stamps[middle])
            records += pipeline.push(SourceHealth(start, 2, "the microphone went silent"))
            records += pipeline.push(Gap(start, start + late * FRAME_NANOSECONDS, "test", late))
            records += pipeline.push(SourceHealth(start, 0, "listening"))
        for first in half[::size]:
            last = min(first + size, half.stop)
            block = stamps[first + late : last + late]
            records += pipeline.push(Frames(first + late, frames[first:last], block))
    return records + pipeline.finish()


@pytest.mark.parametrize("size", [1, 7, 200])
def test_blocks_of_any_size_give_the_same_records(frames, model_file, size):
    whole = in_blocks(frames, len(frames), model_file)
    assert len(said(whole)) > 10
    assert in_blocks(frames, size, model_file) == whole


def test_every_segment_is_a_line_that_follows_it_at_its_end(frames, model_file):
    records = in_blocks(frames, 100, model_file)
    places = [i for i, record in enumerate(records) if record.topic == "/mic/segment"]
    assert len(places) > 5
    for place in places:
        segment = decode(records[place].data, SEGMENT)
        ((time, line),) = said([records[place + 1]])
        end = nanoseconds(segment.header.stamp) + nanoseconds(segment.duration)
        assert time == nanoseconds(line.stamp) == end
        seconds, share = nanoseconds(segment.duration) / 1e9, 100 * segment.confidence
        assert line.msg == f"{segment.label} for {seconds:.2f} s ({share:.0f} %)"
        assert (line.level, line.name) == (line.INFO, "hearthlog.mic")


def test_a_gap_is_a_warning_at_its_end():
    gap = Gap(START, START + 2_050_000_000, "the recorder was too slow", 41)
    ((time, line),) = said(Pipeline("mic", DEFAULT).push(gap))
    assert time == nanoseconds(line.stamp) == gap.end
    assert line.level == line.WARN
    assert line.msg == "gap of 2.05 s: the recorder was too slow"


def test_only_a_change_of_health_is_a_line():
    pipeline = Pipeline("mic", DEFAULT)
    levels = [0, 0, 2, 2, 1, 1, 0, 0, 2]
    records = []
    for second, level in enumerate(levels):
        stamp = START + second * 10**9
        records += pipeline.push(SourceHealth(stamp, level, f"state {level}"))
    assert sum(record.topic == "/diagnostics" for record in records) == len(levels)
    found = [(time, line.level, line.msg) for time, line in said(records)]
    assert found == [
        (START + 2 * 10**9, 40, "state 2"),
        (START + 4 * 10**9, 30, "state 1"),
        (START + 6 * 10**9, 20, "state 0"),
        (START + 8 * 10**9, 40, "state 2"),
    ]


def test_the_first_line_names_the_device_and_the_model():
    info = message(
        STREAM_INFO,
        header=header(START, "mic"),
        device="Küche",
        sample_rate=16_000,
        frame_seconds=0.05,
        window_seconds=1.0,
        feature_set="auros21",
        feature_names=[],
        model="general",
        model_sha256="0123456789abcdef" * 4,
        labels=["speech", "silence"],
    )
    records = opening_messages(info)
    assert [record.topic for record in records] == ["/mic/info", "/rosout"]
    assert decode(records[0].data, STREAM_INFO).device == "Küche"
    ((time, line),) = said(records)
    assert time == nanoseconds(line.stamp) == START
    assert line.msg == "recording Küche: 2 labels by general (0123456789ab)"


def test_the_clock_that_was_set_back_is_a_gap_of_less_than_nothing():
    gap = Gap(START, START - 3 * 10**9, "the clock was set by -3.000 s", 0)
    line = decode(rosout.gap_line("mic", gap), LOG)
    assert line.msg == "gap of -3.00 s: the clock was set by -3.000 s"
