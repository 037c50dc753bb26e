"""Objects of another kind than a call takes end in one line that names both, before any work."""

import copy
import functools
import inspect
import pickle

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused

import warpcage as wc

CAGE = wc.Cage.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
POINTS = np.zeros((2, 3))
CAMERA = wc.Camera.look_at([0, -4, 0], [0, 0, 0], width=4, height=4)
PICTURES = np.zeros((1, 4, 4, 3))
SCENE = wc.Scene(PICTURES, None, [CAMERA])
SPLAT = (np.zeros((2, 3)), np.full((2, 3), -2.0), np.ones((2, 4)), np.zeros(2), np.zeros((2, 1, 3)))
SPLATS = wc.SplatField(*SPLAT, device="cpu")
DENSE = (np.full((6, 6, 6), 5.0), np.zeros((6, 6, 6, 9, 3)))
YES_OR_NO = "antialias must be true or false, got "


def deformer(field):
    return wc.Deformer(field, CAGE, resolution=16)


def look(**options):
    return wc.Camera.look_at([0, -4, 0], [0, 0, 0], **options)


WRONG = {
    "path as a cage": (lambda field: wc.mean_value_coordinates(POINTS, "cage.obj"), "a Cage, got str"),
    "vertices as a cage": (lambda field: wc.deform_points(POINTS, CAGE.vertices, CAGE), "a Cage, got ndarray"),
    "a list as a pose": (lambda field: wc.deform_points(POINTS, CAGE, [CAGE]), "deformed cage .* vertices, got list"),
    "a list as a pose of a map": (
        lambda field: wc.PositionMap(CAGE).pose([CAGE]),
        "a pose must be .* vertices, got list",
    ),
    "few vertices as a pose": (
        lambda field: wc.deform_points(POINTS, CAGE, CAGE.vertices[1:]),
        "needs 8 vertices, got 7",
    ),
    "text as points": (lambda field: wc.green_coordinates("abc", CAGE), "real numbers, got str"),
    "complex points": (lambda field: CAGE.contains(POINTS * 1j), "real numbers, got ndarray"),
    "ragged points": (lambda field: CAGE.contains([[0, 0, 0], [0, 0]]), "real numbers, got list"),
    "number as a pose": (lambda field: deformer(field).pose(5), "edit 0 .* int"),
    "cage as a field": (lambda field: wc.Deformer(CAGE, field), "SampledField or SurfaceMesh, got Cage"),
    "text as a flag of an edit": (
        lambda field: wc.CageEdit(CAGE, remove="no"),
        "remove must be true or false, got 'no'",
    ),
    "name as a camera": (lambda field: field.render("test:3"), "a Camera, got str"),
    "no camera": (lambda field: deformer(field).render(None), "a Camera, got NoneType"),
    "path as a pose to match": (lambda field: CAGE.match("posed.obj"), "the pose must be a Cage, got str"),
    "vertices as a pose to check": (lambda field: CAGE.check(pose=CAGE.vertices), "a Cage, got ndarray"),
    "path as a rest cage": (lambda field: wc.PoseFile("cage.obj"), "the rest cage must be a Cage, got str"),
    "text as an angle": (lambda field: CAGE.bend("30"), MESSAGES["cage.degrees"]),
    "numbers as a factor": (lambda field: CAGE.taper([1, 2]), "factor must be positive and finite, got"),
    "text as an offset": (lambda field: CAGE.translate("right"), MESSAGES["cage.offset"]),
    "share of a segment": (lambda field: wc.Cage.box([0] * 3, [1] * 3, segments=1.5), "whole number of at least 1"),
    "path as a scene": (lambda field: wc.fit("data/lego"), "a Scene, got str"),
    "evaluate the wrong way round": (lambda field: wc.evaluate(SCENE, field), "a Scene, got VoxelField"),
    "points as a mesh": (lambda field: wc.Cage.from_mesh(POINTS), "vertices and faces, .* got ndarray"),
    "text as antialias of voxels": (lambda field: deformer(field).render(CAMERA, antialias="x"), YES_OR_NO),
    "text as antialias of splats": (lambda field: SPLATS.render(CAMERA, antialias="x"), YES_OR_NO),
    "text as antialias of posed splats": (lambda field: deformer(SPLATS).render(CAMERA, antialias="x"), YES_OR_NO),
    "text as antialias of a pose": (lambda field: deformer(SPLATS).posed(CAGE).render(CAMERA, antialias=2), YES_OR_NO),
    "text as antialias of a fit": (lambda field: wc.fit_splats(SPLATS, [CAMERA], PICTURES, antialias="x"), YES_OR_NO),
    "a table as an angle": (lambda field: CAGE.bend(np.zeros((2, 2))), MESSAGES["cage.degrees_of_array"]),
    "a huge number as an angle": (lambda field: CAGE.bend(10**5000), MESSAGES["cage.degrees_of_number"]),
    "a huge number among bounds": (lambda field: field.from_dense(*DENSE, [[-(10**400)] * 3, [1] * 3]), "real numbers"),
    "words as limits": (lambda field: CAGE.bend(10, limits="ab"), "limits must be real numbers, got 'ab'"),
    "a width of none": (lambda field: CAMERA.resized(None, 4), MESSAGES["view.picture_width"]),
    "a width of text": (lambda field: look(width="4"), MESSAGES["view.look_at_width"]),
    "half a pixel": (lambda field: look(height=4.5), MESSAGES["view.look_at_height"]),
    "a view of 180 degrees": (lambda field: look(fov_degrees=180), "must be between 0 and 180, got 180"),
    "text as a view": (lambda field: look(fov_degrees="40"), MESSAGES["view.look_at_degrees"]),
    "text as an eye": (lambda field: wc.Camera.look_at("eye", [0, 0, 0]), "eye of look_at must be 3 finite"),
    "text as points of a picture": (lambda field: CAMERA.project("abc"), "points must be real numbers, got 'abc'"),
    "text as a motion": (lambda field: CAMERA.moved("turned"), "must be real numbers, got 'turned'"),
    "no count of a turntable": (lambda field: wc.turntable([0] * 3, 1, 0, None), "cameras of a turntable must be"),
    "a number as a background": (lambda field: field.render(CAMERA, background={"a": 1}), "must be real numbers, got"),
    "text as harmonics": (lambda field: wc.SplatField(*SPLAT[:4], "x"), "harmonics must be real numbers, got 'x'"),
    "a number as a path to read": (lambda field: wc.Cage.load(7), "must be a path, got int"),
    "a number as a path to write": (lambda field: CAGE.save(7), "must be a path, got int"),
    "no path of a field": (lambda field: wc.VoxelField.load(None), MESSAGES["field.path"]),
    "no path of splats": (lambda field: wc.SplatField.load(None), "must be a path, got NoneType"),
    "no path of a scene": (lambda field: wc.load_scene(None), "the scene must be a path, got NoneType"),
    "text as a field to cage": (lambda field: wc.Cage.from_field("lego.npz"), "a field is needed, .* got str"),
    "text as a field to select": (lambda field: wc.select_nodes("lego.npz"), "a field is needed, .* got str"),
    "text as a threshold": (lambda field: field.extract_mesh(threshold="1"), "a density, must be positive and finite"),
    "text as a margin": (lambda field: wc.Cage.from_field(field, 40, margin="1"), "margin must be a finite number"),
    "text as a share": (lambda field: wc.select_nodes(field, floaters="1"), "floaters must be one finite number"),
    "a number as a camera to select by": (lambda field: wc.select_nodes(field, cameras=3), "a list of cameras"),
    "a path as edits": (lambda field: wc.Deformer(field, "cage.obj"), "got str"),
    "a field as a renderer": (lambda field: wc.evaluate("lego.npz", SCENE), "a field or a Deformer, got str"),
    "text as a time": (lambda field: wc.PoseFile(CAGE, {"a": CAGE}).at("0"), "time must be one finite number"),
    "a list as weights": (lambda field: wc.PoseFile(CAGE).blend([1.0]), "weights must be numbers by names"),
    "numbers as the keys of a path": (lambda field: wc.camera_at([1, 2], 0.5), "a CameraKey, got int"),
    "a number as a name of a camera": (lambda field: wc.CameraFile([CAMERA]).named(1.5), "a str, got float"),
    "a number as modes": (lambda field: CAGE.random_pose(modes=3), MESSAGES["cage.random_modes"]),
    "a mode alone": (lambda field: CAGE.random_pose(modes="bend"), MESSAGES["cage.random_modes"]),
    "a list as a frame's picture": (lambda field: wc.Frame(1, 1, [0] * 3, None, None), "must be an array, got list"),
    "a camera alone": (lambda field: wc.Scene(SCENE.images, None, CAMERA), "cameras of a scene must be a list"),
}


@pytest.fixture(scope="module")
def field():
    return wc.VoxelField.from_dense(np.full((6, 6, 6), 5.0), np.zeros((6, 6, 6, 9, 3)), [[-1] * 3, [1] * 3])


@pytest.mark.parametrize("call, message", WRONG.values(), ids=list(WRONG))
def test_another_kind_of_object_is_named(call, message, field):
    refused(lambda: call(field), match=message)


#: What is held on a device, by the public class that it is of or is reached from.
HELD = {
    "Deformer": deformer,
    "Deformer.posed": lambda field: deformer(field).posed(CAGE),
    "Deformer.posed_edits": lambda field: deformer(field).posed_edits(),
    "FieldOptimizer": lambda field: wc.FieldOptimizer(white_balls(), device="cpu", resolution=16),
    "NodeSelection": lambda field: wc.select_nodes(field, cage=CAGE),
    "PositionMap": lambda field: wc.PositionMap(CAGE, resolution=16),
    "PositionMap.pose": lambda field: wc.PositionMap(CAGE, resolution=16).pose(CAGE),
    "PositionMap.lattice": lambda field: wc.PositionMap(CAGE, resolution=16).pose(CAGE).lattice,
    "PositionMap.launches": lambda field: wc.PositionMap(CAGE, resolution=16).pose(CAGE).launches,
    "PositionMap.weights": lambda field: wc.PositionMap(CAGE, resolution=16, store="weights").pose(CAGE).weights,
    "SplatDeformer": lambda field: wc.Deformer(SPLATS, CAGE, coordinates="green"),
    "SplatDeformer.posed_edits": lambda field: wc.Deformer(SPLATS, CAGE, coordinates="green").posed_edits(),
    "SplatField": lambda field: SPLATS,
    "SplatFit": lambda field: wc.SplatFit(white_balls(), device="cpu", steps=2),
    "Stage": lambda field: wc.Stage().add("a", field),
    "SurfaceMesh": lambda field: wc.SurfaceMesh(CAGE.vertices, CAGE.faces, device="cpu"),
    "VoxelField": lambda field: field,
}

#: Public classes that processes hand each other; a SampledField refuses, as it asks a function.
PICKLED = {
    *("Cage", "CageEdit", "CageReport", "Camera", "CameraFile", "CameraKey", "Cancelled", "CaptureReport", "Error"),
    *("FitOptions", "Frame", "Frames", "Place", "PlaceFile", "PoseFile", "PoseFit", "PoseTargets"),
    *("RandomPoses", "RunReport", "SampledField", "Scene", "SplatFitOptions", "SplatRates"),
}


def white_balls():
    """A scene that fits can begin with."""
    cameras = wc.turntable((0, 0, 0), 3, 20, 4, width=12, height=12)
    return wc.Scene(np.full((4, 12, 12, 3), 0.5), None, cameras, bounds=CAGE.bounds)


@pytest.mark.parametrize("name", HELD)
def test_what_a_device_holds_is_not_pickled(name, field):
    """Nor copied: each object has memory of its own."""
    held = HELD[name](field)
    for copied in (pickle.dumps, copy.deepcopy):
        refused(functools.partial(copied, held), match=MESSAGES["core.not_copied"], error=wc.errors.UseError)


def test_each_public_class_is_pickled_or_held():
    classes = {name for name in wc.__all__ if inspect.isclass(getattr(wc, name))}
    held = {name.partition(".")[0] for name in HELD}
    assert classes == held | PICKLED and not held & PICKLED


def test_cuda_where_there_is_none_is_one_line(capfd, monkeypatch):
    monkeypatch.setattr("warp.is_cuda_available", lambda: False)
    for device in ("cuda", "cuda:0"):
        with pytest.raises(ValueError, match=MESSAGES["core.no_device"].format(device=device)):
            wc.mean_value_coordinates(POINTS, CAGE, device=device)
    assert capfd.readouterr().err == ""
