"""All that is wrong with a cage, what it encloses and what a pose does: a CageReport, as JSON and a table."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..mesh.match import matched_vertices
from ..mesh.mesh import ClosedMesh, TriangleMesh, require_mesh
from ..mesh.patches import face_middles
from ..mesh.queries import crossing_faces, inside_mesh
from ..mesh.validity import coincident_vertices, degenerate_faces, first_problem, inward_parts
from ..select.selection import NodeSelection, visible_nodes
from ..splats.splat_field import SplatField
from .up_axis import other_standing

#: Lattice cells along the longest side for which the expected cost of a pose is counted.
COST_RESOLUTION = 128


@dataclasses.dataclass(frozen=True)
class PoseReport:
    """What a pose does to the inside of its cage, from samples of the map posed -> rest by mean value coordinates."""

    sample_count: int
    volume_ratio: float  # of the posed cage over that of the rest cage
    inverted_share: float  # of the samples, where the map turns space inside out
    outside_share: float  # of the samples that are mapped out of the rest cage, where nothing is drawn
    least_stretch: float  # length in the pose over length at rest, over all directions and samples not inverted
    largest_stretch: float
    intersecting_faces: tuple[tuple[int, int], ...]  # pairs of faces of the posed cage that cross: the pose folds there
    problem: str  # why the posed cage cannot be used; empty where it can

    @property
    def usable(self) -> bool:
        """Whether the posed cage can be used at all. Folds and inverted parts are drawn as they are."""
        return not self.problem

    def rows(self) -> list[tuple[str, str, str]]:
        """The rows of the table: what was measured, its value, and advice or nothing."""
        inverted = "bring the vertices there apart: colours would show through" if self.inverted_share else ""
        outside = "move the cage less there: nothing is shown" if self.outside_share > 0.01 else ""
        strong = self.least_stretch < 0.25 or self.largest_stretch > 4.0
        stretch = "strong: expect blur where it is large, aliasing where it is small" if strong else ""
        return [
            ("pose: volume", f"{100 * self.volume_ratio:.1f} % of rest", ""),
            ("pose: turned inside out", f"{100 * self.inverted_share:.2f} %", inverted),
            ("pose: has nothing to show", f"{100 * self.outside_share:.2f} %", outside),
            ("pose: stretch", f"{self.least_stretch:.3g} to {self.largest_stretch:.3g}", stretch),
            offender_row("pose: faces that cross", self.intersecting_faces, "move vertices apart"),
            ("pose: usable", "yes" if self.usable else "no", f"the posed cage {self.problem}" if self.problem else ""),
        ]


@dataclasses.dataclass(frozen=True)
class CageReport:
    """What `Cage.check` found. `str(report)` is a table that says what to do about each problem.

    Attributes:
        vertex_count: Number of vertices.
        face_count: Number of faces.
        part_count: Number of connected parts.
        genus: Number of handles over all parts; None unless the cage is closed and manifold.
        volume: Enclosed volume, world units cubed.
        size: Longest side of the bounding box, world units.
        convexity: Volume over that of the cage's convex hull.
        open_edges: Edges of one face only, as pairs of vertices.
        crowded_edges: Edges of three or more faces.
        pinched_vertices: Vertices whose faces form more than one fan.
        clashing_edges: Edges whose two faces are wound against each other.
        degenerate_faces: Faces without area.
        coincident_vertices: Pairs of vertices at the same place.
        inward_parts: Parts that look inward, or are flat.
        intersecting_faces: Pairs of faces that cross; a face with more than three corners that folds over itself is a
            pair with itself.
        unused_vertices: Vertices of no face.
        mesh_enclosed: Share of the mesh's vertices inside; None without a mesh.
        field_enclosed: Share of the field's visible voxels inside; None without a field.
        leaking_faces: (face, count) of the faces nearest to what lies outside, the leakiest first.
        hull_ratio: Volume over that of the convex hull of what should be enclosed; None where there is nothing.
        lattice_nodes: Nodes of a lattice of 128 cells along the longest side.
        standing: Why another axis may be up in the cage's file, or that the cage holds nothing; empty otherwise.
        notes: What a selection left out of the field.
        problem: Why the cage cannot be used; empty where it can.
        pose: What a pose does; None without a pose.
        concave_faces: Faces of four and more corners that are cut into triangles, as a patch between the corners would
            fold over.
        planarity: The farthest that a corner of a face lies from the plane that fits it best, over the face's size; 0
            where all are triangles.
    """

    vertex_count: int
    face_count: int
    part_count: int
    genus: int | None
    volume: float
    size: float
    convexity: float
    open_edges: tuple[tuple[int, int], ...]
    crowded_edges: tuple[tuple[int, int], ...]
    pinched_vertices: tuple[int, ...]
    clashing_edges: tuple[tuple[int, int], ...]
    degenerate_faces: tuple[int, ...]
    coincident_vertices: tuple[tuple[int, int], ...]
    inward_parts: tuple[int, ...]
    intersecting_faces: tuple[tuple[int, int], ...]
    unused_vertices: tuple[int, ...]
    mesh_enclosed: float | None
    field_enclosed: float | None
    leaking_faces: tuple[tuple[int, int], ...]
    hull_ratio: float | None
    lattice_nodes: int
    standing: str
    notes: tuple[str, ...]
    problem: str
    pose: PoseReport | None = None
    concave_faces: tuple[int, ...] = ()
    planarity: float = 0.0

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
        """Whether coordinates can be computed on the cage (`Cage.require_usable`), and on its pose if one is given."""
        return not self.problem and (self.pose is None or self.pose.usable)

    @property
    def cost(self) -> dict[str, int]:
        """What a pose costs on a lattice of 128 cells.

        Its nodes, those inside, bytes of the map (a position and a distance per node), bytes of stored weights, and
        face terms of a closed form (mean value, green) at the nodes inside.
        """
        inside = round(max(self.volume, 0.0) * (COST_RESOLUTION / self.size) ** 3) if self.size else 0
        return {
            "resolution": COST_RESOLUTION, "nodes": self.lattice_nodes, "inside_nodes": inside,
            "map_bytes": 16 * self.lattice_nodes, "weight_bytes": 4 * self.vertex_count * inside,
            "face_terms": self.face_count * inside,
        }  # fmt: skip

    def _polygon_rows(self) -> list[tuple[str, str, str]]:
        """What is said of faces of more than three corners, where there are any."""
        rows = [("faces off their plane", f"by {100 * self.planarity:.1f} % of their size at most", "")]
        rows = rows if self.planarity > 0.001 else []
        if self.concave_faces:
            advice = "cut into triangles, whose diagonals show: make them convex"
            rows.append(offender_row("concave faces", self.concave_faces, advice))
        return rows

    def as_dict(self) -> dict[str, Any]:
        """The whole report for JSON.

        Returns:
            All attributes and properties by name, as plain numbers, strings and lists.
        """
        plain = _plain_fields(self)
        plain["pose"] = None if self.pose is None else _plain_fields(self.pose) | {"usable": self.pose.usable}
        return plain | {name: getattr(self, name) for name in ("closed", "manifold", "oriented", "usable", "cost")}

    def __str__(self) -> str:
        genus = "not defined" if self.genus is None else self.genus
        rows = [
            ("vertices, faces", f"{self.vertex_count}, {self.face_count}", ""),
            ("separate parts, holes through them", f"{self.part_count}, {genus}", ""),
            ("size, volume", f"{self.size:.6g}, {self.volume:.6g}", ""),
            ("share of its convex hull", f"{100 * self.convexity:.1f} %", ""),
            offender_row("open edges", self.open_edges, "fill the holes: every edge needs two faces"),
            offender_row("edges of three or more faces", self.crowded_edges, "delete inner faces or split the edge"),
            offender_row("corners touching at a point", self.pinched_vertices, "one vertex for each fan of faces"),
            offender_row("faces facing opposite ways", self.clashing_edges, "flip faces until all look outward"),
            offender_row("inside out", self.inward_parts, "flip all faces of the part, or move its sides apart"),
            offender_row("faces without area", self.degenerate_faces, "remove the face or move its vertices apart"),
            offender_row("vertices at the same place", self.coincident_vertices, "merge them or move them apart"),
            offender_row("intersecting faces", self.intersecting_faces, "move vertices apart: the picture tears there"),
            *self._polygon_rows(),
            offender_row("unused vertices", self.unused_vertices, "harmless: kept so that poses match one to one"),
        ]
        for what, share in (("mesh vertices", self.mesh_enclosed), ("the visible object", self.field_enclosed)):
            if share is not None:
                advice = "" if share == 1.0 else f"{outside_text(share)}; move the cage outward there"
                advice = "not known before the cage is repaired" if self.problem else advice
                rows.append((f"{what} enclosed", f"{100 * share:.3f} %", advice))
        if self.hull_ratio is not None:
            rows.append(("volume over the object's convex hull", f"{self.hull_ratio:.2f}", ""))
        rows += [("stands around its object", "no", f"the cage {self.standing}")] if self.standing else []
        rows += [("selection", "", note) for note in self.notes]
        if self.leaking_faces:
            shown = ", ".join(f"{face} ({count})" for face, count in self.leaking_faces[:5])
            rows.append(("leaks nearest to faces", str(len(self.leaking_faces)), f"face (points outside): {shown}"))
        cost = self.cost
        rows.append(
            (
                "memory of a pose",
                f"{cost['map_bytes'] / 1e6:.0f} MB",
                f"at {COST_RESOLUTION} cells along the longest side (--resolution)",
            )
        )
        rows += [] if self.pose is None else self.pose.rows()
        problem = self.problem or ("" if self.pose is None else self.pose.problem)
        usable = "no" if not self.usable else "not as it stands" if self.standing else "yes"
        which = "cage" if self.problem else "posed cage"
        rows.append(("usable", usable, f"the {which} {problem}" if problem else ""))
        widths = [max(len(row[k]) for row in rows) for k in range(2)]
        return "\n".join(f"{a:<{widths[0]}}  {b:<{widths[1]}}  {c}".rstrip() for a, b, c in rows)


def _planarity(cage: ClosedMesh) -> float:
    """The farthest that a corner of a face lies from the plane that fits it best, over the face's size."""
    farthest = 0.0
    for face in () if cage.polygon_faces is None else cage.polygons:
        points = cage.vertices[list(face)]
        points = points - points.mean(axis=0)
        normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # Newell 1972
        length = np.linalg.norm(normal) * np.ptp(points, axis=0).max()
        farthest = max(farthest, float(np.abs(points @ normal).max() / length) if length > 0.0 else 0.0)
    return farthest


def _plain_fields(report: PoseReport | CageReport) -> dict[str, Any]:
    return {entry.name: _plain(getattr(report, entry.name)) for entry in dataclasses.fields(report)}


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return [_plain(each) for each in value] if isinstance(value, tuple) else value


def offender_row(what: str, offenders: tuple[Any, ...], advice: str) -> tuple[str, str, str]:
    """A row of the table: what the offenders are, how many, and the advice with the first three."""
    if not offenders:
        return what, "none", ""
    shown = ", ".join(str(each) for each in offenders[:3]) + (", ..." if len(offenders) > 3 else "")
    return what, str(len(offenders)), f"{advice}: {shown}"


def check_cage(
    cage: ClosedMesh,
    field: VoxelField | NodeSelection | SplatField | None = None,
    mesh: TriangleMesh | None = None,
    pose: ClosedMesh | None = None,
) -> CageReport:
    """Examine a cage; see `Cage.check`.
    Enclosure is defined for usable cages only: it is 0 for others, and their poses are not looked at."""
    if pose is not None:
        require_mesh(pose, "the pose must be")
    topology = cage.topology
    problem = first_problem(cage)
    mesh_points = None if mesh is None else np.asarray(mesh.vertices, dtype=np.float64)
    field_points = None if field is None else visible_nodes(field)
    objects = [points for points in (mesh_points, field_points) if points is not None]
    outside: list[np.ndarray] = []
    mesh_enclosed = _enclosed(cage, mesh_points, problem, "mesh has no vertices", outside)
    field_enclosed = _enclosed(cage, field_points, problem, "field has no visible voxels", outside)
    closed = topology.closed and topology.manifold
    return CageReport(
        vertex_count=len(cage.vertices), face_count=cage.face_count, part_count=topology.part_count,
        genus=topology.genus, volume=cage.volume, size=cage.size, convexity=_convexity(cage),
        open_edges=tuples(topology.open_edges), crowded_edges=tuples(topology.crowded_edges),
        pinched_vertices=tuples(topology.pinched_vertices), clashing_edges=tuples(topology.clashing_edges),
        degenerate_faces=tuples(degenerate_faces(cage)), coincident_vertices=tuples(coincident_vertices(cage)),
        inward_parts=tuples(inward_parts(cage)) if closed else (),
        intersecting_faces=tuples(crossing_faces(cage)), planarity=_planarity(cage),
        concave_faces=() if cage.polygon_faces is None else tuples(cage.polygon_faces.cut),
        unused_vertices=tuples(topology.unused_vertices),
        mesh_enclosed=mesh_enclosed, field_enclosed=field_enclosed,
        leaking_faces=_nearest_faces(cage, outside), hull_ratio=_hull_ratio(cage, objects),
        standing=_standing(cage, field, mesh), lattice_nodes=_lattice_nodes(cage),
        notes=tuple(getattr(field, "notes", ())), problem=problem,
        pose=None if pose is None or problem else check_pose(cage, pose),
    )  # fmt: skip


def outside_text(inside_share: float) -> str:
    """What a share of the object, below 1, in the cage means."""
    if inside_share == 0.0:
        return "Nothing visible is inside this cage: it moves nothing"
    return f"{percent_text(1.0 - inside_share)} of what is visible is outside this cage and stays where it is"


def percent_text(share: float) -> str:
    return "Less than 1 %" if share < 0.01 else f"{100 * share:.0f} %"


def _standing(cage: ClosedMesh, *objects: object) -> str:
    """The note that speaks for another axis up, by the first object that has one."""
    notes = [other_standing(cage, scene_object) for scene_object in objects if scene_object is not None]
    return next((note for note in notes if note), "")


def _enclosed(
    cage: ClosedMesh, points: np.ndarray | None, problem: str, complaint: str, outside: list[np.ndarray]
) -> float | None:
    """Share of points inside, None without points; those outside are added to a list."""
    if points is None:
        return None
    if not len(points):
        raise InputError(complaint)
    if problem:
        return 0.0
    inside = inside_mesh(points, cage)
    outside.append(points[~inside])
    return float(np.mean(inside))


def _nearest_faces(cage: ClosedMesh, outside: list[np.ndarray], most: int = 500) -> tuple[tuple[int, int], ...]:
    """(face, count) by the centre nearest to each point outside, the most frequent first.
    Of more than `most` points it takes every second, third, ..."""
    points = np.concatenate(outside) if outside else np.zeros((0, 3))
    if not len(points):
        return ()
    points = points[:: -(-len(points) // most)]
    centers = face_middles(cage)
    nearest = np.argmin(((points[:, None] - centers[None]) ** 2).sum(axis=2), axis=1)
    faces, counts = np.unique(nearest, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return tuples(np.stack([faces[order], counts[order]], axis=1))


def _lattice_nodes(cage: ClosedMesh) -> int:
    """Nodes of a lattice of COST_RESOLUTION cells along the longest side, with its margins; 0 for no extent."""
    if cage.size == 0.0:
        return 0
    return int(np.prod(np.ceil(np.ptp(cage.bounds, axis=0) / cage.size * COST_RESOLUTION) + 6))


def _convexity(cage: ClosedMesh) -> float:
    """Volume over that of the convex hull; 0 for a flat cage."""
    hull = _hull_volume(cage.vertices[cage.topology.used_vertices])
    return cage.volume / hull if hull > 0.0 else 0.0


def _hull_ratio(cage: ClosedMesh, objects: list[np.ndarray]) -> float | None:
    """Volume over that of the convex hull of points (n, 3); None without points, or for flat ones."""
    hull = _hull_volume(np.concatenate(objects)) if objects else 0.0
    return cage.volume / hull if hull > 0.0 else None


def _hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points (n, 3); 0 for flat ones."""
    extent = np.ptp(points, axis=0)
    if len(points) < 4 or extent.min() <= 1e-12 * extent.max():
        return 0.0
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume)
    except QhullError:  # all in one plane
        return 0.0


def tuples(array: np.ndarray) -> tuple[Any, ...]:
    """Rows of an array (n,) or (n, k) as n plain numbers or tuples."""
    return tuple(tuple(row) if isinstance(row, list) else row for row in np.asarray(array).tolist())


#: About how many samples are taken inside the posed cage.
_SAMPLES = 3000

#: Distance of the points of a finite difference, as a share of the size; float32 maps err by about 1e-6 of it.
_DIFFERENCE = 2e-3


def check_pose(rest: ClosedMesh, pose: ClosedMesh) -> PoseReport:
    """Examine a pose of a usable cage: the same mesh, in any order that `Cage.match` takes."""
    pose = rest.with_vertices(matched_vertices(rest, pose))
    problem = first_problem(pose)
    folds = tuples(crossing_faces(pose))
    ratio = pose.volume / rest.volume
    if problem:
        return PoseReport(0, ratio, 0.0, 0.0, 0.0, 0.0, folds, problem)

    count, inverted, outside, stretch = sample_pose(rest, pose)
    return PoseReport(
        sample_count=count, volume_ratio=ratio, inverted_share=inverted, outside_share=outside,
        least_stretch=stretch[0], largest_stretch=stretch[1], intersecting_faces=folds, problem=problem,
    )  # fmt: skip


def sample_pose(
    rest: ClosedMesh, pose: ClosedMesh, samples: int = _SAMPLES
) -> tuple[int, float, float, tuple[float, float]]:
    """Number of samples in the posed cage, shares of them that the map posed -> rest folds and sends out of the rest
    cage, and least and largest stretch. Shares are 0 and stretches 1 where no sample fits; both cages are usable."""
    (points, _), step = grid_points(pose, samples), _DIFFERENCE * pose.size
    points = points[inside_mesh(points, pose)]
    offsets: np.ndarray = np.concatenate([np.zeros((1, 3)), step * np.eye(3)])
    stencil = points[:, None] + offsets
    stencil = stencil[inside_mesh(stencil[:, 1:].reshape(-1, 3), pose).reshape(-1, 3).all(axis=1)]
    if not len(stencil):
        return 0, 0.0, 0.0, (1.0, 1.0)
    from ..coordinates.coordinates import deform_points  # here, as its kernels take a while to load

    mapped = deform_points(stencil.reshape(-1, 3), pose, rest, coordinates="mean_value")
    assert isinstance(mapped, np.ndarray)  # as the points are
    mapped = mapped.reshape(-1, 4, 3)
    # Forward differences; inverted where det J <= 0, else stretched by 1 / s for each singular value s of J.
    jacobian = (mapped[:, 1:] - mapped[:, :1]) / step
    inverted = np.linalg.det(jacobian) <= 0.0
    singular = np.linalg.svd(jacobian[~inverted], compute_uv=False)
    stretch = 1.0 / np.clip(singular, 1e-6, 1e6) if len(singular) else np.zeros((1, 3))
    outside = float(np.mean(~inside_mesh(mapped[:, 0], rest)))
    return len(stencil), float(inverted.mean()), outside, (float(stretch.min()), float(stretch.max()))


def grid_points(cage: ClosedMesh, samples: int) -> tuple[np.ndarray, float]:
    """Points (n, 3) of a grid over a cage's bounding box, `samples` or so inside, and their distance, world units."""
    lower, upper = cage.bounds
    spacing = (cage.volume / samples) ** (1.0 / 3.0)
    axes = [  # begun aside, off the cage's planes of symmetry
        np.arange(low + 0.37 * min(spacing, high - low), high, spacing) for low, high in zip(lower, upper, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), spacing
