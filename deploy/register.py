"""Makes what nLights needs on a Prefect server: work pool, deployments, automations.

Usage: python deploy/register.py      (with PREFECT_API_URL, and PREFECT_API_AUTH_STRING where one is set)

Safe to repeat: what exists is brought up to date.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from nlights_core.errors import NlightsError
from nlights_flows.tiles import environment

HERE = Path(__file__).resolve().parent
POOL = "nlights"


def main() -> None:
    """Work pool first: a deployment needs it."""
    environment.prepare()
    address = environment.api_address()
    if address is None:
        sys.exit("no Prefect server is configured; set PREFECT_API_URL, as http://127.0.0.1:4200/api")
    try:
        environment.require_api(address)
    except NlightsError as fault:
        sys.exit(str(fault))
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        _pool(client)
        _automations(client)
    command = ["--no-prompt", "deploy", "--all", "--prefect-file", "deploy/prefect.yaml"]
    sys.exit(subprocess.call([sys.executable, "-m", "prefect", *command], cwd=HERE.parent))


def _pool(client: object) -> None:
    from prefect.client.schemas.actions import WorkPoolCreate
    from prefect.exceptions import ObjectNotFound

    try:
        client.read_work_pool(POOL)  # type: ignore[attr-defined]
        print(f"work pool {POOL}: is there")
    except ObjectNotFound:
        client.create_work_pool(WorkPoolCreate(name=POOL, type="process"))  # type: ignore[attr-defined]
        print(f"work pool {POOL}: made")


def _automations(client: object) -> None:
    """Create the automations, or bring those of the same name up to date."""
    from prefect.events.schemas.automations import AutomationCore

    wanted = yaml.safe_load((HERE / "automations.yaml").read_text(encoding="utf-8"))["automations"]
    for one in wanted:
        if not _with_blocks(client, one):
            print(f"automation {one['name']}: left out, there is no notification block of that name")
            continue
        automation = AutomationCore.model_validate(one)
        body = automation.model_dump(mode="json", exclude={"owner_resource"})  # which an update may not name
        answer = client._client.post("/automations/filter", json={})  # type: ignore[attr-defined]
        answer.raise_for_status()
        former = [found["id"] for found in answer.json() if found["name"] == automation.name]
        if former:
            client._client.put(f"/automations/{former[0]}", json=body).raise_for_status()  # type: ignore[attr-defined]
        else:
            client._client.post("/automations/", json=body).raise_for_status()  # type: ignore[attr-defined]
        print(f"automation {automation.name}: {'brought up to date' if former else 'made'}")


def _with_blocks(client: object, automation: dict[str, Any]) -> bool:
    """Replace the names of the blocks that an automation notifies through by their numbers; False where one lacks."""
    for action in automation["actions"]:
        if name := action.get("block_document_id"):
            asked = {"block_documents": {"name": {"any_": [name]}}, "include_secrets": False}
            answer = client._client.post("/block_documents/filter", json=asked)  # type: ignore[attr-defined]
            answer.raise_for_status()
            found = [one["id"] for one in answer.json() if one["name"] == name]
            if not found:
                return False
            action["block_document_id"] = found[0]
    return True


if __name__ == "__main__":
    main()
