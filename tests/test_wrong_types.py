"""Things of another kind than a call takes end in one line that names both, before any work."""

import pickle

import numpy as np
import pytest

import warpcage

CAGE = warpcage.Cage.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
POINTS = np.zeros((2, 3))
CAMERA = warpcage.Camera.look_at([0, -4, 0], [0, 0, 0], width=4, height=4)
SCENE = warpcage.Scene(np.zeros((1, 4, 4, 3)), None, [CAMERA])

WRONG = {
    "path as a cage": (lambda field: warpcage.mean_value_coordinates(POINTS, "cage.obj"), "a Cage, got str"),
    "vertices as a cage": (lambda field: warpcage.deform_points(POINTS, CAGE, CAGE.vertices), "a Cage, got ndarray"),
    "text as points": (lambda field: warpcage.green_coordinates("abc", CAGE), "real numbers, got str"),
    "complex points": (lambda field: CAGE.contains(POINTS * 1j), "real numbers, got ndarray"),
    "ragged points": (lambda field: CAGE.contains([[0, 0, 0], [0, 0]]), "real numbers, got list"),
    "path as a pose": (lambda field: warpcage.Deformer(field, CAGE, resolution=16).pose("posed.obj"), "edit 0 .* str"),
    "vertices as a pose": (lambda field: warpcage.PositionMap(CAGE, resolution=16).pose(CAGE.vertices), "got ndarray"),
    "cage as a field": (lambda field: warpcage.Deformer(CAGE, field), "a VoxelField, got Cage"),
    "name as a camera": (lambda field: field.render("test:3"), "a Camera, got str"),
    "no camera": (lambda field: warpcage.Deformer(field, CAGE, resolution=16).render(None), "a Camera, got NoneType"),
    "path as a pose to match": (lambda field: CAGE.match("posed.obj"), "the pose must be a Cage, got str"),
    "vertices as a pose to check": (lambda field: CAGE.check(pose=CAGE.vertices), "a Cage, got ndarray"),
    "path as a rest cage": (lambda field: warpcage.PoseFile("cage.obj"), "the rest cage must be a Cage, got str"),
    "text as an angle": (lambda field: CAGE.bend("30"), "degrees must be one finite number, got '30'"),
    "numbers as a factor": (lambda field: CAGE.taper([1, 2]), "factor must be positive and finite, got"),
    "text as an offset": (lambda field: CAGE.translate("right"), "offset must be 3 finite numbers, got 'right'"),
    "share of a segment": (
        lambda field: warpcage.Cage.box([0] * 3, [1] * 3, segments=1.5),
        "whole number of at least 1",
    ),
    "path as a scene": (lambda field: warpcage.fit("data/lego"), "a Scene, got str"),
    "evaluate the wrong way round": (lambda field: warpcage.evaluate(SCENE, field), "a Scene, got VoxelField"),
    "points as a mesh": (lambda field: warpcage.Cage.from_mesh(POINTS), "vertices and faces, .* got ndarray"),
}


@pytest.fixture(scope="module")
def field():
    return warpcage.VoxelField.from_dense(np.full((6, 6, 6), 5.0), np.zeros((6, 6, 6, 9, 3)), [[-1] * 3, [1] * 3])


@pytest.mark.parametrize("name", list(WRONG))
def test_another_kind_of_thing_is_named(name, field):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message) as error:
        call(field)
    assert "\n" not in str(error.value)


def test_what_a_device_holds_is_not_pickled(field):
    for held in (field, warpcage.Deformer(field, CAGE, resolution=16)):
        with pytest.raises(TypeError, match="is held on a device and not copied between processes: "):
            pickle.dumps(held)


def test_cuda_where_there_is_none_is_one_line(capfd, monkeypatch):
    monkeypatch.setattr("warp.is_cuda_available", lambda: False)
    for device in ("cuda", "cuda:0"):
        with pytest.raises(ValueError, match=f"device '{device}' is not there: this machine has "):
            warpcage.mean_value_coordinates(POINTS, CAGE, device=device)
    assert capfd.readouterr().err == ""
