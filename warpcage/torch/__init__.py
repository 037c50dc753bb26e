"""Functions of the package that gradients of torch pass through, as operators that `torch.compile` knows."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {"coordinates": "deform_points green_coordinates mean_value_coordinates", "posed": "render to_canonical"},
    extra="torch",
)
