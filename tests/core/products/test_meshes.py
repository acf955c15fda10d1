"""Meshes are read back with trimesh and compared with the analytic surface."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
import trimesh

from nlights_core.files import reduction
from nlights_core.frames import PixelGrid
from nlights_core.products import compiled_meshes, meshes
from nlights_core.products.meshes import refined, write_glb
from nlights_core.products.pixel_meshes import write_ply
from nlights_core.products.viewing import srgb

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
    monkeypatch.setattr(reduction, "BAND_BYTES", 1)
    write_ply(tmp_path / "b.ply", height, albedo, GRID)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_the_ply_is_coloured_with_the_srgb_albedo(tmp_path):
    albedo = np.random.default_rng(1).random((40, 60, 3), dtype=np.float32)
    albedo[0, 0] = np.nan
    write_ply(tmp_path / "m.ply", bumps(GRID), albedo, GRID)
    colours = load(tmp_path / "m.ply").visual.vertex_colors[:, :3]
    assert np.abs(colours - 255 * np.nan_to_num(srgb(albedo)).reshape(-1, 3)).max() <= 0.5 + 1e-3
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
    monkeypatch.setattr(reduction, "BAND_BYTES", 1 << 20)
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


def test_the_normals_of_the_glb_are_those_of_its_surface():
    places, corners = refined(bumps(PixelGrid(65, 65, 1.0)), 1000)
    found = np.empty(places.shape, np.float32)
    compiled_meshes.vertex_normals(places, corners, found)
    expected = trimesh.Trimesh(places, corners, process=False).vertex_normals
    np.testing.assert_allclose(found, expected, atol=1e-6)


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


def deviations_of(path, grid, height):
    """Distance along z of a mesh from every pixel of a height (orthographic grids), NaN off the mesh, mm."""
    mesh = trimesh.load(path).to_geometry()
    x, y = np.meshgrid(grid.x(), grid.y())
    under = heights_under(mesh, x.ravel() / 1000, y.ravel() / 1000) * 1000
    distance = np.abs(under - height.ravel()[:, None])
    off = np.isnan(under).all(axis=1)
    return np.where(off, np.nan, np.nanmax(np.where(off[:, None], 0, distance), axis=1)), mesh


def test_the_stated_deviation_of_the_decimated_mesh_is_true(tmp_path):
    grid = PixelGrid(40, 60, 0.5)
    height = bumps(grid)
    found = write_glb(tmp_path / "m.glb", height, grey_albedo(grid), grid, faces=400)
    distance, mesh = deviations_of(tmp_path / "m.glb", grid, height)
    assert len(mesh.faces) == found["faces"] <= 400
    assert found["largest_deviation_mm"] == pytest.approx(np.nanmax(distance), rel=1e-3)
    assert found["rms_deviation_mm"] == pytest.approx(np.sqrt(np.nanmean(distance**2)), rel=1e-2)
    assert found["covered"] == pytest.approx(np.isfinite(distance).mean(), abs=2e-3)
    assert 0 < np.nanmax(distance) < 0.5


def test_the_stated_deviation_includes_what_reduction_averaged_away(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "REDUCED_PIXELS", 700)
    grid = PixelGrid(40, 60, 0.5)
    checkers = np.float32(0.1) * (np.indices(grid.shape).sum(axis=0) % 2).astype(np.float32)
    found = write_glb(tmp_path / "m.glb", checkers, grey_albedo(grid), grid)
    assert found["largest_deviation_mm"] == pytest.approx(0.05)
    assert found["rms_deviation_mm"] == pytest.approx(0.05)


def test_the_deviation_of_a_tilted_triangle_is_that_of_its_plane():
    height = np.zeros((9, 9), np.float32)
    height[2, 1] = np.nan
    places = np.array([[0.5, 0.5, 1.0], [0.5, 7.5, 8.0], [7.5, 0.5, 1.0]])  # z = row + 0.5
    found = meshes.deviation(places, np.array([[0, 1, 2]]), height)
    rows, columns = np.indices(height.shape)
    inside = (rows > 0) & (columns > 0) & (rows + columns <= 8)
    known = inside & np.isfinite(height)
    assert found["largest_deviation_mm"] == pytest.approx(7.5)
    assert found["rms_deviation_mm"] == pytest.approx(np.sqrt(np.mean((rows[known] + 0.5) ** 2)))
    assert found["covered"] == known.sum() / 80
    assert found["bridged"] == 1


def test_a_plane_takes_few_triangles_and_no_deviation(tmp_path):
    grid = PixelGrid(257, 385, 0.5)
    x, y = np.meshgrid(grid.x(), grid.y())
    found = write_glb(
        tmp_path / "m.glb", (x / 64 - y / 32).astype(np.float32), grey_albedo(grid), grid, faces=5000
    )
    assert found["faces"] == 2 * 2 * 3
    assert found["largest_deviation_mm"] < 1e-5
    assert found["covered"] == 1


def test_the_network_closes_without_gaps_and_faces_the_camera():
    grid = PixelGrid(150, 200, 1.0)
    places, corners = refined(bumps(grid), 4000)
    assert 3500 < len(corners) < 4500
    a, b, c = (places[corners[:, i], :2] for i in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    assert (area < 0).all()  # rows go down: clockwise there is counter-clockwise for the camera
    assert -area.sum() / 2 == 149 * 199
    edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, faces = np.unique(edges, axis=0, return_counts=True)
    once = np.unique(edges, axis=0)[faces == 1]
    at_border = np.isin(places[once, 0], [0, 199]).all(axis=1) | np.isin(places[once, 1], [0, 149]).all(
        axis=1
    )
    assert faces.max() == 2
    assert at_border.all()


def test_more_faces_follow_the_surface_more_closely():
    height = bumps(PixelGrid(200, 200, 1.0))
    found = [meshes.deviation(*refined(height, faces), height) for faces in (1000, 4000, 16000)]
    for worse, better in pairwise(found):
        assert better["largest_deviation_mm"] < worse["largest_deviation_mm"] / 1.5
        assert better["rms_deviation_mm"] < worse["rms_deviation_mm"] / 2


def test_what_is_not_known_is_not_bridged(tmp_path):
    grid = PixelGrid(300, 300, 0.5)
    height = bumps(grid)
    row, column = np.indices(grid.shape)
    hole = np.hypot(row - 100, column - 170) < 30
    height[hole] = np.nan
    found = write_glb(tmp_path / "m.glb", height, grey_albedo(grid), grid, faces=10_000)
    assert found["bridged"] < 0.01
    assert found["covered"] > 0.99
    mesh = trimesh.load(tmp_path / "m.glb").to_geometry()
    middle = np.abs(mesh.triangles_center[:, :2] * 1000 - [grid.x()[170], grid.y()[100]])
    assert (np.hypot(*middle.T) > 14).all()


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
    x, y = grid.reduced(2).x(), grid.reduced(2).y()
    np.testing.assert_allclose(mesh.bounds[:, :2] * 1000, [[x[2], y.min()], [x[-1], y.max()]], rtol=1e-5)


def test_the_same_surface_gives_the_same_glb(tmp_path):
    albedo = np.random.default_rng(2).random((40, 60, 3), dtype=np.float32)
    for name in "ab":
        write_glb(tmp_path / f"{name}.glb", bumps(GRID), albedo, GRID, faces=500)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()
