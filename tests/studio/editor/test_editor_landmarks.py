"""Landmarks of the editor: places of the object that drags take along, by messages and in a real browser."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("simplejpeg")

from editor_browser import CAGE, Window, editor, looks_cheap, on_page, settle, until, window
from editor_pages import nothing_logged, tiny_field, with_pages  # noqa: F401
from splat_scenes import ball_of_splats

import warpcage
from warpcage import Place
from warpcage.studio.editor import Fields, SceneObject, Session, View, new_document

__all__ = ["editor", "window"]  # fixtures

#: Radius of the ball of `tiny_field`.
RADIUS = np.sqrt(0.3)

#: Where pages press, as shares of the picture: its middle, and four places about it that show the ball.
MIDDLE, AROUND = (0.5, 0.5), [(0.44, 0.5), (0.56, 0.5), (0.5, 0.4), (0.5, 0.6)]


def session_of(field: Any, coordinates: str = "mean_value", **changes: Any) -> Session:
    document = new_document(field, [CAGE], 24)
    settings = dataclasses.replace(document.settings, coordinates=coordinates)
    (edit,) = document.edits
    edits = (dataclasses.replace(edit, **changes),)
    return Session(field, dataclasses.replace(document, settings=settings, edits=edits), None)


def press(place: tuple[float, float]) -> dict[str, Any]:
    return {"do": "landmark.begin", "edit": 1, "across": place[0], "down": place[1], "aspect": 1.5}


async def pin(page: Any, place: tuple[float, float]) -> dict[str, Any]:
    found = await page.do(**press(place))
    await page.do(do="landmark.end")
    return found


async def take(page: Any, *targets: Any) -> None:
    for number, target in enumerate(targets):
        await page.send(do="landmark.set", place=[float(x) for x in target], seq=page.sequence + number + 1)
    page.sequence += len(targets)


def outward(session: Session, amount: float) -> np.ndarray:
    """To the right in the picture, world units."""
    view = session.document.view
    side = np.cross(np.subtract(view.target, view.eye), view.up)
    return amount * side / np.linalg.norm(side)


def labels(session: Session) -> list[str]:
    return [label for label, _ in session.history.undo_steps]


def test_a_press_finds_the_surface_of_a_ball(tmp_path):
    session = session_of(tiny_field())

    async def test(server, page):
        await page.until(lambda: page.frames)
        found = await pin(page, MIDDLE)
        view = session.document.view
        eye = np.asarray(view.eye)  # the ray of the middle meets the ball, by formula
        ray = np.subtract(view.target, eye) / np.linalg.norm(np.subtract(view.target, eye))
        along = -eye @ ray - np.sqrt((eye @ ray) ** 2 - eye @ eye + RADIUS**2)
        np.testing.assert_allclose(found["place"], eye + along * ray, atol=0.08)
        assert found["landmark"] == 0 and labels(session) == ["add a landmark"]
        await page.until(lambda: page.sections["edits"][0]["landmarks"])
        np.testing.assert_allclose(page.sections["edits"][0]["landmarks"], [found["place"]])
        np.testing.assert_array_equal(session.document.edits[0].posed, CAGE.vertices)

    with_pages(test, tmp_path, session=session)


@pytest.mark.parametrize("coordinates", ["mean_value", "green", "harmonic"])
def test_the_picture_has_landmarks_where_they_were_dragged(coordinates, tmp_path):
    session, field = session_of(tiny_field(), coordinates), tiny_field()

    async def test(server, page):
        await page.until(lambda: page.frames)
        for place in AROUND[:3]:
            await pin(page, place)
        held = await page.do(**press(AROUND[3]))
        target = np.array(held["place"]) + outward(session, 0.12)
        await take(page, *np.linspace(held["place"], target, 6))
        await page.do(do="landmark.end")

    with_pages(test, tmp_path, session=session)
    (edit,) = session.document.edits
    found, size = edit.landmarks, CAGE.size
    assert len(found.places) == 4 and not np.allclose(edit.posed, CAGE.vertices, atol=0.02)
    deformer = warpcage.Deformer(field, CAGE, coordinates=coordinates, resolution=48).pose(edit.posed)
    shown, _, region = deformer.to_canonical(found.targets, np.tile([0.0, 0.0, 1.0], (4, 1)))
    assert (region == 2).all()
    assert np.abs(shown - found.places).max() < 0.006 * size
    moved = np.linalg.norm(found.targets - found.places, axis=1)
    assert moved[:3].max() < 1e-5 and moved[3] == pytest.approx(0.12, abs=1e-4)


def test_splats_and_one_landmark_that_moves_all(tmp_path):
    field = ball_of_splats(0.08)
    session = session_of(field)

    async def test(server, page):
        await page.until(lambda: page.frames)
        held = await page.do(**press(MIDDLE))
        target = np.array(held["place"]) + outward(session, 0.1)
        await take(page, target)
        await page.do(do="landmark.end")

    with_pages(test, tmp_path, session=session)
    (edit,) = session.document.edits
    nearest = np.argmin(np.linalg.norm(field.centers - edit.landmarks.places[0], axis=1))
    np.testing.assert_allclose(field.centers[nearest], edit.landmarks.places[0], atol=1e-6)
    # one landmark and nothing else: all of the cage goes along, and nothing bends
    np.testing.assert_allclose(edit.posed - CAGE.vertices, np.tile(outward(session, 0.1), (42, 1)), atol=1e-4)
    baked = warpcage.Deformer(field, CAGE, coordinates="mean_value").pose(edit.posed).baked()
    np.testing.assert_allclose(baked.centers[nearest], edit.landmarks.targets[0], atol=1e-3)


def test_a_mesh_in_a_place_of_its_own(tmp_path):
    ball, place = warpcage.Cage.icosphere((0.0, 0.0, 0.0), 0.5, subdivisions=4), Place((2.0, 0.5, 0.0), (0, 0, 40), 0.5)
    fields = Fields(tiny_field())
    fields.files["ball.obj"] = warpcage.SurfaceMesh(ball.vertices, ball.faces)
    document = session_of(tiny_field(), object_id=7).document
    view = View((2.0, -1.5, 0.8), (2.0, 0.5, 0.0), (0.0, 0.0, 1.0))
    objects = (*document.objects, SceneObject(7, "ball", "ball.obj", place))
    document = dataclasses.replace(document, view=view, objects=objects, next_id=8)
    session = Session(fields, document, None)

    async def test(server, page):
        await page.until(lambda: page.frames)
        first = await pin(page, MIDDLE)
        eye = np.linalg.norm(np.subtract(view.eye, view.target)) * 2  # in units of the object, from its middle
        nearest = np.linalg.norm(place.moved([first["place"]]) - np.array(view.eye)) * 2
        assert eye - 0.5 <= nearest < eye - 0.48
        for where in AROUND[:2]:
            await pin(page, where)
        held = await page.do(**press(AROUND[3]))
        await take(page, np.array(held["place"]) + (0, 0, -0.1))
        await page.do(do="landmark.end")

    with_pages(test, tmp_path, session=session)
    (edit,) = session.document.edits
    found = edit.landmarks
    moved = warpcage.deform_points(found.places, CAGE, edit.posed, device="cpu")
    np.testing.assert_allclose(moved, found.targets, atol=2e-3)
    np.testing.assert_allclose(found.targets - found.places, [[0, 0, 0]] * 3 + [[0, 0, -0.1]], atol=1e-5)


def test_steps_are_undone_and_landmarks_deleted(tmp_path):
    session = session_of(tiny_field())

    async def test(server, page):
        await page.until(lambda: page.frames)
        first = await pin(page, AROUND[0])
        held = await page.do(**press(AROUND[1]))
        await take(page, np.array(held["place"]) + outward(session, 0.1))
        await page.do(do="landmark.end")
        assert labels(session) == ["add a landmark", "drag a landmark"]
        bent = session.document.edits[0]
        assert len(bent.landmarks.places) == 2
        await page.do(do="undo")
        (edit,) = session.document.edits
        assert len(edit.landmarks.places) == 1 and np.array_equal(edit.posed, CAGE.vertices)
        await page.do(do="undo")
        assert session.document.edits[0].landmarks is None
        await page.do(do="redo")
        await page.do(do="redo")
        assert session.document.edits[0] is bent

        # the second again, and taken back
        held = await page.do(do="landmark.begin", edit=1, landmark=1)
        np.testing.assert_array_equal(held["place"], bent.landmarks.targets[1])
        await take(page, np.array(held["place"]) + outward(session, 0.1))
        await page.do(do="landmark.end", cancel=True)
        np.testing.assert_array_equal(session.document.edits[0].posed, bent.posed)

        await page.do(do="landmark.delete", edit=1, landmark=1)
        (edit,) = session.document.edits
        np.testing.assert_array_equal(edit.landmarks.targets, [first["place"]])
        assert edit.posed is bent.posed
        await page.do(do="undo")
        await page.do(do="landmark.delete", edit=1)
        assert session.document.edits[0].landmarks is None and labels(session)[-1] == "delete landmarks"
        await page.do(do="undo")

        # another change of the pose ends them, as it does what sliders hold, and undo brings them back
        await page.do(do="pose.set", edit=1, vertices=(bent.posed * 1.01).tolist())
        assert session.document.edits[0].landmarks is None
        assert "changed the pose" in await page.refused(do="landmark.begin", edit=1, landmark=0)
        await page.do(do="undo")
        assert session.document.edits[0].landmarks is bent.landmarks

    with_pages(test, tmp_path, session=session)


def test_what_cannot_be_dragged_is_refused(tmp_path):
    session = session_of(tiny_field())

    async def test(server, page, other):
        await page.until(lambda: page.frames)
        assert "nothing of scene is seen there" in await page.refused(**press((0.02, 0.02)))
        assert "there are no landmarks" in await page.refused(do="landmark.delete", edit=1)
        assert "changed the pose" in await page.refused(do="landmark.begin", edit=1, landmark=0)
        for name, value in (("across", 2.0), ("down", "x"), ("aspect", None)):
            assert name in await page.refused(**{**press(MIDDLE), name: value})
        assert not session.moving and session.document.edits[0].landmarks is None
        await page.do(do="settings", mode="rest")
        assert "the mode Pose" in await page.refused(**press(MIDDLE))
        await page.do(do="settings", mode="pose")
        await page.do(do="edit.change", id=1, visible=False)
        assert "is hidden" in await page.refused(**press(MIDDLE))
        await page.do(do="undo")

        # another page's change ends a drag: what the first one does on is said to be so
        await pin(page, MIDDLE)
        assert "landmark" in await page.refused(do="landmark.begin", edit=1, landmark=3)
        held = await page.do(do="landmark.begin", edit=1, landmark=0)
        await other.do(do="edit.change", id=1, name="leg")
        await take(page, np.array(held["place"]) + 0.1)
        await page.until(lambda: any("this move has ended" in text for text in page.notices))
        assert "this move has ended" in await page.refused(do="landmark.end")
        np.testing.assert_array_equal(session.document.edits[0].posed, CAGE.vertices)

    with_pages(test, tmp_path, 2, session=session)


def test_a_press_is_on_the_pose_of_now(tmp_path, monkeypatch):
    """Not on that of the last picture, which may be older than a command before it."""
    session = session_of(tiny_field())

    async def test(server, page):
        await page.until(lambda: page.frames and page.frames[-1]["sharp"])
        count = len(page.frames)
        await page.do(do="edit.change", id=1, visible=False)
        await page.until(lambda: len(page.frames) > count)
        monkeypatch.setattr(server.renderer, "request", lambda request: None)
        await page.do(do="undo")
        await pin(page, MIDDLE)

    with_pages(test, tmp_path, session=session)
    assert len(session.document.edits[0].landmarks.places) == 1


def test_a_place_of_the_object_is_dragged_on_the_page(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.rest()
    steps = len(editor.session.history.undo_steps)
    window.press("J")
    window.wait('warpcage.store.tools.tool === "landmark"')
    middle = on_page(window, (0, 0, 0))
    side = np.cross((0, 0, 1), editor.document.view.eye)
    side /= np.linalg.norm(side)
    reach = on_page(window, RADIUS * side) - middle
    for number, share in enumerate((-0.7, 0.0)):  # clicks pin
        window.drag([middle + share * reach])
        settle(editor, steps + number + 1)
    start, way = middle + 0.7 * reach, np.array([26.0, -18.0])
    window.drag([start + share * way for share in np.linspace(0, 1, 8)])
    settle(editor, steps + 3)
    (edit,) = editor.document.edits
    assert len(edit.landmarks.places) == 3 and not np.allclose(edit.posed, edit.rest, atol=0.01)
    # the place that was pressed is where the pointer let go of it, and the pins where they were
    for target, pixel in zip(edit.landmarks.targets, (middle - 0.7 * reach, middle, start + way), strict=True):
        np.testing.assert_allclose(on_page(window, target), pixel, atol=1.5)
    deformer = warpcage.Deformer(tiny_field(), CAGE, coordinates="mean_value", resolution=24).pose(edit.posed)
    shown, _, _ = deformer.to_canonical(edit.landmarks.targets, np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert np.abs(shown - edit.landmarks.places).max() < 0.006 * CAGE.size
    window.wait("warpcage.store.sections.edits[0].landmarks.length === 3")
    until(lambda: np.allclose(window.posed(), edit.posed, atol=1e-9), "the page has the pose")
    assert "3 landmarks" in window.get('document.getElementById("landmark-text").textContent')

    # Escape in mid-drag takes it back; Delete, Undo; Escape leaves the tool
    window.point("mouseMoved", middle)
    window.point("mousePressed", middle, button="left")
    window.point("mouseMoved", middle + [0, 40], button="left")
    until(lambda: not np.array_equal(editor.document.edits[0].posed, edit.posed), "the cage follows")
    window.press("Escape")
    until(lambda: np.array_equal(editor.document.edits[0].posed, edit.posed), "Escape takes it back")
    window.point("mouseReleased", middle + [0, 40], button="left")
    window.press("Delete")
    until(lambda: len(editor.document.edits[0].landmarks.places) == 2, "one is deleted")
    assert np.array_equal(editor.document.edits[0].posed, edit.posed)
    window.press("Ctrl+Z", "Ctrl+Z")
    until(lambda: np.array_equal(editor.document.edits[0].posed, edit.rest), "the drag is undone")
    window.wait("warpcage.store.sections.edits[0].landmarks.length === 2")
    window.press("Escape")
    window.wait('warpcage.store.tools.tool === "select"')
    assert window.get('document.getElementById("landmark-options").hidden')
