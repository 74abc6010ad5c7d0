"""ESC-50: 2,000 clips of five seconds, fifty categories.

Layout and licence as its repository says, https://github.com/karolpiczak/ESC-50, in version 2:
`meta/esc50.csv` with `filename,fold,target,category,esc10,src_file,take`, and `audio/`. `src_file`
is the number of the recording at Freesound. The clips of the subset ESC-10 are CC BY, all others
CC BY-NC.
"""

from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.collections.clip import CollectionClip, Sound
from hearthlog.analyzer.collections.files import inside, read_table


def read(folder: Path) -> Iterator[CollectionClip]:
    """Yield the clips of the collection.

    Raise `DataError` if the table of the collection cannot be read.
    """
    columns = "filename", "category", "esc10", "src_file"
    for where, row in read_table(folder / "meta" / "esc50.csv", columns):
        name, category, esc10, recording = row
        licence = "CC BY 3.0" if esc10 == "True" else "CC BY-NC 3.0"
        path = inside(where, folder / "audio", name)
        yield CollectionClip(path, (Sound((category,)),), f"fs{recording}", licence)
