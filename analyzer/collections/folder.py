"""A folder of one's own: a sub-folder for each label, any audio in it.

In a sub-folder, what is in a further folder is of one source: `coughing/anna/a.wav` and
`speech/anna/b.wav` are of `anna`. A file without such a folder is of the source that its name says,
without the number of a take at its end: `kettle_001.wav`, `kettle-2.wav` and `kettle (3).wav` are
of `kettle`.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.recorder.sources.audio_files import files_below
from hearthlog.recorder.sources.open_audio import is_audio

_TAKE = re.compile(r"(?:[ _.-]\d{1,3}| ?\(\d{1,3}\))$")


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the audio files in the sub-folders of a folder; the name of each is the category."""
    for path in files_below(folder):
        inner = path.relative_to(folder).parts
        if len(inner) > 1:
            source = inner[1] if len(inner) > 2 else _TAKE.sub("", path.stem) or path.stem
            reason = "" if is_audio(path.name) else _no_audio(path)
            yield CollectionClip(path, (Sound((inner[0],)),), source, "", left_out=reason)


def _no_audio(path: Path) -> str:
    if path.name.startswith("."):
        return "hidden: its name begins with a dot"
    return f"not named as audio that can be read: *{path.suffix}"
