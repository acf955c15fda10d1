"""Figures of accuracy say where they come from: simulated (S), public data (P) or a real stand (R)."""

import re
from pathlib import Path

import pytest

from nlights_core.report.figures import CHECKED_ON

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOT_OF_ACCURACY = {"performance.md", "scaling.md", "faults.md", "operating.md", "stands.md"}
"""Pages of times, machines and measured positions."""
MARK = re.compile(r"\((?:[SPR](?:, [SPR])*|figures \([SPR]\)|[SPR][;,] [^)]*)\)")
OF_ACCURACY = re.compile(r"normals,? mean|height,? rms|\brms\b|degrees|\berror\b|mm \(|least-squares", re.I)
"""In the head of a table whose numbers are accuracies."""
ERROR = re.compile(r"\d ?(?:degrees?|°|mm|um|µm)\b")
"""An amount that may be an error, in prose."""
SEEN_ON = re.compile(r"simulated (?!\()|DiLiGenT's|Harvard's|UW's|mean angle (?:stays|is)|covers \d", re.I)
"""Words by which a sentence tells of a measured figure."""
NUMBER = re.compile(r"\|[^|]*\d\.\d")


def blocks(text: str) -> list[tuple[str, str, str]]:
    """Paragraphs, items and tables outside of code: the headings above, the paragraph before, the text."""
    found: list[tuple[str, str, str]] = []
    headings: dict[int, str] = {}
    before = ""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    text = re.sub(r"^<!--.*-->$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(?=- |\d+\. )", "\n", text, flags=re.MULTILINE)
    for block in re.split(r"\n\s*\n", re.sub(r"^(#+ .*)$", r"\n\1\n", text, flags=re.MULTILINE)):
        part = block.strip()
        if heading := re.match(r"(#+) (.*)", part):
            depth = len(heading[1])
            headings = {level: title for level, title in headings.items() if level < depth}
            headings[depth], before = heading[2], ""
        elif part:
            found.append((" ".join(headings.values()), before, part))
            before = before if part.startswith("- ") else part
    return found


def unmarked(text: str) -> list[str]:
    """The blocks that state an accuracy and do not say where it was measured."""
    found = []
    for headings, before, part in blocks(text):
        if "costs" in headings or MARK.search(headings) or MARK.search(part):
            continue
        if part.startswith("|"):
            head, *rows = part.splitlines()
            if OF_ACCURACY.search(head) and any(map(NUMBER.search, rows)) and not MARK.search(before):
                found.append(part)
        elif ERROR.search(part) and SEEN_ON.search(part):
            found.append(part)
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_figure_of_accuracy_says_where_it_was_measured(path):
    if path.name in NOT_OF_ACCURACY:
        pytest.skip("it has no figures of accuracy")
    assert unmarked(path.read_text(encoding="utf-8")) == []


def test_the_test_sees_what_is_not_marked():
    table = "| scene | normals mean, degrees |\n|---|---|\n| plane | 0.11 |\n"
    assert unmarked(f"# A\n\nText.\n\n{table}") == [table.strip()]
    assert unmarked("On a simulated painting 0.1 degrees are left.") != []
    assert unmarked("- one\n- DiLiGenT's ball is wrong by 2 degrees") != []
    for marked in (f"# A (S)\n\n{table}", f"Errors (P):\n\n{table}", table.replace("degrees", "degrees (S)")):
        assert unmarked(marked) == []
    assert unmarked("DiLiGenT's ball is wrong by 2 degrees (P)") == []


def test_the_marks_are_explained_and_nothing_claims_a_real_stand():
    page = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")
    for mark in ("**(S)** is simulated", "**(P)** is from public data", "**(R)** is from a\nreal stand"):
        assert mark in page
    assert "There is no figure of kind R yet" in page
    for path in PAGES:
        for number in re.finditer(r"[^.|]*\(R\)[^.|]*", path.read_text(encoding="utf-8")):
            assert re.search(r"yet|marked|\*\*\(R\)\*\*", number[0]), f"{path.name}: {number[0]}"


def test_the_report_says_where_its_uncertainty_was_checked():
    assert {"(S)", "(P)", "(R)"} <= set(re.findall(r"\([SPR]\)", CHECKED_ON))
    assert "no real stand (R) yet" in CHECKED_ON
