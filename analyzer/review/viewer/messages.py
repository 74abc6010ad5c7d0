"""The messages of Rerun's viewer control (0.41) that the page in a browser takes, in protobuf.

A viewer in a window takes them from Rerun's own client. A field is a head, 8 * number + kind, and a
value.
"""

from collections.abc import Iterator

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_SIZES = {_FIXED64: 8, _FIXED32: 4}
_STATE, _SET_TIME, _BLUEPRINT, _SET_BLUEPRINT = 3, 6, 12, 14  # operations
_PAUSED, _PLAYING = 1, 2
_ON_RECORDING = 3  # in `set_blueprint`

Value = int | bytes


def get_state() -> bytes:
    """Make the request for what the viewer shows."""
    return _field(_STATE, b"")


def get_blueprint() -> bytes:
    """Make the request for the blueprint, which has the selection of the user."""
    return _field(_BLUEPRINT, b"")


def set_blueprint(blueprint: str) -> bytes:
    """Make the request to replace the blueprint by another one."""
    return _field(_SET_BLUEPRINT, _field(2, blueprint.encode()) + _field(_ON_RECORDING, b""))


def set_time(axis: str, nanoseconds: int, *, play: bool) -> bytes:
    """Make the request to put the cursor on a time."""
    timeline = _field(2, _field(1, axis.encode()))
    time = _field(3, _field(1, nanoseconds))
    return _field(_SET_TIME, timeline + time + _field(5, _PLAYING if play else _PAUSED))


def read_blueprint(answer: bytes) -> str:
    """Read the JSON of a blueprint.

    Returns
    -------
    str
        Empty if the answer has none.

    Raises
    ------
    ValueError
        If the answer is no message of protobuf.
    """
    return _text(_message(answer, _BLUEPRINT), 2)


def read_state(answer: bytes) -> tuple[str, list[list[str]], int | None]:
    """Read what a viewer says of its state.

    Returns
    -------
    version : str
        Of the viewer; empty if the answer has none.
    cursor : int or None
        In nanoseconds of the axis of time; None if there is no cursor.

    Raises
    ------
    ValueError
        If the answer is no message of protobuf.
    """
    state = _message(answer, _STATE)
    reports = [
        [f"{_text(view, 3)}: {_text(report, 2)}" for report in _messages(view, 6)]
        for view in _messages(state, 5)
    ]
    active = _text(state, 2)
    shown = [one for one in _messages(state, 3) if _text(one, 1) == active]
    cursor = _last(_message(_message(shown[0], 3), 3), 1) if shown else None
    return _text(state, 6), reports, cursor if isinstance(cursor, int) else None


def _field(number: int, value: Value) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3 | _VARINT) + _varint(value)
    return _varint(number << 3 | _BYTES) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    """Write a number in groups of seven bits, the lowest first."""
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*groups, value])


def _fields(content: bytes) -> Iterator[tuple[int, Value]]:
    """Yield number and value of each field.

    Raise `ValueError` if it is no message.
    """
    place = 0
    while place < len(content):
        head, place = _read_varint(content, place)
        number, kind = head >> 3, head & 7
        if kind == _VARINT:
            value, place = _read_varint(content, place)
            yield number, value
            continue
        if kind == _BYTES:
            size, place = _read_varint(content, place)
        elif kind in _SIZES:
            size = _SIZES[kind]
        else:
            raise ValueError(f"a field of kind {kind}")
        if place + size > len(content):
            raise ValueError("a field is cut off")
        yield number, content[place : place + size]
        place += size


def _read_varint(content: bytes, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(content):
            raise ValueError("a number is cut off")
        byte = content[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("a number is too long")


def _last(content: bytes, field: int) -> Value | None:
    """Return the last value of a field, which counts; None if there is none."""
    values = [value for number, value in _fields(content) if number == field]
    return values[-1] if values else None


def _messages(content: bytes, field: int) -> list[bytes]:
    return [v for number, v in _fields(content) if number == field and isinstance(v, bytes)]


def _message(content: bytes, field: int) -> bytes:
    value = _last(content, field)
    return value if isinstance(value, bytes) else b""


def _text(content: bytes, field: int) -> str:
    return _message(content, field).decode(errors="replace")
