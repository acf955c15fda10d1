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


@dataclass(frozen=True)
class Broken:
    """A plugin, or one of its algorithms, that cannot be used.

    Attributes
    ----------
    distribution, version : str
        Whose it is.
    why : str
        What is wrong with it and what to do, in a sentence that names it.
    """

    distribution: str
    version: str
    why: str

    @property
    def origin(self) -> str:
        """Distribution and version, as people write them."""
        return f"{self.distribution} {self.version}"


class Registry:
    """The algorithms at hand, by slot and name.

    Parameters
    ----------
    offers : iterable of Offer
        Checked one by one: complete, of a known kind, and named.
    broken : iterable of Broken
        What could not even be looked at.

    Attributes
    ----------
    broken : list of Broken
        Plugins that cannot be used.  They cost nothing until a recipe asks for one.
    """

    def __init__(self, offers: Iterable[Offer], broken: Iterable[Broken] = ()) -> None:
        self._offers: dict[tuple[str, str], Offer] = {}
        self._contested: dict[tuple[str, str], str] = {}
        self.broken = list(broken)
        for offer in offers:
            try:
                _check(offer)
            except PluginError as fault:
                self.broken.append(Broken(offer.distribution, offer.version, str(fault)))
                continue
            key = (offer.algorithm.slot, offer.algorithm.name)
            other = self._offers.setdefault(key, offer)
            if other is not offer:
                self._contested[key] = (
                    f"{key[0]}: '{key[1]}' is offered by {other.origin} and by {offer.origin}; "
                    "uninstall one of them"
                )
                self.broken.append(Broken(offer.distribution, offer.version, self._contested[key]))

    def offers(self, slot: str | None = None) -> list[Offer]:
        """Algorithms on offer, for one slot or for all, sorted by slot and name."""
        order = [kind.slot for kind in KINDS]
        found = [o for (s, _), o in self._offers.items() if slot in (None, s)]
        return sorted(found, key=lambda o: (order.index(o.algorithm.slot), o.algorithm.name))

    def get(self, slot: str, name: str) -> Offer | None:
        """Look an offer up.

        Raises
        ------
        PluginError
            When two distributions offer it: nobody can tell which is meant.
        """
        if (slot, name) in self._contested:
            raise PluginError(self._contested[slot, name])
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
    unknown = set(cls.needs) - {"stand", "flats", "spheres", "lights", "known_heights"}
    if unknown:
        raise PluginError(
            f"{offer.origin}: {cls.__name__} needs {', '.join(sorted(unknown))}, which no tile has; a tile has "
            "stand, flats, spheres, lights and known_heights"
        )
    if not isinstance(getattr(cls, "name", None), str):
        raise PluginError(f"{offer.origin}: {cls.__name__} has no name; set name: ClassVar[str]")
    if inspect.isabstract(cls):
        missing = ", ".join(sorted(cls.__abstractmethods__))
        raise PluginError(f"{offer.origin}: {cls.__name__} lacks {missing}")


@lru_cache(maxsize=1)
def installed() -> Registry:
    """Load every installed plugin, once per process.

    One that cannot be loaded, offers a misspelt hook, or offers what is incomplete or already taken is
    among the registry's `Registry.broken`.

    Raises
    ------
    PluginError
        When what nLights itself ships cannot be loaded.
    """
    offers: list[Offer] = []
    broken: list[Broken] = []
    for entry in sorted(metadata.entry_points(group=GROUP), key=lambda e: (e.name != "bundled", e.name)):
        distribution = (entry.dist.metadata["Name"] if entry.dist else None) or "unknown distribution"
        version = (entry.dist.version if entry.dist else None) or "0"
        try:
            offers += [Offer(cls, distribution, version) for cls in _offered(entry)]
        except PluginError as fault:
            if entry.value == BUNDLED:
                raise PluginError(f"{distribution} {version}: {fault}") from fault
            broken.append(Broken(distribution, version, f"{distribution} {version}: {fault}"))
    return Registry(offers, broken)


def broken_plugins() -> list[Broken]:
    """Plugins that were found to be broken in this process; none where nobody has looked yet."""
    return installed().broken if installed.cache_info().currsize else []


def _offered(entry: metadata.EntryPoint) -> list[type[Algorithm]]:
    """Classes that an entry point offers.

    Raises
    ------
    PluginError
        Saying what is wrong with it, but not whose it is.
    """
    # A manager of its own: a misspelt hook would count against every plugin that comes after it.
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    try:
        manager.register(entry.load(), name=entry.name)
        manager.check_pending()
    except (Exception, SystemExit) as fault:
        said = f"{type(fault).__name__}: {fault}" if str(fault) else type(fault).__name__
        raise PluginError(f"cannot be loaded ({said}); repair or uninstall it") from fault
    callers = manager.hook.nlights_algorithms.get_hookimpls()
    if not callers:
        raise PluginError(
            f"{entry.value} has no hook nlights_algorithms; mark one with @hookimpl, or uninstall it"
        )
    try:
        classes: list[type[Algorithm]] = list(callers[0].function())  # type: ignore[call-overload]
    except (Exception, SystemExit) as fault:
        raise PluginError(
            "its hook nlights_algorithms should return a list of classes, but failed "
            f"({type(fault).__name__}: {fault}); repair or uninstall it"
        ) from fault
    return classes


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
