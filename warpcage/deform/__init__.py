"""Deformed fields: the Deformer, baking, and stages of several objects."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "fill": "membrane",
        "splat_baking": "quaternions_of",
        "splat_instances": "BOUND FOLLOWED LEFT make_instances shared_ways",
    },
)
