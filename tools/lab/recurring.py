"""`python -m hearthlog.tools.lab.recurring MANIFEST`: how well sounds that recur are known again.

Ten kinds of sounds that no class of the starter model is about are drawn from manifests with a
column `detail`, one clip of each or several. They recur for some days among other sounds. The
groups of the first day are named by what most of their sounds are; the other days show what those
names give: by features, and where there is a network by what it hears, too.
"""

import csv
import random
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray
from sklearn.metrics import adjusted_rand_score

from hearthlog.analyzer.discover import NO_CLUSTER
from hearthlog.analyzer.discover.sounds import ALL, HomeSounds, discover, read_sounds
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Bool, Float32, Int64
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.recurring_scene import OTHER, Sounded, names_of, record_scene

_KINDS = 10
_UNNAMED = {"other_negative", "objects_activity"}  # labels whose details no class is about
_BACKGROUND = {"speech", "music", "coughing", "crying", "laughing", "yelling"}
_MOST_OTHERS = 300
_START = 1_772_352_000 * NANOSECONDS
_DAY = 86_400 * NANOSECONDS


def recurring(
    manifests: Annotated[list[Path], typer.Argument(help="Of clips, with a column detail.")],
    clips: Annotated[int, typer.Option(min=1, help="Of each kind, of as many sources.")] = 1,
    days: Annotated[int, typer.Option(min=2)] = 4,
    minutes: Annotated[float, typer.Option(min=2, help="A day.")] = 30.0,
    noise: Annotated[float, typer.Option(help="Level of the room, dBFS.")] = -48.0,
    seed: Annotated[int, typer.Option(help="Of what is drawn.")] = 1,
) -> None:
    """Draw ten kinds of sounds that recur, and tell how well groups of them are found."""
    kinds, others = _drawn(manifests, seed, clips)
    print(", ".join(kinds), flush=True)
    with tempfile.TemporaryDirectory(prefix="hearthlog-recurring-") as folder:
        logs, truth = Path(folder) / "logs", list[Sounded]()
        for day in range(days):
            start = _START + day * _DAY
            truth += record_scene(kinds, others, 60 * minutes, noise, logs, start, 100 * seed + day)
        with read_sounds(find_home_logs([logs]), ALL) as sounds:
            none = np.empty((len(sounds.descriptors), 0), np.float32)
            ways = {"features": replace(sounds, embedding=None, embeddings=none)}
            if sounds.embedding is not None:
                ways[f"features and {sounds.embedding.network}"] = sounds
            for way, described in ways.items():
                grouped, known = _grouped(described, truth)
                rows = _rows(list(kinds), grouped, truth, known)
                print(Table(f"recurring: ten sounds on {days} days, by {way}", rows))


class _Grouped(NamedTuple):
    """Sounds in the order in which they were read.

    Attributes
    ----------
    of : np.ndarray [shape=(n,)], int64
        The row of the group of each, or `NO_CLUSTER`.
    kinds : np.ndarray [shape=(n,)], str
        What each was.
    events : np.ndarray [shape=(n,)], int64
        Where it is in the truth; -1 for nothing.
    is_early : np.ndarray [shape=(n,)], bool
        Whether it is of the first day.
    """

    of: Int64
    kinds: NDArray[np.str_]
    events: Int64
    is_early: Bool


def _drawn(
    manifests: Sequence[Path], seed: int, clips: int
) -> tuple[dict[str, list[Float32]], list[Float32]]:
    kinds: dict[str, dict[str, Path]] = {}  # and their clips, one of a source
    background: list[Path] = []
    for manifest in manifests:
        with manifest.open(newline="", encoding="utf-8") as stream:
            for row in csv.DictReader(stream):
                path = manifest.parent / row["path"]
                if row["label"] in _UNNAMED:
                    own = kinds.setdefault(row.get("detail", ""), {})
                    own.setdefault(row.get("source_group", row["path"]), path)
                elif row["label"] in _BACKGROUND:
                    background.append(path)
    kinds = {name: own for name, own in kinds.items() if len(own) >= clips}
    if len(kinds) < _KINDS:
        raise DataError(
            f"{manifests[0]}: {len(kinds)} kinds of sounds by detail with {clips} clips; it takes "
            f"{_KINDS}"
        )
    rng = random.Random(1000 + seed)
    drawn = {
        name: [_samples(path) for path in [*kinds[name].values()][:clips]]
        for name in rng.sample(sorted(kinds), _KINDS)
    }
    chosen = rng.sample(background, min(len(background), _MOST_OTHERS))
    return drawn, [_samples(path) for path in chosen]


def _samples(path: Path) -> Float32:
    return np.concatenate([*read_audio(path)])


def _grouped(sounds: HomeSounds, truth: Sequence[Sounded]) -> tuple[_Grouped, int]:
    """Group the sounds of the first day, and know those of all days by these groups."""
    names, events = names_of(sounds, truth)
    is_early = sounds.starts < _START + _DAY
    first = replace(
        sounds,
        log=sounds.log[is_early],
        microphone=sounds.microphone[is_early],
        starts=sounds.starts[is_early],
        ends=sounds.ends[is_early],
        labels=sounds.labels[is_early],
        descriptors=sounds.descriptors[is_early],
        embeddings=sounds.embeddings[is_early],
    )
    groups, _, _ = discover(first, None)
    _, of, _ = discover(sounds, groups)
    known = len(groups.numbers)
    of = np.where(of < known, of, NO_CLUSTER)
    return _Grouped(of, np.array(names), np.array(events), is_early), known


def _rows(
    kinds: Sequence[str], sounds: _Grouped, truth: Sequence[Sounded], groups: int
) -> list[Row]:
    names = np.array([*(_name(sounds, group) for group in range(groups)), OTHER])
    named = names[sounds.of]  # the last one for those of no group
    recurs, is_grouped = sounds.kinds != OTHER, sounds.of != NO_CLUSTER
    right = sum(
        np.unique(sounds.kinds[sounds.of == g], return_counts=True)[1].max(initial=0)
        for g in range(groups)
    )
    shares = [_share(kind, named, sounds, truth) for kind in kinds]
    single = sum(_is_one_group(kind, sounds) for kind in kinds)
    index = float(adjusted_rand_score(sounds.kinds[recurs], sounds.of[recurs]))
    given = float(np.mean([share for share, _ in shares]))
    return [
        Row("one group each", single, "of 10", target=Target(8)),
        Row("adjusted Rand index", index, target=Target(0.7)),
        Row("purity of the groups", float(right / max(is_grouped.sum(), 1))),
        Row("sounds that recur and are of a group", float(is_grouped[recurs].mean())),
        Row("events of the later days that names give", given, target=Target(0.7)),
        *(
            Row(f"  {kind}", share, note=f"{right:.0%} of what gets the name")
            for kind, (share, right) in zip(kinds, shares, strict=True)
        ),
    ]


def _name(sounds: _Grouped, group: int) -> str:
    """Name a group as a person does on the first evening: by what most of it is."""
    names, counts = np.unique(
        sounds.kinds[(sounds.of == group) & sounds.is_early], return_counts=True
    )
    return str(names[counts.argmax()]) if len(names) else OTHER


def _share(
    kind: str, named: NDArray[np.str_], sounds: _Grouped, truth: Sequence[Sounded]
) -> tuple[float, float]:
    """Return what share of the later events of a kind get its name, and how many of all do so."""
    late = (named == kind) & ~sounds.is_early
    right = late & (sounds.kinds == kind)
    events = [each for each in truth if each.name == kind and each.start >= _START + _DAY]
    return len(set(sounds.events[right].tolist())) / max(len(events), 1), float(
        right.sum() / max(late.sum(), 1)
    )


def _is_one_group(kind: str, sounds: _Grouped) -> bool:
    """Tell whether most of the sounds of a kind are one group, and most of that group is this."""
    own = sounds.of[sounds.kinds == kind]
    counts = np.bincount(own[own != NO_CLUSTER], minlength=1)
    group = int(counts.argmax())
    is_whole = 2 * counts[group] > len(own)
    return bool(is_whole and (sounds.kinds[sounds.of == group] == kind).mean() > 0.5)


if __name__ == "__main__":
    run(recurring)
