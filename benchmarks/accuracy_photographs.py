"""Accuracy on photographed objects whose normals are known: DiLiGenT, and the grey sphere of UW."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy_subjects import DATA, present, solvers
from tables import Cell, Table, kept

from nlights_core.algorithms import NormalSolver
from nlights_core.capture import Encoding
from nlights_core.frames import Array
from nlights_core.manifest import load_capture
from nlights_core.photographs.images import Photograph, grey
from nlights_core.recipe import load_recipe
from nlights_core.simulation.evaluation import angles_between
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

OBJECTS = ("ball", "bear")
DEFAULT = "robust"

PEERS: list[tuple[Cell, ...]] = [
    ("plain least squares, published", None, 4.17, None, 8.39, None, None),
    ("L1, public Python", None, 2.43, None, 6.25, None, None),
    ("robust principal components, public Python", None, 3.10, None, 7.17, None, None),
    ("rank 20-90 %, then least squares", None, 2.37, None, 6.59, None, None),
    ("PSBox (its own shadow mask; given strengths)", 3.1, None, None, None, None, None),
]
"""Mean angles of other programs as rows of the table ``diligent``; none of them was run here."""

LIMITS = {"ball": 2.45, "bear": 6.3}
LEAST_SPEED = 0.3
"""Million pixels per second with all 96 lights."""
GREY_LIMIT = 5.3
RIG = [91, 7, 43, 48, 92, 55, 44, 0]
"""The lights nearest to 15 and to 45 degrees above the horizon on each of four sides, as in this rig."""


class Shots(NamedTuple):
    """The pixels of an object: images (L, 1, n), lights (L, 1, 1, 3), weights (L, 1, n), truth (1, n, 3)."""

    images: Array
    lights: Array
    weights: Array
    truth: Array

    def of(self, lamps: list[int]) -> Shots:
        """The same pixels under some of the lamps."""
        return Shots(self.images[lamps], self.lights[lamps], self.weights[lamps], self.truth)


def diligent(quick: bool) -> list[Table]:
    """Tables ``diligent`` and ``diligent-limits``: solvers alone, on all pixels of an object at once."""
    shots = {
        name: _shots(folder, name)
        for name in OBJECTS[: 1 if quick else 2]
        if (folder := present("diligent", name))
    }
    if not shots:
        return []
    rows: list[tuple[Cell, ...]] = []
    limits: list[tuple[Cell, ...]] = []
    for name, solver in solvers().items():
        print(f"  {name}", flush=True)
        figures: list[Cell] = []
        speed = copies = 0.0
        for thing in OBJECTS:
            one = shots.get(thing)
            if one is None:
                figures += [None, None]
                continue
            error, seconds = _error(solver(), one)
            speed, copies = one.truth.shape[1] / seconds / 1e6, seconds / _copying(one.images)
            figures += [error, _error(solver.model_validate({"shadow": 0}), one)[0]]
            if name == DEFAULT:
                limits.append(_limit(f"`{name}`, 96 lights, {thing}: degrees", error, LIMITS[thing]))
        rows.append((f"`{name}`", *figures, speed, copies))
        if name == DEFAULT:
            fast = kept(speed >= LEAST_SPEED)
            limits.append((f"`{name}`, 96 lights: Mpx/s, **at least**", speed, LEAST_SPEED, fast))
    limits += _few_lights(shots)
    columns = (f"{thing}{what}" for thing in OBJECTS for what in (", degrees", ", `shadow: 0`"))
    return [
        Table("diligent", ("normal solver", *columns, "Mpx/s", "time, copies of the images"), rows + PEERS),
        Table("diligent-limits", ("figure", "found", "at most", "verdict"), limits),
    ]


def _limit(what: str, found: float, most: float) -> tuple[Cell, ...]:
    return what, found, most, kept(found <= most)


def _few_lights(shots: dict[str, Shots]) -> list[tuple[Cell, ...]]:
    """The default solver beside least squares with eight lights that lie like this rig's."""
    rows = []
    for name, one in shots.items():
        robust, plain = (_error(solvers()[s](), one.of(RIG))[0] for s in (DEFAULT, "least-squares"))
        rows.append(_limit(f"`{DEFAULT}`, 8 lights, {name}: degrees (limit: `least-squares`)", robust, plain))
    return rows


def _shots(folder: Path, name: str) -> Shots:
    """Photographs as grey relative to each lamp's strength, and the measured normals."""
    from scipy.io import loadmat

    print(f"  reading {name}", flush=True)
    truth = loadmat(folder / "Normal_gt.mat")["Normal_gt"]
    inside = np.any(truth != 0, axis=-1)
    directions = np.loadtxt(folder / "light_directions.txt", dtype=np.float32)
    intensities = np.loadtxt(folder / "light_intensities.txt", dtype=np.float32)
    files = (folder / "filenames.txt").read_text(encoding="utf-8").split()
    images = np.empty((len(files), 1, np.count_nonzero(inside)), np.float32)
    with tempfile.TemporaryDirectory() as scratch:
        for image, file, intensity in zip(images, files, intensities, strict=True):
            with Photograph(folder / file, Encoding(saturation="none"), Path(scratch)) as photograph:
                image[0] = grey(photograph.band(0, len(inside))[inside] / intensity)
    return Shots(images, directions[:, None, None], np.ones_like(images), truth[inside][None])


def _error(solver: NormalSolver, shots: Shots) -> tuple[float, float]:
    """Mean angle in degrees, an unknown normal counting as 90, and the seconds it took."""
    started = time.perf_counter()
    found = solver.solve(shots.images, shots.lights, shots.weights)
    seconds = time.perf_counter() - started
    angles = angles_between(found.normals, shots.truth)
    return float(np.where(np.isfinite(angles), angles, 90).mean()), seconds


def _copying(images: Array) -> float:
    """Seconds that a copy of the images takes in memory: the floor that no solver can go below."""
    target = images.copy()
    times = []
    for _ in range(5):
        started = time.perf_counter()
        np.copyto(target, images)
        times.append(time.perf_counter() - started)
    return min(times)


def strengths(quick: bool) -> list[Table]:
    """Table ``strengths``: what the refinement of the lamps' strengths does, through the whole chain."""
    rows: list[tuple[Cell, ...]] = []
    for name in ("grey sphere",) if quick else ("grey sphere", *OBJECTS):
        capture = _grey_sphere() if name == "grey sphere" else _object(name)
        for solver in ("least-squares", DEFAULT) if capture else ():
            assert capture is not None
            print(f"  {name}, {solver}", flush=True)
            off, on = (_chain_error(capture, solver, refine) for refine in (False, True))
            good, asked = on <= off + 0.05, "on at most 0.05 above off"
            if name == "grey sphere":
                good, asked = max(on, off) < GREY_LIMIT and on < off, f"below {GREY_LIMIT}, on below off"
            rows.append((f"{name}, `{solver}`", off, on, asked, kept(good)))
    if not rows:
        return []
    rows += [("grey sphere, PSBox", 5.28, 10.33, None, None), ("ball, PSBox", 3.1, 15.7, None, None)]
    return [
        Table("strengths", ("object", "refine off, degrees", "refine on, degrees", "asked", "verdict"), rows)
    ]


class Capture(NamedTuple):
    """A manifest with DATA for the folder of the data, a light model, true normals and where they count."""

    manifest: str
    light_model: str
    truth: Array
    counts: Array


def _object(name: str) -> Capture | None:
    """An object of DiLiGenT; the strengths that it states are true."""
    from scipy.io import loadmat

    folder = present("diligent", name)
    if folder is None:
        return None
    manifest = (
        f'artwork: {{id: {name}}}\nframes: "DATA/diligent/{name}/{{n:03d}}.png"\n'
        f"mask: DATA/diligent/{name}/mask.png\nencoding: {{saturation: none}}\nlights:\n"
        f"  directions: DATA/diligent/{name}/light_directions.txt\n"
        f"  intensities: DATA/diligent/{name}/light_intensities.txt\n"
    )
    truth = loadmat(folder / "Normal_gt.mat")["Normal_gt"]
    return Capture(manifest, "given-directions", truth, np.any(truth != 0, axis=-1))


def _grey_sphere() -> Capture | None:
    """A matt sphere: its outline gives its normals; those near the outline (nz below 0.2) do not count."""
    from PIL import Image

    folder = present("uw")
    if folder is None:
        return None
    with Image.open(folder / "gray" / "gray.mask.tga") as image:
        inside = np.asarray(image.convert("L")) > 127
    rows, columns = np.nonzero(inside)
    radius = (np.ptp(rows) + np.ptp(columns) + 2) / 4
    y, x = np.indices(inside.shape, float)
    x, y = (x - (columns.min() + columns.max()) / 2) / radius, ((rows.min() + rows.max()) / 2 - y) / radius
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    manifest = (
        'artwork: {id: gray}\nframes: "DATA/uw/gray/gray.{n}.tga"\nmask: DATA/uw/gray/gray.mask.tga\n'
        'chrome_spheres:\n  - frames: "DATA/uw/chrome/chrome.{n}.tga"\n'
        "    mask: DATA/uw/chrome/chrome.mask.tga\n"
    )
    return Capture(manifest, "chrome-sphere", np.stack([x, y, z], axis=-1), inside & (z > 0.2))


def _chain_error(capture: Capture, solver: str, refine: bool) -> float:
    """Mean angle of what the whole chain makes of a capture, degrees; an unknown normal counts as 90."""
    import tifffile

    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        here = Path(os.path.relpath(DATA, folder.resolve())).as_posix()
        (folder / "artwork.yaml").write_text(capture.manifest.replace("DATA", here), encoding="utf-8")
        (folder / "recipe.yaml").write_text(
            f"light_model: {{use: {capture.light_model}, refine: {str(refine).lower()}}}\n"
            f"normals: {{use: {solver}}}\nintegrator: simchony\n",
            encoding="utf-8",
        )
        tile = load_capture(folder, root=Path(folder.anchor))[0]
        recipe = load_recipe(str(folder / "recipe.yaml"))
        outcome = run_directly(tile, recipe, RunOptions(out=folder / "out"), lambda *_: None)
        if outcome.folder is None:
            raise SystemExit(f"{tile.artwork}: {outcome.message}")
        normals = tifffile.imread(outcome.folder / "normals.tif")
    angles = angles_between(normals[capture.counts], capture.truth[capture.counts])
    return float(np.where(np.isfinite(angles), angles, 90).mean())
