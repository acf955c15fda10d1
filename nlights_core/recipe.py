"""Recipes: which algorithm fills each slot."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny, ValidationError

from nlights_core.algorithms import (
    Algorithm,
    HeightDetrend,
    ImageDetrend,
    Integrator,
    LightModel,
    NormalDetrend,
    NormalSolver,
)
from nlights_core.capture import Tile
from nlights_core.configurations import GivenSource, Source, explain, find, list_faults
from nlights_core.errors import PluginError, RecipeError
from nlights_core.registry import Registry, installed
from nlights_core.stands import Record


class Detrends(Record):
    """The optional corrections; each returns the nuisance, the stage removes and keeps it."""

    images: SerializeAsAny[ImageDetrend] | None = None
    normals: SerializeAsAny[NormalDetrend] | None = None
    height: SerializeAsAny[HeightDetrend] | None = None


class Sought(Record):
    """Unknowns that are sought in a tile's own photographs and hold for all its pixels; see docs/calibration.md."""

    level: bool = Field(default=True, description="the height of the surface above the plane of the flat")
    lamps: bool = Field(default=True, description="the strength of each lamp since the flats were taken")
    gloss: bool = Field(default=True, description="highlights of varnish, and of the flat")
    departure: bool = Field(default=True, description="what rough matt paint does that Lambert's law lacks")
    ambient: bool = Field(
        default=True, description="light that the dark frame lacks, and the light of the room"
    )
    align: bool = Field(
        default=False,
        description="how far each photograph moved against the others; taken out while it is developed",
    )

    def groups(self) -> tuple[str, ...]:
        """Names of the groups of unknowns, as `nlights_core.calibration.unknowns.groups` has them."""
        chosen = [name for name in ("level", "lamps", "gloss", "departure", "ambient") if getattr(self, name)]
        return (*chosen, "flat-gloss") if self.gloss else tuple(chosen)


class Recipe(Record):
    """A whole recipe: plain, frozen, picklable."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    name: str = Field(description="of the recipe; the file's name without its ending, where it says none")
    light_model: SerializeAsAny[LightModel]
    detrend: Detrends = Detrends()
    normals: SerializeAsAny[NormalSolver]
    integrator: SerializeAsAny[Integrator]
    passes: int = Field(
        default=1,
        ge=1,
        le=5,
        description="how often normals and height are computed; from the second on, near lights see "
        "the height of the pass before; all but the last are made on reduced photographs",
    )

    integrable: bool = Field(
        default=False,
        description="take out of the normals what no surface can have: the part that the height "
        "integrated from them does not follow",
    )

    calibration: Sought | None = Field(
        default=None,
        description="what is sought in reduced photographs before the normals, and taken out of them; needs near "
        "lights and a photographed flat",
    )

    def algorithms(self) -> list[Algorithm]:
        """Every algorithm of the recipe, in the order in which they run."""
        slots = (
            self.light_model,
            self.detrend.images,
            self.normals,
            self.detrend.normals,
            self.integrator,
            self.detrend.height,
        )
        return [algorithm for algorithm in slots if algorithm is not None]

    def needs(self, field: str) -> bool:
        """Test whether any algorithm needs a field of the tile."""
        return any(field in algorithm.needs for algorithm in self.algorithms())

    def lacking(self, tile: Tile) -> list[str]:
        """List what of a capture this recipe needs and the tile has not, and what fits instead, as sentences."""
        found = [
            f"{MANIFEST_FIELD.get(need, need)}: is missing, and {algorithm.slot}: {algorithm.name} of the recipe "
            f"'{self.name}' needs it; add it to the manifest, or choose another {algorithm.slot}"
            for algorithm in self.algorithms()
            for need in algorithm.needs
            if not getattr(tile, need)
        ]
        return [*found, _what_fits(tile)] if found else []

    def record(self) -> dict[str, Any]:
        """The recipe as it could be written in YAML, with every option spelled out."""
        detrend = {
            slot: described(value)
            for slot in Detrends.model_fields
            if (value := getattr(self.detrend, slot)) is not None
        }
        return {
            "light_model": described(self.light_model),
            **({"detrend": detrend} if detrend else {}),
            "normals": described(self.normals),
            "integrator": described(self.integrator),
            "passes": self.passes,
            "integrable": self.integrable,
            "calibration": self.calibration.model_dump() if self.calibration else "none",
        }


FOR_CAPTURES = {
    "default": "a stand is given, and the manifest lists flats",
    "no-flats": "a stand is given",
    "given-directions": "the manifest lists lights",
    "chrome-sphere": "the manifest lists chrome_spheres",
}
"""Shipped recipes to measure with, best first, and which captures they fit; the others are there to compare with."""


def fitting(tile: Tile) -> list[str]:
    """Names of the shipped recipes that a capture has everything for, best first."""
    return [
        name
        for name in FOR_CAPTURES
        if all(getattr(tile, need) for part in load_recipe(name).algorithms() for need in part.needs)
    ]


def _what_fits(tile: Tile) -> str:
    """Sentence that names the shipped recipes which fit a tile."""
    fits = [f"{FOR_CAPTURES[name]}: --recipe {name}" for name in fitting(tile)]
    if fits:
        return f"what fits this capture: {'; or '.join(fits)}"
    return (
        "no shipped recipe fits this capture: nothing in it says where the lamps are; add a stand, chrome_spheres "
        "or lights to the manifest"
    )


MANIFEST_FIELD = {"spheres": "chrome_spheres"}
"""Where a tile's field has another name in the manifest."""


def described(algorithm: Algorithm) -> dict[str, Any]:
    """An algorithm as a recipe names it: ``{use: name, option: value, ...}``."""
    return {"use": algorithm.name, **algorithm.model_dump(mode="json")}


LONGEST_NAME = 200
"""Letters of the name that a recipe may give itself."""

REQUIRED = ("light_model", "normals", "integrator")


RecipeLike = str | Path | Mapping[str, Any] | Recipe
"""What a recipe may be given as."""


def load_recipe(what: RecipeLike, registry: Registry | None = None) -> Recipe:
    """Load a recipe by the name of a shipped one, by a path, or from what a file would hold.

    Parameters
    ----------
    what : str, Path, mapping or Recipe
        ``default``; a path that ends in .yaml; the content of such a file, with a ``name`` if wanted, since it has
        no file to be called after; or a recipe, which stays as it is.
    registry : Registry, optional
        The algorithms to choose from; those installed by default.

    Raises
    ------
    RecipeError
        Every fault at once, each with file, line, field, what was found and what is allowed.

    Examples
    --------
    >>> load_recipe({"light_model": "measured-poi", "normals": "robust", "integrator": "simchony"}).name
    'recipe'
    """
    if isinstance(what, Recipe):
        return what
    if isinstance(what, Mapping):
        name = str(what.get("name", "recipe"))
        given = {field: value for field, value in what.items() if field != "name"}
        return _Reader(GivenSource(name, given, RecipeError), registry or installed()).recipe(name)
    source = Source(find(str(what), "recipes", RecipeError), RecipeError)
    return _Reader(source, registry or installed()).recipe(source.path.stem)


def choose(slot: str, name: str, options: Mapping[str, Any], whose: str) -> Algorithm:
    """Choose an installed algorithm as a recipe does, where there is no recipe.

    Parameters
    ----------
    slot : str
        Of a recipe.
    name : str
        What ``use:`` would say.
    options : mapping
        Its options; the others keep their defaults.
    whose : str
        Who asks, for the sentences.

    Raises
    ------
    RecipeError
        Every fault at once, as for `load_recipe`.

    Examples
    --------
    >>> choose("integrator", "simchony", {"stencil": "trapezoid"}, "integrate").name
    'simchony'
    """
    reader = _Reader(GivenSource(whose, {}, RecipeError), installed())
    chosen = reader.algorithm(tuple(slot.split(".")), {**options, "use": name})
    if chosen is None:
        raise RecipeError(list_faults(reader.faults))
    return chosen


class _Reader:
    """Reader that turns a mapping into a recipe and collects every fault."""

    def __init__(self, source: Source, registry: Registry) -> None:
        self.source, self.registry = source, registry
        self.faults: list[str] = []

    def recipe(self, name: str) -> Recipe:
        data = self.source.data
        self._refuse_unknown((), data, list(Recipe.model_fields))
        name = self._own_name(data, name)
        chosen = {slot: self.algorithm((slot,), data.get(slot)) for slot in REQUIRED if self._has(slot)}
        detrend = data.get("detrend")
        removed: dict[str, Any] = {}
        if isinstance(detrend, dict):
            self._refuse_unknown(("detrend",), detrend, list(Detrends.model_fields))
            known = [k for k in detrend if k in Detrends.model_fields and detrend[k] is not None]
            removed = {k: self.algorithm(("detrend", k), detrend[k]) for k in known}
        elif detrend is not None:
            self.faults.append(self.source.fault(("detrend",), f"should be a mapping; got {detrend!r}"))
        plain = {name: data[name] for name in ("passes", "integrable", "calibration") if name in data}
        if "calibration" in plain:
            plain["calibration"] = self._sought(plain["calibration"])
        self._are_numbers((), plain, Recipe)
        if not self.faults:
            try:
                return Recipe(name=name, detrend=Detrends(**removed), **chosen, **plain)
            except ValidationError as faults:
                self.faults += self.source.sentences(faults, Recipe)
        raise RecipeError(list_faults(self.faults))

    def _own_name(self, data: Mapping[str, Any], name: str) -> str:
        """Name that the recipe gives itself, as in a tile's provenance; else the given one."""
        own = data.get("name", name)
        if not isinstance(own, str) or not own.isprintable() or not 0 < len(own) <= LONGEST_NAME:
            what = f"should be text of 1 to {LONGEST_NAME} letters; put a number in quotes"
            self.faults.append(self.source.fault(("name",), f"{what}; got {str(own)[:60]!r}"))
        return str(own)

    def _sought(self, given: Any) -> Any:
        """Read what a calibration is asked for; None where there shall be none."""
        names = list(Sought.model_fields)
        if isinstance(given, dict):
            self._refuse_unknown(("calibration",), given, names)
        elif given is not None and given != "none":
            what = f"none, or a mapping of {', '.join(names)} to true or false"
            self.faults.append(self.source.fault(("calibration",), f"should be {what}; got {given!r}"))
        return None if given == "none" else given

    def _has(self, slot: str) -> bool:
        if slot in self.source.data:
            return True
        names = ", ".join(o.algorithm.name for o in self.registry.offers(slot))
        self.faults.append(
            f"{self.source.path}: {slot}: is missing; add it, for instance with use: one of {names}"
        )
        return False

    def _refuse_unknown(self, location: tuple[str, ...], data: dict[str, Any], allowed: list[str]) -> None:
        for key in data:
            if key not in allowed:
                near = difflib.get_close_matches(str(key), allowed, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                self.faults.append(
                    self.source.fault(
                        (*location, key), f"unknown field; {hint}allowed here: {', '.join(allowed)}"
                    )
                )

    def algorithm(self, location: tuple[str, ...], data: Any) -> Algorithm | None:
        slot = ".".join(location)
        if isinstance(data, str):
            data = {"use": data}
        if not isinstance(data, dict) or not isinstance(data.get("use"), str):
            self.faults.append(
                self.source.fault(location, f"should be like {{use: name, ...}}; got {data!r}")
            )
            return None
        try:
            offer = self.registry.get(slot, data["use"])
        except PluginError as contested:
            self.faults.append(self.source.fault((*location, "use"), str(contested)))
            return None
        if offer is None:
            self.faults.append(self.source.fault((*location, "use"), self._unknown(slot, data["use"])))
            return None
        options = {k: v for k, v in data.items() if k != "use"}
        if not self._are_numbers(location, options, offer.algorithm):
            return None
        try:
            return offer.algorithm.model_validate(options)
        except ValidationError as faults:
            fields = list(offer.algorithm.model_fields)
            for fault in faults.errors():
                sentence = explain(dict(fault), fields if len(fault["loc"]) == 1 else None)
                self.faults.append(self.source.fault(location + fault["loc"], sentence))
            return None

    def _are_numbers(
        self, location: tuple[str, ...], options: dict[str, Any], model: type[BaseModel]
    ) -> bool:
        """Refuse ``yes`` and quoted numbers where a number is meant: pydantic would read them as one."""
        before = len(self.faults)
        for name, value in options.items():
            field = model.model_fields.get(name)
            if field is not None and field.annotation in (int, float) and isinstance(value, bool | str):
                self.faults.append(self.source.fault((*location, name), f"should be a number; got {value!r}"))
        return len(self.faults) == before

    def _unknown(self, slot: str, name: str) -> str:
        offers = self.registry.offers(slot)
        near = difflib.get_close_matches(name, [o.algorithm.name for o in offers], n=1)
        width = max((len(o.algorithm.name) for o in offers), default=0)
        listed = "".join(f"\n    available: {o.algorithm.name:{width}}  ({o.origin})" for o in offers)
        what = slot.replace("detrend.", "detrend of ").replace("_", " ")
        hint = f"; did you mean '{near[0]}'?" if near else ""
        broken = "".join(f"\n    broken: {one.why}" for one in self.registry.broken)
        return f"no {what} is called '{name}'{hint}{listed}{broken}"


def recipe_schema(registry: Registry | None = None) -> dict[str, Any]:
    """JSON schema of a recipe over what is installed, for editors."""
    registry = registry or installed()

    def choice(slot: str) -> dict[str, Any]:
        options = []
        for offer in registry.offers(slot):
            schema = offer.algorithm.model_json_schema()
            schema["properties"] = {"use": {"const": offer.algorithm.name}, **schema.get("properties", {})}
            schema["required"] = ["use", *schema.get("required", [])]
            options.append(schema)
        return {"anyOf": options}

    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "nLights recipe",
        "type": "object",
        "additionalProperties": False,
        "required": list(REQUIRED),
        "properties": {
            "name": {"type": "string", "minLength": 1, "maxLength": LONGEST_NAME},
            "light_model": choice("light_model"),
            "detrend": {
                "type": "object",
                "additionalProperties": False,
                "properties": {name: choice(f"detrend.{name}") for name in Detrends.model_fields},
            },
            "normals": choice("normals"),
            "integrator": choice("integrator"),
            "passes": {"type": "integer", "minimum": 1, "maximum": 5, "default": 1},
            "integrable": {"type": "boolean", "default": False},
            "calibration": {"anyOf": [{"const": "none"}, Sought.model_json_schema()], "default": "none"},
        },
    }
