"""Several edits in one scene, sources kept or removed, and input that is refused."""

import functools

import numpy as np
import pytest
from fields import BOX, ellipsoid, make_field, plain, psnr, shiny_field, view
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, CageEdit, Camera, Deformer

LEFT = Cage.box([-0.9, -0.3, -0.3], [-0.3, 0.3, 0.3])
RIGHT = Cage.box([0.3, -0.3, -0.3], [0.9, 0.3, 0.3])


@pytest.fixture
def side_view():
    return Camera.look_at([0.0, -4.0, 0.5], (0, 0, 0), width=48, height=48, fov_degrees=35)


def balls(*centers, device):
    def density(x):
        return sum(ellipsoid(x, center, (0.2, 0.2, 0.2)) for center in centers)

    return make_field(density, plain([0.8, 0.3, 0.1]), device=device)


def test_disjoint_edits_each_move_their_part(device, side_view):
    field = balls((-0.6, 0, 0), (0.6, 0, 0), device=device)
    frame = (
        Deformer(field, [LEFT, RIGHT], resolution=32)
        .pose([LEFT.translate([0, 0, 0.5]), RIGHT.translate([-0.3, 0, -0.5])])
        .render(side_view)
    )
    # shifts by whole voxels, so that the expected field is the same one
    expected = balls((-0.6, 0, 0.5), (0.3, 0, -0.5), device=device).render(side_view)
    assert psnr(frame.rgb, expected.rgb) > 45


def test_an_edit_can_keep_its_source_or_remove_it(device, side_view):
    field = balls((-0.6, 0, 0), (0.6, 0, 0), device=device)
    copied = Deformer(field, CageEdit(LEFT, keep_source=True), resolution=32).pose(LEFT.translate([0.6, 0, 0.5]))
    expected = balls((-0.6, 0, 0), (0.6, 0, 0), (0, 0, 0.5), device=device).render(side_view)
    frame = copied.render(side_view)
    assert psnr(frame.rgb, expected.rgb) > 45
    assert frame.reveal.max() == 0

    removed = Deformer(field, CageEdit(LEFT, remove=True), resolution=32)
    for deformer in (removed, removed.pose(None)):
        frame = deformer.render(side_view)
        assert psnr(frame.rgb, balls((0.6, 0, 0), device=device).render(side_view).rgb) > 45
        assert frame.reveal.max() > 0.9


def test_overlapping_edits_resolve_in_order(device, side_view):
    """The second edit takes what the first one put into its cage, and leaves nothing there."""
    field = balls((-0.6, 0, 0), device=device)
    moved = RIGHT.translate([0, 0, 0.5])
    frame = Deformer(field, [LEFT, RIGHT], resolution=32).pose([LEFT.translate([1.2, 0, 0]), moved]).render(side_view)
    assert psnr(frame.rgb, balls((0.6, 0, 0.5), device=device).render(side_view).rgb) > 45
    # the other way round the right cage is empty when it moves, and is then filled
    frame = Deformer(field, [RIGHT, LEFT], resolution=32).pose([moved, LEFT.translate([1.2, 0, 0])]).render(side_view)
    assert psnr(frame.rgb, balls((0.6, 0, 0), device=device).render(side_view).rgb) > 45


# -- Bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coordinates": "bilinear"}, "coordinates .*, got 'bilinear'"),
        ({"density": "thick"}, "density .*, got 'thick'"),
        ({"resolution": None}, MESSAGES["deform.no_closed_form"]),
        ({"resolution": 2}, "resolution"),
        ({"device": "cuda:99"}, "device"),
    ],
)
def test_bad_options_are_refused(options, message):
    refused(lambda: Deformer(shiny_field(None, resolution=8), BOX, **options), match=message)


def test_bad_cages_are_refused():
    field = shiny_field(None, resolution=8)
    open_cage = Cage(BOX.vertices, BOX.faces[1:])
    inverted = Cage(BOX.vertices, BOX.faces[:, ::-1])
    for cage in (open_cage, inverted):
        refused(functools.partial(Deformer, field, cage), match="the rest cage")
    refused(lambda: Deformer(field, BOX.vertices), match="Cage")
    refused(lambda: Deformer(BOX, BOX), match="VoxelField")
    refused(lambda: Deformer(field, []), match="1 to")
    refused(lambda: CageEdit(BOX, keep_source=True, remove=True), match="keep the source")


def test_bad_poses_are_refused_and_the_last_one_stays():
    field, camera = shiny_field(None, resolution=24), view(size=24)
    deformer = Deformer(field, BOX, resolution=16).pose(BOX.twist(40))
    before = deformer.render(camera).rgb
    reordered = Cage(BOX.vertices, np.roll(BOX.faces, 1, axis=0))
    mirrored = BOX.with_vertices(BOX.vertices * [-1, 1, 1])
    flat = BOX.with_vertices(BOX.vertices * [1, 1, 0])
    other = Cage.box([0, 0, 0], [1, 1, 1])
    for pose, message in (
        (reordered, "order"),
        (mirrored, "the deformed cage"),
        (flat, "the deformed cage"),
        (other, "vertices"),
        ([BOX, BOX], "one cage per edit"),
        (BOX.vertices[1:], "vertices"),
        (None, "its vertices, got NoneType"),
    ):
        refused(functools.partial(deformer.pose, pose), match=message)
        np.testing.assert_array_equal(deformer.render(camera).rgb, before)
    refused(lambda: deformer.pose(BOX.with_vertices(BOX.vertices * np.nan)), match="finite")


def test_bad_points_and_steps_are_refused():
    deformer = Deformer(shiny_field(None, resolution=8), BOX, resolution=8)
    refused(lambda: deformer.to_canonical(np.zeros((2, 3)), np.zeros((3, 3))), match="as many")
    refused(lambda: deformer.to_canonical(np.zeros((2, 2)), np.zeros((2, 2))), match="points must be")
    refused(lambda: deformer.to_canonical(np.full((2, 3), np.nan), np.zeros((2, 3))), match="finite")
    for step in (0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="step must be"):
            deformer.render(view(), step=step)
    refused(lambda: deformer.render(view(), background="plaid"), match="background")


@pytest.mark.parametrize(("width", "height"), [(0, 4), (4, 0), (-1, 4)])
def test_pictures_without_pixels_are_refused(width, height):
    with pytest.raises(ValueError, match="must be a whole number of at least 1"):
        Camera(10.0, 10.0, 2.0, 2.0, width, height, np.eye(4))
