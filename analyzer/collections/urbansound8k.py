"""UrbanSound8K: 8,732 clips of at most four seconds, ten categories of city sound.

Layout and licence as `UrbanSound8K_README.txt` in it says,
https://urbansounddataset.weebly.com/urbansound8k.html: `metadata/UrbanSound8K.csv` with
`slice_file_name,fsID,start,end,salience,fold,classID,class`, and `audio/fold1` to `audio/fold10`.
`fsID` is the number of the recording at Freesound. Salience 2 is a sound in the background.
"""

from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.analyzer.collections.files import inside, read_table

_FOREGROUND = "1"


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection.

    Raise `DataError` if the table of the collection cannot be read.
    """
    columns = "slice_file_name", "fsID", "salience", "fold", "class"
    for where, row in read_table(folder / "metadata" / "UrbanSound8K.csv", columns):
        name, recording, salience, fold, category = row
        yield CollectionClip(
            inside(where, folder / "audio", f"fold{fold}/{name}"),
            (Sound((category,)),),
            f"fs{recording}",
            "CC BY-NC 3.0",
            left_out="" if salience == _FOREGROUND else "in the background of other sounds",
        )
