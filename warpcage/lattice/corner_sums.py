"""CornerSums: slopes of a number by a cage that is looked from and one that is looked to, summed up face by face."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import WarpStruct, empty_array
from ..core.devices import lane_count, launch
from ..kernels.gradients.corners import gather_corners
from ..kernels.gradients.green_adjoint import place_off_cage, slope_stretched_normals, sum_green_corners
from ..kernels.gradients.maximum_likelihood_adjoint import LikelyPoints, pull_likely_points, sum_likely_corners
from ..kernels.gradients.mean_value_adjoint import PulledPoints, pull_positions, pull_weights, sum_mean_value_corners
from ..kernels.gradients.quad_mean_value_adjoint import pull_quad_positions, pull_quad_weights, sum_quad_corners
from ..mesh.mesh import ClosedMesh, prepared_fans, prepared_quads

#: Parts that points are cut into, each with sums of its own: on a CPU, which adds them up in the same order whatever
#: threads it has, and items of a launch on CUDA, of all faces together.
CPU_PARTS, CUDA_ITEMS = 32, 1 << 16


class CornerSums:
    """Sums over parts of the points, for each corner of a face of a cage's triangles, or of its bilinear patches."""

    def __init__(self, cage: ClosedMesh, device: wp.Device, quads: np.ndarray | None = None):
        self.cage, self.device, self.is_quads = cage, device, quads is not None
        corners = cage.faces if quads is None else quads
        self.faces = wp.array(corners, dtype=wp.vec3i if quads is None else wp.vec4i, device=device)
        self.fan_faces = wp.array(cage.topology.fans.faces, dtype=wp.vec3i, device=device)
        self.parts = CPU_PARTS if device.is_cpu else max(8, CUDA_ITEMS // self.faces.size)
        shape = (self.parts, *corners.shape)
        self.no_rows, self.no_vectors = empty_array((0, 0), wp.float32, device), empty_array(0, wp.vec3, device)
        self.arrays = [
            wp.zeros(shape, dtype=wp.vec3, device=device) for _ in range(2)
        ]  # by the cage, and by its targets
        self._starts, self._corners, self._shares = (
            wp.array(each, device=device) for each in _corner_shares(cage, corners)
        )

    def clear(self) -> None:
        """Launch what sets the sums to zero."""
        for array in self.arrays:
            array.zero_()

    def add_mean_value(
        self,
        points: wp.array,
        slopes: wp.array,
        vertices: wp.array,
        targets: wp.array,
        size: float,
        weights: wp.array | None = None,
    ) -> WarpStruct:
        """Add slopes of a number by a mean value map, from those by the positions (n,) vec3 of points (n,) vec3, in the
        unit of the vertices (v,), or by weights (n, v) where they are given. Returns what the points pass on."""
        pulled = PulledPoints()
        pulled.places, pulled.pulls, pulled.positions = (empty_array(points.size, wp.vec3, self.device) for _ in "ppp")
        pulled.totals = empty_array(points.size, wp.float32, self.device)
        if self.is_quads:
            surface = [vertices, self.faces, prepared_quads(vertices, self.faces, size)]
            pulls, add_up = (pull_quad_positions, pull_quad_weights), sum_quad_corners
        else:
            surface = [vertices, self.fan_faces, prepared_fans(vertices, self.fan_faces, size)]
            pulls, add_up = (pull_positions, pull_weights), sum_mean_value_corners
        if weights is None:
            rows = self.no_rows
            self._launch(pulls[0], points.size, [points, slopes, *surface, targets, size], [pulled])
        else:
            rows = slopes
            self._launch(pulls[1], points.size, [points, rows, weights, *surface, size], [pulled])
        self._launch(add_up, self._items, [pulled, vertices, self.faces, targets, rows, size], self.arrays)
        return pulled

    def add_maximum_likelihood(
        self, points: wp.array, slopes: wp.array, vertices: wp.array, targets: wp.array, size: float, rows: wp.array
    ) -> WarpStruct:
        """The same by maximum likelihood coordinates; rows: slopes by their weights (n, v), or (0, 0) for those by
        positions."""
        likely = LikelyPoints()
        likely.places = self._places(points, slopes, vertices, size)
        likely.pulls, likely.positions = (empty_array(points.size, wp.vec3, self.device) for _ in "pp")
        likely.phis, likely.lambdas = (empty_array(points.size, wp.vec3d, self.device) for _ in "pl")
        inputs = [slopes, rows, vertices, self.faces, targets, size]
        self._launch(pull_likely_points, points.size, inputs, [likely])
        inputs = [likely, vertices, self.faces, targets, rows, size]
        self._launch(sum_likely_corners, self._items, inputs, self.arrays)
        return likely

    def add_green(
        self, points: wp.array, slopes: wp.array, vertices: wp.array, targets: wp.array, normals: wp.array, size: float
    ) -> wp.array:
        """The same by a Green map; normals (f,) vec3: stretched ones of the targets. Returns the points, none of them
        on the cage."""
        places = self._places(points, slopes, vertices, size)
        inputs = [places, slopes, vertices, self.faces, targets, normals, self.no_rows, self.no_rows]
        by_normals = self._sum_green(inputs)
        inputs = [vertices, targets, self.faces, by_normals]
        launch(slope_stretched_normals, self.faces.size, inputs, self.arrays, device=self.device)
        return places

    def add_green_weights(
        self, points: wp.array, vertices: wp.array, rows: wp.array, face_rows: wp.array, size: float
    ) -> wp.array:
        """The same from slopes by Green weights, (n, v) of vertices and (n, f) of faces."""
        places = self._places(points, self.no_vectors, vertices, size)
        self._sum_green([places, places, vertices, self.faces, vertices, self.no_vectors, rows, face_rows])
        return places

    def _places(self, points: wp.array, slopes: wp.array, vertices: wp.array, size: float) -> wp.array:
        places = empty_array(points.size, wp.vec3, self.device)
        self._launch(place_off_cage, points.size, [points, slopes, vertices, self.faces, size], [places])
        return places

    def _sum_green(self, inputs: list) -> wp.array:
        by_normals = wp.zeros((self.parts, self.faces.size), dtype=wp.vec3, device=self.device)
        self._launch(sum_green_corners, self._items, inputs, [*self.arrays, by_normals])
        return by_normals

    @property
    def _items(self) -> int:
        return self.parts * self.faces.size

    def _launch(self, kernel, count: int, inputs: list, outputs: list | None = None) -> None:
        launch(kernel, count, inputs, outputs or [], device=self.device, work=self.faces.size)

    def gathered(self, scales: tuple[float, float]) -> tuple[wp.array, wp.array]:
        """The sums at each of the cage's own vertices, times scales: two (v,) vec3, by the cage and by its targets."""
        found = []
        for array, scale in zip(self.arrays, scales, strict=True):
            by_vertices = empty_array(self.cage.own_count, wp.vec3, self.device)
            inputs = [array.reshape((self.parts, -1)), self._starts, self._corners, self._shares, scale]
            launch(
                gather_corners, lane_count(self.device) * by_vertices.size, inputs, [by_vertices], device=self.device
            )
            found.append(by_vertices)
        return found[0], found[1]


def _corner_shares(cage: ClosedMesh, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which corners of faces (f, k), one after the other, each own vertex of a cage has a share in: of vertex j from
    starts[j] to starts[j + 1], and how much."""
    from scipy import sparse

    corners = faces.reshape(-1)
    shape = len(cage.vertices), len(corners)
    shares = sparse.csr_matrix((np.ones(len(corners)), (corners, np.arange(len(corners)))), shape)
    if cage.operator is not None:
        shares = (cage.operator.T @ shares).tocsr()
    shares.sort_indices()
    return shares.indptr.astype(np.int32), shares.indices.astype(np.int32), shares.data.astype(np.float32)
