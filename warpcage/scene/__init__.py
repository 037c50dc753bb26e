"""Posed pictures, and how they are loaded."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "agreement": "agreement_of ahead_share held_groups rays_meet",
        "box": "FoundBox Look are_inliers find_box",
        "box_picture": "draw_box",
        "camera_check": "camera_doubt",
        "coverage": "Coverage draw_coverage find_coverage",
        "formats.parsing": "held_out",
        "formats.table": "SceneFormat scene_formats",
        "pictures": "COEFFICIENTS View distort make_scene undistort undistorted_intrinsics",
    },
)
