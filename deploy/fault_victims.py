"""Whom a round of faults may kill, how it is brought back, and whose processes are about."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from fault_evidence import FaultError
from night_services import Services

VICTIMS = ("worker", "flow", "server", "postgres")
"""The worker alone (its run lives on), the process of the night's run, the server, the whole database."""

RUN_DIES = ("flow", "power")
"""Victims with which the run's process dies; "power" is everything at once."""

ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}


def processes(*marks: str) -> list[int]:
    """The processes of this machine whose environment has an entry that begins so, for every mark."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            with suppress(OSError):
                entries = (folder / "environ").read_bytes().split(b"\0")
                if all(any(entry.startswith(mark.encode()) for entry in entries) for mark in marks):
                    found.append(int(folder.name))
    return found


def kill_all(*marks: str) -> int:
    """Kill the processes whose environment is marked so; returns how many there were."""
    killed = 0
    for _ in range(20):
        there = processes(*marks)
        if not there:
            break
        killed += len(there)
        for process in there:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(0.1)
    return killed


def kill(services: Services, victim: str, run: Mapping[str, Any]) -> None:
    """Kill a victim as a power cut would.

    Raises
    ------
    FaultError
        When there is nothing to kill.
    """
    if victim == "worker":
        services.worker.kill(alone=True)
    elif victim == "power":
        for service in (services.worker, services.server, services.postgres):
            service.kill()
        end_runs(services)
    elif victim == "flow":
        if not kill_all(f"PREFECT__FLOW_RUN_ID={run['id']}"):
            raise FaultError(f"the run '{run['name']}' has no process")
    else:
        {"server": services.server, "postgres": services.postgres}[victim].kill()


def bring_back(services: Services, victim: str) -> None:
    """Start again what was killed, as the service manager of a machine does."""
    if victim == "power":
        for service in (services.postgres, services.server, services.worker):
            service.start()
    elif victim != "flow":
        {"worker": services.worker, "server": services.server, "postgres": services.postgres}[victim].start()


def follow(services: Services, run: Mapping[str, Any], patience: float) -> dict[str, Any]:
    """Wait until a run ends; returns its last state, or the present one when the patience is over."""
    until = time.monotonic() + patience
    state: dict[str, Any] = {"type": "UNKNOWN", "name": "unknown", "message": ""}
    while time.monotonic() < until:
        with suppress(OSError):  # the server or its database comes back just now
            state = services.state(run)
            if state["type"] in ENDED:
                break
            if state["type"] == "RUNNING" and not processes(f"PREFECT__FLOW_RUN_ID={run['id']}"):
                time.sleep(3)  # its last word may be on the way
                state = services.state(run)
                break
        time.sleep(0.3)
    return state


def give_up(services: Services, run: Mapping[str, Any]) -> None:
    """Mark a run as crashed whose process is lost: the act of the automation, sooner."""
    state = {"type": "CRASHED", "name": "Crashed", "message": "its process is lost"}
    services.ask(f"flow_runs/{run['id']}/set_state", {"state": state, "force": True})


def end_runs(services: Services) -> int:
    """End the runs that outlived their worker; returns how many processes there were."""
    return kill_all(f"PREFECT_HOME={services.environment['PREFECT_HOME']}", "PREFECT__FLOW_RUN_ID=")
