"""VocalSound: 21,024 clips of laughter, sighs, coughs, throat clearing, sneezes and sniffs.

Layout and licence as its repository says, https://github.com/YuanGongND/vocalsound: `audio_16k`, or
`audio_44k` with the same clips, called `f0003_0_cough.wav` for speaker, session and category;
`datafiles/all.json` lists them as `{"data": [{"wav": "…/f0003_0_cough.wav", …}, …]}`.
"""

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.analyzer.collections.files import read_json
from hearthlog.analyzer.errors import DataError
from hearthlog.recorder.sources.open_audio import is_audio

_NAME = re.compile(r"([fm]\d+)_\d+_([a-z]+)\.wav")


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection.

    Raise `DataError` if the list of clips is there and cannot be read.
    """
    audio = folder / "audio_16k"
    if not audio.is_dir():
        audio = folder / "audio_44k"
    listing = folder / "datafiles" / "all.json"
    names = {path.name for path in audio.iterdir() if is_audio(path.name)}
    for name in sorted(names.union(_listed(listing) if listing.exists() else ())):
        found = _NAME.fullmatch(name)
        speaker, category = found.groups() if found else ("", "")
        yield CollectionClip(
            audio / name,
            (Sound((category,)),),
            f"vocalsound_{speaker}",
            "CC BY-SA 4.0",
            left_out="" if found else "not named as a clip of the collection",
        )


def _listed(path: Path) -> Iterator[str]:
    clips = read_json(path).get("data")
    if not isinstance(clips, list):
        raise DataError(f"{path}: has no list `data`; is this another version of the collection?")
    for clip in clips:
        if isinstance(clip, dict) and isinstance(clip.get("wav"), str):
            yield PurePosixPath(clip["wav"]).name
