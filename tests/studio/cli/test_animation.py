"""Keyframes, camera paths and the texts that name poses."""

import numpy as np
import pytest

from warpcage import Cage, Camera, turntable
from warpcage.cage import Preset, is_preset
from warpcage.edits.spec import EditSpec
from warpcage.studio.films import AssetResolver, EditReader, RestCage
from warpcage.studio.films.motion import cameras_along, frame_places, pose_along, pose_weights
from warpcage.view import value_along

BOX = Cage.box([-1, -1, -1], [1, 1, 1], segments=2)


def test_places_go_there_and_back():
    np.testing.assert_allclose(frame_places(8, 3, "swing", "linear"), [0, 0.5, 1, 1.5, 2, 1.5, 1, 0.5])
    np.testing.assert_allclose(frame_places(5, 3, "once", "linear"), [0, 0.5, 1, 1.5, 2])
    smooth = frame_places(41, 2, "once")
    assert smooth[0] == 0 and smooth[-1] == pytest.approx(1) and (np.diff(smooth) > 0).all()
    assert np.diff(smooth)[0] < 0.2 * np.diff(smooth).max() > 0 and np.diff(smooth)[-1] < 0.2 * np.diff(smooth).max()
    np.testing.assert_array_equal(frame_places(3, 4, "hold"), 3)
    np.testing.assert_allclose(pose_weights(4), [0, 0.5, 1, 0.5])
    assert pose_weights(1, "once").shape == (1,)


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
def test_keyframes_are_met_and_straight_ways_stay_straight(interpolation):
    line = [np.array([float(k), -2.0 * k]) for k in range(5)]
    for place in np.linspace(0, 4, 33):
        value = value_along(line, place, interpolation)
        np.testing.assert_allclose(value, [place, -2.0 * place], atol=1e-12)  # evenly spaced: even speed
    values = list(np.random.default_rng(1).normal(size=(5, 4, 3)))
    for index in range(5):
        np.testing.assert_array_equal(value_along(values, index, interpolation), values[index])


def test_a_cage_between_two_keyframes():
    high = BOX.translate([0, 0, 4])
    np.testing.assert_allclose(pose_along([BOX, high], 0.25).vertices, BOX.vertices + [0, 0, 1])
    np.testing.assert_allclose(pose_along([BOX, high, BOX], 2.0).vertices, BOX.vertices)


def test_camera_paths_go_through_their_cameras():
    cameras = turntable((0, 0, 0), 3.0, 20.0, 4, width=8, height=6)[:3]
    path = cameras_along(cameras, 5)
    for index, camera in enumerate(cameras):
        np.testing.assert_allclose(path[2 * index].camera_to_world, camera.camera_to_world, atol=1e-9)
    for camera in path:  # rotations stay rotations, and halfway the camera looks half-way
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-9)
    half = turntable((0, 0, 0), 3.0, 0.0, 8, width=8, height=6)
    level = cameras_along([half[0], half[2]], 3)[1]
    np.testing.assert_allclose(level.rotation, half[1].rotation, atol=1e-9)
    flipped = Camera.look_at([3, 0, 0], (0, 0, 0), width=8, height=6)
    back = Camera.look_at([-3, 0, 0], (0, 0, 0), width=8, height=6)
    middle = cameras_along([flipped, back], 3, "linear")[1]  # half a turn has no shortest way, but is a turn
    np.testing.assert_allclose(middle.rotation @ middle.rotation.T, np.eye(3), atol=1e-9)
    assert len(cameras_along(cameras[:1], 3)) == 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frame_places(0, 2), "at least one frame"),
        (lambda: frame_places(2, 2, "jump"), "motion must be .* got 'jump'"),
        (lambda: frame_places(2, 2, "once", "cubic"), "interpolation must be .* got 'cubic'"),
        (lambda: value_along([np.zeros(1)] * 2, 1.5), "must be 0 to 1"),
        (lambda: cameras_along([], 2), "at least one camera"),
        (
            lambda: cameras_along(
                [*turntable((0, 0, 0), 3, 0, 1, width=4, height=4), *turntable((0, 0, 0), 3, 0, 1)], 2
            ),
            "one picture",
        ),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# -- Poses as texts


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bend:40:y:z", lambda cage: cage.bend(40, axis="y", towards="z")),
        ("bend:40:x", lambda cage: cage.bend(40, axis="x", towards="z")),
        ("bend:-20", lambda cage: cage.bend(-20)),
        ("twist:60:x", lambda cage: cage.twist(60, axis="x")),
        ("taper:0.5", lambda cage: cage.taper(0.5)),
        ("stretch:1.5:y", lambda cage: cage.stretch(1.5, axis="y")),
        ("scale:0.8", lambda cage: cage.scale(0.8)),
        ("rotate:30:x", lambda cage: cage.rotate(30, axis="x")),
        ("translate:1:2:-3", lambda cage: cage.translate([1, 2, -3])),
        ("rest", lambda cage: cage),
    ],
)
def test_presets(text, expected):
    assert is_preset(text)
    np.testing.assert_allclose(AssetResolver().pose(RestCage(BOX), text).vertices, expected(BOX).vertices)


@pytest.mark.parametrize(
    "text",
    ["bend", "bend:x", "bend:nan", "bend:3:w", "bend:3:-x", "twist:3:x:y", "rest:1", "translate:1:2", "scale:1:x"],
)
def test_presets_that_are_none(text):
    with pytest.raises(ValueError, match="not a preset: rest, bend:"):
        Preset(text)


def test_one_preset_changes_by_its_amount_and_files_by_their_vertices(tmp_path):
    spec = EditSpec({"vertices": BOX.vertices.tolist(), "faces": BOX.faces.tolist()}, "rest")
    bends = EditReader(interpolation="linear").edit(spec, ["bend:90:x:z", "bend:30:x:z", "rest"], None)
    np.testing.assert_allclose(bends.at(0.5).vertices, BOX.bend(45, axis="x", towards="z").vertices)
    np.testing.assert_allclose(bends.at(1.5).vertices, BOX.bend(60, axis="x", towards="z").vertices)
    np.testing.assert_allclose(bends.at(3).vertices, BOX.vertices)
    scales = EditReader(interpolation="smooth").edit(spec, ["scale:0.5"], None)
    np.testing.assert_allclose(scales.at(0.5).vertices, BOX.scale(0.75).vertices)
    BOX.twist(50).save(tmp_path / "twisted.obj")
    mixed = EditReader(interpolation="linear").edit(spec, [str(tmp_path / "twisted.obj"), "scale:2"], None)
    np.testing.assert_allclose(mixed.at(0.5).vertices, 0.5 * (BOX.vertices + BOX.twist(50).vertices), atol=1e-6)
    assert len(mixed.cages) == 3
