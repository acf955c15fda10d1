"""The parts of a night, each alone: inbox, claims, limits, estimates, trends, photographs."""

import os
import shutil
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from nlights_core.errors import CaptureError, TileError
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.store import Store
from nlights_flows.nights.charts import chart
from nlights_flows.nights.claims import Claims
from nlights_flows.nights.estimates import Deadline, learn_estimate
from nlights_flows.nights.inbox import scan
from nlights_flows.nights.limits import load_limits
from nlights_flows.nights.order import Order, check_order
from nlights_flows.nights.page import moved
from nlights_flows.nights.trends import captures_of, control_limits, trends
from nlights_flows.tiles import environment, running
from nlights_flows.tiles.photographs import Photographs
from nlights_flows.tiles.run_options import RunOptions

MANIFEST = 'artwork: {id: %s}\nstand: horizontal\nframes: "light_{n}.tif"\n'


def upload(folder: Path, name: str, extra: str = "", uploaded: float | None = 1000.0) -> Path:
    folder.mkdir(parents=True)
    (folder / "artwork.yaml").write_text(MANIFEST % name + extra)
    (folder / "light_1.tif").touch()
    if uploaded is not None:
        (folder / "upload-complete").touch()
        os.utime(folder / "upload-complete", (uploaded, uploaded))
    return folder


def test_the_order_is_priority_then_oldest_upload_then_number(tmp_path):
    upload(tmp_path / "a", "inv-9", uploaded=50)
    upload(tmp_path / "b", "inv-2")
    upload(tmp_path / "c" / "deep", "inv-1")
    upload(tmp_path / "d", "inv-7", "priority: 3\n", uploaded=5000)
    upload(tmp_path / "e", "inv-0", "priority: -1\n", uploaded=1)
    found = scan(tmp_path, 300)
    assert [one.artwork for one in found.ready] == ["inv-7", "inv-9", "inv-1", "inv-2", "inv-0"]
    assert found.passed_by == []


def test_an_upload_without_a_marker_waits_until_it_is_quiet(tmp_path):
    folder = upload(tmp_path / "a", "inv-1", uploaded=None)
    found = scan(tmp_path, 300)
    assert found.ready == []
    assert "upload-complete" in found.passed_by[0].message
    assert not found.passed_by[0].failed
    assert [one.artwork for one in scan(tmp_path, 0).ready] == ["inv-1"]
    (folder / "upload-complete").touch()
    assert [one.artwork for one in scan(tmp_path, 300).ready] == ["inv-1"]


def test_links_out_of_the_inbox_doubled_numbers_and_reserved_names_are_faults(tmp_path):
    inbox = tmp_path / "inbox"
    upload(inbox / "a", "inv-1")
    upload(inbox / "b", "INV-1")
    upload(inbox / "c", "Nights")
    upload(tmp_path / "elsewhere", "inv-2")
    (inbox / "d").symlink_to(tmp_path / "elsewhere")
    linked = upload(inbox / "e", "inv-3")
    (linked / "artwork.yaml").unlink()
    (linked / "artwork.yaml").symlink_to(tmp_path / "elsewhere" / "artwork.yaml")
    upload(inbox / "f", "inv-4", "dark: ../../elsewhere/light_1.tif\n")
    found = scan(inbox, 300)
    assert [one.artwork for one in found.ready] == ["inv-1"]
    told = {one.folder.name: one.message for one in found.passed_by}
    assert all(one.failed for one in found.passed_by)
    assert str(inbox / "a" / "artwork.yaml") in told["b"]
    assert "a folder or file of nLights' own" in told["c"]
    assert "leads out" in told["d"]
    assert "leads out" in told["e"]
    assert "outside the capture root" in told["f"]


def test_flats_that_artworks_share_are_no_artwork_that_waits(tmp_path):
    for name in ("flats", "lost"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "light_1.tif").touch()
    upload(tmp_path / "a", "inv-1", 'flats: "../flats/light_{n}.tif"\n')
    found = scan(tmp_path, 300)
    assert [one.artwork for one in found.ready] == ["inv-1"]
    assert [one.folder.name for one in found.passed_by] == ["lost"]
    assert "no artwork.yaml" in found.passed_by[0].message


def test_a_claim_keeps_others_off_until_it_is_given_back_or_stale(tmp_path):
    with Claims(tmp_path) as mine, Claims(tmp_path) as yours:
        assert mine.take("inv 1", "a")
        assert not yours.take("inv 1", "a")
        assert yours.holder("inv 1", "a").startswith(f"process {os.getpid()}")
        assert yours.take("inv 1", "b")
        mine.give_back("inv 1", "a")
        assert yours.take("inv 1", "a")
        # Its holder has not touched it for longer than a living one would.
        claim = tmp_path / ".claims" / "inv 1" / "a"
        os.utime(claim, (time.time() - 31, time.time() - 31))
        assert mine.take("inv 1", "a")
        yours.give_back("inv 1", "a")  # it is not theirs any more
        assert claim.exists()
    assert not [path for path in (tmp_path / ".claims").rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("limits: [{name: Saturatd, unit: '%', warn: 1, source: x}]", "did you mean 'Saturated'?"),
        (
            "limits: [{name: Saturated, unit: mm, warn: 1, source: x}]",
            "'Saturated' is in % of pixels; got mm",
        ),
        (
            "limits: [{name: Known share, unit: '% of pixels', warn: 1, fail: 1, source: x}]",
            "make them differ",
        ),
        ("limits: [{name: Saturated, unit: '% of pixels', warn: 1}]", "source: is missing"),
        (
            "limits: [{name: Saturated, unit: '% of pixels', warn: 1, source: x, colour: red}]",
            "unknown field",
        ),
        ("limits: [{name: Saturated, unit: '% of pixels', warn: much, source: x}]", "should be a number"),
    ],
)
def test_a_fault_of_the_limits_is_told_with_line_and_field(tmp_path, text, told):
    path = tmp_path / "limits.yaml"
    path.write_text(text)
    with pytest.raises(CaptureError, match=r"limits\.yaml:1: limits\.0") as fault:
        load_limits(str(path))
    assert told in str(fault.value)


def test_a_limit_is_of_what_is_too_large_or_of_what_is_too_small():
    limits = {limit.name: limit for limit in load_limits().limits}
    largest, smallest = limits["Uncertainty of the normals, mean"], limits["Known share"]
    assert [largest.verdict(v) for v in (0.1, 0.4, 0.6)] == ["ok", "warn", "fail"]
    assert [smallest.verdict(v) for v in (99, 80, 40)] == ["ok", "warn", "fail"]
    assert [limits["Flat level"].verdict(v) for v in (20, 2)] == ["ok", "warn"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ({"until": "25:00"}, "--until: '25:00'"),
        ({"runner": "moon"}, "--runner: there is no runner 'moon'"),
        ({"memory": "much"}, "--memory: 'much'"),
        ({"recipe": "nosuch"}, "nosuch"),
        ({"limits": "nosuch.yaml"}, "--limits"),
        ({"settle": -1.0}, "--settle"),
    ],
)
def test_a_wrong_order_is_refused_by_its_option(tmp_path, words, told):
    own = {name: value for name, value in words.items() if name in ("until", "limits", "settle")}
    with pytest.raises(Exception, match=told):
        check_order(Order(tmp_path, RunOptions.of({"out": tmp_path, **words}), **own))


def test_seconds_per_tile_are_learnt_from_tiles():
    truth = [(size, 30 + 0.5 * size) for size in (6, 25, 50, 100) for _ in range(20)]
    found = learn_estimate(truth)
    for size, seconds in truth:
        assert found.seconds(size) == pytest.approx(seconds, rel=0.1)
    # Few tiles do not mean much: one that took a minute for nothing is not believed.
    assert learn_estimate([(1.0, 60.0)]).seconds(1.0) < 45


def test_the_deadline_is_the_next_such_time_and_the_clock_may_be_set_back(monkeypatch):
    evening = datetime(2026, 3, 2, 22, 0)
    assert Deadline.of("06:30", evening).left == pytest.approx(8.5 * 3600, abs=5)
    assert Deadline.of("23:00", evening).left == pytest.approx(3600, abs=5)
    deadline = Deadline.of("06:30", evening)
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert deadline.left == pytest.approx(8.5 * 3600, abs=5)
    assert Deadline.of(None).left == np.inf


def night(name: str, artwork: str, flats: str, level: float, state: str = "done") -> dict:
    numbers = {"Flat level, Relio_1": {"value": level, "unit": "%"}}
    tile = {"state": state, "measured": {"stand": "horizontal", "flats": flats, "numbers": numbers}}
    return {"name": name, "artworks": [{"artwork": artwork, "tiles": [tile, tile]}]}


def captures(nights: list[dict]) -> list[dict]:
    return [capture for night in reversed(nights) for capture in captures_of(night)]


def test_a_lamp_that_fails_is_marked_and_flats_that_are_used_again_count_once():
    levels = [20.0, 20.1, 19.9, 20.05, 19.95, 20.1, 19.9, 20.0]
    nights = [night(f"n{i}", f"inv-{i}", f"flats-{i}", level) for i, level in enumerate(levels)]
    nights += [night("n8", "inv-8", "flats-7", 20.0), night("n9", "inv-9", "flats-9", 15.0)]
    nights += [night("n10", "inv-9", "flats-9", 15.0, state="unchanged")]
    (stand,) = trends(captures(nights))
    (trend,) = stand["charts"]
    assert stand["captures"] == 10
    assert [point["outside"] for point in trend["points"]] == [False] * 9 + [True]
    assert [point["new_flats"] for point in trend["points"]] == [True] * 8 + [False, True]
    drawn = chart(trend)
    assert "OUTSIDE: inv-9 (n9)" in drawn["sentence"]
    assert [chart["name"] for _, chart in moved({"trends": [stand], "name": "n9"})] == ["Flat level, Relio_1"]
    assert moved({"trends": [stand], "name": "n10"}) == []  # it was told the night before
    assert float(drawn["points"][9]["y"]) > float(drawn["points"][0]["y"])  # lower is further down
    many = [night(f"n{i}", "a", f"f{i}", 20.0) for i in range(40)]
    assert trends(captures(many))[0]["captures"] == 30


def test_control_limits_are_three_standard_deviations_whatever_a_few_outliers_do():
    values = np.random.default_rng(1).normal(10, 0.5, 2000)
    values[:100] = 100
    centre, low, high = control_limits(list(values))
    assert centre == pytest.approx(10, abs=0.1)
    assert low == pytest.approx(8.5, abs=0.2)
    assert high == pytest.approx(11.5, abs=0.2)


def test_a_photograph_that_is_replaced_while_its_tile_runs_fails_the_tile(capture, tmp_path, monkeypatch):
    (tile,), recipe, store = load_capture(capture), load_recipe("default"), Store(tmp_path / "store")
    options = RunOptions(out=tmp_path / "out", store=tmp_path / "store")
    store.prepare()
    made = store.root / tile.artwork / tile.name / "normals-000000000000"

    def replaced(*_):
        made.mkdir(parents=True)
        shutil.copy(capture / "light_2.tif", capture / "light_1.tif")

    monkeypatch.setattr(running, "digitise_tile", replaced)
    with pytest.raises(TileError, match=r"changed while it ran \(light_1\.tif\)"):
        running.run_tile(tile, recipe, options, lambda: None)
    assert not made.exists()  # nobody knows what it was made of
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("stop", [TileError("damaged"), KeyboardInterrupt()])
def test_nothing_is_kept_of_a_replaced_photograph_where_its_tile_fails_or_is_stopped(capture, tmp_path, stop):
    (tile,), recipe, store = load_capture(capture), load_recipe("default"), Store(tmp_path / "store")
    store.prepare()
    made = store.root / tile.artwork / tile.name / "normals-000000000000"

    def replaced_and_stopped():
        with Photographs.watched(tile, recipe, store):
            made.mkdir(parents=True)
            shutil.copy(capture / "light_2.tif", capture / "light_1.tif")
            raise stop

    said = "changed while it ran" if isinstance(stop, TileError) else None
    with pytest.raises(type(stop), match=said):
        replaced_and_stopped()
    assert not made.exists()


def test_a_photograph_that_is_only_touched_or_copied_over_itself_is_the_same(capture, tmp_path):
    (tile,), store = load_capture(capture), Store(tmp_path / "store")
    store.prepare()
    with Photographs.watched(tile, load_recipe("default"), store) as seen:
        assert all(digest.result() for _, digest in seen.stamps.values())
        shutil.copy(capture / "light_1.tif", capture / "again.tif")
        (capture / "again.tif").replace(capture / "light_1.tif")
        os.utime(capture / "dark.tif")
        made = store.root / tile.artwork / tile.name / "height-0123456789ab"
        made.mkdir(parents=True)
    assert made.exists()  # what was made of these photographs is kept


def test_an_empty_address_of_the_api_means_none(monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", "")
    environment.prepare()
    assert "PREFECT_API_URL" not in os.environ
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:4200/api")
    environment.prepare()
    assert os.environ["PREFECT_API_URL"] == "http://127.0.0.1:4200/api"
