"""Files that people write: safe YAML, faults with line numbers, and the shipped examples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from nlights_core.errors import NlightsError, StandError
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.names.photographs import did_you_mean
from nlights_core.stands import Stand
from nlights_core.yaml_documents import Document

Model = TypeVar("Model", bound=BaseModel)

LARGEST = 1 << 19
"""No file written by a person is larger than this many bytes; Python takes a second to read so many."""


def shipped(kind: str) -> Path:
    """Folder of the shipped ``recipes`` or ``stands``, in a wheel or in a checkout."""
    here = Path(__file__).parent
    inside = here / "configs" / kind
    return inside if inside.is_dir() else here.parent / "configs" / kind


def shipped_names(kind: str) -> list[str]:
    """Names of the shipped recipes or stands."""
    return sorted(path.stem for path in shipped(kind).glob("*.yaml"))


def find(what: str, kind: str, error: type[NlightsError], base: Path | None = None) -> Path:
    """Find a recipe or stand by the name of a shipped one or by a path.

    Parameters
    ----------
    what : str
        ``horizontal``, or a path that ends in .yaml or .yml.
    kind : {"recipes", "stands"}
        Where shipped ones are.
    error : type
        What to raise when there is none.
    base : Path, optional
        Folder that a relative path starts from; the working folder by default.
    """
    if not what.endswith((".yaml", ".yml")):
        if what in shipped_names(kind):
            return shipped(kind) / f"{what}.yaml"
        raise error(
            f"{what}: no {kind[:-1]} of this name is shipped; shipped are "
            f"{', '.join(shipped_names(kind))}; for one of your own give a path that ends in .yaml"
        )
    path = (base or Path()) / what
    try:
        there = path.is_file()
    except OSError as fault:
        raise error(
            f"{path}: cannot be read ({fault.strerror}); check the path and its permissions"
        ) from None
    if not there:
        raise error(f"{path}: there is no such file; give a path or one of {', '.join(shipped_names(kind))}")
    return path


MOST_FAULTS = 50
"""Of a file, that are told; whoever has mended these sees the others."""


def list_faults(faults: Sequence[str]) -> str:
    """Faults of a file as one message, a line each; of very many the first.

    Examples
    --------
    >>> list_faults(["a: is missing", "b: is missing"]).splitlines(), list_faults(["a"] * 60).splitlines()[-1]
    (['a: is missing', 'b: is missing'], 'and 10 more; mend these first')
    """
    more = len(faults) - MOST_FAULTS
    return "\n".join([*faults[:MOST_FAULTS], *([f"and {more} more; mend these first"] if more > 0 else [])])


class Source:
    """A YAML mapping and where in its file each field stands.

    Parameters
    ----------
    path : Path
        The file.
    error : type
        What to raise, naming the file and the line.
    texts : sequence of locations
        Fields whose value is the text that was written, as ``("artwork", "id")``, whatever YAML takes it for;
        None stands for every entry of a list.
    """

    def __init__(
        self, path: Path, error: type[NlightsError], texts: Sequence[tuple[str | None, ...]] = ()
    ) -> None:
        self.path, self.error = path, error
        try:
            if kind := irregular_kind(path):
                raise error(f"{path}: {kind}, where a file is expected; name the file itself")
            if path.stat().st_size > LARGEST:
                raise error(f"{path}: larger than {LARGEST >> 10} KiB, which no file of this kind is")
            self._document = Document(path.read_text(encoding="utf-8"), texts)
        except OSError as fault:
            raise error(
                f"{path}: cannot be read ({fault.strerror}); check the path and its permissions{did_you_mean(path)}"
            ) from fault
        except UnicodeDecodeError as fault:
            raise error(f"{path}: is not text in UTF-8; save it as UTF-8") from fault
        except yaml.MarkedYAMLError as fault:
            line = fault.problem_mark.line + 1 if fault.problem_mark else 1
            hint = "; put text with ': ' in it in quotes" if "mapping values" in str(fault.problem) else ""
            raise error(
                f"{path}:{line}: not valid YAML here: {fault.problem or fault.context}{hint}"
            ) from fault
        except NlightsError:
            raise
        except Exception as fault:  # what a parser can stumble over is not to be listed
            said = str(fault).partition("\n")[0] or type(fault).__name__
            raise error(f"{path}: not valid YAML: {said}") from fault
        self.data: Any = self._document.data
        if not isinstance(self.data, dict):
            raise error(f"{path}:1: should be a mapping of fields to values; got {_named(self.data)}")

    def fault(self, location: tuple[Any, ...], sentence: str) -> str:
        """One sentence about a field: ``file:line: field: sentence``."""
        field = ".".join(str(part) for part in location)
        return f"{self.path}:{self._document.line(location)}: {field + ': ' if field else ''}{sentence}"

    def check(self, model: type[Model]) -> Model:
        """Validate the whole file into a model, telling every fault at once."""
        try:
            return model.model_validate(self.data)
        except ValidationError as faults:
            raise self.error(list_faults(list(self.sentences(faults, model)))) from None

    def sentences(self, faults: ValidationError, model: type[BaseModel] | None = None) -> Iterator[str]:
        """Every fault that pydantic found, in our words, one for each field."""
        told: dict[tuple[Any, ...], list[str]] = {}
        for fault in faults.errors():
            location = self._of_field(fault["loc"], fault["type"])
            fields = list(model.model_fields) if model is not None and len(location) == 1 else None
            told.setdefault(location, []).append(explain(dict(fault), fields))
        for location, sentences in told.items():
            yield self.fault(location, "; or ".join(dict.fromkeys(sentences)))

    def _of_field(self, location: tuple[Any, ...], kind: str) -> tuple[Any, ...]:
        """Cut pydantic's own words (names of a union's branches) off a location."""
        value, steps = self.data, list(location)
        for i, step in enumerate(steps):
            if (isinstance(value, dict) and step in value) or (
                isinstance(value, list) and isinstance(step, int) and step < len(value)
            ):
                value = value[step]
            else:
                return tuple(steps[: i + 1] if kind == "missing" else steps[:i])
        return location


class GivenSource(Source):
    """A mapping that a program gave in the place of a file; it has a name, and no lines.

    Parameters
    ----------
    name : str
        What sentences call it.
    data : mapping
        What the file would hold.
    """

    def __init__(self, name: str, data: Mapping[str, Any], error: type[NlightsError]) -> None:
        self.path, self.error, self.data = Path(name), error, dict(data)

    def fault(self, location: tuple[Any, ...], sentence: str) -> str:
        """One sentence about a field: ``name: field: sentence``."""
        field = ".".join(str(part) for part in location)
        return f"{self.path}: {field + ': ' if field else ''}{sentence}"


def explain(fault: dict[str, Any], fields: list[str] | None = None) -> str:
    """One pydantic fault as a sentence: what should be, what was found."""
    context = fault.get("ctx", {})
    given = _named(fault.get("input"))
    match fault["type"]:
        case "extra_forbidden":
            allowed = (
                f"; allowed here: {', '.join(fields)}" if fields else "; remove it or correct its spelling"
            )
            return f"unknown field{allowed}"
        case "missing":
            return "is missing; add it"
        case "greater_than_equal":
            return f"should be at least {context['ge']:g}; got {given}"
        case "greater_than":
            return f"should be more than {context['gt']:g}; got {given}"
        case "less_than_equal":
            return f"should be at most {context['le']:g}; got {given}"
        case "less_than":
            return f"should be less than {context['lt']:g}; got {given}"
        case "literal_error":
            return f"should be {context['expected']}; got {given}"
        case "model_type" | "dict_type":
            return f"should be a mapping of fields to values; got {given}"
        case "list_type" | "tuple_type":
            return f"should be a list; got {given}"
        case "string_type":
            return f"should be text; got {given}"
        case "float_type" | "float_parsing" | "int_type" | "int_parsing":
            return f"should be a number; got {given}"
        case "finite_number":
            return f"should be a finite number; got {given}"
        case "value_error":
            return str(context.get("error", fault["msg"]))
        case _:
            return f"{fault['msg'][0].lower()}{fault['msg'][1:]}; got {given}"


def _named(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def load_stand(what: str, base: Path | None = None) -> Stand:
    """Load a stand by the name of a shipped one or by a path.

    Raises
    ------
    StandError
        Naming the file, the line, the field, what was found and what is allowed.
    """
    path = find(what, "stands", StandError, base)
    try:
        status = path.stat()
    except OSError:  # reading it says why
        return Source(path, StandError).check(Stand)
    return _read_stand(
        path.resolve(), path, (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    )


@lru_cache(maxsize=32)  # thousands of artworks name the same stand
def _read_stand(place: Path, path: Path, stamp: tuple[int, ...]) -> Stand:
    stand = Source(path, StandError).check(Stand)
    stand._file = path.absolute()
    return stand
