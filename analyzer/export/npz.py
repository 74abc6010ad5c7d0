"""A topic as NumPy arrays, in one file that loads without pickle."""

from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from hearthlog.analyzer.export.exporter import Exporter, OutputFiles
from hearthlog.analyzer.export.file_names import file_stem
from hearthlog.analyzer.export.text import json_texts
from hearthlog.analyzer.logs.channel_names import array_names
from hearthlog.analyzer.logs.selection import Selection
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, read_columns
from hearthlog.schemas.messages.fields import DURATION, TIME, Field, fields_of
from hearthlog.schemas.messages.type_definitions import message_type
from hearthlog.schemas.progress import Progress

_TEXTS_LIMIT = 1 << 30  # bytes


def _save(selection: Selection, files: OutputFiles, _: Progress) -> None:
    """Write an array for each field, by its path, and `log_time`, `publish_time` and `sequence`.

    Stamps are datetime64[ns], durations timedelta64[ns]. Arrays of different lengths lie one
    after the other, their lengths in `<field>.lengths`; arrays of messages are JSON. The names
    that the channel has for the elements of an array are in `<field>_names`.
    """
    selection.verify()
    saved = [_save_topic(topic, selection, files) for topic in selection.channels]
    if not any(saved):
        raise selection.nothing()


def _save_topic(topic: str, selection: Selection, files: OutputFiles) -> bool:
    """Write a file if there is a message."""
    by_topic = read_columns(selection.logs, {topic}, selection.start, selection.end)
    if topic not in by_topic:
        return False
    arrays = _arrays(by_topic.pop(topic), _fields(topic, selection))
    with ZipFile(files.new(file_stem(topic)), "x") as archive:
        for key, array in arrays.items():  # np.savez has no place for a field named `file`
            with archive.open(f"{key}.npy", "w", force_zip64=True) as part:
                np.lib.format.write_array(part, array, allow_pickle=False)
    return True


def _fields(topic: str, selection: Selection) -> dict[str, Field]:
    kinds = {
        message_type(schema.name, schema.encoding, schema.data)
        for _, schema in selection.channels[topic]
        if schema is not None
    }
    definitions = [fields_of(kind) for kind in kinds]
    if any(fields != definitions[0] for fields in definitions):
        raise LogError(f"{topic}: is defined in two ways; choose one log")
    return definitions[0]


def _arrays(columns: Columns, fields: dict[str, Field]) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    for path, values in columns.fields.items():
        arrays |= _column(path, values, fields[path])
        names = array_names(columns.metadata, path)
        if names:
            arrays[f"{path}_names"] = np.array(names)
    return arrays | {
        "log_time": columns.log_times.view("M8[ns]"),
        "publish_time": columns.publish_times.view("M8[ns]"),
        "sequence": columns.sequences,
    }


def _column(path: str, values: NDArray[Any], field: Field) -> dict[str, NDArray[Any]]:
    if field.size is None and field.type in {TIME, DURATION}:
        return {path: values.view("M8[ns]" if field.type == TIME else "m8[ns]")}
    if values.dtype != object:
        return {path: values}
    if field.type == "string" and (field.size is None or values.ndim == 2):
        return {path: _texts(path, values)}
    if field.elements or field.type == "string":
        return {path: _texts(path, np.array(json_texts(values, field), object))}
    lengths = np.array([len(row) for row in values])
    return {path: np.concatenate(list(values)), f"{path}.lengths": lengths}


def _texts(path: str, values: NDArray[Any]) -> NDArray[np.str_]:
    """Make an array of texts of equal size, as NumPy has them."""
    longest = max(map(len, values.reshape(-1).tolist()), default=0)
    if values.size * longest * 4 > _TEXTS_LIMIT:
        raise LogError(f"{path}: texts are too long for NPZ; choose parquet")
    return values.astype(f"U{max(longest, 1)}")


EXPORTER = Exporter(_save)
