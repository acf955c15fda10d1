"""The docs are built as a site, in which every link leads somewhere."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("sphinx", reason="the docs' tools are not installed: pip install -e '.[docs]'")
pytest.importorskip("myst_parser")

DOCS = Path(__file__).parents[1] / "docs"


def build(pages: Path, site: Path) -> subprocess.CompletedProcess:
    words = [sys.executable, "-m", "sphinx", "-b", "html", "-W", "--keep-going", "-n", "-q", pages, site]
    return subprocess.run(list(map(str, words)), capture_output=True, text=True, check=False)


def test_every_page_is_built_and_in_the_table_of_contents(tmp_path):
    done = build(DOCS, tmp_path)
    assert done.returncode == 0, done.stderr
    contents = (tmp_path / "README.html").read_text(encoding="utf-8")
    for page in DOCS.rglob("*.md"):
        name = page.relative_to(DOCS).with_suffix(".html")
        assert (tmp_path / name).is_file()
        assert name.name == "README.html" or f'href="{name}"' in contents


@pytest.mark.parametrize("link", ["[gone](gone.md)", "[gone](tutorial.md#gone)", "![gone](gone.png)"])
def test_a_link_that_leads_nowhere_is_an_error(tmp_path, link):
    pages = tmp_path / "pages"
    pages.mkdir()
    shutil.copy(DOCS / "conf.py", pages)
    (pages / "README.md").write_text(f"# Pages\n\n- [tutorial](tutorial.md)\n\n{link}\n")
    (pages / "tutorial.md").write_text("# Tutorial\n")
    done = build(pages, tmp_path / "site")
    assert done.returncode != 0
    assert "gone" in done.stderr
