"""What a notebook shows: small, self-contained, escaped."""

import base64
import io
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
import yaml
from PIL import Image
from rich.console import Console

import nlights
from nlights.comparisons import ComparisonResult
from nlights.notebook import LONGEST, _small
from nlights_flows.tiles import console

VOID = {"img", "br"}


class Page(HTMLParser):
    """Tags, text and sources of a piece of HTML whose tags are closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_a_tile_shows_its_pictures_a_sentence_and_numbers(tile):
    html = tile._repr_html_()
    page = Page(html)
    assert len(html) < 200_000
    assert page.tags.count("img") == 2
    assert all(source.startswith("data:image/jpeg;base64,") for source in page.sources)
    assert "http" not in re.sub(r'"data:[^"]*"', "", html)
    for words in ("Simulated painting", "68 % of the normals are off by no more than", "Height range", "mm"):
        assert words in page.text
    for source in page.sources:
        image = Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2])))
        assert max(image.size) <= LONGEST
        assert np.std(np.asarray(image, float)) > 5


def test_pictures_of_large_maps_are_small():
    for shape in ((5000, 7000, 3), (3, 9000, 3), (400, 2, 3)):
        small = _small(np.broadcast_to(np.float32(1), shape))
        assert max(small.shape) < 2 * LONGEST or min(shape[:2]) < 25
        assert (small == 1).all()


@pytest.mark.parametrize("nasty", ["<script>alert('1')</script> & \"x\"", "</div><b>"])
def test_titles_and_messages_are_escaped(capture, quick, tmp_path, nasty):
    described = yaml.safe_load((capture / "artwork.yaml").read_text(encoding="utf-8"))
    described["artwork"]["title"] = nasty
    (capture / "artwork.yaml").write_text(yaml.safe_dump(described), encoding="utf-8")
    (tile,) = nlights.digitise(capture, recipe=quick, out=tmp_path / "out", progress=False)
    failed = nlights.TileResult("inv-1", "a", "failed", None, nasty)
    for html in (tile._repr_html_(), failed._repr_html_()):
        page = Page(html)
        assert nasty in page.text
        assert "script" not in page.tags


@pytest.mark.parametrize("widgets", [False, True])
def test_a_notebook_has_bars_where_they_can_be_drawn(monkeypatch, widgets):
    monkeypatch.setattr(console, "find_spec", lambda name: object() if widgets else None)
    assert console._has_bars(Console(force_jupyter=True)) is widgets
    assert console._has_bars(Console(force_jupyter=False)) is sys.stderr.isatty()


def test_a_failed_tile_shows_why():
    page = Page(nlights.TileResult("inv-1", "a", "failed", None, "light_1.tif: is missing")._repr_html_())
    assert "light_1.tif: is missing" in page.text
    assert "img" not in page.tags


def test_a_comparison_without_a_result_shows_its_notes(tmp_path):
    record = {"metrics": [], "runs": [], "notes": ["a < b"]}
    page = Page(ComparisonResult(record, tmp_path / "compare.html")._repr_html_())
    assert "a < b" in page.text
    assert "There is no truth" in page.text
