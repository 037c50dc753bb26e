"""Gradient of a frame of posed splats by the posed cage, by the camera, and by the splats at rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import SpareMemory, launch
from ..deform.deformer import Deformer
from ..deform.splat_edits import SplatEdits
from ..errors import InputError
from ..field.render import RenderOptions
from ..kernels.fitting.cameras import CAMERA_NUMBERS
from ..kernels.gradients.splat_pose import CarriedSlopes, propagate_pose, weigh_pixels
from ..splats.fit import VALUE_TYPES, SplatGradients, as_values, value_slopes
from ..splats.render import IMAGE_BLUR, PROJECT_WORK, splat_lens
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from .loss import FrameGradient, column_sums


class SplatBackward:
    """What gradients of a Deformer's splats keep between calls."""

    def __init__(self, field: SplatField):
        self.renderer, self.spare = SplatGradients(field.device), SpareMemory(field.device)
        self._field = field
        self._shapes: list[wp.array] = []

    @property
    def shapes(self) -> list[wp.array]:
        """Logarithms of the scales (n,) vec3 and quaternions (n,) vec4 at rest."""
        if not self._shapes:
            held = self._field.contents
            self._shapes = [
                wp.array(
                    np.asarray(getattr(held, name), np.float32), dtype=VALUE_TYPES[name], device=self._field.device
                )
                for name in ("log_scales", "quaternions")
            ]
        return self._shapes


def splat_gradient(
    deformer: Deformer[SplatField], camera: Camera, loss: dict[str, wp.array], background: Any, **wanted: bool
) -> FrameGradient:
    """See `frame_gradient`; loss: of `frame_loss`."""
    found = views_gradient(deformer, [camera], loss, background, **wanted)
    edits: Any = deformer.posed_edits()
    edits.backward.spare.keep(sum(part.capacity for part in vars(found).values() if isinstance(part, wp.array)))
    return found


def views_gradient(
    deformer: Deformer[SplatField],
    cameras: Sequence[Camera],
    loss: dict[str, wp.array],
    background: Any,
    *,
    by_vertices: bool = False,
    by_camera: bool = False,
    by_field: bool = False,
) -> FrameGradient:
    """The sum of the gradients of frames of one size; loss: (views * h * w,) by their parts, view after view.
    `by_camera` is for one. See `frame_gradient`."""
    field, device = deformer.field, deformer.device
    edits: Any = deformer.posed_edits()
    assert isinstance(edits, SplatEdits) and deformer.deformed is not None
    _require_one_way(deformer, edits)
    cage: Any = deformer._backend.surface(deformer.deformed[0])
    at_rest = edits.posed is field.splats
    if at_rest:  # whose frame is the field's own: the same splats, in pieces and shares
        edits.carry([cage])
    try:
        splats = edits.posed
        if by_field and edits.is_split:
            raise InputError(
                "by_field is of splats that a pose draws whole, some are drawn in pieces here: give a field of smaller "
                "splats, or a pose that bends them less"
            )
        if edits.backward is None:
            edits.backward = SplatBackward(field)
        backward: SplatBackward = edits.backward
        renderer = backward.renderer
        color = RenderOptions(background=background).color(np.asarray(field.background, np.float32))
        count, pixels = splats.centers.size, cameras[0].width * cameras[0].height
        carried = CarriedSlopes()
        carried.positions = wp.zeros(count, dtype=wp.vec3, device=device)
        carried.jacobians = wp.zeros(count, dtype=wp.mat33, device=device)
        rays = wp.zeros((count if by_camera else 0, int(CAMERA_NUMBERS)), dtype=wp.float32, device=device)
        slopes = value_slopes(field) if by_field else {}
        none = [empty_array(0, VALUE_TYPES[name], device) for name in ("log_scales", "quaternions")]
        shapes, by_values = (backward.shapes if by_field else none), as_values(slopes)
        threads = 1 if by_field else None  # rows of the file are shared
        for number, camera in enumerate(cameras):
            seen: dict[str, Any] = {
                name: array[number * pixels : (number + 1) * pixels] for name, array in loss.items()
            }
            lens = splat_lens(camera, field.center, field.near, IMAGE_BLUR, field.antialias)
            drawn = renderer.draw_splats(splats, camera, lens, wp.vec3(*map(float, color)), "depth" in loss)
            sums = _picture_sums(renderer, seen, *drawn)
            inputs = [edits.law, splats, lens, renderer.view, *sums, edits.covariances, edits.opacities, edits.carried]
            outputs = [carried, rays, by_values]
            launch(
                propagate_pose,
                count,
                [*inputs, *shapes],
                outputs,
                device=device,
                threads=threads,
                work=4 * PROJECT_WORK,
            )
        found: dict[str, Any] = {}
        if by_vertices:
            bound = edits.bound[0]
            members, others, _, offsets = bound.carriers
            found["vertices"] = bound.binding.vertex_gradient(cage, members, others, offsets, carried)
        if by_camera:
            found["camera"] = column_sums(rays)
        if by_field:
            found |= slopes | {"logits": slopes["logits"].flatten()}
        return FrameGradient(**found)
    finally:
        if at_rest:
            edits.posed = field.splats


def _require_one_way(deformer: Deformer[SplatField], edits: SplatEdits) -> None:
    """Refuse edits that no gradient is of."""
    if len(deformer.edits) != 1 or deformer.edits[0].remove or deformer.edits[0].falloff:
        raise InputError("a frame's gradient is of one edit that moves or copies, without falloff and fragments")
    if any(each is not None for each in edits.maps):
        raise InputError('a frame\'s gradient is of splats that move forward: leave map="backward" out')


def _picture_sums(
    renderer: SplatGradients, loss: dict[str, wp.array], rgb: wp.array, alpha: wp.array, depth: wp.array
) -> tuple[wp.array, wp.array]:
    """Sums of the splats drawn last, (9 n,), and (3 n,) by depths or (0,)."""
    device, none = renderer.device, empty_array(0, wp.float32, renderer.device)
    by_rgb = loss.get("rgb")
    if by_rgb is None:
        by_rgb = wp.zeros(rgb.size, dtype=wp.vec3, device=device)
    if not {"alpha", "depth"} & loss.keys():
        return renderer.sum_slopes(by_rgb), none
    others = empty_array(rgb.size, wp.vec3, device)
    inputs = [loss.get("alpha", none), loss.get("depth", none), alpha, depth]
    launch(weigh_pixels, rgb.size, inputs, [others], device=device)
    return renderer.sum_depth_slopes(by_rgb, others)
