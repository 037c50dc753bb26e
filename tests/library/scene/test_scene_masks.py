"""Mask files beside the pictures of a scene: one rule of names for every format, and what their pixels say."""

import dataclasses
import functools
import shutil
import warnings

import numpy as np
import pytest
from messages import MESSAGES
from phone_writers import write_arkitscenes, write_polycam, write_record3d, write_stray
from program_writers import write_bundler, write_llff, write_metashape, write_opensfm, write_realityscan
from refusals import refused
from scene_readers import load
from scene_writers import (
    Pictures,
    brick_pictures,
    write_blender,
    write_colmap,
    write_dtu,
    write_image,
    write_nsvf,
    write_transforms,
)

from warpcage import load_scene


@pytest.fixture(scope="module")
def opaque():
    """Pictures without opacity, of a principal point in the middle, which all formats can say."""
    pictures = brick_pictures(3, centered=True)
    rgba = pictures.rgba.copy()
    rgba[..., 3] = 255
    return Pictures(rgba, pictures.cameras)


def half_masks(count=3):
    """(n, 20, 24) uint8, each with another rectangle of what is kept, and some grey."""
    masks = np.zeros((count, 20, 24), np.uint8)
    for index, mask in enumerate(masks):
        mask[3 + index : 15, 4:20] = 255
        mask[2 + index, 4:20] = 102
    return masks


WRITERS = {
    "blender": (write_blender, "train"),
    "nsvf": (functools.partial(write_nsvf, splits="000"), "rgb"),
    "dtu": (functools.partial(write_dtu, masks=False), "image"),
    "transforms": (write_transforms, "images"),
    "colmap": (functools.partial(write_colmap, binary=True), "images"),
    "polycam": (write_polycam, "keyframes/images"),
    "record3d": (write_record3d, "rgb*"),
    "arkitscenes": (write_arkitscenes, "*/lowres_wide"),
    "stray": (write_stray, "rgb"),
    "opensfm": (write_opensfm, "images"),
    "metashape": (write_metashape, "images"),
    "bundler": (write_bundler, "images"),
    "realityscan": (write_realityscan, "images"),
    "llff": (write_llff, "images"),
}
NAMINGS = {
    "stem": lambda folder, home, file: f"masks/{file.stem}.png",
    "whole name": lambda folder, home, file: f"masks/{file.name}.png",
    "with folders": lambda folder, home, file: f"masks/{file.relative_to(folder)}.PNG",
    "beside": lambda folder, home, file: str((home.parent / "masks" / f"{file.stem}.tif").relative_to(folder)),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("naming", NAMINGS)
def test_masks_of_the_pictures_names_are_opacity_in_every_format(tmp_path, opaque, name, naming):
    write, place = WRITERS[name]
    write(tmp_path, opaque)
    (home,) = (path for path in tmp_path.glob(place) if path.is_dir())
    split = "train" if name in ("blender", "nsvf") else "all"
    whole = load(tmp_path, split=split, format=name)
    assert whole.alphas is None
    files = sorted(home.glob("*.png"))
    files = files[::2] if name == "arkitscenes" else files  # there, each second one is between poses
    for file, mask in zip(files, half_masks(), strict=True):
        path = tmp_path / NAMINGS[naming](tmp_path, home, file)
        write_image(path.with_suffix(".png"), mask)
        path.with_suffix(".png").rename(path) if path.suffix == ".PNG" else None
        write_image(path, mask) if path.suffix == ".tif" else None
    if NAMINGS[naming](tmp_path, home, home / "a.png").endswith(".tif"):
        for file in (home.parent / "masks").glob("*.png"):
            file.unlink()
    scene = load(tmp_path, split=split, format=name)
    assert scene.captured
    np.testing.assert_allclose(scene.alphas, half_masks() / 255, atol=1e-6)
    weighted = load(tmp_path, split=split, format=name, masks="weights")
    np.testing.assert_allclose(weighted.weights, half_masks() / 255, atol=1e-6)
    np.testing.assert_array_equal(load(tmp_path, split=split, format=name, masks=False).images, whole.images)


def rigs(folder, pictures):
    """A COLMAP model of two cameras in folders of their own, whose pictures have the same names."""
    write_colmap(folder, pictures, binary=False)
    listing = folder / "sparse/0/images.txt"
    text = listing.read_text()
    for index, name in enumerate(pictures.names):
        moved = f"rig{index % 2}/{index // 2:04d}.png"
        (folder / "images" / moved).parent.mkdir(exist_ok=True)
        (folder / "images" / f"{name}.png").rename(folder / "images" / moved)
        text = text.replace(f"{name}.png", moved)
    listing.write_text(text)


def test_masks_of_folders_in_folders_keep_to_their_own(tmp_path, bricks):
    """Of images/rig0/0001.png it is masks/rig0/0001.png, and never masks/0001.png, which may be of either."""
    rigs(tmp_path, bricks)
    for index in range(10):
        shade = np.full((20, 24), 10 * index + 100, np.uint8)
        write_image(tmp_path / f"masks/rig{index % 2}/{index // 2:04d}.png", shade)
    for split in ("train", "test", "all"):
        scene = load_scene(tmp_path, split=split)
        for name, alpha in zip(scene.names, scene.alphas, strict=True):
            rig, number = name.split("/")
            assert alpha.max() == pytest.approx((10 * (2 * int(number) + int(rig[-1])) + 100) / 255)
    for file in sorted((tmp_path / "masks").glob("*/*.png")):
        file.rename(tmp_path / "masks" / file.name)
    with pytest.warns(UserWarning, match=MESSAGES["scene.masks_of_rigs"]):
        assert load_scene(tmp_path, split="all").alphas.min() == bricks.rgba[..., 3].min() / 255


@pytest.mark.parametrize(
    "files, said",
    [
        (("other_00.png", "other_01.png"), MESSAGES["scene.masks_unused"]),
        (("view_00.npy",), MESSAGES["scene.masks_none"]),
        (("view_00.png", "view_02.png"), MESSAGES["scene.masks_lacking"]),
    ],
)
@pytest.mark.parametrize("name", ["llff", "transforms", "colmap"])
def test_masks_that_are_not_used_are_told_once(tmp_path, opaque, name, files, said):
    WRITERS[name][0](tmp_path, opaque)
    for file in files:
        write_image(tmp_path / "masks" / "a.png", np.full((20, 24), 255, np.uint8))
        (tmp_path / "masks" / "a.png").rename(tmp_path / "masks" / file)
    with pytest.warns(UserWarning, match=said) as caught:
        load_scene(tmp_path, split="all")
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(tmp_path, split="all", masks=False)


def test_masks_of_splits_in_folders_keep_to_their_own(tmp_path, opaque):
    """train/view_00.png and test/view_00.png: masks/view_00.png may be of either."""
    for split in ("train", "test"):
        write_blender(tmp_path, opaque, split)
        for name in opaque.names:
            shade = np.full((20, 24), {"train": 51, "test": 102}[split], np.uint8)
            write_image(tmp_path / "masks" / split / f"{name}.png", shade)
    for place in ("masks/{}", "{}/masks"):
        for split, shade in (("train", 0.2), ("test", 0.4)):
            np.testing.assert_allclose(load(tmp_path, split=split).alphas, shade, atol=1e-6)
            if place == "masks/{}":
                (tmp_path / "masks" / split).rename(tmp_path / split / "masks")
    (tmp_path / "masks").rmdir()
    (tmp_path / "test/masks").rename(tmp_path / "masks")
    shutil.rmtree(tmp_path / "train/masks")
    with pytest.warns(UserWarning, match="train/view_00.png.png would be the mask"):
        assert load(tmp_path).alphas is None


def test_a_mask_of_two_pictures_is_refused(tmp_path, bricks):
    """a.png is the mask of a.jpg, and of a.png."""
    write_colmap(tmp_path, bricks, binary=False)
    listing = tmp_path / "sparse/0/images.txt"
    listing.write_text(listing.read_text().replace("view_01.png", "view_00.jpg"))
    write_image(tmp_path / "images" / "view_00.jpg", bricks.rgba[1, ..., :3])
    for name in ("view_00", *bricks.names[2:]):
        write_image(tmp_path / "masks" / f"{name}.png", half_masks(1)[0])
    refused(lambda: load_scene(tmp_path), match=MESSAGES["scene.mask_of_two"])
    write_image(tmp_path / "masks" / "view_00.jpg.png", half_masks(1)[0])
    assert "view_00.jpg" in load_scene(tmp_path, split="all").names


GREY = half_masks(1)[0]
BINARY = np.where(GREY > 200, 255, 0).astype(np.uint8)
OPAQUE = np.full_like(GREY, 255)
COLORS = np.random.default_rng(0).integers(20, 256, (20, 24, 3), dtype=np.uint8)
KINDS = {
    "grey": (GREY, GREY),
    "three channels": (np.stack([GREY] * 3, axis=-1), GREY),
    "numbers of objects": (np.where(BINARY > 0, 1, 0).astype(np.uint8), BINARY),
    "colors of objects": (BINARY[..., None] // 2 * np.uint8([0, 1, 0]), BINARY),
    "a cutout": (np.concatenate([COLORS, GREY[..., None]], axis=-1), GREY),
    "white with alpha": (np.stack([OPAQUE] * 3 + [GREY], axis=-1), GREY),
    "black with alpha": (np.stack([OPAQUE * 0] * 3 + [GREY], axis=-1), GREY),
    "black and white, all opaque": (np.stack([GREY] * 3 + [OPAQUE], axis=-1), GREY),
    "grey with alpha": (np.stack([GREY, OPAQUE], axis=-1), GREY),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("downscale", [1, 2])
def test_what_pixels_of_masks_say(tmp_path, opaque, kind, downscale):
    image, expected = KINDS[kind]
    write_transforms(tmp_path, opaque)
    for name in opaque.names:
        write_image(tmp_path / "masks" / f"{name}.png", image)
    alphas = load_scene(tmp_path, split="all", downscale=downscale).alphas
    blocks = (expected / 255).reshape(20 // downscale, downscale, 24 // downscale, downscale).mean(axis=(1, 3))
    np.testing.assert_allclose(alphas, np.stack([blocks] * 3), atol=1e-6)


def test_masks_of_smaller_copies(tmp_path, opaque):
    """masks_2/ for images_2/; whole ones are of another size, and refused."""
    write_llff(tmp_path, opaque, (2,))
    small = half_masks()[:, ::2, ::2]
    for name, mask in zip(opaque.names, small, strict=True):
        write_image(tmp_path / "masks_2" / f"{name}.png", mask)
        write_image(tmp_path / "masks" / f"{name}.png", half_masks(1)[0])
    np.testing.assert_allclose(load_scene(tmp_path, split="all", downscale=2).alphas, small / 255, atol=1e-6)
    shutil.rmtree(tmp_path / "masks_2")
    refused(lambda: load_scene(tmp_path, split="all", downscale=2), match=MESSAGES["scene.mask_size"])


def test_a_format_that_names_its_masks_keeps_to_them(tmp_path, bricks):
    """mask_path of nerfstudio and mask/ of DTU, whatever lies in masks/; a path of elsewhere is no picture."""
    write_transforms(tmp_path / "a", bricks, masks=True)
    for file in (tmp_path / "a/masks").iterdir():
        file.rename(file.with_name(f"m_{file.name}"))
        write_image(file, np.full((20, 24), 9, np.uint8))
    path = tmp_path / "a/transforms.json"
    path.write_text(path.read_text().replace("masks/view", "masks/m_view"))
    np.testing.assert_allclose(load(tmp_path / "a", split="all").alphas, bricks.rgba[..., 3] / 255, atol=1e-6)
    path.write_text(path.read_text().replace("masks/m_view_00", "/home/somebody/view_00"))
    refused(lambda: load(tmp_path / "a", split="all"), match=MESSAGES["scene.mask_path_lost"], error=FileNotFoundError)
    write_dtu(tmp_path / "b", dataclasses.replace(bricks))
    write_image(tmp_path / "b/masks/000000.png", np.full((20, 24), 9, np.uint8))
    np.testing.assert_allclose(load(tmp_path / "b", split="all").alphas, bricks.rgba[..., 3] / 255, atol=1e-6)
