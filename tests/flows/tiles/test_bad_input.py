"""Bad input: one sentence, no traceback, no half product, and the others go on."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

NLIGHTS = Path(sys.executable).parent / "nlights"
SHAPE = (120, 160, 3)


def digitise(capture: Path, out: Path, *options, code: int) -> str:
    done = subprocess.run(
        [NLIGHTS, "digitise", capture, "--out", out, *map(str, options)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


def leftovers(out: Path) -> list[Path]:
    return list(out.rglob(".draft-*")) if out.exists() else []


def black(path: Path) -> None:
    tifffile.imwrite(path, np.zeros(SHAPE, np.uint16), photometric="rgb")


def burnt(path: Path) -> None:
    tifffile.imwrite(path, np.full(SHAPE, 65535, np.uint16), photometric="rgb")


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:60000])


def smaller(path: Path) -> None:
    tifffile.imwrite(path, tifffile.imread(path)[:100], photometric="rgb")


def shallower(path: Path) -> None:
    tifffile.imwrite(path, (tifffile.imread(path) >> 8).astype(np.uint8), photometric="rgb")


def not_an_image(path: Path) -> None:
    path.write_bytes(b"this is no photograph" * 100)


def empty(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (Path.unlink, ["no such file"]),
        (black, ["all black", "lamp"]),
        (burnt, ["saturated", "shorter exposure"]),
        (truncated, []),
        (smaller, ["160 x 100", "160 x 120"]),
        (shallower, ["uint8", "uint16"]),
        (not_an_image, []),
        (empty, ["empty"]),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_bad_photograph_costs_its_own_tile_and_no_other(two_tiles, tmp_path, spoil, words):
    spoil(two_tiles / "a" / "light_3.tif")
    out = tmp_path / "out"
    said = digitise(two_tiles, out, code=1)
    assert "light_3.tif" in said
    assert "1 of 2 tiles done, 1 failed" in said
    for word in words:
        assert word in said, said
    assert (out / "inv-1" / "b" / "report.html").exists()
    assert not (out / "inv-1" / "a").exists()
    assert not leftovers(out)


def test_not_a_number_in_a_float_photograph_costs_its_tile(two_tiles, tmp_path):
    for path in (*two_tiles.glob("*/*.tif"), two_tiles / "dark.tif"):
        image = (tifffile.imread(path) / 65535).astype(np.float32)
        if path.name == "light_3.tif" and path.parent.name == "a":
            image[7, 7] = np.nan
        tifffile.imwrite(path, image, photometric="rgb" if image.ndim == 3 else "minisblack")
    said = digitise(two_tiles, tmp_path / "out", code=1)
    assert "light_3.tif" in said
    assert "NaN" in said


def test_a_flat_of_another_size_leaves_nothing_to_produce(two_tiles, tmp_path):
    smaller(two_tiles / "flat" / "light_1.tif")
    said = digitise(two_tiles, tmp_path / "out", code=2)
    assert "flats.Relio_1" in said
    assert not (tmp_path / "out" / "inv-1").exists()


def test_flats_that_the_recipe_needs_are_asked_for(capture, tmp_path):
    text = (capture / "artwork.yaml").read_text()
    head, _, tail = text.partition("flats:")
    (capture / "artwork.yaml").write_text(head + tail[tail.index("dark:") :])
    said = digitise(capture, tmp_path / "out", code=2)
    assert "flats" in said
    assert "choose another detrend.images" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        (
            "integrator: {use: simchonny}",
            ["no integrator is called 'simchonny'", "did you mean 'simchony'", "0.1.0"],
        ),
        ("integrator: {use: simchony, stencl: x}", ["integrator.stencl", "unknown field", "stencil"]),
        ("integrator: {use: simchony}\npases: 2", ["pases", "did you mean 'passes'"]),
        ("integrator: {use: simchony}\npasses: 0", ["passes", "at least 1"]),
        (
            "integrator: simchony\nnormals: {use: least-squares, shadow: -1}",
            ["normals.shadow", "at least 0", "-1"],
        ),
    ],
)
def test_a_bad_recipe_stops_before_anything_is_written(capture, tmp_path, recipe, words):
    path = tmp_path / "bad.yaml"
    lines = [recipe, "light_model: {use: measured-poi}"]
    if "normals" not in recipe:
        lines.append("normals: {use: least-squares}")
    path.write_text("\n".join(lines))
    said = digitise(capture, tmp_path / "out", "--recipe", path, code=2)
    assert "bad.yaml:" in said
    for word in words:
        assert word in said, said
    assert not (tmp_path / "out").exists()


def test_a_bad_manifest_stops_before_anything_is_written(capture, tmp_path):
    text = (capture / "artwork.yaml").read_text()
    (capture / "artwork.yaml").write_text(text.replace("name: r0c0", "name: ../../r0c0"))
    assert "not a plain name" in digitise(capture, tmp_path / "out", code=2)
    assert not (tmp_path / "out").exists()


def test_an_output_folder_that_cannot_be_written_is_told(capture, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    said = digitise(capture, blocked / "out", code=2)
    assert str(blocked) in said
    assert "--out" in said


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="needs to mount a small file system")
@pytest.mark.parametrize("where", ["--store", "--out"])
def test_a_full_disk_leaves_no_half_product(capture, tmp_path, where):
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1500k", "tmpfs", small], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("mounting is not allowed here")
    try:
        if where == "--store":
            said = digitise(capture, tmp_path / "out", "--store", small / "store", code=2)
        else:
            said = digitise(capture, small / "out", "--store", tmp_path / "store", code=2)
        assert "disk is full" in said
        assert not leftovers(tmp_path)
        assert not list(tmp_path.rglob("report.html")) or where == "--out"
        assert not (small / "out" / "simulated-painting" / "r0c0").exists()
    finally:
        subprocess.run(["umount", small], check=True)


def test_a_plugin_that_breaks_costs_the_tile_with_its_name(two_tiles, tmp_path):
    # An impossible condition number leaves no pixel known: the honest end of a hopeless tile.
    recipe = tmp_path / "hopeless.yaml"
    recipe.write_text(
        "light_model: measured-poi\nnormals: {use: least-squares, condition: 1.0001}\nintegrator: simchony\n"
    )
    said = digitise(two_tiles, tmp_path / "out", "--recipe", recipe, code=2)
    assert "found no height" in said
    shutil.rmtree(tmp_path / "out")
