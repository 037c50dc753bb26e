"""Posed pictures, and how they are loaded."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {"box": "are_inliers bulk_box view_box", "pictures": "COEFFICIENTS distort undistort undistorted_intrinsics"},
)
