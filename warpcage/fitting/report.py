"""What an evaluation found, as files keep it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from ..field.voxel_field import VoxelField
from ..scene.scene import Scene
from .evaluation import SSIM_WINDOW, evaluate, mean_psnr


@dataclasses.dataclass(frozen=True)
class Report:
    """The figures of every view, and their means."""

    # as `evaluate` returns them, at least one
    rows: list[dict[str, Any]]

    @property
    def mean_psnr(self) -> float:
        """Mean PSNR, dB."""
        return mean_psnr(self.rows)

    @property
    def mean_ssim(self) -> float | None:
        """Mean structural similarity; None where it was not measured."""
        return self._mean("ssim")

    @property
    def mean_masked_psnr(self) -> float | None:
        """Mean PSNR over the pixels of the object, dB; None where no view has any."""
        return self._mean("masked_psnr")

    @property
    def worst(self) -> int:
        """Number of the view with the lowest PSNR."""
        return min(range(len(self.rows)), key=lambda index: self.rows[index]["psnr"])

    def to_json(self) -> dict[str, Any]:
        """The figures as JSON takes them: None for the infinite PSNR of equal pictures."""
        return {
            "mean_psnr": finite(self.mean_psnr),
            "mean_ssim": self.mean_ssim,
            "mean_masked_psnr": finite(self.mean_masked_psnr),
            "worst_view": self.rows[self.worst]["view"],
            "views": [
                {name: finite(value) if name.endswith("psnr") else value for name, value in row.items()}
                for row in self.rows
            ],
        }

    def _mean(self, name: str) -> float | None:
        values = [row[name] for row in self.rows if name in row]
        return sum(values) / len(values) if values else None


def evaluation_report(field: VoxelField, scene: Scene, *, progress: bool = False) -> Report:
    """Compare a field with the pictures of a scene; the structural similarity too where they are large enough."""
    return Report(evaluate(field, scene, similarity=min(scene.images.shape[1:3]) >= SSIM_WINDOW, progress=progress))


def finite(decibels: float | None) -> float | None:
    """A PSNR or None as JSON has it: None for infinity."""
    return decibels if decibels is not None and decibels < math.inf else None
