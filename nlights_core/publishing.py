"""Publishing: a tile's products appear whole, where people look for them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from nlights_core.capture import Tile
from nlights_core.products import WHAT
from nlights_core.store import ArtefactRef, Store, draft_name, link_or_copy, sweep


def publish(store: Store, tile: Tile, refs: Mapping[str, ArtefactRef], out: Path) -> Path:
    """Put a tile's products where people look for them: ``out/<artwork>/<tile>/``.

    The folder appears whole.  Files are hard links into the store where the file system allows
    (so that they take no second place; they are read-only for that reason), copies otherwise.
    What people added to the folder is kept, but an evaluation of other products is not.

    Parameters
    ----------
    store : Store
    tile : Tile
    refs : mapping
        The artefacts "maps", "mesh" and "report".
    out : Path
        Folder of all products.

    Returns
    -------
    Path
        The tile's folder.
    """
    target = out / tile.artwork / tile.name
    former = target.parent / f".former-{tile.name}"
    sweep(target.parent)
    if former.is_dir():  # a run was killed between two renames: what was there before comes back
        if not target.exists():
            former.rename(target)
        shutil.rmtree(former, ignore_errors=True)
    files = [
        path
        for name in ("maps", "mesh", "report")
        for path in sorted(store.path(refs[name]).iterdir())
        if path.name in WHAT
    ]
    if _published(target, refs["report"], files):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.parent / draft_name()
    draft.mkdir()
    try:
        for path in files:
            path.chmod(0o444)
            link_or_copy(path, draft / path.name)
        if target.is_dir():
            for path in target.iterdir():
                if path.name not in WHAT and path.name != "evaluation.json":
                    _copy(path, draft / path.name)
            target.rename(former)
        draft.rename(target)
        shutil.rmtree(former, ignore_errors=True)
    except OSError:
        if not _published(target, refs["report"], files):  # else another run was faster
            raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):  # the artwork's folder, where nothing could be put into it
            target.parent.rmdir()
    return target


def _published(target: Path, report: ArtefactRef, files: list[Path]) -> bool:
    try:
        provenance = json.loads((target / "provenance.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return provenance.get("key") == report.key and all((target / path.name).exists() for path in files)


def _copy(source: Path, target: Path) -> None:
    """Copy what people added, a file or a folder; the original stays until all is in place."""
    if source.is_dir():
        shutil.copytree(source, target, symlinks=True)
    else:
        shutil.copy2(source, target, follow_symlinks=False)
