"""`python -m hearthlog.tools.lab.names YAMNET MANIFEST`: which names may be events.

Clips are laid, each once and at a level of its own, into hours of noise, and the network names what
it hears. A threshold is chosen on half of the sources, so that a name is right often enough and
said falsely seldom enough, and tried on the other half, for many halves. With `-o` the table of
names takes the thresholds and figures; what is printed is the table of docs/audioset.md.

The manifest needs a column `detail`, the kind of the sound; `KINDS` says which kinds are which
names'.
"""

import csv
import math
from bisect import bisect
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.evaluation.scenes import background
from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.manifest import LabelledClip
from hearthlog.models.embedding import HOP_FRAMES, NO_EMBEDDINGS, Embeddings, Projection
from hearthlog.models.embedding.networks import YAMNET, Embedder
from hearthlog.models.embedding.sound_names import (
    NamedSound,
    SoundName,
    audioset_names,
    named_sounds,
    write_names,
)
from hearthlog.models.features.floor import FloorTracker
from hearthlog.models.features.installed import DEFAULT
from hearthlog.recorder.stream.stages import MicrophoneEmbeddings
from hearthlog.schemas.arrays import Bool, Float32, Float64
from hearthlog.schemas.frames import FRAME_SAMPLES, FRAME_SECONDS
from hearthlog.tools.lab.command import run

# Kinds as `label/detail`, or a label alone, and the names that are right for them.
KINDS: Mapping[str, tuple[str, ...]] = {
    "speech": ("speech", "television/news", "television/broadcast_speech"),
    "music": ("music",),
    "phone_ring": ("phone_ring",),
    "doorbell": ("other_negative/doorbell",),
    "knock": ("objects_activity/knock", "objects_activity/knocking", "other_negative/knock"),
    "door": ("other_negative/door", "other_negative/door_slam", "objects_activity/doorslam"),
    "slam": ("other_negative/door_slam", "objects_activity/doorslam"),
    "cupboard": ("objects_activity/cupboard", "objects_activity/drawer"),
    "keys": ("objects_activity/keys", "objects_activity/keysDrop"),
    "footsteps": ("other_negative/footsteps",),
    "thump": ("other_negative/thump_fall",),
    "glass": ("other_negative/glass_break",),
    "breaking": ("other_negative/glass_break",),
    "paper": ("objects_activity/paper", "objects_activity/book", "objects_activity/pageturn"),
    "zipper": ("objects_activity/zipper",),
    "writing": ("objects_activity/pencil",),
    "coughing": ("coughing",),
    "throat_clearing": (
        "other_negative/clearthroat",
        "other_negative/throat",
        "other_negative/throatclear",
    ),
    "sneeze": ("other_negative/sneeze",),
    "burp": ("other_negative/burp",),
    "breathing": ("other_negative/breathing",),
    "snoring": ("other_negative/snoring",),
    "sobbing": ("crying/cry", "crying/adult_or_unknown", "crying/unknown_age_baby_like"),
    "baby_cry": (
        "crying/baby",
        "crying/baby_cry",
        "crying/baby_cry/discomfort",
        "crying/baby_cry/hungry",
        "crying/baby_cry/tired",
    ),
    "scream": ("yelling/scream", "yelling/agony"),
    "yelling": ("yelling",),
    "laughing": ("laughing",),
    "chuckle": ("laughing",),
    "clapping": ("other_negative/applause",),
    "eating": ("objects_activity/eat",),
    "dishes": (
        "objects_activity/dishes",
        "objects_activity/clean-dishes",
        "objects_activity/plates",
        "objects_activity/cutlery",
    ),
    "chopping": ("objects_activity/chopping",),
    "frying": ("objects_activity/frying-pan", "objects_activity/frying"),
    "boiling": ("objects_activity/boiling-water", "other_negative/kettle"),
    "microwave": ("objects_activity/microwave", "other_negative/microwave"),
    "blender": ("objects_activity/blender", "objects_activity/juicer"),
    "tap_water": ("tap_water",),
    "flushing_water": ("flushing_water",),
    "shower": ("shower",),
    "toothbrush": ("bathroom_other/toothbrush",),
    "hair_dryer": ("bathroom_other/hair_dryer", "bathroom_other/dryer"),
    "vacuum_cleaner": ("other_negative/vacuum",),
    "fan": ("other_negative/fan_hum", "objects_activity/stove-fan"),
    "printer": ("other_negative/printer",),
    "keyboard": ("objects_activity/keyboard", "other_negative/keyboard"),
    "clock": ("objects_activity/clock_tick", "other_negative/clock"),
    "alarm_clock": ("other_negative/alarm_clock",),
    "smoke_alarm": ("other_negative/fire_alarm",),
    "siren": ("other_negative/siren",),
    "fire": ("other_negative/fire_crackling",),
    "dog": ("other_negative/dog", "other_negative/dog_bark"),
    "cat": ("other_negative/cat", "other_negative/cat_meow"),
    "rooster": ("other_negative/rooster",),
    "rain": ("other_negative/rain",),
    "waves": ("other_negative/sea_waves",),
    "car_horn": ("other_negative/car_honk",),
    "aircraft": ("other_negative/helicopter",),
    "chainsaw": ("other_negative/chainsaw",),
    "television": ("television",),
    "radio": ("television/radio", "television/radio_static?"),
}
# Kinds of which a name is neither right nor wrong: they may well hold such sounds.
LIKE: Mapping[str, tuple[str, ...]] = {
    "speech": ("television", "speech", "crying", "laughing", "yelling"),
    "music": ("television", "phone_ring", "other_negative/alarm_clock"),
    "phone_ring": ("other_negative/alarm_clock",),
    "door": ("objects_activity/cupboard", "objects_activity/drawer"),
    "slam": ("other_negative/door",),
    "cupboard": ("other_negative/door",),
    "glass": ("objects_activity/bottle", "objects_activity/dishes", "objects_activity/cutlery"),
    "paper": ("objects_activity/sheets",),
    "throat_clearing": ("coughing",),
    "coughing": ("other_negative/clearthroat", "other_negative/throat"),
    "breathing": ("other_negative/snoring", "other_negative/yawn"),
    "snoring": ("other_negative/breathing",),
    "sobbing": ("crying",),
    "baby_cry": ("crying", "laughing/baby"),
    "scream": ("yelling", "crying"),
    "yelling": ("crying",),
    "clapping": ("laughing/audience", "laughing/canned_audience_laugh"),
    "dishes": ("objects_activity/dishwasher", "other_negative/dishwasher"),
    "boiling": ("objects_activity/frying-pan", "objects_activity/frying"),
    "tap_water": ("flushing_water", "shower", "objects_activity/clean-dishes", "bathroom_other"),
    "flushing_water": ("tap_water",),
    "shower": ("tap_water", "bathroom_other/bath", "other_negative/rain"),
    "vacuum_cleaner": ("bathroom_other/hair_dryer", "bathroom_other/dryer"),
    "hair_dryer": ("other_negative/vacuum",),
    "fan": ("silence", "other_negative/air_conditioner_hum", "other_negative/heater"),
    "alarm_clock": ("phone_ring",),
    "smoke_alarm": ("other_negative/alarm_clock",),
    "cat": ("other_negative/cat_imitation",),
    "rain": ("shower", "tap_water"),
    "waves": ("other_negative/rain",),
    "radio": ("television",),
}
_LONGEST = round(10 / FRAME_SECONDS)
_PAUSES = (10, 40, 120)  # frames
_FLOOR = -70.0  # dBFS
_BLOCK = 12_000  # frames
_FAINTEST = -12.0  # dB, by which a clip is laid fainter
_THRESHOLDS = np.arange(-3.5, 12.1, 0.5)
_PRECISION, _FALSE_AN_HOUR = 0.8, 1.0  # of an event
_MARGINS = 1, 2, 3  # thresholds that the chosen one is above the lowest that would do
_LEAST_RECALL = 0.2
_FEWEST = 4  # sources
_SPLITS = 20
_EDGE = 10  # frames
_SEED = 1
_CLIPS, _HEARD, _RIGHT, _WRONG, _HOURS = range(5)  # places in `Counts`


class Kind(NamedTuple):
    """A clip, and the kind of its sound."""

    clip: LabelledClip
    kind: str


class Laid(NamedTuple):
    """A clip in a scene: its kind, source, and frames."""

    kind: str
    source: str
    first: int
    end: int


@dataclass(frozen=True, eq=False)
class Scene:
    """What the network said of a scene.

    Attributes
    ----------
    embeddings : Embeddings
    laid : sequence of Laid
    hours : float
    """

    embeddings: Embeddings
    laid: Sequence[Laid]
    hours: float


class Counts(NamedTuple):
    """How often a name was said.

    Attributes
    ----------
    clips, heard : float
        Of its kinds, and those in which it was said.
    right, wrong : float
        Times that it was said in them, and where there was nothing of the kind.
    hours : float
        Without it.
    """

    clips: float
    heard: float
    right: float
    wrong: float
    hours: float

    @property
    def precision(self) -> float:
        """Share of the times that were right."""
        return self.right / (self.right + self.wrong) if self.right + self.wrong else math.nan

    @property
    def recall(self) -> float:
        """Share of the clips that were heard."""
        return self.heard / self.clips if self.clips else math.nan

    @property
    def false_an_hour(self) -> float:
        """Wrong ones in an hour without it."""
        return self.wrong / self.hours if self.hours else math.nan

    @property
    def good(self) -> bool:
        """Whether it is heard, and right often enough, to be an event."""
        right = self.precision >= _PRECISION and self.false_an_hour <= _FALSE_AN_HOUR
        return right and self.recall >= _LEAST_RECALL


def names(
    network: Annotated[Path, typer.Argument(help="File of YAMNet.")],
    manifests: Annotated[list[Path], typer.Argument(help="Clips, with their kinds.")],
    output: Annotated[Path | None, typer.Option("-o", help="Table to write.")] = None,
    seeds: Annotated[int, typer.Option(help="Scenes.")] = 4,
) -> None:
    """Measure each name, and print the table."""
    clips = [kind for manifest in manifests for kind in read_kinds(manifest)]
    embedder = Embedder(YAMNET, network)
    scenes = [compose(clips, embedder, seed) for seed in range(seeds)]
    hours = sum(scene.hours for scene in scenes)
    sources = len({each.clip.source_group for each in clips})
    print(f"{len(clips):,} clips of {sources:,} sources; {hours:.1f} hours of scenes")
    measured = measure(scenes, embedder.projection)
    print(table(measured))
    if output is not None:
        write_names(measured, output)


def read_kinds(manifest: Path) -> list[Kind]:
    """Read the clips of a manifest; its labels are free.

    Parameters
    ----------
    manifest : Path
    """
    with manifest.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    return [
        Kind(
            LabelledClip(manifest.parent / row["path"], row["label"], row["source_group"], "", ""),
            f"{row['label']}/{row['detail']}",
        )
        for row in rows
    ]


def compose(clips: Sequence[Kind], embedder: Embedder, seed: int) -> Scene:
    """Lay clips into noise, each once, and ask the network.

    Parameters
    ----------
    clips : sequence of Kind
    embedder : Embedder
    seed : int
    """
    rng = np.random.default_rng(seed)
    laid: list[Laid] = []
    parts: list[tuple[int, np.ndarray]] = []
    place = 40
    for number in rng.permutation(len(clips)):
        clip, kind = clips[number]
        frames = clip_frames(clip)[:_LONGEST] * 10 ** (rng.uniform(_FAINTEST, 0.0) / 20)
        laid.append(Laid(kind, clip.source_group, place, place + len(frames)))
        parts.append((place, frames))
        place += len(frames) + int(rng.choice(_PAUSES)) + int(rng.integers(10))
    noise = background((place + 1) * FRAME_SECONDS, _FLOOR, "white", seed)
    sound = noise[: place * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    for first, frames in parts:
        sound[first : first + len(frames)] += frames
    return Scene(_embedded(sound, embedder), laid, len(sound) * FRAME_SECONDS / 3600)


def _embedded(sound: Float32, embedder: Embedder) -> Embeddings:
    """Embed what is above the floor, as a recorder does, shape (n, FRAME_SAMPLES)."""
    stream, extractor = MicrophoneEmbeddings(embedder, DEFAULT), DEFAULT.extractor()
    tracker, embeddings = FloorTracker(), NO_EMBEDDINGS
    assert DEFAULT.band_powers is not None
    for first in range(0, len(sound), _BLOCK):
        frames = sound[first : first + _BLOCK]
        features = extractor(frames)
        floors = tracker(DEFAULT.band_powers(features), first)
        stamps = np.arange(first, first + len(frames), dtype=np.int64)
        found = stream.push(frames, features, floors, first, stamps)
        embeddings = embeddings.followed_by(found)
    return embeddings


def count(
    name: SoundName, sounds: Sequence[NamedSound], scene: Scene, sources: Mapping[str, int]
) -> Float64:
    """Count how often a name was right and wrong in a scene.

    Parameters
    ----------
    name : SoundName
    sounds : sequence of NamedSound
        That were given the name.
    scene : Scene
    sources : mapping of str to int
        Numbers of the sources.

    Returns
    -------
    np.ndarray [shape=(n, 5)], float64
        `Counts` of each source; the pause behind a clip is its source's, too.
    """
    right, like = _right_for(name, scene)
    counts = np.zeros((len(sources), len(Counts._fields)))
    begins = [each.first for each in scene.laid]
    owners = [sources[each.source] for each in scene.laid]
    is_right = [_inside(sound, right) for sound in sounds]
    for good, sound in zip(is_right, sounds, strict=True):
        owner = owners[max(0, bisect(begins, (sound.first + sound.end) // 2) - 1)]
        if good:
            counts[owner, _RIGHT] += 1
        elif not _inside(sound, [*right, *like]):
            counts[owner, _WRONG] += 1
    told = [sound for good, sound in zip(is_right, sounds, strict=True) if good]
    for each in right:
        counts[sources[each.source], _CLIPS] += 1
        counts[sources[each.source], _HEARD] += any(_overlap(sound, each) for sound in told)
    held = {each.first for each in (*right, *like)}
    lengths = np.diff([*begins, scene.laid[-1].end]) * FRAME_SECONDS / 3600
    for begin, owner, hours in zip(begins, owners, lengths, strict=True):
        if begin not in held:
            counts[owner, _HOURS] += hours
    return counts


def _is_of(kind: str, kinds: Sequence[str]) -> bool:
    return kind in kinds or kind.partition("/")[0] in kinds


def _right_for(name: SoundName, scene: Scene) -> tuple[list[Laid], list[Laid]]:
    """Return the clips that a name is right for, and those of which it may be; short ones may."""
    right = [each for each in scene.laid if _is_of(each.kind, KINDS.get(name.name, ()))]
    like = [each for each in scene.laid if _is_of(each.kind, LIKE.get(name.name, ()))]
    frames = name.windows * HOP_FRAMES
    short = [each for each in right if each.end - each.first < frames]
    return [each for each in right if each.end - each.first >= frames], like + short


def _inside(sound: NamedSound, clips: Sequence[Laid]) -> bool:
    """Tell whether half of a sound or more is in clips, give or take half a second."""
    parts = (_overlap(sound, each, _EDGE) for each in clips)
    return 2 * sum(part for part in parts if part > 0) >= sound.end - sound.first


def _overlap(sound: NamedSound, laid: Laid, edge: int = 0) -> int:
    return max(0, min(sound.end, laid.end + edge) - max(sound.first, laid.first - edge))


def measure(scenes: Sequence[Scene], projection: Projection) -> list[SoundName]:
    """Choose the threshold of each name, and try it on halves of the sources.

    Parameters
    ----------
    scenes : sequence of Scene
    projection : Projection
    """
    names = audioset_names()
    tried = [name._replace(threshold=float(each)) for name in names for each in _THRESHOLDS]
    sounds: dict[tuple[str, float, Scene], list[NamedSound]] = defaultdict(list)
    for scene in scenes:
        for sound in named_sounds(scene.embeddings, projection, tried):
            sounds[sound.name.name, sound.name.threshold, scene].append(sound)
    groups = sorted({each.source for scene in scenes for each in scene.laid})
    sources = {source: number for number, source in enumerate(groups)}
    measured = []
    for name in names:
        counts = np.zeros((len(_THRESHOLDS), len(sources), len(Counts._fields)))
        for row, each in enumerate(_THRESHOLDS.tolist()):
            for scene in scenes:
                counts[row] += count(name, sounds[name.name, each, scene], scene, sources)
        measured.append(_measured(name, counts, len(scenes)))
    return measured


def _measured(name: SoundName, counts: Float64, times: int) -> SoundName:
    """Fill in the figures of a name, from counts of shape (thresholds, sources, 5)."""
    positive = counts[0, :, _CLIPS] > 0
    name = SoundName(
        name.name,
        name.words,
        name.group,
        name.seconds,
        name.windows,
        clips=round(counts[0, :, _CLIPS].sum() / times),
        sources=int(positive.sum()),
    )
    if name.sources < _FEWEST:
        return name
    for margin in _MARGINS:
        tried, place = _tried(counts, positive, margin), _chosen(counts.sum(axis=1), margin)
        if place is not None and tried.good:
            return _with_figures(name, place, tried)._replace(is_event=True)
    both = [Counts(*row) for row in counts.sum(axis=1).tolist()]
    place = max(range(len(both)), key=lambda place: _f1(both[place]))
    return _with_figures(name, place, both[place])


def _with_figures(name: SoundName, place: int, tried: Counts) -> SoundName:
    return name._replace(
        threshold=float(_THRESHOLDS[place]),
        precision=round(tried.precision, 2),
        recall=round(tried.recall, 2),
        false_an_hour=round(tried.false_an_hour, 1),
    )


def _tried(counts: Float64, positive: Bool, margin: int) -> Counts:
    """Choose on half of the sources and try on the other, for many halves, and both ways."""
    rng, total = np.random.default_rng(_SEED), np.zeros(len(Counts._fields))
    for _ in range(_SPLITS):
        half = np.zeros(len(positive), bool)
        for kind in (positive, ~positive):  # as many of each in both
            half[rng.permutation(np.flatnonzero(kind))[::2]] = True
        for chosen, other in ((half, ~half), (~half, half)):
            place = _chosen(counts[:, chosen].sum(axis=1), margin)
            rows = counts[:, other].sum(axis=1)
            if place is not None:
                total += rows[place]
            else:  # it would be no event, and is never said
                total[[_CLIPS, _HOURS]] += rows[0, [_CLIPS, _HOURS]]
    return Counts(*total.tolist())


def _chosen(counts: Float64, margin: int) -> int | None:
    """Return the threshold some steps above the one that hears most of those that would do."""
    each = [Counts(*row) for row in counts.tolist()]
    good = [place for place, one in enumerate(each) if one.good]
    if not good:
        return None
    return min(max(good, key=lambda place: each[place].recall) + margin, len(each) - 1)


def _f1(counts: Counts) -> float:
    found = counts.precision + counts.recall
    return 2 * counts.precision * counts.recall / found if found > 0 else 0.0


def table(measured: Sequence[SoundName]) -> str:
    """Make the table of the documentation.

    Parameters
    ----------
    measured : sequence of SoundName
    """
    head = (
        "| name | in words | says it | threshold | clips, sources | precision | recall "
        "| false an hour |\n|---|---|---|---|---|---|---|---|"
    )
    rows = sorted(measured, key=lambda name: (not name.is_event, math.isnan(name.precision)))
    return "\n".join([head, *map(_row, rows)])


def _row(name: SoundName) -> str:
    figures = [f"{each:.2f}" for each in (name.precision, name.recall)]
    figures.append(f"{name.false_an_hour:.1f}")
    shown = ["-"] * 3 if math.isnan(name.recall) else figures
    kind = "event" if name.is_event else "hint"
    cells = [f"`{name.name}`", name.words, kind, f"{name.threshold:g}"]
    cells += [f"{name.clips}, {name.sources}", *shown]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    run(names)
