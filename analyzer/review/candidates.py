"""Spans for a review without ranking: changes by a model, hints, random minutes."""

from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.activity.day_profile import television_spans
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import Events, indexed_events
from hearthlog.analyzer.logs.labelling import (
    LabelledFile,
    Labelling,
    Labellings,
    NamedLabelling,
    unified,
)
from hearthlog.analyzer.logs.sound_vectors import EMBEDDING_FIELDS, embeddings_of
from hearthlog.analyzer.logs.spans import (
    NONE,
    Spans,
    intersection,
    joined,
    lengths,
    overlay,
    rows_at,
)
from hearthlog.analyzer.marks.marks import RANDOM, read_review
from hearthlog.analyzer.promotion import find_champion, other_features
from hearthlog.analyzer.promotion.paired_labels import ChangedTime, find_changed_time
from hearthlog.analyzer.promotion.recent_time import recent_logs
from hearthlog.analyzer.review.ranking import spread
from hearthlog.analyzer.review.review_list import CHANGE, HINT, ReviewSpan
from hearthlog.analyzer.review.spans import (
    JudgeableSpans,
    judgeable_spans,
    other_labels,
    remove_reviewed,
)
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.network_names import AUDIOSET
from hearthlog.models.embedding import Embeddings, Projection, read_projection
from hearthlog.models.embedding.networks import YAMNET
from hearthlog.models.embedding.sound_names import SoundName, audioset_names, named_sounds
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.errors import LogError, Progress, ignore_progress
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import is_layer
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import (
    LIVE,
    EmbeddingSource,
    labelling_topic,
    relabelling,
    scenario_labelling,
    topic,
)


def hinted_spans(
    side: NamedLabelling,
    sources: Labellings,
    microphone: str,
    reviewed: Spans,
    count: int,
) -> list[ReviewSpan]:
    """Choose up to `count` sounds with a network name that is a hint, and without such a label.

    They are spread over names and days, the clearest of each first; the score is the network's
    logit minus the threshold of the name. Raise `DataError` if there are no embeddings, or no hint
    is left.
    """
    names = [name for name in audioset_names() if not name.is_event]
    hints, above = _named(sources, microphone, names)
    classes = list(dict.fromkeys([*side.classes, *(name.name for name in names)]))
    spans = judgeable_spans(remove_reviewed(hints, reviewed))
    labels, _ = other_labels(spans, indexed_events(side.labelling, classes))
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


def _named(sources: Labellings, microphone: str, names: list[SoundName]) -> tuple[Events, Float64]:
    """Return the sounds named by networks, one at a time, and their logits above the threshold.

    Of two simultaneous names the one further above its threshold is used.
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


def _embedded(log: LabelledFile, microphone: str) -> Iterator[tuple[Embeddings, Projection]]:
    """Yield the embeddings of a log that are followed by frames, with their projection."""
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
    """Return the start of a frame in nanoseconds of UTC, from the last window before it."""
    place = max(int(np.searchsorted(embeddings.frames, frame, "right")) - 1, 0)
    away = frame - int(embeddings.frames[place])
    return int(embeddings.stamps[place]) + away * FRAME_NANOSECONDS


MINUTE = 60 * NANOSECONDS
SOUND_SHARE = 0.75  # of the drawn minutes have a sound, so that nights waste no time
_SEED = 20_261_123
_UNLABELLED = NANOSECONDS // 10  # maximum in a minute


class RecordedMinutes(NamedTuple):
    """Completely labelled minutes of the clock."""

    starts: Int64  # [shape=(n,)], in nanoseconds of UTC, ascending
    # [shape=(n,)]; whether any label in it is not silence, and no television seems to be on
    has_sound: Bool


def complete_minutes(labelling: Labelling) -> RecordedMinutes:
    """Find the complete minutes of a labelling, and which have a sound.

    Minutes with a television say little about counts, since hardly a class counts in them.
    """
    if not len(labelling):
        return RecordedMinutes(np.empty(0, np.int64), np.empty(0, bool))
    stretches = joined(labelling.starts, labelling.ends, _UNLABELLED)
    numbers = [np.arange(-(-start // MINUTE), end // MINUTE) for start, end in stretches.pairs()]
    starts = np.concatenate(numbers) * MINUTE
    labels = unified(labelling)
    has_sound = _length_in(labels.spans(labels.labels != SILENCE), starts) > 0
    return RecordedMinutes(starts, has_sound & (rows_at(television_spans(labels), starts) < 0))


def draw_minutes(
    minutes: RecordedMinutes, count: int, drawn: Collection[int] = (), taken: Spans = NONE
) -> Int64:
    """Draw up to `count` minutes at random, three of four with a sound; return their starts.

    They are in the order of the draw. `drawn` are starts of minutes drawn and reviewed before; all
    are nanoseconds of UTC. `taken` is reviewed time, excluded from the draw. The same minutes and
    the same earlier draws give the same result.
    """
    before = minutes.has_sound[np.isin(minutes.starts, list(drawn))]
    shuffled = np.random.default_rng([_SEED, len(drawn)]).permutation(len(minutes.starts))
    free = shuffled[_length_in(taken, minutes.starts)[shuffled] == 0]
    left = {sound: free[minutes.has_sound[free] == sound].tolist()[::-1] for sound in (True, False)}
    total, sounds = len(before), int(before.sum())
    chosen: list[int] = []
    while len(chosen) < count and any(left.values()):
        sound = bool(left[True]) and (not left[False] or sounds < SOUND_SHARE * (total + 1))
        chosen.append(left[sound].pop())
        total, sounds = total + 1, sounds + sound
    return minutes.starts[np.array(chosen, np.intp)]


def _length_in(spans: Spans, minutes: Int64) -> Int64:
    """Return the length of each minute covered by spans, in nanoseconds."""
    if not len(minutes):
        return np.empty(0, np.int64)
    edges = np.unique(np.concatenate([minutes, minutes + MINUTE]))
    inside = lengths(intersection(spans, joined(minutes, minutes + MINUTE)), edges)
    return inside[np.searchsorted(edges, minutes)]


class ReviewedTime(NamedTuple):
    """Marked or reviewed time of a microphone."""

    spans: Spans
    random: frozenset[int]  # starts of the spans drawn at random, in nanoseconds of UTC


def reviewed_time(sources: Labellings, microphone: str, scenario: str = "") -> ReviewedTime:
    """Read the reviewed time of a microphone, by all reviewers, of all labellings of one scenario.

    The scenario is empty for the sounds of the home.
    """
    times, random = [], set[int]()
    for log in sources.logs:
        if is_layer(log.path):
            continue
        try:
            review = read_review(log.path)
        except LogError as error:
            sources.lose(error)
            continue
        marks, reviewed = review.get(scenario, ((), ()))
        own = [span for span in reviewed if span.microphone == microphone]
        random |= {span.start for span in own if span.chosen == RANDOM}
        times += [(span.start, span.end) for span in own]
        times += [(mark.start, mark.end) for mark in marks if mark.microphone == microphone]
    starts, ends = np.array(times, np.int64).reshape(-1, 2).T
    return ReviewedTime(joined(starts, ends), frozenset(random))


def changed_by(  # noqa: PLR0913, PLR0917
    model: tuple[Path, Model],
    side: NamedLabelling,
    sources: Labellings,
    microphone: str,
    count: int,
    progress: Progress = ignore_progress,
) -> list[ReviewSpan]:
    """Choose up to `count` spans that a model labels differently from the current model.

    Spans of the labelling to review, `side`, are skipped where it differs from the current model,
    as it may for older logs. `progress` receives the processed share of the sound, 0 to 1. Spans of
    the largest changes come first, spread over changes and days, the longest of each first; the
    score is minutes a day, if a day is recorded.

    Raise `DataError` if the model cannot be compared, or changes nothing that a person could judge;
    `ModelError` as `find_champion`, and if a feature set is not installed.
    """
    folder, after = model
    topic = labelling_topic(microphone, LIVE, "segment")
    paths = [log.path for log in sources.with_topic(topic)]
    before = _champion(folder, after, paths)
    changed = find_changed_time(before, after, recent_logs(paths), microphone, progress)
    sources.losses.extend(loss for loss in changed.losses if loss not in sources.losses)
    left = remove_reviewed(_where(changed, side), reviewed_time(sources, microphone).spans)
    spans = judgeable_spans(left)
    if not len(spans):
        raise DataError(f"{after.name}: no span is left in which it differs from {before.name}")
    return _listed(spans, changed, side.name, microphone, after.name, count)


def _champion(folder: Path, model: Model, paths: list[Path]) -> Model:
    champion = find_champion(folder, paths, model)
    if champion is None:
        raise DataError(f"{model.name}: no model labels here yet, so nothing would change")
    if champion.sha256 == model.sha256:
        raise DataError(f"{model.name} labels here already: name a model that would change that")
    if other := other_features(champion, model):
        raise DataError(f"{model.name}: {other}")
    return champion


def _where(changed: ChangedTime, side: NamedLabelling) -> Events:
    """Return the changed time in which a labelling agrees with the first model."""
    classes, labels = changed.changes.classes, side.called_as(changed.changes.classes)
    every = list(dict.fromkeys([*classes, *labels.classes]))
    current = indexed_events(labels.labelling, every)
    parts = overlay([changed.spans, current]).in_all()
    pairs = changed.spans.labels[parts.rows[0]]
    same = pairs // len(classes) == current.labels[parts.rows[1]]
    return Events(parts.starts[same], parts.ends[same], pairs[same])


def _listed(  # noqa: PLR0913, PLR0917
    spans: JudgeableSpans,
    changed: ChangedTime,
    a: str,
    microphone: str,
    model: str,
    count: int,
) -> list[ReviewSpan]:
    """List the spans for the review, at most one per uninterrupted change."""
    classes, changes = changed.changes.classes, changed.changes
    _, first = np.unique(spans.sources, return_index=True)
    ordered = first[np.argsort(spans.starts[first] - spans.ends[first], kind="stable")]
    longest = spans.take(ordered)
    minutes = changes.minutes.reshape(-1)[longest.labels]
    rows = spread(minutes, longest, count)
    chosen, score = longest.take(rows), minutes[rows].round(1).tolist()
    columns = (column.tolist() for column in (chosen.starts, chosen.ends, chosen.labels))
    return [
        ReviewSpan(
            microphone,
            start,
            end,
            a,
            classes[pair // len(classes)],
            relabelling(model),
            classes[pair % len(classes)],
            much if changes.each else None,
            CHANGE,
        )
        for start, end, pair, much in zip(*columns, score, strict=True)
    ]
