"""The cage as a wireframe: where lines fall, what is in front, and what hides them."""

import numpy as np
import pytest
from refusals import refused

from warpcage import Cage, Camera
from warpcage.view import draw_cage

SIZE = 64
RED = (1.0, 0.0, 0.0)


@pytest.fixture
def camera():
    return Camera.look_at([0.0, -4.0, 0.0], [0.0, 0.0, 0.0], width=SIZE, height=SIZE, fov_degrees=40)


def drawn(camera, cage, **options):
    """How red each pixel of a black picture became."""
    return draw_cage(np.zeros((SIZE, SIZE, 3)), camera, cage, color=RED, **options)[..., 0]


def pixel(camera, point):
    (uv,), _ = camera.project([point])
    return int(np.floor(uv[1])), int(np.floor(uv[0]))


def test_front_edges_are_opaque_and_back_edges_faint(camera):
    red = drawn(camera, Cage.box([-1, -1, -1], [1, 1, 1]), width=1.5, back_opacity=0.25)
    for point in ([1, -1, 0.3], [-1, -1, -0.4], [0.2, -1, 1]):  # edges of the face that looks at the camera
        assert red[pixel(camera, point)] > 0.7
    for point in ([1, 1, 0.3], [0.2, 1, 1]):  # edges of the far face, seen through the near one
        assert 0.1 < red[pixel(camera, point)] <= 0.25 + 1e-9
    assert red[pixel(camera, [0.2, -1, 0.8])] == 0  # inside a face


def test_edges_hidden_by_another_part_of_a_concave_cage():
    """A C-shaped cage: its far arm lies behind the near one, although both face the camera."""
    outline = [[-1, -1], [1, -1], [1, -0.5], [-0.5, -0.5], [-0.5, 0.5], [1, 0.5], [1, 1], [-1, 1]]
    fans = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 7], [7, 4, 5], [7, 5, 6]]
    low = [[x, y, -0.5] for x, y in outline]
    high = [[x, y, 0.5] for x, y in outline]
    faces = [f[::-1] for f in fans] + [[i + 8 for i in f] for f in fans]
    for i in range(8):
        j = (i + 1) % 8
        faces += [[i, j, j + 8], [i, j + 8, i + 8]]
    cage = Cage(low + high, faces)
    cage.require_usable()
    camera = Camera.look_at([0.0, -6.0, 0.0], [0.0, 0.0, 0.0], width=SIZE, height=SIZE, fov_degrees=30)
    red = drawn(camera, cage, back_opacity=0.2)
    assert red[pixel(camera, [1, 0.5, 0.2])] <= 0.2 + 1e-9  # the edge of the far arm that faces the camera
    assert red[pixel(camera, [1, -1, 0.2])] > 0.7


def test_matter_in_front_hides_edges(camera):
    cage = Cage.box([-1, -1, -1], [1, 1, 1])
    depth = np.full((SIZE, SIZE), np.inf)
    depth[:, : SIZE // 2] = 1.0  # before the cage
    red = drawn(camera, cage, depth=depth)
    assert red[:, : SIZE // 2 - 2].max() == 0
    assert red[pixel(camera, [1, -1, 0.3])] > 0.7


def test_line_width_and_antialiasing(camera):
    box = Cage.box([-1, -1, -1], [1, 1, 1])
    row = pixel(camera, [1, -1, 0.31])[0]
    across = [drawn(camera, box, width=width, back_opacity=0.0)[row, SIZE // 2 :].sum() for width in (1.0, 2.0, 4.0)]
    np.testing.assert_allclose(across, [1.0, 2.0, 4.0], rtol=0.02)  # one vertical line; the diagonal is elsewhere


def test_edges_that_cross_the_image_plane():
    cage = Cage.box([-1, -5, -0.5], [1, 5, 0.2])
    camera = Camera.look_at([0.0, 0.0, 0.0], [0.0, 1.0, 0.0], width=SIZE, height=SIZE, fov_degrees=60)
    red = drawn(camera, cage)
    assert red[pixel(camera, [1, 3, 0.2])] > 0.7  # from inside no face is in front of an edge
    assert red[pixel(camera, [-1, 3, -0.2])] == 0  # where the part behind the camera would be, mirrored


def test_a_cage_behind_the_camera_draws_nothing(camera):
    assert drawn(camera, Cage.box([-1, -9, -1], [1, -7, 1])).max() == 0


def test_uint8_pictures_stay_uint8(camera):
    picture = np.full((SIZE, SIZE, 3), 200, np.uint8)
    result = draw_cage(picture, camera, Cage.box([-1, -1, -1], [1, 1, 1]), color=RED)
    assert result.dtype == np.uint8 and picture.min() == 200
    assert tuple(result[0, 0]) == (200, 200, 200)
    assert result[pixel(camera, [1, -1, 0.3])][0] > 240


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "line width"),
        ({"color": (2, 0, 0)}, "color must be"),
        ({"opacity": 1.5}, "opacities"),
        ({"depth": np.zeros((3, 3))}, "depth must be"),
    ],
)
def test_bad_options_are_refused(camera, options, message):
    with pytest.raises(ValueError, match=message):
        draw_cage(np.zeros((SIZE, SIZE, 3)), camera, Cage.box([-1, -1, -1], [1, 1, 1]), **options)


def test_a_picture_of_another_size_is_refused(camera):
    refused(lambda: draw_cage(np.zeros((8, 8, 3)), camera, Cage.box([-1, -1, -1], [1, 1, 1])), match="must be")
