"""The documentation site: these pages, and the public API from its docstrings."""

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
napoleon_use_ivar = True
autodoc_typehints = "none"  # the Parameters say them
autodoc_member_order = "bysource"


def _outside(_app: Any, _env: Any, node: Any, content: Any) -> Any:
    """Make text of links to what lies outside of this folder: they lead on in the repository."""
    target = node.get("reftarget", "")
    is_beside = target.startswith("../") and (Path(__file__).parent / target).exists()
    return content if is_beside else None


def setup(app: Any) -> None:
    """Connect what is here with Sphinx."""
    app.connect("missing-reference", _outside)
