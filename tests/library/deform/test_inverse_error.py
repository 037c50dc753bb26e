"""How far apart the forward map of splats and the backward map of voxels are, as a Deformer says it."""

import numpy as np
import oracles
import pytest
from fields import BOX, KINDS, rotation, shiny_field
from refusals import refused
from splat_scenes import one_splat, splats_in_box

from warpcage import CageEdit, Deformer

TURN = rotation(35, 20)
AFFINE = BOX.with_vertices(1.3 * BOX.vertices @ TURN.T + [0.1, -0.2, 0.3])
BENT = BOX.bend(50, axis="x", towards="z")


@pytest.mark.parametrize("kind", KINDS)
def test_similarities_have_inverses(kind, device):
    """Which all three kinds reproduce."""
    points, errors = Deformer(one_splat(device), BOX, coordinates=kind, resolution=48).pose(AFFINE).inverse_error()
    assert len(points) > 1000 and AFFINE.contains(points).all()
    assert np.nanmax(errors) < 3e-4 * BOX.size and np.isfinite(errors).mean() > 0.8


def test_bends_have_none(device):
    """By the float64 formula of mean value coordinates, there and back."""
    deformer = Deformer(shiny_field(device, resolution=8), BOX, coordinates="mean_value", resolution=16).pose(BENT)
    points, errors = deformer.inverse_error()
    back = oracles.mean_value_weights(points, BENT.vertices, BENT.faces) @ BOX.vertices
    there = oracles.mean_value_weights(back, BOX.vertices, BOX.faces) @ BENT.vertices
    inside = BOX.contains(back)
    expected = np.linalg.norm(there - points, axis=1)
    np.testing.assert_allclose(errors[inside], expected[inside], atol=2e-5)
    assert np.isnan(errors[~inside]).all()
    assert 5e-4 < np.nanmedian(errors) / BOX.size < 1e-2


@pytest.mark.parametrize("kind", ["harmonic", "mean_value"])
def test_it_is_how_far_splats_move_between_the_two_maps(kind, device):
    """A splat that `map="backward"` puts at y, and the forward map elsewhere: by the error at y."""
    field = splats_in_box(device, count=60, half=0.3)
    centers = {}
    for map in ("forward", "backward"):
        deformer = Deformer(field, BOX, coordinates=kind, resolution=64, map=map).pose(BENT)
        centers[map] = deformer.baked().contents.centers[: field.splat_count]
    if len(centers["forward"]) != len(centers["backward"]):
        pytest.fail("a splat was split")
    _, errors = deformer.inverse_error(centers["backward"])
    apart = np.linalg.norm(centers["forward"] - centers["backward"], axis=1)
    assert np.median(apart) > 1e-3
    np.testing.assert_allclose(errors, apart, atol=0.05 * np.median(apart) + 2e-4)


def test_before_a_pose_and_of_several_edits(device):
    field = shiny_field(device, resolution=8)
    points, errors = Deformer(field, BOX, coordinates="mean_value", resolution=16).inverse_error([[0, 0, 0], [2, 0, 0]])
    assert points.shape == (2, 3) and errors[0] < 1e-5 and np.isnan(errors[1])
    edits = [CageEdit(BOX), CageEdit(BOX.scale(0.5), remove=True)]
    several = Deformer(field, edits, coordinates="mean_value", resolution=16)
    assert several.pose([BENT, None]).inverse_error([[0, 0, 0.1]])[1].shape == (1,)
    refused(lambda: several.inverse_error(edit=1), match="edit 1 removes")
    refused(lambda: several.inverse_error(edit=2), match="edit must be a whole number from 0 to 1")
    refused(lambda: several.inverse_error([[np.nan, 0, 0]]), match="points must be finite, row 0")
