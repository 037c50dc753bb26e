"""Poses that launch what the next view is likely to ask for, before it does."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp
from fields import (
    BOX,
    KINDS,
    alter_map,
    box_around,
    marches,
    mirrored,
    shiny_field,
    slotted,
    two_balls,
    use_march,
    view,
)
from refusals import refused

from warpcage import CageEdit, Deformer
from warpcage.core import devices, recorded_launches
from warpcage.lattice import PoseGraph
from warpcage.render import CarriedColors, CellBuffers, FineCells
from warpcage.render import launch as pose_modules
from warpcage.render import scene as lattice_edits


@pytest.fixture(params=["rows", "shaded"])
def ahead(request, device, monkeypatch):
    """The march by rows or of shaded voxels, with tables launched ahead on a CPU too; maps by graphs there too."""
    use_march(request.param, device, monkeypatch)
    monkeypatch.setattr(lattice_edits, "LOOKS_AHEAD_ON_CPU", True)
    monkeypatch.setattr(PoseGraph, "is_supported", staticmethod(lambda device: True))
    return request.param


def one_cage():
    return BOX, [BOX.twist(50), BOX.bend(40, towards="y"), BOX.scale((0.9, 1.2, 1.0)), BOX]


def a_slot():
    """The second pose has narrow gaps, the others none."""
    rest = slotted(0.5)
    narrow = rest.with_vertices(np.where(np.abs(rest.vertices) == 0.25, 0.02 * np.sign(rest.vertices), rest.vertices))
    return rest, [rest.bend(20), narrow, rest.rotate(15)]


def beside_each_other():
    rests = [box_around(-0.5, 0, 0), box_around(0.5, 0, 0)]
    return rests, [[rests[0].rotate(angle), rests[1].translate([0, 0.1, 0.001 * angle])] for angle in (10, 20, 30)]


def removed_and_copied():
    rests = [CageEdit(box_around(-0.5, 0, 0), remove=True), CageEdit(box_around(0.5, 0, 0), keep_source=True)]
    return rests, [[None, rests[1].cage.translate([0, 0.1 * k, 0.3])] for k in (1, 2, 3)]


def removed_alone():
    return CageEdit(box_around(-0.5, 0, 0), remove=True), [[None], [None], [None]]


def fading():
    return CageEdit(BOX, falloff=0.2, held=(0, 1)), [BOX.translate([0.05 * k, 0, 0]) for k in (1, 2, 3)]


def nightly_pairs(*options):
    return [pytest.param(*each, marks=pytest.mark.nightly) for each in itertools.product(*options)]


def same_frames(frame, other):
    return all(np.array_equal(array.numpy(), other.arrays[name].numpy()) for name, array in frame.arrays.items())


@pytest.mark.parametrize(
    "ahead, scene",
    [
        ("rows", one_cage),
        ("shaded", one_cage),
        ("shaded", a_slot),
        ("rows", beside_each_other),
        ("shaded", removed_and_copied),
        ("rows", removed_alone),
        ("shaded", fading),
        *nightly_pairs(["rows", "shaded"], [a_slot, beside_each_other, removed_and_copied, removed_alone, fading]),
    ],
    indirect=["ahead"],
)
def test_frames_are_those_of_a_deformer_that_has_seen_nothing(ahead, scene, device):
    """Cameras change between poses, and poses are seen more than once, or never."""
    field, (rests, poses) = two_balls(device), scene()
    resolution = 40 if scene is a_slot else 16  # of cells as fine as the narrow gaps
    options = {"coordinates": "mean_value", "resolution": resolution}

    @functools.cache
    def fresh(pose):
        return Deformer(field, rests, **options).pose(poses[pose])

    deformer = Deformer(field, rests, **options)
    for number in range(2 * len(poses)):
        deformer.pose(poses[number % len(poses)])
        eyes = [(2.5, 1.2, 1.0), (-2.0, 1.5, 0.5 + number)][: number % 3 or 1]
        for eye in eyes:
            camera = view(eye, size=32)
            assert same_frames(deformer.render(camera), fresh(number % len(poses)).render(camera))
    deformer.pose(poses[1])  # nobody looks
    deformer.pose(poses[0])
    assert same_frames(deformer.render(view(size=32)), fresh(0).render(view(size=32)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_view_finds_its_tables_there(ahead, kind, device, monkeypatch):
    """Those of the first pose, and of one that follows one that was seen; of others the view finds them."""
    begun, views = [], []
    begin = FineCells.begin
    monkeypatch.setattr(FineCells, "begin", lambda self, *rest: begun.append(len(views)) or begin(self, *rest))
    field, camera = shiny_field(device), view(size=24)
    deformer = Deformer(field, BOX, coordinates=kind, resolution=20)
    begun.clear()
    _, poses = one_cage()
    for number, pose in enumerate(poses[:3], 1):
        deformer.pose(pose)
        assert len(begun) == number
        views.append(deformer.render(camera))
    assert begun == [0, 1, 2]
    deformer.pose(poses[0]).pose(poses[1])
    assert begun == [0, 1, 2, 3]  # of the first, which followed a view
    deformer.render(camera)
    assert begun == [0, 1, 2, 3, 3]
    deformer.render(camera, step=3 * field.step)  # for which what was looked for does not hold
    assert begun == [0, 1, 2, 3, 3, 3]


def test_deformers_that_take_turns_share_the_largest_tables(ahead, device, monkeypatch):
    """Drawn again, posed both before either is drawn, and once the other is gone: frames are those of each alone."""
    field, camera = two_balls(device), view(size=32)
    _, poses = one_cage()
    made = [functools.partial(Deformer, field, BOX, resolution=resolution) for resolution in (16, 24)]
    expected = [[make().pose(pose).render(camera) for pose in poses[:2]] for make in made]
    buffers = CellBuffers(wp.get_device(device))
    monkeypatch.setattr(CellBuffers, "of", staticmethod(lambda device: buffers))  # on a CPU too
    coarse, fine = (make().pose(poses[0]) for make in made)
    for pose in (0, 1):
        for _ in range(2):
            assert same_frames(coarse.render(camera), expected[0][pose])
            assert same_frames(fine.render(camera), expected[1][pose])
        coarse.pose(poses[1])
        fine.pose(poses[1])
    del fine
    assert same_frames(coarse.render(camera), expected[0][1])


def test_fields_that_change_between_a_pose_and_its_view(ahead, device):
    field = two_balls(device)
    deformer = Deformer(field, BOX, resolution=20)
    for turn, angle in enumerate((20, 30, 40)):
        deformer.pose(BOX.twist(angle))
        density = field.grid.density.numpy()
        density[turn :: 3 + turn] *= -1  # other voxels hold matter
        field.grid.density.assign(density)
        frame = deformer.render(view())
        assert same_frames(frame, Deformer(field, BOX, resolution=20).pose(BOX.twist(angle)).render(view()))
    assert frame.alpha.max() > 0.5


def test_poses_that_turn_matter_over_are_found_out_ahead(ahead, device):
    """The march by rows takes them, whatever the tables that were launched are for."""
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=20)
    plain = deformer.pose(BOX).render(view())
    alter_map(deformer, mirrored)
    deformer.pose(BOX)
    with recorded_launches() as launched:
        frame = deformer.render(view())
    assert marches(launched) == ["views.rows"] and frame.fold.max() > 0.9 > plain.fold.max()


@pytest.mark.parametrize(
    "kind, scene",
    [
        ("mean_value", one_cage),
        ("harmonic", a_slot),
        ("green", beside_each_other),
        *nightly_pairs(KINDS, (one_cage, a_slot, beside_each_other)),
    ],
)
def test_no_frame_waits_for_a_compiler(scene, kind, device, monkeypatch):
    """Of poses with narrow gaps, and of those that turn matter over, once there is a Deformer. The field was seen."""
    use_march("shaded", device, monkeypatch)
    monkeypatch.setattr(lattice_edits, "LOOKS_AHEAD_ON_CPU", True)
    monkeypatch.setattr(PoseGraph, "is_supported", staticmethod(lambda device: True))
    (rests, poses), field = scene(), two_balls(device)
    field.render(view())
    loaded, needed = set(), set()
    load = pose_modules.load_modules

    def load_and_note(modules, where, *rest):
        loaded.update(each.module.name if isinstance(each, wp.Kernel) else each.__name__ for each in modules)
        load(modules, where, *rest)

    monkeypatch.setattr(pose_modules, "load_modules", load_and_note)
    monkeypatch.setattr(devices, "require_loaded", lambda kernel, *_: needed.add(kernel.module.name))
    folds = itertools.cycle([True, False])
    monkeypatch.setattr(CarriedColors, "has_inverted_cells", lambda self: next(folds))
    deformer = Deformer(field, rests, coordinates=kind, resolution=20)
    loaded |= needed  # it launched them
    needed.clear()
    for pose in poses:
        deformer.pose(pose)
        for _ in range(3):
            deformer.render(view(size=16))
    assert needed and needed <= loaded


def test_a_cage_that_cannot_be_used_leaves_the_pose_before(ahead, device):
    """It is found while the device is at work on it, perhaps in the second of two edits, whoever has looked before."""
    field, (rests, poses), camera = two_balls(device), beside_each_other(), view(size=24)
    options = {"coordinates": "mean_value", "resolution": 16}
    expected = [Deformer(field, rests, **options).pose(pose).render(camera) for pose in poses]
    inverted = rests[1].with_vertices(rests[1].vertices * [-1, 1, 1])
    broken = [[poses[0][0], inverted], [inverted, inverted]]

    def refuse(call, cages):
        refused(lambda: call(cages), match="^the deformed cage looks inward")

    deformer = Deformer(field, rests, **options)
    refuse(deformer.pose, broken[0])
    assert deformer.deformed is None
    for number, other, looked in ((1, 0, False), (2, 1, True), (0, 2, False)):
        deformer.pose(poses[number])
        if looked:
            deformer.render(camera)
        for cages in broken:
            refuse(deformer.pose, cages)
        assert deformer.deformed == poses[number]
        held = deformer.posed(poses[other])
        refuse(deformer.posed, broken[1])
        assert same_frames(held.render(camera), expected[other])
        assert same_frames(deformer.render(camera), expected[number])


def test_poses_and_frames_on_different_streams_wait_for_each_other(device):
    if wp.get_device(device).is_cpu:
        pytest.skip("CUDA only")
    field, rest = shiny_field(device), BOX
    _, poses = one_cage()
    options = {"coordinates": "harmonic", "resolution": 96}
    expected = [Deformer(field, rest, **options).pose(pose).render(view()) for pose in poses]
    deformer, streams = Deformer(field, rest, **options), [wp.Stream(device) for _ in range(3)]
    for number in range(20):
        pose, frame = poses[number % len(poses)], expected[number % len(poses)]
        with wp.ScopedStream(streams[number % 3], sync_enter=False):
            deformer.pose(pose)
        with wp.ScopedStream(streams[(number + 1) % 3], sync_enter=False):
            assert same_frames(deformer.render(view()), frame)
