"""The accuracy benchmark runs, writes its tables and leaves what people wrote around them."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROSE = "# Accuracy\n\nBefore.\n\n<!-- table surfaces -->\nold figures\n<!-- end surfaces -->\n\nAfter.\n"


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """What the cheapest section writes into a page that is already there."""
    out = tmp_path_factory.mktemp("accuracy")
    (out / "accuracy.md").write_text(PROSE, encoding="utf-8")
    (out / "accuracy.json").write_text('{"depths": {"made": {}, "rows": []}}', encoding="utf-8")
    command = [
        sys.executable,
        ROOT / "benchmarks" / "accuracy.py",
        "--quick",
        "--only",
        "surfaces",
        "--out",
        out,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_a_table_replaces_what_stood_between_its_markers_and_nothing_else(written):
    page = (written / "accuracy.md").read_text(encoding="utf-8")
    assert page.startswith("# Accuracy\n\nBefore.\n\n<!-- table surfaces -->\n| integrator |")
    assert page.endswith("|\n<!-- end surfaces -->\n\nAfter.\n")
    assert "old figures" not in page


def test_figures_are_kept_with_all_digits_and_say_how_they_were_made(written):
    record = json.loads((written / "accuracy.json").read_text(encoding="utf-8"))
    assert set(record) == {"depths", "surfaces"}
    assert record["surfaces"]["made"]["quick"] is True
    peaks = {row["integrator"]: row["peaks(512), share of range"] for row in record["surfaces"]["rows"]}
    assert peaks["`simchony`"] < 1e-6 < peaks["`simchony`, `stencil: trapezoid`"] < 6e-5


def test_every_table_of_the_page_has_its_figures_in_the_json():
    page = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")
    record = json.loads((ROOT / "docs" / "accuracy.json").read_text(encoding="utf-8"))
    blocks = dict(re.findall(r"<!-- table ([\w-]+) -->\n(.*?)<!-- end \1 -->", page, flags=re.DOTALL))
    assert set(blocks) == set(record)
    for name, block in blocks.items():
        assert not record[name]["made"]["quick"], name
        assert len(block.splitlines()) == 2 + len(record[name]["rows"]), name
