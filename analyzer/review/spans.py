"""Single-label spans that a person can judge, with their uncertainty and sound features."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import Events
from hearthlog.analyzer.logs.labelling import LabelledFile, Labellings
from hearthlog.analyzer.logs.recorder_info import model_of
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.logs.sound_vectors import mean_embeddings
from hearthlog.analyzer.logs.spans import (
    Spans,
    concatenated_ranges,
    difference_rows,
    intersection_rows,
    overlay,
)
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet, Inputs, WindowStatistics
from hearthlog.models.features.floor import BLOCK_FRAMES, FloorTracker
from hearthlog.models.features.installed import feature_set
from hearthlog.models.modelfile import load_model
from hearthlog.models.registry import find_model_by_sha256
from hearthlog.schemas.arrays import Bool, Float64, Int64
from hearthlog.schemas.errors import LogError, ModelError, Progress, ignore_progress
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages.topics import EmbeddingSpace, topic

SHORTEST = NANOSECONDS // 2
LONGEST = 10 * NANOSECONDS
LEAST_AUDIBLE = NANOSECONDS // 4  # of kept sound, for a person to judge
_FLICKER = NANOSECONDS
_MOST = 5_000_000


@dataclass(frozen=True)
class JudgeableSpans(Events):
    """Spans in time order (nanoseconds of UTC), without overlaps."""

    sources: Int64  # [shape=(n,)]; equal for spans cut from the same segment

    def take(self, rows: Int64) -> "JudgeableSpans":
        """Return some of the spans; rows must be in time order, or the result is not."""
        return JudgeableSpans(
            self.starts[rows], self.ends[rows], self.labels[rows], self.sources[rows]
        )


def judgeable_spans(segments: Events) -> JudgeableSpans:
    """Make spans that a person can judge: join flickering segments, and cut long ones.

    Segments are nanoseconds of UTC, in time order, one label at a time. Successive segments of less
    than a second each are joined, with the label of the longest. Spans longer than ten seconds are
    cut into equal parts; spans shorter than half a second are dropped, since nobody could judge
    them. Raise `DataError` if there are more than five million spans, as of a year and a half.
    """
    lengths = segments.ends - segments.starts
    short = lengths < _FLICKER
    joined = short[1:] & short[:-1] & (segments.starts[1:] == segments.ends[:-1])
    new = np.append(True, ~joined)[: len(lengths)]
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(new))[: len(first)] - 1
    longest = np.lexsort((lengths, np.cumsum(new)))[last]
    starts, ends = segments.starts[first], segments.ends[last]
    parts = np.where(ends - starts < SHORTEST, 0, -(-(ends - starts) // LONGEST))
    if parts.sum() > _MOST:
        raise DataError("too much to rank at once: choose a part with --start and --end")
    source, part = concatenated_ranges(np.zeros(len(first), np.int64), parts)
    begins, stops = (
        starts[source] + (ends - starts)[source] * number // parts[source]
        for number in (part, part + 1)
    )
    return JudgeableSpans(begins, stops, segments.labels[longest][source], source)


def border_pieces(spans: JudgeableSpans, silent: Bool) -> Bool:
    """Find spans shorter than a second next to another sound; `silent` labels are silence.

    Where one sound changes into the next the label wavers, and a person hears only the two. A sound
    as short that stands alone, such as a cough, can be judged.
    """
    touching = spans.starts[1:] == spans.ends[:-1]
    sounds = ~silent[spans.labels]
    is_next = np.zeros(len(spans), bool)
    is_next[1:] |= touching & sounds[:-1]
    is_next[:-1] |= touching & sounds[1:]
    return is_next & (spans.ends - spans.starts < _FLICKER)


def audible_time(spans: JudgeableSpans, audible: Spans) -> Int64:
    """Return the kept sound in each span, in nanoseconds; shape (n,)."""
    kept, row, _ = intersection_rows(spans, audible)
    return np.bincount(row, kept.ends - kept.starts, len(spans)).astype(np.int64)


def cut_to_audible(spans: JudgeableSpans, audible: Spans, least: int) -> JudgeableSpans:
    """Cut spans that are partly audible to the part from their first to their last kept sound.

    The part is at least `least` nanoseconds long, if its span is. Spans with less than a quarter of
    a second of kept sound stay as they are.
    """
    kept, row, _ = intersection_rows(spans, audible)
    enough = audible_time(spans, audible) >= LEAST_AUDIBLE
    first, last = spans.ends.copy(), spans.starts.copy()
    np.minimum.at(first, row, kept.starts)
    np.maximum.at(last, row, kept.ends)
    missing = np.maximum(least - (last - first), 0)
    starts = np.clip(
        first - missing // 2, spans.starts, np.maximum(spans.ends - least, spans.starts)
    )
    ends = np.minimum(np.maximum(last, starts + least), spans.ends)
    return replace(
        spans,
        starts=np.where(enough, starts, spans.starts),
        ends=np.where(enough, ends, spans.ends),
    )


def remove_reviewed(segments: Events, reviewed: Spans) -> Events:
    """Return the parts of segments outside the reviewed time."""
    spans, rows = difference_rows(segments, reviewed)
    return Events(*spans, segments.labels[rows])


def other_labels(spans: JudgeableSpans, others: Events) -> tuple[Int64, Float64]:
    """Compare spans with another labelling.

    Return its main label in each span, -1 for none, and the share of each span with a different
    label, 0 to 1.
    """
    pieces = overlay([spans, others]).in_all()
    row, label = pieces.rows[0], others.labels[pieces.rows[1]]
    lengths = pieces.ends - pieces.starts
    apart = np.where(label != spans.labels[row], lengths, 0)
    differing = np.bincount(row, apart, len(spans)) / (spans.ends - spans.starts)
    pairs, place = np.unique(np.stack([row, label]), axis=1, return_inverse=True)
    by_length = np.lexsort((np.bincount(place, lengths), pairs[0]))
    labels = np.full(len(spans), -1)
    labels[pairs[0][by_length]] = pairs[1][by_length]  # of duplicate rows the last value remains
    return labels, differing


class ModelUncertainty:
    """Mean uncertainty and novelty (0 to 1), and probability of silence, of one or more spans.

    They are computed from batches of labels; silence is 1 where nothing is above the noise floor.
    """

    def __init__(self, spans: JudgeableSpans, classes: Sequence[str]) -> None:
        self._spans, self._classes = spans, classes
        self.uncertainty, self.novelty, self.silence = (SpanMeans(len(spans)) for _ in range(3))

    def add(self, frames: Columns) -> None:
        """Add label messages, in any order, with stamp, probabilities and novelty.

        Probabilities without names are skipped.
        """
        stamps, probabilities = frames["header.stamp"], frames["probabilities"]
        row = np.searchsorted(self._spans.starts, stamps, side="right") - 1
        inside = (row >= 0) & (stamps < self._spans.ends[row])
        row = row[inside]
        self.novelty.add(row, frames["novelty"][inside].astype(np.float64))
        names = array_names(frames.metadata, "probabilities")
        if probabilities.ndim == 2 and probabilities.shape[1] == len(names) > 1:
            place = {name: i for i, name in enumerate(names)}
            columns = np.array([place.get(name, -1) for name in self._classes])
            labelled = columns[self._spans.labels[row]]
            self.uncertainty.add(row, uncertainty(probabilities[inside], labelled))
            silent = [class_name(name) == SILENCE for name in names]
            self.silence.add(row, probabilities[inside][:, silent].sum(axis=1, dtype=np.float64))


def uncertainty(probabilities: NDArray[np.floating], labelled: Int64) -> Float64:
    """Return (1 - p + q) / 2 for p of the label and q of the best other class.

    It is 0 (certain) to 1; 0.5 where another class is as probable as the label. Smoothing may
    choose another label than the most probable class, so the difference of the two highest
    probabilities [shape=(n, C)] would be wrong. `labelled` has columns of the labels; -1 for a
    label without a column, with p = 0.
    """
    others = probabilities.astype(np.float64)
    rows = np.flatnonzero(labelled >= 0)
    own = np.zeros(len(others))
    own[rows] = others[rows, labelled[rows]]
    others[rows, labelled[rows]] = 0.0
    return np.clip((1.0 - own + others.max(axis=1, initial=0.0)) / 2.0, 0.0, 1.0)


class SpanMeans:
    """Means of the finite values in each span."""

    def __init__(self, count: int) -> None:
        self._sums, self._counts = np.zeros(count), np.zeros(count)

    def add(self, row: Int64, values: Float64) -> None:
        """Add values to the rows of their spans; values that are not finite are skipped."""
        finite = np.isfinite(values)
        row, values = row[finite], values[finite]
        if len(row):
            first = int(row.min())
            part = slice(first, int(row.max()) + 1)
            self._sums[part] += np.bincount(row - first, values)
            self._counts[part] += np.bincount(row - first)

    @property
    def exist(self) -> bool:
        """Whether there is any value."""
        return bool(self._counts.any())

    def values(self) -> Float64:
        """Return the means, shape (count,); 0 where there is no value."""
        return self._sums / np.maximum(self._counts, 1.0)


_FIELDS = ("header.stamp", "frame", "values")
_BEFORE = 60 * NANOSECONDS  # time used to find the noise floor
_MOST_AT_ONCE = 1800 * NANOSECONDS
_MOST_WINDOWS = 12  # per span
_EMBEDDED = 0.5  # their part of the kernel exponent of two spans, on average, halved
_GAMMA = 0.5  # divided by the number of inputs, as in the starter models


class SpanSounds(NamedTuple):
    """One point per span; the kernel of two points is exp(-gamma |x - y|^2).

    A point has means of scaled inputs, followed by the embeddings of one network, 0 for a span
    without any; NaN for a span without features.
    """

    points: Float64  # [shape=(n, width)]
    gamma: float


def labelling_model(
    logs: list[LabelledFile], microphone: str, models: Path, scenario: str = ""
) -> Model | None:
    """Find the model that labelled a microphone in the latest of some logs or layers.

    The scenario is empty for the sounds of the home. None if the file of the model is missing or
    unusable.
    """
    with suppress(ModelError):
        path = find_model_by_sha256(
            models, model_of(logs[-1].path, microphone, scenario).model_sha256
        )
        return None if path is None else load_model(path)
    return None


def span_sounds(
    spans: JudgeableSpans,
    sources: Labellings,
    microphone: str,
    model: Model | None,
    progress: Progress = ignore_progress,
) -> SpanSounds:
    """Read the inputs and embeddings of one or more spans.

    Without the model that labelled them, or if its feature set differs from that of the logs, the
    points are means and standard deviations of the features, scaled by their spread. `progress`
    receives the share of the spans that is read, 0 to 1.
    """
    name, points = topic(microphone, "features"), np.empty((len(spans), 0))
    embedded: dict[EmbeddingSpace, Float64] = {}
    space = None if model is None else _space(model)
    for first, last in _groups(spans):
        start, end = int(spans.starts[first]), int(spans.ends[last - 1])
        part = slice(first, last)
        recorded = _read(sources, name, start - _BEFORE, end)
        if recorded is not None:
            if space is None or not space.is_of(recorded):
                width = recorded["values"].shape[1]
                space = _Space(None, WindowStatistics(BLOCK_FRAMES, np.asarray, width))
            means = _means(recorded, spans.starts[part], spans.ends[part], space)
            if means.shape[1] != points.shape[1]:
                points = np.full((len(spans), means.shape[1]), np.nan)
            points[part] = means
            _embed(embedded, sources, microphone, spans, part)
        progress(last / len(spans))
    if not points.shape[1]:
        return SpanSounds(np.full((len(spans), 1), np.nan), 1.0)
    if space is None or space.features is None:
        spread = np.nanstd(points, axis=0)
        points, gamma = points / np.where(spread > 0.0, spread, 1.0), _GAMMA / points.shape[1]
    else:
        points, gamma = (points - space.mean) / space.scale, space.gamma
    own = None if model is None else model.description.embedding_space
    if embedded:
        most = max(embedded, key=lambda one: (one == own, np.isfinite(embedded[one]).sum()))
        points = np.concatenate([points, _scaled(embedded[most], gamma)], axis=1)
    return SpanSounds(points, gamma)


def _embed(
    embedded: dict[EmbeddingSpace, Float64],
    sources: Labellings,
    microphone: str,
    spans: JudgeableSpans,
    part: slice,
) -> None:
    """Read the embeddings of some spans, log by log, separately for each network."""
    name, starts, ends = topic(microphone, "embedding"), spans.starts[part], spans.ends[part]
    for log in sources.logs:
        if log.last < starts[0] or log.first >= ends[-1]:
            continue
        try:
            span = int(starts[0]), int(ends[-1]) + NANOSECONDS  # logged when a window has ended
            columns = read_columns([log.path], {name}, *span, fields=_FIELDS[::2]).get(name)
        except LogError as error:
            sources.lose(error)
            continue
        space, means = mean_embeddings(columns, starts, ends)
        if space is not None:
            every = embedded.setdefault(space, np.full((len(spans), means.shape[1]), np.nan))
            there = np.isfinite(means).all(axis=1)
            if every.shape[1] == means.shape[1]:
                every[part][there] = means[there]


def _scaled(embedded: Float64, gamma: float) -> Float64:
    """Scale embeddings so that spans are on average as far apart as by their inputs."""
    there = np.isfinite(embedded).all(axis=1)
    own = embedded[there] - embedded[there].mean(axis=0)
    spread = own.std(axis=0)
    scaled = np.zeros(embedded.shape)
    scaled[there] = own / np.where(spread > 0.0, spread, 1.0)
    return scaled * np.sqrt(_EMBEDDED / (gamma * embedded.shape[1]))


class _Space(NamedTuple):
    """Inputs of windows, and their scaling."""

    features: FeatureSet | None
    inputs: Inputs
    mean: Float64 = np.empty(0)
    scale: Float64 = np.empty(0)
    gamma: float = 0.0

    def is_of(self, recorded: Columns) -> bool:
        """Return whether these are inputs of recorded features."""
        width = recorded["values"].shape[1]
        if self.features is None:
            return self.inputs.width == 2 * width
        names = array_names(recorded.metadata, "values")
        return (tuple(names) or self.features.feature_names) == self.features.feature_names


def _space(model: Model) -> _Space | None:
    """Return the input space of a kernel classifier; None for other models."""
    description, arrays = model.description, model.arrays
    gamma = description.parameters.get("gamma")
    if gamma is None or not {"scaler_mean", "scaler_scale"} <= arrays.keys():
        return None
    try:
        features = feature_set(description.feature_set)
    except ModelError:
        return None
    inputs = features.inputs[description.inputs]
    return _Space(features, inputs, arrays["scaler_mean"], arrays["scaler_scale"], gamma)


def _groups(spans: JudgeableSpans) -> Iterator[tuple[int, int]]:
    """Yield row ranges (first, end) of spans that are read at once."""
    first = 0
    while first < len(spans):
        last = int(np.searchsorted(spans.starts, spans.starts[first] + _MOST_AT_ONCE))
        yield first, last
        first = last


def _read(sources: Labellings, name: str, start: int, end: int) -> Columns | None:
    near = [log.path for log in sources.logs if log.last >= start and log.first < end]
    try:
        recorded = read_columns(near, {name}, start, end, fields=_FIELDS).get(name)
    except LogError as error:
        sources.lose(error)
        return None
    return recorded if recorded is not None and len(recorded) else None


def _means(recorded: Columns, starts: Int64, ends: Int64, space: _Space) -> Float64:
    """Return the mean inputs of the windows of each span; NaN where there is none."""
    stamps, values = recorded["header.stamp"], recorded["values"]
    means = np.full((len(starts), space.inputs.width), np.nan)
    length = space.inputs.window_frames
    first, last = (np.searchsorted(stamps, times) for times in (starts, ends))
    there = np.flatnonzero((last > first) & (len(stamps) >= length))
    if not len(there):
        return means
    first = np.minimum(first[there], len(stamps) - length)
    room = np.maximum(last[there] - length - first, 0)
    counts = np.minimum(1 + room // length, _MOST_WINDOWS)
    row, number = concatenated_ranges(np.zeros(len(there), np.int64), counts)
    begin = first[row] + number * room[row] // np.maximum(counts - 1, 1)[row]
    windows = values[begin[:, np.newaxis] + np.arange(length)]
    floors = None
    if space.inputs.needs_floor:
        floors = _floors(recorded, space.features)[begin + length - 1]
    sums = np.add.reduceat(
        space.inputs.of_windows(windows, floors), np.cumsum(counts) - counts, dtype=np.float64
    )
    means[there] = sums / counts[:, np.newaxis]
    return means


def _floors(recorded: Columns, features: FeatureSet | None) -> Float64:
    """Return the noise floor at each frame, close to the recorder's own."""
    assert features is not None
    assert features.band_powers is not None
    frames, powers = recorded["frame"].astype(np.int64), features.band_powers(recorded["values"])
    for run in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) != 1) + 1):
        tracked = FloorTracker()(powers[run], int(frames[run[0]])).powers
        powers[run[len(run) - len(tracked) :]] = tracked
        if len(tracked):
            powers[run[: len(run) - len(tracked)]] = tracked[0]
    return powers
