"""Fit the layers behind a field, beside the field's own fit."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from ..core.devices import launch
from ..core.files import require_numbers
from ..core.threads import run_parallel
from ..field.background import LayeredBackground, surface_node_count
from ..kernels.field.background import BackgroundLayers, refine_layers
from ..kernels.fitting import background_loss
from ..kernels.fitting import rmsprop as field_step

#: What may stand behind the pictures while they are fitted.
KINDS = ("auto", "layers", "random", "constant")

#: Opacity of all layers before the last together, at the start.
START_OPACITY = 0.5

#: Where this share of the pictures' border pixels has the scene's background colour, nothing else is taken to be there.
PLAIN_SHARE, PLAIN_DIFFERENCE = 0.95, 2.5 / 255


def chosen_background(scene, kind: str) -> tuple[bool, bool]:
    """Whether random colours, and whether layers go behind the pictures: what `kind` (see KINDS) means for a scene.

    "auto" is random colours where the pictures carry opacity, with layers where masks split their surroundings off;
    without opacity layers, unless the pictures' border says that there is nothing but the background colour.
    Raises ValueError for another kind, or one that does not go with the scene.
    """
    if kind not in KINDS:
        raise ValueError(f"background {kind!r} is not known: {', '.join(KINDS)}")
    if kind == "auto":
        if scene.alphas is None:
            return False, not _is_plain(scene)
        return True, scene.surroundings is not None
    if kind == "layers" and scene.alphas is not None and scene.surroundings is None:
        raise ValueError(
            "the pictures' own background is cut away by their opacity: background layers need whole "
            "pictures (masks=False) or split ones (masks='split')"
        )
    if kind == "random" and scene.alphas is None:
        raise ValueError("the pictures have no opacity: random backgrounds need it, fit with background='layers'")
    return kind == "random" or (kind == "layers" and scene.alphas is not None), kind == "layers"


def _is_plain(scene) -> bool:
    images = scene.images
    border = np.concatenate([images[:, [0, -1]].reshape(-1, 3), images[:, :, [0, -1]].reshape(-1, 3)])
    same = (np.abs(border - scene.background) < PLAIN_DIFFERENCE).all(axis=1)
    return bool(same.mean() >= PLAIN_SHARE)


def layers_that_fit(scene, options, shards: int, limit: int) -> tuple[int, int]:
    """Cells along a layer's edge that the options ask for, or fewer for a quarter of `limit` bytes, and the bytes that
    the layers and their gradients then take."""
    side = options.background_side
    if side is None:
        focal = float(np.median([camera.fx for camera in scene.cameras]))  # pixels a unit of a face's half side
        side = int(
            np.clip(
                2.0 * focal * options.background_detail,
                min(16, options.max_background_side),
                options.max_background_side,
            )
        )
    node_bytes = options.background_layers * 16 * (2 + shards)  # vec4: values, moments and gradients
    side = max(2, min(side, math.isqrt(int(limit / (4 * 6 * node_bytes)))))
    return side, node_bytes * surface_node_count(side)


class BackgroundOptimizer:
    """RMSProp on the layers behind a field, one step beside each of the field's.

    scene: Scene of whole pictures, whose every ray the field and the layers explain together; or of split ones, whose
    surroundings the layers explain alone. pictures: TrainingPictures of it. bounds: (2, 3) of the field. options:
    FitOptions. side: cells along a layer's edge in the end. batch_rays: of a batch. shards: gradient arrays, one a CPU
    thread. `prepare`, `accumulate` and `apply` make a step.
    """

    def __init__(self, scene, pictures, bounds, options, side: int, batch_rays: int, shards: int, device):
        self.options, self.device, self.batch_rays, self.shards = options, device, batch_rays, shards
        self.pictures = pictures
        self.center, self.half = bounds.mean(axis=0), 0.5 * float((bounds[1] - bounds[0]).max())
        self.sides = [max(2, round(side / 2 ** (options.levels - 1 - level))) for level in range(options.levels)]
        self.start = np.empty(4, np.float32)  #: of each node
        self.start[:3] = _mean_colour(scene)
        self.start[3] = -math.log(1.0 - START_OPACITY) / (options.background_layers - 1)
        self.layers = None
        self.start_level(0)
        self.behind = None  #: (rays,) vec3 what each ray of a batch sees behind the field, where the field's march asks
        if scene.surroundings is None:
            self.behind = wp.zeros(batch_rays, dtype=wp.vec3, device=device)
        self._grad_behind = wp.zeros(batch_rays, dtype=wp.vec3, device=device)

    def start_level(self, level: int) -> None:
        """Cells for a level of the field's, interpolated from the ones before; fresh gradients and moments."""
        self.gradients = self.moments = None  # room for the new ones
        coarse = self.layers
        shape = (self.options.background_layers, surface_node_count(self.sides[level]))
        layers = BackgroundLayers()
        layers.half, layers.side = self.half, self.sides[level]
        if coarse is None:
            layers.values = wp.full(shape, wp.vec4(*self.start), dtype=wp.vec4, device=self.device)
        else:
            layers.values = wp.empty(shape, dtype=wp.vec4, device=self.device)
            launch(refine_layers, layers.values.size, [coarse, layers.side], [layers.values], device=self.device)
        self.layers = layers
        self.moments = wp.zeros(shape, dtype=wp.vec4, device=self.device)
        self.gradients = [wp.zeros(shape, dtype=wp.vec4, device=self.device) for _ in range(self.shards)]

    @property
    def grad_behind(self) -> wp.array | None:
        """(rays,) vec3, where the field's march leaves the loss's gradient by `behind`."""
        return None if self.behind is None else self._grad_behind

    def prepare(self, rays) -> None:
        """Before the field's march of a batch: fill `behind`, or compare with the surroundings."""
        if self.pictures.surroundings is None:
            launch(
                background_loss.gather_background,
                self.batch_rays,
                [self.layers, rays],
                [self.behind],
                device=self.device,
            )
        else:
            inputs = [self.layers, rays, self.pictures.surroundings, 1.0 / (3.0 * self.batch_rays)]
            launch(
                background_loss.compare_surroundings, self.batch_rays, inputs, [self._grad_behind], device=self.device
            )

    def accumulate(self, rays, random: np.random.Generator) -> None:
        """Gradients of the batch, after the field's march, and of the total variation."""
        options = self.options
        nodes = self.layers.values.size
        varied = max(1, int(options.variation_share * nodes))
        first_node = int(random.integers(nodes))
        boost = nodes / varied / nodes
        variation = [
            self.layers,
            self.moments,
            first_node,
            options.variation_background * boost,
            options.variation_background_depth * boost,
        ]

        def shard(index: int) -> None:
            begin, end = (self.batch_rays * i // self.shards for i in (index, index + 1))
            wp.launch(
                background_loss.accumulate_background_gradient,
                dim=end - begin,
                inputs=[begin, self.layers, rays, self._grad_behind],
                outputs=[self.gradients[index]],
                device=self.device,
            )
            begin, end = (varied * i // self.shards for i in (index, index + 1))
            if end > begin:
                wp.launch(
                    background_loss.accumulate_layer_variation,
                    dim=end - begin,
                    inputs=[begin, *variation],
                    outputs=[self.gradients[index]],
                    device=self.device,
                )

        wp.load_module(background_loss, device=self.device)
        run_parallel([lambda i=i: shard(i) for i in range(self.shards)], self.shards)

    def apply(self, progress: float) -> None:
        """One step; progress: 0 to 1 through the fit."""
        options = self.options
        start, end = options.rate_background, options.rate_background_end
        rate = math.exp((1.0 - progress) * math.log(start) + progress * math.log(end))
        total, *others = map(_numbers, self.gradients)
        for other in others:
            launch(field_step.add_gradients, total.size, [other], [total], device=self.device)
        launch(
            background_loss.apply_layer_rmsprop,
            total.size,
            [rate, options.beta, 1e-12, total, _numbers(self.moments)],
            [_numbers(self.layers.values)],
            device=self.device,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Values and second moments of the nodes that a ray has met, for a checkpoint."""
        values = self.layers.values.numpy()
        met = (np.abs(values - self.start) > 1e-6).any(axis=-1)  # interpolation rounds
        return {
            "layers_met": np.packbits(met.ravel()),
            "layers_values": values[met],
            "layers_moments": self.moments.numpy()[met],
        }

    def restore(self, contents: dict, level: int, path) -> None:
        """Take over the state of a level. Raises ValueError for one that does not fit."""
        self.layers = None
        self.start_level(level)
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

    def result(self) -> LayeredBackground:
        """The layers so far, colours in [0, 1] and optical depths of at least 0."""
        values = self.layers.values.numpy()
        values[..., :3] = np.clip(values[..., :3], 0.0, 1.0)
        values[..., 3] = np.maximum(values[..., 3], 0.0)
        return LayeredBackground(
            self.center, self.half, self.layers.side, values, unseen=self.start, device=self.device
        )


def _mean_colour(scene) -> np.ndarray:
    """(3,) of the pictures, or of their surroundings."""
    if scene.surroundings is None:
        return scene.images[:, ::8, ::8].reshape(-1, 3).mean(axis=0)
    share = (1.0 - scene.alphas[:, ::8, ::8]).sum()
    return scene.surroundings[:, ::8, ::8].reshape(-1, 3).sum(axis=0) / max(float(share), 1.0)


def _numbers(array: wp.array) -> wp.array:
    """The numbers of an array of vec4, one after another, without a copy."""
    return wp.array(ptr=array.ptr, dtype=wp.float32, shape=4 * array.size, device=array.device, copy=False)
