"""Precise mode: tables over cells must not change what the closed forms say, and one module is compiled once."""

import numpy as np
import oracles
import pytest
from fields import make_field, plain, shiny_field, view
from ground_truth import InverseMap

from warpcage import Cage, Deformer, PositionMap
from warpcage.core import load_modules, module_block_dim
from warpcage.kernels.edits import cell_tables as edit_cells
from warpcage.kernels.field import march as volume_march
from warpcage.kernels.field.march import image_kernel, record_weights
from warpcage.kernels.render.views import view_kernel


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_points_anywhere_are_where_float64_has_them(kind, device):
    vertices, faces = oracles.icosphere(1)
    rest = Cage(vertices, faces)
    posed = rest.twist(35).bend(25)
    field = make_field(lambda x: np.zeros(x.shape[:3]), plain((1, 1, 1)), device=device, resolution=8)
    points = np.random.default_rng(3).uniform(*(1.1 * posed.bounds), (4000, 3))
    deformer = Deformer(field, rest, coordinates=kind, resolution=None).pose(posed)
    back, _, region, outside = deformer.to_canonical(points, np.ones_like(points), return_outside=True)
    winding = oracles.winding_numbers(points, posed.vertices, posed.faces)
    rest_winding = oracles.winding_numbers(points, rest.vertices, rest.faces)
    inside = winding > 0.5
    mapped = InverseMap(rest, posed, kind, device=device)(points[inside])
    kept = region[inside] == 2
    assert np.abs(back[inside][kept] - mapped[kept]).max() < 2e-5 * rest.size
    # what is not mapped there leaves the rest cage, and only that
    stays = oracles.winding_numbers(mapped, rest.vertices, rest.faces) > 0.5
    assert (kept == stays).mean() > 0.999
    assert ((region[inside] == 1) == (outside[inside] == 1)).all()
    assert (region[~inside] == np.where(rest_winding[~inside] > 0.5, 1, 0)).mean() > 0.999


def test_cells_that_are_skipped_show_nothing(device):
    """The picture with the skips against one whose tables say nothing."""
    field = shiny_field(device)
    vertices, faces = oracles.icosphere(1)
    rest = Cage(1.4 * vertices, faces)
    deformer = Deformer(field, rest, coordinates="mean_value", resolution=None).pose(rest.twist(40))
    quick = deformer.render(view(size=32))
    for _, skip in deformer.posed_edits().guide.posed():
        assert (skip.numpy() > 0).mean() > 0.2
        skip.zero_()
    slow = deformer.render(view(size=32))
    assert np.abs(quick.rgb - slow.rgb).max() < 2e-4 and quick.alpha.max() > 0.9


def test_kernels_of_a_module_share_a_block_size_and_modules_load_together(device):
    assert module_block_dim(view_kernel(False, False)) == 64
    assert module_block_dim(image_kernel(False)) == module_block_dim(record_weights) == 128
    load_modules([edit_cells, volume_march, image_kernel(False)], device)
    rest = Cage(*oracles.icosphere(1))
    assert PositionMap(rest, resolution=16, device=device).pose(rest).data.distance.size > 0
