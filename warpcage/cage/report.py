"""What `Cage.check` found, as numbers, as JSON and as a table that says what to do."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

#: Lattice cells along the longest side for which the expected cost of a pose is counted.
COST_RESOLUTION = 128


@dataclasses.dataclass(frozen=True)
class PoseReport:
    """What a pose does to the inside of its cage, from samples of the map posed -> rest by mean value coordinates."""

    sample_count: int
    # of the posed cage over that of the rest cage
    volume_ratio: float
    # of the samples, where the map turns space inside out
    inverted_share: float
    # of the samples that are mapped out of the rest cage, where nothing is drawn
    outside_share: float
    # length in the pose over length at rest, over all directions and samples not inverted
    least_stretch: float
    largest_stretch: float
    # pairs of faces of the posed cage that cross: the pose folds there
    intersecting_faces: tuple
    # why the posed cage cannot be used; empty where it can
    problem: str

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
        inward_parts: Parts that look inward.
        intersecting_faces: Pairs of faces that cross.
        unused_vertices: Vertices of no face.
        mesh_enclosed: Share of the mesh's vertices inside; None without a mesh.
        field_enclosed: Share of the field's visible voxels inside; None without a field.
        leaking_faces: (face, count) of the faces nearest to what lies outside, the leakiest first.
        hull_ratio: Volume over that of the convex hull of what should be enclosed; None where there is nothing.
        lattice_nodes: Nodes of a lattice of 128 cells along the longest side.
        standing: What speaks for another axis up in the cage's file, or that the cage holds nothing; empty where
            nothing does.
        notes: What a selection left out of the field.
        problem: Why the cage cannot be used; empty where it can.
        pose: What a pose does; None without a pose.
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
    leaking_faces: tuple
    hull_ratio: float | None
    lattice_nodes: int
    standing: str
    notes: tuple
    problem: str
    pose: PoseReport | None = None

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
            offender_row("pinched vertices", self.pinched_vertices, "duplicate the vertex, one for each fan of faces"),
            offender_row("clashing edges", self.clashing_edges, "flip faces until all look outward"),
            offender_row("inward parts", self.inward_parts, "flip all faces of the part"),
            offender_row("faces without area", self.degenerate_faces, "remove the face or move its vertices apart"),
            offender_row("vertices at the same place", self.coincident_vertices, "merge them or move them apart"),
            offender_row("intersecting faces", self.intersecting_faces, "move vertices apart: the picture tears there"),
            offender_row("unused vertices", self.unused_vertices, "harmless: kept so that poses match one to one"),
        ]
        for what, share in (("mesh vertices", self.mesh_enclosed), ("visible matter", self.field_enclosed)):
            if share is not None:
                advice = "" if share == 1.0 else "move the cage outward there: what is outside does not follow"
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
        rows.append(("usable", usable, f"the cage {problem}" if problem else ""))
        widths = [max(len(row[k]) for row in rows) for k in range(2)]
        return "\n".join(f"{a:<{widths[0]}}  {b:<{widths[1]}}  {c}".rstrip() for a, b, c in rows)


def _plain_fields(report: PoseReport | CageReport) -> dict[str, Any]:
    return {entry.name: _plain(getattr(report, entry.name)) for entry in dataclasses.fields(report)}


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return [_plain(each) for each in value] if isinstance(value, tuple) else value


def offender_row(what: str, offenders: tuple, advice: str) -> tuple[str, str, str]:
    """A row of the table: what the offenders are, how many, and the advice with the first three."""
    if not offenders:
        return what, "none", ""
    shown = ", ".join(str(each) for each in offenders[:3]) + (", ..." if len(offenders) > 3 else "")
    return what, str(len(offenders)), f"{advice}: {shown}"
