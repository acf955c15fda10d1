"""A simulated capture: photographs of a known artwork on a measured stand, with their truth.

The physics, and what it leaves out, is described in docs/simulator.md.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml
from numpy.random import Generator, default_rng

from nlights_core.configurations import shipped_names
from nlights_core.errors import CaptureError
from nlights_core.files.tiffs import BandTiff
from nlights_core.frames import Array, PixelGrid
from nlights_core.simulation.illumination import Horizon, LampGroup, horizon, lamp_groups, shine
from nlights_core.simulation.scenes import SCENES, Scene
from nlights_core.simulation.surfaces import plane, seen_points
from nlights_core.stands import Stand

FLAT_ALBEDO = 0.9
EXPOSURE = 0.8
"""The brightest matt pixel, as a share of saturation."""
FULL_WELL = 50_000.0
"""Electrons at saturation."""
READ_NOISE = 4.0
"""Standard deviation of the readout, electrons."""
BLACK_LEVEL = 256
"""What the camera writes in the dark, 16-bit numbers."""
SATURATION = 65535
FINEST_PX = 5.0
"""Half width of the finest detail, so that no wave is shorter than the pixels can carry."""
BAND = 64
"""Rows rendered at a time; the noise is drawn per band, so it is part of the result."""


@dataclass(frozen=True)
class Studio:
    """The artwork, the flat, the lamps and the camera of one simulated capture.

    Parameters
    ----------
    scene : Scene
        The artwork.
    grid : PixelGrid
        The photograph, with its camera.
    groups : list of LampGroup
        The lamps.
    horizons : list of Horizon
        Cast shadows of the artwork, per group.
    varnish : bool
        Whether the artwork is varnished.
    """

    scene: Scene
    grid: PixelGrid
    groups: list[LampGroup]
    horizons: list[Horizon]
    varnish: bool

    def truth(self, start: int, stop: int) -> tuple[Array, Array, Array]:
        """Points (3, h, w) mm, normals and albedo (h, w, 3) of a band of rows, float32."""
        points = seen_points(self.scene.surface, self.grid, start, stop)
        normals = self.scene.surface.normals(points[0], points[1])
        albedo = self.scene.albedo(points[0], points[1])
        return points.astype(np.float32), normals.astype(np.float32), albedo.astype(np.float32)

    def vignetting(self, start: int, stop: int) -> Array:
        """cos^4 of the angle between the camera's axis and each ray, (h, w, 1) float32."""
        assert self.grid.camera is not None
        x, y, z = self.grid.camera
        squared = (self.grid.x() - x)[None, :] ** 2 + (self.grid.y(start, stop) - y)[:, None] ** 2
        return np.asarray(1 / (1 + squared / z**2) ** 2, np.float32)[..., None]

    def radiance(
        self, start: int, stop: int, truth: tuple[Array, Array, Array]
    ) -> Iterator[tuple[Array, Array, Array]]:
        """Light that the lens receives of a band of rows, lamp group by lamp group, before exposure.

        Parameters
        ----------
        start, stop : int
            The band of rows.
        truth : tuple of 3 arrays
            What `truth` returned for it.

        Yields
        ------
        matt, gloss, flat : (h, w, 3) float32 arrays
            The artwork's body colour, its highlights, and the flat in its stead.
        """
        points, normals, albedo = truth
        level = seen_points(plane(), self.grid, start, stop).astype(np.float32)
        upright = np.zeros_like(normals)
        upright[..., 2] = 1
        camera = np.array(self.grid.camera) if self.varnish else None
        lens = self.vignetting(start, stop)
        for group, shadows in zip(self.groups, self.horizons, strict=True):
            matt, gloss = shine(group, points, normals, shadows, camera)
            light, _ = shine(group, level, upright, None)
            flat = np.broadcast_to(FLAT_ALBEDO * light[..., None] * lens, albedo.shape)
            yield matt[..., None] * albedo * lens, gloss[..., None] * lens, flat

    def brightest(self) -> float:
        """The brightest matt radiance in any photograph, sampled on every 32nd row."""
        brightest = 0.0
        for row in range(0, self.grid.rows, 32):
            for matt, _, flat in self.radiance(row, row + 1, self.truth(row, row + 1)):
                brightest = max(brightest, float(matt.max()), float(flat.max()))
        return brightest


def expose(radiance: Array, gain: float, random: Generator) -> Array:
    """Photograph a radiance: shot noise, read noise, black level, saturation, 16 bits.

    Parameters
    ----------
    radiance : (h, w, 3) float32 array
        Any scale.
    gain : float
        Share of saturation per unit of radiance.
    random : Generator
        Draws the noise: Gaussian of the shot noise's variance, which a count of more than some
        tens of electrons justifies.

    Returns
    -------
    (h, w, 3) uint16 array
        Linear.
    """
    electrons = radiance * np.float32(gain * FULL_WELL)
    noise = random.standard_normal(radiance.shape, np.float32)
    electrons += noise * np.sqrt(electrons + np.float32(READ_NOISE**2))
    numbers = BLACK_LEVEL + electrons * np.float32((SATURATION - BLACK_LEVEL) / FULL_WELL)
    return np.asarray(np.clip(np.rint(numbers), 0, SATURATION), np.uint16)


def simulate(
    folder: str | Path,
    stand: Stand,
    *,
    scene: str,
    width: int,
    varnish: bool = False,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a simulated capture: photographs, flats, dark frame, manifest and truth.

    Parameters
    ----------
    folder : str or Path
        Where to; absent or empty.  It appears whole, or not at all.
    stand : Stand
        Its name goes into the manifest.
    scene : str
        One of `nlights_core.simulation.scenes.SCENES`.
    width : int
        Columns of the photographs; the rows follow from the stand's field.
    varnish : bool
        Add highlights to the artwork.
    seed : int
        The same seed gives the same files.
    progress : callable, optional
        Called as ``progress(rows done, rows in all)``.

    Returns
    -------
    Path
        The manifest, ``folder / "artwork.yaml"``.

    Raises
    ------
    CaptureError
        When the folder holds something, or scene, width or seed is out of range.
    """
    if scene not in SCENES:
        raise CaptureError(f"scene: '{scene}' is not known; choose one of {', '.join(SCENES)}")
    if width < 32 or seed < 0:
        raise CaptureError(f"width: at least 32, seed: at least 0; got width {width}, seed {seed}")
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(f"{folder}: already holds something; name a new or an empty folder")
    studio = set_up(stand, scene, width, varnish, seed)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as scratch:
        draft = Path(scratch) / "capture"
        _photograph(studio, draft, seed, progress)
        manifest = _manifest(stand, scene, varnish, seed)
        if stand.name not in shipped_names("stands"):
            manifest["stand"] = "stand.yaml"
            own = yaml.safe_dump(stand.model_dump(mode="json"), sort_keys=False)
            (draft / "stand.yaml").write_text(own, encoding="utf-8")
        (draft / "artwork.yaml").write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        draft.rename(folder)
    return folder / "artwork.yaml"


def _chance(seed: int, purpose: str) -> Generator:
    """Random numbers for one purpose, independent of all others."""
    return default_rng([seed, zlib.crc32(purpose.encode())])


def set_up(stand: Stand, scene: str, width: int, varnish: bool, seed: int) -> Studio:
    """The studio of a capture that `simulate` would write."""
    size = stand.field_mm[0] / width
    x, y, z = (float(c) for c in stand.camera_position)
    grid = PixelGrid(round(stand.field_mm[1] / size), width, size, (x, y, z))
    artwork = SCENES[scene](stand.field_mm, FINEST_PX * size, _chance(seed, scene))
    groups = lamp_groups(stand, _chance(seed, "lamps"))
    horizons = [horizon(artwork.surface, grid, group.centre) for group in groups]
    return Studio(artwork, grid, groups, horizons, varnish)


def _photograph(studio: Studio, folder: Path, seed: int, progress: Callable[[int, int], None] | None) -> None:
    """Write all images, band by band, so that memory does not grow with the rows."""
    rows, columns = studio.grid.shape
    (folder / "flat").mkdir(parents=True)
    (folder / "truth").mkdir()

    with ExitStack() as stack:

        def image(name: str, dtype: str, channels: tuple[int, ...] = (3,)) -> BandTiff:
            return stack.enter_context(BandTiff(folder / name, (rows, columns, *channels), dtype))

        numbers = range(1, len(studio.groups) + 1)
        frames = [image(f"light_{n}.tif", "uint16") for n in numbers]
        flats = [image(f"flat/light_{n}.tif", "uint16") for n in numbers]
        dark = image("dark.tif", "uint16")
        normals, albedo = (image(f"truth/{name}.tif", "float32") for name in ("normals", "albedo"))
        height = image("truth/height.tif", "float32", ())
        gain = EXPOSURE / studio.brightest()
        for start in range(0, rows, BAND):
            stop = min(start + BAND, rows)
            truth = studio.truth(start, stop)
            height.write(truth[0][2])
            normals.write(truth[1])
            albedo.write(truth[2])
            dark.write(expose(np.zeros_like(truth[2]), gain, _chance(seed, f"dark {start}")))
            for k, (matt, gloss, flat) in enumerate(studio.radiance(start, stop, truth)):
                frames[k].write(expose(matt + gloss, gain, _chance(seed, f"frame {k} {start}")))
                flats[k].write(expose(flat, gain, _chance(seed, f"flat {k} {start}")))
            if progress is not None:
                progress(stop, rows)


def _manifest(stand: Stand, scene: str, varnish: bool, seed: int) -> dict[str, object]:
    finish = "-varnished" if varnish else ""
    return {
        "artwork": {"id": f"simulated-{scene}{finish}", "title": f"Simulated {scene}, seed {seed}"},
        "stand": stand.name,
        "frames": {lamp: f"light_{n}.tif" for n, lamp in enumerate(stand.lamps, 1)},
        "flats": {lamp: f"flat/light_{n}.tif" for n, lamp in enumerate(stand.lamps, 1)},
        "dark": "dark.tif",
        "white_reflectance": FLAT_ALBEDO,
        "tiles": [{"name": "r0c0", "origin_mm": [0, 0]}],
    }
