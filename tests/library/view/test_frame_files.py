"""Frames as pipelines take them: opacity, masks, depth along the axis, and files by their ending."""

import io
import pickle

import numpy as np
import pytest
from fields import BOX, shiny_field, view
from PIL import Image
from refusals import refused
from splat_scenes import splats_in_box

from warpcage import Deformer, Frame
from warpcage.field import LayeredBackground
from warpcage.view import read_exr, read_image
from warpcage.view.frame import parse_background

CAMERA = view(size=24)


@pytest.fixture(scope="module", params=["voxels", "splats", "posed voxels", "posed splats"])
def renderer(request):
    field = splats_in_box("cpu") if "splats" in request.param else shiny_field("cpu", resolution=16)
    if "posed" not in request.param:
        return field
    return Deformer(field, BOX, coordinates="mean_value", resolution=16).pose(BOX.bend(20))


def test_a_transparent_frame_is_the_light_alone(renderer):
    clear, black = renderer.render(CAMERA, background="transparent"), renderer.render(CAMERA, background="black")
    np.testing.assert_array_equal(clear.rgb, black.rgb)
    assert clear.transparent and not black.transparent and clear.camera is CAMERA


def test_opacity_without_the_background_is_the_same_on_all_colors(renderer):
    clear = renderer.render(CAMERA, background="transparent")
    for color in ("white", (0.2, 0.5, 0.9)):
        frame = renderer.render(CAMERA, background=color)
        np.testing.assert_allclose(frame.rgba_premultiplied, clear.rgba_premultiplied, atol=1e-6)
        seen = frame.alpha > 0.02
        np.testing.assert_allclose(frame.rgba[seen], clear.rgba[seen], atol=1e-4)


def test_straight_color_times_opacity_is_premultiplied_color():
    rgb = np.array([[0.2, 0.1, 0.0], [0.0, 0.0, 0.0], [1.2, -0.1, 0.5]])
    frame = Frame(3, 1, rgb, np.array([0.5, 0.0, 1.0]), np.ones(3))
    frame.background = np.zeros(3)
    np.testing.assert_allclose(frame.rgba, [[[0.4, 0.2, 0, 0.5], [0, 0, 0, 0], [1, 0, 0.5, 1]]], atol=1e-6)
    np.testing.assert_allclose(frame.rgba_premultiplied[0, :, :3], rgb, atol=1e-6)  # as rendered, not clipped
    np.testing.assert_array_equal(frame.mask, [[True, False, True]])


def test_a_background_that_is_misspelt_is_told_with_all_names(renderer):
    refused(lambda: renderer.render(CAMERA, background="transparen"), match="white, .*, transparent or 3")
    with pytest.raises(ValueError, match="'transparent' is not .* gray or 3"):
        parse_background("transparent")  # where a colour is asked for


def test_a_background_that_cannot_be_taken_away_is_told(device):
    bare = Frame(1, 1, np.zeros(3), np.zeros(1), np.ones(1))
    with pytest.raises(ValueError, match='not known, .*background="transparent"'):
        bare.rgba  # noqa: B018
    with pytest.raises(ValueError, match="set its camera"):
        bare.z_depth  # noqa: B018
    field = shiny_field(device, resolution=8)
    field.background_model = LayeredBackground(np.zeros(3), 1.0, 2, np.ones((2, 26, 4), np.float32), device=device)
    with pytest.raises(ValueError, match="a model of a scene"):
        field.render(CAMERA).rgba  # noqa: B018
    assert field.render(CAMERA, background="transparent").rgba[0, 0, 3] == 0.0


def test_depth_along_the_axis_is_that_of_the_point(renderer):
    frame = renderer.render(CAMERA, background="transparent")
    origins, directions = CAMERA.rays()
    seen = np.isfinite(frame.depth)
    points = (origins + frame.depth[..., None] * directions)[seen]
    along = (points - CAMERA.center) @ CAMERA.camera_to_world[:3, 2]
    np.testing.assert_allclose(frame.z_depth[seen], along, rtol=1e-5)
    assert seen.any() and np.isinf(frame.z_depth[~seen]).all()


def test_files_hold_the_frame(renderer, tmp_path):
    opaque, clear = renderer.render(CAMERA, background="white"), renderer.render(CAMERA, background="transparent")
    opaque.save(tmp_path / "a.PNG")
    np.testing.assert_array_equal(read_image(tmp_path / "a.PNG") * 255, opaque.rgb_bytes)
    clear.save(tmp_path / "a.png")
    assert np.abs(read_image(tmp_path / "a.png") - clear.rgba).max() < 0.51 / 255
    opaque.save(tmp_path / "a.jpg")
    assert np.abs(read_image(tmp_path / "a.jpg") - np.clip(opaque.rgb, 0, 1)).mean() < 0.02
    clear.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        for name in (*clear.arrays, "z_depth", "background"):
            np.testing.assert_array_equal(arrays[name], getattr(clear, name))
    refused(lambda: clear.save(tmp_path / "b.jpg"), match="JPEG holds")
    for name in ("b.gif", "b", "b.tiff"):
        with pytest.raises(ValueError, match="ends in .png"):
            opaque.save(tmp_path / name)
    assert not list(tmp_path.glob("b*"))


def test_an_exr_has_opacity_and_depth(renderer, tmp_path):
    pytest.importorskip("OpenEXR")
    for background, channels in (("white", "RGB"), ("transparent", "RGBA")):
        frame = renderer.render(CAMERA, background=background)
        frame.save(tmp_path / "a.exr")
        held = read_exr(tmp_path / "a.exr")
        assert (
            set(held) == {channels, "Z"} and (held["Z"] == np.where(np.isinf(frame.depth), 1e10, frame.z_depth)).all()
        )


def test_notebooks_show_the_picture(renderer):
    for background, mode in (("white", "RGB"), ("transparent", "RGBA")):
        frame = renderer.render(CAMERA, background=background)
        with Image.open(io.BytesIO(frame._repr_png_())) as shown:
            assert shown.mode == mode and shown.size == (24, 24)


def test_what_is_known_of_a_frame_passes_between_processes(renderer):
    frame = renderer.render(CAMERA, background="transparent")
    again = pickle.loads(pickle.dumps(frame))
    assert again.transparent
    np.testing.assert_array_equal(again.z_depth, frame.z_depth)
    np.testing.assert_array_equal(again.rgba, frame.rgba)
