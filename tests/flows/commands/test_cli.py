"""The command line, run as people run it: a process of its own."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.simulation.evaluation import angles_between

NLIGHTS = Path(sys.executable).parent / "nlights"
PRODUCTS = {
    "albedo.tif",
    "albedo_view.tif",
    "confidence.tif",
    "height.tif",
    "height_uncertainty.tif",
    "mesh.glb",
    "mesh.ply",
    "normals.tif",
    "normals_opengl.png",
    "provenance.json",
    "quality.json",
    "reflection.tif",
    "report.html",
    "warnings.json",
}


def nlights(*words, code=0) -> subprocess.CompletedProcess:
    done = subprocess.run(
        [NLIGHTS, *map(str, words)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def products(out: Path) -> list[Path]:
    return [path for path in out.rglob("*") if path.is_file() and ".store" not in path.parts]


@pytest.fixture(scope="module")
def digitised(painting, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("out")
    nlights("digitise", painting / "artwork.yaml", "--out", out)
    return out


def test_a_capture_becomes_every_product(digitised):
    folder = digitised / "simulated-painting" / "r0c0"
    assert {path.name for path in folder.iterdir()} == PRODUCTS
    normals, height = tifffile.imread(folder / "normals.tif"), tifffile.imread(folder / "height.tif")
    assert normals.shape == (120, 160, 3)
    assert height.shape == (120, 160)
    assert normals.dtype == height.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)


def test_the_stated_uncertainty_covers_68_percent_of_the_errors(digitised, painting):
    folder = digitised / "simulated-painting" / "r0c0"
    names = ("normals.tif", "confidence.tif")
    normals, stated = (tifffile.imread(folder / name) for name in names)
    errors = angles_between(normals, tifffile.imread(painting / "truth" / "normals.tif"))
    # The whole, and each quarter of the field: dim corners state more.
    assert np.mean(errors <= stated) == pytest.approx(0.68, abs=0.05)
    for rows in (slice(0, 60), slice(60, 120)):
        for columns in (slice(0, 80), slice(80, 160)):
            covered = np.mean(errors[rows, columns] <= stated[rows, columns])
            assert covered == pytest.approx(0.68, abs=0.05)


def test_the_products_agree_with_the_truth(digitised, painting):
    folder = digitised / "simulated-painting" / "r0c0"
    done = nlights("evaluate", folder, "--truth", painting / "truth")
    result = json.loads((folder / "evaluation.json").read_text())
    # With 160 columns the noise of the flats weighs; at 1000 columns it is 0.18 degree and 0.005 mm.
    assert result["angle_mean_deg"] < 0.4
    assert result["height_rms_mm"] < 0.2
    assert result["known_share"] == 1
    assert result["normals_coverage"] == pytest.approx(0.68, abs=0.05)
    said = dict(line.split(": ") for line in done.stdout.splitlines())
    assert set(said) == set(result)
    assert float(said["normals_coverage"]) == pytest.approx(result["normals_coverage"], rel=1e-5)


def test_what_products_state_no_uncertainty_of_is_said_to_be_not_measured(painting, tmp_path):
    for name in ("normals.tif", "height.tif"):
        shutil.copy(painting / "truth" / name, tmp_path)
    done = nlights("evaluate", tmp_path, "--truth", painting / "truth")
    assert "normals_coverage: not measured\n" in done.stdout
    assert "height_coverage: not measured\n" in done.stdout
    result = json.loads((tmp_path / "evaluation.json").read_text())
    assert result["normals_coverage"] is result["height_coverage"] is None
    assert result["known_share"] == 1
    uncertain = np.full((120, 160), 0.01, np.float32)
    tifffile.imwrite(tmp_path / "height_uncertainty.tif", uncertain)
    assert "height_coverage: 1\n" in nlights("evaluate", tmp_path, "--truth", painting / "truth").stdout


def test_the_albedo_and_its_scale_agree_with_the_truth(digitised, painting):
    found = tifffile.imread(digitised / "simulated-painting" / "r0c0" / "albedo.tif")
    truth = tifffile.imread(painting / "truth" / "albedo.tif")
    assert np.median(np.abs(found - truth) / truth) < 0.01


def test_the_reflection_map_of_a_matt_surface_is_nothing_on_average(digitised):
    folder = digitised / "simulated-painting" / "r0c0"
    reflection, albedo = (tifffile.imread(folder / f"{name}.tif") for name in ("reflection", "albedo"))
    assert np.abs(np.mean(reflection)) < 0.01 < np.mean(albedo)


def test_a_second_run_changes_nothing_and_says_so(digitised, painting):
    before = {path: path.read_bytes() for path in products(digitised)}
    done = nlights("digitise", painting, "--out", digitised)
    assert "unchanged" in done.stdout
    assert {path: path.read_bytes() for path in products(digitised)} == before


def test_a_variant_recomputes_only_what_differs(digitised, painting, tmp_path):
    recipe = tmp_path / "variant.yaml"
    recipe.write_text(
        "light_model: {use: measured-poi}\ndetrend: {images: {use: flat-field}}\n"
        "normals: {use: robust}\nintegrator: {use: simchony, stencil: trapezoid}\ncalibration: {}\n"
    )
    done = nlights("plan", painting, "--out", digitised, "--recipe", recipe)
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if len(line.split()) > 2}
    for stage in ("lights", "flat_field", "calibration", "normals"):
        assert "exists" in rows[stage]
    for stage in ("height", "level", "maps", "mesh", "report"):
        assert "to be made" in rows[stage]
    assert "algorithm.options.stencil" in rows["height"]


def test_what_people_added_is_kept_when_products_change(digitised, painting, tmp_path):
    nlights("digitise", painting, "--out", tmp_path, "--store", digitised / ".store")
    folder = tmp_path / "simulated-painting" / "r0c0"
    (folder / "notes.txt").write_text("seen by M.")
    nlights("digitise", painting, "--out", tmp_path, "--store", digitised / ".store", "--recipe", "psbox")
    assert (folder / "notes.txt").read_text() == "seen by M."
    assert json.loads((folder / "provenance.json").read_text())["recipe"]["name"] == "psbox"


def test_the_paper_recipe_keeps_what_it_removed(painting, tmp_path):
    nlights("digitise", painting, "--out", tmp_path, "--recipe", "paper")
    trend = tifffile.imread(tmp_path / "simulated-painting" / "r0c0" / "trend.tif")
    assert np.isfinite(trend).all()
    assert np.ptp(trend) > 0.1


def test_help_teaches_and_plugins_lists_origins():
    text = nlights("--help").stdout
    for command in ("simulate", "check", "plan", "digitise", "plugins", "report", "evaluate"):
        assert command in text
        assert len(nlights(command, "--help").stdout) > 300
    listed = nlights("plugins").stdout
    assert "simchony" in listed
    assert "nlights 0.1.0" in listed


def test_report_prints_numbers_with_units_also_of_different_recipes(digitised, painting, tmp_path):
    nlights("digitise", painting, "--out", tmp_path, "--recipe", "psbox")
    text = nlights("report", digitised, tmp_path).stdout
    assert "mm" in text
    assert "not in this recipe" in text
    assert text.count("report.html") == 2


def test_without_a_photographed_white_the_albedo_is_said_to_be_relative(painting, tmp_path):
    nlights("digitise", painting, "--out", tmp_path, "--recipe", "paper")
    with tifffile.TiffFile(tmp_path / "simulated-painting" / "r0c0" / "albedo.tif") as file:
        assert "relative" in file.pages[0].description


def test_check_reads_every_photograph_and_writes_nothing(capture):
    before = sorted(capture.rglob("*"))
    done = nlights("check", capture)
    assert "can be digitised" in done.stdout
    assert "Relio_8" in done.stdout
    assert sorted(capture.rglob("*")) == before
    tifffile.imwrite(capture / "light_2.tif", np.zeros((120, 160, 3), np.uint16), photometric="rgb")
    assert "all black" in nlights("check", capture, code=2).stderr


def test_the_core_and_the_help_start_fast_because_nothing_heavy_is_imported():
    script = "import sys, nlights_core.stages, nlights_flows.commands.cli; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    assert not modules & {"prefect", "matplotlib", "trimesh", "jinja2", "rawpy", "skimage"}


def test_a_memory_budget_that_is_too_small_is_said_before_anything_runs(painting, tmp_path):
    done = nlights("digitise", painting, "--out", tmp_path / "out", "--memory", "1MiB", code=2)
    assert "integrator: simchony: needs" in done.stderr
    assert "GiB of memory, but --memory allows 1.0 MiB" in done.stderr
    assert products(tmp_path / "out") == []
    done = nlights("digitise", painting, "--out", tmp_path / "out", "--memory", "much", code=2)
    assert "write for instance 6GiB" in done.stderr


@pytest.mark.parametrize(
    ("gone", "words"),
    [
        ("stdout", "--version"),
        ("stdout", "--help"),
        ("stdout", "plugins"),
        ("stdout", "plugins --schema"),
        ("stdout", "report {digitised}"),
        ("stdout", "check {painting}"),
        ("stderr", "nosuch"),
        ("stderr", "report {painting}"),
        ("stderr", "check {painting}/nowhere"),
    ],
)
def test_a_command_whose_reader_goes_away_ends_quietly(digitised, painting, gone, words):
    process = subprocess.Popen(
        [NLIGHTS, *words.format(digitised=digitised, painting=painting).split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    streams = {"stdout": process.stdout, "stderr": process.stderr}
    streams.pop(gone).close()  # before anything is written
    (other,) = streams.values()
    said = other.read()
    other.close()
    assert process.wait() == 141
    assert said.strip() == ""


def test_digitising_for_a_reader_who_goes_away_keeps_what_is_finished(painting, tmp_path):
    words = [NLIGHTS, "digitise", painting, "--out", tmp_path]
    process = subprocess.Popen(list(map(str, words)), stderr=subprocess.PIPE, text=True)
    assert process.stderr.readline().startswith("r0c0: lights:")
    process.stderr.close()
    assert process.wait() == 141
    assert list(tmp_path.rglob("lights-*/artefact.json"))
    assert not list(tmp_path.rglob(".draft-*"))
