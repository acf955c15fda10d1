"""The report is read as a page: what it shows, says and never asks the network for."""

import base64
import html
import io
import re
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.frames import PixelGrid
from nlights_core.report import chapters, pictures, plots
from nlights_core.report.figures import Number, figure_of
from nlights_core.report.page import draw, write_report
from nlights_core.report.quality import measure

LAMPS = ("Relio_1", "Relio_2", "Relio_3")
POSITIONS = np.array([[800.0, 0, 600], [-400, 700, 610.5], [-400, -700, 620]])


def tile(rows=48, columns=64, channels=3, known=1.0, unit="mm"):
    """Record, maps and grid of a small synthetic tile."""
    rng = np.random.default_rng(5)
    size = 0.5 if unit == "mm" else 1.0
    grid = PixelGrid(rows, columns, size, (0.0, 0.0, 1542.0) if unit == "mm" else None, unit)
    x, y = np.meshgrid(grid.x(), grid.y())
    height = (0.2 * np.sin(x) * np.cos(y)).astype(np.float32)
    normals = rng.normal([0, 0, 1], 0.05, (rows, columns, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    maps = {
        "albedo": rng.random((rows, columns, channels), dtype=np.float32),
        "normals": normals,
        "height": height,
        "confidence": rng.random((rows, columns), dtype=np.float32),
        "residual": 0.1 * rng.random((rows, columns), dtype=np.float32),
        "used": rng.integers(1, 4, (rows, columns)).astype(np.uint8),
        "saturated": np.zeros((rows, columns), np.uint8),
        "reflection": rng.normal(0, 0.02, (rows, columns, channels)).astype(np.float32),
        "flat_field": 1 + rng.random((3, 6, 8, channels), dtype=np.float32),
        "trend": (0.01 * x).astype(np.float32),
        "bias": np.full((rows, columns, 3), 0.001, np.float32),
        "frames": rng.random((3, 12, 16, channels), dtype=np.float32),
    }
    unknown = rng.random((rows, columns)) >= known
    for name in ("albedo", "normals", "height", "residual", "reflection"):
        maps[name][unknown] = np.nan
    record = {
        "artwork": "inv-7",
        "title": "A plan",
        "tile": "r0c0",
        "origin_mm": [250.0, -187.5],
        "stand": "horizontal",
        "uncertainty_mm": 2.5,
        "white": 0.9,
        "recipe": {"normals": {"use": "robust"}, "passes": 2},
        "lamps": list(LAMPS),
        "lights": LightField(LAMPS, positions=POSITIONS).record(),
        "version": "0.1.0",
        "files": [{"name": "height.tif", "bytes": 407_560_000, "what": "height, mm"}],
        "key": "ab12" * 16,
        "mesh": {
            "glb": {
                "faces": 4000,
                "vertices": 2100,
                "largest_deviation_mm": 0.0123,
                "rms_deviation_mm": 0.0021,
                "covered": 0.999,
            }
        },
    }
    return record, maps, grid


class Page(HTMLParser):
    """The tags, attributes and words of a page."""

    def __init__(self, text):
        super().__init__()
        self.text, self.tags, self.words = text, [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.words.append(data)

    def images(self):
        return [attributes for tag, attributes in self.tags if tag == "img"]

    def read(self):
        return " ".join(" ".join(self.words).split())


def written(tmp_path, record, maps, grid, numbers=None):
    numbers = measure(maps, grid) if numbers is None else numbers
    write_report(tmp_path / "report.html", record, draw(record, maps, grid), numbers)
    return Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_the_page_needs_no_network_and_no_script(tmp_path):
    page = written(tmp_path, *tile())
    assert {tag for tag, _ in page.tags}.isdisjoint({"script", "link", "iframe", "object", "form"})
    addresses = [v for _, a in page.tags for k, v in a.items() if k in ("src", "href", "srcset", "data")]
    assert addresses
    assert all(address.startswith(("data:image/", "#")) for address in addresses)
    without_pictures = re.sub(r"data:image/[^\"]*", "", page.text)
    assert not re.search(r"https?:|//|url\(|@import", without_pictures)


def test_every_picture_opens_and_is_described(tmp_path):
    page = written(tmp_path, *tile())
    assert len(page.images()) > 20
    for attributes in page.images():
        assert attributes["alt"].strip()
        kind, content = re.fullmatch(r"data:image/(png|jpeg);base64,(.*)", attributes["src"]).groups()
        with Image.open(io.BytesIO(base64.b64decode(content))) as image:
            image.load()
            assert image.format == kind.upper()
            assert max(image.size) <= 1300


def test_every_map_has_its_picture_and_quantities_have_units(tmp_path):
    words = written(tmp_path, *tile()).read()
    for title in (
        "Albedo",
        "Raking light",
        "Height",
        "Height profiles",
        "Normals",
        "Slope in degrees",
        "Residual in % of albedo",
        "Lights used: share of the pixels",
        "Uncertainty of the normals in °",
        "Reflection, on the scale of the albedo",
        "Light of Relio_2",
        "Trend in µm",
        "Bias in degrees",
        "Lamps around the field",
        "Height in µm",
        "OpenGL",
        "5 mm",
    ):
        assert title in words, title


def test_every_number_stands_with_its_unit_and_meaning(tmp_path):
    record, maps, grid = tile()
    numbers = measure(maps, grid)
    page = written(tmp_path, record, maps, grid, numbers)
    rows = re.findall(r"<tr><th scope=\"row\">(.*?)</tr>", page.text)
    for number in numbers:
        (row,) = (r for r in rows if r.startswith(html.escape(number.name) + "</th>"))
        factor, unit = (1000, "µm") if number.unit == "mm" else (1, number.unit)  # the pictures' unit
        assert html.escape(unit) in row
        value = None if number.value is None else number.value * factor
        assert html.escape(figure_of(value, unit)) in row
        assert html.escape(number.meaning).replace("&#x27;", "&#39;") in row


def test_what_was_not_measured_says_so(tmp_path):
    record, maps, grid = tile()
    page = written(tmp_path, record, maps, grid, [Number("Light", "Glow", None, "%", "Nothing.")])
    assert re.search(r"Glow.*?missing.*?not measured", page.text)
    del maps["trend"]
    page = written(tmp_path, record, maps, grid)
    assert re.search(r"Trend of the height.*?missing.*?not in this recipe", page.text)


def test_heights_have_one_unit_in_pictures_and_numbers(tmp_path):
    record, maps, grid = tile()
    assert re.search(
        r"Height range</th><td class=\"number\">[34]\d\d</td><td class=\"unit\">µm",
        written(tmp_path, record, maps, grid).text,
    )
    maps["height"] *= 10
    page = written(tmp_path, record, maps, grid)
    assert "Height in mm" in page.read()
    assert re.search(r"Height range</th><td class=\"number\">[34].\d\d</td><td class=\"unit\">mm", page.text)


def test_pictures_and_numbers_agree_on_uneven_light(tmp_path):
    record, maps, grid = tile()
    page = written(tmp_path, record, maps, grid, measure(maps, grid, LAMPS))
    below = re.findall(r"Brightest to darkest (.*?)\.</figcaption>", page.text)
    listed = re.findall(r"Uneven light, Relio_\d</th><td class=\"number\">(.*?)</td>", page.text)
    assert len(below) == 3
    assert below == listed


def test_the_albedo_says_what_it_counts_from(tmp_path):
    record, maps, grid = tile()
    assert "stated reflectance of 0.9" in written(tmp_path, record, maps, grid).read()
    record["white"] = None
    words = written(tmp_path, record, maps, grid).read()
    assert "Relative: there was no flat" in words
    assert "perfect diffuser" not in words


def test_header_states_artwork_tile_scale_frame_and_provenance(tmp_path):
    words = written(tmp_path, *tile()).read()
    for fact in (
        "A plan",
        "inv-7",
        "r0c0, its centre at x 250, y −187.5 mm on the artwork",
        "32 × 24 mm, 64 × 48 pixels",
        "0.5 mm on the artwork",
        "1542 mm from the plane of the artwork",
        "x right, y up, z from the artwork to the camera",
        "horizontal",
        "use: robust",
        "nLights 0.1.0",
        "ab12ab12",
        "height.tif",
        "408 MB",
        "610.5",
        "horizontal, positions known to ± 2.5 mm",
        "uncertainty (positions known to ± 2.5 mm)",
        "The decimated mesh (mesh.glb)",
        "at most 12.3 µm (2.10 µm rms), and covers 99.9 % of the known pixels",
    ):
        assert fact in words, fact


def test_markup_in_names_is_shown_not_obeyed(tmp_path):
    record, maps, grid = tile()
    record["title"] = '<script>alert("x")</script> & <b>bold</b>'
    record["lamps"] = ["<i>one</i>", "two", "three"]
    record["recipe"] = {"note": "</pre><script>"}
    page = written(tmp_path, record, maps, grid)
    assert "script" not in {tag for tag, _ in page.tags}
    assert '<script>alert("x")</script> & <b>bold</b>' in page.read()
    assert "Light of <i>one</i>" in page.read()


def test_the_same_tile_gives_the_same_bytes(tmp_path):
    first = written(tmp_path, *tile()).text
    assert written(tmp_path, *tile()).text == first


@pytest.mark.parametrize("known", [0.0, 0.02, 0.6])
def test_a_tile_that_is_partly_or_not_at_all_known_is_reported(tmp_path, known):
    record, maps, grid = tile(known=known)
    assert "Height in" in written(tmp_path, record, maps, grid).read()


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (3, 200)])
def test_a_tiny_tile_is_reported(tmp_path, size):
    assert "Height in" in written(tmp_path, *tile(*size)).read()


def test_one_channel_is_reported(tmp_path):
    assert "Reflection" in written(tmp_path, *tile(channels=1)).read()


def test_a_level_surface_is_reported(tmp_path):
    record, maps, grid = tile()
    maps["height"] = np.zeros(grid.shape, np.float32)
    maps["normals"] = np.broadcast_to(np.array([0, 0, 1], np.float32), (*grid.shape, 3))
    maps["residual"] = np.zeros(grid.shape, np.float32)
    assert "Height in" in written(tmp_path, record, maps, grid).read()


def test_without_a_scale_lengths_are_pixels_and_millimetres_are_not_mentioned(tmp_path):
    record, maps, grid = tile(unit="px")
    record |= {
        "origin_mm": None,
        "uncertainty_mm": None,
        "files": [],
        "mesh": None,
        "lights": LightField(LAMPS, directions=np.eye(3)).record(),
    }
    words = written(tmp_path, record, maps, grid).read()
    assert "scale not known: heights in pixels" in words
    assert "Height in pixels" in words
    assert " mm" not in words
    assert "µm" not in words


def test_an_empty_record_and_few_maps_still_make_a_report(tmp_path):
    _, maps, grid = tile()
    words = written(tmp_path, {}, {"height": maps["height"]}, grid).read()
    assert "Nothing was taken out of this measurement." in words
    assert "not stated" in words


def test_more_than_sixteen_lights_get_a_colour_scale(tmp_path):
    record, maps, grid = tile()
    maps["used"] = np.random.default_rng(0).integers(0, 97, grid.shape).astype(np.uint8)
    assert "Lights used" in written(tmp_path, record, maps, grid).read()


def test_a_relative_albedo_is_shown_at_a_stated_exposure(tmp_path):
    record, maps, grid = tile()
    assert "brightened" not in written(tmp_path, record, maps, grid).read()
    maps["albedo"][:] = 0.01
    assert "This picture is brightened × 90." in written(tmp_path, record, maps, grid).read()


def test_a_large_tile_is_shown_reduced_and_its_middle_pixel_by_pixel(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "LONGEST", 20)
    monkeypatch.setattr(chapters, "DETAIL", 16)
    words = written(tmp_path, *tile()).read()
    assert "the mean of 4 × 4 measured ones" in words
    assert "The middle of the field, 16 × 12 pixels" in words


def test_counts_that_hardly_occur_are_not_listed_and_neighbours_differ_plainly():
    counts = np.full((100, 100), 8)
    counts[:50] = 7
    counts[0, :4] = 5
    counts[0, 4:9] = 6
    _, bar = pictures.counted(counts, 8, "Lights")
    assert [text for _, text in bar.swatches] == ["6: 0.05 %", "7: 49.9 %", "8: 50.0 %"]
    colours = [np.array(list(bytes.fromhex(colour[1:])), int) for colour, _ in bar.swatches]
    assert min(np.abs(np.diff(colours, axis=0)).max(axis=1)) > 40


@pytest.mark.parametrize("name", ["horizontal", "vertical-open", "vertical-dark"])
def test_on_the_plan_no_lamp_is_hidden_by_a_name_and_no_name_by_another(name):
    stand = load_stand(name)
    lights = LightField(tuple(stand.lamps), positions=stand.lamp_positions()).record()
    figure, axes = plots.draw_lights(lights, PixelGrid(300, 400, 1.25, tuple(stand.camera_position)))
    figure.canvas.draw()
    names = [text.get_window_extent() for text in axes.texts if text.get_text().startswith("Relio")]
    field = axes.patches[0].get_window_extent()
    assert len(names) == 8
    dots = axes.transData.transform(stand.lamp_positions()[:, :2])
    for i, box in enumerate(names):
        assert not any(box.overlaps(other) for other in [field, *names[i + 1 :]])
        near = np.abs(dots - np.clip(dots, box.min, box.max)).max(axis=1)
        assert near.min() > 5 * figure.dpi / 72, name  # a dot's radius is 4.5 points
        assert axes.bbox.contains(*box.min)
        assert axes.bbox.contains(*box.max)


def test_raking_light_brightens_slopes_that_face_the_upper_left():
    normals = np.tile(np.array([0, 0, 1.0]), (9, 9, 1))
    normals[4, 2] = [-0.1, 0.1, 0.99]  # faces left and up
    normals[4, 6] = [0.1, -0.1, 0.99]
    normals[0, 0] = np.nan
    shade, gain = pictures.hillshade(normals)
    assert shade[4, 2] > 0.5 > shade[4, 6]
    assert shade[8, 8] == 0.5
    assert np.isnan(shade[0, 0])
    assert gain > 0


def test_unknown_is_hatched_in_a_neutral_grey_finer_than_a_pixel():
    known = np.zeros((4, 3), bool)
    known[:2] = True
    seen = pictures.hatch(np.zeros((4, 3, 3), np.uint8), known)
    assert seen.shape == (600, 450, 3)
    assert (seen[:300] == 0).all()
    assert set(np.unique(seen[300:])) == {164, 196}
    assert set(np.unique(seen[300:450, :150])) == {164, 196}  # both greys within one pixel
    assert (seen[..., 0] == seen[..., 2]).all()


@pytest.mark.parametrize(("width", "label"), [(500, "100 mm"), (41.7, "10 mm"), (3, "0.5 mm")])
def test_a_scale_bar_is_a_round_length_at_its_true_width(width, label):
    percent, text = pictures.scale_bar(width, "mm")
    assert text == label
    assert percent / 100 * width == pytest.approx(float(label.split()[0]))


def test_ticks_stand_where_their_labels_say():
    for low, high in ((-250.0, 250.0), (187.5, -187.5), (0.0, 0.0123)):
        ticks = pictures.edge_ticks(low, high)
        assert len(ticks) >= 3
        for place, label in ticks:
            assert low + place / 100 * (high - low) == pytest.approx(float(label.replace("−", "-")), abs=1e-9)


def test_importing_the_report_stays_light():
    code = (
        "import sys, nlights_core.report.page, nlights_core.products.meshes, nlights_core.files.tiffs\n"
        "import nlights_core.report.quality\n"
        "heavy = {'matplotlib', 'trimesh', 'jinja2', 'PIL', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
