"""Settings that Prefect must find in the environment before it is imported, and whether an API is configured."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "180",
}
"""No telemetry leaves the house; an ephemeral server gets the time that it really needs."""


def prepare() -> None:
    """Set what is not set already; call before importing prefect."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    if not os.environ.get("PREFECT_API_URL"):  # empty, it means none, which Prefect takes for an address
        os.environ.pop("PREFECT_API_URL", None)


def api_configured() -> bool:
    """Test whether a Prefect API is configured, by the environment or by the active profile.

    Reads the profile itself: importing prefect to ask costs seconds.
    """
    if os.environ.get("PREFECT_API_URL"):
        return True
    home = Path(os.environ.get("PREFECT_HOME", Path.home() / ".prefect"))
    try:
        profiles = tomllib.loads((home / "profiles.toml").read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError):
        return False
    active = os.environ.get("PREFECT_PROFILE", profiles.get("active", ""))
    return bool(profiles.get("profiles", {}).get(active, {}).get("PREFECT_API_URL"))


def outlive_reader() -> None:
    """Let a run go on when nobody reads what it prints any more.

    A worker reads its runs through a pipe.  When it is killed, the next line of the log would end
    the run: rich exits where a pipe is broken, which is meant for a command in a shell.
    """
    from rich.console import Console

    def be_quiet(console: Console) -> None:
        console.quiet = True

    Console.on_broken_pipe = be_quiet  # type: ignore[assignment,method-assign]
