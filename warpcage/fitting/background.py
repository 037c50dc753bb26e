"""Fit the layers behind a field, together with the field."""

from __future__ import annotations

import math
import pathlib
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view
from ..core.devices import launch
from ..core.files import require_numbers
from ..core.names import FIT_BACKGROUNDS
from ..field.io.field_file import surface_node_count
from ..field.surroundings import LayeredBackground
from ..field.voxel_field import VoxelField
from ..kernels.field.background import BackgroundLayers, refine_layers
from ..kernels.fitting import background_loss
from ..scene.scene import Scene
from .options import FitOptions
from .schedule import Rates
from .shards import ShardedWork, launch_shards, sum_shards

#: Opacity of all layers in front of the last one together, at the start.
START_OPACITY = 0.5

#: Where this share of the pictures' border pixels has the scene's background colour, nothing else is taken to be there.
PLAIN_SHARE, PLAIN_DIFFERENCE = 0.95, 2.5 / 255

#: Share of the memory of a fit that layers may take, and least cells along an edge that the images ask for.
MEMORY_SHARE, LEAST_SIDE = 0.25, 16

#: Bytes of a node's colour and optical depth, and of a colour.
NODE_BYTES, COLOUR_BYTES = 16, 12

#: Nodes that differ from the start by no more than this were met by no ray: interpolation rounds.
UNMET_DIFFERENCE = 1e-6

#: Every how many pixels the mean colour takes one.
COLOUR_STRIDE = 8

#: Keeps a step finite where the second moment is almost zero.
EPSILON = 1e-12


def chosen_background(scene: Scene, kind: str) -> tuple[bool, str | None]:
    """Whether random colours are behind a field in a fit; and "layers", "outer" or None, what is fitted beside it."""
    if kind not in FIT_BACKGROUNDS:
        raise ValueError(f"background {kind!r} is not known: {', '.join(FIT_BACKGROUNDS)}")
    if kind == "auto":
        # without opacity an outer field, unless the border of the pictures shows the background colour alone; layers
        # where masks split the surroundings off
        if scene.alphas is None:
            return False, None if _is_plain(scene) else "outer"
        return True, None if scene.surroundings is None else "layers"
    if kind == "layers" and scene.alphas is not None and scene.surroundings is None:
        raise ValueError(
            "the pictures' own background is cut away by their opacity: background layers need whole "
            "pictures (masks=False) or split ones (masks='split')"
        )
    if kind == "outer" and scene.alphas is not None:
        raise ValueError("an outer field needs whole pictures: load them with masks=False, or fit background='layers'")
    if kind == "random" and scene.alphas is None:
        raise ValueError("the pictures have no opacity: random backgrounds need it, fit with background='layers'")
    is_random = kind == "random" or (kind == "layers" and scene.alphas is not None)
    return is_random, kind if kind in ("layers", "outer") else None


def _is_plain(scene: Scene) -> bool:
    images = scene.images
    border = np.concatenate([images[:, [0, -1]].reshape(-1, 3), images[:, :, [0, -1]].reshape(-1, 3)])
    same = (np.abs(border - scene.background) < PLAIN_DIFFERENCE).all(axis=1)
    return bool(same.mean() >= PLAIN_SHARE)


def layers_that_fit(scene: Scene, options: FitOptions, shards: int, limit: int) -> tuple[int, int]:
    """Cells along a layer's edge, and the bytes that the layers, their moments and their gradients then take.
    shards: arrays of gradients, one for each CPU thread; limit: bytes that the fit may take."""
    side = options.background_side
    if side is None:
        focal = float(np.median([camera.fx for camera in scene.cameras]))  # pixels per unit of a face's half side
        least = min(LEAST_SIDE, options.max_background_side)
        side = int(np.clip(2.0 * focal * options.background_detail, least, options.max_background_side))
    surface_bytes = options.background_layers * NODE_BYTES * (2 + shards)  # values, moments and gradients
    side = max(2, min(side, math.isqrt(int(limit * MEMORY_SHARE / (6 * surface_bytes)))))
    return side, surface_bytes * surface_node_count(side)


class BackgroundOptimizer:
    """RMSProp on the layers behind a field, one step with each of the field's.
    `prepare`, `accumulate` and `apply` make a step, in this order."""

    #: Nothing is before the field.
    front = grad_front = None

    def __init__(
        self,
        colour: np.ndarray,
        # False for whole pictures, whose every ray the field and the layers explain together; True for split ones,
        # whose surroundings the layers explain alone
        split: bool,
        bounds: np.ndarray,
        options: FitOptions,
        # cells along a layer's edge in the last level
        side: int,
        batch_rays: int,
        # arrays of gradients, one for each CPU thread
        shards: int,
        device: wp.Device,
    ):
        self.options, self.device, self.batch_rays, self.shards = options, device, batch_rays, shards
        self.center, self.half = bounds.mean(axis=0), 0.5 * float((bounds[1] - bounds[0]).max())
        # cells along a layer's edge in each level
        self.sides = [max(2, round(side / 2 ** (options.levels - 1 - level))) for level in range(options.levels)]
        self.start = np.empty(4, np.float32)  #: of each node
        self.start[:3] = colour
        self.start[3] = -math.log(1.0 - START_OPACITY) / (options.background_layers - 1)
        self.layers = self._untouched(0)
        # (layers, nodes) vec4 for each shard, as the second moments
        self.gradients: list[wp.array] = []
        self.moments = wp.zeros(0, dtype=wp.vec4, device=device)
        self._allocate()
        # (rays,) vec3, what each ray of a batch sees behind the field; split pictures do not need it
        self.behind = None if split else wp.zeros(batch_rays, dtype=wp.vec3, device=device)
        self._grad_behind = wp.zeros(batch_rays, dtype=wp.vec3, device=device)

    def start_level(self, level: int, rays: Any, field: VoxelField) -> None:
        """Layers of a level, interpolated from the ones before; gradients and moments start anew.
        The rest is not used: layers are not pruned."""
        self._release()
        coarse, self.layers = self.layers, self._untouched(level)
        values = self.layers.values
        launch(refine_layers, values.size, [coarse, self.layers.side], [values], device=self.device)
        del coarse
        self._allocate()

    def _untouched(self, level: int) -> Any:
        """BackgroundLayers of a level as they start."""
        layers: Any = BackgroundLayers()
        layers.half, layers.side = self.half, self.sides[level]
        shape = (self.options.background_layers, surface_node_count(layers.side))
        layers.values = wp.full(shape, wp.vec4(*self.start), dtype=wp.vec4, device=self.device)
        return layers

    def _release(self) -> None:
        """Free the memory of gradients and second moments."""
        self.gradients, self.moments = [], wp.zeros(0, dtype=wp.vec4, device=self.device)

    def _allocate(self) -> None:
        """Fresh gradients and second moments."""
        shape = self.layers.values.shape
        self.moments = wp.zeros(shape, dtype=wp.vec4, device=self.device)
        self.gradients = [wp.zeros(shape, dtype=wp.vec4, device=self.device) for _ in range(self.shards)]

    @property
    def held_bytes(self) -> int:
        """Device memory of the layers of this level, and of the colours behind a batch."""
        colours = self.batch_rays * (1 if self.behind is None else 2)
        return NODE_BYTES * self.layers.values.size * (2 + self.shards) + COLOUR_BYTES * colours

    @property
    def grad_behind(self) -> wp.array | None:
        """(rays,) vec3, where the field's march leaves the loss's gradient by `behind`. None where that is None."""
        return None if self.behind is None else self._grad_behind

    def prepare(self, rays: Any, surroundings: Any) -> None:
        """Fill `behind`, or compare with the surroundings that masks split off, None for whole pictures.
        Before the field's march of a batch; rays: TrainingRays that begin at its first tile."""
        if self.behind is not None:
            self.gather(rays, self.behind)
        else:
            inputs = [self.layers, rays, surroundings, 1.0 / (3.0 * self.batch_rays)]
            outputs = [self._grad_behind]
            launch(background_loss.compare_surroundings, self.batch_rays, inputs, outputs, device=self.device)

    def gather(self, rays: Any, behind: wp.array, front: wp.array | None = None) -> None:
        """Fill `behind`, (rays,) vec3, with what TrainingRays see of the layers; front is not used."""
        launch(background_loss.gather_background, behind.size, [self.layers, rays], [behind], device=self.device)

    def accumulate(self, rays: Any, random: np.random.Generator) -> None:
        """Add the gradients of the batch, after the field's march, and of the total variation.
        random: chooses the first node that gets one of the total variation."""
        options = self.options
        nodes = self.layers.values.size
        varied = max(1, int(options.variation_share * nodes))
        boost = nodes / varied / nodes
        variation = [
            self.layers,
            self.moments,
            int(random.integers(nodes)),
            options.variation_background * boost,
            options.variation_background_depth * boost,
        ]
        outputs = [[gradients] for gradients in self.gradients]
        photometric = [self.layers, rays, self._grad_behind]
        launch_shards(
            [
                ShardedWork(background_loss.accumulate_background_gradient, self.batch_rays, photometric, outputs),
                ShardedWork(background_loss.accumulate_layer_variation, varied, variation, outputs),
            ],
            self.shards,
            self.device,
        )

    def thin_out(self, rays: Any, field: VoxelField) -> None:
        """Nothing: layers are not pruned."""

    def apply(self, rates: Rates) -> None:
        """One step of RMSProp by the gradients, which are cleared."""
        total = sum_shards([_numbers(gradients) for gradients in self.gradients])
        inputs = [rates.background, self.options.beta, EPSILON, total, _numbers(self.moments)]
        outputs = [_numbers(self.layers.values)]
        launch(background_loss.apply_layer_rmsprop, total.size, inputs, outputs, device=self.device)

    def state(self) -> dict[str, np.ndarray]:
        """Values and second moments of the nodes that a ray has met, for a checkpoint."""
        values = self.layers.values.numpy()
        met = (np.abs(values - self.start) > UNMET_DIFFERENCE).any(axis=-1)
        return {
            "layers_met": np.packbits(met.ravel()),
            "layers_values": values[met],
            "layers_moments": self.moments.numpy()[met],
        }

    def restore(self, contents: dict[str, np.ndarray], level: int, path: pathlib.Path) -> None:
        """Take over the state of a level from a checkpoint's arrays; path: for errors."""
        self._release()
        self.layers = self._untouched(level)
        self._allocate()
        shape = self.moments.shape
        size = shape[0] * shape[1]
        packed = require_numbers(contents, "layers_met", (-(-size // 8),), path)
        met = np.unpackbits(packed, count=size).astype(bool).reshape(shape)
        for name, target in (("layers_values", self.layers.values), ("layers_moments", self.moments)):
            rows = require_numbers(contents, name, (int(met.sum()), 4), path)
            if not np.isfinite(rows).all() or (name == "layers_moments" and rows.min(initial=0.0) < 0):
                raise ValueError(f"{name} holds values that cannot be")
            values = target.numpy()
            values[met] = rows
            target.assign(values)

    def result(self, rays: Any, field: VoxelField) -> LayeredBackground:
        """The layers so far, colours in [0, 1] and optical depths of at least 0; the arguments are not used."""
        values = self.layers.values.numpy()
        values[..., :3] = np.clip(values[..., :3], 0.0, 1.0)
        values[..., 3] = np.maximum(values[..., 3], 0.0)
        return LayeredBackground(
            self.center, self.half, self.layers.side, values, unseen=self.start, device=self.device
        )


def mean_colour(scene: Scene) -> np.ndarray:
    """(3,) mean colour of a scene's pictures, or of what masks split off them."""
    thinned = slice(None), slice(None, None, COLOUR_STRIDE), slice(None, None, COLOUR_STRIDE)
    if scene.surroundings is None or scene.alphas is None:
        return scene.images[thinned].reshape(-1, 3).mean(axis=0)
    share = (1.0 - scene.alphas[thinned]).sum()
    return scene.surroundings[thinned].reshape(-1, 3).sum(axis=0) / max(float(share), 1.0)


def _numbers(array: wp.array) -> wp.array:
    """The numbers of an array of vec4, one after another, without a copy."""
    return array_view(array, wp.float32, (4 * array.size,))
