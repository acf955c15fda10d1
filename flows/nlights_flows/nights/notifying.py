"""Telling somebody: at its end a night posts its sentence, its counts and its page's address to a web hook.

The address of a hook is a secret: whoever has it can post there.  Only its host is ever shown,
written down or said.
"""

from __future__ import annotations

import logging
import os
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from http.client import responses
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from nlights_core.errors import CaptureError
from nlights_core.names.control_characters import escape_controls
from nlights_flows.nights.decisions import standing
from nlights_flows.nights.inbox import NIGHTS
from nlights_flows.nights.record import PAGE, NightRecord, night_exit_code, summarise_night

VARIABLE = "NLIGHTS_NOTIFY"
"""Of the environment, in place of the option ``--notify``: other people see the words of a command."""

TIMEOUT = 10.0
"""Seconds in which a hook must answer."""

WAITS = (2.0, 8.0)
"""Seconds before the second and the third try."""

PASSING = (408, 425, 429)
"""Answers below 500 that another try may change."""


@dataclass(frozen=True)
class Hook:
    """A web hook that is to be told of a night.

    Attributes
    ----------
    address : str
        Secret.
    host : str
        The part of it that may be shown.
    """

    address: str = field(repr=False)
    host: str


def read_hook(address: str) -> Hook:
    """Read the address of a web hook.

    Raises
    ------
    CaptureError
        When it is none; of the address no more than scheme and host is said.
    """
    import httpx

    wanted = "--notify: should be the address of a web hook that begins with https:// or http://"
    try:
        parts = urlsplit(address)
        host = parts.hostname or ""
        shown = escape_controls(f"{host}:{parts.port}" if parts.port else host)
        httpx.URL(address)
    except (ValueError, httpx.InvalidURL):
        raise CaptureError(f"{wanted}; what was given cannot be read as one") from None
    if parts.scheme not in ("http", "https"):
        plain = "://" in address and parts.scheme.isalnum()
        raise CaptureError(f"{wanted}; got {f'one with {parts.scheme}://' if plain else 'one without'}")
    if not host:
        raise CaptureError(f"{wanted}, and names a host; got none")
    return Hook(address, shown)


def notify(
    record: NightRecord, hook: Hook, timeout: float = TIMEOUT, waits: Sequence[float] = WAITS
) -> dict[str, Any]:
    """Tell a hook of a night, in three tries.

    Parameters
    ----------
    record : NightRecord
    hook : Hook
    timeout : float
        Seconds in which it must answer.
    waits : sequence of float
        Seconds before each further try.

    Returns
    -------
    dict
        "host", "told" (whether it took the message), "tries" and "message" (why not, as a sentence).
    """
    for client in ("httpx", "httpcore"):  # below a warning they write whole addresses into a log
        logging.getLogger(client).setLevel(logging.WARNING)
    said, tries = "", 0
    for wait in (0.0, *waits):
        time.sleep(wait)
        tries += 1
        said, again = _try(hook, message(record), timeout)
        if not said:
            return {"host": hook.host, "told": True, "tries": tries, "message": ""}
        if not again:
            break
    count = f"{tries} tries" if tries > 1 else "1 try"
    sentence = f"{hook.host} was not told of this night: {said} ({count}); see --notify, or {VARIABLE}"
    return {"host": hook.host, "told": False, "tries": tries, "message": sentence}


def message(record: NightRecord) -> dict[str, Any]:
    """Message about a night: "text" is for people, and what chat programs show."""
    sentence = summarise_night(record)
    page = (Path(record.out) / NIGHTS / record.name / PAGE).as_uri()
    tiles = list(record.tiles)
    decisions = [standing(tile.review) for tile in tiles]
    open_tiles = [tile for tile, one in zip(tiles, decisions, strict=True) if one is None]
    return {
        "schema": 1,
        "text": f"nLights, night of {record.name}: {sentence}\n{page}",
        "night": record.name,
        "sentence": sentence,
        "page": page,
        "machine": socket.gethostname(),
        "started": record.started,
        "ended": record.ended,
        "exit_code": night_exit_code(record),
        "counts": {
            "artworks": dict(Counter(artwork.state for artwork in record.artworks)),
            "tiles": dict(Counter(tile.state for tile in tiles)),
            "open": {
                "warnings": sum(bool(tile.warnings) for tile in open_tiles),
                "warn": sum(tile.verdict == "warn" for tile in open_tiles),
                "fail": sum(tile.verdict == "fail" for tile in open_tiles),
            },
            "to_be_photographed_again": sum(one["decision"] == "repeat" for one in decisions if one),
        },
    }


def _try(hook: Hook, told: dict[str, Any], timeout: float) -> tuple[str, bool]:
    """Post once: why it failed (empty if it did not), and whether another try may help."""
    answers: list[tuple[str, bool]] = []
    # In a thread that nobody waits for longer: neither a name that is looked up nor an answer that comes
    # letter by letter keeps to the time-out of the client.
    thread = threading.Thread(target=lambda: answers.append(_post(hook, told, timeout)), daemon=True)
    thread.start()
    thread.join(timeout)
    return answers[0] if answers else (f"no answer within {timeout:g} s", True)


def _post(hook: Hook, told: dict[str, Any], timeout: float) -> tuple[str, bool]:
    import httpx

    try:
        with (
            httpx.Client(timeout=timeout) as client,
            client.stream("POST", hook.address, json=told) as answer,
        ):
            status = answer.status_code  # the rest of the answer is of no interest
    except httpx.TimeoutException:
        return f"no answer within {timeout:g} s", True
    except Exception as fault:  # its own words may hold the address
        return _reason(fault), True
    if 200 <= status < 300:
        return "", False
    said = f"it answers {status} {responses.get(status, '')}".rstrip()
    if 300 <= status < 400:
        return f"{said}, which leads elsewhere; give the address that it leads to", False
    return said, status >= 500 or status in PASSING


def _reason(fault: BaseException) -> str:
    """Words of the system about a connection that failed."""
    cause: BaseException | None = fault
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            return f"its certificate is not trusted ({cause.verify_message})"
        if isinstance(cause, OSError) and cause.strerror:
            return cause.strerror
        cause = cause.__cause__ or cause.__context__
    return f"it gives no answer of HTTP ({type(fault).__name__})"


def take_address(given: str | None) -> str | None:
    """Address that was given, or that stands in the environment; from there it is taken away.

    Plugins may run in children of this process, which have its environment.
    """
    found = os.environ.pop(VARIABLE, None)
    return given or found or None
