"""Sources: digests of the code that a result, or a compiled loop, rests on."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

CORE = Path(__file__).parents[1]
"""The folder of the core."""

_IMPORT = re.compile(r"^\s*from (nlights_core[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)

EVERYTHING_RESTS_ON = (
    "algorithms",
    "capture",
    "capture_warnings",
    "contracts",
    "fields",
    "files",
    "frames",
    "machine",
    "memory",
    "registry",
    "stands",
    "stages.inputs",
    "store",
)
"""Nouns and departments whose code is behind every artefact.

Left out: `errors` holds only sentences; `manifest`, `recipe` and `configurations` read what people write, and
what they found is in an artefact's key itself.
"""


def digests_of_places(places: Iterable[str]) -> dict[str, str]:
    """Digest the code of some places, each on its own, so that it can be said which of them changed.

    Parameters
    ----------
    places : iterable of str
        Modules or departments of the core, as ``"frames"``, ``"solving"`` or ``"stages.maps"``.

    Returns
    -------
    dict
        By place, sorted.  sha256 of the names and contents of all its files, 16 hexadecimal digits.

    Examples
    --------
    >>> list(digests_of_places(("solving", "frames", "solving")))
    ['frames', 'solving']
    """
    return {place: _digest_of_place(place, CORE) for place in sorted(set(places))}


@cache
def core_digest() -> str:
    """Digest all code of the core: whether two machines have the same."""
    return digest_of_files(files_below(CORE), CORE)


@cache
def _digest_of_place(place: str, core: Path) -> str:
    path = core.joinpath(*place.split("."))
    module = path.with_suffix(".py")
    return digest_of_files([module] if module.is_file() else files_below(path), core)


def reached_files(modules: Iterable[str]) -> list[Path]:
    """Find the files of modules of the core and of all that they import from it, in any depth.

    Parameters
    ----------
    modules : iterable of str
        As ``"nlights_core.solving.compiled_fits"``.

    Returns
    -------
    list of Path
        Imports within functions and for types only are followed too.
    """
    found: dict[str, Path] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        path = CORE.joinpath(*name.split(".")[1:]).with_suffix(".py")
        if name in found or not path.is_file():
            continue
        found[name] = path
        for module, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
            waiting += [module, *(f"{module}.{word}" for word in re.findall(r"\w+", names))]
    return sorted(found.values())


def files_below(folder: Path) -> list[Path]:
    """List the files of a package, in any depth, but for hidden ones and what Python makes of them."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return [path for path in found if not any(_is_made(part) for part in path.relative_to(folder).parts)]


def _is_made(name: str) -> bool:
    return name == "__pycache__" or name.startswith(".")


def digest_of_files(paths: Iterable[Path], base: Path) -> str:
    """Digest the names, relative to a folder, and the contents of files: sha256, 16 hexadecimal digits.

    Raises
    ------
    ValueError
        When there is no file at all: a digest of nothing would never change.
    """
    found = sorted((path.relative_to(base).as_posix(), path) for path in paths)
    if not found:
        raise ValueError(f"{base}: no files to digest")
    digest = hashlib.sha256()
    for name, path in found:
        content = path.read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]
