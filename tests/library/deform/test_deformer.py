"""The deformed scene against fields seen by moved cameras, float64 references and closed forms of optical depth."""

import numpy as np
import oracles
import pytest
import warp as wp
from fields import (
    BOX,
    KINDS,
    SIZE,
    OnlyDLPack,
    alter_map,
    counter_moved,
    ellipsoid,
    make_field,
    march_in_numpy,
    mirrored,
    plain,
    psnr,
    rotation,
    shiny,
    shiny_field,
    view,
)

from warpcage import Cage, Camera, Deformer
from warpcage.coordinates import stretched_normals

# -- Poses whose picture is known


@pytest.mark.parametrize(("kind", "resolution"), [("harmonic", 64), ("mean_value", 32), ("green", 32)])
def test_poses_whose_picture_another_camera_sees(kind, resolution, device):
    """At rest, rigid poses and scaled ones, one after the other."""
    field, camera = shiny_field(device), view()
    still = field.render(camera)
    deformer = Deformer(field, BOX, coordinates=kind, resolution=resolution)
    for frame in (deformer.render(camera), deformer.pose(BOX).render(camera)):
        assert psnr(frame.rgb, still.rgb) > 50
        seen = still.alpha > 0.5
        np.testing.assert_allclose(frame.depth[seen], still.depth[seen], atol=1e-3)
        assert frame.reveal.max() == frame.fold.max() == frame.outside.max() == 0

    turn, offset = rotation(40, 25), np.array([0.1, -0.05, 0.15])
    frame = deformer.pose(BOX.with_vertices(BOX.vertices @ turn.T + offset)).render(camera)
    assert psnr(frame.rgb, field.render(counter_moved(camera, turn, offset)).rgb) > 45
    assert psnr(frame.rgb, still.rgb) < 30  # the pose is not a small one
    assert frame.fold.max() == frame.outside.max() == 0

    for scale in (0.5, 1.7):
        pose = camera.camera_to_world.copy()
        pose[:3, 3] /= scale
        expected = field.render(Camera(camera.fx, camera.fy, camera.cx, camera.cy, SIZE, SIZE, pose))
        frame = deformer.pose(BOX.scale(scale, center=(0, 0, 0))).render(camera)
        assert psnr(frame.rgb, expected.rgb) > 45


def test_a_scene_far_from_zero(device):
    """Float32 positions at 1e5 would be off by a fifth of a voxel."""
    origin = np.array([1e5, -3e5, 2e5])
    near, far = shiny_field(device), shiny_field(device, origin=origin)
    camera = view()
    moved = np.eye(4)
    moved[:3, 3] = origin
    pose = BOX.twist(50)
    expected = Deformer(near, BOX, resolution=32).pose(pose).render(camera)
    frame = Deformer(far, BOX.translate(origin), resolution=32).pose(pose.translate(origin)).render(camera.moved(moved))
    assert psnr(frame.rgb, expected.rgb) > 60


# -- The march against a march in NumPy


def test_the_march_composites_what_to_canonical_says_and_directions_follow(device):
    field, camera = shiny_field(device), view(size=28)
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=32).pose(BOX.rotate(70).bend(60, towards="y"))
    frame = deformer.render(camera)
    assert psnr(frame.rgb, march_in_numpy(field, deformer, camera)) > 45
    # the same with directions left alone fails: the scene is shiny enough to tell
    assert psnr(frame.rgb, march_in_numpy(field, deformer, camera, with_directions=False)) < 25


@pytest.mark.parametrize("kind", KINDS)
def test_skipping_empty_cells_changes_nothing(kind, device):
    field, camera = shiny_field(device), view()
    pose = BOX.twist(100, axis="x").translate([0.3, 0, 0])
    deformer = Deformer(field, BOX, coordinates=kind, resolution=32).pose(pose)
    skipped = deformer.render(camera)
    edits = deformer.posed_edits()
    assert all((skip.numpy() > 0).mean() > 0.3 for skip in edits.lattices.skips)  # there is something to skip
    for skip in edits.lattices.skips:
        skip.zero_()
    edits.tables.fill(edits.lattices.posed())
    assert psnr(deformer.render(camera).rgb, skipped.rgb) > 80


def test_matter_beside_a_deformed_cage_stays(device):
    """A ball in a corner of the box of the pose's lattice that the pose itself leaves free."""
    field = make_field(lambda x: ellipsoid(x, (0.42, 0.42, 0), (0.1, 0.1, 0.1)), shiny, device=device)
    cage = Cage.box([-0.2] * 3, [0.2] * 3)
    pose = cage.rotate(45).scale(2.0, center=(0, 0, 0))
    frame = Deformer(field, cage, resolution=32).pose(pose).render(view())
    assert psnr(frame.rgb, field.render(view()).rgb) > 60


def test_a_compressed_thin_sheet_is_not_jumped_over(device):
    """A sheet two voxels thick, squeezed by 12, is a tenth of a march step thick."""

    def sheet(x):
        return np.where(np.abs(x[..., 0]) < 0.05, 40.0, 0.0)

    field = make_field(sheet, plain([0.2, 0.4, 0.8]), device=device)
    cage = Cage.box([-0.9, -1.1, -1.1], [0.9, 1.1, 1.1])
    pose = cage.scale([1 / 12, 1, 1], center=(0, 0, 0))
    camera = Camera.look_at([3.0, 0.1, 0.05], (0, 0, 0), width=24, height=24, fov_degrees=12)
    frame = Deformer(field, cage, coordinates="mean_value", resolution=64).pose(pose).render(camera)
    thickness = 40 * 0.05 * 2  # two voxels of 0.05 in canonical arc length, trilinear ramps included
    np.testing.assert_allclose(frame.alpha, 1 - np.exp(-thickness), atol=0.02)


# -- Optical depth


@pytest.mark.parametrize(
    ("density", "stretched_along", "factor"),
    [("opacity", 0, 1.0), ("paper", 0, 2.0), ("opacity", 2, 1.0), ("paper", 2, 1.0)],
)
def test_optical_depth_of_a_stretched_part(density, stretched_along, factor, device):
    """A ray along x through 0.8 of matter of density 1.5, stretched to twice its size along x or across it."""

    def slab(x):
        return np.where(np.abs(x).max(axis=-1) < 0.4, 1.5, 0.0)

    field = make_field(slab, plain([0.5, 0.5, 0.5]), device=device)
    cage = Cage.box([-0.6] * 3, [0.6] * 3)
    sizes = np.ones(3)
    sizes[stretched_along] = 2.0
    camera = Camera.look_at([4.0, 0.02, 0.03], (0, 0.02, 0.03), width=4, height=4, fov_degrees=2)
    frame = (
        Deformer(field, cage, coordinates="mean_value", resolution=32, density=density)
        .pose(cage.scale(sizes, center=(0, 0, 0)))
        .render(camera)
    )
    np.testing.assert_allclose(-np.log1p(-frame.alpha), 1.5 * 0.8 * factor, rtol=0.01)


# -- The three cases


def two_balls(x):
    return ellipsoid(x, (-0.35, 0, 0), (0.25, 0.25, 0.25)) + ellipsoid(x, (0.6, 0, 0), (0.2, 0.2, 0.2))


def test_what_moves_away_reveals_what_lies_behind(device):
    def back_ball(x):
        return ellipsoid(x, (-0.35, 0, 0), (0.25, 0.25, 0.25))

    color = plain([0.8, 0.3, 0.1])
    field = make_field(two_balls, color, device=device)
    camera = Camera.look_at([4.0, 0, 0], (0, 0, 0), width=48, height=48, fov_degrees=30)
    cage = Cage.box([0.3, -0.3, -0.3], [0.9, 0.3, 0.3])
    frame = Deformer(field, cage, resolution=32).pose(cage.translate([0, 0, 5.0])).render(camera)
    expected = make_field(back_ball, color, device=device).render(camera)
    assert psnr(frame.rgb, expected.rgb) > 50
    front = make_field(lambda x: ellipsoid(x, (0.6, 0, 0), (0.2, 0.2, 0.2)), color, device=device).render(camera)
    np.testing.assert_allclose(frame.reveal, front.alpha, atol=5e-3)
    # seen from the other side the ball that stays is in front: it hides what was cleared behind it
    behind = Camera.look_at([-4.0, 0, 0], (0, 0, 0), width=48, height=48, fov_degrees=30)
    frame = Deformer(field, cage, resolution=32).pose(cage.translate([0, 0, 5.0])).render(behind)
    assert frame.reveal[24, 24] < 0.01


def affine_pose():
    matrix = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.25], [0.1, 0.0, 1.1]])
    offset = np.array([0.5, -0.2, 0.1])
    return matrix, offset, BOX.with_vertices(BOX.vertices @ matrix.T + offset)


def in_box(x, margin):
    return (np.abs(x) < np.array([0.75, 0.55, 0.4]) + margin).all(axis=1)


@pytest.mark.parametrize(("kind", "resolution"), [("harmonic", 48), ("mean_value", 48), ("mean_value", None)])
def test_to_canonical_of_an_affine_pose(kind, resolution, device):
    matrix, offset, pose = affine_pose()
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=resolution).pose(pose)
    random = np.random.default_rng(3)
    points = random.uniform(-1.6, 1.6, (20000, 3))
    directions = random.normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x, d, region = deformer.to_canonical(points, directions)

    back = (points - offset) @ np.linalg.inv(matrix).T
    margin = 0.02  # what the trilinear distance may err by at edges
    mapped = in_box(back, -margin)
    cleared = ~in_box(back, margin) & in_box(points, -margin)
    unchanged = ~in_box(back, margin) & ~in_box(points, margin)
    assert min(mapped.sum(), cleared.sum(), unchanged.sum()) > 100
    assert (region[mapped] == 2).all() and (region[cleared] == 1).all() and (region[unchanged] == 0).all()
    np.testing.assert_allclose(x[mapped], back[mapped], atol=2e-5)
    along = directions @ np.linalg.inv(matrix).T
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(d[mapped], along[mapped], atol=2e-3)
    np.testing.assert_array_equal(x[region != 2], points[region != 2])
    np.testing.assert_allclose(d[region != 2], directions[region != 2], atol=1e-7)


@pytest.mark.parametrize("resolution", [64, None])
def test_to_canonical_of_a_bend_against_float64_weights(resolution, device):
    """Positions by the half-angle form in extended precision, directions by differences of those."""
    deformed = BOX.bend(50, axis="x", towards="z")
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=resolution).pose(deformed)
    center = deformed.vertices.mean(axis=0)
    points = center + 0.8 * (oracles.inside_points(deformed.vertices, deformed.faces, 120) - center)
    directions = np.random.default_rng(0).normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    inside = oracles.winding_numbers(points, deformed.vertices, deformed.faces) > 0.5
    x, d, region = deformer.to_canonical(points, directions)

    def phi(y):
        return np.asarray(oracles.mean_value_weights(y, deformed.vertices, deformed.faces) @ BOX.vertices, float)

    away = inside & (region == 2)
    assert away.sum() > 0.95 * inside.sum()
    np.testing.assert_allclose(x[away], phi(points[away]), atol=2e-4 if resolution is None else 2e-3)
    step = 0.5 * deformer.field.step
    slope = (phi(points + step * directions) - phi(points - step * directions)) / (2 * step)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((slope[away] * d[away]).sum(axis=1), -1, 1)))
    assert np.percentile(angle, 95) < 3.0
    turned = np.degrees(np.arccos(np.clip((slope[away] * directions[away]).sum(axis=1), -1, 1)))
    assert np.median(turned) > 8  # the bend does turn them


def test_to_canonical_at_the_cage_looks_back(device):
    """Directions of points whose next step leaves the cage come from the step before."""
    turn = rotation(50, 30)
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=48).pose(
        BOX.with_vertices(BOX.vertices @ turn.T)
    )
    inner = np.array([[0.749, 0.1, 0.1], [-0.749, 0.2, -0.1], [0.1, 0.549, 0.0], [0.1, 0.2, -0.399]])
    outward = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, -1]])
    _, d, region = deformer.to_canonical(inner @ turn.T, outward @ turn.T)
    assert (region == 2).all()
    np.testing.assert_allclose(d, outward, atol=1e-3)


def test_arrays_of_a_device_stay_there(device):
    _, _, pose = affine_pose()
    deformer = Deformer(shiny_field(device, origin=(3, 2, 1)), BOX.translate([3, 2, 1]), resolution=24)
    deformer.pose(pose.translate([3, 2, 1]))
    points = np.random.default_rng(0).uniform(-1.6, 1.6, (300, 3)).astype(np.float32) + np.float32([3, 2, 1])
    directions = np.tile(np.float32([0, 0, 1]), (300, 1))
    expected = deformer.to_canonical(points, directions)
    assert all(isinstance(array, np.ndarray) for array in expected)
    assert expected[0].dtype == np.float32 and deformer.to_canonical(points.astype(float), directions)[0].dtype == float
    on_device = [wp.array(array, dtype=wp.vec3, device=device) for array in (points, directions)]
    foreign = [OnlyDLPack(wp.array(array, dtype=wp.float32, device=device)) for array in (points, directions)]
    for given in (on_device, foreign):
        got = deformer.to_canonical(*given)
        assert all(isinstance(array, wp.array) and array.device == wp.get_device(device) for array in got)
        for ours, reference in zip(got, expected, strict=True):
            np.testing.assert_allclose(ours.numpy(), reference, atol=2e-6)
    assert [len(array) for array in deformer.to_canonical(np.zeros((0, 3)), np.zeros((0, 3)))] == [0, 0, 0]


# -- Masks


def test_samples_that_leave_the_rest_cage_are_empty_and_marked(device):
    """Green coordinates do not reproduce a stretch: their map bulges out of the rest cage, into a solid background."""
    stretched = BOX.stretch(1.6, axis="z")
    field = make_field(lambda x: np.full(x.shape[:3], 20.0), plain([0.5, 0.5, 0.5]), device=device)
    for resolution in (48, None):
        deformer = Deformer(field, BOX, coordinates="green", resolution=resolution).pose(stretched)
        points = oracles.inside_points(stretched.vertices, stretched.faces, 800)
        x, _, region, outside = deformer.to_canonical(points, np.tile([0.0, 0, 1], (800, 1)), return_outside=True)
        phi, psi = oracles.green_weights(points, stretched.vertices, stretched.faces)
        exact = phi @ BOX.vertices + psi @ stretched_normals(stretched, BOX)
        margin = 0.03
        center = stretched.bounds.mean(axis=0)
        deep = (np.abs(points - center) < 0.5 * np.ptp(stretched.bounds, axis=0) - margin).all(axis=1)
        leaves, stays = deep & ~in_box(exact, margin), deep & in_box(exact, -margin)
        assert leaves.sum() > 20
        assert (outside[leaves] == 1).all() and (region[leaves] == 1).all()
        assert (outside[stays] == 0).all() and (region[stays] == 2).all()
        np.testing.assert_array_equal(x[outside == 1], np.float64(points[outside == 1]))

    away = stretched.translate([0, 0, 4])
    camera = Camera.look_at([6.0, 0, 4], (0, 0, 4), width=32, height=32, fov_degrees=24)
    green, harmonic = (
        Deformer(field, BOX, coordinates=kind, resolution=48).pose(away).render(camera)
        for kind in ("green", "harmonic")
    )
    assert green.outside.max() > 2 and harmonic.outside.max() == 0


def test_a_map_that_turns_over_is_marked(device):
    """Positions mirrored by hand: the whole picture folds, and is the mirror image."""
    field, camera = shiny_field(device), view()
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=32).pose(BOX)
    assert deformer.render(camera).fold.max() == 0
    alter_map(deformer, mirrored)
    frame = deformer.pose(BOX).render(camera)
    np.testing.assert_allclose(frame.fold, frame.alpha, atol=0.05)
    assert frame.fold.max() > 0.9
    mirror = field.render(view((-2.5, 1.2, 1.0))).alpha[:, ::-1]
    assert np.abs(frame.alpha - mirror).mean() < 1e-3


# -- Precise mode


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_the_lattice_agrees_with_the_closed_forms(kind, device):
    field, camera = shiny_field(device), view(size=40)
    cage = Cage.box([-0.75, -0.55, -0.4], [0.75, 0.55, 0.4])
    pose = cage.twist(35, axis="x")
    precise = Deformer(field, cage, coordinates=kind, resolution=None).pose(pose).render(camera)
    lattice = Deformer(field, cage, coordinates=kind, resolution=64).pose(pose).render(camera)
    assert psnr(precise.rgb, lattice.rgb) > 40
    assert psnr(precise.rgb, field.render(camera).rgb) < 35
    assert precise.fold.max() == 0


# -- Cameras and cages in odd places


def test_a_camera_inside_the_cage(device):
    field = make_field(lambda x: ellipsoid(x, (0.5, 0, 0), (0.2, 0.2, 0.2)), shiny, device=device)
    cage = Cage.box([-0.9] * 3, [0.9] * 3)
    camera = Camera.look_at([-0.5, 0.1, 0.05], (0.5, 0, 0), width=40, height=40, fov_degrees=60)
    turn = rotation(20, 10)
    frame = Deformer(field, cage, resolution=32).pose(cage.with_vertices(cage.vertices @ turn.T)).render(camera)
    assert psnr(frame.rgb, field.render(counter_moved(camera, turn, np.zeros(3))).rgb) > 45


def test_an_edit_beside_the_field_changes_nothing(device):
    field, camera = shiny_field(device), view()
    cage = BOX.translate([5, 0, 0])
    frame = Deformer(field, cage, resolution=24).pose(cage.translate([0, 9, 0])).render(camera)
    # on CUDA the field's own frame takes each voxel's colour at the voxel: 70 dB with voxels as coarse as these
    assert psnr(frame.rgb, field.render(camera).rgb) > (80 if wp.get_device(device).is_cpu else 65)


def test_background_and_step(device):
    field, camera = shiny_field(device), view()
    deformer = Deformer(field, BOX, resolution=24)
    np.testing.assert_allclose(deformer.render(camera, background=(0, 0.5, 1)).rgb[0, 0], [0, 0.5, 1], atol=1e-6)
    coarse = deformer.render(camera, step=3 * field.step)
    assert psnr(coarse.rgb, field.render(camera, step=3 * field.step).rgb) > 50
