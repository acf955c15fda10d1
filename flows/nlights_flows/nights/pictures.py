"""Thumbnails of a night: small pictures of the albedo, made once and kept beside the nights."""

from __future__ import annotations

import base64
import io
import json
import uuid
from pathlib import Path

import numpy as np

from nlights_core.files.tiffs import read_tiff
from nlights_flows.nights.inbox import NIGHTS

LONGEST = 240
"""Longest side of a thumbnail, px."""

LARGEST = 30_000
"""Characters of a thumbnail as a data URI."""


def thumbnail(products: Path, out: Path, draw: bool = True) -> str:
    """A picture of a tile's albedo as a data URI of at most `LARGEST` characters.

    It is kept under the products' key, since reading the albedo of a hundred megapixels takes time.

    Parameters
    ----------
    products : Path
        The tile's.
    out : Path
        Beside whose nights pictures are kept.
    draw : bool
        Whether to draw one that is not there.

    Returns
    -------
    str
        Empty where there is none.
    """
    try:
        provenance = json.loads((products / "provenance.json").read_text(encoding="utf-8"))
        kept = out / NIGHTS / ".thumbnails" / f"{provenance['key'][:32]}.jpg"
        if not kept.is_file() and draw:
            kept.parent.mkdir(parents=True, exist_ok=True)
            draft = kept.with_name(f".{uuid.uuid4().hex[:8]}.jpg")
            draft.write_bytes(_drawn(products / "albedo_view.tif"))
            draft.replace(kept)
        found = "data:image/jpeg;base64," + base64.b64encode(kept.read_bytes()).decode()
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    return found if len(found) <= LARGEST else ""


def _drawn(albedo: Path) -> bytes:
    from PIL import Image

    pixels = read_tiff(albedo)
    # Every so many pixels are enough for a thumbnail, and a large file need not be read whole.
    step = max(1, max(pixels.shape[:2]) // (4 * LONGEST))
    view = np.asarray(pixels[::step, ::step] >> 8).astype(np.uint8)
    picture = Image.fromarray(view)
    picture.thumbnail((LONGEST, LONGEST), Image.Resampling.LANCZOS)
    for quality in (82, 65, 45, 25):
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=quality, optimize=True)
        if file.tell() < 0.74 * LARGEST:
            break
    return file.getvalue()
