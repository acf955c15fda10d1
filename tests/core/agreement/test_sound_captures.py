"""Sound captures, simulated and real: nothing is said of them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from nlights_core.agreement.comparisons import compare_photographs
from nlights_core.capture import Encoding, Tile
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.photographs.images import grey
from nlights_core.reduced_light.samples import Rows, Samples, sample_photographs
from nlights_core.simulation.captures import BLACK_LEVEL, SATURATION, expose, set_up
from nlights_core.simulation.scenes import synthetic_stand

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.exists(), reason="the real captures are not beside the repository")

WIDTH = 120
CAPTURES = [
    (stand, scene, varnish, change)
    for k, stand in enumerate(("horizontal", "vertical-open", "vertical-dark", "synthetic"))
    for j, scene in enumerate(("plane", "drawing", "painting", "relief"))
    for varnish, change in ((False, "none"), (True, ("drift", "dark", "noise", "dust")[(k + j) % 4]))
]


def photographed(stand, scene, varnish, change, seed):
    """Samples of a simulated capture of as many pixels, with something that happens to sound ones too."""
    studio = set_up(stand, scene, WIDTH, varnish, seed)
    random = np.random.default_rng(seed)
    truth = studio.truth(0, studio.grid.rows)
    gain = 0.8 / studio.brightest()
    frames, flats = [], []
    for matt, gloss, flat in studio.radiance(0, studio.grid.rows, truth):
        art = matt * (0.1 if change == "dark" else 1) + gloss
        if change == "drift":
            art, flat = art * random.normal(1, 0.01), flat * random.normal(1, 0.01)
        if change == "dust":
            flat = flat * np.where(random.uniform(size=flat.shape[:2]) > 0.995, 0.6, 1)[..., None]
        frames.append(art)
        flats.append(flat)
    blank = np.zeros((*studio.grid.shape, 3), np.float32)

    def light(radiance):
        numbers = expose(radiance.astype(np.float32), gain, random)
        if change == "noise":
            numbers = numbers + random.normal(0, 60, numbers.shape)
        return grey((numbers - BLACK_LEVEL).astype(np.float32) / SATURATION)

    shots = np.stack([light(one) for one in frames]), np.stack([light(one) for one in flats])
    dark = light(blank) + np.float32(BLACK_LEVEL / SATURATION)
    black = dark.mean(axis=1)
    return Samples(
        lamps=tuple(stand.lamps),
        frames=shots[0],
        flats=shots[1],
        dark=dark,
        inside=np.ones(dark.shape, bool),
        grid=PixelGrid(*dark.shape, studio.grid.pixel_size, studio.grid.camera),
        block=1,
        step=1 / SATURATION,
        rows=Rows(shots[0].mean(axis=2) + black, shots[1].mean(axis=2) + black, black),
    )


def tile_of(stand):
    here = {lamp: Path(f"{lamp}.tif") for lamp in stand.lamps}
    return Tile(artwork="a", name="t", stand=stand, frames=here, flats=here)


@pytest.fixture(autouse=True)
def no_exif(monkeypatch):
    """The simulated photographs are no files."""
    monkeypatch.setattr("nlights_core.agreement.exposures.find_odd_exposures", lambda *_: [])
    monkeypatch.setattr("nlights_core.agreement.comparisons.find_odd_exposures", lambda *_: [])


@pytest.mark.parametrize(("stand", "scene", "varnish", "change"), CAPTURES)
def test_simulated_captures(stand, scene, varnish, change):
    measured = synthetic_stand() if stand == "synthetic" else load_stand(stand)
    samples = photographed(measured, scene, varnish, change, len(stand) + len(scene))
    tile = tile_of(measured)
    assert compare_photographs(samples, tile, None).warnings == []
    # Nor where less is known: no flats, no stand, few lamps, a mask.
    alone = dataclasses.replace(samples, flats=None)
    assert compare_photographs(alone, tile.model_copy(update={"flats": None}), None).warnings == []
    assert compare_photographs(samples, tile.model_copy(update={"stand": None}), None).warnings == []
    few = samples.of([samples.lamps[i] for i in (0, 3, 5, 6)])
    assert compare_photographs(few, tile, None).warnings == []
    masked = samples.frames.copy()
    masked[:, :, : WIDTH // 2] = np.nan
    assert compare_photographs(dataclasses.replace(samples, frames=masked), tile, None).warnings == []


REAL = {
    "psbox": ("psbox/Objects/*.png", None, {}),
    "psbox sphere": ("psbox/LightProbe-1/Image*.JPG", None, {}),
    "harvard cat": ("harvard/cat/Objects/*.png", None, {}),
    "harvard pig": ("harvard/pig/Objects/*.png", None, {}),
    "uw gray": ("uw/gray/gray.[0-9]*.tga", "uw/gray/gray.mask.tga", {}),
    "uw owl": ("uw/owl/owl.[0-9]*.tga", "uw/owl/owl.mask.tga", {}),
    "diligent ball": ("diligent/ball/0[0-3]?.png", "diligent/ball/mask.png", {}),
    "diligent bear": ("diligent/bear/0[2-4]?.png", "diligent/bear/mask.png", {}),
    "leaves": ("leaves/*.png", None, {}),
    "banknote": ("coins/banknote/I_*.png", None, {"mosaic": "RGGB"}),
    "coin": ("coins/italy/I_0[1248].png", None, {"mosaic": "RGGB"}),
}


@needs_data
@pytest.mark.parametrize(("pattern", "mask", "encoding"), REAL.values(), ids=REAL)
def test_real_captures_without_flats(tmp_path, pattern, mask, encoding):
    frames = {path.stem: path for path in sorted(DATA.glob(pattern))}
    assert len(frames) >= 4
    inside = None if mask is None else DATA / mask
    tile = Tile(artwork="a", name="t", frames=frames, mask=inside, encoding=Encoding(**encoding))
    samples = sample_photographs(tile, True, tmp_path)
    around = np.linspace(0, 6, len(frames))
    directions = np.stack(
        [0.5 * np.cos(around), 0.5 * np.sin(around), np.full(len(frames), 0.75**0.5)], axis=1
    )
    assert compare_photographs(samples, tile, LightField(tile.lamps, directions=directions)).warnings == []
