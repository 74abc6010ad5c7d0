"""Label Studio codec: one task per microphone, with one item per mark."""

import json
from collections.abc import Iterator, Mapping, Sequence
from json import dumps
from pathlib import Path
from typing import Any

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.marks.formats.labels import (
    UNREADABLE,
    Choice,
    FileLabel,
    LabelCodec,
    LineError,
    made_text,
    place_text,
    scan,
)
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.frames import seconds_text, time_text

_TYPE = "labels"
_NO_TASK = "unreadable task"


def read(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:  # noqa: ARG001
    """Yield the items of a Label Studio JSON export or import file, in its order.

    An entry that is no task is a `LineError`. Raise `DataError` if the text is not JSON.
    """
    try:
        # Numbers stay text, so that no digits are lost and no length is too large.
        tasks = json.loads(text, parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is not JSON ({error})") from error
    for number, task in enumerate(tasks if isinstance(tasks, list) else [tasks], 1):
        place = f"task {number}"
        if not isinstance(task, dict) or not isinstance(task.get("data"), dict):
            reason = "is no task of Label Studio; export them as JSON"
            yield LineError(place_text(path, place), _NO_TASK, reason)
        else:
            yield from _of_task(path, place, task)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return Label Studio tasks, one per microphone; times are seconds since its first frame."""
    tasks = [
        _task(name, [mark for mark in marks if mark.microphone == name], coverage[name])
        for name in sorted({mark.microphone for mark in marks})
    ]
    return "[\n" + ",\n".join(tasks) + "\n]\n"


def _task(microphone: str, marks: Sequence[Mark], coverage: Coverage) -> str:
    zero = coverage.starts[0]
    length = seconds_text(coverage.ends[-1] - zero)
    data = {"audio": f"{microphone}.wav", "microphone": microphone, "start": time_text(zero)}
    items = ",\n".join(_item(number, mark, zero, length) for number, mark in enumerate(marks, 1))
    return f'{{"data": {dumps(data)}, "annotations": [{{"result": [\n{items}\n]}}]}}'


def _item(number: int, mark: Mark, zero: int, length: str) -> str:
    """Format an item; times are inserted as text, because `json` would round them."""
    origin = {"reviewer": mark.reviewer, "made": made_text(mark), "corrects": mark.corrects}
    item = {
        "id": f"mark{number}",
        "from_name": "label",
        "to_name": "audio",
        "type": _TYPE,
        "origin": "manual",
        "meta": {name: text for name, text in origin.items() if text},
    }
    value = (
        f'{{"start": {seconds_text(mark.start - zero)}, "end": {seconds_text(mark.end - zero)}, '
        f'"channel": 0, "labels": [{dumps(mark.label)}]}}'
    )
    return f'{dumps(item)[:-1]}, "original_length": {length}, "value": {value}}}'


def _of_task(path: Path, place: str, task: Mapping[str, Any]) -> Iterator[FileLabel | LineError]:
    """Yield the items of a task's annotations; of its predictions if it has no annotations."""
    kind = next((kind for kind in ("annotations", "predictions") if kind in task), None)
    if kind is None or not isinstance(task[kind], list):
        reason = "has no annotations and no predictions"
        yield LineError(place_text(path, place), _NO_TASK, reason)
        return
    microphone, start = (_text(task["data"].get(name)) for name in ("microphone", "start"))
    for number, annotation in enumerate(task[kind], 1):
        within = f"{place}, {kind[:-1]} {number}"
        if not isinstance(annotation, dict) or not isinstance(annotation.get("result"), list):
            yield LineError(place_text(path, within), UNREADABLE, "has no result")
            continue
        if annotation.get("was_cancelled") is True:
            continue
        reviewer, made = _completed(annotation) if kind == "annotations" else ("", "")
        items = ((f"{within}, result {i}", item) for i, item in enumerate(annotation["result"], 1))
        for label in scan(path, items, _item_label):
            if isinstance(label, FileLabel):
                yield label._replace(
                    microphone=microphone,
                    zero=start,
                    reviewer=label.reviewer or reviewer,
                    made=label.made or made,
                )
            else:
                yield label


def _item_label(where: str, item: Any) -> FileLabel | None:
    """Parse an item; None for one without a label (a rating, a remark, a relation)."""
    kind = item.get("type") if isinstance(item, dict) else None
    if not isinstance(kind, str) or not kind.endswith(_TYPE):
        return None
    value = item.get("value")
    names = value.get(_TYPE) if isinstance(value, dict) else None
    if kind != _TYPE or not isinstance(names, list) or not {"start", "end"} <= value.keys():
        raise LineError(where, UNREADABLE, f"{kind[:64]!r} is no label of a span of sound")
    if len(names) > 1:
        raise LineError(where, "label of several names", f"has {len(names)} labels; choose one")
    meta = item.get("meta")
    origin = meta if isinstance(meta, dict) else {}
    return FileLabel(
        _text(value["start"]),
        _text(value["end"]),
        _text(names[0]) if names else "",
        **{name: _text(origin.get(name)) for name in ("reviewer", "made", "corrects")},
        length=_text(item.get("original_length")),
    )


def _completed(annotation: Mapping[str, Any]) -> tuple[str, str]:
    """Return author and time of an annotation."""
    by = annotation.get("completed_by")
    if isinstance(by, dict):
        reviewer = _text(by.get("email")) or _text(by.get("id"))
    else:
        reviewer = f"user {by}" if isinstance(by, str) else ""
    return reviewer, _text(annotation.get("created_at"))


def _text(value: Any) -> str:
    """Return a text, empty for null; other values as JSON."""
    return value if isinstance(value, str) else "" if value is None else dumps(value)


CODECS: Mapping[str, LabelCodec] = {
    "Label Studio": LabelCodec(read, write),
}
