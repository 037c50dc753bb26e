"""Picture and film files, sheets, disparity colours."""

from fractions import Fraction

import imageio.v3 as iio
import numpy as np
import pytest
from messages import MESSAGES
from PIL import Image
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
    write_gif,
    write_png,
    write_video,
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


def film(count=6, height=32, width=48):
    """A bright square that moves right, on a blue ground."""
    for index in range(count):
        frame = np.zeros((height, width, 3), np.float32)
        frame[..., 2] = 0.5
        frame[8:24, 4 + 4 * index : 20 + 4 * index] = (1.0, 0.8, 0.1)
        yield frame


def test_video_is_h264_that_browsers_play(tmp_path):
    path = tmp_path / "film.mp4"
    write_video(path, film(), fps=12)
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
        assert float(stream.average_rate) == pytest.approx(12)
    back = iio.imread(path, plugin="pyav") / 255.0
    assert back.shape == (6, 32, 48, 3)
    for ours, theirs in zip(film(), back, strict=True):
        assert np.abs(ours - theirs).mean() < 0.05


@pytest.mark.parametrize(
    ("fps", "rate"),
    [
        (0.3, Fraction(3, 10)),
        (12.5, Fraction(25, 2)),
        (1.5, Fraction(3, 2)),
        (29.97002997, Fraction(30000, 1001)),
        (Fraction(24000, 1001), Fraction(24000, 1001)),
        (0.01, Fraction(1, 100)),
        (1000, Fraction(1000)),
    ],
)
def test_rates_stay_fractions(tmp_path, fps, rate):
    import av

    write_video(tmp_path / "film.mp4", film(3), fps=fps)
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        starts = [frame.pts * stream.time_base for frame in container.decode(stream)]
        assert stream.average_rate == rate and starts == [0, 1 / rate, 2 / rate]
    if rate > 50:
        return  # no GIF
    write_gif(tmp_path / "film.gif", film(6), fps=fps)
    with Image.open(tmp_path / "film.gif") as picture:
        ends = np.cumsum([picture.seek(index) or picture.info["duration"] for index in range(picture.n_frames)])
    np.testing.assert_allclose(
        ends, [float(1000 * index / rate) for index in range(1, 7)], atol=5
    )  # to half a hundredth


@pytest.mark.parametrize("fps", [0, -1, 0.001, 1e30, float("nan"), float("inf"), Fraction(1, 101), "fast"])
@pytest.mark.parametrize("write, ending", [(write_video, ".mp4"), (write_gif, ".gif")])
def test_rates_that_no_film_has_are_refused(tmp_path, write, ending, fps):
    refused(lambda: write(tmp_path / f"film{ending}", film(), fps=fps), match="^fps .*must be .*got [^\n]*$")
    assert list(tmp_path.iterdir()) == []


def test_a_gif_that_would_lose_time_is_refused(tmp_path):
    with pytest.raises(ValueError, match=MESSAGES["view.gif_fps"]):  # viewers would slow it down
        write_gif(tmp_path / "film.gif", film(), fps=60)
    still = [np.zeros((4, 4, 3))] * 8
    refused(lambda: write_gif(tmp_path / "film.gif", still, fps=0.01), match=MESSAGES["view.gif_seconds"])
    write_gif(tmp_path / "film.gif", still, fps=0.0125)
    with Image.open(tmp_path / "film.gif") as picture:
        assert picture.info["duration"] == 640000


def test_video_cuts_odd_sizes(tmp_path):
    write_video(tmp_path / "odd.mp4", film(2, height=33, width=49))
    assert iio.imread(tmp_path / "odd.mp4", plugin="pyav").shape == (2, 32, 48, 3)


def test_gif_keeps_frames_and_colors(tmp_path):
    path = tmp_path / "film.gif"
    write_gif(path, film(), fps=10)
    back = iio.imread(path)[..., :3] / 255.0
    assert back.shape == (6, 32, 48, 3)
    for ours, theirs in zip(film(), back, strict=True):
        assert np.abs(ours - theirs).max() < 0.03
    noise = [np.clip(0.97 + 0.03 * picture(40, 40, seed=seed), 0, 1) for seed in range(3)]
    for frame in noise:
        frame[:, :20] = 1.0
    write_gif(tmp_path / "white.gif", noise, colors=8)
    assert (iio.imread(tmp_path / "white.gif")[:, :, :20] == 255).all()  # the background is not mixed with its like
    properties = iio.immeta(path)
    assert properties["duration"] == pytest.approx(100) and properties["loop"] == 0


@pytest.mark.parametrize("write, ending", [(write_video, ".mp4"), (write_gif, ".gif")])
def test_films_are_whole_or_absent(tmp_path, write, ending):
    def breaks():
        yield from film(2)
        raise KeyboardInterrupt

    path = tmp_path / f"film{ending}"
    with pytest.raises(KeyboardInterrupt):
        write(path, breaks())
    refused(lambda: write(path, []), match="at least one frame")
    refused(lambda: write(path, [np.zeros((4, 4, 3)), np.zeros((4, 6, 3))]), match="frame 1 is")
    refused(lambda: write(tmp_path / "film.avi", film()), match="must end in")
    refused(lambda: write(path, film(), fps=0), match="fps")
    assert list(tmp_path.iterdir()) == []
