"""The sound of labelled clips."""

import numpy as np

from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.recorder.errors import SourceError
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.frame_cutter import FrameCutter
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES


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
        If the clip cannot be read, or samples of it are not finite.
    """
    cutter = FrameCutter()
    blocks = [cutter.push(block) for block in read_audio(clip.path, clip.start, clip.end)]
    frames = np.concatenate([np.empty((0, FRAME_SAMPLES), np.float32), *blocks])
    if not np.isfinite(frames).all():
        raise SourceError(f"{clip.path}: samples of it are no numbers (NaN or infinity)")
    return InfrasoundFilter()(frames)
