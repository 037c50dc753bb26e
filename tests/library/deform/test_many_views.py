"""Many views by one call, and what pixels show beside colours, against single views, to_canonical and deform_points."""

import pickle

import numpy as np
import pytest
import warp as wp
from fields import BOX, box_around, make_field, plain, rotation, shiny_field, two_balls, view
from messages import MESSAGES
from refusals import refused
from splat_scenes import splats_in_box

from warpcage import CageEdit, Camera, Deformer, Frames, deform_points, turntable
from warpcage.core import recorded_launches

BENT = BOX.bend(40, axis="x", towards="z")
TWISTED = BOX.twist(50, axis="x")

#: Kinds of maps, with the cells of their lattice; None evaluates the closed form, by which pictures are small.
MAPS = [("harmonic", 32), ("mean_value", 32), ("green", 32), ("mean_value", None)]


def sized(resolution, usual):
    return usual if resolution else 16


def equal_frames(frames, others):
    return all(equal(*pair) for pair in zip(frames, others, strict=True))


def cameras_around(count=3, width=24, height=20):
    return turntable((0, 0, 0), 2.8, 25, count, fov_degrees=45, width=width, height=height)


def equal(frame, other):
    pairs = [(getattr(frame, name), getattr(other, name)) for name in other.arrays]
    return all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


def seen_points(frame):
    """Pixels (n, 2), rows and columns, of a frame that show anything, and the points (n, 3) at their depths."""
    pixels = np.argwhere(np.isfinite(frame.depth))
    origins, directions = frame.camera.rays()
    at = tuple(pixels.T)
    return pixels, origins[at] + frame.depth[at][:, None] * directions[at]


def expected_flow(pixels, camera, points):
    """Flow (n, 2) from the middle of pixels to points (n, 3), by the camera's projection in float64."""
    return camera.project(points)[0] - (pixels[:, ::-1] + 0.5)


# Many views


@pytest.mark.parametrize(("kind", "resolution", "supersampling"), [(*each, 1 + n % 2) for n, each in enumerate(MAPS)])
def test_views_of_one_call_are_those_of_a_loop(kind, resolution, supersampling, device):
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=resolution).pose(BENT)
    cameras = cameras_around(3, sized(resolution, 24) // 2, 10)
    frames = deformer.render(cameras, background="black", supersampling=supersampling)
    loop = [deformer.render(camera, background="black", supersampling=supersampling) for camera in cameras]
    assert len(frames) == 3 and frames[1].camera is cameras[1] and isinstance(frames, Frames)
    assert equal_frames(frames, loop)
    for name in loop[0].arrays:
        assert np.array_equal(getattr(frames, name), np.stack([getattr(frame, name) for frame in loop]))
    assert equal(deformer.posed(TWISTED).render(cameras)[2], deformer.posed(TWISTED).render(cameras[2]))


def test_poses_of_one_call_are_those_of_a_loop(device):
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24).pose(TWISTED)
    camera, cameras = view(size=32), cameras_around(3, 32, 32)
    poses, own = [BENT, BOX.translate([0.1, 0, 0]), BENT.scale(0.8)], deformer.render(camera)
    frames = deformer.render_poses(poses, camera)
    assert equal_frames(frames, [deformer.posed(pose).render(camera) for pose in poses])
    assert equal(deformer.render(camera), own)
    frames = deformer.render_poses(np.stack([pose.vertices for pose in poses]), cameras)
    loop = [deformer.posed(pose).render(camera) for pose, camera in zip(poses, cameras, strict=True)]
    assert equal_frames(frames, loop)


def test_poses_of_several_edits(device):
    cages = [box_around(-0.5, 0, 0), box_around(0.5, 0, 0)]
    deformer = Deformer(two_balls(device), cages, coordinates="mean_value", resolution=24)
    poses = [[cages[0].translate([0, 0, h]), cages[1].translate([0, 0, -h])] for h in (0.1, 0.3)]
    frames = deformer.render_poses(poses, view(size=32))
    assert equal_frames(frames, [deformer.pose(pose).render(view(size=32)) for pose in poses])


def test_densities_are_looked_at_once_a_call(device):
    """What the host waits for at each frame of a loop."""
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24).pose(BENT)
    deformer.render(view(size=16))
    with recorded_launches() as labels:
        deformer.render(cameras_around(4))
    looks = "occupancy.note_densities" if device == "cpu" else "occupancy.note_signs"
    assert labels.count(looks) == 1
    field = deformer.field
    field.grid.density.assign(0.5 * field.grid.density.numpy())
    assert equal(deformer.render(cameras_around(2))[1], deformer.render(cameras_around(2)[1]))


def test_splats_too(device):
    deformer = Deformer(splats_in_box(device), BOX, coordinates="mean_value").pose(BENT)
    cameras = cameras_around()
    frames = deformer.render(cameras)
    assert equal_frames(frames, [deformer.render(camera) for camera in cameras])
    frames = deformer.render_poses([TWISTED, BENT], cameras[0])
    assert equal(frames[1], deformer.render(cameras[0])) and not equal(frames[0], frames[1])
    refused(lambda: deformer.render(cameras, outputs=["canonical"]), match="splats move forward")


def test_frames_are_pickled_as_numpy():
    deformer = Deformer(shiny_field("cpu"), BOX, coordinates="mean_value", resolution=16).pose(BENT)
    frames = deformer.render(cameras_around(2), outputs="instance")
    copied = pickle.loads(pickle.dumps(frames))
    assert repr(copied) == repr(frames) and np.array_equal(copied.instance, frames.instance)
    assert copied[1].instance.dtype == np.int32 and [len(copied), len(copied[:1])] == [2, 1]
    for given in (np.zeros(1), wp.zeros(1, dtype=float, device="cpu")):
        found = copied.arrays_like(given)
        assert {type(each) for each in found.values()} == {type(given)} and found["rgb"].shape == (2, 20, 24, 3)
        np.testing.assert_array_equal(np.asarray(found["instance"]), frames.instance)


# What pixels show


@pytest.mark.parametrize(("kind", "resolution"), MAPS)
def test_canonical_positions_are_those_of_points_at_the_depth(kind, resolution, device):
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=resolution).pose(BENT)
    camera = view(size=sized(resolution, 40))
    frame = deformer.render(camera, outputs=["rgb", "canonical", "instance"])
    assert equal(frame, deformer.render(camera, outputs=["canonical", "instance"]))
    pixels, points = seen_points(frame)
    at = tuple(pixels.T)
    places, _, region = deformer.to_canonical(points, np.ones_like(points))
    there = region != 1
    assert there.mean() > 0.9
    np.testing.assert_allclose(frame.canonical[at][there], places[there], atol=2e-5)
    assert np.isnan(frame.canonical[at][~there]).all() and np.isnan(frame.canonical[np.isinf(frame.depth)]).all()
    np.testing.assert_array_equal(frame.instance[at], np.where(region == 2, 0, -1))
    assert (frame.instance[np.isinf(frame.depth)] == -1).all()


def test_far_from_zero_places_are_those_of_the_world(device):
    origin = np.array([4000.0, -2000.0, 1000.0])
    near = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24).pose(BENT)
    far = Deformer(shiny_field(device, origin=origin), BOX.translate(origin), coordinates="mean_value", resolution=24)
    far.pose(BENT.translate(origin))
    motion = np.eye(4)
    motion[:3, 3] = origin
    camera = view(size=32)
    options = {"outputs": ["canonical", "flow"]}
    here = near.render(camera, **options, flow_pose=TWISTED)
    there = far.render(camera.moved(motion), **options, flow_pose=TWISTED.translate(origin))
    np.testing.assert_allclose(there.canonical - origin, here.canonical, atol=2e-3)
    np.testing.assert_allclose(there.flow, here.flow, atol=2e-2)


def test_instances_are_the_edits_that_hold_what_is_seen(device):
    """Two balls, the second of which leaves a copy where it was; a third ball that nobody touches."""

    def density(x):
        distances = [np.linalg.norm(x - center, axis=-1) for center in ((-0.5, 0, 0), (0.5, 0, 0), (0, 0, 0.6))]
        return np.where(np.min(distances, axis=0) < 0.2, 60.0, 0.0)

    field = make_field(density, plain([0.5, 0.5, 0.5]), device=device)
    cages = [box_around(-0.5, 0, 0, half=0.28), box_around(0.5, 0, 0, half=0.28)]
    deformer = Deformer(
        field, [cages[0], CageEdit(cages[1], keep_source=True)], coordinates="mean_value", resolution=24
    )
    deformer.pose([cages[0].translate([0, 0, -0.5]), cages[1].translate([0, 0, -0.6])])
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=64, height=64, fov_degrees=32)
    frame = deformer.render(camera, outputs=["instance", "canonical"])
    for place, number, rest in [
        ((-0.5, 0, -0.5), 0, (-0.5, 0, 0)),
        ((0.5, 0, -0.6), 1, (0.5, 0, 0)),
        ((0.5, 0, 0), -1, (0.5, 0, 0)),
        ((0, 0, 0.6), -1, (0, 0, 0.6)),
    ]:
        ((column, row),), _ = camera.project([place])
        pixel = int(row), int(column)
        assert frame.alpha[pixel] > 0.95 and frame.instance[pixel] == number
        np.testing.assert_allclose(frame.canonical[pixel][[0, 2]], np.array(rest)[[0, 2]], atol=0.05)
    assert set(np.unique(frame.instance)) == {-1, 0, 1}


# Flow


def test_flow_to_another_camera_is_what_it_sees_of_the_points(device):
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24).pose(BENT)
    cameras = cameras_around(3)
    others = [cameras[2].resized(80, 48), *cameras[:2]]
    frames = deformer.render(cameras, outputs="flow", flow_camera=others)
    for frame, other in zip(frames, others, strict=True):
        pixels, points = seen_points(frame)
        np.testing.assert_allclose(frame.flow[tuple(pixels.T)], expected_flow(pixels, other, points), atol=2e-3)
        assert np.isnan(frame.flow[np.isinf(frame.depth)]).all()
    behind = Camera.look_at((0, 0, -9), (0, 0, -10), width=8, height=8)
    assert np.isnan(deformer.render(cameras[0], outputs="flow", flow_camera=behind).flow).all()


@pytest.mark.parametrize(("kind", "resolution"), MAPS)
def test_flow_to_a_moved_pose_is_the_motion_of_points(kind, resolution, device):
    """Rigid motions are what all maps reproduce: forward positions are deform_points of the canonical ones."""
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=resolution)
    shifted = BOX.translate([0.12, -0.05, 0.08])
    turned = BOX.with_vertices(BOX.vertices @ rotation(25, 15).T + np.array([0.05, 0.1, 0.0]))
    size = sized(resolution, 40)
    camera, other = view(size=size), view(eye=(2.0, 1.8, 1.2), size=size)
    deformer.pose(shifted)
    still = deformer.render(camera, outputs=["flow"], flow_pose=BOX)
    pixels, points = seen_points(still)
    found = still.flow[tuple(pixels.T)]
    there = np.isfinite(found).all(axis=1)
    assert there.mean() > 0.98
    moved = expected_flow(pixels, camera, points - [0.12, -0.05, 0.08])
    np.testing.assert_allclose(found[there], moved[there], atol=5e-3)
    frame = deformer.render(camera, outputs=["canonical", "flow"], flow_pose=turned, flow_camera=other)
    pixels, _ = seen_points(frame)
    at = tuple(pixels.T)
    there = np.isfinite(frame.flow[at]).all(axis=1) & np.isfinite(frame.canonical[at]).all(axis=1)
    assert there.mean() > 0.98
    points = deform_points(frame.canonical[at][there].astype(np.float64), BOX, turned, "mean_value")
    np.testing.assert_allclose(frame.flow[at][there], expected_flow(pixels[there], other, points), atol=2e-2)
    assert equal(deformer.render(camera), deformer.pose(shifted).render(camera))  # the pose is what it was


@pytest.mark.parametrize(("kind", "resolution"), MAPS)
def test_flow_to_a_bent_pose_leads_to_the_same_matter(kind, resolution, device):
    """On the ray of the other camera that flow leads to, some point has the canonical position of the pixel."""
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=resolution).pose(TWISTED)
    size = sized(resolution, 32)
    camera, other = view(size=size), view(eye=(2.2, 1.6, 0.6), size=size)
    frame = deformer.render(camera, outputs=["canonical", "flow"], flow_pose=BENT, flow_camera=other)
    pixels = np.argwhere(np.isfinite(frame.canonical).all(axis=-1))
    assert np.isfinite(frame.flow[tuple(pixels.T)]).all(axis=1).mean() > 0.95
    chosen = [tuple(pixel) for pixel in pixels[:: len(pixels) // 12] if np.isfinite(frame.flow[tuple(pixel)]).all()]
    deformer.pose(BENT)
    times = np.linspace(1.8, 4.0, 1101)
    for pixel in chosen:
        u, v = np.array(pixel)[::-1] + 0.5 + frame.flow[pixel]
        along = other.rotation @ [(u - other.cx) / other.fx, (v - other.cy) / other.fy, 1.0]
        points = other.center + times[:, None] * along / np.linalg.norm(along)
        places, _, region = deformer.to_canonical(points, np.ones_like(points))
        away = np.linalg.norm(places - frame.canonical[pixel], axis=1)
        assert away[region == 2].min() < 2e-3


def test_flow_of_poses(device):
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24)
    poses, others = [BOX, BENT], [BENT, TWISTED]
    frames = deformer.render_poses(poses, view(size=24), outputs=["flow", "instance"], flow_poses=others)
    for frame, pose, other in zip(frames, poses, others, strict=True):
        alone = deformer.pose(pose).render(view(size=24), outputs=["flow", "instance"], flow_pose=other)
        assert equal(frame, alone)


def middle_of(frame, place):
    """The pixel that shows a place, and the point that it shows."""
    ((column, row),), _ = frame.camera.project([place])
    pixels, points = seen_points(frame)
    return (int(row), int(column)), points[(pixels == [int(row), int(column)]).all(axis=1)][0]


@pytest.mark.parametrize(
    ("keeps", "first", "then", "moved"),
    [
        (False, [(0, 0, 0.6), (0.05, 0, 0)], [(0, 0, 0.5), (0, 0, -0.5)], {(-0.5, 0, 0.6): (0, 0, -0.1)}),
        (
            True,
            [(0, 0, 0.6), (0, 0, 0)],
            [(0, 0, -0.6), (0, 0, 0)],
            {(-0.5, 0, 0.6): (0, 0, -1.2), (-0.5, 0, 0): (0, 0, 0)},
        ),
        (False, [(1, 0, 0), (0, 0, 0.6)], [(1, 0, 0), (0, 0, -0.4)], {(0.5, 0, 0.6): (0, 0, -1.0)}),
        (False, [(1, 0, 0), (0, 0, 0.6)], [(0, 0, 0.5), (0, 0, 0)], {(0.5, 0, 0.6): (-1, 0, -0.1)}),
    ],
    ids=["beside each other", "a copy and what it is of", "one after the other", "one of the two alone"],
)
def test_flow_goes_by_all_edits(keeps, first, then, moved, device):
    """Two balls, each in a cage; one cage may put its ball into the other, which takes it on."""
    cages = [box_around(-0.5, 0, 0), box_around(0.5, 0, 0)]
    edits = [CageEdit(cages[0], keep_source=keeps), CageEdit(cages[1])]
    deformer = Deformer(two_balls(device), edits, coordinates="mean_value", resolution=24)
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=48, height=48, fov_degrees=40)
    start, end = ([cage.translate(shift) for cage, shift in zip(cages, pose, strict=True)] for pose in (first, then))
    frame = deformer.pose(start).render(camera, outputs=["flow"], flow_pose=end)
    for place, motion in moved.items():
        pixel, point = middle_of(frame, place)
        expected = expected_flow(np.array([pixel]), camera, (point + motion)[None])[0]
        np.testing.assert_allclose(frame.flow[pixel], expected, atol=2e-2)


def test_what_another_pose_shows_nowhere_has_no_flow(device):
    """A ball over which the other pose puts the empty content of a cage."""
    cage = box_around(0, 0, 0.6)
    deformer = Deformer(two_balls(device), cage, coordinates="mean_value", resolution=24)
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=48, height=48, fov_degrees=40)
    frame = deformer.render(camera, outputs=["flow"], flow_pose=cage.translate([0.5, 0, -0.6]))
    assert np.isnan(frame.flow[middle_of(frame, (0.5, 0, 0))[0]]).all()
    np.testing.assert_allclose(frame.flow[middle_of(frame, (-0.5, 0, 0))[0]], 0, atol=2e-3)


REFUSED = {
    MESSAGES["views.sizes"]: lambda deformer: deformer.render([view(size=32), view(size=24)]),
    MESSAGES["views.none"]: lambda deformer: deformer.render([]),
    MESSAGES["views.output"]: lambda deformer: deformer.render(view(), outputs=["canonicl"]),
    MESSAGES["views.no_output"]: lambda deformer: deformer.render(view(), outputs=None),
    MESSAGES["views.aim"]: lambda deformer: deformer.render(view(), outputs=["flow"]),
    MESSAGES["views.asked"]: lambda deformer: deformer.render(view(), flow_pose=BENT),
    MESSAGES["views.counts"]: lambda deformer: deformer.render_poses([BOX, BENT], [view()] * 3),
    MESSAGES["views.flow_counts"]: lambda deformer: deformer.render_poses(
        [BOX, BENT], view(), outputs="flow", flow_poses=[BOX]
    ),
    MESSAGES["views.poses"]: lambda deformer: deformer.render_poses("walk.npz", view()),
    "render needs a Camera, got str": lambda deformer: deformer.render([view(), "left"]),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refusals(message):
    deformer = Deformer(shiny_field("cpu", resolution=12), BOX, coordinates="mean_value", resolution=8)
    refused(lambda: REFUSED[message](deformer), match=message)
