"""Pictures of several sizes in one scene: every reader, cuts of a few pixels, frames, fits and figures."""

import dataclasses
import functools
import json
import re
import shutil
import warnings

import numpy as np
import pytest
from messages import MESSAGES
from phone_writers import write_polycam
from PIL import Image
from program_writers import SQUARE, write_llff
from refusals import refused
from scene_readers import BACKGROUND, load, require_equal
from scene_writers import (
    Pictures,
    brick_pictures,
    spiral_cameras,
    write_blender,
    write_colmap,
    write_dtu,
    write_nsvf,
    write_transforms,
)
from scenes import blob_scene
from splat_scenes import ring, scene_of, true_field

import warpcage
from warpcage import evaluate, mean_psnr
from warpcage.demo import brick_model, render_mesh_views
from warpcage.fitting import tuned_scene
from warpcage.fitting.splats import SplatFit
from warpcage.scene.pictures import flight_bytes
from warpcage.scene.sizes import View
from warpcage.studio.cli import main
from warpcage.view import read_image
from warpcage.view.pictures import shrink, shrunk_size

TALL, WIDE = (16, 20), (24, 14)


@dataclasses.dataclass
class Sized:
    """Pictures of their own sizes: what writers take."""

    rgba: list
    cameras: list
    names: list

    def pick(self, indices):
        return Sized(*[[each[i] for i in indices] for each in (self.rgba, self.cameras, self.names)])


def cut(pictures, sizes):
    """The upper left of pictures, in turn of these sizes."""
    sizes = [sizes[i % len(sizes)] for i in range(len(pictures.cameras))]
    cameras = [dataclasses.replace(c, width=w, height=h) for c, (w, h) in zip(pictures.cameras, sizes, strict=True)]
    rgba = [image[:h, :w] for image, (w, h) in zip(pictures.rgba, sizes, strict=True)]
    return Sized(rgba, cameras, pictures.names)


WRITERS = {
    "transforms": functools.partial(write_transforms, shared=False),
    "transforms with masks": functools.partial(write_transforms, shared=False, masks=True),
    "colmap": functools.partial(write_colmap, binary=True),
    "colmap text with masks": functools.partial(write_colmap, binary=False, masks=True),
    "polycam": functools.partial(write_polycam, kinds=("corrected_",)),
}


#: Formats that do not say for which size a camera is.
UNSAID = {
    "dtu": write_dtu,
    "nsvf": lambda folder, pictures: write_nsvf(folder, pictures, "0" * len(pictures.cameras)),
    "transforms without sizes": functools.partial(write_transforms, shared=False, sized=False),
}


def require_sized(scene, pictures):
    """Each picture as it is, at the upper left of one that counts nowhere else."""
    width, height = (max(getattr(camera, side) for camera in scene.cameras) for side in ("width", "height"))
    assert scene.images.shape[1:3] == (height, width) and scene.has_sizes
    for index, (rgba, camera) in enumerate(zip(pictures.rgba, pictures.cameras, strict=True)):
        values = rgba / 255.0
        expected = values[..., :3] * values[..., 3:] + (1 - values[..., 3:]) * np.asarray(BACKGROUND)
        np.testing.assert_allclose(scene.cut(index, scene.images[index]), expected, atol=1e-6)
        np.testing.assert_allclose(scene.cut(index, scene.alphas[index]), values[..., 3], atol=1e-6)
        counts = np.zeros((height, width))
        counts[: camera.height, : camera.width] = 1.0
        np.testing.assert_array_equal(scene.weights[index], counts)
        read = scene.cameras[index]
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(read, name) == pytest.approx(getattr(camera, name), rel=1e-5)
        np.testing.assert_allclose(read.camera_to_world, camera.camera_to_world, atol=1e-5)


@pytest.mark.parametrize("kind", WRITERS)
def test_portrait_and_landscape(tmp_path, bricks, kind):
    pictures = cut(bricks, [WIDE, TALL, TALL])
    WRITERS[kind](tmp_path, pictures)
    require_sized(load(tmp_path, split="all"), pictures)
    train, test = load(tmp_path), load(tmp_path, split="test")
    require_sized(train, pictures.pick([1, 2, 3, 4, 5, 6, 7, 9]))
    assert train.images.shape[1:] == test.images.shape[1:]


@pytest.mark.parametrize("kind", UNSAID)
def test_sizes_that_nothing_says_are_refused(tmp_path, bricks, kind):
    """A picture of half the size may be a part of a larger one, or all of it: cameras say which, or it is not read."""
    UNSAID[kind](tmp_path, cut(bricks, [WIDE, WIDE, TALL]))
    refused(lambda: load(tmp_path), "nothing says the size", match="is 16x20, others are 24x14")


def test_blender_with_one_angle_of_view(tmp_path):
    """The focal length follows the width of each picture."""
    cameras = [
        dataclasses.replace(c, fx=30 * w / 24, fy=30 * w / 24, cx=w / 2, cy=h / 2, width=w, height=h)
        for c, (w, h) in zip(spiral_cameras(4, centered=True), [(24, 20), (16, 20)] * 2, strict=True)
    ]
    drawn = [render_mesh_views(*brick_model(), [camera], samples=2)[0] for camera in cameras]
    pictures = Sized([np.round(255 * each).astype(np.uint8) for each in drawn], cameras, list("abcd"))
    write_blender(tmp_path, pictures)
    require_sized(load(tmp_path), pictures)


@pytest.mark.parametrize("kind", [*WRITERS, *UNSAID])
def test_a_pixel_more_is_cut_off(tmp_path, bricks, kind):
    """As COLMAP's undistorter writes 453x800 and 453x801; in all splits alike, also where one has a size alone."""
    pictures = cut(bricks, [(24, 19), *[(23, 20)] * 7])
    {**WRITERS, **UNSAID}[kind](tmp_path, pictures)
    scene = load(tmp_path) if kind == "nsvf" else load(tmp_path, split="all")
    assert scene.weights is None and not scene.has_sizes
    same = cut(bricks, [(23, 19)])
    same = Pictures(np.stack(same.rgba), same.cameras)
    require_equal(scene, same)
    if kind != "nsvf":
        require_equal(load(tmp_path, split="test"), same.pick([0, 8]))
        require_equal(load(tmp_path), same.pick([1, 2, 3, 4, 5, 6, 7, 9]))


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("lens", [{}, {"k1": 0.03}])
def test_smaller_pictures_of_several_sizes(tmp_path, bricks, factor, lens):
    """Each is what it is alone, of one size."""
    pictures = cut(bricks, [WIDE, TALL])
    write_transforms(tmp_path / "both", pictures, shared=False, distortion=lens)
    both = load(tmp_path / "both", split="all", downscale=factor)
    for first in (0, 1):
        few = list(range(first, 10, 2))
        write_transforms(tmp_path / str(first), pictures.pick(few), shared=False, distortion=lens)
        alone = load(tmp_path / str(first), split="all", downscale=factor)
        assert not alone.has_sizes and (both.cameras[first].width, both.cameras[first].height) == shrunk_size(
            (WIDE, TALL)[first], factor
        )
        for place, index in enumerate(few):
            np.testing.assert_array_equal(both.cut(index, both.images[index]), alone.images[place])
            assert both.cameras[index].fx == alone.cameras[place].fx and both.cut(index, both.weights[index]).all()
    if not lens:
        expected = shrink(pictures.rgba[1] / np.float32(255) * [1, 1, 1, 1], factor)[..., 3]
        np.testing.assert_allclose(both.cut(1, both.alphas[1]), expected, atol=1e-6)


def test_refined_cameras_keep_their_sizes(tmp_path, bricks):
    write_colmap(tmp_path, cut(bricks, [WIDE, TALL]), binary=True)
    scene = load(tmp_path)
    names = [warpcage.CameraKey(camera, name=name) for name, camera in zip(scene.names, scene.cameras, strict=True)]
    warpcage.CameraFile(names).save(tmp_path / "refined.json")
    again = load(tmp_path, cameras=tmp_path / "refined.json")
    assert [(c.width, c.height) for c in again.cameras] == [(c.width, c.height) for c in scene.cameras]
    refused(lambda: scene.with_cameras(scene.cameras[::-1]), match="a whole factor")


def test_a_smaller_camera_needs_weights_of_nothing_beyond():
    scene = blob_scene(count=2, size=16, device="cpu")
    cameras = [scene.cameras[0], dataclasses.replace(scene.cameras[1], height=12)]
    weights = np.ones(scene.images.shape[:3])
    refused(lambda: warpcage.Scene(scene.images, scene.alphas, cameras, weights=weights), match="weights must be 0")
    refused(lambda: warpcage.Scene(scene.images, scene.alphas, cameras), match="is 16x12, images are 16x16")
    weights[1, 12:] = 0.0
    assert warpcage.Scene(scene.images, scene.alphas, cameras, weights=weights).cut(1, weights[1]).shape == (12, 16)


def test_memory_is_that_of_the_frames_that_hold_all(tmp_path, bricks, monkeypatch):
    write_transforms(tmp_path, cut(bricks, [WIDE, TALL]), shared=False)
    view = View(tmp_path / "images", np.eye(4), "", (1, 1, 1, 1))
    flight = max(flight_bytes(view, size, 1, False) for size in (WIDE, TALL))
    held = 10 * WIDE[0] * TALL[1] * (4 * 5 + 1)
    monkeypatch.setattr("warpcage.scene.pictures.free_host_bytes", lambda: held + flight)
    assert len(load(tmp_path, split="all")) == 10
    monkeypatch.setattr("warpcage.scene.pictures.free_host_bytes", lambda: held + flight - 1)
    refused(lambda: load(tmp_path, split="all"), match="pictures of 24x20 need")


def two_sizes(scene, width, height):
    """Every second picture cut to this size, on frames as large as before; what is cut off holds garbage."""
    weights, images = np.ones(scene.images.shape[:3], np.float32), scene.images.copy()
    cameras = list(scene.cameras)
    for index in range(1, len(scene), 2):
        weights[index, height:], weights[index, :, width:] = 0.0, 0.0
        cameras[index] = dataclasses.replace(cameras[index], width=width, height=height)
    images[weights == 0.0] = np.random.default_rng(0).random((int((weights == 0.0).sum()), 3))
    return dataclasses.replace(scene, images=images, cameras=cameras, weights=weights)


@pytest.mark.parametrize("representation", ["voxels", "splats"])
def test_fits_of_two_sizes_are_as_good(two_threads, representation, tmp_path):
    """Every second picture without its border, where the object is not."""
    scene = blob_scene(count=14, size=24, device="cpu")
    parts = [scene.subset([i for i in range(14) if (i in (4, 11)) == held]) for held in (False, True)]
    options = {"resolution": 24, "levels": 2, "epochs": 6, "batch_rays": 512}
    if representation == "splats":
        options = {"steps": 120, "most_splats": 400, "pixels_per_splat": 1.0}
    options |= {"representation": representation, "device": "cpu", "progress": False}
    test = two_sizes(parts[1], 21, 20)
    figures = []
    for train in (parts[0], two_sizes(parts[0], 21, 20)):
        preview = tmp_path / "preview.png"
        field = warpcage.fit(train, preview=preview, **options)
        rows = evaluate(field, test, similarity=True)
        figures.append((mean_psnr(rows), mean_psnr(evaluate(field, parts[1]))))
        size = train.cameras[len(train) // 2]
        assert read_image(preview).shape[:2] == (size.height, 2 * size.width + 4)
    (one, one_whole), (two, two_whole) = figures
    assert two > one - 1.0 and two_whole > one_whole - 1.0
    for index, row in enumerate(rows):  # of the picture alone, by a camera of its size
        rgb = field.render(test.cameras[index], background=test.background).rgb
        assert rgb.shape[:2] == ((24, 24), (20, 21))[index]
        assert row["psnr"] == pytest.approx(warpcage.psnr(rgb, test.cut(index, test.images[index])))


def squares(rgb, scene, index):
    """Mean squared error of the pixels of a picture that count, by NumPy."""
    counts = scene.cut(index, scene.weights[index]) > 0
    errors = np.clip(rgb.astype(np.float64), 0, 1) - np.clip(scene.cut(index, scene.images[index]), 0, 1)
    return float((errors[counts] ** 2).mean())


@pytest.mark.parametrize("representation", ["voxels", "splats"])
def test_the_last_line_of_a_fit_is_over_real_pixels(two_threads, representation):
    """What lies beyond small pictures is garbage, and some pixels are ignored: they are no part of the figure."""
    if representation == "voxels":
        whole, options = blob_scene(count=6, size=24, device="cpu"), {"resolution": 16, "levels": 1, "epochs": 6}
    else:
        truth = true_field("cpu", 60)
        whole = scene_of(truth, ring(6, 20, (24, 24)), points=np.repeat(truth.contents.centers, 2, axis=0))
        options = {"steps": 60, "most_splats": 200, "pixels_per_splat": 1.0, "start": "points"}
    scene, lines = two_sizes(whole, 21, 18), []
    scene.weights[:, 3:5, 3:9] = 0.0
    reported = {"progress": lambda done, total, message: lines.append(message)}
    field = warpcage.fit(scene, representation=representation, device="cpu", **reported, **options)
    last = float(re.fullmatch(r"fit: (\S+) dB, .*", lines[-1])[1])
    renders = [field.render(camera, background=scene.background).rgb for camera in scene.cameras]
    by_hand = np.mean([-10 * np.log10(squares(rgb, scene, index)) for index, rgb in enumerate(renders)])
    assert last == pytest.approx(by_hand, abs=0.006)
    assert last == pytest.approx(mean_psnr(evaluate(field, scene)), abs=0.006)


def test_figures_of_steps_are_over_real_pixels(two_threads):
    """Of splats on what the field has behind it, not on the random colours of a step; of voxels without the parts of
    tiles that lie beyond the picture."""
    truth = true_field("cpu", 60)
    whole = scene_of(truth, ring(4, 20, (24, 24)), points=np.repeat(truth.contents.centers, 2, axis=0))
    scene = two_sizes(whole, 21, 18)
    fit = SplatFit(scene, device="cpu", steps=40, most_splats=200, pixels_per_splat=1.0, start="points")
    for _ in range(36):
        fit.step()
    for _ in range(4):  # nothing says of which picture
        field = fit.field
        rows = [row["psnr"] for row in evaluate(field, scene)]
        fit.step()
        assert min(abs(fit.measure_psnr() - row) for row in rows) < 0.02
    blobs = blob_scene(count=3, size=24, device="cpu")
    voxels = warpcage.FieldOptimizer(blobs, device="cpu", resolution=16, levels=1, tile_size=5, batch_rays=100_000)
    voxels.step()
    by_hand = voxels.batches.squared_error.numpy().sum() / blobs.images.size
    assert voxels.measure_psnr() == pytest.approx(-10 * np.log10(by_hand), abs=1e-4)


def test_cameras_that_a_fit_refines_keep_their_sizes(two_threads, tmp_path):
    """Where the first picture is a small one, too: rays and pruning are of the frames that hold all."""
    scene = blob_scene(count=8, size=24, device="cpu")
    small_first = two_sizes(scene, 21, 20).subset([1, 0, *range(2, 8)])
    options = {"device": "cpu", "resolution": 24, "levels": 2, "epochs": 4, "batch_rays": 512}
    figures = {}
    for name, each in (("whole", scene), ("small first", small_first)):
        field = warpcage.fit(each, refine_cameras=True, progress=False, **options)
        figures[name] = mean_psnr(evaluate(field, scene))
        sizes = [(camera.width, camera.height) for camera in field.refined_cameras.cameras]
        assert sizes == [(camera.width, camera.height) for camera in each.cameras]
        field.refined_cameras.save(tmp_path / "refined.json")
        again = each.with_cameras(warpcage.CameraFile.load(tmp_path / "refined.json"))
        assert [(camera.width, camera.height) for camera in again.cameras] == sizes
    assert tuned_scene(field, small_first.subset([0])).cameras[0].width == 21
    assert figures["small first"] > figures["whole"] - 1.5


def test_the_command_line_shows_pictures_of_their_own_size(tmp_path, bricks, capsys):
    write_colmap(tmp_path / "scene", cut(bricks, [WIDE, TALL]), binary=True)
    main(["info", str(tmp_path / "scene"), "--split", "all"])
    shown = capsys.readouterr().out
    assert "10 of 16x20 to 24x14" in shown and re.search(r"ignored +0.0 % of pixels", shown)
    parts = np.ones((4, 4, 4)), np.zeros((4, 4, 4, 9, 3)), [[-1] * 3, [1] * 3]
    warpcage.VoxelField.from_dense(*parts, device="cpu").save(tmp_path / "f.npz")
    files = ["--worst", str(tmp_path / "worst.png"), "--json", str(tmp_path / "report.json"), "--device", "cpu"]
    main(["evaluate", str(tmp_path / "f.npz"), str(tmp_path / "scene"), "--split", "all", "--quiet", *files])
    worst = json.loads((tmp_path / "report.json").read_text())["worst_view"]
    width, height = (WIDE, TALL)[int(worst[-1]) % 2]
    assert read_image(tmp_path / "worst.png").shape[:2] == (height, 3 * width + 8)


# Smaller copies, and pictures that were made another size


@pytest.mark.parametrize("downscale, taken", [(1, 1), (2, 2), (4, 4), (5, 1)])
def test_llff_takes_the_pictures_of_the_size_that_is_asked_for(tmp_path, centered, downscale, taken):
    black = Pictures(np.zeros_like(centered.rgba) + np.uint8([0, 0, 0, 255]), centered.cameras)
    write_llff(tmp_path, black, (1, 2, 4))
    white = Pictures(np.full_like(centered.rgba, 255), centered.cameras)
    write_llff(tmp_path, white, (taken,))
    scene = load(tmp_path, split="all", downscale=downscale)
    assert scene.images.min() > 0.999
    for read, written in zip(scene.cameras, centered.cameras, strict=True):
        assert (read.width, read.height) == (round(written.width / downscale), round(written.height / downscale))
        assert read.fx / read.width == pytest.approx(written.fx / written.width, rel=1e-12)


COPIES = {
    "llff": write_llff,
    "colmap": functools.partial(write_colmap, binary=True),
    "transforms": write_transforms,
    "transforms of no size": functools.partial(write_transforms, sized=False),
}


@pytest.mark.parametrize("downscale, read, total", [(1, 2, 2), (2, 2, 2), (3, 4, 4), (4, 4, 4), (6, 2, 6), (7, 4, 8)])
@pytest.mark.parametrize("name", COPIES)
def test_smaller_copies_alone_are_read(tmp_path, name, downscale, read, total):
    """images_2/, images_4/ beside cameras of images/, as mip-NeRF 360 scenes are handed on: cameras are scaled by the
    true sizes, and it is said where pictures become smaller than was asked for."""
    pictures = brick_pictures(10, centered=True, width=48, height=40)
    COPIES[name](tmp_path, pictures)
    shutil.rmtree(tmp_path / "images")
    white = Pictures(np.full_like(pictures.rgba, 255), pictures.cameras)
    write_llff(tmp_path / "more", white, (2, 4))
    for factor in (2, 4):
        (tmp_path / f"more/images_{factor}").rename(tmp_path / f"images_{factor}")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load(tmp_path, split="all", downscale=downscale)
    said = re.compile(MESSAGES["scene.copies"].format(read, total))
    assert [bool(said.search(str(each.message))) for each in caught] == [True] * (total != downscale)
    assert scene.images.min() > 0.999 and len(scene) == 10
    for camera, whole in zip(scene.cameras, pictures.cameras, strict=True):
        size = round(48 / total), round(40 / total)
        assert (camera.width, camera.height) == size
        np.testing.assert_allclose(camera.project(SQUARE)[0] / size, whole.project(SQUARE)[0] / [48, 40], atol=1e-9)


def resize_pictures(folder, size):
    for file in folder.iterdir():
        Image.open(file).resize(size).save(file)


@pytest.mark.parametrize("write, bent", [(write_transforms, {"distortion": {"k1": -0.01}}), (write_colmap, None)])
@pytest.mark.parametrize(
    "size, share",
    [((12, 10), 0.5), ((8, 7), 1 / 3), ((48, 40), 2.0), ((14, 12), 0.59), ((36, 30), 1.5)]
    + [((23, 20), None), ((26, 22), None), ((25, 21), None), ((12, 20), None), ((23, 21), None)],
)
def test_pictures_of_another_size_by_one_factor(tmp_path, bricks, write, bent, size, share):
    """They were made smaller; of other sizes they were cropped, which a factor near one is too, and refused once."""
    options = {"binary": False} if write is write_colmap else {}
    write(tmp_path / "a", bricks, **options)
    resize_pictures(tmp_path / "a/images", size)
    if share is None:
        said = MESSAGES["scene.sizes_differ"].format(*size, 8, 8)
        refused(lambda: load(tmp_path / "a"), match=said)
        return
    with pytest.warns(UserWarning, match=MESSAGES["scene.sizes_scaled"].format(*size)) as caught:
        scene = load(tmp_path / "a", split="all")
    assert len(caught) == 1
    for camera, whole in zip(scene.cameras, bricks.cameras, strict=True):
        assert (camera.width, camera.height) == size
        np.testing.assert_allclose(camera.project(SQUARE)[0] / size, whole.project(SQUARE)[0] / [24, 20], atol=1e-9)
    if bent:  # what undoes a lens may have made pictures of any size, but for half and double
        write(tmp_path / "b", bricks, **bent)
        resize_pictures(tmp_path / "b/images", size)
        if share in (0.5, 1 / 3, 2.0):
            with pytest.warns(UserWarning, match="cameras are scaled"):
                assert load(tmp_path / "b").cameras[0].fx > 0.9 * share * bricks.cameras[1].fx
        else:
            refused(lambda: load(tmp_path / "b"), match="before a lens was undone")


def test_one_picture_of_another_size_is_refused(tmp_path, bricks):
    write_transforms(tmp_path, bricks)
    image = Image.open(tmp_path / "images/view_03.png").resize((12, 10))
    image.save(tmp_path / "images/view_03.png")
    refused(lambda: load(tmp_path, split="all"), match=MESSAGES["scene.sizes_differ"].format(12, 10, 1, 10))
