"""ELAN codec: one tier per microphone and reviewer, with dependent tiers for other mark fields.

Times in ELAN are whole milliseconds.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl, InputSource, Locator

from defusedxml.common import DefusedXmlException
from defusedxml.sax import parse

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.layers import Coverage
from hearthlog.analyzer.marks.formats.labels import (
    WRONG_TIME,
    Choice,
    FileLabel,
    LabelCodec,
    LineError,
    made_text,
    scan,
)
from hearthlog.analyzer.marks.marks import Mark
from hearthlog.schemas.errors import listed
from hearthlog.schemas.frames import seconds_text, time_text

_MILLISECOND = 1_000_000  # ns
_START = "hearthlog:start"  # property with the start time of the document
_MARKS = "marks"  # tier type, as are the names in `_ORIGIN`
_ORIGIN = ("made", "corrects")
_DEEPEST = 20  # maximum nesting of elements; ELAN has 5
_ENDLESS = re.compile(r"<[^<>]{65536}")  # a tag that would keep the parser busy for minutes
_SCHEMA = "http://www.mpi.nl/tools/elan/EAFv3.0.xsd"
_INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"
_NO_XML = dict.fromkeys((*range(0xD800, 0xE000), 0xFFFE, 0xFFFF), "\N{REPLACEMENT CHARACTER}")


class _Annotation(NamedTuple):
    line: int
    tier: Mapping[str, str]
    start: str  # time slot
    end: str
    label: str


class _Wrong(Exception):  # noqa: N818
    """Well-formed XML that is no ELAN document."""


class _Document(ContentHandler):
    """Collects the times and labels of the chosen tiers, by default of the top tiers."""

    def __init__(self, chosen: Sequence[str]) -> None:
        super().__init__()
        self._chosen = chosen
        self.tiers: list[str] = []
        self.start = ""
        self.annotations: dict[str, _Annotation] = {}
        self.origins: dict[str, dict[str, str]] = {kind: {} for kind in _ORIGIN}
        self.slots: dict[str, str] = {}
        self._locator: Locator | None = None
        self._depth = 0
        self._tier: dict[str, str] = {}
        self._open: dict[str, str] = {}  # current annotation or property
        self._line = 0
        self._text: list[str] = []

    @property
    def line(self) -> int:
        """Current line number."""
        return (self._locator.getLineNumber() if self._locator else None) or 1

    def setDocumentLocator(self, locator: Locator) -> None:  # noqa: N802
        """Store the locator, for line numbers."""
        self._locator = locator

    def startElement(self, name: str, attrs: AttributesImpl) -> None:  # noqa: N802
        """Read the attributes of an element."""
        self._depth += 1
        given = dict(attrs.items())
        if (self._depth == 1 and name != "ANNOTATION_DOCUMENT") or self._depth > _DEEPEST:
            raise _Wrong("is no document of ELAN")
        if name == "HEADER" and given.get("TIME_UNITS", "milliseconds") != "milliseconds":
            raise _Wrong("has times that are no milliseconds; save it with a newer ELAN")
        if name == "MEDIA_DESCRIPTOR" and given.get("TIME_ORIGIN", "0") != "0":
            raise _Wrong("has an offset of the recording; set it to 0 in ELAN")
        if name == "TIME_SLOT":
            self.slots[given.get("TIME_SLOT_ID", "")] = given.get("TIME_VALUE", "")
        elif name == "TIER":
            self._tier = given
            self.tiers.append(given.get("TIER_ID", ""))
        elif name in {"ALIGNABLE_ANNOTATION", "REF_ANNOTATION", "PROPERTY"}:
            self._open, self._line = given, self.line
            self._text.clear()

    def characters(self, content: str) -> None:
        """Append a piece of text."""
        if self._open:
            self._text.append(content)

    def endElement(self, name: str) -> None:  # noqa: N802
        """Store a complete annotation or property."""
        self._depth -= 1
        depends = "PARENT_REF" in self._tier
        text = "".join(self._text).strip()
        if name == "PROPERTY" and self._open.get("NAME") == _START:
            self.start = text
        elif name == "ALIGNABLE_ANNOTATION" and self._is_read():
            start, end = (self._open.get(f"TIME_SLOT_REF{i}", "") for i in (1, 2))
            identity = self._open.get("ANNOTATION_ID", f"line {self._line}")
            self.annotations[identity] = _Annotation(self._line, self._tier, start, end, text)
        elif name == "REF_ANNOTATION" and depends:
            kind = self._tier.get("LINGUISTIC_TYPE_REF", "")
            self.origins.get(kind, {})[self._open.get("ANNOTATION_REF", "")] = text
        if name in {"ALIGNABLE_ANNOTATION", "REF_ANNOTATION", "PROPERTY"}:
            self._open = {}
            self._text.clear()

    def _is_read(self) -> bool:
        if self._chosen:
            return self._tier.get("TIER_ID") in self._chosen
        return "PARENT_REF" not in self._tier


def read(path: Path, text: str, choice: Choice) -> Iterator[FileLabel | LineError]:
    """Yield the time-aligned annotations of the chosen tiers, by default of the top tiers.

    Raise `DataError` if the text is not XML, declares a DTD, is no ELAN document, has times
    in another unit or a recording with an offset, or lacks a chosen tier.
    """
    document = _Document(choice.tiers)
    endless = _ENDLESS.search(text)
    if endless is not None:
        line = text.count("\n", 0, endless.start()) + 1
        raise DataError(f"{path}:{line}: is no document of ELAN")
    try:
        source = InputSource()
        source.setCharacterStream(StringIO(text))  # decoded, so declarations are ignored
        parse(source, document, forbid_dtd=True)
    except SAXParseException as error:
        line = error.getLineNumber() or 1
        raise DataError(f"{path}:{line}: is not XML ({error.getMessage()})") from error
    except DefusedXmlException as error:
        raise DataError(f"{path}:{document.line}: declares a DTD, as ELAN never does") from error
    except _Wrong as error:
        raise DataError(f"{path}:{document.line}: {error}") from error
    unknown = [name for name in choice.tiers if name not in document.tiers]
    if unknown:
        names = listed([repr(name[:64]) for name in document.tiers[:20]])
        raise DataError(f"{path}: no tier {unknown[0][:64]!r}; there is {names or 'none'}")

    def label(where: str, entry: tuple[str, _Annotation]) -> FileLabel:
        identity, each = entry
        start, end = (_seconds(where, each, document.slots.get(s)) for s in (each.start, each.end))
        return FileLabel(
            start,
            end,
            each.label,
            microphone=each.tier.get("PARTICIPANT", ""),
            reviewer=each.tier.get("ANNOTATOR", ""),
            **{kind: texts.get(identity, "") for kind, texts in document.origins.items()},
            zero=document.start,
        )

    yield from scan(path, ((each[1].line, each) for each in document.annotations.items()), label)


def _seconds(where: str, annotation: _Annotation, milliseconds: str | None) -> str:
    if not milliseconds:
        reason = f"{annotation.label[:64]!r} has no time; align it in ELAN"
        raise LineError(where, "label without a time", reason)
    if not (milliseconds.isascii() and milliseconds.isdecimal() and len(milliseconds) < 16):
        reason = f"{milliseconds[:64]!r} is no number of milliseconds"
        raise LineError(where, WRONG_TIME, reason)
    return seconds_text(int(milliseconds) * _MILLISECOND)


def write(path: Path, marks: Sequence[Mark], coverage: Mapping[str, Coverage]) -> str:  # noqa: ARG001
    """Return an ELAN document with times, in whole ms, since the first frame of any microphone.

    There is at least one mark.
    """
    marks = [mark._replace(reviewer=mark.reviewer.translate(_NO_XML)) for mark in marks]
    zero = min(coverage[mark.microphone].starts[0] for mark in marks)
    root = ET.Element(
        "ANNOTATION_DOCUMENT",
        {
            "AUTHOR": "hearthlog",
            "DATE": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
            "FORMAT": "3.0",
            "VERSION": "3.0",
            "xmlns:xsi": _INSTANCE,
            "xsi:noNamespaceSchemaLocation": _SCHEMA,
        },
    )
    header = ET.SubElement(root, "HEADER", MEDIA_FILE="", TIME_UNITS="milliseconds")
    ET.SubElement(header, "PROPERTY", NAME=_START).text = time_text(zero)
    spans = _in_milliseconds(marks, zero)
    _add_slots(root, spans)
    kinds = _add_tiers(root, marks)
    _add_types(root, kinds)
    ET.indent(root, "")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, "unicode") + "\n"


def _in_milliseconds(marks: Sequence[Mark], zero: int) -> list[tuple[int, int]]:
    """Round spans to milliseconds, without empty spans or overlaps within a microphone."""
    spans = [(0, 0)] * len(marks)
    last: dict[str, int] = {}
    for i in sorted(range(len(marks)), key=marks.__getitem__):
        mark = marks[i]
        start, end = (
            (time - zero + _MILLISECOND // 2) // _MILLISECOND for time in (mark.start, mark.end)
        )
        start = max(start, last.get(mark.microphone, 0))
        last[mark.microphone] = end = max(end, start + 1)
        spans[i] = start, end
    return spans


def _add_slots(root: ET.Element, spans: Sequence[tuple[int, int]]) -> None:
    """Add the time slots, two for each annotation, in order of time."""
    order = ET.SubElement(root, "TIME_ORDER")
    slots = [(start, f"ts{2 * i}") for i, (start, _) in enumerate(spans, 1)]
    slots += [(end, f"ts{2 * i + 1}") for i, (_, end) in enumerate(spans, 1)]
    for time, name in sorted(slots, key=lambda slot: slot[0]):
        ET.SubElement(order, "TIME_SLOT", TIME_SLOT_ID=name, TIME_VALUE=str(time))


def _add_tiers(root: ET.Element, marks: Sequence[Mark]) -> list[str]:
    """Add the tiers; return the types of the dependent ones."""
    kinds: list[str] = []
    identity = len(marks)
    for microphone, reviewer in sorted({(mark.microphone, mark.reviewer) for mark in marks}):
        own = {
            i: mark
            for i, mark in enumerate(marks, 1)
            if (mark.microphone, mark.reviewer) == (microphone, reviewer)
        }
        name = f"{microphone}@{reviewer}" if reviewer else microphone
        who = {"PARTICIPANT": microphone, "ANNOTATOR": reviewer}
        tier = ET.SubElement(root, "TIER", who, TIER_ID=name, LINGUISTIC_TYPE_REF=_MARKS)
        for i, mark in own.items():
            slots = {"TIME_SLOT_REF1": f"ts{2 * i}", "TIME_SLOT_REF2": f"ts{2 * i + 1}"}
            _add(tier, "ALIGNABLE_ANNOTATION", slots | {"ANNOTATION_ID": f"a{i}"}, mark.label)
        for kind in _ORIGIN:
            texts = {i: made_text(m) if kind == "made" else m.corrects for i, m in own.items()}
            if not any(texts.values()):
                continue
            kinds.append(kind)
            below = {"TIER_ID": f"{kind}: {name}", "PARENT_REF": name, "LINGUISTIC_TYPE_REF": kind}
            tier = ET.SubElement(root, "TIER", who | below)
            for i, text in texts.items():
                if text:
                    identity += 1
                    ids = {"ANNOTATION_ID": f"a{identity}", "ANNOTATION_REF": f"a{i}"}
                    _add(tier, "REF_ANNOTATION", ids, text.translate(_NO_XML))
    return sorted(set(kinds))


def _add(tier: ET.Element, kind: str, attributes: dict[str, str], text: str) -> None:
    annotation = ET.SubElement(ET.SubElement(tier, "ANNOTATION"), kind, attributes)
    ET.SubElement(annotation, "ANNOTATION_VALUE").text = text


def _add_types(root: ET.Element, kinds: Sequence[str]) -> None:
    """Add the types of tiers, and their constraint."""
    top = {"LINGUISTIC_TYPE_ID": _MARKS, "TIME_ALIGNABLE": "true", "GRAPHIC_REFERENCES": "false"}
    ET.SubElement(root, "LINGUISTIC_TYPE", top)
    for kind in kinds:
        own = {"LINGUISTIC_TYPE_ID": kind, "TIME_ALIGNABLE": "false"}
        ET.SubElement(root, "LINGUISTIC_TYPE", top | own, CONSTRAINTS="Symbolic_Association")
    ET.SubElement(
        root,
        "CONSTRAINT",
        DESCRIPTION="1-1 association with a parent annotation",
        STEREOTYPE="Symbolic_Association",
    )


CODECS: Mapping[str, LabelCodec] = {
    "ELAN": LabelCodec(read, write),
}
