"""Sizes of files in bytes, as people write them."""

import re
from typing import Annotated

from pydantic import BeforeValidator

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_LARGEST = 10**18


def parse_size(value: object) -> int:
    """Read a size.

    Parameters
    ----------
    value : object
        A number of bytes, or a text such as "500M" or "1.5 GB".

    Raises
    ------
    ValueError
        If it is neither.
    """
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,15})?) ?([kmgt]?)b?", str(value).lower())
    if match is None:
        raise ValueError(f"{str(value)[:40]!r} is no size; say how many bytes, such as 500M or 20G")
    size = int(float(match[1]) * _UNITS[match[2]])
    if size > _LARGEST:
        raise ValueError("more than any disk has; say how many bytes, such as 500M or 20G")
    return size


def size_text(size: int) -> str:
    """Say a size in the unit that fits.

    Parameters
    ----------
    size : int
        Bytes.
    """
    for unit, text in (("g", "GB"), ("m", "MB"), ("k", "kB")):
        if size >= _UNITS[unit]:
            return f"{size / _UNITS[unit]:.1f} {text}"
    return f"{size} B"


Size = Annotated[int, BeforeValidator(parse_size, json_schema_input_type=int | str)]
