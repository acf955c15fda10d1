"""The public contracts, run on installed plugins: which are kept, which are broken and how.

They run in a child process where there is a time-out, and for plugins that nLights does not ship:
one that hangs, crashes or fills the memory is named, and costs itself only.
"""

from __future__ import annotations

import inspect
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from nlights_core import algorithms
from nlights_core import testing as contracts
from nlights_core.algorithms import Algorithm
from nlights_core.errors import PluginError
from nlights_core.registry import Offer, Registry, installed
from nlights_flows.tiles import children
from nlights_flows.tiles.isolation import needs_child

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
    """Verdict on an algorithm's contract.

    Attributes
    ----------
    broken : tuple of str
        Each rule that is broken, and how.
    unchecked : str
        Why it could not be looked at here; empty if it was.
    ended : str
        What ended the checks before their time, and what to do; empty if nothing did.
    """

    broken: tuple[str, ...] = ()
    unchecked: str = ""
    ended: str = ""


def choose_offers(registry: Registry, names: Sequence[str], everything: bool = False) -> list[Offer]:
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


def run_contract(offer: Offer, timeout: float | None = None) -> Verdict:
    """Run the contract of an algorithm's kind on it, with the default values of its options.

    Parameters
    ----------
    offer : Offer
        The algorithm.
    timeout : float, optional
        Seconds that each check may take.

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
    if needs_child([algorithm], timeout):
        return _verdict_of_child(offer, timeout)
    return Verdict(tuple(f"{rule}: {how}" for rule, how in _checked(algorithm) if how))


def _verdict_of_child(offer: Offer, timeout: float | None) -> Verdict:
    """The verdict of a child; what it was at when it ended without one counts as broken."""
    cls, rule, finished = offer.algorithm, "start", False
    broken: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        job = {"slot": cls.slot, "use": cls.name}
        with children.child(__name__, job, Path(scratch), timeout) as child:
            for said in child.words():
                if finished := "finished" in said:
                    break
                child.start_clock()
                rule = said["rule"]
                if said["broken"]:
                    broken.append(f"{rule}: {said['broken']}")
        if finished:
            return Verdict(tuple(broken))
        own = inspect.getsourcefile(cls)
        places = [f" in {Path(f['file']).name}:{f['line']}" for f in child.frames() if f["file"] == own]
        ending = child.ending(places[0] if places else "", "or report it to its author")
    subject = f"{cls.slot}: {cls.name} ({offer.origin}): the check '{rule}'"
    return Verdict(
        (*broken, f"{rule}: did not end"), ended=f"{subject} {ending}; the checks after it were not made"
    )


def _answer(job: dict[str, Any], say: Callable[..., None]) -> None:
    """Check an installed algorithm, in a child; each check is told before and after."""
    children.limit_memory(job["memory"])
    offer = installed().get(job["slot"], job["use"])
    assert offer is not None
    for rule, how in _checked(offer.algorithm()):
        say(rule=rule, broken=how)
    say(finished=True)


def _checked(algorithm: Algorithm) -> Iterator[tuple[str, str | None]]:
    """Each rule of the contract in words: with None before it is checked, then with how it is broken or ""."""
    contract = next(contract for kind, contract in CONTRACTS.items() if isinstance(algorithm, kind))
    case = type(f"Test{type(algorithm).__name__}", (contract,), {"algorithm": algorithm})()
    for name in sorted(name for name in dir(case) if name.startswith("test_")):
        rule = name.removeprefix("test_").replace("_", " ")
        yield rule, None
        yield rule, _broken(getattr(case, name))


def _broken(check: Callable[[], None]) -> str:
    """Fault of a broken rule; empty where it is kept."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            check()
        except AssertionError as fault:
            return str(fault) or "broken"
        except (Exception, SystemExit) as fault:
            where = traceback.extract_tb(fault.__traceback__)[-1]
            return f"{type(fault).__name__}: {fault} ({Path(where.filename).name}:{where.lineno})"
    return ""


if __name__ == "__main__":
    children.answer(_answer)
