"""Films as files: H.264 and GIF."""

from fractions import Fraction

import imageio.v3 as iio
import numpy as np
import pytest
from messages import MESSAGES
from PIL import Image
from refusals import refused

from warpcage.studio.films.video import write_gif, write_video


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
    random = np.random.default_rng(0)
    noise = [np.clip(0.97 + 0.03 * random.random((40, 40, 3)), 0, 1) for _ in range(3)]
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
