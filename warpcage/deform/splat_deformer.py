"""`SplatDeformer`, the name of a Deformer of splats up to version 0.2."""

from __future__ import annotations

from typing import Any

from ..core.checks import require_type, warn_renamed
from ..splats.splat_field import SplatField
from .deformer import Deformer
from .poses import RestLike


class _DeformersOfSplats(type):
    """Lets `isinstance` find a Deformer of splats by the old name."""

    def __instancecheck__(cls, instance: Any) -> bool:
        if cls is not SplatDeformer:
            return super().__instancecheck__(instance)
        warn_renamed("SplatDeformer", "Deformer")
        return isinstance(instance, Deformer) and isinstance(instance.field, SplatField)


class SplatDeformer(Deformer[SplatField], metaclass=_DeformersOfSplats):
    """The old name of `Deformer(splat_field, rest)`, for one version.

    Args:
        field: The splats.
        rest: As for `Deformer`.
        options: As for `Deformer`.

    Raises:
        ValueError: As `Deformer`, and for another kind of field.
        Cancelled: Where `progress` returned False.

    Attributes:
        field: The SplatField, on the device.
        edits: The CageEdits in their order.
        deformed: The posed cages, one per edit, None for an edit that removes; None before the first pose.
    """

    def __init__(self, field: SplatField, rest: RestLike, **options: Any):
        warn_renamed("SplatDeformer", "Deformer")
        require_type(field, SplatField, "a SplatDeformer needs")
        super().__init__(field, rest, **options)
