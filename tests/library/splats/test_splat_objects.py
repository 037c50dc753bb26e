"""Objects of a whole place of splats: chosen by clicks and regions, caged, cut out; against which splat is whose."""

import numpy as np
import pytest
from refusals import refused
from splat_scenes import (
    BALL,
    CUP,
    CUP_AT,
    CUP_HEIGHT,
    CUP_RADIUS,
    FLOOR,
    TABLE,
    TABLE_TOP,
    joined,
    one_splat,
    place,
    place_camera,
    reference_view,
)

from warpcage import Cage, Camera, Deformer, NodeSelection, SplatField, bake, select_nodes, select_object
from warpcage.select import pick_point

#: Height up to which the cup stays with the table that it stands on: two cells and what the table is rough.
FOOT = 0.03

MIDDLE = np.array([*CUP_AT, TABLE_TOP + 0.5 * CUP_HEIGHT])
ON_CUP = MIDDLE + [CUP_RADIUS, 0.0, 0.0]


@pytest.fixture(scope="module")
def scene():
    return place()


@pytest.fixture(scope="module")
def cup(scene):
    """The cup, by a point on it."""
    return select_object(scene[0], point=ON_CUP)


def ways():
    """Each way to choose the cup but by a point."""
    camera = place_camera()
    seen = camera.project(MIDDLE[None] + [0.0, -CUP_RADIUS, 0.0])[0][0]
    reach = np.array([CUP_RADIUS, CUP_RADIUS, 0.5 * CUP_HEIGHT]) + 0.05
    turns = np.arange(6) * np.pi / 3
    cameras = [place_camera((*(CUP_AT + 1.1 * np.array([np.cos(a), np.sin(a)])), 1.3), MIDDLE, 120) for a in turns]
    return {
        "pixel": {"pixel": np.floor(seen), "camera": camera},
        "box": {"box": [MIDDLE - reach, MIDDLE + reach]},
        "sphere": {"sphere": [*MIDDLE, 0.2]},
        "cage": {"cage": Cage.icosphere(MIDDLE, 0.22, 2)},
        "depth": {"depth": (0.9, 1.4), "cameras": iter(cameras), "point": ON_CUP},
    }


def rows_of(chosen):
    """(n,) bool, the splats of a selection."""
    return chosen.field.splats_in(chosen.mask)


@pytest.mark.parametrize("way", ["point", "pixel", "box", "sphere", "cage", "depth"])
def test_the_cup_without_its_table(scene, cup, way):
    field, labels = scene
    chosen = cup if way == "point" else select_object(field, **ways()[way])
    rows, of_cup = rows_of(chosen), labels == CUP
    assert not (rows & ~of_cup).any()
    assert rows[of_cup & (field.contents.centers[:, 2] > TABLE_TOP + FOOT)].all() and rows.sum() > 0.9 * of_cup.sum()
    assert chosen.floor.normal @ [0, 0, 1] > 0.999 and 0 < chosen.floor.offset - TABLE_TOP < FOOT
    assert any("cells) above the ground plane" in note for note in chosen.notes)
    # a cell of the whole room is a fifth of the cup
    assert chosen.voxel_size[0] < 0.2 * field.voxel_size[0] < 0.2 * 0.05


def test_other_objects_of_the_place(scene):
    field, labels = scene
    ball = rows_of(select_object(field, point=(1.5, 1.2, 0.6)))
    assert not (ball & (labels != BALL)).any() and ball.sum() > 0.9 * (labels == BALL).sum()
    table = rows_of(select_object(field, point=(-0.4, 0.1, TABLE_TOP)))
    assert set(np.unique(labels[table])) == {TABLE, CUP} and table[labels == CUP].all()
    both = rows_of(select_object(field, point=[(1.5, 1.2, 0.6), ON_CUP], plane=None))
    assert both[(labels == BALL) | (labels == CUP)].all()


def black(centers, log_scales):
    """Values of nearly opaque splats."""
    count = len(centers)
    return centers, log_scales, np.eye(4)[[0] * count], np.full(count, 3.0), np.zeros((count, 1, 3))


def require_cup_alone(wide, labels, **ways):
    rows = rows_of(select_object(wide, point=ON_CUP, **ways))
    assert not rows[len(labels) :].any() and not (rows[: len(labels)] & (labels != CUP)).any()
    assert rows.sum() > 0.9 * (labels == CUP).sum()


def test_far_splats_make_nothing_coarser(scene):
    """A sky around the place: its box is forty times as long as before."""
    field, labels = scene
    sky = np.random.default_rng(3).normal(size=(60, 3))
    sky = 100.0 * sky / np.linalg.norm(sky, axis=1, keepdims=True)
    wide = joined(field, black(sky, np.full((60, 3), np.log(5.0))))
    assert wide.voxel_size[0] > 1.0
    require_cup_alone(wide, labels)


@pytest.mark.parametrize("plane", ["ground", "any"])
def test_far_walls_are_not_what_an_object_stands_on(scene, plane):
    """A hall around the place, whose walls are twelve times as long: they are planes too, and the room is what is above
    them."""
    field, labels = scene
    across = np.arange(-30.0, 30.1, 2.5)
    sheet = np.stack([each.ravel() for each in np.meshgrid(across, across)], axis=1)
    flat = np.full((len(sheet), 2), np.log(2.0))
    walls = [(axis, end) for axis in range(3) for end in (-30.0, 30.0)]
    centers = np.concatenate([np.insert(sheet, axis, end, axis=1) for axis, end in walls])
    scales = np.concatenate([np.insert(flat, axis, np.log(0.5), axis=1) for axis, _ in walls])
    require_cup_alone(joined(field, black(centers, scales)), labels, plane=plane)


def test_what_is_cut_out_is_those_splats(scene, cup):
    field, _ = scene
    alone, rows = cup.cut_out(), rows_of(cup)
    assert isinstance(alone, SplatField) and len(alone) == rows.sum()
    np.testing.assert_array_equal(alone.contents.centers, field.contents.centers[rows])
    camera = place_camera(size=80)
    whole, seen = field.render(camera), alone.render(camera)
    opaque = seen.alpha > 0.95
    assert opaque.sum() > 20 and np.abs(whole.rgb - seen.rgb)[opaque].max() < 0.12
    assert seen.alpha[:10].max() == 0.0
    shown = cup.preview(camera, color=(0, 0, 1), strength=1.0)
    blue = np.all(np.abs(shown - [0, 0, 1]) < 0.12, axis=2)
    assert blue[opaque].mean() > 0.9 and not blue[seen.alpha < 0.02].any()
    cage = Cage.box(*alone.bounds, segments=2)
    bent = Deformer(alone, cage, coordinates="mean_value").pose(cage.bend(30, axis="x", towards="z"))
    assert len(bake(bent)) >= len(alone)


@pytest.mark.parametrize("ending", ["npz", "json"])
def test_files_of_selections_find_their_splats(scene, cup, ending, tmp_path):
    field, _ = scene
    field.save(tmp_path / "place.ply")
    again = SplatField.load(tmp_path / "place.ply", device=field.device)
    whole = select_nodes(field, floaters=0.1)  # on the grid of all splats
    for name, chosen in (("cup", cup), ("whole", whole)):
        chosen.save(tmp_path / f"{name}.{ending}")
        held = NodeSelection.load(tmp_path / f"{name}.{ending}", again)
        np.testing.assert_array_equal(held.mask, chosen.mask)
        np.testing.assert_allclose(held.bounds, chosen.bounds, atol=1e-9)
        assert held.notes == chosen.notes
        alone, expected = (each.cut_out().contents.centers for each in (held, chosen))
        np.testing.assert_allclose(alone, expected, atol=1e-6)
        assert len(held.cut_out()) == rows_of(held).sum()
    assert NodeSelection.load(tmp_path / f"cup.{ending}", again).floor.offset == cup.floor.offset
    with pytest.raises(ValueError, match="is of another field than these splats"):
        NodeSelection.load(tmp_path / f"cup.{ending}", again.chosen(np.arange(100)))


def test_a_ray_ends_where_half_of_its_light_is_gone(device):
    camera = Camera.look_at((0.3, -4.0, 0.2), (0, 0, 0), up=(0, 0, 1), fov_degrees=30, width=41, height=41)
    rng = np.random.default_rng(5)
    held = [
        (0.1 * rng.normal(size=3) * [1, 12, 1], rng.uniform(0.05, 0.2, 3), rng.uniform(0.1, 0.5)) for _ in range(30)
    ]
    field = joined(*(one_splat(device, *each) for each in held))
    origin, direction = camera.center, -camera.center / np.linalg.norm(camera.center)
    far = field.distance_seen(origin, direction, spread=1.0 / camera.fx)
    order = np.argsort(field.contents.centers @ direction)
    opaque = []  # of what lies before, by the equations of views: half of the light is gone between two splats
    for count in range(1, len(order) + 1):
        rows = order[:count]
        held = field.contents.centers, field.covariances, field.opacities, field.contents.harmonics
        opaque.append(reference_view(*(each[rows] for each in held), camera)[1][20, 20])
    crossed = int(np.argmax(np.array(opaque) >= 0.5))
    at = (field.contents.centers[order] - origin) @ direction
    assert opaque[-1] > 0.5 and abs(far - at[crossed]) < 0.05
    np.testing.assert_allclose(pick_point(field, camera, (20, 20)), origin + far * direction, atol=0.02)
    assert np.isinf(field.distance_seen(origin, -direction)) and np.isinf(field.distance_seen(origin, (1, 0, 0)))


def test_a_click_through_haze_is_on_what_is_behind(scene):
    """The mean depth of a half transparent floater and the cup would be in the air between them."""
    field, _ = scene
    camera = place_camera()
    haze = one_splat("cpu", center=camera.center + 0.5 * (MIDDLE - camera.center), scales=(0.1,) * 3, opacity=0.45)
    both = joined(field, haze)
    pixel = np.floor(camera.project(MIDDLE[None])[0][0])
    found = pick_point(both, camera, pixel)
    assert np.linalg.norm(found - MIDDLE) < CUP_RADIUS + 0.05
    assert both.render(camera).depth[int(pixel[1]), int(pixel[0])] < np.linalg.norm(MIDDLE - camera.center) - 0.3


CLICKS = {
    "on the floor": ({"point": (-1.5, -1.0, 0.0)}, "is on the ground plane"),
    "on nothing": ({"point": (-1.5, -1.0, 1.0)}, "is on nothing: nothing dense"),
    "beside everything": (
        {"pixel": (5, 5), "camera": Camera.look_at((9, 9, 9), (20, 20, 20), up=(0, 0, 1), width=10, height=10)},
        "is not half opaque there",
    ),
    "in an empty box": ({"box": [(-2, -2, 1), (-1.8, -1.8, 1.2)]}, "the field shows nothing"),
    "in a box of no size": ({"box": [(0, 0, 1), (0, 0, 1)]}, "box"),
    "in a sphere of no size": ({"sphere": (0, 0, 0, 0)}, "a positive radius"),
    "in no cage": ({"cage": 3}, "takes a ClosedMesh, got int"),
    "of a wall that is not there": ({"sphere": (*MIDDLE, 0.2), "plane_at": (9, 9, 9)}, "no ground plane passes near"),
}


@pytest.mark.parametrize("case", CLICKS)
def test_what_cannot_be_chosen_is_said_in_a_line(scene, case):
    options, message = CLICKS[case]
    refused(lambda: select_object(scene[0], **options), match=message)


def test_matter_on_a_grid_of_any_box(scene):
    field, labels = scene
    matter = field.matter([(0, -0.1, 0.7), (0.4, 0.3, 1.0)], 40)
    assert matter.node_densities().shape == (40, 40, 30) and matter.voxel_size[0] == pytest.approx(0.01)
    assert field.matter() is field.matter() and matter.device == field.device
    np.testing.assert_array_equal(field.matter().node_densities(), field.node_densities())
    every = matter.splats_in(np.ones((40, 40, 30), bool))
    assert every[labels == CUP].all() and not every[labels == FLOOR].any()
    assert not matter.splats_in(np.zeros((40, 40, 30), bool)).any()
    refused(lambda: matter.cut_out(np.zeros((40, 40, 30), bool)), match="nothing is chosen")
    refused(lambda: field.matter(None, 1), match="resolution")
