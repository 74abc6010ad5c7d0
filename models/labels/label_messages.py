"""Labels and segments as columns of messages, the same from a recorder and from a relabelling."""

from collections.abc import Sequence

import numpy as np

from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.models.labels.segments import Segment
from hearthlog.schemas.messages.cdr_codec import Column


def label_columns(labels: FrameLabels, microphone: str) -> dict[str, Column]:
    """Return the fields of one `AudioLabel` a frame."""
    best = labels.probabilities.argmax(axis=1)
    return {
        "header.stamp": labels.stamps,
        "header.frame_id": microphone,
        "frame": labels.frames,
        "label": np.array(labels.classes, object)[best],
        "confidence": labels.probabilities[np.arange(len(best)), best],
        "novelty": labels.novelty,
        "probabilities": labels.probabilities,
    }


def segment_columns(
    segments: Sequence[Segment], classes: Sequence[str], microphone: str
) -> dict[str, Column]:
    """Return the fields of one `AudioSegment` a segment."""
    starts = np.array([segment.start for segment in segments], np.int64)
    ends = np.array([segment.end for segment in segments], np.int64)
    return {
        "header.stamp": starts,
        "header.frame_id": microphone,
        "duration": ends - starts,
        "label": [classes[segment.label] for segment in segments],
        "confidence": np.array([segment.confidence for segment in segments], np.float32),
    }
