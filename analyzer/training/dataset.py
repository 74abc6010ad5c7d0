"""Datasets: training windows of one second, cut from labelled sound."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.clips import (
    AS_IT_IS,
    NO_NUMBERS,
    SHORT,
    SHORT_PARTS,
    ClipEmbedder,
    ClipEmbeddings,
    ClipSound,
    RoomCopy,
    in_room,
    read_clip,
    spread,
)
from hearthlog.analyzer.training.direction_samples import DirectionSample
from hearthlog.analyzer.training.manifest import LabelledClip, Scenario, SkippedClip
from hearthlog.models.classes import SILENCE, class_name
from hearthlog.models.classifiers.model import Amount, Model
from hearthlog.models.embedding import Int8
from hearthlog.models.features import SILENCE_POWER, FeatureSet
from hearthlog.models.features.floor import low_power
from hearthlog.models.features.installed import DEFAULT
from hearthlog.schemas.arrays import Bool, Float32, Float64, Indices, Int64
from hearthlog.schemas.errors import Progress, SourceError
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS

HOP_FRAMES = 10
SEGMENTS_PER_GROUP = 24
_WINDOWS_PER_GROUP = 32  # windows of each version
UNREADABLE = "cannot be read, or not all of it"
CONFIRMED = "this home, as it was labelled"  # name of a collection
_BELOW_CLIP = 10 ** (-12 / 10)  # 12 dB
_SEED = 20_261_122


class Recording(NamedTuple):
    """Sound with one label."""

    label: str
    group: str  # never in both training and test sets
    collection: str
    licence: str
    features: Float32  # [shape=(n, d)]
    weight: float = 1.0
    # [shape=(n, b)], of each frame; None without a room, as in a cut clip
    floor: Float64 | None = None
    copies: Sequence[RoomCopy] = ()
    most: int | None = None  # maximum number of evenly spaced segments; None for no limit
    span: tuple[int, int] | None = None  # start and end in nanoseconds of UTC, if recorded
    sighting: DirectionSample | None = None
    fault: str = ""  # read error
    breaks: Sequence[int] = ()
    hole: str = ""  # missing part
    embedded: ClipEmbeddings | None = None  # None without a network


Segment = tuple[Recording, int]  # with the first frame


class EmbeddingWindows(NamedTuple):
    """Embedded windows for training heads."""

    values: Int8  # [shape=(m, W)]; logged integers
    target: Indices  # [shape=(m,)], as are the following
    group: Indices
    collection: Indices
    tried: Bool  # whether the window is unchanged and used for calibrating heads
    recording: Indices  # number of the recording; in a home, of the mark

    def rows(self, chosen: Indices | Bool) -> "EmbeddingWindows":
        """Return a subset of the windows."""
        return EmbeddingWindows._make(column[chosen] for column in self)


_NO_NUMBERS = np.empty(0, np.intp)
NO_WINDOWS = EmbeddingWindows(
    np.empty((0, 0), np.int8),
    _NO_NUMBERS,
    _NO_NUMBERS,
    _NO_NUMBERS,
    np.empty(0, bool),
    _NO_NUMBERS,
)


@dataclass(frozen=True)
class Dataset:
    """Training segments: windows of one second."""

    windows: Float32  # [shape=(n, window_frames, d)]
    target: Indices  # [shape=(n,)]; index into `classes`
    group: Indices  # [shape=(n,)]; number of the source group
    collection: Indices  # [shape=(n,)]
    weight: Float64  # [shape=(n,)]
    floor: Float64  # [shape=(n, b)]; b is 0 for a feature set without bands
    copies: Float32  # [shape=(k, n, window_frames, d)]; in other rooms; NaN if missing
    copy_floor: Float64  # [shape=(k, n, b)]
    classes: tuple[str, ...]
    seconds: Mapping[str, float]  # of sound of each class, before thinning
    collection_names: tuple[str, ...]
    collections: Mapping[tuple[str, str], int]
    skipped: Mapping[str, int]
    # [shape=(k, 2)]; starts and ends of the used recordings in nanoseconds of UTC, if recorded
    spans: Int64 = field(default_factory=lambda: np.empty((0, 2), np.int64))
    # directions of the segments, if recorded; empty if none has one
    sightings: Sequence[DirectionSample | None] = ()
    # unreadable recordings, which `skipped` counts too, and unreadable parts of others
    left_out: Sequence[SkippedClip] = ()
    # [shape=(n, W)]; W is 0 without a network
    embedded: Int8 = field(default_factory=lambda: np.empty((0, 0), np.int8))
    is_embedded: Bool = field(default_factory=lambda: np.empty(0, bool))  # [shape=(n,)]
    embedding_windows: EmbeddingWindows = NO_WINDOWS

    def __len__(self) -> int:
        return len(self.target)

    @property
    def bands(self) -> int:
        """Number of bands of the floor."""
        return self.floor.shape[1]

    @property
    def digest(self) -> str:
        """SHA-256 of the segments, their classes and their groups, in hexadecimal."""
        digest = hashlib.sha256("\n".join(self.classes).encode())
        for array in (self.windows, self.target.astype("<i8"), self.group.astype("<i8")):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @property
    def amounts(self) -> dict[str, Amount]:
        """Amount of each class."""
        sources = source_counts(self.target, self.group, len(self.classes))
        return {
            name: Amount(
                sources=int(sources[i]),
                segments=int((self.target == i).sum()),
                seconds=round(self.seconds.get(name, 0.0), 3),
            )
            for i, name in enumerate(self.classes)
        }


def source_counts(target: Indices, group: Indices, classes: int) -> Indices:
    """Return the number of source groups of each class."""
    pairs = np.unique(np.stack([target, group]), axis=1)
    return np.bincount(pairs[0], minlength=classes)


def build_dataset(  # noqa: PLR0913, PLR0917
    clips: Sequence[LabelledClip],
    scenario: Scenario,
    progress: Progress,
    home: Iterable[Recording] = (),
    features: FeatureSet = DEFAULT,
    rooms: int = 0,
    embedder: ClipEmbedder | None = None,
    seed: int = 0,
) -> Dataset:
    """Cut clips and recordings of a home into segments of a scenario, as `cut_recordings` does.

    Recordings of the home have the same features; their labels may be names of classes. The other
    parameters are those of `clip_recordings`. Raise `DataError` if a class has no segments.
    """
    of_clips = clip_recordings(clips, scenario, progress, features, rooms, embedder, seed)
    data = cut_recordings(chain(of_clips, home), scenario, features)
    for name, amount in data.amounts.items():
        if not amount.segments:
            labels = ", ".join(scenario.classes[name])
            why = f" (left out: {data.left_out[0].clip})" if data.left_out else ""
            raise DataError(
                f"class {name} has no segments: no usable clip is labelled {labels}{why}"
            )
    return data


def clip_recordings(  # noqa: PLR0913, PLR0917
    clips: Sequence[LabelledClip],
    scenario: Scenario,
    progress: Progress,
    features: FeatureSet = DEFAULT,
    rooms: int = 0,
    embedder: ClipEmbedder | None = None,
    seed: int = 0,
) -> Iterator[Recording]:
    """Read clips and compute their features, and those of `rooms` copies in other rooms, in order.

    Clips with labels outside the scenario and unreadable clips have no features. Copies are
    deterministic for clips and seed. The embedder embeds the windows of clips for methods with
    heads. `progress` receives the completed share of the clips, 0 to 1.
    """
    for number, clip in enumerate(clips):
        progress(number / len(clips))
        sound, fault = ClipSound(np.empty((0, FRAME_SAMPLES), np.float32)), ""
        if scenario.find(clip.label) is not None:
            try:
                sound = read_clip(clip)
            except SourceError as error:
                fault = str(error)
        rng = np.random.default_rng([_SEED + seed, number])
        recording = _recording(clip, sound, features, rooms, rng)._replace(fault=fault)
        if embedder is not None and len(sound.frames):
            segments = _segments(recording, features)[1]
            if len(segments) or len(sound.frames) < features.window_frames:
                silence = class_name(clip.label) == SILENCE
                embedded = embedder(sound.frames, segments, silence=silence)
                recording = recording._replace(embedded=embedded)
        yield recording
    progress(1.0)


def cut_recordings(
    recordings: Iterable[Recording], scenario: Scenario, features: FeatureSet = DEFAULT
) -> Dataset:
    """Cut recordings into segments of one window, half a second apart.

    All segments of silence are kept; others if above -60 dBFS and at most 12 dB below the mean
    level of their recording. At most 24 evenly spaced segments, times their weight, are kept of
    each class, source group and collection. Some classes of the scenario may be without segments;
    `skipped` counts the reasons for recordings without segments.
    """
    classes = tuple(scenario.classes)
    groups: dict[str, int] = {}
    collections: dict[str, int] = {}
    used: Counter[tuple[str, str]] = Counter()
    skipped: Counter[str] = Counter()
    seconds: dict[str, float] = {}
    left_out: list[SkippedClip] = []
    chosen: list[Segment] = []
    embedded_recordings: list[tuple[Recording, Indices]] = []
    spans: list[tuple[int, int]] = []
    rows = [np.empty((0, 3), np.intp)]
    weights = [np.empty(0)]
    for item in recordings:
        name = scenario.find(item.label, marked=True)
        if name is None:
            skipped[f"label {item.label} is not in the scenario"] += 1
            continue
        reason, starts = _segments(item, features)
        if item.fault:
            left_out.append(SkippedClip(reason, item.fault))
        if item.hole:
            left_out.append(SkippedClip(f"parts of clips, in which {NO_NUMBERS}", item.hole))
        skipped[reason] += bool(reason)
        if reason and item.embedded is None:
            continue
        group = groups.setdefault(item.group, len(groups))
        collection = collections.setdefault(item.collection, len(collections))
        key = np.array([classes.index(name), group, collection])
        used[item.collection, item.licence] += 1
        if item.embedded is not None:
            embedded_recordings.append((item, key))
        if reason:
            continue
        spans += [item.span] if item.span else []
        seconds[name] = seconds.get(name, 0.0) + len(item.features) * FRAME_SECONDS
        chosen += [(item, start) for start in starts.tolist()]
        weights.append(np.full(len(starts), item.weight))
        rows.append(np.tile(key, (len(starts), 1)))
    target, group_of, collection_of = np.concatenate(rows).T
    weight = np.concatenate(weights)
    kept = _thinned((target * len(groups) + group_of) * len(collections) + collection_of, weight)
    segments = [chosen[place] for place in kept.tolist()]
    windows, floors = _cut(segments, features)
    embedded, is_embedded = _embedded(segments)
    return Dataset(
        windows=windows[0],
        target=target[kept],
        group=group_of[kept],
        collection=collection_of[kept],
        weight=weight[kept],
        floor=floors[0],
        copies=windows[1:],
        copy_floor=floors[1:],
        classes=classes,
        seconds=seconds,
        collection_names=tuple(collections),
        collections=dict(used),
        skipped={why: count for why, count in sorted(skipped.items()) if why},
        spans=np.array(spans, np.int64).reshape(-1, 2),
        sightings=[recording.sighting for recording, _ in segments],
        left_out=left_out,
        embedded=embedded,
        is_embedded=is_embedded,
        embedding_windows=_joined(embedded_recordings),
    )


def _cut(segments: Sequence[Segment], features: FeatureSet) -> tuple[Float32, Float64]:
    """Return features (1 + k, n, window_frames, d) and floors (1 + k, n, b), first unchanged.

    A missing copy in another room is NaN.
    """
    count = 1 + max((len(recording.copies) for recording, _ in segments), default=0)
    shape = (count, len(segments), features.window_frames, features.width)
    windows = np.full(shape, np.nan, np.float32)
    floors = np.zeros((count, len(segments), features.bands))
    for number, (recording, start) in enumerate(segments):
        frames = slice(start, start + features.window_frames)
        windows[0, number] = recording.features[frames]
        if recording.floor is not None:
            floors[0, number] = recording.floor[frames][-1]
        for place, copy in enumerate(recording.copies, 1):
            windows[place, number], floors[place, number] = copy.features[frames], copy.floor
    return windows, floors


def _joined(embedded: Sequence[tuple[Recording, Indices]]) -> EmbeddingWindows:
    """Join the training windows of heads; windows of large sources are thinned evenly.

    Each recording has one class, group and collection.
    """
    parts = [
        (one.values[one.taught], one.version[one.taught], key, recording.weight)
        for recording, key in embedded
        if (one := recording.embedded) is not None and one.taught.any()
    ]
    if not parts:
        return NO_WINDOWS
    counts = [len(part[1]) for part in parts]
    values = np.concatenate([part[0] for part in parts])
    version = np.concatenate([part[1] for part in parts])
    keys = np.repeat([part[2] for part in parts], counts, axis=0)
    most = np.repeat([part[3] for part in parts], counts) * (
        _WINDOWS_PER_GROUP / SEGMENTS_PER_GROUP
    )
    columns = np.column_stack([keys, version])
    key = np.unique(columns, axis=0, return_inverse=True)[1].ravel()
    kept = _thinned(key, np.where(version == SHORT, SHORT_PARTS, 1.0) * most)
    target, group, collection = keys.T
    tried, recording = version == AS_IT_IS, np.repeat(np.arange(len(counts)), counts)
    return EmbeddingWindows(values, target, group, collection, tried, recording).rows(kept)


def _embedded(segments: Sequence[Segment]) -> tuple[Int8, Bool]:
    """Return the embeddings of segments, zeros where missing, and which segments have one."""
    rows: list[tuple[int, Int8]] = []
    for number, (recording, start) in enumerate(segments):
        if recording.embedded is not None:
            rows += [(number, one) for one in recording.embedded.at(start)]
    embedded = np.zeros((len(segments), len(rows[0][1]) if rows else 0), np.int8)
    is_embedded = np.zeros(len(segments), bool)
    for number, values in rows:
        embedded[number], is_embedded[number] = values, True
    return embedded, is_embedded


def _recording(
    clip: LabelledClip,
    sound: ClipSound,
    features: FeatureSet,
    rooms: int,
    rng: np.random.Generator,
) -> Recording:
    """Compute the features of a clip and of its copies in other rooms."""
    frames, lost = sound.frames, sound.lost * FRAME_SECONDS
    runs = np.split(frames, sound.breaks)
    values = np.concatenate([features.extractor()(run) for run in runs])
    copies, floor = [], None
    silence = class_name(clip.label) == SILENCE
    if len(values) >= features.window_frames and features.band_powers is not None:
        copies = [in_room(frames, features, rng, silence=silence) for _ in range(rooms)]
        if silence:
            floor = np.tile(low_power(features.band_powers(values)), (len(values), 1))
    return Recording(
        clip.label,
        clip.source_group,
        clip.source,
        clip.licence,
        values,
        floor=floor,
        copies=copies,
        breaks=sound.breaks,
        hole=f"{lost:.2f} s of {clip.path}" if lost else "",
    )


def _segments(recording: Recording, features: FeatureSet) -> tuple[str, Indices]:
    """Return the starts of sufficiently loud segments, and the reason if there are none."""
    values, window = recording.features, features.window_frames
    nothing = np.empty(0, np.intp)
    if recording.fault:
        return UNREADABLE, nothing
    if values.shape[1] != features.width:
        return f"its features are not {features.name}", nothing
    if len(values) < window:
        return f"shorter than {features.window_seconds:g} s", nothing
    starts = np.arange(0, len(values) - window + 1, HOP_FRAMES)
    for place in recording.breaks:
        starts = starts[(starts + window <= place) | (starts >= place)]
    if not len(starts):
        return f"shorter than {features.window_seconds:g} s", nothing
    if class_name(recording.label) == SILENCE:
        return "", spread(starts, recording.most)
    power = features.power(values)
    windows = np.lib.stride_tricks.sliding_window_view(power, window)[starts]
    loudest = max(SILENCE_POWER, power.mean(dtype=np.float64) * _BELOW_CLIP)
    loud = starts[windows.mean(axis=1, dtype=np.float64) > loudest]
    return ("" if len(loud) else "nowhere above -60 dBFS"), spread(loud, recording.most)


def _thinned(key: Indices, weight: Float64) -> Indices:
    """Return the indices of evenly spaced rows of each key, at most 24 times their weight."""
    kept = [np.empty(0, np.intp)]
    for value in np.unique(key):
        rows = np.flatnonzero(key == value)
        kept.append(spread(rows, int(SEGMENTS_PER_GROUP * weight[rows[0]])))
    return np.sort(np.concatenate(kept))


_DIGEST_BYTES = 8


def segment_digests(windows: Float32) -> Int64:
    """Return the sorted, unique digests of segments [shape=(n, window_frames, d)].

    Digital silence is excluded, as its digests are all equal.
    """
    return np.unique(_digests(windows)[_distinguishable(windows)])


def learned_digests(model: Model) -> Int64:
    """Return the digests of a model's training segments; older models store the segments."""
    if len(model.training_digests):
        return model.training_digests
    return segment_digests(model.training_windows)


def learned_groups(model: Model, data: Dataset) -> Indices:
    """Return the numbers of the source groups with a segment in a model's training set."""
    learned = np.isin(_digests(data.windows), learned_digests(model))
    return np.unique(data.group[learned & _distinguishable(data.windows)])


def _digests(windows: Float32) -> Int64:
    with np.errstate(over="ignore"):
        rows = windows.astype("<f2")  # the last bits of features differ between machines
    digests = b"".join(
        hashlib.blake2b(row.tobytes(), digest_size=_DIGEST_BYTES).digest() for row in rows
    )
    return np.frombuffer(digests, "<i8").astype(np.int64)


def _distinguishable(windows: Float32) -> Bool:
    """Return which segments have changing features."""
    return (windows != windows[:, :1]).any(axis=(1, 2))
