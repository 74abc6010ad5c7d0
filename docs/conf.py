"""The documentation site: these pages, and the public API from its docstrings."""

import re
from pathlib import Path
from typing import Any

import hearthlog

project = "hearthlog"
release = hearthlog.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["conf.py"]
html_theme = "alabaster"  # of Sphinx itself; fetches nothing from anywhere
html_theme_options = {"fixed_sidebar": True, "page_width": "75em"}
html_show_copyright = False
html_copy_source = False
myst_heading_anchors = 4
napoleon_custom_sections = [("Attributes", "params_style")]  # which may have `start, end : int`
autodoc_typehints = "none"  # the Parameters say them
autodoc_member_order = "bysource"


def _unlink(_app: Any, _name: str, source: list[str]) -> None:
    """Make text of links to what lies beside this folder, as it is not part of the site."""

    def text(link: re.Match[str]) -> str:
        return link[1] if (Path(__file__).parent / link[2]).exists() else link[0]

    source[0] = re.sub(r"\[([^\]]+)\]\((\.\./[^)]+)\)", text, source[0])


def setup(app: Any) -> None:
    """Connect what is here with Sphinx."""
    app.connect("source-read", _unlink)
