"""How Sphinx makes a site of these pages: ``make docs``."""

import re
from typing import Any

import nlights_core

project = "nLights"
version = release = nlights_core.__version__
extensions = ["myst_parser"]
root_doc = "README"
html_theme = "alabaster"
html_theme_options = {"page_width": "60rem", "sidebar_width": "15rem", "fixed_sidebar": True}
myst_heading_anchors = 3
exclude_patterns = ["build"]


def _list_pages(app: Any, name: str, source: list[str]) -> None:
    """Make the list of pages, which people read, the table of contents too."""
    if name == root_doc:
        pages = re.findall(r"^ *- \[[^]]*\]\(([\w/-]+)\.md\)", source[0], flags=re.MULTILINE)
        source[0] += "\n".join(["\n```{toctree}", ":hidden:", "", *pages, "```\n"])


def setup(app: Any) -> None:
    """Tell Sphinx."""
    app.connect("source-read", _list_pages)
