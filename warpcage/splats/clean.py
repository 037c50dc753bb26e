"""Splats without those that are invisible, detached, too large, or shown by too few views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from ..core.names import counted
from ..core.threads import device_turn
from ..field.io.field_file import Y0
from ..select.clean import Cleaned, CleanOptions, detached_nodes, require_left, small_cameras, unshown, went
from ..select.selection import visible_mask
from ..view.camera import Camera
from .fit import SplatGradients, SplatParameters
from .io.contents import MIN_OPACITY
from .matter import RESOLUTION
from .render import IMAGE_BLUR, splat_lens
from .splat_field import SplatField

#: How much of what is around most of a place is looked at for floaters, on each side, as a share of it.
AROUND = 0.5


def clean_splats(field: SplatField, options: CleanOptions, largest_scale: float | None = None) -> Cleaned:
    """A field of splats cleaned by the options; refused where no visible splat would be left.
    largest_scale: splats with a larger standard deviation are removed too, world units; None for none."""
    seen = field.opacities >= MIN_OPACITY
    kinds: list[tuple[np.ndarray, str]] = [(~seen, "fainter than 1/255")]
    if largest_scale is not None:
        large = field.scales.max(axis=1) > largest_scale
        kinds.append((large, f"longer than {largest_scale:g}"))
    loose, count = loose_splats(field, options)
    kinds.append((loose, f"in {counted(count, 'detached part')}"))
    if options.cameras is not None:
        views = views_of_splats(field, options.cameras, options.least_weight)
        kinds.append((views < options.least_views, unshown(options)))
    gone, notes = np.zeros(len(field), bool), []
    for rows, where in kinds:
        rows = rows & ~gone
        gone |= rows
        if rows.any():
            notes.append(went(int(rows.sum()), len(field), "splat", where))
    require_left(seen & ~gone)
    return Cleaned(field.chosen(~gone), gone, tuple(notes))


def loose_splats(field: SplatField, options: CleanOptions) -> tuple[np.ndarray, int]:
    """The splats (n,) bool of small connected parts of the matter away from the others, and how many such parts."""
    from scipy.ndimage import binary_dilation

    shown = field.shown_bounds
    side = (shown[1] - shown[0]).max()
    cell = max(side / RESOLUTION, field.finest_cell(field.bounds))
    reach = AROUND * side
    box = np.stack([np.maximum(shown[0] - reach, field.bounds[0]), np.minimum(shown[1] + reach, field.bounds[1])])
    matter = field.matter(box, max(2, round(float((box[1] - box[0]).max()) / cell)))
    mask = visible_mask(matter)
    nodes, count = detached_nodes(mask, options)
    if not count:
        return np.zeros(len(field), bool), 0
    around = np.asarray(binary_dilation(nodes, np.ones((3, 3, 3), bool)), bool) & ~(mask & ~nodes)
    return matter.splats_in(around), count


def views_of_splats(field: SplatField, cameras: Sequence[Camera], least: float) -> np.ndarray:
    """(n,) number of views in which a splat's rendering weights add up to `least` pixels."""
    # The slope of all pixels' sum by a grey splat's first harmonic is Y_0 times its weights.
    held = field.contents
    values = (held.centers, held.log_scales, held.quaternions, held.logits)
    grey = SplatField(*values, np.zeros((len(field), 1, 3), np.float32), device=field.device)
    views = np.zeros(len(field), np.int64)
    parameters, gradients = SplatParameters(grey), SplatGradients(field.device)
    with device_turn(field.device):
        parameters.refresh()
        for camera in small_cameras(cameras):
            lens = splat_lens(camera, grey.center, grey.near, IMAGE_BLUR, field.antialias)
            gradients.draw(parameters, camera, lens, wp.vec3(0.0, 0.0, 0.0))
            ones = wp.full(camera.width * camera.height, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=field.device)
            gradients.take_back(ones)
            views += parameters.slopes["harmonics"].numpy()[:, 0] / Y0 >= least
    return views
