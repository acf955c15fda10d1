"""Prefect's surroundings: an API that is down is a sentence, and first starts at once wait for each other."""

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from night_processes import free_port

from nlights_core.errors import NlightsError
from nlights_flows.tiles import environment

NLIGHTS = Path(sys.executable).parent / "nlights"


@pytest.fixture
def served():
    """Start servers that answer every question with a code and a text; gives their addresses."""
    running = []
    asked = []

    def serve(code: int, text: bytes) -> str:
        class Answers(BaseHTTPRequestHandler):
            def do_GET(self):
                asked.append(self.path)
                self.send_response(code)
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text)

            def log_message(self, *words):
                pass

        server = HTTPServer(("127.0.0.1", 0), Answers)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        running.append(server)
        return f"http://127.0.0.1:{server.server_port}/api"

    serve.asked = asked
    yield serve
    for server in running:
        server.shutdown()
        server.server_close()


def commands(painting: Path, folder: Path) -> list[list[object]]:
    inbox = folder / "inbox"
    inbox.mkdir()
    return [
        ["digitise", painting, "--out", folder / "out"],
        ["nightly", inbox, "--out", folder / "night"],
        ["compare", painting, "--recipes", "psbox", "paper", "--out", folder / "compared"],
    ]


@pytest.mark.parametrize("where", ["environment", "profile"])
def test_an_api_that_is_down_is_one_sentence_with_its_address(painting, tmp_path, where):
    address = f"http://127.0.0.1:{free_port()}/api"
    home = tmp_path / "home"
    home.mkdir()
    variables = os.environ | {"PREFECT_HOME": str(home)}
    if where == "environment":
        variables["PREFECT_API_URL"] = address
    else:
        (home / "profiles.toml").write_text(
            f'active = "house"\n[profiles.house]\nPREFECT_API_URL = "{address}"\n'
        )
    for words in commands(painting, tmp_path):
        done = subprocess.run(
            [NLIGHTS, *map(str, words)], capture_output=True, text=True, check=False, env=variables
        )
        assert done.returncode == 2, done.stderr
        (line,) = done.stderr.strip().splitlines()
        assert line.startswith(
            f"{address}: the Prefect API does not answer as it should (Connection refused)"
        )
        assert "PREFECT_API_URL" in line


@pytest.mark.parametrize(
    ("code", "text", "words"),
    [
        (503, b"no healthy upstream", "it answers 503"),
        (502, b"", "it answers 502"),
        (200, b"<html>Prefect</html>", "something else answers there"),
    ],
)
def test_a_gateway_or_another_server_is_no_api(served, code, text, words):
    address = served(code, text)
    with pytest.raises(NlightsError, match=words) as fault:
        environment.require_api(address)
    assert str(fault.value).startswith(address)


def test_a_server_that_hangs_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(environment, "PATIENCE", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}/api"
        with pytest.raises(NlightsError, match="timed out"):
            environment.require_api(address)


@pytest.mark.parametrize(
    "address", ["http://no-such-host.invalid/api", "127.0.0.1:4200/api", "http://", "nonsense"]
)
def test_an_address_that_leads_nowhere_is_told(address):
    with pytest.raises(NlightsError, match="does not answer as it should"):
        environment.require_api(address)


@pytest.mark.parametrize(("code", "text"), [(200, b"true"), (401, b""), (404, b"")])
def test_a_server_that_is_there_is_for_prefect_to_talk_to(served, code, text):
    environment.require_api(served(code, text))
    assert served.asked == ["/api/health"]


HOLD = "import sys, time; from nlights_flows.tiles.environment import alone; from pathlib import Path\n"


def holder(path: Path, seconds: float) -> subprocess.Popen[str]:
    """A process that holds the lock; it has it when this returns."""
    script = f"{HOLD}with alone(Path(sys.argv[1])): print('held', flush=True); time.sleep({seconds})"
    process = subprocess.Popen([sys.executable, "-c", script, path], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def ended(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    process.stdout.close()


def test_one_process_at_a_time_and_a_killed_one_holds_nobody_up(tmp_path):
    path = tmp_path / "home" / "lock"
    process = holder(path, 600)
    try:
        with path.open("a") as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        process.send_signal(signal.SIGKILL)
        with environment.alone(path, patience=60), path.open("a") as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # now it is ours
    finally:
        ended(process)


def test_a_holder_that_hangs_is_not_waited_for_for_ever(tmp_path):
    process = holder(tmp_path / "lock", 600)
    try:
        with environment.alone(tmp_path / "lock", patience=0.3):
            assert process.poll() is None
    finally:
        ended(process)


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_lets_everybody_in(tmp_path, monkeypatch, number):
    def refused(file, how):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refused)
    with environment.alone(tmp_path / "lock", patience=60):
        entered = True
    assert entered


def test_a_folder_that_cannot_be_made_does_not_stop_the_start_and_faults_inside_pass(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="of the block"), environment.alone(tmp_path / "file" / "lock"):
        raise OSError("of the block")


def test_first_starts_of_prefect_at_once_all_succeed(tmp_path):
    script = (
        "from nlights_flows.tiles.environment import prefect_at_hand\n"
        "with prefect_at_hand():\n"
        "    from prefect.client.orchestration import get_client\n"
        "    with get_client(sync_client=True) as client:\n"
        "        print(client.read_flows())"
    )
    variables = {name: value for name, value in os.environ.items() if name != "PREFECT_API_URL"}
    variables["PREFECT_HOME"] = str(tmp_path / "home")
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", script],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=variables,
        )
        for _ in range(2)
    ]
    for run in runs:
        said, complained = run.communicate(timeout=400)
        assert run.returncode == 0, complained
        assert said.strip() == "[]"
        assert "Traceback" not in complained
