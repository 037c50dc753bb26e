"""What warpcage.torch and warpcage.jax share: objects by numbers, poses, and the backward passes of a Deformer."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "numbers": "number_of object_of weight_counts",
        "posed": "FrameOptions canonical_points_vjp posed_as posed_frame posed_frame_vjp posed_vertices",
    },
)
