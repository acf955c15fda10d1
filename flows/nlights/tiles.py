"""Tiles: digitising from Python, and finished products as maps and numbers."""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nlights.calling import in_python, run_options, told_in_python
from nlights.maps import Map
from nlights_core.capture_warnings import FILE, CaptureWarning, read_warnings
from nlights_core.errors import CaptureError, TileError
from nlights_core.files.tiffs import Compression, read_tiff
from nlights_core.frames import PixelGrid
from nlights_core.recipe import RecipeLike
from nlights_core.report.figures import Number
from nlights_core.stands import Stand
from nlights_flows.tiles import direct
from nlights_flows.tiles.running import Outcome

if TYPE_CHECKING:
    import trimesh


class Numbers(dict[str, Number]):
    """The quality numbers of a tile by their names, in the report's order."""

    def __missing__(self, name: str) -> Number:
        near = difflib.get_close_matches(name, self, n=5, cutoff=0.4)
        raise KeyError(
            f"no number is called '{name}'; {'near are' if near else 'there are'} {near or list(self)}"
        )


@dataclass(frozen=True)
class TileResult:
    """A tile after it was digitised: what became of it, and its products.

    Attributes
    ----------
    artwork, tile : str
        Which.
    state : {"done", "unchanged", "failed"}
        Unchanged: nothing had to be computed.
    folder : Path or None
        The products; None where it failed.
    message : str
        Why it failed.
    seconds : float
        How long it took.
    notes : tuple of str
        Sentences about what was done and may not be expected.

    Notes
    -----
    Every other attribute raises `TileError` with the message where the tile failed.  Maps are read-only; uncompressed
    ones are mapped from their files, so that opening one costs nothing, whatever its size.
    """

    artwork: str
    tile: str
    state: Literal["done", "unchanged", "failed"]
    folder: Path | None = None
    message: str = ""
    seconds: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def failed(self) -> bool:
        """Failure: there are no products."""
        return self.state == "failed"

    @cached_property
    def height(self) -> Map:
        """z, (H, W) float32, in mm; in pixels where the scale is not known."""
        return self._map("height", self.grid.unit)

    @cached_property
    def normals(self) -> Map:
        """Unit normals x, y, z in the plane frame, (H, W, 3) float32."""
        return self._map("normals", "")

    @cached_property
    def albedo(self) -> Map:
        """Reflected share of the light, linear, (H, W) or (H, W, 3) float32; relative without a white reference."""
        return self._map("albedo", "")

    @cached_property
    def reflection(self) -> Map:
        """Apparent colour minus albedo, of the albedo's shape, float32, signed."""
        return self._map("reflection", "")

    @cached_property
    def height_uncertainty(self) -> Map | None:
        """Standard uncertainty of the height, (H, W) float32, in its unit; None: not measured."""
        present = self._path("height_uncertainty.tif").is_file()
        return self._map("height_uncertainty", self.grid.unit) if present else None

    @cached_property
    def confidence(self) -> Map:
        """Standard uncertainty of each normal, (H, W) float32, degrees: 68 % are off by no more."""
        return self._map("confidence", "°")

    @cached_property
    def trend(self) -> Map | None:
        """Trend removed from the height, in its unit, (H, W) float32; None where the recipe removes nothing."""
        return self._map("trend", self.grid.unit) if self._path("trend.tif").is_file() else None

    @cached_property
    def grid(self) -> PixelGrid:
        """Grid of all maps: where their pixels are on the plane of the artwork."""
        return _grid(self._path("height.tif"), self.provenance["stand"])

    @cached_property
    def quality(self) -> Numbers:
        """The numbers of the report, by name; each has value, unit, meaning and warning."""
        rows = json.loads(self._path("quality.json").read_text(encoding="utf-8"))
        return Numbers((row["name"], Number(**row)) for row in rows)

    @cached_property
    def warnings(self) -> list[CaptureWarning]:
        """Warnings about the capture, the most urgent first; each has code, lamps, value, unit and sentence."""
        return read_warnings(self._path(FILE).parent)

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """Record of what made these products, in full."""
        found: dict[str, Any] = json.loads(self._path("provenance.json").read_text(encoding="utf-8"))
        return found

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The decimated mesh with the albedo as its texture, in the frame and the unit of the height."""
        import trimesh

        loaded: Any = trimesh.load_mesh(self._path("mesh.glb"), process=False)
        loaded.apply_scale(1000)  # the file is in metres, as glTF wants it
        mesh: trimesh.Trimesh = loaded
        return mesh

    @property
    def report(self) -> Path:
        """The page for people."""
        return self._path("report.html")

    def _repr_html_(self) -> str:
        from nlights.notebook import tile_html

        return tile_html(self)

    def _path(self, name: str) -> Path:
        if self.folder is None:
            raise TileError(f"{self.artwork}/{self.tile}: failed: {self.message}")
        return self.folder / name

    def _map(self, name: str, unit: str) -> Map:
        return Map(read_tiff(self._path(f"{name}.tif")), self.grid, unit)


def _grid(height: Path, stand: dict[str, Any] | None) -> PixelGrid:
    """The grid of some products: by the stand as on record, else by the resolution that their files state."""
    import tifffile

    with tifffile.TiffFile(height) as file:
        page = file.pages.first
        rows, columns = page.shape
        per_cm = page.tags["XResolution"].value if page.tags["ResolutionUnit"].value == 3 else None
    if stand is not None:
        measured = Stand.model_validate(stand)
        x, y, z = measured.camera_position
        return PixelGrid(rows, columns, measured.field_mm[0] / columns, (float(x), float(y), float(z)))
    if per_cm is not None:
        return PixelGrid(rows, columns, 10 * per_cm[1] / per_cm[0])
    return PixelGrid(rows, columns, 1.0, unit="px")


def open(folder: str | Path) -> TileResult:
    """Open the finished products of a tile.

    Parameters
    ----------
    folder : str or Path
        Of one tile, as ``products/inv-1/r0c0``.

    Returns
    -------
    TileResult
        Its state is "unchanged".

    Raises
    ------
    CaptureError
        When the folder holds no products, naming those below it.
    """
    place = Path(folder)
    record = place / "provenance.json"
    if not record.is_file():
        below = sorted(str(path.parent) for path in place.glob("*/*/provenance.json"))
        below += sorted(str(path.parent) for path in place.glob("*/provenance.json"))
        hint = (
            f"open one of {', '.join(below[:5])}"
            if below
            else "give the folder of a tile, as products/inv-1/r0c0"
        )
        raise CaptureError(f"{place}: holds no products of a tile (no provenance.json); {hint}")
    made = json.loads(record.read_text(encoding="utf-8"))
    return TileResult(made["artwork"], made["tile"], "unchanged", place)


def digitise(
    artwork: str | Path,
    *,
    recipe: RecipeLike = "default",
    out: str | Path = "products",
    store: str | Path | None = None,
    stand: str | Path | None = None,
    root: str | Path | None = None,
    tiles: str | Sequence[str] | None = None,
    compression: Compression = "none",
    copies: bool = False,
    memory: str | None = None,
    timeout: float | None = None,
    runner: Literal["here", "dask"] = "here",
    address: str | None = None,
    progress: bool = True,
) -> list[TileResult]:
    """Turn the photographs of an artwork into measured surfaces, as ``nlights digitise`` does.

    Parameters
    ----------
    artwork : str or Path
        The ``artwork.yaml``, or the folder that holds it.
    recipe : str, Path, mapping or Recipe
        Name of a shipped recipe, path of a file, or what such a file would hold.
    out : str or Path
        Folder of the products.
    store : str or Path, optional
        Folder of the artefacts; ``<out>/.store`` by default.
    stand : str or Path, optional
        Name or path of a stand, instead of the manifest's.
    root : str or Path, optional
        Folder that no photograph may be outside of; the manifest's by default.
    tiles : str or sequence of str, optional
        Only the tiles of these names.
    compression : {"none", "zstd"}
        Of the TIFFs; compressed ones cannot be mapped in place.
    copies : bool
        Copy the products out of the store, instead of sharing their place on the disk.
    memory : str, optional
        What a tile may take, as ``"6GiB"``.
    timeout : float, optional
        Seconds that a stage may take.
    runner : {"here", "dask"}
        Where tiles run: in this process, or on the workers of a Dask cluster.
    address : str, optional
        Of the Dask scheduler.
    progress : bool
        Show bars on a terminal or in a notebook, and lines elsewhere.

    Returns
    -------
    list of TileResult
        Of every tile, in the manifest's order; those that failed say so, and cost no other its products.

    Raises
    ------
    RecipeError, CaptureError, StandError
        What is to be mended first; nothing was computed.
    TileError
        When every tile failed, naming each.
    """
    options = run_options(locals())
    with told_in_python():
        found = [_result(one) for one in direct.digitise(artwork, options, recipe, shown=progress)]
    if all(tile.failed for tile in found):
        raise TileError("\n".join(f"{tile.artwork}/{tile.tile}: {tile.message}" for tile in found))
    return found


def _result(found: Outcome) -> TileResult:
    message = in_python(found.message)
    return TileResult(
        found.artwork, found.tile, found.state, found.folder, message, found.seconds, found.notes
    )
