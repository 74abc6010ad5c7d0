"""Text files that people make: read within limits, and refused with the line that is wrong."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.errors import DataError


def read_text(path: Path, what: str, size_limit: int) -> str:
    """Read a text file in UTF-8.

    Parameters
    ----------
    path : Path
    what : str
        What it should be, for the message.
    size_limit : int
        In bytes.

    Raises
    ------
    DataError
        If it cannot be read, is larger, or is not UTF-8.
    """
    try:
        if not path.is_file():
            raise DataError(f"{path}: no such {what}")
        with path.open("rb") as stream:
            raw = stream.read(size_limit + 1)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if len(raw) > size_limit:
        raise DataError(f"{path}: larger than {size_limit >> 20} MB; this is no {what}")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise DataError(f"{path}:{line}: is not UTF-8; save the {what} as UTF-8") from error


def csv_records(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the records of CSV that are not blank, each with the line it starts in.

    Raises
    ------
    DataError
        If the text is not CSV.
    """
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    while True:
        line = reader.line_num + 1
        try:
            record = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            raise DataError(f"{path}:{line}: is not CSV ({error})") from error
        if any(field.strip() for field in record):
            yield line, record
