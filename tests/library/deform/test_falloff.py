"""Local cages whose edits fade to rest inside the walls that they hold: formula, continuity, folds, bad input."""

import warnings

import numpy as np
import pytest
from fields import make_field, shiny, view
from messages import MESSAGES
from oracles import mean_value_weights
from refusals import refused

from warpcage import Cage, CageEdit, Deformer
from warpcage.cage import cut_faces
from warpcage.edits import walls_share

WIDTH = 0.25
#: Around the right half of a bar along x: its wall at x = 0 cuts the bar.
HALF = Cage.box([0.0, -0.5, -0.5], [0.97, 0.5, 0.5], segments=2)
RAISED = HALF.stretch(1.2, axis="x", center=[0, 0, 0]).translate([0, 0, 0.12]).twist(15, axis="x")
ON_WALL = np.flatnonzero(HALF.vertices[:, 0] == 0.0)


def bar(device):
    return make_field(lambda x: 30.0 * (np.abs(x) < [0.9, 0.45, 0.45]).all(axis=-1), shiny, device=device)


@pytest.fixture
def field(device):
    return bar(device)


def traced(deformer, points, step=1e-3):
    return deformer.to_canonical(points, np.broadcast_to([0.6, 0.0, 0.8], points.shape), step=step)


def places(x, count=200):
    """Points of a plane across the bar, within it."""
    yz = np.random.default_rng(3).uniform(-0.33, 0.33, (count, 2))
    return np.column_stack([np.full(count, x), yz])


def test_walls_that_cut_matter_are_found(field):
    faces = cut_faces(HALF, field)
    on_wall = np.isin(HALF.faces, ON_WALL).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(on_wall), faces)
    assert len(cut_faces(Cage.box([-0.97, -0.6, -0.6], [0.97, 0.6, 0.6], segments=2), field)) == 0


@pytest.mark.parametrize(("kind", "resolution"), [("mean_value", None), ("mean_value", 64), ("green", None)])
def test_the_map_is_the_cage_map_times_its_share(field, kind, resolution):
    """Against mean value coordinates in float64 and the formula x + s (phi(x) - x)."""
    deformer = Deformer(field, CageEdit(HALF, falloff=WIDTH), coordinates=kind, resolution=resolution).pose(RAISED)
    held = deformer.deformed[0]
    np.testing.assert_array_equal(held.vertices[ON_WALL], HALF.vertices[ON_WALL])  # the wall is held
    free = HALF.vertices[:, 0] > WIDTH
    np.testing.assert_array_equal(held.vertices[free], RAISED.vertices[free])  # the rest is as it was posed
    x = np.concatenate([places(share * WIDTH) for share in (0.02, 0.3, 0.7, 1.2)])
    points, _, region = traced(deformer, x)
    assert (region == 2).all()
    if kind == "mean_value":
        mapped = mean_value_weights(x, held.vertices, held.faces) @ HALF.vertices
    else:
        plain = Deformer(field, CageEdit(HALF), coordinates=kind, resolution=None).pose(held)
        mapped = traced(plain, x)[0]
    t = np.minimum(x[:, :1] / WIDTH, 1.0)
    expected = x + (6 * t**5 - 15 * t**4 + 10 * t**3) * (mapped - x)
    np.testing.assert_allclose(points, expected, atol=1e-4 if resolution is None else 2e-3)


@pytest.mark.parametrize(
    ("kind", "resolution", "slack"),
    [("harmonic", 64, 1e-3), ("mean_value", 48, 1e-3), ("green", 48, 1e-3), ("mean_value", None, 1e-4)],
)
def test_positions_and_directions_go_on_through_a_held_wall(field, kind, resolution, slack):
    """Just inside the wall both are what they are just outside of it; without a falloff both jump."""
    near = 0.01
    outside, inside = places(-near), places(near)
    for falloff, torn in ((WIDTH, False), (0.0, True)):
        edit = CageEdit(HALF, falloff=falloff)
        deformer = Deformer(field, edit, coordinates=kind, resolution=resolution).pose(RAISED)
        points, directions, region = traced(deformer, inside)
        beyond, straight, still = traced(deformer, outside)
        assert (still == 0).all() and ((region == 2).all() or torn)
        move = np.abs((points - inside) - (beyond - outside)).max()
        turn = np.abs(directions - straight).max()
        if torn:  # Green coordinates lead out of the rest cage there
            assert (region == 1).all() or (move > 0.05 and turn > 0.02)
        else:
            assert move < slack and turn < 20 * slack, (move, turn)


def test_the_band_has_no_jump_within(field):
    """Along a way through wall and band neither the position nor its slope jumps, also where two held walls meet."""
    corner = Cage.box([0.0, -0.5, -0.2], [0.97, 0.5, 0.8], segments=2)
    moved = corner.translate([0.05, 0.05, 0.1])
    deformer = Deformer(field, CageEdit(corner, falloff=0.3), coordinates="mean_value", resolution=None).pose(moved)
    along = np.linspace(-0.05, 0.4, 451)
    for way in ([1.0, 0.0, 0.0], [1.0, 0.0, 1.0]):  # through one wall, and along the crease between two
        x = np.array([0.0, 0.1, -0.2]) + along[:, None] * way
        if way[2] == 0.0:
            x[:, 2] = 0.02
        points, _, _ = deformer.to_canonical(x, np.broadcast_to(way, x.shape))
        slope = np.diff(points - x, axis=0) / np.diff(along)[:, None]
        assert np.abs(slope).max() > 0.05  # it moves
        assert np.abs(np.diff(slope, axis=0)).max() < 0.02


def test_pictures_do_not_tear(field):
    """Where the cut bar has a step in its outline, that of the held one rises gently."""
    camera, lifted = view(eye=(0.2, -2.5, 0.5), size=64), HALF.translate([0, 0, 0.25])
    steps = []
    for edit in (HALF, CageEdit(HALF, falloff=0.5)):
        alpha = Deformer(field, edit, resolution=32).pose(lifted).render(camera).alpha[:, 8:56]
        height = np.argmax(alpha > 0.5, axis=0)
        assert height[0] - height[-1] >= 7  # lifted on the right
        steps.append(np.abs(np.diff(height)).max())
    assert steps[0] >= 7 and steps[1] <= 2, steps


def test_a_pose_may_say_which_walls_are_still(field):
    """Those that it leaves in place are held, wherever they are; or faces by their numbers."""
    posed = HALF.with_vertices(HALF.vertices + np.where(HALF.vertices[:, :1] > 0.9, [0.0, 0.0, 0.15], 0.0))
    points = {}
    wall = np.flatnonzero(np.isin(HALF.faces, ON_WALL).all(axis=1))
    for held in ("still", "cut", wall):
        deformer = Deformer(field, CageEdit(HALF, falloff=WIDTH, held=held), resolution=32).pose(posed)
        np.testing.assert_array_equal(deformer.deformed[0].vertices, posed.vertices)
        points[str(held)] = traced(deformer, places(0.1))[0]
    cut, numbered, still = points["cut"], points[str(wall)], points["still"]
    np.testing.assert_array_equal(cut, numbered)
    # the long walls are still as well up to x = 0.65, so that less is left near them
    assert np.abs(still - cut).max() > 1e-4
    assert np.linalg.norm(still - places(0.1), axis=1).mean() < np.linalg.norm(cut - places(0.1), axis=1).mean()


def test_a_band_that_folds_is_told(field):
    edit = CageEdit(HALF, falloff=0.3)
    with pytest.warns(UserWarning, match=MESSAGES["deform.falloff_inside_out"]):
        deformer = Deformer(field, edit, resolution=48).pose(HALF.stretch(4.0, axis="x", center=[0, 0, 0]))
    assert deformer.render(view(size=24)).fold.max() > 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        deformer.pose(HALF.stretch(1.5, axis="x", center=[0, 0, 0]))


def test_shares_of_walls_that_meet_multiply():
    wall = np.array([[[0, -1, -1], [0, 1, -1], [0, 0, 2]]], float)
    floor = wall[..., [1, 2, 0]]
    points = np.array([[0.25, 0.0, 0.25], [0.0, 0, 0.3], [0.6, 0, 0.1]])
    shares = walls_share(points, [wall, floor], 0.5)
    s = lambda t: 6 * t**5 - 15 * t**4 + 10 * t**3  # noqa: E731
    np.testing.assert_allclose(shares, [s(0.5) ** 2, 0.0, s(0.2)], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"falloff": -1.0}, "must be a width"),
        ({"falloff": np.nan}, "falloff"),
        ({"falloff": "wide"}, "falloff"),
        ({"falloff": 0.1, "remove": True}, "no pose to fade"),
        ({"falloff": 0.1, "held": "some"}, "held must be 'cut' or 'still'"),
        ({"falloff": 0.1, "held": [999]}, "names face 999"),
        ({"falloff": 0.1, "held": [3, -2, 999]}, "names face -2"),
        ({"falloff": 0.1, "held": [0.5]}, "numbers of faces"),
    ],
)
def test_bad_bands_are_refused(options, message):
    refused(lambda: CageEdit(HALF, **options), match=message)


def test_a_cage_that_cuts_nothing_needs_no_band(field):
    around = Cage.box([-0.97, -0.6, -0.6], [0.97, 0.6, 0.6])
    said = refused(lambda: Deformer(field, CageEdit(around, falloff=0.1)), match="no side of the cage cuts")
    assert '"' not in said and "are held: still" in said  # as a command says it, too


def test_a_cage_that_its_falloff_squeezes_is_told_from_one_with_gaps(field):
    """The pose as it is given has neither gaps nor crossing faces; held walls beside turned vertices make them."""
    cage = Cage.box([0.0, -0.5, -0.5], [0.97, 0.5, 0.5], segments=3)
    posed = cage.twist(90)
    assert not len(posed.check().intersecting_faces)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Deformer(field, CageEdit(cage), resolution=32).pose(posed)
    squeezed = Deformer(field, CageEdit(cage, falloff=0.2), resolution=32)
    with pytest.warns(UserWarning, match=MESSAGES["deform.falloff_walls"]):
        squeezed.pose(posed)
    assert len(squeezed.deformed[0].check().intersecting_faces)
