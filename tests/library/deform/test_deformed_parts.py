"""Edits that cannot meet each other, marched one by one, against the march of all at once; their boxes and orders."""

import concurrent.futures
import itertools

import numpy as np
import pytest
import warp as wp
from fields import (
    MARCHES,
    TILES,
    alter_map,
    ball,
    box_around,
    make_field,
    march_in_numpy,
    marches,
    marches_of,
    mirrored,
    psnr,
    seen_by_marches,
    shiny,
    slotted,
    two_balls,
    use_march,
    view,
)

from warpcage import Cage, CageEdit, Camera, Deformer
from warpcage.core import recorded_launches
from warpcage.edits import EditBoxes, box_gaps, edit_boxes, front_to_back
from warpcage.kernels.render.rays import Picture
from warpcage.render import FrameTables, FrameTarget
from warpcage.view import camera_struct

LEFT, MIDDLE, RIGHT = (box_around(x, 0, 0, half=0.3) for x in (-0.7, 0.0, 0.7))
HIGH, SLOTTED = box_around(0, 0, 0.85, half=0.14), slotted(0.4).scale(0.5, center=(0, 0, 0)).translate((0, 0, -0.2))


def shiny_balls(device):
    """Matter in and around all cages, with colours that follow directions."""

    def density(x):
        return sum(
            ball(x, center) for center in ((-0.7, 0, 0), (0, 0.05, -0.1), (0.65, 0, 0), (0, 0, 0.85), (0, 0.7, 0))
        )

    return make_field(density, shiny, device=device)


def turned():
    """Each turned, the one in the middle squeezed, so that samples are cut."""
    squeezed = MIDDLE.scale((0.4, 1.0, 1.0), center=(0, 0, 0))
    return [LEFT, MIDDLE, RIGHT], [LEFT.rotate(30, axis="x"), squeezed, RIGHT.twist(40, axis="x")]


def of_all_sorts():
    """One kept where it was, one removed, one moved away, which is the first in space and the last in order."""
    rests = [CageEdit(RIGHT, remove=True), CageEdit(HIGH, keep_source=True), CageEdit(MIDDLE), CageEdit(LEFT)]
    moved = LEFT.rotate(20, axis="z").translate((-0.6, 0.2, 0.1))
    return rests, [None, HIGH.rotate(25, axis="y").translate((0, 0.3, 0.1)), MIDDLE.rotate(15, axis="x"), moved]


def with_a_slot():
    """A slot that closes to less than a cell, between two boxes."""
    closed = slotted(0.02).scale(0.5, center=(0, 0, 0)).translate((0, 0, -0.2))
    boxes = [box_around(x, 0, 0, half=0.2) for x in (-0.75, 0.75)]
    return [boxes[0], SLOTTED, boxes[1]], [boxes[0].rotate(10, axis="y"), closed, boxes[1].rotate(20, axis="x")]


SCENES = {"turned": turned, "of all sorts": of_all_sorts, "with a slot": with_a_slot}
#: Around the scene, in the gap between two boxes, and in a box.
EYES = ((-2.6, 0.3, 0.4), (2.0, -0.8, 1.6), (0.35, -2.5, 0.1), (0.1, 0.2, -2.5), (0.35, 0, 0), (0.05, 0.2, 0.25))


def camera_at(eye):
    """To the middle of the scene, to its left end from within; not along an axis, where boxes have walls."""
    target = (0.0, 0.013, 0.0) if np.linalg.norm(eye) > 1.5 else (-0.9, 0.02, 0.03)
    return Camera.look_at(np.array(eye), target, width=60, height=44, fov_degrees=60)


def parts_by_marches(deformer, camera, monkeypatch, **options):
    """Views by each march, one edit after the other, against the march of all at once: name of the march, labels of
    its launches, whether it shades voxels, the frame of all at once."""
    for march, marched, by_parts, at_once in seen_by_marches(deformer, camera, monkeypatch, **options):
        shades = {label in ("views.shaded+part", "views.shaded+sides+part") for label in marched}
        assert len(shades) == 1
        assert_alike(by_parts, at_once, shades == {True})
        yield march, marched, shades == {True}, at_once


def assert_alike(by_parts, at_once, shaded):
    least = 100 if by_parts.arrays["rgb"].device.is_cpu else 70  # compilers for GPUs join products and sums
    for name in ("alpha", "reveal"):
        assert psnr(getattr(by_parts, name), getattr(at_once, name)) > least, name
    assert psnr(by_parts.rgb, at_once.rgb) > (55 if shaded else least)
    seen = at_once.alpha > 0.1
    assert np.abs(by_parts.depth[seen] - at_once.depth[seen]).mean() < (5e-4 if shaded else 1e-4)  # depths as halves
    for name in ("fold", "outside"):  # a sample at a wall counts or not
        here, there = getattr(by_parts, name), getattr(at_once, name)
        assert here.sum() == pytest.approx(there.sum(), rel=0.02, abs=2.0), name
        assert np.abs(here - there).mean() < 1e-3 * max(1.0, there.mean()), name


@pytest.mark.filterwarnings("ignore:a cage has gaps narrower")
@pytest.mark.parametrize("scene", SCENES)
def test_edits_one_by_one_are_seen_as_all_at_once(scene, device, monkeypatch):
    rests, posed = SCENES[scene]()
    deformer = Deformer(shiny_balls(device), rests, coordinates="mean_value", resolution=32).pose(posed)
    orders = set()
    for eye in EYES:
        for march, marched, is_shaded, at_once in parts_by_marches(deformer, camera_at(eye), monkeypatch):
            assert at_once.alpha.max() > 0.9
            if march == "tiles":
                assert marched == len(rests) * [TILES]
                continue
            gaps = sum(flat.has_sides for flat in deformer.posed_edits().tables.edits)
            is_far = np.linalg.norm(eye) > 1.5
            turns_over = scene == "with a slot"  # the map, where its slot closes
            assert is_shaded == (march == "shaded" and is_far and not turns_over)
            table = "shaded" if is_shaded else "rows"
            assert marched.count(f"views.{table}+sides+part") == gaps
            assert marched.count(f"views.{table}+part") == len(rests) - gaps > 0
            assert gaps > 0 or scene != "with a slot"
            orders.add(tuple("sides" in label for label in marched))
    assert len(orders) > 1 or scene != "with a slot"  # the slot's is first, second or last


def test_samples_sent_out_are_counted_in_each_part(device, monkeypatch):
    """By maps that lead out of the rest cages, in a field that is filled all over."""
    field = make_field(lambda x: np.full(x.shape[:3], 2.0), shiny, device=device)
    posed = [LEFT.stretch(1.6, axis="z"), RIGHT.stretch(1.5, axis="y")]
    deformer = Deformer(field, [LEFT, RIGHT], coordinates="green", resolution=40).pose(posed)
    for _, marched, _, at_once in parts_by_marches(deformer, view(), monkeypatch):
        assert len(marched) == 2 and at_once.outside.max() > 3


def test_folds_and_what_is_revealed_are_kept_from_part_to_part(device, monkeypatch):
    """The nearer of two maps is mirrored by hand, so that all it shows folds; the other part shrinks."""
    deformer = Deformer(shiny_balls(device), [LEFT, RIGHT], coordinates="mean_value", resolution=32)
    alter_map(deformer, lambda positions: np.float32([-1.4, 0, 0]) + mirrored(positions))
    deformer.pose([LEFT, RIGHT.scale((1, 0.5, 0.5), center=(0.7, 0, 0))])
    for _, marched, _, at_once in parts_by_marches(deformer, view((-2.5, 0.4, 0.6)), monkeypatch):
        assert len(marched) == 2 and at_once.fold.max() > 0.9 and at_once.reveal.max() > 0.1


@pytest.mark.parametrize("density", ["opacity", "paper"])
def test_edits_one_by_one_against_a_march_in_numpy(density, device, monkeypatch):
    field, (rests, posed) = shiny_balls(device), turned()
    posed[1] = MIDDLE.rotate(20, axis="x")
    options = {"coordinates": "mean_value", "resolution": 32, "density": density}
    deformer = Deformer(field, rests, **options).pose(posed)
    camera = Camera.look_at([2.0, -1.4, 1.0], (0, 0, 0), width=28, height=28, fov_degrees=45)
    expected = march_in_numpy(field, deformer, camera)
    for march in marches_of(device):
        use_march(march, device, monkeypatch)
        with recorded_launches() as launched:
            frame = deformer.render(camera)
        assert len(marches(launched)) == 3
        assert psnr(frame.rgb, expected) > 45  # turns keep lengths
        assert psnr(frame.rgb, field.render(camera).rgb) < 30


def test_edits_at_rest_leave_the_field(device, monkeypatch):
    field = two_balls(device)
    deformer = Deformer(field, [box_around(-0.5, 0, 0), box_around(0.5, 0, 0)], resolution=24)
    for march in marches_of(device):
        use_march(march, device, monkeypatch)
        for size in ((64, 64), (1, 1), (9, 5), (31, 2)):  # some are no multiple of a tile
            camera = Camera.look_at([2.5, 1.2, 1.0], (0, 0, 0), width=64, height=64, fov_degrees=30).resized(*size)
            with recorded_launches() as launched:
                frame = deformer.render(camera)
            assert len(marches(launched)) == 2
            assert psnr(frame.rgb, field.render(camera).rgb) > 50


def test_other_cameras_steps_and_rays_per_pixel(device, monkeypatch):
    """Of one pose, whose tables are kept."""
    rests, posed = of_all_sorts()
    deformer = Deformer(shiny_balls(device), rests, resolution=32).pose(posed)
    step = deformer.field.step
    for eye, options in itertools.product(
        ((-2.6, 0.3, 0.4), (2.6, 0.3, 0.4)), ({}, {"supersampling": 2}, {"step": 0.6 * step}, {"step": 1.5 * step})
    ):
        for _, marched, _, _ in parts_by_marches(deformer, camera_at(eye), monkeypatch, **options):
            assert len(marched) == 4


def test_states_of_as_many_rays_as_an_array_holds(monkeypatch):
    """Three numbers of each would be more; none is touched, as nobody has so much memory."""
    dot = wp.zeros(1, dtype=wp.vec4, device="cpu")
    marched_parts = []

    class Untouched:
        def take(self, shape):
            return wp.array(ptr=dot.ptr, shape=shape, dtype=wp.vec4, device="cpu", copy=False)

    def march(kernel, inputs, target, *, number, item_rays):
        assert number == len(marched_parts)
        marched_parts.append(inputs[-1])

    deformer = Deformer(two_balls("cpu"), [LEFT, RIGHT], device="cpu", resolution=16)
    deformer.render(view(size=8))
    plan, launcher = deformer.posed_edits().plan, deformer.posed_edits().launcher
    monkeypatch.setattr(launcher, "march", march)
    monkeypatch.setattr(launcher, "rays", Untouched())
    width, height = 46340, 46340
    camera = camera_struct(Camera(4e4, 4e4, width / 2, height / 2, width, height, view().camera_to_world), (0, 0, 0))
    boxes = [[[x, -1.0, -1.0], [x + 0.5, 1.0, 1.0]] for x in (-1.0, 0.5)]
    tables = FrameTables([], [None, None], boxes, None)
    launcher.launch_frame(plan, tables, FrameTarget(camera, wp.vec3(), None, Picture(), {}, width * height, 1.0))
    assert [(part.is_first, part.is_last) for part in marched_parts] == [(1, 0), (0, 1)]
    for part in marched_parts:
        arrays = part.progress, part.colors, part.masks
        assert [array.shape for array in arrays] == 3 * [(width * height,)]
        assert [array.ptr - dot.ptr for array in arrays] == [16 * row * width * height for row in range(3)]


@pytest.mark.parametrize("march", MARCHES)
def test_threads_that_share_a_deformer_see_their_own_views(march, device, monkeypatch):
    use_march(march, device, monkeypatch)
    rests, posed = turned()
    deformer = Deformer(shiny_balls(device), rests, resolution=16).pose(posed)
    cameras = [camera_at(eye) for eye in EYES[:3]]
    expected = [deformer.render(camera).rgb for camera in cameras]
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        found = pool.map(lambda camera: [deformer.render(camera).rgb for _ in range(4)], cameras)
        assert all(np.array_equal(each, rgb) for own, rgb in zip(found, expected, strict=True) for each in own)


# -- What is marched at once


def marches_for(rests, posed, camera=None, **options):
    deformer = Deformer(two_balls("cpu"), rests, device="cpu", **{"resolution": 16, **options}).pose(posed)
    with recorded_launches() as launched:
        deformer.render(view(size=8) if camera is None else camera)
    return marches(launched)


def test_edits_that_may_meet_are_marched_at_once():
    apart = marches_for([LEFT, RIGHT], [LEFT, RIGHT])
    assert apart == [TILES, TILES]
    into = marches_for([LEFT, RIGHT], [LEFT, RIGHT.translate((-0.9, 0, 0))])
    over_rest = marches_for([LEFT, RIGHT], [LEFT.translate((0.8, 0, 0)), RIGHT.translate((0, 2, 0))])
    assert into == over_rest == ["views.stack+simple"]
    # between their cages is less than what a map may lead out of the later one's, half a cell, or than a step
    near = RIGHT.translate((-0.782, 0, 0))
    assert near.bounds[0, 0] - LEFT.bounds[1, 0] == pytest.approx(0.018)
    assert len(marches_for([LEFT, near], [LEFT, near], resolution=40)) == 1  # 0.6 / 40 / 2 apart is enough: the step
    step = {"resolution": 40, "coordinates": "mean_value"}
    deformer = Deformer(two_balls("cpu"), [LEFT, near], device="cpu", **step).pose([LEFT, near])
    with recorded_launches() as launched:
        deformer.render(view(size=8), step=0.015)
        deformer.render(view(size=8), step=0.02)
    assert marches(launched) == [TILES, TILES, "views.stack+simple"]
    deformer = Deformer(two_balls("cpu"), [LEFT, near], device="cpu", resolution=16).pose([LEFT, near])
    with recorded_launches() as launched:
        deformer.render(view(size=8), step=0.01)
    assert marches(launched) == ["views.stack+simple"]  # half a cell is 0.6 / 32 and more


def bars():
    """Three bars, each of which hides a part of the next from a corner."""
    bars = [Cage.box((-0.9, -0.2, 0.2), (0.9, 0.0, 0.4)), Cage.box((0.2, -0.9, -0.2), (0.4, 0.9, 0.0))]
    return [*bars, Cage.box((-0.2, 0.2, -0.9), (0.0, 0.4, 0.9))]


def test_bars_that_hide_each_other_in_a_circle_are_marched_at_once():
    circle = [view(eye, size=8) for eye in itertools.product((-3.0, 3.0), repeat=3)]
    found = [len(marches_for(bars(), bars(), camera)) for camera in circle]
    assert set(found) == {1, 3}
    assert found == [1 if order_by_rays(boxes_of(bars()), camera.center) is None else 3 for camera in circle]


# -- Boxes


def boxes_of(cages):
    return np.stack([cage.bounds for cage in cages])


def spans(boxes, origins, directions):
    """(rays, boxes, 2) distances at which rays enter and leave boxes; the first is larger where they miss."""
    with np.errstate(divide="ignore"):
        ends = (boxes[None] - origins[:, None, None]) / directions[:, None, None]
    return np.stack([np.maximum(ends.min(axis=2).max(axis=-1), 0.0), ends.max(axis=2).min(axis=-1)], axis=-1)


def pairs_by_rays(boxes, center, count=4000):
    """Pairs (i, j) of which rays from a point meet box i before box j: rays through points of each."""
    random = np.random.default_rng(5)
    found = set()
    for lower, upper in boxes:
        targets = random.uniform(lower, upper, (count, 3))
        directions = targets - center
        times = spans(boxes, np.broadcast_to(center, targets.shape), directions)
        for i, j in itertools.permutations(range(len(boxes)), 2):
            met = (times[:, [i, j], 0] < times[:, [i, j], 1]).all(axis=1)
            if (met & (times[:, i, 0] < times[:, j, 0])).any():
                found.add((i, j))
    return found


def order_by_rays(boxes, center):
    """Any order that agrees with rays, by trying all; None where none does."""
    pairs = pairs_by_rays(boxes, center)
    for order in itertools.permutations(range(len(boxes))):
        if all(order.index(i) < order.index(j) for i, j in pairs):
            return list(order)
    return None


def random_boxes(random, count):
    """Boxes no two of which overlap."""
    boxes = []
    while len(boxes) < count:
        middle, half = random.uniform(-1, 1, 3), random.uniform(0.05, 0.5, 3)
        box = np.stack([middle - half, middle + half])
        if all(((box[0] > other[1]) | (box[1] < other[0])).any() for other in boxes):
            boxes.append(box)
    return np.stack(boxes)


@pytest.mark.parametrize("seed", range(6))
def test_orders_agree_with_rays(seed):
    random = np.random.default_rng(seed)
    boxes = random_boxes(random, 5)
    inside = boxes[1, 0] + 0.3 * (boxes[1, 1] - boxes[1, 0])
    for center in (*random.uniform(-2, 2, (4, 3)), inside):
        order = front_to_back(boxes, center)
        pairs = pairs_by_rays(boxes, center, count=1500)
        if order is None:
            assert order_by_rays(boxes, center) is None
        else:
            assert sorted(order) == list(range(5))
            assert all(order.index(i) < order.index(j) for i, j in pairs)
    assert front_to_back(boxes, inside)[0] == 1 or not any(i == 1 for i, _ in pairs_by_rays(boxes, inside))


def test_orders_by_hand():
    left, right = boxes_of([LEFT, RIGHT])
    assert front_to_back(np.stack([left, right]), (-3, 0, 0)) == [0, 1]
    assert front_to_back(np.stack([left, right]), (3, 5, 5)) == [1, 0]
    assert front_to_back(np.stack([right, left]), (-0.7, 0, 0)) == [1, 0]  # in the left one
    assert front_to_back(np.stack([right, left]), (0, 0, 9)) == [0, 1]  # between both: no ray meets both
    circle = boxes_of(bars())
    assert {front_to_back(circle, eye) is None for eye in itertools.product((-3.0, 3.0), repeat=3)} == {True, False}
    assert front_to_back(circle, (3.0, 0.1, 0.1)) is not None


def test_gaps_and_boxes_by_hand():
    boxes = np.array([((0, 0, 0), (1, 1, 1)), ((1.25, 0.5, -4), (2, 2, 9)), ((0.5, 0, 1.5), (9, 9, 9))])
    # the last two overlap by 1.5, 2 and 7.5
    np.testing.assert_allclose(box_gaps(boxes, boxes)[0], [-1, 0.25, 0.5])
    np.testing.assert_allclose(box_gaps(boxes[1:], boxes), [[0.25, -0.75, -1.5], [0.5, -1.5, -7.5]])
    cage = Cage.box((1, 1, 1), (2, 3, 4))
    edits = [CageEdit(cage), CageEdit(cage, remove=True)]
    found = edit_boxes(edits, [cage.translate((0.5, 0, -1)), None], (1, 1, 1), [0.01, 0.02], [0.25, 0.25])
    np.testing.assert_allclose(found.changed[0], [[-0.01, -0.01, -1.01], [1.51, 2.01, 3.01]])
    np.testing.assert_allclose(found.changed[1], [[-0.02, -0.02, -0.02], [1.02, 2.02, 3.02]])
    np.testing.assert_allclose(found.sources[0], [[-0.26, -0.26, -0.26], [1.26, 2.26, 3.26]])
    assert (found.sources[1, 0] > found.sources[1, 1]).all()  # an edit that removes maps nothing


def test_boxes_are_apart_where_no_place_has_to_do_with_two():
    left, right = np.array([[0, 0, 0], [1, 1, 1.0]]), np.array([[1.3, 0, 0], [2, 1, 1.0]])
    changed = np.stack([left, right])
    close = EditBoxes(changed, np.stack([left, right]))
    assert close.are_apart(0.1) and close.are_apart(0.149) and not close.are_apart(0.151)
    # a later map may not lead into what an earlier edit changes; an earlier one's is not asked about later ones
    assert not EditBoxes(changed, np.stack([left, right - [0.31, 0, 0]])).are_apart(0.1)
    assert EditBoxes(changed, np.stack([left + [0.31, 0, 0], right])).are_apart(0.1)
