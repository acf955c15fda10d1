"""Cleaning takes what no product needs, and nothing else."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nlights_core.errors import NlightsError
from nlights_core.recipe import load_recipe
from nlights_core.store import Store, draft
from nlights_flows.tiles import direct
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.upkeep.cleaning import clean
from nlights_flows.upkeep.verification import verify

NLIGHTS = Path(sys.executable).parent / "nlights"
TILE = Path("simulated-painting") / "r0c0"


def names(store: Path) -> set[str]:
    return {folder.relative_to(store).as_posix() for folder in store.glob("*/*/*") if folder.is_dir()}


def age(store: Path, days: float) -> None:
    then = time.time() - days * 86400
    for folder in store.glob("*/*/*"):
        for path in (folder, folder / "artefact.json"):
            os.utime(path, (then, then))


def forsaken(store: Path, of: str = "mesh") -> Path:
    """An artefact that nothing refers to."""
    (one,) = store.glob(f"*/*/{of}-*")
    other = one.with_name(f"{of}-0123456789ab")
    shutil.copytree(one, other)
    return other


def test_all_that_products_rest_on_stays_and_the_rest_goes(out):
    store = out / ".store"
    before = names(store)
    gone = forsaken(store)
    age(store, 10)
    size = sum(path.stat().st_size for path in gone.iterdir())
    found = clean(store, [out], 7, dry=True)
    assert (found.artefacts, found.size, found.kept) == ([gone], size, len(before))
    assert gone.is_dir()
    assert clean(store, [out], 11).artefacts == []
    assert clean(store, [out], 7).artefacts == [gone]
    assert names(store) == before
    assert verify(out, store).exit_code() == 0


def test_every_given_folder_of_products_keeps_its_own(painting, out, tmp_path):
    store = out / ".store"
    other = tmp_path / "other"
    recipe = load_recipe({**load_recipe("default").record(), "name": "kept", "calibration": "none"})
    (outcome,) = direct.digitise(painting, RunOptions(out=other, store=store), recipe, shown=False)
    assert outcome.state == "done"
    both = names(store)
    age(store, 10)
    assert clean(store, [out, other], 7).artefacts == []
    found = clean(store, [out], 7)
    assert found.artefacts
    assert verify(out, store).exit_code() == 0
    (again,) = direct.digitise(painting, RunOptions(out=other, store=store), recipe, shown=False)
    assert again.state == "done"
    assert names(store) == both


def test_what_a_run_uses_again_is_young_again(painting, out):
    store = out / ".store"
    age(store, 10)
    shutil.rmtree(out / TILE)
    (folder,) = store.glob("*/*/report-*")
    shutil.rmtree(folder)
    direct.digitise(painting, RunOptions(out=out), shown=False)
    ages = {name: time.time() - (store / name).stat().st_mtime for name in names(store)}
    assert max(ages.values()) < 3600, ages
    provenance = out / TILE / "provenance.json"
    provenance.unlink()
    (out / TILE / "report.html").unlink()
    (out / TILE / "quality.json").unlink()
    (out / "another" / "tile").mkdir(parents=True)
    shutil.copy(folder / "provenance.json", out / "another" / "tile")
    assert clean(store, [out], 7).artefacts == []


def test_the_mask_that_the_store_found_belongs_to_the_chain(painting, tmp_path):
    capture = shutil.copytree(painting, tmp_path / "capture")
    manifest = capture / "artwork.yaml"
    manifest.write_text(manifest.read_text() + "\nmask: auto\n")
    out = tmp_path / "out"
    (outcome,) = direct.digitise(capture, RunOptions(out=out), shown=False)
    assert outcome.state == "done", outcome.message
    assert any(name.split("/")[2].startswith("mask-") for name in names(out / ".store"))
    assert clean(out / ".store", [out], 0).artefacts == []


def test_products_that_say_nothing_keep_all_of_their_artwork(out):
    store = out / ".store"
    forsaken(store)
    before = names(store)
    (out / TILE / "provenance.json").unlink()
    found = clean(store, [out], 0)
    assert found.unreadable == [out / TILE]
    assert names(store) == before


def test_a_folder_without_products_is_refused_since_everything_would_go(out, tmp_path):
    (tmp_path / "empty").mkdir()
    for wrong in ("empty", "nothing"):
        with pytest.raises(NlightsError, match=f"--out: .*{wrong} holds no products"):
            clean(out / ".store", [out, tmp_path / wrong], 0)
    with pytest.raises(NlightsError, match=r"--store: .* holds no artefacts"):
        clean(tmp_path / "empty", [out], 0)


WRITER = """
import sys
from pathlib import Path
from nlights_core.store import draft
with draft(Path(sys.argv[1])) as place:
    place.mkdir()
    print(place.name, flush=True)
    sys.stdin.read()
"""


def test_drafts_of_a_container_that_is_gone_go_and_those_at_work_stay(out):
    store = out / ".store"
    left = []
    for folder in (store / TILE, store / ".scratch", out / TILE.parent):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        left.append(folder / process.stdout.readline().strip())
        process.send_signal(signal.SIGKILL)
        process.communicate()
    with draft(store / TILE) as place:
        place.mkdir()
        assert clean(store, [out], 7, dry=True).drafts == 3
        assert all(path.is_dir() for path in left)
        assert clean(store, [out], 7).drafts == 3
        assert place.is_dir()
    assert not list(out.rglob(".draft-*"))
    assert Store(store).root.is_dir()


def test_the_command_says_what_goes_and_asks_for_all_it_needs(out):
    gone = forsaken(out / ".store")
    words = [NLIGHTS, "clean", "--store", out / ".store", "--out", out, "--older-than", "0"]
    done = subprocess.run([*words, "--dry-run"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[0] == str(gone)
    assert "1 artefacts and 0 drafts would be removed" in done.stdout
    assert gone.is_dir()
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "1 artefacts and 0 drafts removed" in done.stdout
    assert not gone.exists()
    assert subprocess.run(words[:4], capture_output=True, check=False).returncode == 2
