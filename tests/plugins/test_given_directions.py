"""Given directions: the four file formats, their order, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from nlights_core.capture import GivenLights, Tile
from nlights_core.errors import TileError
from nlights_plugins.given_directions import GivenDirections, read_directions

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"

needs_data = pytest.mark.skipif(not DATA.exists(), reason="the real captures are not beside the repository")

FOUR = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8], [0, -0.6, 0.8]])
LP = "4\nC:\\dome\\shot 2.jpg 0 0.6 0.8\nshot 1.jpg 3 0 4\nshot 4.jpg 0 -0.6 0.8\nshot 3.jpg -0.6 0 0.8\n"


@pytest.fixture
def locate(tmp_path):
    """Write the files, make a tile with such frames, locate its lights."""

    def run(directions, intensities=None, frames=("1.tif", "2.tif", "3.tif", "4.tif")):
        path = tmp_path / "directions.txt"
        path.write_text(directions)
        strengths = None
        if intensities is not None:
            strengths = tmp_path / "intensities.txt"
            strengths.write_text(intensities)
        tile = Tile(
            artwork="a",
            name="t",
            frames={f"lamp {i}": Path(name) for i, name in enumerate(frames)},
            lights=GivenLights(directions=path, intensities=strengths),
        )
        return GivenDirections().locate(
            tile, lambda path, *, reduce=1: pytest.fail("no photograph is needed")
        )

    return run


def text(matrix):
    return "\n".join(" ".join(str(value) for value in row) for row in matrix)


@pytest.mark.parametrize(
    "content",
    [text(FOUR), text(FOUR.T), "4\n" + text(FOUR * 5), "# dome\n\n" + text(FOUR)],
    ids=["a row per light", "a column per light", "counted, not unit", "comments"],
)
def test_every_shape_of_file_gives_unit_directions_in_the_order_of_the_frames(locate, content):
    field = locate(content)
    assert not field.near
    np.testing.assert_allclose(field.directions, FOUR)
    np.testing.assert_array_equal(field.power, np.ones((4, 1)))


def test_an_lp_file_is_matched_by_file_name_even_with_spaces_and_folders(locate):
    field = locate(LP, frames=("shot 1.jpg", "shot 2.JPG", "shot 3.jpg", "shot 4.jpg"))
    np.testing.assert_allclose(field.directions, FOUR)


def test_an_lp_file_may_hold_more_lights_than_the_tile_has_frames(locate):
    field = locate(LP, frames=("shot 3.jpg", "shot 1.jpg"))
    np.testing.assert_allclose(field.directions, FOUR[[2, 0]])


def test_an_lp_file_of_exports_is_matched_without_extension_capitals_and_ways_of_writing_accents(locate):
    lp = "3\nD:\\Export\\Pru\u0308fung 2.JPG 0 0.6 0.8\n/a b/prüfung 1.jpeg 3 0 4\nprüfung 3 -0.6 0 0.8\n"
    field = locate(lp, frames=("Prüfung 1.tif", "prüfung 2.CR2", "pru\u0308fung 3.tiff"))
    np.testing.assert_allclose(field.directions, FOUR[[0, 1, 2]])


def test_names_that_end_in_a_number_and_have_no_extension_are_told_apart(locate):
    lp = "3\ngray.2 0 0.6 0.8\ngray.0 3 0 4\ngray.1 -0.6 0 0.8\n"
    field = locate(lp, frames=("gray.0.tga", "gray.1.tga", "gray.2.tga"))
    np.testing.assert_allclose(field.directions, FOUR[[0, 2, 1]])


def test_photographs_of_one_name_are_told_apart_by_their_folders(locate):
    lp = "4\nx\\b\\1.jpg 0 0.6 0.8\nx\\a\\1.jpg 3 0 4\nx\\a\\2.jpg -0.6 0 0.8\nx\\b\\2.jpg 0 -0.6 0.8\n"
    field = locate(lp, frames=("c/a/1.tif", "c/b/1.tif", "c/a/2.tif", "c/b/2.tif"))
    np.testing.assert_allclose(field.directions, FOUR)


def test_the_line_with_the_very_extension_goes_before_that_of_an_export(locate):
    lp = "4\n1.jpg 0 0.6 0.8\n1.tif 3 0 4\n2.tif -0.6 0 0.8\n3.tif 0 -0.6 0.8\n"
    np.testing.assert_allclose(locate(lp, frames=("1.tif", "2.tif", "3.tif")).directions, FOUR[[0, 2, 3]])


@pytest.mark.parametrize(
    ("lp", "frames", "words"),
    [
        (LP, ("1.tif", "2.tif", "3.tif", "4.tif"), r"none of them is a frame of tile t \(1\.tif, 2\.tif"),
        (
            LP,
            ("shot 1.jpg", "shot 2.jpg", "shot 3.jpg", "7.tif"),
            r"some of the frames of tile t but not 7\.tif",
        ),
        (
            "3\n1.jpg 0 0 1\n1.png 0 1 1\n2.jpg 1 0 1\n",
            ("1.tif", "2.tif"),
            "1.jpg and 1.png may both mean 1.tif",
        ),
        (
            "2\n1.jpg 0 0 1\n2.jpg 0 1 1\n",
            ("a/1.tif", "b/1.tif", "a/2.tif"),
            "1.jpg may mean a/1.tif and b/1.tif",
        ),
        ("3\n1.jpg 0 0 1\n0 1 1\n2.jpg 1 0 1\n", ("1.tif", "2.tif"), "light 2 has no name"),
    ],
    ids=["none fits", "some fit", "two lines", "two photographs", "names of some"],
)
def test_names_that_leave_a_doubt_are_refused_and_never_taken_in_order(locate, lp, frames, words):
    with pytest.raises(TileError, match=words):
        locate(lp, frames=frames)


def test_intensities_follow_the_order_of_the_directions_file(locate):
    field = locate(LP, "2\n1\n4\n3\n", frames=("shot 1.jpg", "shot 2.jpg", "shot 3.jpg", "shot 4.jpg"))
    np.testing.assert_array_equal(field.power, [[1], [2], [3], [4]])


def test_intensities_may_differ_between_colours(locate):
    colours = np.arange(12).reshape(4, 3) + 1.0
    np.testing.assert_array_equal(locate(text(FOUR), text(colours)).power, colours)


def test_three_by_three_is_a_row_per_light(locate):
    field = locate("0 0 1\n0.6 0 0.8\n0 0.6 0.8", frames=("1", "2", "3"))
    np.testing.assert_allclose(field.directions, [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (text(FOUR[:3]), r"directions\.txt: 3 lights, but tile t has 4 frames"),
        ("5\n" + text(FOUR), "the first line says 5 lights, but 4 lines follow"),
        (text(FOUR).replace("0.6", "nan", 1), "row 1 holds a number that is not finite"),
        (text(FOUR[:3]) + "\n0 0 0", "light 4 is a zero vector"),
        (text(FOUR[:3]) + "\n0 1 -0.2", r"light 4 has z = -0\.2, behind the artwork"),
        (text(FOUR[:3]) + "\n0 1", "lines hold different numbers of values"),
        (text(FOUR).replace("0.6", "east", 1), "not a number where one is expected.*east"),
        (text(np.ones((4, 4))), "4 rows of 4 numbers; directions are L rows of 3"),
        ("\n# nothing\n", "the file is empty"),
    ],
)
def test_a_faulty_file_of_directions_is_refused_by_name(locate, content, message):
    with pytest.raises(TileError, match=message):
        locate(content)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1\n1\n1", r"intensities\.txt: 3 rows of 1 numbers, but 4 lights need 4 rows"),
        ("1\n1\n0\n1", "light 3 has an intensity of 0; it must be above 0"),
        ("1\n1\ninf\n1", "row 3 holds a number that is not finite"),
    ],
)
def test_a_faulty_file_of_intensities_is_refused_by_name(locate, content, message):
    with pytest.raises(TileError, match=message):
        locate(text(FOUR), content)


def test_a_tile_without_files_of_lights_is_refused():
    tile = Tile(artwork="a", name="t", frames={"a": Path("a")})
    with pytest.raises(TileError, match="given-directions needs a file of directions"):
        GivenDirections().locate(tile, lambda path, *, reduce=1: pytest.fail("no photograph is needed"))


@needs_data
@pytest.mark.parametrize(
    ("path", "count", "first"),
    [
        ("psbox/light_directions.txt", 12, (-0.34766159, 0.07252963, 0.93481061)),
        ("diligent/ball/light_directions.txt", 96, None),
        ("uw/lights.txt", 12, (0.403259, 0.480808, 0.778592)),
    ],
)
def test_published_files_are_read(path, count, first):
    listed = read_directions(DATA / path)
    assert listed.directions.shape == (count, 3)
    if first is not None:
        np.testing.assert_allclose(listed.directions[0], first, atol=1e-6)
