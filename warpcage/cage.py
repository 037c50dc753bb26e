"""Cage: the coarse triangle mesh around an object whose vertices steer it."""

from __future__ import annotations

import numpy as np

from .arrays import as_host_points, is_device_array
from .cage_topology import CageTopology

#: Points this close to the cage, as a share of its size, count as inside.
SURFACE_TOLERANCE = 1e-5


class Cage:
    """A triangle mesh that encloses (a part of) an object; immutable.

    vertices: (v, 3) finite floats in the scene's world units, kept as float64 in the order given.
    faces: (f, 3) whole numbers, vertex indices, kept as int32; anticlockwise seen from outside.

    The constructor refuses what cannot be held (other shapes, values that are not finite, indices that point nowhere)
    with a ValueError. An open, inverted or tangled cage can be held, so that `check` can describe it; the coordinate
    functions and `Deformer` call `require_usable`, which refuses it.
    """

    __slots__ = ("_vertices", "_faces", "_topology", "_problem", "_bounds")

    def __init__(self, vertices, faces):
        self._set(_checked_vertices(vertices), None, None)
        self._faces = _checked_faces(faces, len(self._vertices))

    def _set(self, vertices, faces, topology):
        vertices.setflags(write=False)
        self._vertices, self._faces, self._topology = vertices, faces, topology
        self._problem, self._bounds = None, None

    def __repr__(self) -> str:
        return f"Cage({len(self.vertices)} vertices, {len(self.faces)} faces, size {self.size:.4g})"

    @property
    def vertices(self) -> np.ndarray:
        """(v, 3) float64, world units, read-only."""
        return self._vertices

    @property
    def faces(self) -> np.ndarray:
        """(f, 3) int32, read-only."""
        return self._faces

    @property
    def topology(self) -> CageTopology:
        """Edges, holes and connected parts; worked out once for a cage and all its poses."""
        if self._topology is None:
            self._topology = CageTopology(len(self.vertices), self.faces)
        return self._topology

    @property
    def edges(self) -> np.ndarray:
        """(e, 2) int32: every edge once, lower index first."""
        return self.topology.edges

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64: lowest and highest corner of the bounding box of the vertices that faces use; read-only."""
        if self._bounds is None:
            used = self.vertices
            if len(self.topology.unused_vertices):
                used = used[self.topology.used_vertices]
            bounds = np.empty((2, 3))
            used.min(axis=0, out=bounds[0])
            used.max(axis=0, out=bounds[1])
            bounds.setflags(write=False)
            self._bounds = bounds
        return self._bounds

    @property
    def size(self) -> float:
        """Longest side of the bounding box, world units."""
        lower, upper = self.bounds
        return float((upper - lower).max())

    @property
    def volume(self) -> float:
        """Enclosed volume, world units cubed; negative where the faces look inward, meaningless on an open cage."""
        return float(self.part_volumes().sum())

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First, second and third corner of each face, (f, 3) each, relative to the middle of the bounding box."""
        local = self.vertices - self.bounds.mean(axis=0)
        return local[self.faces[:, 0]], local[self.faces[:, 1]], local[self.faces[:, 2]]

    def part_volumes(self) -> np.ndarray:
        """(part_count,) float64: signed volume of each connected part."""
        a, b, c = self.corners
        cones = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
        return np.bincount(self.topology.parts, weights=cones, minlength=self.topology.part_count)

    def with_vertices(self, vertices) -> Cage:
        """A cage with the same faces and these vertices (v, 3). Raises ValueError for another count or NaN."""
        vertices = _checked_vertices(vertices)
        if len(vertices) != len(self.vertices):
            raise ValueError(f"with_vertices needs {len(self.vertices)} vertices as the cage has, got {len(vertices)}")
        posed = Cage.__new__(Cage)
        posed._set(vertices, self.faces, self.topology)
        return posed

    def match(self, pose: Cage) -> Cage:
        """A pose read from elsewhere as a pose of this cage: its vertices in this cage's order, with this cage's faces.

        pose: a Cage of the same mesh whose vertices or faces may come in another order, with quads cut along other
        diagonals, or with vertices repeated where faces meet. A symmetric cage can be laid over itself in several
        ways; the one that moves the vertices least is taken.
        Raises ValueError that says how they differ where no order fits, or where two fit equally well.
        """
        from .cage_match import matched_vertices

        return self.with_vertices(matched_vertices(self, pose))

    # -- Checks

    def require_usable(self, name: str = "cage") -> None:
        """Raise a ValueError of one line, beginning with `name`, unless coordinates can be computed on this cage.

        Refused: open edges, edges of more than two faces, vertices where parts merely touch, neighbours wound against
        each other, parts that look inward (a cavity inside another part may), faces without area, and used vertices
        at the same place. Self-intersections are not looked for here: see `check`.
        """
        if self._problem is None:
            from .cage_check import first_problem

            self._problem = first_problem(self)
        if self._problem:
            raise ValueError(f"{name} {self._problem}")

    def contains(self, points, device=None):
        """Whether each point is inside, by winding number; points within 1e-5 of the size of the surface are inside.

        points: (n, 3), world units. Returns (n,) bool, NumPy for NumPy input, on the device for an array of a device.
        Raises ValueError for points of another shape, NumPy points that are not finite, or an unusable cage.
        """
        from .containment import inside_cage

        return inside_cage(points, self, tolerance=SURFACE_TOLERANCE, device=device)

    def check(self, field=None, mesh=None, pose: Cage | None = None):
        """Examine the cage, what it encloses where a field or a mesh is given, and what a pose does: a CageReport.

        mesh: trimesh.Trimesh whose vertices ought to be inside. field: VoxelField whose visible voxels ought to be.
        pose: a pose of this cage, in any order that `match` takes. Raises ValueError for one that does not match.
        """
        from .cage_check import check_cage

        return check_cage(self, field=field, mesh=mesh, pose=pose)

    def repair(self, *, largest_hole: int = 12) -> tuple[Cage, tuple[str, ...]]:
        """A mended cage and a line for each thing done to it: see `warpcage.cage_repair.repaired_cage`.

        Repeated vertices, repeated faces, winding and holes of few edges; vertices keep their numbers and places.
        """
        from .cage_repair import repaired_cage

        return repaired_cage(self, largest_hole)

    # -- Files

    @classmethod
    def load(cls, path, *, up: str | None = None) -> Cage:
        """Read an OBJ, PLY, OFF or glTF file. Vertices keep their order exactly, used or not; polygons are cut.

        up: the axis that points up in the file, "z" or "y" (as Blender writes OBJ by default); y-up files are turned,
        (x, y, z) -> (x, -z, y). None is "y" for glTF, which is y-up by its specification, "z" for the others.
        Raises FileNotFoundError for a missing file, ValueError with file name and line for one that cannot be read.
        """
        from .cage_files import read_mesh

        path, vertices, faces = read_mesh(path, up)
        try:
            return cls(vertices, faces)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def save(self, path, *, up: str | None = None) -> None:
        """Write an OBJ, PLY (binary), OFF or glTF (.glb, .gltf) file, as the ending of `path` says; up: as in `load`.

        Vertices survive in their order, and to the last bit save in glTF, which holds float32. The file appears whole
        or not at all. Raises ValueError for another ending.
        """
        from .cage_files import write_mesh

        write_mesh(path, self.vertices, self.faces, up)

    # -- Simple shapes

    @classmethod
    def box(cls, lower, upper=None, *, segments=1) -> Cage:
        """A closed box between two corners.

        lower, upper: (3,) corners in world units; or `lower` alone, (2, 3) bounds. segments: pieces along each axis,
        one number or three. One segment gives 8 vertices and 12 faces.
        Raises ValueError for corners that are not finite, a side that is not positive or segments below 1.
        """
        from .cage_shapes import box

        return cls(*box(lower, upper, segments))

    @classmethod
    def cylinder(cls, centre, radius: float, height: float, *, axis="z", sides: int = 12, rings: int = 1) -> Cage:
        """A closed cylinder around an axis: (rings + 1) * sides vertices and two in the middle of the caps.

        centre: (3,), halfway up, world units; radius: of the circle through the vertices, so that the flat sides lie
        radius * cos(pi / sides) from the axis; rings: pieces along the height.
        Raises ValueError for radius or height that is not positive, fewer than 3 sides or 1 ring.
        """
        from .cage_shapes import cylinder

        return cls(*cylinder(centre, radius, height, axis, sides, rings))

    @classmethod
    def icosphere(cls, centre, radius: float, subdivisions: int = 1) -> Cage:
        """An icosahedron divided `subdivisions` times with its vertices on a sphere: 12, 42, 162, ... vertices.

        The middles of the faces lie inside the sphere. Raises ValueError for a radius that is not positive.
        """
        from .cage_shapes import icosphere

        return cls(*icosphere(centre, radius, subdivisions))

    # -- Generation

    @classmethod
    def from_mesh(cls, mesh, vertex_count: int = 100, **options) -> Cage:
        """A cage of about `vertex_count` vertices around a mesh. options: margin, method, symmetry, progress; see
        `warpcage.cage_generation.cage_around_mesh`."""
        from .cage_generation import cage_around_mesh

        return cage_around_mesh(mesh, vertex_count, **options)

    @classmethod
    def from_field(cls, field, vertex_count: int = 100, **options) -> Cage:
        """A cage of about `vertex_count` vertices around what a field shows. options: margin, threshold, select,
        method, symmetry, progress; see `cage_around_field` there."""
        from .cage_generation import cage_around_field

        return cage_around_field(field, vertex_count, **options)

    # -- Other cages of the same object

    def subdivide(self, times: int = 1) -> Cage:
        """Every face cut in four: see `warpcage.cage_refine.subdivided`."""
        from .cage_refine import subdivided

        return subdivided(self, times)

    def simplify(self, vertex_count: int, *, field=None, mesh=None, margin: float = 0.0) -> Cage:
        """Fewer vertices around the same object: see `warpcage.cage_refine.simplified`."""
        from .cage_refine import simplified

        return simplified(self, vertex_count, field=field, mesh=mesh, margin=margin)

    def symmetrise(self, axis: str = "x", *, centre: float | None = None, keep: str = "both") -> Cage:
        """Its own mirror image: see `warpcage.cage_refine.symmetrised`."""
        from .cage_refine import symmetrised

        return symmetrised(self, axis, centre=centre, keep=keep)

    # -- Poses: the same faces, other vertices

    def bend(self, degrees: float, *, axis="z", towards="x", limits=(0.0, 1.0), centre=None) -> Cage:
        """Bend along `axis` towards `towards`, as a circular arc: see `warpcage.poses.bend`."""
        return self._posed("bend", degrees, axis=axis, towards=towards, limits=limits, centre=centre)

    def twist(self, degrees: float, *, axis="z", limits=(0.0, 1.0), centre=None) -> Cage:
        """Turn about `axis` by an angle that grows along it: see `warpcage.poses.twist`."""
        return self._posed("twist", degrees, axis=axis, limits=limits, centre=centre)

    def taper(self, factor: float, *, axis="z", limits=(0.0, 1.0), centre=None) -> Cage:
        """Scale across `axis` by a factor that goes from 1 to `factor` along it: see `warpcage.poses.taper`."""
        return self._posed("taper", factor, axis=axis, limits=limits, centre=centre)

    def stretch(self, factor: float, *, axis="z", limits=(0.0, 1.0), keep_volume: bool = False, centre=None) -> Cage:
        """Lengthen along `axis`, and thin across it with keep_volume: see `warpcage.poses.stretch`."""
        return self._posed("stretch", factor, axis=axis, limits=limits, keep_volume=keep_volume, centre=centre)

    def scale(self, factor, *, centre=None) -> Cage:
        """Scale by one factor, or one an axis, about `centre`: see `warpcage.poses.scale`."""
        return self._posed("scale", factor, centre=centre)

    def translate(self, offset) -> Cage:
        """Move by `offset` (3,), world units."""
        return self._posed("translate", offset)

    def rotate(self, degrees: float, *, axis="z", centre=None) -> Cage:
        """Turn about `axis` through `centre`, anticlockwise seen against it: see `warpcage.poses.rotate`."""
        return self._posed("rotate", degrees, axis=axis, centre=centre)

    def move(self, offset, *, group=None, centre=None, radius: float | None = None) -> Cage:
        """Move a group of vertices, or what is near `centre`, with falloff over `radius`: see `warpcage.poses.move`."""
        from . import poses

        return self.with_vertices(poses.move(self.vertices, offset, group=group, centre=centre, radius=radius))

    def _posed(self, pose: str, *arguments, **options) -> Cage:
        from . import poses

        if pose != "translate":
            options["bounds"] = self.bounds  # of the vertices in use
        return self.with_vertices(getattr(poses, pose)(self.vertices, *arguments, **options))


def require_same_faces(rest: Cage, deformed: Cage) -> None:
    """Raise a ValueError that says how they differ unless both cages have the same faces in the same order."""
    if rest.faces is deformed.faces:
        return
    same_count = len(rest.vertices) == len(deformed.vertices)
    if same_count and np.array_equal(rest.faces, deformed.faces):
        return
    try:
        rest.match(deformed)
    except ValueError as error:
        raise ValueError(str(error).replace("the pose", "the deformed cage", 1)) from None
    if same_count and np.array_equal(np.unique(np.sort(rest.faces, axis=1), axis=0),
                                     np.unique(np.sort(deformed.faces, axis=1), axis=0)):
        first = int(np.flatnonzero((rest.faces != deformed.faces).any(axis=1))[0])
        raise ValueError(f"the deformed cage has the rest cage's faces in another order, from face {first} "
                         f"({deformed.faces[first].tolist()}, not {rest.faces[first].tolist()}): pass "
                         "rest.match(deformed)")
    what = "vertices in another order" if same_count else f"faces on {len(deformed.vertices)} vertices, not on "\
        f"{len(rest.vertices)}"
    raise ValueError(f"the deformed cage has the rest cage's {what}: pass rest.match(deformed)")


def _checked_vertices(vertices) -> np.ndarray:
    vertices = as_host_points(vertices, name="cage vertices")
    return np.array(vertices, dtype=np.float64, order="C", copy=True)


def _checked_faces(faces, vertex_count: int) -> np.ndarray:
    faces = np.asarray(faces.numpy() if is_device_array(faces) and hasattr(faces, "numpy") else faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise ValueError(f"cage faces must be (f, 3) triangles, at least one, got {faces.shape}")
    if faces.dtype.kind not in "iu":
        raise ValueError(f"cage faces must be whole numbers, got {faces.dtype}")
    wrong = (faces < 0) | (faces >= vertex_count)
    if wrong.any():
        row = int(np.flatnonzero(wrong.any(axis=1))[0])
        raise ValueError(f"cage face {row} is {faces[row].tolist()}, indices must be 0 to {vertex_count - 1}")
    faces = np.array(faces, dtype=np.int32, order="C", copy=True)
    faces.setflags(write=False)
    return faces
