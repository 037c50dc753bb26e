"""Weights of pixels: kept with the scene, and what has none has no influence on fits and figures."""

import dataclasses
import pickle

import numpy as np
import pytest
import warp as wp
from refusals import refused
from scene_writers import write_colmap, write_image, write_transforms
from scenes import blob_scene, room_scene
from splat_scenes import ring, scene_of, true_field

import warpcage
from warpcage import FieldOptimizer, evaluate, load_scene, mean_psnr, psnr
from warpcage.core import resolve_device
from warpcage.fitting import PictureRays, Silhouettes, load_progress, save_progress, ssim
from warpcage.fitting.batches import counted_tile_size
from warpcage.fitting.level import Level
from warpcage.studio.cli import main
from warpcage.view.camera import camera_array
from warpcage.view.pictures import shrink, shrink_weights

SPLATS = {"representation": "splats", "progress": False, "steps": 40, "most_splats": 200, "pixels_per_splat": 1.0}


@pytest.fixture(scope="module")
def scene():
    truth = true_field("cpu", 60)
    scene = scene_of(truth, ring(6, 20, (64, 48)), points=np.repeat(truth.contents.centers, 2, axis=0))
    weights = np.ones((6, 48, 64))
    weights[:, 11:30, 25:49] = 0.0
    weights[:, :4] = 0.5
    return dataclasses.replace(scene, weights=weights)


def test_weights_stay_with_the_pictures(scene):
    assert scene.weights.dtype == np.float32 and scene.weights.shape == scene.images.shape[:3]
    motion = np.eye(4)
    motion[:3, 3] = [1, 2, 3]
    others = [scene.moved(motion), scene.straightened(), scene.with_cameras(scene.cameras)]
    for other in [*others, pickle.loads(pickle.dumps(scene))]:
        np.testing.assert_array_equal(other.weights, scene.weights)
    assert "weights" in repr(scene) and dataclasses.replace(scene, weights=None).weights is None


def test_a_subset_has_all_of_its_pictures(scene):
    share = np.random.default_rng(0).random(scene.images.shape[:3]).astype(np.float32)
    scene = dataclasses.replace(scene, alphas=share, surroundings=(1 - share[..., None]) * scene.images)
    for numbers, chosen in (([4, 1], [4, 1]), (slice(1, None, 2), [1, 3, 5]), (np.array([2]), [2])):
        part = scene.subset(numbers)
        assert part.names == [scene.names[k] for k in chosen] and part.cameras == [scene.cameras[k] for k in chosen]
        for name in ("images", "alphas", "surroundings", "weights"):
            np.testing.assert_array_equal(getattr(part, name), getattr(scene, name)[chosen])
        np.testing.assert_array_equal(part.points, scene.points)
    refused(lambda: scene.subset([]), match="at least one image")


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones((6, 48)), r"scene weights must be \(6, 48, 64\)"),
        (np.full((6, 48, 64), -0.5), "from -0.5 to -0.5"),
        (np.full((6, 48, 64), np.nan), r"must lie in \[0, 1\]"),
        ("all", "scene weights must be real numbers"),
    ],
)
def test_other_weights_are_refused(scene, weights, message):
    refused(lambda: dataclasses.replace(scene, weights=weights), match=message)


@pytest.mark.parametrize("size", [(8, 12), (9, 13), (7, 11), (1, 2)])
@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_a_smaller_picture_ignores_all_that_ignored_pixels_are_in(size, factor):
    weights = np.random.default_rng(0).uniform(0.1, 1.0, size)
    small = shrink_weights(weights, factor)
    for row in range(size[0]):
        for column in range(size[1]):
            one = np.ones(size)
            one[row, column] = 0.0
            touched = shrink(1.0 - one[..., None], factor)[..., 0] > 1e-9  # of which the pixel is a part
            np.testing.assert_array_equal(shrink_weights(one, factor) == 0.0, touched)
            assert (small[touched] <= weights[row, column]).all()
    assert np.isin(small, weights).all()
    stack = np.stack([weights, 1.0 - weights])
    np.testing.assert_array_equal(shrink_weights(stack, factor)[0], small)


SMALL = {"device": "cpu", "progress": False, "resolution": 24, "levels": 2, "epochs": 3, "batch_rays": 512}


def with_garbage(scene, seed=0):
    """Other colors, opacities and surroundings wherever nothing counts."""
    random, ignored = np.random.default_rng(seed), scene.weights == 0.0
    changed = {}
    for name in ("images", "alphas", "surroundings"):
        if getattr(scene, name) is not None:
            changed[name] = getattr(scene, name).copy()
            changed[name][ignored] = random.random(changed[name][ignored].shape)
    return dataclasses.replace(scene, **changed)


def with_walkers(scene, share=0.25):
    """A scene with weights of 0 in a rectangle that is at another place in each picture."""
    weights = np.ones(scene.images.shape[:3], np.float32)
    height, width = (int(np.sqrt(share) * side) for side in weights.shape[1:])
    for index, weight in enumerate(weights):
        top, left = np.random.default_rng(index).integers(0, (weight.shape[0] - height, weight.shape[1] - width))
        weight[top : top + height, left : left + width] = 0.0
    return dataclasses.replace(scene, weights=weights)


def require_same_fields(field, other):
    for name in ("links", "density", "sh"):
        np.testing.assert_array_equal(getattr(field.grid, name).numpy(), getattr(other.grid, name).numpy())
    np.testing.assert_array_equal(field.node_weights(), other.node_weights())


@pytest.mark.parametrize("kind", ["alphas", "outer", "layers", "cameras"])
def test_voxels_have_nothing_of_ignored_pixels(two_threads, kind):
    """The same field to the bit, and what is around it."""
    scene = with_walkers(room_scene(8, 26, masks="split" if kind in ("alphas", "layers") else False))
    scene = dataclasses.replace(scene, surroundings=None) if kind == "alphas" else scene
    options = {**SMALL, "refine_cameras": kind == "cameras", "bounds": [[-1.2] * 3, [1.2] * 3]}
    fields = [warpcage.fit(each, **options) for each in (scene, with_garbage(scene))]
    require_same_fields(*fields)
    around = [field.background_model for field in fields]
    assert (around[0] is None) == (kind == "alphas")
    if around[0] is not None:
        for camera in scene.cameras[:2]:
            np.testing.assert_array_equal(*[field.render(camera).rgb for field in fields])
    if kind == "cameras":
        for one, other in zip(*[field.refined_cameras.cameras for field in fields], strict=True):
            np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)


def test_a_fit_loses_little_by_what_it_ignores(two_threads):
    """Beside one of pictures without anything to ignore, and one that takes the garbage for the object."""
    scene = blob_scene(count=24, size=24, device="cpu")
    test = dataclasses.replace(scene.subset([4, 17]), alphas=None)
    train = scene.subset([i for i in range(24) if i not in (4, 17)])
    wrong = with_garbage(with_walkers(train, 0.08))
    options = {**SMALL, "epochs": 8}
    clean, ignoring, misled = (
        mean_psnr(evaluate(warpcage.fit(each, **options), test))
        for each in (train, wrong, dataclasses.replace(wrong, weights=None))
    )
    # 1.0 below, and 4.4 to 4.7 above, over two seeds
    assert ignoring > clean - 2.0 and ignoring > misled + 4.0, (clean, ignoring, misled)


def test_a_fit_goes_on_with_its_weights(two_threads, tmp_path):
    scene = with_walkers(blob_scene(count=6, size=25, device="cpu"))
    options = {name: value for name, value in SMALL.items() if name != "progress"}
    whole, stopped = FieldOptimizer(scene, **options), FieldOptimizer(scene, **options)
    for _ in range(whole.total_steps // 2 + 3):
        stopped.step()
    save_progress(stopped, tmp_path / "c.npz")
    resumed = FieldOptimizer(scene, **options)
    load_progress(resumed, tmp_path / "c.npz")
    for fit in (whole, resumed):
        while fit.step_count < fit.total_steps:
            fit.step()
    require_same_fields(whole.finish(), resumed.finish())
    other = dataclasses.replace(scene, weights=scene.weights[::-1])
    refused(lambda: load_progress(FieldOptimizer(other, **options), tmp_path / "c.npz"), match="another fit")


def test_a_picture_of_which_nothing_counts_keeps_its_camera(two_threads):
    scene = room_scene(8, 26, masks=False)
    weights = np.ones(scene.images.shape[:3])
    weights[3] = 0.0
    scene = with_garbage(dataclasses.replace(scene, weights=weights))
    field = warpcage.fit(scene, refine_cameras=True, bounds=[[-1.2] * 3, [1.2] * 3], **SMALL)
    refined = field.refined_cameras
    poses = [np.stack([camera.camera_to_world for camera in cameras]) for cameras in (refined.cameras, scene.cameras)]
    moved = np.abs(poses[0] - poses[1]).max(axis=(1, 2))
    assert np.isfinite(moved).all() and moved[3] < max(moved)
    assert np.abs(np.log(refined.gains)).max() < 0.5 and np.abs(refined.offsets).max() < 0.5


def test_weights_of_one_change_nothing(two_threads):
    scene = blob_scene(count=6, size=25, device="cpu")
    ones = dataclasses.replace(scene, weights=np.ones(scene.images.shape[:3]))
    fields = [warpcage.fit(each, **SMALL) for each in (scene, ones)]
    require_same_fields(*fields)
    for row, other in zip(*[evaluate(fields[0], each) for each in (scene, ones)], strict=True):
        assert row == pytest.approx(other)


def test_weights_between_are_shares_of_tiles(two_threads):
    scene = blob_scene(count=2, size=64, with_alpha=False, device="cpu")
    weights = np.zeros(scene.images.shape[:3], np.float32)
    weights[0, :, :32], weights[0, :, 32:], weights[1, :32] = 0.25, 1.0, 0.5
    options = {name: value for name, value in SMALL.items() if name != "progress"}
    fit = FieldOptimizer(dataclasses.replace(scene, weights=weights), background="outer", **options)
    taken = np.zeros(2 * 32 * 32)
    taken[fit.rays.tiles.numpy()] = 1.0
    taken = taken.reshape(2, 32, 32)
    assert taken[0, :, 16:].all() and not taken[1, 16:].any()
    assert taken[0, :, :16].mean() == pytest.approx(0.25, abs=0.08)
    assert taken[1, :16].mean() == pytest.approx(0.5, abs=0.08)
    fit.step()
    assert np.isfinite(fit.measure_psnr())


@pytest.mark.parametrize(("share", "expected"), [(0.0, 2), (0.3, 1)])
def test_single_pixels_are_taken_where_tiles_would_lose_many(share, expected):
    weights = (np.random.default_rng(0).random((3, 21, 17)) >= share).astype(np.float32)
    assert counted_tile_size(weights, 2) == expected
    assert counted_tile_size(None, 2) == 2


def test_what_only_ignored_pixels_see_is_not_seen(device):
    """Rendering weights: of the pixels that count alone, which a field's pruning keeps."""
    cameras = warpcage.turntable((0, 0, 0), 3.0, 20, 2, fov_degrees=40, width=9, height=8)
    cameras = [cameras[0], dataclasses.replace(cameras[1], width=8, height=7)]
    whole = [dataclasses.replace(camera, width=9, height=8) for camera in cameras]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    level = Level(wp.full((12, 12, 12), 1, dtype=wp.uint8, device=device), box, np.ones(3, np.float32), 1)
    random = np.random.default_rng(0)
    level.field.grid.density.assign(random.uniform(0.0, 8.0, level.field.voxel_count).astype(np.float32))
    counted = (random.random((2, 8, 9)) < 0.3).astype(np.uint8)
    counted[1, 7], counted[1, :, 8] = 0, 0

    def found(counts, stride=1):
        held = None if counts is None else wp.array(counts, dtype=wp.uint8, device=device)
        rays = PictureRays(camera_array(whole, level.field.center, device), 9, 8, held)
        return level.measure_weights(rays, stride).numpy()

    np.testing.assert_array_equal(found(None), found(np.ones_like(counted)))
    assert not found(np.zeros_like(counted)).any()
    for stride in (1, 2):
        one_by_one = np.zeros(level.field.voxel_count, np.float32)
        for view, row, column in np.argwhere(counted):
            if row % stride == 0 and column % stride == 0:
                alone = np.zeros_like(counted)
                alone[view, row, column] = 1
                one_by_one = np.maximum(one_by_one, found(alone))
        np.testing.assert_array_equal(found(counted, stride), one_by_one)
    assert (found(counted) == 0.0).sum() > (found(None) == 0.0).sum()


def test_ignored_pixels_carve_nothing(device):
    """A hull from pictures whose ignored pixels are transparent is larger, and it holds that of whole ones."""
    scene = blob_scene(count=8, size=40, device=device)
    wrong = with_walkers(scene)
    wrong = dataclasses.replace(wrong, alphas=np.where(wrong.weights > 0.0, wrong.alphas, 0.0))
    seen = [
        Silhouettes(each, resolve_device(device)) for each in (scene, wrong, dataclasses.replace(wrong, weights=None))
    ]
    hulls = [each.carve(np.array([[-1.0] * 3, [1.0] * 3]), (32,) * 3).numpy() > 0 for each in seen]
    assert not (hulls[0] & ~hulls[1]).any() and (hulls[1] & ~hulls[0]).sum() < hulls[0].sum()
    assert (hulls[0] & ~hulls[2]).any()
    nothing = dataclasses.replace(scene, weights=(scene.alphas == 0.0).astype(np.float32))
    refused(lambda: Silhouettes(nothing, resolve_device(device)), match="transparent")


def cube(count, density):
    """A field of one density from -1 to 1."""
    sh = np.zeros((count, count, count, 9, 3))
    return warpcage.VoxelField.from_dense(np.full((count,) * 3, density), sh, [[-1] * 3, [1] * 3], device="cpu")


def test_a_fit_of_nothing_is_refused():
    scene = blob_scene(count=3, size=16, device="cpu")
    nothing = dataclasses.replace(scene, weights=np.zeros(scene.images.shape[:3]))
    for representation in ("voxels", "splats"):
        with pytest.raises(ValueError, match="no pixel"):
            warpcage.fit(nothing, representation=representation, device="cpu", progress=False)
    refused(lambda: evaluate(cube(4, 1.0), nothing), match="no pixel")


def test_figures_are_of_what_counts():
    random = np.random.default_rng(0)
    image, reference = random.random((30, 41, 3)), random.random((30, 41, 3))
    weights = random.uniform(0.1, 1.0, (30, 41))
    weights[3:9, 5:30] = 0.0
    error = (weights[..., None] * (image - reference) ** 2).sum() / (3 * weights.sum())
    assert psnr(image, reference, weights=weights) == pytest.approx(-10 * np.log10(error), abs=1e-9)
    assert psnr(image, reference, weights=np.ones((30, 41))) == pytest.approx(psnr(image, reference), abs=1e-9)
    image[weights == 0.0] = 7.0
    assert psnr(image, reference, weights=weights) == pytest.approx(-10 * np.log10(error), abs=1e-9)
    # windows that lie wholly in a part are those of the part
    part = np.zeros((30, 41))
    part[8:27, 10:33] = 1.0
    cut = image[8:27, 10:33], reference[8:27, 10:33]
    assert ssim(image, reference, weights=part) == pytest.approx(ssim(*cut), abs=1e-9)
    for wrong in (np.zeros((30, 41)), -weights, np.full((30, 41), np.nan)):
        with pytest.raises(ValueError, match="weights"):
            psnr(image, reference, weights=wrong)
    refused(lambda: psnr(image, reference, weights=weights[1:]), match="weights must be those of the pixels")


def test_views_are_compared_where_they_count():
    scene = blob_scene(count=4, size=24, device="cpu")
    field, weights = cube(6, 2.0), np.zeros(scene.images.shape[:3])
    weights[:3, 2:20, 3:22] = 1.0
    weights[2, :, 12:] = 0.0  # too narrow for a window
    scene = with_garbage(dataclasses.replace(scene, weights=weights))
    rows = evaluate(field, scene, similarity=True)
    assert [row["view"] for row in rows] == scene.names[:3] and "ssim" not in rows[2]
    for index, row in enumerate(rows):
        rgb, counts = field.render(scene.cameras[index], background=scene.background).rgb, weights[index] > 0.0
        assert row["psnr"] == pytest.approx(psnr(rgb[counts], scene.images[index][counts]), abs=1e-9)
        inside = counts & (scene.alphas[index] > 0.5)
        assert row["masked_psnr"] == pytest.approx(psnr(rgb[inside], scene.images[index][inside]), abs=1e-9)


def test_splats_take_the_weights_of_their_scene(scene):
    """And what they say of a pixel that has none changes nothing, to the bit, points without colors neither."""
    garbage = scene.images.copy()
    garbage[scene.weights == 0.0] = np.random.default_rng(0).random((int((scene.weights == 0.0).sum()), 3))
    scene = dataclasses.replace(scene, point_colors=None)
    bare = dataclasses.replace(scene, weights=None)
    fields = [
        warpcage.fit(scene, device="cpu", **SPLATS),
        warpcage.fit(dataclasses.replace(scene, images=garbage), device="cpu", **SPLATS),
        warpcage.fit(bare, device="cpu", weights=scene.weights, **SPLATS),
        warpcage.fit(bare, device="cpu", **SPLATS),
    ]
    values = [np.concatenate([each.contents.centers, each.contents.log_scales], axis=1) for each in fields]
    np.testing.assert_array_equal(values[0], values[1])
    np.testing.assert_array_equal(values[0], values[2])
    assert values[0].shape != values[3].shape or (values[0] != values[3]).any()


def walkers_of(pictures, seed=0):
    """(n, h, w) bool, a rectangle somewhere in each picture."""
    random = np.random.default_rng(seed)
    found = np.zeros(pictures.rgba.shape[:3], bool)
    for one in found:
        top, left = random.integers(0, 12, 2)
        one[top : top + 7, left : left + 5] = True
    return found


@pytest.mark.parametrize(
    "format, kind", [*(("transforms", kind) for kind in ("white", "grey", "red", "with opacity")), ("colmap", "grey")]
)
def test_dynamic_masks_are_those_of_instant_ngp(tmp_path, bricks, format, kind):
    """dynamic_mask_NAME.png beside NAME: what is not black is ignored; pictures without one count as a whole."""
    write = {"transforms": write_transforms, "colmap": lambda *parts: write_colmap(*parts, binary=True)}[format]
    write(tmp_path, bricks)
    walkers = walkers_of(bricks)
    walkers[3] = False
    for name, mask in zip(bricks.names, walkers, strict=True):
        masks = {"white": mask * 255, "grey": mask * 1, "red": mask[..., None] * np.array([9, 0, 0])}
        masks["with opacity"] = np.stack([mask * 255, np.full_like(mask, 255, np.uint8)], axis=-1)
        if mask.any():
            write_image(tmp_path / "images" / f"dynamic_mask_{name}.png", masks[kind].astype(np.uint8))
    scene = load_scene(tmp_path, split="all")
    np.testing.assert_array_equal(scene.weights, np.where(walkers, 0.0, 1.0))
    whole = load_scene(tmp_path, split="all", masks=False)
    assert whole.weights is None
    np.testing.assert_array_equal(scene.images, whole.images)
    small = load_scene(tmp_path, downscale=2, split="all")
    for weights, mask in zip(small.weights, walkers, strict=True):
        np.testing.assert_array_equal(weights, ~mask.reshape(10, 2, 12, 2).any(axis=(1, 3)))
    assert load_scene(tmp_path, split="all", format=format).names == bricks.names


@pytest.mark.parametrize("lens", [{}, {"k1": 0.1, "p1": 0.01}])
def test_masks_of_a_lens_are_undone_with_the_picture(tmp_path, bricks, lens):
    """Colors made of an ignored pixel too are ignored: garbage there changes none that counts."""
    walkers, random = walkers_of(bricks), np.random.default_rng(0)
    changed = bricks.rgba.copy()
    changed[walkers] = random.integers(0, 256, (int(walkers.sum()), 4))
    scenes = []
    for name, rgba in (("as they are", bricks.rgba), ("changed", changed)):
        write_transforms(tmp_path / name, dataclasses.replace(bricks, rgba=rgba), distortion=lens)
        for stem, mask in zip(bricks.names, walkers, strict=True):
            write_image(tmp_path / name / "images" / f"dynamic_mask_{stem}.png", mask.astype(np.uint8) * 255)
        scenes.append(load_scene(tmp_path / name, split="all", downscale=2))
    counts = scenes[0].weights > 0.0
    np.testing.assert_array_equal(scenes[0].weights, scenes[1].weights)
    np.testing.assert_array_equal(scenes[0].images[counts], scenes[1].images[counts])
    assert 0.6 < counts.mean() < 0.95 and np.isin(scenes[0].weights, (0.0, 1.0)).all()
    assert (scenes[0].images != scenes[1].images).any()


@pytest.mark.parametrize("format", ["transforms", "colmap"])
def test_mask_files_may_say_what_counts(tmp_path, bricks, format, capsys):
    """mask_path and masks/NAME.png: opacity as ever, or weights of whole pictures; a dynamic mask goes with either."""
    if format == "transforms":
        write_transforms(tmp_path, bricks, masks=True)
    else:
        write_colmap(tmp_path, bricks, binary=False, masks=True)
    write_image(tmp_path / "images" / f"dynamic_mask_{bricks.names[1]}.png", np.full((20, 24), 255, np.uint8))
    alphas = bricks.rgba[..., 3] / np.float32(255)
    scene = load_scene(tmp_path, split="all", masks="weights")
    assert scene.alphas is None and not scene.captured
    np.testing.assert_allclose(scene.images, bricks.rgba[..., :3] / np.float32(255), atol=1e-6)
    expected = alphas.copy()
    expected[1] = 0.0
    np.testing.assert_allclose(scene.weights, expected, atol=1e-6)
    cut = load_scene(tmp_path, split="all")
    np.testing.assert_allclose(cut.alphas, alphas, atol=1e-6)
    assert cut.weights[0].all() and not cut.weights[1].any()
    around = load_scene(tmp_path, split="all", masks="split").surroundings
    np.testing.assert_allclose(around[0], (1 - alphas[0, ..., None]) * scene.images[0], atol=1e-6)
    main(["info", str(tmp_path)])
    assert "ignored       12.5 % of pixels" in capsys.readouterr().out  # one of eight that are train
    refused(lambda: load_scene(tmp_path, masks="weight"), match="'split' or 'weights'")


def test_a_mask_of_another_size_is_refused(tmp_path, bricks):
    write_transforms(tmp_path, bricks)
    write_image(tmp_path / "images" / f"dynamic_mask_{bricks.names[1]}.png", np.zeros((20, 23), np.uint8))
    refused(lambda: load_scene(tmp_path), match="view_01.png' is 23x20")


def test_commands_take_weights(tmp_path, bricks, capsys):
    write_colmap(tmp_path, bricks, binary=True, masks=True)
    share = 100 * (bricks.rgba[[i for i in range(10) if i % 8]][..., 3] == 0).mean()
    main(["info", str(tmp_path)])
    assert "ignored" not in capsys.readouterr().out  # they are opacity, where nothing says otherwise
    arguments = ["fit", str(tmp_path), "-o", str(tmp_path / "f.npz"), "--weight-masks", "--device", "cpu", "--quiet"]
    main([*arguments, "--epochs", "0.5", "--resolution", "16"])
    scene = load_scene(tmp_path, masks="weights")
    assert scene.alphas is None and scene.weights is not None
    assert 100 * (scene.weights == 0.0).mean() == pytest.approx(share)
    main(["evaluate", str(tmp_path / "f.npz"), str(tmp_path), "--weight-masks", "--device", "cpu", "--quiet"])
    shown = capsys.readouterr().out
    rows = evaluate(warpcage.VoxelField.load(tmp_path / "f.npz"), load_scene(tmp_path, split="test", masks="weights"))
    assert f"{mean_psnr(rows):7.2f}" in shown
