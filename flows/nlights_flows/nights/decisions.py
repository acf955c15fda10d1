"""Decisions of people about a tile, ``review.json`` beside its products: accepted, or to be photographed again.

A decision is about the products that it was made of: it names their key.  Where others stand in
their place it is kept, shown as one about former products, and no longer counts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from nlights_core.errors import CaptureError, NlightsError
from nlights_core.names.control_characters import escape_controls
from nlights_core.store import write_whole
from nlights_flows.tiles.environment import alone
from nlights_flows.tiles.records import damaged, read_json, read_provenance

FILE = "review.json"
"""People's own addition to a tile's folder, which publishing keeps."""

LOCK = ".review.lock"
"""File of all products by which people who decide at once wait for each other."""

SCHEMA = 1

LONGEST = {"--by": 200, "--why": 2000}
"""Letters that are allowed."""

TRIES = 20
"""How often a decision is written anew when products are published at the very time."""

Choice = Literal["accept", "repeat"]

WORDS = {"accept": "accepted by", "repeat": "to be photographed again, says"}


@dataclass(frozen=True)
class Decision:
    """One decision about a tile.

    Attributes
    ----------
    decision : {"accept", "repeat"}
    by, why : str
        Who decided, and the reason.
    at : str
        ISO time.
    key : str
        Of the products that were looked at.
    """

    decision: Choice
    by: str
    why: str
    at: str
    key: str


def decide(decision: Choice, by: str, why: str, products: Path) -> Decision:
    """Make a decision about the products that stand in a folder now.

    Raises
    ------
    CaptureError
        When the name or the reason is no text, or the products have no key.
    """
    now = datetime.now().astimezone().isoformat(timespec="seconds")
    return Decision(
        decision, _worded("--by", by), _worded("--why", why), now, read_provenance(products)["key"]
    )


def read_decisions(products: Path) -> list[Decision]:
    """All decisions about a tile, oldest first.

    Raises
    ------
    CaptureError
        When the file is damaged.
    """
    path = products / FILE
    if not path.exists():
        return []
    remedy = "mend it, or move it away; nothing in it was changed"
    found = read_json(path, remedy)
    try:
        decisions = [Decision(**one) for one in found["decisions"]]
    except (TypeError, KeyError):
        raise damaged(path, "it is no list of decisions", remedy) from None
    for one in decisions:
        if not all(isinstance(text, str) for text in asdict(one).values()) or one.decision not in WORDS:
            raise damaged(path, "a decision is neither accept nor repeat, or lacks a word", remedy)
    return decisions


def add_decision(products: Path, decision: Decision, out: Path) -> None:
    """Add a decision to those about a tile; the file appears whole, and nobody else's is lost.

    Raises
    ------
    CaptureError
        When the earlier ones cannot be read, or the folder cannot be written; nothing was changed then.
    """
    path = products / FILE
    with alone(out / LOCK):
        for _ in range(TRIES):  # publishing moves the folder, and may have copied it before this was there
            decisions = [*read_decisions(products), decision]
            text = json.dumps(
                {"schema": SCHEMA, "decisions": [asdict(one) for one in decisions]},
                indent=1,
                ensure_ascii=False,
            )
            try:
                write_whole(path, text + "\n")
            except OSError as fault:
                raise CaptureError(
                    f"{path}: cannot be written ({fault.strerror}); whoever decides must be allowed to write there"
                ) from None
            if decision in read_decisions(products):
                return
    raise CaptureError(f"{path}: the products are being replaced; decide again when they are there")


def reviewed(products: Path) -> tuple[list[dict[str, Any]], str]:
    """Decisions about a tile as plain values, each with "counts", and why they cannot be told, where so.

    Of those about the products that stand in the folder, the newest counts.
    """
    try:
        decisions = read_decisions(products)
        key = read_provenance(products)["key"] if decisions else ""
    except NlightsError as fault:
        return [], str(fault)
    newest = max((i for i, one in enumerate(decisions) if one.key == key), default=None)
    return [
        {**asdict(one), "counts": i == newest, "of_former": one.key != key} for i, one in enumerate(decisions)
    ], ""


def standing(review: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Decision that counts among those that `reviewed` tells."""
    return next((one for one in review if one["counts"]), None)


def describe_decision(one: Mapping[str, Any]) -> str:
    """A decision in one sentence: what, who, when and why."""
    said = f"{WORDS[one['decision']]} {one['by']} ({one['at'][:10]}): {one['why']}"
    if one["of_former"]:
        return f"{said} (about former products; it no longer counts)"
    return said if one["counts"] else f"{said} (since decided anew)"


def _worded(option: str, text: str) -> str:
    """A name or a reason as one line of text."""
    plain = " ".join(text.split())
    if not plain:
        raise CaptureError(f"{option}: is empty; write {'a name' if option == '--by' else 'the reason'}")
    if (shown := escape_controls(plain)) != plain:
        raise CaptureError(f"{option}: '{shown}' holds a control character; leave it out")
    if len(plain) > LONGEST[option]:
        raise CaptureError(f"{option}: has {len(plain)} letters; {LONGEST[option]} are allowed")
    return plain
