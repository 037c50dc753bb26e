"""What lies behind a voxel field: layers of pictures on cubes around it, out to infinity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.checks import checked_positive, checked_vector
from ..core.devices import launch, resolve_device
from ..core.locks import device_turn, in_turn
from ..kernels.field.background import BackgroundLayers, add_background, sample_background
from ..view.camera import Camera, camera_struct, tile_threads
from .around import seen_by_rays
from .files.contents import LayerContents, surface_node_count


class LayeredBackground:
    """Colour and opacity on concentric cubes, the last one opaque at infinity; values (layers, 6 side^2 + 2, 4)."""

    # Multi-sphere images (Plenoxels 2022, section 3.3) in the max norm, even in inverse distance. A ray meets a layer
    # where it leaves the cube. What lies between a camera outside the cubes and the field is taken to be empty.

    def __init__(
        self,
        center: ArrayLike,
        half: float,
        side: int,
        values: np.ndarray | wp.array,
        *,
        unseen: ArrayLike | None = None,
        device: wp.DeviceLike = None,
    ):
        self.device = resolve_device(values.device if device is None and isinstance(values, wp.array) else device)
        if int(side) != side or side < 2:
            raise ValueError(f"a background has 2 cells or more along an edge, got {side}")
        node_count = surface_node_count(side)
        # (3,) float64, world units
        self.center = checked_vector(center, "a background's center").copy()
        half = checked_positive(half, "a background's half side")
        # red, green, blue and optical depth at the surface's lattice points, in the order of kernels/field/background;
        # negative depths count as none, the last layer's is not used
        if not isinstance(values, wp.array):
            values = np.asarray(values, np.float32)
            if not np.isfinite(values).all():
                raise ValueError("a background's values must be finite")
        shape = tuple(values.shape) + ((4,) if isinstance(values, wp.array) else ())
        if len(shape) != 3 or shape[0] < 2 or shape[1:] != (node_count, 4):
            raise ValueError(
                f"a background of {side} cells along an edge has values (2 layers or more, "
                f"{node_count}, 4), got {shape}"
            )
        # what nodes hold that no picture showed; None where that is not known
        self.unseen = None if unseen is None else np.array(unseen, np.float32)
        if self.unseen is not None and (self.unseen.shape != (4,) or not np.isfinite(self.unseen).all()):
            raise ValueError(f"a background's unseen must be (4,) and finite, got {self.unseen.tolist()}")
        layers = BackgroundLayers()
        layers.half, layers.side = half, int(side)
        if isinstance(values, wp.array):
            layers.values = values if values.device == self.device else values.to(self.device)
        else:
            with device_turn(self.device):
                layers.values = wp.array(values, dtype=wp.vec4, device=self.device)
        # positions in it are relative to the centre
        self.layers = layers

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
        """Number of cubes."""
        return self.layers.values.shape[0]

    @property
    @in_turn
    def values(self) -> np.ndarray:
        """(layers, nodes, 4) float32 red, green, blue and optical depth."""
        return self.layers.values.numpy()

    @classmethod
    def from_contents(cls, contents: LayerContents, device: wp.DeviceLike = None) -> LayeredBackground:
        """The background of a file."""
        return cls(
            contents.center, contents.half, contents.side, contents.values, unseen=contents.unseen, device=device
        )

    def contents(self) -> LayerContents:
        """The layers on the host, for a file."""
        return LayerContents(self.center, self.half, self.side, self.values, self.unseen)

    @property
    def summary(self) -> str:
        """What it is, in a few words."""
        return f"{self.layer_count} background layers"

    def __repr__(self) -> str:
        return f"LayeredBackground({self.layer_count} layers of 6x{self.side}x{self.side}, {self.device})"

    @in_turn
    def sample(self, origins: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Colours (n, 3) float32 that rays see of the layers; origins (n, 3), world units.
        directions: (n, 3), of any length but zero."""
        return seen_by_rays(sample_background, self.layers, self.center, origins, directions, self.device)

    def add_around(
        self, camera: Camera, rgb: wp.array, alpha: wp.array, depth: wp.array, masks: Sequence[wp.array] = ()
    ) -> None:
        """Put the background behind a view on black: rgb (h * w,) vec3, changed, alpha (h * w,).
        depth and masks are not used: all layers lie behind."""
        inputs = [self.layers, camera_struct(camera, self.center), alpha]
        launch(add_background, tile_threads(camera), inputs, [rgb], device=self.device)

    def to(self, device: wp.DeviceLike) -> LayeredBackground:
        """The same background on another device; this one if it is there already."""
        device = resolve_device(device)
        if device == self.device:
            return self
        return LayeredBackground(
            self.center, self.half, self.side, self.layers.values, unseen=self.unseen, device=device
        )
