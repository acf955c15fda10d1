"""A night of two small artworks on a real PostgreSQL, a real Prefect server and a real worker."""

import time
import urllib.error

import night_captures
import page_pictures
import pytest
import yaml
from night_services import Services

from nlights_core.configurations import load_stand
from nlights_core.simulation.captures import simulate

ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}
NAMES = [night_captures.whole_name(number) for number in (1, 2)]


@pytest.fixture(scope="module")
def services(tmp_path_factory):
    """Database and server, with the deployments registered; the worker is started by who needs it."""
    folder = tmp_path_factory.mktemp("night")
    (folder / "products").mkdir()
    list(night_captures.fill(folder / "inbox", whole=2, width=96, faults=False))
    # The flat as an artwork: the photographs are its flats.
    simulate(folder / "flat", load_stand("horizontal"), scene="plane", width=96, seed=9)
    manifest = yaml.safe_load((folder / "flat" / "artwork.yaml").read_text())
    manifest = {**manifest, "frames": "flat/light_{n}.tif", "flats": "flat/light_{n}.tif"}
    (folder / "flat" / "artwork.yaml").write_text(yaml.safe_dump(manifest))
    settings = {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30"}
    places = folder / "inbox", folder / "products", folder / "flat"
    with Services(folder / "services", *places, ui=True, settings=settings) as services:
        services.register()
        yield services


def ended(services, run, patience=90):
    until = time.monotonic() + patience
    while time.monotonic() < until:
        state = services.state(run)
        if state["type"] in ENDED:
            return state
        time.sleep(0.5)
    pytest.fail(f"{run['name']} did not end within {patience} s: {state}")


def test_nobody_gets_in_without_the_secret(services):
    for wrong in ("", "operator:", "operator:guessed"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            services.ask("flow_runs/filter", {}, auth=wrong)
        assert refused.value.code == 401
    assert services.ask("flow_runs/filter", {"limit": 1}) is not None


def test_everything_is_deployed_with_its_places_and_schedule(services):
    found = {one["name"]: one for one in services.ask("deployments/filter", {})}
    assert set(found) == {"nightly", "flat-check", "digitise", "compare"}
    night = found["nightly"]
    assert night["parameters"]["inbox"] == services.environment["NLIGHTS_INBOX"]
    assert night["parameters"]["out"] == services.environment["NLIGHTS_PRODUCTS"]
    assert night["parameters"]["until"] == "06:00"
    assert night["schedules"][0]["schedule"]["cron"] == "0 20 * * *"
    assert night["schedules"][0]["schedule"]["timezone"] == "Europe/Rome"
    assert night["global_concurrency_limit"]["limit"] == 1
    assert [len(found[name]["schedules"]) for name in ("flat-check", "digitise", "compare")] == [1, 0, 0]
    assert [one["name"] for one in services.ask("automations/filter", {})] == ["nlights zombie runs"]


def test_the_server_plans_the_coming_nights(services):
    # With some versions of its database library Prefect's server takes schedules and plans nothing.
    until, planned = time.monotonic() + 30, []
    while not planned and time.monotonic() < until:
        planned = services.ask("flow_runs/filter", {"flows": {"name": {"any_": ["nightly"]}}, "limit": 5})
        time.sleep(0.5)
    assert planned
    assert {one["state"]["name"] for one in planned} == {"Scheduled"}
    assert all(one["auto_scheduled"] for one in planned)


def test_the_worker_runs_the_night_on_postgres(services):
    services.worker.start()
    check = services.run("flat-check/flat-check")
    run = services.run("nightly/nightly", until=None, settle=0)
    state = ended(services, run)
    assert state["type"] == "COMPLETED", state["message"]
    products = services.folder.parent / "products"
    for name in NAMES:
        assert (products / name / "r0c0" / "report.html").exists()
        assert name in (products / "night.html").read_text(encoding="utf-8")
    runs = services.ask("flow_runs/filter", {})
    assert {one["name"] for one in runs} >= {*NAMES, run["name"]}
    # The database is PostgreSQL, not a file beside the server.
    assert services.environment["PREFECT_SERVER_DATABASE_CONNECTION_URL"].startswith("postgresql+asyncpg://")
    assert not list((services.folder / "prefect").glob("*.db"))
    checked = ended(services, check)
    assert checked["type"] == "COMPLETED", checked["message"]
    assert "came out flat" in checked["message"]
    assert len(list((products / "flat-checks").glob("*.json"))) == 1


@pytest.mark.skipif(page_pictures.chromium() is None, reason="there is no Chromium here")
def test_both_pages_show_the_night_in_a_browser(services, tmp_path):
    night = services.folder.parent / "products" / "night.html"
    taken = page_pictures.of_night(tmp_path, night, NAMES, ["done"])
    taken += page_pictures.of_prefect(tmp_path, services.url, services.auth, ["nightly", *NAMES])
    assert all(path.stat().st_size > 10_000 for path in taken)
    # Without the secret the server's page asks for it, and shows nothing.
    with pytest.raises(page_pictures.PictureError, match=NAMES[0]), page_pictures.browser() as page:
        page.open(f"{services.url}/runs", NAMES, patience=3)
