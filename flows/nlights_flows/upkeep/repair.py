"""Repair: products that were damaged, from whole artefacts that the store still has."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from nlights_core.files.content_digests import digest_of_file
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.products.writing import PROVENANCE, WHAT
from nlights_core.store import RECORD, draft
from nlights_core.store.drafts import discard
from nlights_core.store.records import read_sealed
from nlights_core.store.whole_files import flush, give_out
from nlights_flows.tiles.inventory import place_of


def restore(products: Path, damaged: Iterable[str], store: Path, rotten: Collection[Path]) -> list[str]:
    """Bring damaged products of a tile back from whole artefacts.

    Parameters
    ----------
    products : Path
        The tile's folder.
    damaged : iterable of str
        Names of its files.
    store : Path
        Root of the store.
    rotten : collection of Path
        Artefacts that are damaged themselves.

    Returns
    -------
    list of str
        Names of the files that are what was written again.
    """
    report = report_of(products, store)
    if report is None or report in rotten:
        return []
    wanted = {*damaged}
    if PROVENANCE in wanted:  # so that nobody knew what the others should be
        wanted |= WHAT.keys()
    restored = []
    for source, digest in _sources(report, store, rotten):
        target = products / source.name
        if source.name in wanted and not _is(target, digest) and _is(source, digest):
            _put(source, target)
            restored.append(source.name)
    return restored


def report_of(products: Path, store: Path) -> Path | None:
    """Artefact of the report that belongs to some products; None where the store has none, or nobody can tell."""
    artwork, tile = place_of(products)
    found = store / artwork / tile
    with suppress(OSError, ValueError):
        return found / f"report-{read_sealed(products / PROVENANCE)['key'][:12]}"
    alike = [report for report in sorted(found.glob("report-*")) if _is_alike(report, products)]
    return alike[0] if len(alike) == 1 else None


def _is_alike(report: Path, products: Path) -> bool:
    """Test whether the report, or its numbers, that some products have are an artefact's."""
    with suppress(OSError, ValueError):
        files = read_sealed(report / RECORD)["files"]
        return any(_is(products / name, files[name]["xxh3"]) for name in ("report.html", "quality.json"))
    return False


def _sources(report: Path, store: Path, rotten: Collection[Path]) -> Iterator[tuple[Path, str]]:
    """Files of artefacts that are products, with their digests; as many as can be told."""
    folders = [report]
    with suppress(OSError, ValueError):
        inputs: dict[str, Any] = read_sealed(report / RECORD)["input_folders"]
        folders += [store / inputs[name] for name in ("maps", "mesh")]
    for folder in folders:
        if folder not in rotten:
            with suppress(OSError, ValueError):
                for name, said in read_sealed(folder / RECORD)["files"].items():
                    if name in WHAT:
                        yield folder / name, said["xxh3"]


def _is(path: Path, digest: str) -> bool:
    try:
        return not irregular_kind(path) and digest_of_file(path) == digest
    except OSError:
        return False


def _put(source: Path, target: Path) -> None:
    """Put a file in another's place, or in that of whatever stands there."""
    with draft(target.parent) as place:
        give_out(source, place)
        if target.is_dir() and not target.is_symlink():
            discard(target)
        place.replace(target)
    flush(target.parent)
