"""Pages of a TIFF: which of them is the photograph."""

from __future__ import annotations

from itertools import islice

import tifffile

MOST_PAGES = 100
"""Of a file, and of the images within a page, that are looked at: a file can hold millions, of nothing."""

_REDUCED, _MASK = 1, 4
"""Bits of NewSubfileType (TIFF 6.0), to which tifffile turns the older SubfileType."""


def full_pages(file: tifffile.TiffFile) -> list[tuple[str, tifffile.TiffPage]]:
    """Pages that are no reduced image and no transparency mask, the one to read first.

    That is the first of the largest: programs that do not mark a thumbnail still make it smaller.
    Images that lie in another page (SubIFDs, where pyramids are) are asked only where all pages
    are reduced, as in a file that is laid out like a DNG.

    Returns
    -------
    list of (str, TiffPage)
        What to call the page, and the page; never empty: of a file in which everything is
        marked as reduced, the largest.

    Raises
    ------
    Exception
        Whatever tifffile says of a damaged file.
    """
    pages = [(f"page {i}", page.aspage()) for i, page in enumerate(islice(file.pages, MOST_PAGES), 1)]
    inner = [
        (f"image {i} in {name}", sub.aspage())
        for name, page in pages
        for i, sub in enumerate(islice(page.pages or (), MOST_PAGES), 1)
    ]
    full = (
        [one for one in pages if _is_full(one[1])]
        or [one for one in inner if _is_full(one[1])]
        or max(([one] for one in pages), key=lambda found: _size(found[0][1]))
    )
    return sorted(full, key=lambda one: -_size(one[1]))


def _is_full(page: tifffile.TiffPage) -> bool:
    return not page.subfiletype & (_REDUCED | _MASK)


def _size(page: tifffile.TiffPage) -> int:
    return page.imagewidth * page.imagelength


def described(pages: list[tuple[str, tifffile.TiffPage]]) -> tuple[str, ...]:
    """Names and sizes of pages, where there is more than one."""
    names = tuple(f"{name} ({page.imagewidth} x {page.imagelength} px)" for name, page in pages)
    return names if len(names) > 1 else ()
