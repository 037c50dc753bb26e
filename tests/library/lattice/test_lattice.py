"""CageLattice: which nodes are inside, and the signed distance near the cage."""

import numpy as np
import oracles
import pytest
import trimesh
from oracles import reference_distance
from refusals import refused

from warpcage import Cage
from warpcage.lattice import BLOCK_FACES, LINE_CAPACITY, CageLattice
from warpcage.lattice import lattice as block_faces


def nodes_of(lattice):
    index = np.stack(np.meshgrid(*[np.arange(side) for side in lattice.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    return lattice.lower + index * lattice.spacing


def picket_fence(count=9):
    """A row of thin boxes: a line along x crosses two faces of each."""
    vertices, faces = oracles.cage("box")
    parts = [vertices * [0.4 / count, 1, 1] + [i / count, 0, 0] for i in range(count)]
    return Cage(np.concatenate(parts), np.concatenate([faces + 8 * i for i in range(count)]))


def named_cage(name):
    if name == "fence":
        return picket_fence()
    if name == "bent":
        return Cage(*oracles.cage("fine icosphere")).stretch(3).bend(150)
    return Cage(*oracles.cage(name))


@pytest.mark.parametrize("name", ["icosphere", "box", "concave", "two boxes", "fence", "bent"])
def test_inside_and_distance_at_nodes(name, device):
    cage = named_cage(name)
    lattice = CageLattice(cage, 16, device=device).measure()
    distance = lattice.distance.numpy().reshape(-1).astype(float)
    nodes = nodes_of(lattice)
    inside = oracles.winding_numbers(nodes, cage.vertices, cage.faces) > 0.5
    assert np.array_equal(distance < 0, inside)
    expected = np.minimum(reference_distance(nodes, cage.vertices, cage.faces), 4 * lattice.spacing)
    assert np.abs(np.abs(distance) - expected).max() < 2e-6 * cage.size


def test_cells_are_cubes_along_the_longest_side_with_a_margin(device):
    cage = Cage.box((0, 0, 0), (1, 2, 4))
    lattice = CageLattice(cage, 40, device=device).measure()
    assert lattice.spacing == pytest.approx(0.1, rel=1e-6)
    upper = lattice.lower + (np.array(lattice.shape) - 1) * lattice.spacing
    assert np.all(cage.bounds[0] - lattice.lower >= 2 * lattice.spacing)
    assert np.all(upper - cage.bounds[1] >= 2 * lattice.spacing)
    assert np.all(upper - cage.bounds[1] <= 5 * lattice.spacing)
    assert lattice.shape == lattice.distance.shape


def test_lines_with_many_crossings_make_room(device):
    cage = picket_fence(2 * LINE_CAPACITY)
    lattice = CageLattice(cage, 100, device=device).measure()
    assert lattice.crossings.counts.numpy().max() == 4 * LINE_CAPACITY
    share = (lattice.distance.numpy() < 0).sum() * lattice.spacing**3 / cage.volume
    assert share == pytest.approx(1.0, abs=0.05)


def test_crossings_alternate_and_lie_on_the_cage(device):
    cage = Cage(*oracles.cage("concave"))
    lattice = CageLattice(cage, 20, device=device).measure()
    counts, places = lattice.crossings.counts.numpy(), lattice.crossings.places.numpy()
    assert (counts % 2 == 0).all() and counts.max() == 2
    nx, ny, nz = lattice.shape
    lines = ny * nz + nx * nz + np.arange(nx * ny)
    points = [
        lattice.lower + lattice.spacing * np.array([line // ny, line % ny, places[lines[line], n]])
        for line in range(nx * ny)
        for n in range(counts[lines[line]])
    ]
    assert len(points) > 100
    assert reference_distance(np.array(points), cage.vertices, cage.faces).max() < 1e-6


def test_overlapping_parts_count_once_and_cavities_are_outside(device):
    big, small = Cage.box((-1, -1, -1), (1, 1, 1)), Cage.box((0, 0, 0), (0.5, 0.5, 0.5))
    vertices = np.concatenate([big.vertices, small.vertices])
    overlap = Cage(vertices, np.concatenate([big.faces, small.faces + 8]))
    cavity = Cage(vertices, np.concatenate([big.faces, small.faces[:, ::-1] + 8]))
    for cage, volume in ((overlap, 8.0), (cavity, 8.0 - 0.125)):
        lattice = CageLattice(cage, 24, device=device).measure()
        inside = (lattice.distance.numpy() < 0).sum() * lattice.spacing**3
        assert inside == pytest.approx(volume, rel=0.01)
    counts = CageLattice(overlap, 32, device=device).measure().crossings.counts.numpy()
    assert counts.max() == 2


@pytest.mark.parametrize("resolution", [7, 1025, 0, -3, 16.5, "64", True])
def test_resolutions_out_of_range_are_refused(resolution, device):
    cage = Cage(*oracles.cage("box"))
    refused(lambda: CageLattice(cage, resolution, device=device).measure(), match="resolution must be")


def test_blocks_list_the_faces_near_them_however_many_there_are(device, monkeypatch):
    sphere = trimesh.creation.icosphere(subdivisions=3)
    cage = Cage(sphere.vertices * [1.0, 1.3, 0.8], sphere.faces)
    lattice = CageLattice(cage, 24, device=device).measure()
    counts, near = lattice.block_faces.counts, lattice.block_faces.near
    # a block near more faces than are listed looks at all of them for each of its nodes
    assert BLOCK_FACES < counts.numpy().max() <= near.shape[1] < len(cage.faces) / 2
    monkeypatch.setattr(block_faces, "LIST_BYTES", 0)
    short = CageLattice(cage, 24, device=device).measure()
    assert short.block_faces.near.shape[1] == BLOCK_FACES
    np.testing.assert_array_equal(lattice.distance.numpy(), short.distance.numpy())
    assert block_faces.listed_faces(Cage(*oracles.cage("icosphere")), (70, 70, 70), 0.03) == BLOCK_FACES


def cages_of_many_faces():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    noise = np.random.default_rng(3).normal(0, 0.03, sphere.vertices.shape)
    fine = Cage(sphere.vertices, sphere.faces)
    concave = trimesh.Trimesh(*oracles.cage("concave")).subdivide().subdivide().subdivide()
    return {
        "noisy": Cage(sphere.vertices + noise, sphere.faces),
        "long": fine.stretch(5).bend(120),
        "far": Cage(sphere.vertices * 3 + [1e3, -2e3, 500], sphere.faces),
        "concave": Cage(concave.vertices, concave.faces),
    }


@pytest.mark.parametrize("side", [2, 4, 8])
@pytest.mark.parametrize("name", ["noisy", "long", "far", "concave"])
def test_faces_near_blocks_are_those_of_a_search_through_all(name, side, device, monkeypatch):
    """Groups of blocks hold every face near one of them, and few others."""
    cage = cages_of_many_faces()[name]
    assert len(cage.faces) >= block_faces.MANY_FACES
    monkeypatch.setattr(block_faces, "GROUP_SIDE", side)
    lattice = CageLattice(cage, 40, device=device).measure()
    for limit in ("MANY_FACES", "MANY_FACES_CPU"):
        monkeypatch.setattr(block_faces, limit, 1 << 30)
    plain = CageLattice(cage, 40, device=device).measure()
    ours, theirs = lattice.block_faces, plain.block_faces
    assert len(theirs.candidates) == len(theirs.boxes) == 0 < len(ours.candidates)
    counts, near = ours.counts.numpy(), ours.near.numpy()
    np.testing.assert_array_equal(counts, theirs.counts.numpy())
    held = np.arange(near.shape[1]) < counts[:, None]
    np.testing.assert_array_equal(near[held], theirs.near.numpy()[held])
    np.testing.assert_array_equal(ours.clear_octants.numpy(), theirs.clear_octants.numpy())
    np.testing.assert_array_equal(lattice.distance.numpy(), plain.distance.numpy())

    found = np.unpackbits(ours.candidates.numpy().view(np.uint8), axis=1, bitorder="little").astype(bool)
    assert not found[:, len(cage.faces) :].any()
    blocks = -(-np.array(lattice.shape) // 4)  # of 4 x 4 x 4 nodes
    groups = -(-blocks // side)
    assert len(found) == groups.prod() and len(counts) == blocks.prod()
    group = np.ravel_multi_index(np.array(np.unravel_index(np.arange(len(counts)), blocks)) // side, groups)
    needed = np.zeros_like(found)
    needed[np.repeat(group, held.sum(axis=1)), near[held]] = True
    assert not (needed & ~found).any()
    assert found.sum() < 2.0 * needed.sum()  # boxes are larger, and there is space between the blocks of a group
    assert side > 4 or found.mean() < 0.4  # of a lattice of 40 cells


@pytest.mark.parametrize("longest", [16, 71, 1031])
@pytest.mark.parametrize("face_count", [512, 5_120, 82_000, 1_000_000])
def test_bits_of_faces_take_little_beside_the_nodes_and_can_be_numbered(face_count, longest):
    side = block_faces.group_side(face_count, longest)
    masks, groups = block_faces.mask_count(face_count), block_faces.block_count((longest, longest, longest), side)
    assert side >= block_faces.GROUP_SIDE and 32 * masks >= face_count
    assert 4 * masks <= block_faces.GROUP_BYTES * (4 * side) ** 3
    assert 32 * masks * groups <= 1 << 30
    assert block_faces.block_count((17, 16, 1)) == 5 * 4 and block_faces.block_count((17, 16, 1), 4) == 2
    assert block_faces.group_side(5_120, 71) == 4 < block_faces.group_side(1_000_000, 71)
