"""`python -m hearthlog.tools.bench.recurring MANIFEST`: how well sounds that recur are known again.

Ten kinds of sounds that no class of the starter model is about are drawn from a manifest with a
column `detail`, one clip of each. They recur for some days among other sounds. The groups of the
first day are named by what most of their sounds are; the other days show what those names give.
"""

import csv
import random
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from sklearn.metrics import adjusted_rand_score

from hearthlog.analyzer.discover.discover import discover
from hearthlog.analyzer.discover.groups import NO_GROUP, Groups
from hearthlog.analyzer.discover.read_sounds import read_sounds
from hearthlog.analyzer.discover.sound_spans import ALL
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.times import NANOSECONDS
from hearthlog.tools.bench.recurring_scene import OTHER, Sounded, names_of, record_scene
from hearthlog.tools.bench.table import Row, Table, Target

_KINDS = 10
_UNNAMED = {"other_negative", "objects_activity"}  # labels whose details no class is about
_BACKGROUND = {"speech", "music", "coughing", "crying", "laughing", "yelling"}
_MOST_OTHERS = 300
_START = 1_772_352_000 * NANOSECONDS
_DAY = 86_400 * NANOSECONDS


def recurring(
    manifest: Annotated[Path, typer.Argument(help="Of clips, with a column detail.")],
    days: Annotated[int, typer.Option(min=2)] = 4,
    minutes: Annotated[float, typer.Option(min=2, help="A day.")] = 30.0,
    noise: Annotated[float, typer.Option(help="Level of the room, dBFS.")] = -48.0,
    seed: Annotated[int, typer.Option(help="Of what is drawn.")] = 1,
) -> None:
    """Draw ten kinds of sounds that recur, and tell how well groups of them are found."""
    kinds, others = _drawn(manifest, seed)
    print(", ".join(kinds), flush=True)
    with tempfile.TemporaryDirectory(prefix="hearthlog-recurring-") as folder:
        logs = Path(folder) / "logs"
        truth = [
            record_scene(
                kinds, others, 60 * minutes, noise, logs, _START + day * _DAY, 100 * seed + day
            )
            for day in range(days)
        ]
        groups, _, _ = _grouped(logs, _START + _DAY)
        _, of, names = _grouped(logs, None, groups, [each for day in truth for each in day])
    print(_table(kinds, groups, of, *names, [each for day in truth for each in day], days))


def _drawn(manifest: Path, seed: int) -> tuple[dict[str, Float32], list[Float32]]:
    with manifest.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    first: dict[str, str] = {}
    for row in rows:
        if row["label"] in _UNNAMED:
            first.setdefault(row.get("detail", ""), row["path"])
    if len(first) < _KINDS:
        raise DataError(f"{manifest}: {len(first)} kinds of sounds by detail; it takes {_KINDS}")
    rng = random.Random(1000 + seed)
    kinds = {name: _samples(manifest, first[name]) for name in rng.sample(sorted(first), _KINDS)}
    paths = [row["path"] for row in rows if row["label"] in _BACKGROUND]
    chosen = rng.sample(paths, min(len(paths), _MOST_OTHERS))
    return kinds, [_samples(manifest, path) for path in chosen]


def _samples(manifest: Path, path: str) -> Float32:
    return np.concatenate([*read_audio(manifest.parent / path)])


def _grouped(
    logs: Path, end: int | None, groups: Groups | None = None, truth: Sequence[Sounded] = ()
) -> tuple[Groups, Int64, tuple[NDArray[np.str_], Int64]]:
    with read_sounds(find_home_logs([logs]), ALL, None, end) as sounds:
        found, of, _ = discover(sounds, groups)
        names, rows = names_of(sounds.spans, truth) if truth else ([], [])
    return found, of, (np.array(names, np.str_), np.array(rows, np.int64))


def _table(  # noqa: PLR0913, PLR0917
    kinds: dict[str, Float32],
    groups: Groups,
    of: Int64,
    names: NDArray[np.str_],
    rows: Int64,
    truth: Sequence[Sounded],
    days: int,
) -> Table:
    recurs = names != OTHER
    known = len(groups.numbers)
    of = np.where(of < known, of, NO_GROUP)  # the later groups have no name yet
    share_of_kind, precision_of_kind = {}, {}
    for kind in kinds:
        own = of[(names == kind) & (of != NO_GROUP)]
        group = int(np.bincount(own).argmax()) if len(own) else NO_GROUP
        events = [row for row, each in enumerate(truth) if each.name == kind]
        labelled = set(rows[(of == group) & (names == kind)].tolist()) if len(own) else set()
        share_of_kind[kind] = len(labelled & set(events)) / max(len(events), 1)
        precision_of_kind[kind] = float((names[of == group] == kind).mean()) if len(own) else 0.0
    found = sum(
        share > 0.5 and precision_of_kind[kind] > 0.5 for kind, share in share_of_kind.items()
    )
    shares = [
        Row(f"  {kind}", share, "", note=f"{precision_of_kind[kind]:.0%} of its group is this")
        for kind, share in share_of_kind.items()
    ]
    return Table(
        f"recurring: ten sounds on {days} days, groups of the first day",
        [
            Row("one group each", found, "of 10", target=Target(8)),
            Row(
                "adjusted Rand index",
                float(adjusted_rand_score(names[recurs], of[recurs])),
                target=Target(0.7),
            ),
            Row("events that names give", float(np.mean([*share_of_kind.values()])), "",
                target=Target(0.7)),
            *shares,
        ],
    )  # fmt: skip


if __name__ == "__main__":
    try:
        typer.run(recurring)
    except HearthlogError as error:
        sys.exit(f"hearthlog bench: {error}")
