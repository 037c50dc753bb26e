"""What a fit takes on its device: what is declared against what is allocated, and max_memory kept."""

import dataclasses
import gc
import re

import numpy as np
import pytest
import warp as wp
from fit_oracles import finished, shuffled
from ground_truth import synthetic_scene
from messages import MESSAGES
from refusals import refused
from scenes import room_scene
from test_fit_edges import around, seen

from warpcage import FieldOptimizer, Scene, evaluate, fit, mean_psnr
from warpcage.fitting import (
    PRECISIONS,
    Level,
    Look,
    Silhouettes,
    TrainingPictures,
    load_progress,
    memory,
    memory_size,
    node_bytes,
    picture_bytes,
    row_bytes,
    save_progress,
    scaled_shape,
    schedule,
)


@pytest.fixture(scope="module")
def scene():
    return seen(around(12, size=48))


@pytest.fixture(scope="module")
def large_pictures():
    return seen(around(12, size=96))


@pytest.fixture
def same_threads(request, device):
    """Two on a CPU: a level takes more memory with more of them."""
    if wp.get_device(device).is_cpu:
        request.getfixturevalue("two_threads")


SIZES = {12345: 12345, "4GB": 4 * 10**9, "1.5 MiB": 3 * 2**19, "200kb": 200_000, ".5tb": 5 * 10**11, "99": 99}


@pytest.mark.parametrize("text, size", [*SIZES.items(), (np.int64(7), 7), (2e6, 2_000_000)])
def test_memory_sizes(text, size):
    assert memory_size(text) == size


@pytest.mark.parametrize("wrong", ["4 apples", "", "-1GB", "GB", 0, -5, np.nan, np.inf, True, [1], "1e3 MB"])
def test_wrong_memory_sizes(wrong, scene):
    refused(lambda: FieldOptimizer(scene, max_memory=wrong), match="memory size")


def test_estimates_match_what_is_allocated(scene, device):
    """Before each refinement the next level's bytes are foretold from the counts of rows and nodes."""
    optimizer = FieldOptimizer(scene, device=device, least_steps=60)
    foretold = None
    for level in range(3):
        if level:
            memory, shape = optimizer.memory(), scaled_shape(optimizer.field.resolution, 2)
            foretold = memory, shape
            while optimizer.level < level:
                optimizer.step()
        held = optimizer.held_bytes
        rows, shape = optimizer.field.voxel_count, optimizer.field.resolution
        own = optimizer.memory()
        tiles = 4 * optimizer.tile_total  # one mark each, and those that count once more
        passing = max(2 * np.prod(shape) + 4 * optimizer.shards * rows, 2 * tiles)
        assert own.level_bytes(rows, shape) == pytest.approx(held + passing, rel=0.01)
        if foretold:
            assert shape == foretold[1]
            assert held <= foretold[0].level_bytes(rows, shape) <= 1.1 * (held + passing)
    # counted: 25 numbers of gradient for each thread and of 16-bit moments, a mark, 25 of the field and its place
    assert own.row == 25 * 4 * optimizer.shards + 25 * 2 + 1 + 25 * 4 + 4
    assert own.node == pytest.approx(4 + 1, rel=0.1)


class Allocations:
    """Bytes that Warp's arrays hold on a device from now on, and their peak."""

    def __init__(self, monkeypatch, device):
        self.held = self.peak = 0
        allocator = wp.get_device(device).get_allocator()
        allocate, deallocate = allocator.allocate, allocator.deallocate

        def counted_allocate(size):
            self.held += size
            self.peak = max(self.peak, self.held)
            return allocate(size)

        def counted_deallocate(pointer, size):
            self.held -= size
            deallocate(pointer, size)

        monkeypatch.setattr(allocator, "allocate", counted_allocate)
        monkeypatch.setattr(allocator, "deallocate", counted_deallocate)


@pytest.fixture
def young_heap():
    """What there is already is left out of collections of garbage, each of which takes long with it."""
    gc.collect()  # nothing older goes meanwhile
    gc.freeze()  # for good: what a worker has imported and collected would be looked through in all later tests


def measured(allocations, make):
    """What a call makes, and the bytes of arrays that are held since."""
    gc.collect()
    before = allocations.held
    made = make()
    gc.collect()
    return made, allocations.held - before


@pytest.mark.usefixtures("young_heap")
@pytest.mark.parametrize("masks, views", [(True, 0.0), (False, 0.0), ("split", 0.0), (False, 4.0)])
def test_owners_declare_what_they_allocate(device, monkeypatch, masks, views):
    """Pictures, silhouettes, a level, batches and layers: to the byte, before the first step and at the last level."""
    scene = room_scene(6, 16, masks=masks)
    allocations = Allocations(monkeypatch, device)
    for bits in PRECISIONS:
        pictures, held = measured(allocations, lambda bits=bits: TrainingPictures(scene, bits, wp.get_device(device)))
        assert pictures.held_bytes == held > 0
    if scene.alphas is not None:
        silhouettes, held = measured(allocations, lambda: Silhouettes(scene, wp.get_device(device)))
        assert silhouettes.held_bytes == held > 0
    box, mask = np.array([[0.0, 0, 0], [1, 1, 1]]), np.random.default_rng(0).random((5, 6, 7)) < 0.4
    marked = wp.array(mask.astype(np.uint8), device=device)
    for shards in (1, 3):
        level, held = measured(allocations, lambda shards=shards: Level(marked, box, np.ones(3, np.float32), shards))
        assert level.held_bytes == held == row_bytes(shards) * mask.sum() + node_bytes((5, 6, 7))
        _, freed = measured(allocations, level.release)
        assert -freed == (25 * 4 * shards + 25 * 2) * mask.sum()
    options = {"resolution": 16, "levels": 2, "epochs": 1.0, "background_layers": 3, "background_side": 4}
    options |= {"variation_views": views, "variation_outer_views": views}
    optimizer, held = measured(allocations, lambda: FieldOptimizer(scene, device=device, **options))
    assert optimizer.held_bytes == held
    if optimizer.background is not None:
        assert optimizer.background.held_bytes > 0
    start = allocations.held - held
    finished(optimizer)
    gc.collect()
    assert optimizer.held_bytes == allocations.held - start and optimizer.level == optimizer.options.levels - 1


def test_as_many_views_as_first_voxels(device):
    """Eight pictures are fixed: they are not mistaken for rows of the smallest grid."""
    optimizer = FieldOptimizer(seen(around(8, size=48)), device=device, max_memory="7MB", least_steps=9, epochs=0.1)
    assert optimizer.shapes[0] == FieldOptimizer(seen(around(8, size=48)), device=device, least_steps=9).shapes[0]


@pytest.mark.parametrize(
    "pictures, limit, least",
    [
        ("scene", "20MB", 30),
        pytest.param("scene", "7MB", 30, marks=pytest.mark.nightly),
        ("scene", "2MB", 28),
        ("scene", "1.3MB", 24),
        pytest.param("large_pictures", "4MB", 28, marks=pytest.mark.nightly),
        ("large_pictures", "2.2MB", 26),
    ],
)
def test_a_limit_is_kept(request, device, monkeypatch, pictures, limit, least):
    """Every array is counted, masks in between too."""
    scene = request.getfixturevalue(pictures)
    allocations = Allocations(monkeypatch, device)
    field = fit(scene, device=device, progress=False, max_memory=limit, least_steps=30)
    assert allocations.peak <= memory_size(limit)
    assert allocations.peak > 0.4 * min(memory_size(limit), 15e6)  # and made use of
    assert mean_psnr(evaluate(field, scene)) > least


@pytest.mark.parametrize("limit", [1_200_000, pytest.param(1_800_000, marks=pytest.mark.nightly)])
def test_a_limit_is_kept_with_what_is_around(same_threads, device, monkeypatch, limit):
    """The sky, and what is before and behind the rays of a batch, are counted: large beside so few voxels."""
    scene = room_scene(8, 32, masks=False)
    allocations = Allocations(monkeypatch, device)
    options = {"resolution": 32, "outer_resolution": 64, "levels": 2, "epochs": 2, "batch_rays": 8192}
    field = fit(scene, device=device, progress=False, max_memory=limit, bounds=[[-2] * 3, [2] * 3], **options)
    assert 0.5 * limit < allocations.peak <= limit
    assert field.background_model.voxel_count > 0


def test_more_memory_is_more_detail(scene, device):
    shapes = []
    for limit in (None, "1GB", "7MB", "2MB"):
        optimizer = finished(FieldOptimizer(scene, device=device, max_memory=limit, least_steps=9, epochs=0.1))
        shapes.append(optimizer.field.resolution)
        np.testing.assert_allclose(optimizer.field.voxel_size, optimizer.field.voxel_size[0], rtol=0.1)
    assert shapes[0] == shapes[1] and shapes[1][0] > shapes[2][0] > shapes[3][0]


# More voxels than a launch has items


def test_levels_have_no_more_voxels_than_a_launch_has_items(scene, device):
    """Whatever the memory: a phone's capture at `quality="high"` asked for 95 million voxels of 25 numbers."""
    optimizer = FieldOptimizer(scene, device=device, levels=2, resolution=16)
    held, most = optimizer.memory(), 2**31 - 1
    assert held.row_numbers == 25
    coarse, planned = (360, 360, 360), (720, 720, 720)
    shape = held.refinement(20_000_000, 12_000_000, coarse, planned, 10**15)
    assert shape is not None and coarse < shape < planned
    assert 12_000_000 * np.prod(shape) / np.prod(coarse) * 25 <= most
    nearly = held.refinement(20_000_000, 9_000_000, coarse, planned, 10**15)
    assert nearly == planned  # 72 million voxels fit
    assert held.refinement(1000, 1000, (1024,) * 3, (2048,) * 3, 10**15)[0] < 1291  # nodes are counted too
    shapes = held.first_shapes([(1500, 1500, 1500)], 10**8, 10**15)
    assert np.prod(shapes[0]) <= most and 10**8 * np.prod(shapes[0]) / 1500**3 * 25 <= most


def test_a_fit_that_meets_the_limit_says_so_and_goes_on(scene, device, monkeypatch, capsys):
    monkeypatch.setattr(memory, "MAX_ITEMS", 25 * 4000)
    field = fit(scene, device=device, least_steps=60)
    lines = capsys.readouterr().err.replace("\r", "\n").splitlines()
    said = [line for line in lines if line.startswith("fit: the field")]
    assert field.voxel_count <= 4000 and mean_psnr(evaluate(field, scene)) > 24
    size = "x".join(str(n) for n in field.resolution)
    assert len(said) == 1 and f"has {size} instead of" in said[0]


# Pictures at 8 bits a channel


@pytest.mark.parametrize("masks", [False, "split"])
@pytest.mark.parametrize("bits", PRECISIONS)
def test_pictures_on_the_device(device, bits, masks):
    scene = room_scene(3, 16, masks=masks)
    pictures = TrainingPictures(scene, bits, device)
    assert pictures.held_bytes == picture_bytes(scene, bits)
    assert pictures.spare_bytes == (picture_bytes(scene, 16) - picture_bytes(scene, 8) if bits == 16 else 0)
    alphas = np.ones((3, 16, 16)) if scene.alphas is None else scene.alphas
    seen_part = scene.images - (1 - alphas[..., None]) * scene.background, alphas
    around_part = (scene.surroundings, 1 - alphas) if masks else None
    for held, part in ((pictures.seen, seen_part), (pictures.surroundings, around_part)):
        if part is None:
            assert held is None
            continue
        expected = np.concatenate([part[0], part[1][..., None]], axis=-1)
        found = held.halves.numpy() if bits == 16 else held.bytes.numpy() / 255
        np.testing.assert_allclose(found, expected, atol=2**-12 + 1e-6 if bits == 16 else 0.5 / 255 + 1e-6)


def test_what_counts_a_little_counts(device):
    """Weights are kept in steps of 1/255: those next to 0 are looked at as those that are fitted."""
    weights = np.full((2, 8, 8), 0.5, np.float32)
    weights[0, :4], weights[1, 2:] = 0.0, 0.001
    scene = dataclasses.replace(room_scene(2, 8, masks=False), weights=weights)
    counted = TrainingPictures(scene, 8, wp.get_device(device)).counted.numpy()
    np.testing.assert_array_equal(counted, np.select([weights == 0.0, weights < 0.1], [0, 1], 128))


@pytest.mark.parametrize("bits", PRECISIONS)
@pytest.mark.parametrize("masks", [False, "split"])
def test_a_loss_compares_with_either_precision(device, bits, masks):
    """The squared error of a field with nothing in it before a colour: what the pictures hold of another colour."""
    scene = room_scene(2, 8, masks=masks)
    options = {"background_side": 4} if masks else {"background": "constant"}
    optimizer = FieldOptimizer(scene, device=device, resolution=16, levels=1, epochs=1, **options)
    optimizer.batches.keep_pictures(bits)
    field = optimizer.field
    field.grid.density.zero_()
    optimizer.random_background, optimizer.rays.first_tile = False, 0
    field.background = np.array([0.2, 0.7, 0.4], np.float32)
    optimizer.accumulate_gradients()
    alphas = np.ones((2, 8, 8)) if scene.alphas is None else scene.alphas
    seen_part = scene.images - (1 - alphas[..., None]) * scene.background
    errors = ((seen_part - alphas[..., None] * field.background) ** 2).sum(axis=-1)
    places = (np.indices((2, 4, 4)) * np.array([1, 2, 2])[:, None, None, None]).reshape(3, -1).T
    tiles = shuffled(optimizer.rays.tiles.numpy(), optimizer.rays.order)
    expected = [errors[v, r + n // 2, c + n % 2] for v, r, c in places[tiles] for n in range(4)]
    found = optimizer.batches.squared_error.numpy()
    assert len(found) <= len(expected) and np.ptp(found) > 0.1
    np.testing.assert_allclose(found, expected[: len(found)], atol=2e-3 if bits == 16 else 8e-3)


@pytest.mark.parametrize("kind", ["bricks", pytest.param("thin", marks=pytest.mark.nightly)])
def test_8_bits_a_channel_are_enough(device, monkeypatch, kind):
    """Measured on eight small fits: 0.024 dB worse at most, 0.018 dB better at most."""
    train, test = synthetic_scene(kind, train_views=32, test_views=16, size=32, samples=2, device=device)
    found = []
    for precisions in (PRECISIONS, PRECISIONS[1:]):
        monkeypatch.setattr("warpcage.fitting.batches.PRECISIONS", precisions)
        optimizer = FieldOptimizer(train, device=device, resolution=32, levels=2, least_steps=100, batch_rays=2048)
        assert optimizer.pictures.bits == precisions[0]
        found.append(mean_psnr(evaluate(finished(optimizer).finish(), test)))
    assert abs(found[0] - found[1]) < 0.1


@pytest.mark.parametrize(
    "limit, bits",
    [
        ("2.8MB", 16),
        ("2.2MB", 8),
        ("1.2MB", 8),
        *(pytest.param(*each, marks=pytest.mark.nightly) for each in (("12.5MB", 16), ("9MB", 8), ("4MB", 8))),
    ],
)
def test_8_bits_are_chosen_where_they_buy_resolution(same_threads, large_pictures, device, monkeypatch, limit, bits):
    shapes, chosen = [], []
    for precisions in (PRECISIONS, PRECISIONS[:1], PRECISIONS[1:]):
        monkeypatch.setattr("warpcage.fitting.batches.PRECISIONS", precisions)
        try:
            optimizer = FieldOptimizer(large_pictures, device=device, max_memory=limit, least_steps=9, epochs=0.01)
        except ValueError as error:
            assert "images take 1.34 MB" in str(error)
            shapes.append((0, 0, 0))
            continue
        shapes.append(finished(optimizer).field.resolution)
        chosen.append(optimizer.pictures.bits)
    either, whole, bytewise = shapes
    if device == "cpu":
        assert chosen[0] == bits
    assert either == whole if chosen[0] == 16 else either > whole
    assert either >= bytewise


def test_limits_that_cannot_be_kept(scene, device):
    refused(lambda: FieldOptimizer(scene, max_memory="100kB"), match=MESSAGES["fitting.images_memory"])
    images = picture_bytes(scene, 8)
    tables = len(scene) * 49 * 49 * 4
    with pytest.raises(ValueError, match="not possible: the images take"):
        FieldOptimizer(scene, device=device, max_memory=images + tables + 20_000)


def test_a_small_device_is_not_overrun(scene, monkeypatch):
    """Without max_memory, what is free is the limit."""
    monkeypatch.setattr("warpcage.fitting.memory.free_bytes", lambda device: 2_000_000)
    optimizer = FieldOptimizer(scene, least_steps=9, epochs=0.1)
    assert optimizer.memory_limit == 1_800_000
    finished(optimizer)
    assert optimizer.field.resolution[0] < optimizer.shapes[0][0] * 4


@pytest.mark.parametrize("pictures, limit, bits", [("scene", "6MB", 16), ("large_pictures", "2.2MB", 8)])
def test_a_checkpoint_of_a_limited_fit_goes_on(request, same_threads, device, tmp_path, pictures, limit, bits):
    scene, options = request.getfixturevalue(pictures), {"max_memory": limit, "least_steps": 60, "device": device}
    optimizer = FieldOptimizer(scene, **options)
    while optimizer.level < 2:
        optimizer.step()
    assert optimizer.field.resolution[0] < 2 * optimizer.shapes[1][0] and optimizer.pictures.bits == bits
    save_progress(optimizer, tmp_path / "c.npz")
    resumed = FieldOptimizer(scene, **options)
    load_progress(resumed, tmp_path / "c.npz")
    assert resumed.pictures.bits == bits
    assert resumed.field.resolution == optimizer.field.resolution and resumed.shapes == optimizer.shapes
    for each in (optimizer, resumed):
        each.step()
    density = optimizer.field.grid.density.numpy()
    np.testing.assert_allclose(resumed.field.grid.density.numpy(), density, rtol=1e-5, atol=1e-4)


def test_a_refinement_by_a_fraction_keeps_the_picture(scene, device):
    """The same field on a grid 1.4 times as fine renders about the same."""
    field = fit(scene, device=device, progress=False, resolution=16, levels=1, least_steps=60, batch_rays=1024)
    optimizer = FieldOptimizer(scene, device=device, resolution=16, levels=1)
    shape = scaled_shape(field.resolution, 1.4)
    optimizer.current.field = field
    optimizer.current.refine(
        Look(wp.ones(shape, dtype=wp.uint8, device=device), wp.zeros(shape, dtype=wp.int32, device=device), None)
    )
    images = np.clip([field.render(camera).rgb for camera in scene.cameras], 0, 1)
    assert mean_psnr(evaluate(optimizer.field, Scene(images, None, scene.cameras))) > 28


# How long it takes, said after the first steps


def stepping(scene, device, monkeypatch, seconds_of, **options):
    """A fit whose clock goes as `seconds_of(level)` says for each step, timed up to where its time is known."""
    optimizer, now = FieldOptimizer(scene, device=device, **options), [0.0]
    monkeypatch.setattr(schedule.time, "perf_counter", lambda: now[0])
    pace = optimizer.pace()

    def step():
        optimizer.step()
        now[0] += seconds_of(optimizer.level)

    while not pace.time(step):
        pass
    return optimizer, pace, step


@pytest.mark.parametrize("supersampling", [1, 2])
def test_steps_to_come_follow_from_the_first_ones(scene, device, monkeypatch, supersampling):
    power = 1.1 if wp.get_device(device).is_cpu else 0.65
    options = {"resolution": 32, "levels": 3, "least_steps": 120, "epochs": 0.1, "batch_rays": 64}

    def seconds_of(level):
        rays = supersampling**2 if level == 2 else 1
        return 0.5 * rays * 2 ** (power * level)

    optimizer, pace, step = stepping(scene, device, monkeypatch, seconds_of, supersampling=supersampling, **options)
    assert optimizer.level == 0
    while optimizer.step_count < optimizer.total_steps:
        left = list(optimizer.level_steps)
        for level in range(3):
            done = min(max(optimizer.step_count - sum(optimizer.level_steps[:level]), 0), left[level])
            left[level] -= done
        assert pace.left() == pytest.approx(sum(n * seconds_of(level) for level, n in enumerate(left)), rel=1e-6)
        pace.time(step)
    assert pace.left() == 0


def test_a_level_that_takes_longer_than_foretold_is_believed(scene, device, monkeypatch):
    options = {"resolution": 32, "levels": 3, "least_steps": 120}
    optimizer, pace, step = stepping(scene, device, monkeypatch, lambda level: (1.0, 20.0, 20.0)[level], **options)
    foretold = pace.left()
    while optimizer.level < 1 or optimizer.step_count < optimizer.level_steps[0] + 3:
        pace.time(step)
    assert pace.left() > 3 * foretold


def test_a_fit_says_what_it_will_take(scene, device, capsys, monkeypatch):
    options = {"device": device, "least_steps": 60, "resolution": 24, "levels": 2}
    fit(scene, **options)
    lines = capsys.readouterr().err
    assert "instead of" not in lines  # no limit was met
    said = [line for line in lines.splitlines() if line.startswith("fit: about")]
    assert len(said) == 1 and " s and " in said[0] and said[0].endswith(("MB", "GB"))
    assert "fast" not in said[0]
    monkeypatch.setattr(schedule.Pace, "left", lambda pace: 1000.0)  # on a CPU a quicker fit is named
    fit(scene, **options)
    quicker = re.compile(r"a fast fit of pictures shrunk \d+ times takes about (\d+) (s|min)$", re.MULTILINE)
    said = quicker.findall(capsys.readouterr().err)
    if wp.get_device(device).is_cpu:
        assert [int(count) * {"s": 1, "min": 60}[unit] <= 600 for count, unit in said] == [True]
    else:
        assert not said
