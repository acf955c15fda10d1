"""Registry of the installed algorithms: the one hook, and the checks at the door.

A distribution offers algorithms by an entry point in the group ``nlights`` that names a module
with the hook::

    from nlights_core.registry import hookimpl

    @hookimpl
    def nlights_algorithms():
        return [CosineBasis]

The bundled algorithms come through the same door.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path

import pluggy

from nlights_core.algorithms import KINDS, Algorithm
from nlights_core.errors import PluginError
from nlights_core.machine.sources import digest_of_files, digests_of_places, files_below

GROUP = "nlights"

BUNDLED = "nlights_plugins"
"""The package of the algorithms that nLights ships."""

PLUGINS_REST_ON = ("integration", "lamps", "photographs", "solving")
"""Departments of the core that a plugin may import, beside what every artefact rests on."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class Hooks:
    """Every hook there is."""

    @hookspec
    def nlights_algorithms(self) -> Iterable[type[Algorithm]]:  # type: ignore[empty-body]
        """Return the classes of algorithms that this plugin offers."""


@dataclass(frozen=True)
class Offer:
    """An algorithm and the distribution that offers it."""

    algorithm: type[Algorithm]
    distribution: str
    version: str

    @property
    def origin(self) -> str:
        """Distribution and version, as people write them."""
        return f"{self.distribution} {self.version}"


class Registry:
    """The algorithms at hand, by slot and name.

    Parameters
    ----------
    offers : iterable of Offer
        Checked one by one: complete, of a known kind, named, and named only once.

    Raises
    ------
    PluginError
        Naming the distribution at fault.
    """

    def __init__(self, offers: Iterable[Offer]) -> None:
        self._offers: dict[tuple[str, str], Offer] = {}
        for offer in offers:
            _check(offer)
            key = (offer.algorithm.slot, offer.algorithm.name)
            other = self._offers.get(key)
            if other is not None:
                raise PluginError(
                    f"{key[0]}: '{key[1]}' is offered by {other.origin} and by {offer.origin}; "
                    "uninstall one of them"
                )
            self._offers[key] = offer

    def offers(self, slot: str | None = None) -> list[Offer]:
        """Algorithms on offer, for one slot or for all, sorted by slot and name."""
        order = [kind.slot for kind in KINDS]
        found = [o for (s, _), o in self._offers.items() if slot in (None, s)]
        return sorted(found, key=lambda o: (order.index(o.algorithm.slot), o.algorithm.name))

    def get(self, slot: str, name: str) -> Offer | None:
        """Look an offer up."""
        return self._offers.get((slot, name))

    def origin(self, algorithm: Algorithm) -> str:
        """Name the distribution that offers an algorithm, with its version."""
        offer = self._offers.get((algorithm.slot, algorithm.name))
        return offer.origin if offer else "not installed"


def _check(offer: Offer) -> None:
    """Refuse a class that could fail later, at night."""
    cls = offer.algorithm
    if not (isinstance(cls, type) and issubclass(cls, Algorithm)):
        raise PluginError(f"{offer.origin}: offers {cls!r}, which is no subclass of Algorithm")
    if not issubclass(cls, KINDS):
        raise PluginError(
            f"{offer.origin}: {cls.__name__} is of no known kind; subclass one of "
            + ", ".join(kind.__name__ for kind in KINDS)
        )
    unknown = set(cls.needs) - {"stand", "flats", "spheres", "lights"}
    if unknown:
        raise PluginError(
            f"{offer.origin}: {cls.__name__} needs {', '.join(sorted(unknown))}, which no tile has; a tile has "
            "stand, flats, spheres and lights"
        )
    if not isinstance(getattr(cls, "name", None), str):
        raise PluginError(f"{offer.origin}: {cls.__name__} has no name; set name: ClassVar[str]")
    if inspect.isabstract(cls):
        missing = ", ".join(sorted(cls.__abstractmethods__))
        raise PluginError(f"{offer.origin}: {cls.__name__} lacks {missing}")


@lru_cache(maxsize=1)
def installed() -> Registry:
    """Load every installed plugin, once per process.

    Raises
    ------
    PluginError
        When a distribution cannot be loaded, offers a misspelt hook, or what it offers is
        incomplete or already taken.
    """
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    offers: list[Offer] = []
    for entry in sorted(metadata.entry_points(group=GROUP), key=lambda e: (e.name != "bundled", e.name)):
        distribution = entry.dist.metadata["Name"] if entry.dist else "unknown distribution"
        version = entry.dist.version if entry.dist else "0"
        try:
            plugin = entry.load()
            name = manager.register(plugin, name=f"{distribution}:{entry.name}")
            manager.check_pending()
        except (Exception, SystemExit) as fault:
            raise PluginError(
                f"{distribution} {version}: cannot be loaded ({fault}); repair or uninstall it"
            ) from fault
        callers = [c for c in manager.hook.nlights_algorithms.get_hookimpls() if c.plugin_name == name]
        if not callers:
            raise PluginError(
                f"{distribution} {version}: {entry.value} has no hook nlights_algorithms; "
                "mark one with @hookimpl, or uninstall it"
            )
        try:
            classes: list[type[Algorithm]] = list(callers[0].function())  # type: ignore[call-overload]
        except (Exception, SystemExit) as fault:
            raise PluginError(
                f"{distribution} {version}: its hook nlights_algorithms should return a list of classes, but "
                f"failed ({type(fault).__name__}: {fault}); repair or uninstall it"
            ) from fault
        offers += [Offer(cls, distribution, version) for cls in classes]
    return Registry(offers)


@cache
def code_digest(cls: type[Algorithm]) -> str:
    """Digest the code behind an algorithm: sha256, 16 hexadecimal digits.

    It is part of the cache key, so that an edited plugin computes anew.  Of a bundled plugin that is its own
    module, since none leans on another.  Of anybody else's it is all of their package, and what of the core
    plugins may import.
    """
    path = inspect.getsourcefile(cls)
    if path is None:
        return hashlib.sha256(cls.__qualname__.encode()).hexdigest()[:16]
    file = Path(path)
    if is_bundled(cls):
        return digest_of_files([file], file.parent)
    package, *inside = cls.__module__.split(".")
    top = file.parents[len(inside) - (file.name != "__init__.py")] if inside else file.parent
    whole = files_below(top) if top.name == package else [file]
    core = digests_of_places(PLUGINS_REST_ON)
    parts = [digest_of_files([p for p in whole if p.suffix == ".py"], top), *core.values()]
    return hashlib.sha256("".join(parts).encode()).hexdigest()[:16]


def is_bundled(cls: type[Algorithm]) -> bool:
    """Tell whether nLights itself ships an algorithm."""
    return cls.__module__.split(".")[0] == BUNDLED
