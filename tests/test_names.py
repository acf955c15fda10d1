"""Names of the field: docstrings begin with a noun or an imperative."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("nlights_core", "flows/nlights", "flows/nlights_flows", "plugins/nlights_plugins")

QUESTIONS = "how what whatever when whenever where wherever whether which who whoever whom whose why"
PREPOSITIONS = (
    "about above after against along among around as at before behind below between beyond by during for from in "
    "inside into like of on onto out outside over per since than through to towards under until up upon via with "
    "within without"
)
OTHERS = (
    "although because but if neither never nor nothing or so something then there though told unless while"
)
FIRST_WORDS = frozenset(f"{QUESTIONS} {PREPOSITIONS} {OTHERS}".split())
"""Words that leave a reader guessing what a function returns or does."""

FOLDERS = [
    folder for package in PACKAGES for folder in sorted({p.parent for p in (ROOT / package).rglob("*.py")})
]


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_docstrings_begin_with_a_noun_or_an_imperative(folder):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in sorted(folder.glob("*.py"))
        for line, text in docstrings(path)
        if text.split()[0].strip(".,:;").lower() in FIRST_WORDS
    ]
    assert not wrong, "\n".join(wrong)


def docstrings(path):
    """First lines of the docstrings of a module, its classes and its functions, with their lines."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield node.body[0].lineno, text.splitlines()[0]
