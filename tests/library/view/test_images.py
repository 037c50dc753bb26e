"""Picture files, sheets, disparity colours."""

import imageio.v3 as iio
import numpy as np
import pytest
from refusals import refused
from scene_writers import png_bytes, write_deep_png

from warpcage.view import (
    color_disparity,
    contact_sheet,
    disparity_range,
    image_size,
    read_image,
    side_by_side,
    to_uint8,
    write_png,
)


def picture(height=12, width=16, channels=3, seed=0):
    return np.random.default_rng(seed).random((height, width, channels)).astype(np.float32)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_round_trip_is_exact_to_8_bits(tmp_path, channels):
    image = picture(channels=channels)
    write_png(tmp_path / "deep" / "image.png", image)
    back = read_image(tmp_path / "deep" / "image.png")
    assert back.shape == image.shape and back.dtype == np.float32
    assert np.abs(back - image).max() <= 0.5 / 255 + 1e-6
    np.testing.assert_array_equal(to_uint8(back), to_uint8(image))


def test_to_uint8_rounds_and_clips():
    np.testing.assert_array_equal(to_uint8([-1.0, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 7.0]), [0, 0, 0, 1, 255, 255])
    same = np.array([0, 3, 255], np.uint8)
    assert to_uint8(same) is same
    refused(lambda: to_uint8([0.5, np.nan]), match="not finite")


@pytest.mark.parametrize("image", [np.zeros((4, 4, 2)), np.zeros((0, 4, 3)), np.zeros(4), np.full((4, 4, 3), np.inf)])
def test_png_refuses_what_is_no_picture_and_keeps_the_old_file(tmp_path, image):
    path = tmp_path / "image.png"
    write_png(path, picture())
    before = path.read_bytes()
    refused(lambda: write_png(path, image))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["image.png"]


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_all_16_bits_of_a_png_are_read(tmp_path, channels):
    image = np.random.default_rng(0).integers(0, 65536, (9, 70, channels), dtype=np.uint16)
    write_deep_png(tmp_path / "deep.png", image)
    np.testing.assert_array_equal(np.round(read_image(tmp_path / "deep.png") * 65535), image)
    assert image_size(tmp_path / "deep.png") == (70, 9)


@pytest.mark.parametrize("depth", [8, 16])
def test_a_picture_that_declares_a_huge_size_is_refused_unread(tmp_path, depth):
    path = tmp_path / "bomb.png"
    path.write_bytes(png_bytes(60000, 60000, depth, 2, bytes(1000)))
    for read in (read_image, image_size):
        with pytest.raises(ValueError, match="bomb.png.*(60000x60000|exceeds limit)"):
            read(path)


@pytest.mark.parametrize("name", ["cut.png", "cut.jpg", "deep.png"])
def test_a_truncated_picture_is_named(tmp_path, name):
    path = tmp_path / name
    if name == "deep.png":
        write_deep_png(path, np.random.default_rng(0).integers(0, 65536, (40, 40, 3), dtype=np.uint16))
    else:
        iio.imwrite(path, np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8))
    whole = path.read_bytes()
    for share in (0.1, 0.3, 0.5, 0.7, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        refused(lambda: read_image(path), match=f"{name}.*cannot be read")


def test_png_wants_its_ending(tmp_path):
    refused(lambda: write_png(tmp_path / "image.jpg", picture()), match=r"must end in \.png")


def test_read_image_says_what_is_wrong(tmp_path):
    refused(lambda: read_image(tmp_path / "missing.png"), match="missing.png", error=FileNotFoundError)
    (tmp_path / "broken.png").write_bytes(b"no picture")
    refused(lambda: read_image(tmp_path / "broken.png"), match="broken.png.*cannot be read")


def test_contact_sheet_places_images():
    images = [np.full((3, 5, 3), level) for level in (0.1, 0.2, 0.3)]
    sheet = contact_sheet(images, columns=2, gap=1, background=(1.0, 0.0, 0.0))
    assert sheet.shape == (3 + 1 + 3, 5 + 1 + 5, 3)
    np.testing.assert_allclose(sheet[:3, :5], 0.1, rtol=1e-6)
    np.testing.assert_allclose(sheet[:3, 6:], 0.2, rtol=1e-6)
    np.testing.assert_allclose(sheet[4:, :5], 0.3, rtol=1e-6)
    for empty in (sheet[3], sheet[:, 5], sheet[4:, 6:].reshape(-1, 3)):
        np.testing.assert_array_equal(empty, np.broadcast_to([1.0, 0.0, 0.0], empty.shape))


def test_side_by_side_takes_grey_bytes_and_generators():
    row = side_by_side((image for image in (np.zeros((2, 2)), np.full((2, 2, 3), 255, np.uint8))), gap=0)
    np.testing.assert_array_equal(row[:, :2], 0.0)
    np.testing.assert_array_equal(row[:, 2:], 1.0)


@pytest.mark.parametrize("images", [[], [np.zeros((2, 2, 3)), np.zeros((3, 2, 3))]])
def test_contact_sheet_refuses(images):
    refused(lambda: contact_sheet(images), match="sheet")


def luminance(color):
    return color @ np.array([0.2126, 0.7152, 0.0722])


def test_disparity_colors_rise_in_lightness_and_show_nothing_as_black():
    disparity = np.linspace(0.2, 0.5, 64)[None].repeat(3, axis=0)
    disparity[0] = 0.0
    color = color_disparity(disparity)
    np.testing.assert_array_equal(color[0], 0.0)
    assert (np.diff(luminance(color[1]))[2:-2] > 0).all()
    assert color.min() >= 0 and color.max() <= 1
    assert luminance(color[1, 0]) > 0.01  # the farthest object still differs from nothing


def test_disparity_scale_ignores_a_few_wild_pixels():
    disparity = np.linspace(0.2, 0.3, 1000).reshape(20, 50)
    calm = disparity_range(disparity)
    disparity[3, 3], disparity[4, 4], disparity[5, 5] = 1e6, 0.0, np.inf
    np.testing.assert_allclose(disparity_range(disparity), calm, rtol=0.01)
    low, high = calm
    assert 0.18 < low < 0.21 and 0.29 < high < 0.31


def test_disparity_of_an_empty_view_and_of_one_depth():
    np.testing.assert_array_equal(color_disparity(np.zeros((2, 3))), 0.0)
    assert np.isfinite(color_disparity(np.full((2, 3), 0.25))).all()
    half = color_disparity(np.full((2, 3), 0.25), alpha=np.full((2, 3), 0.5), scale=(0.0, 1.0))
    np.testing.assert_allclose(half, 0.5 * color_disparity(np.full((2, 3), 0.25), scale=(0.0, 1.0)), rtol=1e-6)
    refused(lambda: color_disparity(np.ones((2, 2)), alpha=np.ones((2, 3))), match="alpha")
    refused(lambda: color_disparity(np.ones((2, 2)), scale=(1.0, 0.0)), match="scale")
    refused(lambda: color_disparity(np.ones((2, 2, 3))), match=r"\(h, w\)")
