"""The maps that leave the system are what was measured, however they are written."""

import numpy as np
import pytest
import tifffile

from nlights_core.errors import TileError
from nlights_core.files import reduction, tiffs
from nlights_core.frames import PixelGrid
from nlights_core.machine import band_threads
from nlights_core.products.integrability import integrable_normals, integrable_uncertainty
from nlights_core.products.writing import write_maps
from nlights_core.simulation.surfaces import bow, normal_field, wave

GRID = PixelGrid(60, 80, 0.5, (3.0, -2.0, 400.0))


@pytest.fixture
def maps():
    rng = np.random.default_rng(5)
    noisy = normal_field(bow(0.5, 40.0, 30.0) + wave(0.1, 6.0), GRID).normals + rng.normal(
        0, 0.01, (*GRID.shape, 3)
    )
    found = {
        "normals": noisy / np.linalg.norm(noisy, axis=-1, keepdims=True),
        "albedo": rng.uniform(0.1, 0.8, (*GRID.shape, 3)),
        "reflection": rng.uniform(-0.1, 0.1, (*GRID.shape, 3)),
        "confidence": rng.uniform(0.1, 0.3, GRID.shape),
        "height": rng.normal(0, 0.1, GRID.shape),
        "trend": rng.normal(0, 0.1, GRID.shape),
    }
    for values in found.values():
        values[20:30, 40:50] = np.nan
    return {name: values.astype(np.float32) for name, values in found.items()}


def written(folder, maps, **options):
    folder.mkdir()
    coloured = folder.parent / f"{folder.name}-coloured"
    coloured.mkdir()
    for name in ("albedo", "reflection"):
        tiffs.write_tiff(coloured / f"{name}.tif", maps[name], GRID, description=name)
    options = {
        "coloured": coloured,
        "absolute": True,
        "progress": lambda share: None,
        "integrated": maps["height"],
        "perspective": True,
    } | options
    write_maps(folder, maps, GRID, **options)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_each_map_holds_what_it_says(tmp_path, maps):
    written(tmp_path / "m", maps)
    corrected = integrable_normals(maps["normals"], maps["height"], GRID, 0, 60, perspective=True)
    expected = {
        "normals": corrected,
        "confidence": integrable_uncertainty(maps["confidence"], 0, 60),
        "albedo": maps["albedo"],
        "reflection": maps["reflection"],
        "height": maps["height"],
        "trend": maps["trend"],
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "m" / f"{name}.tif"), values, err_msg=name)


def test_without_an_integrated_height_the_normals_are_as_measured(tmp_path, maps):
    written(tmp_path / "m", maps, integrated=None)
    for name in ("normals", "confidence"):
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "m" / f"{name}.tif"), maps[name])


def test_any_number_of_threads_writes_the_same_bytes(tmp_path, maps, monkeypatch):
    monkeypatch.setattr(reduction, "BAND_BYTES", 7000)
    found = []
    for count in (1, 2, 5):
        monkeypatch.setattr(band_threads, "cores", lambda count=count: count)
        found.append(written(tmp_path / str(count), maps))
    assert found[0] == found[1] == found[2]
    assert len(found[0]) == 8


def test_compression_changes_no_value(tmp_path, maps):
    written(tmp_path / "plain", maps)
    written(tmp_path / "packed", maps, compression="zstd")
    for path in (tmp_path / "plain").glob("*.tif"):
        with tifffile.TiffFile(tmp_path / "packed" / path.name) as file:
            assert file.pages[0].compression == tifffile.COMPRESSION.ZSTD
            np.testing.assert_array_equal(file.asarray(), tifffile.imread(path))


def test_a_relative_albedo_is_shown_bright_but_kept_as_it_is(tmp_path, maps):
    dark = maps | {"albedo": maps["albedo"] / 100}
    written(tmp_path / "m", dark, absolute=False)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "m" / "albedo.tif"), dark["albedo"])
    assert 60_000 < tifffile.imread(tmp_path / "m" / "albedo_view.tif").max() <= 65_535


def test_maps_of_nothing_are_refused(tmp_path, maps):
    nothing = {name: np.full_like(values, np.nan) for name, values in maps.items()}
    with pytest.raises(TileError, match="not a single pixel"):
        written(tmp_path / "m", nothing)
