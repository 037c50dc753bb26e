"""Lattice, closed forms and baked field agree on a field of real pictures."""

import pytest
from fields import psnr

import warpcage

pytestmark = pytest.mark.nightly  # by day on fields that are made for it, in tests/library/deform


@pytest.fixture(scope="module")
def bent(lego):
    """A cage around it with rings to bend, at rest and bent, and a camera."""
    lower, upper = lego.bounds
    middle, half = lego.center, 0.55 * (upper - lower)
    cage = warpcage.Cage.box(middle - half, middle + half, segments=(1, 3, 1))
    camera = warpcage.turntable(middle, 4.03, 30, 1, fov_degrees=39.6, width=80, height=80, start_degrees=30)[0]
    return cage, cage.bend(45, axis="y", towards="z"), camera


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_a_lattice_of_128_cells_stands_for_the_closed_form(kind, lego, bent):
    cage, pose, camera = bent
    precise, lattice = (
        warpcage.Deformer(lego, cage, coordinates=kind, resolution=resolution).pose(pose).render(camera)
        for resolution in (None, 128)
    )
    assert psnr(precise.rgb, lattice.rgb) > 40
    assert psnr(precise.rgb, lego.render(camera).rgb) < 20  # the bend shows


def test_stored_weights_show_the_same_lego(lego, bent):
    cage, pose, camera = bent
    frames = [warpcage.Deformer(lego, cage, resolution=40, store=store).pose(pose).render(camera)
              for store in ("map", "weights")]  # fmt: skip
    assert psnr(frames[0].rgb, frames[1].rgb) > 60


def test_a_baked_lego_looks_like_the_live_one(lego, bent):
    cage, pose, camera = bent
    live = warpcage.Deformer(lego, cage, resolution=64).pose(pose)
    assert psnr(warpcage.bake(live).render(camera).rgb, live.render(camera).rgb) > 32
