"""Small pieces that a cage cuts off a part go away with it."""

import numpy as np
import pytest
from deformed_scenes import make_field, nodes, plain, psnr

from warpcage.cage.cage import Cage
from warpcage.deform.crumbs import crumbs, without_crumbs
from warpcage.deform.deformer import Deformer
from warpcage.deform.edits import CageEdit
from warpcage.field.voxel_field import VoxelField
from warpcage.view.camera import Camera

PART = Cage.box([0.0, -0.4, -0.4], [0.8, 0.4, 0.4])
CAMERA = Camera.look_at([1.0, -4.0, 1.5], (0, 0, 0), width=48, height=48, fov_degrees=35)


def boxes(*corners):
    """Matter in boxes given by their corners."""
    return lambda x: 40.0 * sum(((x > low) & (x < high)).all(axis=-1) for low, high in corners).clip(0, 1)


BODY = ([-0.9, -0.3, -0.3], [-0.2, 0.3, 0.3])  # beside the cage
INSIDE = ([0.1, -0.3, -0.3], [0.7, 0.3, 0.3])
NUB = ([0.2, -0.1, 0.2], [0.3, 0.0, 0.5])  # out of the cage by a little
BEAM = ([0.45, -0.1, 0.2], [0.6, 0.1, 0.9])  # out of the cage by much
SPECK = ([0.2, 0.2, 0.6], [0.3, 0.3, 0.7])  # small, but the cage cuts nothing off there


def field(*corners, device=None):
    return make_field(boxes(*corners), plain([0.8, 0.3, 0.1]), device=device)


@pytest.fixture
def scene(device):
    return field(BODY, INSIDE, NUB, BEAM, SPECK, device=device)


def test_crumbs_are_what_the_wall_cuts_off_and_is_small(scene):
    found = crumbs(scene, PART, 0.35)
    x = nodes(40, scene.bounds)
    expected = boxes(NUB)(x) > 0
    expected &= x[..., 2] > 0.4
    dense = scene.node_densities()[tuple(found.T)] > 0
    np.testing.assert_array_equal(found[dense], np.argwhere(expected))
    assert len(crumbs(scene, PART, 0.1)) == 0
    both = crumbs(scene, PART, 0.9)
    assert len(both) > len(found) and (both[:, 2] > 27).all()  # the beam too, the speck never
    speck = (np.array(SPECK[0]) + SPECK[1]) / 2
    assert np.linalg.norm(scene.bounds[0] + (both + 0.5) * 0.05 - speck, axis=1).min() > 0.08
    assert len(crumbs(scene, PART.translate([9, 0, 0]), 0.5)) == 0


def test_the_part_goes_with_its_crumbs(scene, device):
    removed = CageEdit(PART, remove=True, crumbs=0.35)
    frame = Deformer(scene, removed, resolution=24).render(CAMERA)
    beam = (BEAM[0], BEAM[1])
    left = field(BODY, SPECK, ([0.45, -0.1, 0.4], beam[1]), device=device)
    without = Deformer(scene, CageEdit(PART, remove=True), resolution=24).render(CAMERA)
    assert psnr(frame.rgb, left.render(CAMERA).rgb) > psnr(without.rgb, left.render(CAMERA).rgb) + 3
    moved = Deformer(scene, CageEdit(PART, crumbs=0.35), resolution=24).pose(PART.translate([0, 0, -0.9]))
    nub = np.array([[0.25, -0.05, 0.45]])
    assert moved.field.sample(nub, nub)[1][0] == 0.0 < scene.sample(nub, nub)[1][0]
    assert scene.voxel_count == moved.field.voxel_count  # rows are shared


def test_a_copy_keeps_its_crumbs_and_fields_without_them_are_the_same(scene):
    for edit in (CageEdit(PART, keep_source=True, crumbs=0.35), CageEdit(PART), CageEdit(PART, crumbs=0.05)):
        assert without_crumbs(scene, [edit]) is scene
    with pytest.raises(ValueError, match="crumbs of an edit must be a size"):
        CageEdit(PART, crumbs=-0.1)


def test_what_was_never_seen_is_no_matter(scene):
    """Of a fitted field only what some picture showed counts: dark junk does not tie a crumb to something else."""
    weights = np.ones(scene.voxel_count, np.float32)
    x = nodes(40, scene.bounds).reshape(-1, 3)
    rows = scene.grid.links.numpy().reshape(-1)
    beam = (boxes(BEAM)(x) > 0) & (x[:, 2] > 0.55) & (rows >= 0)
    weights[rows[beam]] = 0.0
    grid = scene.grid
    weighed = VoxelField(scene.bounds, grid.links, grid.density, grid.sh, weights=weights, device=scene.device)
    assert len(crumbs(weighed, PART, 0.35)) > len(crumbs(scene, PART, 0.35))
