"""What is said of a cage while it is edited: checked beside the session, only the newest pose."""

from __future__ import annotations

import asyncio
import collections
import dataclasses
import logging
import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from ...cage.cage import Cage
from ...cage.check import outside_text, percent_text, sample_pose
from ...core.names import error_line
from ...mesh.faces import column_cross, column_dot, face_edges
from ...mesh.patches import faces_of
from ...mesh.queries import crossing_faces, inside_mesh
from ...mesh.validity import first_problem
from ...render.surface_mesh import AnyObject, SurfaceMesh
from ...select.selection import visible_mask
from ..films.checks import MAX_LINE
from ..films.document import Document, Edit, same
from .session import Session

#: About how many samples of the map are taken in a posed cage, and of the visible nodes for the share inside: fewer
#: than `Cage.check` takes, so that a check ends before the next drag.
POSE_SAMPLES, NODE_SAMPLES = 300, 2000

#: Cells along the longest side of a mesh in which its surface is, and points of it by which they are found.
MESH_CELLS, MESH_SAMPLES = 100, 200_000

#: Points on all faces of a cage at most, at which it is asked whether matter passes through.
FACE_SAMPLES = 40_000

#: Distance of those points from their face, outward, in voxels.
FACE_DISTANCE = 0.5

#: Rest cages whose answers are kept: they stay the same while a pose is dragged.
KEPT = 8


@dataclasses.dataclass(frozen=True)
class RestFindings:
    """What is known of a cage at rest."""

    problem: str  # what makes it unusable; empty for a usable cage
    crossing: np.ndarray  # (k, 2) pairs of faces that pass through each other
    leaking: np.ndarray  # (k,) faces that visible matter passes through
    inside_share: float | None  # of the visible nodes; None for an unusable cage, or where nothing is visible


class Inspector:
    """Checks edits in one field. Any thread may use it, one at a time."""

    def __init__(self, field: AnyObject):
        import trimesh.sample

        self._lower = np.array(field.bounds[0])
        if isinstance(field, SurfaceMesh):
            self._side = np.full(3, np.ptp(field.bounds, axis=0).max() / MESH_CELLS)
            self._mask = np.zeros(np.floor(np.ptp(field.bounds, axis=0) / self._side).astype(int) + 1, bool)
            surface = trimesh.Trimesh(field.vertices, field.faces, process=False)
            points = trimesh.sample.sample_surface(surface, MESH_SAMPLES, seed=0)[0]
            self._mask[tuple(np.floor((points - self._lower) / self._side).astype(int).T)] = True
        else:
            self._mask, self._side = visible_mask(field), np.array(field.voxel_size)
        nodes = np.argwhere(self._mask)
        chosen = np.random.default_rng(0).permutation(len(nodes))[:NODE_SAMPLES]
        self._nodes = self._lower + (nodes[chosen] + 0.5) * self._side
        self.findings: collections.OrderedDict[tuple[bytes, bytes], RestFindings] = collections.OrderedDict()
        self._lock = threading.Lock()

    def rest(self, edit: Edit) -> RestFindings:
        """What is known of the rest cage of an edit, from before where it was looked at already."""
        key = (edit.rest.tobytes(), edit.faces.tobytes())
        with self._lock:
            if key not in self.findings:
                self.findings[key] = self._examined(edit.rest_cage)
            self.findings.move_to_end(key)
            while len(self.findings) > KEPT:
                self.findings.popitem(last=False)
            return self.findings[key]

    def _examined(self, cage: Cage) -> RestFindings:
        problem = first_problem(cage)
        crossing = crossing_faces(cage)
        share = None
        if not problem and len(self._nodes):
            share = float(inside_mesh(self._nodes, cage).mean())
        return RestFindings(problem, crossing, self.leaking_faces(cage), share)

    def leaking_faces(self, cage: Cage) -> np.ndarray:
        """The faces (k,), ascending, that visible matter passes through: there is some right outside of them."""
        surface = cage.refined(1)
        edges = face_edges(surface)
        normals = column_cross(*edges)
        double_area = np.sqrt(column_dot(normals, normals))
        voxel = float(self._side.min())
        # a grid on each face, as fine as the voxels or as the number of points allows
        spacing = max(voxel, np.sqrt(0.5 * double_area.sum() / FACE_SAMPLES))
        counts = np.ceil(np.sqrt(double_area) / spacing).astype(int).clip(1, 400)
        leaking = []
        for count in np.unique(counts):
            faces = np.flatnonzero((counts == count) & (double_area > 0.0))
            i, j = np.nonzero(np.tri(count, dtype=bool)[::-1])
            across, along = (i + 1 / 3) / count, (j + 1 / 3) / count
            normal = (normals[:, faces] / double_area[faces]).T
            corner = surface.vertices[surface.faces[faces, 0]] + FACE_DISTANCE * voxel * normal
            one, two = (edge[:, faces].T[:, None] for edge in edges)
            points = corner[:, None] + across[:, None] * one + along[:, None] * two
            leaking.append(faces[self._visible(points).any(axis=1)])
        return faces_of(cage, np.sort(np.concatenate(leaking)), 1)

    def _visible(self, points: np.ndarray) -> np.ndarray:
        """Whether the voxels that points (..., 3) lie in can be seen; not where they lie in none."""
        cells = np.floor((points - self._lower) / self._side)
        there = ((cells >= 0) & (cells < self._mask.shape)).all(axis=-1)
        cells = np.where(np.expand_dims(there, -1), cells, 0).astype(np.int64)
        return np.logical_and(there, self._mask[tuple(np.moveaxis(cells, -1, 0))])


_inspectors: weakref.WeakKeyDictionary[AnyObject, Inspector] = weakref.WeakKeyDictionary()


def inspector(field: AnyObject) -> Inspector:
    """The inspector of a field, made once; it knows which of the field's voxels can be seen."""
    if field not in _inspectors:
        _inspectors[field] = Inspector(field)
    return _inspectors[field]


def inspect(document: Document, number: int, field: AnyObject) -> dict[str, Any]:
    """Check an edit, as pages show it: the section `check`.
    Shares are folded and outside of the posed cage's inside, inside of what is visible (or None); leaks are at rest."""
    edit = document.edit(number)
    known = inspector(field).rest(edit)
    rest_only = document.settings.mode == "rest" or edit.kind == "remove"
    problem = f"The cage at rest {known.problem}" if known.problem else ""
    crossing, folded, outside = known.crossing, 0.0, 0.0
    if not rest_only:
        rest = edit.rest_cage
        pose = rest.with_vertices(edit.posed)
        at_rest = np.array_equal(edit.posed, edit.rest)
        crossing = known.crossing if at_rest else crossing_faces(pose)
        if not problem and not at_rest:
            trouble = first_problem(pose)
            problem = f"The posed cage {trouble}" if trouble else ""
            if not problem:
                _, folded, outside, _ = sample_pose(rest, pose, POSE_SAMPLES)  # mean value; `Cage.check` looks closer
    crossed = np.unique(crossing).tolist()
    leaking = known.leaking.tolist()
    return {
        "edit": number,
        "pending": False,
        "problem": problem,
        "crossing_faces": crossed,
        "folded_share": folded,
        "leaking_faces": leaking,
        "outside_share": outside,
        "inside_share": known.inside_share,
        "lines": _lines(problem, len(crossed), folded, outside, len(leaking), known.inside_share),
    }


def _lines(
    problem: str, crossing: int, folded: float, outside: float, leaking: int, inside_share: float | None
) -> list[str]:
    """What was found, as sentences that say what to do."""
    lines = []
    if problem:
        lines.append(f"{problem}. The picture stays as it was until this is fixed.")
    if crossing:
        lines.append(f"{crossing} faces pass through each other. The picture may tear there: move them apart.")
    if folded:
        lines.append(
            f"{percent_text(folded)} of the posed cage is turned inside out. Move, turn or twist it less there."
        )
    if outside:
        share = percent_text(outside)
        lines.append(f"{share} of the posed cage stays empty: it has nothing to show. Move it less there.")
    if leaking:
        faces = "1 face of the cage at rest cuts" if leaking == 1 else f"{leaking} faces of the cage at rest cut"
        lines.append(f"{faces} through what is visible. Move them outward, unless the cut is meant.")
    if inside_share is not None and inside_share < 1.0:
        lines.append(f"{outside_text(inside_share)}.")
    return lines or ["All is well: the cage holds all that is visible, and nothing is turned inside out."]


#: Seconds from a change to the check of the cage.
CHECK_SECONDS = 0.3

#: The section of a cage before its first check.
NOTHING_KNOWN = {
    "problem": "",
    "crossing_faces": [],
    "folded_share": 0.0,
    "leaking_faces": [],
    "outside_share": 0.0,
    "inside_share": None,
    "lines": [],
}

_log = logging.getLogger(__name__)


class Checker:
    """Checks the active edit, one check at a time, in another thread. All else is in the thread of the server's loop.
    While `busy` (a drag, or the film plays) the check waits; `notify` is called when the section has changed."""

    def __init__(self, session: Session, busy: Callable[[], bool], notify: Callable[[], None]):
        self._session, self._busy, self._notify = session, busy, notify
        self._timer: asyncio.TimerHandle | None = None
        self._task: asyncio.Task | None = None
        self._known: tuple[object, ...] = ()  # what the section says something of
        self.section: dict[str, Any] | None = None  # the section `check` of pages; None where no edit is active

    def plan(self) -> None:
        """Check before long."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(CHECK_SECONDS, self._begin)

    async def stop(self) -> None:
        """Check no more."""
        if self._timer is not None:
            self._timer.cancel()
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _begin(self) -> None:
        self._timer = None
        if self._task is not None or self._busy():
            self.plan()
        elif not same(self._known, _seen(self._session.document)):
            self._task = asyncio.create_task(self._check())

    async def _check(self) -> None:
        document = self._session.document
        number, self._known = document.selection.edit, ()
        try:
            if number is None:
                found = None
            else:
                before = self.section if self.section and self.section["edit"] == number else NOTHING_KNOWN
                self.section = {**before, "edit": number, "pending": True}
                self._notify()
                found = await asyncio.get_running_loop().run_in_executor(None, self._look, document, number)
            if same(_seen(document), _seen(self._session.document)):  # otherwise another check is on its way
                self.section, self._known = found, _seen(document)
                self._notify()
        finally:
            self._task = None

    def _look(self, document: Document, number: int) -> dict[str, Any]:
        try:
            return inspect(
                document, number, self._session.fields.field(document.scene_object(document.edit(number).object_id))
            )
        except Exception as error:
            if not isinstance(error, ValueError | MemoryError | ArithmeticError | RuntimeError):
                _log.exception("a cage could not be checked")
            line = f"This cage could not be checked: {error_line(error, MAX_LINE, folders=False)}"
            return {**NOTHING_KNOWN, "edit": number, "pending": False, "problem": line, "lines": [line]}


def _seen(document: Document) -> tuple[object, ...]:
    """What a check looks at."""
    return document.edits, document.selection.edit, document.settings.mode
