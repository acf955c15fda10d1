"""Documents in YAML as people write them: safe, bounded, and where in the text each field stands."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

Location = tuple[Any, ...]
"""Where a value stands: names of fields, and numbers of entries."""

MOST_NODES = 30_000
"""Names and values of a document: an artwork of a thousand tiles of which each names eight photographs has fewer.
Python takes about a second for so many."""

LONGEST_TEXT = 4000
"""Letters of one value."""

DEEPEST = 30
"""Mappings and lists within each other."""

_NO_LETTER = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x84\x86-\x9f\ud800-\udfff]")
"""Control characters and halves of letters: escapes such as ``"\\0"`` can say what no file of text may hold."""

_NO_TEXT = frozenset(
    f"tag:yaml.org,2002:{kind}" for kind in ("bool", "float", "int", "merge", "null", "timestamp", "value")
)
"""What YAML takes some words for, such as ``no``, ``0012`` and ``2024-05-01``, unless they are in quotes."""


class _Bounded(Composer, SafeConstructor):
    """Safe YAML without tags, without aliases (they can explode) and without doubled keys, of a bounded size."""

    _nodes = _depth = 0
    peek_event: Any

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a value, unless it is one that no file of ours needs."""
        event = self.peek_event()
        self._nodes += 1
        if fault := self._fault(event):
            raise yaml.MarkedYAMLError(problem=fault, problem_mark=event.start_mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def _fault(self, event: Any) -> str:
        if isinstance(event, yaml.AliasEvent):
            return "anchors and aliases are not allowed; write it out"
        if event.tag is not None:
            return f"the tag {event.tag[:60]} is not allowed; remove it"
        if self._nodes > MOST_NODES:
            return (
                f"there are more than {MOST_NODES} names and values; use patterns, or fewer tiles in a file"
            )
        if self._depth >= DEEPEST:
            return f"it is more than {DEEPEST} levels deep"
        if not isinstance(event, yaml.ScalarEvent):
            return ""
        if len(event.value) > LONGEST_TEXT:
            return f"a text of {len(event.value)} letters; {LONGEST_TEXT} are allowed"
        bad = _NO_LETTER.search(event.value)
        return (
            f"holds U+{ord(bad[0]):04X}, which is no letter but a control character; remove it" if bad else ""
        )

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        """Construct a mapping whose keys are the text that was written: a lamp may be called 1, or no."""
        seen = set()
        for key, _ in node.value:
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


class _Loader(_Bounded, yaml.SafeLoader):
    """Parser in Python, whose sentences people are told."""


_LOADERS: list[Any] = [_Loader]
if yaml.__with_libyaml__:
    from yaml.cyaml import CParser  # type: ignore[attr-defined]

    class _FastLoader(_Bounded, CParser, Resolver):
        """Parser in C, seven times as fast, for inboxes of thousands; it takes a tab for a space in more places."""

        def __init__(self, text: str) -> None:
            CParser.__init__(self, text)
            for part in (Composer, SafeConstructor, Resolver):
                part.__init__(self)

    _LOADERS.insert(0, _FastLoader)


class Document:
    """A document, read.

    Parameters
    ----------
    text : str
        In YAML.
    texts : sequence of locations
        Fields whose value is the text that was written, as ``("artwork", "id")``, whatever YAML takes it for;
        None stands for every entry of a list.

    Attributes
    ----------
    data : object
        Plain values.

    Raises
    ------
    Exception
        `yaml.MarkedYAMLError` with the place, or whatever Python says of a value such as the 40th of May.
    """

    def __init__(self, text: str, texts: Sequence[tuple[str | None, ...]] = ()) -> None:
        self._lines: dict[Location, int] | None = None
        for make in _LOADERS:
            try:
                self._node, self.data = _read(make, text, texts)
                break
            except (yaml.YAMLError, UnicodeEncodeError):  # halves of letters are no UTF-8, which C reads
                if make is _LOADERS[-1]:
                    raise

    def line(self, location: Location) -> int:
        """Line of a field, or of the nearest enclosing one that exists; counted from 1."""
        if self._lines is None:
            self._lines = {(): 1, **dict(_lines_below(self._node, ()))}
        written: Location = ()
        for step in location:
            inner = next((w for w in ((*written, step), (*written, str(step))) if w in self._lines), None)
            if inner is None:
                break
            written = inner
        return self._lines[written]


def _read(make: Any, text: str, texts: Sequence[tuple[str | None, ...]]) -> tuple[Any, Any]:
    """Node of a document, None of an empty one, and its plain values."""
    loader = make(text)
    try:
        node = loader.get_single_node()
        for location in texts:
            _take_as_text(node, location, text)
        return node, None if node is None else loader.construct_document(node)
    finally:
        loader.dispose()


def _lines_below(node: Any, location: Location) -> Iterator[tuple[Location, int]]:
    """Lines of everything in a node: of an entry of a mapping that of its name."""
    if isinstance(node, yaml.MappingNode):
        inside = [(key.value, key, value) for key, value in node.value]
    elif isinstance(node, yaml.SequenceNode):
        inside = [(i, value, value) for i, value in enumerate(node.value)]
    else:
        return
    for step, named, value in inside:
        yield (*location, step), named.start_mark.line + 1
        yield from _lines_below(value, (*location, step))


def _take_as_text(node: Any, location: tuple[str | None, ...], written: str) -> None:
    """Take plain values for the text that was written.

    Raises
    ------
    MarkedYAMLError
        Where a ``#`` with no space behind it ends the text: YAML would leave the rest out.
    """
    if not location:
        if isinstance(node, yaml.ScalarNode) and not node.style and node.value and node.tag in _NO_TEXT:
            node.tag = "tag:yaml.org,2002:str"
        if isinstance(node, yaml.ScalarNode) and not node.style:
            rest = written[node.end_mark.index :].partition("\n")[0].lstrip()
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
