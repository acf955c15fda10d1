"""The files of deploy/ keep what an installation relies on: secrets, loopback, pinned versions, no telemetry."""

import ast
import configparser
import inspect
import re
import shutil
import subprocess
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from night_services import PATIENT

from nlights_flows.nights import deployment

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
}
SERVICES = ("postgres", "server", "register", "worker")
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))


@pytest.fixture(scope="module")
def compose():
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())


def test_the_stack_refuses_to_start_without_its_secrets(compose):
    text = (DEPLOY / "compose.yaml").read_text()
    uses = re.findall(r"\$\{(PREFECT_SERVER_API_AUTH_STRING|NLIGHTS_POSTGRES_PASSWORD)(:\?[^}]+)?\}", text)
    # Each is demanded, with a sentence, wherever it enters by itself.
    assert {name for name, message in uses if message} == {
        "PREFECT_SERVER_API_AUTH_STRING",
        "NLIGHTS_POSTGRES_PASSWORD",
    }
    assert all(message for name, message in uses if name == "PREFECT_SERVER_API_AUTH_STRING")
    for name in ("server", "register", "worker"):
        secrets = [
            v for k, v in compose["services"][name]["environment"].items() if k.endswith("AUTH_STRING")
        ]
        assert len(secrets) == 1
        assert ":?" in secrets[0]


def test_the_stack_is_reached_from_this_machine_only_and_reaches_nothing(compose):
    published = [port for service in compose["services"].values() for port in service.get("ports", [])]
    assert published == ["${NLIGHTS_BIND:-127.0.0.1}:4200:4200"]
    assert compose["networks"]["inside"]["internal"] is True
    for name in SERVICES:
        networks = compose["services"][name]["networks"]
        assert networks == (["inside", "front"] if name == "server" else ["inside"])


def test_the_stack_heals_itself_and_tells_nobody(compose):
    services = compose["services"]
    assert set(services) == set(SERVICES)
    for name in ("postgres", "server", "worker"):
        assert services[name]["restart"] == "unless-stopped"
        assert services[name]["healthcheck"]["test"]
    for name in ("server", "register", "worker"):
        assert services[name]["environment"].items() >= QUIET.items()
    for name in ("register", "worker"):
        assert services[name]["environment"].items() >= PATIENT.items()
    server = services["server"]["environment"]
    assert server["PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED"] == "true"
    assert "PREFECT_SERVER_UI_API_URL" in server
    assert services["worker"]["depends_on"] == {"server": {"condition": "service_healthy"}}
    assert services["server"]["depends_on"] == {"postgres": {"condition": "service_healthy"}}
    inbox = next(v for v in services["worker"]["volumes"] if ":/srv/nlights/inbox" in v)
    assert inbox.endswith(":ro")


def test_every_image_is_pinned_and_no_container_is_roots(compose):
    images = {service["image"] for service in compose["services"].values()}
    images |= set(re.findall(r"^FROM (\S+)", (DEPLOY / "Dockerfile").read_text(), flags=re.MULTILINE))
    for values in (DEPLOY / "helm").glob("*.yaml"):
        assert "latest" not in values.read_text()
        images |= set(re.findall(r"prefectTag: (\S+?)\}", values.read_text()))
    assert len(images) == 5
    for image in images:
        assert re.search(r"\d+\.\d+(\.\d+)?", image.rpartition(":")[2]), image
    docker = (DEPLOY / "Dockerfile").read_text()
    assert re.search(r"^USER 1001:1001$", docker, flags=re.MULTILINE)
    assert "-c /wheels/constraints.txt" in docker
    for source in re.findall(r"^COPY (?!--from)(.+) \S+$", docker, flags=re.MULTILINE):
        for path in source.split():
            assert (ROOT / path).exists(), path


def test_the_servers_version_is_the_tested_one():
    pinned = re.search(r"^prefect==(\S+)$", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)[1]
    assert yaml.safe_load((DEPLOY / "prefect.yaml").read_text())["prefect-version"] == pinned
    assert f"prefectTag: {pinned}-python" in (DEPLOY / "helm" / "server-values.yaml").read_text()


def test_every_deployment_is_a_flow_with_the_parameters_it_is_given():
    described = yaml.safe_load((DEPLOY / "prefect.yaml").read_text())
    names = [one["name"] for one in described["deployments"]]
    assert names == ["nightly", "flat-check", "digitise", "compare"]
    for one in described["deployments"]:
        module, function = one["entrypoint"].split(":")
        flow = getattr(import_module(module), function)
        assert flow.name == one["name"]
        assert set(one["parameters"]) <= set(inspect.signature(flow.fn).parameters)
        assert one["work_pool"] == {"name": "nlights"}
        for value in one["parameters"].values():
            assert set(re.findall(r"\{\{ (\w+) \}\}", value)) <= set(deployment.PLACES)
        for schedule in one["schedules"]:
            assert set(schedule) == {"cron", "timezone", "active"}
        # Prefect resolves the types of a flow's parameters itself.
        tree = ast.parse(Path(inspect.getsourcefile(flow.fn)).read_text())
        futures = [n for n in tree.body if isinstance(n, ast.ImportFrom) and n.module == "__future__"]
        assert not futures, module
    scheduled = [one["name"] for one in described["deployments"] if one["schedules"]]
    assert scheduled == ["nightly", "flat-check"]


def test_places_come_from_the_environment_or_are_those_of_the_operators_page(monkeypatch):
    for variable, _ in deployment.PLACES.values():
        monkeypatch.delenv(variable, raising=False)
    assert deployment.places()["inbox"] == "/srv/nlights/inbox"
    monkeypatch.setenv("NLIGHTS_PRODUCTS", "/data/products")
    monkeypatch.setenv("NLIGHTS_UNTIL", "")  # compose hands on what is not set as empty
    assert deployment.places()["products"] == "/data/products"
    assert deployment.places()["until"] == "06:00"
    monkeypatch.setenv("NLIGHTS_INBOX", "captures")
    with pytest.raises(ValueError, match="NLIGHTS_INBOX: 'captures' is not absolute"):
        deployment.places()


def test_a_lost_run_is_marked_after_three_heartbeats():
    from prefect.events.schemas.automations import AutomationCore
    from prefect.settings import get_current_settings

    wanted = yaml.safe_load((DEPLOY / "automations.yaml").read_text())["automations"]
    automation = AutomationCore.model_validate(wanted[0])
    assert automation.enabled
    beat = get_current_settings().flows.heartbeat_frequency or 180
    assert automation.trigger.within.total_seconds() >= 3 * beat
    assert automation.actions[0].state.value == "CRASHED"


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_are_hardened_restart_and_need_their_secret(path):
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read_string(path.read_text())
    service = unit["Service"]
    assert service["Restart"] == "always"
    assert service["User"] == "nlights"
    assert service["ProtectSystem"] == "strict"
    assert service["NoNewPrivileges"] == "true"
    assert service["EnvironmentFile"].startswith("/etc/nlights/")
    assert "AUTH_STRING" in service["ExecStartPre"]
    assert "Environment=DO_NOT_TRACK=1" in path.read_text()
    if "worker" in path.name:
        for name, value in PATIENT.items():
            assert f"Environment={name}={value}\n" in path.read_text()
    if "server" in path.name:
        assert "--host 127.0.0.1" in service["ExecStart"]
        assert unit["Unit"]["Requires"] == "postgresql.service"
        for name, value in QUIET.items():
            assert f"Environment={name}={value}\n" in path.read_text()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd here")
def test_systemd_understands_the_units():
    done = subprocess.run(["systemd-analyze", "verify", *UNITS], capture_output=True, text=True, check=False)
    # The programs themselves are not installed where tests run.
    complaints = [line for line in done.stderr.splitlines() if "is not executable" not in line]
    assert [line for line in complaints if "nlights" in line] == []


def test_charts_demand_the_secret():
    server, worker = (
        yaml.safe_load((DEPLOY / "helm" / f"{name}-values.yaml").read_text()) for name in ("server", "worker")
    )
    demanded = {"enabled": True, "existingSecret": "nlights-auth"}
    assert server["server"]["basicAuth"] == demanded
    assert worker["worker"]["selfHostedServerApiConfig"]["basicAuth"] == demanded
    told = {one["name"]: one["value"] for one in server["global"]["prefect"]["env"]}
    assert told.items() >= QUIET.items()


def test_the_example_of_the_environment_names_all_that_is_read_and_no_secret(compose):
    example = dict(
        line.split("=", 1)
        for line in (DEPLOY / "environment.example").read_text().splitlines()
        if line and not line.startswith("#")
    )
    assert {variable for variable, _ in deployment.PLACES.values()} <= set(example)
    read = set(re.findall(r"\$\{(\w+)", (DEPLOY / "compose.yaml").read_text()))
    assert read - set(example) == {"NLIGHTS_BIND"}
    assert example["PREFECT_SERVER_API_AUTH_STRING"] == example["NLIGHTS_POSTGRES_PASSWORD"] == ""
    for name, (variable, default) in deployment.PLACES.items():
        assert example[variable].strip('"') == default, name
