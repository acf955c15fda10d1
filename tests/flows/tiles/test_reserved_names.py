"""Names that nLights' own folders have: refused by every command, for artworks and for tiles."""

import pytest
import yaml

import nlights
from nlights_core.errors import CaptureError
from nlights_core.manifest import load_capture
from nlights_core.names.artworks import RESERVED
from nlights_flows.commands.cli import app
from nlights_flows.nights.inbox import scan


def name(capture, number: str, tile: str = "r0c0") -> None:
    manifest = capture / "artwork.yaml"
    described = yaml.safe_load(manifest.read_text(encoding="utf-8"))
    described |= {"artwork": {"id": number}, "tiles": [{"name": tile}]}
    manifest.write_text(yaml.safe_dump(described), encoding="utf-8")


@pytest.mark.parametrize("number", [*sorted(RESERVED), "NIGHTS", "Flat-Checks", "nights "])
def test_no_artwork_may_have_one(capture, number):
    name(capture, number)
    with pytest.raises(
        CaptureError, match=r"artwork\.id: .* is the name of a folder or file of nLights' own"
    ):
        load_capture(capture)


@pytest.mark.parametrize("tile", ["mosaic", "Mosaic", "nights"])
def test_no_tile_may_have_one(capture, tile):
    name(capture, "inv-1", tile)
    with pytest.raises(CaptureError, match=r"tiles\.0\.name: .* is the name of a folder of nLights' own"):
        load_capture(capture)


def test_longer_names_are_an_artworks_own(capture):
    name(capture, "nights 2", "mosaics")
    assert load_capture(capture)[0].folder == "nights 2"


def test_every_command_refuses_it(capture, tmp_path, capsys):
    name(capture, "nights")
    out = tmp_path / "out"
    for words in (["check", capture], ["plan", capture, "--out", out], ["digitise", capture, "--out", out]):
        with pytest.raises(CaptureError, match="of nLights' own"):
            app([str(word) for word in words], standalone_mode=False)
    with pytest.raises(CaptureError, match="of nLights' own"):
        nlights.digitise(capture, out=out)
    (passed,) = scan(capture.parent, 0).passed_by
    assert "of nLights' own" in passed.message
    (capture / "artwork.yaml").unlink()
    app(["init", str(capture), "--id", "nights", "--stand", "horizontal"], standalone_mode=False)
    assert "of nLights' own" in "".join(capsys.readouterr())
    assert not out.exists()
