"""FSD50K: 51,197 clips of 0.3 to 30 seconds, 200 categories of AudioSet's ontology.

Layout and licences as `FSD50K.doc/README.md` in it says, https://zenodo.org/records/4060432:
`FSD50K.ground_truth/dev.csv` with `fname,labels,mids,split`, `eval.csv` without `split`; audio in
`FSD50K.dev_audio` and `FSD50K.eval_audio`, called by its number at Freesound; title, uploader and
licence of each clip in `FSD50K.metadata/dev_clips_info_FSD50K.json` and `eval_clips_…`. Labels are
separated by commas and have their parents in the ontology with them.

Clips of one uploader are one source: people upload takes of one afternoon, and the collection
itself divides development and evaluation by uploader.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.analyzer.collections.files import inside, read_json, read_table
from hearthlog.analyzer.errors import DataError

_PARTS = "dev", "eval"
_LICENCE = re.compile(r"https?://creativecommons\.org/licenses/([a-z+-]+)/([\d.]+)/?")
_ZERO = re.compile(r"https?://creativecommons\.org/publicdomain/zero/[\d.]+/?")


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection.

    Raise `DataError` if a table of the collection cannot be read.
    """
    truth = folder / "FSD50K.ground_truth"
    parts = [part for part in _PARTS if (truth / f"{part}.csv").exists()]
    if not parts:
        raise DataError(f"{truth}: holds neither dev.csv nor eval.csv")
    for part in parts:
        about = read_json(folder / "FSD50K.metadata" / f"{part}_clips_info_FSD50K.json")
        audio = folder / f"FSD50K.{part}_audio"
        for where, (number, labels) in read_table(truth / f"{part}.csv", ("fname", "labels")):
            uploader, licence = _about(about.get(number))
            yield CollectionClip(
                inside(where, audio, f"{number}.wav"),
                (Sound(tuple(labels.split(","))),),
                f"freesound_user_{uploader}" if uploader else f"fs{number}",
                licence,
            )


def _about(clip: object) -> tuple[str, str]:
    """Return uploader and licence of a clip."""
    known = clip if isinstance(clip, dict) else {}
    return str(known.get("uploader") or "").strip(), short_licence(str(known.get("license")))


def short_licence(address: str) -> str:
    """Return the short name of a licence of Creative Commons; `unstated` for another.

    Parameters
    ----------
    address : str
        As `http://creativecommons.org/licenses/by/3.0/`.
    """
    if _ZERO.fullmatch(address):
        return "CC0"
    found = _LICENCE.fullmatch(address)
    if found is None:
        return "unstated"
    kind, version = found.groups()
    return f"CC {'Sampling+' if kind == 'sampling+' else kind.upper()} {version}"
