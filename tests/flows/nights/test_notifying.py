"""Telling somebody of a night: a web hook that answers, hesitates, refuses, hangs, or sends elsewhere."""

import http.server
import json
import logging
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from nlights_core.errors import CaptureError
from nlights_flows.nights.notifying import VARIABLE, Hook, message, notify, read_hook
from nlights_flows.nights.record import ArtworkEntry, NightRecord, TileEntry

SECRET = "T0KEN-of-the-house"
WAITS = (0.01, 0.01)


class Server(http.server.ThreadingHTTPServer):
    """A hook that answers in the ways it was told, the last of them from then on, and keeps what it was told."""

    def __init__(self, *answers: int) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.answers, self.told, self.paths, self.headers = list(answers), [], [], []
        self.ended = threading.Event()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/hooks/{SECRET}?key={SECRET}"


class Answer(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        told = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.told.append(told)
        self.server.paths.append(self.path)
        self.server.headers.append(dict(self.headers))
        code = self.server.answers.pop(0) if len(self.server.answers) > 1 else self.server.answers[0]
        if code == 0:  # hangs
            self.server.ended.wait(30)
            return
        if code == 1:  # one letter at a time, for ever
            while not self.server.ended.wait(0.05):
                self.wfile.write(b"H")
            return
        self.send_response(code)
        if 300 <= code < 400:
            self.send_header("Location", self.server.address + "/elsewhere")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def do_GET(self) -> None:
        self.server.paths.append(f"GET {self.path}")
        self.send_error(405)

    def log_message(self, *words: object) -> None:
        pass

    def handle_one_request(self) -> None:
        try:
            super().handle_one_request()
        except OSError:  # who asked has gone
            self.close_connection = True


@contextmanager
def hook(*answers: int) -> Iterator[Server]:
    server = Server(*answers)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.ended.set()
        server.shutdown()
        server.server_close()
        thread.join()


def night(out: Path = Path("/srv/products")) -> NightRecord:
    record = NightRecord("2026-03-02", "2026-03-02", "", str(out), "", "default", "2026-03-02T20:00:00+01:00")
    tiles = [TileEntry("a", "done", "", verdict="warn"), TileEntry("b", "failed", "no")]
    record.artworks = [ArtworkEntry("Schiele 3", "Häuser", "x", "failed", tiles=tiles)]
    return record


def told(address: str, timeout: float = 5.0) -> dict:
    return notify(night(), read_hook(address), timeout, WAITS)


def test_a_hook_is_told_sentence_counts_and_page():
    with hook(204) as server:
        assert told(server.address) == {
            "host": f"127.0.0.1:{server.server_port}",
            "told": True,
            "tries": 1,
            "message": "",
        }
    (said,) = server.told
    assert said == json.loads(json.dumps(message(night())))
    assert said["sentence"] == "0 of 1 artwork done, 1 failed, 1 tile to be watched"
    assert said["page"] == "file:///srv/products/nights/2026-03-02/night.html"
    assert said["text"].endswith(f"{said['sentence']}\n{said['page']}")
    assert said["counts"]["tiles"] == {"done": 1, "failed": 1}
    assert said["counts"]["open"] == {"warnings": 0, "warn": 1, "fail": 0}
    assert said["exit_code"] == 1
    assert server.paths == [f"/hooks/{SECRET}?key={SECRET}"]


@pytest.mark.parametrize(
    ("answers", "tries"), [((500, 500, 200), 3), ((503, 201), 2), ((429, 408, 200), 3)], ids=str
)
def test_what_may_pass_is_tried_again(answers, tries):
    with hook(*answers) as server:
        found = told(server.address)
    assert (found["told"], found["tries"], len(server.told)) == (True, tries, tries)


@pytest.mark.parametrize(
    ("code", "tries", "said"),
    [
        (500, 3, "it answers 500 Internal Server Error (3 tries)"),
        (599, 3, "it answers 599 (3 tries)"),
        (404, 1, "it answers 404 Not Found (1 try)"),
        (401, 1, "it answers 401 Unauthorized (1 try)"),
        (301, 1, "which leads elsewhere; give the address that it leads to (1 try)"),
        (307, 1, "which leads elsewhere"),
        (0, 3, "no answer within 0.5 s (3 tries)"),
        (1, 3, "no answer within 0.5 s (3 tries)"),
    ],
)
def test_what_does_not_help_is_a_sentence_without_the_secret(code, tries, said):
    with hook(code) as server:
        found = told(server.address, timeout=0.5)
    assert (found["told"], found["tries"], len(server.paths)) == (False, tries, tries)
    assert said in found["message"]
    assert found["message"].startswith(f"127.0.0.1:{server.server_port} was not told of this night")
    assert SECRET not in json.dumps(found)


def test_a_hook_that_is_not_there_is_a_sentence():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        found = told(f"http://ann:{SECRET}@127.0.0.1:{taken.getsockname()[1]}/")
    assert "Connection refused (3 tries)" in found["message"]
    assert SECRET not in json.dumps(found)
    assert "ann" not in found["host"]


def test_a_host_that_nobody_knows_is_a_sentence():
    found = told(f"https://hook.invalid/{SECRET}", timeout=20)
    assert found["message"].startswith("hook.invalid was not told")
    assert SECRET not in found["message"]


def test_what_is_no_http_is_a_sentence():
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer() -> None:
            for _ in range(3):
                other, _ = listening.accept()
                other.sendall(b"220 mail.example ESMTP\r\n")
                other.close()

        thread = threading.Thread(target=answer)
        thread.start()
        found = told(f"http://127.0.0.1:{listening.getsockname()[1]}/{SECRET}")
        thread.join()
    assert not found["told"]
    assert SECRET not in found["message"]


def test_a_server_without_a_good_certificate_is_told_nothing():
    with hook(200) as server:
        found = told(server.address.replace("http://", "https://"))
    assert not found["told"]
    assert server.told == []


def test_a_name_and_a_password_in_the_address_are_sent_and_not_shown():
    with hook(200) as server:
        found = told(server.address.replace("127.0.0.1", f"ann:{SECRET}@127.0.0.1"))
    assert found["told"]
    assert found["host"] == f"127.0.0.1:{server.server_port}"
    assert server.headers[0]["Authorization"].startswith("Basic ")


def test_no_log_holds_the_address(caplog):
    caplog.set_level(logging.DEBUG)
    with hook(500) as server:
        told(server.address)
    assert SECRET not in caplog.text


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("ftp://hooks.example/" + SECRET, "got one with ftp://"),
        ("file:///etc/" + SECRET, "got one with file://"),
        ("hooks.example/" + SECRET, "got one without"),
        (SECRET, "got one without"),
        (f"{SECRET}:x", "got one without"),
        ("https:///" + SECRET, "got none"),
        (f"https://:{SECRET}@/x", "got none"),
        (f"https://[::1/{SECRET}", "cannot be read"),
        (f"https://hooks.example:{SECRET}/", "cannot be read"),
        (f"https://hooks.example/\x1b{SECRET}", "cannot be read"),
        (" ", "got one without"),
    ],
)
def test_what_is_no_address_of_a_hook_is_refused_without_showing_it(address, said):
    with pytest.raises(CaptureError) as fault:
        read_hook(address)
    assert said in str(fault.value)
    assert SECRET not in str(fault.value)


def test_a_hook_does_not_show_its_address():
    assert SECRET not in repr(read_hook(f"https://a.example:8443/{SECRET}"))
    assert read_hook(f"https://a.example:8443/{SECRET}") == Hook(
        f"https://a.example:8443/{SECRET}", "a.example:8443"
    )


@pytest.fixture(scope="module")
def spent(upload, nlights, tmp_path_factory) -> tuple[Path, Path]:
    """An inbox whose products are all there: a night over it takes a second."""
    folder = tmp_path_factory.mktemp("told")
    upload(folder / "inbox", "inv-1")
    nlights("nightly", folder / "inbox", "--out", folder / "out")
    return folder / "inbox", folder / "out"


def everything_in(out: Path) -> str:
    paths = [out / "night.html", out / "night.json", *(out / "nights").glob("2*/*.*")]
    return "".join(path.read_text(encoding="utf-8") for path in paths)


def test_a_night_tells_at_its_end_when_its_page_is_whole(spent, nlights):
    inbox, out = spent
    with hook(500, 500, 200) as server:
        done = nlights("nightly", inbox, "--out", out, "--notify", server.address)
    record = json.loads((out / "night.json").read_text())
    assert record["notified"] == {
        "host": f"127.0.0.1:{server.server_port}",
        "told": True,
        "tries": 3,
        "message": "",
    }
    said = server.told[-1]
    assert said["sentence"] == record["verdict"]
    assert said["night"] == record["name"]
    page = Path(unquote(urlsplit(said["page"]).path))
    assert record["verdict"] in page.read_text()
    assert "Told of this night" in (out / "night.html").read_text()
    assert SECRET not in everything_in(out) + done.stdout + done.stderr + json.dumps(said)


def test_a_night_that_cannot_tell_says_so_on_its_page_and_ends_as_it_would(spent, nlights):
    inbox, out = spent
    with hook(404) as server:
        environment = os.environ | {VARIABLE: server.address}
        done = nlights("nightly", inbox, "--out", out, env=environment)
    sentence = f"127.0.0.1:{server.server_port} was not told of this night: it answers 404 Not Found (1 try)"
    assert sentence in done.stderr
    assert sentence in (out / "night.html").read_text()
    record = json.loads((out / "night.json").read_text())
    assert sentence in record["notes"][0]
    assert record["ended"]
    assert SECRET not in everything_in(out) + done.stdout + done.stderr


def test_a_wrong_address_is_refused_before_the_night(spent, nlights, tmp_path):
    done = nlights("nightly", spent[0], "--out", tmp_path / "out", "--notify", f"mailto:{SECRET}", code=2)
    assert "--notify: should be the address of a web hook" in done.stderr
    assert SECRET not in done.stderr
    assert not (tmp_path / "out").exists()
