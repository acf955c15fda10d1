"""Known heights are read from files as instruments write them, and compared where they lie."""

import numpy as np
import pytest
import trimesh

from nlights_core.capture import HeightFile
from nlights_core.errors import TileError
from nlights_core.fields import HeightMap, KnownHeights
from nlights_core.frames import PixelGrid
from nlights_core.integration.known_heights import (
    MOST,
    differences,
    heights_at,
    read_differences,
    read_known_heights,
    write_differences,
)
from nlights_core.simulation.surfaces import bow, height_map, plane, wave

POINTS = np.array([[-10.0, 5.0, 0.25], [12.5, -3.0, 0.5], [0.0, 0.0, -0.125]])


def read(path, text=None, **stated):
    if text is not None:
        path.write_text(text, encoding="utf-8")
    return read_known_heights(HeightFile(file=path, **stated))


@pytest.mark.parametrize(
    "text",
    [
        "x_mm,y_mm,z_mm,sigma_mm\n-10,5,0.25,0.02\n12.5,-3,0.5,0.02\n0,0,-0.125,0.02\n",
        "\ufeffx_mm;y_mm;z_mm;sigma_mm\r\n-10;5;0.25;0.02\r\n12.5;-3;0.5;0.02\r\n0;0;-0.125;0.02\r\n",
        "# probe of 3 May\n\nz_mm\tsigma_mm\tname\ty_mm\tx_mm\n0.25\t.02\ta\t5\t-10\n\n0.5\t.02\tb\t-3\t12.5\n"
        "# once more\n-0.125\t2e-2\tc\t0\t0\n",
    ],
)
def test_a_csv_is_read_whatever_divides_it(tmp_path, text):
    known = read(tmp_path / "probe.csv", text)
    assert np.array_equal(known.points, POINTS)
    assert np.array_equal(known.sigma, np.full(3, 0.02))
    assert known.source == "probe.csv"


def test_what_the_manifest_says_of_the_file_is_kept(tmp_path):
    text = "x_mm,y_mm,z_mm\n-10,5,0.25\n"
    known = read(tmp_path / "probe.csv", text, sigma_mm=0.03, registration_mm=0.4, tilted=True)
    assert (known.sigma.tolist(), known.registration_mm, known.tilted) == ([0.03], 0.4, True)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_a_ply_is_read_as_points_or_as_a_mesh(tmp_path, encoding):
    for name, shape in (
        ("points.ply", trimesh.PointCloud(POINTS)),
        ("mesh.ply", trimesh.Trimesh(POINTS, [[0, 1, 2]], process=False)),
    ):
        shape.export(tmp_path / name, encoding=encoding)
        known = read(tmp_path / name, sigma_mm=0.05)
        assert known.points == pytest.approx(POINTS, abs=1e-6)
        assert np.array_equal(known.sigma, np.full(3, 0.05))


def test_of_a_large_scan_points_are_kept_from_all_over(tmp_path):
    count = 2 * MOST + 1
    points = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1)
    trimesh.PointCloud(points).export(tmp_path / "scan.ply")
    known = read(tmp_path / "scan.ply", sigma_mm=0.05)
    assert MOST / 2 < len(known.points) <= MOST
    assert len(known.sigma) == len(known.points)
    assert np.ptp(known.points[:, 0]) > 0.99 * count


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "x,y,z\n1,2,3\n", ["no column x_mm, y_mm, z_mm", "plane frame"]),
        ("a.csv", "", ["no column"]),
        ("a.csv", "x_mm,y_mm,z_mm\n", ["no points"]),
        ("a.csv", "x_mm,y_mm,z_mm\n1,2,3\n", ["sigma_mm", "manifest"]),
        ("a.csv", "# one\nx_mm,y_mm,z_mm\n1,2,3\n1,2\n", ["a.csv:4:", "z_mm", "got ''"]),
        ("a.csv", "x_mm;y_mm;z_mm\n1;2;0,3\n", ["a.csv:2:", "z_mm", "decimal point", "'0,3'"]),
        ("a.csv", "x_mm,y_mm,z_mm,sigma_mm\n1,2,3,0\n", ["a.csv:2:", "sigma_mm", "above 0"]),
        ("a.csv", "x_mm,y_mm,z_mm\n1,nan,3\n", ["y_mm", "finite"]),
        ("a.ply", "x_mm,y_mm,z_mm\n1,2,3\n", ["no PLY"]),
        ("a.ply", "", ["no PLY"]),
        ("a.xlsx", "", ["neither a CSV nor a PLY"]),
        ("missing.csv", None, ["cannot be read", "correct its name"]),
    ],
)
def test_a_fault_of_the_file_is_told_with_its_place(tmp_path, name, text, words):
    with pytest.raises(TileError) as fault:
        read(tmp_path / name, text)
    for word in (str(tmp_path / name), "known_heights", *words):
        assert word in str(fault.value)


def test_a_file_that_is_no_text_and_a_folder_are_told(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"x_mm,y_mm,z_mm\n\xff\xfe,1,2\n")
    with pytest.raises(TileError, match="no CSV in UTF-8"):
        read(tmp_path / "a.csv")
    (tmp_path / "b.csv").mkdir()
    with pytest.raises(TileError, match="a folder, where a file"):
        read(tmp_path / "b.csv")


@pytest.mark.parametrize("camera", [None, (20.0, -10.0, 400.0)])
def test_heights_are_looked_up_where_the_point_lies_and_not_where_it_is_seen(camera):
    grid = PixelGrid(90, 120, 1.0, camera)
    surface = plane(0.05, -0.08, level=6.0) + wave(0.4, 30.0, angle_deg=25.0)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-45, 45, 60), rng.uniform(-35, 35, 60)
    known = KnownHeights(np.stack([x, y, np.zeros(60)], axis=1), np.ones(60))
    found, spread = heights_at(height_map(surface, grid), known)
    assert found == pytest.approx(surface.height(x, y), abs=6e-3)
    assert not spread.any()


def test_points_outside_and_where_nothing_is_known_have_no_height():
    field = height_map(plane(), PixelGrid(40, 60, 0.5))
    field.height[:20] = np.nan
    at = [[0, -5, 0], [0, 5, 0], [15.2, -5, 0], [14.9, -5, 0], [0, -10.5, 0]]
    found, _ = heights_at(field, KnownHeights(np.array(at, float), np.ones(5)))
    assert np.isfinite(found).tolist() == [True, False, False, True, False]


def test_an_uncertain_place_on_a_slope_is_an_uncertain_height():
    field = height_map(plane(slope_x=0.3, slope_y=0.4), PixelGrid(80, 100, 0.2))
    known = KnownHeights(np.array([[1.0, -2.0, 0.0], [9.7, 0.0, 0.0]]), np.ones(2), registration_mm=0.6)
    found, spread = heights_at(field, known)
    assert found[0] == pytest.approx(0.3 - 0.8, abs=1e-6)
    assert spread[0] == pytest.approx(0.5 * 0.6, rel=1e-4)


def test_differences_are_written_after_the_best_constant_and_read_again(tmp_path):
    grid = PixelGrid(60, 80, 1.0)
    surface = bow(0.3, 80, 60)
    field, removed = height_map(surface, grid), height_map(surface, grid).height
    at = np.stack([np.linspace(-30, 30, 9), np.linspace(20, -20, 9), np.full(9, 7.0)], axis=1)
    at[4] += (0, 0, 0.5)
    at[8, 0] = 70
    known = KnownHeights(at, np.full(9, 0.02))
    write_differences(tmp_path, field, removed, known)
    before, after = read_differences(tmp_path)
    assert np.isnan(before).tolist() == [False] * 8 + [True]
    assert np.nanmax(np.abs(before[:4])) > 0.05
    assert after[:8] == pytest.approx([0, 0, 0, 0, -0.5, 0, 0, 0], abs=2e-4)
    assert (
        (tmp_path / "known_heights.csv")
        .read_text()
        .splitlines()[0]
        .startswith("x_mm,y_mm,z_mm,sigma_mm,before")
    )
    assert read_differences(tmp_path / "elsewhere") is None


def test_a_tilt_that_is_free_is_no_difference():
    field = HeightMap(np.zeros((60, 80), np.float32), PixelGrid(60, 80, 1.0))
    x, y = np.array([-30.0, 30, -30, 30, 0]), np.array([-20.0, -20, 20, 20, 0])
    points = np.stack([x, y, 2 + 0.01 * x - 0.02 * y], axis=1)
    assert differences(field, KnownHeights(points, np.ones(5), tilted=True)) == pytest.approx(
        np.zeros(5), abs=1e-9
    )
    assert np.abs(differences(field, KnownHeights(points, np.ones(5)))).max() > 0.5
