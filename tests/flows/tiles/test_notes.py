"""Sentences that a stage says of itself reach whoever looks on, from a child process too."""

import pytest

from nlights_core.machine.progress import note
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_flows.tiles import console
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

DIRECT = """
light_model: {use: measured-poi}
normals: {use: least-squares}
integrator: {use: simchony}
"""


@pytest.fixture
def recipe(tmp_path):
    (tmp_path / "recipe.yaml").write_text(DIRECT)
    return load_recipe(str(tmp_path / "recipe.yaml"))


def test_a_note_is_a_line_of_the_standard_error_and_nothing_where_nothing_is_shown(recipe, capsys):
    for shown in (True, False):
        with console.TileProgress(recipe, [], shown):
            note("integrator: a field with unknown parts: at most about 3 minutes")
        note("nobody looks on")
        heard = capsys.readouterr().err
        assert heard == ("integrator: a field with unknown parts: at most about 3 minutes\n" if shown else "")


@pytest.mark.parametrize("timeout", [None, 300.0])
def test_the_height_tells_progress_from_within(capture, recipe, tmp_path, timeout):
    import numpy as np
    from PIL import Image

    # A labyrinth of unknown pixels takes many iterations.
    tile = load_capture(capture)[0]
    with Image.open(capture / "light_1.tif") as photograph:
        mask = np.full((photograph.height, photograph.width), 255, np.uint8)
    mask[10::20, 5:] = mask[20::20, :-5] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    tile = tile.model_copy(update={"mask": tmp_path / "mask.png"})
    shares = []

    def watch(place, stage, share):
        if stage == "height":
            shares.append(share)

    outcome = run_directly(tile, recipe, RunOptions(out=tmp_path / "out", timeout=timeout), watch)
    assert outcome.state == "done", outcome.message
    assert len(shares) > 5
    assert shares == sorted(shares)
