"""Functions of the package that gradients of JAX pass through, under `jax.jit`, by calls of Warp from XLA."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {"coordinates": "deform_points green_coordinates mean_value_coordinates", "posed": "render to_canonical"},
    extra="jax",
)
