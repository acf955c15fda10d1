"""Real captures through the whole chain, against the figures that are known of them."""

import os
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

DATA = Path(__file__).parents[4] / "shared" / "data"

PLAIN = """
light_model: {{use: {model}, refine: {refine}}}
normals: {{use: least-squares, shadow: 0}}
integrator: {{use: simchony}}
"""


def present(*names: str) -> Path:
    folder = DATA.joinpath(*names)
    if not folder.exists():
        pytest.skip(f"{'/'.join(names)} is not beside the project")
    return folder


def digitise(folder: Path, manifest: str, recipe: str) -> Path:
    """Digitise a capture whose photographs are far from its manifest; returns the product folder."""
    (folder / "artwork.yaml").write_text(manifest)
    (folder / "recipe.yaml").write_text(recipe)
    tile = load_capture(folder, root=Path(folder.anchor))[0]
    chosen = load_recipe(str(folder / "recipe.yaml"))
    outcome = run_directly(tile, chosen, RunOptions(out=folder / "out"), lambda *_: None)
    assert outcome.state == "done", outcome.message
    assert outcome.folder is not None
    return outcome.folder


def angles(folder: Path, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Angles to the true normals over a mask, degrees; unknown ones count as 90."""
    normals = np.nan_to_num(tifffile.imread(folder / "normals.tif")[mask].astype(float))
    truth = truth[mask] / np.linalg.norm(truth[mask], axis=-1, keepdims=True)
    cross = np.linalg.norm(np.cross(normals, truth), axis=-1)
    return np.degrees(np.arctan2(cross, np.sum(normals * truth, axis=-1)))


@pytest.mark.parametrize(("thing", "known"), [("ball", 4.17), ("bear", 8.39)])
def test_diligent_by_plain_least_squares_gives_the_known_error(tmp_path, thing, known):
    from scipy.io import loadmat

    source = Path(os.path.relpath(present("diligent", thing), tmp_path)).as_posix()
    folder = digitise(
        tmp_path,
        f'artwork: {{id: {thing}}}\nframes: "{source}/{{n:03d}}.png"\nmask: {source}/mask.png\n'
        f"lights:\n  directions: {source}/light_directions.txt\n"
        f"  intensities: {source}/light_intensities.txt\n"
        "encoding: {saturation: none}\n",
        PLAIN.format(model="given-directions", refine="false"),
    )
    truth = loadmat(DATA / "diligent" / thing / "Normal_gt.mat")["Normal_gt"]
    mask = np.any(truth != 0, axis=-1)
    assert angles(folder, truth, mask).mean() == pytest.approx(known, abs=0.03)


def gray_sphere() -> tuple[np.ndarray, np.ndarray]:
    """Analytic normals of the UW matte sphere and where they are not grazing."""
    from PIL import Image

    with Image.open(present("uw", "gray", "gray.mask.tga")) as image:
        inside = np.asarray(image.convert("L")) > 127
    rows, columns = np.nonzero(inside)
    centre = (rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2
    radius = (rows.max() - rows.min() + columns.max() - columns.min() + 2) / 4
    y, x = np.indices(inside.shape, float)
    nx, ny = (x - centre[1]) / radius, -(y - centre[0]) / radius
    nz = np.sqrt(np.maximum(1 - nx**2 - ny**2, 0))
    return np.stack([nx, ny, nz], axis=-1), inside & (nz > 0.2)


def test_the_gray_sphere_with_lights_found_on_chrome_improves_by_refinement(tmp_path):
    truth, mask = gray_sphere()
    source = Path(os.path.relpath(present("uw"), tmp_path)).as_posix()
    manifest = (
        f'artwork: {{id: gray}}\nframes: "{source}/gray/gray.{{n}}.tga"\nmask: {source}/gray/gray.mask.tga\n'
        f'chrome_spheres:\n  - frames: "{source}/chrome/chrome.{{n}}.tga"\n'
        f"    mask: {source}/chrome/chrome.mask.tga\n"
    )
    errors = {}
    for refine in ("false", "true"):
        own = tmp_path / refine
        own.mkdir()
        text = manifest.replace(source, f"../{source}")
        recipe = PLAIN.format(model="chrome-sphere", refine=refine).replace("shadow: 0}", "shadow: 0.05}")
        errors[refine] = angles(digitise(own, text, recipe), truth, mask).mean()
    assert errors["false"] <= 5.3
    assert errors["true"] <= errors["false"]


@pytest.mark.parametrize(("thing", "numbers"), [("italy", (1, 2, 4, 8)), ("banknote", (1, 2, 4, 8))])
def test_a_coin_and_a_banknote_show_their_relief(tmp_path, thing, numbers):
    import json

    source = Path(os.path.relpath(present("coins", thing), tmp_path)).as_posix()
    fitted = json.loads((DATA / "coins" / "fitted_lights.json").read_text())
    lights = fitted["Coin_Italy" if thing == "italy" else "Banknote"]
    # The field is 1 image width; take it as 30 mm, so that the lamps are at some 35 mm.
    width = 30.0
    positions = width * np.array(lights["led_positions_image_widths"])
    rows = "".join(f"  led_{n}: {p.tolist()}\n" for n, p in zip(numbers, positions, strict=True))
    (tmp_path / "stand.yaml").write_text(
        f"name: leds\nsource: fitted\nfield_mm: [{width}, {0.75 * width}]\ncamera: [0, 0, 70]\nlamps:\n{rows}"
        "lamp: {half_angle_deg: 60, emitter_size_mm: 5}\nuncertainty_mm: 1\n"
    )
    frames = "".join(f"  led_{n}: {source}/I_{n:02d}.png\n" for n in numbers)
    folder = digitise(
        tmp_path,
        f"artwork: {{id: {thing}}}\nstand: stand.yaml\nframes:\n{frames}"
        "encoding: {mosaic: RGGB, saturation: 65}\n",
        "light_model: {use: measured-poi, refine: true}\ndetrend: {images: {use: inverse-square}}\n"
        "normals: {use: least-squares}\nintegrator: {use: simchony}\n",
    )
    normals = tifffile.imread(folder / "normals.tif")
    assert normals.shape == (1374, 1832, 3)
    assert np.isfinite(normals).mean() > 0.9
    assert (folder / "report.html").stat().st_size > 100_000
