"""Pictures of pages by a real browser: what is blank or lacks a word is refused."""

import page_pictures
import pytest
from PIL import Image

pytestmark = pytest.mark.skipif(page_pictures.chromium() is None, reason="there is no Chromium here")


@pytest.fixture(scope="module")
def page():
    with page_pictures.browser() as page:
        yield page


def test_a_page_with_its_words_is_pictured(page, tmp_path):
    file = tmp_path / "night.html"
    bars = "".join(f'<p style="color: rgb({5 * i}, 90, 200)">tile {i}</p>' for i in range(30))
    file.write_text(f"<h1>Night</h1><p>inv-1801 Done</p>{bars}")
    page.open(file.as_uri(), ["inv-1801", "done"])
    page.picture(tmp_path / "night.png")
    with Image.open(tmp_path / "night.png") as picture:
        assert picture.width == page_pictures.SIZE[0]


def test_a_page_that_lacks_a_word_is_refused(page, tmp_path):
    file = tmp_path / "night.html"
    file.write_text("<h1>Night</h1><p hidden>inv-1801</p>")
    with pytest.raises(page_pictures.PictureError, match="lacks inv-1801"):
        page.open(file.as_uri(), ["night", "inv-1801"], patience=1)


def test_a_blank_page_is_refused(page, tmp_path):
    file = tmp_path / "night.html"
    file.write_text("<p style='color: white'>night</p>")
    page.open(file.as_uri(), ["night"])
    with pytest.raises(page_pictures.PictureError, match="as good as blank"):
        page.picture(tmp_path / "night.png")


def test_the_browser_reaches_nothing_beyond_this_machine(page):
    page.open("http://example.org/", ["ERR_NAME_NOT_RESOLVED"])
