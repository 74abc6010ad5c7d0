"""Size-limited readers of user-made text and CSV files, with line numbers in errors."""

import codecs
import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path

from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.files import read_limited

# A spreadsheet evaluates such a text as a formula, unless it is a number. An apostrophe before
# the text prevents that; existing apostrophes get one more, so that reading restores the text.
FORMULA = r"^'*[=+\-@\t\r\n＝＋－＠]"  # noqa: RUF001  full-width characters, too
NUMBER = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_MOST_LINES = 1_000_000  # including blank lines: each takes a microsecond
_LONGEST = 1 << 20  # characters of a record: its fields take fifty times as much memory


def disarmed(text: str) -> str:
    """Prefix an apostrophe to a text that a spreadsheet would evaluate as a formula."""
    is_formula = re.match(FORMULA, text) and not re.fullmatch(NUMBER, text)
    return f"'{text}" if is_formula else text


def without_disarming(text: str) -> str:
    """Undo `disarmed`."""
    return text[1:] if text.startswith("'") and re.match(FORMULA, text) else text


def read_text(path: Path, what: str, size_limit: int) -> str:
    """Read a text file in UTF-8, or in UTF-16 with a byte order mark.

    Raise `DataError` if the file is missing, unreadable, larger than `size_limit` bytes, or in
    another encoding.
    """
    raw = read_limited(path, what, size_limit, DataError)
    wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return raw.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise DataError(f"{path}:{line}: is not UTF-8; save the {what} as UTF-8") from error


def numbered_lines(path: Path, text: str) -> Iterator[tuple[int, str]]:
    """Yield the non-blank lines with their numbers from 1.

    Raise `DataError` if the text has more than a million lines.
    """
    _check_lines(path, text)
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            yield number, line


def csv_records(path: Path, text: str, delimiter: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield the non-blank records of CSV with the number of their first line, from 1.

    Raise `DataError` if the text is not CSV, has more than a million lines, or a record of more
    than 1 MiB.
    """
    for line, record in csv_rows(path, text, delimiter):
        if isinstance(record, csv.Error):
            raise DataError(f"{path}:{line}: is not CSV ({record})") from record
        yield line, record


def csv_rows(
    path: Path, text: str, delimiter: str, *, quoted: bool = True
) -> Iterator[tuple[int, list[str] | csv.Error]]:
    """Yield non-blank records of CSV, or the error of each malformed one, with their first line.

    Lines count from 1. Raise `DataError` if the text has more than a million lines, or a record of
    more than 1 MiB.
    """
    _check_lines(path, text)
    line, length = 1, 0

    def lines() -> Iterator[str]:
        nonlocal length
        for text_line in io.StringIO(text, newline=""):
            length += len(text_line)
            if length > _LONGEST:
                raise DataError(
                    f"{path}:{line}: is not CSV (a record is longer than {_LONGEST >> 20} MB)"
                )
            yield text_line

    reader = csv.reader(
        lines(),
        strict=True,
        delimiter=delimiter,
        quoting=csv.QUOTE_MINIMAL if quoted else csv.QUOTE_NONE,
    )
    while True:
        length = 0
        line = reader.line_num + 1
        try:
            record = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            yield line, error
            continue
        if any(field.strip() for field in record):
            yield line, record


def _check_lines(path: Path, text: str) -> None:
    count = max(text.count("\n"), text.count("\r"))
    if count > _MOST_LINES:
        raise DataError(f"{path}: has {count:,} lines; at most {_MOST_LINES:,} are read")
