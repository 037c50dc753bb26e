"""Points bound to a cage at rest: coordinates and their gradients once, then a weighted sum a pose."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import warp as wp

from ..coordinates.harmonic import weight_maps
from ..core.arrays import empty_array
from ..core.devices import HeldOnDevice, lane_count, launch
from ..core.memory import require_memory
from ..core.names import coordinate_kind
from ..core.reports import Progress, report_progress
from ..errors import InputError
from ..kernels.coordinates.local_points import find_not_finite
from ..kernels.gradients import splat_pose
from ..kernels.gradients.green_adjoint import slope_stretched_normals
from ..kernels.splats import lattice_rows, pose
from ..kernels.splats.packed_rows import PackedRows, carry_packed, pack_rows
from ..lattice.closed_form import weight_operator
from ..lattice.corner_sums import CPU_PARTS, CornerSums
from ..mesh.faces import StretchTarget, column_cross, column_dot, face_edges, stretched_normals
from ..mesh.mesh import ClosedMesh
from ..mesh.surface import merge_rows
from .io.axes import sh_basis

#: Rows of x, y, z, x, y, of which cross products take slices.
_AROUND = np.array([0, 1, 2, 0, 1])


class PoseFit:
    """Fits poses of a cage, for which every pose waits on the host: what the cage at rest says is worked out once.
    origin: (3,) world point that everything is relative to."""

    def __init__(self, rest: ClosedMesh, coordinates: str, origin: np.ndarray):
        self._origin, self._size = origin, rest.size
        self._local = rest.vertices - origin
        self._green = coordinate_kind(coordinates).has_face_weights
        self.own_count = rest.own_count  # of a surface the first vertices, from which the others follow
        self.row_count = self.own_count + (len(rest.faces) if self._green else 0)  # r_j: by vertex; Green: by face
        used = np.ones(len(rest.vertices), dtype=bool)
        if not self._green:
            used[rest.topology.unused_vertices] = False  # they may lie anywhere
        self._mean = used / used.sum()
        self._center = self._mean @ self._local
        spread = np.where(used[:, None], self._local - self._center, 0.0)
        self._spread, self._square_sum = spread, (spread**2).sum()
        # directions that the vertices of an almost flat cage do not span are left out
        self._inverse = np.linalg.pinv(spread / self._size, rcond=1e-9) / self._size
        if self._green:
            self._normals = rest.size * stretched_normals(rest, StretchTarget.of(rest))
            self._first, self._second, self._third = rest.faces.T.astype(np.intp)
            u, v = face_edges(rest)
            cross = column_cross(u, v)
            scale = 0.5 * rest.size**2 / column_dot(cross, cross)
            self._ss, self._tt = scale * column_dot(v, v), scale * column_dot(u, u)
            self._st = -2.0 * scale * column_dot(u, v)

    def targets(self, deformed: ClosedMesh, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fit a pose: A - 1 (3, 3) and t (3,) float64, relative to the origin, and in `out` (v + row_count, 3) float32
        the posed vertices, relative to the origin, and then r_j."""
        count = len(self._local)
        posed = deformed.vertices - self._origin
        middle = self._mean @ posed
        around = posed - middle
        if self._green:
            matrix = nearest_similarity(self._spread, around, self._square_sum)
            out[count + self.own_count :] = (self._tilts(around) - matrix @ self._normals).T  # r_j times the size
        else:
            matrix = (self._inverse @ around).T
        out[:count] = posed
        # relative to the centres, so that nothing is lost far from the origin
        out[count : count + self.own_count] = (around - (self._local - self._center) @ matrix.T)[: self.own_count]
        return matrix - np.eye(3), middle - matrix @ self._center

    def _tilts(self, vertices: np.ndarray) -> np.ndarray:
        """(3, f) stretched normals of posed faces times the size; as `stretched_normals`, in few array calls."""
        columns = vertices.T.take(_AROUND, axis=0)
        first = columns.take(self._first, axis=1)
        s = columns.take(self._second, axis=1) - first  # (5, f)
        t = columns.take(self._third, axis=1) - first
        normals = s[1:4] * t[2:5] - s[2:5] * t[1:4]
        ss, st, tt = (np.einsum("if,if->f", a[:3], b[:3]) for a, b in ((s, s), (s, t), (t, t)))
        energy = np.maximum(self._ss * ss + self._st * st + self._tt * tt, 0.0)
        squared = np.einsum("if,if->f", normals, normals)
        normals *= np.sqrt(np.divide(energy, squared, out=np.zeros_like(squared), where=squared > 0.0))
        return normals


def nearest_similarity(a: np.ndarray, b: np.ndarray, square_sum: float) -> np.ndarray:
    """The rotation times a scale (3, 3) that takes points a (v, 3) around 0 nearest to b; square_sum: of a."""
    u, s, vt = np.linalg.svd(b.T @ a)  # Umeyama 1991
    matrix = u @ vt
    if np.linalg.det(matrix) < 0.0:  # it would turn over
        u[:, 2] *= -1.0
        s[2] *= -1.0
        matrix = u @ vt
    return (s.sum() / square_sum) * matrix


def fit_similarity(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The similarity that takes points (v, 3) nearest to others: rotation times scale (3, 3) and offset (3,)."""
    center, middle = source.mean(axis=0), target.mean(axis=0)
    a = source - center
    matrix = nearest_similarity(a, target - middle, (a**2).sum())
    return matrix, middle - matrix @ center


#: Groups of lanes that share the rows of bound points in a backward pass on CUDA.
BACKWARD_GROUPS = 1 << 13

#: Points that are bound in one launch: their sums in float64 take 32 bytes a vertex.
CHUNK = 1 << 15

#: Cells along the longest side of the lattice of harmonic coordinates, by default.
RESOLUTION = 128


class CageBinding(HeldOnDevice):
    """Points in a cage at rest, and where a pose of it takes them, with the Jacobian of the map there.
    A pose costs one weighted sum a point: phi(x) = A x + t + sum_j w_j(x) r_j (kernels/splats/pose.py)."""

    def __init__(
        self,
        points: np.ndarray,  # (m, 3) world units, inside the cage, 1e-5 of its size or more from its faces
        cage: ClosedMesh,  # at rest, usable, of triangles
        coordinates: str,  # a name of `coordinate_kinds`
        origin: np.ndarray,  # (3,) world point that positions on the device are relative to
        device: wp.Device,
        resolution: int | None = None,  # harmonic only: cells of the lattice along the cage's longest side
        packed: bool | None = None,  # ten bytes an entry, gradients as half floats, instead of sixteen; None: on CUDA
        progress: bool | Progress = False,
    ):
        self._cage, self._device = cage, device
        self._fit = PoseFit(cage, coordinates, origin)
        # (j, m) vec4, weight and gradient (per size of the cage) of each vertex (Green: then face); None if packed
        self.rows: wp.array | None = None
        self.packed: Any = None  # the PackedRows of kernels/splats/packed_rows.py; None if not packed
        pack = not device.is_cpu if packed is None else packed  # CUDA waits for memory; a CPU is slower to unpack
        count, height, corners = len(points), self._fit.row_count, len(cage.vertices)
        groups = (height + 3) // 4
        kind = coordinate_kind(coordinates)
        step = max(1, CHUNK // 8) if kind.face_layers > 1 else CHUNK
        chunk = min(step, count) if kind.is_closed_form else count
        need = 40 * groups * count + 16 * height * chunk if pack else 16 * height * count
        merges = kind.is_closed_form and (cage.operator is not None or kind.face_layers > 1)
        taken = corners + max(1, kind.face_layers) * (height - cage.own_count)  # rows that a kernel writes
        if kind.is_closed_form:
            need += 32 * corners * chunk + merges * (32 if kind.face_layers > 1 else 16) * taken * chunk
        require_memory(
            need,
            device,
            f"{count} splats bound to a cage of {corners} vertices need {{size}}: take a cage of fewer, or "
            "fewer splats",
        )
        #: the posed vertices, r_j, and zeros for the rows that packing adds
        self._host = np.zeros((corners + (8 * ((groups + 1) // 2) if pack else height), 3), np.float32)
        if pack:
            self.packed = PackedRows()
            self.packed.groups = empty_array(((count + 31) // 32, groups, 160), wp.uint64, device)
            self.packed.scales = empty_array(count, wp.float32, device)
            rows = _columns(height, max(chunk, 1), wp.vec4, device)
        else:
            rows = self.rows = _columns(height, count, wp.vec4, device)
        if not kind.is_closed_form:
            for column, cage_map, places, spacing in weight_maps(
                points, cage, resolution or RESOLUTION, device, progress=progress
            ):
                inputs = [column, 1.0 / spacing, cage_map, places]
                launch(lattice_rows.bind_lattice, count, inputs, [rows], device=device)
            launch(lattice_rows.settle_rows, count, [], [rows], device=device)
            self._pack(0, rows, count)
            return
        center = cage.bounds.mean(axis=0)
        local = wp.array((points - center) / cage.size, dtype=wp.vec3d, device=device)
        vertices = wp.array((cage.vertices - center) / cage.size, dtype=wp.vec3d, device=device)
        faces = wp.array(cage.faces, dtype=wp.vec3i, device=device)
        scratch = _columns(corners, max(chunk, 1), wp.vec4d, device)
        dtype = wp.vec4d if kind.face_layers > 1 else wp.vec4
        every = _columns(taken, max(chunk, 1), dtype, device) if merges else None
        operator = weight_operator(kind, cage, faces, 1.0) if count else None
        kernel = kind.load("bind_points")
        unsolved: Any = wp.zeros(1, dtype=int, device=device)
        if cage.quads is not None and kind.bind_quads is not None:
            faces, kernel = wp.array(cage.quads, dtype=wp.vec4i, device=device), kind.load("bind_quads")
        for begin in range(0, count, step):
            report_progress(progress, begin, count, "bind splats")
            items = min(step, count - begin)
            into: Any = rows if pack else rows[:, begin : begin + items]
            inputs = [local[begin : begin + items], vertices, faces, scratch]
            outputs = [into if every is None else every]
            launch(kernel, items, inputs, outputs, device=device, work=4 * len(cage.faces))
            if every is not None:
                merge_rows(every[:, :items], operator, into)
            if kind.is_iterative:
                launch(find_not_finite, items, [into[0]], [unsolved], device=device)
            self._pack(begin, rows, items)
        if kind.is_iterative and unsolved.numpy()[0]:
            raise InputError(
                f"no {kind.name} coordinates of splats are found where the cage passes through itself, is inside out "
                "or a hundred times wider than high: take another cage, or other coordinates"
            )

    def _pack(self, begin: int, rows: wp.array, items: int) -> None:
        """Pack rows (j, items or more) of points from `begin` on, where they are packed."""
        if self.packed is not None:
            launch(pack_rows, items, [begin, rows, self.packed], device=self._device, work=rows.shape[0])

    def carry(
        self,
        deformed: ClosedMesh,
        members: wp.array,  # (m,) int32, which of the splats they are
        others: wp.array,  # (n,) int32, the splat that goes the same way as each, or -1
        anchors: wp.array,  # (m,) vec3, the bound points, relative to the origin
        offsets: wp.array,  # (m,) vec3, from each to the centre of its splat
        carried: Any,  # a CarriedSplats of kernels/splats/pose.py that takes them
    ) -> wp.array:
        """Take the bound points to a pose; returns vec3 on the device.
        The first v of them are the posed vertices, relative to the origin."""
        corners, height = len(deformed.vertices), self._fit.row_count
        slope, shift = self._fit.targets(deformed, self._host[: corners + height])
        targets = wp.array(self._host, dtype=wp.vec3, device=self._device, copy=True)
        kernel, rows = (carry_packed, self.packed) if self.packed is not None else (pose.carry_bound, self.rows)
        inputs = [
            *(members, others, anchors, offsets, rows, targets, corners),
            *(wp.mat33(*slope.ravel()), wp.vec3(*shift), 1.0 / self._cage.size, carried),
        ]
        launch(kernel, members.size, inputs, device=self._device, work=height)
        return targets

    def vertex_gradient(
        self,
        deformed: ClosedMesh,
        members: wp.array,  # as for `carry`
        others: wp.array,
        offsets: wp.array,
        slopes: Any,  # CarriedSlopes of kernels/gradients/splat_pose.py, by what `carry` put there
    ) -> wp.array:
        """Slopes (v,) vec3 by the posed cage's own vertices, per world unit, of the pose that was carried last."""
        device, count, height, own = self._device, members.size, self._fit.row_count, self._fit.own_count
        bound = splat_pose.CarriedSlopes()
        bound.positions = empty_array(count, wp.vec3, device)
        bound.jacobians = empty_array(count, wp.mat33, device)
        launch(splat_pose.gather_bound, count, [members, others, offsets, slopes], [bound], device=device)
        inverse_size = 1.0 / self._cage.size
        if self.packed is not None:
            tiles, groups, _ = self.packed.groups.shape
            parts = max(1, min(tiles, BACKWARD_GROUPS // groups))
            by_targets = wp.zeros((parts, 4 * groups), dtype=wp.vec3, device=device)
            inputs = [count, self.packed, inverse_size, bound]
            items = parts * groups * lane_count(device)
            launch(splat_pose.propagate_packed_rows, items, inputs, [by_targets], device=device, work=count)
        else:
            span = -(-count // CPU_PARTS)
            by_targets = wp.zeros((CPU_PARTS, height), dtype=wp.vec3, device=device)
            inputs = [span, self.rows, inverse_size, bound]
            launch(splat_pose.propagate_rows, CPU_PARTS, inputs, [by_targets], device=device, work=span * height)
        by_vertices = wp.zeros(own, dtype=wp.vec3, device=device)
        if height > own:  # r_j of faces are their stretched normals times the size
            sums, faces = CornerSums(self._cage, device), len(self._cage.faces)
            by_normals = wp.zeros(faces, dtype=wp.vec3, device=device)
            launch(splat_pose.add_parts, faces, [by_targets, own, self._cage.size], [by_normals], device=device)
            rest, posed = (
                wp.array(mesh.vertices - self._cage.bounds[0], dtype=wp.vec3, device=device)
                for mesh in (self._cage, deformed)
            )
            inputs = [rest, posed, sums.faces, by_normals.reshape((1, faces))]
            launch(slope_stretched_normals, faces, inputs, sums.arrays, device=device)
            by_vertices = sums.gathered((1.0, 1.0))[1]
        launch(splat_pose.add_parts, own, [by_targets, 0, 1.0], [by_vertices], device=device)
        return by_vertices


def _columns(height: int, count: int, dtype: Any, device: wp.Device) -> wp.array:
    """An array (height, count) whose columns lie together on the CPU, where a thread walks down one after another, and
    whose rows do on CUDA, where the threads of a warp walk side by side."""
    if device.is_cpu:
        return empty_array((count, height), dtype, device).transpose([1, 0])
    return empty_array((height, count), dtype, device)


def turned_harmonics(harmonics: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Coefficients (n, b, 3) float32 of d -> f(R^-1 d) from those of f, b = 1, 4, 9 or 16; rotations: R (n, 3, 3).
    That is a splat and its highlights, turned by R."""
    turned = harmonics.astype(np.float32, copy=True)
    degree = round(np.sqrt(harmonics.shape[1])) - 1
    if degree == 0:
        return turned
    directions, parts = _probes()
    for begin in range(0, len(harmonics), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        seen = sh_basis(directions @ rotations[chunk])  # rows d^T R are R^-1 d
        # A turned harmonic is a sum of those of its degree: it is evaluated in some directions, and taken apart again.
        for band in range(1, degree + 1):
            own = slice(band**2, (band + 1) ** 2)
            values = seen[..., own] @ harmonics[chunk, own].astype(np.float64)
            turned[chunk, own] = parts[band] @ values
    return turned


@functools.cache
def _probes() -> tuple[np.ndarray, list[np.ndarray]]:
    """Directions (k, 3) evenly over the sphere, and for each degree what takes values there apart, (2 l + 1, k)."""
    count = 24
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    basis = sh_basis(directions)
    return directions, [np.linalg.pinv(basis[:, band**2 : (band + 1) ** 2]) for band in range(4)]


#: Standard deviation of a piece along the axis that is cut, in those of the whole.
PIECE = 0.65

#: Least squares over the picture of a splat seen from the side, alphas composited: opacity of the whole; of the piece
#: in the middle; of the two at the sides; their distance from it, in standard deviations of the whole; and how much
#: narrower the pieces are across. Worst errors of alpha: 0.0015 at 0.1, 0.011 at 0.5, 0.046 at 0.99.
_TABLE = np.array(
    [
        (0.0, 0.0, 0.0, 1.0493, 1.0),
        (0.1, 0.0827, 0.0359, 1.0400, 0.9953),
        (0.2, 0.1675, 0.0730, 1.0306, 0.9904),
        (0.3, 0.2551, 0.1114, 1.0210, 0.9851),
        (0.4, 0.3459, 0.1511, 1.0114, 0.9793),
        (0.5, 0.4406, 0.1923, 1.0017, 0.9732),
        (0.6, 0.5401, 0.2350, 0.9921, 0.9666),
        (0.7, 0.6455, 0.2791, 0.9826, 0.9596),
        (0.8, 0.7580, 0.3248, 0.9735, 0.9520),
        (0.9, 0.8792, 0.3720, 0.9649, 0.9438),
        (0.95, 0.9437, 0.3960, 0.9609, 0.9396),
        (1.0, 1.0, 0.4215, 0.9570, 0.9352),
    ]
)

#: Pieces of pieces are cut no more often than this.
MAX_CUTS = 4


@dataclasses.dataclass(frozen=True)
class SplitTree:
    """Splats and their pieces. A node is a splat or a piece."""

    rows: np.ndarray  # (nodes,) the splat that each node is, or is a piece of
    parents: np.ndarray  # (nodes,) the node that each is a piece of, -1 for splats
    pieces: np.ndarray  # (nodes,) the first of the three pieces of each node, -1 for those that are not cut
    centers: np.ndarray  # (nodes, 3) world units
    factors: np.ndarray  # (nodes, 3, 3) axes times standard deviations, one per column
    opacities: np.ndarray  # (nodes,) 0 to 1

    @property
    def covariances(self) -> np.ndarray:
        """(nodes, 3, 3) world units squared."""
        return self.factors @ self.factors.transpose(0, 2, 1)


def pieces_of(
    centers: np.ndarray, factors: np.ndarray, opacities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three pieces of each splat along its longest axis, the middle one first, which together look like it.
    Arrays as in `SplitTree`, (n, ...); those returned are centres (n, 3, 3), factors (n, 3, 3, 3), opacities (n, 3)."""
    middle, side, distance, across = (np.interp(opacities, _TABLE[:, 0], column) for column in _TABLE[:, 1:].T)
    longest = np.argmax((factors**2).sum(axis=1), axis=1)
    rows = np.arange(len(centers))
    axis = factors[rows, :, longest] * distance[:, None]
    cut = factors * across[:, None, None]
    cut[rows, :, longest] = PIECE * factors[rows, :, longest]
    return (
        np.stack([centers, centers - axis, centers + axis], axis=1),
        np.repeat(cut[:, None], 3, axis=1),
        np.stack([middle, side, side], axis=1),
    )


def split_tree(
    centers: np.ndarray,
    factors: np.ndarray,
    opacities: np.ndarray,
    largest: np.ndarray,
    cuts: int = MAX_CUTS,
    most: int | None = None,  # None is no limit
) -> SplitTree:
    """Splats, the first n nodes, and pieces of those, or of pieces, of a standard deviation above `largest` (n,).
    Arrays as in `SplitTree`; cuts: how often at most; most: nodes at most, the largest are cut first."""
    count = len(centers)
    nodes = [(np.arange(count), np.full(count, -1), centers, factors, opacities)]
    pieces = [np.full(count, -1)]
    begin, total = 0, count
    for _ in range(cuts):
        rows, _, places, axes, alphas = nodes[-1]
        excess = np.sqrt((axes**2).sum(axis=1).max(axis=1, initial=0.0)) / largest[rows]
        cut = np.flatnonzero(excess > 1.0)
        if most is not None:
            room = max(0, (most - total) // 3)
            cut = np.sort(cut[np.argsort(-excess[cut], kind="stable")[:room]])
        if not len(cut):
            break
        pieces[-1][cut] = total + 3 * np.arange(len(cut))
        new_places, new_axes, new_alphas = pieces_of(places[cut], axes[cut], alphas[cut])
        parents = np.repeat(begin + cut, 3)
        flat = (new_places.reshape(-1, 3), new_axes.reshape(-1, 3, 3), new_alphas.reshape(-1))
        nodes.append((np.repeat(rows[cut], 3), parents, *flat))
        pieces.append(np.full(3 * len(cut), -1))
        begin, total = total, total + 3 * len(cut)
    rows, parents, places, axes, alphas = (np.concatenate(parts) for parts in zip(*nodes, strict=True))
    return SplitTree(rows, parents, np.concatenate(pieces), places, axes, alphas)
