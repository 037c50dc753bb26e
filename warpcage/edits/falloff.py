"""The band inside the walls of a local cage in which an edit fades to rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..cage.walls import cut_faces, in_matter, wall_groups
from ..core.arrays import empty_array
from ..core.devices import launch
from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..kernels.edits import extension as kernels
from ..kernels.edits.structs import CELL_CARRIES, CELL_FOLDED, CELL_INSIDE
from ..kernels.lattice.cage_map import CageMap
from ..kernels.mesh.triangle import Walls
from ..lattice.position_map import PositionMap
from ..mesh.patches import faces_within, triangles_of, vertices_of
from .edits import CageEdit

#: Vertices nearer to rest than this share of the cage's size are in place.
STILL = 1e-6

#: Faces of one wall meet at less than this angle, degrees.
WALL_ANGLE = 30.0


class FalloffBand:
    """The walls of a cage that an edit holds, and the band inside them in which its map fades to the identity.
    `field` is where walls that cut matter are found."""

    # At a held wall the map and its derivative are the identity: nothing jumps. In the band vertices move by shares.

    def __init__(self, edit: CageEdit, field: VoxelField):
        self._cage, self._width, self._field = edit.cage, edit.falloff, field
        self.faces: np.ndarray | None = None  # (k,) held; None where each pose decides: those that it leaves in place
        if edit.held == "cut":
            self.faces = cut_faces(edit.cage, field)
            if not len(self.faces):
                raise InputError(
                    "no side of the cage cuts through the object, so that nothing tears and no falloff is needed: "
                    "leave it out, or say which sides are held: still (those that each pose leaves in place), or "
                    "numbers of faces"
                )
        elif edit.held != "still":
            self.faces = np.asarray(edit.held, dtype=np.int64)

    def held(self, posed: Cage) -> Cage:
        """A pose with the held walls at rest: the one that is rendered."""
        faces = self.held_faces(posed)
        rest = self._cage.vertices
        share = walls_share(rest, wall_corners(self._cage, faces), self._width)
        share[vertices_of(self._cage, faces)] = 0.0
        moved = rest + share[:, None] * (posed.vertices - rest)
        return posed.with_vertices(np.where(share[:, None] < 1.0, moved, posed.vertices))

    def held_faces(self, posed: Cage) -> np.ndarray:
        """(k,) the faces that do not move in a pose."""
        return still_faces(self._cage, posed) if self.faces is None else self.faces

    def has_matter(self, points: np.ndarray) -> bool:
        """Whether any of the points (n, 3), world units, at rest, lies in matter of the field."""
        return bool(in_matter(self._field, points).any())

    def on_device(self, posed: Cage, origin: ArrayLike, device: wp.Device) -> Any:
        """The Walls for kernels of a pose whose held walls are at rest, relative to the world point `origin`."""
        walls = wall_corners(self._cage, self.held_faces(posed))
        data = Walls()
        if not walls:
            return data
        corners = np.concatenate(walls).reshape(-1, 3) - np.asarray(origin)
        data.corners = wp.array(corners.astype(np.float32), dtype=wp.vec3, device=device)
        data.starts = wp.array(np.cumsum([0, *map(len, walls)]), dtype=wp.int32, device=device)
        boxes = [corner for wall in walls for corner in (wall.min(axis=(0, 1)), wall.max(axis=(0, 1)))]
        data.boxes = wp.array((np.array(boxes) - origin).astype(np.float32), dtype=wp.vec3, device=device)
        data.lower = wp.vec3(*(corners.min(axis=0) - self._width))
        data.upper = wp.vec3(*(corners.max(axis=0) + self._width))
        data.width = self._width
        return data


def faded_map(cage_map: Any, walls: Any, held: Any = None) -> Any:
    """A CageMap faded towards Walls, with positions of its own; `cage_map` stays as it is.
    held: the faded map of the last pose, whose arrays are used again where they fit, or None."""
    if walls.width == 0.0:
        return cage_map
    positions, device = cage_map.positions, cage_map.positions.device
    faded = CageMap()
    faded.lower, faded.spacing, faded.inverse_spacing = cage_map.lower, cage_map.spacing, cage_map.inverse_spacing
    faded.distance = cage_map.distance
    if held is not None and held.positions is not None and held.positions.shape == positions.shape:
        faded.positions = held.positions
    else:
        faded.positions = empty_array(positions.shape, wp.vec3, device)
    launch(kernels.fade_nodes, positions.size, [cage_map, walls], [faded.positions], device=device)
    if has_sides(cage_map):
        faded.side_index, faded.sides = cage_map.side_index, wp.clone(cage_map.sides)
        launch(kernels.fade_sides, positions.size, [cage_map, walls], [faded.sides], device=device)
    return faded


def has_sides(cage_map: Any) -> bool:
    """Whether a CageMap has cells at narrow gaps of its cage."""
    return cage_map.side_index is not None and cage_map.side_index.size > 0


def set_gap_remedies(maps: Sequence[PositionMap | None], bands: Sequence[FalloffBand | None]) -> None:
    """Name the falloff band in the warning about narrow gaps of each map with one."""
    for index, (position_map, band) in enumerate(zip(maps, bands, strict=True)):
        if position_map is not None and band is not None:
            position_map.gap_remedy = (
                f"the falloff of edit {index} holds walls of the cage, and the pose squeezes it beside them: move it "
                "less, or give it another width of the falloff or other vertices there"
            )


def folded_cells(flags: np.ndarray) -> np.ndarray:
    """Which cells wholly inside a posed cage its map turns over, by their CELL_... flags (nx-1, ny-1, nz-1) uint8."""
    return (flags & (CELL_FOLDED | CELL_CARRIES)) == (CELL_FOLDED | CELL_INSIDE)


def walls_share(points: np.ndarray, walls: Sequence[np.ndarray], width: float) -> np.ndarray:
    """How much of an edit is left at points (n, 3): (n,) shares, 0 to 1, by the formula of kernels/mesh/triangle.py in
    float64. walls: (k, 3, 3) corners of the faces of each; width: of the band, world units."""
    share = np.ones(len(points))
    for corners in walls:
        t = np.minimum(triangle_distance(points, corners) / width, 1.0)
        share *= t**3 * (t * (6.0 * t - 15.0) + 10.0)
    return share


def triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n,) distance of points (n, 3) to the nearest of triangles (k, 3, 3)."""
    import trimesh

    nearest = np.full(len(points), np.inf)
    for triangle in corners:
        at = trimesh.triangles.closest_point(np.broadcast_to(triangle, (len(points), 3, 3)), points)
        nearest = np.minimum(nearest, np.linalg.norm(points - at, axis=1))
    return nearest


def wall_corners(cage: Cage, faces: np.ndarray) -> list[np.ndarray]:
    """Faces (k,) of a cage as walls, sets that meet at less than WALL_ANGLE: the corners (m, 3, 3), world units, of the
    triangles of each."""
    return [triangles_of(cage, wall)[0] for wall in wall_groups(cage, faces, WALL_ANGLE)]


def still_faces(rest: Cage, posed: Cage) -> np.ndarray:
    """(k,) the faces whose vertices a pose leaves in place."""
    # of the surface of a pose, the vertices of its cage come first
    moved = np.linalg.norm(posed.vertices[: len(rest.vertices)] - rest.vertices, axis=1) > STILL * rest.size
    return faces_within(rest, ~moved)
