"""Loss of a drawn picture beside the true one, its slopes by the drawn colors, and exposures of pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ...core.arrays import empty_array
from ...core.devices import launch, module_block_dim
from ...core.modules import require_loaded
from ...errors import InputError
from ...kernels.fitting import splat_loss, splat_step

#: Share of the structural similarity in the loss (Kerbl et al. 2023).
SSIM_SHARE = 0.2

#: Windows or pixels of a block's tile on CUDA.
TILE_ITEMS = int(splat_loss.TILE) ** 2

#: Partial sums of the slopes by a picture's exposure, those that they are joined to, and what a partial sum costs.
EXPOSURE_LANES, EXPOSURE_ROWS, LANE_WORK = 8192, 64, 400


class PictureLoss:
    """Slopes of (1 - share) mean |drawn - truth| + share (1 - mean SSIM) of pictures of one size, on their device.
    Windows of SSIM lie wholly in the picture; where there are none, |drawn - truth| counts alone."""

    # Each call launches kernels alone: it may stand in a graph, and what it returns is what the next one overwrites.

    def __init__(
        self,
        width: int,
        height: int,
        device: wp.DeviceLike,
        ssim_share: float = SSIM_SHARE,
        *,
        tiled: bool = True,  # on CUDA: whether blocks sum in shared memory, as they do fastest
    ):
        self.device = wp.get_device(device)
        self._tiled = tiled and self.device.is_cuda
        rows, columns = height - int(splat_loss.OVERLAP), width - int(splat_loss.OVERLAP)
        if min(rows, columns) < 1 or ssim_share == 0.0:
            rows, columns, ssim_share = 0, 0, 0.0
        self._pixels, self._windows = height * width, rows * columns
        self._loss = splat_loss.LossTerms()
        self._loss.height, self._loss.width = height, width
        self._loss.rows, self._loss.columns = rows, columns
        self._loss.by_color = (1.0 - ssim_share) / (3 * self._pixels)
        self._loss.by_similarity = -ssim_share / (3 * max(self._windows, 1))

        self._slopes = empty_array(self._pixels, wp.vec3, self.device)
        self.errors = empty_array(self._pixels, wp.float32, self.device)  # (h * w,) mean of (drawn - truth)^2
        self._ones = empty_array(0, wp.float32, self.device)
        self._window_slopes = empty_array(self._windows, splat_loss.vec9, self.device)
        kept = 0 if self._tiled else 1
        self._row_sums = empty_array(kept * height * columns, splat_loss.vec16, self.device)
        self._slope_sums = empty_array(kept * rows * width, splat_loss.vec9, self.device)
        require_loaded(splat_loss.find_slopes, self.device, module_block_dim(splat_loss.find_slopes))

    def slopes(self, drawn: wp.array, truth: wp.array, weights: wp.array | None = None) -> wp.array:
        """Slopes (h * w,) vec3 by `drawn`, valid until the next call, with the `errors`; drawn, truth: (h * w,) vec3.
        weights: (h * w,) float32, a pixel's share; a window's is the least of its pixels. The means stay over all."""
        weights = self._ones if weights is None else weights
        for name, array in (("drawn", drawn), ("truth", truth), ("weights", weights)):
            if len(array) != self._pixels and array is not self._ones:
                raise InputError(f"{name} must have {self._pixels} pixels, got {len(array)}")
        pictures, found = [self._loss, drawn, truth, weights], [self._slopes, self.errors]
        if self._tiled and self._windows:
            count = _tile_items(self._loss.rows, self._loss.columns)
            launch(splat_loss.find_window_slopes_of_tiles, count, pictures, [self._window_slopes], device=self.device)
            count, inputs = _tile_items(self._loss.height, self._loss.width), [*pictures, self._window_slopes]
            launch(splat_loss.find_slopes_of_tiles, count, inputs, found, device=self.device)
            return self._slopes
        launch(splat_loss.sum_rows, len(self._row_sums), pictures, [self._row_sums], device=self.device)
        inputs = [self._loss, self._row_sums]
        launch(splat_loss.find_window_slopes, self._windows, inputs, [self._window_slopes], device=self.device)
        inputs = [self._loss, self._window_slopes]
        launch(splat_loss.sum_window_rows, len(self._slope_sums), inputs, [self._slope_sums], device=self.device)
        launch(splat_loss.find_slopes, self._pixels, [*pictures, self._slope_sums], found, device=self.device)
        return self._slopes


def _tile_items(rows: int, columns: int) -> int:
    """Threads of all tiles over so many items."""
    side = int(splat_loss.TILE)
    return -(-rows // side) * -(-columns // side) * TILE_ITEMS


class PictureExposures:
    """Gains and offsets of pictures, and how they are learnt; of no picture where exposures are not."""

    def __init__(self, count: int, device: wp.Device):
        self.count, self.device = count, device
        self.rows: Any = splat_step.Exposures()
        for name in ("values", "means", "squares"):
            setattr(self.rows, name, wp.zeros((count, 2), dtype=wp.vec3, device=device))
        self.rows.steps = wp.zeros(count, dtype=wp.int32, device=device)
        lanes, rows = (EXPOSURE_LANES, EXPOSURE_ROWS) if count else (0, 0)
        self._sums, self._joined = (empty_array((number, 2), wp.vec3, device) for number in (lanes, rows))

    def take_back(self, step: wp.array, missed: wp.array, alpha: wp.array, drawn: wp.array, slopes: wp.array) -> None:
        """Make slopes (h * w,) by the picture as it is exposed those by the drawn one, and step its exposure."""
        device, (lanes, rows) = self.device, (len(self._sums), len(self._joined))
        inputs = [lanes, step, self.rows, alpha, drawn]
        launch(splat_step.sum_exposure_slopes, lanes, inputs, [slopes, self._sums], device=device, work=LANE_WORK)
        launch(splat_step.join_sums, rows, [self._sums], [self._joined], device=device)
        launch(splat_step.step_exposure, min(1, rows), [step, missed, self._joined], [self.rows], device=device)

    def center(self) -> None:
        """Leave to the splats what all pictures share."""
        launch(splat_step.center_exposures, 2 * min(1, self.count), [], [self.rows], device=self.device)

    def state(self) -> np.ndarray:
        """(n, 19) float64 values, means, squares, and steps."""
        parts = [getattr(self.rows, name).numpy().reshape(-1, 6) for name in ("values", "means", "squares")]
        return np.concatenate([*parts, self.rows.steps.numpy()[:, None]], axis=1, dtype=np.float64)

    def restore(self, state: np.ndarray) -> None:
        """Go on with what `state` gave."""
        for index, name in enumerate(("values", "means", "squares")):
            part = np.ascontiguousarray(state[:, 6 * index : 6 * index + 6], np.float32).reshape(-1, 2, 3)
            setattr(self.rows, name, wp.array(part, dtype=wp.vec3, device=self.device))
        self.rows.steps = wp.array(state[:, 18].astype(np.int32), dtype=wp.int32, device=self.device)
