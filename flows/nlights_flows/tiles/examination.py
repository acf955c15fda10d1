"""Examination of an installation: what `nlights doctor` says."""

from __future__ import annotations

import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import gettempdir

from nlights_core import __version__
from nlights_core.errors import NlightsError
from nlights_core.machine.band_threads import cores
from nlights_core.machine.containers import memory_limit
from nlights_core.machine.kernel_cache import folders, is_prepared, writable_folder
from nlights_core.machine.kernel_switch import SWITCH, available
from nlights_core.machine.targets import NATIVE, TARGETS
from nlights_core.memory import GIB, budget, machine_memory
from nlights_core.registry import installed

PACKAGES = ("numpy", "scipy", "numba", "scikit-image", "rawpy", "tifffile", "trimesh", "pydantic", "prefect")
"""Whose versions are asked for first when something is wrong."""

OPTIONAL = ("dask", "prefect-dask")


def facts() -> list[tuple[str, str]]:
    """Facts of this machine, as pairs of a name and a sentence or number with its unit."""
    return [
        ("nLights", __version__),
        ("Python", f"{platform.python_version()}, {sys.prefix}"),
        ("System", f"{platform.system()} {platform.release()}, {platform.machine()}"),
        ("Packages", ", ".join(f"{name} {_version(name)}" for name in PACKAGES)),
        ("Optional", ", ".join(f"{name} {_version(name)}" for name in OPTIONAL)),
        ("Plugins", _plugins()),
        ("Cores", f"{cores()} for this process"),
        ("Memory", _memory()),
        ("Disk", "; ".join(_disk(place) for place in (Path.cwd(), Path(gettempdir())))),
        ("Compiled loops", _compiled()),
    ]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _plugins() -> str:
    try:
        found = installed()
    except NlightsError as fault:
        return str(fault)
    offers = found.offers()
    said = f"{len(offers)} algorithms of {', '.join(sorted({offer.origin for offer in offers}))}"
    return "; ".join([said, *(f"broken: {plugin.why}" for plugin in found.broken)])


def _memory() -> str:
    whose = "container's limit" if memory_limit() else "machine"
    return f"{machine_memory() / GIB:.1f} GiB ({whose}); a tile may take {budget() / GIB:.1f} GiB"


def _disk(place: Path) -> str:
    return f"{shutil.disk_usage(place).free / GIB:.1f} GiB free in {place}"


def _compiled() -> str:
    if not available():
        return f"not used: {SWITCH}=off, or numba is not installed"
    prepared = [name for name in (*(target.name for target in TARGETS), NATIVE) if is_prepared(name)]
    if prepared:
        places = ", ".join(str(folder) for folder in folders() if any(folder.iterdir()))
        return f"prepared for {', '.join(prepared)}: {places}"
    target = writable_folder()
    if target is None:
        return (
            "not prepared, and no folder for them can be written: every run compiles for half a minute; run "
            "`nlights doctor --warm` as the owner of the installation, or set NUMBA_CACHE_DIR to a folder of your own"
        )
    return (
        f"not prepared: the first painting waits half a minute, or run `nlights doctor --warm` (to {target})"
    )
