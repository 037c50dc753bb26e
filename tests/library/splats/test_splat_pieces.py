"""Splats in pieces: an unmoved split cannot be seen, a bent splat is drawn in pieces, and a baked pose is a file."""

import numpy as np
import pytest
from field_oracles import basis
from refusals import refused
from scipy.spatial.transform import Rotation
from splat_scenes import drawn, one_splat, splats_in_box

import warpcage
from warpcage import Cage, Deformer
from warpcage.splats import PIECE, pieces_of, sh_basis, split_tree, turned_harmonics

BOX = Cage.box((-1, -1, -1), (1, 1, 1), segments=2)


def picture(centers, covariances, opacities, axes, half=0.6, side=81):
    """Alphas composited of splats seen from afar along the third of some axes, float64."""
    u, v = np.meshgrid(*[np.linspace(-half, half, side)] * 2, indexing="ij")
    light = np.ones_like(u)
    for center, covariance, opacity in zip(centers, covariances, opacities, strict=True):
        inverse = np.linalg.inv((axes @ covariance @ axes.T)[:2, :2])
        du, dv = u - (axes @ center)[0], v - (axes @ center)[1]
        far = inverse[0, 0] * du * du + 2 * inverse[0, 1] * du * dv + inverse[1, 1] * dv * dv
        light *= 1.0 - opacity * np.exp(-0.5 * far)
    return 1.0 - light


@pytest.mark.parametrize("opacity", [0.05, 0.3, 0.5, 0.7, 0.99])
def test_an_unmoved_split_cannot_be_seen(opacity):
    """Three pieces against the whole, seen from the side and aslant; as opaque as the whole they are off ten times as
    much, which is what the table is for."""
    center, factor = np.zeros((1, 3)), np.diag([0.15, 0.08, 0.05])[None]
    places, factors, opacities = pieces_of(center, factor, np.array([opacity]))
    covariances = factors[0] @ factors[0].transpose(0, 2, 1)
    assert np.sqrt(covariances[0, 0, 0]) == pytest.approx(PIECE * 0.15)
    for turn in (np.eye(3), Rotation.from_euler("xyz", [0.4, 0.6, 0.3]).as_matrix()):
        whole = picture(center, factor @ factor, [opacity], turn)
        off = np.abs(picture(places[0], covariances, opacities[0], turn) - whole)
        naive = np.abs(picture(places[0], covariances, [opacity] * 3, turn) - whole)
        seen = whole > 0.01 * opacity
        assert np.sqrt((off[seen] ** 2).mean()) < 0.02 * opacity and off[seen].max() < 0.07 * opacity
        assert opacity != 0.5 or naive.max() > 10 * off.max()


def test_the_tree_of_pieces():
    rng = np.random.default_rng(0)
    factors = rng.uniform(0.01, 0.3, (30, 1, 3)) * np.eye(3)
    tree = split_tree(rng.normal(size=(30, 3)), factors, rng.uniform(0, 1, 30), np.full(30, 0.1))
    np.testing.assert_array_equal(tree.rows[:30], np.arange(30))
    parents = np.flatnonzero(tree.pieces >= 0)
    assert len(tree.rows) == 30 + 3 * len(parents) and (tree.parents[:30] == -1).all()
    for parent in parents:
        children = tree.pieces[parent] + np.arange(3)
        assert (tree.parents[children] == parent).all() and (tree.rows[children] == tree.rows[parent]).all()
        np.testing.assert_allclose(tree.centers[children].mean(axis=0), tree.centers[parent], atol=1e-12)
    widest = np.sqrt((tree.factors**2).sum(axis=1).max(axis=1))
    depth = np.array([0 if p < 0 else 1 for p in tree.parents])
    assert (widest[(tree.pieces < 0) & (depth == 0)] <= 0.1).all()
    few = split_tree(rng.normal(size=(30, 3)), factors, rng.uniform(0, 1, 30), np.full(30, 0.1), most=45)
    assert len(few.rows) == 45
    never = split_tree(rng.normal(size=(30, 3)), factors, rng.uniform(0, 1, 30), np.full(30, np.inf))
    assert len(never.rows) == 30


def test_bent_splats_are_drawn_in_pieces_that_follow(device):
    """A long splat along a bend: whole it sticks out, its pieces lie where the map takes the matter in it."""
    cage = Cage.box((-1, -1, -1), (1, 1, 1), segments=4)
    bent = cage.bend(110)
    field = one_splat(device, (0.0, 0.0, 0.0), (0.01, 0.01, 0.25), 0.4)
    deformer = Deformer(field, cage, coordinates="mean_value").pose(bent)
    _, centers, covariances, _opacities = drawn(deformer)
    assert 3 <= len(centers) <= 81
    # samples of the matter, moved by the map, are near the posed splats' axes
    heights = np.linspace(-0.4, 0.4, 41)
    matter = warpcage.deform_points(np.outer(heights, [0, 0, 1.0]), cage, bent, "mean_value", device=device)
    away = np.linalg.norm(matter[:, None] - centers[None], axis=2).min(axis=1)
    spread = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    assert away.max() < 1.2 * spread.max() < 0.25
    reach = [(m - c) @ np.linalg.inv(s) @ (m - c) for m in matter[::4] for c, s in [nearest(m, centers, covariances)]]
    assert np.sqrt(max(reach)) < 2.0
    # a small pose needs none, and an affine one never
    for pose in (cage.bend(1), cage.with_vertices(cage.vertices @ np.diag([3.0, 0.5, 2.0]))):
        assert len(drawn(deformer.pose(pose))[0]) == 1


def nearest(point, centers, covariances):
    """The splat whose Gaussian a point lies deepest in."""
    far = [(point - c) @ np.linalg.inv(s) @ (point - c) for c, s in zip(centers, covariances, strict=True)]
    return centers[np.argmin(far)], covariances[np.argmin(far)]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_are_seen_from_turned_directions(degree):
    rng = np.random.default_rng(7)
    harmonics = rng.normal(size=(40, (degree + 1) ** 2, 3))
    turns = Rotation.random(40, random_state=1).as_matrix()
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = turned_harmonics(harmonics, turns)
    before = np.einsum("nb,nbc->nc", basis(directions, degree + 1), harmonics)
    after = np.einsum("nb,nbc->nc", basis(np.einsum("nij,nj->ni", turns, directions), degree + 1), turned)
    np.testing.assert_allclose(after, before, atol=2e-6)
    np.testing.assert_allclose(sh_basis(directions)[:, : (degree + 1) ** 2], basis(directions, degree + 1), atol=1e-12)


def test_a_baked_pose_is_a_file_of_its_own(tmp_path, device):
    """Saved and opened again it is what is drawn: places, covariances, opacities, and colours from any side."""
    field = splats_in_box(device, count=120, scales=(-6.0, -2.6))
    deformer = Deformer(field, BOX, coordinates="mean_value").pose(BOX.twist(80))
    baked = warpcage.bake(deformer)
    assert isinstance(baked, warpcage.SplatField)
    baked.save(tmp_path / "posed.ply")
    again = warpcage.SplatField.load(tmp_path / "posed.ply", device=device)
    rows, centers, covariances, opacities = drawn(deformer)
    assert len(rows) > 120  # some are in pieces
    np.testing.assert_allclose(again.contents.centers, centers, atol=1e-6)
    scale = np.abs(covariances).max(axis=(1, 2), keepdims=True)
    assert (np.abs(again.covariances - covariances) / scale).max() < 5e-6
    np.testing.assert_allclose(again.opacities, opacities, atol=1e-6)
    splats = deformer.posed_splats()
    turns = Rotation.from_quat(splats.turns.numpy()[splats.opacities.numpy() > 0.0])
    for direction in np.random.default_rng(0).normal(size=(5, 3)):
        direction /= np.linalg.norm(direction)
        seen = np.einsum("b,nbc->nc", basis(direction[None], 4)[0], again.contents.harmonics)
        at_rest = np.einsum("nb,nbc->nc", basis(turns.inv().apply(direction), 4), field.contents.harmonics[rows])
        np.testing.assert_allclose(seen, at_rest, atol=2e-5)
    assert np.linalg.det(again.rotations).min() > 0.99


def test_what_does_not_move_is_baked_to_the_bit(device):
    field = splats_in_box(device, half=2.0, count=300, scales=(-9.0, -8.0))
    baked = Deformer(field, BOX, coordinates="mean_value").pose(BOX.twist(30)).baked()
    outside = np.flatnonzero((np.abs(field.contents.centers) > 1.5).any(axis=1))
    assert len(outside) > 50
    place = {tuple(center): row for row, center in enumerate(baked.contents.centers)}
    same = [place[tuple(center)] for center in field.contents.centers[outside]]
    for name in ("log_scales", "quaternions", "logits", "harmonics"):
        np.testing.assert_array_equal(getattr(baked.contents, name)[same], getattr(field.contents, name)[outside])


def test_a_cage_around_splats_holds_their_matter(device):
    """Large faint and small opaque splats: the cage goes around what is seen of them, not around their centres."""
    values = ([[0, 0, 0], [2.0, 0, 0]], np.log([[0.3, 0.02, 0.3], [0.05, 0.05, 0.05]]), np.tile([1.0, 0, 0, 0], (2, 1)))
    field = warpcage.SplatField(*values, [2.0, 4.0], np.zeros((2, 1, 3)), device=device)
    assert (field.bounds[0] < [-0.89, -0.14, -0.89]).all() and (field.bounds[1] > [2.14, 0.14, 0.89]).all()
    density = field.node_densities()
    shape = np.round((field.bounds[1] - field.bounds[0]) / field.voxel_size)
    np.testing.assert_array_equal(density.shape, shape)
    # across the thin side of the first the optical depth is that of its opacity
    column = np.round((np.zeros(3) - field.bounds[0]) / field.voxel_size - 0.5).astype(int)
    depth = density[column[0], :, column[2]].sum() * field.voxel_size[1]
    assert depth == pytest.approx(-np.log(1.0 - field.opacities[0]), rel=0.05)
    cage = Cage.from_field(field, 60)
    two_deviations = [[0.55, 0, 0], [0, 0, -0.55], [2.08, 0, 0], [0, 0.03, 0], [2, 0, 0.08]]
    assert cage.contains(two_deviations).all()
    assert cage.check(field=field).usable
    part = warpcage.select_nodes(field, box=[(1.5, -1, -1), (3, 1, 1)])
    assert Cage.from_field(part, 40).bounds[0][0] > 1.5
    faint = warpcage.SplatField(*values, [-9.0, 4.0], np.zeros((2, 1, 3)), device=device)
    assert faint.bounds[0][0] > 1.5
    nothing = warpcage.SplatField(*values, [-9.0, -9.0], np.zeros((2, 1, 3)), device=device)
    refused(lambda: Cage.from_field(nothing, 40), match="nothing to put a cage around")
