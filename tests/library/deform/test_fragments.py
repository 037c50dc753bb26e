"""Small pieces that a cage cuts off a part go with it."""

import numpy as np
import pytest
from fields import INSIDE, KINDS, NUB, PART, boxes, make_field, nodes, plain, psnr, rotation
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, CageEdit, Camera, Deformer, VoxelField, bake
from warpcage.edits import fragment_voxels

CAMERA = Camera.look_at([1.0, -4.0, 1.5], (0, 0, 0), width=48, height=48, fov_degrees=35)
UNCHANGED, CLEARED, MAPPED = range(3)
WAYS = [*((kind, 32) for kind in KINDS), ("mean_value", None), ("green", None)]


BODY = ([-0.9, -0.3, -0.3], [-0.2, 0.3, 0.3])  # beside the cage
BEAM = ([0.45, -0.1, 0.2], [0.6, 0.1, 0.9])  # out of the cage by much
SPECK = ([0.2, 0.2, 0.6], [0.3, 0.3, 0.7])  # small, but the cage cuts nothing off there

#: Places in the part of the nub outside the cage.
IN_NUB = np.random.default_rng(0).uniform([0.21, -0.09, 0.41], [0.29, -0.01, 0.49], (100, 3))
ALONG = np.tile([0.0, 0.6, 0.8], (len(IN_NUB), 1))


def field(*corners, device=None):
    return make_field(boxes(*corners), plain([0.8, 0.3, 0.1]), device=device)


@pytest.fixture
def scene(device):
    return field(BODY, INSIDE, NUB, BEAM, SPECK, device=device)


def test_fragments_are_what_the_wall_cuts_off_and_is_small(scene):
    found = fragment_voxels(scene, PART, 0.35)
    x = nodes(40, scene.bounds)
    expected = boxes(NUB)(x) > 0
    expected &= x[..., 2] > 0.4
    dense = scene.node_densities()[tuple(found.T)] > 0
    np.testing.assert_array_equal(found[dense], np.argwhere(expected))
    assert len(fragment_voxels(scene, PART, 0.1)) == 0
    both = fragment_voxels(scene, PART, 0.9)
    assert len(both) > len(found) and (both[:, 2] > 27).all()  # the beam too, the speck never
    speck = (np.array(SPECK[0]) + SPECK[1]) / 2
    assert np.linalg.norm(scene.bounds[0] + (both + 0.5) * 0.05 - speck, axis=1).min() > 0.08
    assert len(fragment_voxels(scene, PART.translate([9, 0, 0]), 0.5)) == 0


def test_a_field_without_matter_has_none(device):
    empty = make_field(lambda x: np.zeros(x.shape[:3]), plain([0.8, 0.3, 0.1]), device=device)
    assert fragment_voxels(empty, PART, 0.35).shape == (0, 3)
    deformer = Deformer(empty, CageEdit(PART, fragments=0.35), resolution=8).pose(PART.rotate(20))
    assert deformer.render(CAMERA).alpha.max() == 0


@pytest.mark.parametrize(("kind", "resolution"), WAYS)
def test_fragments_are_where_a_turn_takes_them_and_not_where_they_were(kind, resolution, scene):
    """Exact for every pose that the coordinates reproduce, in position and direction."""
    turn, middle, offset = rotation(30, 20), np.array([0.4, 0, 0]), np.array([0.6, 0.3, -0.1])
    posed = PART.with_vertices(1.2 * (PART.vertices - middle) @ turn.T + offset)
    deformer = Deformer(scene, CageEdit(PART, fragments=0.35), coordinates=kind, resolution=resolution).pose(posed)
    moved = 1.2 * (IN_NUB - middle) @ turn.T + offset
    came, seen, region, outside = deformer.to_canonical(moved, ALONG, return_outside=True)
    np.testing.assert_array_equal(region, MAPPED)
    np.testing.assert_allclose(came, IN_NUB, atol=2e-6)
    np.testing.assert_allclose(seen, ALONG @ turn, atol=2e-5)
    assert not outside.any()
    assert (deformer.to_canonical(IN_NUB, ALONG)[2] == CLEARED).all()
    beam = np.array([[0.5, 0.0, 0.6], [0.25, 0.25, 0.65]])  # too large, and cut off nothing
    assert (deformer.to_canonical(beam, beam)[2] == UNCHANGED).all()


@pytest.mark.parametrize(("kind", "resolution"), WAYS)
def test_fragments_hang_on_their_part_in_any_pose(kind, resolution, scene):
    """A line of the posed scene from the part into a fragment comes from a line without a jump; what is found of it
    is all of it, and nothing of it twice."""
    deformer = Deformer(scene, CageEdit(PART, fragments=0.35), coordinates=kind, resolution=resolution)
    deformer.pose(PART.bend(30, towards="y").twist(20, axis="x"))
    low, high = np.array([-0.1, -0.8, -0.8]), np.array([1.0, 1.0, 1.0])
    for _ in range(2):  # everywhere, then closely around what was found
        x = low + np.argwhere(np.ones((40, 40, 40))) / 39 * (high - low)
        came, _, region = deformer.to_canonical(x, np.ones_like(x))
        held = (region == MAPPED) & ((came > [0.2, -0.1, 0.4]) & (came < [0.3, 0.0, 0.5])).all(axis=1)
        side = (high - low) / 39
        low, high = x[held].min(axis=0) - side, x[held].max(axis=0) + side
    columns = [deformer.to_canonical(x[held] + 1e-4 * axis, x[held])[0] - came[held] for axis in np.eye(3)]
    volume = np.abs(np.linalg.det(np.stack(columns, axis=-1) / 1e-4)).sum() * np.prod(side)
    assert volume == pytest.approx(1e-3, rel=0.05)
    middle = x[held][np.argmin(np.linalg.norm(came[held] - [0.25, -0.05, 0.47], axis=1))]
    start = middle + 0.25 * (deformer.deformed[0].vertices.mean(axis=0) - middle)
    line = start + np.linspace(0, 1, 500)[:, None] * (middle - start)
    path, _, region = deformer.to_canonical(line, np.ones_like(line))
    assert (region == MAPPED).all() and path[0, 2] < 0.39 and path[-1, 2] > 0.45
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps.max() < (10 if kind == "green" else 4) * np.median(steps)


def test_the_picture_is_that_of_the_moved_matter(device):
    """A quarter turn and a shift by whole voxels, so that the moved scene is a field as well."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    places = np.sort((np.array([*INSIDE, *NUB]) @ turn.T + [0.0, -0.2, 0.3]).reshape(2, 2, 3), axis=1)
    truth = field(BODY, *places, device=device)
    scene = field(BODY, INSIDE, NUB, device=device)
    posed = PART.with_vertices(PART.vertices @ turn.T + [0.0, -0.2, 0.3])
    camera = Camera.look_at([3.5, -1.0, 1.5], (0, 0, 0), width=48, height=48, fov_degrees=35)
    expected = truth.render(camera)
    for size in (0.35, 0.0):
        deformer = Deformer(scene, CageEdit(PART, fragments=size), resolution=24).pose(posed)
        frame = deformer.render(camera)
        likeness = psnr(frame.rgb, expected.rgb)
        assert likeness > 50 if size else likeness < 30, likeness
        if size:
            assert psnr(bake(deformer).render(camera).rgb, expected.rgb) > 40
            precise = Deformer(scene, CageEdit(PART, fragments=size), coordinates="mean_value", resolution=None)
            assert psnr(precise.pose(posed).render(camera).rgb, expected.rgb) > 50
            still = Deformer(scene, CageEdit(PART, fragments=size), resolution=24).render(camera)
            assert psnr(still.rgb, scene.render(camera).rgb) > 50


def test_the_part_may_come_to_lie_where_its_fragment_was(scene):
    deformer = Deformer(scene, CageEdit(PART, fragments=0.35), resolution=24).pose(PART.translate([0, 0, 0.25]))
    came, _, region = deformer.to_canonical(IN_NUB, ALONG)
    np.testing.assert_array_equal(region, MAPPED)
    np.testing.assert_allclose(came, IN_NUB - [0, 0, 0.25], atol=1e-6)
    came, _, region = deformer.to_canonical(IN_NUB + [0, 0, 0.25], ALONG)
    np.testing.assert_array_equal(region, MAPPED)
    np.testing.assert_allclose(came, IN_NUB, atol=1e-6)


def test_matter_two_voxels_from_a_fragment_stays_however_coarse_the_lattice(device):
    other = ([0.35, -0.1, 0.45], [0.9, 0.0, 0.9])  # beside the nub, one voxel between them
    scene = field(INSIDE, NUB, other, device=device)
    near = np.array([[0.33, -0.05, 0.49], [0.34, -0.05, 0.46]])
    deformer = Deformer(scene, CageEdit(PART, fragments=0.35), resolution=8).pose(PART.translate([-0.6, 0, 0.3]))
    came, _, region = deformer.to_canonical(near, near)
    np.testing.assert_array_equal(region, UNCHANGED)
    np.testing.assert_array_equal(came, near)
    came, _, region = deformer.to_canonical(IN_NUB + [-0.6, 0, 0.3], ALONG)
    np.testing.assert_array_equal(region, MAPPED)


def test_a_later_edit_takes_the_fragments_of_an_earlier_one_along(scene):
    """Each acts on what the one before it left; where both cages are posed, each fragment is traced through both."""
    first = CageEdit(PART, fragments=0.35)
    around = PART.translate([0, 0, -0.9]).scale(1.6)
    edits = [first, CageEdit(around)]
    posed = [PART.translate([0, 0, -0.9]), around.translate([0.2, -3.0, 0.1])]
    deformer = Deformer(scene, edits, resolution=24).pose(posed)
    came, _, region = deformer.to_canonical(IN_NUB + [0.2, -3.0, -0.8], ALONG)
    np.testing.assert_array_equal(region, MAPPED)
    np.testing.assert_allclose(came, IN_NUB, atol=2e-6)
    for shift in ([0, 0, 0], [0, 0, -0.9]):
        region = deformer.to_canonical(IN_NUB + shift, ALONG)[2]
        assert (region == CLEARED).all()
    alone = Deformer(scene, first, resolution=24).pose(posed[0]).render(CAMERA)
    frame = Deformer(scene, [first, CageEdit(Cage.box([5, 5, 5], [6, 6, 6]))], resolution=24)
    np.testing.assert_allclose(frame.pose([posed[0], frame.edits[1].cage]).render(CAMERA).rgb, alone.rgb, atol=2e-3)


def test_copies_bring_their_fragments_and_removals_take_them(scene, device):
    copied = Deformer(scene, CageEdit(PART, keep_source=True, fragments=0.35), resolution=24)
    copied.pose(PART.translate([0, 0, -0.95]))
    assert (copied.to_canonical(IN_NUB, ALONG)[2] == UNCHANGED).all()
    assert (copied.to_canonical(IN_NUB - [0, 0, 0.95], ALONG)[2] == MAPPED).all()
    removed = CageEdit(PART, remove=True, fragments=0.35)
    frame = Deformer(scene, removed, resolution=24).render(CAMERA)
    left = field(BODY, SPECK, ([0.45, -0.1, 0.4], BEAM[1]), device=device).render(CAMERA)
    without = Deformer(scene, CageEdit(PART, remove=True), resolution=24).render(CAMERA)
    assert psnr(frame.rgb, left.rgb) > psnr(without.rgb, left.rgb) + 3


def test_a_band_that_fades_holds_fragments_at_its_walls_too(device):
    """A fragment at a wall that is held stays; one at another wall goes."""
    side = ([0.6, 0.2, -0.1], [0.7, 0.5, 0.0])  # out of the wall y = 0.4
    scene = field(INSIDE, NUB, side, device=device)
    top = [f for f, face in enumerate(PART.faces) if (PART.vertices[face][:, 2] > 0.39).all()]
    edit = CageEdit(PART, falloff=0.25, held=top, fragments=0.35)
    deformer = Deformer(scene, edit, resolution=32).pose(PART.translate([0, 0, -0.15]))
    came, _, region = deformer.to_canonical(IN_NUB, ALONG)
    np.testing.assert_array_equal(region, MAPPED)
    np.testing.assert_allclose(came, IN_NUB, atol=0.01)
    places = np.random.default_rng(1).uniform([0.61, 0.41, -0.09], [0.69, 0.49, -0.01], (50, 3))
    sunk = np.where(np.arange(3) == 2, 0.15 * (0.4 - places[:, 2:]) / 0.8, 0.0)  # the top of the cage is held
    came, _, region = deformer.to_canonical(places - sunk, places)
    np.testing.assert_array_equal(region, MAPPED)
    np.testing.assert_allclose(came, places, atol=1e-5)


def test_a_pose_without_a_place_for_fragments_says_so(scene):
    with pytest.warns(UserWarning, match=MESSAGES["deform.no_place"]):
        Deformer(scene, CageEdit(PART, fragments=0.35), resolution=16).pose(PART.taper(0.02))


def test_a_size_that_finds_no_fragments_changes_nothing(scene, recwarn):
    none = Deformer(scene, CageEdit(PART, fragments=0.05), resolution=16).pose(PART.translate([0, 0, -0.9]))
    plain = Deformer(scene, CageEdit(PART), resolution=16).pose(PART.translate([0, 0, -0.9]))
    np.testing.assert_array_equal(none.render(CAMERA).rgb, plain.render(CAMERA).rgb)
    assert not recwarn.list
    refused(lambda: CageEdit(PART, fragments=-0.1), match="fragments of an edit must be a size")


def test_the_old_name_is_taken_with_a_warning():
    with pytest.warns(UserWarning, match="crumbs= is fragments= now"):
        edit = CageEdit(PART, crumbs=0.25)
    with pytest.warns(UserWarning, match="CageEdit.crumbs is fragments now"):
        assert edit.crumbs == edit.fragments == 0.25


def test_what_was_never_seen_is_no_matter(scene):
    """Of a fitted field only what some picture showed counts: dark junk does not tie a fragment to something else."""
    weights = np.ones(scene.voxel_count, np.float32)
    x = nodes(40, scene.bounds).reshape(-1, 3)
    rows = scene.grid.links.numpy().reshape(-1)
    beam = (boxes(BEAM)(x) > 0) & (x[:, 2] > 0.55) & (rows >= 0)
    weights[rows[beam]] = 0.0
    grid = scene.grid
    weighed = VoxelField(scene.bounds, grid.links, grid.density, grid.sh, weights=weights, device=scene.device)
    assert len(fragment_voxels(weighed, PART, 0.35)) > len(fragment_voxels(scene, PART, 0.35))
