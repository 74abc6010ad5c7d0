"""HTML that needs nothing else, and prints: the template `page.html`, filled."""

import base64
from collections.abc import Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2


class Cell(NamedTuple):
    """A cell of a table: a colour before its text, a change behind it; `whole` is one line."""

    text: str
    change: str = ""
    colour: tuple[int, int, int] | None = None
    whole: bool = False


class TableRow(NamedTuple):
    """A row of a table, whose first cell is its head."""

    cells: Sequence[Cell]
    kind: str = ""


class PageTable(NamedTuple):
    """A table and its class in the style."""

    heads: Sequence[str]
    rows: Sequence[TableRow]
    kind: str = ""


def fill_page(picture: bytes, **parts: Any) -> str:
    """Fill the template; all text is escaped, and the picture is in the page itself.

    Parameters
    ----------
    **parts
        By the names that the template has for them; none may be lacking.
    """
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    template = files("hearthlog.analyzer.report").joinpath("page.html").read_text("utf-8")
    return environment.from_string(template).render(
        picture=base64.b64encode(picture).decode(), **parts
    )
