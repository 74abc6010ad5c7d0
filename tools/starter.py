"""Learn the starter models: `python -m hearthlog.tools.starter MANIFEST … -o models/starter`.

Only recordings whose licence allows that a model is passed on are learned from, and none of those
that the simulated home plays, so that its days try the models on what they have not heard.
"""

import argparse
import csv
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import soundfile

from hearthlog.analyzer.training.dataset import build_dataset
from hearthlog.analyzer.training.manifest import LabelledClip, read_manifest
from hearthlog.analyzer.training.scenario import BUILTIN, LABELS, Scenario
from hearthlog.analyzer.training.svm_method import ROOM
from hearthlog.analyzer.training.train import train_model
from hearthlog.models.classes import PHONE_RING, SILENCE
from hearthlog.models.classifiers.description import SIMULATED
from hearthlog.models.classifiers.model import Model
from hearthlog.models.licences import may_be_shipped
from hearthlog.models.modelfile.card import model_card
from hearthlog.models.modelfile.modelfile import load_model, save_model
from hearthlog.models.starter import STARTERS
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.schemas.progress import ignore_progress
from hearthlog.tools.home.sounds import synthesize

_FEWEST_SOURCES = 5  # a class of fewer would only mislead
_RING_TONES, _RING_SECONDS = 40, 4.0
_PLAYED = Path(__file__).parent / "home" / "clips" / "manifest.csv"


def learn_starters(manifests: Sequence[Path], folder: Path) -> None:
    """Learn the starter models, and write them and a page about them.

    Parameters
    ----------
    manifests : sequence of Path
        Of the collections, with licences.
    folder : Path
        Is written over.

    Raises
    ------
    DataError
        If a manifest cannot be read, or too little of it may be used.
    """
    clips = list(_usable(manifests))
    with TemporaryDirectory() as temporary:
        clips += _ring_tones(Path(temporary))
        models = [_learn(BUILTIN[name], clips, folder / f"{name}.safetensors") for name in STARTERS]
    page = "\n".join([*map(model_card, models), *_credits(manifests, clips)])
    (folder / "README.md").write_text(page, "utf-8")


def _usable(manifests: Sequence[Path]) -> Iterator[LabelledClip]:
    """Yield the clips that may be learned from, and print how many may not."""
    played = {(clip.source, clip.source_group) for clip in read_manifest(_PLAYED, LABELS)}
    left_out: Counter[str] = Counter()
    for manifest in manifests:
        for clip in read_manifest(manifest, LABELS):
            if not may_be_shipped(clip.licence):
                left_out[clip.licence or "unstated"] += 1
            elif (clip.source, clip.source_group) in played:
                left_out["played by the simulated home"] += 1
            else:
                yield clip
    for reason, count in left_out.most_common():
        print(f"{count:5d} clips left out: {reason}")


def _ring_tones(folder: Path) -> list[LabelledClip]:
    """Make ring tones: telephones synthesise theirs, too."""
    clips = []
    for number in range(_RING_TONES):
        path = folder / f"ring_{number:02d}.flac"
        soundfile.write(path, synthesize(PHONE_RING, _RING_SECONDS, number), SAMPLE_RATE, "PCM_16")
        clips.append(LabelledClip(path, PHONE_RING, path.stem, SIMULATED, "CC0"))
    return clips


def _learn(scenario: Scenario, clips: Sequence[LabelledClip], path: Path) -> Model:
    """Learn one model of the classes that have enough sources."""
    sources: dict[str, set[tuple[str, str]]] = {}
    for clip in clips:
        name = scenario.find(clip.label)
        if name is not None:
            sources.setdefault(name, set()).add((clip.source, clip.source_group))
    classes = {
        name: labels
        for name, labels in scenario.classes.items()
        if name == SILENCE or len(sources.get(name, ())) >= _FEWEST_SOURCES
    }
    for name in scenario.classes.keys() - classes:
        print(f"{scenario.name}: no class {name}, {len(sources.get(name, ()))} sources of it")
    chosen = Scenario(scenario.name, classes).with_unknown(
        (clip.label, clip.source_group) for clip in clips
    )
    data = build_dataset(clips, chosen, ignore_progress, features=ROOM.features, rooms=ROOM.rooms)
    model = train_model(data, chosen, ignore_progress, ROOM)
    path.unlink(missing_ok=True)
    save_model(model, path)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    return load_model(path)


def _credits(manifests: Sequence[Path], clips: Sequence[LabelledClip]) -> Iterator[str]:
    """Yield the lines that name the authors of the recordings, where manifests tell them."""
    used = {clip.path for clip in clips}
    yield from ("# Credits", "", "The collections are at https://github.com/ and their names.", "")
    for manifest in manifests:
        with manifest.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                author = row.get("credit") or row.get("author")
                if author and manifest.parent / row["path"].strip() in used:
                    about = (row.get("title"), row["source"], row["licence"], row.get("url"))
                    yield f"- {author}: {', '.join(text for text in about if text)}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m hearthlog.tools.starter", description=__doc__)
    parser.add_argument("manifests", nargs="+", type=Path, metavar="MANIFEST")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the models")
    options = parser.parse_args(arguments)
    try:
        learn_starters(options.manifests, options.output)
    except HearthlogError as error:
        print(f"hearthlog: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
