"""Baked fields against the scenes they were resampled from."""

import inspect

import field_oracles as oracle
import numpy as np
import pytest
from field_oracles import random_background
from fields import BOX, KINDS, ellipsoid, make_field, plain, psnr, rotation, shiny_field, view
from refusals import refused

from warpcage import Cage, CageEdit, Deformer, VoxelField, bake


def voxel_centers(field):
    """World positions (n, 3) of voxels that hold values, without those at the border, where a sample may lie beside."""
    nodes = np.argwhere(field.grid.links.numpy()[1:-1, 1:-1, 1:-1] >= 0) + 1
    return field.bounds[0] + (nodes + 0.5) * field.voxel_size


def unit_directions(count, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", KINDS)
def test_voxels_hold_what_a_turned_scene_shows(kind, device):
    """Colours at the voxels themselves, where no interpolation of the new field takes part: SH turn exactly."""
    turn, offset = rotation(40, 65), np.array([0.1, -0.05, 0.15])
    source = shiny_field(device)
    pose = BOX.with_vertices(BOX.vertices @ turn.T + offset)
    baked = bake(Deformer(source, BOX, coordinates=kind, resolution=32).pose(pose))
    points = voxel_centers(baked)
    directions = unit_directions(len(points))
    rgb, density = baked.sample(points, directions)
    back = (points - offset) @ turn
    inside = (np.abs(back) < np.array([0.74, 0.54, 0.39])).all(axis=1)
    assert inside.sum() > 4000
    expected_rgb, expected_density = source.sample(back, directions @ turn)
    np.testing.assert_allclose(rgb[inside], expected_rgb[inside], atol=5e-3)
    np.testing.assert_allclose(density[inside], expected_density[inside], atol=0.02)
    unturned, _ = source.sample(back, directions)
    assert np.abs(rgb[inside] - unturned[inside]).mean() > 0.1  # the scene is shiny enough to tell


@pytest.mark.parametrize("density", ["opacity", "paper"])
def test_density_follows_the_deformer(density, device):
    """A ball of twice the size keeps its opacity, so half its density, or its density."""
    source = make_field(
        lambda x: ellipsoid(x, radii=(0.35, 0.35, 0.35), sigma=4.0), plain([0.2, 0.5, 0.7]), device=device
    )
    cage = Cage.box([-0.6] * 3, [0.6] * 3)
    deformer = Deformer(source, cage, coordinates="mean_value", resolution=32, density=density)
    baked = bake(deformer.pose(cage.scale(2.0, center=(0, 0, 0))))
    middle = np.zeros((1, 3))
    expected = 4.0 * (0.5 if density == "opacity" else 1.0)
    assert baked.sample(middle, [[0, 0, 1.0]])[1][0] == pytest.approx(expected, rel=1e-3)
    assert psnr(baked.render(view()).rgb, deformer.render(view()).rgb) > 40


@pytest.mark.parametrize("format", ["warpcage", "svox2"])
def test_a_bent_scene_baked_and_saved_looks_like_the_live_one(format, device, tmp_path):
    source, camera = shiny_field(device), view()
    live = Deformer(source, BOX, resolution=48).pose(BOX.bend(60, axis="x", towards="z"))
    baked = bake(live)
    frame = live.render(camera)
    assert psnr(baked.render(camera).rgb, frame.rgb) > 32
    assert psnr(source.render(camera).rgb, frame.rgb) < 25
    finer = bake(live, resolution=int(1.5 * max(baked.resolution)), bounds=baked.bounds)
    assert psnr(finer.render(camera).rgb, frame.rgb) > psnr(baked.render(camera).rgb, frame.rgb) + 2
    path = tmp_path / "bent.npz"
    baked.save(path, format=format)
    read = VoxelField.load(path, device=device)
    assert psnr(read.render(camera).rgb, baked.render(camera).rgb) > 50


@oracle.both_kinds
def test_baked_harmonics_are_turned(numbers, device):
    """One colour of all degrees everywhere: a turned cage shows it from the other side."""
    sh = np.random.default_rng(0).normal(0, 0.3, numbers)
    links = np.arange(24**3, dtype=np.int32).reshape(24, 24, 24)
    field = VoxelField(
        [[-1] * 3, [1] * 3], links, np.full(links.size, 3.0), np.broadcast_to(sh, (links.size, *numbers)), device=device
    )
    box = Cage.box([-0.7] * 3, [0.7] * 3)
    turn = rotation(40, 73)
    baked = bake(Deformer(field, box, resolution=32).pose(box.with_vertices(box.vertices @ turn.T)))
    d = np.random.default_rng(1).normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    points = np.random.default_rng(2).uniform(-0.3, 0.3, (200, 3))
    expected = np.maximum(oracle.colors(np.broadcast_to(sh, (200, *numbers)), d @ turn), 0)
    np.testing.assert_allclose(baked.sample(points, d)[0], expected, atol=2e-3)
    np.testing.assert_allclose(baked.sample(10 * points + 9, d)[1], 0)


def test_edits_and_what_is_not_deformed_are_baked_too(device):
    def balls(*centers):
        return make_field(
            lambda x: sum(ellipsoid(x, c, (0.2, 0.2, 0.2)) for c in centers), plain([0.8, 0.3, 0.1]), device=device
        )

    left, right = (Cage.box([x - 0.34, -0.34, -0.34], [x + 0.34, 0.34, 0.34]) for x in (-0.6, 0.6))
    edits = [CageEdit(left, keep_source=True), CageEdit(right, remove=True)]
    deformer = Deformer(balls((-0.6, 0, 0), (0.6, 0, 0), (0, 0.6, 0)), edits, resolution=24)
    baked = bake(deformer.pose([left.translate([0, 0, 0.6]), None]))
    expected = balls((-0.6, 0, 0), (0, 0.6, 0), (-0.6, 0, 0.6)).render(view())
    assert psnr(baked.render(view()).rgb, expected.rgb) > 35
    assert baked.bounds[1][0] < 0.35 and baked.bounds[1][2] > 0.8  # as large as what there is


def test_a_deformer_without_lattice_is_baked_from_one(device):
    source, cage = shiny_field(device, resolution=24), Cage.box(*BOX.bounds)
    precise, lattice = (
        bake(Deformer(source, cage, coordinates="mean_value", resolution=cells).pose(cage.twist(30, axis="x")))
        for cells in (None, 128)
    )
    np.testing.assert_array_equal(precise.grid.density.numpy(), lattice.grid.density.numpy())


def test_a_baked_field_is_viewed_as_its_source(device):
    """What the constructor takes besides voxels, each other than its default, and a view that depends on it."""
    layers = random_background(device, center=(0, 0, 0), half=3.0)[0]
    plain_source = shiny_field(device)
    grid = plain_source.grid
    given = {"background": (0.1, 0.2, 0.3), "background_model": layers, "up": (0.0, 0.6, 0.8), "supersampling": 2}
    given["straightening"] = [[0, -1, 0, 2], [1, 0, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]]
    assert set(given) == set(inspect.signature(VoxelField).parameters) - {
        "bounds",
        "links",
        "density",
        "sh",
        "weights",
        "device",
    }
    source = VoxelField(plain_source.bounds, grid.links, grid.density, grid.sh, **given, device=device)
    live = Deformer(source, BOX, coordinates="mean_value", resolution=32).pose(BOX.translate([0.1, 0, 0]))
    baked = bake(live)
    np.testing.assert_allclose(baked.background, given["background"], atol=1e-6)
    assert baked.background_model is layers and baked.supersampling == 2
    np.testing.assert_array_equal(baked.up, source.up)
    np.testing.assert_array_equal(baked.straightening, given["straightening"])
    camera = view(size=24)
    expected = live.render(camera).rgb
    like, single = (psnr(baked.render(camera, supersampling=side).rgb, expected) for side in (None, 1))
    assert like > 35 and like > single + 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 1}, "resolution must be"),
        ({"resolution": 20.5}, "resolution must be"),
        ({"bounds": [[0, 0, 0], [1, 1, 0]]}, "bounds must be"),
        ({"bounds": [[0, 0, 0], [1, 1, np.nan]]}, "bounds must be"),
        ({"bounds": [[5, 5, 5], [6, 6, 6]]}, "nothing to bake"),
    ],
)
def test_bad_input_is_refused(options, message):
    deformer = Deformer(shiny_field(None, resolution=8), BOX, resolution=8)
    refused(lambda: bake(deformer, **options), match=message)
    refused(lambda: bake(deformer.field), match="needs a Deformer")
