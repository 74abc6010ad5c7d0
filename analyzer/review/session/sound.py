"""Play the kept sound of a span of time."""

from collections.abc import Sequence

import numpy as np

from hearthlog.analyzer.review.timeline.model import SoundClip
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import NANOSECONDS

_FULL_SCALE = np.float32(32768.0)


def listen(clips: Sequence[SoundClip], start: int, end: int) -> str:
    """Start to play the kept sound of a span of time.

    Returns
    -------
    str
        A line for the reviewer: how long the sound is, or why there is none.
    """
    rate, samples = sound_of(clips, start, end)
    if not len(samples):
        return "no sound of this span was kept"
    try:
        import sounddevice  # noqa: PLC0415 - few reviews have sound, and PortAudio may be missing

        sounddevice.play(samples, rate)
    except (OSError, ValueError, RuntimeError) as error:
        return f"the sound cannot be played here ({error})"
    return f"playing {len(samples) / rate:.1f} s"


def sound_of(clips: Sequence[SoundClip], start: int, end: int) -> tuple[int, Float32]:
    """Return the kept sound of a span of time, without the holes.

    Clips of another rate than the first are left out.

    Returns
    -------
    rate : int
        Samples per second; 0 if no sound was kept.
    samples : np.ndarray [shape=(n,)], float32
        -1 to 1.
    """
    parts, rate = [np.empty(0, np.float32)], 0
    for clip in clips:
        if clip.start < end and clip.end > start and rate in {0, clip.rate}:
            rate = clip.rate
            first, last = ((t - clip.start) * rate // NANOSECONDS for t in (start, end))
            samples = clip.samples[max(first, 0) : max(last, 0)].astype(np.float32)
            parts.append(samples / _FULL_SCALE)
    return rate, np.concatenate(parts)
