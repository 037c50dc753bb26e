"""Points bound to a cage at rest: coordinates and their gradients once, then a weighted sum for each pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..coordinates.harmonic import WeightGaps
from ..core.arrays import empty_array
from ..core.devices import launch
from ..core.memory import require_memory
from ..kernels.splats import green_rows, lattice_rows, mean_value_rows, pose
from ..kernels.splats.packed_rows import PackedRows, carry_packed, pack_rows
from ..lattice.harmonic import HarmonicSolver
from ..lattice.lattice import CageLattice
from ..mesh.mesh import ClosedMesh
from .pose_fit import PoseFit

#: Points that are bound in one launch: their sums in float64 take 32 bytes a vertex.
CHUNK = 1 << 15

#: Cells along the longest side of the lattice of harmonic coordinates, where nobody asks for another number.
RESOLUTION = 128


class CageBinding:
    """Points in a cage at rest, and where a pose of it takes them, with the Jacobian of the map there."""

    # A pose costs one weighted sum a point: phi(x) = A x + t + sum_j w_j(x) r_j (kernels/splats/pose.py).

    def __init__(
        self,
        points: np.ndarray,  # (m, 3) world units, inside the cage, 1e-5 of its size or more from its faces
        cage: ClosedMesh,  # at rest, usable
        coordinates: str,  # "harmonic", "mean_value" or "green"
        origin: np.ndarray,  # (3,) world point that positions on the device are relative to
        device: wp.Device,
        resolution: int | None = None,  # harmonic only: cells of the lattice along the cage's longest side
        packed: bool | None = None,  # ten bytes an entry, gradients as half floats, instead of sixteen; None: on CUDA
    ):
        self._cage, self._device = cage, device
        self._fit = PoseFit(cage, coordinates, origin)
        # (j, m) vec4, weight and gradient (per size of the cage) of each vertex (Green: then face); None if packed
        self.rows: wp.array | None = None
        self.packed: Any = None  # the PackedRows of kernels/splats/packed_rows.py; None if not packed
        # On CUDA poses wait for memory; a CPU takes longer to unpack the rows.
        pack = not device.is_cpu if packed is None else packed
        count, height, corners = len(points), self._fit.row_count, len(cage.vertices)
        groups = (height + 3) // 4
        chunk = count if coordinates == "harmonic" else min(CHUNK, count)
        need = 40 * groups * count + 16 * height * chunk if pack else 16 * height * count
        if coordinates != "harmonic":
            need += 32 * corners * chunk
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
            self.packed.words = empty_array(((count + 31) // 32, groups, 160), wp.uint64, device)
            self.packed.scales = empty_array(count, wp.float32, device)
            rows = _columns(height, max(chunk, 1), wp.vec4, device)
        else:
            rows = self.rows = _columns(height, count, wp.vec4, device)
        if coordinates == "harmonic":
            self._bind_lattice(points, resolution or RESOLUTION, rows)
            self._pack(0, rows, count)
            return
        centre = cage.bounds.mean(axis=0)
        local = wp.array((points - centre) / cage.size, dtype=wp.vec3d, device=device)
        vertices = wp.array((cage.vertices - centre) / cage.size, dtype=wp.vec3d, device=device)
        faces = wp.array(cage.faces, dtype=wp.vec3i, device=device)
        scratch = _columns(corners, max(chunk, 1), wp.vec4d, device)
        kernel = green_rows.bind_green if coordinates == "green" else mean_value_rows.bind_mean_value
        for begin in range(0, count, CHUNK):
            items = min(CHUNK, count - begin)
            into = rows if pack else rows[:, begin : begin + items]
            inputs = [local[begin : begin + items], vertices, faces, scratch]
            launch(kernel, items, inputs, [into], device=device, work=4 * len(cage.faces))
            self._pack(begin, rows, items)

    def _pack(self, begin: int, rows: wp.array, items: int) -> None:
        """Pack rows (j, items or more) of points from `begin` on, where they are packed."""
        if self.packed is not None:
            launch(pack_rows, items, [begin, rows, self.packed], device=self._device, work=rows.shape[0])

    def _bind_lattice(self, points: np.ndarray, resolution: int, rows: wp.array) -> None:
        """Rows of harmonic coordinates."""
        cage, device = self._cage, self._device
        centre = cage.bounds.mean(axis=0)
        local = cage.with_vertices((cage.vertices - centre) / cage.size)
        lattice = CageLattice(local, resolution, device=device)
        places = ((points - centre) / cage.size - lattice.lower) / lattice.spacing
        places = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
        solver = HarmonicSolver(lattice)
        solver.prepare()
        gaps = WeightGaps(solver)
        for column, selected in solver.solve_vertices():
            inputs = [column, 1.0 / lattice.spacing, gaps.cage_map(selected), places]
            launch(lattice_rows.bind_lattice, len(points), inputs, [rows], device=device)
        gaps.report()
        launch(lattice_rows.settle_rows, len(points), [], [rows], device=device)

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


def _columns(height: int, count: int, dtype: Any, device: wp.Device) -> wp.array:
    """An array (height, count) whose columns lie together on the CPU, where a thread walks down one after another, and
    whose rows do on CUDA, where the threads of a warp walk side by side."""
    if device.is_cpu:
        return empty_array((count, height), dtype, device).transpose([1, 0])
    return empty_array((height, count), dtype, device)
