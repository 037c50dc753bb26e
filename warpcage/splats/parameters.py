"""The values of splats on a device, as an optimiser steps them, and the slopes of a loss by them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view, empty_array
from ..core.devices import launch
from ..kernels.splats import parameters
from ..kernels.splats.project_slopes import ValueSlopes
from ..kernels.splats.splats import Splats
from .splat_field import SplatField

#: Names of the values, and the types of those that kernels read by rows.
VALUE_TYPES = {
    "centres": wp.vec3,
    "log_scales": wp.vec3,
    "quaternions": wp.vec4,
    "logits": wp.float32,
    "harmonics": wp.float32,
}


class SplatParameters:
    """Values of a field's splats that change, on its device; the field itself is left as it is."""

    def __init__(self, field: SplatField):
        self.field, held, count = field, field.contents, len(field)
        host = {name: np.asarray(getattr(held, name), np.float64) for name in VALUE_TYPES}
        host["centres"] = host["centres"] - field.center
        self._first_centres = host["centres"].astype(np.float32)
        # By name (VALUE_TYPES), (n, width) float32 each, centres relative to the field's `center`; and derivatives of a
        # loss by each of them.
        self.values: dict[str, wp.array] = {}
        self.slopes: dict[str, wp.array] = {}
        for name, values in host.items():
            rows = np.ascontiguousarray(values.reshape(count, values.size // max(count, 1)), np.float32)
            self.values[name] = wp.array(rows, dtype=wp.float32, device=field.device)
            self.slopes[name] = wp.zeros(rows.shape, dtype=wp.float32, device=field.device)
        # What `refresh` makes of the values.
        self.splats: Any = Splats()
        self.splats.centres = self.by_rows("centres", self.values)
        self.splats.covariances = empty_array((count, 6), wp.float32, field.device)
        self.splats.opacities = empty_array(count, wp.float32, field.device)
        self.splats.harmonics, self.splats.degree = self.values["harmonics"], field.degree
        self.splats.turns = empty_array(0, wp.quat, field.device)
        self.splats.rows = empty_array(0, wp.int32, field.device)
        # The slopes as kernels/splats/project_slopes.py writes them.
        self.value_slopes: Any = ValueSlopes()
        for name in VALUE_TYPES:
            setattr(self.value_slopes, name, self.by_rows(name, self.slopes))

    def by_rows(self, name: str, arrays: dict[str, wp.array]) -> wp.array:
        """An array of `values` or `slopes` as kernels read it: (n,) of VALUE_TYPES' type, for harmonics (n, width)."""
        array = arrays[name]
        return array if name == "harmonics" else array_view(array, VALUE_TYPES[name], array.shape[0])

    def refresh(self) -> None:
        """Make the covariances and opacities of `splats` from the values as they are now."""
        names = ("log_scales", "quaternions", "logits")
        inputs = [self.by_rows(name, self.values) for name in names]
        outputs = [self.splats.covariances, self.splats.opacities]
        launch(parameters.make_splats, len(self.field), inputs, outputs, device=self.field.device)

    def to_field(self) -> SplatField:
        """A field of the values as they are now, with what else the file of the first one says."""
        held, count = self.field.contents, len(self.field)
        host = {name: array.numpy() for name, array in self.values.items()}
        moved = host["centres"].astype(np.float64) - self._first_centres  # from where the file has them, to the bit
        centres = (held.centres + moved).astype(held.centres.dtype)
        return SplatField(
            centres,
            host["log_scales"],
            host["quaternions"],
            host["logits"].reshape(count),
            host["harmonics"].reshape(held.harmonics.shape),
            layout=held.layout,
            device=self.field.device,
            **self.field.view_options(),
        )
