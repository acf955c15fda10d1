"""Settings that Prefect must find in the environment before it is imported, and whether an API is configured."""

from __future__ import annotations

import os
import ssl
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

from nlights_core.errors import NlightsError

QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
}
"""No telemetry leaves the house; an ephemeral server gets the time that it really needs."""

LOCK = "nlights-starts-a-server.lock"
"""File in Prefect's folder.  Servers that start at once on a new database each want to make its tables, and all but
one fail."""

PATIENCE = 10.0
"""Seconds in which an API must answer."""


def prepare() -> None:
    """Set what is not set already; call before importing prefect."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    if not os.environ.get("PREFECT_API_URL"):  # empty, it means none, which Prefect takes for an address
        os.environ.pop("PREFECT_API_URL", None)


def api_configured() -> bool:
    """Test whether a Prefect API is configured, by the environment or by the active profile."""
    return api_address() is not None


def api_address() -> str | None:
    """Address of the Prefect API that is configured, by the environment or by the active profile.

    Reads the profile itself: importing prefect to ask costs seconds.
    """
    if address := os.environ.get("PREFECT_API_URL"):
        return address
    try:
        profiles = tomllib.loads((_home() / "profiles.toml").read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError):
        return None
    active = os.environ.get("PREFECT_PROFILE", profiles.get("active", ""))
    return profiles.get("profiles", {}).get(active, {}).get("PREFECT_API_URL") or None


def _home() -> Path:
    """Prefect's folder; an account may have no home."""
    return Path(os.environ.get("PREFECT_HOME") or os.path.expanduser("~/.prefect"))  # noqa: PTH111 - it never raises


@contextmanager
def prefect_at_hand() -> Iterator[None]:
    """Have a Prefect API for a block that imports and runs a flow: the configured one, or one of its own.

    Raises
    ------
    NlightsError
        When it does not answer, goes away, or does not start: with its address, and what to do.
    """
    prepare()
    address = api_address()
    if address:
        require_api(address)
    import httpx

    try:
        if not address:
            with alone(_home() / LOCK):
                _start_server()
        yield
    except httpx.HTTPStatusError as fault:
        raise _unreachable(str(fault.request.url), f"it answers {fault.response.status_code}") from fault
    except httpx.HTTPError as fault:
        raise _unreachable(address or "its own server", f"{type(fault).__name__}: {fault}") from fault


def require_api(address: str) -> None:
    """See that a Prefect API answers at an address.

    Raises
    ------
    NlightsError
        Naming the address, the reason and what to do.
    """
    # Nothing secret is sent: whether the certificate is to be trusted is for Prefect to say.
    unverified = ssl._create_unverified_context()
    try:
        with urlopen(f"{address.rstrip('/')}/health", timeout=PATIENCE, context=unverified) as answer:
            if answer.read(64).strip() != b"true":
                raise _unreachable(address, "something else answers there; the address ends in /api")
    except HTTPError as fault:
        fault.close()
        # A server that wants a secret, or has another layout, is there; Prefect itself will say more.
        if fault.code >= 500:
            raise _unreachable(address, f"it answers {fault.code} {fault.reason}") from fault
    except (OSError, ValueError, HTTPException) as fault:
        reason = getattr(fault, "reason", fault)
        raise _unreachable(address, str(getattr(reason, "strerror", None) or reason)) from fault


def _unreachable(address: str, reason: str) -> NlightsError:
    return NlightsError(
        f"{address}: the Prefect API does not answer as it should ({reason}); see whether its server runs, and "
        "whether PREFECT_API_URL (or the active profile) and PREFECT_API_AUTH_STRING are right; without an address "
        "and without --prefect no server is needed"
    )


def _start_server() -> None:
    """Start Prefect's own server for this process; the flow then finds it running."""
    from prefect.client.orchestration import get_client

    try:
        with get_client(sync_client=True):
            pass
    except (RuntimeError, ValueError) as fault:
        raise NlightsError(
            f"Prefect started no server of its own ({str(fault).splitlines()[0]}); run again, set PREFECT_API_URL to "
            "the address of a server, or leave out --prefect"
        ) from fault


@contextmanager
def alone(path: Path, patience: float = 300.0) -> Iterator[None]:
    """Let one process at a time into a block: the others wait, for so many seconds at most.

    The lock is the operating system's, which takes it back from a process that was killed.  Where there is none,
    as on Windows and on some network file systems, nobody waits.

    Parameters
    ----------
    path : Path
        The file that is locked; it stays.
    patience : float
        Seconds after which to go on all the same: whoever holds the lock may hang.
    """
    with ExitStack() as held:
        with suppress(ImportError, OSError):
            import fcntl

            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                file = held.enter_context(path.open("a"))
            except PermissionError:  # made by another account: to read it is enough for a lock of most disks
                file = held.enter_context(path.open())
            until = time.monotonic() + patience
            while time.monotonic() < until:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.1)
        yield


def outlive_reader() -> None:
    """Let a run go on when nobody reads what it prints any more.

    A worker reads its runs through a pipe.  When it is killed, the next line of the log would end
    the run: rich exits where a pipe is broken, which is meant for a command in a shell.
    """
    from rich.console import Console

    def be_quiet(console: Console) -> None:
        console.quiet = True

    Console.on_broken_pipe = be_quiet  # type: ignore[assignment,method-assign]
