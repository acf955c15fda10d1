"""The public contracts, run on installed plugins: which are kept, which are broken and how."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from nlights_core import algorithms
from nlights_core.algorithms import Algorithm
from nlights_core.errors import PluginError
from nlights_core.registry import Offer, Registry
from nlights_core.testing import contracts

CONTRACTS: dict[type[Algorithm], type[contracts.AlgorithmContract]] = {
    algorithms.LightModel: contracts.LightModelContract,
    algorithms.ImageDetrend: contracts.ImageDetrendContract,
    algorithms.NormalSolver: contracts.NormalSolverContract,
    algorithms.NormalDetrend: contracts.NormalDetrendContract,
    algorithms.Integrator: contracts.IntegratorContract,
    algorithms.HeightDetrend: contracts.HeightDetrendContract,
}

ABSENT = {"spheres": "a chrome sphere of its own making", "lights": "a file of given lights"}
"""What the contract's tile does not describe as every light model may want it."""


@dataclass(frozen=True)
class Verdict:
    """What became of an algorithm's contract.

    Attributes
    ----------
    broken : tuple of str
        Each rule that is broken, and how.
    unchecked : str
        Why it could not be looked at here; empty if it was.
    """

    broken: tuple[str, ...] = ()
    unchecked: str = ""


def chosen(registry: Registry, names: Sequence[str], everything: bool = False) -> list[Offer]:
    """Offers by the names of algorithms or distributions; without names all that nLights does not ship.

    Raises
    ------
    PluginError
        When nothing is called so.
    """
    offers = registry.offers()
    for name in names:
        if not any(name in (o.algorithm.name, o.distribution) for o in offers):
            known = ", ".join(dict.fromkeys(o.algorithm.name for o in offers))
            raise PluginError(f"no algorithm or distribution is called '{name}'; installed are {known}")
    if names:
        return [o for o in offers if o.algorithm.name in names or o.distribution in names]
    return [o for o in offers if everything or o.distribution != "nlights"]


def verdict(offer: Offer) -> Verdict:
    """Run the contract of an algorithm's kind on it, with the default values of its options.

    Parameters
    ----------
    offer : Offer
        The algorithm.

    Returns
    -------
    Verdict
        An algorithm with an option that has no default is not checked.
    """
    cls = offer.algorithm
    try:
        algorithm = cls()
    except ValidationError as faults:
        options = ", ".join(str(fault["loc"][0]) for fault in faults.errors() if fault["loc"])
        return Verdict(unchecked=f"not checked: no default for {options}; its own tests must")
    lacking = [ABSENT[need] for need in cls.needs if need in ABSENT]
    if lacking:
        return Verdict(unchecked=f"not checked: needs {' and '.join(lacking)}; its own tests must")
    contract = next(contract for kind, contract in CONTRACTS.items() if issubclass(cls, kind))
    case = type(f"Test{cls.__name__}", (contract,), {"algorithm": algorithm})()
    return Verdict(tuple(_broken(case)))


def _broken(case: contracts.AlgorithmContract) -> Iterator[str]:
    for rule in sorted(name for name in dir(case) if name.startswith("test_")):
        words = rule.removeprefix("test_").replace("_", " ")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                getattr(case, rule)()
            except AssertionError as fault:
                yield f"{words}: {fault}"
            except (Exception, SystemExit) as fault:
                where = traceback.extract_tb(fault.__traceback__)[-1]
                place = f"{Path(where.filename).name}:{where.lineno}"
                yield f"{words}: {type(fault).__name__}: {fault} ({place})"
