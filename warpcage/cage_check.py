"""What is wrong with a cage, and what it encloses: the first problem in a line, or all of them in a CageReport."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from .cage_intersections import intersecting_faces

if TYPE_CHECKING:
    from .cage import Cage

#: A face lower than this share of the cage's size has no normal in float32.
DEGENERATE_HEIGHT = 1e-7


@dataclasses.dataclass(frozen=True)
class CageReport:
    """What `Cage.check` found. `str(report)` is a table that says what to do about each problem.

    Counts and measures of the cage, world units; the offenders themselves as tuples of indices; `enclosed` the share of
    the mesh's vertices and of the field's visible voxels that lie inside (None where none was given).
    """

    vertex_count: int
    face_count: int
    part_count: int
    genus: int | None
    volume: float
    size: float
    convexity: float
    open_edges: tuple
    crowded_edges: tuple
    pinched_vertices: tuple
    clashing_edges: tuple
    degenerate_faces: tuple
    coincident_vertices: tuple
    inward_parts: tuple
    intersecting_faces: tuple
    unused_vertices: tuple
    mesh_enclosed: float | None
    field_enclosed: float | None
    problem: str

    @property
    def closed(self) -> bool:
        """Whether no edge has a single face."""
        return not self.open_edges

    @property
    def manifold(self) -> bool:
        """Whether every edge has at most two faces and every vertex one fan of them."""
        return not self.crowded_edges and not self.pinched_vertices

    @property
    def oriented(self) -> bool:
        """Whether all faces look outward (those of a cavity into it)."""
        return not self.clashing_edges and not self.inward_parts

    @property
    def usable(self) -> bool:
        """Whether coordinates can be computed on the cage: what `Cage.require_usable` demands."""
        return not self.problem

    def as_dict(self) -> dict:
        """All entries as plain numbers, strings and lists, as JSON takes them."""
        entries = {entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self)}
        plain = {name: _plain(value) for name, value in entries.items()}
        return plain | {name: getattr(self, name) for name in ("closed", "manifold", "oriented", "usable")}

    def __str__(self) -> str:
        genus = "not defined" if self.genus is None else self.genus
        rows = [
            ("vertices, faces", f"{self.vertex_count}, {self.face_count}", ""),
            ("connected parts, handles", f"{self.part_count}, {genus}", ""),
            ("size, volume", f"{self.size:.6g}, {self.volume:.6g}", ""),
            ("volume of the convex hull filled", f"{100 * self.convexity:.1f} %", ""),
            _row("open edges", self.open_edges, "fill the holes: every edge needs two faces"),
            _row("edges of three or more faces", self.crowded_edges, "delete inner faces or split the edge"),
            _row("pinched vertices", self.pinched_vertices, "duplicate the vertex, one for each fan of faces"),
            _row("clashing edges", self.clashing_edges, "flip faces until all look outward"),
            _row("inward parts", self.inward_parts, "flip all faces of the part"),
            _row("degenerate faces", self.degenerate_faces, "remove the face or move its vertices apart"),
            _row("vertices at the same place", self.coincident_vertices, "merge them or move them apart"),
            _row("intersecting faces", self.intersecting_faces, "move vertices apart: the map folds there"),
            _row("unused vertices", self.unused_vertices, "harmless: kept so that poses match one to one"),
        ]
        for what, share in (("mesh vertices", self.mesh_enclosed), ("visible voxels", self.field_enclosed)):
            if share is not None:
                advice = "" if share == 1.0 else "move the cage outward there: what is outside does not follow"
                rows.append((f"{what} enclosed", f"{100 * share:.3f} %", advice))
        rows.append(("usable", "yes" if self.usable else "no", f"the cage {self.problem}" if self.problem else ""))
        widths = [max(len(row[k]) for row in rows) for k in range(2)]
        return "\n".join(f"{a:<{widths[0]}}  {b:<{widths[1]}}  {c}".rstrip() for a, b, c in rows)


def check_cage(cage: Cage, field=None, mesh=None) -> CageReport:
    """Examine a cage: see `Cage.check`. Raises ValueError for a mesh or a field with nothing in it.

    Enclosure is only defined for a usable cage; it is 0 otherwise.
    """
    topology = cage.topology
    problem = first_problem(cage)
    shares = {"mesh": None, "field": None}
    if mesh is not None:
        shares["mesh"] = _enclosed(cage, np.asarray(mesh.vertices, dtype=np.float64), problem, "mesh has no vertices")
    if field is not None:
        from .cage_generation import visible_nodes

        shares["field"] = _enclosed(cage, visible_nodes(field), problem, "field has no visible voxels")
    closed = topology.closed and topology.manifold
    return CageReport(
        vertex_count=len(cage.vertices), face_count=len(cage.faces), part_count=topology.part_count,
        genus=topology.genus, volume=cage.volume, size=cage.size, convexity=_convexity(cage),
        open_edges=_tuples(topology.open_edges), crowded_edges=_tuples(topology.crowded_edges),
        pinched_vertices=_tuples(topology.pinched_vertices), clashing_edges=_tuples(topology.clashing_edges),
        degenerate_faces=_tuples(degenerate_faces(cage)), coincident_vertices=_tuples(coincident_vertices(cage)),
        inward_parts=_tuples(inward_parts(cage)) if closed else (),
        intersecting_faces=_tuples(intersecting_faces(cage.vertices, cage.faces)),
        unused_vertices=_tuples(topology.unused_vertices),
        mesh_enclosed=shares["mesh"], field_enclosed=shares["field"], problem=problem,
    )  # fmt: skip


def _enclosed(cage, points, problem, complaint) -> float:
    if not len(points):
        raise ValueError(complaint)
    return 0.0 if problem else float(np.mean(cage.contains(points)))


def _convexity(cage) -> float:
    """Volume over that of the convex hull; 0 for a flat cage."""
    if cage.size == 0.0 or np.ptp(cage.bounds, axis=0).min() == 0.0:
        return 0.0
    import trimesh

    hull = trimesh.convex.convex_hull(np.concatenate(cage.corners))
    return cage.volume / hull.volume if hull.volume > 0.0 else 0.0


def _tuples(array) -> tuple:
    return tuple(tuple(row) if isinstance(row, list) else row for row in np.asarray(array).tolist())


def _plain(value):
    return [_plain(each) for each in value] if isinstance(value, tuple) else value


def _row(what: str, offenders: tuple, advice: str) -> tuple:
    if not offenders:
        return what, "none", ""
    shown = ", ".join(str(each) for each in offenders[:3]) + (", ..." if len(offenders) > 3 else "")
    return what, str(len(offenders)), f"{advice}: {shown}"


def degenerate_faces(cage: Cage) -> np.ndarray:
    """Indices of the faces whose height is below 1e-7 of the cage's size, or that name a vertex twice."""
    a, b, c = cage.corners
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.sqrt(np.maximum.reduce([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))]))
    return np.flatnonzero(double_area <= DEGENERATE_HEIGHT * cage.size * longest)


def coincident_vertices(cage: Cage) -> np.ndarray:
    """(k, 2): used vertices that are the same in float32, each with the first of its place."""
    used = np.unique(cage.faces)
    local = (cage.vertices[used] - cage.bounds.mean(axis=0)).astype(np.float32)
    _, first, place = np.unique(local + 0.0, axis=0, return_index=True, return_inverse=True)
    leader = first[place.reshape(-1)]
    extra = np.flatnonzero(leader != np.arange(len(used)))
    return np.stack([used[leader[extra]], used[extra]], axis=1)


def winding_numbers(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding number of a closed mesh about points (n, 3), float64 on the host: (n,). For a few points only.

    Sum of signed solid angles over 4 pi (van Oosterom and Strackee 1983, "The solid angle of a plane triangle").
    """
    total = np.zeros(len(points))
    for first in range(0, len(points), 4096):
        a, b, c = (vertices[faces[:, k]][None] - points[first : first + 4096, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
        triple = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        below = (la * lb * lc + np.einsum("nfi,nfi->nf", a, b) * lc + np.einsum("nfi,nfi->nf", b, c) * la
                 + np.einsum("nfi,nfi->nf", c, a) * lb)
        total[first : first + 4096] = 2.0 * np.arctan2(triple, below).sum(axis=1) / (4.0 * np.pi)
    return total


def inward_parts(cage: Cage) -> np.ndarray:
    """Indices of connected parts that look inward without being a cavity inside another part (closed cages only)."""
    volumes = cage.part_volumes()
    parts = cage.topology.parts
    wrong = []
    for part in np.flatnonzero(volumes <= 0.0):
        inside = cage.vertices[cage.faces[parts == part][:1, 0]]
        others = cage.faces[parts != part]
        if volumes[part] == 0.0 or not len(others) or winding_numbers(inside, cage.vertices, others)[0] < 0.5:
            wrong.append(part)
    return np.asarray(wrong, dtype=np.int64)


def first_problem(cage: Cage) -> str:
    """What makes the cage unusable, in one line without its name; empty for a usable cage."""
    topology = cage.topology
    if len(topology.open_edges):
        a, b = topology.open_edges[0]
        return (f"is open: {len(topology.open_edges)} edges have one face only, the first from vertex {a} to {b}: "
                "close it")
    if len(topology.crowded_edges):
        a, b = topology.crowded_edges[0]
        return (f"is not manifold: {len(topology.crowded_edges)} edges have more than two faces, the first from vertex "
                f"{a} to {b}")
    if len(topology.repeated_faces):
        return f"has degenerate faces: face {topology.repeated_faces[0]} names a vertex twice"
    if len(topology.pinched_vertices):
        return (f"is not manifold: parts of it only touch at {len(topology.pinched_vertices)} vertices, the first "
                f"{topology.pinched_vertices[0]}: split them")
    if len(topology.clashing_edges):
        a, b = topology.clashing_edges[0]
        return (f"is wound inconsistently: the two faces at {len(topology.clashing_edges)} edges clash, the first from "
                f"vertex {a} to {b}: flip faces until all are anticlockwise seen from outside")
    coincident = coincident_vertices(cage)
    if len(coincident):
        a, b = coincident[0]
        return (f"has {len(coincident)} vertices at the place of another, the first {b} at that of {a}: "
                "merge or move them")
    degenerate = degenerate_faces(cage)
    if len(degenerate):
        return f"has degenerate faces: {len(degenerate)} without area, the first {degenerate[0]}: remove or widen them"
    inward = inward_parts(cage)
    if len(inward):
        face = int(np.flatnonzero(topology.parts == inward[0])[0])
        return (f"looks inward: the part with face {face} encloses volume {cage.part_volumes()[inward[0]]:.4g}: flip "
                "its faces to be anticlockwise seen from outside")
    return ""
