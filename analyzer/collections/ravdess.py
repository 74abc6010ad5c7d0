"""RAVDESS: 1,440 spoken and 1,012 sung sentences of 24 actors, each in up to eight emotions.

Layout and licence as its record says, https://zenodo.org/records/1188976: folders `Actor_01` to
`Actor_24`, wherever they are, with files called `03-01-05-01-02-01-12.wav` for modality, channel,
emotion, intensity, statement, repetition and actor.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.recorder.sources.audio_files import files_below
from hearthlog.recorder.sources.open_audio import is_audio

_NAME = re.compile(r"03-0[12]-(0[1-8])-0[12]-0[12]-0[12]-(\d\d)\.wav")
_EMOTIONS = (
    *("neutral", "calm", "happy", "sad"),
    *("angry", "fearful", "disgust", "surprised"),
)


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection; the category is the emotion."""
    for path in files_below(folder):
        if is_audio(path.name):
            found = _NAME.fullmatch(path.name)
            emotion, actor = found.groups() if found else ("", "")
            yield CollectionClip(
                path,
                (Sound((_EMOTIONS[int(emotion) - 1] if emotion else "",)),),
                f"ravdess_{actor}",
                "CC BY-NC-SA 4.0",
                left_out="" if found else "not named as a clip of the collection",
            )
