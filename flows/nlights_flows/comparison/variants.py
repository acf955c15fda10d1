"""Variants: the recipes that are compared, from files or from a grid of choices."""

from __future__ import annotations

import copy
import difflib
import re
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from nlights_core.configurations import explain
from nlights_core.errors import RecipeError
from nlights_core.recipe import Detrends, Recipe, RecipeLike, load_recipe
from nlights_core.registry import Registry, installed

MOST = 64
"""Variants of one comparison."""

REQUIRED = ("light_model", "normals", "integrator")
SLOTS = (*REQUIRED, *(f"detrend.{name}" for name in Detrends.model_fields))
PLAIN = ("passes", "integrable", "calibration")
WITH_OPTIONS = (*SLOTS, "calibration")
NONE = "none"
"""What a grid says for a detrend, or a calibration, that shall be left out."""

Axis = tuple[str, list[Any]]
"""One direction of a grid: the field of the recipe, and its values."""


def variants_of(
    recipes: Sequence[RecipeLike],
    grid: Sequence[str],
    base: RecipeLike = "default",
    registry: Registry | None = None,
) -> list[Recipe]:
    """Load the recipes to compare, each under a name of its own.

    Parameters
    ----------
    recipes : sequence of RecipeLike
        Names of shipped recipes, paths, or recipes themselves.
    grid : sequence of str
        ``field=value,value``: every combination becomes a variant of ``base``; none if empty.
    base : RecipeLike
        The recipe that a grid varies.
    registry : Registry, optional
        The algorithms to choose from; those installed by default.

    Returns
    -------
    list of Recipe
        Those of ``recipes`` first, then those of the grid, the last axis running fastest.

    Raises
    ------
    RecipeError
        Naming the option, what was found and what is allowed.
    """
    registry = registry or installed()
    found = [load_recipe(what, registry) for what in recipes]
    found = _apart(found, recipes)
    if grid:
        found += grid_variants(load_recipe(base, registry), [parse_axis(text) for text in grid], registry)
    doubled = [name for name, count in Counter(recipe.name for recipe in found).items() if count > 1]
    if doubled:
        raise RecipeError(f"--recipes, --grid: the variant '{doubled[0]}' stands twice; leave one out")
    if len(found) < 2:
        raise RecipeError(
            f"--recipes, --grid: {len(found)} variant{'s' * (len(found) != 1)} given, and a comparison needs two; "
            "for instance --recipes default psbox, or --grid integrator=simchony,frankot-chellappa"
        )
    if len(found) > MOST:
        raise RecipeError(f"--recipes, --grid: make {len(found)} variants; at most {MOST} are allowed")
    return found


def _apart(found: list[Recipe], given: Sequence[RecipeLike]) -> list[Recipe]:
    """Recipes of the same file name, told apart by what was written on the command line."""
    count = Counter(recipe.name for recipe in found)
    return [
        recipe.model_copy(update={"name": str(what)})
        if count[recipe.name] > 1 and isinstance(what, str | Path)
        else recipe
        for recipe, what in zip(found, given, strict=True)
    ]


def folder_of(recipe: Recipe) -> str:
    """A plain folder name for a variant's products."""
    return re.sub(r"[^\w .,()+-]", "_", recipe.name).strip(" .")[:100] or "variant"


def parse_axis(text: str) -> Axis:
    """Read ``field=value,value``; each value is a YAML scalar.

    Raises
    ------
    RecipeError
        When it is not of that form, or there is no such field.

    Examples
    --------
    >>> parse_axis("normals.shadow=0.02,0.05")
    ('normals.shadow', [0.02, 0.05])
    """
    field, equals, said = text.partition("=")
    if not equals or not said:
        raise RecipeError(
            f"--grid {text}: should be like passes=1,3 or integrator=simchony,frankot-chellappa"
        )
    if field not in (*SLOTS, *PLAIN) and field.rpartition(".")[0] not in WITH_OPTIONS:
        near = difflib.get_close_matches(field.split(".")[0], (*SLOTS, *PLAIN), n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise RecipeError(
            f"--grid {field}: a recipe has no such field; {hint}allowed: {', '.join((*SLOTS, *PLAIN))}, and a "
            "slot's option as normals.shadow"
        )
    values = [_scalar(field, part) for part in said.split(",")]
    twice = [value for i, value in enumerate(values) if value in values[:i]]
    if twice:
        raise RecipeError(f"--grid {field}: the value {twice[0]!r} stands twice; leave one out")
    return field, values


def _scalar(field: str, text: str) -> Any:
    try:
        value = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError):
        value = []
    if not isinstance(value, str | int | float | None) or not text.strip():
        raise RecipeError(f"--grid {field}: should be plain values between commas; got {text!r}")
    return value


def grid_variants(base: Recipe, axes: Sequence[Axis], registry: Registry) -> list[Recipe]:
    """Every combination of the values of some axes, as variants of a recipe.

    A slot that gets another algorithm starts from that algorithm's defaults; one that keeps its
    algorithm keeps the recipe's options.

    Raises
    ------
    RecipeError
        Naming the field of the grid that is at fault.
    """
    fields = [field for field, _ in axes]
    doubled = [field for field, count in Counter(fields).items() if count > 1]
    if doubled:
        raise RecipeError(f"--grid {doubled[0]}: stands twice; put all its values behind one =")
    # A slot is filled before its options are set, in whatever order they were given.
    order = sorted(range(len(axes)), key=lambda i: fields[i] not in SLOTS)
    found = []
    for values in product(*(choices for _, choices in axes)):
        record = copy.deepcopy(base.record())
        for i in order:
            _set(record, fields[i], values[i], base)
        name = " + ".join(_said(field, value, fields) for field, value in zip(fields, values, strict=True))
        found.append(_recipe(record, name, registry))
    return found


def _said(field: str, value: Any, fields: Sequence[str]) -> str:
    """One choice in a variant's name."""
    if field in SLOTS:
        return f"no {field}" if _is_none(value) else str(value)
    option = field.rpartition(".")[2]
    clear = sum(other.rpartition(".")[2] == option for other in fields) == 1
    shown = {True: "on", False: "off"}.get(value) if isinstance(value, bool) else value
    return f"{option if clear else field} {shown}"


def _is_none(value: Any) -> bool:
    return value is None or value == NONE


def _set(record: dict[str, Any], field: str, value: Any, base: Recipe) -> None:
    """Change one field of a recipe's record."""
    if field in PLAIN:
        record[field] = value
        return
    if field.startswith("calibration."):
        given = record["calibration"]
        record["calibration"] = ({} if given == NONE else given) | {field.partition(".")[2]: value}
        return
    slot, option = (field, "") if field in SLOTS else field.rsplit(".", 1)
    holder, name = record, slot
    if slot.startswith("detrend."):
        holder, name = record.setdefault("detrend", {}), slot.partition(".")[2]
    if option:
        if name not in holder:
            raise RecipeError(
                f"--grid {field}: there is no {slot} in the recipe '{base.name}' to have options; choose one with "
                f"{slot}=NAME in the grid"
            )
        holder[name][option] = value
    elif holder is not record and _is_none(value):
        holder.pop(name, None)
    elif not isinstance(value, str):
        raise RecipeError(f"--grid {field}: should be the name of an algorithm; got {value!r}")
    elif holder.get(name, {}).get("use") != value:
        holder[name] = {"use": value}


def _recipe(record: dict[str, Any], name: str, registry: Registry) -> Recipe:
    """A recipe from its record, which differs from a valid one only where the grid said so."""
    filled: dict[str, Any] = {}
    removed: dict[str, Any] = {}
    for slot in SLOTS:
        holder, key = (record, slot) if slot in REQUIRED else (record.get("detrend", {}), slot[8:])
        if key in holder:
            algorithm = _algorithm(slot, holder[key], registry)
            (filled if slot in REQUIRED else removed)[key] = algorithm
    plain = {field: record[field] for field in PLAIN}
    if _is_none(plain["calibration"]):
        plain["calibration"] = None
    _refuse_words("", {"passes": plain["passes"]}, Recipe)
    try:
        return Recipe(name=name, detrend=Detrends(**removed), **filled, **plain)
    except ValidationError as faults:
        raise RecipeError(_sentence("", faults, list(Recipe.model_fields))) from None


def _algorithm(slot: str, described: dict[str, Any], registry: Registry) -> Any:
    offer = registry.get(slot, described["use"])
    if offer is None:
        names = [other.algorithm.name for other in registry.offers(slot)]
        near = difflib.get_close_matches(described["use"], names, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise RecipeError(
            f"--grid {slot}: no algorithm is called '{described['use']}'; {hint}available: {', '.join(names)}"
            + (f", {NONE}" if slot not in REQUIRED else "")
        )
    options = {name: value for name, value in described.items() if name != "use"}
    _refuse_words(f"{slot}.", options, offer.algorithm)
    try:
        return offer.algorithm.model_validate(options)
    except ValidationError as faults:
        names = list(offer.algorithm.model_fields)
        raise RecipeError(f"{_sentence(f'{slot}.', faults, names)} ({offer.algorithm.name})") from None


def _refuse_words(prefix: str, options: dict[str, Any], model: Any) -> None:
    """Refuse ``yes`` and words where a number is meant: pydantic would read some of them as one."""
    for name, value in options.items():
        field = model.model_fields.get(name)
        if field is not None and field.annotation in (int, float) and isinstance(value, bool | str):
            raise RecipeError(f"--grid {prefix}{name}: should be a number; got {value!r}")


def _sentence(prefix: str, faults: ValidationError, fields: list[str]) -> str:
    fault = faults.errors()[0]
    field = ".".join(str(step) for step in fault["loc"])
    return f"--grid {prefix}{field}: {explain(dict(fault), fields)}"
