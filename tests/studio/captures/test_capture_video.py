"""Frames of videos: which are picked, how they are turned, and what becomes of damage."""

import fractions
import struct

import numpy as np
import pytest
from messages import MESSAGES
from PIL import Image
from refusals import refused
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as shifted

from warpcage.studio.captures import FrameScores, motion, pick_frames, scan_video, sharpness, write_frames


def turn_video(path, degrees):
    """Write the rotation of a phone into the track header of an MP4 file (ISO 14496-12, 8.3.2): its matrix alone."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    cosine, sine = round(np.cos(np.radians(degrees))), round(np.sin(np.radians(degrees)))
    struct.pack_into(">9i", data, at, cosine << 16, sine << 16, 0, -sine << 16, cosine << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def write_video(path, pictures, times=None):
    """An H.264 video with frames at the given times, in thirtieths of a second."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12", "g": "4", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], "yuv420p"
        stream.time_base = stream.codec_context.time_base = fractions.Fraction(1, 30)
        for index, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = index if times is None else times[index]
            frame.time_base = fractions.Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def moving_pictures(shifts, size=(96, 128), seed=0):
    """Cut-outs of one random picture with soft patches, shifted by so many pixels."""
    rng = np.random.default_rng(seed)
    wide = gaussian_filter(rng.standard_normal((size[0], size[1] + int(max(shifts)) + 8, 3)), (2, 2, 0))
    wide = np.clip(128 + 200 * wide, 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(wide[:, int(s) : int(s) + size[1]]) for s in shifts]


def test_blur_lowers_sharpness_whatever_is_seen():
    rng = np.random.default_rng(3)
    for content in (rng.uniform(0, 255, (200, 300)), gaussian_filter(rng.uniform(0, 2550, (200, 300)), 1.5)):
        values = [sharpness(gaussian_filter(content, blur)) for blur in (0.0, 0.7, 1.5, 3.0)]
        assert all(np.diff(values) < 0) and values[3] < 0.75 * values[0]
    assert sharpness(np.full((200, 300), 80.0)) == 0.0


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_motion_is_how_far_the_view_moves(shift):
    picture = gaussian_filter(np.random.default_rng(1).uniform(0, 255, (80, 96)), 2.5) * 4
    moved = shifted(picture, (0, shift), order=3, mode="nearest")
    assert motion(picture, picture) == 0.0
    # along one axis the mean over directions of gradients is half to all of it
    assert 0.4 * shift < 96 * motion(picture, moved) < 1.1 * shift


def test_frames_are_sharp_and_evenly_along_the_way():
    rng = np.random.default_rng(0)
    steps = np.where(np.arange(300) < 200, 0.002, 0.02)  # slow, then ten times as fast
    scores = FrameScores(np.arange(300), rng.uniform(0.5, 1.0, 300), np.cumsum(steps), (640, 480), 0)
    picked = pick_frames(scores, 24)
    assert len(picked) == 24 and (np.diff(picked) > 0).all()
    assert (picked >= 200).sum() == 20  # of a way of 2.4 the fast part is 2.0
    part = (scores.way / scores.way[-1] * 24).astype(int).clip(max=23)
    for frame in picked:
        assert scores.sharpness[frame] == scores.sharpness[part == part[frame]].max()


def test_a_still_video_has_one_frame():
    scores = FrameScores(np.arange(50), np.ones(50), np.full(50, 1e-4), (640, 480), 0)
    assert len(pick_frames(scores, 20)) == 1


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_frames_are_turned_as_the_phone_was_held(tmp_path, degrees):
    """A player turns a picture clockwise by the angle of the matrix; Pillow is the judge of the turn."""
    pictures = moving_pictures([0, 9, 18])
    video = write_video(tmp_path / "v.mp4", pictures)
    turn_video(video, degrees)
    scores = scan_video(video)
    assert scores.size == ((96, 128) if degrees % 180 else (128, 96))
    files = [tmp_path / f"{k}.png" for k in range(3)]
    write_frames(video, scores.times, files)
    for file, picture in zip(files, pictures, strict=True):
        upright = np.asarray(Image.fromarray(picture).rotate(-degrees, expand=True)).astype(float)
        assert np.abs(np.asarray(Image.open(file)) - upright).mean() < 6


def test_frames_at_uneven_times(tmp_path):
    """Variable frame rate: each frame is found again by its own time."""
    pictures = moving_pictures([0, 8, 16, 24, 32, 40])
    video = write_video(tmp_path / "v.mp4", pictures, times=[0, 1, 7, 8, 30, 31])
    scores = scan_video(video)
    assert len(scores.times) == 6 and np.ptp(np.diff(scores.times)) > 0
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    write_frames(video, scores.times[[1, 4]], files)
    for file, picture in zip(files, (pictures[1], pictures[4]), strict=True):
        assert np.abs(np.asarray(Image.open(file)).astype(float) - picture).mean() < 6


def test_broken_frames_are_left_out(tmp_path):
    video = write_video(tmp_path / "v.mp4", moving_pictures(range(0, 160, 4)))
    data = bytearray(video.read_bytes())
    start = data.index(b"mdat") + 4
    rng = np.random.default_rng(0)
    for at in rng.integers(start + (len(data) - start) // 4, start + (len(data) - start) // 2, 60):
        data[at] = rng.integers(256)
    video.write_bytes(data)
    with pytest.warns(UserWarning, match=MESSAGES["captures.frames_left_out"]):
        scores = scan_video(video)
    assert 20 <= len(scores.times) < 40 and scores.broken > 0


@pytest.mark.parametrize("content", [b"", b"no video at all", b"\0\0\0\x18ftypmp42" + bytes(400)])
def test_a_file_that_is_no_video(tmp_path, content):
    file = tmp_path / "v.mp4"
    file.write_bytes(content)
    refused(lambda: scan_video(file), match=MESSAGES["captures.no_video"])


@pytest.mark.parametrize("word_is_known", [True, False])
def test_versions_of_pyav_with_and_without_the_word_for_names(tmp_path, monkeypatch, word_is_known):
    """From version 19 on `av.open` does not take `metadata_errors`."""
    import av

    video, usual = write_video(tmp_path / "v.mp4", moving_pictures([0, 9, 18])), av.open

    def opened(name, **options):
        known = options.pop("metadata_errors", None) is None
        if not (known or word_is_known):
            raise TypeError("open() got an unexpected keyword argument 'metadata_errors'")
        return usual(name, **options)

    monkeypatch.setattr(av, "open", opened)
    assert len(scan_video(video).times) == 3
