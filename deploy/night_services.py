"""PostgreSQL, a Prefect server and a worker as processes of this machine, started and stopped together.

For the demonstration of a night and for tests; `docs/operating.md` says how they are installed to stay.
Everything listens on the loopback address only, has secrets made for the occasion, and ends with the
block that started it.  Each can be killed and started again by itself, as a fault would.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from night_database import Database
from night_processes import Service, ServiceError, free_port

from nlights_flows.tiles import environment

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
POOL = "nlights"

QUIET = {**environment.QUIET, "NO_PROXY": "127.0.0.1,localhost", "no_proxy": "127.0.0.1,localhost"}
"""Nothing leaves the machine."""

PATIENT = {"PREFECT_CLIENT_RETRY_EXTRA_CODES": "500", "PREFECT_CLIENT_MAX_RETRIES": "7"}
"""A run waits for minutes where the server has lost its database; by itself Prefect would give the run up."""


class Services:
    """The three services of a night, in a folder; a context manager that stops what it started.

    Parameters
    ----------
    folder : Path
        For data, logs and secrets; what an earlier run left of them is removed.
    inbox, products, flat : Path
        What the deployments are given.
    ui : bool
        Whether the server serves its pages.
    settings : mapping, optional
        More of the environment of all three.
    """

    def __init__(
        self,
        folder: Path,
        inbox: Path,
        products: Path,
        flat: Path | None = None,
        *,
        ui: bool = False,
        settings: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder.resolve()
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        self._database = Database(self.folder)
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.auth = f"operator:{secrets.token_urlsafe(24)}"
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")},
            **QUIET,
            **PATIENT,
            "PREFECT_HOME": str(self.folder / "prefect"),
            "PREFECT_API_URL": f"{self.url}/api",
            "PREFECT_API_AUTH_STRING": self.auth,
            "PREFECT_SERVER_API_AUTH_STRING": self.auth,
            "PREFECT_SERVER_DATABASE_CONNECTION_URL": self._database.url,
            "PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED": "true",
            "PREFECT_SERVER_UI_API_URL": f"{self.url}/api",
            "PREFECT_WORKER_QUERY_SECONDS": "2",
            "NLIGHTS_INBOX": str(inbox.resolve()),
            "NLIGHTS_PRODUCTS": str(products.resolve()),
            "NLIGHTS_FLAT": str((flat or inbox).resolve()),
            **(settings or {}),
        }
        prefect = str(BIN / "prefect")
        start = [prefect, "server", "start", "--host", "127.0.0.1", "--port", str(self.port)]
        self.postgres = self._database.service
        self.server = Service(
            "server", self.folder, start + ([] if ui else ["--no-ui"]), self.environment, self._answers
        )
        work = [prefect, "worker", "start", "--pool", POOL, "--type", "process", "--limit", "2"]
        self.worker = Service("worker", self.folder, [*work, "--name", "demo"], self.environment, self._works)

    def __enter__(self) -> Services:
        """Start database and server; the worker is started by its own method."""
        try:
            self._database.make()
            self.postgres.start()
            self.server.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop all three."""
        self.stop()

    def stop(self) -> None:
        """Stop the three, the database last; a second ctrl-C does not get between."""
        with _undisturbed():
            self.worker.stop(patience=8)  # it would wait for its runs
            self.server.stop()
            self.postgres.stop()
            self._database.clear()

    def register(self) -> None:
        """Make the work pool, the deployments and the automations, by the operator's own script."""
        done = subprocess.run(
            [sys.executable, str(ROOT / "deploy" / "register.py")],
            cwd=ROOT,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        if done.returncode:
            raise ServiceError(f"deploy/register.py failed:\n{done.stdout}\n{done.stderr}")

    def ask(self, path: str, body: Any = None, method: str | None = None, auth: str | None = None) -> Any:
        """Ask the server's API: GET, or POST where there is a body.

        Raises
        ------
        urllib.error.HTTPError
            As the server answers.
        """
        token = base64.b64encode((self.auth if auth is None else auth).encode()).decode()
        request = urllib.request.Request(
            f"{self.url}/api/{path}",
            None if body is None else json.dumps(body).encode(),
            {"Content-Type": "application/json", "Authorization": f"Basic {token}"},
            method=method or ("GET" if body is None else "POST"),
        )
        # No proxy: this is the loopback address.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(request, timeout=30) as answer:
                return json.loads(answer.read() or b"null")
        except urllib.error.HTTPError as refused:
            refused.close()
            raise

    def run(self, deployment: str, **parameters: Any) -> dict[str, Any]:
        """Ask for a run of a deployment, ``flow/name``; the worker takes it up."""
        found = self.ask(f"deployments/name/{deployment}")
        return self.ask(f"deployments/{found['id']}/create_flow_run", {"parameters": parameters})  # type: ignore[no-any-return]

    def state(self, run: Mapping[str, Any]) -> dict[str, Any]:
        """The state of a flow run now: type, name, message."""
        return self.ask(f"flow_runs/{run['id']}")["state"]  # type: ignore[no-any-return]

    def _answers(self) -> bool:
        try:
            self.ask("health")
        except (OSError, ValueError):  # not there yet
            return False
        return True

    def _works(self) -> bool:
        """Whether the pool has a worker that lives."""
        try:
            workers = self.ask(f"work_pools/{POOL}/workers/filter", {})
        except (OSError, ValueError):
            return False
        return any(worker["status"] == "ONLINE" for worker in workers)


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore what asks this process to end, until the block is through."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    former = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, former, strict=True):
            signal.signal(number, handler)
