"""Three kills in one night, of real processes; `make faults` makes many more, and other faults."""

import subprocess
import sys

import fault_evidence as evidence
import fault_kills
import fault_victims
import pytest
from fault_kills import Kill, Whole
from fault_night import require_no_pickles, run_night

from nlights_core.store.records import described_files, sealed


@pytest.fixture(scope="module")
def services(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    with fault_kills.at_work(folder, artworks=2, width=96) as services:
        yield services
    assert not fault_victims.processes(f"PREFECT_HOME={services.environment['PREFECT_HOME']}")


def test_a_night_survives_its_own_death_its_server_and_its_worker(services):
    folder = services.folder.parent
    run_night(folder / "inbox", folder / "whole")
    whole = Whole.of(folder / "whole", folder / "whole" / ".store")
    kills = [Kill("flow", 2, 0.1), Kill("server", 5, 0.0), Kill("worker", 10, 0.1)]
    night = fault_kills.killed_night(services, folder / "killed", whole, kills)
    # Only the run that died itself had to be asked for again.
    assert night.acts == ["it ended Crashed; asked for again"]
    assert night.finished[0] < night.finished[1] < night.finished[2] < whole.folders
    require_no_pickles(folder / fault_kills.WATCHED)


TALKER = """
import sys
from rich.console import Console
from nlights_flows.tiles.environment import outlive_reader
if sys.argv[1] == "outlives":
    outlive_reader()
sys.stdin.read()  # until the reader is gone
console = Console(file=sys.stdout)
for _ in range(2):
    console.print("a line of the log")
sys.stderr.write("went on")
"""


@pytest.mark.parametrize(("how", "end"), [("outlives", "went on"), ("does not", "")])
def test_a_run_outlives_who_reads_its_log(how, end):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", TALKER, how], **pipes) as talker:
        talker.stdout.close()
        talker.stdin.close()
        assert talker.stderr.read().decode().partition("Exception")[0] == end


def test_what_is_damaged_redone_or_left_about_is_noticed(tmp_path):
    folder = tmp_path / "inv-1" / "r0c0" / "maps-0123456789ab"
    folder.mkdir(parents=True)
    (folder / "a").write_bytes(b"1")
    record = {"stage": "maps", "artwork": "inv-1", "tile": "r0c0", "key": "0123456789ab"}
    (folder / "artefact.json").write_text(sealed({**record, "files": described_files([folder / "a"])}))
    evidence.require_whole(tmp_path)
    before = evidence.seen(tmp_path)
    evidence.require_nothing_redone(before, tmp_path)
    (folder / "a").write_bytes(b"")
    with pytest.raises(evidence.FaultError, match="is not whole"):
        evidence.require_whole(tmp_path)
    folder.rename(folder.with_name(".draft-host-1-2"))
    assert evidence.left_about(tmp_path) == [str(folder.with_name(".draft-host-1-2"))]
    with pytest.raises(evidence.FaultError, match="done again"):
        evidence.require_nothing_redone(before, tmp_path)
    with pytest.raises(evidence.FaultError, match="lacks x"):
        evidence.require_same({"x": "1"}, {}, "products")
