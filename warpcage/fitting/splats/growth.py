"""The splats of a fit on its device: their values, how they begin anew where there is something, and how they grow."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ...core.arrays import array_view, empty_array
from ...core.devices import launch
from ...kernels.fitting import splat_growth
from ...kernels.splats import fit
from ...kernels.splats.project_slopes import SplatValues
from ...kernels.splats.splats import Splats
from ...splats.io.contents import SplatContents

#: Numbers of a splat by kind, and the type of a row; harmonics are rows of numbers.
KINDS = {"centers": wp.vec3, "log_scales": wp.vec3, "quaternions": wp.vec4, "logits": wp.float32}

#: Opacity at which a splat is dead: Kheradmand et al. 2024.
DEAD_OPACITY = 0.005


class GrowingSplats:
    """Values of splats with Adam's means of their slopes, and room for more of them."""

    def __init__(self, contents: SplatContents, room: int, degree: int, device: wp.Device):
        self.device, self.count, self.room = device, contents.count, max(room, contents.count)
        self.numbers = 3 * (degree + 1) ** 2  # of a splat's harmonics
        self.values, self.means, self.squares = (self._rows() for _ in range(3))
        held = contents.harmonics.reshape(contents.count, -1)
        harmonics = np.zeros((contents.count, self.numbers), np.float32)
        harmonics[:, : held.shape[1]] = held[:, : self.numbers]
        for name in KINDS:
            self._set(getattr(self.values, name), getattr(contents, name))
        self._set(self.values.harmonics, harmonics)
        self.splats: Any = Splats()
        self.splats.centers, self.splats.harmonics = self.values.centers, self.values.harmonics
        self.splats.covariances = empty_array((self.room, 6), wp.float32, device)
        self.splats.opacities = empty_array(self.room, wp.float32, device)
        self.splats.turns, self.splats.rows = empty_array(0, wp.quat, device), empty_array(0, wp.int32, device)
        self.splats.degree = 0
        self._weights, self._ends = (empty_array(self.room, wp.int64, device) for _ in range(2))
        self._sources, self._copies = (empty_array(self.room, wp.int32, device) for _ in range(2))
        self.refresh()

    def _rows(self) -> Any:
        rows: Any = SplatValues()
        for name, dtype in KINDS.items():
            setattr(rows, name, wp.zeros(self.room, dtype=dtype, device=self.device))
        rows.harmonics = wp.zeros((self.room, self.numbers), dtype=wp.float32, device=self.device)
        return rows

    def _set(self, target: wp.array, values: np.ndarray) -> None:
        """Write the first rows of an array."""
        if len(values):
            source = wp.array(np.ascontiguousarray(values, np.float32), dtype=target.dtype, device=self.device)
            wp.copy(target, source, count=source.size)

    @staticmethod
    def row_bytes(degree: int) -> int:
        """Device memory of a splat: its values and their means, what is made of them, and what draws it."""
        bases = (degree + 1) ** 2
        return 4 * (3 * (11 + 3 * bases) + 7) + 24 + 148 + 4 * bases

    def refresh(self) -> None:
        """Make the covariances and opacities of the values as they are now."""
        inputs = [self.values.log_scales, self.values.quaternions, self.values.logits]
        launch(fit.make_splats, self.count, inputs, [self.splats], device=self.device)

    def revive(self, seed: int) -> None:
        """Let dead splats begin anew as copies of living ones."""
        self._copy_to(self.count, DEAD_OPACITY, seed)

    def grow(self, count: int, seed: int) -> None:
        """Add copies of splats until there are so many, at most as there is room for."""
        count = min(count, self.room)
        if count > self.count:
            self._copy_to(count, -1.0, seed)

    def _copy_to(self, count: int, least: float, seed: int) -> None:
        """Make splats of opacity `least` or less, and those that are added, copies of others."""
        device, before = self.device, self.count
        weights, ends = (array_view(each, wp.int64, before) for each in (self._weights, self._ends))
        inputs = [least, self.splats.opacities, self.values, self.squares]
        launch(splat_growth.weigh_splats, before, inputs, [weights], device=device)
        wp.utils.array_scan(weights, ends)
        copies = array_view(self._copies, wp.int32, before)
        copies.zero_()
        # copies are counted by atomics, which threads of a CPU do not share
        inputs, outputs = [before, seed, weights, ends], [self._sources, copies]
        launch(splat_growth.draw_sources, count, inputs, outputs, device=device, threads=1)
        rows = [self.values, self.means, self.squares]
        inputs = [DEAD_OPACITY, self._sources, copies, *rows]
        launch(splat_growth.copy_sources, count, inputs, device=device)
        launch(splat_growth.settle_sources, before, [DEAD_OPACITY, copies, *rows], device=device)
        self.count = count
        self.refresh()

    @property
    def widths(self) -> dict[str, int]:
        """Numbers of a splat by kind."""
        return {"centers": 3, "log_scales": 3, "quaternions": 4, "logits": 1, "harmonics": self.numbers}

    def state(self) -> dict[str, dict[str, np.ndarray]]:
        """Values, and means of slopes and of their squares, by kind, on the host."""
        parts = {"values": self.values, "means": self.means, "squares": self.squares}
        return {
            part: {name: getattr(rows, name)[: self.count].numpy() for name in self.widths}
            for part, rows in parts.items()
        }

    def restore(self, state: dict[str, dict[str, np.ndarray]]) -> None:
        """Go on with what `state` gave."""
        self.count = len(state["values"]["centers"])
        for part, rows in state.items():
            for name, array in rows.items():
                self._set(getattr(getattr(self, part), name), array)
        self.refresh()

    def to_contents(self, degree: int) -> dict[str, np.ndarray]:
        """The values on the host, as the arguments of SplatField name them."""
        host = {name: getattr(self.values, name)[: self.count].numpy() for name in KINDS}
        rows = self.values.harmonics[: self.count].numpy()
        host["harmonics"] = rows.reshape(self.count, -1, 3)[:, : (degree + 1) ** 2]
        return host
