"""`python -m hearthlog.tools.lab.routine_hearing MICROPHONE=HOME ...`: how sounds are labelled.

Each sound of a simulated home has the label that most of what its microphone said of it has; less
than a quarter of it labelled is not heard. `routine_hearing.csv` was made so, from two days of
`python -m hearthlog.tools.lab.home 2 --seed 11`, once with `--model general` and once with `--model
bathroom --room bathroom`.
"""

import csv
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from hearthlog.analyzer.logs.labelling import Labelling, find_labellings, unified
from hearthlog.models.classes import SILENCE
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import LIVE
from hearthlog.tools.home.routine import RADIO, TELEVISION
from hearthlog.tools.lab.command import run

MEASURED = Path(__file__).with_suffix(".csv")
_DAY = 86_400 * NANOSECONDS
_LEAST = 0.25
_ALIKE = 20.0  # how much homes are heard alike: of so many sounds, shares would vary as much
_RARE = 1e-3

Names = NDArray[np.object_]
_Key = tuple[str, str, str]  # microphone, label, place; any place where that is empty


class Hearing:
    """How the sounds of one home are labelled: as measured, a little better or worse.

    Parameters
    ----------
    rng : numpy.random.Generator
        Draws how.

    Attributes
    ----------
    classes : dict of str to list of str
        By microphone, the labels that it gives, but silence.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        counts: dict[_Key, Counter[str]] = {}
        self.classes: dict[str, list[str]] = {}
        with MEASURED.open(encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                microphone, label, place = row["microphone"], row["label"], row["place"]
                for key in ((microphone, label, place), (microphone, label, "")):
                    counts.setdefault(key, Counter())[row["labelled"]] += int(row["sounds"])
                known = self.classes.setdefault(microphone, [])
                if row["labelled"] not in {SILENCE, *known}:
                    known.append(row["labelled"])
        self._shares = {key: _varied(row, rng) for key, row in sorted(counts.items())}

    def draw(
        self, microphone: str, labels: Names, places: Names, rng: np.random.Generator
    ) -> Names:
        """Draw what sounds are labelled as.

        Parameters
        ----------
        microphone : str
        labels, places : np.ndarray [shape=(n,)] of str
            What each sound is, and where; one that was never measured is not heard.
        rng : numpy.random.Generator

        Returns
        -------
        np.ndarray [shape=(n,)] of str
        """
        drawn = np.full(len(labels), SILENCE, object)
        for label, place in sorted(set(zip(labels, places, strict=True))):
            keys = (microphone, label, place), (microphone, label, "")
            row = next((self._shares[key] for key in keys if key in self._shares), None)
            if row is not None:
                own = (labels == label) & (places == place)
                drawn[own] = rng.choice(row[0], int(own.sum()), p=row[1])
        return drawn


def _varied(row: Counter[str], rng: np.random.Generator) -> tuple[Names, NDArray[np.float64]]:
    counts = np.array([*row.values()], float)
    shares = rng.dirichlet(_ALIKE * counts / counts.sum() + _RARE)
    return np.array([*row], object), shares


def measure(home: Path) -> Counter[tuple[str, str, str]]:
    """Count what the sounds of a simulated home were labelled as.

    Parameters
    ----------
    home : Path
        Folder that `python -m hearthlog.tools.lab.home` has made, with labels.

    Returns
    -------
    Counter of (str, str, str)
        Label, place, and what it was labelled as.
    """
    sources = find_labellings(home / "logs")
    labels = unified(sources.read(sources.microphone(None), LIVE).labelling)
    start = int(labels.starts[0]) // _DAY * _DAY
    counts: Counter[tuple[str, str, str]] = Counter()
    with (home / "events.csv").open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream):
            begin, end = (start + round(float(row[key]) * NANOSECONDS) for key in ("start", "end"))
            place = row["from"] if row["from"] in {TELEVISION, RADIO} else row["room"]
            counts[row["label"], place, _labelled(labels, begin, end)] += 1
    return counts


def _labelled(labels: Labelling, start: int, end: int) -> str:
    first, last = np.searchsorted(labels.ends, start, "right"), np.searchsorted(labels.starts, end)
    lengths: Counter[str] = Counter()
    for row in range(first, last):
        name = labels.labels[row]
        if name != SILENCE:
            lengths[name] += int(min(labels.ends[row], end) - max(labels.starts[row], start))
    if lengths.total() < _LEAST * (end - start):
        return SILENCE
    return max(lengths, key=lambda name: (lengths[name], name))


def main(
    homes: Annotated[list[str], typer.Argument(help="living_room=FOLDER bathroom=FOLDER")],
) -> None:
    """Print what sounds of simulated homes were labelled as."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("microphone", "label", "place", "labelled", "sounds"))
    for text in homes:
        microphone, _, folder = text.partition("=")
        rows: Sequence[tuple[tuple[str, str, str], int]] = sorted(measure(Path(folder)).items())
        writer.writerows((microphone, *what, number) for what, number in rows)


if __name__ == "__main__":
    run(main)
