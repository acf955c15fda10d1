"""Distributions of new plugins, written from templates: pyproject, algorithm, contract test, recipe, README."""

from __future__ import annotations

import importlib.util
import keyword
import re
from importlib import metadata
from pathlib import Path

import nlights_core
from nlights_core import algorithms, capture, errors, fields, frames
from nlights_core.algorithms import KINDS
from nlights_core.errors import PluginError
from nlights_core.registry import installed
from nlights_core.store import draft

TEMPLATES = Path(__file__).parent / "template"

NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def begin(name: str, kind: str, out: Path) -> Path:
    """Write a new plugin's distribution; it appears whole or not at all.

    Parameters
    ----------
    name : str
        What recipes will call the algorithm.
    kind : str
        Of ``light-model``, ``image-detrend``, ``normal-solver``, ``normal-detrend``, ``integrator``
        and ``height-detrend``.
    out : Path
        The distribution's folder ``nlights-<name>`` is made in it.

    Returns
    -------
    Path
        That folder.

    Raises
    ------
    PluginError
        When the name is no name, or taken, or the folder is there already.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    words = _words(name, kind)
    folder = out / words["distribution"]
    if folder.exists():
        raise PluginError(f"{folder}: is there already and is left as it is; choose another name or --out")
    # autoescape is for HTML; these are Python, TOML, YAML and Markdown, made of checked words.
    templates = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
    )
    files = {
        "pyproject.toml": "pyproject.toml.j2",
        "README.md": "README.md.j2",
        "recipe.yaml": "recipe.yaml.j2",
        f"{words['module']}.py": f"{kind}.py.j2",
        f"test_{words['module']}.py": "test.py.j2",
    }
    out.mkdir(parents=True, exist_ok=True)
    with draft(out) as place:
        place.mkdir()
        for file, template in files.items():
            (place / file).write_text(templates.get_template(template).render(words), encoding="utf-8")
        place.rename(folder)
    return folder


def _words(name: str, kind: str) -> dict[str, str]:
    """Words of the templates, once it is known that nothing is called so yet."""
    if not NAME.fullmatch(name) or len(name) > 60:
        raise PluginError(
            f"'{name}' is no name of an algorithm; use lower-case words with hyphens between them, as "
            "line-integrals"
        )
    class_name = "".join(word.capitalize() for word in name.split("-"))
    base = "".join(word.capitalize() for word in kind.split("-"))
    words = {
        "name": name,
        "kind": kind,
        "slot": next(k.slot for k in KINDS if k.__name__ == base),
        "base": base,
        "class_name": class_name,
        "distribution": f"nlights-{name}",
        "module": f"nlights_{name.replace('-', '_')}",
        "version": ".".join(nlights_core.__version__.split(".")[:2]),
    }
    if keyword.iskeyword(class_name) or any(
        hasattr(module, class_name) for module in (algorithms, capture, errors, fields, frames)
    ):
        raise PluginError(
            f"'{name}': its class {class_name} would hide one of nLights' own; choose another name"
        )
    for offer in installed().offers():
        if offer.algorithm.name == name:
            raise PluginError(
                f"'{name}' is taken: {offer.origin} offers an algorithm for {offer.algorithm.slot} of that name; "
                "choose another"
            )
    if importlib.util.find_spec(words["module"]) or words["distribution"] in _distributions():
        raise PluginError(
            f"'{name}' is taken: {words['distribution']} is installed here; choose another name, or uninstall it"
        )
    return words


def _distributions() -> set[str]:
    names = (distribution.metadata["Name"] or "" for distribution in metadata.distributions())
    return {name.lower().replace("_", "-") for name in names}
