"""Measures the chain against what its bytes alone cost, up to 102 megapixels, and writes docs/performance.md.

Run: python benchmarks/full_size.py [--sizes 6 25 102] [--recipe NAME] [--work FOLDER] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import datetime
import os
import re
import shutil
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import scipy.fft
from digest_delays import DELAYS, digest_delay, digitising
from full_size_capture import write_capture
from stage_rates import SOLVERS, integration_ratio, normals_rate, raw_transforms
from tables import Table, write

DOCS = Path(__file__).parents[1] / "docs"
CHUNK = 64 << 20
GB = 1e9


def main() -> None:
    """Make a capture of every size, measure the floor and the chain, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sizes", type=float, nargs="+", default=[6, 25, 102], metavar="MEGAPIXELS")
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--work", type=Path, help="folder for some 35 GB, a temporary one by default")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of performance.md and .json")
    wanted = parser.parse_args()
    rows, growth, rates, delays = [], [], [], []
    with tempfile.TemporaryDirectory(dir=wanted.work) as place:
        _compile(Path(place) / "none", wanted.recipe)
        for size in wanted.sizes:
            measured = _measure(Path(place) / "one", size, wanted.recipe)
            rows += _rows(measured)
            growth.append(_summary(measured))
            rates.append((f"{measured['pixels']:.0f}", *measured["rates"].values()))
            delays.append(_delays(measured))
            shutil.rmtree(Path(place) / "one")
    made = {
        "date": datetime.date.today().isoformat(),
        "cores": os.cpu_count(),
        "memory_GiB": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30),
        "recipe": wanted.recipe,
    }
    columns = ("size, Mpx", "step", "seconds", "share of the chain", "ratio to the floor")
    totals = ("size, Mpx", "floor, s", "chain, s", "ratio", "s per Mpx", "peak memory, GiB", "repeated, s")
    alone = ("size, Mpx", *measured["rates"])
    tables = [
        Table("totals", totals, growth),
        Table("rates", alone, rates),
        Table("store", ("size, Mpx", *(f"{name}, {unit}" for name in DELAYS for unit in ("s", "%"))), delays),
        Table("steps", columns, rows),
    ]
    write(wanted.out, "performance", tables, made)
    for table in tables:
        print(f"\n{table.markdown()}", flush=True)


def _compile(folder: Path, recipe: str) -> None:
    """Have every loop compiled, which a new installation does once, for some 40 seconds."""
    write_capture(folder / "capture", 400)
    _digitise(folder, recipe)
    shutil.rmtree(folder)


def _measure(folder: Path, megapixels: float, recipe: str) -> dict:
    """Make a capture, run the chain on it, and measure what its bytes cost."""
    started = time.monotonic()
    shape = write_capture(folder / "capture", round((megapixels * 1e6 * 4 / 3) ** 0.5))
    pixels = shape[0] * shape[1] / 1e6
    print(f"{pixels:.1f} Mpx: capture written in {time.monotonic() - started:.0f} s", flush=True)
    _forget(folder / "capture")
    floor = {"read all inputs": _read(folder / "capture")}
    _forget(folder / "capture")
    stages, seconds, peak = _digitise(folder, recipe)
    again = _digitise(folder, recipe)[1]
    products = [path for path in (folder / "out").rglob("*") if path.is_file() and ".store" not in path.parts]
    floor["write all outputs"] = _write(folder / "floor.bin", sum(path.stat().st_size for path in products))
    floor["two cosine transforms"] = raw_transforms([scipy.fft.next_fast_len(n, real=True) for n in shape])
    floor["copy the inputs in memory"] = _copy(
        sum(p.stat().st_size for p in (folder / "capture").rglob("*.tif"))
    )
    store = folder / "out" / ".store"
    rates = {f"normals, {name}, Mpx/s": normals_rate(folder / "capture", store, name) for name in SOLVERS}
    rates["simchony / two raw transforms"] = integration_ratio(folder / "capture", store)
    delays = {name: digest_delay(folder, recipe, further=further) for name, further in DELAYS.items()}
    stages["start and end"] = seconds - sum(stages.values())
    for name, value in floor.items():
        print(f"  floor: {name}: {value:.1f} s", flush=True)
    print(f"  chain: {seconds:.1f} s, peak {peak / 2**30:.2f} GiB; again {again:.1f} s", flush=True)
    return {
        "pixels": pixels,
        "floor": floor,
        "stages": stages,
        "seconds": seconds,
        "peak": peak,
        "again": again,
        "rates": rates,
        "delays": delays,
    }


def _rows(measured: dict) -> list[tuple]:
    floor = sum(measured["floor"].values())
    size = f"{measured['pixels']:.0f}"
    rows = [(size, f"floor: {name}", value, None, value / floor) for name, value in measured["floor"].items()]
    rows += [
        (size, name, value, value / measured["seconds"], value / floor)
        for name, value in measured["stages"].items()
    ]
    return rows


def _summary(measured: dict) -> tuple:
    floor = sum(measured["floor"].values())
    return (
        f"{measured['pixels']:.0f}",
        floor,
        measured["seconds"],
        measured["seconds"] / floor,
        measured["seconds"] / measured["pixels"],
        measured["peak"] / 2**30,
        measured["again"],
    )


def _delays(measured: dict) -> tuple:
    """What the digests cost, and that as a share of the chain in percent."""
    shares = [
        one for delay in measured["delays"].values() for one in (delay, 100 * delay / measured["seconds"])
    ]
    return (f"{measured['pixels']:.0f}", *shares)


def _forget(capture: Path) -> None:
    """Take the photographs out of the page cache: at night they come from the disk."""
    for path in capture.rglob("*.tif"):
        with path.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _read(capture: Path) -> float:
    """Seconds to read every photograph."""
    buffer = bytearray(CHUNK)
    started = time.monotonic()
    for path in sorted(capture.rglob("*.tif")):
        with path.open("rb", buffering=0) as file:
            while file.readinto(buffer):
                pass
    return time.monotonic() - started


def _write(path: Path, size: int) -> float:
    """Seconds to write as many bytes as the products have."""
    block = np.random.default_rng(0).bytes(CHUNK)
    started = time.monotonic()
    with path.open("wb", buffering=0) as file:
        for start in range(0, size, CHUNK):
            file.write(block[: min(CHUNK, size - start)])
    seconds = time.monotonic() - started
    path.unlink()
    return seconds


def _copy(size: int) -> float:
    """Seconds to copy as many bytes as the photographs have, in memory."""
    source = np.ones(CHUNK, np.uint8)
    target = np.empty_like(source)
    started = time.monotonic()
    for _ in range(max(1, size // CHUNK)):
        np.copyto(target, source)
    return time.monotonic() - started


def _digitise(folder: Path, recipe: str) -> tuple[dict[str, float], float, int]:
    """Run the command; seconds per stage, in all, and the peak of the memory that is not page cache."""
    started = time.monotonic()
    process = digitising(folder, recipe)
    peak, ended = [0], threading.Event()
    watcher = threading.Thread(target=_watch, args=(process.pid, peak, ended))
    watcher.start()
    stages: dict[str, float] = {}
    assert process.stderr is not None
    for line in process.stderr:
        match = re.match(r"\S+: (\w+): ([\d.]+) s$", line.strip())
        if match:
            stages[match[1]] = stages.get(match[1], 0.0) + float(match[2])
        else:
            print(f"  {line.rstrip()}", flush=True)
    code = process.wait()
    seconds = time.monotonic() - started
    ended.set()
    watcher.join()
    if code:
        raise SystemExit(f"nlights digitise ended with {code}")
    return stages, seconds, peak[0]


def _watch(process: int, peak: list[int], ended: threading.Event) -> None:
    """Keep the largest sum of private memory of a process and its children."""
    while not ended.wait(0.1):
        peak[0] = max(peak[0], sum(_private(one) for one in _family(process)))


def _family(process: int) -> list[int]:
    found = [process]
    for one in found:
        try:
            tasks = list(Path(f"/proc/{one}/task").iterdir())
            for task in tasks:
                found += [int(child) for child in (task / "children").read_text().split()]
        except OSError:
            continue
    return found


def _private(process: int) -> int:
    """Resident bytes that are not those of a file."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0
    return sum(1024 * int(match) for match in re.findall(r"Rss(?:Anon|Shmem):\s+(\d+) kB", status))


if __name__ == "__main__":
    main()
