"""Names of artworks: inventory numbers as museums write them, and the folders that are called after them."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path

from nlights_core.errors import CaptureError
from nlights_core.names.photographs import composed

LONGEST_NAME = 120
"""Bytes of a folder's name."""

PLAIN = re.compile(r"[\w .,()+-]")
"""A letter that a folder's name keeps as it is."""

RESERVED = frozenset(
    (
        *("nights", "night.json", "night.html", "flat-checks", "compare.json", "compare.html"),
        *("mosaic", ".former", ".store", ".scratch", ".claims", ".digests", ".thumbnails"),
    )
)
"""Names, in lower case, that nLights gives to folders and files of its own, in the products or in the store: no
artwork and no tile may have one."""

_OF_WINDOWS = re.compile(
    r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$) *(\..*)?", re.IGNORECASE
)
"""Names that no folder of Windows can have, with any extension."""


def folder_of(artwork: str) -> str:
    """Name of the folder of an artwork: plain letters stay, every other byte of the UTF-8 name becomes ``%XX``.

    `urllib.parse.unquote` gives the number back.

    Parameters
    ----------
    artwork : str
        Inventory number.

    Examples
    --------
    >>> folder_of("MS. Bodl. 264/3"), folder_of("D'Arpino 3"), folder_of("100 %"), folder_of("inv-1785-012")
    ('MS. Bodl. 264%2F3', 'D%27Arpino 3', '100 %25', 'inv-1785-012')
    >>> folder_of("..", ), folder_of("Inv. "), folder_of("CON")
    ('%2E%2E', 'Inv.%20', '%43ON')
    """
    letters = list(composed(artwork))
    last = len(letters) - 1
    hidden = {0} if letters and (letters[0] in ". " or _OF_WINDOWS.fullmatch(composed(artwork))) else set()
    # Windows cuts off what ends in a dot or a space.
    cut = {last} if letters and letters[-1] in ". " else set()
    return "".join(
        letter if PLAIN.fullmatch(letter) and i not in hidden | cut else _bytes(letter)
        for i, letter in enumerate(letters)
    )


def is_reserved(name: str) -> bool:
    """Test whether a name is that of a folder or file of nLights' own.

    Examples
    --------
    >>> is_reserved("Nights"), is_reserved("nights 2")
    (True, False)
    """
    return composed(name).strip().casefold() in RESERVED


def fault_of(artwork: str) -> str | None:
    """Fault of an inventory number, as the rest of a sentence; None where it has none."""
    if not artwork.strip():
        return "is empty; write the inventory number"
    if is_reserved(artwork):
        return f"'{artwork}' is the name of a folder or file of nLights' own; write another, such as 'inv. {artwork}'"
    bad = next((letter for letter in artwork if unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp")), "")
    if bad:
        return f"holds U+{ord(bad):04X}, which is no letter but a control character; remove it"
    size = len(folder_of(artwork).encode())
    if size > LONGEST_NAME:
        return f"names a folder of {size} bytes, {folder_of(artwork)[:40]}...; {LONGEST_NAME} are allowed; shorten it"
    return None


def require_own_folder(artwork: str, out: Path) -> None:
    """Refuse an inventory number whose folder is nLights' own, or another's of the same products but for capitals.

    Parameters
    ----------
    artwork : str
        Inventory number.
    out : Path
        Folder of all products, which need not exist.

    Raises
    ------
    CaptureError
        Naming the folder that is there.
    """
    if is_reserved(artwork):
        raise CaptureError(f"artwork.id: {fault_of(artwork)}")
    own = folder_of(artwork)
    try:
        names = [path.name for path in out.iterdir()]
    except OSError:
        return
    for name in names:
        if composed(name) != own and composed(name).casefold() == own.casefold():
            raise CaptureError(
                f"artwork.id: '{artwork}' and the folder {out / name} differ by capitals only, and many disks take "
                "them for one; write the number as before, or choose another --out"
            )


def _bytes(letter: str) -> str:
    return "".join(f"%{byte:02X}" for byte in letter.encode())
