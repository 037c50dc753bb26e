"""Voxels that a pose moves, shaded once for a camera: where the pose takes them, whence they are seen, and views."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fields import (
    BOX,
    KINDS,
    alter_map,
    ball,
    box_around,
    counter_moved,
    make_field,
    marches,
    mirrored,
    psnr,
    shiny,
    shiny_field,
    slotted,
    two_balls,
    use_march,
    view,
)

from warpcage import Cage, CageEdit, Deformer
from warpcage.core import launch, recorded_launches
from warpcage.field import tables
from warpcage.kernels.render.volume import ALL_LAYERS, COLOR_LAYERS, ShadedVolume, shaded_value, write_shaded_volume

TURN = BOX.rotate(35, axis="z").translate([0.2, -0.1, 0.15])
BEND = BOX.bend(60, axis="x", towards="z")


@pytest.fixture(autouse=True)
def march(device, monkeypatch):
    return use_march("shaded", device, monkeypatch)


def assert_marched_by(table, launched):
    """By that of one edit or those of parts, with sides or without."""
    found = marches(launched)
    assert found and {label.partition("+")[0] for label in found} == {table}


def shaded(deformer, camera):
    """A frame of shaded voxels."""
    with recorded_launches() as launched:
        frame = deformer.render(camera)
    assert_marched_by("views.shaded", launched)
    return frame


def of_rows(deformer, camera):
    """The same, whose colours are looked up at each sample."""
    with pytest.MonkeyPatch.context() as patch, recorded_launches() as launched:
        patch.setattr(tables, "NEAR_VOXELS", np.inf)
        frame = deformer.render(camera)
    assert_marched_by("views.rows", launched)
    return frame


def found_places(deformer):
    """Of the only edit: nodes of the rest lattice that are taken somewhere (m, 3), where in the posed lattice (m, 3),
    the signed distance of all nodes to the rest cage, and whether each is taken somewhere."""
    ((edit, places, _),) = deformer.posed_edits().carried_colors.posed
    places, distance = places.numpy(), edit.rest.distance.numpy()
    taken = places[..., 3] > 0
    return edit, np.argwhere(taken), places[taken][:, :3], distance, taken


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pose", [TURN, BEND, BOX.scale([0.5, 1.4, 1.0])], ids=["turn", "bend", "squeeze"])
def test_the_map_leads_back_from_where_nodes_are_taken(pose, kind, device):
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=24).pose(pose)
    deformer.render(view())
    edit, nodes, places, distance, taken = found_places(deformer)
    counts = tuple(edit.node_counts)
    canonical = oracle.trilinear(edit.nodes.numpy().reshape(*counts, 4), places.astype(float))[:, :3]
    back = (canonical - np.array(edit.rest.lower)) * edit.rest.inverse_spacing
    assert np.abs(back - nodes).max() < 5e-3
    if kind != "green":  # whose map leaves some of the rest cage out
        assert taken[distance < -1.5 * edit.rest.spacing].all()
    assert (distance < 0).any()


@pytest.mark.parametrize("kind", ["harmonic", "mean_value"])
def test_directions_of_affine_poses(kind, device):
    """They reproduce those exactly: a voxel at x is seen along x - M^-1 (eye - b) where y = M x + b."""
    matrix, offset = np.array([[0.9, 0.3, 0.0], [-0.2, 1.1, 0.1], [0.0, 0.2, 0.8]]), np.array([0.1, 0.2, -0.1])
    pose = BOX.with_vertices(BOX.vertices @ matrix.T + offset)
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=24).pose(pose)
    camera = view()
    shaded(deformer, camera)
    edit, _nodes, _, distance, taken = found_places(deformer)
    ((_, _, cage),) = deformer.posed_edits().carried_colors.posed
    aims = cage.aims.numpy().reshape(*taken.shape, 4)
    x = np.array(edit.rest.lower) + edit.rest.spacing * np.argwhere(taken) + deformer.field.center
    along = x - np.linalg.solve(matrix, camera.center - offset)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inside = distance[taken] < 0
    assert inside.sum() > 500
    np.testing.assert_allclose(aims[taken][inside, :3], along[inside], atol=2e-3)
    np.testing.assert_array_equal(aims[..., 3], distance)
    assert (aims[~taken][:, :3] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_views_are_those_of_colors_looked_up_at_each_sample(kind, device):
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=40)
    for pose, least in ((BOX, 65), (TURN, 65), (BEND, 62), (BOX.twist(80, axis="x"), 60)):
        for eye in ((2.6, 0.9, 1.2), (-1.2, 2.4, -1.5)):
            camera = view(eye)
            deformer.pose(pose)
            frame, expected = shaded(deformer, camera), of_rows(deformer, camera)
            assert psnr(frame.rgb, expected.rgb) > least
            for name in ("alpha", "reveal"):
                assert psnr(getattr(frame, name), getattr(expected, name)) > 60, name
            np.testing.assert_allclose(frame.fold, expected.fold, atol=2e-3)
            assert np.abs(frame.outside - expected.outside).mean() < 0.05
    assert psnr(frame.rgb, deformer.field.render(camera).rgb) < 30


def test_a_rigid_pose_is_the_field_seen_by_the_camera_moved_back(device):
    field = shiny_field(device)
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    pose = BOX.with_vertices(BOX.vertices @ turn.T + [0.2, 0.1, 0.0])
    frame = shaded(Deformer(field, BOX, coordinates="mean_value", resolution=64).pose(pose), view())
    still = field.render(counter_moved(view(), turn, [0.2, 0.1, 0.0]))
    assert psnr(frame.rgb, still.rgb) > 45


def test_matter_beside_the_cage_is_seen_as_it_is(device):
    """A cage cuts the field in two; what it leaves alone keeps its colours, up to a voxel from the cage."""
    field = make_field(lambda x: ball(x, (-0.5, 0, 0)) + ball(x, (0.5, 0, 0)), shiny, device=device)
    half = box_around(0.5, 0, 0, half=0.45)
    camera = view((0.3, 2.8, 0.9))
    frame = shaded(Deformer(field, half, coordinates="mean_value", resolution=32).pose(half.rotate(90)), camera)
    expected = field.render(camera)
    left = camera.rays()[1][..., 0] < 0.05 if camera.rays()[1][0, 0, 0] < 0 else camera.rays()[1][..., 0] < -0.05
    assert expected.alpha[left].max() > 0.9
    assert psnr(frame.rgb[left], expected.rgb[left]) > 55
    assert psnr(frame.rgb, expected.rgb) < 40


@pytest.mark.filterwarnings("ignore:a cage has gaps narrower")
def test_gaps_whose_cells_have_sides(device):
    """In such cells each side of the gap has a map of its own; where it does not turn matter over, views agree."""
    field = make_field(lambda x: np.full(x.shape[:3], 6.0), shiny, device=device)
    deformer = Deformer(field, slotted(0.12), coordinates="mean_value", resolution=20)
    deformer.pose(slotted(0.06).rotate(20, axis="x"))
    camera = view((0.4, 2.6, 1.4))
    assert psnr(shaded(deformer, camera).rgb, of_rows(deformer, camera).rgb) > 50
    assert deformer.posed_edits().tables.edits[0].has_sides


@pytest.mark.filterwarnings("ignore:a cage has gaps narrower")
def test_matter_in_a_notch_narrower_than_a_voxel_keeps_its_own_colors(device):
    """All nodes around it lie in the cage."""
    field = make_field(lambda x: np.full(x.shape[:3], 4.0), shiny, resolution=20, device=device)
    cage = slotted(0.04)
    deformer = Deformer(field, cage, coordinates="mean_value", resolution=64)
    deformer.pose(cage.rotate(60, axis="x").translate([0.1, 0.2, 0.3]))
    camera = view((0.4, 5.6, 1.4))
    least = 70 if wp.get_device(device).is_cpu else 62  # halves, and places to 1/256 of a voxel
    assert psnr(shaded(deformer, camera).rgb, of_rows(deformer, camera).rgb) > least


def test_poses_that_turn_matter_over_take_rows(device):
    """Matter is in several places then. The first frame of a pose finds out, and others know."""
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24)
    alter_map(deformer, mirrored)
    deformer.pose(BOX.rotate(10))
    for _ in range(2):
        with recorded_launches() as launched:
            frame = deformer.render(view())
        assert marches(launched) == ["views.rows"]
        assert psnr(frame.rgb, of_rows(deformer, view()).rgb) > 100
    assert frame.fold.max() > 0.9


def test_a_map_that_throws_a_node_far_away_takes_rows(device):
    """By hand. It turns cells over, and squeezes others so much that no thread looks through their images."""
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=40)

    def thrown(positions):
        middle = tuple(n // 2 for n in positions.shape[:3])
        positions[middle] += np.float32([40.0, 30.0, 20.0])
        return positions

    alter_map(deformer, thrown)
    deformer.pose(BOX)
    with recorded_launches() as launched:
        deformer.render(view())
    assert marches(launched) == ["views.rows"]


def test_what_takes_rows(device):
    """Cameras near the field or the posed cage, and fields for whose colors memory is short."""
    field = shiny_field(device)
    near, far = view(), view((7.5, 2.5, 3.4))
    away = BOX.translate([3.4, 1.0, 1.5])

    def used(edit, pose, camera, most=np.inf):
        deformer = Deformer(field, edit, resolution=16).pose(pose)
        deformer.posed_edits().max_color_bytes = most
        with recorded_launches() as launched:
            frame = deformer.render(camera)
        return marches(launched), frame

    assert used(BOX, TURN, near)[0] == ["views.shaded"]
    assert used(BOX, away, near)[0] == ["views.rows"]
    assert used(BOX, away, far)[0] == ["views.shaded"]
    assert used(BOX, TURN, view((0.3, 0.2, 0.1)))[0] == ["views.rows"]
    marched, frame = used(BOX, TURN, near, most=1000)
    assert marched == ["views.rows"]
    assert psnr(frame.rgb, used(BOX, TURN, near)[1].rgb) > 60


def test_copies_and_what_they_are_copies_of(device):
    """The same voxels are seen in two places, each from a direction of its own."""
    field = shiny_field(device)
    edit = CageEdit(BOX, keep_source=True)
    deformer = Deformer(field, edit, coordinates="mean_value", resolution=24)
    deformer.pose(BOX.rotate(100, axis="z").translate([0.3, 0.9, 0.6]))
    camera = view((3.6, 1.5, 1.4))
    frame = shaded(deformer, camera)
    assert psnr(frame.rgb, of_rows(deformer, camera).rgb) > 60
    assert psnr(frame.rgb, field.render(camera).rgb) < 30


def box_distance(x, half):
    """Signed distance to a box around the origin, in float64."""
    away = np.abs(x) - half
    return np.linalg.norm(np.maximum(away, 0), axis=-1) + np.minimum(away.max(axis=-1), 0)


@wp.kernel(module="unique")
def read_depths(
    first: int, laid: ShadedVolume, places: wp.array(dtype=wp.vec3), layer: int, depths: wp.array(dtype=float)
):
    n = first + wp.tid()
    depths[n] = shaded_value(laid, places[n], layer)[3]


@pytest.mark.parametrize("cells", [16, 24, 32])
def test_rows_that_are_seen_from_both_sides_of_a_cage(cells, device):
    """All rows that a voxel's diagonal parts from the cage, also those beyond its lattice; few more."""
    field = make_field(lambda x: np.full(x.shape[:3], 3.0), shiny, resolution=20, device=device)
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=cells).pose(TURN)
    frame = shaded(deformer, view((5.0, 2.4, 2.0)))
    assert frame.alpha.max() > 0
    colors, table = deformer.posed_edits().carried_colors, field.marching.columns
    ((edit, _, _),) = colors.posed
    laid = colors.shaded(field.marching.grid(), table, wp.vec3(5.0, 2.4, 2.0), 1.0)
    nodes = np.stack(np.unravel_index(table.nodes.numpy(), field.resolution), axis=1)
    held = wp.array(np.minimum(nodes, np.array(field.resolution) - 1.001), dtype=wp.vec3, device=device)
    depths = wp.zeros(len(nodes), dtype=wp.float32, device=device)
    has_layer = []
    for layer in range(int(COLOR_LAYERS)):
        launch(read_depths, len(nodes), [laid, held, layer], [depths], device=device)
        has_layer.append(depths.numpy() > 1.5)
    is_plain, is_carried = has_layer
    distance = box_distance(field.bounds[0] + (nodes + 0.5) * field.voxel_size, BOX.bounds[1])
    # the lattice blends distances
    reach, error = np.linalg.norm(field.voxel_size), 0.5 * edit.rest.spacing
    assert (is_plain | is_carried).all()
    near = (distance > error - reach) & (distance < edit.slack + reach - error)
    assert near.any() and (is_plain & is_carried)[near].all()
    assert not is_plain[distance < -2 * reach - error].any()
    assert not is_carried[distance > 2 * (edit.slack + reach + edit.rest.spacing) + error].any()


def test_removed_matter_and_what_it_uncovers(device):
    field = shiny_field(device)
    slab = Cage.box([-0.3, -0.9, -0.9], [0.9, 0.9, 0.9], segments=2)
    deformer = Deformer(field, CageEdit(slab, remove=True), resolution=24).pose([None])
    frame, expected = shaded(deformer, view()), of_rows(deformer, view())
    assert psnr(frame.rgb, expected.rgb) > 65 and psnr(frame.reveal, expected.reveal) > 80
    assert expected.reveal.max() > 0.3


def test_several_edits_each_with_its_own_directions(device):
    boxes = [box_around(x, 0, 0, half=0.22) for x in (-0.7, 0.0, 0.7)]
    field = make_field(lambda x: sum(ball(x, (c, 0, 0)) for c in (-0.7, 0.0, 0.7)), shiny, device=device)
    posed = [boxes[0].rotate(50, axis="x"), boxes[1].rotate(-70, axis="z"), boxes[2].twist(30, axis="x")]
    deformer = Deformer(field, boxes, coordinates="mean_value", resolution=24).pose(posed)
    for eye in ((2.4, 1.1, 1.0), (-0.4, 2.6, -1.0)):
        camera = view(eye)
        frame = shaded(deformer, camera)
        assert psnr(frame.rgb, of_rows(deformer, camera).rgb) > 60
    assert psnr(frame.rgb, field.render(camera).rgb) < 35


def test_frames_do_not_depend_on_the_ones_before(device):
    """Colors are kept from frame to frame, and so are those of other deformers of the field."""
    field = shiny_field(device)
    cameras = [view(), view((-1.4, 2.2, 1.6))]
    deformers = [Deformer(field, BOX, coordinates="mean_value", resolution=24).pose(pose) for pose in (TURN, BEND)]
    alone = [[deformer.render(camera).rgb.copy() for camera in cameras] for deformer in deformers]
    for first in range(2):
        for second in range(2):
            deformers[first].render(cameras[second])
            field.render(cameras[1 - second])
            for number, deformer in enumerate(deformers):
                for camera, rgb in zip(cameras, alone[number], strict=True):
                    np.testing.assert_array_equal(deformer.render(camera).rgb, rgb)
    # another pose, and back
    deformers[0].pose(BEND).render(cameras[0])
    np.testing.assert_array_equal(deformers[0].pose(TURN).render(cameras[1]).rgb, alone[0][1])


@pytest.mark.parametrize("how", ["moved", "copied", "removed", "faded", "several"])
def test_frames_read_no_shade_that_they_do_not_write(how, device):
    """Most rows are in one layer only. What is left of other frames in the other one is not seen."""
    if how == "several":
        field, edits = two_balls(device), [box_around(x, 0, 0) for x in (-0.5, 0.5)]
        poses = [edits[0].rotate(50, axis="x"), edits[1].translate([0, 0.3, 0.4])]
    else:
        field = make_field(lambda x: np.full(x.shape[:3], 3.0), shiny, resolution=56, device=device)
        cage = box_around(0, 0, 0, half=0.55) if how == "faded" else BOX
        options = {
            "copied": {"keep_source": True},
            "removed": {"remove": True},
            "faded": {"falloff": 0.2, "held": (0, 1)},
        }
        edits = [CageEdit(cage, **options.get(how, {}))]
        poses = [None if how == "removed" else cage.rotate(35, axis="z").translate([0.2, -0.1, 0.15])]
    deformer = Deformer(field, edits, coordinates="mean_value", resolution=32).pose(poses)
    camera = view((3.4, 1.6, 1.3))
    expected = shaded(deformer, camera)
    with pytest.MonkeyPatch.context() as patch:
        spoil_colors(deformer, patch)
        found = shaded(deformer, camera)
    for name in expected.arrays:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    # the same by a march that looks colours up at each sample
    rows = of_rows(deformer, camera)
    assert psnr(found.rgb, rows.rgb) > 55 and psnr(found.reveal, rows.reveal) > 55


def spoil_colors(deformer, patch):
    """Let frames begin with colors of thick white matter at all rows, in both layers."""
    colors = deformer.posed_edits().carried_colors
    shaded_volume = colors.shaded_volume

    def spoiled(table):
        laid = shaded_volume(table)
        launch(whiten, table.nodes.shape[0], [table.nodes, laid], device=deformer.device)
        return laid

    patch.setattr(colors, "shaded_volume", spoiled)


@wp.kernel(module="unique")
def whiten(first: int, nodes: wp.array(dtype=wp.int32), laid: ShadedVolume):
    node = nodes[first + wp.tid()]
    write_shaded_volume(laid, node, ALL_LAYERS, wp.vec4(0.5, 0.5, 0.5, 100.0))


def test_numbers_of_a_field_may_change_between_frames(device):
    field = shiny_field(device)
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=24).pose(BEND)
    before = shaded(deformer, view()).rgb
    field.grid.sh.assign(0.5 * field.grid.sh.numpy())
    pale = shaded(deformer, view())
    assert psnr(pale.rgb, of_rows(deformer, view()).rgb) > 60 and psnr(pale.rgb, before) < 40
    field.grid.density.assign(np.where(np.arange(field.grid.density.size) % 2, field.grid.density.numpy(), -1.0))
    thin = shaded(deformer, view())
    assert psnr(thin.alpha, of_rows(deformer, view()).alpha) > 60
    assert np.abs(thin.alpha - pale.alpha).max() > 0.1
