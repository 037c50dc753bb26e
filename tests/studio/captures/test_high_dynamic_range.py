"""Videos of high dynamic range become pictures of sRGB: beside BT.2100's formulas in float64, colour by colour."""

import fractions

import numpy as np
import pytest

from warpcage import capture
from warpcage.studio.captures import scan_video, write_frames
from warpcage.studio.captures.tones import light_of_hlg, light_of_pq, mapped_picture, pressed, srgb_of, transfer_of

TRC = {"HLG": 18, "PQ": 16}

#: Signals R'G'B' of patches.
PATCHES = np.array(
    [[0, 0, 0], [0.25, 0.25, 0.25], [0.5, 0.5, 0.5], [0.58, 0.58, 0.58], [0.75, 0.75, 0.75], [1, 1, 1],
     [0.5, 0.4, 0.3], [0.2, 0.5, 0.3], [0.6, 0.5, 0.7], [0.3, 0.3, 0.45]]
)  # fmt: skip


def oracle(signal, transfer):
    """sRGB of one signal, channel by channel, by the texts of BT.2100, BT.2087 and IEC 61966-2-1."""
    if transfer == "HLG":
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = [x * x / 3 if x <= 0.5 else (np.exp((x - c) / a) + b) / 12 for x in signal]
        luminance = 0.2627 * scene[0] + 0.6780 * scene[1] + 0.0593 * scene[2]
        light = [1000 / 203 * (luminance**0.2 if luminance else 0.0) * x for x in scene]
    else:
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        roots = [x ** (1 / m2) for x in signal]
        light = [10000 / 203 * (max(x - c1, 0) / (c2 - c3 * x)) ** (1 / m1) for x in roots]
    to_709 = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    light = [max(0.0, sum(m * x for m, x in zip(row, light, strict=True))) for row in to_709]
    most, white = max(light), (1000 / 203 - 0.5) / 0.5
    above = (most - 0.5) / 0.5
    shown = most if most <= 0.5 else min(1.0, 0.5 + 0.5 * above * (1 + above / white**2) / (1 + above))
    light = [min(1.0, x * shown / most) if most else 0.0 for x in light]
    return [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in light]


def codes(signal, *, full=False, wide=True):
    """Y'CbCr codes of 10 bits of signals (n, 3), BT.2100 tables 6 and 9."""
    red, blue = (0.2627, 0.0593) if wide else (0.2126, 0.0722)
    r, g, b = signal.T
    luma = red * r + (1 - red - blue) * g + blue * b
    cb, cr = (b - luma) / (2 - 2 * blue), (r - luma) / (2 - 2 * red)
    if full:
        return np.round([1023 * luma, 1023 * cb + 512, 1023 * cr + 512]).astype(np.uint16)
    return np.round([876 * luma + 64, 896 * cb + 512, 896 * cr + 512]).astype(np.uint16)


def frame_of(signal, transfer, *, full=False, height=16):
    """A frame of 10 bits with a patch for each signal, 16 pixels wide."""
    import av

    planes = np.repeat(np.repeat(codes(signal, full=full)[:, None], height, axis=1), 16, axis=2)  # (3, height, 16 n)
    frame = av.VideoFrame(planes.shape[2], height, "yuv420p10le")
    for plane, values in zip(frame.planes, (planes[0], planes[1, ::2, ::2], planes[2, ::2, ::2]), strict=True):
        rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
        rows[:, : values.shape[1]] = values
        plane.update(rows.tobytes())
    frame.color_trc, frame.color_primaries, frame.colorspace = TRC[transfer], 9, 9
    frame.color_range = 2 if full else 1
    return frame


@pytest.mark.parametrize("transfer", TRC)
def test_values_are_those_of_the_formulas(transfer):
    found = srgb_of(PATCHES.astype(np.float64), transfer)
    np.testing.assert_allclose(found, [oracle(each, transfer) for each in PATCHES], atol=1e-6)
    assert np.abs(srgb_of(PATCHES.astype(np.float32), transfer) - found).max() < 2e-4


def test_white_paper_and_the_ends():
    """BT.2408: paper at 75 % of HLG and 58 % of PQ; both ends of the curve, which never falls."""
    np.testing.assert_allclose(light_of_hlg(np.full(3, 0.75)), 1.0, atol=0.01)
    np.testing.assert_allclose(light_of_pq(np.full(3, 0.58)), 1.0, atol=0.02)
    np.testing.assert_allclose(light_of_hlg(np.ones(3)), 1000 / 203, rtol=1e-3)
    np.testing.assert_allclose(light_of_pq(np.ones(3)), 10000 / 203, rtol=1e-6)
    light = np.linspace(0, 60, 5000)
    shown = pressed(light)
    np.testing.assert_array_equal(shown[light <= 0.5], light[light <= 0.5])
    assert (np.diff(shown) >= 0).all() and shown[-1] == 1.0 and pressed(np.array(1000 / 203)) == pytest.approx(1.0)
    slopes = np.diff(pressed(np.array([0.5 - 1e-6, 0.5, 0.5 + 1e-6])))
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-4)  # no corner at the knee


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("transfer", TRC)
def test_frames_of_ten_bits(transfer, full):
    frame = frame_of(PATCHES, transfer, full=full)
    assert transfer_of(frame) == transfer
    picture = mapped_picture(frame, transfer)
    found = picture[8, 8::16].astype(float) / 255
    expected = np.array([oracle(each, transfer) for each in PATCHES])
    # half a step of 8 bits, and a step of 10 bits of the signal, which is steep for PQ
    assert np.abs(found - expected).max() < (0.02 if transfer == "PQ" else 0.01)
    assert np.abs(found - expected).mean() < 0.004


def test_other_frames_are_left_alone():
    import av

    frame = av.VideoFrame.from_ndarray(np.zeros((16, 16, 3), np.uint8), format="rgb24")
    assert transfer_of(frame) == ""
    for number in (1, 2, 13, 14):
        frame.color_trc = number
        assert transfer_of(frame) == ""

    class Old:
        """A frame of an older PyAV, which does not say."""

    class Context:
        color_trc = 18

    assert transfer_of(Old(), Context()) == "HLG" and transfer_of(Old()) == ""


def write_video(path, transfer, count=4):
    """An H.265 video of 10 bits without loss, its frames shifted patches."""
    import av

    if "libx265" not in av.codecs_available:
        pytest.skip("no encoder for 10 bits")
    with av.open(str(path), "w") as container:
        params = "lossless=1:log-level=none:colorprim=bt2020:colormatrix=bt2020nc:transfer="
        params += {"HLG": "arib-std-b67", "PQ": "smpte2084"}[transfer]
        stream = container.add_stream("libx265", rate=30, options={"x265-params": params})
        stream.width, stream.height, stream.pix_fmt = 160, 64, "yuv420p10le"
        stream.codec_context.color_trc, stream.codec_context.color_primaries = TRC[transfer], 9
        stream.codec_context.colorspace, stream.codec_context.color_range = 9, 1
        for index in range(count):
            frame = frame_of(np.roll(PATCHES, index, axis=0), transfer, height=64)
            frame.pts, frame.time_base = index, fractions.Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("transfer", TRC)
def test_videos_are_tone_mapped_and_it_is_said(tmp_path, transfer):
    from PIL import Image

    video = write_video(tmp_path / "v.mp4", transfer)
    scores = scan_video(video)
    assert scores.transfer == transfer and len(scores.times) == 4
    files = [tmp_path / f"{k}.png" for k in range(4)]
    write_frames(video, scores.times, files)
    for index, file in enumerate(files):
        found = np.asarray(Image.open(file))[8, 8::16].astype(float) / 255
        expected = [oracle(each, transfer) for each in np.roll(PATCHES, index, axis=0)]
        assert np.abs(found - expected).max() < (0.02 if transfer == "PQ" else 0.01)
    with pytest.warns(UserWarning, match=f"of high dynamic range .{transfer}.: its"), pytest.raises(ValueError):
        capture(video, tmp_path / "scene")  # four frames of patches show no views
