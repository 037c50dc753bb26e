"""What becomes of splats under edits: the three cases of Eq. 5, copies, removals, several edits, walls, falloffs."""

import numpy as np
import pytest
from scipy.stats import norm
from splat_scenes import covariances_of, drawn, one_splat, splats_in_box

import warpcage
from warpcage import Cage, CageEdit, Deformer
from warpcage.deform import BOUND, FOLLOWED, LEFT, make_instances

LEFT_BOX, RIGHT_BOX = Cage.box((-1, -1, -1), (0, 1, 1)), Cage.box((0, -1, -1), (1, 1, 1))
TINY = (-9.0, -8.0)


def rows_at(field, low, high):
    """The splats whose centre is in a box."""
    centers = field.contents.centers
    return np.flatnonzero(((centers > low) & (centers < high)).all(axis=1))


def test_the_three_cases(device):
    """In the cage at rest: it goes. Outside of both: it stays, to the bit. Where the posed cage comes: cleared."""
    field = splats_in_box(device, half=2.0, count=600, scales=TINY)
    cage = Cage.box((-1, -1, -1), (0, 1, 1))
    deformer = Deformer(field, cage, coordinates="mean_value").pose(cage.translate((1.5, 0, 0)))
    rows, centers, _, _opacities = drawn(deformer)
    inside, covered = rows_at(field, (-1, -1, -1), (0, 1, 1)), rows_at(field, (0.5, -1, -1), (1.5, 1, 1))
    stays = np.setdiff1d(np.arange(600), np.concatenate([inside, covered]))
    np.testing.assert_array_equal(np.sort(rows), np.sort(np.concatenate([inside, stays])))
    place = dict(zip(rows, centers, strict=True))
    rest = field.contents.centers
    np.testing.assert_allclose([place[row] for row in inside], rest[inside] + [1.5, 0, 0], atol=1e-5)
    posed = deformer.posed_splats()
    clear = np.min([np.abs(rest - wall).min(axis=1) for wall in (-1.0, 0.0, 0.5, 1.0, 1.5)], axis=0) > 1e-2
    stays = stays[clear[stays]]
    assert len(stays) > 300
    np.testing.assert_array_equal(posed.centers.numpy()[stays], field.splats.centers.numpy()[stays])
    np.testing.assert_array_equal(posed.covariances.numpy()[stays], field.splats.covariances.numpy()[stays])
    np.testing.assert_array_equal(posed.opacities.numpy()[stays], field.splats.opacities.numpy()[stays])
    np.testing.assert_array_equal(posed.turns.numpy()[stays], np.tile([0, 0, 0, 1], (len(stays), 1)))


def test_a_copy_and_a_removal(device):
    field = splats_in_box(device, half=0.9, count=200, scales=TINY)
    inside = rows_at(field, (-1, -1, -1), (0, 1, 1))
    copied = Deformer(field, CageEdit(LEFT_BOX, keep_source=True), coordinates="mean_value")
    rows, centers, _, _ = drawn(copied.pose(LEFT_BOX.translate((5, 0, 0))))
    np.testing.assert_array_equal(np.sort(rows), np.sort(np.concatenate([np.arange(200), inside])))
    away = centers[:, 0] > 2.0
    np.testing.assert_allclose(centers[away], field.contents.centers[rows[away]] + [5, 0, 0], atol=1e-5)
    np.testing.assert_array_equal(np.sort(rows[away]), inside)
    # half over itself: what the copy covers of the source is gone
    rows, centers, _, _ = drawn(copied.pose(LEFT_BOX.translate((0.5, 0, 0))))
    hidden = rows_at(field, (-0.5, -1, -1), (0.5, 1, 1))
    np.testing.assert_array_equal(np.bincount(rows, minlength=200)[hidden], np.isin(hidden, inside))
    removed = Deformer(field, CageEdit(LEFT_BOX, remove=True), coordinates="mean_value").pose([None])
    np.testing.assert_array_equal(drawn(removed)[0], np.setdiff1d(np.arange(200), inside))


@pytest.mark.parametrize("kind", ["mean_value", "harmonic"])
def test_several_edits_are_those_of_points(kind, device):
    """Two apart, and a third that takes along what the first put into it."""
    field = splats_in_box(device, half=0.9, count=150, scales=TINY)
    third = Cage.box((1.5, -1.5, -1.5), (4.5, 1.5, 1.5))
    deformer = Deformer(field, [LEFT_BOX, RIGHT_BOX, third], coordinates=kind, resolution=24)
    poses = [LEFT_BOX.translate((3.5, 0, 0)), RIGHT_BOX.rotate(20, axis="x"), third.translate((0, 6, 0)).twist(30)]
    rows, centers, _, opacities = drawn(deformer.pose(poses))
    np.testing.assert_array_equal(np.sort(rows), np.arange(150))
    rest = field.contents.centers.astype(float)
    left = rows_at(field, (-1, -1, -1), (0, 1, 1))
    place = centers[np.argsort(rows)]
    through = warpcage.deform_points(rest[left] + [3.5, 0, 0], third, poses[2], kind, device=device)
    np.testing.assert_allclose(place[left], through, atol=3e-2 if kind == "harmonic" else 1e-3)
    right = np.setdiff1d(np.arange(150), left)
    turned = warpcage.deform_points(rest[right], RIGHT_BOX, poses[1], "mean_value", device=device)
    np.testing.assert_allclose(place[right], turned, atol=1e-5)
    np.testing.assert_array_equal(opacities[np.argsort(rows)], field.splats.opacities.numpy())
    # the third keeps its source: what the first brought is there twice
    kept = Deformer(field, [LEFT_BOX, CageEdit(third, keep_source=True)], coordinates=kind, resolution=24)
    rows, _, _, _ = drawn(kept.pose([poses[0], third.translate((0, 8, 0))]))
    np.testing.assert_array_equal(np.bincount(rows, minlength=150), 1 + np.isin(np.arange(150), left))
    # and a removal of where it is clears it
    gone = Deformer(field, [LEFT_BOX, CageEdit(third, remove=True)], coordinates=kind, resolution=24)
    np.testing.assert_array_equal(np.sort(drawn(gone.pose([poses[0], None]))[0]), right)


def test_histories_of_copies():
    """Splats half in one cage, then half in another: four shares, that add up to the whole."""
    edits = [CageEdit(LEFT_BOX), CageEdit(RIGHT_BOX)]
    made = make_instances(edits, np.array([[0.25, 1.0, 0.0], [0.5, 0.0, 0.0]]))
    first, second = made.actions
    np.testing.assert_array_equal(made.nodes, [0, 1, 2, 0, 0])
    np.testing.assert_array_equal(first.kinds, [BOUND, BOUND, LEFT, LEFT, LEFT])
    np.testing.assert_array_equal(second.kinds, [FOLLOWED, FOLLOWED, LEFT, BOUND, LEFT])
    np.testing.assert_allclose(made.shares, [0.25, 1.0, 1.0, 0.5, 1.0])
    np.testing.assert_allclose(first.outside[3:], 0.75)
    np.testing.assert_allclose(second.outside[4], 0.5)


@pytest.mark.parametrize("offset", [-0.15, -0.05, 0.0, 0.03, 0.1])
def test_a_splat_at_a_wall_goes_and_stays_by_its_shares(offset, device):
    """Optical depths are those of the shares of a Gaussian on both sides of a flat wall, and together the whole."""
    field = one_splat(device, (offset, 0.1, 0.0), (0.05, 0.01, 0.01), 0.8)
    deformer = Deformer(field, LEFT_BOX, coordinates="mean_value").pose(LEFT_BOX.translate((-1e-5, 0, 0)))
    _, centers, _, opacities = drawn(deformer)
    share = norm.cdf(-offset / 0.05)
    expected = [1.0 - 0.2**each for each in (share, 1.0 - share) if 0.0014 < each < 0.9986]
    if len(expected) == 2:
        np.testing.assert_allclose(np.sort(opacities), np.sort(expected), rtol=2e-3)
    assert 1.0 - np.prod(1.0 - opacities) == pytest.approx(0.8, abs=1e-3)
    assert np.abs(centers - field.contents.centers).max() < 1e-4


def test_a_torn_splat_goes_in_pieces(device):
    """A large one across a wall: what lies left of it is taken along, what lies right stays, and nothing is lost."""
    field = one_splat(device, (0.0, 0.0, 0.0), (0.15, 0.05, 0.05), 0.5)
    deformer = Deformer(field, LEFT_BOX, coordinates="mean_value").pose(LEFT_BOX.translate((-3, 0, 0)))
    _, centers, covariances, opacities = drawn(deformer)
    assert len(centers) > 3
    goes = centers[:, 0] < -2.0
    widths = np.sqrt(covariances[:, 0, 0])
    # how far pieces of either part reach over the wall, by the share that is left of them
    assert (centers[goes, 0] + 3.0 <= 3.0 * widths[goes]).all() and (centers[~goes, 0] >= -3.0 * widths[~goes]).all()
    depth = -np.log(1.0 - opacities) * widths
    assert depth[goes].sum() == pytest.approx(depth[~goes].sum(), rel=1e-3)  # as many on each side


def test_a_falloff_holds_a_wall(device):
    """Splats at the held wall stay; those beyond the band go as without it."""
    field = splats_in_box(device, half=0.95, count=400, scales=TINY)
    cage = Cage.box((-1, -1, -1), (1, 1, 1), segments=3)
    posed = cage.with_vertices(cage.vertices + [0.0, 0.0, 0.4] * (cage.vertices[:, 2:] > 0.0))
    still = Deformer(field, CageEdit(cage, falloff=0.5, held="still"), coordinates="mean_value").pose(posed)
    free = Deformer(field, cage, coordinates="mean_value").pose(posed)
    rest = field.contents.centers.astype(float)
    held, loose = (drawn(each)[1] for each in (still, free))
    low = rest[:, 2] < -0.9
    assert np.abs(held[low] - rest[low]).max() < 1e-2 < np.abs(loose[low] - rest[low]).max()
    high = rest[:, 2] > 0.2  # the walls at the sides are held up to -1/3
    np.testing.assert_allclose(held[high], loose[high], atol=1e-5)
    # the Jacobian is that of the faded map: neighbours show it
    step = 1e-3 * np.eye(3)[2]
    values = (field.contents.log_scales, field.contents.quaternions, field.contents.logits, field.contents.harmonics)
    edits, kind = still.edits, "mean_value"
    fields = [warpcage.SplatField(rest + way * step, *values, device=device) for way in (-1, 1)]
    moved = [drawn(Deformer(each, edits, coordinates=kind).pose(posed))[1] for each in fields]
    expected = (moved[1] - moved[0]) / 2e-3
    found = still.posed_edits().carried.jacobians.numpy()[:400, :, 2]
    band = (rest[:, 2] > -0.95) & (rest[:, 2] < -0.55) & (np.abs(rest[:, :2]).max(axis=1) < 0.9)
    np.testing.assert_allclose(found[band], expected[band], atol=2e-2)


def test_a_cut_wall_is_found_among_splats(device):
    """A falloff of the walls that cut matter: only the one that does is held."""
    field = splats_in_box(device, half=0.9, count=6000, scales=(-3.2, -2.8), degree=0, seed=2)
    cage = Cage.box((-2, -2, 0.0), (2, 2, 2))  # the wall z = 0 goes through the splats
    deformer = Deformer(field, CageEdit(cage, falloff=0.3), coordinates="mean_value")
    held = deformer.posed_edits().bands[0].faces
    assert len(held) == 2 and (cage.vertices[cage.faces[held]][..., 2] == 0.0).all()


def test_a_posed_deformer_that_several_share(device):
    field = splats_in_box(device, count=50, scales=TINY)
    cage = Cage.box((-1, -1, -1), (1, 1, 1), segments=2)
    deformer = Deformer(field, cage, coordinates="mean_value").pose(cage.twist(40))
    first = drawn(deformer)[1]
    deformer.posed(cage.bend(30))
    np.testing.assert_array_equal(drawn(deformer)[1], first)
    assert covariances_of(deformer.posed_splats()).shape == (50, 3, 3)
