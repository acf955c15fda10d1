"""Pictures of pages by a real browser: what is blank or lacks a word is refused."""

import http.server
import socket
import threading
from typing import ClassVar

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


class Asked(http.server.BaseHTTPRequestHandler):
    """Serves one page, whose pictures are on several hosts, and remembers what it was asked for."""

    asked: ClassVar[list[str]] = []
    page: ClassVar[str] = ""

    def do_GET(self) -> None:
        self.asked.append(self.path)
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        if self.path == "/":
            self.wfile.write(self.page.encode())

    def log_message(self, *words) -> None:
        """Say nothing."""


def test_the_browser_reaches_nothing_beyond_the_loopback_address(page):
    with http.server.ThreadingHTTPServer(("0.0.0.0", 0), Asked) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_port
        # All of these are this very server: only what the browser is forbidden keeps it from asking there.
        far = ["127.0.0.2", socket.gethostname()]
        places = [f"http://127.0.0.1:{port}/near", *(f"http://{host}:{port}/far/{host}" for host in far)]
        pictures = "".join(f'<img src="{place}">' for place in places)
        Asked.page = f"{pictures}<script>onload = () => document.body.append('all was tried')</script>"
        with socket.create_connection(("127.0.0.2", port)):
            pass  # it can be reached
        page.open(f"http://127.0.0.1:{port}/", ["all was tried"])
        server.shutdown()
    assert "/near" in Asked.asked
    assert not [path for path in Asked.asked if path.startswith("/far")]
