"""Pictures of pages, taken by a headless Chromium, and whether the pages hold what they should.

Chromium is driven through its own debugging protocol over a loopback socket; nothing is installed.
"""

from __future__ import annotations

import base64
import contextlib
import io
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import connect
from websockets.sync.connection import Connection

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SIZE = (1400, 1700)
FEWEST_COLOURS = 24
"""A page with text and signs has more colours than this; an empty one has a few."""


class PictureError(Exception):
    """A page that is blank, or lacks what it should say."""


def chromium() -> str | None:
    """The path of an installed Chromium; None when there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


@contextlib.contextmanager
def browser() -> Iterator[Page]:
    """A headless Chromium with one page, in a profile of its own that is removed afterwards."""
    program = chromium()
    if program is None:
        raise PictureError("there is no Chromium here; on Debian: apt install chromium")
    with tempfile.TemporaryDirectory(prefix="nlights-chromium-", ignore_cleanup_errors=True) as profile:
        words = [
            "--headless=new",
            "--remote-debugging-port=0",
            f"--user-data-dir={profile}",
            f"--window-size={SIZE[0]},{SIZE[1]}",
            "--no-first-run",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--no-proxy-server",
            # Nothing but this machine is reached, whatever a page asks for.
            "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
            # A sandbox is not to be had for root, who only looks at pages of this machine here.
            *(["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []),
            "about:blank",
        ]
        process = subprocess.Popen(
            [program, *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            with connect(_address(Path(profile), process), max_size=None, proxy=None) as socket:
                yield Page(socket)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, 9)
            process.wait()


def _address(profile: Path, process: subprocess.Popen[bytes], patience: float = 60) -> str:
    """Where Chromium listens; it writes that into its profile."""
    told, until = profile / "DevToolsActivePort", time.monotonic() + patience
    while time.monotonic() < until and process.poll() is None:
        with contextlib.suppress(OSError, ValueError):
            port, path = told.read_text().split()
            return f"ws://127.0.0.1:{port}{path}"
        time.sleep(0.1)
    raise PictureError(f"Chromium did not start within {patience:g} s")


class Page:
    """One page of a browser."""

    def __init__(self, socket: Connection) -> None:
        self._socket, self._numbers, self._session = socket, itertools.count(1), ""
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._call("Page.enable")

    def remember(self, key: str, value: str) -> None:
        """Put something into the local storage of every page that is opened from now on."""
        script = f"localStorage.setItem({json.dumps(key)}, {json.dumps(value)})"
        self._call("Page.addScriptToEvaluateOnNewDocument", source=f"try {{ {script} }} catch (e) {{}}")

    def open(self, address: str, words: Sequence[str], patience: float = 60) -> None:
        """Open a page and wait until it shows all of some words, whatever their case.

        Raises
        ------
        PictureError
            When it does not; with what it shows instead.
        """
        self._call("Page.navigate", url=address)
        until, lacking, text = time.monotonic() + patience, list(words), ""
        while time.monotonic() < until:
            text = self.text().casefold()
            lacking = [word for word in words if word.casefold() not in text]
            if not lacking:
                return
            time.sleep(0.3)
        raise PictureError(f"{address} lacks {', '.join(lacking)}; it shows: {text[:600]!r}")

    def text(self) -> str:
        """What a person can read on the page."""
        found = self._call(
            "Runtime.evaluate", expression="document.body ? document.body.innerText : ''", returnByValue=True
        )
        return str(found["result"].get("value", ""))

    def picture(self, path: Path) -> None:
        """Write what the window shows as PNG.

        Raises
        ------
        PictureError
            When that is blank.
        """
        time.sleep(1.0)  # pictures and fonts come after the text
        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).reshape(-1, 3)
        colours = len(np.unique(pixels[:: max(1, len(pixels) // 200_000)], axis=0))
        if colours < FEWEST_COLOURS:
            raise PictureError(f"{path} is as good as blank: {colours} colours")

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == number:
                if "error" in answer:
                    raise PictureError(f"{method}: {answer['error']}")
                return dict(answer["result"])


def of_night(folder: Path, night: Path, ids: Sequence[str], words: Sequence[str]) -> list[Path]:
    """Take a picture of a night's page, which must name its artworks and say the words."""
    with browser() as page:
        page.open(night.resolve().as_uri(), [*ids, *words])
        page.picture(folder / "night.png")
    return [folder / "night.png"]


def of_prefect(folder: Path, url: str, auth: str, ids: Sequence[str]) -> list[Path]:
    """Take a picture of a Prefect server's list of runs, which must name the artworks' runs.

    The page asks for the authentication string and keeps it in its local storage, under the name
    used here; so it is put there before.
    """
    with browser() as page:
        page.remember("prefect-password", base64.b64encode(auth.encode()).decode())
        page.open(f"{url}/runs", ids)
        page.picture(folder / "prefect-runs.png")
    return [folder / "prefect-runs.png"]
