"""Interrupts, as an impatient person sends them: five in a row, at any moment of a run."""

import os
import pty
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from nlights_core.names.artworks import folder_of

NLIGHTS = Path(sys.executable).parent / "nlights"
PAUSES = (0.0, 0.001, 0.02, 0.1)


def heed_interrupts() -> None:
    """Undo what a shell does to its background jobs, of which a test run may be one."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def interrupted(words: list, moment: float, chance: random.Random, at_terminal: bool) -> tuple[int, str]:
    """Run a command, interrupt it five times from a moment on; its exit code and all that it said."""
    here, there = pty.openpty() if at_terminal else os.pipe()
    process = subprocess.Popen(
        list(map(str, words)),
        stdin=subprocess.DEVNULL,
        stdout=there,
        stderr=there,
        preexec_fn=heed_interrupts,
        start_new_session=True,
    )
    os.close(there)
    said = bytearray()

    def read() -> None:
        try:
            while part := os.read(here, 65536):
                said.extend(part)
        except OSError:  # how a terminal says that all have left
            pass

    reader = threading.Thread(target=read)
    reader.start()
    while not said and process.poll() is None:  # from the first word on; what is before is Python itself
        time.sleep(0.01)
    time.sleep(moment)
    for _ in range(5):
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        time.sleep(chance.choice(PAUSES))
    code = process.wait(timeout=60)
    reader.join()
    os.close(here)
    return code, said.decode(errors="replace")


@pytest.mark.parametrize("at_terminal", [False, True], ids=["pipe", "terminal"])
@pytest.mark.parametrize("command", ["digitise", "nightly"])
def test_five_interrupts_in_a_row_end_a_run_in_order_at_any_moment(painting, tmp_path, command, at_terminal):
    out, chance = tmp_path / "out", random.Random(f"{command} {at_terminal}")
    words = [NLIGHTS, command, painting, "--out", out]
    if command == "nightly":
        words = [NLIGHTS, command, painting.parent, "--out", out, "--settle", "0"]
    for _ in range(4):  # each goes on where the last one was stopped
        code, said = interrupted(words, chance.uniform(0, 2.5), chance, at_terminal)
        assert code in (0, 130), said
        assert "Traceback" not in said
        assert "Exception ignored" not in said
        if code == 130:
            assert said.count("stopped; what is finished is kept") == 1
        assert not list(out.rglob(".draft-*"))
        assert not [path for path in out.glob(".store/.claims/*/*") if path.is_file()]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (out / folder_of("simulated-painting") / "r0c0" / "report.html").is_file()
    if at_terminal:
        assert said.count("\x1b[?25l") <= said.count("\x1b[?25h")  # the cursor is shown again


def test_an_interrupt_while_the_program_is_being_loaded_is_a_sentence(tmp_path):
    # As Python raises it, at a moment that a test can hit: while the command line is imported.
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt")
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(
        [NLIGHTS, "--version"], capture_output=True, text=True, env=environment, check=False
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "stopped; what is finished is kept: the same command goes on from there\n"


LOST = """
import sys, time
from nlights_flows.commands.cli import main
from nlights_flows.commands import cli
import os, signal

class Last:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # raised here, where Python can only ignore it
            pass

def report(*a, **k):
    one = Last()
    del one
    time.sleep(30)

cli.app.registered_commands.clear()
cli.app.command("report")(lambda: report())
sys.argv = ["nlights", "report"]
main()
"""


def test_an_interrupt_that_python_can_only_ignore_is_heeded_a_moment_later():
    done = subprocess.run(
        [sys.executable, "-c", LOST],
        capture_output=True,
        text=True,
        preexec_fn=heed_interrupts,
        timeout=25,
        check=False,
    )
    assert done.returncode == 130, done.stderr
    assert done.stderr == "stopped; what is finished is kept: the same command goes on from there\n"


def test_an_interrupt_that_comes_when_ending_takes_too_long_ends_at_once():
    ending = "try:\n        print('begun', flush=True)\n        time.sleep(30)\n    finally:\n        time.sleep(60)"
    script = LOST.replace("one = Last()\n    del one", "").replace("time.sleep(30)", ending)
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_interrupts,
    )
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    time.sleep(5.5)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=10)
    assert process.returncode == 130
    assert said == "stopped; what is finished is kept: the same command goes on from there\n"
