"""Which axis points up in a cage file: found from the object that the cage stands around, or from its rest cage."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from ..core.files import PathLike
from ..errors import InputError
from ..mesh.io import UPS, Faces, file_up, read_object, turned_up
from ..mesh.match import matched_vertices
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import inside_mesh
from ..mesh.validity import first_problem

Mesh = TypeVar("Mesh", bound=ClosedMesh)

#: A cage holds a whole object from this share of it on, and misses nothing up to this share.
_WHOLE, _MISSED = 0.9, 0.02

#: Another axis is taken where the cage misses less than this share of what it misses otherwise.
_CLEARLY_LESS = 0.25

#: Where a cage holds the object with either axis, unevenness of its margins decides from this share on.
_UNEVEN = 0.04

#: A cage that holds less than this share of the object with either axis is not a cage of it.
_NOTHING = 1e-4

#: A cage beside the object is turned where it then holds this share of it.
_SOMETHING = 0.01

#: Points of the object that are tested: fewer for cages of many faces.
_MIN_POINTS, _MAX_POINTS, _WORK = 1000, 20_000, 20_000_000

#: A part that holds so many times more of the object with another axis may have been written with it; from the lesser
#: number on that is mentioned. Most parts hold a little more or less when they are turned.
_FAR_MORE, _MORE = 2.0, 1.25

#: A vertex stays in a pose within this share of the cage's size: files hold 6 digits.
_STAYS = 1e-4

#: A pose is near its rest cage with another axis where it has this share of the distance.
_NEARER = 0.5

#: Largest turn of a whole pose that is near its rest cage, and least one of a pose on its side, in degrees.
_LEVEL, _ON_ITS_SIDE = 25.0, 60.0

#: A pose that is a similarity up to this share of the cage's size may be turned as a whole, on purpose.
_SIMILAR = 1e-3


@dataclasses.dataclass(frozen=True)
class UpAxis:
    """How a cage file stands."""

    up: str  # the axis that points up in the file, "y" or "z"
    turned: bool = False  # whether it is another one than was expected
    note: str = ""  # why, or what speaks against it; empty where there is nothing to say
    doubtful: bool = False  # whether the note says that something may be wrong
    likelier: bool = False  # whether a cage of a part would hold far more with another axis
    lost: bool = False  # whether the cage holds nothing of its object, however it stands


def load_standing(
    make: Callable[[np.ndarray, Faces], Mesh],
    path: PathLike,
    *,
    up: str | None = None,
    reference: object = None,
    expected: str | None = None,
    anywhere: bool = False,
    object: str | None = None,
) -> tuple[Mesh, UpAxis]:
    """Read a cage file, and say how it stands by its `reference`: the cage at rest, or the object that it is around.
    `up` None finds the axis so, else `expected`, else the format's; `anywhere` takes a cage that holds nothing."""
    # object: as `read_object` takes it; without it the pose of a cage is that of its name, or the only one that fits
    chosen = up or expected or file_up(path)
    rest = reference if isinstance(reference, ClosedMesh) else None
    fits = None if rest is None else functools.partial(is_pose, rest)
    file = read_object(path, chosen, object, fits, "" if rest is None else rest.object_name)
    path = file.path
    try:
        cage, standing = make(file.vertices, file.as_came).named(file.name), UpAxis(chosen)
        if reference is not None:
            given = up is not None
            if isinstance(reference, ClosedMesh):
                standing = standing_of_pose(cage, chosen, reference, given=given)
            else:
                standing = standing_of_rest(cage, chosen, reference, given=given)
        if standing.lost and up is None and not anywhere:
            raise InputError(standing.note)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return restood(cage, chosen, standing.up), standing


def is_pose(rest: ClosedMesh, vertices: np.ndarray, faces: Faces) -> bool:
    """Whether a mesh is a pose of a cage."""
    try:
        matched_vertices(rest, ClosedMesh(vertices, faces))
    except ValueError:
        return False
    return True


def standing_of_rest(cage: ClosedMesh, up: str, scene_object: object, *, given: bool = False) -> UpAxis:
    """How a cage at rest, turned from the axis `up` to z, stands by what it holds of a field, a selection or a mesh.
    An axis that the user gave is kept; a cage that cannot be used, or an object that shows nothing, is as expected."""
    if first_problem(cage):
        return UpAxis(up)
    points = object_points(scene_object, count=max(_MIN_POINTS, min(_MAX_POINTS, _WORK // len(cage.surface.faces))))
    if not len(points):
        return UpAxis(up)
    here, other = _share_inside(cage, points), _other(up)
    turned = restood(cage, up, other)
    if here >= 1.0 - _MISSED:
        snug = _unevenness(turned, points) <= _CLEARLY_LESS * _unevenness(cage, points)
        if given or not snug or _unevenness(cage, points) < _UNEVEN or _share_inside(turned, points) < here:
            return UpAxis(up)
        return UpAxis(up, note=f"holds the object either way, but would fit it closer with {other} up", doubtful=True)
    there = _share_inside(turned, points)
    whole = there >= _WHOLE and 1.0 - there <= _CLEARLY_LESS * (1.0 - here)
    if whole or (here < _NOTHING and there >= _SOMETHING):
        held = f"it holds {_percent(there)} of the object so, with {up} up {_percent(here)}"
        if given:
            return UpAxis(up, note=f"seems to have {other} up: {held}", doubtful=True)
        return UpAxis(other, turned=True, note=f"has {other} up, and is turned: {held}")
    if here < _NOTHING:
        places = f"{_span(*cage.bounds)}, the object {_span(points.min(axis=0), points.max(axis=0))}"
        nothing = f"holds nothing of the object, with z up or with y up: it lies at {places}"
        return UpAxis(up, note=nothing, doubtful=True, lost=True)
    more = f"; with {other} up it would hold {_percent(there)}" if there > _MORE * here else ""
    note = f"is around a part, {_percent(here)} of what can be seen: the rest of it stays where it is{more}"
    return UpAxis(up, note=note, likelier=there > _FAR_MORE * here)


def other_standing(cage: ClosedMesh, scene_object: object) -> str:
    """The note of a cage that would hold more of its object with another axis up, or ""."""
    found = [standing_of_rest(cage, up, scene_object, given=True) for up in UPS]
    return next((each.note for each in found if each.doubtful), "")


def standing_of_pose(cage: ClosedMesh, up: str, rest: ClosedMesh, *, given: bool = False) -> UpAxis:
    """How a posed cage, turned from the axis `up` to z, stands by its rest cage; as expected where they do not match.
    An axis that the user gave is kept, whatever the pose looks like."""
    other = _other(up)
    here, there = (_pose_of(rest, each) for each in (cage, restood(cage, up, other)))
    if here is None or there is None:
        return UpAxis(up)
    nearer = there.distance <= _NEARER * here.distance
    on_its_side = nearer and there.turn <= _LEVEL and here.turn >= _ON_ITS_SIDE
    if there.similar:  # a turn of everything would look the same
        sure = False
    else:
        sure = on_its_side or (there.still >= 0.05 and there.still_count >= 3 and there.still > 4.0 * here.still)
    if sure and not given:
        return UpAxis(other, turned=True, note=f"has {other} up, and is turned to its rest cage")
    if sure or nearer:
        note = f"would lie much nearer to its rest cage with another axis up: {other} instead of {up}"
        return UpAxis(up, note=note, doubtful=True)
    return UpAxis(up)


@dataclasses.dataclass(frozen=True)
class _Pose:
    """A pose beside its rest cage."""

    distance: float  # root of the mean squared distance of vertices, of the cage's size
    turn: float  # degrees by which all is turned (Kabsch 1976)
    similar: bool  # whether the pose is a similarity
    still: float  # share and number of the vertices that stay, of those that another axis would move
    still_count: int


def _pose_of(rest: ClosedMesh, cage: ClosedMesh) -> _Pose | None:
    try:
        posed = matched_vertices(rest, cage)
    except ValueError:
        return None
    used = rest.topology.used_vertices
    before, after, size = rest.vertices[used], posed[used], max(rest.size, 1e-300)
    moved = np.linalg.norm(after - before, axis=1) / size
    decisive = np.linalg.norm(turned_up(before, "y", "z") - before, axis=1) > 10.0 * _STAYS * size
    still = int(np.count_nonzero(moved[decisive] <= _STAYS))
    rotation, residual = _similarity(before, after)
    cosine = np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0)
    return _Pose(
        distance=float(np.sqrt(np.mean(moved**2))),
        turn=float(np.degrees(np.arccos(cosine))),
        similar=residual <= _SIMILAR * size,
        still=still / max(1, int(np.count_nonzero(decisive))),
        still_count=still,
    )


def _similarity(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation (3, 3) that takes points (n, 3) nearest to others, and what a similarity leaves (Umeyama 1991)."""
    one, two = before - before.mean(axis=0), after - after.mean(axis=0)
    left, values, right = np.linalg.svd(two.T @ one)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0])
    rotation = (left * signs) @ right
    scale = float((values * signs).sum() / max((one**2).sum(), 1e-300))
    return rotation, float(np.sqrt(np.mean(((two - scale * one @ rotation.T) ** 2).sum(axis=1))))


def _other(up: str) -> str:
    return next(each for each in UPS if each != up)


def restood(cage: Mesh, was: str, up: str) -> Mesh:
    """A cage, z up, that was read with the axis `was` up ("y" or "z"), as it is read with `up`."""
    return cage if was == up else cage.with_vertices(turned_up(cage.vertices, up, was))


def object_points(scene_object: Any, count: int) -> np.ndarray:
    """(n, 3) at most `count` points of a field, a selection or a mesh, world units."""
    # splats of whole places reach so far that the cells of a grid over all of them are larger than the object
    vertices = getattr(scene_object, "vertices", getattr(scene_object, "shown_points", None))
    if vertices is None:
        from ..select.selection import some_visible_nodes

        return some_visible_nodes(scene_object, count)
    points = np.asarray(vertices, dtype=np.float64)
    chosen = np.random.default_rng(0).permutation(len(points))[:count]
    return points[np.sort(chosen)]


def _share_inside(cage: ClosedMesh, points: np.ndarray) -> float:
    return float(np.mean(inside_mesh(points, cage)))


def _unevenness(cage: ClosedMesh, points: np.ndarray) -> float:
    """How much the room between a cage's box and that of its object differs from side to side, of the object's size."""
    low, high = points.min(axis=0), points.max(axis=0)
    room = np.concatenate([low - cage.bounds[0], cage.bounds[1] - high])
    return float(np.ptp(room) / max(float((high - low).max()), 1e-300))


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _span(low: np.ndarray, high: np.ndarray) -> str:
    return f"{low.round(3).tolist()} to {high.round(3).tolist()}"
