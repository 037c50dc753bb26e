"""Gradient of a frame of posed splats by the posed cage, by the camera, and by the splats at rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import empty_array, struct_array
from ..core.devices import SpareMemory, launch
from ..deform.deformer import Deformer
from ..deform.splat_edits import SplatEdits
from ..errors import InputError
from ..field.render import RenderOptions, picture_arrays
from ..kernels.fitting.cameras import CAMERA_NUMBERS
from ..kernels.gradients.splat_pose import CarriedSlopes, propagate_pose, weigh_pixels
from ..kernels.splats.project import Lens
from ..splats.fit import VALUE_TYPES, SplatGradients, as_values, value_slopes
from ..splats.render import IMAGE_BLUR, PROJECT_WORK, splat_lens
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import PART_NAMES
from .loss import FrameGradient, column_sums

#: Splats of all views that are drawn at once, of which each takes some 150 bytes, and 60 for each tile that it touches.
MAX_DRAWN = 1 << 22


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


class SplatViews:
    """Frames of a Deformer's last pose of splats by cameras of one size, all drawn at once, of which gradients can be
    taken until it has another pose. Needs its lock."""

    def __init__(
        self, deformer: Deformer[SplatField], cameras: Sequence[Camera], background: Any, *, with_depth: bool = True
    ):
        field, edits = deformer.field, deformer.posed_edits()
        assert isinstance(edits, SplatEdits) and deformer.deformed is not None
        _require_one_way(deformer, edits)
        self._field, self._device, self._with_depth = field, deformer.device, with_depth
        self._edits: Any = edits
        self._cage: Any = deformer._backend.surface(deformer.deformed[0])
        at_rest = edits.posed is field.splats
        if at_rest:  # whose frame is the field's own: the same splats, in pieces and shares
            edits.carry([self._cage])
        self._splats = edits.posed
        if at_rest:
            edits.posed = field.splats
        if edits.backward is None:
            edits.backward = SplatBackward(field)
        self._backward: SplatBackward = edits.backward
        color = RenderOptions(background=background).color(np.asarray(field.background, np.float32))
        self._color = wp.vec3(*map(float, color))
        lenses = [splat_lens(camera, field.center, field.near, IMAGE_BLUR, field.antialias) for camera in cameras]
        self._lenses = struct_array(lenses, Lens, self._device)
        self._size = cameras[0].width, cameras[0].height
        self._pixels = cameras[0].width * cameras[0].height
        names = PART_NAMES if with_depth else PART_NAMES[:2]
        #: by names of their parts, (views * h * w,), view after view
        self.frames: dict[str, wp.array] = picture_arrays(len(cameras) * self._pixels, names, self._device)
        self._draw_all()

    def _draw_all(self) -> None:
        """Set `frames`, and the `_parts` of the views that are drawn at once."""
        most = max(MAX_DRAWN // max(self._splats.centers.size, 1), 1)
        self._parts: list[tuple[int, int]] = []
        begin = 0
        while begin < self._lenses.size:
            end = min(begin + most, self._lenses.size)
            drawn = self._draw(begin, end)
            if drawn is None:
                most = (end - begin) // 2
                continue
            for name, part in zip(PART_NAMES, drawn, strict=True):
                if name in self.frames:
                    wp.copy(self.frames[name], part, dest_offset=begin * self._pixels)
            self._parts.append((begin, end))
            begin = end

    def _draw(self, begin: int, end: int) -> Any:
        """Draw the views from `begin` to `end`; None where these are too many."""
        renderer, lenses = self._backward.renderer, self._lenses[begin:end]
        found = renderer.draw_splats(self._splats, self._size, lenses, self._color, self._with_depth)
        self._last = renderer.drawn
        return found

    def gradient(
        self, loss: dict[str, wp.array], *, by_vertices: bool = False, by_camera: bool = False, by_field: bool = False
    ) -> FrameGradient:
        """The sum of the gradients of the frames; loss: slopes by their parts, (views * h * w,). `by_camera` is for
        one. See `frame_gradient`."""
        field, edits, device, splats = self._field, self._edits, self._device, self._splats
        if by_field and edits.is_split:
            raise InputError(
                "by_field is of splats that a pose draws whole, some are drawn in pieces here: give a field of smaller "
                "splats, or a pose that bends them less"
            )
        backward, renderer, count = self._backward, self._backward.renderer, splats.centers.size
        carried = CarriedSlopes()
        carried.positions = wp.zeros(count, dtype=wp.vec3, device=device)
        carried.jacobians = wp.zeros(count, dtype=wp.mat33, device=device)
        rays = wp.zeros((count if by_camera else 0, int(CAMERA_NUMBERS)), dtype=wp.float32, device=device)
        slopes = value_slopes(field) if by_field else {}
        none = [empty_array(0, VALUE_TYPES[name], device) for name in ("log_scales", "quaternions")]
        shapes, by_values = (backward.shapes if by_field else none), as_values(slopes)
        threads = 1 if by_field else None  # rows of the file are shared
        for begin, end in self._parts:
            if len(self._parts) > 1 or renderer.drawn is not self._last:
                self._draw(begin, end)
            seen, frames = (
                {name: array[begin * self._pixels : end * self._pixels] for name, array in each.items()}
                for each in (loss, self.frames)
            )
            lenses, sums = self._lenses[begin:end], _picture_sums(renderer, seen, frames)
            rest = [edits.covariances, edits.opacities, edits.carried]
            inputs = [edits.law, splats, lenses, renderer.view, *sums, *rest, *shapes]
            work = 4 * PROJECT_WORK * (end - begin)
            outputs = [carried, rays, by_values]
            launch(propagate_pose, count, inputs, outputs, device=device, threads=threads, work=work)
        found: dict[str, Any] = {}
        if by_vertices:
            bound = edits.bound[0]
            members, others, _, offsets = bound.carriers
            found["vertices"] = bound.binding.vertex_gradient(self._cage, members, others, offsets, carried)
        if by_camera:
            found["camera"] = column_sums(rays)
        if by_field:
            found |= slopes | {"logits": slopes["logits"].flatten()}
        return FrameGradient(**found)


def splat_gradient(
    deformer: Deformer[SplatField], camera: Camera, loss: dict[str, wp.array], background: Any, **wanted: bool
) -> FrameGradient:
    """See `frame_gradient`; loss: of `frame_loss`."""
    found = SplatViews(deformer, [camera], background, with_depth="depth" in loss).gradient(loss, **wanted)
    edits: Any = deformer.posed_edits()
    edits.backward.spare.keep(sum(part.capacity for part in vars(found).values() if isinstance(part, wp.array)))
    return found


def _require_one_way(deformer: Deformer[SplatField], edits: SplatEdits) -> None:
    """Refuse edits that no gradient is of."""
    if len(deformer.edits) != 1 or deformer.edits[0].remove or deformer.edits[0].falloff:
        raise InputError("a frame's gradient is of one edit that moves or copies, without falloff and fragments")
    if any(each is not None for each in edits.maps):
        raise InputError('a frame\'s gradient is of splats that move forward: leave map="backward" out')


def _picture_sums(renderer: SplatGradients, loss: dict[str, Any], frames: dict[str, Any]) -> tuple[wp.array, wp.array]:
    """Sums of the splats drawn last, (9 n,), and (3 n,) by depths or (0,)."""
    device, none, count = renderer.device, empty_array(0, wp.float32, renderer.device), frames["alpha"].size
    by_rgb = loss.get("rgb")
    if by_rgb is None:
        by_rgb = wp.zeros(count, dtype=wp.vec3, device=device)
    if not {"alpha", "depth"} & loss.keys():
        return renderer.sum_slopes(by_rgb), none
    others = empty_array(count, wp.vec3, device)
    inputs = [loss.get("alpha", none), loss.get("depth", none), frames["alpha"], frames.get("depth", none)]
    launch(weigh_pixels, count, inputs, [others], device=device)
    return renderer.sum_depth_slopes(by_rgb, others)
