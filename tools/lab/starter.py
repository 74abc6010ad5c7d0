"""Learn the starter models: `python -m hearthlog.tools.lab.starter MANIFEST … -o models/starter`.

With `--method embedding` those for a home with a network, `general-embedding` and
`bathroom-embedding`: smaller, and with classes that the features alone mislead about. Of what the
manifests have hardly any recordings, they keep what the other starters have learned.

Only recordings whose licence allows that a model is passed on are learned from, and none of those
that the simulated home plays, so that its days try the models on what they have not heard.
"""

import argparse
import csv
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import soundfile

from hearthlog.analyzer.training.clips import clip_frames
from hearthlog.analyzer.training.dataset import Dataset, clip_recordings, cut_recordings
from hearthlog.analyzer.training.heads import head_inputs_of
from hearthlog.analyzer.training.manifest import (
    BUILTIN,
    LABELS,
    LabelledClip,
    Scenario,
    read_manifest,
)
from hearthlog.analyzer.training.method import prepare
from hearthlog.analyzer.training.train import clip_embedder, train_model
from hearthlog.analyzer.training.window_methods import EMBEDDING, ROOM, LandmarkMethod, kept_inputs
from hearthlog.models.classes import CRYING, LAUGHING, PHONE_RING, SILENCE
from hearthlog.models.classifiers.evidence import UNTAUGHT
from hearthlog.models.classifiers.model import SIMULATED, Model, may_be_shipped
from hearthlog.models.modelfile import load_model, model_card, save_model
from hearthlog.models.starter import BY_FEATURES, starter_file
from hearthlog.schemas.arrays import Float32, Indices
from hearthlog.schemas.errors import HearthlogError, ignore_progress, listed
from hearthlog.schemas.frames import SAMPLE_RATE
from hearthlog.tools.home.sounds import synthesize

_FEWEST_SOURCES = 3  # a class of fewer would only mislead
# Laughing has an F1 of 0.05 in collections left out. The crying of these recordings is that of
# babies, and speech is taken for it.
_MISLEADING = {"general": (LAUGHING, CRYING)}
_RING_TONES, _RING_SECONDS = 40, 4.0
_METHODS = {method.name: method for method in (ROOM, EMBEDDING)}
_COLUMNS = ("path", "label", "source_group", "source", "licence", "seconds", "credit", "url")
_ABOUT = """# The starter models

`{sources}` lists every recording that they have learned from, with its licence and its author.
It is a manifest: with the recordings in the places that it names, it learns the same models again.
The collections are repositories at https://github.com, or packages of Debian where they say so.
"""
_OF_NETWORK = """\
Where it has hardly any recordings of a class, they keep what the starters without a network
have learned of it, from those in `sources.csv`.

They take what the network {network} hears, whose file is not part of hearthlog:
`hearthlog models fetch {network}` brings it. AudioSet's names, by which it was taught, count as
evidence as they are, without a recording: each class has a head that goes by the names which mean
it.{by_names} Without the network they label by the features alone.
"""
_PLAYED = Path(__file__).parents[1] / "home" / "clips" / "manifest.csv"


def learn_starters(manifests: Sequence[Path], folder: Path, method: LandmarkMethod = ROOM) -> None:
    """Learn the starter models, and write them and a page about them.

    Parameters
    ----------
    manifests : sequence of Path
        Of the collections, with licences.
    folder : Path
        Is written over.
    method : LandmarkMethod, optional

    Raises
    ------
    DataError
        If a manifest cannot be read, or too little of it may be used.
    ModelError
        If the network of the method is not there.
    """
    clips = list(_usable(manifests))
    with TemporaryDirectory() as temporary:
        sounds = [*_joined(clips, Path(temporary)), *_ring_tones(Path(temporary))]
        models = [_learn(name, sounds, folder, method) for name in BY_FEATURES]
    suffix = _suffix(method)
    _write_sources(folder / f"sources{suffix}.csv", manifests, clips)
    (folder / f"README{suffix}.md").write_text(_page(models, method), "utf-8")


def _suffix(method: LandmarkMethod) -> str:
    """Return what the names of files end in, of starters that are for a network."""
    return f"-{method.name}" if method.network else ""


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


def _joined(clips: Sequence[LabelledClip], folder: Path) -> list[LabelledClip]:
    """Join clips that are too short for a segment, such as single words, to one of each source."""
    short: dict[tuple[str, str, str, str], list[Float32]] = {}
    long = []
    for clip in clips:
        frames = clip_frames(clip)
        if len(frames) < ROOM.features.window_frames:
            source = clip.label, clip.source_group, clip.source, clip.licence
            short.setdefault(source, []).append(frames)
        else:
            long.append(clip)
    for number, (source, parts) in enumerate(short.items()):
        path = folder / f"joined_{number:04d}.flac"
        soundfile.write(path, np.concatenate(parts).ravel(), SAMPLE_RATE, "PCM_16")
        long.append(LabelledClip(path, *source))
    return long


def _ring_tones(folder: Path) -> list[LabelledClip]:
    """Make ring tones: telephones synthesise theirs, too."""
    clips = []
    for number in range(_RING_TONES):
        path = folder / f"ring_{number:02d}.flac"
        soundfile.write(path, synthesize(PHONE_RING, _RING_SECONDS, number), SAMPLE_RATE, "PCM_16")
        clips.append(LabelledClip(path, PHONE_RING, path.stem, SIMULATED, "CC0"))
    return clips


def _learn(name: str, clips: Sequence[LabelledClip], folder: Path, method: LandmarkMethod) -> Model:
    """Learn one model of the classes that have enough sources."""
    scenario, path = BUILTIN[name], folder / f"{name}{_suffix(method)}.safetensors"
    sources: dict[str, set[tuple[str, str]]] = {}
    for clip in clips:
        if (class_ := scenario.find(clip.label)) is not None:
            sources.setdefault(class_, set()).add((clip.source, clip.source_group))
    few = {one for one in scenario.classes if len(sources.get(one, ())) < _FEWEST_SOURCES}
    before = load_model(starter_file(name)) if method.network else None
    kept = few & set(before.classes) if before is not None else set()
    named = set[str]()
    if method.network:  # whose names say what is of a class, if there is any recording at all
        named = (few - kept) & sources.keys() & set(head_inputs_of(method.network).groups)
    misleading = () if method.network else _MISLEADING.get(name, ())
    classes = dict(scenario.classes)
    for one in scenario.classes:
        if one in few - kept - named or one in misleading:
            print(f"{name}: no class {one}, of which there are {len(sources.get(one, ()))} sources")
            del classes[one]
    chosen = Scenario(scenario.name, classes).with_unknown(
        (clip.label, clip.source_group) for clip in clips
    )
    data = cut_recordings(
        clip_recordings(
            clips, chosen, ignore_progress, method.features, method.rooms, clip_embedder(method)
        ),
        chosen,
        method.features,
    )
    others = [_own_windows(method, data, named)] if named else []
    if before is not None and kept:
        others.append(_kept(before, data, kept))
    joined = None
    if others:
        joined = (
            np.concatenate([one[0] for one in others]),
            np.concatenate([one[1] for one in others]),
        )
    model = train_model(data, chosen, ignore_progress, method, others=joined)
    if before is not None and kept:
        model = _crediting(model, before)
    path.unlink(missing_ok=True)
    save_model(model, path)
    path.chmod(0o644)  # it learned from published recordings, and is passed on
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    changed: list[str] = []
    model = load_model(path, changed.append)  # where it takes the place of another
    if changed:
        print(f"{path}: write its sha256 {model.sha256} into {path.with_name('__init__.py')}")
    return model


def _own_windows(
    method: LandmarkMethod, data: Dataset, classes: set[str]
) -> tuple[Float32, Indices]:
    """Return the windows of classes of which folds may leave nothing to learn from."""
    numbers = [data.classes.index(name) for name in classes]
    rows = np.flatnonzero(np.isin(data.target, numbers))
    return prepare(method, data).windows(rows)[:2]


def _kept(before: Model, data: Dataset, kept: set[str]) -> tuple[Float32, Indices]:
    """Return the windows of some classes that a model without a network has kept."""
    windows = kept_inputs(before)
    assert windows is not None
    inputs, target = windows
    own = np.isin(target, [before.classes.index(one) for one in kept])
    numbers = [data.classes.index(before.classes[one]) for one in target[own].tolist()]
    return inputs[own], np.array(numbers, np.intp)


def _crediting(model: Model, before: Model) -> Model:
    """Name the collections, too, of which only another model has learned."""
    training = model.description.training_data
    named = {(one.name, one.licence) for one in training.collections}
    more = [
        one
        for one in before.description.training_data.collections
        if (one.name, one.licence) not in named
    ]
    update = {"collections": sorted([*training.collections, *more], key=lambda one: one.name)}
    described = model.description.model_copy(
        update={"training_data": training.model_copy(update=update)}
    )
    return replace(model, description=described)


def _page(models: Sequence[Model], method: LandmarkMethod) -> str:
    """Describe the models, and name the classes that they lack."""
    about = _ABOUT.format(sources=f"sources{_suffix(method)}.csv")
    if method.network:
        about += _OF_NETWORK.format(network=method.network, by_names=_by_names(models))
    lacking = [
        f"- `{model.name}` has no class `{one}`: its recordings are too few, or too alike."
        for name, model in zip(BY_FEATURES, models, strict=True)
        for one in BUILTIN[name].classes
        if one not in model.classes
    ]
    return "\n".join([about, *lacking, "", *map(model_card, models)])


def _by_names(models: Sequence[Model]) -> str:
    """Say of which classes the recordings were too few to teach a head anything."""
    untaught = [
        f"`{name}` of `{model.name}`"
        for model in models
        for name, biases in zip(model.classes, model.embedding_bias.T.tolist(), strict=True)
        if name != SILENCE and UNTAUGHT in biases
    ]
    if not untaught:
        return ""
    return f"\nOf {listed(untaught, 'and')} these and the features alone say what it is."


def _write_sources(path: Path, manifests: Sequence[Path], clips: Sequence[LabelledClip]) -> None:
    """Write a manifest of what was learned from, in a folder for each collection."""
    used = {clip.path for clip in clips}
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, _COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        for manifest in manifests:
            with manifest.open(encoding="utf-8", newline="") as rows:
                for row in csv.DictReader(rows):
                    clip = Path(row["path"].strip())
                    if manifest.parent / clip in used:
                        place = Path(row["source"].replace(":", "_"), *clip.parts[-2:])
                        writer.writerow(row | {"path": place})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog="python -m hearthlog.tools.lab.starter", description=__doc__
    )
    parser.add_argument("manifests", nargs="+", type=Path, metavar="MANIFEST")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the models")
    parser.add_argument("--method", choices=_METHODS, default=ROOM.name)
    options = parser.parse_args(arguments)
    try:
        learn_starters(options.manifests, options.output, _METHODS[options.method])
    except HearthlogError as error:
        print(f"hearthlog: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
