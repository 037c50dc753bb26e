"""Landmarks: a drag takes a place of the object along, and the cage follows, as rigidly as earlier landmarks let it."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...core.checks import checked_number
from ...core.names import error_line
from ...deform.deformer import Deformer
from ...errors import InputError
from ...pose_fits.points import PointPull, positions_of
from ...render.surface_mesh import SurfaceMesh
from ...splats.splat_field import SplatField
from ..films.checks import MAX_LINE, checked_triple, frozen_vertices
from ..films.document import Document, Edit, Landmarks, Message
from ..films.session.scene import PosedScene, clicked_pixel, same_pose
from .commands import require_landmark
from .renderer import COARSE_CELLS, Renderer
from .session import Session

#: Landmarks of an edit.
MAX_LANDMARKS = 32

#: Turns of the solver for each move of the pointer, and at the end of a drag.
TURNS, LAST_TURNS = 5, 30

#: Poses whose maps are asked for at its end, at most (Green coordinates need most), and the share of the size that
#: landmarks may be off the picture's.
SETTLINGS, CLOSE = 6, 5e-4

#: Cells of the lattice on which a drag ends, at most.
CELLS = COARSE_CELLS[2]


@dataclasses.dataclass(eq=False)
class _Pull:
    """A drag of a landmark that is under way."""

    owner: object
    edit: int
    number: int  # of the landmark
    label: str
    solve: PointPull
    target: np.ndarray | None = None  # (3,) where it is to go and is not yet
    added: np.ndarray | None = None  # (k, 3) found anew since the last move
    moved: Callable[[], None] | None = None  # called when it is there
    follower: asyncio.Task | None = None
    is_asking: bool = False
    has_moved: bool = False


class Puller:
    """Drags of landmarks, one at a time. All in the thread of the server's loop, but for what is computed.
    `hurry` is called so that a picture that rests is left, and the scene can be asked."""

    def __init__(self, session: Session, renderer: Renderer, hurry: Callable[[], None]):
        self._session, self._renderer, self._hurry = session, renderer, hurry
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()  # messages act in their order, also those that take a while
        self._pull: _Pull | None = None

    async def begin(self, owner: object, message: Message) -> dict[str, Any]:
        """Take hold of a landmark by its number, or of what a pixel shows; returns its number and where it is."""
        async with self._turn:
            return await self._begin(owner, message)

    async def _begin(self, owner: object, message: Message) -> dict[str, Any]:
        session = self._session
        edit = _posable(session.document, message)
        held, number = edit.landmarks, message.get("landmark")
        if number is not None:
            require_landmark(held, number)
        elif held is not None and len(held.places) >= MAX_LANDMARKS:
            raise InputError(f"an edit takes at most {MAX_LANDMARKS} landmarks: delete one first")
        label = "add a landmark" if number is None else "drag a landmark"
        session.begin_gesture(owner, edit.id, label)
        try:
            if held is None or number is None:
                found = await self._ask(_picker(session.document, edit, message))
                held, number = _with_landmark(edit, *found), len(held.places) if held else 0
            made = edit.rest_cage, held.before, held.places, "cpu"
            pull = await self._loop.run_in_executor(None, PointPull, *made)
            if len(held.added) < len(held.places):  # the new one's
                own = held.targets[-1:] - pull.shares[-1:] @ edit.posed
                held = dataclasses.replace(held, added=np.concatenate([held.added, own]))
        except BaseException:
            session.end_gesture(owner, cancel=True)
            raise
        if not session.move_edit(owner, dataclasses.replace(edit, pulled_landmarks=held), label):
            raise InputError("another page, or another command, changed the scene meanwhile: take hold of it again")
        self._pull = _Pull(owner, edit.id, number, label, pull)
        return {"landmark": number, "place": held.targets[number].tolist()}

    def set(self, owner: object, message: Message, moved: Callable[[], None]) -> bool:
        """Take the landmark that is held to a place; `moved` is called when it is there. False: the drag has ended."""
        place, pull = np.array(checked_triple(message["place"], "place")), self._pull
        if pull is None or pull.owner is not owner or not self._session.is_moved_by(owner):
            return False
        pull.target, pull.moved = place, moved
        if pull.follower is None or pull.follower.done():
            pull.follower = asyncio.create_task(self._follow(pull))
        return True

    async def end(self, owner: object, cancel: bool) -> None:
        """Let go of it: a step, whose landmarks lie where the picture will show them; or take all of it back."""
        async with self._turn:
            await self._end(owner, cancel)

    async def _end(self, owner: object, cancel: bool) -> None:
        pull = self._pull
        if cancel or pull is None or pull.owner is not owner:
            self._pull = None
            self._session.end_gesture(owner, cancel)
            return
        try:
            if pull.follower is not None:
                await pull.follower
            for _ in range(SETTLINGS if pull.has_moved else 0):
                document = self._session.document
                if not self._session.is_moved_by(owner):
                    return
                edit = document.edit(pull.edit)
                before, pull.added = edit.landmarks, await self._ask(_settler(pull, document, edit))
                if not await self._step(pull, None, LAST_TURNS) or before is None:
                    return
                if np.abs(pull.added - before.added).max() < CLOSE * edit.rest_cage.size:
                    break
        finally:  # a pose that cannot be shown stays, as that of any drag
            self._pull = None if self._pull is pull else self._pull
            self._session.end_gesture(owner)

    def stop(self) -> None:
        """The editor ends."""
        if self._pull is not None and self._pull.follower is not None:
            self._pull.follower.cancel()

    async def _ask(self, question: Callable[[PosedScene], Any]) -> Any:
        answer = self._renderer.ask(question)
        self._hurry()
        return await asyncio.wrap_future(answer)

    async def _follow(self, pull: _Pull) -> None:
        """Go where the pointer is by now, until it rests."""
        while pull.target is not None:
            target, moved, pull.target = pull.target, pull.moved, None
            try:
                if not await self._step(pull, target, TURNS):
                    return
            except (ValueError, ArithmeticError) as error:  # a place that is too far away
                self._session.notify(error_line(error, MAX_LINE, folders=False))
                continue
            if moved is not None:
                moved()
            if not pull.is_asking:
                pull.is_asking = True
                document = self._session.document
                answer = self._renderer.ask(_settler(pull, None, document.edit(pull.edit)))
                answer.add_done_callback(functools.partial(self._hear, pull))

    def _hear(self, pull: _Pull, answer: concurrent.futures.Future[np.ndarray]) -> None:
        """What the map adds is known; called in the renderer's thread. A pose without a picture leaves it as it was."""

        def take() -> None:
            pull.is_asking = False
            if answer.exception() is None:
                pull.added = answer.result()

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(take)

    async def _step(self, pull: _Pull, target: np.ndarray | None, turns: int) -> bool:
        """Solve once, in another thread, and pose the cage; False where the drag has ended."""
        edit = self._session.document.edit(pull.edit)
        held = edit.landmarks
        if held is None or not self._session.is_moved_by(pull.owner):
            return False
        targets, added = held.targets.copy(), held.added if pull.added is None else pull.added
        if target is not None:
            targets[pull.number] = target
            pull.has_moved = True
        solved = await self._loop.run_in_executor(None, pull.solve, edit.posed, targets - added, turns)
        posed = frozen_vertices(solved, len(edit.posed))
        held = dataclasses.replace(held, posed=posed, targets=targets, added=added)
        label = "drag a landmark" if pull.has_moved else pull.label
        edit = dataclasses.replace(edit, posed=posed, pulled_landmarks=held)
        return self._session.move_edit(pull.owner, edit, label, only_vertices=True)


def _posable(document: Document, message: Message) -> Edit:
    """The edit of a message, whose cage can be posed by what is seen."""
    edit = document.edit(message["edit"])
    if document.settings.mode != "pose":
        raise InputError("landmarks are dragged in the mode Pose: switch to it")
    if edit.kind == "remove":
        raise InputError(f"{edit.name} removes what is in its cage: there is nothing to drag")
    if not edit.visible or not document.scene_object(edit.object_id).visible:
        raise InputError(f"{edit.name} is hidden: show it to drag what it moves")
    return edit


def _with_landmark(edit: Edit, place: np.ndarray, target: np.ndarray) -> Landmarks:
    """The landmarks of an edit and one more, of which it is not known yet what the map adds."""
    held = edit.landmarks or Landmarks(edit.posed, edit.posed, *[np.zeros((0, 3))] * 3)
    places, targets = np.vstack([held.places, place]), np.vstack([held.targets, target])
    return dataclasses.replace(held, places=places, targets=targets)


def _picker(document: Document, edit: Edit, message: Message) -> Callable[[PosedScene], tuple[np.ndarray, np.ndarray]]:
    """Asks a scene what place of an object a pixel shows: at rest, and in the pose, (3,) in its own coordinates."""
    across, down = (checked_number(message[name], name, 0.0, 1.0) for name in ("across", "down"))
    pixel = clicked_pixel(document.view, across, down, checked_number(message["aspect"], "aspect", 0.05, 20.0))
    owner = document.scene_object(edit.object_id)

    def pick(scene: PosedScene) -> tuple[np.ndarray, np.ndarray]:
        if scene.held is None or not same_pose(scene.held[0], document):  # the last picture is of another pose
            scene.prepare(document, min(document.settings.resolution, CELLS))
        posed = scene.posed(owner.id)
        seen = scene.surface_at(owner.id, owner.place, pixel)
        if seen is None or not isinstance(posed, Deformer):
            raise InputError(f"nothing of {owner.name} is seen there: press on the object")
        matter, is_moved = _moved_matter(posed), True
        if matter is not None:  # moves forward: the nearest of it
            nearest = int(np.argmin(np.linalg.norm(matter[1] - seen, axis=1)))
            place, seen = (np.asarray(side[nearest], np.float64) for side in matter)
        else:
            canonical, _, region = posed.to_canonical(seen[None], np.array([[0.0, 0.0, 1.0]]))
            place, is_moved = canonical[0], bool(region[0] == 2)
        if not is_moved or not edit.rest_cage.contains(place[None])[0]:
            raise InputError(f"{edit.name} does not move what is seen there: press on what is in its cage")
        return place, seen

    return pick


def _settler(pull: _Pull, document: Document | None, edit: Edit) -> Callable[[PosedScene], np.ndarray]:
    """Asks a scene, in its last pose or in that of a document, what its map adds to mean value weights, (k, 3)."""
    held = edit.landmarks
    assert held is not None
    places, shares = held.places, pull.solve.shares

    def settle(scene: PosedScene) -> np.ndarray:
        if document is not None:
            scene.prepare(document, min(document.settings.resolution, CELLS))
        deformer = scene.posed(edit.object_id)
        posed: list[Cage] = []
        if isinstance(deformer, Deformer) and deformer.deformed is not None:
            pairs = zip(deformer.edits, deformer.deformed, strict=True)
            posed = [cage for one, cage in pairs if np.array_equal(one.cage.vertices, edit.rest) and cage is not None]
        if not isinstance(deformer, Deformer) or not posed:
            raise InputError(f"the picture does not show the pose of {edit.name}")
        guess, matter = shares @ posed[0].vertices, _moved_matter(deformer)
        if matter is None:
            return positions_of(deformer, places, guess + held.added) - guess
        rest, now = matter
        nearest = [int(np.argmin(np.linalg.norm(rest - place, axis=1))) for place in places]
        return places + now[nearest] - rest[nearest] - guess

    return settle


def _moved_matter(deformer: Deformer) -> tuple[np.ndarray, np.ndarray] | None:
    """Places (n, 3) of what moves forward, splats that are drawn or a mesh's vertices, at rest and in the last pose;
    None for voxels, which are looked up backward."""
    with deformer.lock:
        edits: Any = deformer.posed_edits()
        if isinstance(deformer.field, SurfaceMesh):
            rest, posed = edits.rest.vertices, edits.mesh.vertices
            if len(rest) != len(posed):
                raise InputError("landmarks are for meshes of which nothing is copied or removed")
            return rest, posed
        if not isinstance(deformer.field, SplatField):
            return None
        if edits.posed is deformer.field.splats:
            return deformer.field.centers, deformer.field.centers
        drawn = edits.posed.opacities.numpy() > 0
        return edits.origin + edits.centers.numpy()[drawn], edits.origin + edits.posed.centers.numpy()[drawn]
