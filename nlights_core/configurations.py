"""Files that people write: safe YAML, faults with line numbers, and the shipped examples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from nlights_core.errors import NlightsError, StandError
from nlights_core.machine.regular_files import irregular_kind
from nlights_core.names.photographs import did_you_mean
from nlights_core.stands import Stand

Model = TypeVar("Model", bound=BaseModel)

LARGEST = 1 << 20
"""No file written by a person is larger than this many bytes."""


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
    if not path.is_file():
        raise error(f"{path}: there is no such file; give a path or one of {', '.join(shipped_names(kind))}")
    return path


_NO_TEXT = frozenset(
    f"tag:yaml.org,2002:{kind}" for kind in ("bool", "float", "int", "merge", "null", "timestamp", "value")
)
"""What YAML takes some words for, such as ``no``, ``0012`` and ``2024-05-01``, unless they are in quotes."""


class _Loader(yaml.SafeLoader):
    """Safe YAML without aliases (they can explode) and without doubled keys."""

    def construct_undefined(self, node: Any) -> Any:
        raise yaml.MarkedYAMLError(problem=f"the tag {node.tag} is not allowed", problem_mark=node.start_mark)

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(
                problem="anchors and aliases are not allowed; write it out", problem_mark=mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key, _ in node.value:  # a lamp may be called 1, or no
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(
                    problem="a field's name should be plain text", problem_mark=key.start_mark
                )
            if key.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key '{key.value}' stands twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
            if key.tag in _NO_TEXT:
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep)


_Loader.add_constructor(None, _Loader.construct_undefined)


def _take_as_text(node: Any, location: tuple[str | None, ...], written: str) -> None:
    """Take plain values for the text that was written.

    Raises
    ------
    MarkedYAMLError
        Where a ``#`` with no space behind it ends the text: YAML would leave the rest out.
    """
    if not location:
        if isinstance(node, yaml.ScalarNode) and node.style is None and node.value and node.tag in _NO_TEXT:
            node.tag = "tag:yaml.org,2002:str"
        if isinstance(node, yaml.ScalarNode) and node.style is None:
            rest = written[node.end_mark.index :].split("\n")[0].lstrip()
            if rest.startswith("#") and rest[1:2].strip(" \t#-=") and node.value:
                raise yaml.MarkedYAMLError(
                    problem=f"'{rest.strip()}' is a comment to YAML, not a part of the text before it; put the text "
                    f"in quotes ('{node.value} {rest.strip()}'), or write a space behind #",
                    problem_mark=node.start_mark,
                )
    elif location[0] is None and isinstance(node, yaml.SequenceNode):
        for entry in node.value:
            _take_as_text(entry, location[1:], written)
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if key.value == location[0]:
                _take_as_text(value, location[1:], written)


def _constructed(text: str, node: Any) -> Any:
    """Plain values of a composed document."""
    loader = _Loader(text)
    try:
        return None if node is None else loader.construct_document(node)
    finally:
        loader.dispose()


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
                raise error(f"{path}: larger than {LARGEST >> 20} MiB, which no file of this kind is")
            text = path.read_text(encoding="utf-8")
            self._node = yaml.compose(text, _Loader)
            for location in texts:
                _take_as_text(self._node, location, text)
            self.data: Any = _constructed(text, self._node)
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
        except (yaml.YAMLError, RecursionError, ValueError) as fault:
            raise error(f"{path}: not valid YAML: {str(fault).splitlines()[0]}") from fault
        if not isinstance(self.data, dict):
            raise error(f"{path}:1: should be a mapping of fields to values; got {_named(self.data)}")

    def line(self, location: tuple[Any, ...]) -> int:
        """Line of a field, or of the nearest enclosing one that exists; counted from 1."""
        node, line = self._node, 1
        for step in location:
            found = None
            if isinstance(node, yaml.MappingNode):
                for key, value in node.value:
                    if key.value == str(step):
                        found, line = value, key.start_mark.line + 1
            elif isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
                found = node.value[step]
                line = found.start_mark.line + 1
            if found is None:
                break
            node = found
        return line

    def fault(self, location: tuple[Any, ...], sentence: str) -> str:
        """One sentence about a field: ``file:line: field: sentence``."""
        field = ".".join(str(part) for part in location)
        return f"{self.path}:{self.line(location)}: {field + ': ' if field else ''}{sentence}"

    def check(self, model: type[Model]) -> Model:
        """Validate the whole file into a model, telling every fault at once."""
        try:
            return model.model_validate(self.data)
        except ValidationError as faults:
            raise self.error("\n".join(self.sentences(faults, model))) from None

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
    stand = Source(path, StandError).check(Stand)
    stand._file = path.absolute()
    return stand
