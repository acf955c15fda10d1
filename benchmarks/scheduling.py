"""What scheduling costs: Prefect with SQLite and PostgreSQL, Dask, and two nights at one store.

Run it from the root of the checkout::

    python benchmarks/scheduling.py --only here sqlite

The tiles are tiny and everything about them is in the store already, so that what is measured is
what it costs to ask.  Figures go into docs/scheduling.json and, between comment marks, into
docs/scaling.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "deploy"))

import scheduling_runs  # the same folder
from night_database import Database
from night_processes import Service, free_port
from tables import Table, write

from nlights_flows.tiles import environment

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
SECTIONS = ("here", "sqlite", "postgres", "dask", "sqlite-dask", "nights", "nights-without-claims")

TASKS = 9
"""Stages of the default recipe, each a task run where Prefect works alone."""


def child(way: str, words: list[str], given: dict[str, str]) -> dict[str, Any]:
    """What one way takes, in a process of its own."""
    done = subprocess.run(
        [sys.executable, Path(scheduling_runs.__file__), way, *words],
        env=given,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{way} {words}:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]


def plain() -> dict[str, str]:
    """The environment without any Prefect configured."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    return {**kept, **environment.QUIET}


@contextmanager
def server(folder: Path, database: Database | None) -> Iterator[dict[str, str]]:
    """A Prefect server with a database of its own; the environment that leads to it."""
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    given = {
        **plain(),
        "PREFECT_HOME": str(folder / "prefect"),
        "PREFECT_API_URL": url,
        "NO_PROXY": "127.0.0.1",
        "PREFECT_LOGGING_LEVEL": "ERROR",
    }
    if database:
        given["PREFECT_SERVER_DATABASE_CONNECTION_URL"] = database.url
    words = [BIN / "prefect", "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"]
    service = Service("server", folder, words, given, lambda: scheduling_runs.answers(f"{url}/health"))
    try:
        service.start()
        yield given
    finally:
        service.stop()


@contextmanager
def postgres(folder: Path) -> Iterator[Database]:
    """An empty PostgreSQL of our own."""
    database = Database(folder)
    try:
        database.make()
        database.service.start()
        yield database
    finally:
        database.service.stop()
        database.clear()


@contextmanager
def dask(folder: Path, count: int = 2) -> Iterator[str]:
    """A Dask scheduler and workers, processes of this machine."""
    address = f"tcp://127.0.0.1:{free_port()}"
    words: list[str | Path] = [BIN / "dask", "scheduler", "--host", address, "--no-dashboard"]
    scheduler = Service("scheduler", folder, words, plain(), lambda: "Scheduler at" in scheduler.said)
    options = ["--nthreads", "1", "--memory-limit", "0", "--no-nanny", "--no-dashboard"]
    words = [BIN / "dask", "worker", address, *options, "--local-directory", folder / "dask"]
    services = [Service(f"worker-{n}", folder, words, plain(), lambda: True) for n in range(count)]
    try:
        scheduler.start()
        for worker in services:
            worker.start()
        while scheduler.said.count("Register worker") < count:
            time.sleep(0.1)
        yield address
    finally:
        for service in (*services, scheduler):
            service.stop(5)


class Trial:
    """One run of the benchmark: its folder, its captures, its rows."""

    def __init__(self, folder: Path, sizes: list[int]) -> None:
        self.folder, self.sizes = folder, sizes
        self.rows: list[dict[str, Any]] = []

    def captures(self) -> None:
        """Captures of each size, with everything in the store and all products published."""
        child("prepare", [str(self.folder), *map(str, self.sizes)], plain())

    def timed(self, how: str, way: str, given: dict[str, str], *words: str) -> None:
        """Time a way for each size."""
        for size in self.sizes:
            found = child(way, [str(self.folder / str(size)), *words], given)
            if "PREFECT_API_URL" in given:
                before = sum(row["runs"] for row in self.rows if row["how"] == how)
                runs, found["later"] = scheduling_runs.settled(given["PREFECT_API_URL"])
                found["runs"] = runs - before
            self.rows.append({"how": how, "tiles": size, **found})
            print(self.rows[-1], flush=True)

    def section(self, name: str) -> None:
        """Measure one section."""
        with ExitStack() as stack:
            own = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="nlights-", dir=self.folder)))
            own.chmod(0o755)
            if name == "here":
                self.timed("directly", "directly", plain())
            elif name == "dask":
                self.timed("Dask, no Prefect", "dask", plain(), stack.enter_context(dask(own)))
            else:
                base = stack.enter_context(postgres(own)) if name == "postgres" else None
                given = stack.enter_context(server(own, base))
                size = scheduling_runs.database_size(given)
                if name == "sqlite-dask":
                    self.timed("Prefect, SQLite, Dask", "prefect", given, stack.enter_context(dask(own)))
                else:
                    self.timed(f"Prefect, {'PostgreSQL' if base else 'SQLite'}", "prefect", given)
                grown = scheduling_runs.database_size(given) - size
                runs = scheduling_runs.task_runs(given["PREFECT_API_URL"])
                self.rows[-1].update(kb_per_run=grown / runs / 1000)
                print(self.rows[-1], flush=True)


def nights(folder: Path, claims: bool, count: int) -> list[dict[str, Any]]:
    """Two nights started at once on one inbox, ``count`` times, each with an empty store."""
    child("inbox", [str(folder)], plain())
    found = []
    for night in range(count):
        out, log = folder / f"out-{claims}-{night}", folder / f"log-{claims}-{night}"
        words = [sys.executable, scheduling_runs.__file__, "night", folder / "inbox", out, log]
        words.append("claims" if claims else "none")
        started = time.monotonic()
        pair = [subprocess.Popen(list(map(str, words)), env=plain()) for _ in range(2)]
        codes = [process.wait(300) for process in pair]
        made = log.read_text(encoding="utf-8").split()
        found.append(
            {
                "claims": "with" if claims else "without",
                "made": len(made),
                "different": len(set(made)),
                "codes": codes,
                "seconds": time.monotonic() - started,
                "twice": sorted({name.split("/")[-1].split("-")[0] for name in made if made.count(name) > 1}),
            }
        )
        print(found[-1], flush=True)
    return found


def main() -> None:
    """Measure what was asked for, and write it down."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    words.add_argument("--tiles", nargs="+", type=int, default=[10, 100, 300], help="sizes of the artworks")
    words.add_argument("--nights", type=int, default=5)
    words.add_argument("--work", type=Path, help="folder of captures; what is there is used again")
    words.add_argument("--out", type=Path, default=ROOT / "docs", help="where page and figures go")
    asked, load = words.parse_args(), round(os.getloadavg()[0], 2)
    conditions = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "cores": len(os.sched_getaffinity(0)),
        "python": sys.version.split()[0],
        "load before": load,
    }
    with ExitStack() as stack:
        work = asked.work or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="nlights-")))
        work.mkdir(parents=True, exist_ok=True)
        work.chmod(0o755)
        trial, pairs = Trial(work.resolve(), asked.tiles), []
        if any(not name.startswith("nights") for name in asked.only):
            trial.captures()
        for name in asked.only:
            if name.startswith("nights"):
                pairs += nights(trial.folder, name == "nights", asked.nights)
            else:
                trial.section(name)
            keep(asked.out, trial.rows, pairs, conditions)


def keep(
    out: Path, rows: list[dict[str, Any]], pairs: list[dict[str, Any]], conditions: dict[str, Any]
) -> None:
    """Write the tables; sections that were not measured stay as they were."""
    out.mkdir(parents=True, exist_ok=True)
    data = out / "scheduling.json"
    former = json.loads(data.read_text(encoding="utf-8")) if data.exists() else {}
    raw = former.get("raw", {"rows": [], "pairs": []})
    measured = {row["how"] for row in rows}
    raw["rows"] = [row for row in raw["rows"] if row["how"] not in measured] + rows
    paired = {pair["claims"] for pair in pairs}
    raw["pairs"] = [pair for pair in raw["pairs"] if pair["claims"] not in paired] + pairs
    data.write_text(json.dumps({**former, "raw": raw}, indent=1) + "\n", encoding="utf-8")
    write(out, "scaling", [*costs(raw["rows"]), *shared(raw["pairs"])], conditions, data="scheduling")


def costs(rows: list[dict[str, Any]]) -> list[Table]:
    """Seconds per tile, what one tile costs, and what stays in the database."""
    direct = {row["tiles"]: row["seconds"] for row in rows if row["how"] == "directly"}
    scheduling = [
        (
            row["how"],
            str(row["tiles"]),
            row["seconds"],
            row["seconds"] / row["tiles"],
            (row["seconds"] - direct[row["tiles"]]) / row["tiles"] if row["tiles"] in direct else None,
            row.get("later"),
        )
        for row in rows
    ]
    one = [
        (
            row["how"],
            row["import"],
            row["usual_empty"],
            row["empty"],
            row["one"],
            row["one_directly"],
            row["one"] - row["empty"] - row["one_directly"],
        )
        for row in rows
        if "one" in row
    ]
    per_tile = {"Prefect, SQLite, Dask": 1}
    stays = [
        (row["how"], str(runs), row["kb_per_run"], row["kb_per_run"] * runs)
        for row in rows
        if "kb_per_run" in row and (runs := per_tile.get(row["how"], TASKS))
    ]
    return [
        Table(
            "scheduling",
            ("how", "tiles", "s in all", "s per tile", "beyond directly, s per tile", "recorded after, s"),
            scheduling,
        ),
        Table(
            "one-tile",
            (
                "how",
                "import of Prefect, s",
                "empty flow, s",
                "without its wait, s",
                "flow of one tile, s",
                "the same directly, s",
                "beyond both, s",
            ),
            one,
        ),
        Table("database", ("how", "task runs per tile", "kB per task run", "kB per tile"), stays),
    ]


def shared(pairs: list[dict[str, Any]]) -> list[Table]:
    """How seldom two nights do the same work."""
    rows = []
    for claims in ("with", "without"):
        found = [pair for pair in pairs if pair["claims"] == claims]
        if found:
            made, different = (sum(pair[name] for pair in found) for name in ("made", "different"))
            which = ", ".join(sorted({name for pair in found for name in pair["twice"]})) or "none"
            seconds = sum(pair["seconds"] for pair in found) / len(found)
            share = f"{100 * (made - different) / different:.1f} %"
            rows.append(
                (claims, str(len(found)), str(different), str(made - different), share, which, seconds)
            )
    columns = ("claims", "pairs of nights", "stages needed", "made twice", "share", "which", "s per pair")
    return [Table("two-nights", columns, rows)]  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
