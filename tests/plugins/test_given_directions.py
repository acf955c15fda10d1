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


def test_an_lp_file_with_other_names_is_taken_in_order(locate):
    np.testing.assert_allclose(locate(LP).directions, FOUR[[1, 0, 3, 2]])


def test_an_lp_file_that_names_only_some_frames_is_refused(locate):
    with pytest.raises(TileError, match=r"names some of the frames of tile t but not 7\.tif"):
        locate(LP, frames=("shot 1.jpg", "shot 2.jpg", "shot 3.jpg", "7.tif"))


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
