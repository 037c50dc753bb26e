"""Objects of a scene by a click, a box, a sphere, a cage and depths of views: against which voxel is whose."""

import re

import numpy as np
import pytest
from field_oracles import random_outer
from fields import GridField
from messages import MESSAGES
from refusals import refused
from scenes import BALL, FRAGMENT, LAMP, TABLE, TableScene

from warpcage import Cage, Camera, NodeSelection, VoxelField, select_nodes, select_object
from warpcage.select import Plane, pick_point

VOXEL = 2.0 / 64


@pytest.fixture(scope="module", params=[0.0, 12.0])
def scene(request):
    return TableScene(degrees=request.param)


@pytest.fixture(scope="module")
def table(request):
    return TableScene(degrees=8.0, floor=False, fragments=False)


def belongs(scene, chosen, label, others=()):
    """Every voxel of a label that is clear of the cut is chosen; of others only those that are named."""
    mask, heights = chosen.mask.ravel(), scene.heights()
    own = scene.labels == label
    cut = chosen.floor.offset  # of a plane that is level in the scene's own axes
    assert cut - (-0.2) < 3 * VOXEL and scene.world((0, 0, 1)) @ chosen.floor.normal > 0.999
    missed = own & ~mask
    assert heights[missed].max(initial=0.0) < 2.6 * VOXEL and missed.sum() < 0.15 * own.sum()
    strangers = np.unique(scene.labels[mask & ~own])
    assert set(strangers.tolist()) <= set(others)
    return mask


def ways(scene):
    """Each way to choose the lamp."""
    own = scene.cells[scene.labels == LAMP]
    camera = scene.camera()
    middle = scene.world((-0.1, 0.1, 0.1))
    return {
        "pixel": {"pixel": scene.pixel_of(camera, LAMP), "camera": camera},
        "point": {"point": scene.world((-0.15, 0.1, 0.2))},
        "box": {"box": [own.min(axis=0) - 0.05, own.max(axis=0) + 0.05], "floaters": 0.1},
        "sphere": {"sphere": [*middle, 0.55], "floaters": 0.1},
        "cage": {"cage": Cage.icosphere(middle, 0.6, 3), "floaters": 0.1},
    }


@pytest.mark.parametrize("way", ["pixel", "point", "box", "sphere", "cage"])
def test_the_lamp_without_the_table(scene, way):
    chosen = select_object(scene.field, **ways(scene)[way])
    mask = belongs(scene, chosen, LAMP, others=(FRAGMENT,))
    assert np.count_nonzero(mask & (scene.labels == FRAGMENT)) <= 3  # those that touch it
    assert any("above the ground plane" in note for note in chosen.notes)


@pytest.mark.parametrize("faces", ["triangles", "quads"])
@pytest.mark.parametrize("way", ["sphere"])
def test_the_cage_holds_the_lamp_and_no_table(scene, way, faces):
    chosen = select_object(scene.field, **ways(scene)[way])
    cage = Cage.from_field(chosen, 60, faces=faces)
    inside = cage.contains(scene.cells)
    assert inside[chosen.mask.ravel()].all() and cage.check(field=chosen).usable
    lamp = scene.labels == LAMP
    assert inside[lamp & (scene.heights() > 2.6 * VOXEL)].all()
    for other in (TABLE, BALL):
        assert not inside[scene.labels == other].any()
    assert chosen.floor.heights(cage.vertices).min() > -1e-9
    if faces == "triangles":  # without the cut it would reach into the table
        free = NodeSelection(chosen.field, chosen.mask)
        assert Cage.from_field(free, 60).contains(scene.cells)[scene.labels == TABLE].any()


def test_depths_of_views_choose_what_they_show(table, device):
    field = table.field.to(device)
    turns = np.arange(8) * np.pi / 4
    cameras = [table.camera((2.9 * np.cos(a), 2.9 * np.sin(a), 1.7), 80) for a in turns]
    distance = np.stack([np.linalg.norm(table.cells - camera.center, axis=1) for camera in cameras])
    lamp = table.labels == LAMP
    near, far = distance[:, lamp].min() - VOXEL, distance[:, lamp].max() + VOXEL
    chosen = select_object(field, depth=(near, far), cameras=cameras, parts=1)
    mask = belongs(table, chosen, LAMP)
    assert np.array_equal(mask, select_object(field, point=table.world((-0.15, 0.1, 0.2))).mask.ravel())
    # farther than the lamp one view shows the edge of the table
    behind = distance[0, lamp].max() + 3 * VOXEL
    edge = select_nodes(field, depth=(behind, 9.0), cameras=cameras[:1]).mask.ravel()
    assert edge.any() and not edge[lamp].any()


def test_a_click_on_the_table_takes_the_table_off_the_floor(scene):
    chosen = select_object(scene.field, point=scene.world((0.5, 0.3, -0.22)))
    taken = set(np.unique(scene.labels[chosen.mask.ravel()]).tolist())
    assert {TABLE, LAMP, BALL} <= taken <= {TABLE, LAMP, BALL, FRAGMENT}


def test_planes_that_are_named(scene):
    up = scene.world((0, 0, 1))
    at_floor = select_object(scene.field, point=scene.world((0.4, -0.3, -0.05)), plane_at=scene.world((0.9, 0.9, -0.8)))
    assert {TABLE, LAMP, BALL} <= set(scene.labels[at_floor.mask.ravel()].tolist())
    given = Plane(up, -0.2)
    ball = select_object(scene.field, point=scene.world((0.4, -0.3, -0.05)), plane=given, clearance=2 * VOXEL)
    own = scene.labels == BALL
    assert np.array_equal(ball.mask.ravel() & own, own & (scene.heights() > 2 * VOXEL))
    both = select_object(scene.field, point=[scene.world((0.4, -0.3, 0)), scene.world((-0.15, 0.1, 0.2))])
    assert {LAMP, BALL} <= set(scene.labels[both.mask.ravel()].tolist()) <= {LAMP, BALL, FRAGMENT}
    alone = select_object(scene.field, box=[[-1] * 3, [1] * 3], plane=None)
    assert alone.floor is None and {TABLE, LAMP, BALL} <= set(scene.labels[alone.mask.ravel()].tolist())


def test_the_seat_of_a_chair_is_not_what_its_back_stands_on():
    x, y, z = (np.indices((64,) * 3) + 0.5) / 32 - 1
    floor = z < -0.8
    seat = (np.abs(x) < 0.35) & (np.abs(y) < 0.35) & (np.abs(z + 0.2) < 0.06)
    back = (np.abs(x) < 0.35) & (y > 0.28) & (y < 0.35) & (z > -0.2) & (z < 0.6)
    legs = (np.abs(np.abs(x) - 0.28) < 0.06) & (np.abs(np.abs(y) - 0.28) < 0.06) & (z < -0.2)
    chair = seat | back | legs
    field = GridField(100.0 * (floor | chair))
    chosen = select_object(field, point=(0.0, 0.32, 0.4))
    assert not (chosen.mask & ~chair).any() and chosen.mask[chair & (z > -0.7)].all()


def test_haze_joins_nothing():
    x, y, z = (np.indices((48,) * 3) + 0.5) / 24 - 1
    one, two = (np.sqrt((x - a) ** 2 + y**2 + (z + 0.1) ** 2) < 0.3 for a in (-0.5, 0.5))
    floor = z < -0.6
    haze = (np.abs(y) < 0.2) & (z > -0.5)
    field = GridField(np.where(one | two | floor, 80.0, np.where(haze, 1.0, 0.0)))
    chosen = select_object(field, point=(-0.5, 0, 0.0)).mask
    assert chosen[one & (z > -0.35)].all() and not (chosen & two).any()
    assert 0 < np.count_nonzero(chosen & haze & ~one) < 4000  # what is next to it alone


@pytest.mark.parametrize(("length", "depth"), [(40, 2), (300, 6)])
def test_fur_is_chosen_as_deep_as_the_object_is_fine(length, depth):
    """Around a bar of so many voxels, ten voxels of what is too faint for a surface."""
    i, j, k = np.indices((length + 24, 32, 32)) - np.array([12, 16, 16]).reshape(3, 1, 1, 1)
    beyond = np.max([-i, i - length + 1, np.abs(j) - 4, np.abs(k) - 4], axis=0)  # voxels from the bar
    voxel = 0.01
    densities = np.where(beyond <= 0, 2.0, np.where(beyond <= 10, 0.2, 0.0)) / voxel
    field = GridField(densities, lower=(0, 0, 0), upper=voxel * np.array(densities.shape))
    chosen = select_object(field, point=voxel * np.array([20.0, 16, 16]), plane=None).mask
    np.testing.assert_array_equal(chosen, beyond <= depth)


def test_a_pixel_shows_the_place_in_front(scene, device):
    field = scene.field.to(device)
    camera = scene.camera()
    up, table_top = scene.world((0, 0, 1)), scene.world((0.55, 0.3, -0.2))
    clicked = np.floor(camera.project(table_top[None])[0][0]).astype(int)
    _origins, rays = camera.rays()
    ray = rays[clicked[1], clicked[0]]
    exact = camera.center + ray * ((table_top - camera.center) @ up) / (ray @ up)
    assert np.linalg.norm(pick_point(field, camera, clicked) - exact) < 2.5 * VOXEL
    for label in (LAMP, BALL):
        place = pick_point(field, camera, scene.pixel_of(camera, label))
        assert np.linalg.norm(scene.cells[scene.labels == label] - place, axis=1).min() < 1.8 * VOXEL


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"point": (0, 0, 5)}, "is on nothing: nothing dense"),
        ({"point": "floor"}, "is on the ground plane, not on an object"),
        ({"point": "lamp", "plane": "wall"}, "no wall is found in the field"),
        ({"point": "lamp", "up": (1, 0, 0)}, "no ground plane is found"),
        ({"point": "lamp", "plane": "sky"}, "plane must be one of ground, wall, any"),
        ({"point": "lamp", "plane_at": (0, 0, 3)}, "passes near"),
        ({"point": "lamp", "clearance": 2.0}, "is on the ground plane"),
        ({"point": "lamp", "clearance": -1.0}, "clearance must not be negative"),
        ({"point": "lamp", "clearance": 0.1, "plane": None}, "choose one"),
        ({"point": "lamp", "plane": None, "plane_at": (0, 0, 0)}, "plane_at is a point on the plane"),
        ({"box": [[0.8, 0.8, 0.8], [0.9, 0.9, 0.9]]}, "outside the box"),
        ({"sphere": [0, 0, 0, -1]}, "sphere must be"),
        ({"sphere": [0, 0, 0.95, 0.02]}, "outside the sphere"),
        ({"cage": "box"}, "takes a ClosedMesh"),
        ({"depth": (1.0, 2.0)}, "cameras and depth"),
        ({"depth": (2.0, 1.0), "cameras": True}, "the nearer one first"),
        ({"depth": (0.0, 0.1), "cameras": True}, "not shown by the views"),
        ({"depth": (0.0, 9.0), "cameras": []}, "needs the cameras"),
        ({"pixel": (0, 0)}, "go together"),
        ({"pixel": (0, 0), "camera": True}, "is on nothing: the field is not half opaque"),
        ({"pixel": (96, 0), "camera": True}, "outside the picture of 96x96"),
        ({"pixel": (0.5, 1), "camera": True}, "two whole numbers"),
        ({"point": np.zeros((0, 3))}, "there is no click"),
    ],
)  # fmt: skip
def test_refusals(table, options, message):
    places = {"lamp": table.world((-0.15, 0.1, 0.2)), "floor": table.world((0.4, 0.4, -0.22))}
    camera = table.camera()
    put = {"point": lambda value: places.get(value, value) if isinstance(value, str) else value}
    given = {name: put.get(name, lambda value: value)(value) for name, value in options.items()}
    if given.get("camera") is True:
        given["camera"] = camera
    if given.get("cameras") is True:
        given["cameras"] = [camera]
    refused(lambda: select_object(table.field, **given), message)


@pytest.mark.parametrize("top", [0.8, 1.0])
@pytest.mark.parametrize("around", [False, True])
def test_an_object_that_reaches_a_side_of_the_box_is_told(top, around):
    """A post that ends below the box or at its top, before one colour or in an outer field that goes on there."""
    x, y, z = (np.indices((32,) * 3) + 0.5) / 16 - 1
    post = (np.abs(x) < 0.2) & (np.abs(y) < 0.2) & (z > -0.6) & (z < top)
    outer = random_outer("cpu")[0] if around else None
    sh = np.zeros((32, 32, 32, 9, 3), np.float32)
    field = VoxelField.from_dense(np.where(post, 60.0, 0.0), sh, [[-1.0] * 3, [1.0] * 3], device="cpu")
    field.background_model = outer
    chosen = select_object(field, point=(0, 0, 0), plane=None)
    notes = [note for note in chosen.notes if "of the field's box" in note]
    if around and top == 1.0:
        assert len(notes) == 1 and re.fullmatch(MESSAGES["field.cut_off"], notes[0])
    else:
        assert notes == []


def test_what_cannot_be_rendered_takes_no_pixels():
    field = GridField(np.full((8, 8, 8), 50.0))
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=8, height=8)
    refused(lambda: select_object(field, pixel=(4, 4), camera=camera), match="can be sampled")
    refused(lambda: select_object(field, depth=(1, 9), cameras=[camera]), match="can be rendered")
