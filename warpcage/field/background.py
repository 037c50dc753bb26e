"""What lies behind a voxel field: layers of pictures on cubes around it, out to infinity."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import as_host_points
from ..core.devices import launch, resolve_device
from ..kernels.field.background import BackgroundLayers, add_background, sample_background
from ..view.frame import camera_struct, tile_threads


class LayeredBackground:
    """Colour and opacity on concentric cubes, even in inverse distance, the last one opaque at infinity (multi-sphere
    images, Plenoxels 2022, section 3.3, in the max norm).

    center: (3,) world units, of all cubes. half: half side of the innermost one, world units. side: cells along a
    cube's edge. values: (layers, 6 side^2 + 2, 4) red, green, blue and optical depth (its negative part counts as
    none; the last layer's is not used) at the surface's lattice points, in the order of kernels.background; or a Warp
    array (layers, nodes) of vec4. unseen: (4,) what nodes hold that no picture showed, or None. device: Warp device;
    None is CUDA where there is one.

    A ray meets a layer where it leaves the cube; what lies between a camera outside the cubes and the field is taken
    for empty. Raises ValueError for shapes that do not fit or values that are not finite.
    """

    def __init__(self, center, half: float, side: int, values, *, unseen=None, device=None):
        self.device = resolve_device(values.device if device is None and isinstance(values, wp.array) else device)
        self.center = np.array(center, np.float64)
        if self.center.shape != (3,) or not np.isfinite(self.center).all():
            raise ValueError(f"a background's center must be (3,) and finite, got {self.center.tolist()}")
        if not (np.isfinite(half) and half > 0):
            raise ValueError(f"a background's half side must be positive, got {half}")
        if int(side) != side or side < 2:
            raise ValueError(f"a background has 2 cells or more along an edge, got {side}")
        if not isinstance(values, wp.array):
            values = np.asarray(values, np.float32)
            if not np.isfinite(values).all():
                raise ValueError("a background's values must be finite")
        shape = tuple(values.shape) + ((4,) if isinstance(values, wp.array) else ())
        if len(shape) != 3 or shape[0] < 2 or shape[1:] != (surface_node_count(side), 4):
            raise ValueError(
                f"a background of {side} cells along an edge has values (2 layers or more, "
                f"{surface_node_count(side)}, 4), got {shape}"
            )
        self.unseen = None if unseen is None else np.array(unseen, np.float32)
        if self.unseen is not None and (self.unseen.shape != (4,) or not np.isfinite(self.unseen).all()):
            raise ValueError(f"a background's unseen must be (4,) and finite, got {self.unseen.tolist()}")
        layers = BackgroundLayers()
        layers.half, layers.side = float(half), int(side)
        if isinstance(values, wp.array):
            layers.values = values if values.device == self.device else values.to(self.device)
        else:
            layers.values = wp.array(values, dtype=wp.vec4, device=self.device)
        self.layers = layers  #: what kernels take; positions in it are relative to `center`

    @property
    def half(self) -> float:
        """Half side of the innermost cube, world units."""
        return self.layers.half

    @property
    def side(self) -> int:
        """Cells along an edge of a cube."""
        return self.layers.side

    @property
    def layer_count(self) -> int:
        return self.layers.values.shape[0]

    @property
    def values(self) -> np.ndarray:
        """(layers, nodes, 4) float32 red, green, blue and optical depth."""
        return self.layers.values.numpy()

    def arguments(self) -> dict:
        """The constructor's arguments but for the device, on the host."""
        return {
            "center": self.center,
            "half": self.half,
            "side": self.side,
            "values": self.values,
            "unseen": self.unseen,
        }

    def __repr__(self) -> str:
        return f"LayeredBackground({self.layer_count} layers of 6x{self.side}x{self.side}, {self.device})"

    def sample(self, origins, directions) -> np.ndarray:
        """Colours (n, 3) float32 along rays from origins (n, 3), world units, in directions (n, 3) of any length but
        zero. Raises ValueError for shapes that differ or are not (n, 3)."""
        origins, directions = as_host_points(origins) - self.center, as_host_points(directions)
        if origins.shape != directions.shape:
            raise ValueError(f"origins and directions must be as many, got {len(origins)} and {len(directions)}")
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        rays = [wp.array(each.astype(np.float32), dtype=wp.vec3, device=self.device) for each in (origins, directions)]
        rgb = wp.empty(len(origins), dtype=wp.vec3, device=self.device)
        launch(sample_background, len(origins), [self.layers, *rays], [rgb], device=self.device)
        return rgb.numpy()

    def add_behind(self, camera, rgb: wp.array, alpha: wp.array) -> None:
        """Put the background behind a view of opacity alpha (h * w,) that was rendered on black, rgb (h * w,) vec3."""
        inputs = [self.layers, camera_struct(camera, self.center), alpha]
        launch(add_background, tile_threads(camera), inputs, [rgb], device=self.device)

    def to(self, device) -> LayeredBackground:
        """The same background on another device."""
        device = resolve_device(device)
        if device == self.device:
            return self
        return LayeredBackground(
            self.center, self.half, self.side, self.layers.values, unseen=self.unseen, device=device
        )


def surface_node_count(side: int) -> int:
    """Lattice points on the surface of a cube of `side` cells along an edge."""
    return 6 * int(side) ** 2 + 2
