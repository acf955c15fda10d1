"""Verification names whatever is not what was written; repair and the named command bring back every byte."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from nlights_core.files import content_digests
from nlights_core.store import RECORD
from nlights_flows.upkeep.verification import Verified, verify

NLIGHTS = Path(sys.executable).parent / "nlights"
TILE = Path("simulated-painting") / "r0c0"


def look(out: Path, **options) -> Verified:
    """Verify as a process of its own does."""
    content_digests._known.clear()
    return verify(out, out / ".store", **options)


def contents(out: Path) -> dict[str, bytes]:
    """Bytes of every product and artefact, but for what says how long something took."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path.name != RECORD and ".digests" not in path.parts
    }


def again(commands: list[str], code: int = 0) -> None:
    for command in commands:
        words = shlex.split(command)
        assert words[0] == "nlights"
        done = subprocess.run([NLIGHTS, *words[1:]], capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    with path.open("r+b") as file:
        file.write(content)
    os.utime(path, (1, 1))


def zero(path: Path) -> None:
    with path.open("r+b") as file:
        file.write(bytes(path.stat().st_size))
    os.utime(path, (1, 1))


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 1)


def empty(path: Path) -> None:
    os.truncate(path, 0)


def lose(path: Path) -> None:
    path.unlink()


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()
    (path / "inside").write_text("x")


def replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def exchange(path: Path) -> None:
    other = next(one for one in sorted(path.parent.iterdir()) if one != path and one.is_file())
    path.rename(path.parent / "aside")
    other.rename(path)
    (path.parent / "aside").rename(other)


FAULTS = [flip, zero, cut, empty, lose, replace_by_folder, replace_by_pipe, exchange]


def test_what_is_whole_is_whole_and_nothing_is_touched(out):
    before = contents(out)
    found = look(out, repair=True)
    assert (found.products, found.artefacts, found.damages, found.commands) == (1, 10, [], [])
    assert found.exit_code() == 0
    assert contents(out) == before


def test_a_flipped_bit_in_any_file_of_any_folder_is_named(out):
    # Only the product's own folder, or only the artefact, though the two share a file: so each is a copy first.
    files = [path for path in out.rglob("*") if path.is_file() and ".digests" not in path.parts]
    assert len(files) > 50
    for path in files:
        whole, status = path.read_bytes(), path.stat()
        path.unlink()
        path.write_bytes(whole)
        flip(path)
        (damage,) = look(out).damages
        assert damage.folder == path.parent
        assert path.name in damage.files
        path.write_bytes(whole)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert look(out).damages == []


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["normals.tif", "quality.json", "provenance.json"])
def test_a_product_that_was_damaged_alone_is_restored_from_its_artefact(out, fault, name):
    before = contents(out)
    product = out / TILE / name
    content = product.read_bytes()
    product.unlink()
    product.write_bytes(content)  # as a copy, or a reflink, is a file of its own
    fault(product)
    (damage,) = look(out).damages
    assert (damage.folder, damage.kind) == (out / TILE, "products")
    assert name in damage.files
    assert look(out).exit_code() == 1
    found = look(out, repair=True)
    assert found.exit_code() == 0
    assert found.commands == []
    assert contents(out) == before
    assert look(out).damages == []
    assert not list(out.rglob(".draft-*"))


@pytest.mark.parametrize("fault", FAULTS)
def test_an_artefact_that_is_damaged_is_removed_and_the_command_makes_it_again(painting, out, fault):
    before = contents(out)
    (normals,) = (out / ".store").glob("*/*/normals-*")
    fault(normals / "normals.npy")
    (damage,) = look(out).damages
    assert (damage.folder, damage.kind) == (normals, "artefact")
    assert "normals.npy" in damage.files
    found = look(out, repair=True)
    assert not normals.exists()
    assert found.exit_code() == 0  # the products are whole
    assert found.commands == [
        f"nlights digitise {painting} --tile r0c0 --out {out}",
    ]
    if fault is flip:
        again(found.commands)
        assert contents(out) == before
        assert look(out).exit_code() == 0


@pytest.mark.parametrize("name", ["mesh.ply", "report.html", "provenance.json"])
def test_a_file_that_product_and_artefact_share_comes_back_by_the_command(out, name):
    before = contents(out)
    (out / TILE / name).chmod(0o644)
    flip(out / TILE / name)
    found = look(out, repair=True)
    assert sorted(damage.kind for damage in found.damages) == ["artefact", "products"]
    assert found.exit_code() == 1
    (command,) = found.commands
    again([command])
    assert contents(out) == before
    assert look(out).exit_code() == 0


def test_several_faults_at_once_are_all_named_and_all_mended(out):
    before = contents(out)
    store = out / ".store"
    (record,) = store.glob("*/*/maps-*/artefact.json")
    (lights,) = store.glob("*/*/lights-*/lights.json")
    (flats,) = store.glob("*/_flats/flat_field-*")
    for fault, path in ((flip, record), (cut, lights), (empty, next(flats.glob("*.npy")))):
        fault(path)
    (mesh,) = store.glob("*/*/mesh-*")
    shutil.rmtree(mesh)
    mesh.write_text("a file in the folder's place")
    (out / TILE / "height.tif").unlink()
    found = look(out)
    assert {damage.folder.name.split("-")[0] for damage in found.damages} == {
        "maps", "lights", "flat_field", "mesh", "r0c0"
    }  # fmt: skip
    found = look(out, repair=True)
    assert found.exit_code() == 1  # the height was in the rotten artefact only
    again(found.commands)
    assert contents(out) == before
    assert look(out).exit_code() == 0


def test_two_artefacts_exchanged_and_two_tiles_exchanged_are_named(out):
    (a,), (b,) = (list((out / ".store").glob(f"*/*/{stage}-*")) for stage in ("height", "level"))
    a.rename(a.with_name("aside"))
    b.rename(a)
    a.with_name("aside").rename(b)
    assert {damage.folder: list(damage.files) for damage in look(out).damages} == {a: [RECORD], b: [RECORD]}
    (out / TILE).rename(out / TILE.parent / "r0c1")
    assert any(
        "is of other products" in damage.files.get("provenance.json", "") for damage in look(out).damages
    )


def test_products_kept_of_before_are_looked_at_and_restored(out):
    kept = out / TILE.parent / ".former" / "2026-11-27T1200" / TILE.name
    kept.parent.mkdir(parents=True)
    (out / TILE).rename(kept)
    assert look(out).products == 1
    before = (kept / "albedo.tif").read_bytes()
    (kept / "albedo.tif").unlink()
    assert list(look(out).damages[0].files) == ["albedo.tif"]
    assert look(out, repair=True).exit_code() == 0
    assert (kept / "albedo.tif").read_bytes() == before


def test_products_without_a_store_are_checked_and_cannot_be_restored(out):
    shutil.rmtree(out / ".store")
    assert look(out).exit_code() == 0
    (out / TILE / "height.tif").unlink()
    found = look(out, repair=True)
    assert found.exit_code() == 1
    assert found.damages[0].files == {"height.tif": "is missing"}
    assert found.commands == [
        f"nlights digitise CAPTURE --tile r0c0 --out {out}   # CAPTURE: the folder of the artwork simulated-painting"
    ]


def nlights(*words: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([NLIGHTS, *map(str, words)], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    return done


def test_the_command_names_and_counts_and_has_its_exit_codes(out, tmp_path):
    done = nlights("verify", out)
    assert (done.returncode, done.stderr.strip()) == (0, "")
    assert done.stdout.startswith("1 products of tiles, 10 artefacts, ")
    (out / TILE / "height.tif").unlink()
    done = nlights("verify", out, "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["damaged"] == [
        {
            "folder": str(out / TILE),
            "kind": "products",
            "files": {"height.tif": "is missing"},
            "restored": [],
            "deleted": False,
        }
    ]
    done = nlights("verify", out, "--repair")
    assert done.returncode == 0
    assert done.stderr.strip() == f"{out / TILE}/height.tif: is missing: restored"
    (tmp_path / "empty").mkdir()
    for place in ("empty", "nothing"):
        done = nlights("verify", tmp_path / place)
        assert done.returncode == 2
        assert "no products" in done.stderr
        assert not (tmp_path / "nothing").exists()


def while_looking(action: Callable[[], None], monkeypatch) -> None:
    """Let something happen once, between a look at a folder and the next."""
    from nlights_flows.upkeep import verification

    real, calls = verification.faults_of_files, []

    def meanwhile(folder, files):
        faults = real(folder, files)
        if faults and not calls:
            calls.append(folder)
            action()
        return faults

    monkeypatch.setattr(verification, "faults_of_files", meanwhile)


def test_what_a_night_replaces_or_removes_meanwhile_is_no_damage(finished, out, monkeypatch):
    (out / TILE / "height.tif").unlink()

    def replace() -> None:
        shutil.rmtree(out / TILE)
        subprocess.run(["cp", "-a", finished / TILE, out / TILE], check=True)

    while_looking(replace, monkeypatch)
    assert look(out).damages == []
    (mesh,) = (out / ".store").glob("*/*/mesh-*")
    (mesh / "mesh.ply").unlink()
    while_looking(lambda: shutil.rmtree(mesh), monkeypatch)
    assert look(out).damages == []
