"""VoxCeleb 1 and 2: speech of 1,251 and of 6,112 people in videos.

Layout as its page says, https://www.robots.ox.ac.uk/~vgg/data/voxceleb: `wav` (of VoxCeleb 2 `aac`)
with files called `id10001/1zcIwhmdeo4/00001.wav` for the person, the video at YouTube, and the
piece. Of the sound the page states no licence; the lists are CC BY 4.0.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.recorder.sources.audio_files import files_below
from hearthlog.recorder.sources.open_audio import is_audio

_PERSON = re.compile(r"id\d{5}")
_VIDEO = re.compile(r"[\w-]{11}", re.ASCII)
_PLACE = 3  # of the person in a path, from its end


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection; the category is the person, the source the video."""
    for name in ("wav", "aac"):
        for path in files_below(folder / name):
            person, video = path.parts[-_PLACE:-1]
            is_clip = _PERSON.fullmatch(person) and _VIDEO.fullmatch(video)
            reason = "" if is_clip else "not placed as a clip of the collection"
            if not is_audio(path.name):
                reason = f"not named as audio that can be read: *{path.suffix}"
            yield CollectionClip(
                path,
                (Sound((person,)),),
                f"youtube_{video}",
                "unstated (sound of YouTube)",
                left_out=reason,
            )
