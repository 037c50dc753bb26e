"""Cage: the coarse mesh around an object whose vertices steer it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike
from ..core.checks import device_by_name, renamed, warn_caller
from ..core.files import PathLike
from ..core.reports import Progress, reports_progress
from ..errors import InputError
from ..mesh.io import write_mesh
from ..mesh.match import matched_vertices
from ..mesh.mesh import TriangleMesh, require_mesh
from ..mesh.queries import inside_mesh
from ..mesh.validity import require_usable
from .poses import PosableMesh
from .repair import repaired_faces, subdivided, symmetrised
from .shapes import box, cylinder, icosphere
from .up_axis import load_standing

if TYPE_CHECKING:  # and imported where they are used: the kernels of fields and of coordinates take a second to load
    from ..field.voxel_field import VoxelField
    from ..select.selection import NodeSelection
    from ..splats.splat_field import SplatField
    from .check import CageReport


class Cage(PosableMesh):
    """A mesh that encloses an object, or a part of it; immutable.

    Faces are triangles, or polygons: those of four corners are the bilinear patches between them, others as many
    patches around their middle, so that all corners of a face count alike. Coordinates are computed on fine triangles
    over the patches (`surface`), and come back as those of the cage's own vertices. Concave polygons are cut into
    triangles.

    The constructor takes open, inverted and self-intersecting meshes too, so that `check` can describe and `repair`
    mend them. The coordinate functions and `Deformer` call `require_usable`, which refuses them.

    Args:
        vertices: (v, 3) finite floats in the scene's world units. They are kept as float64 in the order given.
        faces: (f, 3) whole numbers, indices of vertices, anticlockwise seen from outside; (f, n) for polygons, with -1
            behind the last corner of faces of fewer; or a sequence of the corners of each. They are kept as int32.

    Raises:
        ValueError: For other shapes, values that are not finite, or indices that point nowhere.
    """

    __slots__ = ()

    def match(self, pose: Cage) -> Cage:
        """A pose from elsewhere as a pose of this cage: its vertices in this cage's order, with this cage's faces.

        A symmetric cage can be laid over itself in several ways; the one that moves the vertices least is taken.

        Args:
            pose: A Cage of the same mesh. Its vertices or faces may come in another order, its quads may be cut along
                any diagonals, and its vertices may be repeated where faces meet.

        Returns:
            The pose.

        Raises:
            ValueError: How the two differ where no order fits, or that two orders fit equally well.
        """
        require_mesh(pose, "the pose must be")
        return self.with_vertices(matched_vertices(self, pose))

    # -- Checks

    def require_usable(self, name: str = "cage") -> None:
        """Refuse a cage on which coordinates cannot be computed.

        Refused are open edges, edges of more than two faces, vertices where parts only touch, neighbours wound against
        each other, parts that look inward (a cavity inside another part may), faces without area, and used vertices at
        the same place. Intersecting faces are not looked for here: see `check`.

        Args:
            name: How the message begins.

        Raises:
            ValueError: One line that names the first problem and where it is.
        """
        require_usable(self, name)

    @overload
    def contains(self, points: np.ndarray, *, device: wp.DeviceLike = None) -> np.ndarray: ...
    @overload
    def contains(self, points: PointsLike, *, device: wp.DeviceLike = None) -> Any: ...
    @device_by_name
    def contains(self, points: PointsLike, *, device: wp.DeviceLike = None) -> Any:
        """Whether points are inside, by winding number. Points within 1e-5 of the cage's size of its surface are.

        Args:
            points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
            device: Warp device. None is the device of an array on a device, else CUDA where there is one.

        Returns:
            (n,) bool, an array of the same kind on the same device.

        Raises:
            ValueError: For points of another shape or not finite, or a cage that is not usable.
        """
        return inside_mesh(points, self, device=device)

    def check(
        self,
        field: VoxelField | NodeSelection | SplatField | None = None,
        mesh: TriangleMesh | None = None,
        pose: Cage | None = None,
    ) -> CageReport:
        """Examine the cage, what it encloses, and what a pose does.

        Args:
            field: A field, or a selection of it, whose visible voxels should be inside. None looks at no field.
            mesh: A trimesh.Trimesh, or the like, whose vertices should be inside. None looks at no mesh.
            pose: A pose of this cage, in any order that `match` takes. None looks at no pose.

        Returns:
            What was found. As text it is a table that says what to do about each problem.

        Raises:
            ValueError: For a field or a mesh with nothing in it, or a pose that does not match.
        """
        from .check import check_cage

        return check_cage(self, field=field, mesh=mesh, pose=pose)

    def repair(self, *, largest_hole: int = 12) -> tuple[Cage, tuple[str, ...]]:
        """Mend repeated vertices, repeated faces, winding and small holes; see `warpcage.cage.repair.repaired_faces`.

        Vertices keep their numbers and places.

        Args:
            largest_hole: Holes of up to this many edges are closed; at least 3.

        Returns:
            The mended cage, and a line for each repair; this cage and no lines where nothing had to be repaired.

        Raises:
            ValueError: For a smaller `largest_hole`, or where no face is left.
        """
        faces, notes = repaired_faces(self, largest_hole)
        return (Cage(self.vertices, faces) if notes else self), notes

    # -- Files

    @classmethod
    def load(
        cls,
        path: PathLike,
        *,
        up: str | None = None,
        reference: Cage | VoxelField | NodeSelection | SplatField | TriangleMesh | None = None,
        object: str | None = None,
    ) -> Cage:
        """Read an OBJ, PLY, OFF, glTF or USD file, or one of another package's format (`warpcage.mesh.MeshFormat`).

        All vertices keep their order, used or not, and polygons stay polygons; glTF has triangles alone. In glTF files,
        and in PLY files with texture coordinates or normals, vertices at one place that differ in these alone are one,
        at the place of the first in the order: programs split vertices so along seams.

        Args:
            path: The file; its ending says which format it has.
            up: The axis that points up in the file, "z" or "y" (as Blender writes OBJ by default). A cage with y up is
                turned: (x, y, z) -> (x, -z, y). "auto" finds it from the reference, and warns where it is not that of
                the format: "y" for glTF, as its specification says, "z" for the others. None does so where there is a
                reference, and is that of the format where there is none.
            reference: What the cage belongs to: the field or the mesh that a cage at rest stands around, or the Cage
                at rest that it is a pose of. A given axis is obeyed, with a warning where another would fit much
                better. None compares the cage with nothing.
            object: The name of one object of the file: of an `o` line of OBJ, of a node of glTF. "*" takes all as one
                cage. None is for files of one; of several it takes, for a pose, the one that is called as the cage at
                rest (`object_name`), or the only one that is a pose of it, and glTF files as one cage.

        Returns:
            The cage.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: File name and line of what cannot be read, "auto" without a reference, a cage that holds
                nothing of its object, or the names of several objects of which none is chosen.
        """
        if up == "auto" and reference is None:
            raise InputError(
                "up='auto' needs a reference: the field that a cage at rest stands around, or the rest cage of a pose"
            )
        cage, standing = load_standing(cls, path, up=None if up == "auto" else up, reference=reference, object=object)
        if standing.doubtful or standing.turned:
            warn_caller(f"cage {str(path)!r} {standing.note} (up='y' or up='z' says which it is)")
        return cage

    def save(self, path: PathLike, *, up: str | None = None) -> None:
        """Write an OBJ, PLY (binary), OFF, glTF (.glb, .gltf) or USD file. It appears whole or not at all.

        Vertices keep their order. They keep every bit too, except in glTF and USD, which hold float32. Polygons are
        written as they came, except in glTF, which has triangles alone.

        Args:
            path: The file; its ending says which format it gets.
            up: The axis that points up in the file, as in `load`.

        Raises:
            ValueError: For another ending or another axis.
        """
        write_mesh(path, self, up)

    # -- Simple shapes

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike | None = None, *, segments: int | Sequence[int] = 1) -> Cage:
        """A closed box between two corners.

        Args:
            lower: (3,) lower corner, world units; or (2, 3) both corners.
            upper: (3,) upper corner, world units. None where `lower` holds both.
            segments: Pieces along each axis, one number or three. One piece gives 8 vertices and 12 faces.

        Returns:
            The cage.

        Raises:
            ValueError: For corners that are not finite, a side that is not positive, or segments below 1.
        """
        return cls(*box(lower, upper, segments))

    @classmethod
    @renamed(center="centre")
    def cylinder(
        cls, center: ArrayLike, radius: float, height: float, *, axis: str = "z", sides: int = 12, rings: int = 1
    ) -> Cage:
        """A closed cylinder around an axis: (rings + 1) * sides vertices, and one in the middle of each cap.

        Args:
            center: (3,) the point on the axis at half the height, world units.
            radius: Radius of the circle through the vertices, world units. The flat sides lie radius * cos(pi / sides)
                from the axis.
            height: Length along the axis, world units.
            axis: "x", "y" or "z".
            sides: Flat sides, at least 3.
            rings: Pieces along the height, at least 1.

        Returns:
            The cage.

        Raises:
            ValueError: For a radius or height that is not positive, fewer sides or rings, or another axis.
        """
        return cls(*cylinder(center, radius, height, axis, sides, rings))

    @classmethod
    @renamed(center="centre")
    def icosphere(cls, center: ArrayLike, radius: float, subdivisions: int = 1) -> Cage:
        """A divided icosahedron with its vertices on a sphere. The middles of its faces lie inside the sphere.

        Args:
            center: (3,) centre of the sphere, world units.
            radius: Radius of the sphere, world units.
            subdivisions: How often each face is cut in four, 0 to 6: 12, 42, 162, ... vertices.

        Returns:
            The cage.

        Raises:
            ValueError: For a radius that is not positive, or another number of subdivisions.
        """
        return cls(*icosphere(center, radius, subdivisions))

    # -- Generation

    @classmethod
    @reports_progress
    def from_mesh(
        cls,
        mesh: TriangleMesh,
        vertex_count: int = 100,
        *,
        margin: float | None = None,
        method: str = "auto",
        symmetry: str | None = None,
        detail: str = "even",
        focus: Any = None,
        finer: float = 2.0,
        faces: str = "triangles",
        progress: bool | Progress = False,
    ) -> Cage:
        """A cage around a mesh: closed, manifold, outward, without intersecting faces; the same for the same mesh.

        Gaps narrower than about an edge of the cage are bridged, unless `detail` asks otherwise. Parts farther apart
        get closed parts of their own. Vertices lie within 1.75 (margin + slack) + 1.5 sqrt(area / count) of the mesh
        where any attempt keeps to that; the area is the cage's, the slack that of distances, at most half a percent of
        the size.

        Args:
            mesh: A trimesh.Trimesh, or anything with .vertices (n, 3) and .faces (f, 3). It may be open and have
                several parts.
            vertex_count: Number of vertices, 8 to 2000; the cage has it within 10 %. 30 to 200 suit deformation.
            margin: Least distance between cage and mesh, world units. None is 1 % of the mesh's size.
            method: "shell": an offset surface, decimated outward and drawn close. "voxel": the outer surface of voxels
                along the mesh's principal axes (Xian, Lin and Gao 2009), whose faces are more even. "auto": the one of
                the smaller volume.
            symmetry: "x", "y" or "z", the normal of a plane through the middle of the mesh about which the cage is its
                own mirror image, and which encloses that of the mesh too. "auto" takes that across which 95 % of the
                mesh's image lie within 2 % of its size of it, the best one, or none. None asks for no symmetry.
            detail: "even": vertices lie evenly, and gaps narrower than about an edge are bridged. "parts": thin parts
                get shorter edges, gaps and holes stay open as far as the count allows, so that limbs get tubes of
                their own ("shell" only, which "auto" then takes). A warning says what had to be closed.
            focus: Where edges are shorter, at the same number of vertices ("shell" only): points (n, 3), world units; a
                NodeSelection; or, where poses bend it, a PoseFile or a list of a cage at rest and poses of it, around
                the same object. None makes them even.
            finer: By which factor edges are shorter in the focus than far from it, 1 to 8.
            faces: "triangles", or "quads": of pairs of triangles, by a matching of most weight on how square and flat
                they are; 9 of 10 faces and more, the rest triangles. Their patches enclose the mesh, see `surface`.
            progress: True shows bars on stderr. A function is called with (done, total, message) and cancels
                the work by returning False.

        Returns:
            The cage.

        Raises:
            ValueError: For a mesh that is empty, not finite or has bad indices, for a bad option, or where no cage
                could be made.
            Cancelled: Where `progress` returned False.
        """
        from .generate import cage_around_mesh

        return cls(
            *cage_around_mesh(
                mesh,
                vertex_count,
                margin=margin,
                method=method,
                symmetry=symmetry,
                detail=detail,
                focus=focus,
                finer=finer,
                faces=faces,
                progress=progress,
            )
        )

    @classmethod
    @reports_progress
    def from_field(
        cls,
        field: VoxelField | NodeSelection | SplatField,
        vertex_count: int = 100,
        *,
        margin: float | None = None,
        threshold: float | None = None,
        method: str = "auto",
        symmetry: str | None = None,
        detail: str = "even",
        focus: Any = None,
        finer: float = 2.0,
        faces: str = "triangles",
        progress: bool | Progress = False,
    ) -> Cage:
        """A cage around what a field shows; otherwise as `from_mesh`.

        Args:
            field: A VoxelField or a SplatField, or what `select_nodes` took of it, to cage one object of a larger
                scene.
            vertex_count: Number of vertices, 8 to 2000; the cage has it within 10 %.
            margin: Least distance between cage and visible voxels, in voxels. None is 1, so that the cage holds all
                that trilinear interpolation spreads around them.
            threshold: Density from which a voxel is visible, per world unit. None takes the weights that were
                recorded when the field was fitted, or the opacity across a voxel where there are none.
            method: "shell", "voxel" or "auto", as in `from_mesh`.
            symmetry: "x", "y", "z", "auto" or None, as in `from_mesh`.
            detail: "even" or "parts", as in `from_mesh`.
            focus: Where edges are shorter, as in `from_mesh`.
            finer: By which factor, as in `from_mesh`.
            faces: "triangles" or "quads", as in `from_mesh`.
            progress: True shows bars on stderr. A function is called with (done, total, message) and cancels
                the work by returning False.

        Returns:
            The cage.

        Raises:
            ValueError: For a field that shows nothing or is not finite, for a bad option, or where no cage could be
                made.
            Cancelled: Where `progress` returned False.
        """
        from .generate import cage_around_field

        return cls(
            *cage_around_field(
                field,
                vertex_count,
                margin=margin,
                threshold=threshold,
                method=method,
                symmetry=symmetry,
                detail=detail,
                focus=focus,
                finer=finer,
                faces=faces,
                progress=progress,
            )
        )

    # -- Other cages of the same object

    def subdivide(self, times: int = 1, *, faces: ArrayLike | None = None, vertices: ArrayLike | None = None) -> Cage:
        """Cut faces at the middles of their edges, triangles and quads in four. The surface stays where it is.

        Faces of more corners are cut in as many quads around their middle. Where only some are chosen, their neighbours
        are cut so that all meet edge to edge: triangles in two, or in four where two of their edges are cut (red-green
        refinement, Bank, Sherman and Weiser 1983); quads in two quads, three quads, or two quads and a triangle, and in
        four where three of their edges are cut. New vertices are means of old ones, the same ones in every pose of a
        cage, so poses subdivided alike are poses of the finer cage (see `PoseFile.subdivide`). Between chosen and other
        faces a warped quad moves, by a sixteenth of its warp at most.

        Args:
            times: How often, 1 to 4.
            faces: (k,) numbers of the faces that are cut; again, what they were cut in is. None chooses none.
            vertices: (k,) numbers of the vertices whose faces are cut; again, their new faces are. None chooses none;
                with neither, all faces are cut.

        Returns:
            The finer cage. The vertices of this one keep their numbers, new ones follow.

        Raises:
            ValueError: For another number of times, numbers of no face or vertex, or both faces and vertices.
        """
        return Cage(*subdivided(self, times, faces=faces, vertices=vertices))

    def simplify(
        self,
        vertex_count: int,
        *,
        field: VoxelField | NodeSelection | SplatField | None = None,
        mesh: TriangleMesh | None = None,
        margin: float = 0.0,
    ) -> Cage:
        """Fewer vertices around the same object. The surface moves outward only, unless the object has to be cleared.

        Args:
            vertex_count: Number of vertices; the cage has it within 10 %.
            field: A field, or a selection of it, whose visible voxels must stay inside.
            mesh: A mesh whose surface must stay inside. Without a field and a mesh this cage itself must.
            margin: Least distance to what must stay inside, world units.

        Returns:
            The coarser cage, of triangles.

        Raises:
            ValueError: For a cage that is not usable, a count that is not below its own, an object that is not inside
                even now, or where no such cage is found.
        """
        from .generate import simplified

        return Cage(*simplified(self, vertex_count, field=field, mesh=mesh, margin=margin))

    @renamed(center="centre")
    def symmetrise(self, axis: str = "x", *, center: float | None = None, keep: str = "both") -> Cage:
        """Make a nearly symmetric cage its own mirror image across a plane. Faces stay as they are.

        Args:
            axis: "x", "y" or "z", the normal of the plane.
            center: Where the plane crosses the axis, world units. None is the middle of the bounding box.
            keep: "both" takes the mean of both halves, "+" or "-" copies the half on that side to the other.

        Returns:
            The symmetric cage.

        Raises:
            ValueError: Where a vertex has no partner across the plane, or for other names.
        """
        return self.with_vertices(symmetrised(self, axis, center=center, keep=keep))
