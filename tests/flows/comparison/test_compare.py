"""The comparison of variants, from the command line to the page."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import tifffile

from nlights_core.simulation.evaluation import evaluate

COMMAND = Path(sys.executable).parent / "nlights"
HOSTILE = "<script>alert(1)</script>"


def compare(*words, code=0) -> subprocess.CompletedProcess:
    done = subprocess.run(
        [COMMAND, "compare", *map(str, words)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.fixture(scope="module")
def compared(painting, tmp_path_factory) -> tuple[Path, str, dict]:
    """A grid on the painting, and what was printed; its title is hostile."""
    capture = Path(shutil.copytree(painting, tmp_path_factory.mktemp("compared") / "capture"))
    manifest = capture / "artwork.yaml"
    text, count = re.subn(r"title: .*", f"title: {json.dumps(HOSTILE)}", manifest.read_text())
    assert count == 1
    manifest.write_text(text)
    out = capture.parent / "out"
    done = compare(
        capture, "--grid", "detrend.images=flat-field,none", "normals=robust,least-squares", "--out", out
    )
    return out, done.stdout, json.loads((out / "compare.json").read_text())


def metric(record: dict, key: str) -> dict:
    return next(one for one in record["metrics"] if one["key"] == key)


def test_the_winner_is_the_one_that_the_truth_confirms(compared, painting):
    out, printed, record = compared
    found = metric(record, "angle_error")
    errors = {}
    for variant in record["variants"]:
        folder = out / variant["folder"] / "simulated-painting" / "r0c0"
        errors[variant["name"]] = evaluate(folder, painting / "truth")
    for row in found["variants"]:
        assert row["value"] == pytest.approx(errors[row["name"]]["angle_mean_deg"], rel=1e-5)
    for row in metric(record, "height_error")["variants"]:
        assert row["value"] == pytest.approx(errors[row["name"]]["height_rms_mm"], rel=1e-4)
    best = min(errors, key=lambda name: errors[name]["angle_mean_deg"])
    assert best in found["winners"]
    assert all(name.startswith("flat-field") for name in found["winners"])
    assert best in printed
    without = next(row for row in found["variants"] if row["name"] == "no detrend.images + robust")
    low, high = without["to_best"]["interval"]
    assert 0 < low < without["to_best"]["value"] < high
    assert without["rank"] > 1


def test_coverage_of_each_variant_is_that_of_evaluate(compared, painting):
    out, _, record = compared
    described = {row["key"]: row["values"] for row in record["described"]}
    shares = {}
    for variant in record["variants"]:
        folder = out / variant["folder"] / "simulated-painting" / "r0c0"
        shares[variant["name"]] = 100 * evaluate(folder, painting / "truth")["normals_coverage"]
    assert described["normals_coverage"] == pytest.approx(shares, abs=1e-3)
    assert described["normals_coverage"]["flat-field + robust"] == pytest.approx(68, abs=5)
    assert described["normals_coverage"]["no detrend.images + robust"] < 40
    page = (out / "compare.html").read_text()
    for title in ("Normals", "Heights"):
        assert f"{title} within their stated uncertainty; 68 is right" in page


def test_coverage_of_the_heights_is_that_of_evaluate_where_an_uncertainty_is_stated(
    compared, painting, tmp_path
):
    out, _, record = compared
    place = Path(shutil.copytree(out, tmp_path / "out", symlinks=True))
    folders = {v["name"]: place / v["folder"] / "simulated-painting" / "r0c0" for v in record["variants"]}
    rising = np.linspace(0, 0.2, 160, dtype=np.float32) * np.ones((120, 1), np.float32)
    tifffile.imwrite(folders["flat-field + robust"] / "height_uncertainty.tif", rising)
    words = ("--grid", "detrend.images=flat-field,none", "normals=robust,least-squares")
    compare(painting, *words, "--out", place)
    again = json.loads((place / "compare.json").read_text())
    found = next(row["values"] for row in again["described"] if row["key"] == "height_coverage")
    truth = {name: evaluate(folder, painting / "truth") for name, folder in folders.items()}
    for name, value in found.items():
        expected = 100 * truth[name]["height_coverage"]
        assert value is None if np.isnan(expected) else value == pytest.approx(expected, abs=1e-2)
    assert 5 < found["flat-field + robust"] < 95


def test_what_variants_have_in_common_is_made_once(compared):
    _, _, record = compared
    runs = {
        run["variant"]: {made["stage"]: made["origin"] for made in run["stages"]} for run in record["runs"]
    }
    assert set(runs["flat-field + robust"].values()) == {"made"}
    second = runs["flat-field + least-squares"]
    assert second["lights"] == second["flat_field"] == "shared"
    assert second["normals"] == "made"
    keys = [made["key"] for run in record["runs"] for made in run["stages"] if made["origin"] == "made"]
    assert len(keys) == len(set(keys))
    spent = record["seconds"]
    assert spent["all"] <= 1.15 * spent["stages"] + 3  # at this size what is fixed weighs


def test_a_second_comparison_makes_nothing_and_finds_the_same(compared, painting):
    out, _, record = compared
    words = ("--grid", "detrend.images=flat-field,none", "normals=robust,least-squares")
    compare(out.parent / "capture", *words, "--out", out)
    again = json.loads((out / "compare.json").read_text())
    assert {made["origin"] for run in again["runs"] for made in run["stages"]} == {"kept"}
    assert again["metrics"] == record["metrics"]
    memory = next(row for row in again["described"] if row["key"] == "peak_memory")
    assert set(memory["values"].values()) == {None}  # nothing was made, so nothing was measured


def test_differences_are_from_the_first_variant(compared):
    _, _, record = compared
    away = record["tiles"][0]["differences_from_first"]
    assert away["flat-field + robust"]["angle_mean_deg"] == 0
    assert away["flat-field + robust"]["height_rms"] == 0
    other = away["no detrend.images + robust"]
    assert other["angle_p95_deg"] > other["angle_mean_deg"] > 0.1
    assert other["height_rms"] >= other["height_rms_after_plane"] > 0


class Page(HTMLParser):
    """Collects the elements of a page and their addresses."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes) -> None:
        self.tags.append(tag)
        given = dict(attributes)
        self.sources += [given[name] for name in ("src", "href") if name in given]
        assert not [name for name in given if name.startswith("on")]


def test_the_page_needs_nothing_else_and_escapes_what_a_capture_says(compared):
    out, _, _ = compared
    text = (out / "compare.html").read_text()
    page = Page(text)
    assert page.tags.count("script") == 1
    assert "&lt;script&gt;alert(1)" in text
    assert page.sources
    assert all(source.startswith("data:image/") for source in page.sources)
    script = re.search(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in text
    for title in ("Normals", "Hillshade", "Height"):
        assert f"<h4>{title}</h4>" in text
    assert "degrees" in text
    assert "95 % interval" in text


def test_a_browser_runs_the_curtain_of_the_page(compared):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    out, _, _ = compared
    options = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--no-first-run",
    )
    done = subprocess.run(
        [
            browser,
            *options,
            f"--user-data-dir={out / 'browser'}",
            "--dump-dom",
            f"file://{out / 'compare.html'}",
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert 'class="curtains live"' in done.stdout  # the script says so when it has come to its end
    assert "live" not in re.findall(r'<section class="([^"]*)"', (out / "compare.html").read_text())[0]


def test_a_variant_that_fails_is_listed_and_the_others_go_on(painting, compared, tmp_path):
    out, _, _ = compared
    spheres = tmp_path / "spheres.yaml"
    spheres.write_text("light_model: chrome-sphere\nnormals: robust\nintegrator: simchony\n")
    words = ("--recipes", "psbox", "paper", spheres, "--out", tmp_path / "out", "--store", out / ".store")
    done = compare(painting, *words, code=1)
    assert "spheres: simulated-painting/r0c0: failed: chrome_spheres: is missing" in done.stderr
    record = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert record["compared"] == ["psbox", "paper"]
    assert "chrome_spheres: is missing" in (tmp_path / "out" / "compare.html").read_text()


def test_without_truth_nothing_is_ranked_by_it(capture, compared, tmp_path):
    out, _, _ = compared
    shutil.rmtree(capture / "truth")
    words = ("--grid", "normals=robust,least-squares", "--out", tmp_path, "--store", out / ".store")
    done = compare(capture, *words)
    assert "There is no truth" in done.stdout
    record = json.loads((tmp_path / "compare.json").read_text())
    for key in ("angle_error", "height_error"):
        found = metric(record, key)
        assert found["over"] is None
        assert found["winners"] == []
        assert {row["rank"] for row in found["variants"]} == {None}
    assert metric(record, "held_out")["over"] == {"kind": "lamps", "places": 8, "tiles": 1}
    described = {row["key"]: set(row["values"].values()) for row in record["described"]}
    assert described["normals_coverage"] == described["height_coverage"] == {None}


def test_what_cannot_be_ordered_is_said_before_anything_is_written(painting, tmp_path):
    out = tmp_path / "out"
    for words, said in (
        ((painting,), "a comparison needs two"),
        ((painting, "--grid", "integrator=simchonny,simchony"), "did you mean 'simchony'?"),
        ((painting, painting, "--recipes", "psbox", "paper"), "was given already"),
        ((painting, "--recipes", "psbox", "nosuch"), "nosuch"),
        ((tmp_path / "nowhere", "--recipes", "psbox", "paper"), "nowhere"),
        (("--recipes", "psbox", "paper"), "ARTWORK"),
    ):
        assert said in compare(*words, "--out", out, code=2).stderr
        assert not out.exists()


def test_the_flow_finds_what_the_direct_call_found_and_runs_each_stage_as_a_task(
    painting, tmp_path, monkeypatch
):
    words = ("--recipes", "psbox", "paper", "--store", tmp_path / "store")
    words += ("--tile", "r0c0", "--compression", "zstd", "--memory", "4GiB", "--timeout", "600")
    compare(painting, *words, "--out", tmp_path / "direct")
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path / "prefect"))
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    done = compare(painting, *words, "--out", tmp_path / "flow", "--prefect")
    assert "psbox: simulated-painting/r0c0 normals" in done.stdout + done.stderr
    assert "Cached" in done.stdout + done.stderr
    direct, flow = (json.loads((tmp_path / name / "compare.json").read_text()) for name in ("direct", "flow"))
    assert flow["metrics"] == direct["metrics"]
    assert {made["origin"] for run in flow["runs"] for made in run["stages"]} == {"kept"}
