"""Errors in a configuration: the origin of each value, and suggested corrections."""

import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ValidationError

from hearthlog._version import __version__
from hearthlog.schemas.errors import ConfigurationError

ENVIRONMENT = "HEARTHLOG_"
DEFAULT = "default"
_PART = r"""(?:[\w-]+|"[^"\\]*"|'[^']*')"""
_NAME = rf"{_PART}(?:\s*\.\s*{_PART})*"
_TABLE = re.compile(rf"\s*(\[\[?)\s*({_NAME})\s*\]\]?")
_KEY = re.compile(rf"\s*({_NAME})\s*=")
_PARTS = re.compile(_PART)

Key = tuple[str | int, ...]  # such as ("microphone", 1, "device")


class Origins(NamedTuple):
    """Given values and their origins."""

    command_line: Mapping[str, Any]
    file: Mapping[str, Any]
    path: Path | None
    lines: Mapping[Key, int]

    def origin(self, key: Key) -> str:
        """Format the origin of a key's value."""
        first = str(key[0]) if key else ""
        if first in self.command_line:
            return "command line"
        if (variable := _variable(first)) is not None:
            return f"environment, {variable}"
        if first not in self.file or not self._is_given(key):
            return DEFAULT
        line = next((self.lines[up] for up in _upwards(key) if up in self.lines), None)
        return f"{self.path}" if line is None else f"{self.path}, line {line}"

    def place(self, key: Key) -> str:
        """Format the place of an error: a line of the file, or another origin of the value."""
        every = (self.origin(key[:end]) for end in range(len(key), 0, -1))  # innermost first
        return next((origin for origin in every if origin != DEFAULT), "configuration")

    def _is_given(self, key: Key) -> bool:
        value: Any = self.file
        for part in key:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return False
        return True


def key_lines(text: str) -> dict[Key, int]:
    """Return the line, from 1, on which each key and table of a TOML file begins.

    Keys of inline tables are not found.
    """
    lines: dict[Key, int] = {}
    table: Key = ()
    counts: dict[Key, int] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if head := _TABLE.match(line):
            table = _parts(head[2])
            lines.setdefault(table, number)
            if head[1] == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = (*table, counts[table])
                lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault((*table, *_parts(key[1])), number)
    return lines


def _parts(name: str) -> Key:
    return tuple(part.strip("\"'") for part in _PARTS.findall(name))


def _variable(name: str) -> str | None:
    wanted = f"{ENVIRONMENT}{name}".upper()
    is_a_key = name and name == name.lower()  # NODE in a file is no key
    return next((each for each in os.environ if each.upper() == wanted), None) if is_a_key else None


def _upwards(key: Key) -> list[Key]:
    """Return a key and the keys that contain it, innermost first."""
    return [key[:end] for end in range(len(key), 0, -1)]


Schema = Mapping[str, Any]

_LONGEST = 40  # characters shown of a value
_MOST = 100  # reported errors
_MOST_LISTED = 16  # keys of a table
_DAY = 86_400
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": _DAY, "w": 7 * _DAY}  # seconds, by the first letter
_LONGER = {"mo": 30 * _DAY, "y": 365 * _DAY}
_MEASURED = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ?([a-zA-Z%]{1,8})")
_UNIT = re.compile(
    r"(mo)(?:n|nths?)?|(y)(?:r|rs|ears?)?|([smhdw])|(s)ec(?:ond)?s?|(m)in(?:ute)?s?|(h)(?:r|rs|ours?)|"
    r"(d)ays?|(w)eeks?"
)
_COUNTED = (  # by the key
    (re.compile(r"_days$"), _DAY),
    (re.compile(r"minutes"), 60),
    (re.compile(r"seconds|duration"), 1),
)
_SIZE = re.compile(r"([kmgt])i?b?")
_MEGABYTES = {"k": 1e-3, "m": 1, "g": 1e3, "t": 1e6}
_PLURALS = {"array": "lists", "integer": "whole numbers", "number": "numbers", "string": "texts"}


class _Place(NamedTuple):
    """Location of an error in a configuration."""

    key: Key
    about: Schema  # schema of the value; empty if unknown
    table: Schema
    name: str  # the innermost key with a schema; the value may be one element of its value
    named: Schema


def configuration_error(
    error: ValidationError,
    origins: Origins,
    model: type[BaseModel],
    table: Key = (),
    others: Mapping[str, type[BaseModel]] | None = None,
) -> ConfigurationError:
    """Format all errors, one line each; `others` are tables to suggest for misplaced keys."""
    schema = model.model_json_schema()
    unknown: list[str] = []
    rest: list[tuple[Key, str]] = []
    meant: set[Key] = set()
    for each in error.errors(include_url=False):
        place = _find(schema, tuple(each["loc"]))
        key = (*table, *place.key)
        where = origins.place(key)
        if each["type"] == "extra_forbidden":
            near, words = _unknown_key(str(key[-1]), place.table, others or {})
            meant.add((*key[:-1], near))
            unknown.append(f"{where}: unknown key {_dotted(key)!r}{words}")
        else:
            rest.append((key, f"{where}: {_dotted(key)}: {_words(each, place, key)}"))
    # Report a misspelt key once, not also as missing.
    lines = [*unknown, *(line for key, line in rest if key not in meant)]
    more = [f"{origins.path}: {len(lines) - _MOST} more"] if len(lines) > _MOST else []
    return ConfigurationError(*dict.fromkeys(lines[:_MOST]), *more)


def _dotted(key: Key) -> str:
    return ".".join(str(part) for part in key)


def _find(root: Schema, location: Key) -> _Place:
    """Follow the location of an error through a JSON schema; union tags are not keys."""
    node = table = named = _resolved(root, root)
    key: list[str | int] = []
    name = ""
    for part in location:
        if part == "[key]":
            continue
        tags = node.get("discriminator", {}).get("mapping", {})
        if part in tags:
            node = _resolved(root, {"$ref": tags[part]})
            continue
        key.append(part)
        if isinstance(part, int):
            node = _resolved(root, node.get("items", {}))
            continue
        table = node
        inner = node.get("properties", {}).get(part, node.get("additionalProperties", {}))
        node = _resolved(root, inner if isinstance(inner, dict) else {})
        if part in table.get("properties", {}):
            name, named = part, node
    return _Place(tuple(key), node, table, name, named)


def _resolved(root: Schema, node: Schema) -> Schema:
    """Return a schema with references resolved and null choices removed."""
    while True:
        kinds = [each for each in node.get("anyOf", ()) if each.get("type") != "null"]
        rest = {name: value for name, value in node.items() if name not in {"$ref", "anyOf"}}
        if "$ref" in node:
            node = {**root.get("$defs", {}).get(str(node["$ref"]).rpartition("/")[2], {}), **rest}
        elif len(kinds) == 1:
            node = {**kinds[0], **rest}
        else:
            return node


def _unknown_key(
    name: str, table: Schema, others: Mapping[str, type[BaseModel]]
) -> tuple[str, str]:
    """Return the suggested key and the text of the suggestion; both may be empty."""
    properties = table.get("properties", {})
    if f"{name}_file" in properties:
        near = f"{name}_file"
        return near, f"; write {near} = {_example(near, properties[near])}, a file that holds it"
    from difflib import get_close_matches  # noqa: PLC0415  not at each start

    for head, model in others.items():
        if name in model.model_json_schema()["properties"]:
            return "", f"; it belongs {head}"
    near = next(iter(get_close_matches(name.lower(), properties, 1, 0.6)), "")
    if near:
        return near, f"; is {near} meant?"
    if 0 < len(properties) <= _MOST_LISTED:
        return (
            "",
            f"; the keys of this table are {', '.join(properties)}, in hearthlog {__version__}",
        )
    words = f"; `hearthlog config schema` lists the keys of hearthlog {__version__}"
    return "", words if properties else ""


def _words(error: Any, place: _Place, key: Key) -> str:
    """Format the fault of a value and its correction."""
    kind, value, about = error["type"], error["input"], place.about
    name = place.name
    if kind in {"value_error", "assertion_error"}:
        return str(error["msg"]).removeprefix("Value error, ").removeprefix("Assertion failed, ")
    if kind == "missing":
        return f"is missing; write {name} = {_example(name, about)}"
    if kind.startswith("union_tag"):
        which = str(error["ctx"]["discriminator"]).strip("'")
        tags = list(about.get("discriminator", {}).get("mapping", {}))
        listed = ", ".join(json.dumps(tag) for tag in tags)
        return f"{which} is one of {listed}; write {which} = {json.dumps(tags[0])}"
    if problem := _problem_of_table(value, about, key, name):
        return problem
    if kind in {"too_long", "too_short"}:
        limits = ("at least", "minItems"), ("at most", "maxItems"), ("at most", "maxProperties")
        counts = [f"{words} {about[limit]}" for words, limit in limits if limit in about]
        return f"has {len(value)} entries; write {' and '.join(counts)}"
    example = _example_of_value(name, value, place)
    what = f"{_shown(value)} is not {_description(about)}"
    return f"{what}; write {name} = {example}"


def _problem_of_table(value: Any, about: Schema, key: Key, name: str) -> str:
    """Format the syntax of the expected table; empty if the value is no table."""
    items = about.get("items", {})
    head = _dotted(tuple(part for part in key if isinstance(part, str)))
    if about.get("type") == "array" and ("$ref" in items or "oneOf" in items):
        return f"write [[{head}]], with two brackets, above the keys of each {name}"
    if "properties" in about and isinstance(key[-1], int):
        return f"is a table; write [[{head}]], with two brackets, above the keys of each {name}"
    if "properties" in about:
        is_many = isinstance(value, list)
        once = "with one bracket, above its keys, once" if is_many else "and its keys below it"
        return f"is a table; write [{head}] {once}"
    return ""


def _description(about: Schema) -> str:
    """Format the values that a key accepts."""
    if choices := about.get("enum", [about["const"]] if "const" in about else []):
        return f"one of {', '.join(map(json.dumps, choices))}"
    if "anyOf" in about:
        return "a size in bytes"
    kind, text = about.get("type"), "a text in quotes"
    if kind in {"integer", "number"}:
        return _description_of_number(about, "a whole number" if kind == "integer" else "a number")
    if "maxLength" in about:
        text += f" of at most {about['maxLength']} characters"
    if kind == "array":
        return f"a list of {_PLURALS.get(about.get('items', {}).get('type'), 'values')}"
    if about.get("format") == "path":
        return "a path in quotes"
    return {"object": "a table of paths", "boolean": "true or false"}.get(str(kind), text)


def _description_of_number(about: Schema, kind: str) -> str:
    least = about.get("minimum", about.get("exclusiveMinimum"))
    most = about.get("maximum", about.get("exclusiveMaximum"))
    if least is None:
        return kind if most is None else f"{kind} up to {most}"
    return f"{kind} of at least {least}" if most is None else f"{kind} from {least} to {most}"


def _example_of_value(name: str, value: Any, place: _Place) -> str:
    """Return a replacement for a value: the value itself, if only its form is wrong."""
    about = place.named
    kind, items = about.get("type"), about.get("items", {})
    is_word = isinstance(value, str) and "://" not in value and 0 < len(value) <= _LONGEST
    is_text = kind == "array" and items.get("type") == "string" and place.about is about
    if is_text and is_word and _has_form_of_examples(value, about):
        return json.dumps([value], ensure_ascii=False)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind == "string" and "format" not in about and "enum" not in about and is_number:
        return json.dumps(str(value))
    found = _MEASURED.fullmatch(value) if is_word and kind in {"integer", "number"} else None
    if found is not None and (without := _without_unit(name, found, about)):
        return f"{without}, without a unit"
    return _example(name, about)


def _has_form_of_examples(value: str, about: Schema) -> bool:
    """Return whether a text has digits at the same positions as an example, if any has digits."""
    examples = [text for each in about.get("examples", ()) for text in each]
    forms = [re.sub(r"\d", "0", text) for text in examples]
    return all("0" not in form for form in forms) or re.sub(r"\d", "0", value) in forms


def _without_unit(name: str, found: re.Match[str], about: Schema) -> str:
    """Convert a number with a unit to the unit of the key; empty if unknown."""
    number, unit = float(found[1]), _UNIT.fullmatch(found[2].lower())
    if name.endswith("_space"):
        size = _SIZE.fullmatch(found[2].lower())
        if size is None:
            return ""
        number = math.ceil(number * _MEGABYTES[size[1]])
    elif unit is not None:
        counted = next((one for words, one in _COUNTED if words.search(name)), None)
        if counted is None:
            return ""
        number *= (_UNITS | _LONGER)[next(filter(None, unit.groups()))] / counted
        if about.get("type") == "integer":
            number = math.ceil(number)
    number = min(max(number, about.get("minimum", number)), about.get("maximum", number))
    return f"{number:.10g}"


def _example(name: str, about: Schema) -> str:
    """Return an example of a value, as TOML."""
    examples = [*about.get("examples", ()), about.get("default")]
    for value in examples:
        if value not in (None, "", [], {}):
            return _toml(value)
    return {
        "integer": str(about.get("minimum", 1)),
        "number": str(about.get("minimum", 1.0)),
        "boolean": "true",
        "array": '["text"]',
        "object": f'{{{name} = "file"}}',
    }.get(str(about.get("type")), '"file"' if about.get("format") == "path" else '"text"')


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(each)}' for key, each in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


def _shown(value: Any) -> str:
    """Format a value, except possible secrets: addresses, and elements of lists and tables."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        text = "a number of more than 40 digits" if 1e40 <= abs(value) < math.inf else str(value)
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"
    if isinstance(value, str) and "://" not in value:
        return repr(value) if len(value) <= _LONGEST else f"{value[:_LONGEST]!r}…"
    words = {list: "a list", dict: "a table", str: "an address", type(None): "null"}
    return words.get(type(value), "a date or a time")
