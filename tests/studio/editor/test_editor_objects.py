"""Several objects in the editor: added, placed, keyed, copied, kept, saved as a stage and opened again."""

import asyncio
import dataclasses
import json

import numpy as np
import pytest
from editor_pages import BOX, green_field, new_session, nothing_logged, on_pages, tiny_field, with_pages
from splat_scenes import ball_of_splats

import warpcage
from warpcage import Place, Stage, SurfaceMesh
from warpcage.core.arrays import box_corners
from warpcage.mesh import write_shown_mesh
from warpcage.studio.editor import (
    MAIN,
    Document,
    Fields,
    Film,
    PosedScene,
    SceneObject,
    Session,
    document_at,
    export_film,
    film_pictures,
    inspect,
    new_document,
    read_fields,
    read_session,
    run_command,
    stage_of,
    state_at,
    view_camera,
    with_new_object,
    write_session,
)

__all__ = ["nothing_logged"]  # a fixture

AWAY = Place((1.5, 0.0, 0.0), (0.0, 0.0, 90.0), 0.5)


@pytest.fixture
def folder(tmp_path):
    """The session's folder with the files of three fields."""
    tiny_field().save(tmp_path / "ball.npz")
    green_field().save(tmp_path / "green.npz")
    ball_of_splats(0.08).save(tmp_path / "blue.ply")
    (tmp_path / "notes.txt").write_text("no field")
    BOX.save(tmp_path / "cage.ply")
    return tmp_path


def session_in(folder, cages=(BOX,)):
    field = tiny_field()
    return Session(field, new_document(field, cages, 16, "ball"), folder / "ball.session.json", folder / "ball.npz")


@pytest.fixture
def session(folder):
    return session_in(folder)


def two_objects(place=AWAY):
    """A document of the ball and a green one, and their fields."""
    fields = Fields(tiny_field())
    fields.files["green.npz"] = green_field()
    _, document = with_new_object(new_document(fields.main, [BOX], 16, "ball"), "green", "green.npz", place)
    return document, fields


def picture(document, fields, size=(40, 30)):
    scene = PosedScene(fields)
    scene.prepare(document)
    return scene.render(view_camera(document.view, *size)).rgb


# pages ---------------------------------------------------------------------------------------------------------------


@on_pages
async def test_an_object_is_added_placed_locked_and_undone(server, page, session):
    assert await page.do(do="object.files") == {"files": ["ball.npz", "blue.ply", "green.npz", "cage.ply"]}
    await page.do(do="object.add", file="green.npz", place={"position": [1.5, 0, 0]})
    await page.until(lambda: len(page.sections["objects"]) == 2)
    ball, green = page.sections["objects"]
    assert (ball["id"], ball["name"], ball["file"]) == (MAIN, "ball", None)
    assert (green["name"], green["file"], green["place"]["position"]) == ("green", "green.npz", [1.5, 0, 0])
    assert page.sections["selection"]["object"] == green["id"] and page.sections["edits"] == []
    number = green["id"]
    await page.do(do="object.change", id=number, place={"position": [1, 2, 3], "turn": [0, 0, 90], "scale": 0.5})
    assert session.document.scene_object(number).place == Place((1, 2, 3), (0, 0, 90), 0.5)
    await page.do(do="object.change", id=number, locked=True)
    for message in ({"do": "object.change", "place": {}}, {"do": "object.remove"}):
        assert await page.refused(**message, id=number) == "'green' is locked: unlock it first"
    assert await page.refused(do="place.begin", object=number) == "'green' is locked: unlock it first"
    await page.do(do="object.change", id=number, locked=False, visible=False, name="my ball")
    assert "hide it instead" in await page.refused(do="object.remove", id=MAIN)
    await page.do(do="object.remove", id=number)
    await page.until(lambda: len(page.sections["objects"]) == 1 and len(page.sections["edits"]) == 1)
    assert page.sections["selection"] == {"edit": 1, "mode": "vertex", "vertices": [], "object": MAIN}
    for _ in range(5):
        await page.do(do="undo")
    assert not session.document.is_staged
    for _ in range(5):
        await page.do(do="redo")
    assert [scene_object.name for scene_object in session.document.objects] == ["ball"]
    for name in ("../green.npz", "no.npz", "notes.txt", 5, ""):
        await page.refused(do="object.add", file=name)
    assert len(session.document.objects) == 1


@on_pages
async def test_cameras_of_keys_are_moved_back_until_they_see_all(server, page, session):
    await page.do(do="key.add", time=0.0, pose=False, camera=True)
    assert await page.do(do="camera.outside", aspect=1.5) == {"keys": 0}
    assert "see everything already" in await page.refused(do="camera.frame", aspect=1.5)
    await page.do(do="object.add", file="green.npz", place={"position": [9, 0, 0]})
    before = session.document.timeline.keys[0].view
    assert await page.do(do="camera.outside", aspect=1.5) == {"keys": 1}
    await page.do(do="camera.frame", aspect=1.5)
    after = session.document.timeline.keys[0].view
    places = np.concatenate(
        [
            scene_object.place.moved(box_corners(session.fields.field(scene_object).bounds))
            for scene_object in session.document.objects
        ]
    )
    ways = [np.subtract(view.target, view.eye) for view in (before, after)]
    np.testing.assert_allclose(*[way / np.linalg.norm(way) for way in ways], atol=1e-9)
    np.testing.assert_allclose(after.target, (places.min(axis=0) + places.max(axis=0)) / 2, atol=1e-9)
    camera = view_camera(after, 600, 400)
    seen = (places - camera.center) @ camera.camera_to_world[:3, :3]
    pixels = seen[:, :2] / seen[:, 2:] * camera.fx
    assert np.all(seen[:, 2] > 0) and np.all(np.abs(pixels) <= [300, 200])
    assert session.history.undo_steps[-1][0] == "move camera keys"
    assert await page.do(do="camera.outside", aspect=1.5) == {"keys": 0}
    await page.do(do="undo")
    assert session.document.timeline.keys[0].view == before
    assert "aspect" in await page.refused(do="camera.frame", aspect="wide")


@on_pages
async def test_a_drag_moves_an_object_in_one_step_and_its_turn_goes_on(server, page, session):
    await page.do(do="object.add", file="green.npz", place={"turn": [0, 0, 170]})
    number, steps = session.document.selection.object_id, len(session.history.undo_steps)
    await page.do(do="place.begin", object=number, label="Rotate")
    for turn in (180.0, 190.0, 300.0, 400.0):
        matrix = Place((0.1 * turn, 0, 0), (0, 0, turn), 0.5).matrix.tolist()
        await page.do(do="place.set", object=number, matrix=matrix, seq=int(turn))
    await page.do(do="place.end")
    assert len(session.history.undo_steps) == steps + 1
    place = session.document.scene_object(number).place
    np.testing.assert_allclose([*place.position, *place.turn, place.scale], [40, 0, 0, 0, 0, 400, 0.5], atol=1e-9)
    await page.until(lambda: page.frames and page.frames[-1]["applied"][str(page.client)] == 400)
    await page.do(do="place.begin", object=number)
    await page.do(do="place.set", object=number, matrix=np.eye(4).tolist(), seq=401)
    await page.do(do="place.end", cancel=True)
    assert session.document.scene_object(number).place == place
    await page.refused(do="object.change", id=number, place={"scale": -1})
    await page.do(do="place.begin", object=number)
    for matrix in (np.diag([-1.0, 1, 1, 1]), np.zeros((4, 4)), np.diag([2.0, 1, 1, 1]), np.eye(3)):
        await page.refused(do="place.set", object=number, matrix=matrix.tolist(), seq=402)
    await page.do(do="place.end")
    assert session.document.scene_object(number).place == place


@on_pages
async def test_edits_are_of_the_active_object(server, page, other, session):
    await page.do(do="object.add", file="green.npz", place={"position": [3, 0, 0]})
    number = session.document.selection.object_id
    await page.do(do="edit.add", lower=[-1, -1, -1], upper=[1, 1, 1])
    await other.until(lambda: [edit["object"] for edit in other.sections["edits"]] == [number])
    (edit,) = session.document.edits_of(number)
    await page.drag(edit.rest + [0, 0, 0.25], edit=edit.id)
    await other.until(lambda: (2, edit.id) in other.vertices or other.posed(edit.id)[0, 2] > edit.rest[0, 2])
    assert np.array_equal(session.document.edit(edit.id).posed, edit.rest + [0, 0, 0.25])
    assert np.array_equal(session.document.edit(1).posed, BOX.vertices)
    await page.do(do="object.select", id=MAIN)
    await page.until(lambda: [edit["id"] for edit in page.sections["edits"]] == [1])
    assert session.document.selection.edit == 1
    await page.do(do="edit.order", ids=[1])  # those of the active object
    await page.refused(do="edit.order", ids=[1, edit.id])
    # a cage is generated for the object that was active when it was asked for
    await page.do(do="cage.generate", count=20)
    await page.do(do="object.select", id=number)
    await page.until(lambda: page.sections["jobs"] and page.sections["jobs"][-1]["state"] != "running")
    assert [len(session.document.edits_of(scene_object)) for scene_object in (MAIN, number)] == [2, 1]


def test_a_click_finds_the_object_that_it_meets(folder):
    session = session_in(folder, ())

    async def test(server, page):
        await page.do(do="object.add", file="green.npz", place={"position": [3, 0, 0]})
        green = session.document.selection.object_id
        await page.do(do="object.add", file="blue.ply", place={"position": [0, -1.5, 0], "scale": 0.6})
        blue = session.document.selection.object_id
        await page.do(do="view", eye=[0, -12, 0], target=[0, 0, 0], up=[0, 0, 1], fov=40)
        frames = len(page.frames)
        await page.do(do="settings", show="alpha")
        await page.until(lambda: len(page.frames) > frames and page.frames[-1]["sharp"])
        camera = view_camera(session.document.view, 200, 100)

        async def at(point):
            x, y = camera.project(np.array([point]))[0][0]
            return (await page.do(do="object.pick", across=x / 200, down=y / 100, aspect=2.0))["object"]

        assert [await at(point) for point in ((3, 0, 0), (0, 0, 0), (0.45, 0, 0), (2, 0, 2))] == [
            green,
            blue,  # before the ball
            MAIN,
            None,
        ]
        await page.do(do="object.change", id=blue, visible=False)
        frames = len(page.frames)
        await page.do(do="settings", show="rgb")
        await page.until(lambda: len(page.frames) > frames and page.frames[-1]["sharp"])
        assert await at((0, 0, 0)) == MAIN
        for wrong in ({"across": 2}, {"down": "x"}, {"aspect": 0}):
            await page.refused(**{"do": "object.pick", "across": 0.5, "down": 0.5, "aspect": 1.0, **wrong})

    with_pages(test, folder, session=session)


# pictures and films --------------------------------------------------------------------------------------------------


def test_one_object_renders_the_bits_that_it_did_and_several_those_of_a_stage():
    document, fields = two_objects()
    alone = dataclasses.replace(document, objects=document.objects[:1])
    camera = view_camera(document.view, 40, 30)
    deformer = warpcage.Deformer(fields.main, BOX, coordinates="harmonic", resolution=16)
    posed = BOX.vertices + [0, 0, 0.3]
    (edit,) = document.edits
    moved = alone.with_edit(dataclasses.replace(edit, posed=posed))
    assert np.array_equal(picture(moved, fields), deformer.pose(BOX.with_vertices(posed)).render(camera).rgb)
    both = document.with_edit(dataclasses.replace(edit, posed=posed))
    stage = Stage().add("ball", deformer).add("green", fields.files["green.npz"], place=AWAY)
    assert np.array_equal(picture(both, fields), stage.render(camera).rgb)
    hidden = both.with_object(dataclasses.replace(both.objects[1], visible=False))
    np.testing.assert_allclose(picture(hidden, fields), picture(moved, fields), atol=1e-6)


def test_keys_hold_places_and_the_film_moves_objects(tmp_path):
    document, fields = two_objects(Place((1.5, 0, 0)))
    number = document.objects[1].id
    _, document = run_command(document, {"do": "key.add", "time": 0, "pose": True})
    document = document.with_object(
        dataclasses.replace(document.scene_object(number), place=Place((0, 0, 1.5), (0, 0, 540)))
    )
    _, document = run_command(document, {"do": "key.add", "time": 1, "pose": True, "camera": True})
    _, document = run_command(document, {"do": "key.change", "id": document.timeline.keys[0].id, "easing": "linear"})
    _, document = run_command(document, {"do": "timeline", "length": 1, "fps": 4})
    half = document_at(document, 0.5)
    np.testing.assert_allclose(half.scene_object(number).place.position, [0.75, 0, 0.75], atol=1e-12)
    np.testing.assert_allclose(half.scene_object(number).place.turn, [0, 0, 270], atol=1e-9)
    assert half.objects[0] is document.objects[0]
    assert set(state_at(document, 0.5)[0]) == {1}
    frames = list(film_pictures(document, fields, Film(40, 30)))
    assert len(frames) == 5 and len({frame.tobytes() for frame in frames}) == 5
    assert np.array_equal(frames[2], np.clip(picture(half, fields), 0, 1))
    assert export_film(document, fields, tmp_path / "film.mp4", Film(40, 30)) == 5
    # a key of poses from before there was a second object holds the field in its own place
    single = new_document(fields.main, [BOX], 16)
    _, single = run_command(single, {"do": "key.add", "time": 0, "pose": True})
    assert single.timeline.keys[0].places is None
    single = single.with_object(dataclasses.replace(single.objects[0], place=Place((0, 0, 1))))
    _, single = run_command(single, {"do": "key.add", "time": 2, "pose": True})
    np.testing.assert_allclose(document_at(single, 1).objects[0].place.position, [0, 0, 0.5], atol=1e-12)
    assert document_at(single, 0).objects[0].place == Place()


@on_pages
async def test_a_scrub_keeps_a_place_that_no_key_holds(server, page, session):
    await page.do(do="object.add", file="green.npz", place={"position": [2, 0, 0]})
    number = session.document.selection.object_id
    await page.do(do="key.add", time=0, pose=True)
    await page.until(lambda: page.sections["timeline"]["keys"][0]["pose"])
    await page.do(do="object.change", id=number, place={"position": [0, 0, 2]})
    await page.do(do="time", time=0.5)
    assert session.document.scene_object(number).place.position == (2.0, 0.0, 0.0)
    await page.until(lambda: page.sections["objects"][1]["place"]["position"] == [2, 0, 0])
    await page.do(do="undo")
    assert session.document.scene_object(number).place.position == (0.0, 0.0, 2.0)


def test_a_copy_has_edits_and_keys_of_its_own_and_shares_the_field(folder):
    document, fields = two_objects()
    _, document = run_command(document, {"do": "edit.add", "lower": [-1, -1, -1], "upper": [1, 1, 1]})
    number = document.objects[1].id
    _, document = run_command(document, {"do": "key.add", "time": 0, "pose": True})
    _, copied = run_command(document, {"do": "object.copy", "id": number, "offset": [0, 1, 0]})
    copy = copied.objects[2]
    assert (copy.name, copy.file, copied.selection.object_id) == ("green 2", "green.npz", copy.id)
    assert copy.place == dataclasses.replace(AWAY, position=(1.5, 1.0, 0.0))
    (old,), (new,) = document.edits_of(number), copied.edits_of(copy.id)
    key = copied.timeline.keys[0]
    assert old.id != new.id and np.array_equal(key.poses[new.id], key.poses[old.id])
    assert key.places[copy.id] == copy.place and key.places[number] == AWAY
    _, twin = run_command(copied, {"do": "object.copy", "id": MAIN, "offset": [0, 0, 3]})
    assert twin.objects[3].file is None and fields.field(twin.objects[3]) is fields.main
    assert Document.from_json(json.loads(json.dumps(twin.to_json()))).objects == twin.objects
    _, without = run_command(twin, {"do": "object.remove", "id": copy.id})
    assert len(without.edits) == len(twin.edits) - 1
    assert copy.id not in without.timeline.keys[0].places and new.id not in without.timeline.keys[0].poses


@on_pages
async def test_a_mesh_is_added_placed_posed_copied_and_kept(server, page, session, folder):
    """A cube with colours of vertices beside the ball, posed by a cage of its own, in a stage file too."""
    cube = warpcage.Cage.box((-0.4,) * 3, (0.4,) * 3, segments=3)
    colors = np.random.default_rng(0).random((len(cube.vertices), 3))
    write_shown_mesh(folder / "cube.glb", cube.vertices, cube.faces, colors=colors)
    cage = warpcage.Cage.box((-0.5,) * 3, (0.5,) * 3, segments=2)
    await page.do(do="object.add", file="cube.glb", beside=True)
    await page.until(lambda: len(page.sections["objects"]) == 2)
    section = page.sections["objects"][1]
    assert section["size"] == f"{len(cube.faces)} triangles" and section["file"] == "cube.glb"
    np.testing.assert_allclose(section["bounds"], cube.bounds, atol=1e-6)
    number = section["id"]
    assert session.document.scene_object(number).place.moved(cube.bounds)[0, 0] > session.field.bounds[1, 0]
    await page.do(do="object.change", id=number, place={"position": [1.4, 0, 0], "turn": [0, 0, 30]})
    await page.do(do="cage.generate", count=24, method="voxel")
    await page.until(lambda: any(edit.object_id == number for edit in session.document.edits))
    around = session.document.edits_of(number)[0].rest_cage
    assert around.contains(cube.vertices).all()
    edit = session.document.edits_of(number)[0]
    await page.do(do="edit.delete", id=edit.id)
    cage.save(folder / "around.obj")
    await page.do(do="cage.load", file="around.obj")
    edit = session.document.edits_of(number)[0]
    await page.do(do="pose.set", edit=edit.id, vertices=cage.twist(60).vertices.tolist())
    await page.do(do="object.copy", id=number, offset=[0, 1.5, 0])
    await page.do(do="stage.save", file="all.stage.json")
    document, fields = session.document, session.fields
    assert [scene_object.file for scene_object in document.objects] == [None, "cube.glb", "cube.glb"]
    mesh = SurfaceMesh(cube.vertices, cube.faces, colors=colors)
    options = {"coordinates": document.settings.coordinates}
    posed = warpcage.Deformer(mesh, cage, **options).pose(cage.twist(60))
    stage = Stage().add("ball", fields.main)
    for name, y in (("one", 0.0), ("two", 1.5)):
        stage.add(name, posed, place=Place((1.4, y, 0.0), (0.0, 0.0, 30.0)))
    view = view_camera(document.view, 48, 36)
    rest = dataclasses.replace(document, edits=tuple(edit for edit in document.edits if edit.object_id != MAIN))
    scene = PosedScene(fields)
    scene.prepare(rest)
    expected = stage.render(view).rgb
    np.testing.assert_allclose(scene.render(view).rgb, expected, atol=0.01)
    opened = Stage.load(folder / "all.stage.json")
    opened.replace("ball", fields.main)
    np.testing.assert_allclose(opened.render(view).rgb, expected, atol=0.01)
    checked = inspect(document, document.edits_of(document.objects[1].id)[0].id, mesh)
    assert checked["inside_share"] == 1.0 and not checked["leaking_faces"]
    cut = warpcage.Cage.box((-0.5, -0.5, -0.5), (0.0, 0.5, 0.5))
    through = inspect(new_document(fields.main, [cut], 16), 1, mesh)
    assert 0.3 < through["inside_share"] < 0.7 and len(through["leaking_faces"]) == 2


def test_a_stage_that_begins_with_a_mesh_is_refused_by_the_editor(folder):
    BOX.save(folder / "cube.ply")
    Stage().add("cube", folder / "cube.ply").add("ball", folder / "ball.npz").save(folder / "all.stage.json")
    with pytest.raises(ValueError, match="its first object is a mesh") as caught:
        warpcage.edit(folder / "all.stage.json")
    assert "\n" not in str(caught.value)


# files ---------------------------------------------------------------------------------------------------------------


def test_sessions_keep_objects_and_older_ones_are_read(folder):
    document, fields = two_objects()
    _, document = run_command(document, {"do": "key.add", "time": 1, "pose": True})
    write_session(folder / "two.session.json", document, fields.main, "ball.npz")
    again = read_session(folder / "two.session.json", fields.main)
    assert again.objects == document.objects and again.selection == document.selection
    assert again.timeline.keys[0].places == document.timeline.keys[0].places
    read = read_fields(again, fields.main, folder)
    assert np.array_equal(picture(again, read), picture(document, fields))
    content = json.loads((folder / "two.session.json").read_text())
    assert content["version"] == 3
    content["version"], content["document"]["things"] = 2, content["document"].pop("objects")
    for part in (content["document"]["selection"], *content["document"]["edits"]):
        if "object" in part:
            part["thing"] = part.pop("object")
    (folder / "older.session.json").write_text(json.dumps(content))  # as it was written up to version 0.2
    assert "object" not in json.dumps(content)
    assert read_session(folder / "older.session.json", fields.main).to_json() == again.to_json()
    alone = new_document(fields.main, [BOX], 16, "ball")
    write_session(folder / "one.session.json", alone, fields.main, "ball.npz")
    assert "object" not in (folder / "one.session.json").read_text()  # as before there were several
    older = read_session(folder / "one.session.json", fields.main)
    assert older.objects == (SceneObject(MAIN, "ball"),) and older.edits[0].object_id == MAIN
    (folder / "green.npz").unlink()
    with pytest.raises(FileNotFoundError, match="green.npz"):
        read_fields(again, fields.main, folder)


@pytest.mark.parametrize(
    "change",
    [
        {"objects": []},
        {"objects": [{"id": 3, "name": "x", "file": "green.npz"}]},
        {"objects": [{"id": 0, "name": "x", "file": "green.npz"}]},
        {"objects": [{"id": 0, "name": ""}]},
        {"objects": [{"id": 0, "name": "x", "place": 5}]},
        {"objects": [{"id": 0, "name": "x", "place": {"scale": 0}}]},
        {"objects": [{"id": 0, "name": "x"}, {"id": 1, "name": "y"}]},  # the number of an edit
        {"objects": [{"id": 0, "name": "x"}] * 40},
        {"selection": {"edit": None, "mode": "vertex", "vertices": [], "object": 7}},
    ],
)
def test_sessions_of_broken_objects_are_refused_in_one_line(change):
    content = new_document(tiny_field(), [BOX], 16).to_json() | change
    with pytest.raises(warpcage.errors.InputError) as refused:
        Document.from_json(content)
    assert "\n" not in str(refused.value)


def test_a_stage_is_saved_rendered_by_the_library_and_opened(folder):
    session = session_in(folder)

    async def test(server, page):
        await page.do(do="object.add", file="green.npz", place={"position": [1.5, 0, 0], "scale": 0.5})
        await page.do(do="object.add", file="blue.ply", place={"position": [0, 0, 1.5]})
        blue = session.document.selection.object_id
        await page.do(do="pose.set", edit=1, vertices=(BOX.vertices + [0, 0, 0.2]).tolist())
        await page.do(do="key.add", time=0, pose=True)
        await page.do(do="object.change", id=blue, place={"position": [0, 0, 2], "turn": [0, 0, 360]})
        await page.do(do="key.add", time=2, pose=True)
        await page.do(do="time", time=0.0)
        for name in ("both.json", "ball.npz", 5, "../x.stage.json"):
            await page.refused(do="stage.save", file=name)
        result = await page.do(do="stage.save", file="three.stage.json")
        assert result == {"download": "download/three.stage.json"}
        await page.do(do="stage.save", file="three.stage.json")  # the editor's own file is replaced

    with_pages(test, folder, session=session)
    document = session.document
    stage = Stage.load(folder / "three.stage.json")
    assert list(stage.items) == ["ball", "green", "blue"] and stage.length == 2.0
    camera = view_camera(document.view, 40, 30)
    shown = picture(document, session.fields)
    assert np.array_equal(stage.render(camera).rgb, shown)
    stage.time = 1.0
    moved = document_at(document, 1.0)
    np.testing.assert_allclose(stage.render(camera).rgb, picture(moved, session.fields), atol=1e-6)
    assert not np.array_equal(stage.render(camera).rgb, shown)

    with warpcage.edit(folder / "three.stage.json") as editor:
        opened = editor.document
        assert editor.session_path == folder / "three.stage.session.json"
        assert [(one.name, one.file, one.place) for one in opened.objects] == [
            (one.name, one.file, one.place) for one in document.objects
        ]
        (edit,) = opened.edits
        assert np.array_equal(edit.posed, BOX.vertices + [0, 0, 0.2]) and edit.object_id == MAIN
        assert [key.time for key in opened.timeline.keys] == [0.0, 2.0] and opened.timeline.length == 2.0
        there = dataclasses.replace(opened, view=document.view)
        assert np.array_equal(picture(there, editor.session.fields), shown)
        saved = stage_of(opened, editor.session.fields, folder / "ball.npz", folder)
        assert list(saved.items) == list(stage.items)
    with warpcage.edit(folder / "three.stage.json") as editor:  # goes on with the session
        assert editor.document.objects == opened.objects
    with pytest.raises(ValueError, match="cages of their own"):
        warpcage.edit(folder / "three.stage.json", BOX, session=folder / "new.session.json")


@on_pages
async def test_objects_are_baked_into_one_field(server, page, session, folder):
    await page.do(do="object.add", file="green.npz", place={"position": [2, 0, 0]})
    await page.do(do="export", what="bake", file="both.npz")
    await page.until(lambda: page.sections["jobs"] and page.sections["jobs"][-1]["state"] != "running")
    assert page.sections["jobs"][-1]["state"] == "done", page.sections["jobs"][-1]
    both = warpcage.VoxelField.load(folder / "both.npz")
    assert both.bounds[1][0] > 2.4
    camera = warpcage.Camera.look_at((1, -8, 0), (1, 0, 0), width=60, height=30, fov_degrees=40)
    expected = Stage().add("a", tiny_field()).add("b", green_field(), place=Place((2, 0, 0))).render(camera).rgb
    assert np.abs(both.render(camera).rgb - expected).mean() < 0.01


@on_pages
async def test_two_pages_of_a_hand_that_has_gone(server, page, other, session):
    await page.do(do="object.add", file="green.npz")
    number = session.document.selection.object_id
    await page.do(do="place.begin", object=number, label="Move")
    await page.do(do="place.set", object=number, matrix=Place((1, 0, 0)).matrix.tolist(), seq=1)
    await other.until(lambda: other.sections["objects"][1]["place"]["position"] == [1, 0, 0])
    await other.do(do="object.change", id=number, name="theirs")  # ends the gesture of the first
    await page.do(do="place.set", object=number, matrix=Place((2, 0, 0)).matrix.tolist(), seq=2)
    assert session.document.scene_object(number).place.position == (1.0, 0.0, 0.0)
    await page.until(lambda: page.notices)
    await asyncio.sleep(0)


@on_pages
async def test_a_scene_of_which_nothing_is_shown_says_so_until_something_is(server, page, session):
    await page.do(do="object.change", id=MAIN, visible=False)
    await page.until(lambda: page.frames and "shows nothing" in (page.frames[-1]["error"] or ""))
    await page.do(do="object.change", id=MAIN, visible=True)
    await page.until(lambda: page.frames[-1]["error"] is None)


def test_a_new_session_has_one_object():
    session = new_session()
    assert session.document.objects == (SceneObject(MAIN, "scene"),) and session.active_field is session.field
