"""Cage: the coarse triangle mesh around an object whose vertices steer it."""

from __future__ import annotations

from ..mesh.closed_mesh import ClosedMesh
from ..mesh.containment import inside_mesh
from ..mesh.files.files import read_mesh, write_mesh
from ..mesh.match import matched_vertices
from ..mesh.usable import require_usable
from . import poses
from .check import check_cage
from .generate.generate import cage_around_field, cage_around_mesh
from .generate.simplify import simplified
from .refine import subdivided, symmetrised
from .repair import repaired_faces
from .shapes import box, cylinder, icosphere


class Cage(ClosedMesh):
    """A triangle mesh that encloses (a part of) an object; immutable.

    vertices: (v, 3) finite floats in the scene's world units, kept as float64 in the order given.
    faces: (f, 3) whole numbers, vertex indices, kept as int32; anticlockwise seen from outside.

    The constructor refuses what cannot be held (other shapes, values that are not finite, indices that point nowhere)
    with a ValueError. An open, inverted or tangled cage can be held, so that `check` can describe it; the coordinate
    functions and `Deformer` call `require_usable`, which refuses it.
    """

    __slots__ = ()

    def match(self, pose: Cage) -> Cage:
        """A pose read from elsewhere as a pose of this cage: its vertices in this cage's order, with this cage's faces.

        pose: a Cage of the same mesh whose vertices or faces may come in another order, with quads cut along other
        diagonals, or with vertices repeated where faces meet. A symmetric cage can be laid over itself in several
        ways; the one that moves the vertices least is taken.
        Raises ValueError that says how they differ where no order fits, or where two fit equally well.
        """
        return self.with_vertices(matched_vertices(self, pose))

    # -- Checks

    def require_usable(self, name: str = "cage") -> None:
        """Raise a ValueError of one line, beginning with `name`, unless coordinates can be computed on this cage.

        Refused: open edges, edges of more than two faces, vertices where parts merely touch, neighbours wound against
        each other, parts that look inward (a cavity inside another part may), faces without area, and used vertices
        at the same place. Self-intersections are not looked for here: see `check`.
        """
        require_usable(self, name)

    def contains(self, points, device=None):
        """Whether each point is inside, by winding number; points within 1e-5 of the size of the surface are inside.

        points: (n, 3), world units. Returns (n,) bool, NumPy for NumPy input, on the device for an array of a device.
        Raises ValueError for points of another shape, NumPy points that are not finite, or an unusable cage.
        """
        return inside_mesh(points, self, device=device)

    def check(self, field=None, mesh=None, pose: Cage | None = None):
        """Examine the cage, what it encloses where a field or a mesh is given, and what a pose does: a CageReport.

        mesh: trimesh.Trimesh whose vertices ought to be inside. field: VoxelField whose visible voxels ought to be.
        pose: a pose of this cage, in any order that `match` takes. Raises ValueError for one that does not match.
        """
        return check_cage(self, field=field, mesh=mesh, pose=pose)

    def repair(self, *, largest_hole: int = 12) -> tuple[Cage, tuple[str, ...]]:
        """A mended cage and a line for each thing done to it: see `warpcage.cage.repair.repaired_faces`.

        Repeated vertices, repeated faces, winding and holes of few edges; vertices keep their numbers and places.
        """
        faces, notes = repaired_faces(self, largest_hole)
        return (Cage(self.vertices, faces) if notes else self), notes

    # -- Files

    @classmethod
    def load(cls, path, *, up: str | None = None) -> Cage:
        """Read an OBJ, PLY, OFF or glTF file. Vertices keep their order exactly, used or not; polygons are cut.

        up: the axis that points up in the file, "z" or "y" (as Blender writes OBJ by default); y-up files are turned,
        (x, y, z) -> (x, -z, y). None is "y" for glTF, which is y-up by its specification, "z" for the others.
        Raises FileNotFoundError for a missing file, ValueError with file name and line for one that cannot be read.
        """
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
        write_mesh(path, self.vertices, self.faces, up)

    # -- Simple shapes

    @classmethod
    def box(cls, lower, upper=None, *, segments=1) -> Cage:
        """A closed box between two corners.

        lower, upper: (3,) corners in world units; or `lower` alone, (2, 3) bounds. segments: pieces along each axis,
        one number or three. One segment gives 8 vertices and 12 faces.
        Raises ValueError for corners that are not finite, a side that is not positive or segments below 1.
        """
        return cls(*box(lower, upper, segments))

    @classmethod
    def cylinder(cls, centre, radius: float, height: float, *, axis="z", sides: int = 12, rings: int = 1) -> Cage:
        """A closed cylinder around an axis: (rings + 1) * sides vertices and two in the middle of the caps.

        centre: (3,), halfway up, world units; radius: of the circle through the vertices, so that the flat sides lie
        radius * cos(pi / sides) from the axis; rings: pieces along the height.
        Raises ValueError for radius or height that is not positive, fewer than 3 sides or 1 ring.
        """
        return cls(*cylinder(centre, radius, height, axis, sides, rings))

    @classmethod
    def icosphere(cls, centre, radius: float, subdivisions: int = 1) -> Cage:
        """An icosahedron divided `subdivisions` times with its vertices on a sphere: 12, 42, 162, ... vertices.

        The middles of the faces lie inside the sphere. Raises ValueError for a radius that is not positive.
        """
        return cls(*icosphere(centre, radius, subdivisions))

    # -- Generation

    @classmethod
    def from_mesh(cls, mesh, vertex_count: int = 100, **options) -> Cage:
        """A cage of about `vertex_count` vertices around a mesh. options: margin, method, symmetry, progress; see
        `warpcage.cage.generate.generate.cage_around_mesh`."""
        return cls(*cage_around_mesh(mesh, vertex_count, **options))

    @classmethod
    def from_field(cls, field, vertex_count: int = 100, **options) -> Cage:
        """A cage of about `vertex_count` vertices around what a field shows. options: margin, threshold, select,
        method, symmetry, progress; see `cage_around_field` there."""
        return cls(*cage_around_field(field, vertex_count, **options))

    # -- Other cages of the same object

    def subdivide(self, times: int = 1) -> Cage:
        """Every face cut in four: see `warpcage.cage.refine.subdivided`."""
        return Cage(*subdivided(self, times))

    def simplify(self, vertex_count: int, *, field=None, mesh=None, margin: float = 0.0) -> Cage:
        """Fewer vertices around the same object: see `warpcage.cage.generate.simplify.simplified`."""
        return Cage(*simplified(self, vertex_count, field=field, mesh=mesh, margin=margin))

    def symmetrise(self, axis: str = "x", *, centre: float | None = None, keep: str = "both") -> Cage:
        """Its own mirror image: see `warpcage.cage.refine.symmetrised`."""
        return self.with_vertices(symmetrised(self, axis, centre=centre, keep=keep))

    # -- Poses: the same faces, other vertices

    def bend(self, degrees: float, *, axis="z", towards="x", limits=(0.0, 1.0), centre=None) -> Cage:
        """Bend along `axis` towards `towards`, as a circular arc: see `warpcage.cage.poses.bend`."""
        return self._posed("bend", degrees, axis=axis, towards=towards, limits=limits, centre=centre)

    def twist(self, degrees: float, *, axis="z", limits=(0.0, 1.0), centre=None) -> Cage:
        """Turn about `axis` by an angle that grows along it: see `warpcage.cage.poses.twist`."""
        return self._posed("twist", degrees, axis=axis, limits=limits, centre=centre)

    def taper(self, factor: float, *, axis="z", limits=(0.0, 1.0), centre=None) -> Cage:
        """Scale across `axis` by a factor that goes from 1 to `factor` along it: see `warpcage.cage.poses.taper`."""
        return self._posed("taper", factor, axis=axis, limits=limits, centre=centre)

    def stretch(self, factor: float, *, axis="z", limits=(0.0, 1.0), keep_volume: bool = False, centre=None) -> Cage:
        """Lengthen along `axis`, and thin across it with keep_volume: see `warpcage.cage.poses.stretch`."""
        return self._posed("stretch", factor, axis=axis, limits=limits, keep_volume=keep_volume, centre=centre)

    def scale(self, factor, *, centre=None) -> Cage:
        """Scale by one factor, or one an axis, about `centre`: see `warpcage.cage.poses.scale`."""
        return self._posed("scale", factor, centre=centre)

    def translate(self, offset) -> Cage:
        """Move by `offset` (3,), world units."""
        return self._posed("translate", offset)

    def rotate(self, degrees: float, *, axis="z", centre=None) -> Cage:
        """Turn about `axis` through `centre`, anticlockwise seen against it: see `warpcage.cage.poses.rotate`."""
        return self._posed("rotate", degrees, axis=axis, centre=centre)

    def move(self, offset, *, group=None, centre=None, radius: float | None = None) -> Cage:
        """Move a group of vertices, or what is near `centre`, with falloff over `radius`: see
        `warpcage.cage.poses.move`."""
        return self.with_vertices(poses.move(self.vertices, offset, group=group, centre=centre, radius=radius))

    def _posed(self, pose: str, *arguments, **options) -> Cage:
        if pose != "translate":
            options["bounds"] = self.bounds  # of the vertices in use
        return self.with_vertices(getattr(poses, pose)(self.vertices, *arguments, **options))
