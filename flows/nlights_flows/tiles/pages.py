"""Pages: how the templates of the flows' HTML pages are filled in."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import jinja2


@cache  # a night fills its page in again and again
def template(path: Path) -> jinja2.Template:
    """Open a page's template, a file beside its module: what is put in is escaped, and what it lacks is a fault."""
    import jinja2

    from nlights_core.names.control_characters import shown_escaped

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent),
        autoescape=True,
        finalize=shown_escaped,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(path.name)
