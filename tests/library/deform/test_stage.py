"""Several objects in one scene, against one field that holds them all, moved cameras, and the equations of places."""

import json

import numpy as np
import pytest
from fields import BOX, ball, ellipsoid, make_field, plain, psnr, shiny_field, surrounded_ball, view
from messages import MESSAGES
from refusals import refused
from splat_scenes import splats_in_box

import warpcage
from warpcage import Cage, CageEdit, Camera, Deformer, Place, PlaceFile, SplatField, Stage, VoxelField
from warpcage.field import harmonics_on_host
from warpcage.view import eased_share

RED, BLUE = plain([0.9, 0.2, 0.1]), plain([0.1, 0.3, 0.9])
NEAR, FAR = np.array([-0.4, 0.0, 0.0]), np.array([0.4, 0.1, 0.0])
PLACE = Place((0.3, -0.2, 0.1), (20.0, -35.0, 70.0), 1.7)
CUBE = Cage.box((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4))


def colored_ball(device, color, center=(0, 0, 0), resolution=60):
    return make_field(lambda x: ball(x, center, 0.25), color, device=device, resolution=resolution)


def both_balls(device, resolution=60):
    """Both balls in one field."""

    def sh(x):
        return np.where((x[..., 0] < 0)[..., None, None], RED(x), BLUE(x))

    return make_field(lambda x: ball(x, NEAR, 0.25) + ball(x, FAR, 0.25), sh, device=device, resolution=resolution)


def two_objects(device):
    """The same two balls as two objects, each around the origin of its own coordinates; voxels fall together."""
    red, blue = colored_ball(device, RED), colored_ball(device, BLUE)
    return Stage().add("red", red, place=Place(NEAR)).add("blue", blue, place=Place(FAR))


def seen_from(place, camera):
    """The camera in the coordinates of an object that stands in a place, by the inverse of its matrix."""
    inverse = np.linalg.inv(place.matrix)
    pose = inverse @ camera.camera_to_world
    pose[:3, :3] *= place.scale
    return Camera(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, pose)


@pytest.mark.parametrize("supersampling", [1, 2])
@pytest.mark.parametrize("eye", [(2.5, 1.2, 1.0), (2.5, 0.0, 0.1), (-2.5, 0.0, 0.1)], ids=["beside", "blue", "red"])
def test_two_objects_are_seen_as_one_field_that_holds_both(eye, supersampling, device):
    camera, stage = view(eye, size=48), two_objects(device)
    frame = stage.render(camera, background=(0.1, 0.6, 0.2), supersampling=supersampling)
    whole = both_balls(device).render(camera, background=(0.1, 0.6, 0.2), supersampling=supersampling)
    assert psnr(frame.rgb, whole.rgb) > 55 and psnr(frame.alpha, whole.alpha) > 55
    seen = (frame.alpha > 0.5) & (whole.alpha > 0.5)
    assert seen.sum() > 60 and np.abs(frame.depth[seen] - whole.depth[seen]).max() < 0.02
    assert np.isinf(frame.depth[frame.alpha == 0]).all() and frame.camera is camera


def test_what_is_nearer_hides_what_is_behind(device):
    stage = two_objects(device).place("blue", Place(-NEAR))
    front, back = (stage.render(view((x, 0, 0), size=33)).rgb[16, 16] for x in (-2.5, 2.5))
    np.testing.assert_allclose(front, [0.9, 0.2, 0.1], atol=0.01)
    np.testing.assert_allclose(back, [0.1, 0.3, 0.9], atol=0.01)
    stage.hide("red")
    np.testing.assert_allclose(stage.render(view((-2.5, 0, 0), size=33)).rgb[16, 16], [0.1, 0.3, 0.9], atol=0.01)
    stage.hide("red", False).remove("blue")
    assert stage.render(view((2.5, 0, 0), size=33)).rgb[16, 16].argmax() == 0 and list(stage.items) == ["red"]


@pytest.mark.parametrize("kind", ["voxels", "splats", "deformed"])
def test_a_moved_object_is_what_the_counter_moved_camera_sees(kind, device):
    scene_object = splats_in_box(device) if kind == "splats" else shiny_field(device)
    if kind == "deformed":
        scene_object = Deformer(scene_object, BOX, coordinates="mean_value", resolution=16).pose(
            BOX.twist(50, axis="x")
        )
    camera = view((4, 1.5, 2), size=40)
    frame = Stage().add("it", scene_object, place=PLACE.matrix).render(camera, background="transparent")
    own = scene_object.render(seen_from(PLACE, camera), background="transparent")
    np.testing.assert_allclose(frame.rgb, own.rgb, atol=2e-4)
    assert frame.transparent and frame.alpha.max() > 0.3
    seen = own.alpha > 0.05
    np.testing.assert_allclose(frame.depth[seen], PLACE.scale * own.depth[seen], rtol=1e-4)


@pytest.mark.parametrize("around", ["layers", "outer"])
@pytest.mark.parametrize("place", [Place(), Place((0.1, 0.2, 0.0), scale=2.0)], ids=["in place", "moved"])
def test_objects_stand_before_the_surroundings_of_one(place, around, device):
    room = surrounded_ball(device, around, fog=False)
    camera = view((0.2, -3.0, 0.4), size=40)
    alone = Stage().add("room", room, place=place).render(camera)
    np.testing.assert_allclose(alone.rgb, room.render(seen_from(place, camera)).rgb, atol=2e-4)
    blue = colored_ball(device, BLUE)
    stage = Stage().add("blue", blue, place=Place((0.9, -0.6, 0.0))).add("room", room, place=place)
    frame, clear = stage.render(camera), stage.render(camera, background="transparent")
    assert frame.layered and frame.background is None
    np.testing.assert_allclose(frame.rgb[clear.alpha == 0], alone.rgb[clear.alpha == 0], atol=1e-4)
    column, row = camera.project(np.array([[0.9, -0.6, 0.0]]))[0][0].astype(int)
    np.testing.assert_allclose(frame.rgb[row, column], [0.1, 0.3, 0.9], atol=0.01)


def test_masks_are_dimmed_by_what_is_before_them(device):
    cleared = Deformer(colored_ball(device, RED), CageEdit(CUBE, remove=True), resolution=16)
    camera = view((-2.5, 0, 0), size=33)
    stage = Stage().add("gone", cleared, place=Place((0.5, 0, 0))).add("ball", colored_ball(device, BLUE))
    hidden, shown = stage.render(camera).reveal[16, 16], stage.hide("ball").render(camera).reveal[16, 16]
    assert shown > 0.99 and hidden < 0.01
    assert Stage().add("ball", colored_ball(device, BLUE)).render(camera).reveal is None


@pytest.mark.parametrize("kind", ["plain", "deformed", "paper"])
def test_merged_voxels_look_like_the_stage(kind, device):
    field = make_field(ellipsoid, plain([0.8, 0.5, 0.2]), device=device, resolution=72)
    scene_object = field
    if kind != "plain":
        density = "paper" if kind == "paper" else "opacity"
        scene_object = Deformer(field, BOX, coordinates="mean_value", resolution=24, density=density)
        scene_object.pose(BOX.bend(30, axis="x", towards="z"))
    stage = Stage().add("it", scene_object, place=Place((0.0, 0.3, 0.1), (10, 20, 30), 0.8))
    stage.add("blue", colored_ball(device, BLUE), place=Place((0.5, -0.3, 0)))
    merged = stage.merged()
    assert isinstance(merged, VoxelField)
    for eye in ((2.5, 1.2, 1.0), (-2.0, 1.5, -1.0)):
        camera = view(eye, size=48)
        assert psnr(stage.render(camera, background="black").rgb, merged.render(camera, background="black").rgb) > 38
    coarse = stage.merged(resolution=40)
    assert max(coarse.resolution) <= 41 and coarse.voxel_count < merged.voxel_count


def test_merged_voxels_in_one_place_add_up(device):
    """Where objects pass through each other, which pictures of them one over the other do not show."""
    haze = make_field(lambda x: ellipsoid(x, radii=(0.5, 0.5, 0.5), sigma=1.5), RED, device=device)
    other = make_field(lambda x: ellipsoid(x, radii=(0.5, 0.5, 0.5), sigma=4.5), BLUE, device=device)
    merged = Stage().add("one", haze).add("other", other).merged()
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    colors, density = merged.sample(points, np.tile([0.0, 0, 1], (50, 1)))
    np.testing.assert_allclose(density, 6.0, rtol=1e-3)
    np.testing.assert_allclose(colors, np.tile([0.3, 0.275, 0.7], (50, 1)), atol=2e-3)


def test_merged_voxels_of_both_kinds_of_harmonics(device):
    field = shiny_field(device)
    sh = harmonics_on_host(field.grid.sh)[:, :4]  # degree 1, in red, green and blue
    orange = 0.5 * (sh[..., 0] - sh[..., 2])
    luminance = 0.25 * (sh[..., 0] + sh[..., 2]) + 0.5 * sh[..., 1]
    packed = np.concatenate([np.pad(luminance, ((0, 0), (0, 12))), orange, sh[..., 1] - luminance], axis=1)
    links, density = field.grid.links, field.grid.density
    luminous = VoxelField(field.bounds, links, density, packed.astype(np.float32), device=device)
    stage = Stage().add("it", luminous).add("ball", colored_ball(device, BLUE), place=Place((0, 0, 0.7)))
    camera = view(size=40)
    assert psnr(stage.render(camera).rgb, stage.merged().render(camera).rgb) > 38


def test_merged_keeps_surroundings_where_they_are(device):
    room, blue = surrounded_ball(device, "layers", fog=False), colored_ball(device, BLUE)
    stage = Stage().add("blue", blue, place=Place((0.9, 0.2, 0.0))).add("room", room)
    merged, camera = stage.merged(), view((0.2, -3.0, 0.4), size=40)
    assert psnr(merged.render(camera).rgb, stage.render(camera).rgb) > 38
    refused(lambda: stage.place("room", Place((1, 0, 0))).merged(), match=MESSAGES["stage.surroundings"])


def test_merged_splats_are_the_same_picture(device):
    one, other = (
        splats_in_box(device, scales=(-4.0, -2.5)),
        splats_in_box(device, degree=1, scales=(-4.0, -2.5), seed=1),
    )
    bent = Deformer(other, BOX, coordinates="mean_value").pose(BOX.bend(20, axis="x", towards="z"))
    for scene_object in (other, bent):
        stage = Stage().add("one", one, place=PLACE).add("other", scene_object, place=Place((0, 4.0, 0)))
        merged = stage.merged()
        assert isinstance(merged, SplatField) and merged.degree == 3
        for camera in (view((9, 3, 3), size=64), view((-3, -8, 4), size=64)):
            frame = stage.render(camera, background="transparent")
            assert frame.alpha.max() > 0.3
            assert psnr(frame.rgb, merged.render(camera, background="transparent").rgb) > 45
    assert len(Stage().add("one", one, place=PLACE).add("other", other).merged()) == 400


def test_voxels_and_splats_are_merged_as_splats(device):
    stage = Stage().add("ball", colored_ball(device, BLUE, resolution=32), place=Place(NEAR, scale=1.5))
    stage.add("splats", splats_in_box(device, half=0.3, scales=(-4.0, -3.0)), place=Place((0.7, 0, 0)))
    refused(stage.merged, match=MESSAGES["stage.mixed"])
    merged, camera = stage.merged(convert=warpcage.to_splats), view((0, 3.5, 0.5), size=64)
    frame = stage.render(camera, background="black")
    assert psnr(frame.rgb, merged.render(camera, background="black", antialias=True).rgb) > 25
    refused(lambda: stage.merged(convert=warpcage.to_splats, resolution=32), match="resolution")


def test_a_stage_is_one_file_that_can_be_opened_again(tmp_path, device):
    shiny_field(device).save(tmp_path / "it.npz")
    field, splats = VoxelField.load(tmp_path / "it.npz", device=device), splats_in_box(device)
    (tmp_path / "more").mkdir()
    splats.save(tmp_path / "more" / "splats.ply")
    edits = [CageEdit(BOX, falloff=0.2, held=(0, 1)), CageEdit(CUBE.scale(0.2), remove=True)]
    deformer = Deformer(field, edits, coordinates="mean_value", resolution=16).pose([BOX.twist(30, axis="x"), None])
    bent = Deformer(splats, BOX, coordinates="mean_value", map="backward", resolution=16).pose(BOX.twist(30, axis="x"))
    around = PlaceFile({0: Place(), 1.5: Place((0, 0, 1), (0, 0, 180))}, {0: "linear"}, "loop")
    stage = Stage().add("it", deformer, place=PLACE, path=tmp_path / "it.npz")
    stage.add("splats", bent, place=around, path=tmp_path / "more" / "splats.ply")
    stage.add("again", tmp_path / "it.npz", place=Place((0, 3, 0))).hide("again")
    stage.save(tmp_path / "scene.stage.json")
    moved = tmp_path.rename(tmp_path.with_name(f"{tmp_path.name}_moved"))  # it names files from its own folder
    loaded, camera = Stage.load(moved / "scene.stage.json", device=device), view((5, 1.5, 2), size=40)
    stage.time = loaded.time = 0.5
    assert np.array_equal(loaded.render(camera).rgb, stage.render(camera).rgb) and loaded.items["again"].hidden
    assert loaded.length == 1.5 and list(loaded.items) == ["it", "splats", "again"]
    loaded.save(moved / "more" / "again.stage.json")
    content = json.loads((moved / "more" / "again.stage.json").read_text())
    assert [scene_object["field"] for scene_object in content["objects"]] == ["../it.npz", "splats.ply", "../it.npz"]
    with pytest.raises(ValueError, match=MESSAGES["stage.no_file"]):
        stage.replace("it", colored_ball(device, RED)).save(moved / "other.stage.json")


def test_places_are_similarities():
    x, y, z = (np.radians(angle) for angle in PLACE.turn)
    about_x = [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]
    about_y = [[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]
    about_z = [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]
    np.testing.assert_allclose(PLACE.matrix[:3, :3], 1.7 * np.array(about_z) @ about_y @ about_x, atol=1e-12)
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(PLACE.moved(points), points @ PLACE.matrix[:3, :3].T + PLACE.position, atol=1e-12)
    for place in (PLACE, Place(turn=(30, 90, 10)), Place(turn=(0, -90, 50), scale=0.1)):
        np.testing.assert_allclose(Place.from_matrix(place.matrix).matrix, place.matrix, atol=1e-7)


def test_places_at_times(tmp_path):
    keys = [
        {"time": 0, "position": [0, 0, 0], "easing": "linear"},
        {"time": 2, "position": [4, 0, 0], "turn": [0, 0, 360], "scale": 3, "easing": "hold"},
        {"time": 3, "matrix": PLACE.matrix.tolist()},
    ]
    (tmp_path / "place.json").write_text(json.dumps({"keys": keys, "loop": "once"}))
    places = PlaceFile.load(tmp_path / "place.json")
    assert places.length == 3 and places.at(0.5) == Place((1, 0, 0), (0, 0, 90), 1.5)
    assert places.at(2.9) == Place((4, 0, 0), (0, 0, 360), 3) and places.at(-1) == Place()
    np.testing.assert_allclose(places.at(7).matrix, PLACE.matrix, atol=1e-7)
    places.save(tmp_path / "again.json")
    again = PlaceFile.load(tmp_path / "again.json")
    assert (again.places, again.easings, again.loop) == (places.places, {**places.easings, 3: "smooth"}, "once")
    curve = {"bezier": [0.9, 0, 0.9, 0.2]}
    keys[0]["easing"] = curve
    (tmp_path / "curved.json").write_text(json.dumps({"keys": keys}))
    curved = PlaceFile.load(tmp_path / "curved.json")
    assert curved.easings[0] == curve and curved.to_json()["keys"][0]["easing"] == curve
    gone = eased_share(curve, 0.25)
    assert 0.0 < gone < 0.1 and curved.at(0.5).position[0] == pytest.approx(4 * gone)
    PlaceFile(PLACE).save(tmp_path / "one.json")
    assert PlaceFile.load(tmp_path / "one.json").at(1) == PLACE


WRONG = {
    "numbers": ({"position": [1, 2]}, "the position of a place"),
    "words": ({"pos": [1, 2, 3]}, "a place has no 'pos'"),
    "scale": ({"scale": 0}, "the scale of a place must be positive"),
    "mirrored": ({"matrix": np.diag([1, 1, -1, 1]).tolist()}, "must turn and scale alike"),
    "both": ({"matrix": np.eye(4).tolist(), "scale": 2}, "a place has a matrix, or"),
    "no keys": ({"keys": []}, "'keys' must be a list"),
    "no time": ({"keys": [{"scale": 2}]}, "key 1 must be an object with a 'time'"),
    "one time": ({"keys": [{"time": 1}, {"time": 1}]}, "two keys are at 1 s"),
    "before": ({"keys": [{"time": -1}]}, "a film begins at 0"),
    "curve": ({"keys": [{"time": 0, "easing": {"bezier": [2, 0, 0, 1]}}]}, "x1 of the easing of a place"),
    "easing": ({"keys": [{"time": 0, "easing": "bouncy"}]}, "the easing of a place"),
    "newer": ({"version": 9}, "its version is 9"),
    "format": ({"format": "warpcage poses"}, "its format is 'warpcage poses'"),
}


@pytest.mark.parametrize("content, message", WRONG.values(), ids=WRONG)
def test_bad_place_files_are_told_in_one_line(content, message, tmp_path):
    (tmp_path / "place.json").write_text(json.dumps(content))
    refused(lambda: PlaceFile.load(tmp_path / "place.json"), "place.json: ", match=message)


def test_bad_stage_files_are_told_in_one_line(tmp_path):
    shiny_field("cpu").save(tmp_path / "it.npz")
    good = {"name": "it", "field": "it.npz"}
    wrong = {
        "its format is": {"format": "warpcage edits"},
        "object 1 needs a field": {"objects": [{"name": "it"}]},
        "'objects' must be": {"objects": []},
        "its version is 3": {"version": 3, "objects": [good]},
        "give one of them": {"objects": [good], "things": [good]},
        "object 1 has no 'file'": {"objects": [good | {"file": "it.npz"}]},
        "the scale of a place": {"objects": [good | {"place": {"scale": -1}}]},
        "object 'it': .* lacks 'edits'": {"objects": [good | {"deformation": {}}]},
        "it has no 'cells'": {"objects": [good | {"deformation": {"edits": [], "cells": 3}}]},
    }
    for message, content in wrong.items():
        (tmp_path / "scene.stage.json").write_text(json.dumps({"format": "warpcage stage", "version": 1} | content))
        said = refused(lambda: Stage.load(tmp_path / "scene.stage.json", device="cpu"), match=message)
        assert said.startswith(f"{tmp_path / 'scene.stage.json'}: ")


def test_what_a_stage_refuses(tmp_path, device):
    field, stage = shiny_field(device), Stage()
    refused(lambda: stage.render(view()), match="the stage shows nothing")
    stage.add("it", field)
    for attempt, message in (
        (lambda: stage.add("it", field), "has an object 'it' already"),
        (lambda: stage.add("", field), "needs a name"),
        (lambda: stage.add("cage", BOX), "an object of a stage"),
        (lambda: stage.add("far", field, place=Place((np.nan, 0, 0))), "the position of a place"),
        (lambda: stage.remove("other"), "the stage has no 'other', only it"),
        (lambda: stage.save(tmp_path / "scene.json"), "ends in .stage.json"),
        (lambda: stage.merged(resolution=1), "resolution must be"),
        (lambda: stage.render(field), "render needs a Camera"),
    ):
        refused(attempt, match=message)
    refused(lambda: stage.add("file", tmp_path / "nothing.npz"), error=FileNotFoundError)
    assert list(stage.items) == ["it"]
