"""From a phone's pictures or video to a scene: frames are picked, cameras found, pictures undistorted, all reported."""

from ...package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "feature_masks": "still_features",
        "colmap": "Solver expected_seconds time_line",
        "solving": "doubts solve",
        "video": "FrameScores motion pick_frames scan_video sharpness write_frames",
    },
)
