"""Pictures and films with opacity, opened again and compared with what was rendered."""

import numpy as np
import pytest
from refusals import refused
from runs import DEFORMED, SMALL, succeed

from warpcage import Camera, Frame
from warpcage.studio.films.video import with_spread_colors, write_film
from warpcage.view import depth_along_view, linear_light, read_exr, read_image, rgba_picture, write_exr

av = pytest.importorskip("av")

VIEW = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, *SMALL]


def read_film(path):
    """(n, h, w, 4) float of a film with opacity, by the decoder that knows of it."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        vp9 = stream.codec_context.name == "vp9"  # FFmpeg's own decoder leaves opacity out
        decoder = av.CodecContext.create("libvpx-vp9", "r") if vp9 else stream.codec_context
        packets = (packet if packet.size else None for packet in container.demux(stream))
        frames = [frame for packet in packets for frame in decoder.decode(packet)]
    # whole colours first: swscale loses the last odd column on the way from 4:2:0 to RGB
    whole = [frame.reformat(format="yuva444p") if vp9 else frame for frame in frames]
    return np.array([one.reformat(format="rgba64le", src_colorspace="ITU709").to_ndarray() for one in whole]) / 65535


def over(rgba, color):
    """Straight colours before a background, as a screen mixes them."""
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * np.asarray(color, float)


def test_a_still_with_opacity_lies_over_any_color(files, tmp_path):
    for color in ("transparent", "white", "black"):
        succeed(files, "render", "@ball.npz", "-o", tmp_path / f"{color}.png", *DEFORMED, *VIEW, "--background", color)
    rgba = read_image(tmp_path / "transparent.png")
    assert rgba.shape == (40, 40, 4) and rgba[0, 0, 3] == 0 and rgba[20, 20, 3] == 1
    for name, color in (("white", 1.0), ("black", 0.0)):
        assert np.abs(over(rgba, [color] * 3) - read_image(tmp_path / f"{name}.png")).max() < 2.5 / 255
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "same.png", *DEFORMED, *VIEW, "--transparent")
    assert (tmp_path / "same.png").read_bytes() == (tmp_path / "transparent.png").read_bytes()


def test_an_exr_holds_light_times_opacity_and_depth(files, tmp_path):
    argv = ["render", "@ball.npz", *DEFORMED, *VIEW]
    succeed(files, *argv, "--transparent", "-o", tmp_path / "ball.png")
    succeed(files, *argv, "--transparent", "-o", tmp_path / "ball.exr")
    succeed(files, *argv, "--background", "white", "-o", tmp_path / "white.exr")
    straight, channels = read_image(tmp_path / "ball.png"), read_exr(tmp_path / "ball.exr")
    rgba, depth = channels["RGBA"].astype(float), channels["Z"]
    assert channels["RGBA"].dtype == np.float16 and depth.dtype == np.float32
    np.testing.assert_allclose(rgba[..., 3], straight[..., 3], atol=3e-3)
    # IEC 61966-2-1, written out again
    light = np.where(straight <= 0.04045, straight / 12.92, ((straight + 0.055) / 1.055) ** 2.4)[..., :3]
    np.testing.assert_allclose(rgba[..., :3], light * straight[..., 3:], atol=6e-3)
    assert depth[0, 0] == np.float32(1e10) and 2.2 < depth[20, 20] < 3.0
    white = read_exr(tmp_path / "white.exr")
    assert set(white) == {"RGB", "Z"} and (white["RGB"][0, 0] == 1).all()


@pytest.mark.parametrize("channels", [3, 4])
def test_an_exr_of_a_turned_picture_is_the_picture(tmp_path, channels):
    pytest.importorskip("OpenEXR")  # 3.5 reads memory in a row, whatever the strides
    image = np.random.default_rng(0).random((channels, 5, 7)).astype(np.float32)
    for turned in (image.transpose(1, 2, 0), image.transpose(2, 1, 0), np.rot90(image.transpose(1, 2, 0))):
        write_exr(tmp_path / "turned.exr", turned)
        write_exr(tmp_path / "plain.exr", np.array(turned, order="C"))
        (one,), (other,) = (read_exr(tmp_path / name).values() for name in ("turned.exr", "plain.exr"))
        np.testing.assert_array_equal(one, other)
        if channels == 4:
            np.testing.assert_allclose(one[..., 3], turned[..., 3], atol=1e-3)


def test_depth_in_a_file_is_along_the_view():
    camera = Camera.look_at([0, -4, 0], (0, 0, 0), width=9, height=7, fov_degrees=80)
    _origins, directions = camera.rays()
    along = directions.reshape(7, 9, 3) @ [0.0, 1.0, 0.0]  # a wall across the view, 4 before the camera
    depth = np.where(np.arange(9) == 0, np.inf, 4.0 / along)
    frame = Frame(9, 7, np.zeros((63, 3)), np.ones(63), depth.reshape(-1))
    np.testing.assert_allclose(depth_along_view(frame, camera)[:, 1:], 4.0, rtol=1e-5)
    assert (depth_along_view(frame, camera)[:, 0] == np.float32(1e10)).all()


@pytest.mark.parametrize("ending", ["mov", "webm"])
def test_a_film_with_opacity_opened_again(files, tmp_path, ending):
    """Over black, white and green it looks as the frames themselves do: no dark rim, no loss of opacity."""
    argv = ["animate", "@ball.npz", *DEFORMED, *VIEW, "--size", 65, 49, "--frames", 3, "--turn", 0, "--quiet"]
    argv += ["--background", "transparent"]
    succeed(files, *argv, "-o", tmp_path / "frames")
    succeed(files, *argv, "-o", tmp_path / f"film.{ending}")
    frames = np.array([read_image(path) for path in sorted((tmp_path / "frames").glob("*.png"))])
    film = read_film(tmp_path / f"film.{ending}")
    assert film.shape == frames.shape == (3, 49, 65, 4)
    assert np.abs(film[..., 3] - frames[..., 3]).mean() < (0.002 if ending == "mov" else 0.01)
    for color in ([0, 0, 0], [1, 1, 1], [0, 1, 0]):
        error = over(film, color) - over(frames, color)
        assert 10 * np.log10(1 / np.mean(error**2)) > (45 if ending == "mov" else 29)
    assert np.abs(frames[1] - frames[0]).mean() > 0.01


def test_folders_of_exr_files(files, tmp_path):
    folder = tmp_path / "frames"
    argv = ["animate", "@ball.npz", "-o", folder, *VIEW, "--frames", 3, "--quiet", "--transparent", "--format", "exr"]
    succeed(files, *argv)
    frames = [read_exr(path) for path in sorted(folder.glob("*.exr"))]
    assert len(frames) == 3 and all(set(one) == {"RGBA", "Z"} for one in frames)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "views", "--cameras", "given", "--scene", "@scene:test",
            "--transparent", "--format", "exr")  # fmt: skip
    assert read_exr(tmp_path / "views" / "view_0001.exr")["RGBA"].shape == (24, 24, 4)


def test_colors_go_on_beyond_an_edge():
    rgba = np.zeros((9, 9, 4), np.float32)
    rgba[4, 4] = [0.2, 0.4, 0.6, 1.0]
    spread = with_spread_colors(rgba, reach=2)
    np.testing.assert_array_equal(spread[..., 3], rgba[..., 3])
    np.testing.assert_allclose(spread[4, 2, :3], [0.2, 0.4, 0.6])
    assert (spread[0, 0] == 0).all()
    np.testing.assert_array_equal(with_spread_colors(np.zeros((2, 2, 4))), np.zeros((2, 2, 4)))


def test_straight_colors_of_a_frame():
    colors = np.array([[[0.2, 0.1, 0.0], [0.0, 0.0, 0.0]]])
    rgba = rgba_picture(Frame(2, 1, colors, np.array([[0.5, 0.0]]), np.ones((1, 2))))
    np.testing.assert_allclose(rgba, [[[0.4, 0.2, 0.0, 0.5], [0, 0, 0, 0]]], atol=1e-6)
    np.testing.assert_allclose(linear_light([0.0, 0.5, 1.0]), [0.0, 0.21404, 1.0], atol=1e-5)


def test_films_and_pictures_that_cannot_be(tmp_path, monkeypatch):
    refused(lambda: write_film(tmp_path / "film.mov", [np.zeros((16, 16, 4)), np.zeros((16, 16, 3))]), match="one size")
    refused(lambda: write_film(tmp_path / "film.webm", []), match="at least one frame")
    refused(lambda: write_exr(tmp_path / "one.exr", np.zeros((4, 4, 3)), np.zeros((2, 2))), match="depth must be")
    monkeypatch.setitem(__import__("sys").modules, "OpenEXR", None)
    refused(lambda: write_exr(tmp_path / "one.exr", np.zeros((4, 4, 3))), match=r"pip install .*\[exr\]")
    assert not list(tmp_path.iterdir())
