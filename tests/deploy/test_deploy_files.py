"""The files of deploy/ keep what an installation relies on: secrets, loopback, pinned versions, no telemetry."""

import ast
import configparser
import inspect
import os
import re
import shutil
import subprocess
import sys
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


def test_the_stacks_secrets_are_files_and_it_refuses_to_start_without(compose):
    text = (DEPLOY / "compose.yaml").read_text()
    assert len(re.findall(r"\$\{NLIGHTS_SECRETS:\?[^}]+\}", text)) == text.count("NLIGHTS_SECRETS") == 2
    given = {name: set(service.get("secrets", ())) for name, service in compose["services"].items()}
    assert given == {
        "postgres": {"postgres-password"},
        "server": {"auth", "postgres-password"},
        "register": {"auth"},
        "worker": {"auth"},
    }
    for name, service in compose["services"].items():
        for variable, value in service["environment"].items():
            if re.search("PASSWORD|AUTH|SECRET|CONNECTION_URL", variable):
                assert variable.endswith("_FILE"), variable
                assert value.removeprefix("/run/secrets/") in given[name]
                # Of the other images' variables nobody but their own entry points makes anything.
                assert (
                    name == "postgres"
                    or variable.removesuffix("_FILE") in (DEPLOY / "with-secrets").read_text()
                )


def test_every_container_is_closed_and_limited(compose):
    assert set(compose["services"]) == set(SERVICES)
    for name, service in compose["services"].items():
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["hostname"] == f"nlights-{name}"
        assert service["mem_limit"]
        assert service["pids_limit"] <= 2048
        assert any(place.startswith("/tmp:") for place in service["tmpfs"])
        added = ["CHOWN", "DAC_OVERRIDE", "FOWNER", "SETGID", "SETUID"] if name == "postgres" else None
        assert service.get("cap_add") == added


@pytest.mark.parametrize("newline", ["", "\n"])
def test_a_command_is_started_with_the_secrets_of_files(tmp_path, newline):
    (tmp_path / "auth").write_text(f"operator:a secret's $HOME `x`{newline}")
    words = ["sh", "-c", 'printf %s "$PREFECT_API_AUTH_STRING"; test -z "${PREFECT_API_AUTH_STRING_FILE:-}"']
    own = {"PATH": os.environ["PATH"], "PREFECT_API_AUTH_STRING_FILE": str(tmp_path / "auth")}
    command = ["sh", str(DEPLOY / "with-secrets"), *words]
    done = subprocess.run(command, env=own, capture_output=True, text=True, check=True)
    assert done.stdout == "operator:a secret's $HOME `x`"
    (tmp_path / "auth").write_text("")
    for _ in ("empty", "missing"):
        refused = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
        assert (refused.returncode, refused.stdout) == (78, "")
        assert "holds no secret for PREFECT_API_AUTH_STRING" in refused.stderr
        (tmp_path / "auth").unlink(missing_ok=True)


def test_the_server_finds_its_database_by_what_compose_tells_it(compose):
    told = {
        name: value
        for name, value in compose["services"]["server"]["environment"].items()
        if name.startswith("PREFECT_SERVER_DATABASE_") and not name.endswith("_FILE")
    }
    program = "from prefect.settings import PREFECT_API_DATABASE_CONNECTION_URL as url; print(url.value())"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={"PATH": os.environ["PATH"], **told, "PREFECT_SERVER_DATABASE_PASSWORD": "p@ss/word"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "postgresql+asyncpg://nlights:p%40ss%2Fword@postgres:5432/nlights"


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
            assert f"!{path}" in (ROOT / ".dockerignore").read_text().splitlines()


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


def test_nights_are_told_through_a_block_that_is_found_by_its_name():
    from prefect.events.schemas.automations import AutomationCore

    wanted = yaml.safe_load((DEPLOY / "automations.yaml").read_text())["automations"][1]
    (action,) = wanted["actions"]
    assert action["block_document_id"] == "nlights"
    action["block_document_id"] = "0" * 8 + "-0000-0000-0000-" + "0" * 12
    automation = AutomationCore.model_validate(wanted)
    assert automation.trigger.match_related.model_dump() == wanted["trigger"]["match_related"]
    assert automation.actions[0].body == "{{ flow_run.state.message }}"


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
    assert service["IPAddressDeny"] == "any"
    assert service["SystemCallErrorNumber"] == "EPERM"
    assert int(service["TasksMax"]) > 0
    assert service["MemoryMax"]
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
@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_systemd_finds_little_that_a_unit_is_exposed_to(path):
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", "--threshold=20", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd is older than --offline")
    assert "Overall exposure level" in done.stdout
    assert done.returncode == 0, done.stdout[-2000:]


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
    assert example["NLIGHTS_SECRETS"] == ""
    for name, (variable, default) in deployment.PLACES.items():
        assert example[variable].strip('"') == default, name
