"""Kinds of picture files, and pictures whose camera was turned."""

import builtins

import numpy as np
import pytest
from messages import MESSAGES
from PIL import Image
from scene_writers import Pictures, spiral_cameras, write_colmap, write_transforms

from warpcage import load_scene
from warpcage.view import read_image

ORIENTATION = 0x0112

#: How a picture that is stored so becomes upright, by EXIF's number of its orientation (the standard's table).
UPRIGHT = {
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
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
    return Pictures(np.repeat(color[None], 9, axis=0), spiral_cameras(9))


def save_heif(picture, path):
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    picture.save(path, format="HEIF", quality=95, chroma=444)


KINDS = {
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


def test_tiffs_of_16_bits_and_of_premultiplied_colours(tmp_path):
    values = np.random.default_rng(0).integers(0, 65536, (6, 8), dtype=np.uint16)
    Image.fromarray(values).save(tmp_path / "deep.tif")
    np.testing.assert_allclose(read_image(tmp_path / "deep.tif")[..., 0], values / 65535, atol=1e-7)
    data = (tmp_path / "deep.tif").read_bytes()
    assert data[:2] == b"II"
    Image.fromarray(np.zeros((4, 4), np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(ValueError, match="float.tif.*8 or 16 bits"):
        read_image(tmp_path / "float.tif")


def test_heic_without_its_library_says_how_to_get_it(tmp_path, smooth, monkeypatch):
    path = tmp_path / "a.heic"
    path.write_bytes(bytes(100))
    load = builtins.__import__

    def missing(name, *rest, **options):
        if name == "pillow_heif":
            raise ImportError(name)
        return load(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ValueError, match=MESSAGES["scene.heif_library"]) as error:
        read_image(path)
    assert "\n" not in str(error.value)


# Pictures on their side


@pytest.fixture
def turned(tmp_path, request):
    """A COLMAP model of upright pictures whose files are stored on their side, with an orientation tag of theirs."""
    number, masks, _ending = request.param
    color = np.random.default_rng(0).integers(0, 256, (9, 20, 24, 4), dtype=np.uint8)
    pictures = Pictures(color, spiral_cameras(9))
    write_colmap(tmp_path, pictures, binary=True, masks=masks)
    for path in (tmp_path / "images").iterdir():
        stored = Image.open(path).transpose(STORED[number])
        exif = Image.Exif()
        exif[ORIENTATION] = number
        stored.save(path, exif=exif)
        assert stored.size == (20, 24)
    return tmp_path, pictures


EACH = [(number, False, ".png") for number in STORED] + [(6, True, ".png")]


@pytest.mark.parametrize("turned", EACH, indirect=True, ids=str)
@pytest.mark.parametrize("downscale", [1, 2])
def test_pictures_on_their_side_are_made_upright_where_the_model_is(turned, downscale):
    folder, pictures = turned
    scene = load_scene(folder, split="all", downscale=downscale, background=(0, 0, 0))
    assert scene.images.shape[1:3] == (20 // downscale, 24 // downscale)
    if downscale == 1:
        images, alphas = pictures.over((0, 0, 0))
        np.testing.assert_allclose(scene.images, images, atol=1e-6)
        np.testing.assert_allclose(scene.alphas, alphas, atol=1e-6)


def test_pictures_that_the_model_has_on_their_side_stay_so(tmp_path):
    color = np.random.default_rng(0).integers(0, 256, (9, 20, 24, 3), dtype=np.uint8)
    write_colmap(tmp_path, Pictures(color, spiral_cameras(9)), binary=True)
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    for path in (tmp_path / "images").iterdir():
        Image.open(path).save(path, exif=exif)
    np.testing.assert_allclose(load_scene(tmp_path, split="all").images, color / 255, atol=1e-6)


def test_pictures_on_their_side_without_a_tag_say_what_to_do(tmp_path):
    color = np.random.default_rng(0).integers(0, 256, (9, 20, 24, 3), dtype=np.uint8)
    write_colmap(tmp_path, Pictures(color, spiral_cameras(9)), binary=True)
    for path in (tmp_path / "images").iterdir():
        Image.open(path).transpose(Image.Transpose.ROTATE_90).save(path)
    with pytest.raises(ValueError, match=MESSAGES["scene.on_its_side"]):
        load_scene(tmp_path)
