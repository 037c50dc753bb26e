"""Cameras, frames, pictures and overlays."""

from ..package import lazy_exports

_HOMES = {
    "alignment": "Similarity aligning_similarity moved_along picture_shifts picture_similarity pose_errors",
    "camera": "camera_array camera_struct framing_orbit",
    "camera_path": "timed_keys",
    "exr": "linear_light mean_picture read_exr write_exr write_picture",
    "frame": "RGB_BYTES average_frame depth_along_view finer_camera",
    "frame_parts": "mask_picture mask_shares rgba_picture",
    "motion": "axis_rotation eased_share frame_rate frame_times limited_velocity value_along value_at",
    "overlay": "draw_cage",
    "pictures": (
        "color_disparity contact_sheet disparity_range image_size read_image read_rows shrink "
        "side_by_side to_uint8 write_jpeg write_png"
    ),
}

#: Names of `warpcage.studio.films` that were here up to version 0.2, by old names of its modules.
_MOVED = {
    "film": "deep_pixels read_film_frame with_spread_colors write_film write_film_frame write_gif write_video",
    "film_motion": "cameras_along frame_places path_cameras pose_along pose_weights",
    "moves": "CameraMove MovingCamera camera_moves",
}

_, __dir__, __all__ = lazy_exports(__name__, _HOMES)

__getattr__ = lazy_exports(__name__, _HOMES | _MOVED)[0]
