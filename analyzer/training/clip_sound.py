"""The sound of labelled clips."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.framing import FrameCutter
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS

NO_NUMBERS = "the samples are no numbers (NaN or infinity)"
MOST_SECONDS = 3600.0  # of a clip, which is held in memory


class ClipSound(NamedTuple):
    """The sound of a clip, without the frames that hold samples that are no numbers.

    Attributes
    ----------
    frames : np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        Whole frames at 16 kHz, of which a recorder takes features; none of a part behind the end
        of the file.
    """

    frames: Float32
    breaks: Sequence[int] = ()
    lost: int = 0


def clip_frames(clip: LabelledClip) -> Float32:
    """Read the frames of a clip, as of `read_clip`."""
    return read_clip(clip).frames


def read_clip(clip: LabelledClip) -> ClipSound:
    """Read a clip.

    Raise `SourceError` if the clip cannot be read completely, is longer than an hour, or has no
    sample that is finite.
    """
    cutter = FrameCutter()
    faults: list[str] = []
    blocks: list[Float32] = []
    left = round(MOST_SECONDS / FRAME_SECONDS)
    for block in read_audio(clip.path, clip.start, clip.end, incomplete=faults.append):
        blocks.append(cutter.push(block))
        left -= len(blocks[-1])
        if left < 0:
            raise SourceError(
                f"{clip.path}: is longer than an hour; give it a start and an end in the manifest"
            )
    if faults:
        raise SourceError(faults[0])
    frames = np.concatenate([np.empty((0, FRAME_SAMPLES), np.float32), *blocks])
    is_finite = np.isfinite(frames).all(axis=1)
    if is_finite.all():
        return ClipSound(InfrasoundFilter()(frames))
    if not is_finite.any():
        raise SourceError(f"{clip.path}: {NO_NUMBERS}")
    runs = np.split(np.arange(len(frames)), np.flatnonzero(np.diff(is_finite)) + 1)
    sounds = [InfrasoundFilter()(frames[run]) for run in runs if is_finite[run[0]]]
    breaks = np.cumsum([len(sound) for sound in sounds])[:-1]
    return ClipSound(np.concatenate(sounds), breaks.tolist(), int((~is_finite).sum()))
