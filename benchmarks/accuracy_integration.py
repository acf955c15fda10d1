"""Accuracy of all installed integrators: surfaces known by formula or by measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from accuracy_subjects import integrators, present
from tables import Cell, Table, kept

from nlights_core.algorithms import Integrator
from nlights_core.fields import NormalField
from nlights_core.frames import Array, PixelGrid

OPTIONS: dict[str, list[dict[str, bool | str]]] = {
    "simchony": [{"stencil": "trapezoid"}, {"weights": False}],
    "frankot-chellappa": [{"periodic": True}],
}
"""What else than its standard options an integrator is tried with."""

WHOLE = np.s_[:, :]
VASE_CROP = np.s_[82:310, 89:180]
VASE_LIMIT = 0.11
VASE_PEERS: list[tuple[Cell, ...]] = [
    ("periodic Fourier transform, published", None, 2.15, 13.4, None, None, None),
    ("cosine transform, published", None, 2.11, 1.27, None, None, None),
    ("masked least squares, published", None, None, None, 0.108, None, 0.072),
]

DEPTH_LIMITS = {"bear": 0.50, "cow": 0.17, "pot1": 1.07, "cat": 0.38}


def variants() -> dict[str, Integrator]:
    """Every installed integrator at its standard options and at those of `OPTIONS`."""
    found = {}
    for name, integrator in integrators().items():
        for options in ({}, *OPTIONS.get(name, [])):
            words = "".join(f", `{option}: {str(value).lower()}`" for option, value in options.items())
            found[f"`{name}`{words}"] = integrator.model_validate(options)
    return found


def surfaces(quick: bool) -> list[Table]:
    """Table ``surfaces``: peaks(512), and the vase of Durou and Queau without and with its mask."""
    vase = present("integration", "vase.mat")
    rows: list[tuple[Cell, ...]] = []
    for title, integrator in variants().items():
        print(f"  {title}", flush=True)
        height, p, q = peaks(512)
        off = integrator.integrate(_field(p, q)).height - height
        figures: list[Cell] = [None] * 5
        if vase is not None:
            whole, crop, whole_masked, crop_masked = (
                _vase_error(vase, integrator, window, masked)
                for masked in (False, True)
                for window in (WHOLE, VASE_CROP)
            )
            judged = kept(whole_masked <= VASE_LIMIT)
            figures = [whole, crop, whole_masked, judged, crop_masked]
        rows.append((title, float(np.abs(off - off.mean()).max() / np.ptp(height)), *figures))
    columns = (
        "integrator",
        "peaks(512), share of range",
        "vase, px",
        "vase cropped, px",
        "vase with mask, px",
        f"at most {VASE_LIMIT}",
        "cropped with mask, px",
    )
    return [Table("surfaces", columns, rows + VASE_PEERS)]


def peaks(size: int) -> tuple[Array, Array, Array]:
    """MATLAB's peaks on [-3, 3]^2: height, and its exact steps per column and per row."""
    step = 6 / (size - 1)
    x, y = np.meshgrid(np.linspace(-3, 3, size), np.linspace(-3, 3, size))
    south, centre = np.exp(-(x**2) - (y + 1) ** 2), np.exp(-(x**2) - y**2)
    west = np.exp(-((x + 1) ** 2) - y**2) / 3
    saddle = -10 * (x / 5 - x**3 - y**5)
    height = 3 * (1 - x) ** 2 * south + saddle * centre - west
    p = (-6 * (1 - x) - 6 * x * (1 - x) ** 2) * south
    p += (-10 * (0.2 - 3 * x**2) - 2 * x * saddle) * centre + 2 * (x + 1) * west
    q = -6 * (y + 1) * (1 - x) ** 2 * south + (50 * y**4 - 2 * y * saddle) * centre + 2 * y * west
    return height, p * step, q * step


def _field(p: Array, q: Array) -> NormalField:
    """Normals of the slopes per column and per row, seen by an orthographic camera; lengths in px."""
    normals = np.stack([-p, q, np.ones_like(p)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return NormalField(normals.astype(np.float32), PixelGrid(p.shape[0], p.shape[1], 1.0, unit="px"))


def _vase_error(file: Path, integrator: Integrator, window: tuple[slice, slice], masked: bool) -> float:
    """RMS over the mask after the best constant, px."""
    from scipy.io import loadmat

    # The file's q runs along a row and its p down a column.
    vase = loadmat(file)
    p, q, height, mask = (vase[key][window].astype(float) for key in ("q", "p", "u", "mask"))
    known = mask > 0
    field = _field(np.where(known | (not masked), p, np.nan), q)
    return float(np.std((integrator.integrate(field).height - height)[known]))


def depths(quick: bool) -> list[Table]:
    """Table ``depths``: measured normals of DiLiGenT integrated along the rays of its camera."""
    rows: list[tuple[Cell, ...]] = []
    for name in list(DEPTH_LIMITS)[: 1 if quick else 4]:
        folder = present("integration", "diligent_depth", name)
        if folder is None:
            continue
        print(f"  {name}", flush=True)
        for title, integrator in variants().items():
            if "periodic" not in title:  # it knows no mask
                rows.append(_depth_row(folder, f"{name}, {title}", integrator))
        flat = variants()["`simchony`"].model_copy(update={"perspective": False})
        rows.append(_depth_row(folder, f"{name}, `simchony`, `perspective: false`", flat))
    columns = ("object, integrator", "mean absolute error, mm", "at most, mm", "verdict")
    return [Table("depths", columns, rows)] if rows else []


def _depth_row(folder: Path, title: str, integrator: Integrator) -> tuple[Cell, ...]:
    field, depth = seen_by_pinhole(folder)
    error = _depth_error(integrator, field, depth)
    most = DEPTH_LIMITS[folder.name]
    return (title, error, most, kept(error <= most))


def seen_by_pinhole(folder: Path) -> tuple[NormalField, Array]:
    """Measured normals on a grid whose camera is the given pinhole, and the measured depth.

    The pinhole K sees a point at column fx X/Z + cx.  With a pixel as the unit of length, the plane
    z = 0 lies fx in front of the camera, which stands over the principal point (cx, cy); a point at
    depth Z has z = fx - Z, apart from the scale, which no normal tells.  Where fx and fy differ, y is
    stretched by fy / fx to make the pixels square, and so the normals' y by fx / fy.

    Returns
    -------
    field : NormalField
        From ``normal_map.png``, 16 bits, decoded as ``2 v / 65535 - 1``, x right, y up, z to the camera.
    depth : (H, W) float64 array
        Along the axis, mm; NaN outside the mask.
    """
    import imagecodecs

    normals = imagecodecs.imread(str(folder / "normal_map.png"))
    if normals.dtype != np.uint16:
        raise SystemExit(f"{folder / 'normal_map.png'}: read as {normals.dtype}, but it has 16 bits")
    normals = 2 * normals.astype(float) / 65535 - 1
    mask = np.asarray(imagecodecs.imread(str(folder / "mask.png")))
    inside = mask.reshape(*mask.shape[:2], -1)[..., 0] > 0
    camera = np.loadtxt(folder / "K.txt")
    (fx, fy), (cx, cy) = camera[[0, 1], [0, 1]], camera[:2, 2]
    normals[..., 1] *= fx / fy
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[~inside] = np.nan
    rows, columns = inside.shape
    grid = PixelGrid(rows, columns, 1.0, (cx - (columns - 1) / 2, (rows - 1) / 2 - cy, fx), "px")
    depth = np.load(folder / "depth_gt.npz")["depth_gt"]
    return NormalField(normals.astype(np.float32), grid), np.where(inside, depth, np.nan)


def _depth_error(integrator: Integrator, field: NormalField, depth: Array) -> float:
    """Mean absolute error of the depth, mm, after scaling by the median ratio."""
    assert field.grid.camera is not None
    found = field.grid.camera[2] - integrator.integrate(field).height.astype(float)
    found *= np.nanmedian(depth / found)
    return float(np.nanmean(np.abs(found - depth)))
