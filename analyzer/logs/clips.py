"""Audio clips in a log."""

import io
import wave
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.logs.selection import is_compatible
from hearthlog.analyzer.logs.spans import Spans, joined
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, decode
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.messages import message_types

CLIP_FIELDS = ("timestamp", "data", "format", "sample_rate", "number_of_channels")
SAMPLE_BYTES = 2
_FORMAT = "pcm-s16"
_FULL_SCALE = np.float32(32768.0)
_WAV_SCALE = np.float32(32767.0)
_RATES = range(1_000, 1_000_001)
_CHANNELS = range(1, 257)
_NEAR = 10 * NANOSECONDS  # maximum difference between the time of a message and of its sound
_TOUCHING = 5_000_000  # ns: stamps have a resolution of 1 ms


class LoggedClip(NamedTuple):
    """One `RawAudio` message: 16-bit samples of the sound from `start` (ns of UTC) on."""

    start: int
    rate: int
    channels: int
    data: bytes

    @property
    def end(self) -> int:
        """End of the clip, in nanoseconds of UTC."""
        samples = len(self.data) // (SAMPLE_BYTES * self.channels)
        return self.start + samples * NANOSECONDS // self.rate


def clips_of(columns: Columns) -> Iterator[LoggedClip]:
    """Yield the clips of messages, in their order.

    Raise `LogError` if a field is missing, or if a clip is not `pcm-s16`, has a sample rate below
    1000 or above 1,000,000 Hz, has no channel or more than 256, or ends within a sample.
    """
    fields = (columns[path].tolist() for path in ("format", "sample_rate", "number_of_channels"))
    for start, data, form, rate, channels in zip(
        columns["timestamp"].tolist(), columns["data"], *fields, strict=True
    ):
        problem = ""
        if form != _FORMAT:
            problem = f"its format is {form!r}, not {_FORMAT!r}"
        elif rate not in _RATES:
            problem = f"{rate} samples a second"
        elif channels not in _CHANNELS:
            problem = f"{channels} channels"
        elif len(data) % (channels * SAMPLE_BYTES):
            problem = f"{len(data)} bytes are no whole samples of {channels} channels"
        if problem:
            raise LogError(f"{columns.topic}: a clip cannot be read ({problem})")
        yield LoggedClip(start, rate, channels, bytes(data))


def read_clips(
    path: Path, name: str, start: int | None = None, end: int | None = None
) -> Iterator[tuple[int, int, Float32]]:
    """Yield start (ns of UTC), rate (samples per second) and samples (-1 to 1) of a topic's clips.

    The samples are the mean of all channels. Messages are from log time `start` on, before `end`,
    in nanoseconds of UTC; by default there is no limit. Raise `LogError` if the log is damaged, if
    the topic holds no clips, or as `clips_of` does.
    """
    for clip in _clips(path, name, start, end):
        samples = np.frombuffer(clip.data, "<i2").astype(np.float32) / _FULL_SCALE
        if clip.channels > 1:
            samples = samples.reshape(-1, clip.channels).mean(axis=1)
        yield clip.start, clip.rate, samples


def _clips(path: Path, name: str, start: int | None, end: int | None) -> Iterator[LoggedClip]:
    for batch in iterate_messages([path], [name], start, end):
        for raw in batch:
            if not is_compatible(raw.channel, raw.schema, message_types.RAW_AUDIO, CLIP_FIELDS):
                kind = "no messages of ROS 2" if raw.schema is None else raw.schema.name
                raise LogError(f"{path}: {name}: holds {kind}, not clips")
        for columns in decode(batch, CLIP_FIELDS):
            try:
                yield from clips_of(columns)
            except LogError as error:
                raise LogError(f"{path}: {error}") from error


def kept_time(layers: Iterable[Path], name: str, start: int, end: int) -> Spans:
    """Return the time spans with recorded audio; raise `LogError` as `read_clips` does."""
    times = [
        (clip.start, clip.end)
        for layer in layers
        for clip in _clips(layer, name, start - _NEAR, end + _NEAR)
    ]
    edges = np.array(times, np.int64).reshape(-1, 2)
    return joined(edges[:, 0], edges[:, 1], _TOUCHING)


def kept_sound(layers: Sequence[Path], name: str, start: int, end: int) -> tuple[int, Float32]:
    """Return rate and samples (-1 to 1) of the recorded audio of a span, with silence elsewhere.

    The rate is that of the first clip, in samples per second; 0 without any clip. Clips with
    another rate are skipped. Raise `LogError` as `read_clips` does.
    """
    rate, sound = 0, np.empty(0, np.float32)
    for layer in layers:
        for begin, own_rate, samples in read_clips(layer, name, start - _NEAR, end + _NEAR):
            place = (begin - start) * own_rate // NANOSECONDS
            length = (end - start) * own_rate // NANOSECONDS
            first, last = max(place, 0), min(place + len(samples), length)
            if first < last and rate in {0, own_rate}:
                if not rate:
                    rate, sound = own_rate, np.zeros(length, np.float32)
                sound[first:last] = samples[first - place : last - place]
    return rate, sound


def wav_bytes(samples: Float32, rate: int) -> bytes:
    """Return sound (-1 to 1) as a WAV file of 16 bits."""
    content = io.BytesIO()
    with wave.open(content, "wb") as sound:
        sound.setparams((1, SAMPLE_BYTES, rate, 0, "NONE", ""))
        sound.writeframes((np.clip(samples, -1.0, 1.0) * _WAV_SCALE).astype("<i2").tobytes())
    return content.getvalue()


def play_sound(samples: Float32, rate: int, *, wait: bool = False) -> None:
    """Play sound on the default output of the machine, and `wait` for its end.

    Raise `LogError` if there is no output, or PortAudio is missing.
    """
    try:
        import sounddevice  # noqa: PLC0415  PortAudio may be missing
    except OSError as error:
        raise LogError(f"the sound cannot be played here ({error})") from error
    try:
        sounddevice.play(samples, rate)
        if wait:
            sounddevice.wait()
    except (sounddevice.PortAudioError, ValueError) as error:
        raise LogError(f"the sound cannot be played here ({error}); is there a speaker?") from error


def stop_sound() -> None:
    """Stop what `play_sound` plays."""
    with suppress(OSError):
        import sounddevice  # noqa: PLC0415  PortAudio may be missing

        sounddevice.stop()
