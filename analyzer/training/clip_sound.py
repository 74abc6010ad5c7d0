"""The sound of labelled clips."""

import numpy as np

from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.frame_cutter import FrameCutter
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS

MOST_SECONDS = 3600.0  # of a clip, which is held in memory


def clip_frames(clip: LabelledClip) -> Float32:
    """Read a clip.

    Parameters
    ----------
    clip : LabelledClip

    Returns
    -------
    np.ndarray [shape=(n, FRAME_SAMPLES)], float32
        Whole frames at 16 kHz, of which a recorder takes features; none of a part behind the end
        of the file.

    Raises
    ------
    SourceError
        If the clip cannot be read completely, is longer than an hour, or if samples of it are not
        finite.
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
    if not np.isfinite(frames).all():
        raise SourceError(f"{clip.path}: samples of it are no numbers (NaN or infinity)")
    return InfrasoundFilter()(frames)
