"""EmoDB, the Berlin database of emotional speech: 535 sentences of ten actors, seven emotions.

Layout as its page says, http://emodb.bilderbar.info/docu: `wav` with files called `03a01Fa.wav` for
the actor, the text, the letter of the emotion in German, and the version. Its page states no
licence.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.recorder.sources.open_audio import is_audio

_NAME = re.compile(r"(\d\d)[ab]\d\d([WLEAFTN])[a-z]?\.wav")
_EMOTIONS = {
    "W": "anger",
    "L": "boredom",
    "E": "disgust",
    "A": "anxiety",
    "F": "happiness",
    "T": "sadness",
    "N": "neutral",
}


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection; the category is the emotion."""
    for path in sorted((folder / "wav").iterdir()):
        if is_audio(path.name):
            found = _NAME.fullmatch(path.name)
            actor, letter = found.groups() if found else ("", "")
            yield CollectionClip(
                path,
                (Sound((_EMOTIONS.get(letter, ""),)),),
                f"emodb_{actor}",
                "unstated",
                left_out="" if found else "not named as a clip of the collection",
            )
