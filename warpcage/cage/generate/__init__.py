"""Cages made around an object: counts and margins, simplification, the plane that the object stands on."""

from __future__ import annotations

import dataclasses
import functools
import logging
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ...core.checks import checked_number, checked_whole
from ...core.names import checked_choice
from ...core.reports import Progress, report_progress
from ...core.threads import cpu_threads
from ...errors import InputError
from ...field.surface import require_field
from ...mesh.mesh import ClosedMesh
from ...mesh.queries import crossing_faces, inside_mesh
from ...mesh.validity import first_problem, require_usable
from ...select.planes import Plane
from ...select.selection import visible_nodes
from .decimate import Sizing, progressive_hull, relative_sizes
from .distance import ObjectShell, ObjectVoxels, bounds_of, one_a_cell
from .fit import cleared, face_samples, row_sums
from .focus import focused
from .mirror import nearest_mirror, reflected
from .parts import symmetric_sizing
from .quads import cut_across, quad_cage
from .shell import NOT_CLEAR, decimated, flaw, shell_cage, strays
from .voxel import voxel_cage

_log = logging.getLogger(__name__)

#: Rounds in which the rim on the plane is widened until it holds the object, and how far in each, in voxels.
_ROUNDS, _STEP = 24, 0.25

#: Objects are looked at up to this height above the plane, in mean edges of the cage: there its faces have moved.
_LOOKED_AT = 2.0


def ended_at(floor: Plane, cage: ClosedMesh, points: np.ndarray, spacing: float) -> np.ndarray:
    """Vertices (v, 3), world units, of a usable cage that ends at a plane; the object's points (n, 3), above it, stay
    inside. `spacing`: side of a voxel of the cage's making, world units."""
    # What lies below moves up to the plane: at the rim to where the cage passed through it, which keeps its section,
    # and straight up within. Where faces then leave some of the object out, the rim is widened along the plane.
    vertices, heights = cage.vertices, floor.heights(cage.vertices)
    below = heights < 0.0
    if not below.any():
        return vertices
    if below.all():
        raise InputError("all of it lies below the plane that the object stands on")
    ends = cage.edges[below[cage.edges[:, 0]] != below[cage.edges[:, 1]]]
    low, high = np.where(below[ends[:, 0], None], ends, ends[:, ::-1]).T
    share = heights[high] / (heights[high] - heights[low])
    passed = vertices[high] + share[:, None] * (vertices[low] - vertices[high])
    count = np.bincount(low, minlength=len(vertices))
    rim = count > 0
    moved = vertices - np.where(below, heights, 0.0)[:, None] * floor.normal
    moved[rim] = (row_sums([low], [passed], len(vertices)) / np.maximum(count, 1)[:, None])[rim]

    # what is near the plane must stay inside: elsewhere no face has moved
    edge = float(np.linalg.norm(np.diff(vertices[cage.edges], axis=1), axis=2).mean())
    near = points[floor.heights(points) < _LOOKED_AT * edge]
    outward = _sideways_normals(cage, floor.normal)
    for _ in range(_ROUNDS):
        now = cage.with_vertices(moved)
        trouble = first_problem(now)
        if trouble or len(crossing_faces(now)):
            raise InputError(f"cut at the plane below the object it {trouble or 'passes through itself'}")
        left = near[~inside_mesh(near, now, device="cpu")]
        if not len(left):
            return moved
        # the vertices of the rim that are nearest to what is left out, and their neighbours a little
        rows = np.flatnonzero(rim)
        distance = np.linalg.norm(moved[rows][:, None] - left[None, :2000], axis=2)
        pushed = np.exp(-0.5 * ((distance.min(axis=1) - distance.min()) / edge) ** 2)
        moved = moved.copy()
        moved[rows] += _STEP * spacing * pushed[:, None] * outward[rows]
    raise InputError("cut at the plane below the object it leaves some of the object out")


def _sideways_normals(cage: ClosedMesh, normal: np.ndarray) -> np.ndarray:
    """(v, 3) directions out of a cage along a plane, 0 where a vertex looks straight up or down."""
    local = cage.vertices - cage.bounds.mean(axis=0)
    a, b, c = (local[cage.faces[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    total = row_sums(list(cage.faces.T), [faces] * 3, len(cage.vertices))
    total = total - (total @ normal)[:, None] * normal
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0.0, length, 1.0)


_MIN_COUNT, _MAX_COUNT = 8, 2000

#: Times more rows than points in a row of a face that is narrow; spacings that points of a row are apart there.
_NARROW, _ACROSS = 16, 0.15

#: Where the vertices of a cage lie: evenly, or as the parts of the object need them.
DETAILS = ("even", "parts")


def voxel_spacing(extent, vertex_count) -> float:
    """Side of a voxel: about 64^3 of them in the box, more for cages of many vertices, at most 160 along a side."""
    size = extent.max()
    finer = np.clip(vertex_count / 200.0, 1.0, 4.0) ** (1.0 / 3.0)
    filled = np.prod(np.maximum(extent, size / 160.0)) ** (1.0 / 3.0) / 64.0
    return float(max(filled, size / 160.0) / finer)


def surface_points(vertices, faces, spacing) -> np.ndarray:
    """Points on faces, so that none of a face is farther off them than spacing / sqrt(3): a regular grid on each, its
    corners left out, or rows of few points across narrow ones."""
    corners = vertices[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)  # the one of k ends at corner k
    pieces = np.maximum(np.ceil(sides.max(axis=1) / spacing).astype(np.int64), 1)
    # along a narrow face half a piece is off a row at most, across it half of the rest of 0.577
    across = np.ceil(sides.min(axis=1) / (_ACROSS * spacing)).astype(np.int64)
    narrow, found = _NARROW * (across + 1) < pieces, []
    for count, cuts in np.unique(np.stack([pieces, across], axis=1)[narrow], axis=0).tolist():
        chosen = np.flatnonzero(narrow & (pieces == count) & (across == cuts))
        found.append(_row_points(corners[chosen], sides[chosen].argmin(axis=1), count, cuts))
    pieces[narrow] = 1
    for count in np.unique(pieces[pieces > 1]):
        samples, weights = face_samples(vertices, faces[pieces == count], int(count))
        found.append(samples[:, weights.max(axis=1) < 1.0].reshape(-1, 3))
    return np.concatenate(found) if found else np.zeros((0, 3))


def _row_points(corners, short, pieces: int, across: int) -> np.ndarray:
    """Points of faces (f, 3, 3) in rows along the shortest side of each, which ends at corner short (f,): so many rows
    from the corner across on, each cut in so many pieces."""
    top, begin, end = np.moveaxis(np.take_along_axis(corners, ((short[:, None] + [1, 2, 0]) % 3)[:, :, None], 1), 1, 0)
    rows = begin[:, None] + np.linspace(0.0, 1.0, across + 1)[:, None] * (end - begin)[:, None]
    along = (np.arange(1, pieces + 1) / pieces)[:, None, None]
    return (top[:, None, None] + along * (rows - top[:, None])[:, None]).reshape(-1, 3)


def checked_count(vertex_count, name: str = "vertex_count") -> int:
    return checked_whole(vertex_count, name, _MIN_COUNT, _MAX_COUNT)


#: Points of a mesh that are all looked at; of more, one in each cell of a tenth of a voxel.
_MAX_POINTS = 1_000_000


#: Mean length of edges in a focus over that of others up to which it has an effect.
_SHORTER = 0.9

#: Voxels that a margin may always have, however small the object.
_SMALL_MARGIN = 16.0


@dataclasses.dataclass(frozen=True)
class _CageOptions:
    """How a cage is made; see `Cage.from_mesh`. sizing: relative lengths of edges in world units, or None."""

    method: str
    symmetry: str | None
    detail: str
    sizing: Sizing
    faces: str


def cage_around_mesh(
    mesh,
    vertex_count: int = 100,
    *,
    margin: float | None = None,
    method: str = "auto",
    symmetry: str | None = None,
    detail: str = "even",
    sizing: Sizing = None,
    focus=None,
    finer: float = 2.0,
    faces: str = "triangles",
    progress: bool | Progress = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a cage of about `vertex_count` vertices around a mesh; see `Cage.from_mesh`.
    `margin`: least distance between cage and mesh, world units; None takes 1 % of the mesh's size."""
    # vertices lie within 1.75 (margin + slack) + 1.5 sqrt(area / count) of it, where any attempt keeps to that
    vertex_count = checked_count(vertex_count)
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        raise InputError(f"a mesh must have vertices and faces, as a trimesh.Trimesh, got {type(mesh).__name__}")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    triangles = np.asarray(mesh.faces, dtype=np.int64)
    if not len(vertices) or not len(triangles):
        raise InputError(f"the mesh is empty: it has {len(vertices)} vertices and {len(triangles)} faces")
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise InputError(f"the mesh is not finite: vertex {row} is {vertices[row].tolist()}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"the mesh's faces must be (f, 3) indices from 0 to {len(vertices) - 1}")
    lower, upper = bounds_of(vertices)
    size = (upper - lower).max()
    if size == 0.0:
        raise InputError("the mesh has no extent: all its vertices are in one place")
    margin = _checked_margin(margin, 0.01 * size, size, "the mesh's size")
    spacing = voxel_spacing(upper - lower, vertex_count)
    points = np.concatenate([vertices, surface_points(vertices, triangles, 0.5 * spacing)])
    sizing = sizing or focused(focus, finer, size, points)
    slack = 0.29 * spacing  # any point of a face lies within 0.5 / sqrt(3) spacings of the points on it
    if len(points) > _MAX_POINTS:  # long, narrow faces: a point stands for those less than a diagonal away
        one = one_a_cell(points, 0.1 * spacing)
        points, slack = points[one], slack + np.sqrt(3.0) * 0.1 * spacing
    options = _CageOptions(method, symmetry, detail, sizing, faces)
    return _cage_around_points(points, spacing, slack, margin, vertex_count, options, progress)


def cage_around_field(
    field,
    vertex_count: int = 100,
    *,
    margin: float | None = None,
    threshold: float | None = None,
    method: str = "auto",
    symmetry: str | None = None,
    detail: str = "even",
    sizing: Sizing = None,
    focus=None,
    finer: float = 2.0,
    faces: str = "triangles",
    progress: bool | Progress = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a cage of `vertex_count` vertices (within 10 %) around what a field shows.
    `margin`: least distance to the visible voxels (boxes of a voxel's size around nodes), in voxels; None takes 1."""
    vertex_count = checked_count(vertex_count)
    require_field(field)
    voxel_size = np.broadcast_to(np.asarray(field.voxel_size, dtype=np.float64), 3)
    points = visible_nodes(field, threshold)
    if not len(points):
        raise InputError("the field shows nothing to put a cage around: lower the threshold")
    lower, upper = bounds_of(points)
    extent = np.maximum(upper - lower, voxel_size)
    most = max(float((extent / voxel_size).max()), _SMALL_MARGIN)
    # 1: where trilinear values end
    margin = _checked_margin(margin, 1.0, most, "the object's size in voxels") * voxel_size.max()
    sizing = sizing or focused(focus, finer, float(extent.max()), points)
    # a grid no finer than the field's, or its empty lines between nodes would count as gaps
    spacing = max(voxel_spacing(extent, vertex_count), voxel_size.max())
    corner = 0.5 * float(np.linalg.norm(voxel_size))
    floor = getattr(field, "floor", None)  # nodes lie above it: the cage ends there, without what they stand on
    return _cage_around_points(
        points,
        spacing,
        corner,
        margin,
        vertex_count,
        _CageOptions(method, symmetry, detail, sizing, faces),
        progress,
        floor,
    )


def _checked_margin(margin: float | None, default: float, most: float, what: str) -> float:
    """A margin, which is at most as large as the object."""
    value = checked_number(default if margin is None else margin, "margin", 0.0)
    if value > most:
        raise InputError(f"margin must be at most {what}, {most:.6g}, got {value:g}")
    return value


def _cage_around_points(
    points, spacing, slack, margin, vertex_count, options: _CageOptions, progress, floor: Plane | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The tightest cage of the methods asked for; slack: how far the object may lie off its points; floor: where it
    ends."""
    method, symmetry, detail, sizing = options.method, options.symmetry, options.detail, options.sizing
    makers = {"shell": functools.partial(shell_cage, detail=detail), "voxel": voxel_cage}
    checked_choice(method, "method", ("auto", *makers))
    checked_choice(detail, "detail", DETAILS)
    checked_choice(options.faces, "faces", ("triangles", "quads"))
    if symmetry not in (None, "x", "y", "z", "auto"):
        raise InputError(
            f"symmetry must be 'x', 'y' or 'z', the normal of the mirror plane, 'auto' or None, got {symmetry!r}"
        )
    if symmetry == "auto":
        symmetry = nearest_mirror(points, spacing)
        _log.info("symmetric about %s", symmetry or "no plane across an axis")
    if sizing and method == "voxel":
        raise InputError("a focus needs method 'shell' (or 'auto', which takes it then): voxels are even")
    if detail == "parts" and method == "voxel":
        raise InputError("detail 'parts' needs method 'shell' (or 'auto', which takes it then)")
    if method == "auto" and (detail == "parts" or sizing):
        method = "shell"  # voxels are even
    if method != "auto":
        makers = {method: makers[method]}
    # in units of the object, about its middle, without the last digits: neither scale nor place may decide a tie
    lower, upper = bounds_of(points)
    middle, size = 0.5 * (lower + upper), float((upper - lower).max()) or spacing
    points = np.round((points - middle) / size, 9)
    spacing, slack, margin = (float(np.round(length / size, 9)) for length in (spacing, slack + 2e-9 * size, margin))
    relative: Sizing = None if sizing is None else lambda x: sizing(middle + size * x)
    along = "xyz".index(symmetry) if symmetry else 0
    plane = (along, float(bounds_of(points)[:, along].mean())) if symmetry else None
    relative = symmetric_sizing(relative, plane) if plane else relative
    enclosed = np.concatenate([points, reflected(points, *plane)]) if plane else points
    voxels, names, strayed = ObjectVoxels(enclosed, spacing, slack + margin), list(makers), {}

    def placed(cage: ClosedMesh) -> ClosedMesh:
        """A cage in world units, which ends where the object stands."""
        cage = cage.with_vertices(middle + size * cage.vertices)
        if floor is None:
            return cage
        cage = cut_across(cage, floor.heights(cage.vertices) < 0.0)  # patches at the rim would bend as it moves
        return cage.with_vertices(ended_at(floor, cage, middle + size * points, size * spacing))

    def made(name: str, progress: bool | Progress) -> tuple[ClosedMesh, ClosedMesh] | str:
        """The cage of a method in units of the object and of the world, or why there is none."""
        try:
            cage = makers[name](voxels, vertex_count, plane, progress, relative)
            strayed[name], there = strays(voxels, cage, relative), placed(cage)
        except ValueError as error:
            _log.info("%s: none (%s)", name, error)
            return f"{name}: {error}"
        _log.info("%s: %d vertices, volume %.4g", name, len(there.vertices), there.volume)
        return cage, there

    _log.info("%s: %d points, to be enclosed by %d vertices", " and ".join(names), len(points), vertex_count)
    report_progress(progress, 0, len(names), f"cage: {names[0]}")
    if len(names) == 1 or cpu_threads() == 1:
        results = [made(name, progress) for name in names]
    else:  # each leaves a core to the other for most of its time; reports come from the caller's thread
        with ThreadPoolExecutor(len(names) - 1) as others:
            later = [others.submit(made, name, False) for name in names[1:]]
            results = [made(names[0], progress), *(each.result() for each in later)]
    found = {name: cage for name, cage in zip(names, results, strict=True) if not isinstance(cage, str)}
    reasons = [reason for reason in results if isinstance(reason, str)]
    if not found:
        raise InputError(
            f"no cage of {vertex_count} vertices could be made ({'; '.join(reasons)}): ask for more "
            "vertices, a smaller margin, or begin with a box"
        )
    own, best = found[min(found, key=lambda name: (strayed[name], found[name][1].volume))]
    if options.faces == "quads":
        try:
            best = placed(quad_cage(voxels, own, plane))
        except ValueError as error:
            _log.info("quads: none (%s)", error)
        if best.polygon_faces is None:
            warnings.warn("no quads around this object hold: the cage has triangles", stacklevel=2)
    if sizing and detail == "even":
        warn_unrefined(best, sizing)
    return best.vertices, best.face_array


def warn_unrefined(cage: ClosedMesh, sizing: Sizing) -> None:
    """One line where the edges of a cage are no shorter where a sizing asks for that."""
    ends = cage.vertices[cage.edges]
    lengths, asked = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), relative_sizes(sizing, ends.mean(axis=1))
    fine = asked <= np.sqrt(asked.min() * asked.max())
    if not fine.all() and lengths[fine].mean() > _SHORTER * lengths[~fine].mean():
        count = len(cage.vertices)
        warnings.warn(
            f"the focus has no effect at {count} vertices, edges there are as long as elsewhere: ask for about "
            f"{2 * count} vertices, or for less with finer",
            stacklevel=2,
        )


def simplified_cage(vertices, faces, points, spacing, need, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """A cage decimated outward, or else plainly, then moved off points (p, 3) where faces come nearer than `need`."""
    voxels, reasons = ObjectVoxels(points, spacing, need), []
    for decimate, closing in ((progressive_hull, 0.0), *((decimated, each) for each in (0.05, 0.1, 0.2, 0.4))):
        reach = need + max(2.0 * spacing, closing * voxels.size)
        shell = ObjectShell(voxels, reach)
        found, triangles = decimate(vertices, faces, vertex_count)
        if abs(len(found) - vertex_count) > 0.1 * vertex_count:
            reasons.append(f"decimation left {len(found)} vertices")
            continue
        found, clear = cleared(shell, found, triangles, need)
        reason = flaw(shell, found, triangles) if clear else NOT_CLEAR
        if not reason:
            return found, triangles
        reasons.append(reason)
    raise InputError(f"no cage of {vertex_count} vertices encloses the same ({reasons[-1]}): ask for more vertices")


def simplified(
    cage: ClosedMesh, vertex_count: int, *, field=None, mesh=None, margin: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3), about `vertex_count` (within a tenth), and faces (f, 3) that enclose a field's visible voxels
    and a mesh, or else the cage itself, from `margin` world units off."""
    require_usable(cage, "the cage")
    vertex_count = checked_count(vertex_count)
    if vertex_count >= len(cage.vertices):
        raise InputError(f"the cage has {len(cage.vertices)} vertices already: ask for fewer, got {vertex_count}")
    margin = checked_number(margin, "margin", 0.0)
    scene_object = cage if mesh is None and field is None else mesh
    spacing, slack, points = cage.size / 96.0, 0.0, []
    if scene_object is not None:
        vertices, faces = (
            np.asarray(scene_object.vertices, dtype=np.float64),
            np.asarray(scene_object.faces, dtype=np.int64),
        )
        points += [vertices, surface_points(vertices, faces, 0.5 * spacing)]
        slack = 0.29 * spacing  # how far a face may lie off the points on it
    if field is not None:
        points.append(visible_nodes(field))
        spacing = max(spacing, float(np.max(field.voxel_size)))
        slack = max(slack, 0.5 * float(np.linalg.norm(np.broadcast_to(field.voxel_size, 3))))
    if not any(map(len, points)):
        raise InputError("there is nothing to enclose: the object is empty")
    # part by part: the first, of few vertices, finds most objects that are not enclosed
    if scene_object is not cage and not all(inside_mesh(part, cage).all() for part in points):
        raise InputError("the cage does not enclose the object even before: check(field=...) says where")
    return simplified_cage(cage.vertices, cage.faces, np.concatenate(points), spacing, slack + margin, vertex_count)
