"""Meshes are read back with trimesh and compared with the analytic surface."""

import tracemalloc

import numpy as np
import pytest
import trimesh

from nlights_core import export, meshes
from nlights_core.export import srgb
from nlights_core.frames import PixelGrid
from nlights_core.meshes import write_glb, write_ply

GRID = PixelGrid(40, 60, 0.5, (20.0, -10.0, 300.0))


def bumps(grid, amplitude=2.0):
    x, y = np.meshgrid(grid.x(), grid.y())
    return (amplitude * np.sin(x / 4) * np.cos(y / 5)).astype(np.float32)


def load(path):
    return trimesh.load(path, process=False, maintain_order=True)


def grey_albedo(grid):
    return np.full((*grid.shape, 1), 0.5, np.float32)


def test_every_vertex_of_the_ply_lies_on_the_ray_of_its_pixel(tmp_path):
    height = bumps(GRID)
    assert write_ply(tmp_path / "m.ply", height, grey_albedo(GRID), GRID) == (2400, 2 * 39 * 59)
    mesh = load(tmp_path / "m.ply")
    x0, y0 = np.meshgrid(GRID.x(), GRID.y())
    camera = np.array(GRID.camera)
    start = np.stack([x0, y0, np.zeros_like(x0)], axis=-1).reshape(-1, 3)
    # P = start + t (camera - start) with the z of the map
    expected = start + (height.ravel() / camera[2])[:, None] * (camera - start)
    np.testing.assert_allclose(mesh.vertices, expected, atol=2e-5)


def test_all_faces_of_the_ply_look_at_the_camera_and_cover_the_field(tmp_path):
    grid = PixelGrid(40, 60, 0.5)
    write_ply(tmp_path / "m.ply", bumps(grid), grey_albedo(grid), grid)
    mesh = load(tmp_path / "m.ply")
    projected = mesh.triangles[:, :, :2]
    edge, other = projected[:, 1] - projected[:, 0], projected[:, 2] - projected[:, 0]
    area = (edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]) / 2
    assert (area > 0).all()
    assert area.sum() == pytest.approx(39 * 59 * 0.25)


def test_an_unknown_pixel_has_no_vertex_and_opens_a_hole(tmp_path):
    height = bumps(GRID)
    height[7, 9] = np.nan
    height[0, :] = np.nan
    vertices, faces = write_ply(tmp_path / "m.ply", height, grey_albedo(GRID), GRID)
    assert (vertices, faces) == (2400 - 61, 2 * (38 * 59 - 4))
    mesh = load(tmp_path / "m.ply")
    assert (len(mesh.vertices), len(mesh.faces)) == (vertices, faces)
    # A triangle that joined wrong pixels would be longer than a pixel's diagonal allows.
    assert mesh.edges_unique_length.max() < 2.0


def test_the_ply_is_the_same_however_the_bands_fall(tmp_path, monkeypatch):
    height = bumps(GRID)
    height[10:13, 20:50] = np.nan
    albedo = np.random.default_rng(0).random((40, 60, 3), dtype=np.float32)
    write_ply(tmp_path / "a.ply", height, albedo, GRID)
    monkeypatch.setattr(export, "BAND_BYTES", 1)
    write_ply(tmp_path / "b.ply", height, albedo, GRID)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_the_ply_is_coloured_with_the_srgb_albedo(tmp_path):
    albedo = np.random.default_rng(1).random((40, 60, 3), dtype=np.float32)
    albedo[0, 0] = np.nan
    write_ply(tmp_path / "m.ply", bumps(GRID), albedo, GRID)
    colours = load(tmp_path / "m.ply").visual.vertex_colors[:, :3]
    np.testing.assert_array_equal(colours, np.rint(255 * srgb(albedo)).reshape(-1, 3))
    assert colours[0].tolist() == [0, 0, 0]


def test_the_header_of_the_ply_states_unit_and_frame(tmp_path):
    write_ply(tmp_path / "m.ply", bumps(GRID), grey_albedo(GRID), GRID)
    header = (tmp_path / "m.ply").read_bytes().split(b"end_header")[0].decode()
    assert "unit mm" in header
    assert "z from the artwork to the camera" in header


def test_progress_rises_to_one(tmp_path):
    shares = []
    write_ply(tmp_path / "m.ply", bumps(GRID), grey_albedo(GRID), GRID, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1


def test_nothing_known_gives_an_empty_ply_and_no_glb(tmp_path):
    height = np.full(GRID.shape, np.nan, np.float32)
    assert write_ply(tmp_path / "m.ply", height, grey_albedo(GRID), GRID) == (0, 0)
    with pytest.raises(ValueError, match="no 2 x 2 pixels"):
        write_glb(tmp_path / "m.glb", height, grey_albedo(GRID), GRID)


def test_the_memory_of_the_ply_follows_the_band(tmp_path, monkeypatch):
    monkeypatch.setattr(export, "BAND_BYTES", 1 << 20)
    grid = PixelGrid(1500, 1000, 0.1)
    height = np.memmap(tmp_path / "z", np.float32, "w+", shape=grid.shape)
    albedo = np.memmap(tmp_path / "a", np.float32, "w+", shape=(*grid.shape, 3))
    tracemalloc.start()
    write_ply(tmp_path / "m.ply", height, albedo, grid)  # 61 MB
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16 << 20


def test_the_glb_is_in_metres_upright_and_faces_the_viewer(tmp_path):
    grid = PixelGrid(40, 60, 0.5)
    height = bumps(grid)
    found = write_glb(tmp_path / "m.glb", height, grey_albedo(grid), grid)
    mesh = trimesh.load(tmp_path / "m.glb").to_geometry()
    assert found["faces"] == len(mesh.faces) == 2 * 39 * 59
    assert found["vertices"] == len(mesh.vertices) == 2400
    assert found["largest_deviation_mm"] == 0
    assert found["covered"] == 1
    np.testing.assert_allclose(mesh.extents, [59 * 0.0005, 39 * 0.0005, np.ptp(height) / 1000], rtol=1e-5)
    assert (mesh.face_normals[:, 2] > 0).all()


def test_perspective_moves_the_vertices_of_the_glb_as_it_moves_the_grid(tmp_path):
    height = bumps(GRID)
    write_glb(tmp_path / "m.glb", height, grey_albedo(GRID), GRID)
    mesh = trimesh.load(tmp_path / "m.glb").to_geometry()
    expected = GRID.points(0, 40, height).reshape(3, -1).T / 1000
    np.testing.assert_allclose(np.sort(mesh.vertices, axis=0), np.sort(expected, axis=0), atol=1e-7)


def test_the_texture_lies_on_the_surface_the_right_way_up(tmp_path):
    grid = PixelGrid(40, 60, 0.5)
    albedo = np.zeros((40, 60, 3), np.float32)
    albedo[:20, :, 0] = 1  # upper half red
    albedo[:, 30:, 2] = 1  # right half blue
    write_glb(tmp_path / "m.glb", bumps(grid), albedo, grid)
    mesh = trimesh.load(tmp_path / "m.glb").to_geometry()
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    # trimesh hands out v upwards again
    column = (mesh.visual.uv[:, 0] * 60).astype(int).clip(0, 59)
    row = ((1 - mesh.visual.uv[:, 1]) * 40).astype(int).clip(0, 39)
    seen = texture[row, column]
    np.testing.assert_array_equal(seen[:, 0] == 255, mesh.vertices[:, 1] > 0)
    np.testing.assert_array_equal(seen[:, 2] == 255, mesh.vertices[:, 0] > 0)


def heights_under(mesh, x, y):
    """Every height of the mesh at points, by barycentric coordinates: (points, faces), else NaN."""
    a, b, c = (mesh.triangles[:, i] for i in range(3))
    det = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    px, py = x[:, None] - a[:, 0], y[:, None] - a[:, 1]
    u = (px * (c[:, 1] - a[:, 1]) - py * (c[:, 0] - a[:, 0])) / det
    v = (py * (b[:, 0] - a[:, 0]) - px * (b[:, 1] - a[:, 1])) / det
    z = a[:, 2] + u * (b[:, 2] - a[:, 2]) + v * (c[:, 2] - a[:, 2])
    return np.where((u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6), z, np.nan)


def test_the_stated_deviation_of_the_decimated_mesh_is_true(tmp_path):
    grid = PixelGrid(40, 60, 0.5)
    height = bumps(grid)
    found = write_glb(tmp_path / "m.glb", height, grey_albedo(grid), grid, faces=400)
    mesh = trimesh.load(tmp_path / "m.glb").to_geometry()
    assert len(mesh.faces) == found["faces"] <= 400
    x, y = np.meshgrid(grid.x(), grid.y())
    under = heights_under(mesh, x.ravel() / 1000, y.ravel() / 1000) * 1000
    deviation = np.nanmax(np.abs(under - height.ravel()[:, None]))
    assert found["largest_deviation_mm"] == pytest.approx(deviation, rel=1e-3)
    assert found["covered"] == pytest.approx(np.isfinite(under).any(axis=1).mean(), abs=2e-3)
    assert 0 < deviation < 0.5


def test_scale_does_not_change_which_edges_collapse(tmp_path):
    small, large = PixelGrid(40, 60, 0.5), PixelGrid(40, 60, 50.0)
    height = bumps(small)
    one = write_glb(tmp_path / "a.glb", height, grey_albedo(small), small, faces=400)
    two = write_glb(tmp_path / "b.glb", height * 100, grey_albedo(large), large, faces=400)
    assert two["faces"] == one["faces"]
    assert two["largest_deviation_mm"] == pytest.approx(100 * one["largest_deviation_mm"], rel=1e-3)


def test_a_large_height_map_is_reduced_before_it_is_decimated(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "REDUCED_PIXELS", 700)
    grid = PixelGrid(40, 60, 0.5)
    height = bumps(grid)
    height[:, :4] = np.nan
    found = write_glb(tmp_path / "m.glb", height, grey_albedo(grid), grid)
    assert found["vertices"] == 20 * 28
    mesh = trimesh.load(tmp_path / "m.glb").to_geometry()
    x, y = grid.block_centres(2)
    np.testing.assert_allclose(mesh.bounds[:, :2] * 1000, [[x[2], y.min()], [x[-1], y.max()]], rtol=1e-5)


def test_the_same_surface_gives_the_same_glb(tmp_path):
    albedo = np.random.default_rng(2).random((40, 60, 3), dtype=np.float32)
    for name in "ab":
        write_glb(tmp_path / f"{name}.glb", bumps(GRID), albedo, GRID, faces=500)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
