"""What is written of the sound does not depend on the blocks it comes in, and is said in words."""

import numpy as np
import pytest

from hearthlog.models.classifiers.classifier import Classifier, label_timing
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.recorder.events import Frames, Gap, SourceHealth
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.stream import gap_line, opening_messages
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES
from hearthlog.schemas.messages.message_types import (
    DIAGNOSTICS,
    LABEL,
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


def output(records):
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
    full = in_blocks(frames, len(frames), model_file)
    assert len(output(full)) > 10
    assert in_blocks(frames, size, model_file) == full


def test_every_segment_is_a_line_that_follows_it_when_its_end_is_known(frames, model_file):
    delay = label_timing(load_model(model_file).description).delay * FRAME_NANOSECONDS
    assert delay > 0
    sounds_end = [START + n * FRAME_NANOSECONDS for n in (len(frames) // 2, len(frames) + LOST)]
    records = in_blocks(frames, 100, model_file)
    places = [i for i, record in enumerate(records) if record.topic == "/mic/segment"]
    assert len(places) > 5
    for place in places:
        segment = decode(records[place].data, SEGMENT)
        ((time, line),) = output([records[place + 1]])
        end = nanoseconds(segment.header.stamp) + nanoseconds(segment.duration)
        over = min(sound_end for sound_end in sounds_end if sound_end >= end)
        assert time == records[place].log_time == nanoseconds(line.stamp) == min(end + delay, over)
        seconds, share = nanoseconds(segment.duration) / 1e9, 100 * segment.confidence
        assert line.msg == f"{segment.label} for {seconds:.2f} s ({share:.0f} %)"
        assert (line.level, line.name) == (line.INFO, "hearthlog.mic")


def test_a_gap_is_a_warning_at_its_end():
    gap = Gap(START, START + 2_050_000_000, "the recorder was too slow", 41)
    ((time, line),) = output(Pipeline("mic", DEFAULT).push(gap))
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
    found = [(time, line.level, line.msg) for time, line in output(records)]
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
        feature_set=DEFAULT.name,
        feature_names=[],
        model="general",
        model_sha256="0123456789abcdef" * 4,
        labels=["speech", "silence"],
    )
    records = opening_messages(info)
    assert [record.topic for record in records] == ["/mic/info", "/rosout"]
    assert decode(records[0].data, STREAM_INFO).device == "Küche"
    ((time, line),) = output(records)
    assert time == nanoseconds(line.stamp) == START
    assert line.msg == "recording Küche: 2 labels by general (0123456789ab)"


def test_the_clock_that_was_set_back_is_a_gap_of_less_than_nothing():
    gap = Gap(START, START - 3 * 10**9, "the clock was set by -3.000 s", 0)
    line = decode(gap_line("mic", gap).data, LOG)
    assert line.msg == "gap of -3.00 s: the clock was set by -3.000 s"


@pytest.mark.parametrize(
    ("names", "begin", "end", "size"),
    [
        (("room", "room"), 600 - 3, 600 - 3, 300),
        (("room", "second"), 600 - 3, 600 - 3, 7),  # it could speak of earlier ones, too
        (("second", "room"), 600 - 3, 600 - 9, 1),  # and it cannot of six of them
        (("second", "room"), 600 - 3, 600 - 9, 300),
        (("second", "second"), 600 - 9, 600 - 9, 7),
        ((None, "room"), 600 - 3, None, 7),
        (("room", None), None, 600 - 3, 300),
    ],
)
def test_a_model_that_takes_over_speaks_of_what_the_other_one_has_not(  # noqa: PLR0913, PLR0917
    frames, model_file, second_file, names, begin, end, size
):
    models = {"room": load_model(model_file), "second": load_model(second_file), None: None}
    classifiers = {name: model and Classifier(model) for name, model in models.items()}
    pipeline = Pipeline("mic", DEFAULT, classifiers[names[0]])
    stamps = START + np.arange(1200) * FRAME_NANOSECONDS

    def push(first, last):
        return [
            record
            for place in range(first, last, size)
            for block in [slice(place, min(place + size, last))]
            for record in pipeline.push(Frames(place, frames[block], stamps[block]))
        ]

    before = push(0, 600)
    closing, _ = pipeline.change_model(models[names[1]], classifiers[names[1]], 600, stamps[600])
    after = push(600, 1200) + pipeline.finish()
    labels = [
        [(r.log_time, decode(r.data, LABEL)) for r in records if r.topic == "/mic/label"]
        for records in (before, after)
    ]
    numbers = [[label.frame for _, label in found] for found in labels]
    if end is not None:
        assert numbers[0] == list(range(numbers[0][0], end))
    if begin is not None:
        delay = classifiers[names[1]].timing.delay
        assert numbers[1] == list(range(begin, 1200 - delay))
    for _, label in labels[0] + labels[1]:
        assert nanoseconds(label.header.stamp) == stamps[label.frame]
    assert all(time >= stamps[600] for time, _ in labels[1])
    segments = [
        [decode(r.data, SEGMENT) for r in records if r.topic == "/mic/segment"]
        for records in (before + closing, after)
    ]
    if names[0]:
        last = segments[0][-1]
        assert nanoseconds(last.header.stamp) + nanoseconds(last.duration) == stamps[600]
    if names[1]:
        assert nanoseconds(segments[1][0].header.stamp) == stamps[600]


def test_diagnostics_say_how_quiet_the_room_is():
    rng = np.random.default_rng(0)
    sound = (10 ** (-50 / 20) * rng.standard_normal((200, FRAME_SAMPLES))).astype(np.float32)
    pipeline = Pipeline("mic", DEFAULT)
    stamps = START + np.arange(400) * FRAME_NANOSECONDS

    def floor(stamp):
        (record,) = pipeline.push(SourceHealth(int(stamp), 0, "listening"))
        (status,) = decode(record.data, DIAGNOSTICS).status
        return {pair.key: pair.value for pair in status.values}.get("floor_dbfs")

    assert floor(stamps[0]) is None
    pipeline.push(Frames(0, sound[:7], stamps[:7]))
    assert floor(stamps[7]) is None  # no block is complete
    pipeline.push(Frames(7, sound[7:], stamps[7:200]))
    assert float(floor(stamps[200])) == pytest.approx(-50, abs=0.5)
    pipeline.push(Gap(int(stamps[200]), int(stamps[201]), "test", 1))
    assert floor(stamps[201]) is None


def health_after(pipeline, stamp, level=0):
    records = pipeline.push(SourceHealth(int(stamp), level, "listening"))
    (status,) = decode(records[0].data, DIAGNOSTICS).status
    return status.level, status.message


def test_a_microphone_that_clips_is_said_for_a_minute_and_a_loud_clap_is_not():
    rng = np.random.default_rng(0)
    sound = np.clip(rng.normal(0.0, 0.5, (3600, FRAME_SAMPLES)), -1, 1).astype(np.float32)
    sound[:, :400] *= 0.1  # clipped or not, no frame is as steady as a room
    sound[0:10] *= 0.01
    sound[30:] *= 0.01
    stamps = START + np.arange(3600) * FRAME_NANOSECONDS
    pipeline, output = Pipeline("mic", DEFAULT), []
    for first in range(0, 3600, 200):
        block = slice(first, first + 200)
        pipeline.push(Frames(first, sound[block], stamps[block]))
        output.append(health_after(pipeline, stamps[first]))
    clipping = (1, "the microphone clips: turn its volume down")
    assert output == [clipping] * 6 + [(0, "listening")] * 12
    assert health_after(pipeline, stamps[-1], 2) == (2, "listening")


def test_full_scale_that_is_not_clipped_is_well():
    peaks = np.zeros((100, FRAME_SAMPLES), np.float32)
    peaks[:, ::400] = 1.0
    pipeline = Pipeline("mic", DEFAULT)
    pipeline.push(Frames(0, peaks, START + np.arange(100) * FRAME_NANOSECONDS))
    assert health_after(pipeline, START) == (0, "listening")


@pytest.mark.parametrize(("level", "loud"), [(-18, True), (-35, False)])
def test_a_room_as_loud_as_sounds_are_is_said_after_ten_minutes(level, loud):
    rng = np.random.default_rng(0)
    noise = (10 ** (level / 20) * rng.standard_normal((400, FRAME_SAMPLES))).astype(np.float32)
    features = np.tile(DEFAULT.extractor()(noise), (31, 1))
    pipeline, output = Pipeline("mic", DEFAULT), []
    for first in range(0, len(features), 400):
        stamps = START + np.arange(first, first + 400) * FRAME_NANOSECONDS
        pipeline.push_features(features[first : first + 400], first, stamps)
        output.append(health_after(pipeline, stamps[-1])[0])
    assert output == ([0] * 30 + [1] if loud else [0] * 31)
