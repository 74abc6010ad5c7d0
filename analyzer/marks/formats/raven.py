"""Selection tables of Raven: columns separated by tabs, below their names."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from hearthlog.analyzer.logs.coverage import Coverage
from hearthlog.analyzer.marks.formats.labels import made_text
from hearthlog.analyzer.marks.formats.tables import read
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.frames import seconds_text

__all__ = ["read", "write"]
_BAND = ("0.000", "8000.000")  # Hz, of sound at 16 kHz
_COLUMNS = (
    "Selection",
    "View",
    "Channel",
    "Begin Time (s)",
    "End Time (s)",
    "Low Freq (Hz)",
    "High Freq (Hz)",
    "Annotation",
    "Microphone",
    "Reviewer",
    "Made",
    "Corrects",
)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Write a table with columns for all fields of the marks, which Raven keeps.

    Parameters
    ----------
    coverage : mapping of str to Coverage
        By microphone; times are written as seconds since its first frame.
    """
    channels = {name: i for i, name in enumerate(sorted({mark.microphone for mark in marks}), 1)}
    lines = ["\t".join(_COLUMNS)]
    for number, mark in enumerate(marks, 1):
        zero = coverage[mark.microphone].starts[0]
        fields = [
            str(number),
            "Spectrogram 1",
            str(channels[mark.microphone]),
            seconds_text(mark.start - zero),
            seconds_text(mark.end - zero),
            *_BAND,
            mark.label,
            mark.microphone,
            mark.reviewer,
            made_text(mark),
            mark.corrects,
        ]
        lines.append("\t".join(fields))
    return "".join(f"{line}\n" for line in lines)
