"""Coordinates of points in a cage, and points moved by them."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "coordinates": "stretched_normals",
        "harmonic": "harmonic_weights",
        "reference_mvc": "host_mean_value_weights mean_value_gradients",
        "vjp": "coordinates_vjp deform_points_vjp",
    },
)
