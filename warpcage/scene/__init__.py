"""Posed pictures, and how they are loaded."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "box": "FoundBox Look are_inliers find_box",
        "box_picture": "draw_box",
        "camera_check": "agreement_of ahead_share camera_doubt held_groups rays_meet",
        "coverage": "Coverage draw_coverage find_coverage",
        "parsing": "held_out",
        "formats.table": "SceneFormat scene_formats",
        "pictures": "COEFFICIENTS distort make_scene undistort undistorted_intrinsics",
        "sizes": "View",
    },
)
