"""Text files that people make: read within limits, and refused with the line that is wrong."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.storage.small_file import read_whole

_MOST_LINES = 1_000_000  # blank ones too: each takes a microsecond
_LONGEST = 1 << 20  # characters of a record: fields take fifty times as much memory


def read_text(path: Path, what: str, size_limit: int) -> str:
    """Read a text file in UTF-8.

    Parameters
    ----------
    path : Path
    what : str
        What the file should be, such as `manifest`, for the message.
    size_limit : int
        Bytes that the file may have at most.

    Raises
    ------
    DataError
        If there is no such file, or it cannot be read, is larger, or is not UTF-8.
    """
    raw = read_whole(path, what, size_limit, DataError)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise DataError(f"{path}:{line}: is not UTF-8; save the {what} as UTF-8") from error


def csv_records(path: Path, text: str, delimiter: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield the records of CSV that are not blank.

    Parameters
    ----------
    path : Path
        Of the file, for the message.
    text : str
        All of it.
    delimiter : str
        Between fields.

    Yields
    ------
    line : int
        The line in which the record begins, from 1.
    record : list of str
        Its fields.

    Raises
    ------
    DataError
        If the text is not CSV, has more than a million lines, or a record of more than 1 MiB.
    """
    count = max(text.count("\n"), text.count("\r"))
    if count > _MOST_LINES:
        raise DataError(f"{path}: has {count:,} lines; at most {_MOST_LINES:,} are read")
    length = 0

    def lines() -> Iterator[str]:
        nonlocal length
        for text_line in io.StringIO(text, newline=""):
            length += len(text_line)
            if length > _LONGEST:
                raise csv.Error(f"a record is longer than {_LONGEST >> 20} MB")
            yield text_line

    reader = csv.reader(lines(), strict=True, delimiter=delimiter)
    while True:
        length = 0
        line = reader.line_num + 1
        try:
            record = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise DataError(f"{path}:{line}: is not CSV ({error})") from error
        if any(field.strip() for field in record):
            yield line, record
