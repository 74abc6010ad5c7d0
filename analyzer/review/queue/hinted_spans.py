"""Spans of sounds that a network has a name for, which it says too often to be counted."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation.event_scores import Events, events_of
from hearthlog.analyzer.logs.labelling import Labellings, LogContents, NamedLabelling
from hearthlog.analyzer.logs.sound_vectors import EMBEDDING_FIELDS, embeddings_of
from hearthlog.analyzer.logs.spans import Spans
from hearthlog.analyzer.review.queue.judgeable_spans import (
    judgeable_spans,
    other_labels,
    without,
)
from hearthlog.analyzer.review.queue.ranking import spread
from hearthlog.analyzer.review.queue.review_list import HINT, ReviewSpan
from hearthlog.models.classes import class_name
from hearthlog.models.classifiers.names import AUDIOSET
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.projection import Embeddings, Projection, read_projection
from hearthlog.models.embedding.sound_names import SoundName, audioset_names, named_sounds
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import EmbeddingSource, scenario_labelling, topic


def hinted_spans(
    side: NamedLabelling,
    sources: Labellings,
    microphone: str,
    reviewed: Spans,
    count: int,
) -> list[ReviewSpan]:
    """Choose sounds that a network names with a name that is a hint, and labels do not.

    Parameters
    ----------
    count : int
        How many, at most.

    Returns
    -------
    list of ReviewSpan
        Spread over names and days, of each the clearest first. The score is by how many logits the
        network is above the threshold of the name.

    Raises
    ------
    DataError
        If there are no embeddings, or nothing is left in which the network gives a hint.
    """
    names = [name for name in audioset_names() if not name.is_event]
    hints, above = _named(sources, microphone, names)
    classes = list(dict.fromkeys([*side.classes, *(name.name for name in names)]))
    spans = judgeable_spans(without(hints, reviewed))
    labels, _ = other_labels(spans, events_of(side.labelling, classes))
    own = [class_name(classes[label]) if label >= 0 else "" for label in labels.tolist()]
    new = np.array(
        [names[n].name != label for n, label in zip(spans.labels.tolist(), own, strict=True)], bool
    )
    labelled = np.flatnonzero(new & (labels >= 0))
    labelled = labelled[np.unique(spans.sources[labelled], return_index=True)[1]]  # one of each
    if not len(labelled):
        raise DataError(f"{side.name}: no span is left in which the network gives a hint")
    spans, labels = spans.take(labelled), labels[labelled]
    place = np.searchsorted(hints.starts, spans.starts, "right") - 1
    scores = above[place]
    rows = spread(1.0 + scores, spans, count)
    return [
        ReviewSpan(
            microphone,
            int(spans.starts[row]),
            int(spans.ends[row]),
            side.name,
            classes[labels[row]],
            scenario_labelling(AUDIOSET),
            names[spans.labels[row]].name,
            round(float(scores[row]), 3),
            HINT,
        )
        for row in rows.tolist()
    ]


def _named(
    sources: Labellings, microphone: str, names: list[SoundName]
) -> tuple[Events, np.ndarray[tuple[int], np.dtype[np.float64]]]:
    """Return the sounds that networks name, one at a time, and how far each is above.

    Of two names at once it is the one that is further above its threshold.
    """
    found: list[tuple[int, int, int, float]] = []
    embedded = False
    numbers = {name: number for number, name in enumerate(names)}
    for log in sources.logs:
        try:
            for embeddings, projection in _embedded(log, microphone):
                embedded = True
                for sound in named_sounds(embeddings, projection, names):
                    start, end = (_time(embeddings, at) for at in (sound.first, sound.end))
                    row = start, end, numbers[sound.name], sound.logit - sound.name.threshold
                    found.append(row)
        except LogError as error:
            sources.lose(error)
    if not embedded:
        raise DataError(
            f"{microphone}: --queue hint needs embeddings, and these logs have none: record with a "
            "network (hearthlog models fetch yamnet)"
        )
    kept: list[tuple[int, int, int, float]] = []
    for row in sorted(found):
        if kept and row[0] < kept[-1][1]:
            if row[3] > kept[-1][3]:
                kept[-1] = row
        else:
            kept.append(row)
    starts, ends, labels = (np.array([row[n] for row in kept], np.int64) for n in range(3))
    return Events(starts, ends, labels), np.array([row[3] for row in kept], np.float64)


def _embedded(log: LogContents, microphone: str) -> Iterator[tuple[Embeddings, Projection]]:
    """Yield the embeddings of a log, of which frames follow, with their projection."""
    name = topic(microphone, "embedding")
    columns = read_columns([log.path], {name}, fields=EMBEDDING_FIELDS).get(name)
    if columns is None or columns.type != message_types.EMBEDDING or not len(columns):
        return
    source = EmbeddingSource.from_metadata(columns.metadata)
    projection = read_projection(YAMNET.projection)
    if source is None or source.projection_sha256 != projection.sha256:
        return
    embeddings = embeddings_of(columns)
    new = np.flatnonzero(np.diff(embeddings.frames) <= 0) + 1
    for first, last in pairwise([0, *new.tolist(), len(embeddings.frames)]):
        yield embeddings.rows(slice(first, last)), projection


def _time(embeddings: Embeddings, frame: int) -> int:
    """Return the start of a frame in nanoseconds of UTC, by the window nearest before it."""
    place = max(int(np.searchsorted(embeddings.frames, frame, "right")) - 1, 0)
    away = frame - int(embeddings.frames[place])
    return int(embeddings.stamps[place]) + away * FRAME_NANOSECONDS
