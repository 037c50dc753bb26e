"""Fine cells of lattices that a march may skip: their bytes against NumPy, and pictures with and without them."""

import functools
import math

import numpy as np
import pytest
from fields import BOX, box_around, make_field, plain, shiny_field, slotted, two_balls, use_march, view

from warpcage import Cage, CageEdit, Deformer
from warpcage.kernels.edits.fine_cells import FINE_FAR, FINE_SIDE
from warpcage.kernels.edits.structs import CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, LOOK_SKIP
from warpcage.render import tables

SKIP, SIDE = int(LOOK_SKIP), int(FINE_SIDE)

#: Cells of lattices of BOX: some five voxels of the fields wide.
CELLS = 10

SLAB = Cage.box([-0.3, -0.9, -0.9], [0.9, 0.9, 0.9], segments=2)
CASES = {
    "bend": (BOX, BOX.bend(70, axis="x", towards="z"), {}),
    "twist that folds": (BOX, BOX.twist(230, axis="x"), {}),
    "squeeze": (BOX, BOX.scale([0.2, 1.3, 1.0]).translate([0.2, 0, 0.1]), {}),
    "flat": (BOX, BOX.scale([0.04, 1.3, 1.0]).rotate(35, axis="y").rotate(20), {}),
    "away": (BOX, BOX.rotate(30).translate([0.4, 0.5, 0.2]), {}),
    "grown": (BOX, BOX.scale(2.5), {}),
    "part of it": (SLAB, SLAB.rotate(25, axis="x").translate([0.1, 0, 0.2]), {}),
    "part of it, kept": (SLAB, SLAB.rotate(25, axis="x").translate([0.5, 0, 0.2]), {"keep_source": True}),
    "part of it, removed": (SLAB, None, {"remove": True}),
    "narrow slot": (slotted(0.3), slotted(0.02), {}),
    "falloff": (SLAB, SLAB.rotate(15, axis="x"), {"falloff": 0.3}),
}


MARCHES = ("rows", "shaded")  # those that know fine cells
UP = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def finest():
    """A field on a device, made once."""
    return functools.cache(lambda device: shiny_field(device, resolution=64))


def table(edit):
    """(nx, ny, nz) bytes of an edit's fine cells, those of all cells along each axis one after the other."""
    counts = tuple(edit.node_counts)
    assert 1 << edit.fine_bits == SIDE
    cells = edit.fine_look.numpy().reshape(*counts, SIDE, SIDE, SIDE)[:-1, :-1, :-1]
    return cells.transpose(0, 3, 1, 4, 2, 5).reshape([SIDE * (n - 1) for n in counts])


def posed(field, rest, pose, monkeypatch, **options):
    """A Deformer that has rendered, and the edits that it marches."""
    use_march("rows", str(field.device), monkeypatch)
    deformer = Deformer(field, CageEdit(rest, **options), resolution=CELLS).pose(pose)
    deformer.render(view(size=8))
    return deformer, deformer.posed_edits().tables.edits


def chebyshev(occupied, limit):
    """How far each cell is from an occupied one, or `limit`."""
    near, distance = occupied.copy(), np.where(occupied, 0, limit)
    for step in range(1, limit):
        for axis in range(3):
            moved = np.zeros((2, *near.shape), bool)
            ahead, behind = [slice(None)] * 3, [slice(None)] * 3
            ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
            moved[0][tuple(ahead)], moved[1][tuple(behind)] = near[tuple(behind)], near[tuple(ahead)]
            near = near | moved[0] | moved[1]
        distance = np.where(near & (distance == limit), step, distance)
    return distance


def asked(deformer, points):
    """Canonical positions, regions and whether outside, of points at which a direction does not matter."""
    canonical, _, region, outside = deformer.to_canonical(points, np.tile(UP, (len(points), 1)), return_outside=True)
    return canonical, region, outside


@pytest.mark.parametrize("case", CASES)
def test_fine_cells_are_what_random_places_in_them_say(case, finest, device, monkeypatch):
    """By to_canonical and field.sample: nothing is skipped that holds matter, flags hold, distances are exact."""
    rest, pose, options = CASES[case]
    field = finest(device)
    deformer, (edit,) = posed(field, rest, pose, monkeypatch, **options)
    fine_look = table(edit)
    places = np.random.default_rng(1).uniform(0, 1, (40_000, 3)) * fine_look.shape
    points = field.center + np.array(edit.lower) + places / SIDE * edit.spacing
    canonical, region, outside = asked(deformer, points)
    found = fine_look[tuple(places.astype(int).T)]
    density, uncovered = (field.sample(at, np.tile(UP, (len(at), 1)))[1] for at in (canonical, points))
    # a place within rounding of the next fine cell may be taken for one in it
    holds = (np.where(region == 1, uncovered, density) > 1e-2) | (outside == 1)
    assert holds.sum() > 300
    assert (found[holds] < SKIP).all()
    assert (found >= SKIP).mean() > 0.2

    looked = found < SKIP
    found, region, outside = found[looked], region[looked], outside[looked]
    is_mapped = (region == 2) | (outside == 1)
    for flag, holds in ((CELL_INSIDE, is_mapped), (CELL_OUTSIDE, ~is_mapped), (CELL_STAYS, outside == 0)):
        flagged = (found & int(flag)) != 0
        assert flagged.any() or case not in ("bend", "squeeze", "part of it")
        assert holds[flagged].sum() >= 0.9999 * flagged.sum()
    cleared = (found & int(CELL_OUTSIDE)) * (found & int(CELL_STAYS)) != 0
    if not options.get("keep_source"):
        assert (region[cleared] == 1).all()
    if case == "bend":  # most of what the pose has left is known for that
        assert cleared.sum() > 0.4 * ((region == 1) & (found & int(CELL_OUTSIDE) != 0)).sum() > 40

    exact, found = chebyshev(fine_look < SKIP, 60), fine_look.astype(int) - SKIP
    near = (exact > 0) & (exact < int(FINE_FAR))
    assert near.sum() > 100
    assert np.array_equal(found[near], exact[near])
    far = exact >= int(FINE_FAR)
    assert far.any()
    assert (found[far] >= int(FINE_FAR)).all() and (found[far] <= exact[far]).all()


def test_most_of_what_is_empty_is_skipped(device, monkeypatch):
    """A fine cell next to which nothing is, is not looked at: of a ball in a still cage by geometry."""
    field = make_field(
        lambda x: 30.0 * (np.linalg.norm(x, axis=-1) < 0.3), plain([0.5, 0.5, 0.5]), device=device, resolution=64
    )
    _, (edit,) = posed(field, BOX, BOX, monkeypatch)
    fine_look = table(edit)
    middles = np.stack(np.indices(fine_look.shape), axis=-1) + 0.5
    away = np.linalg.norm(np.array(edit.lower) + middles / SIDE * edit.spacing, axis=-1)
    half = 0.5 * math.sqrt(3) * edit.spacing / SIDE
    voxel = math.sqrt(3) * field.voxel_size[0]
    assert (fine_look[away < 0.3 - voxel - half] < SKIP).all()
    assert (fine_look[away > 0.3 + 2 * voxel + 2 * half] >= SKIP).all()


def frames(deformer, monkeypatch, camera):
    """The same frame without and with fine cells."""
    with monkeypatch.context() as patch:
        patch.setattr(tables, "MIN_VOXELS", math.inf)
        whole = deformer.pose(deformer.deformed).render(camera)
        assert all(flat.fine_bits == 0 for flat in deformer.posed_edits().tables.edits)
    fine = deformer.pose(deformer.deformed).render(camera)
    return whole, fine


def alike(whole, fine):
    for name in ("rgb", "alpha", "reveal", "fold", "outside"):
        assert np.allclose(getattr(fine, name), getattr(whole, name), atol=2e-5), name


@pytest.mark.parametrize(
    ("march", "density", "eye"),
    [
        ("rows", "opacity", (2.5, 1.2, 1.0)),
        ("shaded", "paper", (-0.3, -2.6, 0.4)),
        pytest.param("rows", "paper", (-0.3, -2.6, 0.4), marks=pytest.mark.nightly),
        pytest.param("shaded", "opacity", (2.5, 1.2, 1.0), marks=pytest.mark.nightly),
    ],
)
@pytest.mark.parametrize("case", CASES)
def test_pictures_are_those_without_fine_cells(case, march, density, eye, finest, device, monkeypatch):
    use_march(march, device, monkeypatch)
    rest, pose, options = CASES[case]
    deformer = Deformer(finest(device), CageEdit(rest, **options), resolution=CELLS, density=density).pose(pose)
    whole, fine = frames(deformer, monkeypatch, view(eye, size=44))
    assert all(1 << flat.fine_bits == SIDE for flat in deformer.posed_edits().tables.edits)
    alike(whole, fine)
    assert fine.alpha.max() > 0.5


@pytest.mark.parametrize("march", MARCHES)
def test_pictures_of_several_edits_are_those_without_fine_cells(march, device, monkeypatch):
    use_march(march, device, monkeypatch)
    cages = [box_around(x, 0, 0, half=0.45) for x in (-0.5, 0.5)]
    deformer = Deformer(two_balls(device), cages, resolution=8)
    deformer.pose([cages[0].rotate(40, axis="x"), cages[1].scale([1.0, 0.7, 0.7])])
    for eye in ((2.5, 1.2, 1.0), (0.1, -2.6, 0.4)):
        whole, fine = frames(deformer, monkeypatch, view(eye, size=44))
        assert [1 << flat.fine_bits for flat in deformer.posed_edits().tables.edits] == [SIDE, SIDE]
        alike(whole, fine)


@pytest.mark.parametrize("march", MARCHES)
def test_follow_the_pose_and_the_matter(march, device, monkeypatch):
    """Another pose, and matter where none was, are seen as by a Deformer that knows nothing else."""
    use_march(march, device, monkeypatch)
    field, camera = shiny_field(device, resolution=64), view(size=32)
    deformer = Deformer(field, BOX, resolution=CELLS).pose(BOX)
    deformer.render(camera)
    for degrees in (40, 0):
        pose = BOX.rotate(degrees)
        later = deformer.pose(pose).render(camera)
        assert np.array_equal(later.rgb, Deformer(field, BOX, resolution=CELLS).pose(pose).render(camera).rgb)
    density = field.grid.density.numpy()
    field.grid.density.assign(np.where(np.arange(len(density)) % 3 == 0, -1.0, density + 1.0).astype(np.float32))
    later = deformer.render(camera)
    assert np.array_equal(later.rgb, Deformer(field, BOX, resolution=CELLS).pose(BOX.rotate(0)).render(camera).rgb)


def test_cells_as_small_as_voxels_are_not_told_apart(device):
    deformer = Deformer(shiny_field(device, resolution=16), BOX, resolution=24).pose(BOX)
    deformer.render(view(size=8))
    (edit,) = deformer.posed_edits().tables.edits
    assert edit.fine_bits == 0 and edit.fine_width == 1.0 and edit.fine_look.ptr == edit.look.ptr
