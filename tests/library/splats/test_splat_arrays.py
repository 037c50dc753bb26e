"""Splats of arrays as renderers have them, of any library, and arrays of splats."""

import numpy as np
import pytest
import warp as wp
from messages import MESSAGES
from refusals import refused
from scipy.spatial.transform import Rotation

from warpcage import SplatField

RANDOM = np.random.default_rng(0)
CENTERS = RANDOM.uniform(-1, 1, (20, 3)).astype(np.float32)
SCALES = RANDOM.uniform(0.01, 0.1, (20, 3))
TURNS = Rotation.random(20, rng=1)
OPACITIES = np.concatenate([[0.0, 1.0], RANDOM.uniform(0.1, 0.9, 18)])
HARMONICS = RANDOM.normal(size=(20, 4, 3)).astype(np.float32)
QUATERNIONS = np.roll(TURNS.as_quat(), 1, axis=1)


@pytest.mark.parametrize("rotations", [QUATERNIONS, 3.0 * QUATERNIONS, TURNS.as_matrix()])
@pytest.mark.parametrize("opacities", [OPACITIES, OPACITIES[:, None]])
def test_a_field_has_what_it_was_made_of(rotations, opacities, device):
    field = SplatField.from_arrays(CENTERS, SCALES, rotations, opacities, harmonics=HARMONICS, device=device)
    np.testing.assert_array_equal(field.centers, CENTERS)
    np.testing.assert_allclose(field.scales, SCALES, rtol=1e-6)
    np.testing.assert_allclose(field.opacities, OPACITIES, atol=1e-6)
    np.testing.assert_allclose(field.rotations, TURNS.as_matrix(), atol=1e-6)
    matrices = TURNS.as_matrix() * SCALES[:, None, :]
    np.testing.assert_allclose(field.covariances, matrices @ matrices.transpose(0, 2, 1), atol=1e-8)
    assert field.degree == 1


def test_colors_are_the_first_harmonic():
    colors = RANDOM.random((20, 3))
    field = SplatField.from_arrays(CENTERS, SCALES, None, OPACITIES, colors, device="cpu", background="white")
    np.testing.assert_allclose(0.5 + 0.28209479177387814 * field.contents.harmonics[:, 0], colors, atol=1e-6)
    np.testing.assert_allclose(field.rotations, np.broadcast_to(np.eye(3), (20, 3, 3)))
    assert field.degree == 0 and field.background.tolist() == [1, 1, 1]


def test_arrays_of_a_device_are_taken(device):
    arrays = [wp.array(each.astype(np.float32), device=device) for each in (CENTERS, SCALES, QUATERNIONS, OPACITIES)]
    field = SplatField.from_arrays(*arrays, harmonics=wp.array(HARMONICS, device=device), device=device)
    np.testing.assert_array_equal(field.contents.harmonics, HARMONICS)
    np.testing.assert_allclose(field.opacities, OPACITIES, atol=1e-6)


def test_the_optimizer_of_3dgs_holds_opacities_as_a_column():
    values = (CENTERS, np.log(SCALES), QUATERNIONS)
    logits = RANDOM.normal(size=20)
    one, two = (SplatField(*values, each, HARMONICS, device="cpu") for each in (logits, logits[:, None]))
    np.testing.assert_array_equal(one.contents.logits, two.contents.logits)
    with pytest.raises(ValueError, match=MESSAGES["splats.logits_of_others"]):
        SplatField(*values, np.repeat(logits[:, None], 2, axis=1), HARMONICS, device="cpu")


def test_a_field_of_none_is_one():
    empty = SplatField.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), [], np.zeros((0, 3)))
    assert len(empty) == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"scales": np.log(SCALES)}, "scales must be above 0: standard"),
        ({"opacities": 5.0 * OPACITIES}, "opacities must be in .0, 1.: not"),
        ({"opacities": np.full(20, np.nan)}, "opacities must be in"),
        ({"opacities": OPACITIES[:5]}, "logits of 20 splats"),
        ({"rotations": np.full((20, 3, 3), 0.5)}, "rotations must be quaternions"),
        ({"rotations": TURNS.as_matrix()[:, :2]}, "rotations must be quaternions"),
        ({"colors": CENTERS}, "give one of them"),
        ({"harmonics": None}, "give one of them"),
        ({"centers": np.zeros(3)}, "centers must be .n, 3."),
        ({"centers": "abc"}, "centers must be real numbers"),
        ({"scales": None}, "scales must be real numbers"),
    ],
)
def test_other_values_are_told(changed, message):
    values = {"centers": CENTERS, "scales": SCALES, "rotations": QUATERNIONS, "opacities": OPACITIES}
    refused(lambda: SplatField.from_arrays(**values | {"harmonics": HARMONICS} | changed, device="cpu"), match=message)
