"""HTML that needs nothing else, and prints."""

import base64
from collections.abc import Iterable, Sequence
from html import escape
from string import Template

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
$style
</style>
</head>
<body>
$body
</body>
</html>
""")
_STYLE = """
@page { size: A4; margin: 14mm 13mm; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 3rem; max-width: 56rem; color: #1d2733;
  background: #fff; font: 1rem/1.5 "Helvetica Neue", Helvetica, Arial, "DejaVu Sans", sans-serif; }
h1 { margin: 0; font-size: 1.9rem; line-height: 1.2; }
h2 { margin: 2.2rem 0 .5rem; font-size: 1.2rem; break-after: avoid; }
p { margin: .4rem 0; }
header p, .note { color: #4a5666; }
.note { font-size: .88rem; max-width: 46rem; }
.gist { margin: 1.2rem 0; padding: .8rem 1.2rem; border-left: 6px solid #2f5d8a;
  background: #f1f5f9; }
.alert { margin: 1.2rem 0; padding: .8rem 1.2rem; border: 2px solid #a33; background: #fdf3f2; }
.gist p, .alert p { margin: .3rem 0; font-size: 1.08rem; }
.alert p.more { font-size: .95rem; }
figure { margin: 1.2rem 0; break-inside: avoid; }
figure img { width: 100%; height: auto; display: block; }
figcaption { font-size: .88rem; color: #4a5666; }
table { width: 100%; border-collapse: collapse; font-variant-numeric: tabular-nums;
  font-size: .95rem; }
th, td { padding: .35rem .6rem; text-align: left; vertical-align: top;
  border-bottom: 1px solid #d5dbe2; }
thead th { border-bottom: 2px solid #1d2733; font-size: .85rem; vertical-align: bottom; }
tbody th { font-weight: normal; }
table, tr { break-inside: avoid; }
tr.sum th, tr.sum td { font-weight: 600; border-top: 2px solid #1d2733; border-bottom: none; }
tr.usual th, tr.usual td { color: #4a5666; border-bottom: none; }
table.wide { font-size: .82rem; }
table.wide th, table.wide td { padding: .3rem .35rem; }
.swatch { display: inline-block; width: .8em; height: .8em; margin-right: .5em;
  border: 1px solid #1d2733; }
.differs { font-weight: 700; }
.unit { white-space: nowrap; }
h2 + .note { break-after: avoid; }
table + p, p.note:last-child { break-before: avoid; }
footer { margin-top: 2.5rem; padding-top: .8rem; border-top: 2px solid #1d2733; }
table.wide th:first-child { white-space: nowrap; }
@media print { html { font-size: 9.5pt; } body { padding: 0; max-width: none; line-height: 1.4; }
  h2 { margin-top: 1.5rem; } th, td { padding: .22rem .5rem; } .note { max-width: none; }
  .gist, .alert, figure { margin: .8rem 0; } h2 + .note { break-after: avoid; }
table + p, p.note:last-child { break-before: avoid; }
footer { margin-top: 1.5rem; break-inside: avoid; }
  * { -webkit-print-color-adjust: exact; print-color-adjust: exact; } }
"""


def page(title: str, body: Iterable[str]) -> str:
    """Put a page together; the title is text, the body HTML."""
    lines = "\n".join(line for line in body if line)
    return _PAGE.substitute(title=escape(title), style=_STYLE.strip(), body=lines)


def paragraph(text: str, kind: str = "") -> str:
    """Write a paragraph of text; nothing if there is none."""
    if not text:
        return ""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def heading(text: str) -> str:
    """Begin a part of the page."""
    return f"<h2>{escape(text)}</h2>"


def box(kind: str, paragraphs: Sequence[str]) -> str:
    """Put paragraphs, HTML, in a box; nothing if there are none."""
    return "\n".join([f'<section class="{kind}">', *paragraphs, "</section>"]) if paragraphs else ""


def figure(picture: bytes, title: str, caption: str) -> str:
    """Put a PNG picture into the page itself."""
    data = base64.b64encode(picture).decode()
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{escape(title)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], kinds: Sequence[str] = (), kind: str = ""
) -> str:
    """Write a table; heads are text, cells HTML, kinds the classes of the last rows."""
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    lines = []
    rows = list(rows)
    for (first, *rest), row_kind in zip(
        rows, [""] * (len(rows) - len(kinds)) + [*kinds], strict=True
    ):
        cells = "".join(f"<td>{cell}</td>" for cell in rest)
        lines.append(f'<tr class="{row_kind}"><th scope="row">{first}</th>{cells}</tr>')
    body = "\n".join(lines).replace(' class=""', "")
    opening = f'<table class="{kind}">' if kind else "<table>"
    return f"{opening}\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"


def swatch(red: int, green: int, blue: int) -> str:
    """Show a colour."""
    return f'<span class="swatch" style="background: rgb({red}, {green}, {blue})"></span>'
