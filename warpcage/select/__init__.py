"""Parts of a field: nodes by space and pictures, objects by a click, planes, and what is cleaned away."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "clean": "CleanOptions Cleaned clean_voxels",
        "objects": "pick_point",
        "planes": "Plane blocks find_planes fit_planes surface_points surrounds",
        "selection": "some_visible_nodes visible_nodes",
    },
)
