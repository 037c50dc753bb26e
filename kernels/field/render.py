"""Names of field/march that kernels for the CPU import from here."""

from .march import PENDING_WEIGHT, Radiance, pending_colour, visible_depth

__all__ = ["PENDING_WEIGHT", "Radiance", "pending_colour", "visible_depth"]
