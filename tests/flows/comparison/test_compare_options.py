"""A comparison takes the options of `digitise`, and survives the same plugins."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import tifffile

COMMAND = Path(sys.executable).parent / "nlights"

RECIPE = """
light_model: {{use: measured-poi}}
detrend:
  images: {{use: inverse-square}}
normals: {{use: least-squares}}
integrator: {{use: {integrator}}}
"""


@pytest.fixture
def compare(rascals, tmp_path):
    def run(capture: Path, *words: object, code: int) -> tuple[dict, str]:
        """What is in ``compare.json``, and what was said on the standard error."""
        done = subprocess.run(
            list(map(str, [COMMAND, "compare", capture, "--out", "out", *words])),
            cwd=tmp_path,
            env=rascals,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        record = tmp_path / "out" / "compare.json"
        return json.loads(record.read_text()) if record.exists() else {}, done.stderr

    return run


def recipes(place: Path, *integrators: str) -> list[Path]:
    for integrator in integrators:
        (place / f"{integrator}.yaml").write_text(RECIPE.format(integrator=integrator))
    return [place / f"{integrator}.yaml" for integrator in integrators]


def heights(record: dict) -> dict[str, dict]:
    return {
        run["variant"]: stage
        for run in record["runs"]
        for stage in run["stages"]
        if stage["stage"] == "height"
    }


def test_plugins_that_hang_or_crash_are_named_and_cost_their_variants_only(compare, painting, tmp_path):
    variants = recipes(tmp_path, "simchony", "hangs", "crashes", "frankot-chellappa")
    compare(painting, "--recipes", variants[0], variants[-1], code=0)  # kernels are compiled in it: no limit
    record, said = compare(painting, "--recipes", *variants, "--timeout", 12, code=1)
    name = "simulated-painting/r0c0: failed: integrator:"
    assert f"hangs: {name} hangs (nlights-rascals 0.1): the stage 'height' was stopped after 12 s" in said
    assert (
        f"crashes: {name} crashes (nlights-rascals 0.1): the stage 'height' crashed (signal SIGSEGV)" in said
    )
    assert record["compared"] == ["simchony", "frankot-chellappa"]
    assert list((tmp_path / "out").rglob(".draft-*")) == []


def test_a_plugin_of_somebody_elses_runs_in_a_child_and_what_is_shipped_does_not(compare, painting, tmp_path):
    variants = recipes(tmp_path, "simchony", "crashes", "frankot-chellappa")
    record, said = compare(painting, "--recipes", *variants, code=1)
    assert "crashed (signal SIGSEGV)" in said
    assert heights(record)["simchony"]["peak_bytes"] > 1 << 20
    (tmp_path / "behave").touch()
    record, said = compare(painting, "--recipes", *variants, code=0)
    # What a child takes of the memory is not measured here, and another number must not stand for it.
    assert heights(record)["crashes"]["origin"] == "made"
    assert heights(record)["crashes"]["peak_bytes"] is None
    away = record["tiles"][0]["differences_from_first"]["crashes"]
    assert away["height_rms"] == away["angle_mean_deg"] == 0


def test_only_the_tiles_that_are_asked_for_are_compared(compare, two_tiles, tmp_path):
    words = ("--recipes", *recipes(tmp_path, "simchony", "frankot-chellappa"), "--tile")
    _, said = compare(two_tiles, *words, "c", code=2)
    assert f"--tile: {two_tiles} has no tile 'c'; it has a, b" in said
    assert not (tmp_path / "out").exists()
    record, _ = compare(two_tiles, *words, "b", code=0)
    assert [tile["name"] for tile in record["tiles"]] == ["inv-1/b"]
    assert {run["tile"] for run in record["runs"]} == {"inv-1/b"}


def test_the_products_of_variants_are_compressed_if_wanted(compare, painting, tmp_path):
    words = ("--recipes", *recipes(tmp_path, "simchony", "frankot-chellappa"))
    for options, compression in (((), 1), (("--compression", "zstd"), 50000)):
        compare(painting, *words, *options, code=0)
        for variant in ("simchony", "frankot-chellappa"):
            with tifffile.TiffFile(
                tmp_path / "out" / variant / "simulated-painting" / "r0c0" / "height.tif"
            ) as file:
                assert file.pages[0].compression == compression


def test_a_memory_budget_that_is_too_small_is_said_before_anything_runs(compare, painting, tmp_path):
    words = ("--recipes", *recipes(tmp_path, "simchony", "frankot-chellappa"), "--memory")
    record, said = compare(painting, *words, "1MiB", code=2)
    assert "integrator: simchony: needs" in said
    assert "GiB of memory, but --memory allows 1.0 MiB" in said
    assert [run["stages"] for run in record["runs"]] == [[], []]
    assert "--memory: " in compare(painting, *words, "much", code=2)[1]
