"""Steps, distances and sizes at the ends of what numbers hold: as exact as elsewhere, or refused in one line."""

import numpy as np
import pytest
from fields import BOX, KINDS, ellipsoid, make_field, nodes, plain, shiny_field, view
from messages import MESSAGES
from refusals import refused

from warpcage import (
    Cage,
    Camera,
    Deformer,
    PositionMap,
    VoxelField,
    deform_points,
    green_coordinates,
    harmonic_coordinates,
    mean_value_coordinates,
)

TURNED = BOX.twist(30)
POINTS = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
EYE = np.array([2.5, 1.2, 1.0]) / np.linalg.norm([2.5, 1.2, 1.0])


def scaled(cage, scale):
    return Cage(cage.vertices * scale, cage.faces)


def from_afar(distance, size=16):
    """A camera whose picture the object fills at any distance."""
    camera = Camera.look_at(distance * EYE, (0, 0, 0), width=size, height=size)
    return Camera(distance * size / 2, distance * size / 2, size / 2, size / 2, size, size, camera.camera_to_world)


@pytest.mark.parametrize("step", [1e-30, 1e-12, 1e-7, 5e-324])
def test_steps_that_would_not_end_are_refused(step, device):
    field = shiny_field(device)
    for scene in (field, Deformer(field, BOX, resolution=8, device=device)):
        with pytest.raises(ValueError, match=MESSAGES["core.step_at_least"]):
            scene.render(view(size=4), step=step)


def test_fine_steps_and_a_fields_own_are_taken(device):
    field = shiny_field(device)
    fine, usual = (field.render(view(size=8), step=step).alpha for step in (1e-4, None))
    assert np.abs(fine - usual).max() < 0.05
    bounds = [[-1, -1, -1e-5], [1, 1, 1e-5]]  # its own steps are shorter than those that callers may ask for
    flat = VoxelField.from_dense(np.ones((2, 2, 3)), np.zeros((2, 2, 3, 9, 3)), bounds, device=device)
    assert np.isfinite(flat.render(view((0, 0.1, 3), size=2)).alpha).all()


@pytest.mark.parametrize("kind", [*KINDS, "two"])
def test_cameras_far_away_see_what_near_ones_do_or_are_refused(kind, device):
    field = make_field(ellipsoid, plain((0.8, 0.4, 0.2)), device=device)
    edits, poses = ([BOX, BOX], [TURNED, TURNED]) if kind == "two" else (BOX, TURNED)
    coordinates = "green" if kind == "two" else kind
    deformer = Deformer(field, edits, resolution=16, coordinates=coordinates, device=device).pose(poses)
    for scene in (deformer, field):
        near = scene.render(from_afar(1e3)).alpha
        for distance in (1e4, 4e4):
            far = scene.render(from_afar(distance)).alpha
            assert np.isfinite(far).all() and np.abs(far - near).mean() < 0.02
        for distance in (1e6, 1e9, 1e30, 1e200):
            with pytest.raises(ValueError, match=MESSAGES["field.camera_too_far"]):
                scene.render(from_afar(distance))
    refused(lambda: Camera.look_at((1.7e308, 0, 0), (-1.7e308, 0, 0)), match=MESSAGES["view.look_at_places"])


def test_a_field_of_any_ordinary_unit_looks_the_same_to_the_bit(device):
    bounds, x = np.array([[-1, -1, -1], [1, 1, 1]]), nodes(24, [[-1, -1, -1], [1, 1, 1]])
    frames = []
    for scale in (1.0, 2.0**-29, 2.0**28):
        sh = np.broadcast_to(plain((0.8, 0.4, 0.2))(x), (24, 24, 24, 9, 3))
        field = VoxelField.from_dense(ellipsoid(x) / scale, sh, scale * bounds, device=device)
        camera = Camera.look_at(3 * scale * EYE, (0, 0, 0), width=16, height=16)
        deformer = Deformer(field, scaled(BOX, scale), resolution=12, coordinates="mean_value", device=device)
        frames.append([field.render(camera).rgb, deformer.pose(scaled(TURNED, scale)).render(camera).rgb])
    for found in frames[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(found, frames[0], strict=True))
    for scale in (1e30, 1e10, 1e-10, 1e-30):
        with pytest.raises(ValueError, match=MESSAGES["field.longest_side"]):
            VoxelField.from_dense(ellipsoid(x), sh, scale * bounds, device=device)
        with pytest.raises(ValueError, match=MESSAGES["lattice.longest_side"]):
            PositionMap(scaled(BOX, scale), resolution=8, device=device).pose(scaled(TURNED, scale))


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_coordinates_do_not_depend_on_the_unit(scale, device):
    cage = scaled(BOX, scale)
    for weights in (mean_value_coordinates, lambda *given, **options: green_coordinates(*given, **options)[0]):
        usual, other = weights(POINTS, BOX, device=device), weights(POINTS * scale, cage, device=device)
        assert np.abs(usual - other).max() < 1e-6
    for kind in ("mean_value", "green", "maximum_likelihood", "biharmonic"):
        usual = deform_points(POINTS, BOX, TURNED, kind, device=device)
        other = deform_points(POINTS * scale, cage, scaled(TURNED, scale), kind, device=device) / scale
        assert np.abs(usual - other).max() < 1e-6


@pytest.mark.parametrize("scale", [1e-300, 1e-50, 1e50, 1e150, 1e300, 8e307])
def test_cages_of_sizes_beyond_numbers_are_refused(scale, device):
    cage = scaled(BOX, scale)
    said = MESSAGES["cage.size_in_units"]
    for weights in (mean_value_coordinates, green_coordinates, harmonic_coordinates):
        with pytest.raises(ValueError, match=said):
            weights(POINTS * min(scale, 1e300), cage, device=device)
    for kind in ("mean_value", "green"):
        with pytest.raises(ValueError, match=said):
            deform_points(POINTS * min(scale, 1e300), cage, cage, kind, device=device)
    if scale > 1:
        refused(lambda: deform_points(POINTS, BOX, cage, "green", device=device), match="deformed cage has a size of")
    refused(cage.require_usable, match=said)


def test_points_beyond_numbers_are_refused(device):
    for place in (1e300, -1e300):
        with pytest.raises(ValueError, match="is 1000 times the cage's size away"):
            mean_value_coordinates([[place, 0, 0]], BOX, device=device)
        with pytest.raises(ValueError, match="1 of 1 points"):
            green_coordinates([[place, 0, 0]], BOX, device=device)


@pytest.mark.parametrize("factor", [1e4, 1e6])
def test_posed_cages_too_large_for_a_march_are_refused(factor, device):
    """A slip of the hand or of a number: the picture would take all day, and nothing could be seen in it."""
    field = shiny_field(device, resolution=16)
    deformer = Deformer(field, BOX, resolution=16).pose(BOX.scale(factor))
    refused(lambda: deformer.render(view(size=4)), match=MESSAGES["deform.posed_across"])
    assert np.isfinite(deformer.pose(BOX.scale(20.0)).render(view(size=4)).rgb).all()  # large, and yet drawn
