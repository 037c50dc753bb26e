"""Pictures of scenes: each kind of PNG, and JPEG, TIFF, AVIF and HEIC, is read as what it shows; and pictures whose
camera was turned."""

import builtins

import numpy as np
import pytest
from messages import MESSAGES
from PIL import Image
from refusals import refused
from scene_writers import Pictures, brick_pictures, spiral_cameras, write_colmap, write_deep_png, write_transforms

from warpcage import load_scene
from warpcage.view import read_image

BACKGROUND = (0.1, 0.5, 0.9)
LENS = {"k1": 0.05, "k2": -0.02}
ORIENTATION = 0x0112

#: How an upright picture is stored, by EXIF's number of its orientation (the standard's table).
STORED = {
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


@pytest.fixture(scope="module")
def smooth():
    rows, columns = np.mgrid[:20, :24]
    color = np.stack([rows * 8 + 40, columns * 7 + 30, (rows + columns) * 4 + 50], axis=-1).astype(np.uint8)
    return Pictures(np.repeat(color[None], 2, axis=0), spiral_cameras(2))


@pytest.mark.parametrize("kind", ["16 bit", "8 bit grey", "16 bit grey", "grey and alpha", "16 bit alpha", "palette"])
def test_kinds_of_png(tmp_path, kind):
    write_transforms(tmp_path, brick_pictures(2))
    rng = np.random.default_rng(0)
    levels, alpha = rng.integers(0, 65536, (2, 20, 24), dtype=np.uint16)
    color = rng.integers(0, 65536, (20, 24, 3), dtype=np.uint16)
    bits = 255.0 if kind in ("8 bit grey", "grey and alpha", "palette") else 65535.0
    expected, opacity = np.repeat(levels[..., None], 3, axis=-1) / 65535.0, np.ones((20, 24, 1))
    for i in range(2):
        path = tmp_path / "images" / f"view_{i:02d}.png"
        if kind == "16 bit":
            expected = color / bits
            write_deep_png(path, color)
        elif kind == "16 bit grey":
            write_deep_png(path, levels[..., None])
        elif kind == "16 bit alpha":
            opacity = alpha[..., None] / bits
            write_deep_png(path, np.stack([levels, levels, levels, alpha], axis=-1))
        elif kind == "palette":
            expected = np.round(color[:1, :4] / 65535 * 255).repeat(20, axis=0).repeat(6, axis=1) / 255
            Image.fromarray(np.round(expected * 255).astype(np.uint8)).convert("P", palette=1, colors=16).save(path)
        else:
            byte = (levels >> 8).astype(np.uint8)
            expected = np.repeat(byte[..., None], 3, axis=-1) / bits
            if kind == "grey and alpha":
                opacity = (alpha >> 8)[..., None] / bits
                byte = np.stack([byte, (alpha >> 8).astype(np.uint8)], axis=-1)
            Image.fromarray(byte).save(path)
    scene = load_scene(tmp_path, background=BACKGROUND)
    np.testing.assert_allclose(scene.images[0], expected * opacity + (1 - opacity) * BACKGROUND, atol=1e-6)
    assert (scene.alphas is None) == (kind in ("16 bit", "8 bit grey", "16 bit grey", "palette"))


@pytest.mark.parametrize("downscale, lens", [(1, None), (2, None), (3, None), (1, LENS), (2, LENS), (4, LENS)])
def test_opaque_pictures_have_no_alphas_at_any_size(tmp_path, downscale, lens):
    colors = np.random.default_rng(0).integers(0, 256, (2, 123, 69, 3), dtype=np.uint8)
    rgba = np.concatenate([colors, np.full((*colors.shape[:3], 1), 255, np.uint8)], axis=-1)
    write_transforms(tmp_path, Pictures(rgba, spiral_cameras(2, width=69, height=123)), distortion=lens)
    assert load_scene(tmp_path, downscale=downscale).alphas is None


def save_heif(picture, path):
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    picture.save(path, format="HEIF", quality=95, chroma=444)


KINDS = {
    "jpg": (lambda picture, path: picture.save(path, quality=95, subsampling=0), 0.02),
    "tif": (lambda picture, path: picture.save(path), 0.0),
    "TIFF": (lambda picture, path: picture.save(path, compression="tiff_lzw"), 0.0),
    "avif": (lambda picture, path: picture.save(path, quality=95, subsampling="4:4:4"), 0.02),
    "heic": (save_heif, 0.02),
}


@pytest.mark.parametrize("kind", KINDS)
def test_kinds_of_pictures(tmp_path, smooth, kind):
    save, tolerance = KINDS[kind]
    write_transforms(tmp_path, smooth, ending=".bmp")
    for path in list((tmp_path / "images").iterdir()):
        save(Image.open(path).convert("RGB"), path.with_suffix(f".{kind}"))
        path.unlink()
    listing = tmp_path / "transforms.json"
    listing.write_text(listing.read_text().replace(".bmp", f".{kind}"))
    scene = load_scene(tmp_path)
    assert scene.alphas is None and np.abs(scene.images[0] - smooth.rgba[0] / 255).max() <= tolerance + 1e-6
    listing.write_text(listing.read_text().replace(f".{kind}", ""))  # names without an ending
    np.testing.assert_array_equal(load_scene(tmp_path).images, scene.images)


def test_tiffs_of_16_bits_and_of_floats(tmp_path):
    values = np.random.default_rng(0).integers(0, 65536, (6, 8), dtype=np.uint16)
    Image.fromarray(values).save(tmp_path / "deep.tif")
    np.testing.assert_allclose(read_image(tmp_path / "deep.tif")[..., 0], values / 65535, atol=1e-7)
    assert (tmp_path / "deep.tif").read_bytes()[:2] == b"II"
    Image.fromarray(np.zeros((4, 4), np.float32)).save(tmp_path / "float.tif")
    refused(lambda: read_image(tmp_path / "float.tif"), match="float.tif.*8 or 16 bits")


def test_heic_without_its_library_says_how_to_get_it(tmp_path, monkeypatch):
    path = tmp_path / "a.heic"
    path.write_bytes(bytes(100))
    load = builtins.__import__

    def missing(name, *rest, **options):
        if name == "pillow_heif":
            raise ImportError(name)
        return load(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", missing)
    refused(lambda: read_image(path), match=MESSAGES["scene.heif_library"])


def turned_model(folder, stored, number, *, masks=False):
    """A COLMAP model of upright pictures, whose files are stored in another way, with an orientation tag."""
    color = np.random.default_rng(0).integers(0, 256, (3, 20, 24, 4), dtype=np.uint8)
    pictures = Pictures(color, spiral_cameras(3))
    write_colmap(folder, pictures, binary=True, masks=masks)
    exif = Image.Exif()
    if number is not None:
        exif[ORIENTATION] = number
    for path in (folder / "images").iterdir():
        picture = Image.open(path)
        (picture if stored is None else picture.transpose(stored)).save(path, exif=exif)
    return pictures


@pytest.mark.parametrize("number, masks", [*((number, False) for number in STORED), (6, True)])
def test_pictures_on_their_side_are_made_upright_where_the_model_is(tmp_path, number, masks):
    images, alphas = turned_model(tmp_path, STORED[number], number, masks=masks).over((0, 0, 0))
    scene = load_scene(tmp_path, split="all", background=(0, 0, 0))
    np.testing.assert_allclose(scene.images, images, atol=1e-6)
    np.testing.assert_allclose(scene.alphas, alphas, atol=1e-6)
    small = load_scene(tmp_path, split="all", background=(0, 0, 0), downscale=2)
    np.testing.assert_allclose(small.images, images.reshape(3, 10, 2, 12, 2, 3).mean(axis=(2, 4)), atol=1e-6)


def test_pictures_that_the_model_has_on_their_side_stay_so(tmp_path):
    images, _ = turned_model(tmp_path, None, 6).over((0, 0, 0))
    np.testing.assert_allclose(load_scene(tmp_path, split="all", background="black").images, images, atol=1e-6)


def test_pictures_on_their_side_without_a_tag_say_what_to_do(tmp_path):
    turned_model(tmp_path, STORED[6], None)
    refused(lambda: load_scene(tmp_path), match=MESSAGES["scene.on_its_side"])
